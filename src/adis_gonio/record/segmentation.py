"""Dwells of a continuous recording: the stretches in which the sensor was still.

A window of samples is still if the standard deviation of every axis lies between the limits of
`adis_gonio.record.stillness`. The noise of an axis is the median of the standard deviations in its quiet
windows, which are windows with less than twice the 5 % quantile of all windows.

Gyros detect a slow turn that the accelerations do not show. A sensor that a hand holds still also turns, by
far more than the noise of its gyros, which does no harm. The limit of a gyro's standard deviation is
therefore ten times its median in windows in which the accelerations are still.

Every run of still windows is trimmed at both ends, which the hand may disturb, by `TRIM_S` or half a
window, and kept if it lasts at least `LEAST_S`. A slow turn or a slip moves the mean more than the standard
deviation: the window between two still windows is not still if their means differ by more than the upper
limit.

A window has at least eight settling times of the chip's filter, if the filter is known: in a shorter one
the samples are correlated, and their standard deviation shows only a part of the noise. If the sensor
turns in all windows of this length, the motion counts as noise; a run in which the readings scatter by more
than the length of their mean is therefore not kept.

Running sums are computed a block of rows at a time, so that memory is needed for little but their results.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError
from adis_gonio.base.numbers import counted
from adis_gonio.device.sensor.settings import filter_settling_samples
from adis_gonio.model.records import Dwell
from adis_gonio.record.stillness import SETTLINGS_PER_WINDOW, UPPER, limits_from_noise

WINDOW_S = 0.5
TRIM_S = 0.25
LEAST_S = 1.0

_GYRO_UPPER = 10.0
_OFTEN = 0.25
"""Share of constant windows above which the converter's resolution is the cause, not stuck data."""
_LEAST_WINDOW = 8
_BLOCK = 1 << 16
"""Number of windows in a block."""
_FIRST = 20_000
"""Number of rows at the beginning that determine the converter's step."""


def segment_with_notes(
    time_s: Floats, accel: Floats, gyro: Floats | None = None, filter_m: int = 0
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
    filter_m : int
        Exponent M of the chip's filter; 0 if there is none or it is unknown.

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
    n = len(time_s)
    if n < 2 * _LEAST_WINDOW or time_s[0] == time_s[-1]:
        return [], [f"{counted(n, 'sample')}: too few for a continuous recording"]
    period = float(np.median(np.diff(np.unique(time_s))))
    # Without a filter one sample settles, so that a window has at least eight samples.
    window = max(round(WINDOW_S / period), SETTLINGS_PER_WINDOW * filter_settling_samples(filter_m))
    # Half a window: two runs with only one window between them then share no rows.
    trim = max(window // 2, round(TRIM_S / period))
    least = max(2 * _LEAST_WINDOW, window, round(LEAST_S / period))
    _refuse_constant(accel)
    if n < least + 2 * trim:
        needed_s = (least + 2 * trim) * period
        return [], [f"the recording lasts {n * period:.3g} s; a rest must last at least {needed_s:.3g} s"]
    windows = n - window + 1
    is_flat, is_still = np.zeros(windows, dtype=np.bool_), np.ones(windows, dtype=np.bool_)
    moved = np.zeros(max(windows - 2 * window, 0), dtype=np.bool_)
    noise = []
    for of_axis in accel.T:
        spread = _deviations(of_axis, window)
        noise.append(_own_noise(spread))
        limits = limits_from_noise(np.array(noise[-1:]), window, _resolution(of_axis))
        is_flat |= spread < limits.lower
        is_still &= spread <= limits.upper
        moved |= _changes(of_axis, window) > limits.upper
    is_still &= ~is_flat
    if gyro is not None and is_still.any():
        at_rest = is_still.copy()
        for of_axis in gyro.T:
            spread = _deviations(of_axis, window)
            coarse = UPPER * _resolution(of_axis) / math.sqrt(12)
            is_still &= spread <= max(_GYRO_UPPER * float(np.median(spread[at_rest])), coarse)
    # Slow motion: a window is not still if it is between two still windows with different means.
    is_still[window : window + len(moved)] &= ~(moved & is_still[: -2 * window] & is_still[2 * window :])
    still, flat = _runs_of(is_still), _runs_of(is_flat)
    runs = [slice(first + trim, last + window - trim) for first, last in still]
    slices = [run for run in runs if run.stop - run.start >= least and not _is_turning(accel[run])]
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


def _refuse_constant(accel: Floats) -> None:
    """Raise `DataError` if the accelerations (n, axes) never change."""
    if not accel.any():
        raise DataError(
            "all-zero accelerations in the whole recording; check wiring and supply, record again"
        )
    if not np.ptp(accel, axis=0).any():
        raise DataError("stuck data: the accelerations never change in the whole recording; record again")


def _is_turning(accel: Floats) -> bool:
    """Return True if readings (n, 3) scatter by more than the length of their mean, which is gravity.

    With fewer axes it returns False, because these may be perpendicular to gravity.
    """
    return accel.shape[1] == 3 and bool(sum(axis.var() - axis.mean() ** 2 for axis in accel.T) > 0)


def _resolution(values: Floats) -> float:
    """Return the smallest difference of values (n,) in the first rows; 0 if all values are equal."""
    # The smallest difference of two values is the step, unless it is a rounding error.
    gaps = np.diff(np.unique(values[:_FIRST]))
    gaps = gaps[gaps > 1e-9 * max(1.0, float(values.max()), -float(values.min()))]
    return float(gaps.min()) if gaps.size else 0.0


def _deviations(values: Floats, window: int) -> NDArray[np.float32]:
    """Return the standard deviation of values (n,) in each window of `window` rows, (n - window + 1,)."""
    middle = values.mean()
    rounding = 1e-12 * max(values.max() - middle, middle - values.min()) ** 2
    result = np.empty(len(values) - window + 1, dtype=np.float32)
    for row in range(0, len(result), _BLOCK):
        # The mean is subtracted, so that the differences of running sums of x and x² lose few digits.
        part = values[row : row + _BLOCK + window - 1] - middle
        mean, mean_square = _running_mean(part, window), _running_mean(part**2, window)
        variance = mean_square - mean**2
        variance[variance < rounding] = 0.0
        result[row : row + _BLOCK] = np.sqrt(variance)
    return result


def _changes(values: Floats, window: int) -> NDArray[np.float32]:
    """Return the change of the mean from the first to the last of three adjacent windows of `window` rows.

    `values` are (n,), the changes (n - 3 window + 1,), without sign; empty if n is smaller.
    """
    result = np.empty(max(len(values) - 3 * window + 1, 0), dtype=np.float32)
    for row in range(0, len(result), _BLOCK):
        mean = _running_mean(values[row : row + _BLOCK + 3 * window - 1] - values[row], window)
        result[row : row + _BLOCK] = np.abs(mean[2 * window :] - mean[: -2 * window])
    return result


def _running_mean(values: Floats, window: int) -> Floats:
    """Return the mean of values (n,) in each window of `window` rows, (n - window + 1,)."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray((sums[window:] - sums[:-window]) / window)


def _own_noise(spread: NDArray[np.float32]) -> float:
    """Return the noise of an axis at rest, from the standard deviations (m,) of all windows (`spread`).

    It is the median over quiet windows: those with less than twice the 5 % quantile. It is 0 if more than a
    quarter of the windows is constant (`_OFTEN`), because the converter is then coarser than the noise.
    """
    varies = spread[spread > 0]
    if len(varies) < (1 - _OFTEN) * len(spread):
        return 0.0
    return float(np.median(varies[varies <= 2 * np.quantile(varies, 0.05)]))


Runs = list[tuple[int, int]]
"""Runs of true flags, each as the numbers of its first and its last flag."""


def _runs_of(flags: NDArray[np.bool_]) -> Runs:
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
