"""The free turn: coverage of its uncertainties, and its angle against that of 24 dwells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from section import Effort, Section, script

HANDS, TWICE = 500, 60
_LABELS = {
    "delta_k": "ΔK",
    "delta_phi": "Δφ",
    "bias_x": "bias of X",
    "bias_y": "bias of Y",
    "angle": "angle",
}


def run(effort: Effort) -> Section:
    """Simulated hands, one turn each, and some that turn twice in the same time."""
    hands = script("free_turn")
    once = hands.run(effort.sessions(HANDS, 4), effort.seed, effort.jobs)
    twice = hands.run(effort.sessions(TWICE, 2), effort.seed, effort.jobs, 2)
    return section_of(once, twice)


def section_of(once: Sequence[Mapping[str, Any]], twice: Sequence[Mapping[str, Any]]) -> Section:
    """The page of results by hand."""
    hands = script("free_turn")
    one, two = hands.summary(once), hands.summary(twice)
    met = "met" if one["ratio"] <= one["target_ratio"] else "not met"
    coverage = "\n".join(
        f"| {_LABELS[name]} | {100 * share:.1f} % | {100 * two['coverage'][name]:.1f} % |"
        for name, share in one["coverage"].items()
    )
    scatter = ", ".join(f"{_LABELS[name]} {value:.2f}" for name, value in one["scatter_over_u"].items())
    refused = f"{len(one['refused'])} and {len(two['refused'])}"
    markdown = f"""
{one["hands"]} simulated hands turn a part once in 60 s of recording, rests included, and {two["hands"]}
turn it twice in the same time. The gyros have bias, 1/f drift, rate random walk, linear g-sensitivity,
scale error and misalignment; the hand stops for new grips, is uneven, trembles and shakes; the part lies
off the axis, whose bearing wobbles. What the chip's filter makes of it is fitted without declared angles.

## Coverage of U (95 %)

| | one turn | two turns |
|---|---|---|
{coverage}

A share of 95 % over {one["hands"]} hands is uncertain by {100 * one["coverage_u"]:.1f} % (one sigma), over
{two["hands"]} by {100 * two["coverage_u"]:.1f} %. Scatter over stated u, one turn: {scatter}.
Refused: {refused}.

## Error of the angle, against 24 dwells

Angle of gravity to X shown for readings without noise minus the true one, rms around the turn and over all
hands. The dwells are those of `tumble`, twelve angles there and back, 2.5 s each, fixture 0.02°, fitted by
`ml`: the same 60 s of samples. Moving and settling between them take about another 50 s, which count for
nothing.

| | rms | 24 dwells, same parts | ratio | 95 % |
|---|---|---|---|---|
{_row("one turn", one)}
{_row("two turns in the same time", two)}

The target is a ratio of {one["target_ratio"]}: {met} by one turn. By the budget of `fit` the 1/f drift of
the accelerometers is most of the variance: one turn in a minute puts bias, gain and misalignment at one and
two cycles a recording, where the drift is strongest, while dwells there and back, over nearly twice the
time, see each angle twice. Two turns in the same minute, without a stop between them, see it twice too.

![Error of the angle, hand by hand](free_turn-errors.svg)
"""
    document = {"one_turn": one, "two_turns": two}
    return Section("Free turn", markdown, document, {"errors": _figure(once)})


def _row(name: str, found: Mapping[str, Any]) -> str:
    low, high = found["ratio_95"]
    return (
        f"| {name} | {found['angle_rms_deg']:.4f}° | {found['dwells_rms_deg']:.4f}° |"
        f" {found['ratio']:.2f} | {low:.2f} to {high:.2f} |"
    )


def _figure(rows: Sequence[Mapping[str, Any]]) -> str:
    """Sorted errors of the angle by both ways."""
    from adis_gonio.report.svg import Series, plot

    good = [row for row in rows if "refused" not in row]
    share = (np.arange(len(good)) + 0.5) / len(good)
    lines = [
        Series(np.sort([1000 * row[key] for row in good]), share, label, role=role)
        for key, label, role in (
            ("angle_rms_deg", "free turn", "after"),
            ("dwells_rms_deg", "24 dwells", "before"),
        )
    ]
    return plot(lines, "rms error of the angle (0.001°)", "share of hands", title="Error of the angle")
