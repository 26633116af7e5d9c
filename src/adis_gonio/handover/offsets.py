"""Offset words: biases and zero rates of a calibration as numbers for the part's offset registers."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from adis_gonio.base.errors import AdisGonioError, DataError, FitError
from adis_gonio.base.jsonable import HIDDEN, JsonRecord
from adis_gonio.calibrate.calibration import Calibration
from adis_gonio.calibrate.gyro_calibration import GYRO_OFFSET_DPS, GyroCalibration
from adis_gonio.device.sensor.registers import register
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.model.effects import AXES
from adis_gonio.tracing.trace_calibrations import load_calibration, load_gyro_calibration


@dataclass(frozen=True)
class OffsetWord:
    """A number for an offset register.

    Attributes
    ----------
    name : str
        Register.
    number, before : int or None
        What to write, and what it held while the session was recorded; None where the file does not say.
    bias_mg, u_mg : float, float or None
        Bias that is corrected.
    left_mg : float
        What rounding to whole numbers leaves of it.
    """

    name: str
    number: int
    before: int | None
    bias_mg: float
    u_mg: float | None
    left_mg: float


def offset_words(calibration: Calibration) -> tuple[OffsetWord, ...]:
    """Numbers that take the bias out of the part's outputs: it adds them, so that their sign is the other.

    Raises
    ------
    FitError
        The sensor has no such registers, the session does not determine a bias, or one is too large.
    """
    where = calibration.provenance
    if where.sensor not in VARIANTS or where.counts:
        raise FitError(
            f"offset registers belong to an ADIS16350, 54 or 55; this session is of a {where.sensor} sensor"
        )
    lsb_mg = VARIANTS[where.sensor].accel_mg_per_lsb
    words = []
    for k, axis in enumerate(AXES[: calibration.axes]):
        if f"bias_{axis}" not in calibration:
            raise FitError(
                f"the session does not determine bias_{axis}: measure the opposite positions too "
                "(180° and 270°)"
            )
        bias = calibration[f"bias_{axis}"]
        row = register(f"{axis.upper()}ACCL_OFF")
        before = None if where.offsets_lsb is None else where.offsets_lsb[k]
        step = round(-bias.value / lsb_mg)
        number = step + (before or 0)
        low, high = row.range
        if not low <= number <= high:
            raise FitError(f"{row.name} holds {low} to {high}, and bias_{axis} would need {number}")
        words.append(OffsetWord(row.name, number, before, bias.value, bias.u, bias.value + step * lsb_mg))
    return tuple(words)


@dataclass(frozen=True)
class GyroOffsetWord:
    """A number for a gyro's offset register.

    Attributes
    ----------
    name : str
        Register.
    number, before : int or None
        What to write, and what it held while the session was recorded; None where the file does not say.
    bias_dps, u_dps : float, float or None
        Zero rate that is corrected.
    left_dps : float
        What rounding to whole numbers leaves of it.
    """

    name: str
    number: int
    before: int | None
    bias_dps: float
    u_dps: float | None
    left_dps: float


def gyro_offset_words(gyro: GyroCalibration) -> tuple[GyroOffsetWord, ...]:
    """Numbers that take the zero rates out of the gyros' outputs, which the part adds to them.

    Raises
    ------
    FitError
        A zero rate is larger than its register holds.
    """
    words = []
    for k, axis in enumerate(AXES):
        bias, row = gyro[f"gyro_bias_{axis}"], register(f"{axis.upper()}GYRO_OFF")
        before = None if gyro.offsets_lsb is None else gyro.offsets_lsb[k]
        step = round(-bias.value / GYRO_OFFSET_DPS)
        number = step + (before or 0)
        low, high = row.range
        if not low <= number <= high:
            raise FitError(
                f"{row.name} holds {low} to {high} ({low * GYRO_OFFSET_DPS:.1f} to "
                f"{high * GYRO_OFFSET_DPS:.1f} °/s), and {bias.name} of {bias.value:.4g} °/s would need "
                f"{number}: is the gyro broken, or did the part turn?"
            )
        left = bias.value + step * GYRO_OFFSET_DPS
        words.append(GyroOffsetWord(row.name, number, before, bias.value, bias.u, left))
    return tuple(words)


@dataclass(frozen=True)
class WantedOffset(JsonRecord):
    """What a calibration would write into an offset register, in the register's unit, with u."""

    name: str = field(metadata=HIDDEN)
    number: int
    value: float
    u: float | None
    unit: str

    def __str__(self) -> str:
        u = "" if self.u is None else f" (u {self.u:.2g})"
        return f"{self.number} = {self.value:+.4g} {self.unit}{u}"


def wanted_offsets(calibration: Calibration) -> tuple[WantedOffset, ...]:
    """Offsets of gyros and accelerometers that a calibration gives; of a half that it cannot give none.

    Raises
    ------
    FitError
        It gives none at all.
    """
    found = [] if calibration.gyro is None else list(wanted_gyro_offsets(calibration.gyro))
    try:
        lsb_mg = (
            0.0
            if calibration.provenance.counts
            else VARIANTS[calibration.provenance.sensor].accel_mg_per_lsb
        )
        found += [
            WantedOffset(one.name, one.number, lsb_mg * one.number, one.u_mg, "mg")
            for one in offset_words(calibration)
        ]
    except (FitError, KeyError):
        if not found:
            raise FitError(
                "the calibration gives no offsets: neither biases nor zero rates of a part"
            ) from None
    return tuple(found)


def wanted_gyro_offsets(gyro: GyroCalibration) -> tuple[WantedOffset, ...]:
    """Offsets of the gyros alone; `FitError` as `gyro_offset_words`."""
    return tuple(
        WantedOffset(one.name, one.number, GYRO_OFFSET_DPS * one.number, one.u_dps, "°/s")
        for one in gyro_offset_words(gyro)
    )


def wanted_offsets_in(path: str | Path) -> tuple[WantedOffset, ...]:
    """Offsets by a calibration's file or a session, which may be of the gyros alone.

    Raises
    ------
    DataError
        The file is neither.
    FitError
        It gives no offsets.
    """
    try:
        return wanted_offsets(load_calibration(path))
    except (DataError, FitError) as error:
        try:
            gyro = load_gyro_calibration(path)
        except AdisGonioError:
            raise error from None
        return wanted_gyro_offsets(gyro)


def _gyro_lines(gyro: GyroCalibration) -> list[str]:
    lines = []
    for word in gyro_offset_words(gyro):
        u = "unknown" if word.u_dps is None else f"{word.u_dps:.2g} °/s"
        held = "" if word.before is None else f", {word.before} before"
        lines.append(f"# zero rate {word.bias_dps:+.4f} °/s (u {u}), {word.left_dps:+.4f} °/s left{held}")
        lines.append(f"{word.name}={word.number}")
    return lines


def registers_text(calibration: Calibration) -> str:
    """Lines `NAME=NUMBER` as `adis-gonio registers` takes them, with what they correct as comments.

    Raises
    ------
    FitError
        As `offset_words`.
    """
    where = calibration.provenance
    lines = [
        f"# Offsets that take the bias out of an {where.sensor}, part {where.serial or 'not stated'}, "
        f"by {where.software}, from {where.source or 'a session'} (data {where.sha256[:16]}).",
        "# Write them: adis-gonio registers URL $(grep -v '^#' THIS_FILE)  # and --save for flash",
        "# The part adds them to its outputs; coefficients exported before hold for the old offsets only.",
    ]
    words = offset_words(calibration)
    if words[0].before is None:
        lines.append(
            "# The session does not say what the registers held: these numbers hold where that was 0."
        )
    for word in words:
        u = "unknown" if word.u_mg is None else f"{word.u_mg:.2g} mg"
        held = "" if word.before is None else f", {word.before} before"
        lines.append(f"# bias {word.bias_mg:+.3f} mg (u {u}), {word.left_mg:+.3f} mg left{held}")
        lines.append(f"{word.name}={word.number}")
    if calibration.gyro is not None:
        if calibration.gyro.source != where.source:
            lines.append(f"# Gyros from {calibration.gyro.source or 'a session not stated'}.")
        if calibration.gyro.offsets_lsb is None and words[0].before is not None:
            lines.append("# What their registers held is not stated: these numbers hold where that was 0.")
        lines += _gyro_lines(calibration.gyro)
    return "\n".join(lines) + "\n"
