"""Tables on terminals of every width: nothing of a row is lost, and no number is cut."""

import io
import re
from dataclasses import replace

import pytest
from rich.console import Console

from adis_gonio.faces.cli import main
from adis_gonio.faces.cli.show import print_sections, print_table
from adis_gonio.fleet.fleet_pages import fleet_sections
from adis_gonio.fleet.fleet_summary import summarise

HEAD = ("serial", "plan", "ΔK", "Δφ / °", "effects", "file")
ROWS = [
    (
        "A7",
        "four-position",
        "-0.00131 ± 0.00057",
        "-0.187 ± 0.051",
        "",
        "/sessions/2024/a7-first.session",
    ),
    ("B", "tumble", "0.00002 ± 0.00003", "–", "quadratic stage_eccentricity", "/b.session"),
]


def shown(width: int) -> list[str]:
    out = io.StringIO()
    screen = Console(file=out, width=width, highlight=False, markup=False, emoji=False)
    print_table(screen, HEAD, ROWS, texts={0, 1, 4, 5})
    return out.getvalue().splitlines()


def test_a_name_of_a_file_is_not_broken_if_half_of_the_screen_holds_it():
    assert all(
        name in "\n".join(shown(80)) for name in ("/sessions/2024/a7-first.session", "four-position")
    )


@pytest.mark.parametrize("width", [30, 60, 80, 100, 160])
def test_every_cell_is_there_at_every_width(width):
    lines = shown(width)
    assert max(map(len, lines)) <= width
    told = "".join("".join(lines).split())
    for cell in (cell for row in ROWS for cell in row if cell != "–"):
        # A long name may go on in the next line, beside other cells.
        assert all(word[:12] in told for word in cell.split())
    if width >= 60:
        assert any("-0.00131 ± 0.00057" in line for line in lines)


def test_with_room_it_is_one_table_and_without_each_part_names_its_rows():
    assert shown(160)[0].split() == ["serial", "plan", "ΔK", "Δφ", "/", "°", "effects", "file"]
    assert len(shown(160)) == 3
    narrow = [line.split() for line in shown(60)]
    assert narrow[0] == ["serial", "plan", "ΔK", "Δφ", "/", "°"]
    assert narrow[1] == ["A7", "four-position", "-0.00131", "±", "0.00057", "-0.187", "±", "0.051"]
    gap = narrow.index([])
    assert narrow[gap + 1] == ["serial", "effects", "file"]
    assert [line[0] for line in narrow[gap + 2 :] if line[0] in ("A7", "B")] == ["A7", "B"]


def test_a_fit_at_40_columns_cuts_no_number(tmp_path, capsys, monkeypatch):
    path = tmp_path / "a.session"
    assert main(["simulate", "--dwell", "0.5", "-o", str(path)]) == 0
    monkeypatch.setenv("COLUMNS", "40")
    capsys.readouterr()
    assert main(["fit", str(path)]) == 0
    narrow = capsys.readouterr().out
    assert max(map(len, narrow.splitlines())) <= 40
    assert "…" not in narrow
    assert re.search(r"^parameter  unit  +value.*$\n(.*\n)*^bias_x  +mg ", narrow, re.M)


def test_a_section_with_more_rows_than_a_screen_names_no_number_that_its_page_has_cut():
    out = io.StringIO()
    failures = tuple((f"{k}.csv", "is empty") for k in range(300))
    failed = fleet_sections(replace(summarise([]), failures=failures), figures=False)
    print_sections(Console(file=out, width=80, markup=False), failed)
    assert "39.csv" in out.getvalue()
    assert "40.csv" not in out.getvalue()
    assert "The first 40 rows; all are in the JSON document." in out.getvalue()
