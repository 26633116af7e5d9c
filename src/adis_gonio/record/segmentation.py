"""Dwells of a continuous recording of any length: the stretches in which the sensor was still.

A window of samples is still if the standard deviation of every axis lies between the limits of
`adis_gonio.record.stillness`. The noise of an axis is the median of the standard deviations in its quiet
windows, which are windows with less than twice the 5 % quantile of all windows.

Gyros detect a slow turn that the accelerations do not show, but a sensor held by hand moves far above their
noise without harm. The limit of a gyro's standard deviation is therefore ten times its median in windows in
which the accelerations are still.

Every run of still windows is trimmed at both ends, which the hand may disturb, and kept if it is long. A
run is split at steps of its mean (a slip, or a slow turn).

The recording is read several times from its beginning, a block at a time: its extent, its noise, the gyros'
noise, its dwells. Memory is needed for one block and the results only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

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
"""Number of rows of a block."""
_FIRST = 20_000
"""Number of rows at the beginning that determine the converter's step."""

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Piece:
    """Consecutive samples of a recording.

    Attributes
    ----------
    time_s : (n,) float
        Time of each sample, increasing.
    accel : (n, axes) float
        Accelerometer samples in any unit.
    gyro : (n, 3) float or None
        Gyro samples in any unit; None for all pieces of a recording without gyros.
    """

    time_s: Floats
    accel: Floats
    gyro: Floats | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    def rows(self, rows: slice) -> Piece:
        """Return some rows of the piece, as views."""
        gyro = None if self.gyro is None else self.gyro[rows]
        return Piece(self.time_s[rows], self.accel[rows], gyro)


Reading = Callable[[], Iterable[Piece]]
"""Function that reads a recording from its beginning; each call gives equal samples."""


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
    whole = Piece(time_s, accel, gyro)
    return segment_pieces(lambda: (whole,))


def segment_pieces(read: Reading) -> tuple[list[slice], list[str]]:
    """Find the dwells of a recording that may be larger than memory; return their rows and remarks.

    The division of the recording into pieces does not change the result.

    Parameters
    ----------
    read : callable
        Returns the pieces of the recording in order; called up to four times.

    Raises
    ------
    DataError
        The samples never change (stuck data).
    """
    extent = _Extent()
    for piece in _blocks(read()):
        extent.take(piece)
    n = extent.rows
    if n < 2 * _LEAST_WINDOW or not extent.steps.positive:
        return [], [f"{counted(n, 'sample')}: too few for a continuous recording"]
    period = extent.steps.quantile(0.5)
    sizes = _Sizes.of(period)
    if n < sizes.least:
        return [], [
            f"the recording lasts {n * period:.2g} s; a dwell needs at least {sizes.least * period:.2g} s"
        ]
    extent.accel.refuse_constant()
    noise, limits = _limits(read, extent.accel, sizes.window)
    turn = _turn_limits(read, extent, limits)
    cutter = _Cutter(sizes, limits, extent, turn)
    for start, piece in _overlapping(read, 2 * sizes.window - 1):
        cutter.take(start, piece)
    slices = cutter.done()
    scatter = ", ".join(f"{value:.3g}" for value in noise)
    notes = [
        f"{counted(len(slices), 'dwell')} found by stillness (window {sizes.window * period:.3g} s, noise"
        f" of the accelerations {scatter} in the file's unit, limit four times that)"
    ]
    if cutter.stuck:
        rows = ", ".join(f"{a:.4g} s to {b:.4g} s" for a, b in cutter.stuck[:4])
        notes.append(f"stuck data left out: an axis has less than a tenth of its noise at {rows}")
    return slices, notes


# Reading ------------------------------------------------------------------------------------------------


def _blocks(pieces: Iterable[Piece]) -> Iterator[Piece]:
    """Regroup a recording into blocks of `_BLOCK` rows; only the last block may be shorter."""
    waiting: list[Piece] = []
    held = 0
    for piece in pieces:
        start = 0
        while held + len(piece) - start >= _BLOCK:
            stop = start + _BLOCK - held
            yield _joined([*waiting, piece.rows(slice(start, stop))])
            waiting, held, start = [], 0, stop
        if start < len(piece):
            waiting.append(piece.rows(slice(start, None)))
            held += len(piece) - start
    if waiting:
        yield _joined(waiting)


def _joined(pieces: list[Piece]) -> Piece:
    if len(pieces) == 1:
        return pieces[0]
    gyros = [piece.gyro for piece in pieces if piece.gyro is not None]
    return Piece(
        np.concatenate([piece.time_s for piece in pieces]),
        np.concatenate([piece.accel for piece in pieces]),
        np.concatenate(gyros) if gyros else None,
    )


def _overlapping(read: Reading, overlap: int) -> Iterator[tuple[int, Piece]]:
    """Yield blocks that begin with the last `overlap` rows of the block before, each with its first row."""
    before: Piece | None = None
    row = 0
    for block in _blocks(read()):
        whole = block if before is None else _joined([before, block])
        row += len(block)
        yield row - len(whole), whole
        before = whole.rows(slice(max(len(whole) - overlap, 0), None))


_SHIFT = 52 - 10
"""Number of low bits of a float64 that are ignored: numbers with equal higher bits share a bin."""


class Quantiles:
    """Histogram of non-negative numbers, fed in pieces, that gives quantiles with 0.1 % resolution.

    A quantile is the mean of the numbers in its bin, so that equal numbers are returned unchanged. Memory
    grows only with the logarithm of the ratio of the largest to the smallest number.

    Attributes
    ----------
    zeros : int
        Number of zeros so far.
    """

    def __init__(self) -> None:
        self.zeros = 0
        self._first = 0
        self._count = np.zeros(0, dtype=np.int64)
        self._sum = np.zeros(0)

    @property
    def positive(self) -> int:
        """Number of numbers above zero so far."""
        return int(self._count.sum())

    def feed(self, values: Floats) -> None:
        """Add non-negative numbers (n,) to the histogram."""
        some = values[values > 0]
        self.zeros += len(values) - len(some)
        if not len(some):
            return
        # The bit pattern of a positive float64 grows with its value, so that its upper bits number the
        # bins.
        places: NDArray[np.int64] = np.ascontiguousarray(some, dtype=np.float64).view(np.int64) >> _SHIFT
        low, high = int(places.min()), int(places.max()) + 1
        self._reach(low, high)
        here = slice(low - self._first, high - self._first)
        self._count[here] += np.bincount(places - low, minlength=high - low)
        self._sum[here] += np.bincount(places - low, weights=some, minlength=high - low)

    def quantile(self, share: float, *, below: float = np.inf, with_zeros: bool = False) -> float:
        """Return the value below which the fraction `share` of the numbers lies.

        Parameters
        ----------
        share : float
            Fraction from 0 to 1.
        below : float
            Larger numbers are excluded.
        with_zeros : bool
            True to include zeros.

        Raises
        ------
        ValueError
            There are no numbers.
        """
        mean = self._sum / np.maximum(self._count, 1)
        count = np.where(mean <= below, self._count, 0)
        zeros = self.zeros if with_zeros else 0
        total = int(count.sum()) + zeros
        if not total:
            raise ValueError("no numbers")
        # Rank among the sorted numbers, of which the zeros are the first.
        rank = share * (total - 1)
        if rank < zeros:
            return 0.0
        return float(mean[np.searchsorted(np.cumsum(count), rank - zeros, side="right")])

    def _reach(self, low: int, high: int) -> None:
        """Extend the histogram so that it includes bins `low` to `high` (exclusive)."""
        if not len(self._count):
            self._first = low
        before = max(self._first - low, 0)
        after = max(high - self._first - len(self._count), 0)
        if before or after:
            self._count = np.pad(self._count, (before, after))
            self._sum = np.pad(self._sum, (before, after))
            self._first -= before


# Results of the passes ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Sizes:
    """Numbers of samples: `window` per window, `trim` cut off at each end of a dwell, `least` per dwell.

    A part at rest with fewer than `least` samples is no dwell.
    """

    window: int
    trim: int
    least: int

    @classmethod
    def of(cls, period_s: float) -> _Sizes:
        window = max(_LEAST_WINDOW, round(WINDOW_S / period_s))
        return cls(window, max(1, round(TRIM_S / period_s)), max(2 * window, round(LEAST_S / period_s)))


class _Range:
    """Minimum, maximum and mean of each axis over a recording, and a copy of its first rows."""

    def __init__(self) -> None:
        self._rows = 0
        self._first: list[Floats] = []
        self._sum: Floats = np.zeros(0)
        self.low: Floats = np.zeros(0)
        self.high: Floats = np.zeros(0)

    def take(self, samples: Floats) -> None:
        low, high, total = samples.min(axis=0), samples.max(axis=0), samples.sum(axis=0)
        if not self._rows:
            self.low, self.high, self._sum = low, high, total
        else:
            self.low, self.high = np.minimum(self.low, low), np.maximum(self.high, high)
            self._sum = self._sum + total
        if self._rows < _FIRST:
            self._first.append(samples[: _FIRST - self._rows].copy())
        self._rows += len(samples)

    @property
    def axes(self) -> int:
        return len(self.low)

    @property
    def middle(self) -> Floats:
        mean: Floats = self._sum / self._rows
        return mean

    @property
    def rounding(self) -> Floats:
        """Variance (axes,) below which a window counts as constant: rounding error of running sums."""
        least: Floats = 1e-12 * np.maximum(self.high - self.middle, self.middle - self.low) ** 2
        return least

    @property
    def quantum(self) -> Floats:
        """Resolution (axes,) of the samples: the smallest difference of values; 0 for a constant axis.

        Only the first rows are used.
        """
        steps = np.zeros(self.axes)
        largest = np.maximum(np.abs(self.low), np.abs(self.high))
        first = np.concatenate(self._first)
        for axis in range(self.axes):
            # The smallest difference of two values is the step, unless it is a rounding error.
            gaps = np.diff(np.unique(first[:, axis]))
            gaps = gaps[gaps > 1e-9 * max(1.0, float(largest[axis]))]
            steps[axis] = gaps.min() if gaps.size else 0.0
        return steps

    def refuse_constant(self) -> None:
        if not self.low.any() and not self.high.any():
            raise DataError(
                "all-zero accelerations in the whole recording; check wiring and supply, record again"
            )
        if (self.low == self.high).all():
            raise DataError(
                "stuck data: the accelerations never change in the whole recording; record again"
            )


@dataclass
class _Extent:
    """Result of the first pass over a recording.

    Attributes
    ----------
    rows : int
        Number of samples.
    steps : Quantiles
        Positive time steps between samples, in s.
    accel, gyro : _Range
        Ranges of the accelerometers and the gyros; `gyro` is None without gyros.
    """

    rows: int = 0
    steps: Quantiles = field(default_factory=Quantiles)
    accel: _Range = field(default_factory=_Range)
    gyro: _Range | None = None
    _latest_s: float = np.nan

    def take(self, piece: Piece) -> None:
        steps = np.diff(piece.time_s, prepend=self._latest_s)
        self.steps.feed(steps[steps > 0])
        self._latest_s = float(piece.time_s[-1])
        self.rows += len(piece)
        self.accel.take(piece.accel)
        if piece.gyro is not None:
            self.gyro = self.gyro or _Range()
            self.gyro.take(piece.gyro)


def _deviation(samples: Floats, window: int, middle: float, rounding: float) -> Floats:
    """Return the standard deviation (n − window + 1,) in each window of samples (n,).

    `middle` is subtracted first, so that the sums lose few digits. A variance below `rounding` counts as
    zero.
    """
    if len(samples) < window:
        return np.zeros(0)
    # Differences of running sums give the sums of x and x² over every window.
    part = samples - middle
    first = np.concatenate([[0.0], np.cumsum(part)])
    second = np.concatenate([[0.0], np.cumsum(part**2)])
    mean = (first[window:] - first[:-window]) / window
    variance = (second[window:] - second[:-window]) / window - mean**2
    variance[variance < rounding] = 0.0
    deviation: Floats = np.sqrt(variance)
    return deviation


def _deviations(samples: Floats, window: int, extent: _Range) -> Iterator[Floats]:
    """Yield, for each axis of samples (n, axes), the standard deviations (n − window + 1,) in all windows.

    `extent` is the range of these samples over the recording.
    """
    for axis in range(extent.axes):
        middle, rounding = float(extent.middle[axis]), float(extent.rounding[axis])
        yield _deviation(samples[:, axis], window, middle, rounding)


def _limits(read: Reading, extent: _Range, window: int) -> tuple[Floats, StillnessLimits]:
    """Measure the noise (axes,) at rest in a second pass, and derive the limits of stillness.

    `extent` is the range of the accelerations over the recording, `window` the length of a window in
    samples.
    """
    spreads = [Quantiles() for _ in range(extent.axes)]
    for _, piece in _overlapping(read, window - 1):
        for spread, deviation in zip(spreads, _deviations(piece.accel, window, extent), strict=True):
            spread.feed(deviation)
    noise = np.array([_own_noise(spread) for spread in spreads])
    return noise, limits_from_noise(noise, window, extent.quantum)


def _own_noise(spread: Quantiles) -> float:
    """Return the noise of an axis at rest: median of the standard deviations in its quiet windows.

    `spread` has the standard deviations of all windows. The noise is zero if many windows are constant,
    because the converter is too coarse.
    """
    alive = spread.positive
    if not alive or alive < (1 - _OFTEN) * (alive + spread.zeros):
        return 0.0
    return spread.quantile(0.5, below=2 * spread.quantile(0.05))


def _turn_limits(read: Reading, extent: _Extent, limits: StillnessLimits) -> Floats:
    """Return the standard deviation (3,) of each gyro above which it turns; empty without gyros.

    This is the third pass over the recording; `limits` are the limits of stillness of the accelerations.
    """
    if extent.gyro is None:
        return np.zeros(0)
    window = limits.window_samples
    usual = [Quantiles() for _ in range(extent.gyro.axes)]
    for _, piece in _overlapping(read, window - 1):
        high, low = _outside(piece.accel, extent.accel, limits)
        still = ~high & ~low
        gyro = np.zeros((0, 3)) if piece.gyro is None else piece.gyro
        for spread, deviation in zip(usual, _deviations(gyro, window, extent.gyro), strict=True):
            spread.feed(deviation[still])
    if not usual[0].positive + usual[0].zeros:
        return np.full(extent.gyro.axes, np.inf)
    median = np.array([spread.quantile(0.5, with_zeros=True) for spread in usual])
    upper: Floats = np.maximum(_GYRO_UPPER * median, UPPER * extent.gyro.quantum / np.sqrt(12))
    return upper


def _outside(accel: Floats, extent: _Range, limits: StillnessLimits) -> tuple[Flags, Flags]:
    """Return two flags for each window (w,): some axis moves, and some axis shows too little noise."""
    windows = max(len(accel) - limits.window_samples + 1, 0)
    high, low = np.zeros((2, windows), dtype=np.bool_)
    for axis, deviation in enumerate(_deviations(accel, limits.window_samples, extent)):
        high |= deviation > limits.upper[axis]
        low |= deviation < limits.lower[axis]
    return high, low


class _Cutter:
    """Finds runs of still windows in a last pass, trims them, and splits them at jumps of the mean.

    Parameters
    ----------
    sizes : _Sizes
        Length of a window, of the ends to trim, and of the shortest dwell, in samples.
    limits : StillnessLimits
        Limits of stillness of the accelerations.
    extent : _Extent
        Result of the first pass.
    turn : (3,) float
        Standard deviation of each gyro above which it turns; empty without gyros.

    Attributes
    ----------
    stuck : list of (float, float)
        Begin and end in s of each run of windows in which an axis shows too little noise.
    """

    def __init__(self, sizes: _Sizes, limits: StillnessLimits, extent: _Extent, turn: Floats) -> None:
        self._sizes = sizes
        self._limits = limits
        self._extent = extent
        self._turn = turn
        # An axis that never changes has the limit 0: avoid a division by zero.
        self._unit = np.maximum(limits.upper / UPPER, 1e-300)
        self._still = _Runs()
        self._flat = _Runs()
        self._windows = 0
        self._open_s = 0.0
        self._steps: list[tuple[NDArray[np.int64], Floats]] = []
        self._found: list[slice] = []
        self.stuck: list[tuple[float, float]] = []
        self._latest: tuple[int, Floats] = (0, np.zeros(0))

    def take(self, start: int, piece: Piece) -> None:
        """Process a block that begins at row `start`; it repeats 2 · window − 1 rows of the last block."""
        window = self._sizes.window
        if len(piece) < window:
            return
        high, low = _outside(piece.accel, self._extent.accel, self._limits)
        if piece.gyro is not None and self._extent.gyro is not None:
            for limit, deviation in zip(
                self._turn, _deviations(piece.gyro, window, self._extent.gyro), strict=True
            ):
                high |= deviation > limit
        still = ~high & ~low
        self._look_for_steps(start, piece.accel, still)
        new = self._windows - start
        self._windows = start + len(still)
        self._latest = (start, piece.time_s)
        for first, last in self._flat.feed(low[new:]):
            self._note_stuck(first, last)
        for first, last in self._still.feed(still[new:]):
            self._close(first, last)
        opened = self._flat.open
        if opened is not None and opened >= start:
            self._open_s = float(piece.time_s[opened - start])

    def done(self) -> list[slice]:
        """Return the rows of all dwells, after the last block."""
        for first, last in self._flat.end():
            self._note_stuck(first, last)
        for first, last in self._still.end():
            self._close(first, last)
        return self._found

    def _note_stuck(self, first: int, last: int) -> None:
        start, time_s = self._latest
        began = float(time_s[first - start]) if first >= start else self._open_s
        self.stuck.append((began, float(time_s[last + self._sizes.window - 1 - start])))

    def _look_for_steps(self, start: int, accel: Floats, still: Flags) -> None:
        """Record the samples at which the mean changes suddenly between adjacent windows."""
        window = self._sizes.window
        if len(still) <= window or not still.any():
            return
        # Difference of the means of adjacent windows in units of the noise, the largest over the axes.
        jump = np.zeros(len(still) - window)
        for axis in range(accel.shape[1]):
            sums = np.concatenate([[0.0], np.cumsum(accel[:, axis] - self._extent.accel.middle[axis])])
            means = (sums[window:] - sums[:-window]) / window
            np.maximum(jump, np.abs(means[window:] - means[:-window]) / self._unit[axis], out=jump)
        rows = np.flatnonzero((jump > UPPER) & still[window:] & still[:-window])
        # The overlap of blocks is one row shorter than a pair of windows, so that no pair occurs twice.
        if rows.size:
            self._steps.append((start + rows, jump[rows]))

    def _close(self, first: int, last: int) -> None:
        """Turn a finished run of still windows into dwells, split at sudden changes of the mean.

        `first` and `last` are the first rows of the first and the last window of the run.
        """
        sizes = self._sizes
        start, stop = first + sizes.trim, last + sizes.window - sizes.trim
        cuts = self._cuts(start, stop) if stop - start >= 2 * sizes.least else []
        edges = [start, *cuts, stop]
        self._found += [slice(a, b) for a, b in pairwise(edges) if b - a >= sizes.least]
        self._steps = [(rows, jump) for rows, jump in self._steps if rows[-1] > last]

    def _cuts(self, start: int, stop: int) -> list[int]:
        """Return the rows at which a dwell is split: large changes of the mean, at least a window apart.

        `start` and `stop` are the first row of the dwell and the row behind its last row.
        """
        window = self._sizes.window
        if not self._steps:
            return []
        rows = np.concatenate([rows for rows, _ in self._steps])
        jump = np.concatenate([jump for _, jump in self._steps])
        inside = (rows >= start) & (rows + 2 * window <= stop)
        rows, jump = rows[inside], jump[inside]
        cuts = []
        while rows.size:
            k = int(rows[jump.argmax()])
            cuts.append(k + window)
            far = (rows < k - window) | (rows >= k + window)
            rows, jump = rows[far], jump[far]
        return sorted(cuts)


class _Runs:
    """Finds runs of true flags in a series fed in pieces; a run is (first, last) by number of the flag.

    Attributes
    ----------
    open : int or None
        Number of the first flag of a run that is not finished; None if there is none.
    """

    def __init__(self) -> None:
        self._fed = 0
        self.open: int | None = None

    def feed(self, flags: Flags) -> list[tuple[int, int]]:
        # +1 where a run begins, -1 behind its last flag.
        edges = np.diff(flags.astype(np.int8), prepend=np.int8(self.open is not None))
        found = []
        for k in np.flatnonzero(edges).tolist():
            if edges[k] > 0:
                self.open = self._fed + k
            elif self.open is not None:
                found.append((self.open, self._fed + k - 1))
                self.open = None
        self._fed += len(flags)
        return found

    def end(self) -> list[tuple[int, int]]:
        """Return the run that is unfinished after the last piece, in a list that may be empty."""
        return [] if self.open is None else [(self.open, self._fed - 1)]


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
