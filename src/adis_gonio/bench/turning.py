"""How far the part was turned, by the integral of its gyros from one dwell to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.record.blocks import Block, session_columns

SCALE_ERROR = 0.01
"""Relative error of a gyro's gain (an estimate, D: the sheets at hand have none)."""
INSTABILITY_DPS = 0.015
"""What a gyro's bias does between dwells (the simulator's default, D)."""
G_SENSITIVITY_DPS = 0.05 * math.sqrt(2)
"""Gyro g-sensitivity, 0.05 °/s/g (CHIP, B), times the change of gravity's part at a quarter turn."""
GYRO_NOISE_DPS = 0.6
"""Of a sample (CHIP, B); averaging over the turn lowers it."""


@dataclass(frozen=True)
class GyroIntegral:
    """Integral of the three gyros.

    Attributes
    ----------
    angle_deg : (3,) float
        About x, y, z of the part, right-handed about the drawn axes.
    u_deg : float
        Standard uncertainty of each.
    zero_u_deg : float
        The part of it that noise and the zero have, without the gain.
    """

    angle_deg: Floats
    u_deg: float
    zero_u_deg: float


class Turning:
    """Follows the part from one dwell to the next.

    Parameters
    ----------
    longest_gap_s : float
        Time without samples after which nobody knows how the part was turned.
    """

    def __init__(self, longest_gap_s: float) -> None:
        self._longest_gap_s = longest_gap_s
        self._bias: Floats | None = None
        self._last_s = 0.0
        self._last = np.zeros(3)
        self._angle = np.zeros(3)
        self._travel = 0.0
        self._length_s = 0.0
        self._period_s = 0.0
        self._broken = False

    def rest(self, dwell: Block) -> None:
        """A dwell has ended: its mean is the gyros' zero, and the next turn begins."""
        rates = _rates(dwell)
        self._broken = rates is None or not len(dwell)
        if rates is None or not len(dwell):
            return
        self._bias = rates.mean(axis=0)
        self._last_s, self._last = float(dwell.time_s[-1]), np.zeros(3)
        self._angle, self._travel, self._length_s = np.zeros(3), 0.0, 0.0

    def see(self, block: Block) -> None:
        """Follow the part through the next samples; those that a dwell holds already are passed over."""
        rates = _rates(block)
        if self._bias is None or rates is None or not len(block):
            return
        new = block.time_s > self._last_s
        if not new.any():
            return
        time_s = np.concatenate([[self._last_s], block.time_s[new]])
        turning = np.concatenate([[self._last], rates[new] - self._bias])
        steps_s = np.diff(time_s)
        self._broken |= bool(steps_s.max() > self._longest_gap_s)
        means = (turning[1:] + turning[:-1]) / 2
        self._angle = self._angle + (means * steps_s[:, None]).sum(axis=0)
        # Blocks of samples, so that noise does not add up as travel.
        self._travel += float(np.abs((means * steps_s[:, None]).sum(axis=0)).max())
        self._length_s += float(time_s[-1] - time_s[0])
        self._period_s = float(np.median(steps_s))
        self._last_s, self._last = float(time_s[-1]), turning[-1]

    def turn(self) -> GyroIntegral | None:
        """The turn so far; None where it was not watched throughout."""
        if self._bias is None or self._broken or not self._length_s:
            return None
        wander = math.hypot(INSTABILITY_DPS, G_SENSITIVITY_DPS) * self._length_s
        noise = GYRO_NOISE_DPS * math.sqrt(self._period_s * self._length_s)
        zero = math.hypot(wander, noise)
        return GyroIntegral(self._angle, math.hypot(zero, SCALE_ERROR * self._travel), zero)


def _rates(block: Block) -> Floats | None:
    columns = session_columns(block)
    if not all(name in columns for name in ("gx", "gy", "gz")):
        return None
    return np.column_stack([columns[name] for name in ("gx", "gy", "gz")])


__all__ = ["GyroIntegral", "Turning"]
