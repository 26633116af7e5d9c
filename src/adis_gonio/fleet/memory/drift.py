"""Drift between sessions: a weighted line with scatter between sessions that their u do not explain.

y_i = a + b t_i + w_i + e_i with e_i of standard deviation u_i and w_i of τ. τ² by Paule and Mandel
(J. Res. NBS 87, 1982, 377): the residual is then as large as expected. Its uncertainty is that of Knapp and
Hartung (Stat. Med. 22, 2003, 2693), never smaller than the stated u allow, with Student's t at n − 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.uncertainty import Value

YEAR_DAYS = 365.25
LEAST = 3
"""Sessions that a line needs, so that its scatter can be seen."""


@dataclass(frozen=True)
class Drift(JsonRecord):
    """A line through a series.

    Attributes
    ----------
    slope : Value
        A year, in `<unit>/a`.
    level : Value
        At `reference_day`.
    reference_day : float
        Weighted middle of the sessions, at which level and slope are independent; days of `when`.
    between : float
        Standard deviation τ between sessions beyond u.
    birge : float
        Birge's ratio: root of χ² per degree of freedom about the line, by the stated u alone.
    birge_p : float
        Probability of so much scatter, were the stated u all there is.
    p_value : float
        Of a slope so large, were there none.
    """

    slope: Value
    level: Value
    reference_day: float
    between: float
    birge: float
    birge_p: float
    p_value: float


def drift_of(day: Floats, value: Floats, u: Floats, unit: str) -> Drift | None:
    """Line through sessions; None where they are fewer than `LEAST` or all of one moment.

    Parameters
    ----------
    day, value, u : (n,) float
        Time in days, value and standard uncertainty above zero in `unit`.
    """
    if len(day) < LEAST or not np.ptp(day) > 0:
        return None
    from scipy.special import gammaincc, stdtr

    from adis_gonio.fleet.statistics import tau_of

    dof = len(day) - 2
    stated = _line(day, value, u**2)
    between = tau_of(lambda tau: _line(day, value, u**2 + tau**2)[-1], dof, value)
    middle, level, slope, variances, chi2 = _line(day, value, u**2 + between**2)
    scale = max(1.0, chi2 / dof)
    u_level, u_slope = (math.sqrt(scale * v) for v in variances)
    return Drift(
        slope=Value(slope * YEAR_DAYS, u_slope * YEAR_DAYS, f"{unit}/a", dof),
        level=Value(level, u_level, unit, dof),
        reference_day=middle,
        between=between,
        birge=math.sqrt(stated[-1] / dof),
        birge_p=float(gammaincc(dof / 2, stated[-1] / 2)),
        p_value=float(2 * stdtr(dof, -abs(slope) / u_slope)),
    )


def _line(
    day: Floats, value: Floats, variance: Floats
) -> tuple[float, float, float, tuple[float, float], float]:
    """Weighted middle, level there, slope a day, their variances, χ²."""
    weight = 1 / variance
    total = float(weight.sum())
    middle = float((weight * day).sum()) / total
    t = day - middle
    spread = float((weight * t**2).sum())
    level, slope = float((weight * value).sum()) / total, float((weight * t * value).sum()) / spread
    chi2 = float((weight * (value - level - slope * t) ** 2).sum())
    return middle, level, slope, (1 / total, 1 / spread), chi2
