"""What 1/f noise of the accelerometers leaves in the angle, after the filter averages, is within u."""

import numpy as np
import pytest

from adis_gonio.live.motion_model import AngleSmoother, Sensing
from live.smoothing_hands import GYRO_NOISE_DPS, NOISE_MG

RATE_HZ, COUNT = 50.0, 120
FLOOR_MG = 0.1
OCTAVES_HZ = 2.0 ** np.arange(1, -16, -1)


def angle_of(pulse_at: int | None, lag_s: float, floor_mg: float):
    """The last angle of a part that lies still without noise, with 0.01 mg more in one sample of Y."""
    sensing = Sensing(1 / RATE_HZ, NOISE_MG / 4, GYRO_NOISE_DPS / 4, drift_mg=floor_mg)
    smoother = AngleSmoother(sensing, lag_s=lag_s)
    accel = np.tile([1000.0, 0.0, 0.0], (COUNT, 1))
    if pulse_at is not None:
        accel[pulse_at, 1] -= 0.01
    smoother.feed(np.arange(COUNT) / RATE_HZ, accel, np.zeros((COUNT, 3)))
    return smoother.angle()


@pytest.mark.parametrize("lag_s", [0.0, 0.5])
def test_u_holds_every_octave_and_at_most_a_little_more(lag_s):
    told, quiet = (angle_of(None, lag_s, floor) for floor in (FLOOR_MG, 0.0))
    weight = np.array(
        [(angle_of(k, lag_s, FLOOR_MG).angle_deg - told.angle_deg) / 0.01 for k in range(COUNT)]
    )
    assert weight.sum() == pytest.approx(np.degrees(1e-3), rel=1e-3)
    apart_s = np.abs(np.subtract.outer(np.arange(COUNT), np.arange(COUNT))) / RATE_HZ
    octaves = [np.exp(-2 * np.pi * corner * apart_s) for corner in OCTAVES_HZ]
    exact = FLOOR_MG**2 / 2 * sum(float(weight @ octave @ weight) for octave in octaves)
    assert exact < told.u_deg**2 - quiet.u_deg**2 < 1.25 * exact
