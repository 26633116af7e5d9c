"""Error of the shown angle by method against the bound, and efficiency of `ml`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from adis_gonio.page.document import ROLES, Series, plot
from efficiency import CASES, Case, Floats, lines, run_all
from results.section import Effort, Section
from shown_angle import ORDER, PLACES_DEG, Shown, cells, figures, measure_all

FIXTURES_DEG = (0.0, 0.02, 0.1)
TRACED_AT_DEG = 0.02


def run(effort: Effort) -> Section:
    """Measure all plans, methods and fixtures."""
    cases = [case for kind in CASES.values() for case in kind]
    fixtures: Sequence[float] = FIXTURES_DEG
    if effort.fast:
        cases, fixtures = [CASES["stated"][2], CASES["stated"][-3]], (TRACED_AT_DEG,)
    chosen = cells(fixtures, TRACED_AT_DEG)
    if effort.fast:
        chosen = [c for c in chosen if c.kind == "bias" and c.positions != 24]
    rows = run_all(cases, effort.sessions(1500, 20), effort.seed, effort.jobs)
    shown = measure_all(chosen, effort.sessions(60, 4), effort.sessions(12, 1), effort.seed, effort.jobs)
    return Section(
        {"efficiency": _efficiency_document(cases, rows), "angle": _angle_document(shown)},
        _turn_figures(shown),
    )


# -- efficiency ------------------------------------------------------------------------------------


def _efficiency_document(cases: Sequence[Case], rows: Sequence[Floats]) -> list[dict[str, Any]]:
    found = [asdict(line) for case, one in zip(cases, rows, strict=True) for line in lines(case, one)]
    return [{**line.pop("case"), **line} for line in found]


# -- angle -----------------------------------------------------------------------------------------


def _angle_document(shown: Sequence[Shown]) -> list[dict[str, Any]]:
    document = []
    for one in shown:
        for method in (m for m in ORDER if m in one.calibration):
            entry: dict[str, Any] = {**asdict(one.cell), "method": method}
            entry["sessions"] = len(one.calibration[method])
            for part in ("calibration", "total"):
                values = asdict(figures(one, method, part))
                refused = values.pop("refused")
                entry[part] = {
                    key: None if v is None or not math.isfinite(v) else v for key, v in values.items()
                }
            document.append({**entry, "refused": refused})
    return document


def _turn_figures(shown: Sequence[Shown]) -> dict[str, str]:
    made = {}
    for one in shown:
        cell = one.cell
        if (cell.plan, cell.positions, cell.fixture_deg) != ("tumble", 12, TRACED_AT_DEG):
            continue
        if cell.kind == "bias":
            drawn = ("two-position", "four-position", "mmpm", "ml")
            made["bias"] = _turn_figure(one, drawn, "Error over the turn, bias of 10 mg")
    return made


def _turn_figure(one: Shown, methods: Sequence[str], title: str) -> str:
    series = []
    for role, method in zip(ROLES, methods, strict=False):
        errors = one.calibration[method]
        errors = errors[np.isfinite(errors).all(axis=1)]
        series.append(Series(PLACES_DEG, np.sqrt((errors**2).mean(axis=0)), method, role=role))
    if one.bound is not None:
        bound = np.sqrt((one.bound[:, 0] ** 2).mean(axis=0))
        series.append(Series(PLACES_DEG, bound, "bound", role="model", style="line"))
    return plot(
        series,
        "angle of the stage / °",
        "error of the shown angle, rms / °",
        title=title,
        description="Root mean square over sessions at each angle, without the noise of the fresh reading.",
        y_log=True,
        x_ticks={k: str(k) for k in range(0, 361, 90)},
        width=560,
        height=340,
    )
