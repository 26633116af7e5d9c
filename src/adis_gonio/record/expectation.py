"""Expected angle of gravity at a position, and the largest plausible deviation of a good sensor.

The angle of a reading is φ = atan2(U_y, U_x) = α − θ + the effects of gains, misalignment and biases. These
are unknown when a session begins, but the sensor's data sheet limits each of them. They are estimated by a
linear Gaussian model, dwell by dwell. At the first positions the limits of the data sheet determine the
allowed deviation; later the dwells have shown the gains and biases, and the fixture determines it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_radians
from adis_gonio.base.uncertainty import POSITION_QUESTIONED
from adis_gonio.record.stillness import SHIFT_MG

K = NormalDist().inv_cdf(1 - POSITION_QUESTIONED / 2)

GAIN_LIMIT = 0.02
"""Sensitivity ±2 % (CHIP, B: the sibling's sheet); as a rectangular distribution."""
ANGLE_LIMIT_DEG = 0.25 + 0.5
"""Non-orthogonality ±0.25° and axis to frame ±0.5° (CHIP, B)."""
UNMODELLED_MG = SHIFT_MG / math.sqrt(3)
"""Standard uncertainty of a reading from effects outside this model: the shift that the watch allows."""
UNSTATED_FIXTURE_DEG = 0.5
"""Assumed uncertainty of a fixture without a stated one: half a division of a scale in degrees."""
_RECTANGULAR = 1 / math.sqrt(3)


@dataclass(frozen=True)
class PriorKnowledge:
    """Uncertainties of a sensor and its fixture that are known before the first measurement.

    Attributes
    ----------
    bias_mg : float
        Standard deviation of a bias.
    reading_mg : float
        Standard uncertainty of the mean of a window.
    fixture_deg : float or None
        Standard uncertainty of a stage angle; None if it is not stated.
    gravity_mg : float
        Local gravity.
    """

    bias_mg: float
    reading_mg: float
    fixture_deg: float | None
    gravity_mg: float = 1000.0


@dataclass(frozen=True)
class Off:
    """Deviation of a reading from the expected stage angle, with its limit.

    Attributes
    ----------
    off_deg : float
        Angle by gravity minus the requested angle, within ±180°, in the sense of the stage.
    limit_deg : float
        Largest deviation of a good sensor in this fixture.
    """

    off_deg: float
    limit_deg: float

    @property
    def allowed(self) -> bool:
        """True if the deviation is not larger than the limit."""
        return abs(self.off_deg) <= self.limit_deg


class Expectation:
    """Model of a turn in the plane, updated dwell by dwell: start angle, two gains, Δφ, two biases.

    Parameters
    ----------
    spread : PriorKnowledge
    sense : {1, -1}
        -1 if the stage counts against the convention.
    """

    def __init__(self, spread: PriorKnowledge, sense: int = 1) -> None:
        self.sense = sense
        gravity = spread.gravity_mg
        gain, bias = GAIN_LIMIT * _RECTANGULAR, spread.bias_mg / gravity
        skew = math.radians(ANGLE_LIMIT_DEG) * _RECTANGULAR
        fixture = UNSTATED_FIXTURE_DEG if spread.fixture_deg is None else spread.fixture_deg
        self._reading = math.hypot(spread.reading_mg, UNMODELLED_MG) / gravity
        self._angle = math.hypot(self._reading, math.radians(fixture))
        self._information = np.diag([0.0, gain**-2, gain**-2, skew**-2, bias**-2, bias**-2])
        self._weighted = np.zeros(6)
        self._gravity = gravity
        self._start_rad: float | None = None

    @property
    def begun(self) -> bool:
        """True after the first dwell, from which the start angle is known."""
        return self._start_rad is not None

    def add(self, accel_mg: Floats, angle_deg: float) -> None:
        """Update the model by a dwell: its mean reading (x, y and perhaps z) in mg, at a stage angle."""
        phi, log_norm = self._polar(accel_mg)
        seen = phi + self.sense * math.radians(angle_deg)
        if self._start_rad is None:
            self._start_rad = seen
        # Two observations for each dwell: the angle, and the logarithm of the length of the reading.
        rest = wrap_radians(seen - self._start_rad)
        for row, value, u in (
            (_angle_row(phi), rest, self._angle),
            (_norm_row(phi), log_norm, self._reading),
        ):
            self._information += np.outer(row, row) / u**2
            self._weighted += row * value / u**2

    def off(self, accel_mg: Floats, angle_deg: float) -> Off:
        """Deviation of a reading in mg from the requested stage angle, with its limit.

        The limit is infinite before the first dwell.
        """
        if self._start_rad is None:
            return Off(0.0, math.inf)
        phi, _ = self._polar(accel_mg)
        covariance = np.linalg.inv(self._information)
        mean = covariance @ self._weighted
        expected = self._start_rad + mean[0] - self.sense * math.radians(angle_deg)
        # Linear prediction of the angle; its variance comes from the parameters and from the reading.
        row = _angle_row(expected)
        residual = wrap_radians(phi - expected - float(row[1:] @ mean[1:]))
        limit = K * math.sqrt(float(row @ covariance @ row) + self._angle**2)
        return Off(-self.sense * math.degrees(residual), math.degrees(limit))

    def angle_deg(self, accel_mg: Floats) -> float:
        """Stage angle in degrees, within ±180°, computed from a reading and the parameters so far."""
        phi, _ = self._polar(accel_mg)
        if self._start_rad is None:
            return -self.sense * math.degrees(phi)
        mean = np.linalg.solve(self._information, self._weighted)
        rest = self._start_rad + float(_angle_row(phi) @ mean)
        return self.sense * math.degrees(wrap_radians(rest - phi))

    def _polar(self, accel_mg: Floats) -> tuple[float, float]:
        x, y = float(accel_mg[0]), float(accel_mg[1])
        return math.atan2(y, x), math.log(max(math.hypot(x, y), 1.0) / self._gravity)


def turned_deg(before_mg: Floats, now_mg: Floats, sense: int = 1) -> float:
    """Angle in degrees, within ±180°, by which the stage turned between two readings in mg."""
    before = math.atan2(float(before_mg[1]), float(before_mg[0]))
    now = math.atan2(float(now_mg[1]), float(now_mg[0]))
    return -sense * math.degrees(wrap_radians(now - before))


def _angle_row(psi: float) -> Floats:
    """Derivatives (6,) of the angle that a reading at angle ψ shows, by the model's parameters.

    They are the start angle, gains of X and Y, Δφ, and biases of X and Y in units of G.
    """
    c, s = math.cos(psi), math.sin(psi)
    return np.array([1.0, -s * c, s * c, c * c, -s, c])


def _norm_row(psi: float) -> Floats:
    """Derivatives (6,) of the log length ln |U| of a reading, by the parameters of `_angle_row`."""
    c, s = math.cos(psi), math.sin(psi)
    return np.array([0.0, c * c, s * s, s * c, c, s])
