"""Random processes whose values do not depend on the grouping of the requested times into calls."""

from __future__ import annotations

import numpy as np

from adis_gonio.base.arrays import Floats

_PAGE = 1024


class White:
    """White noise of several channels, drawn in order, one value for each update and channel."""

    def __init__(self, sigma: Floats, rng: np.random.Generator) -> None:
        self._sigma = np.asarray(sigma, np.float64)
        self._rng = rng

    def next(self, n: int) -> Floats:
        """Draw the noise of the next n updates, (n, channels)."""
        drawn = self._rng.standard_normal((n, len(self._sigma)))
        drawn *= self._sigma
        return drawn


class RateWalk:
    """Random walk of the three gyro biases, which starts from 0 at the first requested time.

    The walk is drawn on its own time grid and interpolated.

    Parameters
    ----------
    size : float
        Standard deviation of the walk after a second, in °/s.
    """

    _STEP_S = 1 / 16

    def __init__(self, size: float, rng: np.random.Generator) -> None:
        self._size = size
        self._rng = rng
        self._start_s: float | None = None
        self._grid = np.zeros((1, 3))

    def at(self, time_s: Floats) -> Floats:
        """Return the random walk (n, 3) in °/s at times (n,) in s.

        The times must increase from call to call.
        """
        if not self._size:
            return np.zeros((len(time_s), 3))
        if self._start_s is None:
            self._start_s = float(np.floor(time_s[0]))
        # Extend the grid as far as needed, then interpolate linearly.
        place = (time_s - self._start_s) / self._STEP_S
        while len(self._grid) < int(place[-1]) + 2:
            steps = self._size * np.sqrt(self._STEP_S) * self._rng.standard_normal((_PAGE, 3))
            self._grid = np.concatenate([self._grid, self._grid[-1] + np.cumsum(steps, axis=0)])
        index = place.astype(np.int64)
        weight = (place - index)[:, None]
        return np.asarray(self._grid[index] + weight * (self._grid[index + 1] - self._grid[index]))

    def past_values(self, time_s: Floats) -> Floats:
        """Return the random walk (m, 3) in °/s at the grid points nearest to earlier times (n,) in s.

        Each grid point appears once; before the first call of `at` there are none.
        """
        if self._start_s is None:
            return np.empty((0, 3))
        index = np.unique(np.rint((time_s - self._start_s) / self._STEP_S).astype(np.int64))
        return np.asarray(self._grid[index[(index >= 0) & (index < len(self._grid))]], np.float64)


class Flicker:
    """Noise with a 1/f spectrum, as a sum of first-order processes with corners an octave apart.

    A process of variance v at every octave has together the one-sided spectrum v / (f ln 2); the Allan
    deviation of h/f is sqrt(2 h ln 2) at all averaging times, hence v = floor² / 2. The values are drawn on
    their own time grid and interpolated, so they depend neither on the sample rate nor on the grouping of
    the times into calls.

    Parameters
    ----------
    floor : (channels,) float
        Allan deviation of each channel where it is flat (bias instability), in the unit of the noise.
    start_s : float
        Earliest time in s that may be asked for.
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
        start_s: float = 0.0,
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
        self._step_s = step_s
        self._origin_s = start_s
        self._state = rng.standard_normal((octaves, len(self._sigma)))
        self._grid = np.empty((0, len(self._sigma)))

    def at(self, time_s: Floats) -> Floats:
        """Return the flicker noise (n, channels) at times (n,) in s.

        The times must increase from call to call.
        """
        place = (time_s - self._origin_s) / self._step_s
        index = np.floor(place).astype(np.int64)
        while len(self._grid) < index[-1] + 2:
            self._grid = np.concatenate([self._grid, self._page()])
        weight = (place - index)[:, None]
        low: Floats = self._grid[index]
        high: Floats = self._grid[index + 1]
        result: Floats = low + weight * (high - low)
        return result

    def past_values(self, time_s: Floats) -> Floats:
        """Return the noise (m, channels) at the grid points nearest to earlier times (n,) in s.

        Each grid point appears once.
        """
        index = np.unique(np.rint((time_s - self._origin_s) / self._step_s).astype(np.int64))
        return np.asarray(self._grid[index[(index >= 0) & (index < len(self._grid))]], np.float64)

    def _page(self) -> Floats:
        drawn = self._rng.standard_normal((_PAGE, *self._state.shape)) * self._drive
        page = np.empty((_PAGE, len(self._sigma)))
        state = self._state
        for k in range(_PAGE):
            page[k] = state.sum(axis=0)
            state = self._memory * state + drawn[k]
        self._state = state
        return np.asarray(page * self._sigma, np.float64)
