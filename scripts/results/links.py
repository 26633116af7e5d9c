"""Poses in space with recorded turns: coverage, gain by the turns, wrong gyros."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import links_statistics as links
from results.section import Effort, Section

SESSIONS = 120


def run(effort: Effort) -> Section:
    """Simulated hands, two parts in turn."""
    at = (4, links.FALSE_POSES) if effort.fast else links.POSES
    return section_of(links.run(effort.sessions(SESSIONS, 1), effort.seed, effort.jobs, at))


def section_of(rows: Sequence[Mapping[str, Any]]) -> Section:
    """Make the section of the measured rows."""
    found = links.summary([dict(row) for row in rows])
    return Section({"links": found}, {"ratio": _figure(found)})


def _way_name(way: str) -> str:
    return {"alone": "gravity alone", "sheet": "data sheet", "calibrated": "calibrated"}[way]


def _figure(found: Mapping[str, Any]) -> str:
    """Draw the u of skews with turns over the u by gravity alone."""
    from adis_gonio.page.document import Series, plot

    lines = []
    for part, way, role in [
        (links.PARTS[0], "sheet", "before"),
        (links.PARTS[0], "calibrated", "after"),
    ]:
        at = [
            (float(poses), one[way]["ratio"][part]["skew"])
            for poses, one in found["poses"].items()
            if one[way]["ratio"][part]["skew"] is not None
        ]
        x, y = np.array(at).T if at else (np.zeros(0), np.zeros(0))
        lines.append(Series(x, y, f"{part}, {_way_name(way)}", role=role))
    return plot(lines, "poses", "u of skews over that by gravity alone", title="What turns gain")
