"""README.md: it is short, and its commands and its Python example run in the order printed."""

import contextlib
import io
import re
import shlex
from pathlib import Path

import pytest

from adis_gonio.faces.cli import main

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "README.md").read_text("utf-8")
SHELL = re.findall(r"^```sh\n(.*?)^```$", PAGE, re.M | re.S)
COMMANDS = [part.strip() for block in SHELL for part in re.split(r"&&\s|\n", block) if part.strip()]


def test_the_page_is_short_and_states_near_the_top_that_no_hardware_was_used():
    assert len(PAGE.split()) <= 600
    assert "not yet run on hardware" in " ".join(PAGE.split()[:200])


def test_the_first_block_installs_the_tool_and_the_second_runs_the_tests():
    assert COMMANDS[:2] == ["python3 -m venv .venv", ".venv/bin/pip install '.[report,bench]'"]
    assert SHELL[0].count("&&") == len(SHELL[0].splitlines()), "one command"
    assert SHELL[1] == "bash scripts/run_tests.sh\n"
    assert "exec bash scripts/run_tests.sh" in (ROOT / ".ci" / "run").read_text("utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder in which the commands of the page were run, one after the other; a dwell takes 2 s."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "examples").symlink_to(ROOT / "examples")
    run = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in COMMANDS:
            words = shlex.split(command, comments=True)
            if words[0] in ("adis-gonio", ".venv/bin/adis-gonio"):
                short = ["--dwell", "2"] if words[1] == "calibrate" else []
                assert main([*words[1:], *short]) == 0, command
                run += 1
    assert run == 8
    return folder


def test_the_commands_write_the_files_that_they_name(folder):
    assert {"first.session", "first.html", "goniometer.h"} <= {path.name for path in folder.iterdir()}


def test_the_python_example_prints_the_answer_and_an_angle(folder, monkeypatch):
    (block,) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.M | re.S)
    monkeypatch.chdir(folder)
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown):
        exec(compile(block, "README.md", "exec"), {})
    assert "ΔK" in shown.getvalue()
    angle_deg, u_deg = re.search(r"(-?\d+\.\d+)°, u (\d\.\d+)", shown.getvalue()).groups()
    assert float(u_deg) < 0.05
    assert abs(float(angle_deg)) < 0.2  # the stage is at 0°, within its own errors
