"""A trace and what declared, gravity's and the gyro's angles say of the positions: one story.

An effect of one dwell (`position_slip`, `outlier_dwell`) that the three angles rule out is no candidate.
A part that slipped for all that followed has no name among the effects: the trace is then of the session as
the part stood, and says so.
"""

from __future__ import annotations

from dataclasses import replace

from adis_gonio.estimation.readings import Readings
from adis_gonio.model.records import Dwell, Session
from adis_gonio.slips import Diagnosis, PositionFinding
from adis_gonio.tracing.outcome.result import TraceResult

_MOVED = frozenset({"mistyped", "misset", "swapped"})


def as_the_part_stood(session: Session, positions: Diagnosis) -> Session:
    """The session with slips that last taken out; the same where there is none."""
    lasting = [found for found in positions.findings if found.finding == "slipped"]
    if not lasting:
        return session
    moved = {dwell.position: 0.0 for dwell in session.dwells}
    for found in lasting:
        for position in (found.position, *found.others):
            moved[position] += found.error_deg[0]
    return replace(session, dwells=tuple(_moved(dwell, moved[dwell.position]) for dwell in session.dwells))


def _moved(dwell: Dwell, by_deg: float) -> Dwell:
    angle = dwell.angle_deg
    return dwell if angle is None or not by_deg else replace(dwell, angle_deg=angle + by_deg)


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


def with_positions(result: TraceResult, positions: Diagnosis) -> TraceResult:
    """The trace with what is said of positions, and how they are put right before anything else."""
    if not positions.findings:
        return result
    said = list(positions.sentences)
    lasting = [found for found in positions.findings if found.finding == "slipped"]
    said += [_traced_without(found) for found in lasting]
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
