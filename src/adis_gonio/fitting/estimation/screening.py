"""Checks of a session's samples before anything is estimated: dead data and limits of the range.

**Dead data** (all zeros, stuck words) is refused. A quiet sensor behind a coarse converter can repeat one
word for a whole dwell, so a dwell without variance is no proof. Data counts as stuck if it contradicts
another known fact:

* the other dwells: the axis has more noise there than values around an edge between two codes can show
  (0.6 steps rms), and its longest constant run there is at most a quarter as long;
* the positions: two or more dwells at different declared angles have identical words on all axes, or all
  dwells are identical;
* the chip: an ADIS1635x has 4.7 mg (16354) of noise before its filter and 1 LSB rms behind the longest
  filter. The chance that two axes keep one word for 256 samples, or one axis for 512, is below 1e-4. This
  rule applies if the words have all their bits.

**A limit of the range** shows as a pile of samples: noise has fewer samples at its extreme value than at
the value next to it, a limit has many times as many. A dwell with all samples at the extreme value is at
a limit if two or more such dwells share that value and gravity allows the reading; otherwise it may be
stuck. A dwell that a limit cuts takes no part in a fit, because its mean is not its reading.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError
from adis_gonio.base.numbers import counted, name_positions
from adis_gonio.base.uncertainty import COMMON_DIVISOR
from adis_gonio.model.records import Dwell, Session

_LEAST_RUN = 32
_CHIP_RUN = 512
_MOST_GRAVITY = 1.1
"""Largest length, in units of local gravity, of a dwell mean at which a limit of the range can be the
reason for constant samples: the true reading is longer than the mean. The tenth above 1 allows for gains
and biases."""


def refuse_dead_data(session: Session, limits: Sequence[Limit], mg_per_unit: float | None) -> None:
    """Raise `DataError` if a dwell is all zero or stuck, by the rules in the module's docstring.

    Parameters
    ----------
    session : Session
        Session to examine.
    limits : sequence of Limit
        Limits of the range that the samples show.
    mg_per_unit : float or None
        Size of the samples' unit in mg; None if unknown.
    """
    dwells = [dwell for dwell in session.dwells if len(dwell)]
    zero = [dwell.position for dwell in dwells if not dwell.accel.any()]
    where = f"{session.source}: " if session.source else ""
    if zero:
        raise DataError(
            f"{where}all-zero accelerations in {name_positions(zero)}; nothing drove the data line: "
            "check wiring and supply and record again"
        )
    at_limit = dwells_at_limit(
        dwells, limits, None if mg_per_unit is None else session.gravity_mg / mg_per_unit
    )
    dwells = [dwell for dwell in dwells if dwell.position not in at_limit]
    sampled = [dwell for dwell in dwells if len(dwell) > 1]
    stuck = dwells_too_still(sampled) or dwells_reading_alike(dwells)
    if not stuck and session.accel_unit == "lsb" and sampled:
        whole = steps_of([dwell.accel for dwell in sampled]) <= 1
        stuck = [
            dwell.position
            for dwell in sampled
            if len(dwell) * int(((np.ptp(dwell.accel, axis=0) == 0) & whole).sum()) >= _CHIP_RUN
        ]
    if stuck:
        raise DataError(
            f"{where}stuck data in {name_positions(stuck)}: words repeat although a working sensor shows"
            " noise or follows the rotation; check the sensor and record again"
        )


def limit_notes(limits: Sequence[Limit], unit: str) -> list[str]:
    """Return sentences for the user, one for each limit of the range, with the dwells that it excludes.

    `unit` is the unit of the samples.
    """
    lines = []
    for limit in limits:
        where = f"the extreme value {limit.value:g} {unit} ({name_positions(limit.positions)})"
        samples = f"{counted(limit.samples, 'sample')} of {'xyz'[limit.axis]}"
        line = f"{samples} are at {where}: a limit was reached there"
        if limit.spoiled:
            word = "takes" if len(limit.spoiled) == 1 else "take"
            where = name_positions(limit.spoiled)
            line += f"; the mean is not the reading, so {where} {word} no part in the fit"
        lines.append(line)
    return lines


def dwells_at_limit(dwells: Sequence[Dwell], limits: Sequence[Limit], gravity: float | None) -> set[int]:
    """Return the positions of dwells with a mean that is changed by a limit of the range.

    `gravity` is local gravity in the unit of the samples. If it is None, because the unit is unknown, the
    result is empty. A limit counts only if two or more dwells reach it, and if the means of the dwells that
    it changes are not clearly longer than gravity.
    """
    if gravity is None:
        return set()
    means = {dwell.position: dwell.accel.mean(axis=0) for dwell in dwells}
    reached: dict[float, set[int]] = defaultdict(set)
    for limit in limits:
        reached[abs(limit.value)].update(limit.positions)
    return {
        position
        for limit in limits
        for position in limit.spoiled
        if len(reached[abs(limit.value)]) > 1
        and all(float(np.linalg.norm(means[p])) <= _MOST_GRAVITY * gravity for p in limit.spoiled)
    }


def longest_runs(accel: Floats) -> Floats:
    """Return the largest number (axes,) of successive equal samples on each axis of samples (n, axes)."""
    return np.array([run_lengths(column).max() for column in accel.T], dtype=float)


def run_lengths(column: Floats) -> NDArray[np.intp]:
    """Return the lengths (m,) of the runs of equal samples of one axis (n,)."""
    # Distances between the positions at which the value changes.
    change = np.flatnonzero(np.diff(column))
    return np.diff(np.concatenate([[-1], change, [len(column) - 1]])).astype(np.intp)


def dwells_too_still(dwells: Sequence[Dwell]) -> list[int]:
    """Return the positions of dwells in which an axis is suspiciously constant.

    Such an axis has one value for at least half of the dwell, and for at least four times as many samples
    in a row as in any dwell without such an axis.
    """
    if len(dwells) < 2:
        return []
    runs = np.stack([longest_runs(dwell.accel) for dwell in dwells])
    length = np.array([len(dwell) for dwell in dwells])
    suspect = (runs >= _LEAST_RUN) & (runs >= 0.5 * length[:, None])
    # Longest run in the healthy dwells; the other rules judge an axis without any healthy dwell.
    healthy = np.where(suspect, 0.0, runs).max(axis=0)
    lively = np.zeros(runs.shape[1], dtype=bool)
    for axis, sound in enumerate(~suspect.T):
        samples = [dwells[k].accel for k in np.flatnonzero(sound).tolist()]
        lively[axis] = bool(samples) and is_lively(samples, steps_of(samples))[axis]
    stuck = suspect & lively & (runs >= 4 * healthy)
    return [dwell.position for dwell, bad in zip(dwells, stuck.any(axis=1), strict=True) if bad]


def dwells_reading_alike(dwells: Sequence[Dwell]) -> list[int]:
    """Return the positions of dwells with constant samples that read equal values at different angles."""
    constant = [d for d in dwells if len(d) == 1 or not np.ptp(d.accel, axis=0).any()]
    if len(constant) < 2:
        return []
    words = np.stack([dwell.accel[0] for dwell in constant])
    angles = np.array([np.nan if d.angle_deg is None else d.angle_deg % 360 for d in constant])
    one_angle = bool((angles == angles[0]).all())
    if len(constant) == len(dwells) > 2 and (words == words[0]).all() and not one_angle:
        return [dwell.position for dwell in constant]
    gap = np.abs(np.diff(angles))
    bad = np.flatnonzero((words[1:] == words[:-1]).all(axis=1) & (gap > 5) & (gap < 355))
    return sorted({constant[k + side].position for k in bad.tolist() for side in (0, 1)})


_PILE, _STEEP = 20, 5
"""Least number of samples at an extreme value, and least ratio of this number to the number at the value
next to it, that show a limit of the range."""
_LEAST_VALUES = 20
"""Least number of different values of an axis for evidence of a limit: a coarse converter gives few."""
LIVELY = 0.6
"""Standard deviation of the noise, in steps of the converter, below which samples pile up at any value (0.5
at an edge between codes)."""
_HARMLESS = 0.1
"""Largest change of a mean by samples cut at a limit, in standard uncertainties of the mean, at which the
mean still counts as the reading."""


@dataclass(frozen=True)
class Limit:
    """A limit of the range on one axis: an extreme value that many samples have.

    Attributes
    ----------
    axis : int
        Number of the axis, 0 for X.
    value : float
        Extreme value in the unit of the samples.
    samples : int
        Number of samples at the limit.
    inside : int
        Number of samples at the value next to the limit.
    positions : tuple of int
        Numbers of the dwells that have samples at the limit.
    spoiled : tuple of int
        Numbers of the dwells with a mean that the limit changes.
    """

    axis: int
    value: float
    samples: int
    inside: int
    positions: tuple[int, ...]
    spoiled: tuple[int, ...]


@dataclass(frozen=True)
class Converter:
    """Steps and limits of the converter on each axis, found in the samples and in their unit.

    Attributes
    ----------
    steps : (axes,) float
        Smallest difference between two values of each axis; 0 for a constant axis.
    limits : tuple of Limit
        At most two for each axis.
    """

    steps: Floats
    limits: tuple[Limit, ...]

    @property
    def spoiled(self) -> set[int]:
        """Positions of the dwells with a mean that a limit of the range changes."""
        return {position for limit in self.limits for position in limit.spoiled}


def converter_of(dwells: Sequence[Dwell]) -> Converter:
    """Return the converter's steps and limits of the range on each axis, from the samples of dwells."""
    samples = [dwell.accel for dwell in dwells]
    steps = steps_of(samples)
    found = piles(samples, is_lively(samples, steps))
    return Converter(steps, tuple(_limit(dwells, axis, value, inside) for axis, value, inside in found))


def is_lively(dwells: Sequence[Floats], steps: Floats) -> NDArray[np.bool_]:
    """Return a mask (axes,) of the axes with noise of at least `LIVELY` steps of the converter.

    `dwells` are the samples (n, axes) of each dwell, `steps` (axes,) the steps of the converter.
    """
    deviation = np.median([rows.std(axis=0) for rows in dwells], axis=0)
    return np.asarray((steps > 0) & (deviation >= LIVELY * steps))


def piles(samples: Sequence[Floats], lively: NDArray[np.bool_]) -> Iterator[tuple[int, float, int]]:
    """Yield the extreme values at which samples (n, axes) pile up, as at a limit of the range.

    Each item is the number of the axis, the extreme value, and the number of samples at the value next to
    it. `lively` (axes,) is True for the axes to examine.
    """
    for axis in np.flatnonzero(lively).tolist():
        column = np.concatenate([rows[:, axis] for rows in samples])
        values, counts = np.unique(column, return_counts=True)
        if len(values) > _LEAST_VALUES:
            for extreme, neighbour in ((-1, -2), (0, 1)):
                if counts[extreme] >= max(_PILE, _STEEP * counts[neighbour]):
                    yield axis, float(values[extreme]), int(counts[neighbour])


def _limit(dwells: Sequence[Dwell], axis: int, value: float, inside: int) -> Limit:
    reached = {d.position: d.accel[:, axis] == value for d in dwells}
    reached = {position: at for position, at in reached.items() if at.any()}
    spoiled = [p for p, at in reached.items() if _moves(float(at.mean()), len(at))]
    samples = sum(int(at.sum()) for at in reached.values())
    return Limit(axis, value, samples, inside, tuple(reached), tuple(spoiled))


def _moves(share: float, n: int) -> bool:
    """Return True if cutting off this share of a normal distribution changes the mean of n samples.

    Changes that are small against the noise of the mean do not count.
    """
    if share >= 0.5:
        return True
    from scipy.special import ndtri  # late: a bench that only records needs no scipy

    z = -float(ndtri(share))
    cut = math.exp(-(z**2) / 2) / math.sqrt(2 * math.pi) - z * share  # in standard deviations of a sample
    return cut > _HARMLESS / math.sqrt(n)


def steps_of(dwells: Sequence[Floats]) -> Floats:
    """Return the smallest difference (axes,) between two values of the converter; 0 if constant.

    Parameters
    ----------
    dwells : sequence of (n, axes) float
        Samples. For integers the step is the common divisor of all differences, or 1 if the divisor may be
        chance; for other numbers it is the smallest difference.
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
