"""The recipes of CONTRIBUTING.md, word for word, as a package that is installed beside this one."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ANY_BLOCK = re.compile(r"^```(?:python|toml)\n# (\S+)\n(.*?)^```$", re.M | re.S)

TRY_METHOD = """
import json, sys
import numpy as np
import adis_gonio, my_bench.forward

session = adis_gonio.load_session(sys.argv[1])
forward = [dwell.position for dwell in session.dwells if dwell.approach > 0]
result = adis_gonio.fit(session, method="forward")
assert list(result.positions) == forward
assert len(forward) < len(session.dwells)
print(json.dumps({"forward": result.as_dict(), "default": adis_gonio.fit(session).as_dict()}))
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Runs a command where the recipes' package is installed, as pip leaves one on the path."""
    folder = tmp_path_factory.mktemp("site-packages")
    files = dict(ANY_BLOCK.findall((ROOT / "CONTRIBUTING.md").read_text("utf-8")))
    for name, text in (*files.items(), ("my_bench/try_method.py", TRY_METHOD)):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, "utf-8")
    project = tomllib.loads(files["pyproject.toml"])["project"]
    info = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    head = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (info / "METADATA").write_text(head)
    groups = [
        f"[{group}]\n" + "".join(f"{name} = {place}\n" for name, place in points.items())
        for group, points in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(groups))

    def run(*arguments: str, check: bool = True) -> subprocess.CompletedProcess:
        done = subprocess.run(
            [sys.executable, "-m", *arguments],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT / "src")])},
            capture_output=True,
            text=True,
            timeout=1800,
            check=False,
        )
        assert not check or done.returncode == 0, done.stdout + done.stderr
        return done

    return run


def test_the_bus_is_listed_and_opens_by_its_url(bench):
    listed = json.loads(bench("adis_gonio", "devices", "--json").stdout)["devices"]
    assert "tap:sim:?seed=1" in [device["url"] for device in listed]
    read = ("registers", "--json", "XACCL_OFF")
    tapped = bench("adis_gonio", *read[:1], "tap:sim:?seed=1", *read[1:])
    plain = bench("adis_gonio", *read[:1], "sim:?seed=1", *read[1:])
    assert tapped.stdout == plain.stdout
    frames = re.findall(r"^([0-9A-F]{4}) [0-9A-F]{4}$", tapped.stderr, re.M)
    assert "2000" in frames, "XACCL_OFF is register 0x20"


def test_the_bus_keeps_the_contract(bench):
    done = bench("pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "test_tap.py")
    (passed,) = re.findall(r"(\d+) passed", done.stdout)
    assert int(passed) > 30
    assert "failed" not in done.stdout


def test_the_effect_is_simulated_and_traced_by_its_name(bench, tmp_path):
    session = str(tmp_path / "drift.session")
    effect = "mount_drift:rate=10"
    bench("adis_gonio", "simulate", "--plan", "tumble", "--effect", effect, "-o", session)
    found = json.loads(bench("adis_gonio", "trace", session, "--json").stdout)["found"]
    (drift,) = [finding for finding in found if finding["effect"] == "mount_drift"]
    rate = drift["parameters"]["rate"]
    assert rate["unit"] == "deg/h"
    assert abs(rate["value"] - 10) < 4 * rate["u"] < 5


def test_the_method_fits_and_takes_part_in_the_comparison_by_its_row_alone(bench, tmp_path):
    session = str(tmp_path / "both.session")
    bench("adis_gonio", "simulate", "--plan", "tumble", "-o", session)
    documents = json.loads(bench("my_bench.try_method", session).stdout)
    found = documents["forward"]["parameters"]["delta_phi"]
    assert documents["forward"]["method"] == "forward"
    assert 0 < found["u"] < 0.1
    assert documents["default"]["method"] == "ml"
    scores = documents["default"]["scores"]
    assert scores["forward"]["dwells"] == scores["ml"]["dwells"] > 0


def test_without_the_package_the_effect_is_unknown_in_one_line(tmp_path):
    command = [sys.executable, "-m", "adis_gonio", "simulate", "--effect", "mount_drift"]
    done = subprocess.run(
        [*command, "-o", str(tmp_path / "none.session")],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 2
    assert "no effect is called 'mount_drift'" in done.stderr
