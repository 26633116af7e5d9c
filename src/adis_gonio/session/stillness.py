"""Where a sensor stood still: dwells of a continuous recording.

A window of samples is still where the standard deviation of every axis lies between two limits. Both
come from the sensor's own noise, not from a table: the noise of an axis is that of its quietest stretches
(median of all windows whose deviation is less than twice the lowest twentieth). The upper limit is four
times that: rotation by hand exceeds it a hundredfold, the window's own scatter and a building's hum do
not. The lower limit catches data that only look still because they are stuck: a working converter shows
its noise. Where the noise is below half a step a constant word is normal and there is no lower limit.

Gyros see a slow turn that the accelerations hide, but a part held by hand wobbles far above their noise
without harm; so their limit is ten times their median where the accelerations are still.

Every run of still windows is trimmed at both ends, where the hand is still near, and kept if it lasts. A
run within which the mean moves on (a slip, or a slow turn) is split there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from adis_gonio.counting import counted
from adis_gonio.errors import DataError
from adis_gonio.model.records import Dwell, Floats

WINDOW_S = 0.5
TRIM_S = 0.25
LEAST_S = 1.0

_UPPER = 4.0
_LOWER = 0.1
_GYRO_UPPER = 10.0
_OFTEN = 0.25
"""Share of windows with a constant word above which this is the converter's step and not a fault."""
_LEAST_WINDOW = 8
_BLOCK = 1 << 16
"""Windows that are worked on at a time: a long recording is as large as memory allows already."""


@dataclass(frozen=True)
class StillnessLimits:
    """Standard deviations within a window between which an axis counts as still.

    Attributes
    ----------
    window_samples : int
        Length of the window.
    lower, upper : (axes,) float
        Limits in the unit of the samples; `lower` is zero where a constant word is normal.
    """

    window_samples: int
    lower: Floats
    upper: Floats

    def still(self, samples: Floats) -> bool:
        """True where the last `window_samples` of samples (n, axes) are still; False if there are fewer."""
        if len(samples) < self.window_samples:
            return False
        deviation = np.std(samples[-self.window_samples :], axis=0)
        return bool(((deviation >= self.lower) & (deviation <= self.upper)).all())

    def stuck(self, samples: Floats) -> bool:
        """True where an axis shows less than a living sensor would in the last window."""
        if len(samples) < self.window_samples:
            return False
        return bool((np.std(samples[-self.window_samples :], axis=0) < self.lower).any())


def limits_from_noise(noise_sd: Floats, window_samples: int, quantum: Floats | float) -> StillnessLimits:
    """Limits from the standard deviation of single samples at rest.

    Parameters
    ----------
    noise_sd : (axes,) float
        Standard deviation of samples at rest within a window.
    window_samples : int
        Length of the window in samples.
    quantum : float or (axes,) float
        Step of the converter in the samples' unit; 0 unknown.
    """
    noise = np.asarray(noise_sd, dtype=float)
    step = np.broadcast_to(np.asarray(quantum, dtype=float), noise.shape)
    # Quantization alone shows as up to half a step where the value sits between two codes.
    upper = _UPPER * np.maximum(noise, step / np.sqrt(12))
    lower = np.where(noise > 0.5 * step, _LOWER * noise, 0.0)
    return StillnessLimits(window_samples, lower, upper)


def segment(time_s: Floats, accel: Floats, gyro: Floats | None = None) -> list[slice]:
    """Dwells of a continuous recording.

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
        Rows of each dwell, in order; empty where the sensor never rests.

    Raises
    ------
    DataError
        If the samples never change (stuck data).
    """
    return segment_with_notes(time_s, accel, gyro)[0]


def segment_with_notes(
    time_s: Floats, accel: Floats, gyro: Floats | None = None
) -> tuple[list[slice], list[str]]:
    """Same as `segment`, with lines on what was found."""
    n = len(time_s)
    steps = np.diff(time_s)
    steps = steps[steps > 0]
    if n < 2 * _LEAST_WINDOW or not steps.size:
        return [], [f"{counted(n, 'sample')}: too few for a continuous recording"]
    period = float(np.median(steps, overwrite_input=True))
    del steps
    window = max(_LEAST_WINDOW, round(WINDOW_S / period))
    least = max(2 * window, round(LEAST_S / period))
    trim = max(1, round(TRIM_S / period))
    if n < least:
        return [], [
            f"the recording lasts {n * period:.2g} s; a dwell needs at least {least * period:.2g} s"
        ]
    _refuse_constant(accel)

    quantum = _quantum(accel)
    noise, upper, lower = np.zeros((3, accel.shape[1]))
    high = np.zeros(n - window + 1, dtype=np.bool_)
    low = np.zeros_like(high)
    for axis in range(accel.shape[1]):
        deviation = _window_deviation(accel[:, axis], window)
        noise[axis] = _own_noise(deviation)
        own = limits_from_noise(noise[axis : axis + 1], window, quantum[axis : axis + 1])
        upper[axis], lower[axis] = own.upper[0], own.lower[0]
        high |= deviation > upper[axis]
        low |= deviation < lower[axis]
        del deviation
    limits = StillnessLimits(window, lower, upper)
    if gyro is not None:
        high |= _turns(gyro, window, ~high & ~low)
    runs = _runs(~high & ~low, window)
    slices = [slice(start + trim, stop - trim) for start, stop in runs if stop - start - 2 * trim >= least]
    slices = [part for rows in slices for part in _split_at_steps(accel, rows, window, least, limits)]
    scatter = ", ".join(f"{value:.3g}" for value in noise)
    notes = [
        f"{counted(len(slices), 'dwell')} found by stillness (window {window * period:.3g} s, noise of the"
        f" accelerations {scatter} in the file's unit, limit four times that)"
    ]
    stuck = _runs(low, window)
    if stuck:
        rows = ", ".join(f"{time_s[a]:.4g} s to {time_s[b - 1]:.4g} s" for a, b in stuck[:4])
        notes.append(f"stuck data left out: an axis shows less than a tenth of its noise at {rows}")
    return slices, notes


def _refuse_constant(accel: Floats) -> None:
    if not accel.any():
        raise DataError(
            "all-zero accelerations in the whole recording; check wiring and supply, record again"
        )
    if not np.ptp(accel, axis=0).any():
        raise DataError("stuck data: the accelerations never change in the whole recording; record again")


def _window_deviation(samples: Floats, window: int) -> Floats:
    """Standard deviation (n − window + 1,) of samples (n,) in every window."""
    middle = float(samples.mean())
    # What is left of a constant window is rounding of the running sums.
    least = 1e-12 * max(float(samples.max()) - middle, middle - float(samples.min())) ** 2
    deviation = np.empty(len(samples) - window + 1)
    for start in range(0, len(deviation), _BLOCK):
        stop = min(start + _BLOCK, len(deviation))
        part = samples[start : stop + window - 1] - middle
        first = np.concatenate([[0.0], np.cumsum(part)])
        second = np.concatenate([[0.0], np.cumsum(part**2)])
        mean = (first[window:] - first[:-window]) / window
        variance = np.maximum((second[window:] - second[:-window]) / window - mean**2, 0.0)
        variance[variance < least] = 0.0
        deviation[start:stop] = np.sqrt(variance)
    return deviation


def _turns(gyro: Floats, window: int, still: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Windows (w,) in which a gyro moves more than it usually does where the accelerations are still."""
    turns = np.zeros(len(still), dtype=np.bool_)
    if not still.any():
        return turns
    for axis, quantum in enumerate(_quantum(gyro).tolist()):
        deviation = _window_deviation(gyro[:, axis], window)
        usual = float(np.median(deviation[still], overwrite_input=True))
        turns |= deviation > max(_GYRO_UPPER * usual, _UPPER * quantum / np.sqrt(12))
        del deviation
    return turns


def _own_noise(deviation: Floats) -> float:
    """Noise of an axis: typical deviation of its quiet windows (w,); zero where words often repeat."""
    alive = deviation[deviation > 0]
    if alive.size < (1 - _OFTEN) * len(deviation):
        return 0.0
    lowest = float(np.quantile(alive, 0.05, overwrite_input=True))
    return float(np.median(alive[alive <= 2 * lowest], overwrite_input=True))


def _quantum(samples: Floats) -> Floats:
    steps = np.zeros(samples.shape[1])
    for axis in range(samples.shape[1]):
        gaps = np.diff(np.unique(samples[:20000, axis]))
        gaps = gaps[gaps > 1e-9 * max(1.0, float(np.abs(samples[:, axis]).max()))]
        steps[axis] = gaps.min() if gaps.size else 0.0
    return steps


def _runs(flag: NDArray[np.bool_], window: int) -> list[tuple[int, int]]:
    """Rows covered by each run of flagged windows, (start, stop)."""
    edges = np.diff(np.concatenate([[False], flag, [False]]).astype(np.int8))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return [(int(a), int(b) - 1 + window) for a, b in zip(starts, ends, strict=True)]


def _split_at_steps(
    accel: Floats, rows: slice, window: int, least: int, limits: StillnessLimits
) -> list[slice]:
    """Parts of a dwell between which its mean steps by more than the noise of a single sample."""
    n = rows.stop - rows.start
    if n < 2 * least:
        return [rows]
    # An axis that never changes has no limit and no step either.
    unit = np.maximum(limits.upper / _UPPER, 1e-300)
    jump = np.zeros(n - 2 * window + 1)
    for axis in range(accel.shape[1]):
        part = accel[rows, axis]
        sums = np.concatenate([[0.0], np.cumsum(part - part[0])])
        means = (sums[window:] - sums[:-window]) / window
        np.maximum(jump, np.abs(means[window:] - means[:-window]) / unit[axis], out=jump)
    cuts = []
    while jump.size and jump.max() > _UPPER:
        k = int(jump.argmax())
        cuts.append(window + k)
        jump[max(0, k - window) : k + window] = 0.0
    edges = [0, *sorted(cuts), n]
    return [slice(rows.start + a, rows.start + b) for a, b in pairwise(edges) if b - a >= least]


_HALF_TURN = math.pi
_MOST_REST = 0.5
"""Part of the time at rest beyond which a recording is a row of positions."""
_OUT_OF_PLANE = 0.25
"""Z and the change of the length of X and Y, over that length, beyond which no plane was kept."""


def is_free_turn(recording: Dwell, dwells: Sequence[slice]) -> bool:
    """True where a continuous recording with gyros is one turn in the plane of X and Y.

    It turns half around or more, and for more than half of its time.

    Parameters
    ----------
    dwells : sequence of slice
        Rests that were found in it; a hand that takes a new grip leaves some too.
    """
    rest = sum(rows.stop - rows.start for rows in dwells)
    if recording.gyro is None or rest > _MOST_REST * len(recording) or len(recording) < 2 * _LEAST_WINDOW:
        return False
    blocks = np.array_split(recording.accel, max(len(recording) // 64, 8))
    x, y, *z = np.array([block.mean(axis=0) for block in blocks]).T
    length = np.hypot(x, y)
    typical = float(np.median(length))
    odd = max(float(np.ptp(length)) / 2, *(float(np.abs(other).max()) for other in z), 0.0)
    turned = float(np.ptp(np.unwrap(np.arctan2(y, x))))
    return turned >= _HALF_TURN and odd < _OUT_OF_PLANE * typical
