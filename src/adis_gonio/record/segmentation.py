"""Dwells of a continuous recording: the stretches in which the sensor was still.

A window of samples is still if the standard deviation of every axis lies between the limits of
`adis_gonio.record.stillness`. The noise of an axis is the median of the standard deviations in its quiet
windows, which are windows with less than twice the 5 % quantile of all windows.

Gyros detect a slow turn that the accelerations do not show, but a sensor held by hand moves far above their
noise without harm. The limit of a gyro's standard deviation is therefore ten times its median in windows in
which the accelerations are still.

Every run of still windows is trimmed at both ends, which the hand may disturb, and kept if it is long. A
run is split at steps of its mean (a slip, or a slow turn).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError
from adis_gonio.base.numbers import counted
from adis_gonio.model.records import Dwell
from adis_gonio.record.stillness import UPPER, limits_from_noise

WINDOW_S = 0.5
TRIM_S = 0.25
LEAST_S = 1.0

_GYRO_UPPER = 10.0
_OFTEN = 0.25
"""Share of constant windows above which the converter's resolution is the cause, not stuck data."""
_LEAST_WINDOW = 8
_BLOCK = 1 << 16
"""Number of windows whose standard deviations are computed at a time, so that running sums stay short."""
_FIRST = 20_000
"""Number of rows at the beginning that determine the converter's step."""

Flags = NDArray[np.bool_]


def segment_with_notes(
    time_s: Floats, accel: Floats, gyro: Floats | None = None
) -> tuple[list[slice], list[str]]:
    """Find the dwells of a continuous recording; return their rows and remarks.

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
    n, steps = len(time_s), np.diff(time_s)
    steps = steps[steps > 0]
    if n < 2 * _LEAST_WINDOW or not steps.size:
        return [], [f"{counted(n, 'sample')}: too few for a continuous recording"]
    period = float(np.median(steps))
    window = max(_LEAST_WINDOW, round(WINDOW_S / period))
    trim, least = max(1, round(TRIM_S / period)), max(2 * window, round(LEAST_S / period))
    if n < least:
        return [], [
            f"the recording lasts {n * period:.2g} s; a dwell needs at least {least * period:.2g} s"
        ]
    _refuse_constant(accel)
    accelerometers = [_Axis(column, window) for column in accel.T]
    noise = np.array([axis.noise() for axis in accelerometers])
    limits = limits_from_noise(noise, window, np.array([axis.quantum for axis in accelerometers]))
    high, low = np.zeros((2, n - window + 1), dtype=np.bool_)
    for axis, lower, upper in zip(accelerometers, limits.lower, limits.upper, strict=True):
        deviation = axis.deviation()
        high |= deviation > upper
        low |= deviation < lower
    still = ~high & ~low
    if gyro is not None and still.any():
        turning = np.zeros_like(still)
        for axis in (_Axis(column, window) for column in gyro.T):
            deviation = axis.deviation()
            usual = float(np.median(deviation[still]))
            turning |= deviation > max(_GYRO_UPPER * usual, UPPER * axis.quantum / math.sqrt(12))
        still &= ~turning
    # An axis that never changes has the limit 0: avoid a division by zero.
    unit = np.maximum(limits.upper / UPPER, 1e-300)
    slices = []
    for first, last in _runs(still):
        start, stop = first + trim, last + window - trim
        cuts = _cuts((accel[start:stop] - accel[start]) / unit, window) if stop - start >= 2 * least else []
        edges = [start, *(start + cut for cut in cuts), stop]
        slices += [slice(a, b) for a, b in pairwise(edges) if b - a >= least]
    scatter = ", ".join(f"{value:.3g}" for value in noise)
    notes = [
        f"{counted(len(slices), 'dwell')} found by stillness (window {window * period:.3g} s, noise"
        f" of the accelerations {scatter} in the file's unit, limit four times that)"
    ]
    stuck = [f"{time_s[a]:.4g} s to {time_s[b + window - 1]:.4g} s" for a, b in _runs(low)]
    if stuck:
        rows = ", ".join(stuck[:4])
        notes.append(f"stuck data left out: an axis has less than a tenth of its noise at {rows}")
    return slices, notes


def _refuse_constant(accel: Floats) -> None:
    if not accel.any():
        raise DataError(
            "all-zero accelerations in the whole recording; check wiring and supply, record again"
        )
    if (accel == accel[0]).all():
        raise DataError("stuck data: the accelerations never change in the whole recording; record again")


@dataclass(frozen=True)
class _Axis:
    """Samples (n,) of one axis, and the number of samples in a window."""

    samples: Floats
    window: int

    def deviation(self) -> Floats:
        """Return the standard deviation (n − window + 1,) in each window; rounding errors count as zero."""
        window, middle = self.window, self.samples.mean()
        rounding = 1e-12 * max(self.samples.max() - middle, middle - self.samples.min()) ** 2
        deviation = np.empty(len(self.samples) - window + 1)
        for start in range(0, len(deviation), _BLOCK):
            # The mean is subtracted, so that the differences of running sums of x and x² lose few digits.
            part = self.samples[start : start + _BLOCK + window - 1] - middle
            first, second = (np.concatenate([[0.0], np.cumsum(part**power)]) for power in (1, 2))
            mean = (first[window:] - first[:-window]) / window
            variance = (second[window:] - second[:-window]) / window - mean**2
            variance[variance < rounding] = 0.0
            deviation[start : start + _BLOCK] = np.sqrt(variance)
        return deviation

    def noise(self) -> float:
        """Return the noise at rest: the median of the standard deviations in the quiet windows.

        It is zero if many windows are constant, because the converter is too coarse.
        """
        deviation = self.deviation()
        alive = deviation[deviation > 0]
        if not alive.size or alive.size < (1 - _OFTEN) * deviation.size:
            return 0.0
        return float(np.median(alive[alive <= 2 * np.quantile(alive, 0.05)]))

    @property
    def quantum(self) -> float:
        """Resolution of the samples: the smallest difference of values; 0 for a constant axis."""
        gaps = np.diff(np.unique(self.samples[:_FIRST]))
        # The smallest difference of two values is the step, unless it is a rounding error.
        gaps = gaps[gaps > 1e-9 * max(1.0, float(np.abs(self.samples).max()))]
        return float(gaps.min()) if gaps.size else 0.0


def _runs(flags: Flags) -> Iterator[tuple[int, int]]:
    """Yield the runs of true flags, each as the indices of its first and its last flag."""
    edges = np.flatnonzero(np.diff(flags, prepend=False, append=False)).tolist()
    yield from ((first, after - 1) for first, after in zip(edges[::2], edges[1::2], strict=True))


def _cuts(samples: Floats, window: int) -> list[int]:
    """Return the rows at which a dwell is split: large changes of the mean, at least a window apart.

    `samples` (n, axes) are the samples of the dwell in units of the noise.
    """
    sums = np.concatenate([np.zeros((1, samples.shape[1])), np.cumsum(samples, axis=0)])
    means = (sums[window:] - sums[:-window]) / window
    # Difference of the means of adjacent windows, the largest over the axes.
    jump = np.abs(means[window:] - means[:-window]).max(axis=1)
    rows = np.flatnonzero(jump > UPPER)
    cuts = []
    while rows.size:
        k = int(rows[jump[rows].argmax()])
        cuts.append(k + window)
        rows = rows[(rows < k - window) | (rows >= k + window)]
    return sorted(cuts)


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
