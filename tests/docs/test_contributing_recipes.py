"""The recipes of CONTRIBUTING.md, as printed: in a package of their own, or added to a copy of this one."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ANY_BLOCK = re.compile(r"^```(?:python|toml)\n# (\S+)\n(.*?)^```$", re.M | re.S)
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
BLOCKS = dict(ANY_BLOCK.findall(CONTRIBUTING))


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Runs a command where the recipes' package is installed, as pip leaves one on the path."""
    folder = tmp_path_factory.mktemp("site-packages")
    files = {name: text for name, text in BLOCKS.items() if "." in name and not name.startswith("src/")}
    for name, text in files.items():
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


@pytest.fixture(scope="module")
def extended(tmp_path_factory):
    """Runs a command of a copy of this package to which the recipes have added a method and an export."""
    folder = tmp_path_factory.mktemp("copy")
    shutil.copytree(ROOT / "src", folder / "src")  # with its bytecode
    for name, text in BLOCKS.items():
        if name.startswith("src/"):
            (folder / name).write_text(text, "utf-8")
    import_line = "from adis_gonio.fitting.cautious import fit_cautious"
    for table, linked, line in (("METHOD_TABLE", "methods.py", import_line), ("FORMATS", "formats.py", "")):
        (path,) = re.findall(rf"`{table}` in \[`\S*{linked}`\]\((\S+)\)", CONTRIBUTING)
        text = (folder / path).read_text("utf-8")
        start = re.search(rf"^{table} = [({{]$", text, re.M).end()
        text = f"{text[:start]}\n{BLOCKS[table]}{text[start:]}"
        first_import = re.search(r"^from adis_gonio", text, re.M).start()
        (folder / path).write_text(f"{text[:first_import]}{line}\n{text[first_import:]}", "utf-8")

    @cache
    def run(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "adis_gonio", *arguments],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(folder / "src")},
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    run("simulate", "--plan", "tumble", "--dwell", "2", "-o", "some.session")
    return run


def test_the_method_is_fitted_and_compared(extended):
    document = json.loads(extended("fit", "some.session", "--method", "cautious", "--json"))
    assert document["method"] == "cautious"
    assert "cautious" in document["scores"]
    assert "cautious" in json.loads(extended("fit", "some.session", "--json"))["scores"]


def test_the_export_follows_from_the_file_name(extended):
    extended("export", "some.session", "-o", "some.gains")
    printed = extended("export", "some.session", "--format", "gains", "-o", "-")
    values = {line.split()[0]: float(line.split()[1]) for line in printed.splitlines()}
    parameters = json.loads(extended("fit", "some.session", "--json"))["parameters"]
    assert values["scale_x"] == pytest.approx(parameters["scale_x"]["value"])


def test_every_file_that_the_page_links_has_the_table_that_it_names():
    rows = re.findall(r"a row of `(\w+)` in \[`[^`]+`\]\(([^)]+)\)", CONTRIBUTING)
    assert len(rows) == 3
    for table, path in rows:
        assert re.search(rf"^{table} = ", (ROOT / path).read_text("utf-8"), re.M), path
