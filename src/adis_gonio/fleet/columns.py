"""The table of many sessions: the columns of `SessionRecord.row`, documented here and nowhere else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from adis_gonio.fleet.record import QUANTITIES

Kind = Literal["text", "number", "integer", "flag", "names"]
Row = Mapping[str, Any]
Table = dict[str, NDArray[Any]]
"""Columns (n,) by name: float with NaN where unknown, str with "" where unknown; of `effects` see
`table_of`."""

_FACTS: dict[str, tuple[Kind, str, str]] = {
    "path": ("text", "", "file of the session, as it was given"),
    "sha256": ("text", "", "SHA-256 of the file"),
    "data_sha256": ("text", "", "SHA-256 of the data in it: the same for an archive and its CSV"),
    "serial": ("text", "", "serial number of the unit"),
    "operator": ("text", "", "who measured"),
    "stage": ("text", "", "stage on which it was measured"),
    "sensor": ("text", "", "variant"),
    "plan": ("text", "", "plan of positions"),
    "when": ("text", "", "begin, UTC, ISO 8601"),
    "simulated": ("flag", "", "of a simulated sensor"),
    "dwells": ("integer", "", "number of dwells"),
    "measuring_s": ("number", "s", "time in the dwells"),
    "temperature_c": ("number", "degC", "mean temperature"),
    "gravity_mps2": ("number", "m/s2", "local gravity"),
    "method": ("text", "", "recommended method, whose values these are"),
    "model_effects": ("names", "", "effects of the model whose values these are"),
    "angle_max_deg": ("number", "deg", "largest error of the angle over the dwells, each left out"),
    "traced": ("flag", "", "a trace ran; else nothing is known of effects"),
    "adequate": ("flag", "", "the traced model leaves no more than the noise"),
    "effects": ("names", "", "effects that the trace found"),
    "doubts": ("text", "", "why the result cannot be right"),
    "status": ("text", "", "ok or failed"),
    "reason": ("text", "", "why it failed"),
    "software": ("text", "", "program that computed it"),
}


def _of_quantities() -> dict[str, tuple[Kind, str, str]]:
    columns: dict[str, tuple[Kind, str, str]] = {}
    for name, unit in QUANTITIES.items():
        what = "error of the angle, rms over dwells left out" if name == "angle" else name
        own = "an angle that is shown" if name == "angle" else name
        columns |= {
            name: ("number", unit, what),
            f"{name}_u": ("number", unit, f"standard uncertainty of {own}"),
            f"{name}_u95": ("number", unit, f"expanded uncertainty U of {own}, 95 %"),
            f"{name}_k": ("number", "1", f"coverage factor of {own}"),
            f"{name}_dof": ("number", "1", f"degrees of freedom of {own}; null where unlimited"),
        }
    return columns


COLUMNS: dict[str, tuple[Kind, str, str]] = {**_FACTS, **_of_quantities()}
"""Kind, unit and meaning of each column, in order."""


_FACTS_USED = (
    *("path", "serial", "operator", "stage", "status", "reason"),
    *("traced", "adequate", "effects", "doubts"),
)
_USED = (*_FACTS_USED, *(f"{name}{part}" for name in QUANTITIES for part in ("", "_u", "_dof")))


def table_of(rows: Sequence[Row] | Any) -> Table:
    """Columns of rows, or of a pyarrow table such as `read_parquet` gives.

    In place of `effects` stand `effect_row` (m,) and `effect_name` (m,): each effect found with the number
    of its row. Rows are put into the order of their paths.
    """
    columns = (
        {name: [row.get(name) for row in rows] for name in _USED}
        if isinstance(rows, Sequence)
        else {name: rows.column(name).to_pylist() for name in _USED if name in rows.column_names}
    )
    order = np.argsort(np.array([path or "" for path in columns["path"]], dtype=object), kind="stable")
    table: Table = {}
    for name, values in columns.items():
        kind = COLUMNS[name][0]
        if kind == "names":
            counts = np.array([len(values[k] or ()) for k in order], dtype=int)
            table["effect_row"] = np.repeat(np.arange(len(order)), counts)
            table["effect_name"] = np.array([one for k in order for one in values[k] or ()], dtype=str)
        elif kind == "text":
            table[name] = np.array([value or "" for value in values], dtype=str)[order]
        else:
            table[name] = np.array([np.nan if value is None else value for value in values], dtype=float)[
                order
            ]
    return table
