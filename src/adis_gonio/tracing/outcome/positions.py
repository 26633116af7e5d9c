"""A trace and what declared, gravity's and the gyro's angles say of the positions: one story.

An effect of one dwell (`position_slip`, `outlier_dwell`) that the three angles rule out is no candidate.
A part that slipped for all that followed has no name among the effects. A slip that is gross is taken out
before the search, and the trace says so; a smaller one competes as a step of the true angle with whatever
else may have turned the part by and by.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adis_gonio.estimation.readings import Readings
from adis_gonio.slips import Diagnosis, PositionFinding
from adis_gonio.tracing.outcome.result import TraceResult
from adis_gonio.tracing.selection.select import out_of_reach

_MOVED = frozenset({"mistyped", "misset", "swapped"})


def as_the_part_stood(data: Readings, positions: Diagnosis) -> Readings:
    """The readings with gross slips that last taken out; the same where there is none.

    The stage's dial, and with it its errors, stays where it was: `Conditions.angle_rad` is not moved.
    """
    moved_deg = np.zeros(len(data))
    for found in _gross(data, positions):
        moved_deg[np.isin(data.position, [found.position, *found.others])] += found.error_deg[0]
    return replace(data, angle_rad=data.angle_rad + np.radians(moved_deg)) if moved_deg.any() else data


def _gross(data: Readings, positions: Diagnosis) -> list[PositionFinding]:
    """Slips that last and that no linear problem reaches."""
    lasting = [found for found in positions.findings if found.finding == "slipped"]
    return [f for f in lasting if out_of_reach(data, np.radians(f.error_deg[0])).mean() > 0.5]


def ruled_out(data: Readings, positions: Diagnosis) -> frozenset[tuple[str, int]]:
    """Effects of one dwell that cannot be: its reading is right, or it stood where it was declared."""
    order = data.conditions.order
    if order is None:
        return frozenset()
    of_position = dict(zip(data.position.tolist(), order.tolist(), strict=True))
    gone = set()
    for found in positions.findings:
        names = {named.name for named in found.names}
        number = int(of_position[found.position])
        if found.finding in _MOVED and "gravity_wrong" not in names:
            gone.add(("outlier_dwell", number))
        if names == {"gravity_wrong"}:
            gone.add(("position_slip", number))
    return frozenset(gone)


def with_positions(result: TraceResult, data: Readings, positions: Diagnosis) -> TraceResult:
    """The trace with what is said of positions, and how they are put right before anything else."""
    if not positions.findings:
        return result
    said = list(positions.sentences)
    said += [_traced_without(found) for found in _gross(data, positions)]
    return replace(
        result,
        position_findings=positions.findings,
        notes=(*result.notes, *said),
        advice=(*_first(positions), *result.advice),
    )


def _traced_without(found: PositionFinding) -> str:
    return (
        f"traced as the part stood: {found.error_deg[0]:+.2f}° from position {found.position} on, whose"
        " uncertainty is not in these figures"
    )


def _first(positions: Diagnosis) -> tuple[str, ...]:
    mended = [found.correction for found in positions.findings if found.correction is not None]
    repeated = [str(found.position) for found in positions.findings if found.correction is None]
    said = []
    if mended:
        each = dict.fromkeys(part for text in mended for part in text.split(","))
        said.append(f"look at what was written down; then trace again with --angles {','.join(each)}")
    if repeated:
        said.append(f"repeat position {', '.join(repeated)}")
    return tuple(said)


__all__ = ["as_the_part_stood", "ruled_out", "with_positions"]
