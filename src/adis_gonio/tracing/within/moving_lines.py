"""Spectral lines inside the dwells with a frequency that changes from dwell to dwell.

A vibration of a machine that warms up, or a resonance of the sensor's package, changes its frequency in the
course of a session. In the mean spectrum of all dwells such a line is smeared over many frequencies, and
the test for lines of constant frequency takes it for rough noise. Here each dwell is its own reference::

    periodograms → heights above the dwell's own noise → path through the dwells → a chirp in each dwell

The heights are exponentially distributed for noise. A path begins at the greatest height. It goes on to the
dwells before and after, each time to the greatest height near the extrapolated frequency if that height is
significant. In each dwell of a path a chirp is fitted, that is, a sine with a frequency that changes
linearly with time. The chirps are subtracted before the next search.

If the frequencies of several lines change alike, these lines have one cause: one finding reports the
strongest line and lists the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from adis_gonio.base.arrays import Floats
from adis_gonio.base.numbers import format_number, join_words
from adis_gonio.base.uncertainty import FOUND_WITHIN, Value
from adis_gonio.tracing.within.samples import Samples, View, WithinFinding, corrected, positions_text
from adis_gonio.tracing.within.tones import (
    LINE_WIDTH,
    LOWEST,
    MOST,
    Density,
    alias_text,
    aliases_hz,
    amplitudes_of,
    cosine_and_sine,
    density_of,
    line_sizes,
    without_line,
)

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


@dataclass(frozen=True, eq=False)
class MovingLine:
    """A spectral line that moves through the session.

    Attributes
    ----------
    dwells : (k,) int
        Indices of the dwells that show the line, ascending.
    time_s : (k,) float
        Time in s of the middle of each of these dwells, since the beginning of the session.
    frequency_hz, u_hz : (k,) float
        Frequency in Hz at the middle of each dwell, and its standard uncertainty.
    slope : (k,) float
        Change of the frequency within each dwell in Hz/s.
    noise : (k, axes) float
        Density of the noise near the line in mg² (two-sided, per sample).
    squares : (k, axes) float
        Squared amplitude in each dwell in mg².
    p_value : float
        Probability that noise has such a greatest height, corrected for the number of tests.
    """

    dwells: NDArray[np.intp]
    time_s: Floats
    frequency_hz: Floats
    u_hz: Floats
    slope: Floats
    noise: Floats
    squares: Floats
    p_value: float

    def moves_like(self, other: MovingLine) -> bool:
        """True if the frequencies of both lines change alike, in at least four dwells that show both."""
        _, own, others = np.intersect1d(self.dwells, other.dwells, return_indices=True)
        if len(own) < _LEAST_DWELLS:
            return False
        pair = self.frequency_hz[own], other.frequency_hz[others]
        return bool(min(map(np.ptp, pair)) > 0 and abs(np.corrcoef(*pair)[0, 1]) > _ALIKE)


def moving_lines(samples: Samples) -> tuple[list[MovingLine], Samples, Density | None]:
    """Find lines that move; return them, the samples without these lines, and the density of these samples.

    The strongest line is the first. The density is None if no dwell has enough samples for a spectrum.
    """
    found: list[MovingLine] = []
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
) -> tuple[MovingLine, Samples]:
    """Fit a chirp in each dwell of a path; return the line, and the samples without it."""
    rows, at = np.array(list(path)), np.array(list(path.values()))
    dwells = density.dwells[rows]
    middle = np.array([float(samples.time_s[k].mean()) for k in dwells])
    rough = density.frequency[at + density.searched.start] / samples.period_s
    slopes = np.gradient(rough, middle)
    values = list(samples.values)
    fits: list[tuple[float, float, float]] = []
    squares: list[Floats] = []
    for k, mid, f, s, own in zip(dwells.tolist(), middle, rough, slopes, noise[rows, at], strict=True):
        time = samples.time_s[k] - mid
        chirp = _chirp(time, without_line(values[k]) / np.sqrt(own), float(f), float(s))
        design = cosine_and_sine(chirp[0] + chirp[1] * time / 2, time)
        wave = np.linalg.lstsq(design, without_line(values[k]), rcond=None)[0]
        values[k] = values[k] - design @ wave
        fits.append(chirp)
        squares.append((wave**2).sum(axis=0))
    f, s, u = np.array(fits).T
    line = MovingLine(dwells, middle, f, u, s, noise[rows, at], np.array(squares), p_value)
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


def findings_of(lines: Sequence[MovingLine], samples: Samples) -> list[WithinFinding]:
    """Return a finding for each line that moves, and one only for lines that move alike."""
    left, out = list(lines), []
    while left:
        line, *others = left
        alike = [one for one in others if one.moves_like(line)]
        left = [one for one in others if one not in alike]
        out.append(_finding(line, alike, samples))
    return out


def _finding(line: MovingLine, alike: Sequence[MovingLine], samples: Samples) -> WithinFinding:
    noise = 4 * line.noise / samples.counts[line.dwells][:, None]
    amplitude, u, stands = line_sizes(line.squares, noise, line.squares / noise)
    axes = [k for k in range(samples.axes) if stands[k]] or [int(amplitude.argmax())]
    letters, parameters, sizes = amplitudes_of(samples, axes, amplitude, u)
    first, last = (Value(float(line.frequency_hz[k]), float(line.u_hz[k]), "Hz") for k in (0, -1))
    positions = tuple(samples.position[line.dwells].tolist())
    folding = aliases_hz(float(np.median(line.frequency_hz)), 1 / samples.period_s)
    others = [format_number(float(one.frequency_hz[0]), 3) for one in alike]
    with_it = f", with weaker lines that move alike, first at {join_words(others)} Hz" if others else ""
    return WithinFinding(
        kind="tone",
        effect="tone",
        axes=letters,
        positions=positions,
        parameters=parameters | {"frequency_first": first, "frequency_last": last},
        p_value=line.p_value,
        sentence=(
            f"a spectral line that moves from {first} to {last} (amplitude {sizes}) in "
            f"{positions_text(positions, len(samples))}{with_it}{alias_text(folding)}"
        ),
        advice=(
            "its frequency follows something that changes with time, such as a temperature: record this"
            " together with the readings, or trace several sessions as one model, which tries the frequency"
            " as a covariate"
        ),
        aliases_hz=folding,
        view=View(
            line.time_s,
            line.frequency_hz,
            "time / s",
            "frequency / Hz",
            f"Frequency of a spectral line of {join_words(letters)} in each dwell.",
        ),
    )
