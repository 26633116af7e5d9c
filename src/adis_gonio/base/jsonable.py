"""Values in the types that JSON has, and JSON from a file that anybody may have written."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

MOST_DEPTH = 100
"""Lists and objects inside one another; the documents of this program have fewer than ten."""
LARGEST_INTEGER = 2**63 - 1


def finite(value: Any) -> Any:
    """The same in types that JSON has; what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(key): finite(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return finite(value.tolist())
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_value(text: str, **options: Any) -> Any:
    """Value of a JSON text whose writer is not known.

    Parameters
    ----------
    options
        Of `json.loads`; `parse_constant=float` lets NaN pass where a check of the field names it.

    Raises
    ------
    ValueError
        No JSON; NaN or an infinity, which JSON does not have; a number beyond float64 (1e400); an integer
        of more than 64 bits; lists or objects more than `MOST_DEPTH` deep.
    """
    try:
        strict = {"parse_constant": _refuse, "parse_float": _real, "parse_int": _whole}
        value = json.loads(text, **{**strict, **options})
    except RecursionError:
        raise ValueError(f"it is nested more than {MOST_DEPTH} deep") from None
    level = [value]
    for _ in range(MOST_DEPTH):
        level = [entry for part in level for entry in _entries(part)]
        if not level:
            return value
    raise ValueError(f"it is nested more than {MOST_DEPTH} deep")


def _entries(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return list(value.values())
    return value if isinstance(value, list) else []


def _refuse(text: str) -> float:
    raise ValueError(f"{text[:20]} is no number of JSON, or too large")


def _real(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _refuse(text)


def _whole(text: str) -> float:
    # Python refuses to convert very long integers, and arrays take none of more than 64 bits.
    value = int(text) if len(text) <= 20 else LARGEST_INTEGER + 1
    return value if abs(value) <= LARGEST_INTEGER else _refuse(text)
