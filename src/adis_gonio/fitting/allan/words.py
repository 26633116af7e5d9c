"""The noise of a part at rest in words and as a table."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence

from adis_gonio.base.numbers import counted, format_number, format_unit
from adis_gonio.base.uncertainty import INADEQUATE, SLOW_NOISE
from adis_gonio.fitting.allan.result import AllanResult, AxisNoise, NoiseParameter

PARTS = {"gyro": "gyros", "accelerometer": "accelerometers"}
_FEW_DOF = 3.0
HEAD = ("", "value", "u", "95 % interval", "ν", "unit")
_WIDTHS = (26, 9, 9, 18, 7)
_MANY_DOF = 9999


def name_shown(parameter: NoiseParameter) -> str:
    """Such as `angle random walk`."""
    return parameter.name.replace("_", " ")


def notes_of(axis: AxisNoise, *, narrowed: bool, coarse: bool, loud: Sequence[int]) -> Iterator[str]:
    """What a reader of an axis has to know; `loud` are the positions of records that were left out."""
    if loud:
        which = ", ".join(map(str, loud[:8])) + (", …" if len(loud) > 8 else "")
        yield f"{counted(len(loud), 'record')} left out, louder than the quietest (positions {which})"
    if coarse:
        yield (
            f"the noise is below half a step of the converter ({format_number(axis.step)}): what is seen is"
            " its rounding"
        )
    if narrowed and axis.adequacy >= INADEQUATE:
        yield f"above {format_number(axis.band_hz[1])} Hz the spectrum is of another kind and was left out"
    if axis.adequacy < INADEQUATE:
        yield f"the spectrum is not that of these noises (p = {axis.adequacy:.1g}): u is too small"
    for line in axis.lines:
        yield (
            f"a sinusoid of {format_number(line.frequency_hz, 4)} Hz, amplitude"
            f" {format_number(line.amplitude)}, taken off: a vibration, or its alias"
        )
    flicker, walk = axis["flicker"], axis["walk"]
    if not flicker.present and not walk.present and axis.slow_p_value < SLOW_NOISE:
        yield (
            "there is slow noise, and the records are too short to tell bias instability from random walk:"
            " let it lie still for four times as long"
        )
    for parameter in (flicker, walk):
        if parameter.present and parameter.profile.dof < _FEW_DOF:
            yield (
                f"{name_shown(parameter)} rests on {format_number(parameter.profile.dof, 2)} degrees of"
                " freedom: a longer record makes it sure"
            )
    if axis.ramps:
        yield f"drifts by {format_number(axis.ramp.value)} {format_unit(axis.ramp.unit)}, which is no noise"


def missing(parameter: NoiseParameter) -> str:
    """What stands for a value that is not there: the limit, and what the records would have shown."""
    found = parameter.profile
    limit = f"not present: at most {format_number(found.high)} (95 %)"
    if parameter.kind == "white":
        return limit
    return f"{limit}; {format_number(found.detectable)} would have shown"


def cells(parameter: NoiseParameter) -> Sequence[tuple[str, ...]]:
    """Rows of `HEAD` for a process that is present: in its unit, and in the other one of the field."""
    found, rows = parameter.profile, []
    for unit, size in ((parameter.unit, 1.0), *((parameter.also,) if parameter.also else ())):
        rows.append(
            (
                name_shown(parameter) if size == 1.0 else "",
                format_number(size * found.value, 4),
                format_number(size * found.u, 2),
                f"{format_number(size * found.low)} … {format_number(size * found.high)}",
                _dof_shown(found.dof) if size == 1.0 else "",
                format_unit(unit),
            )
        )
    return rows


def _dof_shown(dof: float) -> str:
    return f"> {_MANY_DOF}" if dof > _MANY_DOF else format_number(dof, 2)


def headline(result: AllanResult) -> str:
    """What was recorded, in a line."""
    records = counted(len(result.samples), "record")
    rate_hz = format_number(1 / result.period_s, 4)
    held = f"{format_number(result.duration_s, 4)} s in {records} at {rate_hz} Hz"
    return f"{held}, filter M = {result.filter_m}" if result.filter_m or result.filter_known else held


def table_lines(result: AllanResult) -> Iterator[str]:
    """The result as lines of at most 80 columns."""
    name = result.title or result.source or "session"
    yield from _folded(f"Noise at rest of the {PARTS[result.part]} of {name} ({result.sensor})", "")
    for text in (headline(result), *result.notes):
        yield from _folded(text)
    for axis in result.axes:
        yield ""
        yield _row((axis.axis.upper(), *HEAD[1:]))
        for parameter in axis.parameters:
            if parameter.present:
                for row in cells(parameter):
                    yield _row(("  " + row[0], *row[1:]))
            elif parameter.kind != "quantization":
                yield f"  {name_shown(parameter)} / {format_unit(parameter.unit)}"
                yield f"    {missing(parameter)}"
        for note in axis.notes:
            yield from _folded(note)


def _row(texts: tuple[str, ...]) -> str:
    name, *numbers, unit = texts
    shown = [f"{text:>{width}}" for text, width in zip(numbers, _WIDTHS[1:], strict=True)]
    return f"{name:<{_WIDTHS[0]}}{''.join(shown)} {unit}".rstrip()


def _folded(text: str, indent: str = "  ") -> list[str]:
    return textwrap.wrap(text, 80, initial_indent=indent, subsequent_indent=indent + "  ")
