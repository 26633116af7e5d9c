"""Plan files: JSON with a version; an error names the file and the field in one line."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.jsonable import finite, json_value
from adis_gonio.base.numbers import counted
from adis_gonio.base.output import ends_in, replacing
from adis_gonio.record.plans import MOST_POSITIONS, PLAN_NAMES, Plan, Position, plan, with_checks

SCHEMA = "adis-gonio/plan"
VERSION = 1
LARGEST_BYTES = 10_000_000
LARGEST_DEG = 3600.0
LONGEST_WAIT_S = 86_400.0
_KEYS = ("angle_deg", "approach", "use", "wait_s")
_FIELDS = ("schema", "version", "name", "plane", "positions", "made_for")
_NAME = re.compile(r"[\w.+-]{1,60}")


def document_of(made: Plan, made_for: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the JSON document that a plan file contains.

    Parameters
    ----------
    made_for : mapping, optional
        Facts about the search, for people; the program does not read them.
    """
    positions = [{key: asdict(position)[key] for key in _KEYS} for position in made.positions]
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "version": VERSION,
        "name": made.name,
        "plane": made.plane,
        "positions": positions,
    }
    return document if made_for is None else {**document, "made_for": finite(made_for)}


def write_plan(path: str | Path, made: Plan, made_for: Mapping[str, Any] | None = None) -> None:
    """Write a plan to a JSON file.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    text = json.dumps(document_of(made, made_for), ensure_ascii=False, indent=1, allow_nan=False) + "\n"
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def read_plan(path: str | Path) -> Plan:
    """Read a plan from a JSON file.

    Raises
    ------
    DataError
        The file cannot be read or is no plan; the message names the file and the field.
    """
    path = Path(path)
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise DataError(f"{path}: is no plan: it has more than {LARGEST_BYTES // 1_000_000} MB")
        text = path.read_text(encoding="utf-8-sig")
        document = json_value(text, object_pairs_hook=_unique_fields, parse_constant=float)
    except _DuplicateError as error:
        raise DataError(f"{path}: {error} is given twice: remove one of them") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    except json.JSONDecodeError as error:
        raise DataError(f"{path}: is no plan: no JSON at line {error.lineno}") from None
    except ValueError as error:
        raise DataError(f"{path}: is no plan: {error}") from None
    return plan_from(document, str(path))


class _DuplicateError(Exception):
    """A JSON object of the plan file contains a field twice."""


def _unique_fields(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for key, value in pairs:
        if key in fields:
            raise _DuplicateError(_quote(key))
        fields[key] = value
    return fields


def plan_from(document: Any, name: str = "plan") -> Plan:
    """Convert a JSON document to a plan; error messages begin with `name`.

    Raises
    ------
    DataError
        The document is no plan, has a newer version, or a field with an impossible value.
    """
    if not isinstance(document, Mapping) or document.get("schema") != SCHEMA:
        raise DataError(f"{name}: schema is not '{SCHEMA}'; make a plan with adis-gonio plan -o NAME.json")
    version = document.get("version")
    if isinstance(version, bool) or version != VERSION:
        newer = isinstance(version, int) and version > VERSION
        cure = "update adis-gonio" if newer else f"take {VERSION}"
        raise DataError(f"{name}: version is {_quote(version)}, this program reads {VERSION}: {cure}")
    unknown = sorted(set(document) - set(_FIELDS))
    if unknown:
        raise DataError(f"{name}: {_quote(unknown[0])} is not known; a plan has {', '.join(_FIELDS)}")
    called = document.get("name")
    if not isinstance(called, str) or not _NAME.fullmatch(called):
        raise DataError(f"{name}: name is {_quote(called)}: take a word of letters, digits and . + - _")
    if called in PLAN_NAMES:
        raise DataError(f"{name}: name is '{called}', which is a plan of the program: take another")
    if document.get("plane") != "xy":
        raise DataError(f"{name}: plane is {_quote(document.get('plane'))}: a plan file has plane 'xy'")
    entries = document.get("positions")
    if not isinstance(entries, list) or not 2 <= len(entries) <= MOST_POSITIONS:
        raise DataError(f"{name}: positions is no list of 2 to {MOST_POSITIONS} entries")
    positions = tuple(_position(entry, f"{name}: positions[{k}]") for k, entry in enumerate(entries))
    if all(position.use == "check" for position in positions):
        raise DataError(f"{name}: positions are all for checking: at least two have to be of use 'fit'")
    return Plan(called, positions)


def _position(entry: Any, where: str) -> Position:
    if not isinstance(entry, Mapping):
        raise DataError(f"{where} is {_quote(entry)}: take an object with {', '.join(_KEYS)}")
    unknown = sorted(set(entry) - set(_KEYS))
    if unknown:
        raise DataError(f"{where}.{unknown[0][:40]} is not known; a position has {', '.join(_KEYS)}")
    angle: Any = entry.get("angle_deg")
    wait: Any = entry.get("wait_s", 0.0)
    if not _number(angle, -LARGEST_DEG, LARGEST_DEG):
        raise DataError(
            f"{where}.angle_deg is {_quote(angle)}: take degrees from {-LARGEST_DEG:g} to {LARGEST_DEG:g}"
        )
    approach, use = entry.get("approach", 1), entry.get("use", "fit")
    if isinstance(approach, bool) or approach not in (1, -1):
        raise DataError(f"{where}.approach is {_quote(approach)}: take 1 (from below) or -1 (from above)")
    if use not in ("fit", "check"):
        raise DataError(f"{where}.use is {_quote(use)}: take 'fit' or 'check'")
    if not _number(wait, 0.0, LONGEST_WAIT_S):
        raise DataError(f"{where}.wait_s is {_quote(wait)}: take 0 to {LONGEST_WAIT_S:g} s")
    return Position(float(angle), -1 if approach == -1 else 1, use, wait_s=float(wait))


def _number(value: Any, low: float, high: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def _quote(value: Any) -> str:
    if value is None:
        return "missing"
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}…"


def find_plan(name: str, positions: int | None = None, check: int = 0) -> Plan:
    """Return a built-in plan by its name; if `name` looks like a path, read the plan from this file.

    Parameters
    ----------
    positions, check : int
        See `record.plans.plan`; a file has its own number of positions.

    Raises
    ------
    DataError
        The file is no plan.
    UsageError
        An unknown plan, or a number that the plan does not allow.
    """
    if name in PLAN_NAMES or not (ends_in(name, ".json") or "/" in name or Path(name).is_file()):
        return plan(name, positions, check)
    made = read_plan(name)
    if positions is not None:
        raise UsageError(f"{name}: fixes {counted(len(made), 'position')}: leave --positions out")
    return with_checks(made, check)
