"""Boots a real Linux kernel and runs the tests of `guest/` in it (rig of level 4, see docs/testing.md).

Skips with a reason where QEMU or Debian's package index is missing; with CI=true that counts as a failure.
"""

import ast
import compileall
import os
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from kernel.image import RigMissingError, kernel_image
from kernel.machine import run_in_guest

REPO = Path(__file__).parents[2]
GUEST = Path(__file__).parent / "guest"
PYTEST = (
    "-p",
    "no:cacheprovider",
    "-p",
    "no:xdist",
    "-p",
    "no:hypothesispytest",
    "--color=no",
    "-q",
    "-rA",
    "--durations=0",
)


def test_the_guests_tests_pass_in_a_real_kernel(tmp_path: Path) -> None:
    try:
        image = kernel_image()
    except RigMissingError as missing:
        pytest.skip(f"kernel rig: {missing}")
    for folder in (REPO / "src", REPO / "tests" / "fakes", REPO / "tests" / "kernel"):
        compileall.compile_dir(folder, quiet=1)  # the guest would take seconds for it, each time
    files = sorted(str(path) for path in GUEST.glob("guest_*.py"))
    job = [sys.executable, "-m", "pytest", *PYTEST, "--junitxml=/guest/junit.xml", *files]
    environment = {"PYTHONPATH": f"{REPO / 'src'}:{REPO / 'tests'}", "CI": os.environ.get("CI", "")}
    run = run_in_guest(
        image,
        tmp_path,
        job,
        environment=environment,
        work_folder=REPO,
        open_to_all=[Path(sys.prefix), Path(sys.base_prefix), REPO / "src"],
    )
    sys.stdout.write(f"{run.console}\nkernel {image.release}: {run.elapsed_s:.0f} s\n")
    assert run.status == 0, (
        f"the guest ended with {run.status} after {run.elapsed_s:.0f} s; its console is above"
    )
    outcome = outcomes(tmp_path / "junit.xml")
    assert {name for name, result in outcome.items() if result in ("failure", "error")} == set()
    assert {name.partition("[")[0] for name in outcome} == written_tests()
    skipped = sorted(name for name, result in outcome.items() if result == "skipped")
    if skipped:
        pytest.skip(f"skipped in the guest: {', '.join(skipped)}")


def outcomes(junit: Path) -> dict[str, str]:
    """What became of each test, by name with parameters."""
    return {
        case.attrib["name"]: next((child.tag for child in case if child.tag != "system-out"), "passed")
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
