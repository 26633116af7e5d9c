"""A session as Parquet: every sample a row, units and what is known of the session as metadata."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.base.errors import DataError, NotInstalledError
from adis_gonio.model.effects import AXES
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record.samples_writer import session_dict

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
    dwells = session.sampled
    if not dwells:
        raise DataError(f"{session.source or 'session'}: the session has no dwell to write")
    about = session_dict(session)
    del about["dwells"]
    units = _units(session, dwells[0])
    if session.free_turn:  # as in the CSV: one continuous recording
        del units["position"]
    schema = pa.schema(
        [
            pa.field(name, _type(pa, name), metadata={"unit": unit} if unit else None)
            for name, unit in units.items()
        ],
        metadata={"adis_gonio": json.dumps(about, ensure_ascii=False)},
    )
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for columns in _groups(session, dwells, list(units)):
            arrays = [pa.array(columns[name], _type(pa, name), from_pandas=True) for name in units]
            writer.write_table(pa.table(arrays, schema=schema))


def _type(pa: Any, name: str) -> Any:
    kinds = {"position": pa.int64(), "approach": pa.int8(), "use": pa.string()}
    return kinds.get(name, pa.float64())


def _units(session: Session, first: Dwell) -> dict[str, str]:
    """Columns that the first dwell has, with their units."""
    by_kind = {"a": session.accel_unit, "g": session.gyro_unit}
    own = {"time_s": "s", "angle_deg": "deg", "temp_c": "degC", "supply_v": "V"}
    return {
        name: own.get(name, by_kind.get(name[0], "") if name[1:] in AXES else "")
        for name in first.columns()
    }


def _groups(session: Session, dwells: Sequence[Dwell], names: list[str]) -> Iterator[dict[str, Any]]:
    waiting: list[dict[str, Any]] = []
    rows = 0
    for dwell in dwells:
        columns = dwell.columns()
        if session.free_turn:
            del columns["position"]
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


def _joined(waiting: list[dict[str, Any]], names: list[str]) -> dict[str, Any]:
    return {name: np.concatenate([columns[name] for columns in waiting]) for name in names}
