"""The uncertainty budget: which source contributes what to ΔK, Δφ and the angle that the goniometer shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from adis_gonio.estimation.fit import Fit
from adis_gonio.estimation.values import Value, finite_or_none
from adis_gonio.fitting.sources import Sources, dof_of
from adis_gonio.model.records import Floats

PLACES = 72
"""Angles of a turn over which the uncertainty of a shown angle is averaged."""


@dataclass(frozen=True)
class BudgetRow:
    """One source in the budget of one quantity.

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
    kind: str
    distribution: str
    u: float | None
    unit: str
    sensitivity: float | None
    contribution: float
    dof: float
    share: float
    note: str = ""

    def as_dict(self) -> dict[str, Any]:
        """One row of `budget`."""
        return {
            "source": self.source,
            "type": self.kind,
            "distribution": self.distribution,
            "u": finite_or_none(self.u),
            "unit": self.unit,
            "sensitivity": finite_or_none(self.sensitivity),
            "contribution": self.contribution,
            "dof": finite_or_none(self.dof),
            "share": self.share,
            "note": self.note,
        }


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


@dataclass(frozen=True)
class ShownAngle:
    """The angle that the calibrated goniometer shows for a reading as long as the session's dwells.

    Attributes
    ----------
    gradient : (m, p) float
        Degrees by the parameters in natural units, at m places all around the turn.
    reading : (m, axes) float
        Degrees per mg of the reading.
    """

    gradient: Floats
    reading: Floats

    @classmethod
    def of(cls, fit: Fit, places: int = PLACES) -> ShownAngle:
        """At the values of a planar fit.

        Where no angle is declared there is no zero of the stage, and the angle is that of gravity to X.
        """
        base, gravity = fit.values.base, fit.data.gravity_mg
        _, k_x, k_y, skew = base
        psi = np.linspace(0, 2 * math.pi, places, endpoint=False)
        x, y = np.cos(psi), np.sin(psi + skew)
        tan, cos = math.tan(skew), math.cos(skew)
        u, v = np.cos(psi), np.sin(psi)
        # Angle ψ = atan2(v, u) with u = (U_x − b_x)/(G K_x), v = ((U_y − b_y)/(G K_y) − u sin Δφ)/cos Δφ.
        by_x, by_y = -v - u * tan, u / cos
        gradient = np.zeros((places, len(base) + 2))
        gradient[:, 0] = 1.0 if fit.data.visible[0] else 0.0
        gradient[:, 1] = by_x * x / k_x
        gradient[:, 2] = by_y * y / k_y
        gradient[:, 3] = -u * (y * math.sin(skew) - x) / cos**2
        gradient[:, 4], gradient[:, 5] = by_x / k_x, by_y / k_y
        reading = -np.stack([by_x / k_x, by_y / k_y], axis=1) / gravity
        return cls(np.degrees(gradient), np.degrees(reading))

    def value(self, sources: Sources, error_deg: float) -> Value:
        """An observed error of the angle with the uncertainty of a shown angle."""
        u, dof = sources.uncertainty(self.gradient, self.reading)
        return Value(error_deg, u, "deg", dof)


def worst_first(rows: Sequence[BudgetRow]) -> list[BudgetRow]:
    """Rows by their share."""
    return sorted(rows, key=lambda row: -row.share)
