"""Group samples into time steps: means of a few samples, and the turn by the gyros between two steps.

Within a step, the accelerations are rotated to the middle of the step by the turn that the gyros measured,
so that motion does not blur their mean. The chip's filter delays gyros and accelerometers equally: the
integral of filtered rates is the filtered angle, and both belong to a time before the sample by the delay
of the filter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from adis_gonio.base.arrays import Floats

ZERO_DPS = 3.0
"""Standard uncertainty of the zero rate of an uncalibrated gyro (D)."""
TURN_ON_DPS = 0.2
"""Standard uncertainty of a calibrated zero rate after another start or at another temperature (D)."""
GAIN_U = 0.01
"""Relative error of an uncalibrated gain (D: the sheets at hand state none)."""
G_DPS_PER_G = 0.05
"""Standard uncertainty of the gyro's sensitivity to acceleration (CHIP, B)."""
WALK_DPS_PER_RT_S = 0.003
"""Random walk of a zero (D): an Allan floor of 0.015 °/s within half a minute."""


class GyroCorrection(Protocol):
    """Interface of an object that corrects gyro readings, such as `calibrate.GyroCalibration`."""

    def correct(self, rate_dps: Floats, force_g: Floats, temperature_c: Floats | None) -> Floats:
        """Return the rates (n, 3) in °/s with the calibrated errors removed."""


@dataclass(frozen=True)
class GyroKnowledge:
    """Standard uncertainties of the gyro about the rotation axis, after its calibration.

    Attributes
    ----------
    zero_dps, scale, g_dps_per_g : float
        Standard uncertainty of the zero rate, the relative gain, and the sensitivity to acceleration along
        each axis of the plane.
    walk_dps_per_rt_s : float
        Random walk of the zero rate.
    calibration : GyroCorrection or None
        Calibration applied to the rates before they are used.
    """

    zero_dps: float = ZERO_DPS
    scale: float = GAIN_U
    g_dps_per_g: float = G_DPS_PER_G
    walk_dps_per_rt_s: float = WALK_DPS_PER_RT_S
    calibration: GyroCorrection | None = None

    @classmethod
    def of(cls, calibration: GyroCorrection | None, u: Mapping[str, float | None] | None) -> GyroKnowledge:
        """Make the knowledge of the gyros from a calibration and its standard uncertainties by name.

        Names are `gyro_bias_z`, `gyro_scale_z`, …; the default is the uncertainty of an uncalibrated gyro.
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
        """Return a rate (3,) in °/s with the calibrated errors removed, if there is a calibration."""
        if self.calibration is None:
            return rate_dps
        warm = None if temperature_c is None else np.array([temperature_c])
        return np.asarray(self.calibration.correct(rate_dps[None], accel_mg[None] / 1000.0, warm)[0])


STEP_S = 0.02
"""Length of a step: short against a tremor of 12 Hz, long against a sample."""
GAP_PERIODS = 1.5
"""Sample periods above which the time between samples is a gap."""
HAND_DPS_PER_RT_S = 50.0
"""Random walk of the rate if a hand turns the sensor during a gap (D): about 90° in 1.5 s."""
BEGIN_S = 0.05
"""Gap in which a hand may begin to turn; in a shorter one it continues its motion."""
OVER_RANGE = 0.98
"""Share of the gyro's range above which a sample is saturated."""
SATURATED_DPS = 200.0
"""Possible rate in excess of the reading of a saturated gyro (D)."""


@dataclass(frozen=True)
class Sensing:
    """Properties of a sensor that the angle in motion depends on.

    Attributes
    ----------
    period_s : float
        Time between samples.
    noise_mg, gyro_noise_dps : float
        White noise (rms) of a sample ahead of the filter.
    filter_m : int
        The number M that sets the length 2^M of the chip's filter; 0 for no filter.
    gyro_range_dps : float or None
        None if unknown: then no saturation is detected.
    drift_mg : float
        Allan floor of the accelerometers; 0 if unknown.
    gravity_mg : float
        Local gravity.
    """

    period_s: float
    noise_mg: float
    gyro_noise_dps: float
    filter_m: int = 0
    gyro_range_dps: float | None = None
    drift_mg: float = 0.0
    gravity_mg: float = 1000.0

    @property
    def step_samples(self) -> int:
        """Number of samples averaged into a time step.

        At least the length of the filter's boxcar, so that the steps are nearly independent.
        """
        return max(1, 1 << self.filter_m, round(STEP_S / self.period_s))

    @property
    def delay_s(self) -> float:
        """Delay of the sensor's filter in s."""
        return ((1 << self.filter_m) - 1) * self.period_s

    @property
    def step_noise_mg2(self) -> float:
        """Variance in mg² of the mean acceleration of a time step by white noise."""
        return self.noise_mg**2 / self.step_samples

    @property
    def angle_walk_deg2_per_s(self) -> float:
        """Growth of the angle's variance by the gyro's white noise, in degrees² per second."""
        return self.gyro_noise_dps**2 * self.period_s


@dataclass(frozen=True)
class Increment:
    """Means of the samples of a time step, and the turn since the step before.

    Attributes
    ----------
    time_s : float
        Middle of the step, by the samples' times.
    length_s : float
        Time since the middle of the step before.
    turned_deg : (3,) float
        Integral of the gyros over that time.
    unseen_deg2 : float
        Variance of the turn about Z that the gyros did not measure: between samples, in gaps, in
        saturation.
    rate_dps, accel_mg : (3,) float
        Mean rate and acceleration of the step; the accelerations are rotated to the middle of the step.
    gap_s : float
        Longest gap between samples since the step before; 0 if there was none.
    saturated : bool
        The gyro of Z was at the end of its range.
    temperature_c : float or None
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
        self._middle: tuple[float, Floats] | None = None
        self._unseen, self._gap, self._stuck = 0.0, 0.0, 0
        self._walk = 0.0
        self._rate_before: float | None = None

    def feed(
        self, time_s: Floats, accel_mg: Floats, gyro_dps: Floats, temperature_c: Floats | None = None
    ) -> list[Increment]:
        """Add n samples (times, accelerations, rates, temperatures); return the completed time steps."""
        warm = np.full(len(time_s), np.nan) if temperature_c is None else temperature_c
        # Columns: time, three accelerations, three rates, temperature.
        self._rows = np.concatenate([self._rows, np.column_stack([time_s, accel_mg, gyro_dps, warm])])
        found = []
        while len(self._rows) >= self._count:
            rows, self._rows = self._rows[: self._count], self._rows[self._count :]
            found.append(self._step(rows))
        return found

    def _step(self, rows: Floats) -> Increment:
        time_s, accel, rates = rows[:, 0], rows[:, 1:4], rows[:, 4:7]
        turn = self._turns(time_s, rates)
        middle_s, mean_turn = float(time_s.mean()), turn.mean(axis=0)
        before = self._middle or (middle_s, mean_turn)
        self._middle = (middle_s, mean_turn)
        length_s = middle_s - before[0]
        saturated = self._saturation(rates[:, 2], length_s)
        # Turn each reading back to the middle of the step, then average.
        back = np.exp(-1j * np.radians(turn[:, 2] - mean_turn[2]))
        level = complex(((accel[:, 0] - 1j * accel[:, 1]) * back).mean())
        rate = rates.mean(axis=0)
        self._follow(float(rate[2]), length_s)
        known = not math.isnan(rows[-1, 7])
        step = Increment(
            middle_s,
            length_s,
            mean_turn - before[1],
            self._unseen,
            rate,
            np.array([level.real, -level.imag, accel[:, 2].mean()]),
            self._gap,
            saturated,
            float(rows[:, 7].mean()) if known else None,
        )
        self._unseen, self._gap = 0.0, 0.0
        self._last[1:4] -= mean_turn  # type: ignore[index]  # turns stay small over hours
        self._middle = (middle_s, np.zeros(3))
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
        self._miss(lengths)
        self._last = np.concatenate([time_s[-1:], turn[-1], rates[-1]])
        return turn

    def _miss(self, lengths_s: Floats) -> None:
        """Add the variance of turns that were missed between samples, and record the longest gap.

        Between two samples the rate is a random walk with known ends (a Brownian bridge); its integral has
        the variance q L³/12.
        """
        hand = np.where(lengths_s > BEGIN_S, max(self._walk, HAND_DPS_PER_RT_S**2), self._walk)
        self._unseen += float((hand * lengths_s**3).sum()) / 12
        gaps = lengths_s[lengths_s > GAP_PERIODS * self._sensing.period_s]
        self._gap = max(self._gap, float(gaps.max(initial=0.0)))

    def _saturation(self, rate_dps: Floats, length_s: float) -> bool:
        limit = self._sensing.gyro_range_dps
        saturated = limit is not None and bool(np.abs(rate_dps).max() >= OVER_RANGE * limit)
        self._stuck = self._stuck + 1 if saturated else 0
        if saturated:
            # Missed turns have one sign: variances of k steps add up to (k SATURATED_DPS length)².
            self._unseen += (SATURATED_DPS * length_s) ** 2 * (2 * self._stuck - 1)
        return saturated

    def _follow(self, rate_dps: float, length_s: float) -> None:
        """Update the estimate of how fast the rate varies (as a random walk) over the last second."""
        if self._rate_before is not None and length_s > 0:
            share = min(1.0, length_s)
            # Exponential mean of squared changes over one second.
            seen = (rate_dps - self._rate_before) ** 2 / length_s
            self._walk += share * (seen - self._walk)
        self._rate_before = rate_dps
