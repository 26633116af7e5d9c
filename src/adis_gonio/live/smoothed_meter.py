"""The angle of a moving sensor as samples arrive, from gyros and gravity, by a smoother with a fixed lag.

A Kalman filter runs over time steps of about 20 ms. The reported angle lags behind the newest sample and
uses all samples up to it. For this the model of every step within the lag is computed again from the
present estimate of the disturbance around it. docs/theory.md explains the model.

The uncertainty of the displayed angle includes the calibration. Impossible values are reported and increase
the uncertainty. They are a length of gravity at rest that contradicts the calibration, and a zero rate that
the gyros' calibration excludes, such as with the file of another sensor.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees, wrap_radians
from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.device.sensor.settings import Configuration, white_noise_gain
from adis_gonio.live.motion_model import (
    AHEAD_S,
    ANGLE,
    BACK_S,
    BEGIN_S,
    BEND,
    G_X,
    G_Y,
    LEAST_STEPS,
    LEVER_X,
    LEVER_Y,
    OPEN_DEG,
    SCALE,
    ZERO,
    Disturbance,
    GyroKnowledge,
    Increment,
    MotionModel,
    Passed,
    Sensing,
    StateEstimate,
    Stepper,
    TimeStep,
    Turned,
    advance,
    coloured,
    disturbance_of,
    slow_drift_mg,
    smooth_lagged,
)
from adis_gonio.record.blocks import Block, session_columns
from adis_gonio.record.source import Measuring

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration

__all__ = ["LAG_S", "AngleSmoother", "GyroKnowledge", "Sensing", "SmoothedAngle"]

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
    """Detect turns out of the plane of X and Y, which the model of the angle assumes.

    The zero rates of the gyros are estimated at rest. Before the first rest they are unknown, and turns are
    detected by gravity alone.
    """

    def __init__(self, length_s: float) -> None:
        self._rows: deque[Floats] = deque(maxlen=max(4, round(SPAN_S / length_s)))
        self._zero: Floats | None = None

    def see(self, rate_dps: Floats, accel_mg: Floats) -> float:
        """Add a time step; return the error (°/s) of the angle's rate because of turns out of the plane.

        It is 0 before the first rest.
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
        """Delete the stored time steps, because a gap in the samples follows."""
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
    accel_mg : (3,) float
        Mean reading of the accelerometers in the time step of this angle.
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
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Seen:
    """A time step of the recording, with the direction of gravity reduced to a fixed attitude.

    `segment` is the number of gaps before the step. `level` is gravity in the plane (x + i y), turned back
    by the gyros to the attitude after the last gap. `turned` is the step itself, `notes` are remarks for
    the user.
    """

    turned: Turned
    level: complex
    segment: int
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
    bend : float
        Standard deviation of the relative error in the slope of the angle that gravity shows, as a function
        of the true angle; the default `motion_model.BEND` is for uncalibrated accelerometers.

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
        bend: float = BEND,
    ) -> None:
        if not 0 <= lag_s <= LONGEST_LAG_S:
            raise UsageError(f"the lag is {lag_s:g} s: take 0 to {LONGEST_LAG_S:g}")
        self._sensing = sensing
        self._gyros = gyros or GyroKnowledge()
        self._corrected = corrected
        self._model = MotionModel(sensing, self._gyros, bend)
        step_s = sensing.step_samples * sensing.period_s
        self._lag = round(lag_s / step_s)
        self._back = max(2 * LEAST_STEPS, round(BACK_S / step_s))
        self._ahead = round(AHEAD_S / step_s)
        self._seen: deque[_Seen] = deque()
        self._waiting: tuple[Increment, Increment | None] | None = None
        self._stepper = Stepper(sensing)
        self._plane = PlaneWatch(step_s)
        self._state: StateEstimate | None = None
        self._done = 0
        """Number of steps in `_seen` that are older than the lag."""
        self._phase_rad, self._segment = 0.0, 0
        self._restarted = self._doubted = False

    # -- taking samples ------------------------------------------------------------------------------

    def feed(
        self, time_s: Floats, accel_mg: Floats, gyro_dps: Floats, temperature_c: Floats | None = None
    ) -> None:
        """Add samples: increasing times (n,), readings (n, 3), rates (n, 3), temperatures (n,) or None."""
        for increment in self._stepper.feed(time_s, accel_mg, gyro_dps, temperature_c):
            self._arrive(increment)

    def restart(self) -> None:
        """Start again after a break of the link, when the sensor may have been turned or switched off.

        The estimated errors of the gyro are kept. The angle starts from gravity again, since the sensor's
        clock may have been reset too.
        """
        self._stepper = Stepper(self._sensing)
        self._waiting = None
        self._restarted = True

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
            self._state = self._model.begin(turned.gravity_deg)
        events = {
            "gap": turned.lost or present.gap_s > 0,
            "saturated": present.saturated,
            "out_of_plane": self._plane.out_of_plane,
        }
        notes = tuple(name for name, holds in events.items() if holds)
        self._seen.append(_Seen(turned, self._level(turned), self._segment, notes))
        while len(self._seen) - self._done > self._lag:
            self._pass(self._state)
        while self._done > self._back + 1:
            self._seen.popleft()
            self._done -= 1

    def _pass(self, state: StateEstimate) -> None:
        """Advance the Kalman filter by the oldest waiting time step, from `state`."""
        passed = advance(state, self._step_of(self._done, state))
        self._state = self._doubt_calibration(passed.filtered)
        self._done += 1

    def _doubt_calibration(self, state: StateEstimate) -> StateEstimate:
        """Return the state, with larger uncertainties if its zero rate contradicts the gyros' calibration.

        It contradicts if it is above `DOUBT` standard uncertainties that the calibration states for it. The
        variances of an uncalibrated gyro are then added to the variances of the state, only once.
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
        lost = self._restarted or present.unseen_deg2 > (OPEN_DEG / 2) ** 2
        self._restarted = False
        warm = present.temperature_c
        accel = present.accel_mg
        gravity = accel if self._corrected is None else self._corrected(accel, warm)
        rate = self._gyros.corrected(present.rate_dps, accel, warm)
        length_s = present.length_s
        turn = present.turned_deg
        force = accel
        if length_s > 0 and before is not None:
            force = 0.5 * (accel + before.accel_mg)
            turn = self._gyros.corrected(turn / length_s, force, warm) * length_s
        earlier = present if before is None or present.gap_s > BEGIN_S else before
        later = present if after.gap_s > BEGIN_S else after
        span_s = later.time_s - earlier.time_s
        # Change of the rate over the two neighbouring steps.
        spin = math.radians(float(later.rate_dps[2] - earlier.rate_dps[2])) / span_s if span_s > 0 else 0.0
        across = self._plane.see(present.rate_dps, accel)
        return Turned(
            present, float(turn[2]), complex(gravity[0], -gravity[1]), force[:2] / 1000.0,
            float(rate[2]), spin, across, lost,
        )  # fmt: skip

    def _level(self, turned: Turned) -> complex:
        """Return gravity (complex, mg) rotated back by the turn that the gyro measured since the last gap.

        The known errors of the gyro and the acceleration by the distance from the axis are removed.
        """
        assert self._state is not None
        known = self._state.mean
        # Turn by the gyro without its known errors, and gravity without the lever arm.
        drift_dps = known[ZERO] + turned.force_g @ known[[G_X, G_Y]]
        turn = turned.turn_deg * (1 - known[SCALE]) - drift_dps * turned.increment.length_s
        self._phase_rad = wrap_radians(self._phase_rad + math.radians(float(turn)))
        by_x, by_y = turned.lever_mg
        felt = turned.gravity - by_x * float(known[LEVER_X]) - by_y * float(known[LEVER_Y])
        return felt * complex(math.cos(self._phase_rad), -math.sin(self._phase_rad))

    # -- the model of a step -------------------------------------------------------------------------

    def _disturbance(self, place: int) -> Disturbance:
        seen = self._seen[place]
        if seen.turned.increment.saturated:
            return coloured(self._sensing.step_noise_mg2, SATURATED_MG**2, 0.9, 0.8)
        first, last = max(0, place - self._back), min(len(self._seen), place + self._ahead + 1)
        # Only steps within the lag count after it, so that the result does not depend on the blocks.
        last = min(last, place + self._lag + 1)
        span = [self._seen[k] for k in range(first, last)]
        # Steps without a break between them and this one.
        alike = [k for k, one in enumerate(span) if one.segment == seen.segment]
        level = np.array([span[k].level for k in alike])
        return disturbance_of(level, alike.index(place - first), self._sensing.step_noise_mg2)

    def _step_of(self, place: int, before: StateEstimate) -> TimeStep:
        return self._model.step(self._seen[place].turned, self._disturbance(place), before)

    # -- the angle -----------------------------------------------------------------------------------

    def angle(self) -> SmoothedAngle | None:
        """Return the angle at one lag before the newest sample, estimated from all samples so far.

        None until a lag has passed.
        """
        if self._state is None or not self._done:
            return None
        state, passed = self._state, list[Passed]()
        # Filter through the lag with the present models, then smooth back to its beginning.
        for place in range(self._done, len(self._seen)):
            passed.append(advance(state, self._step_of(place, state)))
            state = passed[-1].filtered
        state = smooth_lagged(self._state, passed)
        at = self._seen[self._done - 1].turned
        mean, u = state.mean, np.sqrt(np.maximum(np.diag(state.covariance), 0.0))
        notes = tuple(name for name in _NOTES if any(name in one.notes for one in self._seen))
        drift_dps = mean[ZERO] + at.force_g @ mean[[G_X, G_Y]]
        return SmoothedAngle(
            self._time_s(at),
            wrap_degrees(float(mean[ANGLE])),
            math.hypot(float(u[ANGLE]), self._drift_deg(at)),
            at.rate_dps * (1 - float(mean[SCALE])) - float(drift_dps),
            float(mean[ZERO]),
            float(u[ZERO]),
            at.increment.accel_mg,
            (*notes, "gyro_calibration") if self._doubted else notes,
        )

    def _time_s(self, at: Turned) -> float:
        return at.increment.time_s - self._sensing.delay_s

    def _drift_deg(self, at: Turned) -> float:
        """Return the standard deviation of an angle, in degrees, by 1/f noise too slow for the state."""
        return math.degrees(slow_drift_mg(self._sensing.drift_mg) / max(abs(at.gravity), 1.0))


GENERIC_WALK_DEG = 0.021
"""Standard deviation, in degrees, of the angle by integrated noise after one second, for gyros of unknown
noise (ADIS16350 data sheet, B)."""
LENGTH_K = 3.0
"""Error of the length of gravity, in standard uncertainties, above which a calibration is rejected."""
LENGTH_FLOOR = 1e-3
"""Standard uncertainty of the length of gravity, as a share of it, that is added to the calibration's:
gravity differs from place to place, and biases change with temperature."""
Z_ERROR = 0.05
"""Relative error of the reading of Z that is allowed if a calibration in the plane does not determine Z
(ADIS16350 data sheet, B and D)."""
_BEND_PER_U = 2.0
"""Ratio of the largest slope of an angle error with two cycles per turn to its amplitude."""


@dataclass(frozen=True)
class Smoothed:
    """The smoothed angle for display.

    Attributes
    ----------
    smoothed_deg, smoothed_u_deg : float
        Angle at one lag before the newest sample, within ±180°. Its zero is the zero of `corrected_deg`
        with a calibration, else of `angle_deg`. Standard uncertainty by noise, motion, drift and
        calibration.
    lag_s : float
        Age of the angle at the end of the span: the smoother's lag, its time step, and the delay of the
        chip's filter.
    rate_dps : float
        Rate of turn at the time of the angle.
    gyro_zero_dps, gyro_zero_u_dps : float
        Estimated zero rate that the gyro has after its calibration, and its standard uncertainty.
    notes : tuple of str
        Events within the last second or so: `gap`, `saturated`, `out_of_plane`; `calibration` or
        `gyro_calibration` if the calibration of accelerometers or gyros does not belong to this part.
    """

    smoothed_deg: float
    smoothed_u_deg: float
    lag_s: float
    rate_dps: float
    gyro_zero_dps: float
    gyro_zero_u_dps: float
    notes: tuple[str, ...]


def sensing_of(measuring: Measuring, part: str, noise_mg: float) -> Sensing:
    """Return the properties of a sensor that the smoother needs, from its settings and its variant.

    Parameters
    ----------
    measuring : Measuring
        Settings of the sensor.
    part : str
        Name of the sensor's variant.
    noise_mg : float
        Noise (rms) of a sample at rest, after the filter.
    """
    period_s = measuring.sample_period_s
    settings = measuring if isinstance(measuring, Configuration) else None
    filter_m = settings.filter_m if settings else 0
    range_dps = settings.gyro_range_dps if settings else None
    known = VARIANTS[part].performance if part in VARIANTS else None
    return Sensing(
        period_s,
        noise_mg / white_noise_gain(filter_m),
        known.gyro_noise_dps if known else GENERIC_WALK_DEG / math.sqrt(period_s),
        filter_m,
        range_dps,
        known.bias_instability_mg if known else 0.0,
    )


class SmoothedMeter:
    """Passes blocks of samples to a smoother; adds the calibration's uncertainty to its angle.

    Parameters
    ----------
    sensing : Sensing
        Properties of the sensor.
    calibration : Calibration or None
        Calibration for the sensor's present offsets (`calibration_for`); None for uncalibrated angles.
    lag_s : float
        Delay of the reported angle; 0 for the filter without smoothing.
    """

    def __init__(
        self, sensing: Sensing, calibration: Calibration | None = None, *, lag_s: float = LAG_S
    ) -> None:
        self._calibration = calibration
        self._period_s = sensing.period_s
        self._drift_rad = sensing.drift_mg / sensing.gravity_mg
        gyro = None if calibration is None else calibration.gyro
        stated = {} if gyro is None else {one.name: one.u for one in gyro.parameters}
        self._smoother = AngleSmoother(
            sensing,
            GyroKnowledge.of(gyro, stated),
            lag_s=lag_s,
            corrected=None if calibration is None else self._corrected,
            bend=BEND if calibration is None else _bend_of(calibration),
        )
        self._off = 0.0
        """Relative error of gravity's length at the last rest if it contradicts the calibration, else 0."""

    def feed(self, block: Block) -> None:
        """Add a block of samples; a block without gyro readings is ignored."""
        columns = session_columns(block)
        if not len(block) or not all(name in columns for name in ("gx", "gy", "gz")):
            return
        gyro = np.column_stack([columns[name] for name in ("gx", "gy", "gz")])
        self._smoother.feed(block.time_s, block.accel_mg, gyro, columns.get("temp_c"))

    def restart(self) -> None:
        """Start again after the link to the sensor broke; the estimated errors of the gyro are kept."""
        self._smoother.restart()

    def take_rest(self, mean_mg: Floats, temperature_c: float | None) -> None:
        """Check the calibration at rest: compare the length of the reading `mean_mg` with local gravity.

        `temperature_c` is None if the sensor reports none: the mean of the calibration's session is taken.
        If the length differs from local gravity by more than the uncertainties allow, the difference is
        added to the uncertainty of later angles, with a note.
        """
        calibration = self._calibration
        if calibration is None:
            return
        gravity = self._corrected(mean_mg, temperature_c) / calibration.gravity_mg
        along = math.hypot(float(gravity[0]), float(gravity[1]))
        if along < 0.1:
            return
        # A calibration in the plane has no Z: use the raw reading of Z, with a larger error.
        planar = len(gravity) < 3
        z = float(mean_mg[2]) / calibration.gravity_mg if planar else float(gravity[2])
        # Relative error of the length of gravity, and the largest allowed error.
        off = abs(math.hypot(along, z) - 1.0)
        _, u_deg = corrected_angle(calibration, mean_mg, temperature_c)
        across = abs(z) * Z_ERROR if planar else 0.0
        allowed = math.hypot(math.radians(u_deg or 0.0), 3 * self._drift_rad, LENGTH_FLOOR, across)
        self._off = off if off > LENGTH_K * allowed else 0.0

    def reading(self, end_s: float) -> Smoothed | None:
        """Return the smoothed angle at one lag before `end_s`, the time of the last sample.

        None until a lag has passed.
        """
        angle, calibration = self._smoother.angle(), self._calibration
        if angle is None:
            return None
        shown_deg, u_deg, notes = angle.angle_deg, angle.u_deg, angle.notes
        if calibration is not None:
            if "alpha" in calibration:
                shown_deg = wrap_degrees(shown_deg + calibration["alpha"].value)
            _, by_calibration = corrected_angle(calibration, angle.accel_mg, None)
            u_deg = math.hypot(u_deg, by_calibration or 0.0, math.degrees(self._off))
            notes = (*notes, "calibration") if self._off else notes
        return Smoothed(
            shown_deg, u_deg, end_s - angle.time_s, angle.rate_dps, angle.zero_dps, angle.zero_u_dps, notes
        )

    def _corrected(self, accel_mg: Floats, temperature_c: float | None) -> Floats:
        """Return the calibrated gravity vector (3,) in mg; zeros if the calibration cannot compute it.

        `temperature_c` None takes the mean of the calibration's session.
        """
        assert self._calibration is not None
        gravity = self._calibration.apply(accel_mg, temperature_c) * self._calibration.gravity_mg
        return np.nan_to_num(gravity)


def corrected_angle(
    calibration: Calibration, mean_mg: Floats, temperature_c: float | None, u_mg: Floats | None = None
) -> tuple[float | None, float | None]:
    """Return the angle of a reading by a calibration, and its standard uncertainty, in degrees.

    The angle is positive for the stage's positive turn. Both results are None if the calibration refuses
    the reading, for example because its length is far from gravity. The uncertainty alone is None if it is
    not finite.

    Parameters
    ----------
    mean_mg : (3,) float
        The reading.
    temperature_c : float or None
        Its temperature; None for the mean of the session.
    u_mg : (3,) float, optional
        Standard uncertainty of the reading; without it u is the uncertainty by the calibration alone.
    """
    reading_u = None if u_mg is None else [float(u) for u in u_mg[: calibration.axes]]
    try:
        if "alpha" in calibration:
            by = calibration.stage_angle(mean_mg, temperature_c, reading_u=reading_u)
            angle_deg = float(by.angle_deg)
        else:
            by = calibration.angle(mean_mg, temperature_c, reading_u=reading_u, plane="xy")
            angle_deg = -float(by.angle_deg)
    except UsageError:
        return None, None
    u_deg = float(by.u_deg)
    return angle_deg, u_deg if math.isfinite(u_deg) else None


def _bend_of(calibration: Calibration) -> float:
    """Return the standard uncertainty of the slope of the calibrated angle as a function of the true angle.

    The slope is 1 for a perfect calibration. Its uncertainty is derived from the largest uncertainty of the
    angle over the turn, without the uncertainty of the start angle.
    """
    # Standard uncertainty of the angle at eight angles over a turn.
    psi = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    unit = np.stack([np.cos(psi), np.sin(psi), np.zeros(8)], axis=1)[:, : calibration.axes]
    u_deg = calibration.angle(calibration.readings_of(unit), plane="xy").u_deg
    u_deg = u_deg[np.isfinite(u_deg)]
    return _BEND_PER_U * math.radians(float(u_deg.max())) if u_deg.size else BEND
