"""The results: the fast part of every section is made, and each has its page in the documentation."""

import json
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

import shown_angle
from results import SECTIONS

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "results"


def check_files(name, folder, command):
    page = (folder / f"{name}.md").read_text("utf-8")
    document = json.loads((folder / f"{name}.json").read_text("utf-8"))
    assert page.startswith("# ")
    assert re.search(rf"Made by `{command}`\.\n$", page)
    assert re.fullmatch(command, document["command"])
    assert len(document) > 1
    figures = re.findall(r"!\[[^]]*\]\(([^)]+)\)", page)
    assert set(figures) == {path.name for path in folder.glob(f"{name}-*.svg")}
    for figure in figures:
        assert ElementTree.parse(folder / figure).getroot().tag.endswith("}svg")


@pytest.mark.parametrize("name", SECTIONS)
def test_the_fast_part_of_a_section_is_made(name, tmp_path):
    command = [sys.executable, "scripts/results", "--fast", "--seed", "1", "-o", str(tmp_path), name]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    assert f"{name}: written to" in done.stdout
    check_files(name, tmp_path, f"python scripts/results {name} --seed 1 --fast")
    if name == "angle":
        document = json.loads((tmp_path / "angle.json").read_text("utf-8"))
        assert {entry["method"] for entry in document["angle"]} == set(shown_angle.ORDER)
        assert {line["parameter"] for line in document["efficiency"]} >= {"delta_k", "skew_xy", "bias_z"}


@pytest.mark.parametrize("name", SECTIONS)
def test_a_section_has_its_page_made_in_full(name):
    check_files(name, PAGES, rf"python scripts/results {name} --seed \d+")


def test_the_index_holds_every_section_and_nothing_else():
    index = (PAGES / "index.md").read_text("utf-8")
    listed = re.search(r"```\{toctree\}\n(?::.*\n)*\n(.*?)```", index, re.S)[1].split()
    assert listed == list(SECTIONS)
    assert {page.stem for page in PAGES.glob("*.md")} == {"index", *SECTIONS}


def test_an_unknown_section_is_answered_with_those_there_are():
    command = [sys.executable, "scripts/results", "papper"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 2
    assert "no section papper; there are " + ", ".join(SECTIONS) in done.stderr
