"""Noise processes of a part at rest, and the likelihood of their coefficients.

The processes are defined in IEEE Std 952-1997, Annex C, in a sampled and filtered record.

Each process has a coefficient (Q, N, F or K). Densities and Allan variances are linear in its square θ. T
is the sampling period. The Allan variance at τ and the two-sided density at f of each process, divided by
θ, are:

==============  ==================  ======================
process         Allan variance      density
==============  ==================  ======================
quantization Q  3/τ²                T (2πf)²
white N         1/τ                 1
flicker F       1                   1/(4 ln 2 · f)
walk K          τ/3                 1/(2πf)²
==============  ==================  ======================

F is the smallest value of the Allan deviation, 0.664 times the coefficient B of the standard. The
likelihood uses the ordinates of a record: the values of its DCT-II without the first one, the mean. The
vectors of this transform are the eigenvectors of the normal matrix of differences, so the ordinates of
white noise and of a random walk of any mean are exactly independent. The ordinates of flicker noise have
correlations of at most 0.12, which are neglected; their squares, which enter the likelihood, have
correlations of at most 0.015.

The variance of the Allan deviation follows from the fitted noise of the record (its variogram), not from an
assumed kind: for Gaussian noise Var σ̂² = 2/M² Σ (M − |l|) R(l)², with R the autocovariance of the M
overlapping differences, and the degrees of freedom are 2 (σ²)²/Var σ̂².

The coefficients are fitted to the spectrum of a record at rest by restricted maximum likelihood.
Sinusoids (a vibrating table, hum) are subtracted from the record first, and the ordinates around them are
left out. The lowest ordinates are used individually, the higher ones as means of narrow bins.

Ordinates are independent and normal with variances linear in the squared coefficients θ ≥ 0. The mean and
the linear slope of each record are no noise. The likelihood therefore describes the part of the data
orthogonal to them (REML), which is a term of rank one for the slope. An absent coefficient is on the
boundary θ = 0, and the likelihood ratio has there the distribution ½χ²₀ + ½χ²₁ (Self and Liang 1987).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import fft, optimize, special

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.uncertainty import LINE_IN_NOISE, NORMAL_95, SLOW_NOISE, Value, finite_or_none
from adis_gonio.device.sensor.settings import filter_response, filter_weights

Kind = Literal["quantization", "white", "flicker", "walk"]
KINDS: tuple[Kind, ...] = get_args(Kind)

_FLICKER_ALLAN = 4 * math.log(2)
"""Allan variance of noise with the two-sided density h/f, in units of h."""
_TABLE = 256


def variances(filter_m: int, n: int, k: Floats, period_s: float) -> Floats:
    """Return the variances (len(k), 4) of DCT-II coefficients of each of the four noise processes.

    The columns are for quantization, white noise, flicker noise and random walk, each with a squared
    coefficient of 1. The rows are for the DCT-II coefficients with the indices `k` of a record of `n`
    samples. The samples are `period_s` apart and have passed the filter M = `filter_m`.
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
    """Return the variances (len(k),) of DCT-II coefficients of a process with a short autocovariance.

    They are for the DCT-II coefficients with the indices `k` of `n` samples; `autocovariance` is by lag.
    The variances are exact and include the effect of the ends of the record, by Σ_t φ_k(t) φ_k(t+l) = ((n −
    l) cos(la) − sin(la)/sin(a))/n for the basis functions φ_k of the DCT-II, with a = πk/n.
    """
    angle = np.pi * k / n
    total = np.full(len(k), autocovariance[0])
    for lag in range(1, min(len(autocovariance), n)):
        turned = lag * angle
        shape = (1 - lag / n) * np.cos(turned) - np.sin(turned) / (n * np.sin(angle))
        total += 2 * autocovariance[lag] * shape
    return np.asarray(np.maximum(total, 0.0), np.float64)


def line(n: int, k: Floats) -> Floats:
    """Return the DCT-II coefficients (len(k),) of the straight line 0, 1, … n − 1, at the indices `k`.

    Coefficients with an even index are zero.
    """
    angle = np.pi * k / n
    odd = -math.sqrt(2 / n) * np.cos(angle / 2) / (2 * np.sin(angle / 2) ** 2)
    return np.where(k % 2 == 1, odd, 0.0)


@lru_cache(maxsize=32)  # equal for all axes
def variograms(filter_m: int, lags: int, period_s: float) -> Floats:
    """Return half the mean squared difference (lags, 4) of two samples, for each process in `KINDS`.

    The rows are for the distances 0, 1, … `lags` − 1 in samples, behind the filter M = `filter_m`;
    `period_s` is the time between samples. Each column is for a squared coefficient of 1.
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
    """Return the cosine integral Cin(x): the integral of (1 − cos t)/t from 0 to x."""
    inside = np.maximum(x, 1e-9)
    value = np.log(inside) + np.euler_gamma - special.sici(inside)[1]
    return np.where(x > 0, value, 0.0)


@lru_cache(maxsize=1)
def _edge_table() -> Floats:
    """Return the variance times frequency of the DCT-II coefficients 1 … `_TABLE` of flicker noise.

    The product would be constant without the ends of a record; the table has their effect. It is computed
    from the variogram 2h Cin(πl) at lag l of noise with the density h/|f| below half the sampling rate, for
    a record so long that its length has no effect.
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
"""Smallest number of differences between neighbouring means from which an Allan deviation is computed."""
_EXACT = 512
"""Largest averaging time, in samples, at which the expected Allan variance is computed sample by sample
with the filter; for longer times it is computed from means of several samples."""
_LATTICE = 32


class AllanCurve(JsonRecord):
    """Allan deviation of one axis with 95 % intervals, and the deviation that the fitted noise predicts.

    Attributes
    ----------
    tau_s : (t,) float
        Averaging times.
    deviation, low, high, dof : (t,) float
        Overlapping estimate of the Allan deviation, pooled over the records, its 95 % interval (χ²) and its
        effective degrees of freedom.
    model : (t,) float
        Expected Allan deviation by the fitted noise.
    """

    tau_s: Floats
    deviation: Floats
    low: Floats
    high: Floats
    dof: Floats
    model: Floats


def octaves(longest: int) -> list[int]:
    """Return the averaging times of the Allan variance in samples: 1, 2, 4, … .

    At the largest time a record of `longest` samples has at least `LEAST_DIFFERENCES` differences of
    neighbouring means.
    """
    return [1 << j for j in range(longest.bit_length()) if 2 * (1 << j) + LEAST_DIFFERENCES <= longest]


def overlapping(samples: Sequence[Floats]) -> tuple[list[int], Floats]:
    """Compute the overlapping Allan deviation of samples, pooled over records.

    Parameters
    ----------
    samples : sequence of (n, axes) float
        Records with one sample rate.

    Returns
    -------
    m : list of int
        Averaging times in samples, at octaves.
    deviation : (len(m), axes) float
        Allan deviation at these times, in the unit of the samples.
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
    """Compute the Allan deviation of an axis from its records, and the deviation by its fitted noise.

    Parameters
    ----------
    records : sequence of (n,) float
        Samples of each record.
    squares : (4,) float
        Squared coefficients of the fitted noise processes, in the order of `KINDS`.
    filter_m : int
        Parameter M of the filter that the samples have passed.
    period_s : float
        Time between samples.
    rounding : (lags,) float
        Autocovariance of the converter's rounding, in the squared unit of the samples.
    """
    times, deviation = overlapping([record[:, None] for record in records])
    lengths = [len(record) for record in records]
    variogram = partial(_variogram, squares, filter_m, period_s, rounding)
    expected, nu = np.array([_expected(m, lengths, variogram) for m in times]).T
    low, high = (deviation[:, 0] * np.sqrt(nu / special.chdtri(nu, 1 - q)) for q in (0.975, 0.025))
    tau = period_s * np.array(times, dtype=float)
    return AllanCurve(tau, deviation[:, 0], low, high, nu, np.sqrt(expected))


def _expected(
    m: int, lengths: Sequence[int], variogram: Callable[[int, int], Floats]
) -> tuple[float, float]:
    """Return the expected Allan variance at m samples under a noise model, and the dof of its estimate.

    The estimate pools records of these `lengths` in samples. `variogram` returns the variogram of the model
    for a number of lags and a number of samples in each mean (`_variogram`).
    """
    coarse = 1 if m <= _EXACT else m // _LATTICE
    step = m // coarse
    gamma = variogram(10 * step, coarse)
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
    squares: Floats, filter_m: int, period_s: float, rounding: Floats, lags: int, coarse: int
) -> Floats:
    """Return half the mean squared difference of two means of `coarse` samples, by their distance.

    The distances are 0, 1, … `lags` − 1 such means of samples `period_s` apart behind the filter M =
    `filter_m`. `squares` are the squared coefficients of the model, `rounding` the autocovariance, by lag,
    of the converter's rounding.
    """
    if coarse == 1:
        own = variograms(filter_m, lags, period_s) @ squares
        return np.asarray(own + rounding[0] - _padded(rounding, lags), np.float64)
    # The filter is short against such a mean, and rounding is white noise there.
    white = squares.copy()
    white[KINDS.index("white")] += period_s * float(rounding[0] + 2 * rounding[1:].sum())
    return np.asarray(variograms(0, lags, period_s * coarse) @ white, np.float64)


MOST = 12
_LOWEST = 24
"""Fewest cycles per record at which a sinusoid can be separated from slow noise."""
_WIDTH = 48
"""Number of ordinates on each side from which the noise power at an ordinate is estimated."""
_LEAKS = 4
"""Number of ordinates on either side of a sinusoid into which its power leaks (Hann's window)."""


class SpectralLine(JsonRecord):
    """A sinusoid that was found in a record.

    Attributes
    ----------
    frequency_hz : float
        Frequency after sampling: a vibration above half the sample rate appears as its alias.
    amplitude : float
        Amplitude in the unit of the samples, behind the sensor's filter.
    """

    frequency_hz: float
    amplitude: float


def subtract_sinusoids(
    record: Floats, period_s: float, highest: float
) -> tuple[Floats, list[SpectralLine], NDArray[np.intp]]:
    """Subtract strong sinusoids from a record.

    Parameters
    ----------
    record : (n,) float
        Samples without their linear slope.
    period_s : float
        Time between samples.
    highest : float
        Highest frequency of a sinusoid in cycles per sample.

    Returns
    -------
    (n,) float
        The record without the sinusoids.
    list of SpectralLine
        The sinusoids, in the order in which they were found.
    (l,) int
        Indices of the DCT-II ordinates that they affect; an index may occur twice.
    """
    found: list[SpectralLine] = []
    masked: list[NDArray[np.intp]] = []
    taken = np.zeros(len(record) // 2 + 1, dtype=bool)
    while len(found) < MOST:
        peak = _peak(record, highest, taken)
        if peak is None:
            break
        place, ratio = peak
        phase = 2 * np.pi * place / len(record) * np.arange(len(record))
        # Least squares of cosine and sine at this frequency.
        columns = np.stack([np.cos(phase), np.sin(phase)], axis=1)
        values = np.linalg.solve(columns.T @ columns, columns.T @ record)
        record = np.asarray(record - columns @ values, np.float64)
        reach = _LEAKS + int(min(math.sqrt(ratio) / 16, len(record) / 256))
        middle = round(place)
        taken[max(0, middle - reach) : middle + reach + 1] = True
        masked.append(np.arange(2 * (middle - reach), 2 * (middle + reach) + 1))
        found.append(SpectralLine(place / len(record) / period_s, float(np.hypot(*values))))
    return record, found, np.concatenate(masked) if masked else np.zeros(0, np.intp)


def _peak(record: Floats, highest: float, taken: NDArray[np.bool_]) -> tuple[float, float] | None:
    """Return the frequency of a record's strongest sinusoid in cycles per record, and its power.

    The power is relative to the noise around it. Frequencies up to `highest` (cycles per sample) count that
    are not in `taken`. The result is None if no sinusoid exceeds the noise clearly.
    """
    n = len(record)
    last = int(highest * n)
    if last - _LOWEST < 4 * _WIDTH:
        return None
    lines = fft.rfft(record * np.hanning(n + 1)[:-1])[: last + 2]
    power = lines.real**2 + lines.imag**2
    level = _level(power[_LOWEST:last])
    # The rest of a subtracted sinusoid does not count again.
    ratio = np.where(taken[_LOWEST:last], 0.0, power[_LOWEST:last] / level)
    at = int(ratio.argmax())
    # The power is exponential around its level, the mean of about ninety neighbours.
    if ratio[at] < 1.35 * math.log(len(ratio) / LINE_IN_NOISE):
        return None
    # Frequency between two ordinates by the ratio of their amplitudes behind Hann's window.
    k = at + _LOWEST
    side = 1 if power[k + 1] > power[k - 1] else -1
    towards = math.sqrt(power[k + side] / power[k])
    return k + side * max(0.0, (2 * towards - 1) / (towards + 1)), float(ratio[at])


def _level(power: Floats) -> Floats:
    """Return the mean power of the noise around each ordinate of a spectrum.

    It is the higher one of two estimates by the median, one from each side of the ordinate.
    """
    step = _WIDTH // 4
    # Medians over four cells of `step` ordinates; the median of exponential noise is ln 2 times its mean.
    cells = power[: len(power) // step * step].reshape(-1, step)
    windows = np.lib.stride_tricks.sliding_window_view(cells, 4, axis=0)
    medians = np.median(windows, axis=(1, 2)) / math.log(2)
    cell = np.minimum(np.arange(len(power)) // step, len(cells) - 1)
    before = np.clip(cell - 4, 0, len(medians) - 1)
    after = np.clip(cell + 1, 0, len(medians) - 1)
    # On a slope (of the filter, of slow noise) the higher side counts.
    level: Floats = np.maximum(np.maximum(medians[before], medians[after]), 1e-300)
    return level


SINGLES = 64
"""Number of the lowest ordinates that have a bin each."""
_RELATIVE, _ABSOLUTE = 1 / 32, 1 / 1024
"""Limits of the width of a bin: relative to its frequency, and in cycles per sample; the smaller one
counts."""
_POINTS = 16
"""Largest number of ordinates of a bin at which the densities of the noise processes are computed."""


@dataclass(frozen=True)
class Ordinates:
    """Spectrum of one or several records of an axis: its ordinates, joined in frequency bins.

    The ordinates of a record are its DCT-II coefficients without the first, the mean.

    Attributes
    ----------
    frequency : (b,) float
        Highest frequency of each bin in cycles per sample.
    weight : (b,) float
        Number of ordinates in each bin.
    power : (b,) float
        Mean of the squares of these ordinates.
    shapes : (b, 4) float
        Mean variance that each noise process in `KINDS` gives the ordinates of a bin, at a squared
        coefficient of 1.
    rounding : (b,) float
        Mean variance of the ordinates from the converter's rounding.
    record : (b,) int
        Number of the record that the bin belongs to.
    single, line : (b,) float
        For a fit of a straight line to each record: the ordinate of a bin that has only one, and this
        ordinate of a straight line with a slope of 1 per sample. `line` is 0 in all other bins.
    """

    frequency: Floats
    weight: Floats
    power: Floats
    shapes: Floats
    rounding: Floats
    record: NDArray[np.intp]
    single: Floats
    line: Floats

    def below(self, frequency: float) -> Ordinates:
        """Return a copy in which the bins above a frequency, in cycles per sample, count as empty."""
        kept = self.frequency <= frequency
        return replace(self, weight=self.weight * kept, line=self.line * kept)


def ordinates(
    record: Floats, filter_m: int, period_s: float, rounding: Floats, masked: NDArray[np.intp]
) -> Ordinates:
    """Compute the spectrum (DCT-II coefficients) of a record after its linear slope was subtracted.

    Parameters
    ----------
    record : (n,) float
        Samples without their linear slope.
    filter_m : int
        Parameter M of the filter that the samples have passed.
    period_s : float
        Time between samples.
    rounding : (lags,) float
        Autocovariance, by lag, of the converter's rounding.
    masked : (l,) int
        Indices of ordinates to leave out, such as the ordinates near a sinusoid.
    """
    n = len(record)
    lines = np.asarray(fft.dct(record, type=2, norm="ortho"), np.float64)[1:]
    grid = _grid(n, filter_m, period_s)
    starts = grid.starts
    kept = np.ones(n - 1, dtype=bool)
    kept[masked[(masked >= 1) & (masked < n)] - 1] = False
    square = np.where(kept, lines**2, 0.0)
    # Sums over the ordinates of each bin.
    weight = np.add.reduceat(kept.astype(np.float64), starts - 1)
    power = np.add.reduceat(square, starts - 1) / np.maximum(weight, 1.0)
    rounded = _rounded(rounding.tobytes(), n, filter_m, period_s)
    single, slope = np.zeros((2, len(starts)))
    singles = min(SINGLES, n - 1)
    single[:singles] = lines[:singles]
    slope[:singles] = kept[:singles] * line(n, np.arange(1.0, singles + 1))
    number = np.zeros(len(starts), dtype=np.intp)
    return Ordinates(grid.highest, weight, power, grid.shapes, rounded, number, single, slope)


def together(parts: list[Ordinates]) -> Ordinates:
    """Combine the spectra of several records of an axis."""
    columns = {name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])}
    number = np.repeat(np.arange(len(parts)), [len(part.record) for part in parts])
    return Ordinates(**columns | {"record": number})


@dataclass(frozen=True)
class _Grid:
    """Frequency bins for records of one length, and the shapes of the noise processes in them.

    Neither depends on the data of the records.

    Attributes
    ----------
    starts : (b,) int
        First ordinate of each bin.
    highest : (b,) float
        Highest frequency of each bin in cycles per sample.
    points : (p,) float
        Ordinates at which densities are computed, `_POINTS` per bin at most.
    first, count : (b,) int
        Index among `points` of the first point of a bin, and number of its points.
    shapes : (b, 4) float
        Mean variance of each noise process in a bin, at a squared coefficient of 1.
    """

    starts: NDArray[np.intp]
    highest: Floats
    points: Floats
    first: NDArray[np.intp]
    count: NDArray[np.intp]
    shapes: Floats

    def mean(self, values: Floats) -> Floats:
        """Return the mean (b,) in each bin of the values (p,) at its points."""
        return np.asarray(np.add.reduceat(values, self.first) / self.count, np.float64)


@lru_cache(maxsize=8)
def _grid(n: int, filter_m: int, period_s: float) -> _Grid:
    # Axes, and most dwells of a session, have one length.
    # Low ordinates have a bin each; at higher frequencies the bins are wider.
    edges = list(range(1, min(SINGLES, n - 1) + 1))
    at = edges[-1] + 1
    while at < n:
        edges.append(at)
        at += max(1, int(min(at * _RELATIVE, 2 * n * _ABSOLUTE)))
    starts = np.array(edges, dtype=np.intp)
    stops = np.append(starts[1:], n).astype(np.intp)
    count = np.minimum(_POINTS, stops - starts)
    first = np.cumsum(count) - count
    owner = np.repeat(np.arange(len(starts)), count)
    # Evenly spaced points within each bin.
    step = np.arange(len(owner)) - first[owner]
    points = starts[owner] + (step + 0.5) / count[owner] * (stops - starts)[owner] - 0.5
    shapes = np.add.reduceat(variances(filter_m, n, points, period_s), first, axis=0) / count[:, None]
    return _Grid(starts, (stops - 1) / (2 * n), points, first, count, shapes)


@lru_cache(maxsize=8)
def _rounded(rounding: bytes, n: int, filter_m: int, period_s: float) -> Floats:
    """Return the mean variance (b,) in each frequency bin that the converter's rounding causes.

    The record has `n` samples `period_s` apart behind the filter M = `filter_m`. `rounding` are the bytes
    of the autocovariance of the rounding errors.
    """
    grid = _grid(n, filter_m, period_s)
    return grid.mean(ordinate_variances(np.frombuffer(rounding), n, grid.points))


_CELLS, _LEAST_CELL = 24, 16
_MOST_STEPS = 100
_SMALLEST_GAIN = 1e-10
"""Expected decrease of the deviance by a step below which a search has converged."""


@dataclass(frozen=True)
class NoiseParameter:
    """One noise process of one axis, with its coefficient (not squared) by the profile likelihood.

    Attributes
    ----------
    kind : {"quantization", "white", "flicker", "walk"}
        Kind of the noise process; `white` is angle or velocity random walk, `flicker` bias instability.
    name, unit : str
        Name, such as `angle_random_walk`, and unit of the coefficient. `bias_instability` is the floor of
        the Allan deviation.
    likeliest : float
        Coefficient at the maximum of the likelihood.
    u : float
        Standard uncertainty by the Fisher information; NaN if the coefficient is zero.
    low, high : float
        Profile-likelihood interval of 95 %; `low` is 0 if the process may be absent.
    p_value : float
        Probability of data that favour the noise process at least as much, if it is absent.
    """

    kind: Kind
    name: str
    unit: str
    likeliest: float
    u: float
    low: float
    high: float
    p_value: float

    @property
    def present(self) -> bool:
        """True if a test of the hypothesis that this noise process is absent rejects it (`p_value`)."""
        return self.p_value < SLOW_NOISE

    @property
    def dof(self) -> float:
        """Degrees of freedom of a standard deviation with the relative uncertainty of the coefficient.

        NaN if u is NaN.
        """
        return self.likeliest**2 / (2 * self.u**2) if self.u > 0 else math.nan

    @property
    def value(self) -> Value | None:
        """Coefficient of the process with its uncertainty; None if the process may be absent.

        The expanded uncertainty U is the longer side of the 95 % interval, and the coverage factor k is
        U/u.
        """
        if not self.present:
            return None
        arm = max(self.high - self.likeliest, self.likeliest - self.low)
        return Value(self.likeliest, self.u, self.unit, self.dof, factor=arm / self.u)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of a noise process: its value with uncertainty, interval and upper limit.

        The value, u, its degrees of freedom ν, k and U are null if the process may be absent.
        """
        empty = {**dict.fromkeys(("value", "u", "dof", "k", "U")), "unit": self.unit}
        return {
            "present": self.present,
            **(empty if self.value is None else self.value.as_dict()),
            "interval_95": [self.low, finite_or_none(self.high)],
            "upper_95": finite_or_none(self.high),
            "p_value": self.p_value,
        }


class Likelihood:
    """−2 log likelihood of the squared coefficients of noise processes, given a spectrum.

    It also has the slope and the Fisher information with respect to the squared coefficients.

    Parameters
    ----------
    data : Ordinates
        Spectrum of the records; the weight of an empty bin is 0.
    without : collection of int
        Indices of noise processes in `KINDS` that the model lacks.
    """

    def __init__(self, data: Ordinates, without: Collection[int] = ()) -> None:
        self._data = data
        self._has = np.array([k not in without for k in range(data.shapes.shape[1])])
        self._least = 1e-12 * float(np.max(data.power, initial=1e-300))
        typical = float(np.average(data.power, weights=data.weight))
        # Bins with equal expectations, as in records of equal length, count as one.
        same = np.column_stack([data.shapes, data.rounding])
        # Rows as bytes are sorted faster than with `axis=0`.
        rows = same.view(f"V{same.shape[1] * same.itemsize}").ravel()
        _, first, self._owner = np.unique(rows, return_index=True, return_inverse=True)
        self._shapes, self._rounding = data.shapes[first], data.rounding[first]
        self._weight = np.bincount(self._owner, data.weight)
        self._power = np.bincount(self._owner, data.weight * data.power) / np.maximum(self._weight, 1e-300)
        # Scales: each process alone would make up the whole power.
        self.scale = typical / np.average(data.shapes, axis=0, weights=data.weight)
        # The single ordinates of all records, one after another: their bins and their records.
        single = np.flatnonzero(data.line)
        self._c, self._d, self._singles = data.single[single], data.line[single], self._owner[single]
        self._lined, self._starts, self._record = np.unique(
            data.record[single], return_index=True, return_inverse=True
        )

    def expected(self, theta: Floats) -> Floats:
        """Return the expected variance (k,) of the ordinates in each of k kinds of frequency bins.

        `theta` (4,) are the squared coefficients. Bins in which every model expects equal variances are one
        kind, such as equal bins of records of equal length.
        """
        return np.asarray(np.maximum(self._shapes @ theta + self._rounding, self._least), np.float64)

    def _lines(self, v: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Return terms and sums for the weighted fit of a straight line to each of r records.

        The slope of the fitted line is b/a with a = Σ d²/v and b = Σ c d/v. Here c are the lowest ordinates
        of a record, d the ordinates of a line of slope 1 and v the expected variances of their bins. The
        results are the terms (s,) of a and of b for the ordinates of all records, then a (r,) and b (r,).
        """
        square, product = self._d**2 / v[self._singles], self._c * self._d / v[self._singles]
        a, b = np.add.reduceat(square, self._starts), np.add.reduceat(product, self._starts)
        return square, product, a, b

    def derivatives(self, theta: Floats) -> tuple[float, Floats, Floats]:
        """Return the deviance of the squared coefficients θ, its gradient, and their Fisher information.

        The deviance is −2 log likelihood up to a constant. The gradient is (4,), the information a matrix
        (4, 4).
        """
        v = self.expected(theta)
        relative, ratio = self._shapes / v[:, None], self._power / v
        slope = relative.T @ (self._weight * (1 - ratio))
        information = relative.T @ (self._weight[:, None] * relative)
        square, product, a, b = self._lines(v)
        # Derivatives of ln a − b²/a, the REML terms of the records' lines.
        shape = relative[self._singles]
        da = -np.add.reduceat(square[:, None] * shape, self._starts, axis=0) / a[:, None]
        db = -np.add.reduceat(product[:, None] * shape, self._starts, axis=0)
        slope += da.sum(axis=0) - 2 * (b / a) @ db + (b**2 / a) @ da
        information += da.T @ da - 2 * shape.T @ ((square / a[self._record])[:, None] * shape)
        lines = float((np.log(a) - b**2 / a).sum())
        return float(self._weight @ (np.log(v) + ratio)) + lines, slope, information / 2

    def maximum(self, start: Floats, fixed: dict[int, float] | None = None) -> tuple[Floats, float]:
        """Return the θ (4,) ≥ 0 of the largest likelihood and its deviance.

        Parameters
        ----------
        start : (4,) float
            Squared coefficients at which the search starts.
        fixed : dict, optional
            Values of fixed squared coefficients, by index; None if all are free.
        """
        held = fixed or {}
        theta = np.where(self._has, np.maximum(start, 0.0), 0.0)
        theta[list(held)] = list(held.values())
        free = np.flatnonzero(self._has & ~np.isin(np.arange(len(theta)), list(held)))
        least, slope, information = self.derivatives(theta)
        step, bend = np.zeros(len(theta)), np.zeros(len(theta))
        for _ in range(_MOST_STEPS if len(free) else 0):
            # Fisher scoring, with the curvature along the last step from the change of the slope (BFGS).
            curvature = 2 * information
            if bend @ step > 0:
                along = curvature @ step
                curvature += np.outer(bend, bend) / (bend @ step) - np.outer(along, along) / (along @ step)
            # Minimum over θ ≥ 0 of the quadratic with this slope and this curvature.
            curvature = curvature[np.ix_(free, free)]
            scale = 1 / np.sqrt(np.diagonal(curvature))
            root = np.linalg.cholesky(curvature * np.outer(scale, scale) + 1e-12 * np.eye(len(free)))
            target = root.T @ (theta[free] / scale) - np.linalg.solve(root, scale * slope[free])
            step[free] = scale * optimize.nnls(root.T, target)[0] - theta[free]
            gain = -float(slope @ step)
            if gain < _SMALLEST_GAIN:
                break
            deviance, new, information = self.derivatives(theta + step)
            # Halve the step until the deviance decreases enough.
            while deviance > least - 1e-4 * gain and gain > _SMALLEST_GAIN:
                step, gain = step / 2, gain / 2
                deviance, new, information = self.derivatives(theta + step)
            theta, least, slope, bend = theta + step, deviance, new, new - slope
        return theta, least

    def best(self) -> tuple[Floats, float]:
        """Maximize the likelihood from white and little slow noise; return θ (4,) and its deviance."""
        return self.maximum(self.scale * [0.0, 1.0, 0.01, 0.01])

    def u_squared(self, theta: Floats, index: int) -> float:
        """Return the standard uncertainty of the squared coefficient θ[index], by the Fisher information.

        Other coefficients count as free if they are above zero.
        """
        information = self.derivatives(theta)[2]
        with_it = (theta > 0) | (np.arange(len(theta)) == index)
        scale = np.where(with_it, self.scale, 0.0)
        inverse = np.linalg.pinv(information * np.outer(scale, scale), rcond=1e-13)
        return float(scale[index] * math.sqrt(max(inverse[index, index], 0.0)))

    def slopes(self, theta: Floats) -> tuple[Floats, Floats]:
        """Return the slopes (r,) per sample of the straight lines fitted to r records, and their 1/u² (r,).

        Both are 0 for a record without a line.
        """
        _, _, a, b = self._lines(self.expected(theta))
        slope, precision = np.zeros((2, int(self._data.record.max()) + 1))
        slope[self._lined], precision[self._lined] = b / a, a
        return slope, precision

    def adequacy(self, theta: Floats) -> float:
        """Return the p-value of the spectrum under the model θ: small if θ does not explain the spectrum.

        The test compares the mean power in groups of neighbouring ordinates with the model.
        """
        data = self._data
        v = self.expected(theta)[self._owner]
        order = np.argsort(data.frequency, kind="stable")
        weight, ratio = data.weight[order], (data.power / v)[order]
        filled = np.cumsum(weight)
        width = max(float(filled[-1]) / _CELLS, _LEAST_CELL)
        # Half of the cells have equal numbers of ordinates, half are octaves, so that slow noise has cells.
        edges = np.concatenate([np.arange(1, _CELLS) * width, _LEAST_CELL * 2.0 ** np.arange(_CELLS)])
        edges = np.unique(edges[edges < filled[-1] - _LEAST_CELL])
        cuts = np.unique(np.concatenate([[0], np.searchsorted(filled, edges) + 1]))
        cuts = cuts[cuts < len(weight)]
        sums = np.add.reduceat(weight, cuts)
        mean = np.add.reduceat(weight * ratio, cuts) / np.maximum(sums, 1.0)
        kept = sums >= _LEAST_CELL / 2
        mean = np.maximum(mean[kept], 1e-12)
        distance = float(np.sum(sums[kept] * (mean - 1 - np.log(mean))))
        dof = int(kept.sum()) - int((theta > 0).sum())
        return float(special.chdtrc(dof, distance)) if dof > 0 else 1.0


def profile(
    likelihood: Likelihood, theta: Floats, least: float, index: int, name: str, unit: str
) -> NoiseParameter:
    """Estimate the coefficient of one noise process, by the likelihood maximized over the others.

    `theta` is the maximum of the likelihood over all squared coefficients, and `least` its deviance;
    `index` is the index of the process in `KINDS`, `name` and `unit` describe its coefficient.
    """
    ratio = max(likelihood.maximum(theta, {index: 0.0})[1] - least, 0.0)
    p_value = 0.5 * float(special.chdtrc(1, ratio)) if theta[index] > 0 else 1.0
    u_squared = likelihood.u_squared(theta, index)
    sigma = math.sqrt(theta[index])
    u = u_squared / (2 * sigma) if sigma > 0 else math.nan
    dof = max(sigma**2 / (2 * u**2), 1.0) if sigma > 0 else 1.0
    # With few degrees of freedom the likelihood ratio exceeds χ² by the mean of ln χ² (Bartlett).
    limit = NORMAL_95 * math.sqrt(1 + 1 / (3 * dof))

    def beyond(squared: float) -> float:
        # The square root of the likelihood ratio is almost linear in θ, so that few steps find a root. Each
        # search starts at the same θ, so that equal arguments give equal values, as a bracket needs.
        return math.sqrt(max(likelihood.maximum(theta, {index: squared})[1] - least, 0.0)) - limit

    # The squares may be far below SciPy's absolute tolerance.
    root = partial(optimize.brentq, beyond, xtol=1e-300, rtol=1e-5)
    begin = float(theta[index])
    top = begin + NORMAL_95 * max(u_squared, 1e-12 * likelihood.scale[index])
    # Double or halve the bound until it brackets the end of the interval.
    for _ in range(60):
        if beyond(top) > 0:
            break
        begin, top = top, 2 * top
    high = float(root(begin, top))
    low = 0.0
    if p_value < SLOW_NOISE:
        halves = (theta[index] / 2.0 ** np.arange(1, 41)).tolist()
        low = next((half for half in halves if beyond(half) > 0), 0.0)
    if low:
        low = float(root(low, 2 * low))
    return NoiseParameter(KINDS[index], name, unit, sigma, u, math.sqrt(low), math.sqrt(high), p_value)
