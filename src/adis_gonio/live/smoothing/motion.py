"""The part's turn in the plane as a linear model: what moves, what is not known, what gravity shows.

The state: angle (deg), zero rate of the gyro (°/s), relative error of its gain, its sensitivity to
acceleration along X and Y (°/s/g), where the part is from the stage's axis (mm, X and Y), and the
disturbance of gravity (mg across it; twice, now and a step ago: an autoregressive process of second order),
and the fast octaves of the accelerometers' 1/f noise across gravity (mg; `drift`).

The gyro is an input, known but for its errors, which enter with measured factors, so that all stays linear.
The gain's error walks as the part turns: accelerometers that are not calibrated, or not perfectly, bend
the scale of the angle by what gravity shows here and there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.live.smoothing import drift
from adis_gonio.live.smoothing.disturbance import START_MG, Disturbance
from adis_gonio.live.smoothing.gyros import TURN_ON_DPS, GyroKnowledge
from adis_gonio.live.smoothing.increments import Increment, Sensing
from adis_gonio.live.smoothing.linear import StateEstimate, TimeStep
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

ANGLE, ZERO, SCALE, G_X, G_Y, LEVER_X, LEVER_Y, NOW, BEFORE = range(9)
DRIFT = slice(9, 9 + drift.COUNT)
SIZE = 9 + drift.COUNT
LEVER_MM = 50.0
"""Spread of the part's distance from the axis (D)."""
BEND = 0.012
"""Spread of the raw angle's slope by bias, gains and Δφ of accelerometers that nobody has calibrated: bias
10 mg, gains ±2 %, ±0.25° (CHIP, B and D)."""
OPEN_DEG = 90.0
"""Standard deviation of an angle of which nothing is known."""
LEAST_MG = 50.0
"""Gravity shorter than this across the axis shows no angle."""
ACROSS_S = 0.5
"""A turn out of the plane keeps its way so long (D)."""
_MG_PER_MM = 1.0 / STANDARD_GRAVITY_MPS2


@dataclass(frozen=True)
class Turned:
    """A step as the model takes it, corrected by what is calibrated.

    Attributes
    ----------
    increment : Increment
    turn_deg : float
        About Z.
    gravity : complex
        x − i y of gravity in the plane, in mg: its phase is the angle.
    force_g : (2,) float
        What X and Y read on the way, in g.
    rate_dps, spin_rad_s2 : float
        Rate of turn, and its change.
    across_dps : float
        What the planar model neglects of the angle's rate: gravity out of the plane times turns about X, Y.
    lost : bool
        Nobody watched the part since the step before for so long that its angle is open; it may have been
        switched off.
    """

    increment: Increment
    turn_deg: float
    gravity: complex
    force_g: Floats
    rate_dps: float
    spin_rad_s2: float
    across_dps: float
    lost: bool = False

    @property
    def gravity_deg(self) -> float:
        """Angle by gravity alone."""
        return math.degrees(math.atan2(self.gravity.imag, self.gravity.real))

    @property
    def lever_mg(self) -> tuple[complex, complex]:
        """What a millimetre along X and Y adds to `gravity`."""
        spin = math.radians(self.rate_dps)
        square = spin * spin * _MG_PER_MM
        change = self.spin_rad_s2 * _MG_PER_MM
        return complex(square, change), complex(change, -square)


class MotionModel:
    """Makes steps of the linear model.

    Parameters
    ----------
    sensing : Sensing
    gyros : GyroKnowledge
    bend : float
        How much the slope of gravity's angle may be off, as a standard deviation.
    """

    def __init__(self, sensing: Sensing, gyros: GyroKnowledge, bend: float = BEND) -> None:
        self._sensing = sensing
        self._gyros = gyros
        self._bend = bend
        self._drift_mg2 = drift.process_mg2(sensing.drift_mg)

    def begin(self, angle_deg: float) -> StateEstimate:
        """What is known before the first step: nothing of the angle."""
        gyros = self._gyros
        u = np.array([
            OPEN_DEG, gyros.zero_dps, math.hypot(gyros.scale, self._bend), gyros.g_dps_per_g,
            gyros.g_dps_per_g, LEVER_MM, LEVER_MM, START_MG, START_MG,
            *[math.sqrt(self._drift_mg2)] * drift.COUNT,
        ])  # fmt: skip
        mean = np.zeros(SIZE)
        mean[ANGLE] = angle_deg
        return StateEstimate(mean, np.diag(u**2))

    def step(self, turned: Turned, disturbance: Disturbance, before: StateEstimate) -> TimeStep:
        """The model of a step; its observation is that turn of gravity which is next to the prediction."""
        length_s = turned.increment.length_s
        f = np.eye(SIZE)
        seen_deg = turned.gravity_deg
        f[ANGLE, ZERO] = -length_s
        f[ANGLE, SCALE] = -turned.turn_deg
        f[ANGLE, G_X], f[ANGLE, G_Y] = -length_s * turned.force_g
        f[NOW, NOW], f[NOW, BEFORE] = disturbance.first, disturbance.second
        f[BEFORE, NOW], f[BEFORE, BEFORE] = 1.0, 0.0
        shift = np.zeros(SIZE)
        shift[ANGLE] = turned.turn_deg
        process = np.zeros((SIZE, SIZE))
        process[ANGLE, ANGLE] = (
            self._sensing.angle_walk_deg2_per_s * length_s
            + turned.increment.unseen_deg2
            + turned.across_dps**2 * length_s * ACROSS_S
        )
        process[ZERO, ZERO] = self._gyros.walk_dps_per_rt_s**2 * length_s
        process[SCALE, SCALE] = 2 * self._bend**2 * abs(math.radians(turned.turn_deg))
        process[NOW, NOW] = disturbance.drive_mg2
        kept = drift.memory(length_s, turned.turn_deg)
        f[DRIFT, DRIFT] = np.diag(kept)
        process[DRIFT, DRIFT] = np.diag(self._drift_mg2 * (1 - kept**2))
        if turned.lost:
            f[ANGLE, :] = f[NOW, :] = f[BEFORE, :] = 0.0
            shift[ANGLE], process[ANGLE, ANGLE] = seen_deg, OPEN_DEG**2
            process[NOW, NOW] = process[BEFORE, BEFORE] = disturbance.coloured_mg2
            process[ZERO, ZERO] += TURN_ON_DPS**2
        length_mg = abs(turned.gravity)
        if length_mg < LEAST_MG:
            return TimeStep(f, shift, process, np.zeros(SIZE), None, math.inf)
        per_mg = math.degrees(1.0 / length_mg)
        along = turned.gravity / length_mg
        design = np.zeros(SIZE)
        design[ANGLE] = 1.0
        for k, lever in zip((LEVER_X, LEVER_Y), turned.lever_mg, strict=True):
            design[k] = per_mg * (lever * along.conjugate()).imag
        design[NOW] = design[DRIFT] = per_mg
        predicted = float(f[ANGLE] @ before.mean) + shift[ANGLE]
        observed = predicted + wrap_degrees(seen_deg - predicted)
        return TimeStep(f, shift, process, design, observed, per_mg**2 * disturbance.white_mg2)


__all__ = ["MotionModel", "Turned"]
