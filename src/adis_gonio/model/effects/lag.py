"""A first-order lag of a recorded series, exact for values that change linearly between records."""

from __future__ import annotations

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError


def _scan(factor: Floats, term: Floats) -> Floats:
    """Solve x_k = factor_k · x_{k−1} + term_k, x_{−1} = 0, for all k; (m,) → (m,).

    By doubling (each pass joins the recurrences of twice as many steps): log₂ m passes over arrays, and no
    growing exponentials, since factors are at most 1.
    """
    factor, term = factor.copy(), term.copy()
    reach = 1
    while reach < len(term):
        term[reach:] += factor[reach:] * term[:-reach]
        factor[reach:] *= factor[:-reach].copy()
        reach *= 2
    return term


def lagged(record_s: Floats, record: Floats, time_s: Floats, tau_s: float) -> tuple[Floats, Floats]:
    """Lagged series y with τ dy/dt = x − y and its derivative by τ.

    Parameters
    ----------
    record_s, record : (m,) float
        Increasing times in s, and values x there; y starts at x of the first record. x is linear between
        records and constant outside.
    time_s : (n,) float
        Where to evaluate.
    tau_s : float
        Time constant τ > 0 in s.

    Returns
    -------
    y : (n,) float
        In the unit of x.
    by_tau : (n,) float
        ∂y/∂τ, in that unit per second.

    Raises
    ------
    UsageError
        No record, times that do not increase, or τ ≤ 0.

    Notes
    -----
    The lag e = x − y obeys de/dt = s − e/τ with x's slope s. Over a step h, with r = exp(−h/τ):
    e' = r e + s τ (1 − r), and ∂e'/∂τ = r ∂e/∂τ + (e − s τ) r h/τ² + s (1 − r).
    """
    if not len(record_s) or len(record_s) != len(record) or (np.diff(record_s) <= 0).any():
        raise UsageError("a history needs one value a time, and times that increase")
    if not tau_s > 0:
        raise UsageError(f"a time constant is greater than 0, not {tau_s:g} s")

    steps = np.diff(record_s)
    slopes = np.diff(record) / steps
    kept = np.exp(-steps / tau_s)
    lag = np.concatenate([[0.0], _scan(kept, slopes * tau_s * (1 - kept))])
    feed = (lag[:-1] - slopes * tau_s) * kept * steps / tau_s**2 + slopes * (1 - kept)
    lag_by_tau = np.concatenate([[0.0], _scan(kept, feed)])

    # From the record at or before each time on; before the first one nothing has happened yet.
    k = np.clip(np.searchsorted(record_s, time_s, side="right") - 1, 0, len(record_s) - 1)
    h = np.maximum(time_s - record_s[k], 0.0)
    s = np.append(slopes, 0.0)[k]
    r = np.exp(-h / tau_s)
    y = record[k] + s * h - (r * lag[k] + s * tau_s * (1 - r))
    by_tau = -(r * lag_by_tau[k] + (lag[k] - s * tau_s) * r * h / tau_s**2 + s * (1 - r))
    return y, by_tau
