"""Error of the shown angle by method against the bound, and efficiency of `ml`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from adis_gonio.page.svg import ROLES, Series, plot
from efficiency import (
    CASES,
    POSITIONS,
    REPORTED,
    SPATIAL,
    Case,
    Floats,
    Line,
    lines,
    pooled,
    run_all,
    together,
)
from results.section import Effort, Section
from results.section import table as markdown
from shown_angle import ORDER, PLACES_DEG, Cell, Figures, Shown, cells, figures, measure_all

FIXTURES_DEG = (0.0, 0.02, 0.1)
TRACED_AT_DEG = 0.02
METHOD = """
Sessions are drawn from the measurement model with hidden start angle, gains and misalignment; a reading
has white noise of 0.2 mg, a declared angle the fixture's error. The *bound* is the Cramér–Rao bound with
the errors of the angles as unknowns with a prior (hybrid bound), written out from how readings arise
(`scripts/information_bound.py`) and not from the code that fits. The mean square error is held to it, so
that a bias would show.
"""
EFFICIENCY = """
## Efficiency of `ml`

Bound over mean square error, the lowest and the highest of all parameters of a line, with its interval of
95 %. The interval comes from comparing every session with the errors that the estimator attaining the
bound would have made of the same noise, whose mean square is the bound exactly; an efficiency slightly
above one is the rest of chance. `stated`: the uncertainty of a reading is stated. `samples`: it is found
from the dwells' samples. `flicker`: with the simulator's 1/f noise as well, the bias being that of the
session. In space attitudes are not declared, so that no fixture comes in. *Bias* is the largest mean
error of a parameter in roots of its bound, *u²* the median of the squared uncertainty that the fit
states, over the bound, the farthest from one of all parameters.
"""
POOLED = """
All `stated` sessions together, by comparison and by the errors alone (half an interval: 1.96 √(2/N)). A
session or two in a thousand make the width of the intervals: where χ² is improbable by chance (below 0.1 %)
`ml` takes it for scatter of the readings and weighs fixture and readings otherwise than the bound, which
is told the noise.
"""
ANGLE = """
## Error of the shown angle

The part of the session stands at 72 angles of the turn that the session did not visit, without any error
of a stage, and the calibration of each method shows its angle. *Error*: root mean square over turn and
sessions, of readings without noise, so that it is the calibration's own. *Median*: of the sessions' rms;
*largest*: over the turn, median of the sessions. *Bound*: the parameters' bound carried to the angle;
*times*: error over bound, with its interval of 95 %, by comparison as above. *With reading*: error and
bound where the fresh reading has the noise of a dwell, too. No bound: the plan does not determine the
model. Kinds: `none` (no bias), `bias` (10 mg on each axis), `quadratic` (that and 2 mg/g² on X),
`quadratic, cubic` (and 2 mg/g³ on Y); the bound of these is that of the model with the effects.
"""


def run(effort: Effort) -> Section:
    """The section."""
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
        "The angle that is shown, and the bound",
        "\n".join([METHOD, *_of_efficiency(cases, rows), ANGLE, *_of_angle(shown)]),
        {"efficiency": _efficiency_document(cases, rows), "angle": _angle_document(shown)},
        {**_efficiency_figure(cases, rows), **_turn_figures(shown)},
    )


# -- efficiency ------------------------------------------------------------------------------------


def _of_efficiency(cases: Sequence[Case], rows: Sequence[Floats]) -> list[str]:
    table = []
    for case, one in zip(cases, rows, strict=True):
        found = lines(case, one)
        low, high = min(found, key=_efficiency), max(found, key=_efficiency)
        bias = max(found, key=lambda line: abs(line.bias))
        stated = max(found, key=lambda line: abs(line.stated - 1))
        table.append(
            [
                case.kind,
                str(case.positions),
                "space" if case.fixture_deg is None else f"{case.fixture_deg:g}°",
                str(len(one)),
                f"{low.parameter} {_interval(low)}",
                f"{high.parameter} {_interval(high)}",
                f"{bias.bias:+.4f} ± {bias.bias_half:.4f}",
                f"{stated.stated:.4f}",
            ]
        )
    head = ["readings", "positions", "fixture", "sessions", "lowest", "highest", "bias", "u²"]
    text = [EFFICIENCY, "![Lowest efficiency by positions and fixture](angle-efficiency.svg)", ""]
    text += markdown(head, table)
    text.append(POOLED)
    table = []
    for where, names in (("plane", REPORTED), ("space", SPATIAL)):
        mine = [
            (case, one)
            for case, one in _stated(cases, rows)
            if (case.fixture_deg is None) == (where == "space")
        ]
        plain = pooled([one for _, one in mine])
        for name, (value, half), by_case in zip(
            names, plain, zip(*(lines(case, one) for case, one in mine), strict=True), strict=True
        ):
            middle, low, high = together(by_case)
            count = str(sum(len(one) for _, one in mine))
            compared = f"{middle:.4f} ({low:.4f} to {high:.4f})"
            table.append([where, name, count, compared, f"{value:.4f} ± {half:.4f}"])
    return [*text, *markdown(["", "parameter", "sessions", "by comparison", "errors alone"], table)]


def _stated(cases: Sequence[Case], rows: Sequence[Floats]) -> list[tuple[Case, Floats]]:
    return [(case, one) for case, one in zip(cases, rows, strict=True) if case.kind == "stated"]


def _efficiency(line: Line) -> float:
    return line.efficiency


def _interval(line: Line) -> str:
    return f"{line.efficiency:.4f} ({line.low:.4f} to {line.high:.4f})"


def _efficiency_document(cases: Sequence[Case], rows: Sequence[Floats]) -> list[dict[str, Any]]:
    found = [asdict(line) for case, one in zip(cases, rows, strict=True) for line in lines(case, one)]
    return [{**line.pop("case"), **line} for line in found]


def _efficiency_figure(cases: Sequence[Case], rows: Sequence[Floats]) -> dict[str, str]:
    series = []
    found = [(case, min(lines(case, one), key=_efficiency)) for case, one in _stated(cases, rows)]
    for role, positions in zip(ROLES, POSITIONS, strict=False):
        mine = [
            (c.fixture_deg, line)
            for c, line in found
            if c.positions == positions and c.fixture_deg is not None
        ]
        if mine:
            x = [fixture for fixture, _ in mine]
            error = [(line.high - line.low) / 2 for _, line in mine]
            y = [line.efficiency for _, line in mine]
            series.append(Series(x, y, f"{positions} positions", error, role))
    series.append(Series([0.0, 0.1], [0.98, 0.98], "target", role="model", style="line"))
    svg = plot(
        series,
        "standard uncertainty of a declared angle / °",
        "lowest efficiency",
        title="Efficiency of ml",
        description="The lowest efficiency over all parameters, with its interval of 95 %.",
    )
    return {"efficiency": svg}


# -- angle -----------------------------------------------------------------------------------------


def _of_angle(shown: Sequence[Shown]) -> list[str]:
    text = [
        "![Error over the turn with a bias](angle-bias.svg)",
        "",
        f"The table is of a fixture of {TRACED_AT_DEG:g}°, the other fixtures follow.",
        "",
    ]
    head = [
        "plan",
        "part",
        "method",
        "error / °",
        "median / °",
        "largest / °",
        "bound / °",
        "times",
        "with reading / °",
    ]
    text += markdown(
        head, [row for one in shown if one.cell.fixture_deg == TRACED_AT_DEG for row in _rows(one)]
    )
    others = [one for one in shown if _is_example(one.cell)]
    if len(others) > 1:
        text += [
            "",
            "Twelve angles there and back, a bias of 10 mg, by the fixture: error / ° (times the bound).",
            "",
        ]
        methods = [m for m in ORDER if all(m in one.calibration for one in others)]
        rows = []
        for one in others:
            found = [figures(one, m) for m in methods]
            cells_ = [f"{f.rms:.4f} ({f.ratio:.2f})" if f.ratio else "–" for f in found]
            rows.append([f"{one.cell.fixture_deg:g}°", *cells_, f"{found[-1].bound or math.nan:.4f}"])
        text += markdown(["fixture", *(f"`{m}`" for m in methods), "bound / °"], rows)
    if any(one.cell.kind == "quadratic, cubic" for one in shown):
        text += ["", "![Error over the turn with two effects](angle-effects.svg)"]
    return text


def _is_example(cell: Cell) -> bool:
    return cell.plan == "tumble" and cell.positions == 12 and cell.kind == "bias"


def _rows(one: Shown) -> list[list[str]]:
    rows = []
    for method in ORDER:
        if method not in one.calibration:
            continue
        own, whole = figures(one, method), figures(one, method, "total")
        rows.append(
            [
                one.cell.name,
                one.cell.kind,
                f"`{method}`" + (f" ({own.refused} refused)" if own.refused else ""),
                f"{own.rms:.4f}",
                f"{own.median:.4f}",
                f"{own.largest:.4f}",
                "–" if own.bound is None else f"{own.bound:.4f}",
                _times(own),
                f"{whole.rms:.4f}" + ("" if whole.bound is None else f" ({whole.bound:.4f})"),
            ]
        )
    return rows


def _times(found: Figures) -> str:
    if found.ratio is None or found.half is None:
        return "–"
    if not math.isfinite(found.half):
        return f"{found.ratio:.2f}"
    digits = 1 if found.ratio > 10 else 2 if found.half > 0.005 else 4
    return f"{found.ratio:.{digits}f} ± {found.half:.{digits}f}"


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
        elif cell.kind == "quadratic, cubic":
            drawn = ("four-position", "mmpm", "ml", "trace")
            made["effects"] = _turn_figure(one, drawn, "Error over the turn, quadratic and cubic effect")
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
