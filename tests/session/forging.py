"""Session files and JSON documents with one value exchanged, as damage that no checksum shows.

`forge` writes a copy of a session file in which one value of one row is another and the row's checksum
fits again.
"""

from __future__ import annotations

import json
import random
import shutil
import sqlite3
from pathlib import Path
from typing import Any

from adis_gonio.session.database import TABLES
from adis_gonio.session.rows import checksum

HUGE = 10**400
DEEP = "[" * 50_000 + "]" * 50_000
STRANGE_CELLS = (
    None, -1, 0, 1, 7, 2**31, 2**63 - 1, -(2**63), 0.5, -1e30, 1e308, float("inf"), "", "x", "nan",
    "1" * 400, "é\n\x1b[31m", b"", b"\x00", b"\xff" * 16, DEEP, "{}", "[]", "null", "true", "NaN",
    "1e400", str(HUGE),
)  # fmt: skip
STRANGE_JSON = (
    None, True, -1, 0, 3, 1e308, -1e308, 1e-320, 2**63, HUGE, float("nan"), float("inf"), "", "x", [], {},
    [[]], [None], [1, 2, 3], {"x": 1}, "y" * 10_000, "\x1b[31m\n",
)  # fmt: skip


def forge(source: Path, target: Path, rng: random.Random) -> str:
    """Copy a session file with one value exchanged; says which."""
    shutil.copyfile(source, target)
    connection = sqlite3.connect(target, isolation_level=None)
    for table in TABLES:
        for verb in ("update", "delete"):
            connection.execute(f"DROP TRIGGER {table}_no_{verb}")
    while True:
        table = rng.choice(TABLES)
        names = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
        rows = connection.execute(f"SELECT rowid, * FROM {table}").fetchall()
        if not rows:
            continue
        rowid, *values, _ = rng.choice(rows)
        k = rng.randrange(len(values))
        old, values[k] = values[k], _exchanged(values[k], rng)
        try:
            connection.execute(f"UPDATE {table} SET {names[k]} = ? WHERE rowid = ?", (values[k], rowid))
        except (sqlite3.IntegrityError, OverflowError):
            continue  # the table itself does not take it
        # Columns have affinities: what is kept may be another number than what was given.
        key = "rowid" if names[k] not in ("run", "record", "attempt", "move") else names[k]
        at = values[k] if key == names[k] and table != "blocks" and k == 0 else rowid
        *kept, _ = connection.execute(f"SELECT * FROM {table} WHERE rowid = ?", (at,)).fetchone()
        connection.execute(f"UPDATE {table} SET crc32 = ? WHERE rowid = ?", (checksum(*kept), at))
        connection.close()
        return f"{table}.{names[k]} of row {rowid}: {str(old)[:60]!r} -> {str(values[k])[:60]!r}"


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
