"""The free turn: coverage of its uncertainties, and its angle against that of 24 dwells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import free_turn_statistics as hands
from results.section import Effort, Section

HANDS, BESIDE = 500, 60
_LABELS = {
    "delta_k": "ΔK",
    "delta_phi": "Δφ",
    "bias_x": "bias of X",
    "bias_y": "bias of Y",
    "angle": "angle",
}


def run(effort: Effort) -> Section:
    """Simulated hands, two turns each; some of the parts turned forth and back, and once, beside them."""
    beside = effort.sessions(BESIDE, 2)
    return section_of(
        hands.run(effort.sessions(HANDS, 2), effort.seed, effort.jobs, 2),
        hands.run(beside, effort.seed, effort.jobs, 2, returns=True),
        hands.run(beside, effort.seed, effort.jobs, 1),
    )


def section_of(
    twice: Sequence[Mapping[str, Any]], back: Sequence[Mapping[str, Any]], once: Sequence[Mapping[str, Any]]
) -> Section:
    """The page of results by hand: two turns on, forth and back, and one turn."""
    two, to_and_fro, one = (hands.summary(rows) for rows in (twice, back, once))
    met = "met" if two["ratio_95"][1] <= two["target_ratio"] else "not shown to be met"
    coverage = "\n".join(
        f"| {_LABELS[name]} | {100 * share:.1f} ± {100 * two['coverage_u']:.1f} % |"
        f" {100 * to_and_fro['coverage'][name]:.1f} % | {100 * one['coverage'][name]:.1f} % |"
        for name, share in two["coverage"].items()
    )
    scatter = ", ".join(f"{_LABELS[name]} {value:.2f}" for name, value in two["scatter_over_u"].items())
    refused = " and ".join(str(len(found["refused"])) for found in (two, to_and_fro, one))
    markdown = f"""
{two["hands"]} simulated hands turn a part twice in 60 s of recording, rests included, as
`calibrate --plan free-turn` asks for; {one["hands"]} of the same parts are turned forth and back too,
and once, in the same time. The gyros have bias, 1/f drift, rate random walk, linear g-sensitivity,
scale error and misalignment; the hand stops for new grips, is uneven, trembles and shakes; the part lies
off the axis, whose bearing wobbles. What the chip's filter makes of it is fitted without declared angles.

## Coverage of U (95 %)

| | two turns | forth and back | one turn (`--turns 1`) |
|---|---|---|---|
{coverage}

A share of 95 % over {one["hands"]} hands is uncertain by {100 * one["coverage_u"]:.1f} % (one sigma).
Scatter over stated u, two turns: {scatter}; u itself scatters,
by its degrees of freedom, for which U has its factor. Refused: {refused}.

## Error of the angle, against 24 dwells

Angle of gravity to X shown for readings without noise minus the true one, rms around the turn and over all
hands. The dwells are those of `tumble`, twelve angles there and back, 2.5 s each, fixture 0.02°, fitted by
`ml`: the same 60 s of samples. Moving and settling between them take about another 50 s, which count for
nothing.

| | rms | 24 dwells, same parts | ratio | 95 % |
|---|---|---|---|---|
{_row("two turns", two)}
{_row("forth and back", to_and_fro)}
{_row("one turn", one)}

The target is a ratio of {two["target_ratio"]}: {met} by two turns. By the budget of `fit` the 1/f drift of
the accelerometers is most of the variance: one turn in a minute puts bias, gain and misalignment at one and
two cycles a recording, where the drift is strongest, while dwells there and back, over nearly twice the
time, see each angle twice. Two turns in the same minute, on and on or forth and back, see it twice too.

![Error of the angle, hand by hand](free_turn-errors.svg)
"""
    document = {"two_turns": two, "forth_and_back": to_and_fro, "one_turn": one}
    return Section("Free turn", markdown, document, {"errors": _figure(twice)})


def _row(name: str, found: Mapping[str, Any]) -> str:
    low, high = found["ratio_95"]
    return (
        f"| {name} | {found['angle_rms_deg']:.4f}° | {found['dwells_rms_deg']:.4f}° |"
        f" {found['ratio']:.2f} | {low:.2f} to {high:.2f} |"
    )


def _figure(rows: Sequence[Mapping[str, Any]]) -> str:
    """Sorted errors of the angle by both ways."""
    from adis_gonio.page.svg import Series, plot

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
