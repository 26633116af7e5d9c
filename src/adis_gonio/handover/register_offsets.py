"""Numbers for the sensor's offset registers that remove the biases and zero rates of a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from adis_gonio.base.errors import AdisGonioError, FitError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import format_number, signed
from adis_gonio.calibrate.calibration import Calibration, Coefficient, Coefficients
from adis_gonio.calibrate.gyro_calibration import GYRO_OFFSET_DPS, GyroCalibration
from adis_gonio.device.sensor.registers import VARIANTS, register
from adis_gonio.model.effects import AXES
from adis_gonio.tracing.trace_calibrations import load_calibration, load_gyro_calibration


class OffsetWord(JsonRecord):
    """The number for one offset register, which the sensor adds to its output.

    The JSON document is the entry `calibration` of a register in `registers --json`.

    Attributes
    ----------
    name : str
        Name of the register.
    number, before : int or None
        Number to write, and the number during the session (None if the file does not state it).
    bias, u : float, float or None
        Bias or zero rate that the number removes and its standard uncertainty (None if unknown), in `unit`.
    lsb : float
        Step of the register, in `unit`.
    unit : {"mg", "°/s"}
        Unit of the axis that the register belongs to.
    """

    document_keys = ("number", "value", "u", "unit")

    name: str
    number: int
    before: int | None
    bias: float
    u: float | None
    lsb: float
    unit: str

    @property
    def value(self) -> float:
        """Offset that the register adds to the output with this number, in mg or, for a gyro, °/s."""
        return self.lsb * self.number

    @property
    def remainder(self) -> float:
        """Bias that remains because the number is rounded, in mg or, for a gyro, °/s."""
        return self.bias + (self.number - (self.before or 0)) * self.lsb

    def __str__(self) -> str:
        u = "" if self.u is None else f" (u {format_number(self.u, 2)})"
        return f"{self.number} = {signed(self.value, digits=4)} {self.unit}{u}"


def _words(
    biases: Sequence[Coefficient], kind: str, offsets: Sequence[int] | None, lsb: float, unit: str
) -> tuple[OffsetWord, ...]:
    """Return the numbers for the offset registers of the axes X, Y, … that remove `biases`, in `unit`.

    `kind` is the name of the registers without the axis, and `lsb` their step in `unit`. `offsets` are the
    numbers in the registers during the session, None if unknown.

    Raises
    ------
    FitError
        A number is beyond the register's range.
    """
    words = []
    for k, bias in enumerate(biases):
        name, before = f"{AXES[k].upper()}{kind}", None if offsets is None else offsets[k]
        number = round(-bias.value / lsb) + (before or 0)
        low, high = register(name).range
        if not low <= number <= high:
            raise FitError(
                f"{name} holds {low} to {high} ({low * lsb:.1f} to {high * lsb:.1f} {unit}), and "
                f"{bias.name} of {bias.value:.4g} {unit} would need {number}: is the part broken, or did "
                "it move?"
            )
        words.append(OffsetWord(name, number, before, bias.value, bias.u, lsb, unit))
    return tuple(words)


def offset_words(calibration: Calibration) -> tuple[OffsetWord, ...]:
    """Return the numbers for the offset registers that remove the biases of the accelerometers.

    Raises
    ------
    FitError
        The sensor has no such registers, the session does not determine a bias, or a bias is too large.
    """
    where = calibration.provenance
    if where.sensor not in VARIANTS or where.counts:
        raise FitError(
            f"offset registers belong to an ADIS16350, 54 or 55; this session is of a {where.sensor} sensor"
        )
    names = [f"bias_{axis}" for axis in AXES[: calibration.axes]]
    missing = [name for name in names if name not in calibration or name in calibration.assumed]
    if missing:
        raise FitError(
            f"the session does not determine {missing[0]}: measure the opposite positions too "
            "(180° and 270°)"
        )
    lsb_mg = VARIANTS[where.sensor].accel_mg_per_lsb
    return _words([calibration[name] for name in names], "ACCL_OFF", where.offsets_lsb, lsb_mg, "mg")


def gyro_offset_words(gyro: GyroCalibration) -> tuple[OffsetWord, ...]:
    """Return the numbers for the offset registers that remove the zero rates of the gyros.

    It raises `FitError` if a number is beyond the range of its register.
    """
    rates = [gyro[f"gyro_bias_{axis}"] for axis in AXES]
    return _words(rates, "GYRO_OFF", gyro.offsets_lsb, GYRO_OFFSET_DPS, "°/s")


def offset_words_in(path: str | Path) -> tuple[tuple[OffsetWord, ...], tuple[str, ...]]:
    """Return the numbers for the offset registers from the file of a calibration or a session.

    The numbers are for accelerometers and gyros. The second tuple has the reason if the file gives no
    numbers for one of them.

    Raises
    ------
    DataError
        The file is neither a calibration nor a session.
    FitError
        The file gives no numbers for either.
    """
    words: list[OffsetWord] = []
    refused: list[AdisGonioError] = []
    gyro: GyroCalibration | None = None
    try:
        calibration = load_calibration(path)
        gyro = calibration.gyro
        words += offset_words(calibration)
    except AdisGonioError as error:
        refused.append(error)
    try:
        # A second load gives the gyros if the accelerometers failed, or the reason if there are none.
        words += gyro_offset_words(gyro or load_gyro_calibration(path))
    except AdisGonioError as error:
        refused.append(error)
    if not words:
        raise refused[0]
    return tuple(words), tuple(map(str, refused))


def registers_text(calibration: Calibration) -> str:
    """Return lines `NAME=NUMBER` for `adis-gonio registers`, with the removed biases as comments.

    Raises
    ------
    FitError
        A bias is not determined or too large for its register, or the sensor has no such registers.
    """
    where, gyro = calibration.provenance, calibration.gyro
    lines = [
        f"# Offsets that remove the bias of sensor {where.sensor}, part {where.serial or 'not stated'}, "
        f"by {where.software}, from {where.source or 'a session'} (data {where.sha256[:16]}).",
        "# Write them: adis-gonio registers URL $(grep -v '^#' THIS_FILE)  # and --save for flash",
        "# The part adds them to its outputs; coefficients exported before hold for the old offsets only.",
    ]
    lines += _lines(offset_words(calibration), "bias", 3, calibration)
    lines += [f"# Not corrected: {one.effect}: {one.reason}." for one in calibration.not_corrected]
    if gyro is not None:
        if gyro.source != where.source:
            lines.append(f"# Gyros from {gyro.source or 'a session not stated'}.")
        lines += _lines(gyro_offset_words(gyro), "zero rate", 4, gyro)
    return "\n".join(lines) + "\n"


def _lines(words: Sequence[OffsetWord], label: str, digits: int, of: Coefficients) -> list[str]:
    lines = [f"# The values hold at {of.holds_at}."]
    if words[0].before is None:
        lines.append("# The session does not state the contents of these registers: the numbers assume 0.")
    for word in words:
        u = "unknown" if word.u is None else f"{format_number(word.u, 2)} {word.unit}"
        held = "" if word.before is None else f", {word.before} before"
        bias, left = (f"{signed(value, digits)} {word.unit}" for value in (word.bias, word.remainder))
        lines += [f"# {label} {bias} (u {u}), {left} left{held}", f"{word.name}={word.number}"]
    return lines
