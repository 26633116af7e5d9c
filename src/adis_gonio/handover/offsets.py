"""Offset words: the bias of a calibration as numbers for the part's offset registers."""

from __future__ import annotations

from dataclasses import dataclass

from adis_gonio.calibration.calibration import Calibration
from adis_gonio.errors import FitError
from adis_gonio.model.effects import AXES
from adis_gonio.sensor.registers import register
from adis_gonio.sensor.variants import VARIANTS


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
    return "\n".join(lines) + "\n"
