"""The angle of a whole recording: the same model, with all samples on both sides of every time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.live.smoothing.gyros import GyroKnowledge
from adis_gonio.live.smoothing.increments import Sensing
from adis_gonio.live.smoothing.linear import backward
from adis_gonio.live.smoothing.motion import ANGLE, BEND
from adis_gonio.live.smoothing.smoother import AngleSmoother, Corrected


@dataclass(frozen=True)
class SmoothedTurn:
    """Angles of a recording.

    Attributes
    ----------
    time_s, angle_deg, u_deg : (m,) float
        As `SmoothedAngle` has them, one a step; angles are unwrapped.
    """

    time_s: Floats
    angle_deg: Floats
    u_deg: Floats


def smooth(
    sensing: Sensing,
    time_s: Floats,
    accel_mg: Floats,
    gyro_dps: Floats,
    gyros: GyroKnowledge | None = None,
    *,
    corrected: Corrected | None = None,
    bend: float = BEND,
) -> SmoothedTurn:
    """Smooth samples (n,), (n, 3) in mg, (n, 3) in °/s.

    The disturbance of every step is that of the second before it and the half second after.
    """
    smoother = AngleSmoother(sensing, gyros, lag_s=0.5, corrected=corrected, bend=bend, keeps=True)
    smoother.feed(time_s, accel_mg, gyro_dps)
    kept = smoother.finish()
    states = backward([one.passed for one in kept])
    variance = np.array([state.covariance[ANGLE, ANGLE] for state in states])
    drift = np.array([one.drift_deg for one in kept])
    return SmoothedTurn(
        np.array([one.time_s for one in kept]),
        np.array([state.mean[ANGLE] for state in states]),
        np.sqrt(np.maximum(variance, 0.0) + drift**2),
    )


__all__ = ["SmoothedTurn", "smooth"]
