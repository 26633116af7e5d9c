"""A trace and what declared, gravity's and the gyro's angles say of the positions: one story.

An effect of one dwell (`position_slip`, `outlier_dwell`) that the three angles rule out is no candidate. A
`position_slip` that they show, and that no linear problem reaches, begins at its size. A part that slipped
for all that followed has no name among the effects. A slip that is gross is taken out before the search,
and the trace says so; a smaller one competes as a step of the true angle with whatever else may have turned
the part by and by.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.fitting.slips import Diagnosis, PositionFinding
from adis_gonio.tracing.outcome.result import TraceResult

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
    return [f for f in positions.findings if f.finding == "slipped" and _out_of_reach(data, f)]


def _out_of_reach(data: Readings, found: PositionFinding) -> bool:
    """Whether the linear problem does not reach an error of a position.

    Off by δ, a reading is G (1 − cos δ) shorter along its old direction than a slip says (2 mg at 4°): out
    of reach is what shortens it by more than its uncertainty.
    """
    shorter = data.gravity_mg * (1 - math.cos(math.radians(found.error_deg[0])))
    return shorter > math.sqrt(float(np.median(data.variance_of_mean)))


def as_the_angles_leave(
    terms: Sequence[NamedTerm], data: Readings, positions: Diagnosis
) -> list[NamedTerm]:
    """Candidates without effects of one dwell that cannot be, and with the sizes of slips that are gross.

    A reading that is right has no `outlier_dwell`; what stood where it was declared has no `position_slip`.
    """
    order = data.conditions.order
    if order is None:
        return list(terms)
    of_position = dict(zip(data.position.tolist(), order.tolist(), strict=True))
    gone: set[tuple[str | None, int | None]] = set()
    begins: dict[tuple[str | None, int | None], float] = {}
    for found in positions.findings:
        if found.position not in of_position:
            continue  # a check dwell
        names = {named.name for named in found.names}
        number = int(of_position[found.position])
        if found.finding in _MOVED and "gravity_wrong" not in names:
            gone.add(("outlier_dwell", number))
        if names == {"gravity_wrong"}:
            gone.add(("position_slip", number))
        if found.finding in _MOVED and _out_of_reach(data, found):
            # ψ = α − θ: what stands further on by e has a slip of −e.
            begins["position_slip", number] = -found.error_deg[0]
    kept = [term for term in terms if (term.name, term.dwell) not in gone]
    return [
        replace(term, begins=begins[key]) if (key := (term.name, term.dwell)) in begins else term
        for term in kept
    ]


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
