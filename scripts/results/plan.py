"""Plans: predicted and simulated uncertainties, gain of the best plans, effects named by order."""

from __future__ import annotations

from typing import Any

import plan_statistics as statistics
from plan_statistics import CLOSE, Line
from results.section import Effort, Section, svg

CASE, CHIP_FIXTURE_DEG = "best 12", 0.05


def run(effort: Effort) -> Section:
    """Measure all plans, the chip and the names."""
    sessions = effort.sessions(1000, 4)
    fixtures = (0.05,) if effort.fast else statistics.FIXTURES_DEG
    most = 12 if effort.fast else 24
    lines = statistics.run(sessions, effort.seed, effort.jobs, fixtures, most)
    chip_sessions = effort.sessions(24, 1)
    (case,) = [c for c in statistics.cases((CHIP_FIXTURE_DEG,), most) if c.name == CASE]
    chip = statistics.through_the_chip(case, chip_sessions, effort.seed % 10**6)
    traced = effort.sessions(12, 1)
    names = statistics.names_found(8 if effort.fast else 12, traced, effort.seed)
    return section(lines, sessions, chip, chip_sessions, names, traced)


def section(
    lines: list[Line],
    sessions: int,
    chip: list[Line],
    chip_sessions: int,
    names: dict[str, dict[str, list[int]]],
    traced: int,
) -> Section:
    """Make the section of the measured lines."""
    document = {
        "sessions": sessions,
        "lines": [_line_entry(line) for line in lines],
        "chip": {"sessions": chip_sessions, "lines": [_line_entry(line) for line in chip]},
        "names": {"sessions": traced, "right_and_wrong": names},
    }
    return Section(document, {"ratios": _figure(lines)})


def _line_entry(line: Line) -> dict[str, Any]:
    return {**vars(line), "ratio": line.ratio}


def _figure(lines: list[Line]) -> str:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"svg.hashsalt": "plan", "svg.fonttype": "none"}):
        figure = Figure(figsize=(7, 3.2), layout="constrained")
        axes = figure.subplots()
        labels = list(dict.fromkeys(line.case for line in lines))
        for name in statistics.NAMES:
            own = [line for line in lines if line.name == name]
            shift = 0.08 * (statistics.NAMES.index(name) - 3.5)
            axes.plot(
                [labels.index(x.case) + shift for x in own], [x.ratio for x in own], "o", ms=3, label=name
            )
        axes.axhspan(1 - CLOSE, 1 + CLOSE, color="0.9", zorder=0)
        axes.axhline(1, color="0.5", lw=0.8)
        axes.set_xticks(range(len(labels)), labels, rotation=25, ha="right")
        axes.set_ylabel("simulated / predicted u")
        axes.legend(ncols=4, fontsize="x-small", loc="lower right")
        return svg(figure)
