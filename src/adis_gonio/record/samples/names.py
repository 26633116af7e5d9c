"""Names and units in a header: `Acc_X (g)`, `time [ms]`, `a_x / (m/s²)` as columns of the format.

What is recognised by its name has one meaning only; all else is for `--columns` to say.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

AXES = ("ax", "ay", "az")
GYROS = ("gx", "gy", "gz")
COLUMNS = ("time_s", "position", "angle_deg", "approach", *AXES, *GYROS, "temp_c", "supply_v", "use")

Scale = tuple[float, float, float]
"""(multiply, divide, add): ms become s by a division, which is exact where a decimal fraction is."""


@dataclass(frozen=True)
class CsvColumn:
    """A column that was recognised.

    Attributes
    ----------
    name : str
        One of `COLUMNS`.
    place : int
        Which cell of a row, from 0.
    text : str
        The header's own text.
    unit : str
        What the header says; empty where it says nothing.
    plain : bool
        True where the header has the format's own name.
    """

    name: str
    place: int
    text: str
    unit: str = ""
    plain: bool = False


def _xyz(*forms: str) -> dict[str, tuple[str, ...]]:
    return {axis: tuple(form.replace("?", axis) for form in forms) for axis in "xyz"}


_ACCEL = _xyz(
    "a?", "a_?", "acc?", "acc_?", "accel?", "accel_?", "?_acc", "?_accel", "acceleration_?",
    "?_acceleration", "accelerometer_?", "beschleunigung_?",
)  # fmt: skip
_GYRO = _xyz(
    "g?", "gyr?", "gyr_?", "gyro?", "gyro_?", "?_gyro", "gyroscope_?", "omega_?", "rate_?", "drehrate_?",
    "angular_rate_?", "angular_velocity_?",
)  # fmt: skip
_ALIASES: dict[str, str] = {
    **dict.fromkeys(
        ("time", "t", "timestamp", "zeit", "elapsed", "seconds", "datetime", "date_time"), "time_s"
    ),
    **dict.fromkeys(("pos", "dwell", "pose"), "position"),
    **dict.fromkeys(("angle", "theta", "θ", "winkel"), "angle_deg"),
    **{alias: f"a{axis}" for axis, forms in _ACCEL.items() for alias in forms},
    **{alias: f"g{axis}" for axis, forms in _GYRO.items() for alias in forms},
    **dict.fromkeys(("temp", "temperature", "temperatur"), "temp_c"),
    **dict.fromkeys(("supply", "supply_voltage", "vcc", "vdd"), "supply_v"),
    **{name: name for name in COLUMNS},
}

_ACCEL_UNITS = {
    "g": "g", "gn": "g", "g0": "g", "mg": "mg", "milli-g": "mg",
    **dict.fromkeys(
        ("m/s²", "m/s^2", "m/s2", "m/s**2", "m/s/s", "mps2", "ms-2", "ms^-2", "m·s⁻²", "m/sâ²"), "mps2"
    ),
    **dict.fromkeys(("lsb", "lsbs"), "lsb"),
    **dict.fromkeys(("count", "counts", "digit", "digits", "raw", "adc"), "counts"),
}  # fmt: skip
_GYRO_UNITS = {
    **dict.fromkeys(("dps", "deg/s", "°/s", "degree/s", "degrees/s", "deg/sec"), "dps"),
    **dict.fromkeys(("rad/s", "rad/sec", "radps", "rads-1", "rad·s⁻¹"), "radps"),
    **dict.fromkeys(("count", "counts", "digit", "digits", "raw", "adc", "lsb"), "counts"),
}
_SCALES: dict[str, dict[str, Scale]] = {
    "time_s": {
        **dict.fromkeys(("s", "sec", "second", "seconds", "sekunden", "utc"), (1.0, 1.0, 0.0)),
        **dict.fromkeys(("ms", "msec", "millis"), (1.0, 1e3, 0.0)),
        **dict.fromkeys(("us", "µs", "μs", "usec", "micros"), (1.0, 1e6, 0.0)),
        "ns": (1.0, 1e9, 0.0),
        "min": (60.0, 1.0, 0.0),
    },
    "angle_deg": {
        **dict.fromkeys(("deg", "°", "degree", "degrees"), (1.0, 1.0, 0.0)),
        "rad": (57.29577951308232, 1.0, 0.0),
    },
    "temp_c": {
        **dict.fromkeys(("c", "°c", "degc", "celsius"), (1.0, 1.0, 0.0)),
        **dict.fromkeys(("k", "kelvin"), (1.0, 1.0, -273.15)),
        **dict.fromkeys(("f", "°f", "degf"), (5.0, 9.0, -160.0 / 9.0)),
    },
    "supply_v": {"v": (1.0, 1.0, 0.0), "mv": (1.0, 1e3, 0.0)},
}
SAME: Scale = (1.0, 1.0, 0.0)

_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\[\]()]*?)\s*[\])]\s*$")
_SLASH = re.compile(r"^([^/]+?)\s*/\s*\(?(.+?)\)?$")
_LONGEST_NAME = 200
"""Characters of a header's cell that are read: these forms take the cube of its length."""
_SPACES = re.compile(r"[\s.\-]+")


def known_units(name: str) -> Mapping[str, object]:
    """Units of a column, by their spelling; empty for one without."""
    if name in AXES:
        return _ACCEL_UNITS
    if name in GYROS:
        return _GYRO_UNITS
    return _SCALES.get(name, {})


def unit_of(name: str, unit: str) -> str | None:
    """The format's spelling of a unit of accelerations or rates; None where it is not known."""
    table = _ACCEL_UNITS if name in AXES else _GYRO_UNITS
    return table.get(_squeezed(unit))


def scale_of(name: str, unit: str) -> Scale | None:
    """How values of a column become the format's; None where the unit is not known."""
    return _SCALES.get(name, {}).get(_squeezed(unit)) if unit else SAME


def recognised(text: str) -> tuple[str, str, bool] | None:
    """Column, unit, and whether it is the format's own name, of a header's cell; None if unknown."""
    text = text.strip()
    if text in COLUMNS:
        return text, "", True
    base, unit = _parted(text)
    name = _ALIASES.get(base)
    if name is not None:
        return name, unit, base == name and not unit
    stem, _, end = base.rpartition("_")
    name = _ALIASES.get(stem)
    if name is not None and not unit and end in known_units(name):
        return name, end, False
    return None


def unit_in(text: str) -> str:
    """Unit in brackets or behind a slash of a header's cell; empty where there is none."""
    return _parted(text)[1]


def without_unit(text: str) -> str:
    """A header's cell without its unit, as it is spelled."""
    for form in (_BRACKETS, _SLASH):
        match = form.match(text[:_LONGEST_NAME].strip())
        if match:
            return match[1].strip(" /")
    return text.strip()


def _parted(text: str) -> tuple[str, str]:
    """Name, with underscores and in small letters, and unit of a header's cell."""
    for form in (_BRACKETS, _SLASH):
        match = form.match(text[:_LONGEST_NAME])
        if match:
            return _normal(match[1]), match[2].strip()
    return _normal(text), ""


def _normal(text: str) -> str:
    return _SPACES.sub("_", text.strip(" /").lower()).strip("_")


def _squeezed(unit: str) -> str:
    return unit.lower().replace(" ", "")
