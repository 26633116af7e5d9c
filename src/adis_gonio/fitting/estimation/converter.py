"""What the converter does to the samples: its step, and the limits at which it stops.

A limit shows as a pile: noise has fewer samples at its extreme than one value inside, a limit has many
times as many. A dwell that stands wholly at an extreme value is at a limit where two or more of them stand
at the very same one and gravity allows the reading; else it may as well be stuck (see `screening`). The
mean of a dwell that a limit cuts is not its reading: the dwell takes no part in a fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import COMMON_DIVISOR
from adis_gonio.model.records import Dwell

_PILE, _STEEP = 20, 5
"""Least samples at an extreme value, and least ratio to the value next to it, that show a limit."""
_LEAST_VALUES = 20
"""Values that an axis takes, below which its extremes are no evidence: noise of a coarse converter."""
_LIVELY = 0.6
"""Noise in steps of the converter below which samples pile up everywhere (an edge between two codes gives
0.5)."""
_HARMLESS = 0.1
"""Shift of a clipped mean, in standard uncertainties of it, up to which the mean is still the reading."""


@dataclass(frozen=True)
class Limit:
    """An extreme value at which samples of an axis pile up.

    Attributes
    ----------
    axis : int
    value : float
        In the unit of the samples.
    samples : int
        Number of samples there.
    inside : int
        Number at the value next to it.
    positions : tuple of int
        Dwells that have samples there.
    spoiled : tuple of int
        Those of them whose mean it moves.
    """

    axis: int
    value: float
    samples: int
    inside: int
    positions: tuple[int, ...]
    spoiled: tuple[int, ...]


@dataclass(frozen=True)
class Converter:
    """What samples show of their converter, in their unit.

    Attributes
    ----------
    steps : (axes,) float
        As `steps_of`.
    limits : tuple of Limit
        At most two an axis.
    """

    steps: Floats
    limits: tuple[Limit, ...]

    @property
    def spoiled(self) -> set[int]:
        """Positions of the dwells whose mean a limit moves."""
        return {position for limit in self.limits for position in limit.spoiled}


def converter_of(dwells: Sequence[Dwell]) -> Converter:
    """Steps and limits that the samples of dwells show."""
    steps = steps_of([dwell.accel for dwell in dwells])
    return Converter(steps, _limits(dwells, steps))


def _limits(dwells: Sequence[Dwell], steps: Floats) -> tuple[Limit, ...]:
    found = []
    scatter = np.median([dwell.accel.std(axis=0) for dwell in dwells], axis=0)
    for axis in range(dwells[0].accel.shape[1]):
        if scatter[axis] < _LIVELY * steps[axis]:
            continue
        columns = [dwell.accel[:, axis] for dwell in dwells]
        for sign in (1.0, -1.0):
            value, count, inside = _pile(columns, sign)
            if count >= max(_PILE, _STEEP * inside) and _many_values(columns):
                found.append(_limit(dwells, axis, value, inside))
    return tuple(found)


def _pile(columns: Sequence[Floats], sign: float) -> tuple[float, int, int]:
    """Largest value (smallest for −1), samples at it, and samples at the value next to it."""
    most = max if sign > 0 else min
    extreme = most(float(column.max() if sign > 0 else column.min()) for column in columns)
    count = sum(int((column == extreme).sum()) for column in columns)
    if count < _PILE:
        return extreme, count, 0
    rest = [column[column != extreme] for column in columns]
    inner = [float(column.max() if sign > 0 else column.min()) for column in rest if column.size]
    if not inner:
        return extreme, count, 0
    return extreme, count, sum(int((column == most(inner)).sum()) for column in rest)


def _many_values(columns: Sequence[Floats]) -> bool:
    """True where there are enough different values for an extreme one to say something."""
    seen: Floats = np.empty(0)
    for column in columns:
        seen = np.union1d(seen, column)
        if len(seen) > _LEAST_VALUES:
            return True
    return False


def _limit(dwells: Sequence[Dwell], axis: int, value: float, inside: int) -> Limit:
    share = {d.position: float(np.mean(d.accel[:, axis] == value)) for d in dwells}
    count = {d.position: len(d) for d in dwells}
    return Limit(
        axis,
        value,
        round(sum(share[p] * count[p] for p in share)),
        inside,
        tuple(p for p in share if share[p] > 0),
        tuple(p for p in share if share[p] > 0 and _moves(share[p], count[p])),
    )


def _moves(share: float, n: int) -> bool:
    """True where cutting this share of a normal distribution moves the mean of n samples."""
    if share >= 0.5:
        return True
    z = float(stats.norm.isf(share))
    cut = float(stats.norm.pdf(z)) - z * share  # in standard deviations of a sample
    return cut > _HARMLESS / math.sqrt(n)


def steps_of(dwells: Sequence[Floats]) -> Floats:
    """Step (axes,) between the values that samples take within dwells; 0 where nothing changes.

    Parameters
    ----------
    dwells : sequence of (n, axes) float
        Samples. Of whole numbers it is the common divisor of all differences, 1 where they may have it by
        chance; of others the smallest difference.
    """
    steps = np.zeros(dwells[0].shape[1])
    for axis in range(len(steps)):
        size = max(float(np.abs(rows[:, axis]).max()) for rows in dwells)
        divisor, number, least = 0, 0, math.inf
        for rows in dwells:  # one by one: together they may be as large as the session
            gaps = np.diff(np.unique(rows[:, axis]))
            gaps = gaps[gaps > 1e-9 * max(1.0, size)]
            least = min(least, float(gaps.min(initial=math.inf)))
            number += gaps.size
            if divisor >= 0 and (gaps == np.round(gaps)).all():
                divisor = math.gcd(divisor, int(np.gcd.reduce(gaps.astype(np.int64), initial=0)))
            else:
                divisor = -1
        if not number:
            continue
        if divisor > 0:
            steps[axis] = divisor if float(divisor) ** -number < COMMON_DIVISOR else 1.0
        else:
            steps[axis] = least
    return steps
