"""Session files and JSON documents with one value exchanged, as damage that no checksum shows.

`forge` writes a copy of a session file in which one value of one row is another and the row's checksum
fits again.
"""

from __future__ import annotations

import json
import random
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

from adis_gonio.record.archive_tables import TABLES, checksum

HUGE = 10**400
DEEP = "[" * 50_000 + "]" * 50_000
STRANGE_CELLS = (
    None, -1, 0, 1, 7, 2**31, 2**63 - 1, -(2**63), 0.5, -1e30, 1e308, float("inf"), "", "x", "nan",
    "1" * 400, "é\n\x1b[31m", b"", b"\x00", b"\xff" * 16, DEEP, "{}", "[]", "null", "true", "NaN",
    "1e400", str(HUGE), 1e6, -1e6, 1e9, 1e10, 1e-300, 65535, 300, 819.2,
)  # fmt: skip
STRANGE_JSON = (
    None, True, -1, 0, 3, 1e308, -1e308, 1e-320, 2**63, HUGE, float("nan"), float("inf"), "", "x", [], {},
    1e6, -1e6, 1e9, -1e9, 1e10, 1e15, 1e-300, 1e-6, 65535, 300, [[]], [None], [1, 2, 3], {"x": 1},
    "y" * 10_000, "\x1b[31m\n",
)  # fmt: skip


def forge(source: Path, target: Path, rng: random.Random) -> str:
    """Copy a session file with one value exchanged; says which."""
    with closing(sqlite3.connect(source)) as connection:
        held = {table: connection.execute(f"SELECT rowid, * FROM {table}").fetchall() for table in TABLES}
    while True:
        table = rng.choice([table for table in TABLES if held[table]])
        rowid, *values, _ = rng.choice(held[table])
        k = rng.randrange(len(values))
        value = _exchanged(values[k], rng)
        shutil.copyfile(source, target)
        try:
            put(target, table, rowid, k, value)
        except (sqlite3.IntegrityError, OverflowError):
            continue  # the table itself does not take it
        return f"{table} row {rowid} column {k}: {str(values[k])[:60]!r} -> {str(value)[:60]!r}"


def put(path: Path, table: str, rowid: int, column: int, value: Any) -> None:
    """Exchange one value of a session file, and let the row's checksum fit."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA synchronous = OFF")
        for verb in ("update", "delete"):
            connection.execute(f"DROP TRIGGER IF EXISTS {table}_no_{verb}")
        *row, _ = connection.execute(f"SELECT * FROM {table} WHERE rowid = ?", (rowid,)).fetchone()
        row[column] = value
        connection.execute(f"DELETE FROM {table} WHERE rowid = ?", (rowid,))
        marks = ", ".join("?" * (len(row) + 1))
        at = connection.execute(f"INSERT INTO {table} VALUES ({marks})", (*row, 0)).lastrowid
        # A column has an affinity: it may hold another number than was given.
        *kept, _ = connection.execute(f"SELECT * FROM {table} WHERE rowid = ?", (at,)).fetchone()
        connection.execute(f"UPDATE {table} SET crc32 = ? WHERE rowid = ?", (checksum(*kept), at))


def _exchanged(value: Any, rng: random.Random) -> Any:
    if isinstance(value, bytes) and rng.random() < 0.6:
        cut = rng.randrange(len(value) + 1)
        return rng.choice(
            [value[:cut], value + value[:cut], rng.randbytes(len(value)), b"\xff" * len(value)]
        )
    if isinstance(value, str) and value[:1] in ("{", "[") and rng.random() < 0.8:
        return json.dumps(exchanged_in(json.loads(value), rng))
    return rng.choice(STRANGE_CELLS)


def exchanged_in(document: Any, rng: random.Random) -> Any:
    """A JSON document with one value, anywhere in it, exchanged, taken out or doubled."""
    if isinstance(document, dict) and document and rng.random() < 0.9:
        key = rng.choice(list(document))
        if rng.random() < 0.15:
            return {name: value for name, value in document.items() if name != key}
        return document | {key: exchanged_in(document[key], rng)}
    if isinstance(document, list) and document and rng.random() < 0.9:
        k = rng.randrange(len(document))
        if rng.random() < 0.15:
            return document[:k] + document[k + 1 :] + rng.choice([[], [document[k]] * 2])
        return [*document[:k], exchanged_in(document[k], rng), *document[k + 1 :]]
    return rng.choice(STRANGE_JSON)
