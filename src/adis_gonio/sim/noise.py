"""Random processes that do not depend on the grouping of the requested times into calls."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from adis_gonio.base.arrays import Floats

_PAGE = 1024


class GridProcess(ABC):
    """Random process of several channels on its own time grid, interpolated linearly.

    The values therefore depend neither on the sample rate nor on the grouping of the times into calls.

    Parameters
    ----------
    grid : (m, channels) float
        Given values at the first m points of the grid; all later values are drawn at random. m may be 0.
    step_s : float
        Step of the grid in s.
    start_s : float or None
        Time of the first point in s; None for the first time that is asked for, rounded down.
    """

    def __init__(self, grid: Floats, step_s: float, start_s: float | None = None) -> None:
        self._grid, self._step_s, self._start_s = grid, step_s, start_s

    @abstractmethod
    def _page(self) -> Floats:
        """Draw the next `_PAGE` points of the grid, (_PAGE, channels)."""

    def at(self, time_s: Floats) -> Floats:
        """Return the values (n, channels) at times (n,) in s, which increase from call to call."""
        if self._start_s is None:
            self._start_s = float(np.floor(time_s[0]))
        # Extend the grid as far as needed, then interpolate linearly.
        place = (time_s - self._start_s) / self._step_s
        index = np.floor(place).astype(np.int64)
        while len(self._grid) < index[-1] + 2:
            self._grid = np.concatenate([self._grid, self._page()])
        low, high = self._grid[index], self._grid[index + 1]
        return np.asarray(low + (place - index)[:, None] * (high - low))

    def past_values(self, time_s: Floats) -> Floats:
        """Return the values (m, channels) at the grid points nearest to times (n,) in s.

        Each grid point appears once. Points that `at` has not reached are left out, so that m is 0 before
        the first call of `at`.
        """
        if self._start_s is None:
            return self._grid[:0]
        index = np.unique(np.rint((time_s - self._start_s) / self._step_s).astype(np.int64))
        return np.asarray(self._grid[index[(index >= 0) & (index < len(self._grid))]], np.float64)


class RateWalk(GridProcess):
    """Random walk of the three gyro biases, (n, 3) in °/s, which starts from 0 at the first requested time.

    Parameters
    ----------
    size : float
        Standard deviation of the walk after a second, in °/s.
    """

    def __init__(self, size: float, rng: np.random.Generator) -> None:
        self._size, self._rng = size, rng
        super().__init__(np.zeros((1, 3)), 1 / 16)

    def _page(self) -> Floats:
        steps = self._size * np.sqrt(self._step_s) * self._rng.standard_normal((_PAGE, 3))
        return np.asarray(self._grid[-1] + np.cumsum(steps, axis=0))


class Flicker(GridProcess):
    """Noise with a 1/f spectrum, as a sum of first-order processes with corners an octave apart.

    Processes with the variance v, one in each octave of the frequency f, have together the one-sided
    spectrum v / (f ln 2). The Allan deviation of a spectrum h/f is sqrt(2 h ln 2) at all averaging times,
    hence v = floor² / 2.

    Parameters
    ----------
    floor : (channels,) float
        Allan deviation of each channel at averaging times at which it is constant (bias instability), in
        the unit of the noise.
    start_s : float or None
        Earliest time in s that may be asked for; None for the first requested time, rounded down.
    step_s : float
        Step of the grid in s; the flicker ends above a tenth of the grid's rate.
    lowest_hz : float
        Lowest corner frequency in Hz; below it the spectrum is flat.
    """

    def __init__(
        self,
        floor: Floats,
        rng: np.random.Generator,
        *,
        start_s: float | None = 0.0,
        step_s: float = 1 / 16,
        lowest_hz: float = 2.0**-15,
    ) -> None:
        octaves = int(np.floor(np.log2(0.15 / (step_s * lowest_hz)))) + 1
        # One first-order process for each octave, all with variance floor² / 2.
        corners = lowest_hz * 2.0 ** np.arange(octaves)
        self._memory = np.exp(-2 * np.pi * corners * step_s)[:, None]
        self._sigma = np.asarray(floor, np.float64) / np.sqrt(2)
        # The drive keeps the variance of each process at 1.
        self._drive = np.sqrt(1 - self._memory**2)
        self._rng = rng
        self._state = rng.standard_normal((octaves, len(self._sigma)))
        super().__init__(np.empty((0, len(self._sigma))), step_s, start_s)

    def _page(self) -> Floats:
        drawn = self._rng.standard_normal((_PAGE, *self._state.shape)) * self._drive
        page = np.empty((_PAGE, len(self._sigma)))
        state = self._state
        for k in range(_PAGE):
            page[k] = state.sum(axis=0)
            state = self._memory * state + drawn[k]
        self._state = state
        return np.asarray(page * self._sigma, np.float64)
