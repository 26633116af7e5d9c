"""Verification of a write-back: dwells at rest are compared with the session and with the plan.

A dwell is read by polling, with read frames only, so that no register except the offsets is ever written.
At a declared angle the session's fit predicts both readings; without an angle, only the magnitude of
gravity. The comparison includes the uncertainties of the parameters (with their covariance), of the dwell,
of the angle, of the drift between the recording and now, and of a different temperature.

The autonull of the chip takes the present outputs of the gyros for zero rates, so that its offsets include
the gyros' noise and the effect of force in this pose. The session predicts this sum with its uncertainty.
If offsets and prediction differ by more than both uncertainties allow, one of them is wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences
from adis_gonio.base.errors import FitError, SessionError, UsageError
from adis_gonio.base.jsonable import NAMED_BY_UNIT, JsonRecord
from adis_gonio.base.numbers import format_fixed, format_number, signed
from adis_gonio.bench.writeback.offset_plan import UNITS, WritePlan, plan_gyro_offsets, plan_offsets
from adis_gonio.calibrate.calibration import STEP
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.device.sensor.registers import (
    ACCEL_OFF,
    ACCEL_OUT,
    GYRO_OFF,
    GYRO_OUT,
    TEMP_OUT,
    Kind,
    variant,
)
from adis_gonio.device.sensor.scanning import ScanStream
from adis_gonio.device.sensor.settings import Configuration, ScanBlock, join, mean_at_rest, white_noise_gain
from adis_gonio.fitting.fit_result import calibration_as_recorded
from adis_gonio.fitting.gyros.gyro_fit import GyroFit, fit_gyro
from adis_gonio.fitting.methods import fit
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.records import Session
from adis_gonio.record.source import LEAST_SAMPLES
from adis_gonio.record.stillness import NoiseMeter, StillnessWatch, limits_from_noise, window_samples
from adis_gonio.record.write_journal import Numbers

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration
    from adis_gonio.fitting.fit_result import FitResult

REGISTERS = (*ACCEL_OUT, "XTEMP_OUT", "SUPPLY_OUT")


def _not_read() -> Floats:
    return np.full(3, np.nan)


@dataclass(frozen=True)
class Rest:
    """Mean readings of the sensor over a dwell at rest.

    Attributes
    ----------
    mean_mg, u_mg : (3,) float
        Mean reading in mg and its standard uncertainty by noise and rounding.
    temperature_c, supply_v : float
        Mean temperature of the X gyro's die (°C) and mean supply (V).
    samples : int
        Number of samples.
    mean_dps, u_dps : (3,) float
        Mean rates in °/s and their standard uncertainties; NaN if the gyros were not read.
    temperatures_c : (3,) float
        Temperatures of the gyros' dies in °C; NaN if the gyros were not read.
    """

    mean_mg: Floats
    u_mg: Floats
    temperature_c: float
    supply_v: float
    samples: int
    mean_dps: Floats = field(default_factory=_not_read)
    u_dps: Floats = field(default_factory=_not_read)
    temperatures_c: Floats = field(default_factory=_not_read)


def measure(sensor: Adis16354, dwell_s: float, patience_s: float, *, gyros: bool = False) -> Rest:
    """Wait until the sensor is at rest, then record a dwell with its present settings.

    Parameters
    ----------
    sensor : Adis16354
        Open sensor; its registers are not written.
    dwell_s : float
        Length of the dwell in s.
    patience_s : float
        Time to wait for rest, in s; a bridge that needs longer to measure the noise gets more.
    gyros : bool
        True to read the gyros too.

    Raises
    ------
    UsageError
        The dwell is too short for the sensor's rate.
    SessionError
        The sensor does not come to rest or moves within the dwell, or an axis is stuck.
    BusError, SilentChipError
        The sensor does not answer.
    """
    now = sensor.configuration()
    if dwell_s < LEAST_SAMPLES * now.sample_period_s:
        raise UsageError(
            f"a dwell of {dwell_s:g} s is too short at {now.sample_rate_hz:.4g} samples a second: take"
            f" {LEAST_SAMPLES * now.sample_period_s:.3g} s or more, or set SMPL_PRD"
        )
    window = window_samples(now)
    block = max(8, window // 2)
    names = (*REGISTERS, *GYRO_OUT, *TEMP_OUT[1:]) if gyros else REGISTERS
    with sensor.stream(names, block_scans=block, leave_registers=True, data_ready=False) as stream:
        noise = _noise(sensor, stream, now, patience_s)
        scans = _dwell(sensor, stream, noise, window, dwell_s)
    part = sensor.variant
    mean, u = mean_at_rest(scans.accel_mg, part.accel_mg_per_lsb, now.filter_m)
    warm = float(scans.column("XTEMP_OUT").mean())
    rest = Rest(mean, u, warm, float(scans.supply_v.mean()), len(scans))
    if not gyros:
        return rest
    lsb = part.lsb(Kind.GYRO, now.gyro_range_dps or 300)[0]
    mean, u = mean_at_rest(scans.gyro_dps, lsb, now.filter_m)
    dies = scans.select(TEMP_OUT).values().mean(axis=0)
    return replace(rest, mean_dps=mean, u_dps=u, temperatures_c=dies)


def _noise(sensor: Adis16354, stream: ScanStream, now: Configuration, patience_s: float) -> Floats:
    expected = sensor.variant.performance.noise_mg * white_noise_gain(now.filter_m)
    meter = NoiseMeter(window_samples(now), expected)
    seen, begin_s = 0, sensor.bus.now_s()
    for scans in stream:
        noise = meter.feed(scans.accel_mg)
        if noise is not None:
            return noise
        seen += len(scans)
        # A slow bridge needs more time for the windows that the meter compares.
        if seen > meter.least_samples and sensor.bus.now_s() - begin_s > patience_s:
            break
    raise SessionError(
        f"the part does not come to rest: a sample varies by {max(meter.spread_mg):.3g} mg, its noise"
        f" should be about {expected:.2g} mg; put it on a quiet support and try again"
    )


def _dwell(sensor: Adis16354, stream: ScanStream, noise: Floats, window: int, dwell_s: float) -> ScanBlock:
    step = sensor.variant.accel_mg_per_lsb
    watch = StillnessWatch(limits_from_noise(noise, window, step), np.maximum(noise, step / np.sqrt(12)))
    watch.anchor(0)
    blocks: list[ScanBlock] = []
    begin_s = sensor.bus.now_s()
    for scans in stream:
        for look in watch.feed(scans.accel_mg):
            if look.state != "still":
                raise SessionError(
                    f"the part moved within the dwell ({look.why}); let it lie and try again"
                )
        blocks.append(scans)
        enough = sum(len(b) for b in blocks) >= max(window, LEAST_SAMPLES)
        if enough and sensor.bus.now_s() - begin_s >= dwell_s:
            break
    return join(blocks)


SIGMAS = 4.0
"""Largest difference in standard uncertainties: a good sensor fails once in 16 000 comparisons."""


class Agreement(JsonRecord):
    """Comparison of measured with expected figures.

    Attributes
    ----------
    what : str
        Text that names the compared figures.
    names : tuple of str
        Name of each figure, such as `X`.
    measured, expected, u : (k,) float
        Measured figures, expected figures, and the standard uncertainty of each difference.
    unit : str
        Unit of the figures: `mg` or `dps`.
    """

    document_keys = ("what", "names", "measured", "expected", "u", "agrees")

    what: str
    names: tuple[str, ...]
    measured: Floats = field(metadata=NAMED_BY_UNIT)
    expected: Floats = field(metadata=NAMED_BY_UNIT)
    u: Floats = field(metadata=NAMED_BY_UNIT)
    unit: str = "mg"

    @property
    def off(self) -> Floats:
        """Differences (k,) measured minus expected, in units of their standard uncertainties."""
        return np.asarray((self.measured - self.expected) / self.u)

    @property
    def agrees(self) -> bool:
        """True if no difference exceeds `SIGMAS` standard uncertainties."""
        return bool((np.abs(self.off) <= SIGMAS).all())

    @property
    def excess(self) -> str:
        """Text with the differences (measured minus expected) that exceed `SIGMAS` uncertainties."""
        unit = UNITS[self.unit]
        each = zip(self.names, self.measured - self.expected, self.u, self.off, strict=True)
        return ", ".join(
            f"{name} {signed(by, 3)} {unit} (u {format_number(u, 2)} {unit})"
            for name, by, u, off in each
            if abs(off) > SIGMAS
        )

    def __str__(self) -> str:
        unit, places = UNITS[self.unit], 2 if self.unit == "mg" else 3
        figures = [
            f"{name} {format_fixed(m, places)} {unit}, expected {format_fixed(e, places)} {unit}"
            f" (u {format_number(u, 2)} {unit})"
            for name, m, e, u in zip(self.names, self.measured, self.expected, self.u, strict=True)
        ]
        return f"{self.what}: {'; '.join(figures)}"


PRECISE_S = 30.0
"""Averaging time of a precision autonull in s (data sheet, A: about 30 s)."""


GYRO_NAMES = tuple(axis.upper() for axis in AXES)
TEMPCO_DPS_PER_C = 0.02
"""Assumed temperature coefficient of a zero rate in °/s/°C if the session does not determine it (D)."""


def compare_effect(part: Accelerometers | Gyros, plan: WritePlan, before: Rest, after: Rest) -> Agreement:
    """Compare the change of the outputs by a write, between two dwells, with the planned change."""
    (first, u_first), (second, u_second) = part.outputs(before), part.outputs(after)
    wander = part.wander(after.temperature_c - before.temperature_c, after.supply_v - before.supply_v)
    rows = [AXES.index(axis.axis) for axis in plan.axes]
    u = np.sqrt(u_first**2 + u_second**2 + wander**2)[rows]
    names = tuple(axis.axis.upper() for axis in plan.axes)
    planned = np.array([axis.effect for axis in plan.axes])
    return Agreement(part.moved, names, (second - first)[rows], planned, u, part.unit)


class Accelerometers:
    """Checks and plans the offsets of a session's accelerometers.

    Parameters
    ----------
    session : Session
        The session.
    method : str or None
        Method by which the session is fitted; None for the method that suits the session best.
    angle_deg : float or None
        Declared angle of the sensor now; None if it is not known.

    Attributes
    ----------
    registers, others : tuple of str
        Offset registers of the accelerometers, and of the gyros.
    moved, unit : str
        Beginning of the message on the effect of a write, and unit of the outputs.
    remarks : tuple of str
        Remarks of the fit for the user.
    """

    registers, others = ACCEL_OFF, GYRO_OFF
    moved, unit = "the write moved the outputs by", "mg"
    remarks: tuple[str, ...] = ()

    def __init__(self, session: Session, method: str | None, angle_deg: float | None) -> None:
        self.session, self._method, self.angle_deg = session, method, angle_deg
        self.figures = variant(session.sensor).performance

    @cached_property
    def result(self) -> FitResult:
        """Fit of the session, by which the biases to cancel are known."""
        return fit(self.session, self._method)

    def plan(self, now: Numbers) -> WritePlan:
        """Plan the new numbers for the offset registers; `now` has the present numbers."""
        return plan_offsets(self.session, self.result, now)

    def expected(self, plan: WritePlan, rest: Rest) -> Agreement:
        """Compare a dwell at rest with the readings that the fit predicts, at the plan's present offsets.

        At the declared angle both readings are compared; without an angle, the magnitude of gravity.

        Raises
        ------
        FitError
            The fit lacks a parameter, or the sensor is not in the session's plane.
        """
        session, result = self.session, self.result
        gains = [f"scale_{axis}" for axis in AXES[: 2 if session.plane == "xy" else 3]]
        missing = [name for name in gains if name not in result]
        if missing or result.covariance is None:
            raise FitError(
                f"{session.source}: the fit does not give {', '.join(missing) or 'uncertainties'}"
            )
        own, axes = calibration_as_recorded(result, nominal=True), len(gains)
        # Readings that the dwell would have at the offsets of the recording.
        offsets = {axis.axis: (axis.now - axis.recorded) * axis.lsb for axis in plan.axes}
        moved = np.array([offsets.get(axis, 0.0) for axis in AXES[:axes]])
        mean, u_mean = rest.mean_mg[:axes] - moved, self._u_of(rest)[:axes]
        fixture = result.fixture_sigma_deg or 0.0
        if self.angle_deg is not None and own.planar and "alpha" in result and math.isfinite(fixture):
            # An angle that is set again: a few positions cannot estimate its uncertainty, and a vernier
            # cannot be read better than 0.05°.
            more = 0.05 if session.fixture_sigma_deg is None else 0.0
            angle, u_angle = np.radians([[self.angle_deg], [math.hypot(fixture, more)]])

            def predicted(values: Floats, angle: Floats) -> Floats:
                base, bias = own.natural(values)
                return np.asarray(own.measurement.ideal(base, np.zeros(1), -angle)[0] + bias)

            value, variance = own.with_variance(lambda values: predicted(values, angle))
            turn = central_differences(lambda at: predicted(own.values, at), angle, STEP, u_angle[None])
            u = np.sqrt(variance + u_mean**2 + turn[:, 0] ** 2)
            where = f"readings at {self.angle_deg:g}° against the session"
            return Agreement(where, ("X", "Y"), mean + moved, value + moved, u)

        def length(values: Floats, mean: Floats) -> Floats:
            base, bias = own.natural(values)
            gravity = own.measurement.calibrated(base, (mean - bias)[None, :])
            return np.asarray(session.gravity_mg * np.linalg.norm(gravity, axis=1))

        value, variance = own.with_variance(lambda values: length(values, mean))
        if value[0] < 0.5 * session.gravity_mg:
            raise FitError(
                f"X and Y read {value[0]:.0f} mg of gravity together: set the part up as in the"
                " session, its plane of rotation vertical"
            )
        noise = central_differences(lambda at: length(own.values, at), mean, STEP, np.diag(u_mean))
        what = "gravity's length by the session's calibration"
        u = np.sqrt(variance + (noise**2).sum(axis=-1))
        return Agreement(what, ("|g|",), value, np.array([session.gravity_mg]), u)

    def _u_of(self, rest: Rest) -> Floats:
        """Return the standard uncertainty (3,) of a dwell's mean in mg, compared with the session.

        The dwell is a sample of the sensor that the session saw, at another temperature.
        """
        seen = [dwell.temperature_c for dwell in self.session.dwells]
        then = [float(temperature.mean()) for temperature in seen if temperature is not None]
        wander = self.wander(rest.temperature_c - float(np.mean(then)) if then else 0.0, 0.0)
        return np.hypot(rest.u_mg, math.hypot(wander, self.result.extra_mg))

    def outputs(self, rest: Rest) -> tuple[Floats, Floats]:
        """Return the mean reading (3,) of a dwell in mg, and its standard uncertainty."""
        return rest.mean_mg, rest.u_mg

    def wander(self, warmer_c: float, volts: float) -> float:
        """Return the standard uncertainty in mg by which a reading wanders between two dwells.

        It comes from the floor of the bias's Allan deviation, and from the second dwell being warmer by
        `warmer_c`; the supply, higher by `volts`, does not count.
        """
        floor = math.sqrt(2) * self.figures.bias_instability_mg
        return math.hypot(floor, self.figures.bias_tempco_mg_per_c * warmer_c)


class Gyros:
    """Checks and plans the offsets of a session's gyros; attributes as of `Accelerometers`."""

    registers, others = GYRO_OFF, ACCEL_OFF
    moved, unit = "the write moved the gyros by", "dps"

    def __init__(self, session: Session) -> None:
        self.session = session
        self.figures = variant(session.sensor).performance

    @cached_property
    def result(self) -> GyroFit:
        """Fit of the gyros, by which the zero rates to cancel are known."""
        return fit_gyro(self.session)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks of the gyro fit on undetermined parameters and on drift."""
        return self.result.warnings

    @cached_property
    def gyro(self) -> GyroCalibration:
        """Calibration of the gyros with the offsets that they had during the recording."""
        made = self.result.calibration_as_recorded()
        if made.covariance is None:
            raise FitError(f"{self.session.source}: the uncertainty of its zero rates is unknown")
        return made

    def plan(self, now: Numbers) -> WritePlan:
        """Plan the new numbers for the offset registers; `now` has the present numbers."""
        return plan_gyro_offsets(self.session, self.gyro, now, self.result.doubts_of_offsets)

    def expected(self, plan: WritePlan, rest: Rest) -> Agreement:
        """Compare the mean rates of a dwell with the zero rates that the session predicts.

        The prediction is for the pose, the temperature and the supply of the dwell, and the plan's present
        offsets.
        """
        moved = np.array([(axis.now - axis.recorded) * axis.lsb for axis in plan.axes])
        zero, of_zero = self.zero(rest)
        u = np.sqrt(rest.u_dps**2 + of_zero**2 + self.wander_since(rest) ** 2)
        what = "zero rates here against the session"
        return Agreement(what, GYRO_NAMES, rest.mean_dps, zero + moved, u, "dps")

    def outputs(self, rest: Rest) -> tuple[Floats, Floats]:
        """Return the mean rates (3,) of a dwell in °/s, and their standard uncertainties."""
        return rest.mean_dps, rest.u_dps

    def wander(self, warmer_c: float, volts: float) -> float:
        """Return the standard uncertainty in °/s by which a rate wanders between two dwells.

        It comes from the floor of the Allan deviation; the second dwell is warmer by `warmer_c` and has a
        supply higher by `volts`.
        """
        return math.hypot(
            math.sqrt(2) * self.figures.gyro_instability_dps,
            TEMPCO_DPS_PER_C * warmer_c,
            self.figures.gyro_supply_sensitivity_dps_per_v * volts,
        )

    def compare_autonull(self, plan: WritePlan, rest: Rest, nulled: Numbers, samples: float) -> Agreement:
        """Compare the zero rates found by the chip's autonull with the session's, in the pose of a dwell.

        Both are for the offsets during the recording, and include the effect of force in this pose.

        Parameters
        ----------
        plan : WritePlan
            Plan of the offsets, which has the numbers during the recording.
        rest : Rest
            A dwell in this pose, with gyros.
        nulled : mapping of str to int
            Numbers that the chip wrote to its registers.
        samples : float
            Number of samples that the autonull averages.
        """
        zero, u = self.zero(rest)
        lsb = plan.axes[0].lsb
        chip = np.array([(axis.recorded - nulled[axis.register]) * lsb for axis in plan.axes])
        # White noise of a mean falls with the root of its length; the dwell before gives its size.
        noise = rest.u_dps * np.sqrt(rest.samples / samples)
        u = np.sqrt(noise**2 + lsb**2 / 12 + u**2 + self.wander_since(rest) ** 2)
        force = ", ".join(signed(each, 3) for each in self.gyro.force_part(rest.mean_mg / 1000))
        what = f"zero rates in this pose by the chip against the session ({force} °/s of it by force)"
        return Agreement(what, GYRO_NAMES, chip, zero, u, "dps")

    def zero(self, rest: Rest) -> tuple[Floats, Floats]:
        """Return the zero rates (3,) in °/s that the session predicts for a dwell, and their u.

        u is the standard uncertainty (3,) in °/s. The zero rates are for the offsets during the recording.
        """
        read = self.gyro.readings_of(
            np.zeros(3), rest.mean_mg / 1000, rest.temperatures_c, supply_v=rest.supply_v
        )
        return read.rate_dps, read.u_dps

    def wander_since(self, rest: Rest) -> float:
        """Return the standard uncertainty in °/s by which a zero rate may have changed since the session.

        It comes from drift in time up to the dwell `rest`, and from the different supply of the dwell if
        the calibration does not include its effect. The effect of another temperature is in u of `zero`.
        """
        then = None if "supply_v" in self.gyro.needs else self.gyro.supply_v
        return self.wander(0.0, 0.0 if then is None else rest.supply_v - then.mean)
