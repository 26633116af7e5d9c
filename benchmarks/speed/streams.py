"""Decoding a stream against loops of `struct`, and writing an archive against plain sqlite3."""

from __future__ import annotations

import sqlite3
import struct
import tempfile
import time
from pathlib import Path

import numpy as np

from adis_gonio.device.sensor.settings import ScanBlock
from adis_gonio.record.archive import Archive
from adis_gonio.record.archive_tables import Attempt, Header
from adis_gonio.record.plans import plan as plan_named
from speed.timing import Row, compare, require

NAMES = ("XGYRO_OUT", "YGYRO_OUT", "ZGYRO_OUT", "XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "SUPPLY_OUT")
LSB = (0.07326,) * 3 + (0.4672,) * 3 + (0.0018315,)
"""°/s, mg and V of one step (DS)."""
DWELLS = 24
SAMPLES = 819 * 5


def scans(rng: np.random.Generator, n: int) -> ScanBlock:
    """Words as a chip sends them: 14 bits of data (12 of the supply), ND and EA at random."""
    words = rng.integers(0, 1 << 16, (n, len(NAMES)), dtype=np.uint16)
    return ScanBlock(NAMES, words, np.arange(n) / 819.2)


def by_struct(content: bytes) -> list[tuple[float, ...]]:
    """Values by a loop, as a script does it that follows the data sheet."""
    rows = []
    for scan in struct.iter_unpack("<7H", content):
        values = []
        for k, word in enumerate(scan):
            if k < 6:
                number = word & 0x3FFF
                number -= (number & 0x2000) << 1
            else:
                number = word & 0x0FFF
            values.append(LSB[k] * number)
        rows.append(tuple(values))
    return rows


def decoding(rng: np.random.Generator, *, fast: bool) -> list[Row]:
    """Rows of the stream decoder."""
    block = scans(rng, 2000 if fast else 20_000)
    content = block.words.astype("<u2").tobytes()

    def ours() -> np.ndarray:
        words = np.frombuffer(content, "<u2").reshape(len(block), -1)
        return ScanBlock(NAMES, words, block.time_s).values()

    def agree(name: str, own: np.ndarray, theirs: list[tuple[float, ...]]) -> str:
        off = float(np.max(np.abs(own / np.array(LSB) - np.array(theirs) / np.array(LSB))))
        return require(off < 1e-6, f"every number to {off:.1g} LSB (allowed 1e-06)")

    runs = 3 if fast else 15
    benchmark = "stream decode, 7 registers"
    return compare(benchmark, ours, {"loop of struct": lambda: by_struct(content)}, agree, runs)


def archiving(rng: np.random.Generator, *, fast: bool) -> list[Row]:
    """Rows of archive writing; each dwell is a transaction that is on the disk when it returns."""
    dwells = 4 if fast else DWELLS
    blocks = [scans(rng, SAMPLES) for _ in range(dwells)]
    plan = plan_named("tumble")
    with tempfile.TemporaryDirectory() as folder:
        numbers = iter(range(10**6))

        def path() -> Path:
            return Path(folder) / f"{next(numbers)}.session"

        def ours() -> Path:
            made = path()
            header = Header("sim:", "adis16354", plan, {}, 9.80665, 0.05)
            with Archive.create(made, header) as archive:
                archive.begin_run(0.0, 0.0)
                for k, block in enumerate(blocks):
                    place, now = plan.positions[k % len(plan.positions)], "2026-01-01T00:00:00.000+00:00"
                    archive.add_attempt(Attempt(k, place, "complete", now, 0.0, 5.0, [("dwell", block)]))
            return made

        def plain(synchronous: str) -> Path:
            made = path()
            connection = sqlite3.connect(made, isolation_level=None)
            connection.execute(f"PRAGMA synchronous={synchronous}")
            connection.execute("CREATE TABLE blocks (attempt INTEGER, words BLOB, time_s BLOB)")
            for k, block in enumerate(blocks):
                rows = [(k + 1, block.words.astype("<u2").tobytes(), block.time_s.astype("<f8").tobytes())]
                connection.execute("BEGIN")
                connection.executemany("INSERT INTO blocks VALUES (?, ?, ?)", rows)
                connection.execute("COMMIT")
            connection.close()
            return made

        def agree(name: str, own: Path, theirs: Path) -> str:
            mine, other = _content(own), _content(theirs)
            return require(mine == other and len(mine) == dwells, f"the same bytes of {dwells} dwells")

        sides = {
            "sqlite3 executemany, as durable": lambda: plain("EXTRA"),
            "sqlite3 executemany, its defaults": lambda: plain("FULL"),
        }
        runs = 3 if fast else 15
        return compare(
            "archive writing, a dwell a transaction", ours, sides, agree, runs, clock=time.perf_counter
        )


def _content(path: Path) -> list[tuple[int, bytes, bytes]]:
    connection = sqlite3.connect(path)
    try:
        return connection.execute("SELECT attempt, words, time_s FROM blocks ORDER BY attempt").fetchall()
    finally:
        connection.close()
