"""Tutorials and how-to pages: their commands and Python examples run in the order printed.

A dwell takes 1 s where the page leaves it at 10 s, and a table turns once about each axis, not five times.
"""

import re
import shlex
import sys
from pathlib import Path

import pytest

from adis_gonio import open_sensor
from adis_gonio.faces.cli import main
from adis_gonio.faces.free_hands import free_hands

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.parametrize(
    "name", ["first_calibration", "hardware", "plans", "gyros", "many_sessions"], ids=str
)
def test_the_commands_of_the_page_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = 0
    for language, block in re.findall(
        r"^```(sh|python)\n(.*?)^```$", (DOCS / f"{name}.md").read_text("utf-8"), re.M | re.S
    ):
        if "Client(" in block:
            continue  # needs a cluster: tests/fleet/test_fleet_cluster.py runs it
        if language == "python":
            exec(compile(block, f"{name}.md", "exec"), {})
            continue
        for line in block.splitlines():
            words = shlex.split(line, comments=True)
            if words[0] == "mkdir":
                Path(words[1]).mkdir()
            elif words[0] == "adis-gonio":
                short = [] if words[1] != "calibrate" or "--dwell" in words else ["--dwell", "1"]
                short += ["--turns", "1"] * ("gyro-turns" in words)
                assert main([*words[1:], *short]) == 0, line
                run += 1
    assert run >= 2


def test_the_extras_that_the_tutorial_installs_suffice_for_the_part_that_only_keys_move(monkeypatch):
    page = (DOCS / "first_calibration.md").read_text("utf-8")
    installed = re.search(r"pip install '\.\[(.*?)\]'", page)[1].split(",")
    (url,) = re.findall(r"'(sim:\S*hands=free)'", page)
    if "serial" not in installed:
        for module in ("serial", "cobs"):
            monkeypatch.setitem(sys.modules, module, None)  # None: an import fails
    with free_hands(url) as (port, hands), open_sensor(port) as sensor:
        assert hands is not None
        assert sensor.read_scans(1).words.shape[0] == 1
