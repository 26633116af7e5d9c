"""Plans: predicted and simulated uncertainties, what the best plans gain, and names told apart by order."""

from __future__ import annotations

from typing import Any

import numpy as np

import plan_statistics as statistics
from plan_statistics import APART, CLOSE, TIMES, Line
from results.section import Effort, Section, svg, table

CASE, CHIP_FIXTURE_DEG = "best 12", 0.05
TARGET = ("two-position", "four-position", "mmpm", "tumble 12", "best 12", "best 24")


def run(effort: Effort) -> Section:
    """The section."""
    sessions = effort.sessions(1000, 20)
    fixtures = (0.05,) if effort.fast else statistics.FIXTURES_DEG
    lines = statistics.run(sessions, effort.seed, effort.jobs, fixtures)
    chip_sessions = effort.sessions(24, 1)
    (case,) = [c for c in statistics.cases((CHIP_FIXTURE_DEG,)) if c.name == CASE]
    chip = statistics.through_the_chip(case, chip_sessions, effort.seed % 10**6)
    traced = effort.sessions(12, 1)
    names = statistics.names_found(12, traced, effort.seed)
    return section(lines, sessions, chip, chip_sessions, names, traced)


def section(
    lines: list[Line],
    sessions: int,
    chip: list[Line],
    chip_sessions: int,
    names: dict[str, dict[str, list[int]]],
    traced: int,
) -> Section:
    """The page of what was found."""
    fixtures = tuple(dict.fromkeys(line.fixture_deg for line in lines))
    document = {
        "sessions": sessions,
        "lines": [_told(line) for line in lines],
        "chip": {"sessions": chip_sessions, "lines": [_told(line) for line in chip]},
        "names": {"sessions": traced, "right_and_wrong": names},
    }
    text = "\n\n".join(
        (
            _predicted(lines, sessions),
            _gained(lines, fixtures),
            _chip(chip, chip_sessions),
            _names(names, traced),
        )
    )
    return Section("Plans: what was predicted, and what came", text, document, {"ratios": _figure(lines)})


def _told(line: Line) -> dict[str, Any]:
    return {**vars(line), "ratio": line.ratio}


def _predicted(lines: list[Line], sessions: int) -> str:
    own = [line for line in lines if line.case in TARGET]
    beyond = [line for line in own if abs(line.ratio - 1) > CLOSE]
    ratios = np.array([line.ratio for line in own])
    error = own[0].standard_error
    rows = []
    for case, fixture in dict.fromkeys((line.case, line.fixture_deg) for line in lines):
        found = {x.name: x.ratio for x in lines if (x.case, x.fixture_deg) == (case, fixture)}
        cells = [f"{found[n]:.3f}" if n in found else "–" for n in statistics.NAMES]
        rows.append((case, f"{fixture}°", *cells))
    told = ", ".join(f"{x.case} {x.fixture_deg}° {x.name} {x.ratio:.3f}" for x in beyond)
    return (
        f"Root mean square errors of {sessions} simulated sessions a plan through the uncertainties that "
        f"were predicted for start angles within ±5°, as they "
        f"are drawn. Each ratio has a standard error of {error:.3f} by the number of sessions alone. "
        f"Of the {len(own)} ratios of the six plans that are promised, {len(own) - len(beyond)} are within "
        f"5 % of 1; their mean is {ratios.mean():.4f}, their scatter {ratios.std():.4f}, where that many "
        f"sessions alone scatter by {error:.4f}. Beyond 5 %: {told or 'none'}; beyond 5 % and three "
        f"standard errors: {sum(x.missed for x in own)}. *angle* is the error of the fitted parameters in "
        "the shown angle, at the worst place of the turn. The sensor has 10 mg of bias, 4.7 mg of noise a "
        "sample and 0.1 mg of 1/f noise.\n\n"
        + "\n".join(table(("plan", "fixture", *statistics.NAMES), rows))
        + "\n\n"
        "![Simulated through predicted](plan-ratios.svg)"
    )


def _gained(lines: list[Line], fixtures: tuple[float, ...]) -> str:
    head = ("best", "over", "fixture", "quantity", "predicted gain", "simulated gain")
    rows = []
    by = {(x.case, x.fixture_deg, x.name): x for x in lines}
    pairs = (("best 12", "even 12"), ("best 12", "tumble 12"), ("best 24", "even 24"))
    for best, other in pairs:
        for fixture in fixtures:
            for name in ("angle", "delta_k", "delta_phi"):
                one, two = by[best, fixture, name], by[other, fixture, name]
                predicted, simulated = two.predicted / one.predicted, two.simulated / one.simulated
                error = simulated * np.hypot(one.standard_error, two.standard_error)
                gains = (f"× {predicted:.2f}", f"× {simulated:.2f} ± {error:.2f}")
                rows.append((best, other, f"{fixture}°", name, *gains))
    return (
        "## The best plan's gain\n\nThe other plan's uncertainty through that of the best.\n\n"
        + "\n".join(table(head, rows))
    )


def _chip(lines: list[Line], sessions: int) -> str:
    told = "; ".join(f"{x.name} {x.ratio:.2f} ± {x.standard_error:.2f}" for x in lines)
    return (
        f"## Through the simulated chip\n\n{sessions} sessions of the best 12 positions at a fixture of "
        f"{CHIP_FIXTURE_DEG}°, measured through driver, archive and the session's own noise: simulated "
        f"through predicted {told}."
    )


def _names(names: dict[str, dict[str, list[int]]], sessions: int) -> str:
    head, rows = ("order", "effect", "its name alone", "another name"), []
    for kind, by_effect in names.items():
        for name, (right, wrong) in by_effect.items():
            rows.append((kind, name, f"{right} of {sessions}", f"{wrong} of {sessions}"))
    return (
        "## Told apart by order\n\n12 positions at a fixture of 0.01°, best to tell "
        f"{' from '.join(APART)}, and the same number evenly spaced in turn. One effect a session, "
        f"{TIMES} times what the best plan sees (on X, or the eccentricity's sine); traced.\n\n"
        + "\n".join(table(head, rows))
    )


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
