"""The declaration of the samples CSV: its columns and its keys, for reading, writing and the template.

A column has a name, the names and units that other programs give it, a largest value and a text form; a key
of a line `# key: value` has a reader and a text form. A header cell such as `Acc_X (g)`, `time [ms]` or
`a_x / (m/s²)` is recognised if it has one meaning only; the user names other cells by `--columns`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adis_gonio.model.records import ACCEL_UNITS, GYRO_UNITS, METADATA, PLANES, SENSORS, SERIES, StageCurve

AXES, GYROS = SERIES["accel"], SERIES["gyro"]

Scale = tuple[float, float, float]
"""Conversion of a number x to x · factor / divisor + summand; a divisor of 1000 for ms rounds only once."""
SAME: Scale = (1.0, 1.0, 0.0)
Units = Mapping[str, tuple[str, Scale]]
"""Units of a column: spelling in small letters → the format's spelling, and the scale to its unit."""


def number_text(value: float) -> str:
    """Return the shortest decimal text that reads back as exactly this float."""
    value = float(value)
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


@dataclass(frozen=True)
class SamplesColumn:
    """Declaration of a column of the samples CSV: names, units, limit and text form.

    Attributes
    ----------
    aliases : tuple of str
        Other names of the column in a header.
    units : Units
        Units that may be stated in a header.
    largest : float
        Largest magnitude of a number in the column; a larger number is refused.
    per_dwell : bool
        True for a column with one value for each dwell; other columns have a number in every row.
    text : callable
        Converts a value to the text of its cell.
    """

    aliases: tuple[str, ...] = ()
    units: Units = field(default_factory=dict)
    largest: float = 1e10  # a count of 32 bits is smaller, and its fourth power is far from overflow
    per_dwell: bool = False
    text: Callable[[Any], str] = number_text

    def unit(self, text: str) -> tuple[str, Scale] | None:
        """Return the format's spelling and the scale of a unit in a header; None for an unknown unit.

        An empty text means the format's own unit, so that the spelling is empty and the scale `SAME`.
        """
        return self.units.get(text.lower().replace(" ", "")) if text else ("", SAME)


def _unit(name: str, *spellings: str, scale: Scale = SAME) -> dict[str, tuple[str, Scale]]:
    return dict.fromkeys(spellings, (name, scale))


def _axis(axis: str, forms: str, units: Units) -> SamplesColumn:
    return SamplesColumn(tuple(forms.replace("?", axis).split()), units)


_ACCEL = (
    "a? a_? acc? acc_? accel? accel_? ?_acc ?_accel acceleration_? ?_acceleration accelerometer_?"
    " beschleunigung_?"
)
_GYRO = (
    "g? gyr? gyr_? gyro? gyro_? ?_gyro gyroscope_? omega_? rate_? drehrate_? angular_rate_?"
    " angular_velocity_?"
)
_ACCEL_UNITS = {
    **_unit("g", "g", "gn", "g0"),
    **_unit("mg", "mg", "milli-g"),
    **_unit("mps2", "m/s²", "m/s^2", "m/s2", "m/s**2", "m/s/s", "mps2", "ms-2", "ms^-2", "m·s⁻²", "m/sâ²"),
    **_unit("lsb", "lsb", "lsbs"),
    **_unit("counts", "count", "counts", "digit", "digits", "raw", "adc"),
}
_GYRO_UNITS = {
    **_unit("dps", "dps", "deg/s", "°/s", "degree/s", "degrees/s", "deg/sec"),
    **_unit("radps", "rad/s", "rad/sec", "radps", "rads-1", "rad·s⁻¹"),
    **_unit("counts", "count", "counts", "digit", "digits", "raw", "adc", "lsb"),
}

_ANGLE_UNITS = {
    **_unit("deg", "deg", "°", "degree", "degrees"),
    **_unit("rad", "rad", scale=(57.29577951308232, 1.0, 0.0)),
}


def _angle_text(angle_deg: float) -> str:
    return "" if math.isnan(angle_deg) else number_text(angle_deg)


COLUMNS: dict[str, SamplesColumn] = {
    "time_s": SamplesColumn(
        ("time", "t", "timestamp", "zeit", "elapsed", "seconds", "datetime", "date_time"),
        {
            **_unit("s", "s", "sec", "second", "seconds", "sekunden", "utc"),
            **_unit("ms", "ms", "msec", "millis", scale=(1.0, 1e3, 0.0)),
            **_unit("us", "us", "µs", "μs", "usec", "micros", scale=(1.0, 1e6, 0.0)),
            **_unit("ns", "ns", scale=(1.0, 1e9, 0.0)),
            **_unit("min", "min", scale=(60.0, 1.0, 0.0)),
        },
        largest=1e20,  # in ns since 1970 a time has 2e18
    ),
    "position": SamplesColumn(("pos", "dwell", "pose"), largest=1e9, per_dwell=True),
    "angle_deg": SamplesColumn(
        ("angle", "theta", "θ", "winkel"), _ANGLE_UNITS, largest=1e6, per_dwell=True, text=_angle_text
    ),
    "turned_deg": SamplesColumn(("turned",), _ANGLE_UNITS, largest=1e6, per_dwell=True, text=_angle_text),
    "approach": SamplesColumn(per_dwell=True, text=lambda sign: f"{sign:+d}" if sign else ""),
    **{f"a{axis}": _axis(axis, _ACCEL, _ACCEL_UNITS) for axis in "xyz"},
    **{f"g{axis}": _axis(axis, _GYRO, _GYRO_UNITS) for axis in "xyz"},
    "temp_c": SamplesColumn(
        ("temp", "temperature", "temperatur", "t"),
        {
            **_unit("c", "c", "°c", "degc", "celsius"),
            **_unit("k", "k", "kelvin", scale=(1.0, 1.0, -273.15)),
            **_unit("f", "f", "°f", "degf", scale=(5.0, 9.0, -160.0 / 9.0)),
        },
    ),
    "supply_v": SamplesColumn(
        ("supply", "supply_voltage", "vcc", "vdd"),
        {**_unit("v", "v"), **_unit("mv", "mv", scale=(1.0, 1e3, 0.0))},
    ),
    "use": SamplesColumn(per_dwell=True, text=str),
}
"""Columns of the format by name, in the order in which they are written."""


def _column_called(alias: str, unit: str) -> str | None:
    """Return the name of the column of the format that has an alias and allows a unit.

    If several columns have this alias, the first that allows the unit is returned, or the first of all if
    none allows it; None if no column has the alias.
    """
    names = [name for name, column in COLUMNS.items() if alias in (*column.aliases, name)]
    return next((name for name in names if COLUMNS[name].unit(unit)), names[0] if names else None)


@dataclass(frozen=True)
class CsvColumn:
    """A column of the file that was recognised in its header.

    Attributes
    ----------
    name : str
        Name of the column in the format, a key of `COLUMNS`.
    place : int
        Number of the cell in a row, from 0.
    text : str
        Text of the header cell.
    unit : str
        Unit from the header, in the format's spelling once it is known; empty if the header has none.
    plain : bool
        True if the header has the format's own name, which states the unit.
    scale : Scale
        Conversion from that unit to the unit of the format.
    """

    name: str
    place: int
    text: str
    unit: str = ""
    plain: bool = False
    scale: Scale = SAME


_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\[\]()]*?)\s*[\])]\s*$")
_SLASH = re.compile(r"^([^/]+?)\s*/\s*\(?(.+?)\)?$")
_LONGEST_NAME = 200
"""Limit of characters in a header cell: the time of the patterns grows with the cube of the length."""
_SPACES = re.compile(r"[\s.\-]+")


def split_unit(text: str) -> tuple[str, str]:
    """Split a header cell into name and unit; the unit is in brackets or after a slash, or empty."""
    for form in (_BRACKETS, _SLASH):
        match = form.match(text[:_LONGEST_NAME].strip())
        if match:
            return match[1].strip(" /"), match[2].strip()
    return text.strip(), ""


def recognise_column(text: str) -> tuple[str, str, bool] | None:
    """Return the name of the column of the format that a header cell means, its unit, and a flag.

    The unit is empty if the cell states none. The flag is True if the cell is exactly the format's name.
    Return None if the cell is not recognised.
    """
    text = text.strip()
    if text in COLUMNS:
        return text, "", True
    base, unit = split_unit(text)
    base = _SPACES.sub("_", base.strip(" /").lower()).strip("_")
    name = _column_called(base, unit)
    if name is not None:
        return name, unit, base == name and not unit
    stem, _, end = base.rpartition("_")
    name = _column_called(stem, "")
    if name is not None and not unit and end in COLUMNS[name].units:
        return name, end, False
    return None


# -- keys -----------------------------------------------------------------------------------------

_LARGEST = 1e6
"""Largest gravity in m/s², and largest uncertainty in degrees or mg, that a key may state."""
_LEAST_SIGMA_DEG = 1e-9


@dataclass(frozen=True)
class Key:
    """Declaration of a line `# key: value`, which states a field of the session.

    Attributes
    ----------
    read : callable
        Converts a text to a value; raises `ValueError`, with a message that may begin with "expected".
    text : callable
        Converts a value to a text of one line.
    """

    read: Callable[[str], Any] = str
    text: Callable[[Any], str] = lambda value: " ".join(value.split())


def _choice(allowed: Sequence[str]) -> Key:
    def read(text: str) -> str:
        if text.lower() not in allowed:
            raise ValueError(f"expected one of {', '.join(allowed)}")
        return text.lower()

    return Key(read)


def _number(text: str) -> float:
    # Python's float accepts '1_000', which no instrument writes. A single comma that is not followed by
    # exactly three digits is a decimal comma, since it cannot separate thousands.
    if "_" in text:
        raise ValueError(text)
    whole, comma, fraction = text.partition(",")
    if comma and "." not in text and (len(fraction) != 3 or whole.lstrip("+-") in ("", "0")):
        text = f"{whole}.{fraction}"
    return float(text)


def _positive(text: str) -> float:
    value = _number(text)
    if not 1 / _LARGEST <= value <= _LARGEST:
        raise ValueError(f"expected a number from {1 / _LARGEST:g} to {_LARGEST:g}")
    return value


def _filter(text: str) -> int:
    if text not in map(str, range(7)):
        raise ValueError("expected a whole number from 0 to 6")
    return int(text)


def _sigma(text: str) -> float:
    if text.lower() == "free":
        return math.inf
    value = _number(text)
    if value != 0 and not _LEAST_SIGMA_DEG <= value <= _LARGEST:
        raise ValueError(f"expected 0, degrees from {_LEAST_SIGMA_DEG:g} to {_LARGEST:g}, or 'free'")
    return value


def _curve(text: str) -> StageCurve:
    try:
        name, *parts = text.split(" / ")
        angle, error, lower = (np.array(part.split(), dtype=float) for part in parts)
        matrix = np.zeros((len(angle), len(error)))
        matrix[np.tril_indices(len(angle))] = lower
    except (ValueError, IndexError):
        form = "'name / angles / errors / lower triangle of their covariance', as export writes it"
        raise ValueError(f"expected {form}") from None
    return StageCurve(name, angle, error, matrix + np.tril(matrix, -1).T)


def _curve_text(curve: StageCurve) -> str:
    lower = curve.covariance_deg2[np.tril_indices(len(curve.angle_deg))]
    numbers = (curve.angle_deg, curve.error_deg, lower)
    return " / ".join([curve.name, *(" ".join(map(number_text, one)) for one in numbers)])


KEYS: dict[str, Key] = {
    **dict.fromkeys(("title", *METADATA), Key()),
    "sensor": _choice(SENSORS),
    "accel_unit": _choice(ACCEL_UNITS),
    "gyro_unit": _choice(GYRO_UNITS),
    "gravity_mps2": Key(_positive, number_text),
    "plane": _choice(PLANES),
    "fixture_sigma_deg": Key(_sigma, lambda sigma: "free" if math.isinf(sigma) else number_text(sigma)),
    "stage_curve": Key(_curve, _curve_text),
    "reading_u_mg": Key(_positive, number_text),
    "bias_instability_mg": Key(_positive, number_text),
    "filter_m": Key(_filter, str),
}
"""Keys of the lines `# key: value` in the order of writing: fields of `Session`."""

_BEGINS = r"(?=[=+\-@＝＋－＠])"
_FORMULA = re.compile(r"""([,;|][\s"']*)""" + _BEGINS)
_WITHOUT_FORMULA = re.compile(r"""([,;|][\s"']*)'""" + _BEGINS)


def without_formulas(text: str) -> str:
    """Make a text safe in a spreadsheet: no part of it is a formula, even if a comma begins a new cell.

    An apostrophe is put before each sign that would begin a formula; `with_formulas` removes it.
    """
    return _FORMULA.sub(r"\1'", text)


def with_formulas(text: str) -> str:
    """Undo `without_formulas`: restore text that was protected from being read as a formula."""
    return _WITHOUT_FORMULA.sub(r"\1", text)
