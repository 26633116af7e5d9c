"""The free turn: coverage of its uncertainties, and its angle against 24 dwells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import free_turn_statistics as hands
from results.section import Effort, Section

HANDS, FEWER_HANDS = 500, 60


def run(effort: Effort) -> Section:
    """Measure two turns; for fewer parts also a turn forth and back, and one turn."""
    fewer = effort.sessions(FEWER_HANDS, 1)
    return section_of(
        hands.run(effort.sessions(HANDS, 1), effort.seed, effort.jobs, 2),
        hands.run(fewer, effort.seed, effort.jobs, 2, returns=True),
        hands.run(fewer, effort.seed, effort.jobs, 1),
    )


def section_of(
    twice: Sequence[Mapping[str, Any]], back: Sequence[Mapping[str, Any]], once: Sequence[Mapping[str, Any]]
) -> Section:
    """The section: two turns on, forth and back, and one turn."""
    two, to_and_fro, one = (hands.summary(rows) for rows in (twice, back, once))
    document = {"two_turns": two, "forth_and_back": to_and_fro, "one_turn": one}
    return Section(document, {"errors": _figure(twice)})


def _figure(rows: Sequence[Mapping[str, Any]]) -> str:
    """Draw the sorted errors of the angle by both methods."""
    from adis_gonio.page.document import Series, plot

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
