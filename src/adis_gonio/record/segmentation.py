"""Dwells of a continuous recording: the stretches in which the sensor was still.

A window of samples is still if the standard deviation of every axis lies between the limits of
`adis_gonio.record.stillness`. The noise of an axis is the median of the standard deviations in its quiet
windows, which are windows with less than twice the 5 % quantile of all windows.

Gyros detect a slow turn that the accelerations do not show. A sensor that a hand holds still also turns, by
far more than the noise of its gyros, which does no harm. The limit of a gyro's standard deviation is
therefore ten times its median in windows in which the accelerations are still.

Every run of still windows is trimmed by `TRIM_S` at both ends, which the hand may disturb, and kept if it
lasts at least `LEAST_S`. A slow turn or a slip moves the mean more than the standard deviation: the window
between two still windows is not still if their means differ by more than the upper limit.

Standard deviations are computed a block of rows at a time, so that memory is needed for one block only.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError
from adis_gonio.base.numbers import counted
from adis_gonio.model.records import Dwell
from adis_gonio.record.stillness import UPPER, StillnessLimits, limits_from_noise

WINDOW_S = 0.5
TRIM_S = 0.25
LEAST_S = 1.0

_GYRO_UPPER = 10.0
_OFTEN = 0.25
"""Share of constant windows above which the converter's resolution is the cause, not stuck data."""
_LEAST_WINDOW = 8
_BLOCK = 1 << 16
"""Number of rows of a block, without the rows that it shares with the next one."""
_FIRST = 20_000
"""Number of rows at the beginning that determine the converter's step."""

Flags = NDArray[np.bool_]


def segment_with_notes(
    time_s: Floats, accel: Floats, gyro: Floats | None = None
) -> tuple[list[slice], list[str]]:
    """Find the dwells of a continuous recording in memory; return their rows and remarks.

    Parameters
    ----------
    time_s : (n,) float
        Time of each sample, increasing.
    accel : (n, axes) float
        Accelerometer samples, any unit.
    gyro : (n, 3) float, optional
        Gyro samples, any unit; windows in which they turn are not still.

    Returns
    -------
    list of slice
        Rows of each dwell, in order; empty if the sensor never rests.
    list of str
        Remarks: number of dwells, noise, stuck data; or why there is no dwell.

    Raises
    ------
    DataError
        The samples never change (stuck data).
    """
    n, axes = len(time_s), accel.shape[1]
    if n < 2 * _LEAST_WINDOW or time_s[0] == time_s[-1]:
        return [], [f"{counted(n, 'sample')}: too few for a continuous recording"]
    whole = _Extent(time_s, [accel] if gyro is None else [accel, gyro])
    period = whole.period_s
    window = max(_LEAST_WINDOW, round(WINDOW_S / period))
    trim, least = max(1, round(TRIM_S / period)), max(2 * window, round(LEAST_S / period))
    if n < least:
        return [], [
            f"the recording lasts {n * period:.2g} s; a dwell needs at least {least * period:.2g} s"
        ]
    whole.refuse_constant()
    noise = np.array([_own_noise(spread) for spread in _spreads(whole.deviations(window), axes)])
    limits = limits_from_noise(noise, window, whole.quantum[:axes])
    still, flat = _runs(whole, limits)
    runs = [slice(first + trim, last + window - trim) for first, last in still]
    slices = [run for run in runs if run.stop - run.start >= least]
    scatter = ", ".join(f"{value:.3g}" for value in noise)
    notes = [
        f"{counted(len(slices), 'dwell')} found by stillness (window {window * period:.3g} s, noise"
        f" of the accelerations {scatter} in the file's unit, limit four times that)"
    ]
    if flat:
        listed = ", ".join(
            f"{time_s[first]:.4g} s to {time_s[last + window - 1]:.4g} s" for first, last in flat[:4]
        )
        notes.append(f"stuck data left out: an axis has less than a tenth of its noise at {listed}")
    return slices, notes


def _blocks(parts: Sequence[Floats], overlap: int) -> Iterator[tuple[int, Floats]]:
    """Yield overlapping blocks (rows, columns) of a recording, each with the number of its first row.

    `parts` are arrays (n, …) with columns of the recording. A block has `_BLOCK` rows, followed by the
    first `overlap` rows of the next block; the last block is shorter. Each window of `overlap` + 1 rows is
    completely in one block, and only in one.
    """
    for row in range(0, len(parts[0]) - overlap, _BLOCK):
        yield row, np.hstack([part[row : row + _BLOCK + overlap] for part in parts])


class Quantiles:
    """Histogram of non-negative numbers, fed in pieces, that gives quantiles with 0.1 % resolution.

    A quantile is the mean of the numbers in its bin, so that equal numbers are returned unchanged. The bit
    pattern of a positive float32 grows with its value, so that its upper bits number the bins.
    """

    _SHIFT = 23 - 10

    def __init__(self) -> None:
        self._count = np.zeros(1 << 31 - self._SHIFT, dtype=np.int64)
        self._sum = np.zeros(len(self._count))

    def feed(self, values: Floats) -> None:
        """Add non-negative numbers (n,) to the histogram."""
        places = values.astype(np.float32).view(np.int32) >> self._SHIFT
        self._count += np.bincount(places, minlength=len(self._count))
        self._sum += np.bincount(places, values, minlength=len(self._count))

    def share_of_zeros(self) -> float:
        """Return the share of zeros among the numbers."""
        return float(self._count[0] / max(self._count.sum(), 1))

    def quantile(self, share: float, *, below: float = math.inf, with_zeros: bool = True) -> float:
        """Return the quantile for a fraction `share` (0 to 1) of the numbers up to `below`.

        Zeros are included if `with_zeros`. The result is infinity if there are no numbers.
        """
        mean = self._sum / np.maximum(self._count, 1)
        count = np.where(mean <= below, self._count, 0)
        count[0] *= with_zeros
        total = int(count.sum())
        if not total:
            return math.inf
        return float(mean[np.searchsorted(np.cumsum(count), share * (total - 1), side="right")])


def _own_noise(spread: Quantiles) -> float:
    """Return the noise of an axis at rest, from the standard deviations of all windows (`spread`).

    It is the median over quiet windows: those with less than twice the 5 % quantile. It is 0 if more than a
    quarter of the windows is constant (`_OFTEN`), because the converter is then coarser than the noise.
    """
    if spread.share_of_zeros() > _OFTEN:
        return 0.0
    quiet = 2 * spread.quantile(0.05, with_zeros=False)
    return spread.quantile(0.5, below=quiet, with_zeros=False)


class _Extent:
    """A recording with the range of each of its columns: accelerations, then rates.

    Parameters
    ----------
    time_s : (n,) float
        Times of the samples.
    parts : sequence of (n, …) float
        Accelerations, and rates if there are any; n is not 0.

    Attributes
    ----------
    period_s : float
        Time between two samples; infinite if the time never increases.
    low, high, middle : (columns,) float
        Minimum, maximum and mean of each column.
    quantum : (columns,) float
        Resolution of each column: the smallest difference of values in the first rows; 0 if the column is
        constant.
    """

    def __init__(self, time_s: Floats, parts: Sequence[Floats]) -> None:
        self.parts = parts
        steps = Quantiles()
        for row in range(0, len(time_s), _BLOCK):
            step = np.diff(time_s[row : row + _BLOCK + 1])
            steps.feed(step[step > 0])
        self.period_s = steps.quantile(0.5)
        self.low, self.high, self.middle = (
            np.hstack([of(part, axis=0) for part in parts]) for of in (np.min, np.max, np.mean)
        )
        self.quantum = np.zeros(len(self.low))
        for k, values in enumerate(np.hstack([part[:_FIRST] for part in parts]).T):
            # The smallest difference of two values is the step, unless it is a rounding error.
            gaps = np.diff(np.unique(values))
            gaps = gaps[gaps > 1e-9 * max(1.0, -self.low[k], self.high[k])]
            self.quantum[k] = gaps.min() if gaps.size else 0.0

    def deviations(self, window: int) -> Iterator[Floats]:
        """Yield the standard deviations (m, columns) of all windows of `window` samples, block by block."""
        rounding = 1e-12 * np.maximum(self.high - self.middle, self.middle - self.low) ** 2
        for _, rows in _blocks(self.parts, window - 1):
            # The mean is subtracted, so that the differences of running sums of x and x² lose few digits.
            part = rows - self.middle
            start = np.zeros((1, part.shape[1]))
            first, second = (np.concatenate([start, np.cumsum(part**k, axis=0)]) for k in (1, 2))
            mean = (first[window:] - first[:-window]) / window
            variance = (second[window:] - second[:-window]) / window - mean**2
            variance[variance < rounding] = 0.0
            yield np.sqrt(variance)

    def refuse_constant(self) -> None:
        """Raise `DataError` if the accelerations never change."""
        axes = self.parts[0].shape[1]
        low, high = self.low[:axes], self.high[:axes]
        if not low.any() and not high.any():
            raise DataError(
                "all-zero accelerations in the whole recording; check wiring and supply, record again"
            )
        if (low == high).all():
            raise DataError(
                "stuck data: the accelerations never change in the whole recording; record again"
            )


def _spreads(deviations: Iterable[Floats], columns: int) -> list[Quantiles]:
    """Return the distribution over all windows of the standard deviations in each of the first `columns`.

    `deviations` has arrays (m, columns or more) with the standard deviations in m windows.
    """
    spreads = [Quantiles() for _ in range(columns)]
    for part in deviations:
        for spread, values in zip(spreads, part.T, strict=False):
            spread.feed(values)
    return spreads


def _runs(whole: _Extent, limits: StillnessLimits) -> tuple[Runs, Runs]:
    """Return the runs of still windows, and the runs in which an accelerometer shows too little noise."""
    axes, window = whole.parts[0].shape[1], limits.window_samples
    upper, turns = limits.upper, len(whole.middle) - axes
    if turns:
        still_rates = (
            part[((part[:, :axes] <= upper) & (part[:, :axes] >= limits.lower)).all(axis=1), axes:]
            for part in whole.deviations(window)
        )
        usual = [spread.quantile(0.5) for spread in _spreads(still_rates, turns)]
        coarse = UPPER * whole.quantum[axes:] / math.sqrt(12)
        upper = np.concatenate([upper, np.maximum(_GYRO_UPPER * np.array(usual), coarse)])
    flat_parts, still_parts, moved_parts = list[Flags](), list[Flags](), [np.zeros(0, dtype=np.bool_)]
    for part in whole.deviations(window):
        flat_parts.append(np.any(part[:, :axes] < limits.lower, axis=1))
        still_parts.append(np.all(part <= upper, axis=1) & ~flat_parts[-1])
    for _, rows in _blocks(whole.parts[:1], 3 * window - 1):
        sums = np.cumsum(np.vstack([np.zeros(axes), rows - rows[0]]), axis=0)
        totals = sums[window:] - sums[:-window]
        change = np.abs(totals[2 * window :] - totals[: -2 * window])
        moved_parts.append(np.any(change > window * limits.upper, axis=1))
    flat, still, moved = map(np.concatenate, (flat_parts, still_parts, moved_parts))
    # Slow motion: a window is not still if it is between two still windows with different means.
    moved &= still[: -2 * window] & still[2 * window :]
    still[window : window + len(moved)] &= ~moved
    return _runs_of(still), _runs_of(flat)


Runs = list[tuple[int, int]]
"""Runs of true flags, each as the numbers of its first and its last flag."""


def _runs_of(flags: Flags) -> Runs:
    edges = np.flatnonzero(np.diff(flags, prepend=False, append=False)).tolist()
    return [(first, after - 1) for first, after in zip(edges[::2], edges[1::2], strict=True)]


_HALF_TURN = math.pi
_MOST_REST = 0.5
"""Share of the recording at rest above which it is a series of positions and no free turn."""
_OUT_OF_PLANE = 0.25
"""Largest reading of Z and largest change of the length of (X, Y) in a turn in the plane.

Both are relative to the median length of (X, Y).
"""


def shows_a_free_turn(recording: Dwell, dwells: Sequence[slice]) -> bool:
    """Return True if a continuous recording with gyros is one turn in the plane of X and Y.

    A free turn is half a turn or more and takes more than half of the time.

    Parameters
    ----------
    recording : Dwell
        All samples of the recording.
    dwells : sequence of slice
        Rows of the dwells that were found; a hand that changes its grip also causes some.
    """
    rest = sum(rows.stop - rows.start for rows in dwells)
    if recording.gyro is None or rest > _MOST_REST * len(recording) or len(recording) < 2 * _LEAST_WINDOW:
        return False
    # Means of 64 samples remove most of the noise before the angle is unwrapped.
    blocks = np.array_split(recording.accel, max(len(recording) // 64, 8))
    x, y, *z = np.array([block.mean(axis=0) for block in blocks]).T
    length = np.hypot(x, y)
    typical = float(np.median(length))
    odd = max(float(np.ptp(length)) / 2, *(float(np.abs(other).max()) for other in z), 0.0)
    turned = float(np.ptp(np.unwrap(np.arctan2(y, x))))
    return turned >= _HALF_TURN and odd < _OUT_OF_PLANE * typical
