"""Gains of the gyros from whole turns by hand: coverage, and u against the bound of each session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import gyro_scale_statistics as hands
from results.section import Effort, Section, table

HANDS = 500


def run(effort: Effort) -> Section:
    """Simulated hands, five turns each way about each axis."""
    return section_of(hands.run(effort.sessions(HANDS, 2), effort.seed, effort.jobs))


def section_of(rows: Sequence[Mapping[str, Any]]) -> Section:
    """The page."""
    found = hands.summary(rows)
    ratio, share = found["u_over_bound"], found["share_of_bound"]
    over = found["u_rms"] / found["bound_rms"]
    met = "met" if over <= found["target_ratio"] else "not met"
    rows_told = [
        ("coverage of U (95 %), gains", f"{_percent(found['coverage'])} ± {_percent(found['coverage_u'])}"),
        ("coverage of U (95 %), misalignments", _percent(found["coverage_of_misalignment"])),
        ("u of a gain, rms", f"{100 * found['u_rms']:.4f} %"),
        ("error of a gain, rms", f"{100 * found['error_rms']:.4f} %"),
        ("bound of a gain, rms", f"{100 * found['bound_rms']:.4f} %"),
        (f"u over bound, rms over rms (target {found['target_ratio']}: {met})", f"{over:.2f}"),
        ("u over bound of its session, median", f"{ratio['median']:.2f}"),
        ("the same, 95 % quantile and largest", f"{ratio['quantile_95']:.2f}, {ratio['max']:.2f}"),
        ("scatter over stated u", f"{found['scatter_over_u']:.2f}"),
        ("u of gyro_misalignment_xy, yx, median", _leans(found)),
        ("refused", str(len(found["refused"]))),
    ]
    told = "\n".join(table(("figure", "value"), rows_told))
    markdown = f"""
## Gyro scale from hand turns

{found["hands"]} simulated hands turn a part of their own on a table as `calibrate --plan gyro-turns` asks
for: {hands.TURNS} whole turns each way with the X, the Y and the Z arrow up, between rests of
{hands.DWELL_S:.0f} s, at {found["rate_dps"]:.0f} °/s on the average of a turn and its rests,
{found["length_s"] / 60:.0f} minutes in all. Gains, misalignments and g-sensitivities are hidden, the
accelerometers' biases and skews too; the gyros have white noise and 1/f noise (0.015 °/s). The bound is the
Cramér–Rao bound of the gain of that very session.

{told}

What limits a gain from ten turns: of the bound's variance 1/f noise has {_percent(share["flicker"])}, white
noise {_percent(share["white"])}, the marks (0.05°) {_percent(share["marks"])}. A zero rate that wanders by
a hundredth of a degree a second for half a minute is a third of a degree in 1800°: what helps is to turn
faster, as far as the range allows, not longer. What the rests of a session show
of that noise goes into its u, which scatters with it. Three of the
six misalignments are limited by the angles between the accelerometers, which this plan does not measure
(within ±0.25°, and covered always); the other three are not.

![Error of the gains over their bound](gyros-errors.svg)
"""
    return Section("Gyros", markdown, {"gyro_scale": found}, {"errors": _figure(rows)})


def _leans(found: Mapping[str, Any]) -> str:
    """Of a misalignment that the accelerometers' skews leave alone, and of one that they hide."""
    return ", ".join(f"{found['misalignment_u_deg_by_name'][pair]:.3f}°" for pair in ("xy", "yx"))


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _figure(rows: Sequence[Mapping[str, Any]]) -> str:
    """Sorted sizes of error and of u, in units of each session's bound."""
    from adis_gonio.page.svg import Series, plot

    good = [row for row in rows if "refused" not in row]
    least, off, u = (np.array([row[key] for row in good]).ravel() for key in ("bound", "off", "u"))
    share = (np.arange(len(off)) + 0.5) / len(off)
    lines = [
        Series(np.sort(np.abs(off) / least), share, "size of the error", role="before"),
        Series(np.sort(u / least), share, "u", role="after"),
    ]
    return plot(lines, "in units of the session's bound", "share of the gains", title="Gains of the gyros")
