"""Noise of samples that a real part has, and the covariance of the dwell means, which the oracle knows.

White noise behind the chip's filter (two boxcars of `taps` samples), flicker as a sum of first-order
processes with time constants a decade apart, and the converter's step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .circumstances import Floats

FLICKER_TAU_S = 10.0 ** np.arange(-2, 5)
"""Time constants of the processes that make up flicker noise; each has the same variance."""


@dataclass
class Noise:
    """Noise of one axis.

    Attributes
    ----------
    white_mg : float
        Standard deviation of a sample before the filter.
    taps : int
        Length N of each of the filter's two boxcars; 1 is no filter.
    flicker_mg : float
        Standard deviation a decade of time constants.
    step_mg : float
        The converter's step; 0 is none.
    reading_u_mg : float
        Of sessions that hold readings only: their standard uncertainty; else 0.
    """

    white_mg: float
    taps: int
    flicker_mg: float
    step_mg: float
    reading_u_mg: float = 0.0

    @property
    def kernel(self) -> Floats:
        """Weights of the filter, (2·taps − 1,), with sum 1."""
        box = np.full(self.taps, 1.0 / self.taps)
        return np.convolve(box, box)

    def sample_covariance(self, m: int) -> Floats:
        """Covariance of m samples of one dwell but for the flicker, (m, m) in mg²."""
        auto = np.correlate(self.kernel, self.kernel, "full")[len(self.kernel) - 1 :]
        row = np.zeros(m)
        row[: min(m, len(auto))] = auto[:m]
        index = np.arange(m)
        covariance = self.white_mg**2 * row[np.abs(index[:, None] - index)]
        return covariance + np.eye(m) * self.step_mg**2 / 12

    def reading_covariance(self, start_s: Floats, m: int, rate_hz: float) -> Floats:
        """Covariance of the means of dwells of m samples that begin at start_s, (n, n) in mg²."""
        n = len(start_s)
        if self.reading_u_mg:
            return np.eye(n) * self.reading_u_mg**2
        out = np.eye(n) * self.sample_covariance(m).sum() / m**2
        t = np.arange(m) / rate_hz
        gaps = np.abs(start_s[:, None] - start_s) - t[-1]
        for tau in FLICKER_TAU_S:
            fade = np.exp(-t / tau).mean()
            between = fade**2 * np.exp(-np.maximum(gaps, 0) / tau)
            inside = np.exp(-np.abs(t[:, None] - t) / tau).mean()
            np.fill_diagonal(between, inside)
            out += self.flicker_mg**2 * between
        return out

    def samples(self, start_s: Floats, m: int, rate_hz: float, rng: np.random.Generator) -> Floats:
        """Noise of m samples in each dwell without the converter's step, (n, m) in mg."""
        n = len(start_s)
        if self.reading_u_mg:
            return rng.normal(0, self.reading_u_mg, (n, 1))
        raw = rng.normal(0, self.white_mg, (n, m + len(self.kernel) - 1))
        out = np.array([np.convolve(row, self.kernel, "valid") for row in raw])
        gaps = np.diff(start_s) - (m - 1) / rate_hz
        inside = np.exp(-1 / (rate_hz * FLICKER_TAU_S))
        fresh = np.sqrt(1 - inside**2)
        # x_j = r^j x_0 + Σ_{i<j} r^(j−1−i) kick_i, of each process at once.
        steps = np.arange(m + 1)
        ago = steps[:, None] - 1 - np.arange(m)
        sums = np.where(ago >= 0, inside[:, None, None] ** np.maximum(ago, 0), 0.0) * fresh[:, None, None]
        fade = inside[:, None] ** steps
        state = rng.normal(size=len(FLICKER_TAU_S))
        for k in range(n):
            if k:
                keep = np.exp(-gaps[k - 1] / FLICKER_TAU_S)
                state = keep * state + np.sqrt(1 - keep**2) * rng.normal(size=len(state))
            kicks = rng.normal(size=(m, len(state)))
            course = fade * state[:, None] + (sums @ kicks.T[:, :, None])[:, :, 0]
            out[k] += self.flicker_mg * course[:, :-1].sum(axis=0)
            state = course[:, -1]
        return out
