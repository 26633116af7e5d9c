"""Result of a noise fit: coefficients with uncertainties or limits, as JSON, a table and notes."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from adis_gonio.base.jsonable import json_object
from adis_gonio.base.numbers import counted, format_number, format_p, format_unit
from adis_gonio.base.uncertainty import INADEQUATE, SLOW_NOISE, Value, finite_or_none
from adis_gonio.fitting.allan.spectral_likelihood import (
    KINDS,
    AllanCurve,
    Kind,
    Profile,
    SpectralLine,
)

Part = Literal["gyro", "accelerometer"]
PARTS: dict[Part, str] = {"gyro": "gyros", "accelerometer": "accelerometers"}
_NAMES: dict[Part, tuple[str, ...]] = {
    "gyro": ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk"),
    "accelerometer": (
        "quantization",
        "velocity_random_walk",
        "bias_instability",
        "acceleration_random_walk",
    ),
}
"""Names of the noise processes in `spectral_likelihood.KINDS`, by sensor part."""
_UNITS = {
    "dps": ("deg", "dps/√Hz", "dps", "dps/√s"),
    "mg": ("mg·s", "mg/√Hz", "mg", "mg/√s"),
    "counts": ("counts·s", "counts/√Hz", "counts", "counts/√s"),
}
"""Units of the coefficients of the noise processes, by the unit of the samples."""


@dataclass(frozen=True)
class NoiseParameter:
    """One noise process of one axis.

    Attributes
    ----------
    kind : {"quantization", "white", "flicker", "walk"}
        Kind of the noise process; `white` is angle or velocity random walk, `flicker` bias instability.
    name : str
        Such as `angle_random_walk`. `bias_instability` is the floor of the Allan deviation.
    unit : str
        Unit of the coefficient.
    profile : Profile
        Likelihood of the coefficient, in `unit`.
    """

    kind: Kind
    name: str
    unit: str
    profile: Profile

    @property
    def present(self) -> bool:
        """True if a test of the hypothesis that this noise process is absent rejects it."""
        return self.profile.present

    @property
    def value(self) -> Value | None:
        """Coefficient of the process with its uncertainty; None if the process may be absent.

        The expanded uncertainty U is the longer side of the 95 % interval, and the coverage factor k is
        U/u.
        """
        if not self.present:
            return None
        found = self.profile
        arm = max(found.high - found.value, found.value - found.low)
        return Value(found.value, found.u, self.unit, found.dof, factor=arm / found.u)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of a noise process: its value with uncertainty, interval and upper limit.

        The value, u, its degrees of freedom ν, k and U are null if the process may be absent.
        """
        value, found = self.value, self.profile
        empty = {"value": None, "u": None, "dof": None, "k": None, "U": None, "unit": self.unit}
        return {
            "present": self.present,
            **(empty if value is None else value.as_dict()),
            "interval_95": [found.low, finite_or_none(found.high)],
            "upper_95": finite_or_none(found.high),
            "p_value": found.p_value,
        }


def parameters(part: Part, unit: str, profiles: dict[Kind, Profile]) -> tuple[NoiseParameter, ...]:
    """Return the noise processes of one axis, with names and units for an accelerometer or a gyro.

    `unit` is the unit of the samples (`dps`, `mg` or `counts`); `profiles` has the likelihood of each
    fitted process.
    """
    named = zip(KINDS, _NAMES[part], _UNITS[unit], strict=True)
    return tuple(
        NoiseParameter(kind, name, own, profiles[kind]) for kind, name, own in named if kind in profiles
    )


@dataclass(frozen=True)
class AxisNoise:
    """Noise of one axis.

    Attributes
    ----------
    axis : str
        `x`, `y` or `z`.
    parameters : tuple of NoiseParameter
        Noise processes in the order of `spectral_likelihood.KINDS`; with the chip's filter on, without
        quantization.
    ramp : Value
        Drift per second: weighted mean of the slopes of straight lines through the records.
    slow_p_value : float
        p-value of the hypothesis that the axis has no flicker noise and no random walk; small if slow noise
        is present.
    adequacy : float
        p-value of the spectrum under the fitted noise; small if this noise does not explain the spectrum.
    band_hz : (float, float)
        Lowest and highest fitted frequency.
    lines : tuple of SpectralLine
        Sinusoids that were found in the records and subtracted before the fit.
    step : float
        Step of the analogue-to-digital converter, 0 if unknown; the coefficients do not include its
        rounding.
    curve : AllanCurve
        Allan deviation of the axis, measured and by the fitted noise.
    notes : tuple of str
        Remarks for the user, one line each.
    """

    axis: str
    parameters: tuple[NoiseParameter, ...]
    ramp: Value
    slow_p_value: float
    adequacy: float
    band_hz: tuple[float, float]
    lines: tuple[SpectralLine, ...]
    step: float
    curve: AllanCurve
    notes: tuple[str, ...]

    def __getitem__(self, name: str) -> NoiseParameter:
        """Return a noise process by its name, such as `angle_random_walk`, or kind, such as `white`."""
        for parameter in self.parameters:
            if name in (parameter.name, parameter.kind):
                return parameter
        raise KeyError(name)

    @property
    def ramps(self) -> bool:
        """True if the axis drifts: the size of its drift is larger than U of the drift."""
        return self.ramp.U is not None and abs(self.ramp.value) > self.ramp.U

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of the axis: its noise processes, Allan deviation, drift and sinusoids."""
        return json_object(
            parameters={parameter.name: parameter for parameter in self.parameters},
            ramp={**self.ramp.as_dict(), "present": self.ramps},
            slow_noise_p_value=self.slow_p_value,
            adequacy_p_value=self.adequacy,
            band_hz=self.band_hz,
            lines=self.lines,
            converter_step=self.step,
            allan=self.curve,
            notes=self.notes,
        )


@dataclass(frozen=True)
class AllanResult:
    """Noise of the gyros or accelerometers of a session at rest.

    Attributes
    ----------
    part : {"gyro", "accelerometer"}
        Sensors that were fitted.
    unit : str
        `dps`, `mg` or `counts`.
    title, sensor, source : str
        Title, sensor and file of the session.
    simulated : bool
        True if the file states that it is simulated.
    period_s : float
        Time between samples.
    filter_m : int
        Parameter M of the chip's filter that the samples have passed.
    filter_known : bool
        True if the file or the user states the filter, False if the spectrum shows it.
    positions : tuple of int
        Number of the dwell that each record comes from.
    samples : tuple of int
        Number of samples of each record.
    axes : tuple of AxisNoise
        Noise of each axis.
    notes : tuple of str
        Remarks for the user on the session.
    """

    part: Part
    unit: str
    title: str
    sensor: str
    source: str
    simulated: bool
    period_s: float
    filter_m: int
    filter_known: bool
    positions: tuple[int, ...]
    samples: tuple[int, ...]
    axes: tuple[AxisNoise, ...]
    notes: tuple[str, ...]

    @property
    def duration_s(self) -> float:
        """Total duration of all records in s."""
        return self.period_s * sum(self.samples)

    @property
    def longest_s(self) -> float:
        """Duration of the longest record in s."""
        return self.period_s * max(self.samples)

    def __getitem__(self, axis: str) -> AxisNoise:
        """Return the noise of the axis with this letter."""
        for found in self.axes:
            if found.axis == axis:
                return found
        raise KeyError(axis)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document that `adis-gonio allan --json` prints."""
        return json_object(
            part=self.part,
            unit=self.unit,
            title=self.title,
            sensor=self.sensor,
            source=self.source,
            sample_rate_hz=1 / self.period_s,
            filter_m=self.filter_m,
            filter_known=self.filter_known,
            records=[
                {"position": position, "samples": n, "duration_s": n * self.period_s}
                for position, n in zip(self.positions, self.samples, strict=True)
            ],
            duration_s=self.duration_s,
            axes={found.axis: found for found in self.axes},
            notes=self.notes,
        )

    def summary(self) -> str:
        """Return a table of at most 80 columns with notes, as `adis-gonio allan` prints it."""
        return "\n".join(table_lines(self))

    def __repr__(self) -> str:
        held = "; ".join(
            f"{found.axis}: "
            + ", ".join(f"{p.name} {p.profile.value:.3g} {p.unit}" for p in found.parameters if p.present)
            for found in self.axes
        )
        return f"AllanResult({self.part}, {math.floor(self.duration_s)} s at rest; {held})"


_FEW_DOF = 3.0
HEAD = ("", "value", "u", "95 % interval", "ν", "unit")
_WIDTHS = (26, 9, 9, 18, 7)
_MANY_DOF = 9999


def name_shown(parameter: NoiseParameter) -> str:
    """Return the name of a noise process for people, such as `angle random walk`."""
    return parameter.name.replace("_", " ")


SWAY_HZ = 1.0
"""Frequency in Hz below which a sinusoid is named a sway: machines run faster, and buildings do not."""


class MovingPeak(NamedTuple):
    """A peak of the spectrum that moves during the records.

    `low_hz` and `high_hz` are its lowest and highest frequency in the pieces of the records. `ratio` is its
    median height, relative to the spectrum around it.
    """

    low_hz: float
    high_hz: float
    ratio: float

    @property
    def line(self) -> str:
        """Sentence for the user on the frequency and the height of the peak."""
        return (
            f"a line between {self.low_hz:.3g} and {self.high_hz:.3g} Hz, {self.ratio:.2g} times the noise"
            " around it: a resonance of the sensor, or a vibration that changes its speed"
        )


def notes_of(
    axis: AxisNoise, *, narrowed: bool, coarse: bool, loud: Sequence[int], peak: MovingPeak | None = None
) -> Iterator[str]:
    """Yield sentences for the user on the noise of an axis, such as excess noise, sinusoids or drift.

    `narrowed` is True if only a part of the frequency band was fitted, `coarse` if the noise is small
    against the step of the converter. `loud` has the dwell numbers of records that were left out because of
    their larger noise. `peak` is a peak above the fitted band.
    """
    if loud:
        which = ", ".join(map(str, loud[:8])) + (", …" if len(loud) > 8 else "")
        yield f"{counted(len(loud), 'record')} left out, louder than the quietest (positions {which})"
    if coarse:
        yield (
            f"the noise is below half a step of the converter ({format_number(axis.step)}): it shows"
            " its rounding"
        )
    if narrowed and axis.adequacy >= INADEQUATE:
        yield f"above {format_number(axis.band_hz[1])} Hz the spectrum is of another kind and was left out"
    yield from [] if peak is None else [peak.line]
    if axis.adequacy < INADEQUATE:
        yield f"these noises do not explain the spectrum ({format_p(axis.adequacy)}): u is too small"
    for line in axis.lines:
        yield (
            f"a sinusoid of {format_number(line.frequency_hz, 4)} Hz, amplitude"
            f" {format_number(line.amplitude)}, subtracted:"
            f" {'a sway, as of a building' if line.frequency_hz < SWAY_HZ else 'a vibration'}, or its alias"
        )
    flicker, walk = axis["flicker"], axis["walk"]
    if not flicker.present and not walk.present and axis.slow_p_value < SLOW_NOISE:
        yield (
            "there is slow noise, and the records are too short to separate bias instability from random"
            " walk: record four times as long at rest"
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
    """Return the text for a process that may be absent, with its upper limit."""
    return f"not separately detected: at most {format_number(parameter.profile.high)} (95 %)"


def cells(parameter: NoiseParameter) -> tuple[str, ...]:
    """Return the table row, with the columns `HEAD`, for a noise process that is present."""
    found = parameter.profile
    return (
        name_shown(parameter),
        format_number(found.value, 4),
        format_number(found.u, 2),
        f"{format_number(found.low)} … {format_number(found.high)}",
        f"> {_MANY_DOF}" if found.dof > _MANY_DOF else format_number(found.dof, 2),
        format_unit(parameter.unit),
    )


def headline(result: AllanResult) -> str:
    """Return one line of text with the total length, the number and the sample rate of the records."""
    records = counted(len(result.samples), "record")
    rate_hz = format_number(1 / result.period_s, 4)
    held = f"{format_number(result.duration_s, 4)} s in {records} at {rate_hz} Hz"
    return f"{held}, filter M = {result.filter_m}" if result.filter_m or result.filter_known else held


def table_lines(result: AllanResult) -> Iterator[str]:
    """Yield the lines of text that show the result, each at most 80 columns wide."""
    name = result.title or result.source or "session"
    yield from _folded(f"Noise at rest of the {PARTS[result.part]} of {name} ({result.sensor})", "")
    for text in (headline(result), *result.notes):
        yield from _folded(text)
    for axis in result.axes:
        yield ""
        yield _row((axis.axis.upper(), *HEAD[1:]))
        for parameter in axis.parameters:
            if parameter.present:
                name, *numbers = cells(parameter)
                yield _row((f"  {name}", *numbers))
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
