"""The example package, from wheels, in a process of its own: as somebody else's CI would run it."""

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "own_bus"


def run(*command: str, cwd: Path, **environment: str) -> str:
    """Standard output of a program that knows nothing of this repository's own path."""
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        command, cwd=cwd, env=inherited | environment, capture_output=True, text=True, timeout=1800,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with both wheels installed, built offline with what is installed here."""
    folder = tmp_path_factory.mktemp("wheels")
    offline = ("--no-deps", "--no-index", "--disable-pip-version-check", "-q")
    pip = (sys.executable, "-m", "pip")
    run(
        *pip,
        "wheel",
        *offline,
        "--no-build-isolation",
        str(ROOT),
        str(EXAMPLE),
        "-w",
        str(folder),
        cwd=folder,
    )
    wheels = sorted(map(str, folder.glob("*.whl")))
    assert len(wheels) == 2
    run(*pip, "install", *offline, "--target", str(folder / "site"), *wheels, cwd=folder)
    return folder / "site"


def test_the_wheel_has_the_test_double_and_no_tests(site):
    (wheel,) = site.parent.glob("adis_gonio-*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "adis_gonio/sim/testing/bus_contract.py" in names
    assert not any(name.startswith(("tests/", "examples/")) for name in names)


def test_the_examples_own_tests_pass_with_the_plugin_that_pytest_finds(site, tmp_path):
    (tmp_path / "tests").symlink_to(EXAMPLE / "tests")
    (tmp_path / "pyproject.toml").symlink_to(EXAMPLE / "pyproject.toml")
    report = run(
        sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", "-p", "no:xdist", "tests",
        cwd=tmp_path, PYTHONPATH=str(site), PYTHONDONTWRITEBYTECODE="1",
    )  # fmt: skip
    assert re.search(r"plugins: .*adis-gonio-", report)
    # That none failed says the exit status; that each file's tests ran say these lines.
    passed = re.findall(r"^tests/(test_\w+\.py)::\S+ PASSED", report, re.M)
    assert len(passed) > 50
    assert set(passed) == {path.name for path in (EXAMPLE / "tests").glob("test_*.py")}


def test_what_ran_was_the_wheel_and_not_this_checkout(site, tmp_path):
    code = "import adis_gonio.testing, tilt_bench; print(adis_gonio.testing.__file__, tilt_bench.__file__)"
    where = run(sys.executable, "-c", code, cwd=tmp_path, PYTHONPATH=str(site)).split()
    assert all(path.startswith(str(site)) for path in where)
