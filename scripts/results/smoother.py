"""The smoothed angle: error and coverage in motion and at rest, by lag, against gravity alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import smoother_statistics as hands
from results.section import Effort, Section, table

HANDS, RESTS = 50, 1000
LAGS_S = (0.0, 0.25, 0.5, 1.0)
WAYS = ("gravity", *(f"{lag:g}" for lag in LAGS_S), "offline")


def run(effort: Effort) -> Section:
    """Simulated hands, each with gyros that nobody has calibrated and with a calibration."""
    count = effort.sessions(HANDS, 2)
    lags = LAGS_S[:2] if effort.fast else LAGS_S
    return section_of(
        hands.run(count, effort.seed, effort.jobs, calibrated=False, lags_s=lags),
        hands.run(count, effort.seed, effort.jobs, calibrated=True, lags_s=lags),
        hands.rests(effort.sessions(RESTS, 4), effort.seed, effort.jobs),
    )


def section_of(
    plain: Sequence[Mapping[str, Any]], known: Sequence[Mapping[str, Any]], rests: Mapping[str, Any]
) -> Section:
    """The page of results without and with a calibration of the gyros, and of parts at rest."""
    without, with_one = hands.summary(plain), hands.summary(known)
    ways = [way for way in WAYS if way in without]
    rows = [_row(way, without[way], with_one[way]) for way in ways]
    head = (
        "", "rms, gyros as they come", "rms, calibrated", "coverage in motion", "calibrated",
        "rms at rest", "coverage at rest",
    )  # fmt: skip
    gain = without["gravity"]["motion"]["rms_deg"] / without[ways[-2]]["motion"]["rms_deg"]
    markdown = f"""
{without["hands"]} simulated hands turn a part by 90 to 400° between two rests, at 15 to 60 °/s, with stops,
uneven, with a tremor, and with a vibration of 2 to 30 mg; the part lies some centimetres off the axis.
Gyros have bias, 1/f noise, rate random walk, gain, misalignment and sensitivity to acceleration, either
unknown or calibrated with the errors that the calibration states. Ten angles a second, as `angle` shows
them, against the true angle at the time that each belongs to.

{chr(10).join(table(head, rows))}

Coverage is the share of angles within 1.96 u of the truth; ± is one standard deviation, from hand to hand
(angles of one hand lean on one another). The error in motion of gravity alone is {gain:.0f} times that of
the longest lag. With long lags u in motion is rather too large: what shakes gravity is told by a second of
samples, which says more of its fast part than of the slow one that a long lag averages.

What is left at rest is mostly the accelerometers' 1/f noise since they were calibrated. Its fast octaves
are averaged by the filter, and u holds what is left of them; the slow ones no gyro sees and no average
takes away: they are one draw for all of a rest, so that the table's hands say little of their size. Over
{rests["parts"]} parts at rest, one angle of each, lag 0.5 s, the coverage is
{100 * rests["coverage"]:.1f} ± {100 * rests["coverage_u"]:.1f} %, the mean square in units of u
{rests["normalised_square"]:.2f}.

![Error of the angle by lag](smoother-lag.svg)
"""
    figure = _figure(without, with_one, [way for way in ways if way not in ("gravity", "offline")])
    return Section(
        "The angle during the turn",
        markdown,
        {"plain": without, "calibrated": with_one, "rests": rests},
        {"lag": figure},
    )


def _row(way: str, plain: Mapping[str, Any], known: Mapping[str, Any]) -> tuple[str, ...]:
    names = {"gravity": "gravity alone, 0.1 s", "0": "filter (lag 0)", "offline": "offline, all samples"}
    motion = plain["motion"]
    return (
        names.get(way, f"lag {way} s"),
        f"{motion['rms_deg']:.3f}°",
        f"{known['motion']['rms_deg']:.3f}°",
        _share(motion),
        _share(known["motion"]),
        f"{known['rest']['rms_deg']:.4f}°",
        _share(known["rest"]),
    )


def _share(found: Mapping[str, Any]) -> str:
    if "coverage" not in found:
        return "–"
    return f"{100 * found['coverage']:.1f} ± {100 * found['coverage_u']:.1f} %"


def _figure(plain: Mapping[str, Any], known: Mapping[str, Any], ways: Sequence[str]) -> str:
    """Rms error in motion against the lag."""
    from adis_gonio.page.svg import Series, plot

    lags = [float(way) for way in ways]
    lines = [
        Series(lags, [found[way]["motion"]["rms_deg"] for way in ways], label, role=role)
        for found, label, role in ((plain, "gyros as they come", "before"), (known, "calibrated", "after"))
    ]
    return plot(lines, "lag / s", "rms error in motion / °", title="Error of the angle by lag", zero=True)
