"""Records as JSON objects, JSON texts from untrusted files, and a cache of computed results.

The cache stores results of functions of an immutable object in this object.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeVar, dataclass_transform

import numpy as np

T = TypeVar("T")


class ComputedOnce:
    """Base class of frozen dataclasses that cache the results of functions of the instance (`once`)."""

    @cached_property
    def _results(self) -> dict[tuple[Hashable, ...], Any]:
        return {}

    def once(self, function: Callable[..., T], *arguments: Hashable) -> T:
        """Return `function(self, *arguments)`; later calls with equal arguments return the first result."""
        key = (function, *arguments)
        if key not in self._results:
            self._results[key] = function(self, *arguments)
        found: T = self._results[key]
        return found


MOST_DEPTH = 100
"""Deepest nesting of lists and objects that is accepted; documents of this program have fewer than ten."""
LARGEST_INTEGER = 2**63 - 1


HIDDEN = {"hidden": True}
"""Metadata of a dataclass field that is omitted from the JSON document."""
OPTIONAL = {"optional": True}
"""Metadata of a dataclass field that is omitted from the document if its value is its default or null.
None, NaN and infinity are null."""
INLINE = {"inline": True}
"""Metadata of a field with another record: its entries become entries of the outer record's document."""
NAMED_BY_UNIT = {"named_by_unit": True}
"""Metadata of a field: its key gets `_` and the value of the record's attribute `unit` at the end."""
KEYED_BY_NAME = {"keyed_by_name": True}
"""Metadata of a field with several records: the document has them as an object, keyed by their `name`."""


def key(name: str) -> dict[str, str]:
    """Return metadata of a dataclass field that sets its key in the JSON document to `name`."""
    return {"key": name}


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
class JsonRecord:
    """Base class of records that convert to a JSON object by their fields and metadata.

    Each subclass becomes a frozen dataclass without a decorator; it gives other options of `dataclass` as
    arguments of the class (`class Name(JsonRecord, eq=False)`).

    Attributes
    ----------
    document_keys : tuple of str
        Names of the fields and properties in the document, in its order. By default all fields in the
        order of the class.
    """

    document_keys: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **options: bool) -> None:
        dataclass(**{"frozen": True, **options})(cls)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of this record."""
        return _document(self, self.document_keys)


def json_object(**entries: Any) -> dict[str, Any]:
    """Return a JSON object of these entries, with each value converted to a JSON type by `finite`."""
    return {name: finite(entry) for name, entry in entries.items()}


def json_text(document: Any, *, ascii_only: bool = False) -> str:
    """Format a JSON document as indented text with a line end; NaN and infinity become null.

    Numbers have as many digits as are needed to restore them exactly. `ascii_only` writes other letters
    than those of ASCII as escape sequences.
    """
    return json.dumps(finite(document), ensure_ascii=ascii_only, indent=2, allow_nan=False) + "\n"


def finite(value: Any) -> Any:
    """Convert a value to JSON types: records become objects, and NaN and infinity become null."""
    if isinstance(value, Mapping):
        return {str(name): finite(entry) for name, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return finite(value.tolist())
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "as_dict"):
        return value.as_dict()
    return _document(value) if is_dataclass(value) else value


def _document(record: Any, names: Iterable[str] = ()) -> dict[str, Any]:
    declared = {entry.name: entry for entry in fields(record)}
    document: dict[str, Any] = {}
    for name in names or declared:
        value: Any = getattr(record, name)
        metadata: Mapping[str, Any] = declared[name].metadata if name in declared else {}
        if "keyed_by_name" in metadata:
            value = {entry.name: entry for entry in value}
        entry = finite(value)
        if "hidden" in metadata or ("optional" in metadata and entry in (None, declared[name].default)):
            continue
        suffix = f"_{record.unit}" if "named_by_unit" in metadata else ""
        document |= entry if "inline" in metadata else {metadata.get("key", name) + suffix: entry}
    return document


def json_value(text: str, **options: Any) -> Any:
    """Parse a JSON text from an untrusted source.

    Parameters
    ----------
    options
        Options of `json.loads`; `parse_constant=float` accepts NaN for a later check of the field.

    Raises
    ------
    ValueError
        Invalid JSON; NaN or an infinity; a number beyond float64 (1e400); an integer of more than 64 bits;
        lists or objects more than `MOST_DEPTH` deep.
    """
    try:
        strict = {"parse_constant": _refuse, "parse_float": _real, "parse_int": _whole}
        value = json.loads(text, **{**strict, **options})
    except RecursionError:
        raise ValueError(f"it is nested more than {MOST_DEPTH} deep") from None
    level = [value]
    for _ in range(MOST_DEPTH):
        lists = [part.values() if isinstance(part, dict) else part for part in level]
        level = [
            entry for part in lists if not isinstance(part, str | int | float | None) for entry in part
        ]
        if not level:
            return value
    raise ValueError(f"it is nested more than {MOST_DEPTH} deep")


def _refuse(text: str) -> float:
    raise ValueError(f"{text[:20]} is no number of JSON, or too large")


def _real(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _refuse(text)


def _whole(text: str) -> float:
    # Python refuses to convert very long integers, and arrays take none of more than 64 bits.
    value = int(text) if len(text) <= 20 else LARGEST_INTEGER + 1
    return value if abs(value) <= LARGEST_INTEGER else _refuse(text)
