"""What is to be written: from a session's biases to register numbers. No sensor, no file.

The part adds the register to its output, so with o the number at which the session was recorded, b the bias
that the fit found then and one LSB of output for one of the register,

    new = o − b / LSB, rounded;    bias afterwards = b + (new − o) LSB, within half an LSB of zero.

The number that stands in the register now does not enter: a plan is absolute, and making it twice gives the
same. Zero rates of gyros go the same way, in °/s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from adis_gonio.base.errors import SessionError
from adis_gonio.device.sensor.registers import ACCEL_OFF, BY_NAME, GYRO_OFF, Kind
from adis_gonio.device.sensor.variants import VARIANTS, variant
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import changed_registers
from adis_gonio.record.write_journal import Numbers

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration
    from adis_gonio.fitting import FitResult

UNITS = {"mg": "mg", "dps": "°/s"}
"""Units as people read them."""
BIASES = tuple(f"bias_{axis}" for axis in AXES)


@dataclass(frozen=True)
class AxisPlan:
    """The plan for one axis.

    Attributes
    ----------
    axis, register : str
        `x` and `XACCL_OFF`.
    bias, u : float
        Bias (zero rate) that was found and its standard uncertainty, at the number in `recorded`.
    recorded, now, new : int
        Number in the register while the session was recorded, as it is now, and as it is to be.
    lsb : float
        What one LSB of the register adds to the output.
    clipped : bool
        True where the register cannot hold the number that would cancel the bias.
    unit : str
        Of all these: `mg` or `dps`.
    """

    axis: str
    register: str
    bias: float
    u: float
    recorded: int
    now: int
    new: int
    lsb: float
    clipped: bool
    unit: str = "mg"

    @property
    def effect(self) -> float:
        """By how much writing moves the output from where it is now."""
        return (self.new - self.now) * self.lsb

    @property
    def bias_now(self) -> float:
        """Bias with the number that is in the register now."""
        return self.bias + (self.now - self.recorded) * self.lsb

    @property
    def bias_after(self) -> float:
        """Bias that is left after writing."""
        return self.bias + (self.new - self.recorded) * self.lsb

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        row, unit = BY_NAME[self.register], self.unit
        return {
            "axis": self.axis,
            "register": self.register,
            f"bias_{unit}": self.bias,
            f"bias_u_{unit}": self.u,
            "recorded": self.recorded,
            "now": self.now,
            "new": self.new,
            "now_word": row.word(self.now),
            "new_word": row.word(self.new),
            f"lsb_{unit}": self.lsb,
            f"effect_{unit}": self.effect,
            f"bias_now_{unit}": self.bias_now,
            f"bias_after_{unit}": self.bias_after,
            "clipped": self.clipped,
        }


@dataclass(frozen=True)
class WritePlan:
    """What is to be written.

    Attributes
    ----------
    session : str
        File of the session.
    variant, method : str
        Part, and the method whose biases these are.
    axes : tuple of AxisPlan
        Axes whose bias the session determines.
    doubts : tuple of str
        Why the fit is no sound base, one line each; empty where it is.
    """

    session: str
    variant: str
    method: str
    axes: tuple[AxisPlan, ...]
    doubts: tuple[str, ...] = ()

    @property
    def new(self) -> dict[str, int]:
        """Numbers by register as they are to be."""
        return {axis.register: axis.new for axis in self.axes}

    @property
    def now(self) -> dict[str, int]:
        """Numbers by register as they are now."""
        return {axis.register: axis.now for axis in self.axes}

    @property
    def carried_out(self) -> WritePlan:
        """The same plan once the registers hold what it asks for."""
        return replace(self, axes=tuple(replace(axis, now=axis.new) for axis in self.axes))

    @property
    def changes(self) -> bool:
        """True where a register is to change."""
        return self.new != self.now

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "session": self.session,
            "variant": self.variant,
            "method": self.method,
            "axes": [axis.as_dict() for axis in self.axes],
            "changes": self.changes,
            "doubts": list(self.doubts),
        }


def recorded_offsets(session: Session, names: Sequence[str] = ACCEL_OFF) -> dict[str, int]:
    """Numbers of three offset registers while a session was recorded.

    Raises
    ------
    SessionError
        The session does not know them: not recorded by `calibrate`, or from no chip.
    """
    registers = (session.facts.get("registers") or {}).get("configured")
    if session.sensor not in VARIANTS or not registers or any(name not in registers for name in names):
        raise SessionError(
            f"{session.source or 'session'}: does not hold the sensor's offset registers; write needs a"
            " session file that calibrate has recorded from the chip itself"
        )
    return {name: int(registers[name]) for name in names}


def plan_offsets(session: Session, result: FitResult, now: Numbers | None = None) -> WritePlan:
    """Plan for a session and a fit of it.

    Parameters
    ----------
    now : mapping of str to int or None
        Numbers in the registers now; None as they were while the session was recorded.

    Raises
    ------
    SessionError
        The session has no bias (two positions), or not the registers.
    """
    recorded = recorded_offsets(session)
    held = recorded if now is None else now
    if not any(name in result for name in BIASES):
        raise SessionError(
            f"{session.source}: method {result.method} gives no bias, so there is nothing to write; measure"
            " the opposite positions too (calibrate --plan four-position, mmpm or tumble)"
        )
    lsb = variant(session.sensor).accel_mg_per_lsb
    axes = []
    for axis, name, register in zip(AXES, BIASES, ACCEL_OFF, strict=True):
        if name not in result:
            continue
        bias = result[name]
        wanted = recorded[register] - round(bias.value / lsb)
        low, high = BY_NAME[register].range
        new = min(max(wanted, low), high)
        u = float("nan") if bias.u is None else bias.u
        axes.append(
            AxisPlan(
                axis, register, bias.value, u, recorded[register], held[register], new, lsb, new != wanted
            )
        )
    unsure = (text for axis in axes for text in _unsure(axis))
    doubts = (*changed_registers(session), *_lacks(session, result), *unsure)
    return WritePlan(session.source, session.sensor, result.method, tuple(axes), doubts)


def plan_gyro_offsets(
    session: Session, gyro: GyroCalibration, now: Numbers | None = None, doubts: Sequence[str] = ()
) -> WritePlan:
    """Plan for the gyros of a session.

    Parameters
    ----------
    gyro : GyroCalibration
        For the offsets that stood while the session was recorded.
    now : mapping of str to int or None
        Numbers in the registers now; None as they were then.
    doubts : sequence of str
        What speaks against the calibration.

    Raises
    ------
    SessionError
        The session does not hold the registers, or a zero rate is beyond what its register holds: no
        gyro that works and is at rest has one.
    """
    recorded = recorded_offsets(session, GYRO_OFF)
    held = recorded if now is None else now
    lsb = variant(session.sensor).lsb(Kind.GYRO_OFFSET)[0]
    axes = []
    for axis, register in zip(AXES, GYRO_OFF, strict=True):
        bias = gyro[f"gyro_bias_{axis}"]
        new = recorded[register] - round(bias.value / lsb)
        low, high = BY_NAME[register].range
        if not low <= new <= high:
            raise SessionError(
                f"{session.source}: {bias.name} is {bias.value:.4g} °/s, and {register} holds {low} to"
                f" {high} ({low * lsb:.1f} to {high * lsb:.1f} °/s): the gyro is broken, or the part turned"
            )
        u = float("nan") if bias.u is None else bias.u
        axes.append(
            AxisPlan(
                axis, register, bias.value, u, recorded[register], held[register], new, lsb, False, "dps"
            )
        )
    unsure = (text for axis in axes for text in _unsure(axis))
    doubts = (*changed_registers(session), *doubts, *unsure)
    return WritePlan(session.source, session.sensor, gyro.method, tuple(axes), doubts)


def _lacks(session: Session, result: FitResult) -> list[str]:
    """Why the model does not describe the session."""
    lacks = []
    if result.extra_mg > 0:
        lacks.append(
            f"chi2 is {result.chi2:.4g} for {result.dof} degrees of freedom, the model lacks"
            f" {result.extra_mg:.2g} mg a reading"
        )
    lacks += dict.fromkeys(found.sentence for found in result.position_findings)
    rounds = session.facts.get("advised") or []
    summary = rounds[-1].get("summary") if rounds else None
    if summary and summary.get("tested") and not summary.get("adequate"):
        lacks.append("the session's own trace found the model not adequate")
    return lacks


def _unsure(axis: AxisPlan) -> list[str]:
    """Why a bias is not known well enough: writing it would as likely do harm as good."""
    unit = UNITS[axis.unit]
    name = f"bias_{axis.axis}" if axis.unit == "mg" else f"gyro_bias_{axis.axis}"
    if axis.u != axis.u:
        return [f"nothing states the uncertainty of {name}"]
    if axis.new != axis.recorded and axis.u > abs(axis.bias):
        return [f"{name} is {axis.bias:.2g} {unit} with u = {axis.u:.2g} {unit}: even its sign is open"]
    return []
