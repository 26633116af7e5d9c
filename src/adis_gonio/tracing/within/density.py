"""Spectral density of the noise inside the dwells, pooled over them, against which tones are judged.

Every dwell's periodogram (least-squares line taken off, Hann's taper, zero-padded to twice its length) is
divided by the dwell's own level, so that a loud dwell does not count for more. Their mean over dwells is
divided by the shape that the chip's Bartlett filter gives to white noise, with a floor (the converter) and
1/f noise; which of the filter's lengths, and how much of both, is chosen by the Whittle likelihood. Other
sensors take the flat one. What is left varies slowly with frequency (other filters) and is followed by a
running median, which a line does not move.

A line near the lowest frequencies looks like 1/f noise to both. Where a line is likelier at what stands
highest above its own neighbours than any shape is that holds it (a filter has lobes), both sides of it
stand in its place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, optimize, signal, stats

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import FOUND_WITHIN
from adis_gonio.tracing.within.finding import corrected
from adis_gonio.tracing.within.samples import Samples

PADDING = 2
"""Points of the grid an independent ordinate."""
LOWEST = 6
"""Cycles a dwell below which a line cannot be told from slow noise or drift."""
LEAST_SAMPLES = 32
_FILTERS = range(7)
_FLOORS = (0.0, *np.geomspace(1e-3, 30.0, 8).tolist())
"""What the converter adds at the lowest frequency searched, in units of the filtered density's largest
value."""
_KNEES = (np.inf, 0.2, 0.07, 0.025, 0.0)
"""Frequencies in cycles a sample above which that falls off with the square: a slow signal jumps from code
to code, the slower the rarer."""
_FLICKERS = (0.0, *np.geomspace(0.01, 300.0, 10).tolist())
"""1/f noise at the lowest frequency searched, in the same unit."""
_ROUNDING = 1e-30
"""Power in mg² that is none: of an axis that shows one code."""
_CELLS = 120
_LENGTHS = 5
_LINE = 2.0
"""Ordinates to each side that a line reaches under Hann's taper."""
_STEEP = 1.5
"""Ordinates to each side over which the density's shape counts as one."""
TAPER_LOSS = 1.944
"""n Σw⁴ / (Σw²)² of Hann's taper: degrees of freedom that it costs."""
_WIDTHS = (6, 16, 40)
"""Half widths of the running median in independent ordinates; the largest one that is at most a third of
the ordinate's number."""


@dataclass(frozen=True)
class Density:
    """Periodograms of dwells of one sampling rate.

    Attributes
    ----------
    dwells : (d,) int
        Which dwells of the samples: those that are long enough.
    frequency : (k,) float
        Cycles a sample.
    searched : slice
        Part of the grid in which lines are looked for.
    power : (d, k, axes) float
        Periodograms, mg² (two-sided density a sample).
    level : (d, axes) float
        Level of each dwell, at least the middle one of all: its density is about `level · base`.
    base : (k, axes) float
        Pooled density, of a level of 1 on average.
    bound : (k, axes) float
        What a line has to stand above: `base`, or what lies beside it where that is more.
    width : (k,) float
        Independent ordinates in the running median.
    """

    dwells: NDArray[np.intp]
    frequency: Floats
    searched: slice
    power: Floats
    level: Floats
    base: Floats
    bound: Floats
    width: Floats

    @property
    def relative(self) -> Floats:
        """Ordinates (d, searched, axes) in units of what a line has to stand above."""
        return self.power[:, self.searched] / self.level[:, None, :] / self.bound[None, self.searched]

    @cached_property
    def effective(self) -> Floats:
        """Dwells (axes,) whose independent ordinates would scatter about the density as the pooled ones do.

        At most all of them. What lies beside a point is no part of that: it scatters by itself.
        """
        part = self.searched
        pooled = (self.power[:, part] / self.level[:, None, :]).mean(axis=0) / self.base[part]
        low, high = np.quantile(np.log(pooled), [0.25, 0.75], axis=0)
        dwells = len(self.dwells)
        above, below = (float(stats.gamma.ppf(share, dwells)) for share in (0.75, 0.25))
        expected = math.log(above / below)
        shared = dwells * (expected / np.maximum(high - low, expected)) ** 2
        return np.asarray(np.maximum(shared, 1.0), dtype=np.float64)


def density_of(samples: Samples) -> Density | None:
    """Density of the dwells that have `LEAST_SAMPLES`; None where there are none."""
    counts = samples.counts
    dwells = np.flatnonzero(counts >= LEAST_SAMPLES)
    if not dwells.size:
        return None
    longest, middle = int(counts[dwells].max()), float(np.median(counts[dwells]))
    size = int(fft.next_fast_len(PADDING * longest, real=True))
    frequency = np.arange(size // 2 + 1) / size
    power = np.empty((len(dwells), len(frequency), samples.axes))
    for row, k in enumerate(dwells.tolist()):
        rows = without_line(samples.values[k])
        lines = fft.rfft((rows * _taper(len(rows))[:, None]).T, size)
        power[row] = np.maximum(lines.real**2 + lines.imag**2, _ROUNDING).T
    each = size / middle
    first = max(1, round(LOWEST * each))
    searched = slice(first, len(frequency) - max(1, round(each / 2)))
    band = power[:, searched]
    level = np.maximum(np.median(band, axis=1), 1e-300)
    width = _widths(len(frequency), each)
    pooled = (power / level[:, None, :]).mean(axis=0)
    beside = _beside(pooled, searched, each)
    information = len(dwells) / each / TAPER_LOSS
    tests = samples.axes * (searched.stop - searched.start) / each
    responses = [own[searched] for own in _responses(counts[dwells], size)]
    shape = np.ones((len(frequency), samples.axes))
    lined = np.zeros(samples.axes, dtype=bool)
    for axis in range(samples.axes):
        own, usual = pooled[searched, axis], beside(pooled, axis)[searched]
        with_peak, without = (_shape(p, frequency[searched], responses) for p in (own, usual))
        gain = information * _gain(own, with_peak, without, own != usual)
        lined[axis] = corrected(math.exp(-max(gain, 0.0)), tests) < FOUND_WITHIN
        shape[searched, axis] = without if lined[axis] else with_peak
    # Below and above what is searched the density counts as level.
    shape[: searched.start], shape[searched.stop :] = shape[searched.start], shape[searched.stop - 1]
    # The median of an exponential distribution is ln 2 of its mean.
    level = np.maximum(np.median(band / shape[None, searched], axis=1) / np.log(2), 1e-300)
    # The converter's floor does not fall with a quiet dwell, which would rule the notches of the filter.
    level = np.maximum(level, np.median(level, axis=0))
    pooled = (power / level[:, None, :]).mean(axis=0)
    base = np.stack(
        [
            _smooth(
                (beside(pooled, axis) if lined[axis] else pooled[:, axis]) / shape[:, axis],
                searched,
                width,
                each,
            )
            for axis in range(samples.axes)
        ],
        axis=1,
    )
    # Where the density is steep (edges and notches of a filter) a small error of its shape is a large one
    # of the density: there its largest value nearby counts.
    base = base * ndimage.maximum_filter1d(shape, 2 * round(_STEEP * each) + 1, axis=0)
    # On a slope of the density one side is as high as a line would be: a line stands above both.
    bound = np.maximum(base, _flanks(pooled, each))
    return Density(dwells.astype(np.intp), frequency, searched, power, level, base, bound, 2 * width + 1)


def _beside(pooled: Floats, searched: slice, each: float) -> Callable[[Floats, int], Floats]:
    """Densities (k,) of an axis without what a line would be: where it stands highest above its neighbours.

    There the geometric mean of both sides stands instead.
    """
    above = (pooled / np.maximum(_flanks(pooled, each), 1e-300))[searched]
    peaks = searched.start + above.argmax(axis=0)
    near, far = round(_LINE * each), 3 * round(_LINE * each)

    def bridged(density: Floats, axis: int) -> Floats:
        peak = int(peaks[axis])
        out = density[:, axis].copy()
        sides = [out[max(0, peak - far) : peak - near + 1], out[peak + near : peak + far + 1]]
        middles = [float(np.median(side)) for side in sides if len(side)]
        out[peak - near + 1 : peak + near] = math.exp(np.mean(np.log(middles)))
        return out

    return bridged


def _gain(own: Floats, with_peak: Floats, without: Floats, peak: NDArray[np.bool_]) -> float:
    """Log likelihood that a line at the peak gains, a dwell and point of the grid of information.

    Whittle's, with the scale fitted: of a shape that was fitted with the peak, against one that was fitted
    without it and a line that takes what is there.
    """

    def loss(shape: Floats, part: NDArray[np.bool_]) -> float:
        scale = float((own[part] / shape[part]).mean())
        return float(np.log(shape[part]).sum()) + float(part.sum()) * (math.log(scale) + 1)

    line = float(np.log(own[peak]).sum()) + float(peak.sum())
    return loss(with_peak, np.ones_like(peak)) - loss(without, ~peak) - line


def _flanks(pooled: Floats, each: float) -> Floats:
    """Larger one of the means (k, axes) over the ordinates on both sides that a line does not reach."""
    near, far = round(_LINE * each), round(2 * _LINE * each)
    sums = np.concatenate([np.zeros((1, pooled.shape[1])), np.cumsum(pooled, axis=0)])
    at = np.arange(len(pooled))

    def mean(first: NDArray[np.intp], last: NDArray[np.intp]) -> Floats:
        first, last = np.clip(first, 0, len(pooled)), np.clip(last, 0, len(pooled))
        count = np.maximum(last - first, 1)[:, None]
        return np.asarray((sums[last] - sums[first]) / count, dtype=np.float64)

    return np.maximum(mean(at - far, at - near + 1), mean(at + near, at + far + 1))


def without_line(rows: Floats) -> Floats:
    """Samples (n, axes) without their mean and slope."""
    place = np.arange(len(rows)) - (len(rows) - 1) / 2
    centred = rows - rows.mean(axis=0)
    slope = place @ centred / max(float(place @ place), 1e-300)
    result: Floats = centred - place[:, None] * slope
    return result


def _widths(points: int, each: float) -> Floats:
    """Half width (k,) of the running median at each point of the grid, in independent ordinates."""
    ordinate = np.arange(points) / each
    width = np.full(points, float(_WIDTHS[0]))
    for half in _WIDTHS[1:]:
        width[ordinate >= 3 * half] = half
    return width


def _smooth(flat: Floats, searched: slice, width: Floats, each: float) -> Floats:
    """Running median of a density over the part that is searched, continued beyond it."""
    smooth = np.empty_like(flat)
    # Beyond the part that is searched lie drift and the last ordinate: they must not pull on the rest.
    inside = flat[searched]
    for half in np.unique(width):
        points = min(2 * int(half * each) + 1, 2 * (len(inside) // 2) - 1)
        level = ndimage.median_filter(inside, size=max(points, 1), mode="reflect")
        padded = np.concatenate(
            [
                np.full(searched.start, level[0]),
                level,
                np.full(len(flat) - searched.start - len(level), level[-1]),
            ]
        )
        at = width == half
        smooth[at] = padded[at]
    return np.maximum(smooth, 1e-300)


def _shape(pooled: Floats, frequency: Floats, responses: Sequence[Floats]) -> Floats:
    """Shape (k,) that fits best: white noise behind a filter (`responses`) with a floor and 1/f noise.

    Whittle likelihood with the scale fitted, over cells of neighbours; the model is averaged over the same
    cells, so that a cell may be wider than a notch of the filter.
    """
    # Cells grow with frequency: the foot of a long filter has few ordinates.
    edges = np.unique((len(frequency) * np.linspace(0, 1, _CELLS, endpoint=False) ** 2).astype(np.intp))
    weight = np.diff(np.append(edges, len(frequency))).astype(float)

    def cells(density: Floats) -> Floats:
        return np.asarray(np.add.reduceat(density, edges) / weight, dtype=np.float64)

    seen = cells(pooled)
    low = np.array(_FLICKERS)[:, None] * cells(frequency[0] / frequency)
    floors = np.array(_FLOORS)[:, None, None]
    falls = {knee: _falling(frequency, knee) for knee in _KNEES}

    def deviance(own: Floats) -> Floats:
        """−2 log likelihood less a constant, of models (…, cells) with their scale fitted."""
        return np.asarray(np.log(own) @ weight + weight.sum() * np.log((seen / own) @ weight))

    best, chosen, start = np.inf, np.ones_like(pooled), (0.0, 0.0, 0.0)
    for through in responses:
        response = through / through.max()  # a long filter leaves little of its noise there
        white = cells(response)
        for knee, falling in falls.items():
            losses = deviance(white + floors * cells(falling) + low)
            floor, amount = np.unravel_index(int(losses.argmin()), losses.shape)
            if losses[floor, amount] < best:
                best, chosen = float(losses[floor, amount]), response
                start = (_FLOORS[floor], _FLICKERS[amount], knee)

    least, most = np.log([1e-7, 1e-7, 0.1 * frequency[0]]), np.log([1e4, 1e4, 1.0])

    def model(logs: Floats) -> Floats:
        floor, amount, knee = np.exp(np.clip(logs, least, most)).tolist()
        return np.asarray(chosen + floor * _falling(frequency, knee) + amount * frequency[0] / frequency)

    def loss(logs: Floats) -> float:
        return float(deviance(cells(model(logs))))

    finer = optimize.minimize(
        loss,
        np.clip(np.log(np.maximum(start, 1e-300)), least, most),
        method="Nelder-Mead",
        options={"maxiter": 120, "xatol": 0.02, "fatol": 0.02},
    )
    return model(finer.x)


def _falling(frequency: Floats, knee: float) -> Floats:
    """A density (k,) that falls off with the square above a frequency; 1 at the lowest one."""
    if np.isinf(knee):
        return np.ones_like(frequency)
    return np.asarray((knee**2 + frequency[0] ** 2) / (knee**2 + frequency**2))


def _responses(counts: NDArray[np.intp], size: int) -> list[Floats]:
    """Expected densities of white noise behind each filter that is shorter than the longest dwell."""
    return [_expected(m, counts, size) for m in _FILTERS if 2 ** (m + 1) <= counts.max()]


def _expected(filter_m: int, counts: NDArray[np.intp], size: int) -> Floats:
    """Expected periodogram of filtered white noise under the taper: its own leakage and resolution."""
    taps = 2**filter_m
    window = np.convolve(np.ones(taps), np.ones(taps)) / taps**2
    covariance = np.correlate(window, window, "full")[len(window) - 1 :]
    total = np.zeros(size // 2 + 1)
    chosen = np.unique(np.quantile(counts, np.linspace(0, 1, _LENGTHS), method="nearest"))
    for n in chosen.tolist():
        taper = _taper(int(n))
        lags = min(len(covariance), int(n))
        spectrum = np.abs(fft.rfft(taper, fft.next_fast_len(2 * int(n), real=True))) ** 2
        overlap = fft.irfft(spectrum, fft.next_fast_len(2 * int(n), real=True))[:lags]
        series = np.zeros(size)
        series[:lags] = covariance[:lags] * overlap
        series[-lags + 1 or size :] += series[1:lags][::-1]
        total += fft.rfft(series).real
    return np.maximum(total / len(chosen), 1e-12)


def _taper(n: int) -> Floats:
    """Hann taper (n,) of mean square 1/n, so that white noise keeps its density."""
    taper = signal.windows.hann(n + 2)[1:-1]
    result: Floats = taper / np.sqrt(taper @ taper)
    return result
