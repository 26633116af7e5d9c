"""Pages of `history` and `fleet` in Chromium: silent, accessible, readable at every width and on paper."""

from __future__ import annotations

from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.base.uncertainty import Value
from adis_gonio.fleet.fleet_pages import build_page, history_page
from adis_gonio.fleet.fleet_summary import summarise
from adis_gonio.fleet.sensor_history import history_of
from adis_gonio.fleet.session_record import FoundEffect, Repeated, SessionRecord
from fleet.sessions import quiet_rows, row
from handover.browser import missing

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())

WIDTHS = (360, 400, 800, 1280)
LONG = "<b>Prüfstand</b> & der Donaudampfschifffahrtsgesellschaftskapitänsmütze, 角度, " + "x" * 60
UNITS = {"delta_k": "1", "delta_phi": "deg", "bias_x": "mg", "bias_y": "mg", "angle": "deg"}


def record(day: date, serial: str, effects: tuple[str, ...], rng: np.random.Generator) -> SessionRecord:
    """A session as a row, whose file nobody has made."""
    names = tuple(FoundEffect(name, ("x",), 1e-5, {"k2_x": Value(2.5, 0.3, "mg/g²")}) for name in effects)
    return SessionRecord(
        path=f"/none/{serial}/{day}.session",
        sha256=f"{day} {serial}",
        data_sha256=f"{day} {serial}",
        serial=serial,
        operator=LONG,
        stage=LONG,
        when=f"{day}T00:00:00+00:00",
        method="ml",
        gravity_mps2=9.80665,
        simulated=True,
        values={
            name: Value(float(rng.normal(0, 0.1)) + 0.001 * (day.year - 2000) ** 2, 0.1, unit)
            for name, unit in UNITS.items()
        },
        traced=True,
        effects=names,
        adequate=True,
    )


def history(sessions: int, serial: str) -> str:
    """The page of so many yearly sessions."""
    rng = np.random.default_rng(3)
    days = [date(2001, 1, 1) + timedelta(days=190 * k) for k in range(sessions)]
    effects = [("quadratic", "stage_eccentricity") if k % 3 else () for k in range(sessions)]
    return history_page(
        history_of(serial, [record(d, serial, e, rng) for d, e in zip(days, effects, strict=True)])
    )


def fleet(sessions: int) -> str:
    """The page of so many sessions, some failed, with a stage that stands out and long names."""
    rows = quiet_rows(np.random.default_rng(4), sessions)
    for k, one in enumerate(rows):
        if k % 4 == 0:
            one["stage"] = LONG
            one["bias_x"] += 9.0
    failed = f"{LONG}.csv: row 1: column 'time_s' is missing"
    rows.append(row(sessions, status="failed", reason=failed, traced=False) | {"path": f"/none/{LONG}.csv"})
    said = ["Common to many: quadratic (k2_x), 1.3 ± 0.2 mg/g² in 30 % of the sessions.", LONG]
    return build_page(summarise(rows), [Repeated(f"/none/{LONG}.csv", "/none/a.csv")], said)


PAGES = {
    "history": lambda: history(24, LONG),
    "history of one session": lambda: history(1, "A7"),
    "fleet": lambda: fleet(60),
    "fleet of nothing but a failure": lambda: build_page(summarise([row(0, status="failed", reason="no")])),
}


@pytest.fixture(scope="module", params=PAGES)
def page(request, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("pages") / f"{request.param}.html"
    path.write_text(PAGES[request.param](), encoding="utf-8")
    return path


def test_a_page_is_silent_and_accessible(chrome, page):
    with chrome.tab(page) as tab:
        assert tab.faults() == []


def test_nothing_is_clipped_and_nothing_overlaps_on_screen_or_paper(chrome, page):
    with chrome.tab(page) as tab:
        tab.open_folds()
        for width in WIDTHS:
            assert tab.audit(width=width) == [], width
        assert tab.audit(paper=True) == []
