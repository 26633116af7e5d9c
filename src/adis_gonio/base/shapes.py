"""Checks of the types and ranges of values from a file; each message names the value and the mistake.

A shape is a function of one value that raises `ShapeError` if the value does not pass. The error's message
begins with the path to the value within the file's content, such as
`.positions[3].angle_deg is 'x': expected a number from -1e+06 to 1e+06`. The caller puts the name of the
file or the row before it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any

Shape = Callable[[Any], None]

LONGEST_TEXT = 100_000
"""Largest number of characters of a text, such as an operator's note."""
_SHOWN = 40


class ShapeError(ValueError):
    """A value does not have its declared type or is outside its allowed range."""


def shown(value: Any) -> str:
    """Return a value as text for an error message: one line of at most 40 characters."""
    if isinstance(value, int) and value.bit_length() > 64:
        return f"an integer of {value.bit_length()} bits"  # Python refuses to print very long integers
    text = ascii(value) if isinstance(value, str) and not value.isprintable() else repr(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 1]}…"


def _refuse(value: Any, expected: str) -> ShapeError:
    return ShapeError(f" is {shown(value)}: expected {expected}")


def _values(expected: str, passes: Callable[[Any], bool]) -> Shape:
    """Return a check that `passes` returns True for a value; `expected` describes such values."""

    def check(value: Any) -> None:
        if not passes(value):
            raise _refuse(value, expected)

    return check


def number(low: float, high: float) -> Shape:
    """Return a check that a value is a number from `low` to `high`; booleans and NaN fail."""

    def passes(value: Any) -> bool:
        return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high

    return _values(f"a number from {low:g} to {high:g}", passes)


def whole(low: int, high: int) -> Shape:
    """Return a check that a value is an integer from `low` to `high`."""
    return _values(
        f"an integer from {low} to {high}", lambda value: type(value) is int and low <= value <= high
    )


def choice(*allowed: str | int | None) -> Shape:
    """Return a check that a value is one of the `allowed` texts or integers."""
    expected = f"one of {', '.join(map(repr, allowed))}" if len(allowed) <= 8 else "a known name"
    # A boolean and a float may equal an integer, and a list cannot be looked up.
    return _values(expected, lambda value: type(value) in (str, int, type(None)) and value in allowed)


def _is_moment(value: Any) -> bool:
    try:
        return datetime.fromisoformat(value).tzinfo is not None
    except (TypeError, ValueError):
        return False


text = _values(
    f"a text of at most {LONGEST_TEXT} characters",
    lambda value: isinstance(value, str) and len(value) <= LONGEST_TEXT,
)
"""Check that a value is a text of at most `LONGEST_TEXT` characters."""
truth_value = _values("true or false", lambda value: type(value) is bool)
"""Check that a value is a boolean."""
blob = _values("bytes", lambda value: isinstance(value, bytes))
"""Check that a value is a bytes object."""
moment = _values("a time such as 2026-11-24T10:00:00+00:00", _is_moment)
"""Check that a value is a date and time as ISO 8601 text with an offset from UTC."""
anything = _values("", lambda value: True)
"""Accept any value; for entries that no computation uses."""


def nullable(shape: Shape) -> Shape:
    """Return a check that a value is None or passes the check `shape`."""

    def check(value: Any) -> None:
        if value is not None:
            shape(value)

    return check


def list_of(shape: Shape, least: int, most: int) -> Shape:
    """Return a check for a list of `least` to `most` values that all pass the check `shape`."""

    def check(value: Any) -> None:
        if not isinstance(value, list) or not least <= len(value) <= most:
            count = f"{most}" if least == most else f"{least} to {most}"
            raise _refuse(value, f"a list of {count} values")
        for k, entry in enumerate(value):
            checked_value(f"[{k}]", shape, entry)

    return check


def mapping_of(shape: Shape) -> Shape:
    """Return a check for an object with any names, in which each value passes the check `shape`."""
    return fields({}, others=shape)


def fields(
    required: Mapping[str, Shape], optional: Mapping[str, Shape] | None = None, others: Shape | None = None
) -> Shape:
    """Return a check for an object with named values, each with a check for its value.

    Parameters
    ----------
    required : mapping of str to Shape
        Names that must be present, with the check of each value.
    optional : mapping of str to Shape, optional
        Names that may be present.
    others : Shape, optional
        Check of values with other names; without it, other names are refused.
    """
    known = {**required, **(optional or {})}

    def check(value: Any) -> None:
        if not isinstance(value, dict):
            raise _refuse(value, "an object")
        missing = next((name for name in required if name not in value), None)
        if missing is not None:
            raise ShapeError(f" lacks '{missing}'")
        for key, entry in value.items():
            shape = known.get(key, others)
            if shape is None:
                raise ShapeError(f"  contains {shown(key)}, which is not known")
            checked_value(f".{key[:_SHOWN]}" if key.isprintable() else f"[{shown(key)}]", shape, entry)

    return check


def checked_value(name: str, shape: Shape, value: Any) -> Any:
    """Return `value` if it passes the check `shape`.

    Raises
    ------
    ShapeError
        The value has a wrong type or is out of range; the message begins with `name`.
    """
    try:
        shape(value)
    except ShapeError as error:
        raise ShapeError(f"{name}{error}") from None
    return value
