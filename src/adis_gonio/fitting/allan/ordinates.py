"""A record at rest as DCT-II ordinates: the lowest one by one, the higher ones as means of narrow bins."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.allan.processes import KINDS, line, ordinate_variances, variances

SINGLES = 64
"""Lowest ordinates that stand by themselves."""
_RELATIVE, _ABSOLUTE = 1 / 32, 1 / 1024
"""Widest bin: a part of its frequency, and in cycles a sample."""
_POINTS = 16
"""Ordinates of a bin at which its densities are computed."""


@dataclass(frozen=True)
class Ordinates:
    """Ordinates of one or several records of an axis, by bins.

    Attributes
    ----------
    frequency : (b,) float
        Highest frequency of each bin in cycles a sample.
    weight : (b,) float
        Number of ordinates.
    power : (b,) float
        Mean of their squares.
    shapes : (b, 4) float
        Mean variance per squared coefficient of each of `processes.KINDS`.
    rounding : (b,) float
        Mean variance of the converter's rounding.
    lines : tuple of (first, ordinate, line)
        For each record: the bin of its first single ordinate, the (s,) single ordinates as they are, and
        those of a line of slope 1 a sample.
    """

    frequency: Floats
    weight: Floats
    power: Floats
    shapes: Floats
    rounding: Floats
    lines: tuple[tuple[int, Floats, Floats], ...]

    def below(self, frequency: float) -> Ordinates:
        """The same without the bins above a frequency; the line is known from the lowest ones."""
        chosen = self.frequency <= frequency
        place = np.cumsum(chosen) - 1
        lines = []
        for first, ordinate, slope in self.lines:
            kept = int(chosen[first : first + len(ordinate)].sum())
            lines.append((int(place[first]), ordinate[:kept], slope[:kept]))
        return Ordinates(
            self.frequency[chosen],
            self.weight[chosen],
            self.power[chosen],
            self.shapes[chosen],
            self.rounding[chosen],
            tuple(lines),
        )


def ordinates(
    record: Floats, filter_m: int, period_s: float, rounding: Floats, masked: NDArray[np.intp]
) -> Ordinates:
    """Ordinates of a record whose line has been taken off.

    Parameters
    ----------
    record : (n,) float
    rounding : (lags,) float
        Autocovariance of the converter's rounding.
    masked : (l,) int
        Ordinates to leave out.
    """
    n = len(record)
    lines = np.asarray(fft.dct(record, type=2, norm="ortho"), np.float64)[1:]
    grid = _grid(n, filter_m, period_s)
    starts = grid.starts
    kept = np.ones(n - 1, dtype=bool)
    kept[masked[(masked >= 1) & (masked < n)] - 1] = False
    square = np.where(kept, lines**2, 0.0)
    weight = np.add.reduceat(kept.astype(np.float64), starts - 1)
    power = np.add.reduceat(square, starts - 1) / np.maximum(weight, 1.0)
    rounded = grid.mean(ordinate_variances(rounding, n, grid.points))
    singles = min(SINGLES, n - 1)
    number = np.arange(1, singles + 1)
    slope = np.where(kept[:singles], line(n, number.astype(np.float64)), 0.0)
    return Ordinates(
        grid.highest, weight, power, grid.shapes, rounded, ((0, lines[:singles].copy(), slope),)
    )


def together(parts: list[Ordinates]) -> Ordinates:
    """Ordinates of several records as one."""
    lines, at = [], 0
    for part in parts:
        lines += [(first + at, ordinate, slope) for first, ordinate, slope in part.lines]
        at += len(part.weight)
    return Ordinates(
        np.concatenate([part.frequency for part in parts]),
        np.concatenate([part.weight for part in parts]),
        np.concatenate([part.power for part in parts]),
        np.concatenate([part.shapes for part in parts]).reshape(-1, len(KINDS)),
        np.concatenate([part.rounding for part in parts]),
        tuple(lines),
    )


@dataclass(frozen=True)
class _Grid:
    """What the bins of records of one length have in common, whatever was recorded.

    Attributes
    ----------
    starts : (b,) int
        First ordinate of each bin.
    highest : (b,) float
        Highest frequency in cycles a sample.
    points : (p,) float
        Ordinates at which densities are computed, `_POINTS` a bin at most.
    first, count : (b,) int
        A bin's first point, and how many it has.
    shapes : (b, 4) float
    """

    starts: NDArray[np.intp]
    highest: Floats
    points: Floats
    first: NDArray[np.intp]
    count: NDArray[np.intp]
    shapes: Floats

    def mean(self, values: Floats) -> Floats:
        """Mean (b,) over each bin's points of values (p,)."""
        return np.asarray(np.add.reduceat(values, self.first) / self.count, np.float64)


@lru_cache(maxsize=8)
def _grid(n: int, filter_m: int, period_s: float) -> _Grid:
    """Axes, and most dwells of a session, are of one length."""
    starts, stops = _bins(n)
    count = np.minimum(_POINTS, stops - starts)
    first = np.cumsum(count) - count
    owner = np.repeat(np.arange(len(starts)), count)
    step = np.arange(len(owner)) - first[owner]
    points = starts[owner] + (step + 0.5) / count[owner] * (stops - starts)[owner] - 0.5
    shapes = np.add.reduceat(variances(filter_m, n, points, period_s), first, axis=0) / count[:, None]
    return _Grid(starts, (stops - 1) / (2 * n), points, first, count, shapes)


def _bins(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First ordinate of each bin, and the one after its last."""
    edges = list(range(1, min(SINGLES, n - 1) + 1))
    at = edges[-1] + 1
    while at < n:
        edges.append(at)
        at += max(1, int(min(at * _RELATIVE, 2 * n * _ABSOLUTE)))
    starts = np.array(edges, dtype=np.intp)
    return starts, np.append(starts[1:], n).astype(np.intp)
