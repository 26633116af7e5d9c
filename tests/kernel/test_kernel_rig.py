"""Boots a real Linux kernel and runs the tests of `guest/` in it (rig of level 4, see docs/testing.md).

Skips with a reason where QEMU or Debian's package index is missing; with CI=true that counts as a failure.
"""

import ast
import compileall
import contextlib
import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import pytest

from firmware import avr_build
from kernel.image import RigMissingError, kernel_image
from kernel.machine import FIRST, run_in_guest

REPO = Path(__file__).parents[2]
GUEST = Path(__file__).parent / "guest"
PYTEST = (
    *("-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:hypothesispytest"),
    *("--color=no", "-v", "-rA", "--durations=0", "-o", "junit_family=legacy"),
    "--assert=plain",  # to rewrite asserts takes the guest seconds
)
GUEST_TIME_S = 1200
"""An idle host needs a quarter of it; a busy one shall not fail for that."""
FIRMWARE_END_S = 20


def test_the_guests_tests_pass_in_a_real_kernel(tmp_path: Path) -> None:
    try:
        image = kernel_image()
    except RigMissingError as missing:
        pytest.skip(f"kernel rig: {missing}")
    for folder in (REPO / "src", REPO / "tests" / "fakes", REPO / "tests" / "kernel"):
        compileall.compile_dir(folder, quiet=1)  # the guest would take seconds for it, each time
    files = sorted(str(path) for path in GUEST.glob("guest_*.py"))
    no_firmware = avr_build.missing()
    share = tmp_path / "share"
    share.mkdir()
    cable: contextlib.AbstractContextManager[list[str]] = firmware(tmp_path)
    if no_firmware:
        cable = contextlib.nullcontext([])
    with cable as board:
        run = run_in_guest(
            image,
            share,
            [sys.executable, "-m", "pytest", *PYTEST, "--junitxml=/guest/junit.xml", *files],
            environment={
                "PYTHONPATH": f"{REPO / 'src'}:{REPO / 'tests'}",
                "CI": os.environ.get("CI", ""),
                "ADIS_GONIO_NO_FIRMWARE": no_firmware,
            },
            work_folder=REPO,
            open_to_all=[Path(sys.prefix), Path(sys.base_prefix), REPO / "src", REPO / "tests"],
            job_time_s=GUEST_TIME_S,
            qemu_options=board,
        )
    sys.stdout.write(f"{run.console}\nkernel {image.release}: {run.elapsed_s:.0f} s\n")
    report = share / "junit.xml"
    assert report.exists(), (
        f"the guest's tests did not end within {GUEST_TIME_S} s ({run.status}), see above"
    )
    outcome = outcomes(report)
    assert {name for name, result in outcome.items() if result in ("failure", "error")} == set()
    assert {name.partition("[")[0] for name in outcome} == written_tests()
    assert run.status == 0
    skipped = sorted(name for name, result in outcome.items() if result == "skipped")
    if skipped:
        pytest.skip(f"skipped in the guest: {', '.join(skipped)}")


@contextlib.contextmanager
def firmware(folder: Path) -> Iterator[list[str]]:
    """The firmware in its emulator beside the guest; gives QEMU's options for the cable between them.

    At its end the firmware's frames are judged: one that broke a limit of the chip fails the test.
    """
    elf = avr_build.elf(folder)
    # A socket's path has 108 bytes at most, which pytest's folders may exceed.
    with tempfile.TemporaryDirectory(prefix="gonio-") as short:
        place = Path(short) / "line"
        process = subprocess.Popen(
            [*FIRST, sys.executable, "-m", "kernel.firmware_process", str(elf), str(place)],
            env={**os.environ, "PYTHONPATH": f"{REPO / 'src'}:{REPO / 'tests'}"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            while line.startswith("nice:"):  # not permitted
                line = process.stdout.readline()
            assert line == "listening\n"
            yield [
                *("-device", "qemu-xhci", "-chardev", f"socket,id=line,path={place}"),
                *("-device", "usb-serial,chardev=line,serial=FW1"),
            ]
            said, _ = process.communicate(timeout=FIRMWARE_END_S)
            sys.stdout.write(said)
            assert process.returncode == 0, "the firmware's frames broke a limit of the chip, see above"
        finally:
            process.kill()
            process.wait(60)
            process.stdout.close()


def outcomes(junit: Path) -> dict[str, str]:
    """What became of each test, by name with parameters."""
    verdicts = ("failure", "error", "skipped")
    return {
        case.attrib["name"]: next((child.tag for child in case if child.tag in verdicts), "passed")
        for case in ET.parse(junit).getroot().iter("testcase")
    }


def written_tests() -> set[str]:
    """Names of the test functions in the guest's files: each must have run."""
    return {
        item.name
        for path in GUEST.glob("guest_*.py")
        for item in ast.parse(path.read_text()).body
        if isinstance(item, ast.FunctionDef) and item.name.startswith("test_")
    }
