"""Noise at rest: coverage, false findings, and the error of the usual reading of slopes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

import allan_boundary
import allan_statistics as allan
from results.section import Effort, Section, svg

SESSIONS = 120
DRAWS = 20000

Limits = Mapping[str, Mapping[str, float]]
"""Coverage of long records by case and kind."""
_NAMES = {
    "quantization": "quantization",
    "white": "random walk N",
    "flicker": "bias instability",
    "walk": "rate random walk K",
}


def run(effort: Effort) -> Section:
    """Measure every case of the script with three axes per session."""
    rows = allan.run(effort.sessions(SESSIONS, 1), effort.seed, effort.jobs)
    return section_of(allan.summary(rows), limits(effort.seed, effort.sessions(DRAWS, 500)))


def limits(seed: int, draws: int = DRAWS) -> Limits:
    """Coverage of long records, which the boundary at zero moves away from 95 %."""
    rng = np.random.default_rng(seed)
    return {name: allan_boundary.coverage(case, draws, rng) for name, case in allan.CASES.items()}


def section_of(cases: Mapping[str, Mapping[str, Any]], limits: Limits) -> Section:
    """The section of a summary, and of the coverage of long records."""
    return Section({"cases": cases, "limits": limits}, {"coverage": _coverage_figure(cases)})


def _each(
    cases: Mapping[str, Mapping[str, Any]], *, present: bool
) -> list[tuple[str, str, Mapping[str, Any]]]:
    return [
        (name, kind, found)
        for name, case in cases.items()
        for kind, found in case["kinds"].items()
        if (found["truth"] is not None) == present and "claimed" in found
    ]


def _coverage_figure(cases: Mapping[str, Mapping[str, Any]]) -> str:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    rows = list(reversed(_each(cases, present=True)))
    with mpl.rc_context({"svg.hashsalt": "allan", "svg.fonttype": "none"}):
        figure = Figure(figsize=(7, 0.26 * len(rows) + 1), layout="constrained")
        axes = figure.subplots()
        axes.axvspan(*(100 * share for share in allan.BAND), color="0.85", label="94 to 96 %")
        for place, (_, _, found) in enumerate(rows):
            low, high = (100 * share for share in found["coverage_95"])
            axes.plot([low, high], [place, place], color="C0")
            axes.plot(100 * found["coverage"], place, "o", color="C0")
        axes.set_yticks(range(len(rows)), [f"{name}: {_NAMES[kind]}" for name, kind, _ in rows])
        axes.set(xlabel="coverage / %, with its own 95 %")
        axes.legend(loc="lower left", frameon=False)
        return svg(figure)
