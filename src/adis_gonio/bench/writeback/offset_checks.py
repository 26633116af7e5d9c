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
from collections.abc import Callable
from dataclasses import field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences
from adis_gonio.base.errors import FitError, SessionError, UsageError
from adis_gonio.base.jsonable import NAMED_BY_UNIT, OPTIONAL, JsonRecord
from adis_gonio.base.numbers import format_fixed, signed
from adis_gonio.bench.writeback.offset_plan import BIASES, UNITS, WritePlan, plan_gyro_offsets, plan_offsets
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
from adis_gonio.device.sensor.settings import Configuration, ScanBlock, join, white_noise_gain
from adis_gonio.fitting import fit
from adis_gonio.fitting.gyros.gyro_fit import GyroFit, fit_gyro
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.measurement import FreeAttitude, PlanarTurn
from adis_gonio.model.records import Session
from adis_gonio.record.source import LEAST_SAMPLES
from adis_gonio.record.stillness import NoiseMeter, StillnessWatch, limits_from_noise, window_samples
from adis_gonio.record.write_journal import Numbers

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration
    from adis_gonio.fitting import FitResult

REGISTERS = (*ACCEL_OUT, "XTEMP_OUT", "SUPPLY_OUT")


class Rest(JsonRecord):
    """Mean readings of the sensor over a dwell at rest.

    Attributes
    ----------
    mean_mg, u_mg : (3,) float
        Mean reading in mg and its standard uncertainty by noise and rounding.
    temperature_c, supply_v : float
        Mean temperature of the X gyro's die (°C) and mean supply (V).
    samples : int
        Number of samples.
    mean_dps, u_dps : (3,) float or None
        Mean rates in °/s and their standard uncertainties; None if the gyros were not read.
    sample_dps : (3,) float or None
        Standard deviation of one sample of the gyros in °/s; None if they were not read.
    temperatures_c : (3,) float or None
        Temperatures of the gyros' dies in °C; None if the gyros were not read.
    """

    document_keys = ("mean_mg", "u_mg", "temperature_c", "supply_v", "samples", "mean_dps", "u_dps")

    mean_mg: Floats
    u_mg: Floats
    temperature_c: float
    supply_v: float
    samples: int
    mean_dps: Floats | None = field(default=None, metadata=OPTIONAL)
    u_dps: Floats | None = field(default=None, metadata=OPTIONAL)
    sample_dps: Floats | None = None
    temperatures_c: Floats | None = None

    @property
    def of_gyros(self) -> tuple[Floats, Floats]:
        """Mean rates (3,) in °/s and their standard uncertainties; `UsageError` if no gyros were read."""
        if self.mean_dps is None or self.u_dps is None:
            raise UsageError("the dwell has no gyros")
        return self.mean_dps, self.u_dps


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
    return _means(scans, now)


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


def _means(scans: ScanBlock, now: Configuration) -> Rest:
    values = scans.values()
    part, k = variant(scans.variant), len(AXES)
    mean, u, _ = _mean(values[:, :k], part.accel_mg_per_lsb, now)
    rest = Rest(mean, u, float(values[:, k].mean()), float(values[:, k + 1].mean()), len(scans))
    if len(scans.registers) == len(REGISTERS):
        return rest
    first = len(REGISTERS)
    lsb = part.lsb(Kind.GYRO, scans.gyro_range_dps or 300)[0]
    mean, u, sample = _mean(values[:, first : first + k], lsb, now)
    dies = np.array([rest.temperature_c, *values[:, first + k :].mean(axis=0)])
    return replace(rest, mean_dps=mean, u_dps=u, sample_dps=sample, temperatures_c=dies)


def _mean(values: Floats, lsb: float, now: Configuration) -> tuple[Floats, Floats, Floats]:
    """Return means (3,) of the samples `values` (n, 3), the u of the means (3,), and the noise (3,).

    The noise is the standard deviation of a single sample. `lsb` is the step of the samples, `now` the
    sensor's configuration.
    """
    deviation = values.std(axis=0, ddof=1)
    # The filter does not reduce noise at the lowest frequencies: use the noise of unfiltered samples.
    spread = deviation / white_noise_gain(now.filter_m)
    rounding = lsb / np.sqrt(12) * np.where(deviation > lsb, 1 / np.sqrt(len(values)), 1.0)
    return values.mean(axis=0), np.hypot(spread / np.sqrt(len(values)), rounding), deviation


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
            f"{name} {signed(by, 3)} {unit} (u {u:.2g} {unit})"
            for name, by, u, off in each
            if abs(off) > SIGMAS
        )

    def __str__(self) -> str:
        unit, places = UNITS[self.unit], 2 if self.unit == "mg" else 3
        figures = [
            f"{name} {format_fixed(m, places)} {unit}, expected {format_fixed(e, places)} {unit}"
            f" (u {u:.2g} {unit})"
            for name, m, e, u in zip(self.names, self.measured, self.expected, self.u, strict=True)
        ]
        return f"{self.what}: {'; '.join(figures)}"


class _FittedSensor:
    """Predicts readings of the sensor from the fit of a session, with the uncertainty of fit and dwell.

    Parameters
    ----------
    session, result : Session, FitResult
        The session and its fit.
    plan : WritePlan
        Plan with the present offsets that the prediction takes into account.
    rest : Rest
        Dwell with which the predictions are compared.

    Raises
    ------
    FitError
        The fit lacks a gain or all uncertainties.
    """

    def __init__(self, session: Session, result: FitResult, plan: WritePlan, rest: Rest) -> None:
        self.session, self.result, self.rest = session, result, rest
        planar = session.plane == "xy"
        self.model = PlanarTurn(session.gravity_mg) if planar else FreeAttitude(session.gravity_mg)
        axes = AXES[: self.model.axes]
        names = [*self.model.names, *(f"bias_{axis}" for axis in axes)]
        # Skews and biases that a session did not show are zero in its fit.
        self.known = [name for name in names if name in result]
        missing = [name for name in names if name.startswith("scale") and name not in result]
        if missing or result.covariance is None:
            raise FitError(
                f"{session.source}: the fit does not give {', '.join(missing) or 'uncertainties'}"
            )
        self.values = np.array([result[name].value for name in self.known])
        order = [[e.name for e in result.parameters].index(name) for name in self.known]
        self.covariance = np.asarray(result.covariance)[np.ix_(order, order)]
        moved = {axis.axis: (axis.now - axis.recorded) * axis.lsb for axis in plan.axes}
        self.moved_mg = np.array([moved.get(axis, 0.0) for axis in axes])
        # Standard uncertainty (axes,) of the dwell as a sample of the sensor that the session saw.
        then = [float(d.temperature_c.mean()) for d in session.dwells if d.temperature_c is not None]
        warmer = rest.temperature_c - float(np.mean(then)) if then else 0.0
        figures = variant(plan.variant).performance
        self.u_mg = np.hypot(
            rest.u_mg[: len(axes)],
            math.hypot(
                math.sqrt(2) * figures.bias_instability_mg,
                figures.bias_tempco_mg_per_c * warmer,
                result.extra_mg,
            ),
        )

    def at_angle(self, angle_rad: float) -> Agreement:
        """Compare the dwell's readings at a declared angle with the readings that the fit predicts."""

        def left(values: Floats, mean: Floats) -> Floats:
            return np.asarray(mean[:2] - self._ideal_mg(values, angle_rad) - self._bias_mg(values))

        # An angle that is set again: a few positions cannot estimate its uncertainty, and a vernier cannot
        # be read better than 0.05°.
        more = 0.05 if self.session.fixture_sigma_deg is None else 0.0
        sigma = math.radians(math.hypot(self.result.fixture_sigma_deg or 0.0, more))
        tangent = self.model.tangent(self._base(self.values), np.zeros(1), np.array([-angle_rad]))
        value, u = self._propagated(left, sigma * np.abs(tangent[0, :, 0]))
        predicted = self._ideal_mg(self.values, angle_rad) + self._bias_mg(self.values)
        where = f"readings at {math.degrees(angle_rad):g}° against the session"
        return Agreement(where, ("X", "Y"), predicted + value, predicted, u)

    def by_length(self) -> Agreement:
        """Compare the magnitude of gravity, by the session's calibration, with local gravity.

        Raises
        ------
        FitError
            The sensor is not in the session's plane.
        """
        gravity = self.session.gravity_mg

        def length(values: Floats, mean: Floats) -> Floats:
            free = (mean[: self.model.axes] - self._bias_mg(values))[None, :]
            calibrated = self.model.calibrated(self._base(values), free)
            return np.asarray(gravity * np.linalg.norm(calibrated, axis=1))

        value, u = self._propagated(length, np.zeros(1))
        if value[0] < 0.5 * gravity:
            raise FitError(
                f"X and Y read {value[0]:.0f} mg of gravity together: set the part up as in the"
                " session, its plane of rotation vertical"
            )
        what = "gravity's length by the session's calibration"
        return Agreement(what, ("|g|",), value, np.array([gravity]), u)

    def _base(self, values: Floats) -> Floats:
        """Convert values of the fitted parameters to the parameters of the model.

        The result is in natural units (rad for angles, 1 for gains). Parameters that were not fitted have
        their nominal value.
        """
        held = dict(zip(self.known, values, strict=True))
        return np.array(
            [held[p.name] / p.per_natural if p.name in held else p.nominal for p in self.model.parameters]
        )

    def _bias_mg(self, values: Floats) -> Floats:
        """Return the biases (axes,) in mg with the present numbers in the offset registers.

        `values` has a value for each fitted parameter of the model.
        """
        held = dict(zip(self.known, values, strict=True))
        found = [held.get(name, 0.0) for name in BIASES[: self.model.axes]]
        return np.asarray(np.array(found) + self.moved_mg)

    def _ideal_mg(self, values: Floats, angle_rad: float) -> Floats:
        """Return the readings (2,) in mg by gravity alone, without bias, at a declared angle.

        `values` has a value for each fitted parameter of the model.
        """
        return np.asarray(self.model.ideal(self._base(values), np.zeros(1), np.array([-angle_rad]))[0])

    def _propagated(
        self, function: Callable[[Floats, Floats], Floats], more_u: Floats
    ) -> tuple[Floats, Floats]:
        """Return the value (k,) of a function, and its standard uncertainty.

        The uncertainty comes from the fit, the dwell and the declared angle. `function` takes the values of
        the fitted parameters and the mean reading of the dwell. `more_u` (k,) is the standard uncertainty
        from the declared angle alone.
        """
        mean = self.rest.mean_mg
        by_parameter = _slopes(lambda v: function(v, mean), self.values)
        by_reading = _slopes(lambda m: function(self.values, m), mean[: self.model.axes])
        # Variances from the parameters, from the reading, and from the declared angle.
        variance = np.einsum("kp,pq,kq->k", by_parameter, self.covariance, by_parameter)
        variance = variance + (by_reading**2) @ self.u_mg**2 + more_u**2
        return function(self.values, mean), np.sqrt(variance)


def _slopes(function: Callable[[Floats], Floats], at: Floats) -> Floats:
    """Return the derivatives ∂f/∂x (k, p) of a function at a point by central differences.

    All functions here are smooth over the step of 1e-4.
    """
    return central_differences(function, at, 1e-4 * np.maximum(1.0, np.abs(at)))


PRECISE_S = 30.0
"""Averaging time of a precision autonull in s (data sheet, A: about 30 s)."""


GYRO_NAMES = tuple(axis.upper() for axis in AXES)
TEMPCO_DPS_PER_C = 0.02
"""Assumed temperature coefficient of a zero rate in °/s/°C if the session does not determine it (D)."""


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
    """

    registers, others = ACCEL_OFF, GYRO_OFF
    remarks: tuple[str, ...] = ()

    def __init__(self, session: Session, method: str | None, angle_deg: float | None) -> None:
        self.session, self._method, self.angle_deg = session, method, angle_deg

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
        sensor = _FittedSensor(self.session, self.result, plan, rest)
        planar = self.session.plane == "xy" and "alpha" in self.result
        if self.angle_deg is None or not planar or not math.isfinite(self.result.fixture_sigma_deg or 0.0):
            return sensor.by_length()
        return sensor.at_angle(math.radians(self.angle_deg))

    def effect(self, plan: WritePlan, before: Rest, after: Rest) -> Agreement:
        """Compare the change of the outputs by the write, between two dwells, with the planned change."""
        figures = variant(plan.variant).performance
        rows = [AXES.index(axis.axis) for axis in plan.axes]
        # Between neighbouring dwells the bias wanders by the floor of its Allan deviation and the warmth.
        wander = math.hypot(
            math.sqrt(2) * figures.bias_instability_mg,
            figures.bias_tempco_mg_per_c * (after.temperature_c - before.temperature_c),
        )
        u = np.sqrt(before.u_mg**2 + after.u_mg**2 + wander**2)[rows]
        names = tuple(axis.axis.upper() for axis in plan.axes)
        planned = np.array([axis.effect for axis in plan.axes])
        moved = (after.mean_mg - before.mean_mg)[rows]
        return Agreement("the write moved the outputs by", names, moved, planned, u)


class Gyros:
    """Checks and plans the offsets of a session's gyros."""

    registers, others = GYRO_OFF, ACCEL_OFF

    def __init__(self, session: Session) -> None:
        self.session = session
        self._figures = variant(session.sensor).performance

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
        mean, u = rest.of_gyros
        moved = np.array([(axis.now - axis.recorded) * axis.lsb for axis in plan.axes])
        zero, of_zero = self.zero(rest)
        u = np.sqrt(u**2 + of_zero**2 + self.wander(rest) ** 2)
        return Agreement("zero rates here against the session", GYRO_NAMES, mean, zero + moved, u, "dps")

    def effect(self, plan: WritePlan, before: Rest, after: Rest) -> Agreement:
        """Compare the change of the rates by the write, between two dwells, with the planned change."""
        (first, u_first), (second, u_second) = before.of_gyros, after.of_gyros
        wander = math.hypot(
            math.sqrt(2) * self._figures.gyro_instability_dps,
            TEMPCO_DPS_PER_C * (after.temperature_c - before.temperature_c),
            self._figures.gyro_supply_sensitivity_dps_per_v * (after.supply_v - before.supply_v),
        )
        u = np.sqrt(u_first**2 + u_second**2 + wander**2)
        planned = np.array([axis.effect for axis in plan.axes])
        return Agreement("the write moved the gyros by", GYRO_NAMES, second - first, planned, u, "dps")

    def compare_autonull(
        self, plan: WritePlan, rest: Rest, nulled: Numbers, samples: float | None
    ) -> Agreement:
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
        samples : float or None
            Number of samples that a precision autonull averages; None for the quick autonull, which takes
            one filtered sample.

        Raises
        ------
        UsageError
            The dwell has no gyros.
        """
        if rest.sample_dps is None or rest.u_dps is None:
            raise UsageError("an autonull needs a dwell with gyros for comparison")
        zero, u = self.zero(rest)
        lsb = plan.axes[0].lsb
        chip = np.array([(axis.recorded - nulled[axis.register]) * lsb for axis in plan.axes])
        # White noise of a mean falls with the root of its length; the dwell before gives its size.
        noise = rest.sample_dps if samples is None else rest.u_dps * np.sqrt(rest.samples / samples)
        u = np.sqrt(noise**2 + lsb**2 / 12 + u**2 + self.wander(rest) ** 2)
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

    def wander(self, rest: Rest) -> float:
        """Return the standard uncertainty in °/s by which a zero rate may have changed since the session.

        It comes from drift in time up to the dwell `rest`, and from the different temperature and supply of
        the dwell if the calibration does not include their effect.
        """
        known, then = self.gyro.needs, (self.gyro.temperature_c, self.gyro.supply_v)
        warmer = 0.0 if then[0] is None else rest.temperature_c - then[0].mean
        volts = 0.0 if then[1] is None else rest.supply_v - then[1].mean
        return math.hypot(
            math.sqrt(2) * self._figures.gyro_instability_dps,
            0.0 if "temperature_c" in known else TEMPCO_DPS_PER_C * warmer,
            0.0 if "supply_v" in known else self._figures.gyro_supply_sensitivity_dps_per_v * volts,
        )


def part_of(
    session: Session, *, gyros: bool, method: str | None = None, angle_deg: float | None = None
) -> Accelerometers | Gyros:
    """Return the object that plans and checks the offsets of a session's gyros or accelerometers.

    Parameters
    ----------
    gyros : bool
        True for the gyros, False for the accelerometers.
    method : str or None
        Method of the fit of the accelerometers; None for the best method.
    angle_deg : float or None
        Declared angle of the sensor now; None if it is not known.

    Raises
    ------
    UsageError
        A method for the accelerometers is given for the gyros.
    """
    if not gyros:
        return Accelerometers(session, method, angle_deg)
    if method is not None:
        raise UsageError(f"{Path(session.source).name}: --method is for accelerometers; leave it out")
    return Gyros(session)
