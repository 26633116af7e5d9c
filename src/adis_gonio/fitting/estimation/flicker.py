"""1/f noise of the means of dwells: its covariance from when they were measured.

Noise of the one-sided spectrum h/f has an Allan variance of 2 h ln 2 at every averaging time, and below its
corner an autocovariance of constant − h ln|t|. The mean of ln|t − t'| over two dwells [a, b] and [c, d] is
(F(a − d) + F(b − c) − F(a − c) − F(b − d))/((b − a)(d − c)) − 3/2 with F(x) = ½ x² ln|x|, for a dwell with
itself ln(b − a) − 3/2. The constant (the variance of all that is slower) belongs to the bias: of 1/f noise
the mean over all time has no variance to be given. A bias is stated as well as it would be found again,
against the mean of a session twice as long that goes on after the last dwell; deviations from it do not
hold the constant, and theirs is the covariance here. N dwells one after the other without a pause scatter
by N ln N/(2 (N − 1) ln 2) times the Allan variance (Barnes 1969).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from adis_gonio.base.arrays import Floats

MOST_MODES = 128
"""Modes in which the covariance is kept. Those of fewer dwells are kept all; of 1000 dwells the
rest, faster than about 16 dwells, is taken as noise of its own in each dwell."""


def covariance_of_means(begin_s: Floats, end_s: Floats) -> Floats:
    """Covariance (n, n) of dwells' means about that of twice their session, for an Allan variance of 1.

    Parameters
    ----------
    begin_s, end_s : (n,) float
        When each dwell began and ended. Where a dwell has no length, or begins before the one before it has
        ended, these are not the times of one session and the dwells are taken as one after the other.

    Source
    ------
    The double integral of −ln|t − t'|; Barnes, Tables of bias functions (NBS TN 375, 1969) for its mean.
    """
    begin_s, end_s = _in_order(begin_s, end_s)
    first = float(begin_s[0])
    begin_s, end_s = np.append(begin_s, first), np.append(end_s, 2 * float(end_s[-1]) - first)
    length = end_s - begin_s
    crossed = (
        _second_integral(begin_s[:, None] - end_s[None, :])
        + _second_integral(end_s[:, None] - begin_s[None, :])
        - _second_integral(begin_s[:, None] - begin_s[None, :])
        - _second_integral(end_s[:, None] - end_s[None, :])
    )
    mean_log = crossed / (length[:, None] * length[None, :])
    about = np.eye(len(length))[:-1] - np.eye(len(length))[-1]
    covariance: Floats = -about @ mean_log @ about.T / (2 * math.log(2))
    return (covariance + covariance.T) / 2


_SHORTEST_S = 1e-9


def _in_order(begin_s: Floats, end_s: Floats) -> tuple[Floats, Floats]:
    """Begin and end of dwells of one session."""
    length = end_s - begin_s
    # Shorter ones are none that a file may mean, and their squares leave the numbers that there are.
    if (length < _SHORTEST_S).any():
        length = np.ones(len(begin_s))
        begin_s = np.arange(len(begin_s), dtype=float)
    elif (begin_s[1:] < end_s[:-1] - 0.1 * length[:-1]).any():
        begin_s = np.cumsum(length) - length
    return begin_s, begin_s + length


def spans(times_s: Sequence[Floats]) -> tuple[Floats, Floats]:
    """When dwells of two samples or more began and ended (n,), the last sample's own time included."""
    begin = np.array([float(time[0]) for time in times_s])
    period = np.array([float(np.ptp(time)) / (len(time) - 1) for time in times_s])
    return begin, np.array([float(time[-1]) for time in times_s]) + period


def scatter_of_means(dwells: int) -> float:
    """Variance by which the means of dwells one after the other scatter, for an Allan variance of 1."""
    return 1.0 if dwells < 2 else dwells * math.log(dwells) / (2 * (dwells - 1) * math.log(2))


def modes(covariance: Floats) -> tuple[Floats, Floats]:
    """Factor (n, k) of the slowest modes of a covariance, and the variances (n,) that it leaves out."""
    from scipy.linalg import eigh

    n = len(covariance)
    values, vectors = eigh(covariance, subset_by_index=(max(n - MOST_MODES, 0), n - 1))
    kept = values > 1e-12 * max(float(values[-1]), 1e-300)
    factor = vectors[:, kept] * np.sqrt(values[kept])
    left = np.diagonal(covariance) - (factor**2).sum(axis=1)
    return factor, np.maximum(left, 0.0)


def _second_integral(x: Floats) -> Floats:
    size = np.abs(x)
    result: Floats = 0.5 * size**2 * np.log(np.where(size > 0, size, 1.0))
    return result
