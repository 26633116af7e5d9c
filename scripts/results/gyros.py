"""Gains of the gyros from whole turns by hand: coverage, and u against the bound of each session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import gyro_scale_statistics as hands
from results.section import Effort, Section

HANDS = 500


def run(effort: Effort) -> Section:
    """Measure simulated hands with five turns each way about each axis."""
    return section_of(hands.run(effort.sessions(HANDS, 1), effort.seed, effort.jobs))


def section_of(rows: Sequence[Mapping[str, Any]]) -> Section:
    """Make the section of the measured rows."""
    found = hands.summary(rows)
    return Section({"gyro_scale": found}, {"errors": _figure(rows)})


def _figure(rows: Sequence[Mapping[str, Any]]) -> str:
    """Draw the sorted errors and uncertainties in units of each session's bound."""
    from adis_gonio.page.document import Series, plot

    good = [row for row in rows if "refused" not in row]
    least, off, u = (np.array([row[key] for row in good]).ravel() for key in ("bound", "off", "u"))
    share = (np.arange(len(off)) + 0.5) / len(off)
    lines = [
        Series(np.sort(np.abs(off) / least), share, "size of the error", role="before"),
        Series(np.sort(u / least), share, "u", role="after"),
    ]
    return plot(lines, "in units of the session's bound", "share of the gains", title="Gains of the gyros")
