"""What disturbs gravity: how much, how it hangs together in time, and single shocks.

The accelerometers, turned back by the gyros, would stand still if there were gravity alone. What they do
instead within the last second, both components together, is the disturbance: the sensor's white noise, an
autoregressive process of second order (tremor at 8 to 12 Hz, a table that rings, or just slow) and shocks.
The process is given by its autocovariances (Yule and Walker).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from adis_gonio.base.arrays import Floats

BACK_S, AHEAD_S = 1.0, 0.5
"""Span that shows the disturbance of a step; of what comes after it only what has come."""
LEAST_STEPS = 8
START_MG = 20.0
"""Level before the first steps have shown it (D): a part held in the hand."""
SHOCK = 16.0
"""A step whose square is so many times the span's is a shock, and counts by itself: one Gaussian step in
nine million."""
STATIONARY = 0.97
_MEDIAN = 2 * math.log(2)


@dataclass(frozen=True)
class Disturbance:
    """Of one step, on each component, in mg².

    Attributes
    ----------
    white_mg2 : float
        Of this step alone: sensor and shock.
    coloured_mg2 : float
        Variance of the autoregressive process.
    first, second : float
        Its coefficients.
    drive_mg2 : float
        Variance of what drives it.
    """

    white_mg2: float
    coloured_mg2: float = 0.0
    first: float = 0.0
    second: float = 0.0
    drive_mg2: float = 0.0


def disturbance_of(level: Floats, at: int, sensor_mg2: float) -> Disturbance:
    """Disturbance of a step by the steps around it.

    Parameters
    ----------
    level : (n,) complex
        What the accelerometers show in the plane, turned back by the gyros, in mg; equal steps.
    at : int
        The step's place among them.
    sensor_mg2 : float
        Variance of a step's mean by the sensor's own noise.
    """
    if len(level) < LEAST_STEPS:
        return coloured(sensor_mg2, START_MG**2, 0.5, 0.0)
    left = _without_course(level)
    squares = left.real**2 + left.imag**2
    middle = len(squares) // 2
    typical = max(float(np.partition(squares, middle)[middle]) / _MEDIAN, 0.5 * sensor_mg2)
    calm = squares <= 2 * SHOCK * typical
    shock = 0.0 if calm[at] else 0.5 * float(squares[at])
    left = np.where(calm, left, 0.0)
    count = int(calm.sum())
    free = 2 * max(count - 2, 1)
    zeroth = float(squares[calm].sum()) / free
    excess = zeroth - sensor_mg2
    if excess <= 2 * zeroth * math.sqrt(2 / free):
        return Disturbance(max(sensor_mg2, zeroth) + shock)
    first = float((left[1:] * left[:-1].conj()).sum().real) / free / excess
    second = float((left[2:] * left[:-2].conj()).sum().real) / free / excess
    return coloured(sensor_mg2 + shock, excess, first, second)


def coloured(white_mg2: float, variance_mg2: float, first: float, second: float) -> Disturbance:
    """Disturbance of a process given by its variance and two autocorrelations, made stationary."""
    r1 = min(max(first, -STATIONARY), STATIONARY)
    r2 = min(max(second, 2 * r1**2 - STATIONARY), STATIONARY)
    one = r1 * (1 - r2) / (1 - r1**2)
    two = (r2 - r1**2) / (1 - r1**2)
    drive = variance_mg2 * max(1 - one * r1 - two * r2, 0.0)
    return Disturbance(white_mg2, variance_mg2, one, two, drive)


def _without_course(level: Floats) -> Floats:
    """Without mean and slope: what a gyro's zero and slow changes make is not disturbance."""
    place, square = _places(len(level))
    centred = level - level.sum() / len(level)
    return np.asarray(centred - place * ((place @ centred) / square))


@lru_cache(maxsize=256)
def _places(count: int) -> tuple[Floats, float]:
    place = np.arange(count, dtype=np.float64) - (count - 1) / 2
    return place, float(place @ place)


__all__ = ["Disturbance", "coloured", "disturbance_of"]
