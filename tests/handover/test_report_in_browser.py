"""Every kind of page in headless Chromium: silent, self-contained, readable at every width and on paper,
accessible by axe-core's rules, and its numbers those of `fit --json`.
"""

from __future__ import annotations

import json
import re
import subprocess
import unicodedata
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from adis_gonio.faces.cli import main
from handover.browser import missing
from handover.rests import rests_csv
from recordings import recording

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())

WIDTHS = (360, 390, 800, 1000, 1400)
KINDS = (
    "planar",
    "spatial",
    "recorded",
    "two positions",
    "odd",
    "untraceable",
    "one pose",
    "board",
    "noise",
    "rests",
)
TWO = "time_s,position,angle_deg,ax,ay\n0,0,0,999,3\n60,1,90,4,-1001\n"
ODD = (
    "<script>alert('x')</script> & \"quoted\" {{ 7 * 7 }} %s </title><h1> a title that was written late "
    f"at night and that goes on and on, with μ, 角度 and عنوان, {'Donaudampfschifffahrtsgesellschaft' * 6}"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("pages")


def session_of(kind: str, folder: Path) -> Path:
    """A session file of a kind."""
    if kind == "recorded":
        return recording("mpu9150_0_recording")
    if kind in ("two positions", "odd", "untraceable"):
        path = folder / f"{kind.replace(' ', '-')}.csv"
        title = f"# title: {ODD}\n# note: {ODD}\n" if kind == "odd" else ""
        rows = TWO.rsplit("60,1")[0] if kind == "untraceable" else TWO
        path.write_text(f"# accel_unit: mg\n# reading_u_mg: 0.1\n{title}{rows}", encoding="utf-8")
        return path
    if kind in ("noise", "rests"):
        return rests_csv(folder / f"{kind}.csv")
    path = folder / f"{kind.replace(' ', '-')}.session"
    if kind == "one pose":
        path = path.with_suffix(".csv")
        command = ["stream", "sim:?seed=4", "--seconds", "10", "--rate", "100", "-o", str(path)]
    else:
        plan = {"planar": "tumble", "spatial": "poses"}[kind]
        command = [
            "simulate",
            "--plan",
            plan,
            "--dwell",
            "4",
            "--rate",
            "100",
            "--seed",
            "1",
            "-o",
            str(path),
        ]
        command += ["--effect", "quadratic:k2_x=3"] if kind == "planar" else []
    assert main(command) == 0
    return path


@pytest.fixture(scope="module", params=KINDS)
def made(request, folder) -> tuple[str, Path, Path]:
    """A kind of page, its session (of a bring-up: its JSON), and the page."""
    kind = request.param
    page = folder / f"{kind}.html"
    if kind == "board":
        assert main(["bringup", "sim:?seed=1", "-o", str(page)]) == 0
        return kind, page.with_suffix(".json"), page
    session = session_of(kind, folder)
    if kind == "noise":
        assert main(["allan", str(session), "-o", str(page)]) == 0
        return kind, session, page
    assert main(["report", str(session), "-o", str(page)]) == 0
    assert ("of the gyros at rest" in page.read_text(encoding="utf-8")) == (kind == "rests")
    assert ("could not be traced" in page.read_text(encoding="utf-8")) == (kind == "untraceable")
    return kind, session, page


def test_a_page_is_silent_and_accessible(chrome, made):
    with chrome.tab(made[2]) as tab:
        assert tab.faults() == []


def test_nothing_is_clipped_and_nothing_overlaps(chrome, made):
    with chrome.tab(made[2]) as tab:
        for width in WIDTHS:
            assert tab.audit(width=width) == [], width
        tab.open_folds()
        for width in WIDTHS:
            assert tab.audit(width=width) == [], width
            if width >= 1000:
                assert tab.tab.evaluate(SCROLLED) == []  # with room for all of it nobody should have to


def test_on_paper_all_of_it_is_there_and_nothing_leaves_the_sheet(chrome, made, tmp_path):
    with chrome.tab(made[2]) as tab:
        assert tab.audit(paper=True) == []
        tab.pdf(tmp_path / "page.pdf")
        tab.open_folds()
        said = tab.tab.evaluate(TEXTS)
    subprocess.run(["pdftotext", "-bbox", "page.pdf", "words.html"], cwd=tmp_path, check=True, timeout=300)
    printed = set()
    for sheet in ET.parse(tmp_path / "words.html").iter("{http://www.w3.org/1999/xhtml}page"):
        for word in sheet:
            left, right = float(word.get("xMin", "nan")), float(word.get("xMax", "nan"))
            assert left >= 0, word.text
            assert right <= float(sheet.get("width", "nan")), word.text
            printed.add(plain(word.text or ""))
    # Latin and Greek letters: others are shaped by fonts that a machine may lack. A long word may be
    # broken at the end of a line.
    wanted = {
        word for word in plain(said).split() if re.fullmatch(r"[\wα-ωΑ-Ω.,±°−+%]{2,18}", word, re.ASCII)
    }
    lost = wanted - printed
    assert "adis-gonio" in printed
    assert len(wanted) > 30
    assert {word for word in lost if not any(word in other for other in printed)} == set()


SCROLLED = """[...document.querySelectorAll('[tabindex]')].filter(e => e.scrollWidth > e.clientWidth + 1)
    .map(e => e.getAttribute('aria-label'))"""
# On paper the margin of each page has the program's name instead of the footer.
TEXTS = """[...document.querySelectorAll('body, body *:not(title, desc, footer, footer *)')]
    .flatMap(e => [...e.childNodes]).filter(node => node.nodeType === Node.TEXT_NODE)
    .map(node => node.data).join(' ')"""


def plain(text: str) -> str:
    """Text without ligatures and no-break spaces."""
    return unicodedata.normalize("NFKC", text)


NAMES = {
    "ΔK": "delta_k",
    "Δφ": "delta_phi",
    "α": "alpha",
    "K_x": "scale_x",
    "K_y": "scale_y",
    "K_z": "scale_z",
}
TABLES = """[...document.querySelectorAll('table')].map(
    table => [...table.rows].map(row => [...row.cells].map(cell => cell.textContent)))"""


def test_the_numbers_of_the_page_are_those_of_fit_json(chrome, made, capsys):
    kind, session, page = made
    if kind in ("untraceable", "one pose", "board", "noise"):
        return  # none of them has results by method
    capsys.readouterr()
    with chrome.tab(page) as tab:
        tables = tab.tab.evaluate(TABLES)
    compared = 0
    for head, *rows in tables:
        for column, method in enumerate(name.removesuffix(", ± U") for name in head):
            if method not in ("paper", "two-position", "four-position", "mmpm", "ml"):
                continue
            assert main(["fit", str(session), "--method", method, "--json"]) == 0
            parameters = json.loads(capsys.readouterr().out)["parameters"]
            for row in rows:
                given = parameters.get(NAMES.get(row[0], row[0]))
                if given is None:
                    continue
                agree(row[column], given["value"], given["U"])
                compared += 1
    assert compared >= 2


def agree(cell: str, value: float, expanded: float | None) -> None:
    """A cell is a value and its U, each rounded to the digits that it shows."""
    numbers = [part.strip(" ()°") for part in plain(cell).replace("−", "-").split("±")]
    for shown, exact in zip(numbers, (value, expanded), strict=False):
        mantissa, _, power = shown.partition("·10")
        digits = len(mantissa.partition(".")[2])
        scale = 10.0 ** int(power or 0)
        assert float(mantissa) * scale == pytest.approx(exact, abs=0.5001 * 10.0**-digits * scale), cell


BROKEN = {
    "scrolls without focus": '<div style="overflow-x:auto"><p style="width:3000px">wide</p></div>',
    "is clipped": '<div style="overflow:hidden;width:50px"><p style="width:300px">wide</p></div>',
    "px wide on": '<p style="width:3000px">wide</p>',
    "overlap": '<p>one line</p><p style="margin-top:-1.9em">another line</p>',
    "cut at the edge": '<svg viewBox="0 0 100 50" width="300"><text x="90" y="20">too long</text></svg>',
    "px high": '<svg viewBox="0 0 1000 500" width="300"><text x="9" y="9" font-size="9">i</text></svg>',
    "leaves the page": '<p style="margin-left:-60px">outside</p>',
}


@pytest.mark.parametrize("what", BROKEN)
def test_the_rig_sees_a_page_that_is_broken(chrome, tmp_path, what):
    path = tmp_path / "broken.html"
    path.write_text(f"<!DOCTYPE html><html lang=en><title>b</title><body>{BROKEN[what]}", encoding="utf-8")
    with chrome.tab(path) as tab:
        assert any(what in found for found in tab.audit(width=800))


def test_the_rig_hears_a_page_that_talks_loads_or_hides_its_text(chrome, tmp_path):
    path = tmp_path / "loud.html"
    body = (
        '<img src="there-is-none.png"><script>console.log("loud")</script><p style="color:#ddd">pale</p>'
        '<table><tr><th scope="col"></th></tr><tr><td>1</td></tr></table>'
    )
    path.write_text(f"<!DOCTYPE html><html><title>l</title><body>{body}", encoding="utf-8")
    with chrome.tab(path) as tab:
        rules = {violation.partition(":")[0] for violation in tab.axe()}
        assert {"image-alt", "color-contrast", "empty-table-header", "html-has-lang"} <= rules
        assert any(sound.startswith("request: ") for sound in tab.noise)
        assert "console: loud" in tab.noise


@pytest.mark.parametrize(
    "body", ["<p class=d>pale</p>", "<details><summary>s</summary><p class=f>pale</p></details>"]
)
def test_the_rig_sees_text_that_is_pale_in_the_dark_or_in_a_fold(chrome, tmp_path, body):
    path = tmp_path / "pale.html"
    style = (
        "p.f { color: #ddd } @media (prefers-color-scheme: dark) { p.d { color: #333; background: #000 } }"
    )
    page = (
        f"<!DOCTYPE html><html lang=en><title>p</title><style>{style}</style><body><main><h1>p</h1>{body}"
    )
    path.write_text(page, encoding="utf-8")
    with chrome.tab(path) as tab:
        assert any(fault.startswith("color-contrast: ") for fault in tab.faults())
