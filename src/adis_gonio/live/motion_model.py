"""The angle of a moving sensor as samples arrive, from gyros and gravity, by a smoother with a fixed lag.

A Kalman filter runs over time steps of about 20 ms. The reported angle lags behind the newest sample and
uses all samples up to it. For this the model of every step within the lag is computed again from the
present estimate of the disturbance around it. docs/theory.md explains the model.

**Time steps.** A step has the means of a few samples, and the turn by the gyros since the step before.
Within a step, the accelerations are rotated to the middle of the step by the turn that the gyros measured,
so that motion does not blur their mean. The chip's filter delays gyros and accelerometers equally: the
integral of filtered rates is the filtered angle, and both belong to a time before the sample by the delay
of the filter.

**State.** The turn of the sensor in the plane is a linear model with the following state.

It has the angle (deg), the zero rate of the gyro (°/s), the relative error of its gain, its sensitivity to
acceleration along X and Y (°/s/g), the distance of the sensor from the stage's axis (mm, X and Y), the
disturbance of the reading perpendicular to gravity (mg, in this time step and the one before: an
autoregressive process of second order).

The gyro is a known input except for its errors. These enter with measured factors, so the model stays
linear. The error of the gain is a random walk in the angle, because imperfectly calibrated accelerometers
distort the scale of the angle differently at each angle.

**Disturbance.** With gravity alone, the accelerometers turned back by the gyros would be constant. Their
changes within the last second, both components together, are the disturbance: the sensor's white noise, an
autoregressive process of second order (tremor at 8 to 12 Hz, a table that rings, or slow motion) and
shocks. The coefficients of the autoregressive process follow from the autocovariances (Yule-Walker
equations).

**1/f noise of the accelerometers.** Each octave has half the square of the Allan floor. All octaves are
added to u as if they were constant; the filter averages the fastest ones a little, so that u is rather
wide.

**Filter and smoother.** Each step k has one scalar observation y, the angle of gravity:

    x(k) = F x(k−1) + s + w,  w ~ N(0, Q);    y(k) = h·x(k) + v,  v ~ N(0, r)

x is the state, F its transition, s the known change, w and v are random. To smooth a state, the filter runs
on over the steps within the lag with a copy of the state, which does not change with time and which the
later observations correct. This needs no inverse, so constant parts of the state, or parts without
variance, are no special case.

A letter B or D after a figure is its confidence: B from the data sheet of related sensors, D an estimate.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from operator import attrgetter
from typing import Protocol

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees, wrap_radians
from adis_gonio.base.errors import UsageError
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

ZERO_DPS = 3.0
"""Standard uncertainty, in °/s, of the zero rate of an uncalibrated gyro (D)."""
TURN_ON_DPS = 0.2
"""Standard uncertainty, in °/s, of a calibrated zero rate after another start or at another temperature
(D)."""
GAIN_U = 0.01
"""Standard uncertainty of the relative gain of an uncalibrated gyro (D: no data sheet states it)."""
G_DPS_PER_G = 0.05
"""Standard uncertainty, in °/s/g, of the gyro's sensitivity to acceleration (ADIS16350 data sheet, B)."""
WALK_DPS_PER_RT_S = 0.003
"""Random walk of a gyro's zero rate, in °/s/√s (D): it gives a minimum of the Allan deviation of 0.015 °/s
within half a minute."""


class GyroCorrection(Protocol):
    """Interface of an object that corrects gyro readings, such as `calibrate.GyroCalibration`."""

    def correct(self, rate_dps: Floats, force_g: Floats, temperature_c: Floats | None) -> Floats:
        """Return the rates (n, 3) in °/s with the calibrated errors removed.

        `rate_dps` (n, 3) are the readings of the gyros, `force_g` (n, 3) of the accelerometers.
        `temperature_c` is None if not measured.
        """


@dataclass(frozen=True)
class GyroKnowledge:
    """Standard uncertainties of the gyro about the rotation axis, after its calibration.

    Attributes
    ----------
    zero_dps, scale, g_dps_per_g : float
        Standard uncertainty of the zero rate, the relative gain, and the sensitivity to acceleration along
        each axis of the plane.
    calibration : GyroCorrection or None
        Calibration that corrects the rates before they are used; None for uncalibrated gyros.
    """

    zero_dps: float = ZERO_DPS
    scale: float = GAIN_U
    g_dps_per_g: float = G_DPS_PER_G
    calibration: GyroCorrection | None = None

    @classmethod
    def of(cls, calibration: GyroCorrection | None, u: Mapping[str, float | None] | None) -> GyroKnowledge:
        """Make the knowledge of the gyros from a calibration and its standard uncertainties `u` by name.

        Names are `gyro_bias_z`, `gyro_scale_z`, …; a missing parameter has the uncertainty of an
        uncalibrated gyro. If `calibration` is None, the gyros are uncalibrated.
        """
        if calibration is None:
            return cls()
        known = {name: value for name, value in (u or {}).items() if value is not None}
        return cls(
            math.hypot(known.get("gyro_bias_z", TURN_ON_DPS), TURN_ON_DPS),
            known.get("gyro_scale_z", GAIN_U),
            max(known.get(f"g_sensitivity_z{axis}", G_DPS_PER_G) for axis in "xy"),
            calibration=calibration,
        )

    def corrected(self, rate_dps: Floats, accel_mg: Floats, temperature_c: float | None) -> Floats:
        """Return the rate (3,) in °/s with the calibrated errors removed, if there is a calibration.

        `rate_dps` (3,) and `accel_mg` (3,) are the readings; `temperature_c` is None if not measured.
        """
        if self.calibration is None:
            return rate_dps
        warm = None if temperature_c is None else np.array([temperature_c])
        return np.asarray(self.calibration.correct(rate_dps[None], accel_mg[None] / 1000.0, warm)[0])


STEP_S = 0.02
"""Least length of a time step in s: short against the period of a tremor of 12 Hz, long against the time
between samples."""
GAP_PERIODS = 1.5
"""Time between two samples, in sample periods, above which it is a gap."""
HAND_DPS_PER_RT_S = 50.0
"""Random walk of the rate of turn, in °/s/√s, if a hand may turn the sensor during a gap (D): about 90° in
1.5 s."""
BEGIN_S = 0.05
"""Length of a gap, in s, above which a hand may begin to turn the sensor; during a shorter gap it continues
its motion."""
OVER_RANGE = 0.98
"""Reading of a gyro, as a fraction of its range, from which it counts as saturated."""
SATURATED_DPS = 200.0
"""Standard deviation, in °/s, by which the true rate may exceed the reading of a saturated gyro (D)."""


@dataclass(frozen=True)
class Sensing:
    """Properties of a sensor that the angle in motion depends on.

    Attributes
    ----------
    period_s : float
        Time between samples.
    noise_mg, gyro_noise_dps : float
        White noise (rms) of a sample ahead of the sensor's filter.
    filter_m : int
        The number M that sets the length 2^M of the chip's filter; 0 for no filter.
    gyro_range_dps : float or None
        Largest rate that the gyros measure; None if unknown: then no saturation is detected.
    drift_mg : float
        Smallest Allan deviation of the accelerometers, which sets their 1/f noise; 0 if unknown.
    bias_mg : float
        Standard deviation of the bias of an accelerometer between sensors; 10 mg if unknown (D).
    """

    period_s: float
    noise_mg: float
    gyro_noise_dps: float
    filter_m: int = 0
    gyro_range_dps: float | None = None
    drift_mg: float = 0.0
    bias_mg: float = 10.0

    @property
    def step_samples(self) -> int:
        """Number of samples averaged into a time step.

        It is at least the length of the filter's boxcar window, so that the steps are nearly independent.
        """
        return max(1, 1 << self.filter_m, round(STEP_S / self.period_s))

    @property
    def delay_s(self) -> float:
        """Delay of the sensor's filter in s."""
        return ((1 << self.filter_m) - 1) * self.period_s

    @property
    def drift_rms_mg(self) -> float:
        """Standard deviation in mg of the 1/f noise of all octaves."""
        return self.drift_mg * math.sqrt(OCTAVES / 2)

    @property
    def bend(self) -> float:
        """Standard deviation of the error of dφ/dψ for uncalibrated accelerometers (`GAIN_BEND`)."""
        return math.hypot(GAIN_BEND, self.bias_mg / 1000)  # gravity is 1000 mg

    @property
    def step_noise_mg2(self) -> float:
        """Variance in mg² that white noise gives the mean acceleration of a time step."""
        return self.noise_mg**2 / self.step_samples


@dataclass(frozen=True)
class Increment:
    """Means of the samples of a time step, and the turn since the step before.

    Attributes
    ----------
    time_s : float
        Time of the middle of the step, by the samples' times.
    length_s : float
        Time since the middle of the step before; 0 for the first step.
    turned_deg : (3,) float
        Angle turned about each axis in that time: the integral of the gyros.
    unseen_deg2 : float
        Variance of the turn about Z that the gyros did not measure: between samples, in gaps, in
        saturation.
    rate_dps, accel_mg : (3,) float
        Mean rate and acceleration of the step; the accelerations are rotated to the middle of the step.
    gap_s : float
        Longest gap between samples since the step before; 0 if there was none.
    saturated : bool
        True if the gyro of Z was at the end of its range.
    temperature_c : float or None
        Temperature at the end of the step; None if not measured.
    """

    time_s: float
    length_s: float
    turned_deg: Floats
    unseen_deg2: float
    rate_dps: Floats
    accel_mg: Floats
    gap_s: float
    saturated: bool
    temperature_c: float | None = None


class Stepper:
    """Groups samples into time steps of fixed length, however they are divided into blocks."""

    def __init__(self, sensing: Sensing) -> None:
        self._sensing = sensing
        self._count = sensing.step_samples
        self._rows = np.empty((0, 8))
        self._last: Floats | None = None
        """Time, turn (3,), rates (3,) of the last sample before these rows."""
        self._middle_s: float | None = None
        self._unseen, self._gap, self._stuck = 0.0, 0.0, 0
        self._walk = 0.0
        self._rate_before: float | None = None

    def feed(
        self, time_s: Floats, accel_mg: Floats, gyro_dps: Floats, temperature_c: Floats | None = None
    ) -> list[Increment]:
        """Add n samples; return the time steps that they complete.

        Times and temperatures are (n,), accelerations and rates (n, 3). The temperatures are None if not
        measured.
        """
        warm = np.full(len(time_s), np.nan) if temperature_c is None else temperature_c
        # Columns: time, three accelerations, three rates, temperature.
        self._rows = np.concatenate([self._rows, np.column_stack([time_s, accel_mg, gyro_dps, warm])])
        found = []
        while len(self._rows) >= self._count:
            rows, self._rows = self._rows[: self._count], self._rows[self._count :]
            found.append(self._step(rows))
        return found

    def _step(self, rows: Floats) -> Increment:
        """Reduce the samples of one time step to an increment.

        `rows` (n, 8) has the time, three accelerations, three rates and the temperature of each sample. The
        turn of an increment begins at the middle of the step before; the first increment has no turn.
        """
        time_s, accel, rates = rows[:, 0], rows[:, 1:4], rows[:, 4:7]
        turn = self._turns(time_s, rates)
        middle_s, mean_turn = float(time_s.mean()), turn.mean(axis=0)
        # The turn counts from the middle of the step before, so that it stays small over hours.
        first = self._middle_s is None
        length_s = 0.0 if self._middle_s is None else middle_s - self._middle_s
        self._middle_s = middle_s
        limit = self._sensing.gyro_range_dps
        saturated = limit is not None and bool(np.abs(rates[:, 2]).max() >= OVER_RANGE * limit)
        self._stuck = self._stuck + 1 if saturated else 0
        if saturated:
            # Missed turns have one sign: variances of k steps add up to (k SATURATED_DPS length)².
            self._unseen += (SATURATED_DPS * length_s) ** 2 * (2 * self._stuck - 1)
        # Turn each reading back to the middle of the step, then average.
        back = np.exp(-1j * np.radians(turn[:, 2] - mean_turn[2]))
        level = complex(((accel[:, 0] - 1j * accel[:, 1]) * back).mean())
        rate = rates.mean(axis=0)
        if self._rate_before is not None:
            # Exponential mean over one second of squared changes of the rate.
            seen = (float(rate[2]) - self._rate_before) ** 2 / length_s
            self._walk += min(1.0, length_s) * (seen - self._walk)
        self._rate_before = float(rate[2])
        turned = np.zeros(3) if first else mean_turn
        gravity = np.array([level.real, -level.imag, accel[:, 2].mean()])
        warm = None if math.isnan(rows[-1, 7]) else float(rows[:, 7].mean())
        step = Increment(
            middle_s, length_s, turned, self._unseen, rate, gravity, self._gap, saturated, warm
        )
        self._unseen, self._gap = 0.0, 0.0
        self._last[1:4] -= mean_turn  # type: ignore[index]
        return step

    def _turns(self, time_s: Floats, rates: Floats) -> Floats:
        """Return the integral (n, 3) of the rates up to each sample, in degrees, by trapezoids."""
        if self._last is None:
            self._last = np.concatenate([time_s[:1], np.zeros(3), rates[0]])
        times = np.concatenate([self._last[:1], time_s])
        all_rates = np.vstack([self._last[4:7], rates])
        lengths = np.diff(times)
        # Cumulative trapezoidal rule, continued from the sample before.
        pieces = 0.5 * (all_rates[1:] + all_rates[:-1]) * lengths[:, None]
        turn = np.asarray(self._last[1:4] + np.cumsum(pieces, axis=0))
        # Between two samples the rate is a random walk with known ends (a Brownian bridge), whose variance
        # grows by q per s. Its integral, the turn, then has the variance q L³/12.
        hand = np.where(lengths > BEGIN_S, max(self._walk, HAND_DPS_PER_RT_S**2), self._walk)
        self._unseen += float((hand * lengths**3).sum()) / 12
        gaps = lengths[lengths > GAP_PERIODS * self._sensing.period_s]
        self._gap = max(self._gap, float(gaps.max(initial=0.0)))
        self._last = np.concatenate([time_s[-1:], turn[-1], rates[-1]])
        return turn


BACK_S, AHEAD_S = 1.0, 0.5
"""Length in s of the span of steps before and after a step from which the disturbance of gravity in this
step is estimated. Fewer steps are used if later ones have not arrived."""
LEAST_STEPS = 8
START_MG = 20.0
"""Standard deviation of the disturbance, in mg, assumed until `LEAST_STEPS` steps are known (D): a sensor
held in the hand."""
SHOCK = 16.0
"""Ratio of the squared deviation of a step to the typical square in the span above which the step is a
shock. Gaussian noise exceeds it once in nine million steps. A shock raises only the variance of this step.
"""
STATIONARY = 0.97


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
        Coefficients by which the process depends on its values one and two steps before.
    drive_mg2 : float
        Variance of the innovations of the process.
    """

    white_mg2: float
    coloured_mg2: float = 0.0
    first: float = 0.0
    second: float = 0.0
    drive_mg2: float = 0.0

    def variance_of_mean(self, steps: int) -> float:
        """Return the variance in mg² that the disturbance gives the mean of `steps` successive steps."""
        lags = [1.0, self.first / (1 - self.second)]
        while len(lags) < steps:
            lags.append(self.first * lags[-1] + self.second * lags[-2])
        # Each lag k occurs in 2 (steps − k) of the pairs of steps, lag 0 in `steps` pairs.
        pairs = 2.0 * np.arange(steps, 0, -1)
        pairs[0] = steps
        return self.white_mg2 / steps + self.coloured_mg2 * float(pairs @ lags[:steps]) / steps**2


def disturbance_of(level: Floats, at: int, sensor_mg2: float) -> Disturbance:
    """Estimate the disturbance of gravity in a time step from the steps around it.

    Parameters
    ----------
    level : (n,) complex
        Readings of the accelerometers in the plane, turned back by the gyros, in mg; equal steps.
    at : int
        Index of the step.
    sensor_mg2 : float
        Variance in mg² of a step's mean from the sensor's own noise; 0 if it is unknown.
    """
    if len(level) < LEAST_STEPS:
        return coloured(sensor_mg2, START_MG**2, 0.5, 0.0)
    # Mean and slope are removed: they come from the gyro's zero rate and from slow changes.
    place, square = _places(len(level))
    centred = level - level.sum() / len(level)
    rest = centred - place * ((place @ centred) / square)
    squares = rest.real**2 + rest.imag**2
    middle = len(squares) // 2
    # The median of a squared modulus is 2 ln 2 of a component's variance.
    typical = max(float(np.partition(squares, middle)[middle]) / (2 * math.log(2)), 0.5 * sensor_mg2)
    # Shocks are left out of mean and slope, which would change all steps, and of the autocovariances.
    calm = squares <= 2 * SHOCK * typical
    if not calm.all():
        rest = level - np.polyval(np.polyfit(place[calm], level[calm], 1), place)
        squares = rest.real**2 + rest.imag**2
    shock = 0.0 if calm[at] else 0.5 * float(squares[at])
    rest = np.where(calm, rest, 0.0)
    # At least half of the steps are calm.
    free = 2 * (int(calm.sum()) - 2)
    zeroth = float(squares[calm].sum()) / free
    # Coloured part: variance in excess of the white noise of the sensor.
    excess = zeroth - sensor_mg2
    if excess <= 2 * zeroth * math.sqrt(2 / free):
        return Disturbance(max(sensor_mg2, zeroth) + shock)
    # In each of the two components, removing mean and slope from white noise takes about twice its variance
    # from the sum of products at each lag. If the noise of the sensor is unknown, all counts as white.
    taken = 4 * (sensor_mg2 or zeroth)
    first = (float((rest[1:] * rest[:-1].conj()).sum().real) + taken) / free / excess
    second = (float((rest[2:] * rest[:-2].conj()).sum().real) + taken) / free / excess
    return coloured(sensor_mg2 + shock, excess, first, second)


def coloured(white_mg2: float, variance_mg2: float, first: float, second: float) -> Disturbance:
    """Return a disturbance with white noise and an autoregressive process of second order.

    `white_mg2` is the variance of the white noise, `variance_mg2` the variance of the process; `first` and
    `second` are the autocorrelations of the process at lags of one and two steps. They are limited to
    values at which the process is stationary.
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
"""Number of octaves of frequency from 2 Hz down to one cycle a day, over which the accelerometers' 1/f
noise acts: the calibration may be a day old."""


@dataclass(frozen=True)
class StateEstimate:
    """Mean (k,) and covariance (k, k) of the state: the angle and the errors that the filter estimates."""

    mean: Floats
    covariance: Floats


@dataclass(frozen=True)
class TimeStep:
    """Matrices of one time step of the model, with the symbols of the module's equations.

    Attributes
    ----------
    transition : (k, k) float
        F, which multiplies the state before.
    shift : (k,) float
        s, the known change of the state.
    process : (k, k) float
        Q, the covariance of the random change w.
    design : (k,) float
        h, the derivative of the observed angle by the state.
    observed : float
        y, the observed angle.
    variance : float
        r, the variance of the observation, above 0; infinite without an observation.
    """

    transition: Floats
    shift: Floats
    process: Floats
    design: Floats
    observed: float
    variance: float


def with_copy(state: StateEstimate) -> StateEstimate:
    """Return a state (2k,) of a state (k,) and a copy of it.

    `advance` changes only the state. Later observations correct the copy, so that it is the smoothed state
    of the present time (fixed-lag smoother).
    """
    return StateEstimate(np.tile(state.mean, 2), np.tile(state.covariance, (2, 2)))


def advance(state: StateEstimate, step: TimeStep) -> StateEstimate:
    """Advance the Kalman filter by one time step: predict the state, then correct it by the observation.

    The state may have more components than the step (`with_copy`); these do not change with time.
    """
    f, k = step.transition, len(step.shift)
    mean, covariance = state.mean.copy(), state.covariance.copy()
    mean[:k] = f @ mean[:k] + step.shift
    covariance[:k] = f @ covariance[:k]
    covariance[:, :k] = covariance[:, :k] @ f.T
    covariance[:k, :k] += step.process
    covariance = 0.5 * (covariance + covariance.T)
    # Kalman gain of one scalar observation.
    seen = covariance[:, :k] @ step.design
    variance = float(step.design @ seen[:k]) + step.variance
    innovation = step.observed - float(step.design @ mean[:k])
    return StateEstimate(
        mean + seen * (innovation / variance), covariance - np.outer(seen, seen / variance)
    )


ANGLE, ZERO, SCALE, G_X, G_Y, LEVER_X, LEVER_Y, NOW, BEFORE = range(9)
SIZE = 9
LEVER_MM = 50.0
"""Standard deviation, in mm, of each component of the sensor's distance from the stage's axis (D)."""
GAIN_BEND = 0.0066
"""Standard deviation of the error of dφ/dψ, which is 1 without errors, by the gains and Δφ of uncalibrated
accelerometers. φ is the angle computed from the direction of gravity, ψ the true angle. Gains ±2 %, Δφ
±0.25° (ADIS16350 data sheet, B and D)."""
OPEN_DEG = 90.0
"""Standard deviation, in degrees, of an angle about which nothing is known."""
LEAST_MG = 50.0
"""Smallest component of gravity in the plane, in mg, from which an angle is computed."""
ACROSS_S = 0.5
"""Time in s over which a turn out of the plane keeps its direction (D)."""
_MG_PER_MM = 1.0 / STANDARD_GRAVITY_MPS2


@dataclass(frozen=True)
class Turned:
    """A time step with corrected readings, as input of the linear model.

    Attributes
    ----------
    increment : Increment
        Means of the step, before the corrections.
    turn_deg : float
        Turn about Z during the step.
    gravity : complex
        Gravity in the plane as the complex number x − i y, in mg: its phase is the angle.
    force_g : (2,) float
        Mean reading of X and Y between this step and the one before, in g.
    rate_dps, spin_rad_s2 : float
        Rate of turn about Z, and its change with time.
    across_dps : float
        Error of the angle's rate in the planar model, if gravity has a part out of the plane and the sensor
        turns about X or Y.
    lost : bool
        True if the gap before the step is so long that the angle is unknown and the sensor may have been
        switched off.
    back : complex
        Rotation by the gyros back to the attitude after the last gap.
    level : complex
        Gravity in the plane as x − i y, in mg, without the lever arm and turned `back`.
    segment : int
        Number of gaps before the step.
    notes : tuple of str
        Names of events, as in `SmoothedAngle`.
    """

    increment: Increment
    turn_deg: float
    gravity: complex
    force_g: Floats
    rate_dps: float
    spin_rad_s2: float
    across_dps: float
    lost: bool = False
    back: complex = 1.0
    level: complex = 0j
    segment: int = 0
    notes: tuple[str, ...] = ()

    @property
    def gravity_deg(self) -> float:
        """Angle in degrees computed from the direction of gravity alone, without the gyro."""
        return math.degrees(math.atan2(self.gravity.imag, self.gravity.real))

    @property
    def lever_mg(self) -> tuple[complex, complex]:
        """Acceleration in mg that 1 mm of distance from the stage's axis adds, along X and along Y.

        It is caused by the rotation, and is complex like `gravity`.
        """
        spin = math.radians(self.rate_dps)
        square = spin * spin * _MG_PER_MM
        change = self.spin_rad_s2 * _MG_PER_MM
        return complex(square, change), complex(change, -square)


SPAN_S = 1.0
REST_DPS = 1.0
"""Largest standard deviation of each rate, in °/s, over the span `SPAN_S` at which the sensor is at rest,
so that the zero rates are estimated."""
REST_MG = 10.0
ACROSS_DPS = 4.0
"""Mean rate about X and Y over a second, in °/s, above which the sensor turns out of its plane; `TILT`
times the rate about Z is added. Smaller rates come from a bearing's wobble or from axes that are not
square."""
TILT = 0.1
"""Largest change, within the span `SPAN_S`, of the component of gravity out of the plane, as a share of
gravity, at which the sensor is still in its plane."""


class PlaneWatch:
    """Detects turns out of the plane of X and Y; the model of the angle assumes that there are none.

    The zero rates of the gyros are estimated at rest. Before the first rest they are unknown, and turns are
    detected by gravity alone.
    """

    def __init__(self, length_s: float) -> None:
        self._rows: deque[Floats] = deque(maxlen=max(4, round(SPAN_S / length_s)))
        self._zero: Floats | None = None

    def see(self, rate_dps: Floats, accel_mg: Floats) -> float:
        """Add a time step; return the error (°/s) of the angle's rate because of turns out of the plane.

        `rate_dps` (3,) and `accel_mg` (3,) are the means of the step. The error is 0 before the first rest.
        """
        self._rows.append(np.concatenate([rate_dps, accel_mg]))
        if len(self._rows) == self._rows.maxlen:
            rows = np.array(self._rows)
            spread, mean = rows.std(axis=0), rows[:, :3].mean(axis=0)
            if spread[:3].max() <= REST_DPS and spread[3:].max() <= REST_MG:
                zero = mean if self._zero is None else self._zero
                self._zero = zero + (mean - zero) / len(rows)
        if self._zero is None:
            return 0.0
        x, y, z = accel_mg
        about = rate_dps - self._zero
        square = x * x + y * y
        return float(abs(z * (x * about[0] + y * about[1])) / square) if square > 1.0 else 0.0

    def forget(self) -> None:
        """Delete the stored time steps, because a gap in the samples separates them from later steps."""
        self._rows.clear()

    @property
    def out_of_plane(self) -> bool:
        """True if the sensor turned out of the plane of X and Y within the last `SPAN_S` seconds."""
        if len(self._rows) < 4:
            return False
        rows = np.array(self._rows)
        # Share of gravity along Z: its change at the two ends of the span is a tilt.
        lengths = np.linalg.norm(rows[:, 3:], axis=1)
        out = rows[:, 5] / np.maximum(lengths, 1.0)
        if abs(float(out[-4:].mean() - out[:4].mean())) > TILT:
            return True
        if self._zero is None:
            return False
        about = np.abs(rows[:, :3].mean(axis=0) - self._zero)
        return math.hypot(about[0], about[1]) > ACROSS_DPS + TILT * float(about[2])


LAG_S = 0.5
"""Default delay of the reported angle in s; a longer delay reduces its uncertainty little
(docs/results/index.md)."""
LONGEST_LAG_S = 10.0
DOUBT = 4.0
"""Distance between the estimated zero rate and the calibrated one, in standard uncertainties, from which
the gyros' calibration is rejected."""
SATURATED_MG = 100.0
"""Standard deviation, in mg, of the disturbance of gravity while the gyro is saturated (D), from the
acceleration at 40 mm from the axis."""
_NOTES = ("gap", "saturated", "out_of_plane")

Corrected = Callable[[Floats, "float | None"], Floats]
"""Type of a function that computes gravity (3,) in mg, in orthogonal axes, from a reading (3,) in mg and a
temperature in °C or None."""


@dataclass(frozen=True)
class SmoothedAngle:
    """The smoothed angle at one time, with its uncertainty and the gyro's zero rate.

    Attributes
    ----------
    time_s : float
        Time of the angle by the samples' times, with the chip's filter delay subtracted.
    angle_deg, u_deg : float
        Angle within ±180°, which is 0 if gravity is along X, and its standard uncertainty by noise, motion
        and drift.
    rate_dps : float
        Rate of turn at that time, corrected for the estimated errors of the gyro.
    zero_dps, zero_u_dps : float
        Estimated zero rate that the gyro has after its calibration, and its standard uncertainty.
    accel_mg, temperature_c : (3,) float, float or None
        Mean reading of the accelerometers in the time step of this angle, and its temperature if measured.
    notes : tuple of str
        Events from a second before this time until the newest sample: `gap`, `saturated`, `out_of_plane`;
        and `gyro_calibration` if the gyros' calibration cannot belong to this sensor.
    """

    time_s: float
    angle_deg: float
    u_deg: float
    rate_dps: float
    zero_dps: float
    zero_u_dps: float
    accel_mg: Floats
    temperature_c: float | None
    notes: tuple[str, ...]


class AngleSmoother:
    """Estimates the angle from samples as they arrive, with a fixed delay (lag).

    Parameters
    ----------
    sensing : Sensing
        Properties of the sensor.
    gyros : GyroKnowledge, optional
        Uncertainties of the gyros; by default of uncalibrated gyros.
    lag_s : float
        Delay of the reported angle; 0 for the filter without smoothing.
    corrected : callable, optional
        Function that corrects accelerometer readings; without it they are not corrected.
    bend : float or None
        Standard deviation of the error of dφ/dψ, with the angle φ computed from the direction of gravity
        and the true angle ψ; None for uncalibrated accelerometers.

    Raises
    ------
    UsageError
        The lag is negative or above 10 s.
    """

    def __init__(
        self,
        sensing: Sensing,
        gyros: GyroKnowledge | None = None,
        *,
        lag_s: float = LAG_S,
        corrected: Corrected | None = None,
        bend: float | None = None,
    ) -> None:
        if not 0 <= lag_s <= LONGEST_LAG_S:
            raise UsageError(f"the lag is {lag_s:g} s: take 0 to {LONGEST_LAG_S:g}")
        self._sensing = sensing
        self._gyros = gyros or GyroKnowledge()
        self._corrected = corrected
        self._bend = sensing.bend if bend is None else bend
        step_s = sensing.step_samples * sensing.period_s
        self._lag = round(lag_s / step_s)
        self._back = max(2 * LEAST_STEPS, round(BACK_S / step_s))
        # Only steps within the lag count after a step, so that the result does not depend on the blocks.
        self._ahead = min(self._lag, round(AHEAD_S / step_s))
        self._seen: deque[Turned] = deque()
        self._waiting: tuple[Increment, Increment | None] | None = None
        self._stepper = Stepper(sensing)
        self._plane = PlaneWatch(step_s)
        self._state: StateEstimate | None = None
        self._done = 0
        """Number of steps in `_seen` that are older than the lag."""
        self._phase_rad, self._segment = 0.0, 0
        self._doubted = False

    # -- taking samples ------------------------------------------------------------------------------

    def feed(
        self, time_s: Floats, accel_mg: Floats, gyro_dps: Floats, temperature_c: Floats | None = None
    ) -> None:
        """Add samples: increasing times (n,), readings (n, 3), rates (n, 3), temperatures (n,) or None."""
        for increment in self._stepper.feed(time_s, accel_mg, gyro_dps, temperature_c):
            self._arrive(increment)

    def _arrive(self, increment: Increment) -> None:
        """Process the time step before `increment`, which is complete only when `increment` is known.

        The change of its rate of turn is computed from the steps before and after it.
        """
        if self._waiting is None:
            self._waiting = (increment, None)
            return
        present, before = self._waiting
        self._waiting = (increment, present)
        turned = self._turned(present, before, increment)
        if turned.lost or present.gap_s > BEGIN_S or present.saturated:
            self._segment += 1
            self._plane.forget()
        if self._state is None:
            self._state = self._begin(turned.gravity_deg)
        events = {
            "gap": turned.lost or present.gap_s > 0,
            "saturated": present.saturated,
            "out_of_plane": self._plane.out_of_plane,
        }
        notes = tuple(name for name, holds in events.items() if holds)
        # Gravity rotated back by the turn that the gyro measured since the last gap: the turn without the
        # gyro's known errors, and gravity without the lever arm.
        known = self._state.mean
        drift_dps = known[ZERO] + turned.force_g @ known[[G_X, G_Y]]
        turn = turned.turn_deg * (1 - known[SCALE]) - drift_dps * turned.increment.length_s
        self._phase_rad = wrap_radians(self._phase_rad + math.radians(float(turn)))
        by_x, by_y = turned.lever_mg
        felt = turned.gravity - by_x * float(known[LEVER_X]) - by_y * float(known[LEVER_Y])
        back = complex(math.cos(self._phase_rad), -math.sin(self._phase_rad))
        self._seen.append(replace(turned, back=back, level=felt * back, segment=self._segment, notes=notes))
        while len(self._seen) - self._done > self._lag:
            self._state = self._doubt_calibration(self._advance(self._state, self._done))
            self._done += 1
        while self._done > self._back + 1:
            self._seen.popleft()
            self._done -= 1

    def _doubt_calibration(self, state: StateEstimate) -> StateEstimate:
        """Return the state, with larger uncertainties if its zero rate contradicts the gyros' calibration.

        The calibrated zero rate is 0, with a standard uncertainty that the calibration states. An estimate
        of more than `DOUBT` times this uncertainty contradicts it. The variances of an uncalibrated gyro
        are then added to the variances of the state, only once.
        """
        stated = self._gyros
        if self._doubted or stated.calibration is None or abs(state.mean[ZERO]) < DOUBT * stated.zero_dps:
            return state
        self._doubted = True
        open_ = GyroKnowledge()
        covariance = state.covariance.copy()
        places = [ZERO, SCALE, G_X, G_Y]
        u = np.array([open_.zero_dps, open_.scale, open_.g_dps_per_g, open_.g_dps_per_g])
        # Add the variances of an uncalibrated gyro.
        covariance[places, places] += u * u
        return StateEstimate(state.mean, covariance)

    def _turned(self, present: Increment, before: Increment | None, after: Increment) -> Turned:
        """Correct a time step by the calibrations, and add the change of its rate between its neighbours.

        `before` is None for the first step. At rest the change of the rate counts as zero.
        """
        lost = present.unseen_deg2 > (OPEN_DEG / 2) ** 2
        warm = present.temperature_c
        accel = present.accel_mg
        gravity = accel if self._corrected is None else self._corrected(accel, warm)
        rate = self._gyros.corrected(present.rate_dps, accel, warm)
        length_s = present.length_s
        turn = present.turned_deg
        force = accel
        if before is not None:
            force = 0.5 * (accel + before.accel_mg)
            turn = self._gyros.corrected(turn / length_s, force, warm) * length_s
        earlier = present if before is None or present.gap_s > BEGIN_S else before
        later = present if after.gap_s > BEGIN_S else after
        span_s = later.time_s - earlier.time_s
        # Change of the rate over the two neighbouring steps.
        spin = math.radians(float(later.rate_dps[2] - earlier.rate_dps[2])) / span_s if span_s > 0 else 0.0
        # At rest the change is noise of the gyro, which would teach the filter a lever arm of 0.
        noise_dps = self._sensing.gyro_noise_dps * math.sqrt(2 / self._sensing.step_samples)
        zero_dps = 0.0 if self._state is None else float(self._state.mean[ZERO])
        if max(abs(math.degrees(spin)) * span_s, abs(float(rate[2]) - zero_dps)) < 4 * noise_dps:
            spin = 0.0
        across = self._plane.see(present.rate_dps, accel)
        return Turned(
            present, float(turn[2]), complex(gravity[0], -gravity[1]), force[:2] / 1000.0,
            float(rate[2]), spin, across, lost,
        )  # fmt: skip

    # -- the model of a step -------------------------------------------------------------------------

    def _begin(self, angle_deg: float) -> StateEstimate:
        """Return the state before the first step, with the uncertainty of an unknown angle.

        `angle_deg` is the angle at which the filter starts.
        """
        gyros = self._gyros
        u = np.array([
            OPEN_DEG, gyros.zero_dps, math.hypot(gyros.scale, self._bend), gyros.g_dps_per_g,
            gyros.g_dps_per_g, LEVER_MM, LEVER_MM, START_MG, START_MG,
        ])  # fmt: skip
        mean = np.zeros(SIZE)
        mean[ANGLE] = angle_deg
        return StateEstimate(mean, np.diag(u**2))

    def _step(self, turned: Turned, disturbance: Disturbance, before: StateEstimate) -> TimeStep:
        """Return the matrices of the linear model for a step, with the angle of gravity as observation.

        `before` is the state after the previous step, perhaps with a copy. The observed angle is shifted by
        whole turns to the value nearest to the predicted angle.
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
            self._sensing.gyro_noise_dps**2 * self._sensing.period_s * length_s
            + turned.increment.unseen_deg2
            + turned.across_dps**2 * length_s * ACROSS_S
        )
        process[ZERO, ZERO] = WALK_DPS_PER_RT_S**2 * length_s
        process[SCALE, SCALE] = 2 * self._bend**2 * abs(math.radians(turned.turn_deg))
        process[NOW, NOW] = disturbance.drive_mg2
        # After a long gap the angle starts again from gravity.
        if turned.lost:
            f[ANGLE, :] = f[NOW, :] = f[BEFORE, :] = 0.0
            shift[ANGLE], process[ANGLE, ANGLE] = seen_deg, OPEN_DEG**2
            process[NOW, NOW] = process[BEFORE, BEFORE] = disturbance.coloured_mg2
            process[ZERO, ZERO] += TURN_ON_DPS**2
        length_mg = abs(turned.gravity)
        if length_mg < LEAST_MG:
            return TimeStep(f, shift, process, np.zeros(SIZE), 0.0, math.inf)
        # Degrees per mg across gravity: disturbances and lever arm shift the observed angle.
        per_mg = math.degrees(1.0 / length_mg)
        along = turned.gravity / length_mg
        design = np.zeros(SIZE)
        design[ANGLE] = 1.0
        for k, lever in zip((LEVER_X, LEVER_Y), turned.lever_mg, strict=True):
            design[k] = per_mg * (lever * along.conjugate()).imag
        design[NOW] = per_mg
        predicted = float(f[ANGLE] @ before.mean[:SIZE]) + shift[ANGLE]
        observed = predicted + wrap_degrees(seen_deg - predicted)
        return TimeStep(f, shift, process, design, observed, per_mg**2 * disturbance.white_mg2)

    def gravity_u_mg(self, samples: int) -> float:
        """Return the standard uncertainty in mg of each axis in the mean of the newest `samples` readings.

        It contains shaking, the acceleration by the lever arm and the sensor's noise, as the readings of
        the last second show them. Before the first time step a sensor held in the hand is assumed.
        """
        if not self._seen:
            return START_MG
        steps = max(1, round(samples / self._sensing.step_samples))
        # The steps differ in shocks only, which count in their own step.
        variances = [
            self._disturbance(place, 0.0, lambda seen: seen.gravity * seen.back).variance_of_mean(steps)
            for place in range(max(0, len(self._seen) - steps), len(self._seen))
        ]
        return math.sqrt(sum(variances) / len(variances))

    def _disturbance(
        self, place: int, sensor_mg2: float, level_of: Callable[[Turned], complex]
    ) -> Disturbance:
        seen = self._seen[place]
        if seen.increment.saturated:
            return coloured(sensor_mg2, SATURATED_MG**2, 0.9, 0.8)
        first, last = max(0, place - self._back), min(len(self._seen), place + self._ahead + 1)
        # Steps without a break between them and this one.
        alike = [k for k in range(first, last) if self._seen[k].segment == seen.segment]
        level = np.array([level_of(self._seen[k]) for k in alike])
        return disturbance_of(level, alike.index(place), sensor_mg2)

    def _advance(self, state: StateEstimate, place: int) -> StateEstimate:
        disturbance = self._disturbance(place, self._sensing.step_noise_mg2, attrgetter("level"))
        return advance(state, self._step(self._seen[place], disturbance, state))

    # -- the angle -----------------------------------------------------------------------------------

    def angle(self) -> SmoothedAngle | None:
        """Return the angle at one lag before the newest sample, estimated from all samples so far.

        Return None until a lag has passed.
        """
        if self._state is None or not self._done:
            return None
        # Filter through the lag with the present models; the copy is the state at its beginning, smoothed.
        state = with_copy(self._state)
        for place in range(self._done, len(self._seen)):
            state = self._advance(state, place)
        at = self._seen[self._done - 1]
        mean, u = state.mean[SIZE:], np.sqrt(np.maximum(np.diag(state.covariance)[SIZE:], 0.0))
        notes = tuple(name for name in _NOTES if any(name in one.notes for one in self._seen))
        drift_dps = mean[ZERO] + at.force_g @ mean[[G_X, G_Y]]
        drift_deg = math.degrees(self._sensing.drift_rms_mg / max(abs(at.gravity), 1.0))
        return SmoothedAngle(
            time_s=at.increment.time_s - self._sensing.delay_s,
            angle_deg=wrap_degrees(float(mean[ANGLE])),
            u_deg=math.hypot(float(u[ANGLE]), drift_deg),
            rate_dps=at.rate_dps * (1 - float(mean[SCALE])) - float(drift_dps),
            zero_dps=float(mean[ZERO]),
            zero_u_dps=float(u[ZERO]),
            accel_mg=at.increment.accel_mg,
            temperature_c=at.increment.temperature_c,
            notes=(*notes, "gyro_calibration") if self._doubted else notes,
        )
