"""A session as Parquet: every sample a row, units and what is known of the session as metadata."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.errors import DataError, NotInstalledError
from adis_gonio.model.effects import AXES
from adis_gonio.model.records import Dwell, Session
from adis_gonio.session.export import session_dict

ROWS = 100_000
"""Least rows of a group, so that many short dwells make no file of many small ones."""


def write_parquet(session: Session, path: str | Path) -> None:
    """Write all samples: the columns of the samples CSV, missing values as nulls.

    Metadata key `adis_gonio` holds the session without its samples as JSON; each column has its unit.

    Raises
    ------
    NotInstalledError
        pyarrow is not installed.
    DataError
        No dwell, or dwells that differ in their columns.
    OSError
        The file cannot be written.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise NotInstalledError("Parquet needs pyarrow: pip install 'adis-gonio[parquet]'") from None
    if not session.dwells:
        raise DataError(f"{session.source or 'session'}: the session has no dwell to write")
    about = session_dict(session)
    del about["dwells"]
    units = _units(session)
    schema = pa.schema(
        [
            pa.field(name, _type(pa, name), metadata={"unit": unit} if unit else None)
            for name, unit in units.items()
        ],
        metadata={"adis_gonio": json.dumps(about, ensure_ascii=False)},
    )
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for columns in _groups(session, list(units)):
            writer.write_table(pa.table(columns, schema=schema))


def _type(pa: Any, name: str) -> Any:
    kinds = {"position": pa.int64(), "approach": pa.int8(), "use": pa.string()}
    return kinds.get(name, pa.float64())


def _units(session: Session) -> dict[str, str]:
    """Columns that the first dwell has, with their units."""
    first = session.dwells[0]
    units = {"time_s": "s", "position": "", "angle_deg": "deg", "approach": "", "use": ""}
    units |= {f"a{axis}": session.accel_unit for axis in AXES[: first.accel.shape[1]]}
    if first.gyro is not None:
        units |= {f"g{axis}": session.gyro_unit for axis in AXES[: first.gyro.shape[1]]}
    if first.temperature_c is not None:
        units["temp_c"] = "degC"
    if first.supply_v is not None:
        units["supply_v"] = "V"
    return units


def _groups(session: Session, names: list[str]) -> Iterator[dict[str, Any]]:
    waiting: list[dict[str, Any]] = []
    rows = 0
    for dwell in session.dwells:
        columns = _columns(dwell)
        if set(columns) != set(names):
            odd = sorted(set(columns) ^ set(names))[0]
            raise DataError(
                f"{session.source or 'session'}: position {dwell.position}: some dwells lack '{odd}'"
            )
        waiting.append(columns)
        rows += len(dwell)
        if rows >= ROWS:
            yield _joined(waiting, names)
            waiting, rows = [], 0
    if waiting:
        yield _joined(waiting, names)


def _columns(dwell: Dwell) -> dict[str, Any]:
    n = len(dwell)
    columns: dict[str, Any] = {
        "time_s": dwell.time_s,
        "position": np.full(n, dwell.position),
        "angle_deg": [dwell.angle_deg] * n,
        "approach": [dwell.approach or None] * n,
        "use": [dwell.use] * n,
    }
    for letter, rows in (("a", dwell.accel), ("g", dwell.gyro)):
        if rows is not None:
            columns |= {f"{letter}{axis}": rows[:, k] for k, axis in enumerate(AXES[: rows.shape[1]])}
    if dwell.temperature_c is not None:
        columns["temp_c"] = dwell.temperature_c
    if dwell.supply_v is not None:
        columns["supply_v"] = dwell.supply_v
    return columns


def _joined(waiting: list[dict[str, Any]], names: list[str]) -> dict[str, Any]:
    lists = ("angle_deg", "approach", "use")
    return {
        name: [value for columns in waiting for value in columns[name]]
        if name in lists
        else np.concatenate([columns[name] for columns in waiting])
        for name in names
    }
