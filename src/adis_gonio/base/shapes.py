"""Types and ranges of values from a file: each shape checks one value and names its mistake.

A shape is a function of one value that raises `ShapeError`. The error's message begins with the way to
the value, such as `.positions[3].angle_deg is 'x': expected a number from -1e+06 to 1e+06`, so that the
caller puts the name of the file or the row before it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any

Shape = Callable[[Any], None]

LONGEST_TEXT = 100_000
"""Most characters of a note of an operator."""
_SHOWN = 40


class ShapeError(ValueError):
    """A value has another type than declared, or lies outside its range."""


def shown(value: Any) -> str:
    """Value in at most 40 characters of one line."""
    if isinstance(value, int) and value.bit_length() > 64:
        return f"an integer of {value.bit_length()} bits"  # Python refuses to print very long integers
    text = ascii(value) if isinstance(value, str) and not value.isprintable() else repr(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 1]}…"


def _refuse(value: Any, expected: str) -> ShapeError:
    return ShapeError(f" is {shown(value)}: expected {expected}")


def number(low: float, high: float) -> Shape:
    """Number from `low` to `high`; neither a truth value nor NaN."""

    def check(value: Any) -> None:
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise _refuse(value, f"a number from {low:g} to {high:g}")

    return check


def whole(low: int, high: int) -> Shape:
    """Integer from `low` to `high`."""

    def check(value: Any) -> None:
        if type(value) is not int or not low <= value <= high:
            raise _refuse(value, f"an integer from {low} to {high}")

    return check


def text(value: Any) -> None:
    """Text of at most `LONGEST_TEXT` characters."""
    if not isinstance(value, str) or len(value) > LONGEST_TEXT:
        raise _refuse(value, f"a text of at most {LONGEST_TEXT} characters")


def truth_value(value: Any) -> None:
    """Boolean."""
    if type(value) is not bool:
        raise _refuse(value, "true or false")


def blob(value: Any) -> None:
    """Bytes."""
    if not isinstance(value, bytes):
        raise _refuse(value, "bytes")


def moment(value: Any) -> None:
    """Time of the wall clock: ISO 8601 with its offset from UTC."""
    text(value)
    try:
        if datetime.fromisoformat(value).tzinfo is not None:
            return
    except ValueError:
        pass
    raise _refuse(value, "a time such as 2026-11-24T10:00:00+00:00")


def anything(value: Any) -> None:
    """Any value, for entries without computations."""


def choice(*allowed: str | int | None) -> Shape:
    """One of some texts or integers."""

    def check(value: Any) -> None:
        if (
            isinstance(value, bool | float)
            or not isinstance(value, str | int | None)
            or value not in allowed
        ):
            few = len(allowed) <= 8
            raise _refuse(value, f"one of {', '.join(map(repr, allowed))}" if few else "a known name")

    return check


def nullable(shape: Shape) -> Shape:
    """Null, or a value of a shape."""

    def check(value: Any) -> None:
        if value is not None:
            shape(value)

    return check


def list_of(shape: Shape, least: int, most: int) -> Shape:
    """List of `least` to `most` values of a shape."""

    def check(value: Any) -> None:
        if not isinstance(value, list) or not least <= len(value) <= most:
            count = f"{most}" if least == most else f"{least} to {most}"
            raise _refuse(value, f"a list of {count} values")
        for k, entry in enumerate(value):
            _inside(f"[{k}]", shape, entry)

    return check


def mapping_of(shape: Shape) -> Shape:
    """Object with any names and values of one shape."""

    def check(value: Any) -> None:
        if not isinstance(value, dict):
            raise _refuse(value, "an object")
        for key, entry in value.items():
            _inside(_way(key), shape, entry)

    return check


def fields(
    required: Mapping[str, Shape], optional: Mapping[str, Shape] | None = None, others: Shape | None = None
) -> Shape:
    """Object with named values.

    Parameters
    ----------
    others : Shape, optional
        Shape of values with other names; without it, they are refused.
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
            _inside(_way(key), shape, entry)

    return check


def _way(key: str) -> str:
    return f".{key[:_SHOWN]}" if key.isprintable() else f"[{shown(key)}]"


def _inside(way: str, shape: Shape, value: Any) -> None:
    try:
        shape(value)
    except ShapeError as error:
        raise ShapeError(f"{way}{error}") from None
