"""The lines `# key: value` before the header: what the file says of itself."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.model.gravity import checked_gravity_mps2
from adis_gonio.model.records import ACCEL_UNITS, GYRO_UNITS, PLANES, SENSORS
from adis_gonio.record.samples.dialect import SPACE, Dialect

_LARGEST = 1e6
"""Of gravity in m/s², an uncertainty in degrees or mg; a session file has the same bounds."""
_LEAST_SIGMA_DEG = 1e-9
_BEGINS = r"(?=[=+\-@＝＋－＠])"
_FORMULA = re.compile(r"""([,;|][\s"']*)""" + _BEGINS)
_WITHOUT_FORMULA = re.compile(r"""([,;|][\s"']*)'""" + _BEGINS)


def without_formulas(text: str) -> str:
    """Text in which a spreadsheet finds no formula, even if it begins a new cell at a comma.

    An apostrophe stands before each sign that would begin one; `keys_of` takes it out again.
    """
    return _FORMULA.sub(r"\1'", text)


@dataclass(frozen=True)
class Keys:
    """What leading lines say.

    Attributes
    ----------
    values : dict of str to object
        Fields of a `Session`, those that are stated; `decimal` (point or comma) beside them.
    notes : tuple of str
    """

    values: dict[str, Any]
    notes: tuple[str, ...]


def keys_of(file: str, lines: Sequence[tuple[int, str]], dialect: Dialect, columns: int) -> Keys:
    """Keys and notes of the leading lines.

    Parameters
    ----------
    file : str
        Name for messages.
    lines : sequence of (int, str)
        Lines that begin with `#`, with their numbers.
    dialect : Dialect
        Of the rows: a spreadsheet writes these lines as rows too.
    columns : int
        Cells of the header, to which a spreadsheet fills every row up.

    Raises
    ------
    DataError
        A key that stands there twice, or an unknown value of one.
    """
    values: dict[str, Any] = {}
    notes: list[str] = []
    for number, line in lines:
        name, colon, text = _bare(line, dialect, columns).partition(":")
        name, text = name.strip().lower(), _WITHOUT_FORMULA.sub(r"\1", text.strip())
        if not colon:
            continue
        if name == "note":
            notes.append(text)
        elif name not in _KEYS:
            notes.append(f"key '{name}' in row {number} is not known and was ignored")
        elif name in values:
            raise DataError(f"{file}, row {number}: key '{name}' stands there twice")
        elif text:
            values[name] = _value(file, number, name, text)
            notes += _remarks(name, values[name])
    return Keys(values, tuple(notes))


def _bare(line: str, dialect: Dialect, columns: int) -> str:
    """A line without its `#`, and without what a spreadsheet has added to it."""
    if line.startswith('"'):
        try:
            line = dialect.cells(line)[0]
        except (ValueError, IndexError):
            line = line.strip('"')
    elif dialect.delimiter != SPACE and (
        line.endswith(2 * dialect.delimiter) or line.count(dialect.delimiter) == columns - 1
    ):
        line = line.rstrip(dialect.delimiter)
    return line.lstrip("#")


def _value(file: str, number: int, name: str, text: str) -> Any:
    try:
        return _KEYS[name](text)
    except ValueError as error:
        reason = (
            str(error) if str(error).startswith("expected") else "expected a number, with a decimal point"
        )
        raise DataError(f"{file}, row {number}: {name} '{text}' is not known: {reason}") from error


def _remarks(name: str, value: Any) -> list[str]:
    if name != "gravity_mps2":
        return []
    try:
        checked_gravity_mps2(value)
    except UsageError as error:
        return [f"gravity_mps2 is taken as it stands, but {str(error).split(';')[0]}"]
    return []


def _choice(allowed: Sequence[str]) -> Callable[[str], str]:
    def parse(text: str) -> str:
        if text.lower() not in allowed:
            raise ValueError(f"expected one of {', '.join(allowed)}")
        return text.lower()

    return parse


def _number(text: str) -> float:
    # Python's float takes '1_000', which no instrument writes. A key has one number: no mark between
    # thousands can be meant where a comma stands alone before other than three digits.
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


def _sigma(text: str) -> float:
    if text.lower() == "free":
        return math.inf
    value = _number(text)
    if value != 0 and not _LEAST_SIGMA_DEG <= value <= _LARGEST:
        raise ValueError(f"expected 0, degrees from {_LEAST_SIGMA_DEG:g} to {_LARGEST:g}, or 'free'")
    return value


def _mark(text: str) -> str:
    marks = {".": ".", "point": ".", ",": ",", "comma": ","}
    if text.lower() not in marks:
        raise ValueError("expected 'point' or 'comma'")
    return marks[text.lower()]


_KEYS: dict[str, Callable[[str], Any]] = {
    "sensor": _choice(SENSORS),
    "gravity_mps2": _positive,
    "fixture_sigma_deg": _sigma,
    "plane": _choice(PLANES),
    "accel_unit": _choice(ACCEL_UNITS),
    "gyro_unit": _choice(GYRO_UNITS),
    "reading_u_mg": _positive,
    "title": str,
    "operator": str,
    "serial": str,
    "stage": str,
    "decimal": _mark,
}
