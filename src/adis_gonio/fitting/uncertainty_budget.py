"""The uncertainty budget: which source contributes what to ΔK, Δφ and the angle that is shown."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord, key
from adis_gonio.fitting.sources import Sources, dof_of

ROUNDING = 1e-10
"""Share of u below which a contribution is what a computation rounds."""


@dataclass(frozen=True)
class BudgetRow(JsonRecord):
    """One source in the budget of one quantity.

    The JSON document is one row of `budget`.

    Attributes
    ----------
    source, kind, distribution : str
        Name, type (`A` or `B`) and distribution.
    u, unit : float or None, str
        Standard uncertainty of the source itself; None where nothing states it.
    sensitivity : float or None
        Contribution per u; of a source that acts in every dwell on its own, the root of the sum of squares.
    contribution : float
        Standard uncertainty that it brings, in the unit of the quantity.
    dof : float
        Effective degrees of freedom; inf where unlimited.
    share : float
        Of the variance; the shares of a budget add up to 1.
    """

    source: str
    kind: str = field(metadata=key("type"))
    distribution: str
    u: float | None
    unit: str
    sensitivity: float | None
    contribution: float
    dof: float
    share: float
    note: str = ""


def budget_of(sources: Sources, gradient: Floats, reading: Floats | None = None) -> tuple[BudgetRow, ...]:
    """Budget of one quantity.

    Parameters
    ----------
    gradient : (m, p) float
        In the quantity's unit by the parameters in natural units; the mean square over m is meant.
    reading : (m, axes) float, optional
        The same by one further reading, per mg.
    """
    total, _ = sources.uncertainty(gradient, reading)
    rows = []
    for source in sources.each:
        parts = source.parts(gradient, reading)
        contribution = math.sqrt(sum(part[2] for part in parts))
        if contribution < ROUNDING * total:
            contribution = 0.0
        known = source.u is not None and source.u > 0
        rows.append(
            BudgetRow(
                source=source.name,
                kind=source.kind,
                distribution=source.distribution,
                u=source.u,
                unit=source.unit,
                sensitivity=contribution / source.u if source.u is not None and known else None,
                contribution=contribution,
                dof=dof_of(parts),
                share=0.0 if source.by_definition or total == 0 else (contribution / total) ** 2,
                note=source.note,
            )
        )
    return tuple(rows)
