"""The page and the document of `adis-gonio paper`: recognisable, complete, and to be made again."""

import json
import re

import numpy as np
import pytest

from adis_gonio.faces.cli import main
from adis_gonio.handover.paper_study import METHODS, TABLE, Study, build_page, sections
from handover.browser import browser, missing

WIDTHS = (360, 800, 1000, 1400)


def part(error: float) -> dict[str, dict[str, tuple[float, float]]]:
    """Results of a part, all off by `error` (in g and °); the paper's method determines no bias."""
    true = {"delta_k": 0.0004, "delta_phi": 0.06, "scale_x": 1.0214, "scale_y": 1.021}
    two = {name: (value + error, 0.002) for name, value in true.items()}
    biases = {"bias_x": (-3.0 + 1e3 * error, 2.0), "bias_y": (-2.9 + 1e3 * error, 2.0)}
    return {method: two | ({} if method == "paper" else biases) for method in METHODS}


@pytest.fixture(scope="module")
def small():
    """A study of two parts of each kind; its sessions are off by 0.001 to both sides."""
    return Study(7, 2, {column: [part(0.001), part(-0.001)] for column in ("x", "y")})


@pytest.fixture(scope="module")
def page(small):
    return build_page(small)


@pytest.fixture(scope="module")
def shown(small):
    return sections(small)


def parts_of(section):
    yield section
    for part in section.parts:
        yield from parts_of(part)


def test_the_table_has_every_printed_number_beside_ours(shown):
    table = next(s for s in shown if s.title == "Table 1").tables[0]
    assert len(table.rows) == len(TABLE)
    for row, printed in zip(table.rows, TABLE, strict=True):
        assert row[0].startswith(printed.name)
        shown = [float(row[k].replace("−", "-")) for k in (1, 2, 5, 8)]
        assert shown == [printed.measured, printed.paper, printed.mmpm, printed.specification]
    # Mean (standard deviation) over the sessions, and u, by both methods.
    both = [[row[k] for k in (3, 4, 6, 7)] for row in table.rows]
    scale, bias = "0.0214\u00a0(0.0014)", "−0.0030\u00a0(0.0014)"
    assert both[0] == [scale, "0.0020", scale, "0.0020"]
    assert both[2] == ["not determined", "–", bias, "0.0020"]


def test_figure_3_has_three_graphs_with_both_methods_of_both_axes(shown):
    figures = next(s for s in shown if s.title.startswith("Figure 3")).figures
    assert len(figures) == 3
    for key, figure in zip(dict.fromkeys(row.printed for row in TABLE), figures, strict=True):
        heights = [float(y) for y in re.findall(r'<use[^>]* y="([\d.]+)"', figure.svg)]
        differences = [
            printed - row.measured
            for row in TABLE
            if row.printed == key
            for printed in (row.paper, row.mmpm)
        ]
        assert np.corrcoef(heights[:4], differences)[0, 1] == pytest.approx(-1, abs=1e-4)
        for word in ("X, paper", "X, MMPM", "Y, paper", "Y, MMPM", "printed", "our sessions"):
            assert word in figure.svg


def test_every_section_with_a_table_or_a_figure_carries_the_command_that_makes_it(shown):
    for section in shown:
        if any(part.tables or part.figures for part in parts_of(section)):
            assert any("adis-gonio paper --seed 7 --sessions 2" in note for note in section.notes), (
                section.title
            )


def test_the_command_writes_page_and_document(small, page, monkeypatch, tmp_path, capsys):
    asked = []
    monkeypatch.setattr(
        "adis_gonio.handover.paper_study.reproduce", lambda *given: asked.append(given) or small
    )
    path = tmp_path / "page.html"
    assert main(["paper", "-o", str(path), "--json", "--seed", "7", "--sessions", "2"]) == 0
    assert asked == [(7, 2)]
    assert path.read_text("utf-8") == page
    document = json.loads(capsys.readouterr().out)
    assert document["command"] == "adis-gonio paper --seed 7 --sessions 2 --json"
    assert [row["measured"] for row in document["table_1"]["rows"]] == [row.measured for row in TABLE]
    assert main(["paper", "--seed", "7", "--sessions", "2"]) == 0
    said = capsys.readouterr().out
    assert "overtakes MMPM" in said
    assert len(said.splitlines()) == 3


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--sessions", "1"], "1 is not in the range 2<=x<=10000"),
        (["--sessions", "many"], "--sessions"),
        (["--seed", "-1"], "-1 is not in the range x>=0"),
        (["-o", "no/such/folder/page.html"], "there is no folder"),
        (["--session", "3"], "--session"),
        (["3"], "3"),
    ],
)
def test_a_bad_option_is_answered_in_one_line(options, told, capsys):
    assert main(["paper", *options]) != 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.strip().splitlines()) == 1
    assert told in captured.err


def test_the_page_loads_nothing(page):
    assert not re.search(r"""(src|href)=["'](?!#)|@import|url\(""", page)


@pytest.mark.skipif(bool(missing()), reason=missing())
def test_the_page_is_readable_at_every_width_and_accessible(page, tmp_path):
    path = tmp_path / "paper.html"
    path.write_text(page, encoding="utf-8")
    with browser() as chrome, chrome.tab(path) as tab:
        for width in WIDTHS:
            assert tab.audit(width=width) == []
        assert tab.audit(paper=True) == []
        assert tab.axe() == []
        assert tab.noise == []
