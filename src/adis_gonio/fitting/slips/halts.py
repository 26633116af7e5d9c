"""Where the part came to rest on its way: a stage that arrives, and then a part that slips, shows twice.

What lasts from a position on may have happened during the move before it, or after the stage had arrived.
In the second case the part rested where it was declared and then turned on by just the error. Of an error
of the first or of the last position this is the only thing that tells a slip from a wrong entry: the
angles themselves are the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.gyros.integral import Path, Sampling

SLOW_DPS = 3.0
"""Mean rate of a tenth of a second below which a hand rests: its tremor is a degree per second or two."""
LEAST_S = 0.15
"""Shortest rest that is one; a hand that changes its grip, or looks at a mark, takes longer."""
AFTERWARDS = 0.5
"""Prior share of slips that come after the stage has arrived."""
NEAR_MARK, ASTRAY = 0.05, 0.1
"""Of the length of a move: where hands rest to correct themselves; how far beyond it they may be."""
ORDINARY = (0.5, 0.45, 0.05)
"""Share of the rests of any move that are near its end, anywhere on its way, anywhere at all."""
GAIN, LEAST_RAD = 0.02, math.radians(0.1)
"""Uncertainty of the rest of a turn by a gyro, of its size and at least."""


@dataclass(frozen=True)
class Halts:
    """Rests on the way of one turn.

    Attributes
    ----------
    left_rad : (m,) float
        How far the part was still turned after each, in the direction of declared angles.
    turned_rad : float
        The whole turn.
    """

    left_rad: Floats
    turned_rad: float

    def log_odds(self, error_rad: Floats, u_rad: Floats) -> Floats:
        """Ln (g,) of how much more probable these rests are if the part slipped in this turn than if not.

        Parameters
        ----------
        error_rad, u_rad : (g,) float
            By how much it slipped, and the standard uncertainty of that.
        """
        m = len(self.left_rad)
        if not m:
            return np.full(len(error_rad), math.log(1 - AFTERWARDS))
        spread = np.sqrt(2 * u_rad**2 + LEAST_RAD**2 + (GAIN * error_rad) ** 2)
        off = (self.left_rad[:, None] - error_rad) / spread
        arrived = np.exp(-0.5 * off**2) / (spread * math.sqrt(2 * math.pi))
        ratio = (arrived / self._ordinary()[:, None]).sum(axis=0) / m
        return np.asarray(np.log(1 - AFTERWARDS + AFTERWARDS * ratio))

    def _ordinary(self) -> Floats:
        """Density (m,) of rests of a move at which nothing slips."""
        size = max(abs(self.turned_rad), LEAST_RAD)
        left = self.left_rad * np.sign(self.turned_rad) if self.turned_rad else self.left_rad
        sd = math.hypot(NEAR_MARK * size, LEAST_RAD)
        near = np.exp(-0.5 * (left / sd) ** 2) / (sd * math.sqrt(2 * math.pi))
        on_its_way = (left > -ASTRAY * size) & (left < (1 + ASTRAY) * size)
        even = on_its_way / ((1 + 2 * ASTRAY) * size)
        a, b, c = ORDINARY
        return np.asarray(a * near + b * even + c / (2 * math.pi))


def halts_of(path: Path, sampling: Sampling) -> Halts:
    """Rests between the first and the last movement of a path, about z."""
    rate = path.rate_dps[:, 2] - path.zero_dps[:, 2].mean()
    steps = np.diff(path.time_s, append=path.time_s[-1])
    means = (rate + np.append(rate[1:], rate[-1])) / 2
    turned = np.concatenate([[0.0], np.cumsum(means * steps)])[: len(rate)]
    width = min(sampling.window, len(rate))
    slow = np.abs(np.convolve(rate, np.full(width, 1 / width), mode="same")) < SLOW_DPS
    moving = np.flatnonzero(~slow)
    if not moving.size:
        return Halts(np.zeros(0), math.radians(float(turned[-1])))
    least = max(1, round(LEAST_S / sampling.period_s))
    inner = slow[moving[0] : moving[-1] + 1]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inner, [False]]).astype(np.int8)))
    begins, ends = edges[::2], edges[1::2]
    # Just before it moves on: what a hand corrects after it has arrived is slow as well.
    at = moving[0] + ends[ends - begins >= least] - (least + 1) // 2
    return Halts(np.radians(turned[-1] - turned[at]), math.radians(float(turned[-1])))
