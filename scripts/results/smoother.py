"""The smoothed angle: error and coverage in motion and at rest, by lag, against gravity alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import smoother_statistics as hands
from results.section import Effort, Section

HANDS, RESTS = 50, 1000
LAGS_S = (0.0, 0.25, 0.5, 1.0)
WAYS = ("gravity", *(f"{lag:g}" for lag in LAGS_S))


def run(effort: Effort) -> Section:
    """Measure simulated hands with uncalibrated and with calibrated gyros."""
    count = effort.sessions(HANDS, 1)
    lags = LAGS_S[:2] if effort.fast else LAGS_S
    return section_of(
        hands.run(count, effort.seed, effort.jobs, calibrated=False, lags_s=lags),
        hands.run(count, effort.seed, effort.jobs, calibrated=True, lags_s=lags),
        hands.rests(effort.sessions(RESTS, 4), effort.seed, effort.jobs),
    )


def section_of(
    plain: Sequence[Mapping[str, Any]], known: Sequence[Mapping[str, Any]], rests: Mapping[str, Any]
) -> Section:
    """The section without and with a calibration of the gyros, and of parts at rest."""
    without, with_one = hands.summary(plain), hands.summary(known)
    ways = [way for way in WAYS if way in without]
    figure = _figure(without, with_one, [way for way in ways if way not in ("gravity")])
    return Section(
        {"plain": without, "calibrated": with_one, "rests": rests},
        {"lag": figure},
    )


def _figure(plain: Mapping[str, Any], known: Mapping[str, Any], ways: Sequence[str]) -> str:
    """Draw the rms error in motion against the lag."""
    from adis_gonio.page.document import Series, plot

    lags = [float(way) for way in ways]
    lines = [
        Series(lags, [found[way]["motion"]["rms_deg"] for way in ways], label, role=role)
        for found, label, role in ((plain, "gyros as they come", "before"), (known, "calibrated", "after"))
    ]
    return plot(lines, "lag / s", "rms error in motion / °", title="Error of the angle by lag", zero=True)
