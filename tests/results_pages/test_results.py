"""The results: every section can be measured, and the page has the numbers of the documents."""

import json
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

import shown_angle
from results import SECTIONS
from results.page import TITLES, render

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "results"


def check_files(name, folder, command):
    document = json.loads((folder / f"{name}.json").read_text("utf-8"))
    section = render(folder).partition(f"\n## {TITLES[name][0]}\n")[2].partition("\n## ")[0]
    assert re.search(rf"Made by `{command}`\.\n$", section)
    assert re.fullmatch(command, document["command"])
    assert len(document) > 1
    figures = re.findall(r"!\[[^]]*\]\(([^)]+)\)", section)
    assert set(figures) == {path.name for path in folder.glob(f"{name}-*.svg")}
    for figure in figures:
        assert ElementTree.parse(folder / figure).getroot().tag.endswith("}svg")


def test_the_fast_part_of_every_section_is_made(tmp_path):
    command = [sys.executable, "scripts/results", "--fast", "--seed", "1", "-o", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=1800)
    assert done.returncode == 0, done.stderr
    for name in SECTIONS:
        assert f"{name}: written to" in done.stdout
        check_files(name, tmp_path, f"python scripts/results {name} --seed 1 --fast")
    document = json.loads((tmp_path / "angle.json").read_text("utf-8"))
    assert {entry["method"] for entry in document["angle"]} == set(shown_angle.ORDER)
    assert {line["parameter"] for line in document["efficiency"]} >= {"delta_k", "skew_xy", "bias_z"}


@pytest.mark.parametrize("name", SECTIONS)
def test_a_section_was_measured_in_full(name):
    check_files(name, PAGES, rf"python scripts/results {name} --seed \d+")


def test_the_page_has_every_section_and_the_numbers_of_its_document():
    assert set(TITLES) == {"trace", *SECTIONS} == {path.stem for path in PAGES.glob("*.json")}
    assert (PAGES / "index.md").read_text("utf-8") == render(PAGES)


def test_an_unknown_section_is_answered_with_those_there_are():
    command = [sys.executable, "scripts/results", "papper"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 2
    assert "no section papper; there are " + ", ".join(SECTIONS) in done.stderr
