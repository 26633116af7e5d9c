"""Sessions, samples, calibrations and plans, damaged or forged by a seed.

Each function of `KINDS` changes a sound file, writes the result and returns a description of the change.
Checksums of a forged session match its rows, so that only the checks of values can refuse it.
"""

from __future__ import annotations

import gzip
import json
import random
import re
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

from adis_gonio.record.archive_tables import TABLES
from record.forging import DEEP, HUGE, exchanged_in, forge, put

ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
BOMB_BYTES = 1_500_000_000
"""Most bytes in a compressed file."""
MEMBER_BYTES = 8_000_000


@dataclass(frozen=True)
class SoundFiles:
    """Files to begin from."""

    sessions: Sequence[Path]
    samples: Sequence[Path]
    calibrations: Sequence[Path]
    plans: Sequence[Path]


Maker = Callable[[SoundFiles, Path, random.Random], str]


def archive_values(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Exchange values of rows; the checksums fit."""
    source, between = rng.choice(sound.sessions), target.with_suffix(".between")
    shutil.copyfile(source, target)
    done = []
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        shutil.copyfile(target, between)
        with suppress(ValueError, RecursionError):  # an earlier change left no JSON to change again
            done.append(forge(between, target, rng))
    between.unlink()
    return f"{source.name}: {'; '.join(done)}"


def archive_texts(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Exchange a piece of a JSON text in a row; the checksum fits."""
    source = rng.choice(sound.sessions)
    shutil.copyfile(source, target)
    with closing(sqlite3.connect(source)) as connection:
        table, column = rng.choice((("meta", 1), ("records", 5), ("attempts", 11), ("moves", 5)))
        rows = connection.execute(f"SELECT rowid, * FROM {table}").fetchall()
    if not rows:
        return archive_texts(sound, target, rng)
    rowid, *values = rng.choice(rows)
    text, what = exchanged_text(values[column], rng)
    put(target, table, rowid, column, text)
    return f"{source.name}: {table} row {rowid}: {what}"


def archive_rows(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Take rows out, or put copies of rows in; the checksums fit."""
    source = rng.choice(sound.sessions)
    shutil.copyfile(source, target)
    table = rng.choice(list(TABLES))
    key = rng.randrange(2)
    with closing(sqlite3.connect(target, isolation_level=None)) as connection:
        connection.execute("PRAGMA synchronous = OFF")
        guards = [statement for (statement,) in connection.execute(_GUARDS, (table,))]
        for verb in ("update", "delete"):
            connection.execute(f"DROP TRIGGER IF EXISTS {table}_no_{verb}")
        rows = connection.execute(f"SELECT rowid, * FROM {table}").fetchall()
        if not rows or rng.random() < 0.4:
            gone = rng.sample(rows, rng.randrange(len(rows) + 1))
            connection.executemany(f"DELETE FROM {table} WHERE rowid = ?", [row[:1] for row in gone])
            what = f"{len(gone)} of {len(rows)} rows of {table} taken out"
        else:
            rowid, *values, _ = rng.choice(rows)
            copies = rng.choice((1, 3, 5000))
            values[key] = values[key] if isinstance(values[key], str) else 10**6
            marks = ", ".join("?" * (len(values) + 1))
            connection.execute("BEGIN")
            for k in range(copies):
                values[0] = f"{values[0]}{k}" if isinstance(values[0], str) else values[0] + 1
                with suppress(sqlite3.IntegrityError):
                    connection.execute(f"INSERT INTO {table} VALUES ({marks})", (*values, crc_of(values)))
            connection.execute("COMMIT")
            what = f"row {rowid} of {table} {copies} times more"
        for statement in guards:
            connection.execute(statement)
    return f"{source.name}: {what}"


_GUARDS = "SELECT sql FROM sqlite_master WHERE type = 'trigger' AND tbl_name = ?"


def crc_of(values: Sequence[object]) -> int:
    """Checksum of a row."""
    from adis_gonio.record.archive_tables import checksum

    return checksum(*values)


OBJECTS = (
    "DROP TABLE {table}; CREATE VIEW {table} AS {endless} SELECT i, 1, '', 0.0, 'x', '{{}}', 0 FROM n",
    "DROP TABLE {table}; CREATE VIEW {table} AS SELECT * FROM {table}",
    "DROP TABLE {table}; CREATE VIRTUAL TABLE {table} USING fts5(a, b, c, d, e, f, g)",
    "DROP TABLE {table}; CREATE VIRTUAL TABLE {table} USING rtree(a, b, c, d, e)",
    "DROP TABLE {table}; CREATE TABLE {table} (a, b, c, d, e, f, g)",
    "DROP TABLE {table}; CREATE TABLE {table} (a INTEGER PRIMARY KEY, b AS (hex(zeroblob(500000000)))) ",
    "DROP TABLE {table}",
    "ALTER TABLE {table} RENAME TO other",
    "ALTER TABLE {table} ADD COLUMN more",
    "ALTER TABLE {table} RENAME COLUMN crc32 TO crc",
    "CREATE VIEW more AS {endless} SELECT i FROM n",
    "CREATE TRIGGER more AFTER INSERT ON {table} BEGIN SELECT count(*) FROM {table}; END",
    "CREATE TRIGGER more BEFORE INSERT ON {table} BEGIN SELECT RAISE(IGNORE); END",
    "CREATE INDEX more ON {table}(hex(crc32))",
    "CREATE TABLE more (value CHECK (length(hex(zeroblob(500000000))) > 0))",
    "CREATE TABLE {table}_é (x)",
    'CREATE TABLE "more\n\x1b[31m" (x)',
    "PRAGMA application_id = 7",
    "PRAGMA user_version = 2000000000",
    "PRAGMA user_version = -1",
    "PRAGMA encoding = 'UTF-16'; VACUUM",
    "PRAGMA page_size = 65536; VACUUM",
    "PRAGMA auto_vacuum = 1; VACUUM",
    "PRAGMA journal_mode = WAL",
    "PRAGMA writable_schema = ON; UPDATE sqlite_master SET sql = 'CREATE TABLE x' WHERE name = '{table}'",
    "PRAGMA writable_schema = ON; UPDATE sqlite_master SET sql = NULL WHERE name = '{table}'",
    "PRAGMA writable_schema = ON; UPDATE sqlite_master SET rootpage = 1 WHERE name = '{table}'",
    "PRAGMA writable_schema = ON; UPDATE sqlite_master SET rootpage = 99999 WHERE name = '{table}'",
    "PRAGMA writable_schema = ON; UPDATE sqlite_master SET type = 'view' WHERE name = '{table}'",
    "PRAGMA writable_schema = ON; UPDATE sqlite_master SET name = x'ff' WHERE name = '{table}'",
    "PRAGMA writable_schema = ON; DELETE FROM sqlite_master",
)
"""Statements that put another thing in the place of a table, or add another thing."""


def archive_objects(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Put a view, a virtual table, a trigger or a damaged schema into a session file."""
    source = rng.choice(sound.sessions)
    shutil.copyfile(source, target)
    script = rng.choice(OBJECTS).format(table=rng.choice(list(TABLES)), endless=ENDLESS)
    with closing(sqlite3.connect(target, isolation_level=None)) as connection:
        connection.execute("PRAGMA synchronous = OFF")
        for statement in script.split(";") if "TRIGGER" not in script else (script,):
            with suppress(sqlite3.Error):  # some builds of SQLite do not make all of them
                connection.execute(statement)
    return f"{source.name}: {script}"


def archive_bytes(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Damage the bytes of a session file, or put a foreign journal next to it."""
    source = rng.choice(sound.sessions)
    way = rng.choice(("bits", "bits", "header", "cut", "page", "zeros", "journal"))
    data = damaged_bytes(source.read_bytes(), "bits" if way == "journal" else way, rng)
    target.write_bytes(source.read_bytes() if way == "journal" else data)
    if way == "journal":
        head = bytes.fromhex("d9d505f920a163d7") + rng.randbytes(20)
        target.with_name(f"{target.name}-journal").write_bytes(rng.choice((head + data, data)))
    return f"{source.name}: {way}"


def damaged_bytes(data: bytes, way: str, rng: random.Random) -> bytes:
    """Bytes with random damage."""
    at = rng.randrange(len(data))
    if way == "cut":
        return data[: rng.choice((at, at, 1, 15, 16, 72, 100, len(data) - 1))]
    if way == "page":
        page, other = (4096 * rng.randrange(len(data) // 4096 + 1) for _ in range(2))
        return data[:page] + data[other : other + 4096] + data[page + 4096 :]
    if way == "zeros":
        return data[:at] + bytes(rng.randrange(5000)) + data[at + 2000 :]
    changed = bytearray(data)
    for _ in range(rng.choice((1, 10, 200))):
        changed[rng.randrange(100 if way == "header" else len(data))] = rng.randrange(256)
    return bytes(changed)


STRANGE_CELLS = (
    "", " ", "nan", "NaN", "inf", "-inf", "1e400", "-1e308", "1e-400", str(HUGE), "1" * 5000, "-", "--1",
    "0x10",
    "1,5", "'1", '"1"', '"', "=1+1", "=HYPERLINK(A1)", "@x", "١", "１", "1_0", "1 000", "1e5e5", "true",
    "None",
    "\x00", "\x1b[31m", "é", "𝟙", "2026-11-24T10:00:00Z", "2026-11-24 10:00:00.5", "10:00:01", "1.5 mg",
    "0,1,2",
    "\r", "\n", "#", ";", "\t", "-5", "1e9", "9" * 18, "9" * 25, "1.7976931348623157e308", "fit", "check",
    "1e6", "-1e6", "-1e9", "1e15", "1e19", "-1e19", "1e-300", "1e-6", "0", "-0", "32767", "100000",
)  # fmt: skip
NAMES = (
    "time_s", "position", "angle_deg", "approach", "ax", "ay", "az", "gx", "gy", "gz", "temp_c", "supply_v",
    "use", "time", "timestamp", "t [ms]", "Time (UTC)", "Acc_X (g)", "ax_mg", "x", "y", "z", "", "\u202e",
    "accel x m/s^2", "a" * 3000, "time_s ", "AX", "gyro_x", "value", "unnamed: 0", "1", "nan", "date",
)  # fmt: skip
KEYS = (
    "sensor", "gravity_mps2", "fixture_sigma_deg", "plane", "accel_unit", "gyro_unit", "reading_u_mg",
    "bias_instability_mg", "title",
    "note", "serial", "x" * 500, "", "__class__", "filter_m", "sample_rate_hz", "recorded_utc",
)  # fmt: skip
VALUES = (
    *STRANGE_CELLS, "adis16350", "generic", "free", "none", "xy", "counts", "g", "mps2", "radps", "0",
    "1e-9", "-9.8",
    "{}", "x" * 5000,
)  # fmt: skip


def csv_cells(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Exchange cells of a samples file."""
    source, keys, rows = _table(sound, rng)
    done = []
    for _ in range(rng.choice((1, 1, 2, 20))):
        row, value = rng.choice(rows[1:]), rng.choice(STRANGE_CELLS)
        column = rng.randrange(len(row))
        done.append(f"{rows[0][column][:20]}={value[:20]!r}")
        row[column] = value
    return f"{source}: {' '.join(done[:3])}{_write_table(target, keys, rows, rng)}"


def csv_columns(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Drop, double, rename or reorder columns, or fill a column with one value or with sums."""
    source, keys, rows = _table(sound, rng)
    column = rng.randrange(len(rows[0]))
    way = rng.choice(("drop", "double", "rename", "rename", "shuffle", "fill", "fill", "walk", "no header"))
    value = rng.choice(STRANGE_CELLS)
    if way == "no header":
        del rows[0]
    elif way == "rename":
        rows[0][column] = rng.choice(NAMES)
    elif way == "shuffle":
        order = rng.sample(range(len(rows[0])), len(rows[0]))
        rows = [[row[k] for k in order] for row in rows]
    elif way in ("drop", "double"):
        rows = [
            row[:column] + row[column : column + 1] * (2 * (way == "double")) + row[column + 1 :]
            for row in rows
        ]
    else:
        for k, row in enumerate(rows[1:]):
            row[column] = value if way == "fill" else repr(k * rng.choice((0.0, 1e-3, 1.0, -1.0, 1e300)))
    return f"{source}: {way} {column} {value[:20]!r}{_write_table(target, keys, rows, rng)}"


def csv_keys(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Exchange or add lines of metadata before the header."""
    source, keys, rows = _table(sound, rng)
    done = []
    for _ in range(rng.choice((1, 1, 2, 5, 300))):
        line = f"# {rng.choice(KEYS)}: {rng.choice(VALUES)}"
        keys.insert(rng.randrange(len(keys) + 1), line)
        done.append(line[:60])
    return f"{source}: {done[:3]}{_write_table(target, keys, rows, rng)}"


def csv_rows(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Repeat, reorder, cut or drop rows, or put foreign lines between them."""
    source, keys, rows = _table(sound, rng)
    way = rng.choice(("repeat", "shuffle", "few", "short", "units", "statistics", "header again", "none"))
    body = rows[1:]
    if way == "repeat":
        body = [row for row in body for _ in range(rng.randrange(1, 4))]
    elif way == "shuffle":
        rng.shuffle(body)
    elif way in ("few", "none"):
        body = body[: rng.randrange(5) if way == "few" else 0]
    elif way == "short":
        k = rng.randrange(len(body))
        body[k] = body[k][: rng.randrange(len(body[k]))]
    else:
        line = {
            "units": ["s", "", "mg", "°"] * 3,
            "statistics": ["mean", *rows[1]],
            "header again": rows[0],
        }[way]
        body.insert(rng.choice((0, len(body) // 2, len(body))), list(line)[: len(rows[0])])
    return f"{source}: {way}{_write_table(target, keys, [rows[0], *body], rng)}"


def _table(sound: SoundFiles, rng: random.Random) -> tuple[str, list[str], list[list[str]]]:
    source = rng.choice(sound.samples)
    lines = source.read_text(encoding="utf-8").splitlines()
    keys = [line for line in lines if line.startswith("#")]
    return source.name, keys, [line.split(",") for line in lines[len(keys) :]]


def _write_table(target: Path, keys: list[str], rows: list[list[str]], rng: random.Random) -> str:
    """Write the file, sometimes compressed, in another encoding or with other line ends."""
    if rng.random() < 0.6:
        target.write_text("\n".join([*keys, *(",".join(row) for row in rows)]) + "\n", encoding="utf-8")
        return ""
    end, mark = rng.choice(("\n",) * 6 + ("\r\n", "\r", "\n\n")), rng.choice((",",) * 8 + (";", "\t", " "))
    encoding = rng.choice(
        ("utf-8",) * 8 + ("utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252", "utf-32")
    )
    text = end.join([*keys, *(mark.join(row) for row in rows)]) + rng.choice(
        (end,) * 12 + ("", "\x00", "\x1a")
    )
    data = text.encode(encoding, errors="replace")
    target.write_bytes(gzip.compress(data, 1) if rng.random() < 0.25 else data)
    return f" ({encoding}, {end!r}, {mark!r})"


FOREIGN = (
    b"", b"\n", b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"<!DOCTYPE html><html><body>404</body></html>",
    b"<?xml version='1.0'?><a/>", b"{}", b"[]", b"[" * 100_000, b'{"a":' * 5000, b"null",
    b"PK\x03\x04" + bytes(100),
    b"\x1f\x8b", b"\x1f\x8b\x08\x00", b"SQLite format 3\x00", b"SQLite format 3\x00" + bytes(200),
    b"time_s,ax,ay",
    b"time_s,ax,ay\n", b"time_s,ax,ay\n0,1,2", b"time_s,ax,ay\n0,1,2\n", b"#" * 70_000,
    b"# a: b\n" * 3000, b",,,\n,,,\n",
    b"time_s" + b",ax" * 20_000 + b"\n", b'"' * 1000, b"\r\r\r", b"\x89PNG\r\n\x1a\n", b"%PDF-1.4",
    b"time_s,ax,ay\n" * 500,
)  # fmt: skip


def csv_bytes(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Damaged bytes of a samples file, plain or compressed, or no samples file at all."""
    if rng.random() < 0.4:
        k = rng.randrange(len(FOREIGN))
        target.write_bytes(FOREIGN[k] if rng.random() < 0.8 else gzip.compress(FOREIGN[k]))
        return f"foreign {k}: {FOREIGN[k][:30]!r}"
    source, way = rng.choice(sound.samples), rng.choice(("bits", "cut", "zeros", "page"))
    data = source.read_bytes()
    packed = rng.random() < 0.4
    data = damaged_bytes(gzip.compress(data, 1) if packed else data, way, rng)
    target.write_bytes(data)
    return f"{source.name}: {way}{' of the compressed file' if packed else ''}"


BOMBS = (
    b"\n", b" ", b",", b"#", b"# x: y\n", b"\x00", b"1", b"a", b"\r", b'"', b"0,1,2\n", b",,\n",
    b"time_s,ax,ay\n", b"\xff",
    b"\xc3\xa9", b" \n", b";\n", b"a,b,c\n",
)  # fmt: skip
HEADS = (
    b"",
    b"time_s,ax,ay\n",
    b"time_s,ax,ay\n0,1000,0\n",
    b"# title: x\n",
    b"\xff\xfe",
    b'time_s,ax,ay\n0,1,"',
)


def csv_bomb(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """A few kilobytes to megabytes that unpack to hundreds of megabytes; written as a stream."""
    head, unit = rng.choice(HEADS), rng.choice(BOMBS)
    size = rng.choice((50_000_000, 300_000_000, BOMB_BYTES))
    member = gzip.compress(unit * (MEMBER_BYTES // len(unit)), 6)
    with target.open("wb") as file:
        file.write(gzip.compress(head))
        for _ in range(size // MEMBER_BYTES):
            file.write(member)
    return f"{head[:30]!r} and {size / 1e6:g} MB of {unit!r}"


def calibration_values(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Exchange values of a calibration file."""
    return _document_values(rng.choice(sound.calibrations), target, rng)


def calibration_texts(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Exchange a piece of the text of a calibration file."""
    return _document_texts(rng.choice(sound.calibrations), target, rng)


def plan_values(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Exchange values of a plan file."""
    return _document_values(rng.choice(sound.plans), target, rng)


def plan_texts(sound: SoundFiles, target: Path, rng: random.Random) -> str:
    """Exchange a piece of the text of a plan file."""
    return _document_texts(rng.choice(sound.plans), target, rng)


def _document_values(source: Path, target: Path, rng: random.Random) -> str:
    document = json.loads(source.read_text(encoding="utf-8"))
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        document = exchanged_in(document, rng)
    target.write_text(json.dumps(document), encoding="utf-8")
    return source.name


def _document_texts(source: Path, target: Path, rng: random.Random) -> str:
    if rng.random() < 0.15:
        k = rng.randrange(len(FOREIGN))
        target.write_bytes(FOREIGN[k])
        return f"foreign {k}: {FOREIGN[k][:30]!r}"
    text, what = exchanged_text(source.read_text(encoding="utf-8"), rng)
    encoding = rng.choice(("utf-8",) * 8 + ("utf-8-sig", "utf-16", "cp1252"))
    target.write_bytes(text.encode(encoding, errors="replace"))
    return f"{source.name}: {what} ({encoding})"


TOKENS = (
    "1e6", "-1e6", "1e9", "-1e9", "1e10", "1e15", "-1e15", "1e-300", "1e-6", "65535", "32767", "-32768",
    "3600", "6",
    "NaN", "Infinity", "-Infinity", "1e400", "1e308", "-1e308", "5e-324", "-0", "0", "-1", "1", str(HUGE),
    "1" * 5000,
    "9223372036854775807", "9223372036854775808", "-9223372036854775808", "0.1e1", "true", "null", '""',
    '"x"',
    '"\\u0000"', '"\\ud800"', '"\\u001b[31m"', '"a\\nb"', '"\\u202e"', "[]", "{}", "[[]]", "[null]",
    "[1, 2, 3]", '{"value": 1}',
    DEEP, '{"a":' * 200 + "1" + "}" * 200, "'1'", "0x1", "01", "1.", ".5", "١", "",
    '"' + "y" * 200_000 + '"', "[0" + ", 0" * 20_000 + "]",
)  # fmt: skip
_VALUE = re.compile(r'"(?:[^"\\]|\\.)*"|-?\d[\d.eE+-]*|true|false|null')


def exchanged_text(text: str, rng: random.Random) -> tuple[str, str]:
    """JSON text with one name, text or number exchanged for a token, and what was exchanged."""
    found = rng.choice(list(_VALUE.finditer(text)) or [None])
    token = rng.choice(TOKENS)
    if found is None:
        return token, f"all -> {token[:20]}"
    return text[: found.start()] + token + text[found.end() :], f"{found[0][:40]} -> {token[:20]}"


KINDS: dict[str, tuple[str, int, Maker]] = {
    "session values": ("session", 20, archive_values),
    "session texts": ("session", 8, archive_texts),
    "session rows": ("session", 6, archive_rows),
    "session objects": ("session", 6, archive_objects),
    "session bytes": ("session", 8, archive_bytes),
    "csv cells": ("samples", 10, csv_cells),
    "csv columns": ("samples", 8, csv_columns),
    "csv keys": ("samples", 6, csv_keys),
    "csv rows": ("samples", 6, csv_rows),
    "csv bytes": ("samples", 6, csv_bytes),
    "csv bomb": ("samples", 2, csv_bomb),
    "calibration values": ("calibration", 14, calibration_values),
    "calibration texts": ("calibration", 8, calibration_texts),
    "plan values": ("plan", 6, plan_values),
    "plan texts": ("plan", 4, plan_texts),
}
"""By name: family of files, weight, and the function that makes one."""
