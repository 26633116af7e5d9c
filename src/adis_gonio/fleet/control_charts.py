"""Drift of a quantity between sessions, and control charts that compare a session with those before it.

Drift is a weighted line with additional scatter between sessions: y_i = a + b t_i + w_i + e_i, with e_i of
standard deviation u_i and w_i of τ. τ² follows from Paule and Mandel (J. Res. NBS 87, 1982, 377): the
residual is then as large as expected. The uncertainty is by Knapp and Hartung (Stat. Med. 22, 2003, 2693),
at least as large as the stated u require, with Student's t at n − 2.

The charts compare each session with the weighted mean of all sessions before it (recursive residuals;
Brown, Durbin and Evans, J. R. Stat. Soc. B 37, 1975). If nothing changes, the differences are independent
and standard normal, so that neither chart needs a baseline of good sessions and the average run lengths of
the textbooks apply. Shewhart's chart detects a session that is far off; the CUSUM (Page, Biometrika 41,
1954) detects a small shift that stays.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.uncertainty import Value

CUSUM_K = 0.5
"""Slack k of the CUSUM in standard deviations: half of the shift that it detects best.

The choice follows Montgomery, chapter 9.
"""
CUSUM_H = 5.0
"""Limit h of the CUSUM in standard deviations, which gives one false alarm in 465 sessions."""
SHEWHART = 3.0
"""Limit of Shewhart's chart in standard deviations, which gives one false alarm in 370 sessions."""
_MOVING_RANGE = 2 / math.sqrt(math.pi)
"""Mean distance of two successive normal values, in their standard deviations (d₂ of two)."""
_MOVING_RANGE_DOF = 0.62
"""Effective degrees of freedom of a mean moving range, for each moving range (Palm and Wheeler, 1990)."""


class ControlChart(JsonRecord):
    """Control charts of a quantity, which compare each session with the sessions before it.

    Entries of the first session are NaN, unless stated otherwise.

    Attributes
    ----------
    expected : (n,) float
        Weighted mean of the values of all sessions before this session.
    low, high : (n,) float
        Shewhart's limits for this session.
    z : (n,) float
        Difference of the value from `expected` in standard deviations. They include the scatter between
        the other sessions; if this is estimated from few sessions, z is the standard normal value that is
        as improbable as Student's t.
    up, down : (n,) float
        The two sums of the CUSUM, in standard deviations; 0 at the first session.
    between : float
        Standard deviation of the values between sessions in excess of their standard uncertainties u.
    since : int or None
        Index of the first session after a change that the CUSUM signals, by the most likely split of the
        sessions up to the signal into two means (Pignatiello and Samuel, J. Qual. Technol. 33, 2001); None
        without a signal.
    k, h : float
        Slack and limit of the CUSUM, in standard deviations.
    """

    document_keys = (
        *("expected", "low", "high", "z", "up", "down"),
        *("between", "k", "h", "outside", "signal", "since"),
    )

    expected: Floats
    low: Floats
    high: Floats
    z: Floats
    up: Floats
    down: Floats
    between: float
    since: int | None = None
    k: float = CUSUM_K
    h: float = CUSUM_H

    @property
    def outside(self) -> list[int]:
        """Indices of the sessions outside the 3σ limits of Shewhart's chart."""
        return [int(n) for n in np.flatnonzero(np.abs(self.z) > SHEWHART)]

    @property
    def signal(self) -> int | None:
        """Index of the first session at which a sum of the CUSUM exceeds its limit; None if none does."""
        over = np.flatnonzero(np.maximum(self.up, self.down) > self.h)
        return int(over[0]) if len(over) else None


def control_chart(value: Floats, u: Floats) -> ControlChart:
    """Make the Shewhart and CUSUM charts of the values of a quantity in successive sessions.

    `value` (n,) and `u` (n,) are the values and their standard uncertainties, in order of time.
    """
    from scipy.special import ndtr, stdtrit

    expected, sigma = np.full(len(value), np.nan), np.full(len(value), np.nan)
    dof = np.full(len(value), np.inf)
    for k in range(1, len(value)):
        # A session that is far off must not widen its own limits.
        others = np.arange(len(value)) != k
        between = between_neighbours(value[others], u[others])
        variance = u**2 + between**2
        weight = 1 / variance[:k]
        expected[k] = np.average(value[:k], weights=weight)
        sigma[k] = math.sqrt(variance[k] + 1 / weight.sum())
        if between:
            spread = between**2 + float((u[others] ** 2).mean())
            dof[k] = _MOVING_RANGE_DOF * (len(value) - 2) * (variance[k] / spread) ** 2
    t = (value - expected) / sigma
    z = as_normal(t, dof)
    up, down = cusum(z[1:])
    limit = sigma * -stdtrit(dof, ndtr(-SHEWHART))
    low, high = expected - limit, expected + limit
    up, down = np.concatenate([[0.0], up]), np.concatenate([[0.0], down])
    between = between_neighbours(value, u)
    chart = ControlChart(expected, low, high, z, up, down, between)
    if chart.signal is None:
        return chart
    return replace(chart, since=_split(value, 1 / (u**2 + between**2), chart.signal))


def as_normal(t: Floats, dof: Floats) -> Floats:
    """Convert values (n,) of Student's t with `dof` (n,) degrees of freedom to normal deviates.

    A value and its deviate have equal probability.
    """
    from scipy.special import ndtri, stdtr

    few = np.isfinite(dof) & (dof < 1e6)
    out = np.array(t, dtype=float)
    # The lower tail keeps the digits of small probabilities.
    tail = np.maximum(stdtr(np.maximum(dof[few], 1.0), -np.abs(out[few])), 1e-300)
    out[few] = -np.sign(out[few]) * ndtri(tail)
    return out


def _split(value: Floats, weight: Floats, last: int) -> int:
    """Return the index of the session at which the mean most probably changed.

    `value` (n,) and `weight` (n,) are the values and the inverse squares of their standard uncertainties.
    Only the sessions up to the index `last`, included, are used; the session returned is the first after
    the change.
    """

    def gain(at: int) -> float:
        one, other = slice(0, at), slice(at, last + 1)
        means = [float(np.average(value[part], weights=weight[part])) for part in (one, other)]
        return (means[1] - means[0]) ** 2 / float(1 / weight[one].sum() + 1 / weight[other].sum())

    return max(range(1, last + 1), key=gain)


def between_neighbours(value: Floats, u: Floats) -> float:
    """Estimate the standard deviation between sessions in excess of their standard uncertainties.

    `value` (n,) and `u` (n,) are the values and their standard uncertainties in order of time. The estimate
    is made from the differences of successive sessions (moving range), so that a single step in the series
    hardly changes it. It is 0 with fewer than three sessions.
    """
    if len(value) < 3:
        return 0.0
    # Scatter of neighbours minus the mean variance of the stated u.
    spread = float(np.abs(np.diff(value)).mean()) / _MOVING_RANGE
    return math.sqrt(max(spread**2 - float((u**2).mean()), 0.0))


def cusum(z: Floats) -> tuple[Floats, Floats]:
    """Return the upper and lower CUSUM (n,) of standardised values z (n,).

    They are S⁺ = max(0, S⁺ + z − k) and S⁻ = max(0, S⁻ − z − k), with k = `CUSUM_K`.
    """
    sums = np.cumsum([z - CUSUM_K, -z - CUSUM_K], axis=1)
    # A sum that starts again at 0 is the whole sum above its lowest value so far, at most 0.
    up, down = sums - np.minimum(np.minimum.accumulate(sums, axis=1), 0.0)
    return up, down


YEAR_DAYS = 365.25
LEAST = 3
"""Smallest number of sessions for a straight line with an estimate of the scatter about it."""


class Drift(JsonRecord):
    """A straight line through the values of a quantity over time.

    Attributes
    ----------
    slope : Value
        Change of the quantity per year, in `<unit>/a`.
    level : Value
        Value of the line at `reference_day`.
    reference_day : float
        Weighted mean time of the sessions in days, at which level and slope are independent.
    between : float
        Standard deviation τ of the values between sessions in excess of their standard uncertainties u.
    birge : float
        Birge ratio: square root of χ² per degree of freedom about the line, with the stated standard
        uncertainties u alone.
    birge_p : float
        Probability of at least this scatter, if the stated u are its only cause.
    p_value : float
        Probability of at least this slope, of either sign, without drift.
    """

    slope: Value
    level: Value
    reference_day: float
    between: float
    birge: float
    birge_p: float
    p_value: float


def drift_of(day: Floats, value: Floats, u: Floats, unit: str) -> Drift | None:
    """Fit a straight line to the values of the sessions over time.

    Returns None for fewer than `LEAST` sessions, or if all sessions have the same time.

    Parameters
    ----------
    day, value, u : (n,) float
        Time in days, value and standard uncertainty of each session; the uncertainty is above zero.
    unit : str
        Unit of the values.
    """
    if len(day) < LEAST or not np.ptp(day) > 0:
        return None
    from scipy.optimize import brentq
    from scipy.special import gammaincc, stdtr

    dof = len(day) - 2
    stated = _line(day, value, u**2)

    def excess(tau: float) -> float:
        return _line(day, value, u**2 + tau**2)[-1] - dof

    # τ at which Cochran's Q has its expectation (Paule and Mandel); 0 if Q is not larger without τ.
    between = 0.0
    if excess(0.0) > 0:
        high = float(np.ptp(value))
        while excess(high) > 0:
            high *= 2
        between = float(brentq(excess, 0.0, high, xtol=1e-7 * high, rtol=1e-6))
    middle, level, slope, variances, chi2 = _line(day, value, u**2 + between**2)
    scale = max(1.0, chi2 / dof)  # Knapp and Hartung, never below the stated u
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
    """Fit a straight line to values over days, weighted by 1/variance.

    Returns the weighted mean time, the value of the line at that time, the slope per day, the variances of
    both, and χ².
    """
    # Weighted straight line about the weighted mean time, where level and slope are independent.
    weight = 1 / variance
    total = float(weight.sum())
    middle = float((weight * day).sum()) / total
    t = day - middle
    spread = float((weight * t**2).sum())
    level, slope = float((weight * value).sum()) / total, float((weight * t * value).sum()) / spread
    chi2 = float((weight * (value - level - slope * t) ** 2).sum())
    return middle, level, slope, (1 / total, 1 / spread), chi2
