"""Which half of the sensor is written: its accelerometers or its gyros. The writer knows no more of it.

A part says which registers these are, plans them by the session's own calibration, takes a dwell, and
compares dwells with what that calibration says.
"""

from __future__ import annotations

import math
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.bench.writeback.checks import Agreement, against_session, bias_found, effect_of
from adis_gonio.bench.writeback.plan import WritePlan, plan_gyro_offsets, plan_offsets
from adis_gonio.bench.writeback.rest import Rest, measure
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.device.sensor.registers import ACCEL_OFF, GYRO_OFF
from adis_gonio.device.sensor.variants import variant
from adis_gonio.fitting import fit
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.records import Session
from adis_gonio.record.write_journal import Numbers
from adis_gonio.tracing.trace_calibrations import gyro_estimates_of, gyros_as_recorded

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration
    from adis_gonio.fitting import FitResult
    from adis_gonio.fitting.gyros.gyro_fit import GyroEstimates

TEMPCO_DPS_PER_C = 0.02
"""What a zero rate may follow the temperature by where the session does not tell (D, as the catalogue)."""


class Accelerometers:
    """The accelerometers of a session that is fitted.

    Parameters
    ----------
    angle_deg : float or None
        Declared angle at which the part stands.
    """

    registers, others, unit = ACCEL_OFF, GYRO_OFF, "mg"
    remarks: tuple[str, ...] = ()

    def __init__(self, session: Session, method: str | None, angle_deg: float | None) -> None:
        self.session, self._method, self._angle_deg = session, method, angle_deg

    @cached_property
    def result(self) -> FitResult:
        """The fit whose biases are written."""
        return fit(self.session, self._method)

    def plan(self, now: Numbers) -> WritePlan:
        """As `plan_offsets`."""
        return plan_offsets(self.session, self.result, now)

    def measure(self, sensor: Adis16354, dwell_s: float, patience_s: float) -> Rest:
        """As `rest.measure`."""
        return measure(sensor, dwell_s, patience_s)

    def expected(self, plan: WritePlan, rest: Rest) -> Agreement:
        """As `against_session`."""
        return against_session(self.session, self.result, plan, rest, self._angle_deg)

    def effect(self, plan: WritePlan, before: Rest, after: Rest) -> Agreement:
        """As `effect_of`."""
        return effect_of(plan, before, after)

    def found(self, plan: WritePlan, rest: Rest) -> tuple[Floats, Floats] | None:
        """As `bias_found`, where the angle is declared."""
        if self._angle_deg is None or self.session.plane != "xy" or "alpha" not in self.result:
            return None
        return bias_found(self.session, self.result, plan, rest, self._angle_deg)


class Gyros:
    """The gyros of a session that calibrates them."""

    registers, others, unit = GYRO_OFF, ACCEL_OFF, "dps"

    def __init__(self, session: Session) -> None:
        self.session = session
        self._figures = variant(session.sensor).performance

    @cached_property
    def _found(self) -> GyroEstimates:
        return gyro_estimates_of(self.session)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the fit of the gyros says: what it does not determine, what a drift would change."""
        return self._found.remarks

    @cached_property
    def gyro(self) -> GyroCalibration:
        """The calibration, for the offsets that stood while the session was recorded."""
        made = gyros_as_recorded(self.session)
        if made.covariance is None:
            raise FitError(f"{self.session.source}: nothing states the uncertainty of its zero rates")
        return made

    def plan(self, now: Numbers) -> WritePlan:
        """As `plan_gyro_offsets`."""
        return plan_gyro_offsets(self.session, self.gyro, now, self._found.doubts)

    def measure(self, sensor: Adis16354, dwell_s: float, patience_s: float) -> Rest:
        """As `rest.measure`, with the gyros."""
        return measure(sensor, dwell_s, patience_s, gyros=True)

    def expected(self, plan: WritePlan, rest: Rest) -> Agreement:
        """Zero rates in this pose by the session, force and warmth in them, against the dwell's means."""
        mean, u = _of_gyros(rest)
        moved = np.array([(axis.now - axis.recorded) * axis.lsb for axis in plan.axes])
        zero, of_zero = self.zero(rest)
        u = np.sqrt(u**2 + of_zero**2 + self.wander(rest) ** 2)
        return Agreement("zero rates here against the session", _names(), mean, zero + moved, u, "dps")

    def effect(self, plan: WritePlan, before: Rest, after: Rest) -> Agreement:
        """How far the gyros moved between two dwells in the same place, against the plan."""
        (first, u_first), (second, u_second) = _of_gyros(before), _of_gyros(after)
        wander = math.hypot(
            math.sqrt(2) * self._figures.gyro_instability_dps,
            TEMPCO_DPS_PER_C * (after.temperature_c - before.temperature_c),
            self._figures.gyro_supply_sensitivity_dps_per_v * (after.supply_v - before.supply_v),
        )
        u = np.sqrt(u_first**2 + u_second**2 + wander**2)
        planned = np.array([axis.effect for axis in plan.axes])
        return Agreement("the write moved the gyros by", _names(), second - first, planned, u, "dps")

    def found(self, plan: WritePlan, rest: Rest) -> tuple[Floats, Floats] | None:
        """Zero rates (3,) of a dwell without what force adds there, and their standard uncertainties."""
        mean, u = _of_gyros(rest)
        force, of_force = self.by_force(rest)
        return mean - force, np.hypot(u, of_force)

    def zero(self, rest: Rest) -> tuple[Floats, Floats]:
        """Zero rates (3,) in °/s in a pose at the recorded offsets, and their standard uncertainties."""
        read = self.gyro.readings_of(
            np.zeros(3), rest.mean_mg / 1000, rest.temperatures_c, supply_v=rest.supply_v
        )
        return read.rate_dps, read.u_dps

    def by_force(self, rest: Rest) -> tuple[Floats, Floats]:
        """Part of it that force makes, and its u."""
        return self.gyro.force_part(rest.mean_mg / 1000)

    def wander(self, rest: Rest) -> float:
        """Standard uncertainty of a zero rate as one of another time, temperature and supply."""
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
    """The half of a session's sensor that is to be written.

    Raises
    ------
    UsageError
        A method of the accelerometers' fit is named for the gyros.
    """
    if not gyros:
        return Accelerometers(session, method, angle_deg)
    if method is not None:
        raise UsageError(f"{Path(session.source).name}: --method is of the accelerometers; leave it out")
    return Gyros(session)


def _of_gyros(rest: Rest) -> tuple[Floats, Floats]:
    assert rest.mean_dps is not None  # `measure` of this part reads them
    assert rest.u_dps is not None
    return rest.mean_dps, rest.u_dps


def _names() -> tuple[str, ...]:
    return tuple(axis.upper() for axis in AXES)
