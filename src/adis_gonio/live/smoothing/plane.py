"""Whether the part turns in the plane of X and Y, as the model of the angle supposes."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from adis_gonio.base.arrays import Floats

SPAN_S = 1.0
REST_DPS = 1.0
"""A gyro that varies by less within the span, in steps, is at rest as far as its zero goes."""
REST_MG = 10.0
ACROSS_DPS = 4.0
"""A turn about X and Y above this, on the average of a second, is out of the plane…"""
TILT = 0.1
"""…where it is more than this part of the turn about Z: a bearing's wobble, axes that are not square."""
TILT = 0.1
"""Gravity that goes out of the plane by this part of itself within the span."""


class PlaneWatch:
    """Follows the two gyros across the axis, and gravity along it.

    Their zeros are learnt at rest; before the first rest nothing is said of them.
    """

    def __init__(self, length_s: float) -> None:
        self._rows: deque[Floats] = deque(maxlen=max(4, round(SPAN_S / length_s)))
        self._zero: Floats | None = None

    def see(self, rate_dps: Floats, accel_mg: Floats) -> float:
        """Take a step; return how much of the angle's rate (°/s) the planar model neglects in it."""
        self._rows.append(np.concatenate([rate_dps, accel_mg]))
        if len(self._rows) == self._rows.maxlen:
            self._learn(np.array(self._rows))
        if self._zero is None:
            return 0.0
        x, y, z = accel_mg
        about = rate_dps - self._zero
        square = x * x + y * y
        return float(abs(z * (x * about[0] + y * about[1])) / square) if square > 1.0 else 0.0

    def forget(self) -> None:
        """A gap lies between the last step and the next."""
        self._rows.clear()

    @property
    def left(self) -> bool:
        """True where the part was turned out of the plane within the span."""
        if len(self._rows) < 4:
            return False
        rows = np.array(self._rows)
        lengths = np.linalg.norm(rows[:, 3:], axis=1)
        out = rows[:, 5] / np.maximum(lengths, 1.0)
        if abs(float(out[-4:].mean() - out[:4].mean())) > TILT:
            return True
        if self._zero is None:
            return False
        about = np.abs(rows[:, :3].mean(axis=0) - self._zero)
        return math.hypot(about[0], about[1]) > ACROSS_DPS + TILT * float(about[2])

    def _learn(self, rows: Floats) -> None:
        spread = rows.std(axis=0)
        if spread[:3].max() > REST_DPS or spread[3:].max() > REST_MG:
            return
        mean = rows[:, :3].mean(axis=0)
        if self._zero is None:
            self._zero = mean
        self._zero = self._zero + (mean - self._zero) / len(rows)


__all__ = ["PlaneWatch"]
