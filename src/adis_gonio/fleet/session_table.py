"""The table of many sessions: its columns with their documentation, and the table as Parquet."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.errors import NotInstalledError, install_extra
from adis_gonio.fleet.session_record import QUANTITIES

Kind = Literal["text", "number", "integer", "flag", "names", "numbers"]
Row = Mapping[str, Any]
Table = dict[str, NDArray[Any]]
"""Columns (n,) by name.

A column has floats (NaN if unknown), str ("" if unknown), or lists of numbers; `table_of` describes
`effects`.
"""

_FACTS: dict[str, tuple[Kind, str, str]] = {
    "path": ("text", "", "file of the session, as it was given"),
    "sha256": ("text", "", "SHA-256 of the file"),
    "data_sha256": ("text", "", "SHA-256 of the data in it: the same for an archive and its CSV"),
    "serial": ("text", "", "serial number of the unit"),
    "operator": ("text", "", "who measured"),
    "stage": ("text", "", "stage on which it was measured"),
    "stage_curve": ("text", "", "digest of the stage's certificate, which corrected the angles"),
    "sensor": ("text", "", "variant"),
    "plan": ("text", "", "plan of positions"),
    "when": ("text", "", "begin, UTC, ISO 8601"),
    "simulated": ("flag", "", "of a simulated sensor"),
    "dwells": ("integer", "", "number of dwells"),
    "measuring_s": ("number", "s", "time in the dwells"),
    "temperature_c": ("number", "degC", "mean temperature"),
    "gravity_mps2": ("number", "m/s2", "local gravity"),
    "method": ("text", "", "recommended method, source of the values"),
    "model_effects": ("names", "", "effects of the model that gave the values"),
    "angle_max_deg": ("number", "deg", "largest error of the angle over the dwells, each left out"),
    "traced": ("flag", "", "a trace ran; otherwise effects are not known"),
    "adequate": ("flag", "", "the traced model leaves no more than the noise"),
    "effects": ("names", "", "effects that the trace found"),
    "doubts": ("text", "", "reasons why the result is doubtful"),
    "status": ("text", "", "ok or failed"),
    "reason": ("text", "", "reason of the failure"),
    "software": ("text", "", "program that computed it"),
}


def _of_quantities() -> dict[str, tuple[Kind, str, str]]:
    columns: dict[str, tuple[Kind, str, str]] = {}
    for name, unit in QUANTITIES.items():
        what = "error of the angle, rms over held-out dwells" if name == "angle" else name
        own = "a displayed angle" if name == "angle" else name
        columns |= {
            name: ("number", unit, what),
            f"{name}_u": ("number", unit, f"standard uncertainty of {own}"),
            f"{name}_u95": ("number", unit, f"expanded uncertainty U of {own}, 95 %"),
            f"{name}_k": ("number", "1", f"coverage factor of {own}"),
            f"{name}_dof": ("number", "1", f"degrees of freedom of {own}; null if unlimited"),
            f"{name}_stage": ("numbers", unit, f"change of {name} by each error of that certificate"),
        }
    return columns


COLUMNS: dict[str, tuple[Kind, str, str]] = {**_FACTS, **_of_quantities()}
"""Kind, unit and meaning of each column of the table, in order."""


_FACTS_USED = (
    *("path", "serial", "operator", "stage", "stage_curve", "status", "reason"),
    *("traced", "adequate", "effects", "doubts"),
)
_USED = (*_FACTS_USED, *(f"{name}{part}" for name in QUANTITIES for part in ("", "_u", "_stage")))


def table_of(rows: Sequence[Row]) -> Table:
    """Convert rows to one array for each column.

    Rows are sorted by path. In place of the column `effects` the result has `effect_row` (m,) and
    `effect_name` (m,): the number of the row and the name of each of m effects found.
    """
    columns = {name: [row.get(name) for row in rows] for name in _USED}
    order = np.argsort(np.array([path or "" for path in columns["path"]], dtype=object), kind="stable")
    table: Table = {}
    for name, values in columns.items():
        kind = COLUMNS[name][0]
        if kind == "names":
            counts = np.array([len(values[k] or ()) for k in order], dtype=int)
            table["effect_row"] = np.repeat(np.arange(len(order)), counts)
            table["effect_name"] = np.array([one for k in order for one in values[k] or ()], dtype=str)
        elif kind == "numbers":
            table[name] = np.fromiter(([] if v is None else v for v in values), object, len(values))[order]
        elif kind == "text":
            table[name] = np.array([value or "" for value in values], dtype=str)[order]
        else:
            table[name] = np.array([np.nan if value is None else value for value in values], dtype=float)[
                order
            ]
    return table


def require_pyarrow() -> Any:
    """Import pyarrow and return the module.

    Raises
    ------
    NotInstalledError
        pyarrow is not installed.
    """
    try:
        import pyarrow.parquet
    except ImportError:
        raise NotInstalledError(f"Parquet needs pyarrow: {install_extra('fleet')}") from None
    return pyarrow


def write_parquet(rows: Sequence[Row], path: str | Path, about: Mapping[str, Any]) -> None:
    """Write rows to a Parquet file.

    The metadata of the file are `unit` and `meaning` of each column, and `adis_gonio`, which is `about` as
    JSON.

    Raises
    ------
    NotInstalledError
        pyarrow is not installed.
    OSError
        The file cannot be written.
    """
    pa = require_pyarrow()
    kinds = {
        "text": pa.string(),
        "number": pa.float64(),
        "integer": pa.int64(),
        "flag": pa.bool_(),
        "names": pa.list_(pa.string()),
        "numbers": pa.list_(pa.float64()),
    }
    fields = [
        pa.field(name, kinds[kind], metadata={"unit": unit, "meaning": meaning})
        for name, (kind, unit, meaning) in COLUMNS.items()
    ]
    schema = pa.schema(
        fields, metadata={"adis_gonio": json.dumps(about, ensure_ascii=False, sort_keys=True)}
    )
    arrays = [pa.array([row[field.name] for row in rows], field.type) for field in schema]
    pa.parquet.write_table(pa.table(arrays, schema=schema), path, compression="zstd")
