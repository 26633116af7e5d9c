"""The turn of the sensor in the plane as a linear model: state, unknown errors, disturbance of gravity.

The state has the angle (deg), the zero rate of the gyro (°/s), the relative error of its gain, its
sensitivity to acceleration along X and Y (°/s/g), the distance of the sensor from the stage's axis (mm, X
and Y), the disturbance of the reading perpendicular to gravity (mg, in this time step and the one before:
an autoregressive process of second order), and the fast octaves of the accelerometers' 1/f noise in this
direction (mg).

The gyro is a known input except for its errors. These enter with measured factors, so the model stays
linear. The error of the gain is a random walk in the angle, because imperfectly calibrated accelerometers
distort the scale of the angle differently at each angle.

**Disturbance.** With gravity alone, the accelerometers turned back by the gyros would be constant. Their
changes within the last second, both components together, are the disturbance: the sensor's white noise,
an autoregressive process of second order (tremor at 8 to 12 Hz, a table that rings, or slow motion) and
shocks. Its autocovariances give the process (Yule and Walker).

**1/f noise of the accelerometers.** Each octave has half the square of the Allan floor. The fastest octaves
change while the filter averages. They are states, so that they are averaged correctly and their remainder
is in u. One state has two octaves: processes with corners a factor of four apart add up to 1/f within a
few per cent. Slower octaves are constant over a few seconds and are added to u.

**Filter and smoother.** One scalar observation a step:

    x(k) = F x(k−1) + s + w,  w ~ N(0, Q);    y(k) = h·x(k) + v,  v ~ N(0, r)

The backward pass follows Rauch, Tung and Striebel in the form of Bierman ("Fixed interval smoothing with
discrete measurements", 1973). It carries the information of later observations as an adjoint vector and
matrix, and needs no inverse, so constant parts of the state, or parts without variance, are no special
case.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.live.gyro_steps import TURN_ON_DPS, GyroKnowledge, Increment, Sensing
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

BACK_S, AHEAD_S = 1.0, 0.5
"""The disturbance of a step is estimated from the steps in this span before and after it; from fewer if
later steps have not arrived."""
LEAST_STEPS = 8
START_MG = 20.0
"""Assumed disturbance in mg until `LEAST_STEPS` steps are known (D): a sensor held in the hand."""
SHOCK = 16.0
"""A step is a shock if its squared deviation is this many times the typical square in the span, which
happens by chance once in nine million Gaussian steps. A shock raises the variance of its own step only."""
STATIONARY = 0.97
_MEDIAN = 2 * math.log(2)


@dataclass(frozen=True)
class Disturbance:
    """Disturbance of gravity in one time step: white noise and an autoregressive process.

    Attributes
    ----------
    white_mg2 : float
        Variance of the white noise of the sensor in this step, plus the square of a shock.
    coloured_mg2 : float
        Variance of the autoregressive process.
    first, second : float
        Coefficients of the process for the steps one and two before.
    drive_mg2 : float
        Variance of the innovations of the process.
    """

    white_mg2: float
    coloured_mg2: float = 0.0
    first: float = 0.0
    second: float = 0.0
    drive_mg2: float = 0.0


def disturbance_of(level: Floats, at: int, sensor_mg2: float) -> Disturbance:
    """Estimate the disturbance of gravity in a time step from the steps around it.

    Parameters
    ----------
    level : (n,) complex
        Readings of the accelerometers in the plane, turned back by the gyros, in mg; equal steps.
    at : int
        Index of the step.
    sensor_mg2 : float
        Variance of a step's mean by the sensor's own noise.
    """
    if len(level) < LEAST_STEPS:
        return coloured(sensor_mg2, START_MG**2, 0.5, 0.0)
    # Mean and slope are removed: they come from the gyro's zero rate and from slow changes.
    place, square = _places(len(level))
    centred = level - level.sum() / len(level)
    rest = centred - place * ((place @ centred) / square)
    squares = rest.real**2 + rest.imag**2
    middle = len(squares) // 2
    typical = max(float(np.partition(squares, middle)[middle]) / _MEDIAN, 0.5 * sensor_mg2)
    # Shocks are left out of the autocovariances.
    calm = squares <= 2 * SHOCK * typical
    shock = 0.0 if calm[at] else 0.5 * float(squares[at])
    rest = np.where(calm, rest, 0.0)
    count = int(calm.sum())
    free = 2 * max(count - 2, 1)
    zeroth = float(squares[calm].sum()) / free
    # Coloured part: variance in excess of the white noise of the sensor.
    excess = zeroth - sensor_mg2
    if excess <= 2 * zeroth * math.sqrt(2 / free):
        return Disturbance(max(sensor_mg2, zeroth) + shock)
    first = float((rest[1:] * rest[:-1].conj()).sum().real) / free / excess
    second = float((rest[2:] * rest[:-2].conj()).sum().real) / free / excess
    return coloured(sensor_mg2 + shock, excess, first, second)


def coloured(white_mg2: float, variance_mg2: float, first: float, second: float) -> Disturbance:
    """Return a disturbance with white noise and an autoregressive process of second order.

    `variance_mg2` is the variance of the process, `first` and `second` are its autocorrelations at lags
    of one and two steps. They are limited to values at which the process is stationary.
    """
    r1 = min(max(first, -STATIONARY), STATIONARY)
    r2 = min(max(second, 2 * r1**2 - STATIONARY), STATIONARY)
    # Yule–Walker equations of second order.
    one = r1 * (1 - r2) / (1 - r1**2)
    two = (r2 - r1**2) / (1 - r1**2)
    drive = variance_mg2 * max(1 - one * r1 - two * r2, 0.0)
    return Disturbance(white_mg2, variance_mg2, one, two, drive)


@lru_cache(maxsize=256)
def _places(count: int) -> tuple[Floats, float]:
    place = np.arange(count, dtype=np.float64) - (count - 1) / 2
    return place, float(place @ place)


OCTAVES = 17
"""Octaves of frequency from 2 Hz down to one cycle a day: the calibration may be a day old."""
CORNERS_HZ = 2.0 ** np.array([0.5, -1.5, -3.5])
"""Corner frequencies of the 1/f processes, each in the middle of two of the six fastest octaves."""
DRIFT_STATES = len(CORNERS_HZ)
_EACH = 2


def slow_drift_mg(floor_mg: float) -> float:
    """Return the standard deviation in mg, on an axis, of the 1/f noise that the filter does not model.

    This is the noise in the octaves that are slower than the octaves of the state.
    """
    return floor_mg * math.sqrt((OCTAVES - _EACH * DRIFT_STATES) / 2)


def drift_process_mg2(floor_mg: float) -> float:
    """Return the variance in mg² of each 1/f process, given the Allan deviation's minimum in mg."""
    return floor_mg**2 * _EACH / 2


def drift_memory(length_s: float, turn_deg: float) -> Floats:
    """Return the factors (DRIFT_STATES,) by which the 1/f processes decay in a time and a turn.

    A turn also reduces the correlation: the noise belongs to the sensor's axes, and after a turn another
    axis is perpendicular to gravity.
    """
    return np.asarray(np.exp(-2 * np.pi * CORNERS_HZ * length_s) * math.cos(math.radians(turn_deg)))


@dataclass(frozen=True)
class StateEstimate:
    """Mean (k,) and covariance (k, k) of the state vector."""

    mean: Floats
    covariance: Floats


@dataclass(frozen=True)
class TimeStep:
    """Matrices of one time step of the model, with the symbols of the module's equations.

    Attributes
    ----------
    transition : (k, k) float
        F.
    shift : (k,) float
        s.
    process : (k, k) float
        Q.
    design : (k,) float
        h.
    observed : float or None
        y; None without an observation.
    variance : float
        r, above 0.
    """

    transition: Floats
    shift: Floats
    process: Floats
    design: Floats
    observed: float | None
    variance: float


@dataclass(frozen=True)
class Passed:
    """A time step with the states and the gain that the filter computed for it.

    Attributes
    ----------
    predicted, filtered : StateEstimate
        State before and after the correction by the step's observation.
    innovation, innovation_variance : float
        Observed minus predicted angle, and its variance; 0 and inf without an observation.
    gain : (k,) float
    step : TimeStep
    """

    predicted: StateEstimate
    filtered: StateEstimate
    innovation: float
    innovation_variance: float
    gain: Floats
    step: TimeStep


def advance(state: StateEstimate, step: TimeStep) -> Passed:
    """Advance the Kalman filter by one time step: predict the state, then correct it by the observation."""
    f = step.transition
    covariance = f @ state.covariance @ f.T + step.process
    predicted = StateEstimate(f @ state.mean + step.shift, 0.5 * (covariance + covariance.T))
    if step.observed is None:
        return Passed(predicted, predicted, 0.0, np.inf, np.zeros(len(state.mean)), step)
    # Kalman gain of one scalar observation.
    seen = predicted.covariance @ step.design
    variance = float(step.design @ seen) + step.variance
    innovation = step.observed - float(step.design @ predicted.mean)
    gain = seen / variance
    filtered = StateEstimate(
        predicted.mean + gain * innovation, predicted.covariance - np.outer(gain, seen)
    )
    return Passed(predicted, filtered, innovation, variance, gain, step)


def backward(passed: Sequence[Passed]) -> list[StateEstimate]:
    """Return the smoothed state of every step, given the observations of all these steps."""
    smoothed: list[StateEstimate] = []
    adjoint = _Adjoint(len(passed[0].gain) if passed else 0)
    for one in reversed(passed):
        smoothed.append(adjoint.applied(one.filtered))
        adjoint.pass_back(one)
    return smoothed[::-1]


def smooth_lagged(state: StateEstimate, later: Sequence[Passed]) -> StateEstimate:
    """Return a filtered state corrected by the observations of the later steps (fixed-lag smoother)."""
    adjoint = _Adjoint(len(state.mean))
    for one in reversed(later):
        adjoint.pass_back(one)
    return adjoint.applied(state)


class _Adjoint:
    """Vector and matrix that carry the information from later observations back to earlier states."""

    def __init__(self, size: int) -> None:
        self._vector, self._matrix = np.zeros(size), np.zeros((size, size))

    def applied(self, state: StateEstimate) -> StateEstimate:
        p = state.covariance
        covariance = p - p @ self._matrix @ p
        return StateEstimate(state.mean - p @ self._vector, 0.5 * (covariance + covariance.T))

    def pass_back(self, one: Passed) -> None:
        """Carry the information back over one time step, and add the step's own observation."""
        h, f = one.step.design, one.step.transition
        if np.isfinite(one.innovation_variance):
            # Cᵀ λ − h innovation/variance and Cᵀ Λ C + h hᵀ/variance, C = I − gain hᵀ, written out.
            by_gain = self._matrix @ one.gain
            pull = float(one.gain @ self._vector) + one.innovation / one.innovation_variance
            self._vector = self._vector - h * pull
            self._matrix = (
                self._matrix
                - np.outer(h, by_gain)
                - np.outer(by_gain, h)
                + np.outer(h, h) * (float(one.gain @ by_gain) + 1 / one.innovation_variance)
            )
        self._vector = f.T @ self._vector
        self._matrix = f.T @ self._matrix @ f


ANGLE, ZERO, SCALE, G_X, G_Y, LEVER_X, LEVER_Y, NOW, BEFORE = range(9)
DRIFT = slice(9, 9 + DRIFT_STATES)
SIZE = 9 + DRIFT_STATES
LEVER_MM = 50.0
"""Standard deviation of the sensor's distance from the stage's axis (D)."""
BEND = 0.012
"""Standard deviation of the raw angle's slope by bias, gains and Δφ of uncalibrated accelerometers: bias
10 mg, gains ±2 %, ±0.25° (CHIP, B and D)."""
OPEN_DEG = 90.0
"""Standard deviation of an unknown angle."""
LEAST_MG = 50.0
"""Smallest component of gravity in the plane, in mg, from which an angle is computed."""
ACROSS_S = 0.5
"""Time over which a turn out of the plane keeps its direction (D)."""
_MG_PER_MM = 1.0 / STANDARD_GRAVITY_MPS2


@dataclass(frozen=True)
class Turned:
    """A time step with corrected readings, as input of the linear model.

    Attributes
    ----------
    increment : Increment
    turn_deg : float
        Turn about Z during the step.
    gravity : complex
        x − i y of gravity in the plane, in mg: its phase is the angle.
    force_g : (2,) float
        Mean reading of X and Y between this step and the one before, in g.
    rate_dps, spin_rad_s2 : float
        Rate of turn, and its change.
    across_dps : float
        Rate of the angle that the planar model neglects, caused by gravity out of the plane together with
        turns about X and Y.
    lost : bool
        True if the gap before the step is so long that the angle is unknown and the sensor may have been
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
        """Angle in degrees computed from the direction of gravity alone, without the gyro."""
        return math.degrees(math.atan2(self.gravity.imag, self.gravity.real))

    @property
    def lever_mg(self) -> tuple[complex, complex]:
        """Change of `gravity` in mg per millimetre of distance from the stage's axis, along X and Y."""
        spin = math.radians(self.rate_dps)
        square = spin * spin * _MG_PER_MM
        change = self.spin_rad_s2 * _MG_PER_MM
        return complex(square, change), complex(change, -square)


class MotionModel:
    """Builds the matrices of the linear model for each time step.

    Parameters
    ----------
    sensing : Sensing
    gyros : GyroKnowledge
    bend : float
        Standard deviation of the relative error of the accelerometers' angle scale, which varies with the
        angle.
    """

    def __init__(self, sensing: Sensing, gyros: GyroKnowledge, bend: float = BEND) -> None:
        self._sensing = sensing
        self._gyros = gyros
        self._bend = bend
        self._drift_mg2 = drift_process_mg2(sensing.drift_mg)

    def begin(self, angle_deg: float) -> StateEstimate:
        """Return the state before the first step, with the uncertainty of an unknown angle."""
        gyros = self._gyros
        u = np.array([
            OPEN_DEG, gyros.zero_dps, math.hypot(gyros.scale, self._bend), gyros.g_dps_per_g,
            gyros.g_dps_per_g, LEVER_MM, LEVER_MM, START_MG, START_MG,
            *[math.sqrt(self._drift_mg2)] * DRIFT_STATES,
        ])  # fmt: skip
        mean = np.zeros(SIZE)
        mean[ANGLE] = angle_deg
        return StateEstimate(mean, np.diag(u**2))

    def step(self, turned: Turned, disturbance: Disturbance, before: StateEstimate) -> TimeStep:
        """Return the matrices of the linear model for a step, with the angle of gravity as the observation.

        The observed angle is shifted by whole turns to the value nearest to the predicted angle.
        """
        length_s = turned.increment.length_s
        f = np.eye(SIZE)
        seen_deg = turned.gravity_deg
        # The angle changes by the turn that the gyro measured, minus its errors times measured factors.
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
        # First-order processes of the 1/f noise.
        kept = drift_memory(length_s, turned.turn_deg)
        f[DRIFT, DRIFT] = np.diag(kept)
        process[DRIFT, DRIFT] = np.diag(self._drift_mg2 * (1 - kept**2))
        # After a long gap the angle starts again from gravity.
        if turned.lost:
            f[ANGLE, :] = f[NOW, :] = f[BEFORE, :] = 0.0
            shift[ANGLE], process[ANGLE, ANGLE] = seen_deg, OPEN_DEG**2
            process[NOW, NOW] = process[BEFORE, BEFORE] = disturbance.coloured_mg2
            process[ZERO, ZERO] += TURN_ON_DPS**2
        length_mg = abs(turned.gravity)
        if length_mg < LEAST_MG:
            return TimeStep(f, shift, process, np.zeros(SIZE), None, math.inf)
        # Degrees per mg across gravity: disturbances, drift and lever arm shift the observed angle.
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
