"""Noise processes of IEEE Std 952-1997, Annex C, in a sampled and filtered record; its Allan deviation.

Coefficients are squared standard deviations, so every density is linear in them. T is the sampling
period. The Allan variance at τ and the two-sided density at f of each process, per squared coefficient,
are:

==============  ==================  ======================
process         Allan variance      density
==============  ==================  ======================
quantization Q  3/τ²                T (2πf)²
white N         1/τ                 1
flicker F       1                   1/(4 ln 2 · f)
walk K          τ/3                 1/(2πf)²
==============  ==================  ======================

F is the floor of the Allan deviation, 0.664 times the standard's B. The likelihood works in the basis of
the DCT-II without its first vector. In this basis white noise and a random walk of any mean are exactly
independent, because its vectors are the eigenvectors of the differences' normal matrix. The correlations of
flicker are at most 0.12, the correlations of the squares in the likelihood 0.015.

The variance of the Allan deviation follows from the fitted noise of the record (its variogram), not from an
assumed kind: for Gaussian noise Var σ̂² = 2/M² Σ (M − |l|) R(l)², with R the autocovariance of the M
overlapping differences, and the degrees of freedom are 2 (σ²)²/Var σ̂².
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import fft, special

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.device.sensor.settings import filter_response, filter_weights

Kind = Literal["quantization", "white", "flicker", "walk"]
KINDS: tuple[Kind, ...] = get_args(Kind)

FLOOR_OF_B = math.sqrt(2 * math.log(2) / math.pi)
"""Floor of the Allan deviation over the standard's coefficient of bias instability."""
_FLICKER_ALLAN = 4 * math.log(2)
"""Allan variance of noise with the two-sided density h/f, in units of h."""
_TABLE = 256


def variances(filter_m: int, n: int, k: Floats, period_s: float) -> Floats:
    """Variances (len(k), 4) of the DCT-II coefficients k of n samples, for each noise process in `KINDS`.

    Each column is for a process with a squared coefficient of 1.
    """
    angle = np.pi * k / n
    frequency = k / (2 * n)
    passed = filter_response(filter_m, frequency)
    white = ordinate_variances(_autocovariance(filter_weights(filter_m)), n, k)
    # Quantization of the angle is white noise of its differences.
    angles = ordinate_variances(_autocovariance(np.convolve(filter_weights(filter_m), [1.0, -1.0])), n, k)
    flicker = passed * _edge(k) / frequency / _FLICKER_ALLAN
    walk = passed / (4 * np.sin(angle / 2) ** 2)
    return np.stack([angles / period_s**2, white / period_s, flicker, walk * period_s], axis=1)


def ordinate_variances(autocovariance: Floats, n: int, k: Floats) -> Floats:
    """Variances (len(k),) of DCT-II coefficients k of n samples of a process with a short autocovariance.

    They are exact and include the ends of the record: with a = πk/n, Σ_t φ_k(t) φ_k(t+l) = ((n − l) cos(la)
    − sin(la)/sin(a))/n.
    """
    angle = np.pi * k / n
    total = np.full(len(k), autocovariance[0])
    for lag in range(1, min(len(autocovariance), n)):
        turned = lag * angle
        shape = (1 - lag / n) * np.cos(turned) - np.sin(turned) / (n * np.sin(angle))
        total += 2 * autocovariance[lag] * shape
    return np.asarray(np.maximum(total, 0.0), np.float64)


def line(n: int, k: Floats) -> Floats:
    """DCT-II coefficients, at the indices k, of the straight line 0, 1, … n − 1.

    Coefficients with an even index are zero.
    """
    angle = np.pi * k / n
    odd = -math.sqrt(2 / n) * np.cos(angle / 2) / (2 * np.sin(angle / 2) ** 2)
    return np.where(k % 2 == 1, odd, 0.0)


def variograms(filter_m: int, lags: int, period_s: float) -> Floats:
    """Half the mean squared difference (lags, 4) of two samples, for each noise process in `KINDS`.

    The rows are for the lags 0, 1, … in samples. Each column is for a squared coefficient of 1.
    """
    own = _autocovariance(filter_weights(filter_m))
    reach = len(own) - 1
    lag = np.arange(lags + reach + 1)
    # Autocovariance of the filter at negative and positive lags.
    both = np.concatenate([own[:0:-1], own])
    made = np.empty((lags, len(KINDS)))
    angles = _autocovariance(np.convolve(filter_weights(filter_m), [1.0, -1.0]))
    made[:, 0] = angles[0] - _padded(angles, lags)
    made[:, 1] = own[0] - _padded(own, lags)
    # Flicker and walk: filter the variogram of the unfiltered process.
    for column, values in ((2, 2 * _cin(np.pi * lag) / _FLICKER_ALLAN), (3, lag / 2)):
        mirrored = np.concatenate([values[reach:0:-1], values])
        filtered = np.convolve(mirrored, both, "valid")[:lags]
        made[:, column] = filtered - filtered[0]
    return made * [1 / period_s**2, 1 / period_s, 1.0, period_s]


def _autocovariance(weights: Floats) -> Floats:
    return np.asarray(np.correlate(weights, weights, "full")[len(weights) - 1 :], np.float64)


def _padded(values: Floats, size: int) -> Floats:
    return np.pad(values[:size], (0, max(size - len(values), 0)))


def _cin(x: NDArray[np.floating[Any]]) -> Floats:
    """Cosine integral Cin(x): the integral of (1 − cos t)/t from 0 to x."""
    inside = np.maximum(x, 1e-9)
    value = np.log(inside) + np.euler_gamma - special.sici(inside)[1]
    return np.where(x > 0, value, 0.0)


@lru_cache(maxsize=1)
def _edge_table() -> Floats:
    """Variances of the DCT-II coefficients 1 … `_TABLE` of flicker noise, each multiplied by its frequency.

    They include the effect of the ends of a record, and come from the variogram 2h Cin(πl) of noise with
    density h/|f| below half the sampling rate. The record is so long that its length has no effect.
    """
    n = 8 * _TABLE
    lag = np.arange(1, n)
    gamma = 2 * _cin(np.pi * lag)
    table = np.empty(_TABLE)
    for k in range(1, _TABLE + 1):
        angle = np.pi * k / n
        shape = (n - lag) * np.cos(lag * angle) - np.sin(lag * angle) / np.sin(angle)
        table[k - 1] = -2 / n * (gamma @ shape) * k / (2 * n)
    return table


def _edge(k: Floats) -> Floats:
    table = _edge_table()
    inside = np.clip(k, 1, _TABLE).astype(np.intp) - 1
    return np.where(k <= _TABLE, table[inside], 1 - (1 - table[-1]) * _TABLE / np.maximum(k, 1))


LEAST_DIFFERENCES = 8
"""Smallest number of differences of means from which an Allan deviation is computed."""
_EXACT = 512
"""Largest averaging time in samples with the filter in the computation; longer ones use a coarser
lattice."""
_LATTICE = 32


class AllanCurve(JsonRecord):
    """Allan deviation of one axis with 95 % intervals, and the deviation that the fitted noise predicts.

    Attributes
    ----------
    tau_s : (t,) float
        Averaging times.
    deviation, low, high, dof : (t,) float
        Overlapping estimate, pooled over the records, its 95 % interval (χ²) and its effective degrees of
        freedom.
    model : (t,) float
        Expected deviation by the fitted noise.
    """

    tau_s: Floats
    deviation: Floats
    low: Floats
    high: Floats
    dof: Floats
    model: Floats


def octaves(longest: int) -> list[int]:
    """Averaging times of the Allan variance, in samples: 1, 2, 4, … as far as `longest` samples allow."""
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
        # Second differences of the integrated samples at distance m, overlapping.
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
    """Allan deviation of an axis from its records, and the deviation that the fitted noise predicts.

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
    expected, nu = np.array([_expected(m, lengths, squares, filter_m, period_s, rounding) for m in times]).T
    low, high = (deviation[:, 0] * np.sqrt(nu / special.chdtri(nu, 1 - q)) for q in (0.975, 0.025))
    tau = period_s * np.array(times, dtype=float)
    return AllanCurve(tau, deviation[:, 0], low, high, nu, np.sqrt(expected))


def _expected(
    m: int, lengths: Sequence[int], squares: Floats, filter_m: int, period_s: float, rounding: Floats
) -> tuple[float, float]:
    """Expected Allan variance at m samples for a noise model, and the dof of its estimate.

    The estimate pools records of these `lengths`; `squares` are the squared coefficients of the model.
    """
    coarse = 1 if m <= _EXACT else m // _LATTICE
    step = m // coarse
    gamma = _variogram(squares, filter_m, 10 * step, period_s, coarse, rounding)
    # The Allan difference as a filter, and its autocorrelation.
    weights = np.concatenate([np.full(step, -1.0), np.full(step, 1.0)]) / (step * np.sqrt(2))
    pairs = np.correlate(weights, weights, "full")  # lags −2m + 1 … 2m − 1
    reach = 2 * step - 1
    mirrored = np.concatenate([gamma[reach:0:-1], gamma])
    size = fft.next_fast_len(len(mirrored), real=True)
    product = fft.irfft(fft.rfft(mirrored, size) * fft.rfft(pairs, size), size)
    covariance = -product[len(pairs) - 1 : len(mirrored)]  # places where both overlap fully
    total = bends = 0.0
    for n in lengths:
        count = n - 2 * m + 1
        if n < 2 * m + LEAST_DIFFERENCES:
            continue
        # Sum over all pairs of differences, on a lattice of `coarse` samples.
        shifts = np.arange(1, len(covariance))
        left = np.maximum(count / coarse - shifts, 0.0)
        squared = count / coarse * covariance[0] ** 2 + 2 * float(left @ covariance[1:] ** 2)
        bends += 2 * squared * coarse**2
        total += count
    return float(covariance[0]), float(max(2 * (total * covariance[0]) ** 2 / bends, 1.0))


def _variogram(
    squares: Floats, filter_m: int, lags: int, period_s: float, coarse: int, rounding: Floats
) -> Floats:
    """Half the mean squared difference of two means of `coarse` samples, by their distance.

    The distances are 0, 1, … `lags` − 1 such means. `squares` are the squared coefficients of the model.
    """
    if coarse == 1:
        own = variograms(filter_m, lags, period_s) @ squares
        return np.asarray(own + rounding[0] - _padded(rounding, lags), np.float64)
    # The filter is short against such a mean, and rounding is white noise there.
    white = squares.copy()
    white[KINDS.index("white")] += period_s * float(rounding[0] + 2 * rounding[1:].sum())
    return np.asarray(variograms(0, lags, period_s * coarse) @ white, np.float64)
