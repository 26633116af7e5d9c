"""Plans of a write-back: register numbers from a session's biases, without a sensor or a file.

The sensor adds the register to its output. With o the number during the recording, b the bias by the fit
and one LSB of the output for one LSB of the register,

    new = o − b / LSB, rounded;    bias afterwards = b + (new − o) LSB, within half an LSB of zero.

The present number in the register is not used, so that the plan can be repeated. Zero rates of gyros are
planned in the same way, in °/s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import TYPE_CHECKING, Any

from adis_gonio.base.errors import SessionError
from adis_gonio.base.jsonable import HIDDEN, NAMED_BY_UNIT, JsonRecord, key
from adis_gonio.base.uncertainty import Value
from adis_gonio.device.sensor.registers import ACCEL_OFF, BY_NAME, GYRO_OFF, VARIANTS, variant
from adis_gonio.fitting.slips.session_positions import sentences_of
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import changed_registers
from adis_gonio.record.write_journal import Numbers

if TYPE_CHECKING:
    from adis_gonio.calibrate.calibration import Coefficient
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration
    from adis_gonio.fitting.fit_result import FitResult

    Biases = Mapping[str, Value | Coefficient]

UNITS = {"mg": "mg", "dps": "°/s"}
"""Unit in messages by the unit's name in JSON."""
BIASES = tuple(f"bias_{axis}" for axis in AXES)


class AxisPlan(JsonRecord):
    """The planned number for the offset register of one axis.

    Attributes
    ----------
    axis, register : str
        Axis such as `x`, and its offset register such as `XACCL_OFF`.
    bias, u : float
        Bias (zero rate) by the fit and its standard uncertainty, with the number `recorded` in the
        register; `u` is NaN if it is not known.
    recorded, now, new : int
        Number in the register during the recording, present number, and planned number.
    lsb : float
        Change of the output by one LSB of the register.
    clipped : bool
        True if the number that would cancel the bias is out of the range of the register.
    unit : str
        Unit of these figures: `mg` or `dps`.
    """

    axis: str
    register: str
    bias: float = field(metadata=NAMED_BY_UNIT)
    u: float = field(metadata={**NAMED_BY_UNIT, **key("bias_u")})
    recorded: int
    now: int
    new: int
    lsb: float = field(metadata=NAMED_BY_UNIT)
    clipped: bool
    unit: str = field(default="mg", metadata=HIDDEN)

    @property
    def effect(self) -> float:
        """Planned change of the output by the write, in mg or, for a gyro, °/s."""
        return (self.new - self.now) * self.lsb

    @property
    def bias_now(self) -> float:
        """Bias with the present number in the register, in mg or, for a gyro, °/s."""
        return self.bias + (self.now - self.recorded) * self.lsb

    @property
    def bias_after(self) -> float:
        """Remaining bias after the write, in mg or, for a gyro, °/s."""
        return self.bias + (self.new - self.recorded) * self.lsb

    def as_dict(self) -> dict[str, Any]:
        """Return the plan for one axis in JSON form."""
        row, unit = BY_NAME[self.register], self.unit
        return super().as_dict() | {
            "now_word": row.word(self.now),
            "new_word": row.word(self.new),
            f"effect_{unit}": self.effect,
            f"bias_now_{unit}": self.bias_now,
            f"bias_after_{unit}": self.bias_after,
        }


class WritePlan(JsonRecord):
    """Plan of the numbers to write to the offset registers of all axes.

    Attributes
    ----------
    session : str
        File of the session.
    variant, method : str
        Variant of the sensor, and method of the fit.
    axes : tuple of AxisPlan
        Axes with a bias that the session determines.
    doubts : tuple of str
        Reasons to doubt the fit, one line each.
    """

    document_keys = ("session", "variant", "method", "axes", "changes", "doubts")

    session: str
    variant: str
    method: str
    axes: tuple[AxisPlan, ...]
    doubts: tuple[str, ...] = ()

    @property
    def new(self) -> dict[str, int]:
        """Planned numbers by the name of the register."""
        return {axis.register: axis.new for axis in self.axes}

    @property
    def now(self) -> dict[str, int]:
        """Present numbers by the name of the register."""
        return {axis.register: axis.now for axis in self.axes}

    @property
    def carried_out(self) -> WritePlan:
        """Copy of the plan for the state after the write: the planned numbers are the present numbers."""
        return replace(self, axes=tuple(replace(axis, now=axis.new) for axis in self.axes))

    @property
    def changes(self) -> bool:
        """True if the plan changes at least one register."""
        return self.new != self.now


def recorded_offsets(session: Session, names: Sequence[str] = ACCEL_OFF) -> dict[str, int]:
    """Return the numbers that the offset registers `names` had during the recording of a session.

    Raises
    ------
    SessionError
        The session does not have these numbers: it was not recorded by `calibrate`, or not from a chip.
    """
    registers = (session.facts.get("registers") or {}).get("configured")
    if session.sensor not in VARIANTS or not registers or any(name not in registers for name in names):
        raise SessionError(
            f"{session.source or 'session'}: does not hold the sensor's offset registers; write needs a"
            " session file that calibrate has recorded from the chip itself"
        )
    return {name: int(registers[name]) for name in names}


def plan_offsets(session: Session, result: FitResult, now: Numbers) -> WritePlan:
    """Plan the offset registers of the accelerometers by a fit of a session.

    Parameters
    ----------
    result : FitResult
        Fit of the session.
    now : mapping of str to int
        Present numbers in the registers.

    Raises
    ------
    SessionError
        The session gives no bias (two positions), or does not have the contents of the registers.
    """
    found = {name: result[bias] for name, bias in zip(ACCEL_OFF, BIASES, strict=True) if bias in result}
    if not found:
        raise SessionError(
            f"{session.source}: method {result.method} gives no bias, so there is nothing to write; measure"
            " the opposite positions too (calibrate --plan four-position, mmpm or tumble)"
        )
    return _plan(session, found, now, result.method, _lacks(session, result))


def plan_gyro_offsets(
    session: Session, gyro: GyroCalibration, now: Numbers, doubts: Sequence[str]
) -> WritePlan:
    """Plan the offset registers of the gyros by their calibration.

    Parameters
    ----------
    gyro : GyroCalibration
        Calibration for the offsets during the recording.
    now : mapping of str to int
        Present numbers in the registers.
    doubts : sequence of str
        Reasons to doubt the calibration.

    Raises
    ------
    SessionError
        The session does not have the contents of the registers, or a zero rate is out of the range of its
        register, which means that the gyro is broken or was not at rest.
    """
    found = {name: gyro[f"gyro_bias_{axis}"] for name, axis in zip(GYRO_OFF, AXES, strict=True)}
    plan = _plan(session, found, now, gyro.method, doubts)
    for axis in plan.axes:
        if axis.clipped:
            low, high = BY_NAME[axis.register].range
            raise SessionError(
                f"{session.source}: gyro_bias_{axis.axis} is {axis.bias:.4g} °/s, and {axis.register} holds"
                f" {low} to {high} ({low * axis.lsb:.1f} to {high * axis.lsb:.1f} °/s): the gyro is broken,"
                " or the part turned"
            )
    return plan


def _plan(session: Session, found: Biases, held: Numbers, method: str, doubts: Sequence[str]) -> WritePlan:
    """Return the plan that cancels biases.

    `found` has each bias by the name of the register, `held` the present numbers in the registers; `method`
    is the method of the fit, and `doubts` are reasons to doubt it.
    """
    axes, recorded = [], recorded_offsets(session, tuple(found))
    for name, estimate in found.items():
        row = BY_NAME[name]
        lsb, _, unit = variant(session.sensor).lsb(row.kind)
        bias, u = estimate.value, float("nan") if estimate.u is None else estimate.u
        wanted = recorded[name] - round(bias / lsb)
        new = min(max(wanted, row.range[0]), row.range[1])
        axis = AxisPlan(name[0].lower(), name, bias, u, recorded[name], held[name], new, lsb, new != wanted)
        axes.append(replace(axis, unit="mg" if unit == "mg" else "dps"))
    unsure = (text for axis in axes for text in _unsure(axis))
    return WritePlan(
        session.source, session.sensor, method, tuple(axes), (*changed_registers(session), *doubts, *unsure)
    )


def _lacks(session: Session, result: FitResult) -> list[str]:
    """Return the reasons why the fitted model does not describe the session; empty if it does."""
    lacks = []
    if result.extra_mg > 0:
        lacks.append(
            f"chi2 is {result.chi2:.4g} for {result.dof} degrees of freedom, the model lacks"
            f" {result.extra_mg:.2g} mg a reading"
        )
    lacks += sentences_of(result.position_findings)
    rounds = session.facts.get("advised") or []
    summary = rounds[-1].get("summary") if rounds else None
    if summary and summary.get("tested") and not summary.get("adequate"):
        lacks.append("the session's own trace found the model not adequate")
    return lacks


def _unsure(axis: AxisPlan) -> list[str]:
    """Return a list with the reason why the bias of an axis is too uncertain to be written.

    The list is empty if the standard uncertainty is known and not larger than the bias, or if it is known
    and the register would not change.
    """
    unit = UNITS[axis.unit]
    name = f"bias_{axis.axis}" if axis.unit == "mg" else f"gyro_bias_{axis.axis}"
    if axis.u != axis.u:
        return [f"nothing states the uncertainty of {name}"]
    if axis.new != axis.recorded and axis.u > abs(axis.bias):
        return [f"{name} is {axis.bias:.2g} {unit} with u = {axis.u:.2g} {unit}: even its sign is open"]
    return []
