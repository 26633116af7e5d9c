"""What the noise of a part at rest is: coefficients with uncertainties, or limits of what is not there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from adis_gonio.base.jsonable import json_object
from adis_gonio.base.uncertainty import Value, finite_or_none
from adis_gonio.fitting.allan.deviation import AllanCurve
from adis_gonio.fitting.allan.likelihood import Profile
from adis_gonio.fitting.allan.lines import SpectralLine
from adis_gonio.fitting.allan.processes import FLOOR_OF_B, KINDS, Kind

_NAMES: dict[str, dict[Kind, str]] = {
    "gyro": {
        "quantization": "quantization",
        "white": "angle_random_walk",
        "flicker": "bias_instability",
        "walk": "rate_random_walk",
    },
    "accelerometer": {
        "quantization": "quantization",
        "white": "velocity_random_walk",
        "flicker": "bias_instability",
        "walk": "acceleration_random_walk",
    },
}
_UNITS: dict[str, dict[Kind, str]] = {
    "dps": {"quantization": "deg", "white": "dps/√Hz", "flicker": "dps", "walk": "dps/√s"},
    "mg": {"quantization": "mg·s", "white": "mg/√Hz", "flicker": "mg", "walk": "mg/√s"},
    "counts": {
        "quantization": "counts·s",
        "white": "counts/√Hz",
        "flicker": "counts",
        "walk": "counts/√s",
    },
}
_MPS_PER_MG_S = 9.80665e-3
_ALSO: dict[tuple[str, Kind], tuple[str, float]] = {
    ("dps", "white"): ("deg/√h", 60.0),
    ("dps", "flicker"): ("deg/h", 3600.0),
    ("dps", "walk"): ("deg/h/√h", 3600.0 * 60.0),
    ("mg", "white"): ("m/s/√h", 60 * _MPS_PER_MG_S),
    ("mg", "walk"): ("m/s/h/√h", 3600 * 60 * _MPS_PER_MG_S),
}


@dataclass(frozen=True)
class NoiseParameter:
    """One noise process of one axis.

    Attributes
    ----------
    kind : {"quantization", "white", "flicker", "walk"}
    name : str
        Such as `angle_random_walk`. `bias_instability` is the floor of the Allan deviation.
    unit : str
    profile : Profile
        What the likelihood says, in `unit`.
    """

    kind: Kind
    name: str
    unit: str
    profile: Profile
    also: tuple[str, float] | None = None
    """Another unit that the field uses, and its size."""

    @property
    def present(self) -> bool:
        """The data refuse that it is absent."""
        return self.profile.present

    @property
    def value(self) -> Value | None:
        """Value with u, ν, k and U, the longer arm of the interval; None where it may be absent."""
        if not self.present:
            return None
        found = self.profile
        arm = max(found.high - found.value, found.value - found.low)
        return Value(found.value, found.u, self.unit, found.dof, factor=arm / found.u)

    @property
    def interval(self) -> tuple[float, float]:
        """Profile-likelihood interval of 95 %; begins at 0 where the process may be absent."""
        return self.profile.low, self.profile.high

    def as_dict(self) -> dict[str, Any]:
        """Value, u, ν, k, U (null where it is not there), interval, upper limit, what would have shown."""
        value, found = self.value, self.profile
        empty = {"value": None, "u": None, "dof": None, "k": None, "U": None, "unit": self.unit}
        document: dict[str, Any] = {
            "present": self.present,
            **(empty if value is None else value.as_dict()),
            "interval_95": [found.low, finite_or_none(found.high)],
            "upper_95": finite_or_none(found.high),
            "p_value": found.p_value,
            "detectable": finite_or_none(found.detectable),
        }
        if self.kind == "flicker":
            document["ieee_952_b"] = None if value is None else found.value / FLOOR_OF_B
        if self.also is not None:
            unit, size = self.also
            document["also"] = {
                "unit": unit,
                "value": None if value is None else size * found.value,
                "u": None if value is None else size * found.u,
                "upper_95": finite_or_none(size * found.high),
            }
        return document


def parameters(part: str, unit: str, profiles: dict[Kind, Profile]) -> tuple[NoiseParameter, ...]:
    """The processes of an axis under the names that a part's have."""
    return tuple(
        NoiseParameter(
            kind, _NAMES[part][kind], _UNITS[unit][kind], profiles[kind], _ALSO.get((unit, kind))
        )
        for kind in KINDS
        if kind in profiles
    )


@dataclass(frozen=True)
class AxisNoise:
    """Noise of one axis.

    Attributes
    ----------
    axis : str
        `x`, `y` or `z`.
    parameters : tuple of NoiseParameter
        In the order of `processes.KINDS`; without quantization behind the chip's filter.
    ramp : Value
        Slope of the records' lines, weighted mean, per second: a drift that is no noise.
    slow_p_value : float
        That neither flicker nor walk is there.
    adequacy : float
        Chance of a spectrum so far from the fitted one.
    band_hz : (float, float)
        Frequencies that were fitted.
    lines : tuple of SpectralLine
        Sinusoids that were taken off.
    step : float
        Step of the converter; its rounding is accounted for and no part of the coefficients. 0 unknown.
    curve : AllanCurve
    notes : tuple of str
        What a reader has to know, one line each.
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
        """Parameter by its name or kind."""
        for parameter in self.parameters:
            if name in (parameter.name, parameter.kind):
                return parameter
        raise KeyError(name)

    @property
    def ramps(self) -> bool:
        """The line is more than noise."""
        return self.ramp.U is not None and abs(self.ramp.value) > self.ramp.U

    def as_dict(self) -> dict[str, Any]:
        """The axis as JSON."""
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
    unit : str
        `dps`, `mg` or `counts`.
    title, sensor, source : str
        Of the session.
    simulated : bool
        The file says that nothing was measured.
    period_s : float
        Time between samples.
    filter_m : int
        The chip's filter that the densities are behind.
    filter_known : bool
        False where the file does not say and the spectrum chose it.
    positions : tuple of int
        Dwell of each record.
    samples : tuple of int
        Length of each record.
    axes : tuple of AxisNoise
    notes : tuple of str
    """

    part: str
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
        """Time of all records."""
        return self.period_s * sum(self.samples)

    @property
    def longest_s(self) -> float:
        """Time of the longest record."""
        return self.period_s * max(self.samples)

    def __getitem__(self, axis: str) -> AxisNoise:
        """Noise of an axis by its letter."""
        for found in self.axes:
            if found.axis == axis:
                return found
        raise KeyError(axis)

    def as_dict(self) -> dict[str, Any]:
        """The JSON document of `adis-gonio allan`."""
        return {
            "part": self.part,
            "unit": self.unit,
            "title": self.title,
            "sensor": self.sensor,
            "source": self.source,
            "sample_rate_hz": 1 / self.period_s,
            "filter_m": self.filter_m,
            "filter_known": self.filter_known,
            "records": [
                {"position": position, "samples": n, "duration_s": n * self.period_s}
                for position, n in zip(self.positions, self.samples, strict=True)
            ],
            "duration_s": self.duration_s,
            "axes": {found.axis: found.as_dict() for found in self.axes},
            "notes": list(self.notes),
        }

    def summary(self) -> str:
        """Table of 80 columns with what there is to say, as `adis-gonio allan` prints it."""
        from adis_gonio.fitting.allan.words import table_lines

        return "\n".join(table_lines(self))

    def __repr__(self) -> str:
        held = "; ".join(
            f"{found.axis}: "
            + ", ".join(f"{p.name} {p.profile.value:.3g} {p.unit}" for p in found.parameters if p.present)
            for found in self.axes
        )
        return f"AllanResult({self.part}, {math.floor(self.duration_s)} s at rest; {held})"
