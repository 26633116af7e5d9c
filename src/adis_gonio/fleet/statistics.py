"""Figures of many sessions: how far values scatter beyond their uncertainties, how often a thing is found.

Pure numpy on columns: one entry a session.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, robust_sd
from adis_gonio.base.jsonable import JsonRecord, key

PROBABILITIES = (0.025, 0.05, 0.25, 0.5, 0.75, 0.95, 0.975)
LEAST = 3
"""Values below which nothing is said of their scatter."""


@dataclass(frozen=True)
class Distribution(JsonRecord):
    """Values of one quantity over the fleet.

    Attributes
    ----------
    n : int
        Sessions that have it.
    mean, sd, robust_sd : float
    quantiles : mapping of str to float
        By probability in percent, such as `50`.
    low, high : float
        Extremes.
    """

    n: int
    mean: float
    sd: float
    robust_sd: float
    quantiles: dict[str, float]
    low: float
    high: float

    @classmethod
    def of(cls, values: Floats) -> Distribution:
        """Of finite values (n,), at least one."""
        probable = np.quantile(values, PROBABILITIES)
        quantiles = {f"{100 * p:g}": float(q) for p, q in zip(PROBABILITIES, probable, strict=True)}
        sd = float(values.std(ddof=1)) if len(values) > 1 else math.nan
        ends = float(values.min()), float(values.max())
        return cls(len(values), float(values.mean()), sd, robust_sd(values), quantiles, *ends)


@dataclass(frozen=True)
class Beyond(JsonRecord):
    """Scatter against what the sessions' own uncertainties explain.

    Attributes
    ----------
    n : int
        Values with an uncertainty.
    u : float
        Their median standard uncertainty.
    q, dof, p_value : float
        Cochran's Q about the weighted mean, its degrees of freedom, and the probability of as much where u
        explains all.
    tau : float
        Standard deviation of the true values by which the sessions differ in addition (Paule and Mandel).
    tau_95 : tuple of float
        Its interval of 95 % (Q profile).
    """

    document_keys = ("n", "u", "q", "dof", "p_value", "birge_ratio", "tau", "tau_95")

    n: int
    u: float = field(metadata=key("median_u"))
    q: float
    dof: int
    p_value: float
    tau: float
    tau_95: tuple[float, float]

    @property
    def birge_ratio(self) -> float:
        """Birge ratio: scatter over what u explains."""
        return math.sqrt(self.q / self.dof)


def beyond(values: Floats, u: Floats, dof: Floats) -> Beyond | None:
    """Whether values (n,) scatter more than their standard uncertainties (n,) with `dof` (n,) explain.

    A deviation in units of u is Student's with its own degrees of freedom; it is counted as the normal one
    of the same probability, so that Q is χ² where few degrees of freedom stand behind the u.
    None with fewer than three values that have a u.
    """
    from scipy.stats import chi2

    good = np.isfinite(values) & np.isfinite(u) & (u > 0)
    x, s, nu = values[good], u[good], dof[good]
    n = len(x)
    if n < LEAST:
        return None

    def q_at(tau: float) -> float:
        variance = s**2 + tau**2
        weight = 1 / variance
        centre = float(weight @ x) / float(weight.sum())
        return float((as_normal((x - centre) / np.sqrt(variance), nu) ** 2).sum())

    expected = (n - 1.0, float(chi2.ppf(0.975, n - 1)), float(chi2.ppf(0.025, n - 1)))
    tau, low, high = (tau_of(q_at, goal, x) for goal in expected)
    q = q_at(0.0)
    return Beyond(n, float(np.median(s)), q, n - 1, float(chi2.sf(q, n - 1)), tau, (low, high))


def as_normal(t: Floats, dof: Floats) -> Floats:
    """Normal deviates of the same probability as Student's t (n,) with `dof` (n,)."""
    from scipy.special import ndtri, stdtr

    few = np.isfinite(dof) & (dof < 1e6)
    out = np.array(t, dtype=float)
    # By the lower tail, where small probabilities keep their digits.
    tail = np.maximum(stdtr(np.maximum(dof[few], 1.0), -np.abs(out[few])), 1e-300)
    out[few] = -np.sign(out[few]) * ndtri(tail)
    return out


def tau_of(q_at: Callable[[float], float], goal: float, values: Floats) -> float:
    """Paule's and Mandel's τ: Q there is as large as expected; 0 if Q is smaller without any τ."""
    from scipy.optimize import brentq

    if q_at(0.0) <= goal:
        return 0.0
    high = float(np.ptp(values))
    while q_at(high) > goal:
        high *= 2
    return float(brentq(lambda tau: q_at(tau) - goal, 0.0, high, xtol=1e-7 * high, rtol=1e-6))


@dataclass(frozen=True)
class Repeats(JsonRecord):
    """How sessions of the same unit agree, in units of their u.

    Attributes
    ----------
    units, sessions : int
        Units with two sessions or more, and their sessions.
    ratio : float
        Scatter within units over what u explains: 1 where u is honest.
    p_value : float
        Of as much scatter where u explains all.
    """

    units: int
    sessions: int
    ratio: float
    p_value: float


def repeats(values: Floats, u: Floats, dof: Floats, unit: NDArray[np.int64]) -> Repeats | None:
    """Scatter of sessions about the mean of their unit; `unit` (n,) numbers them, negative is unknown.

    None where no unit has two sessions.
    """
    from scipy.stats import chi2

    good = np.isfinite(values) & np.isfinite(u) & (u > 0) & (unit >= 0)
    x, s, nu = values[good], u[good], dof[good]
    _, index, count = np.unique(unit[good], return_inverse=True, return_counts=True)
    weight = 1 / s**2
    centre = np.bincount(index, weight * x) / np.bincount(index, weight) if len(x) else x
    several = count[index] > 1
    freedom = int((count[count > 1] - 1).sum())
    if not freedom:
        return None
    q = float((as_normal((x - centre[index]) / s, nu)[several] ** 2).sum())
    return Repeats(
        int((count > 1).sum()), int(several.sum()), math.sqrt(q / freedom), float(chi2.sf(q, freedom))
    )
