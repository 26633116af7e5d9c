"""Spectral lines inside the dwells, tested against the density of the session's own noise.

Search
    Two searches at every frequency and axis: the ordinates of all dwells together (a line that occurs in
    all of them, with any phases), and the largest ordinate of a single dwell. An ordinate is one of the
    independent values of a periodogram; for noise it is exponentially distributed about the density, so
    the sum of d ordinates is a gamma variable; the estimated density makes it an F variable. Real noise
    varies more, since dwells differ in their spectra. The degrees of freedom are therefore lowered until
    they explain the scatter of the ordinates about the running median. A line is subtracted before the
    next search.

    Times between samples may vary: frequency and amplitude are fitted at the times of the samples. At a
    sampling rate f_s, a line at f may be a vibration at f or at any k f_s ± f, k = 1, 2, …. Above half of
    the rate a vibration appears as an alias, and a filter after the sampling treats it like f. A finding
    lists all these frequencies up to `HIGHEST_HZ`. A stated amplitude is the amplitude behind the filter of
    the sensor.

Density
    The periodogram of each dwell (line removed, Hann's taper, zero-padded to twice its length) is divided
    by the level of the dwell, so that a loud dwell has no larger weight. Their mean is divided by a
    shape: white noise behind the chip's Bartlett filter, a floor (the converter) and 1/f noise. The
    Whittle likelihood chooses the filter length and both amounts; sensors without this filter get a flat
    shape. The remaining slow variation with frequency (other filters) is followed by a running median,
    which lines do not affect.

    Near the lowest frequencies a line resembles 1/f noise. If the highest point above its neighbours is
    more likely to be a line than part of any filter shape (a filter has lobes), the density there is
    replaced by the density on both sides.

Lines that move
    A vibration of a machine that warms up, or a resonance of the sensor's package, changes its frequency in
    the course of a session. In the mean spectrum of all dwells such a line is smeared over many
    frequencies, and the test for lines of constant frequency takes it for rough noise. Here each dwell is
    its own reference::

        periodograms → heights above the dwell's own noise → path through the dwells → a chirp in each dwell

    The heights are exponentially distributed for noise. A path begins at the greatest height. It goes on to
    the dwells before and after, each time to the greatest height near the extrapolated frequency if that
    height is significant. In each dwell of a path a chirp is fitted, that is, a sine with a frequency that
    changes linearly with time. The chirps are subtracted before the next search.

    If the frequencies of several lines change alike, these lines have one cause: one finding reports the
    strongest line and lists the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, optimize, special

from adis_gonio.base.arrays import Floats
from adis_gonio.base.numbers import format_number, join_words
from adis_gonio.base.uncertainty import FOUND_WITHIN, Detectable, Value
from adis_gonio.device.sensor.settings import filter_weights
from adis_gonio.model.effects import effect
from adis_gonio.tracing.within.samples import (
    POWER,
    SEARCHES,
    Samples,
    WithinFinding,
    corrected,
    positions_text,
)

HIGHEST_HZ = effect("tone", ("x",)).parameters[1].high
"""Highest frequency in Hz that is considered: the bound of the catalogue's `tone`."""
MOST_ALIASES = 6
"""Largest number of aliases that a sentence lists."""
MOST = 5
"""Largest number of spectral lines that are searched for."""


@dataclass(frozen=True)
class _Peak:
    """A point of the spectrum at which there is a significant line.

    Attributes
    ----------
    at : int
        Index of the frequency.
    p_value : float
        p-value of the line, corrected for the number of tests.
    """

    at: int
    p_value: float
    dwell: int | None
    """Row in `Density.power` of the only dwell with the line; None for a line in all dwells."""


@dataclass(frozen=True, eq=False)
class Line:
    """A spectral line in some dwells, of constant or of changing frequency.

    Attributes
    ----------
    dwells : (k,) int
        Indices of the dwells that show the line, ascending.
    axes : list of int
        Axes that show the line.
    frequency_hz, u_hz : (k,) float
        Frequency in Hz at the middle of each dwell, and its standard uncertainty.
    noise : (k, axes) float
        Density of the noise near the line in mg² (two-sided, per sample).
    squares : (k, axes) float
        Squared amplitude in each dwell in mg².
    p_value : float
        p-value of the line, corrected for the number of tests.
    """

    dwells: NDArray[np.intp]
    axes: list[int]
    frequency_hz: Floats
    u_hz: Floats
    noise: Floats
    squares: Floats
    p_value: float

    @property
    def moves(self) -> bool:
        """True if the frequency changes through the session."""
        return bool(np.ptp(self.frequency_hz) > 0)

    def moves_like(self, other: Line) -> bool:
        """True if the frequencies of both lines change alike, in at least four dwells that show both."""
        _, own, others = np.intersect1d(self.dwells, other.dwells, return_indices=True)
        if len(own) < _LEAST_DWELLS:
            return False
        pair = self.frequency_hz[own], other.frequency_hz[others]
        return bool(min(map(np.ptp, pair)) > 0 and abs(np.corrcoef(*pair)[0, 1]) > _ALIKE)


def steady_lines(samples: Samples, density: Density | None) -> tuple[list[Line], Samples, Density | None]:
    """Find lines of constant frequency; return them, the samples without them, and the remaining density.

    `density` is the density of `samples`; it is None if no dwell has the `LEAST_SAMPLES` samples for a
    spectrum.
    """
    found: list[Line] = []
    while density is not None and len(found) < MOST:
        peak = _highest(density)
        line = None if peak is None else _steady_line(samples, density, peak)
        if line is None:
            break
        found.append(line[0])
        samples = line[1]
        density = density_of(samples)
    return found, samples, density


def _highest(density: Density) -> _Peak | None:
    """Return the most significant line of the spectrum; None if no line is significant."""
    searched, relative = density.searched, density.relative
    d, points, axes = relative.shape
    if points < 1:
        return None
    tests = 2.0 * points * axes
    pooled = relative.mean(axis=0)
    width = density.width[searched]
    peaks: list[_Peak] = []
    for axis in range(axes):
        effective = float(density.effective[axis])
        freedom = 2 * effective * width / TAPER_LOSS
        at = int(np.argmax(pooled[:, axis]))
        p = corrected(float(special.fdtrc(2 * effective, freedom[at], pooled[at, axis])), tests)
        peaks.append(_Peak(at + searched.start, p, None))
        single = relative[:, :, axis]
        dwell, at = divmod(int(np.argmax(single)), points)
        # Spectra of single dwells differ: the line has to exceed the density of its own dwell too.
        half = int(width[at] * PADDING / 2)
        own = single[dwell, max(0, at - half) : at + half + 1]
        height = single[dwell, at] / max(1.0, float(np.median(own)) / np.log(2))
        rough = effective / d
        p = corrected(float(special.fdtrc(2, 2 * width[at] / TAPER_LOSS, height)) ** rough, tests * d)
        peaks.append(_Peak(at + searched.start, p, dwell))
    best = min(peaks, key=lambda peak: peak.p_value)
    return best if best.p_value < FOUND_WITHIN else None


def _steady_line(samples: Samples, density: Density, peak: _Peak) -> tuple[Line, Samples] | None:
    """Fit a sine near a peak and subtract it; return the line and the samples without it.

    The result is None if the sine is not significant at the real times of the samples.
    """
    period = samples.period_s
    dwells = density.dwells
    times = [samples.elapsed_s(int(k)) for k in dwells]
    rows = [without_line(samples.values[int(k)]) for k in dwells]
    weight = 1.0 / (density.level * density.base[peak.at])
    step = density.frequency[1] / period
    about = density.frequency[peak.at] / period

    every = list(zip(times, rows, weight, strict=True))
    showing = [every[k] for k in _dwells_with(density, peak)]

    def power(frequency: float) -> float:
        total = 0.0
        for time, own, w in showing:
            total += float((np.abs(np.exp(-2j * np.pi * frequency * time) @ own) ** 2 / len(own)) @ w)
        return -total

    search = optimize.minimize_scalar(
        power, bounds=(about - step, about + step), method="bounded", options={"xatol": 1e-4 * step}
    )
    frequency = float(search.x)
    # Amplitudes of cosine and sine in each dwell, (d, 2, axes).
    designs = [np.column_stack([cosine_and_sine(frequency, time), np.ones_like(time)]) for time in times]
    solved = [np.linalg.lstsq(*pair, rcond=None)[0] for pair in zip(designs, rows, strict=True)]
    waves = np.array(solved)[:, :2]
    squares = (waves**2).sum(axis=1)
    counts = np.array([len(own) for own in rows], dtype=float)[:, None]
    noise = density.level * density.base[peak.at]
    # A quadrature of n samples with density S has the variance 2 S/n.
    excess = squares * counts / (4 * noise)
    chosen = np.ones(len(dwells), dtype=bool)
    if peak.dwell is not None:
        chosen = excess.max(axis=1) > -np.log(FOUND_WITHIN / excess.size)
        if not chosen.any():
            return None
    amplitude, _, stands = line_sizes(squares[chosen], (4 * noise / counts)[chosen])
    axes = [k for k in range(samples.axes) if stands[k]] or [int(np.argmax(excess.sum(axis=0)))]
    if not amplitude[axes].max() > 0:
        return None
    clear = excess[:, axes].max(axis=1) > -np.log(FOUND_WITHIN / (len(dwells) * len(axes)))
    if peak.dwell is None and (clear.mean() > 0.5 or not clear.any()):
        # A line in most dwells is present in the others too, below the noise of a single dwell.
        expected = (amplitude[axes] ** 2 * counts / (4 * noise[:, axes])).sum(axis=1)
        clear |= excess[:, axes].sum(axis=1) > 0.25 * expected
    if not clear.any():
        return None
    information = float((clear[:, None] * amplitude[axes] ** 2 * counts**3 / (24 * noise[:, axes])).sum())
    u_frequency = 1 / (2 * np.pi * period * np.sqrt(max(information, 1e-300)))
    values = list(samples.values)
    for k, design, wave in zip(dwells.tolist(), designs, waves, strict=True):
        values[k] = values[k] - design[:, :2] @ wave
    same = np.ones(int(clear.sum()))
    line = Line(
        dwells[clear],
        axes,
        frequency * same,
        u_frequency * same,
        noise[clear],
        squares[clear],
        peak.p_value,
    )
    return line, samples.with_values(values)


def _dwells_with(density: Density, peak: _Peak) -> list[int]:
    """Return the rows (in `Density.power`) of the dwells that show a spectral line.

    These are all dwells if the line was found in the average over all. `peak` is the peak of the line.
    """
    if peak.dwell is None:
        return list(range(len(density.dwells)))
    near = slice(peak.at - PADDING, peak.at + PADDING + 1)
    height = density.power[:, near] / density.level[:, None, :] / density.bound[None, near]
    shown = height.max(axis=(1, 2)) > -np.log(FOUND_WITHIN / height.size)
    shown[peak.dwell] = True
    return [int(k) for k in np.flatnonzero(shown)]


def aliases_hz(frequency_hz: float, rate_hz: float) -> tuple[float, ...]:
    """Return the other frequencies that sampling at `rate_hz` shows at `frequency_hz`, ascending.

    They are k f_s ± f, up to `HIGHEST_HZ`.
    """
    orders = np.arange(1, int((HIGHEST_HZ + frequency_hz) / rate_hz) + 1)
    folding = np.concatenate([orders * rate_hz - frequency_hz, orders * rate_hz + frequency_hz])
    return tuple(np.sort(folding[folding <= HIGHEST_HZ]).tolist())


def alias_text(folding: tuple[float, ...]) -> str:
    """Return the text that lists the aliases `folding` (in Hz) of a spectral line; empty without any."""
    if not folding:
        return ""
    named = ", ".join(format_number(f, 4) for f in folding[:MOST_ALIASES])
    more = ", …" if len(folding) > MOST_ALIASES else ""
    return f"; a vibration at {named}{more} Hz would be seen there as well"


def cosine_and_sine(frequency: float | Floats, time: Floats) -> Floats:
    """Return cosine and sine (n, 2) of a frequency in Hz at times (n,) in s; the frequency may be (n,)."""
    turn = 2 * np.pi * frequency * time
    return np.column_stack([np.cos(turn), np.sin(turn)])


def line_sizes(squares: Floats, noise: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return a line's amplitude on each axis (axes,), its standard uncertainty and its significance.

    `squares` (d, axes) are the squared amplitudes in each dwell, and `noise` is the mean squared amplitude
    of noise alone. Noise and a change of the line's strength
    both appear in the scatter of the squares over dwells.
    """
    d = len(squares)
    weight = 1 / noise
    weight = weight / weight.sum(axis=0)
    mean = (weight * (squares - noise)).sum(axis=0)
    amplitude = np.sqrt(np.maximum(mean, 0.0))
    own = (weight**2 * noise * (noise + 2 * np.maximum(mean, 0.0))).sum(axis=0)
    if d > 1:
        spread = (weight**2 * (squares - noise - mean) ** 2).sum(axis=0) * d / (d - 1)
        own = np.maximum(own, spread)
    u = np.sqrt(own) / (2 * np.maximum(amplitude, 1e-300))
    u = np.minimum(u, np.sqrt(np.sqrt(own)))
    shown = special.gammaincc(d, (squares / noise).sum(axis=0)) < 1e-3
    return amplitude, u, np.asarray(shown)


PADDING = 2
"""Number of frequencies on the grid per independent value of the spectrum (ordinate)."""
LOWEST = 6
"""Cycles per dwell below which a line cannot be distinguished from slow noise or drift."""
LEAST_SAMPLES = 32
_FILTERS = range(7)
_FLOORS = (0.0, *np.geomspace(1e-3, 30.0, 8).tolist())
"""Floors of the converter's noise that are tried, at the lowest searched frequency.
They are in units of the filtered noise density's maximum."""
_KNEES = (np.inf, 0.2, 0.07, 0.025, 0.0)
"""Corner frequencies in cycles per sample above which the floor falls with the square of the frequency.
A slow signal crosses codes the more rarely the slower it is."""
_FLICKERS = (0.0, *np.geomspace(0.01, 300.0, 10).tolist())
"""Densities of 1/f noise that are tried, at the lowest searched frequency, in the unit of `_FLOORS`."""
_ROUNDING = 1e-30
"""Smallest power in mg²: an axis that repeats a single value has no noise at all."""
_CELLS = 120
_LENGTHS = 5
LINE_WIDTH = 2.0
"""Number of independent values of the spectrum on each side that a line covers under Hann's taper."""
_STEEP = 1.5
"""Distance within which the largest value of the fitted shape is used.
It is the number of independent values of the spectrum on each side."""
_TAPERED = 2 / 3 * 0.95
"""Loss of a tone's power by Hann's taper, (Σw)²/(n Σw²), and between two frequencies of the grid."""
TAPER_LOSS = 1.944
"""Factor n Σw⁴ / (Σw²)² of Hann's taper, by which it reduces the degrees of freedom."""
_WIDTHS = (6, 16, 40)
"""Half widths of the running median in independent values of the spectrum (ordinates).
The largest half width is used that is at most a third of the ordinate's number."""


@dataclass(frozen=True)
class Density:
    """Noise density in the dwells, and their periodograms, for one sampling rate.

    Attributes
    ----------
    dwells : (d,) int
        Indices of the dwells with at least `LEAST_SAMPLES` samples.
    frequency : (k,) float
        Frequency in cycles per sample.
    searched : slice
        Part of the frequencies in which lines are searched for.
    power : (d, k, axes) float
        Periodograms in mg² (two-sided density per sample).
    level : (d, axes) float
        Noise power of each dwell relative to `base`; a value below the median over the dwells is replaced
        by the median. The density of a dwell is about `level · base`.
    base : (k, axes) float
        Noise density from all dwells together, for a `level` of 1.
    bound : (k, axes) float
        Density that a line has to exceed: `base` or, if larger, the density on either side.
    width : (k,) float
        Number of independent values of the spectrum in the running median, at each frequency.
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
        """Power of each dwell at each searched frequency, in units of the density that a line must exceed.

        The shape is (d, searched, axes).
        """
        return self.power[:, self.searched] / self.level[:, None, :] / self.bound[None, self.searched]

    @cached_property
    def effective(self) -> Floats:
        """Effective number (axes,) of independent dwells in the mean spectrum of all dwells.

        An average over this many independent spectra would scatter about `base` as much as the mean
        spectrum of the dwells does. The number is at least 1 and at most the number of dwells. `bound` is
        not the reference, since it scatters too.
        """
        part = self.searched
        pooled = (self.power[:, part] / self.level[:, None, :]).mean(axis=0) / self.base[part]
        low, high = np.quantile(np.log(pooled), [0.25, 0.75], axis=0)
        dwells = len(self.dwells)
        above, below = (float(special.gammaincinv(dwells, share)) for share in (0.75, 0.25))
        expected = math.log(above / below)
        shared = dwells * (expected / np.maximum(high - low, expected)) ** 2
        return np.asarray(np.maximum(shared, 1.0), dtype=np.float64)


def density_of(samples: Samples) -> Density | None:
    """Return the spectral density of dwells with at least `LEAST_SAMPLES` samples; None if none has."""
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
    ordinate = np.arange(len(frequency)) / each
    width = np.array(_WIDTHS, dtype=float)[np.digitize(ordinate, 3 * np.array(_WIDTHS[1:]))]
    pooled = (power / level[:, None, :]).mean(axis=0)
    without_peak = _peak_remover(pooled, searched, each)
    information = len(dwells) / each / TAPER_LOSS
    tests = samples.axes * (searched.stop - searched.start) / each
    # Only filters shorter than the longest dwell.
    filters = [m for m in _FILTERS if 2 ** (m + 1) <= longest]
    responses = [_expected(m, counts[dwells], size)[searched] for m in filters]
    shape = np.ones((len(frequency), samples.axes))
    lined = np.zeros(samples.axes, dtype=bool)
    for axis in range(samples.axes):
        own, usual = pooled[searched, axis], without_peak(pooled, axis)[searched]
        with_peak, without = (_shape(p, frequency[searched], responses) for p in (own, usual))
        gain = information * _gain(own, with_peak, without, own != usual)
        lined[axis] = corrected(math.exp(-max(gain, 0.0)), tests) < FOUND_WITHIN
        shape[searched, axis] = without if lined[axis] else with_peak
    # Outside the searched part the density counts as constant.
    shape[: searched.start], shape[searched.stop :] = shape[searched.start], shape[searched.stop - 1]
    # The median of an exponential distribution is ln 2 times its mean.
    level = np.maximum(np.median(band / shape[None, searched], axis=1) / np.log(2), 1e-300)
    # The converter's floor does not fall in a quiet dwell, which would dominate the notches of the filter.
    level = np.maximum(level, np.median(level, axis=0))
    pooled = (power / level[:, None, :]).mean(axis=0)
    base = np.stack(
        [
            _smooth(
                (without_peak(pooled, axis) if lined[axis] else pooled[:, axis]) / shape[:, axis],
                searched,
                width,
                each,
            )
            for axis in range(samples.axes)
        ],
        axis=1,
    )
    # On steep parts of the density (edges and notches of a filter) a small error of its shape is a large
    # error of the density: use the largest value nearby.
    base = base * ndimage.maximum_filter1d(shape, 2 * round(_STEEP * each) + 1, axis=0)
    # On a slope of the density one flank is as high as a line: a line has to exceed both flanks.
    bound = np.maximum(base, _flanks(pooled, each))
    return Density(dwells.astype(np.intp), frequency, searched, power, level, base, bound, 2 * width + 1)


def _peak_remover(pooled: Floats, searched: slice, each: float) -> Callable[[Floats, int], Floats]:
    """Return a function that removes the highest peak of one axis from a density (k, axes).

    The peak is the highest point of `pooled` (k, axes) relative to its neighbours. The density (k,) there
    is replaced by the geometric mean of the densities on both sides. `each` is the number of frequencies
    per ordinate. `searched` are the frequencies among which the peak is searched for.
    """
    above = (pooled / np.maximum(_flanks(pooled, each), 1e-300))[searched]
    peaks = searched.start + above.argmax(axis=0)
    near, far = round(LINE_WIDTH * each), 3 * round(LINE_WIDTH * each)

    def bridged(density: Floats, axis: int) -> Floats:
        peak = int(peaks[axis])
        out = density[:, axis].copy()
        sides = [out[max(0, peak - far) : peak - near + 1], out[peak + near : peak + far + 1]]
        middles = [float(np.median(side)) for side in sides if len(side)]
        out[peak - near + 1 : peak + near] = math.exp(np.mean(np.log(middles)))
        return out

    return bridged


def _gain(own: Floats, with_peak: Floats, without: Floats, peak: NDArray[np.bool_]) -> float:
    """Return the log likelihood ratio of two explanations of a peak: the shape of the noise, or a line.

    It is positive if a noise shape that was fitted with the peak (`with_peak`) describes the density `own`
    better than a shape fitted without it (`without`) plus a spectral line at the peak. `peak` is the mask
    of the peak's frequencies. The ratio is per dwell and independent point of the spectrum, by Whittle's
    likelihood with a fitted scale.

    All arrays are (k,).
    """

    def loss(shape: Floats, part: NDArray[np.bool_]) -> float:
        scale = float((own[part] / shape[part]).mean())
        return float(np.log(shape[part]).sum()) + float(part.sum()) * (math.log(scale) + 1)

    line = float(np.log(own[peak]).sum()) + float(peak.sum())
    return loss(with_peak, np.ones_like(peak)) - loss(without, ~peak) - line


def _flanks(pooled: Floats, each: float) -> Floats:
    """Return at each frequency the larger of the mean noise densities below and above it, (k, axes).

    `pooled` (k, axes) is the noise density. The width of a line around the frequency is left out; `each` is
    the number of frequencies per ordinate.
    """
    near, far = round(LINE_WIDTH * each), round(2 * LINE_WIDTH * each)
    sums = np.concatenate([np.zeros((1, pooled.shape[1])), np.cumsum(pooled, axis=0)])
    at = np.arange(len(pooled))

    def mean(first: NDArray[np.intp], last: NDArray[np.intp]) -> Floats:
        first, last = np.clip(first, 0, len(pooled)), np.clip(last, 0, len(pooled))
        count = np.maximum(last - first, 1)[:, None]
        return np.asarray((sums[last] - sums[first]) / count, dtype=np.float64)

    return np.maximum(mean(at - far, at - near + 1), mean(at + near, at + far + 1))


def without_line(rows: Floats) -> Floats:
    """Return the samples `rows` (n, axes) with their mean and linear trend subtracted."""
    place = np.arange(len(rows)) - (len(rows) - 1) / 2
    centred = rows - rows.mean(axis=0)
    slope = place @ centred / max(float(place @ place), 1e-300)
    return np.asarray(centred - place[:, None] * slope)


def _smooth(flat: Floats, searched: slice, width: Floats, each: float) -> Floats:
    """Smooth the density `flat` (k,) by a running median of half width `width` (k,), in ordinates.

    Outside the searched frequencies it is constant. `each` is the number of frequencies per ordinate.
    """
    smooth = np.empty_like(flat)
    # The parts outside contain drift and the last ordinate, which must not influence the rest.
    inside = flat[searched]
    for half in np.unique(width):
        points = min(2 * int(half * each) + 1, 2 * (len(inside) // 2) - 1)
        level = ndimage.median_filter(inside, size=max(points, 1), mode="reflect")
        padded = np.pad(level, (searched.start, len(flat) - searched.stop), mode="edge")
        at = width == half
        smooth[at] = padded[at]
    return np.maximum(smooth, 1e-300)


def _shape(pooled: Floats, frequency: Floats, responses: Sequence[Floats]) -> Floats:
    """Fit the shape (k,) of a noise density: white noise behind a filter, a floor and 1/f noise.

    `pooled` (k,) is the measured density; the `responses` (k,) are the possible filters. The fit maximises
    the Whittle likelihood with a fitted scale, over cells of neighbouring frequencies. The model is
    averaged over these cells too, so that a cell may be wider than a notch of the filter. `frequency` (k,)
    is in cycles per sample.
    """
    # Cells grow with frequency, since the passband of a long filter has few ordinates.
    edges = np.unique((len(frequency) * np.linspace(0, 1, _CELLS, endpoint=False) ** 2).astype(np.intp))
    weight = np.diff(np.append(edges, len(frequency))).astype(float)

    def cells(density: Floats) -> Floats:
        return np.asarray(np.add.reduceat(density, edges) / weight, dtype=np.float64)

    seen = cells(pooled)
    low = np.array(_FLICKERS)[:, None] * cells(frequency[0] / frequency)
    floors = np.array(_FLOORS)[:, None, None]
    falls = {knee: _falling(frequency, knee) for knee in _KNEES}

    def deviance(own: Floats) -> Floats:
        """Return −2 log likelihood (…) of the measured density under models, up to a constant.

        `own` (…, cells) are the densities of the models; the scale of each model is fitted.
        """
        return np.asarray(np.log(own) @ weight + weight.sum() * np.log((seen / own) @ weight))

    best, chosen, start = np.inf, np.ones_like(pooled), (0.0, 0.0, 0.0)
    for through in responses:
        response = through / through.max()  # normalise: a long filter passes little of its noise
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
    """Return a density (k,) that falls with the square of the frequency above a corner frequency.

    It is 1 at the lowest frequency; `knee` is the corner frequency.
    """
    if np.isinf(knee):
        return np.ones_like(frequency)
    return np.asarray((knee**2 + frequency[0] ** 2) / (knee**2 + frequency**2))


def _expected(filter_m: int, counts: NDArray[np.intp], size: int) -> Floats:
    """Return the expected periodogram (k,) of white noise behind a sensor filter with 2^`filter_m` taps.

    It includes the leakage and resolution of the taper, averaged over the lengths `counts` of the dwells;
    `size` is the length of the transform.
    """
    window = filter_weights(filter_m)
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
    """Return a Hann taper (n,), scaled so that its squares add up to 1."""
    taper = np.hanning(n + 2)[1:-1]
    return np.asarray(taper / np.sqrt(taper @ taper))


_REACH = 8
"""Largest difference of a line from its extrapolated frequency, in ordinates, for each dwell passed."""
_MISSED = 2
"""Largest number of dwells in succession in a path that do not show the line."""
_LEAST_DWELLS = 4
_BLOCKS = (8, 40)
"""Least and largest width, in ordinates, of the parts of a spectrum with medians that give its noise."""
_GROWTH = 0.4
"""Width of such a part, as a share of the frequency at which it begins."""
_ALIKE = 0.95
"""Least correlation of the frequencies of two lines that change alike."""


def moving_lines(samples: Samples) -> tuple[list[Line], Samples, Density | None]:
    """Find lines that move; return them, the samples without these lines, and the density of these samples.

    The strongest line is the first. The density is None if no dwell has enough samples for a spectrum.
    """
    found: list[Line] = []
    density = density_of(samples)
    if density is None or len(density.dwells) < _LEAST_DWELLS:
        return found, samples, density
    counts = samples.counts[density.dwells]
    each = 2 * (len(density.frequency) - 1) / float(np.median(counts))
    passed = np.zeros(density.power[:, density.searched].shape[:2], dtype=bool)
    wide = round(LINE_WIDTH * each)
    for _ in range(2 * MOST):
        noise = _own_noise(density, each, counts < np.median(counts) / 2)
        heights = (density.power[:, density.searched] / noise).max(axis=2)
        heights[passed] = 0.0
        dwell, at = np.unravel_index(int(heights.argmax()), heights.shape)
        p = corrected(float(np.exp(-heights[dwell, at])), heights.size * samples.axes / each)
        if p >= FOUND_WITHIN or len(found) == MOST:
            break
        path = _path(heights, (int(dwell), int(at)), each, samples.axes)
        for row, place in path.items():
            passed[row, max(0, place - wide) : place + wide + 1] = True
        if len(path) < _LEAST_DWELLS or np.ptp(list(path.values())) < wide:
            continue
        line, samples = _fitted(samples, density, noise, path, p)
        found.append(line)
        density = density_of(samples) or density
    return sorted(found, key=lambda line: -float(line.squares.sum())), samples, density


def strongest_frequency(samples: Samples, position: NDArray[np.intp]) -> Floats | None:
    """Return the frequency (n,) in Hz of the strongest moving line in dwells with the numbers `position`.

    It is interpolated if a dwell does not show the line. The result is None if no line moves.
    """
    lines = moving_lines(samples)[0]
    if not lines:
        return None
    return np.asarray(np.interp(position, samples.position[lines[0].dwells], lines[0].frequency_hz))


def _own_noise(density: Density, each: float, short: NDArray[np.bool_]) -> Floats:
    """Return the noise density (d, searched, axes) of each dwell.

    Its shape is the density of all dwells or, if it is larger, the median over the dwells at each
    frequency, which a line that moves does not change. Its level is the median over a part of the dwell's
    own spectrum, the larger one of the two nearest parts. In the dwells `short` (d,) a line covers whole
    parts: their levels are medians over the other dwells. `each` is the number of frequencies per ordinate.
    """
    base = density.base[density.searched]
    relative = density.power[:, density.searched] / base
    edges, at = [0], 0.0
    while edges[-1] < len(base):
        at += float(np.clip(_GROWTH * (LOWEST + at / each), *_BLOCKS)) * each
        edges.append(min(round(at), len(base)))
    if len(edges) > 2 and edges[-1] - edges[-2] < _BLOCKS[0] * each / 2:
        edges.pop(-2)
    levels = np.stack([np.median(relative[:, low:high], axis=1) for low, high in pairwise(edges)], axis=1)
    levels[short] = np.median(levels[~short], axis=0)
    middles = (np.array(edges[:-1]) + np.array(edges[1:])) / 2
    above = np.clip(np.searchsorted(middles, np.arange(len(base))), 0, len(middles) - 1)
    # The median of an exponential distribution is ln 2 times its mean.
    larger = np.maximum(levels[:, np.maximum(above - 1, 0)], levels[:, above]) / np.log(2)
    larger = np.maximum(larger, 1e-300)
    shared = np.maximum(np.median(relative / larger, axis=0) / np.log(2), 1.0)
    return np.asarray(larger * shared * base, dtype=np.float64)


def _path(heights: Floats, start: tuple[int, int], each: float, axes: int) -> dict[int, int]:
    """Return the index of a line's frequency by dwell, ascending.

    `start` is the dwell and the frequency of the greatest of the `heights` (d, searched).
    """
    path = {start[0]: start[1]}
    for step in (1, -1):
        dwell, missed = start[0] + step, 0
        while 0 <= dwell < len(heights) and missed <= _MISSED:
            last, *earlier = sorted(path, reverse=step > 0)
            rate = (path[last] - path[earlier[0]]) / (last - earlier[0]) if earlier else 0.0
            expected, reach = path[last] + rate * (dwell - last), _REACH * each * abs(dwell - last)
            low = max(0, round(expected - reach))
            near = heights[dwell, low : max(0, round(expected + reach) + 1)]
            height = float(near.max(initial=0.0))
            if np.exp(-height) * axes * len(near) / each < FOUND_WITHIN and height > 0:
                path[dwell], missed = low + int(near.argmax()), -1
            missed += 1
            dwell += step
    return dict(sorted(path.items()))


def _fitted(
    samples: Samples, density: Density, noise: Floats, path: dict[int, int], p_value: float
) -> tuple[Line, Samples]:
    """Fit a chirp in each dwell of a path; return the line, and the samples without it."""
    rows, at = np.array(list(path)), np.array(list(path.values()))
    dwells = density.dwells[rows]
    middle = np.array([float(samples.time_s[k].mean()) for k in dwells])
    rough = density.frequency[at + density.searched.start] / samples.period_s
    slopes = np.gradient(rough, middle)
    values = list(samples.values)
    fits, squares = [], []
    for k, mid, f, s, own in zip(dwells.tolist(), middle, rough, slopes, noise[rows, at], strict=True):
        time = samples.time_s[k] - mid
        chirp = _chirp(time, without_line(values[k]) / np.sqrt(own), float(f), float(s))
        design = cosine_and_sine(chirp[0] + chirp[1] * time / 2, time)
        wave = np.linalg.lstsq(design, without_line(values[k]), rcond=None)[0]
        values[k] = values[k] - design @ wave
        fits.append(chirp)
        squares.append((wave**2).sum(axis=0))
    frequency_hz, _, u_hz = np.array(fits).T
    own = 4 * noise[rows, at] / samples.counts[dwells][:, None]
    amplitude, _, stands = line_sizes(np.array(squares), own)
    axes = [k for k in range(samples.axes) if stands[k]] or [int(amplitude.argmax())]
    line = Line(dwells, axes, frequency_hz, u_hz, noise[rows, at], np.array(squares), p_value)
    return line, samples.with_values(values)


def _chirp(time: Floats, rows: Floats, frequency: float, slope: float) -> tuple[float, float, float]:
    """Return frequency in Hz at time 0, its change in Hz/s, and the frequency's standard uncertainty.

    `time` (n,) is in s from the middle of the dwell, `rows` (n, axes) are samples in units of the noise.
    The search begins at `frequency` and `slope`.
    """
    length = max(float(np.ptp(time)), 1e-9)

    def at(scaled: Floats) -> tuple[float, float]:
        return frequency + float(scaled[0]) / length, slope + float(scaled[1]) / length**2

    def loss(scaled: Floats) -> float:
        f, s = at(scaled)
        return -float((np.abs(np.exp(-2j * np.pi * (f + s * time / 2) * time) @ rows) ** 2).sum())

    simplex = [[0.0, 0.0], [0.3, 0.0], [0.0, 1.0]]
    best = optimize.minimize(
        loss,
        np.zeros(2),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-6},
    )
    squared_amplitude = max(-4 * float(best.fun) / len(time) ** 2, 1e-300)
    u = np.sqrt(24 / (squared_amplitude * len(time))) / (2 * np.pi * length)
    return *at(best.x), float(u)


def findings_of(lines: Sequence[Line], samples: Samples) -> list[WithinFinding]:
    """Return a finding for each line, and one only for lines that move alike."""
    left, out = list(lines), []
    while left:
        line, *others = left
        alike = [one for one in others if one.moves_like(line)]
        left = [one for one in others if one not in alike]
        out.append(_finding(line, alike, samples))
    return out


def _finding(line: Line, alike: Sequence[Line], samples: Samples) -> WithinFinding:
    """Return the finding of a line; `alike` are the weaker lines that move alike."""
    amplitude, u, _ = line_sizes(line.squares, 4 * line.noise / samples.counts[line.dwells][:, None])
    sizes = {samples.letters[k]: Value(float(amplitude[k]), float(u[k]), "mg") for k in line.axes}
    first, last = (Value(float(line.frequency_hz[k]), float(line.u_hz[k]), "Hz") for k in (0, -1))
    frequencies, course = {"frequency": first}, f"at {first}"
    advice = (
        "find what shakes the table at the line's frequency, or at one that folds to it: record again at"
        " another rate, where a line of that frequency stays and an alias moves"
    )
    if line.moves:
        frequencies = {"frequency_first": first, "frequency_last": last}
        course = f"that moves from {first} to {last}"
        advice = (
            "its frequency follows something that changes with time, such as a temperature: record this"
            " together with the readings, or trace several sessions as one model, which tries the frequency"
            " as a covariate"
        )
    positions = tuple(samples.position[line.dwells].tolist())
    folding = aliases_hz(float(np.median(line.frequency_hz)), 1 / samples.period_s)
    others = [format_number(float(one.frequency_hz[0]), 3) for one in alike]
    with_it = f", with weaker lines that move alike, first at {join_words(others)} Hz" if others else ""
    return WithinFinding(
        kind="tone",
        effect="tone",
        axes=tuple(sizes),
        positions=positions,
        parameters={f"tone_{letter}": size for letter, size in sizes.items()} | frequencies,
        p_value=line.p_value,
        sentence=(
            f"a spectral line {course} (amplitude"
            f" {', '.join(f'{letter} {size}' for letter, size in sizes.items())}) in"
            f" {positions_text(positions, len(samples))}{with_it}{alias_text(folding)}"
        ),
        advice=advice,
        aliases_hz=folding,
    )


def smallest_tone(samples: Samples, density: Density | None) -> Detectable:
    """Return the smallest amplitude of a sine in all dwells that the search would have found.

    The limit comes from the F-test of the spectrum pooled over the dwells. `density` is the noise density
    of the dwells; with None (dwells too short) the result gives this reason.

    An amplitude A adds c A² n/4S to an ordinate of n samples, with density S and loss c by the taper, so
    that the sum of d ordinates is half a noncentral χ² variable with 2d degrees of freedom.
    """
    if density is None or not density.relative.size:
        return Detectable(None, "mg", "tone", "the dwells are too short for a spectrum")
    searched = density.searched
    dwells, points, axes = density.relative.shape
    p = FOUND_WITHIN / SEARCHES / (2.0 * points * axes)
    counts = float(np.median(samples.counts[density.dwells]))
    worst = 0.0
    for axis in range(axes):
        effective = float(density.effective[axis])
        freedom = 2 * effective * float(np.median(density.width[searched])) / TAPER_LOSS
        height = float(special.fdtri(2 * effective, freedom, 1 - p))
        # Noncentrality with which the sum exceeds the height with a probability of 90 %.
        excess = float(special.chndtrinc(2 * dwells * height, 2 * dwells, 1 - POWER)) / (2 * dwells)
        noise = float(np.median(density.level[:, axis])) * float(np.median(density.bound[searched, axis]))
        worst = max(worst, float(np.sqrt(4 * noise * excess / (_TAPERED * counts))))
    return Detectable(worst, "mg", "tone")
