"""Overlapping Allan deviation, and how surely a record shows it.

The variance of the estimate follows from the noise that the record has (its variogram), not from an assumed
kind: for Gaussian noise Var σ̂² = 2/M² Σ (M − |l|) R(l)², with R the autocovariance of the M overlapping
differences, and the degrees of freedom are 2 (σ²)²/Var σ̂².
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal, stats

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.fitting.allan.processes import KINDS, variograms

LEAST_DIFFERENCES = 8
"""Differences that an Allan deviation needs to be worth a point."""
_EXACT = 512
"""Samples of an averaging time up to which the filter counts; longer ones stand on a coarser lattice."""
_LATTICE = 32


@dataclass(frozen=True)
class AllanCurve(JsonRecord):
    """Allan deviation of one axis with its intervals of 95 %, and the fitted model's.

    Attributes
    ----------
    tau_s : (t,) float
        Averaging times.
    deviation, low, high, dof : (t,) float
        Overlapping estimate, pooled over the records, its interval of 95 % (χ²) and its effective
        degrees of freedom.
    model : (t,) float
        Expected by the fitted noise.
    """

    tau_s: Floats
    deviation: Floats
    low: Floats
    high: Floats
    dof: Floats
    model: Floats


def octaves(longest: int) -> list[int]:
    """Averaging times in samples, an octave apart, that a record of so many samples can show."""
    return [1 << j for j in range(longest.bit_length()) if 2 * (1 << j) + LEAST_DIFFERENCES <= longest]


def overlapping(samples: Sequence[Floats]) -> tuple[list[int], Floats]:
    """Overlapping Allan deviation of the samples, pooled over records.

    Parameters
    ----------
    samples : sequence of (n, axes) float
        Records of one rate.

    Returns
    -------
    m : list of int
        Averaging times in samples, at octaves.
    deviation : (len(m), axes) float
    """
    times = octaves(max(len(part) for part in samples))
    totals = np.zeros((len(times), samples[0].shape[1]))
    counts = np.zeros(len(times))
    for part in samples:
        sums = np.concatenate([np.zeros((1, part.shape[1])), np.cumsum(part - part.mean(axis=0), axis=0)])
        for row, m in enumerate(times):
            if len(part) < 2 * m + LEAST_DIFFERENCES:
                break
            second = sums[2 * m :] - 2 * sums[m:-m]
            second += sums[: -2 * m]
            totals[row] += np.einsum("na,na->a", second, second) / m**2
            counts[row] += len(second)
    return times, np.sqrt(totals / (2 * counts[:, None]))


def curve(
    records: Sequence[Floats], squares: Floats, filter_m: int, period_s: float, rounding: Floats
) -> AllanCurve:
    """Allan deviation of an axis beside that of the fitted noise.

    Parameters
    ----------
    records : sequence of (n,) float
    squares : (4,) float
        Squared coefficients of the fitted processes.
    rounding : (lags,) float
        Autocovariance of the converter's rounding, in the squared unit of the samples.
    """
    times, deviation = overlapping([record[:, None] for record in records])
    lengths = [len(record) for record in records]
    expected, dof = [], []
    for m in times:
        variance, freedom = _expected(m, lengths, squares, filter_m, period_s, rounding)
        expected.append(variance)
        dof.append(freedom)
    nu = np.array(dof)
    low, high = (deviation[:, 0] * np.sqrt(nu / stats.chi2.ppf(q, nu)) for q in (0.975, 0.025))
    tau = period_s * np.array(times, dtype=float)
    return AllanCurve(tau, deviation[:, 0], low, high, nu, np.sqrt(np.array(expected)))


def _expected(
    m: int, lengths: Sequence[int], squares: Floats, filter_m: int, period_s: float, rounding: Floats
) -> tuple[float, float]:
    """Expected Allan variance, and degrees of freedom of the estimate that pools the records."""
    coarse = 1 if m <= _EXACT else m // _LATTICE
    step = m // coarse
    gamma = _variogram(squares, filter_m, 10 * step, period_s, coarse, rounding)
    weights = np.concatenate([np.full(step, -1.0), np.full(step, 1.0)]) / (step * np.sqrt(2))
    pairs = np.correlate(weights, weights, "full")  # lags −2m + 1 … 2m − 1
    reach = 2 * step - 1
    mirrored = np.concatenate([gamma[reach:0:-1], gamma])
    covariance = -signal.fftconvolve(mirrored, pairs, "valid")
    total = bends = 0.0
    for n in lengths:
        count = n - 2 * m + 1
        if n < 2 * m + LEAST_DIFFERENCES:
            continue
        # On a lattice of `coarse` samples.
        shifts = np.arange(1, len(covariance))
        left = np.maximum(count / coarse - shifts, 0.0)
        squared = count / coarse * covariance[0] ** 2 + 2 * float(left @ covariance[1:] ** 2)
        bends += 2 * squared * coarse**2
        total += count
    return float(covariance[0]), float(max(2 * (total * covariance[0]) ** 2 / bends, 1.0))


def _variogram(
    squares: Floats, filter_m: int, lags: int, period_s: float, coarse: int, rounding: Floats
) -> Floats:
    """Half the mean squared difference of means over `coarse` samples, at `lags` of those."""
    if coarse == 1:
        own = variograms(filter_m, lags, period_s) @ squares
        held = np.zeros(lags)
        held[: min(len(rounding), lags)] = rounding[:lags]
        return np.asarray(own + rounding[0] - held, np.float64)
    # The filter is short against such a mean; rounding then counts as white noise.
    white = squares.copy()
    white[KINDS.index("white")] += period_s * float(rounding[0] + 2 * rounding[1:].sum())
    return np.asarray(variograms(0, lags, period_s * coarse) @ white, np.float64)
