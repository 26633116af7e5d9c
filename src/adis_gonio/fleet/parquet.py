"""The fleet's table as Parquet: one row a session; units and meanings stand with the columns."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from adis_gonio.base.errors import DataError, NotInstalledError
from adis_gonio.fleet.columns import COLUMNS, Row


def require_pyarrow() -> Any:
    """The package pyarrow.

    Raises
    ------
    NotInstalledError
        It is not installed.
    """
    try:
        import pyarrow.parquet
    except ImportError:
        raise NotInstalledError("Parquet needs pyarrow: pip install 'adis-gonio[fleet]'") from None
    return pyarrow


def write_parquet(rows: Sequence[Row], path: str | Path, about: Mapping[str, Any]) -> None:
    """Write rows; each column says `unit` and `meaning`, the file `adis_gonio` (`about` as JSON).

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


def read_parquet(path: str | Path) -> Any:
    """Table of a fleet as a pyarrow table, for `summarise`.

    Raises
    ------
    NotInstalledError
        pyarrow is not installed.
    DataError
        The file is not there, or is no table of a fleet.
    """
    pa = require_pyarrow()
    try:
        table = pa.parquet.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        raise DataError(f"{path}: cannot be read as Parquet: {' '.join(str(error).split())}") from error
    missing = [name for name in ("path", "status", "effects") if name not in table.column_names]
    if missing:
        raise DataError(f"{path}: is no table of a fleet: it has no column {', '.join(missing)}")
    return table
