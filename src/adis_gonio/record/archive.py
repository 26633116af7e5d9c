"""The archive: one SQLite file that holds all of a session; see `database` for its tables.

A dwell enters in one transaction, with its samples, its moves and what interrupted it: it is there whole or
not at all, and it is announced only once it is on the disk. A kill or a power cut at any moment therefore
loses at most the dwell in hand.
"""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from adis_gonio.base import __version__
from adis_gonio.base.errors import SessionError
from adis_gonio.record import database
from adis_gonio.record.blocks import to_bytes
from adis_gonio.record.reading import read_session
from adis_gonio.record.rows import Attempt, Header, Move, Record, StoredAttempt, checksum, to_json, utc_now
from adis_gonio.record.tables import statements
from adis_gonio.record.view import ArchiveView


class Archive(ArchiveView):
    """A session file that a session is being written to; one writer at a time.

    `create` begins a new file, `open_existing` goes on with one; then `begin_run`.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection
        self._header = None
        self._run = 0

    @classmethod
    def create(cls, path: str | Path, header: Header) -> Archive:
        """Begin a new session file.

        Raises
        ------
        UsageError
            The file exists already.
        SessionError
            It cannot be made here.
        """
        path = Path(path)
        archive = cls(path, database.create(path))
        values = dict(vars(header)) | {"plan": header.plan.as_dict(), "settings": dict(header.settings)}
        if header.fixture_sigma_deg is not None and math.isinf(header.fixture_sigma_deg):
            values["fixture_sigma_deg"] = "free"
        values["created_utc"] = header.created_utc or utc_now()
        try:
            with archive._transaction(new=True):
                for statement in statements():
                    archive._connection.execute(statement)
                for key, value in values.items():
                    archive._insert("meta", key, to_json(value))
        except BaseException:
            archive.close()
            raise
        return archive

    @classmethod
    def open_existing(cls, path: str | Path) -> Archive:
        """Open a session file to go on with it; errors as `ArchiveView`."""
        path = Path(path)
        return cls(path, database.connect(path, write=True))

    @property
    def run(self) -> int:
        """Number of this opening, from 1; 0 before `begin_run`."""
        return self._run

    def begin_run(self, bus_s: float, clock_offset_s: float, continues: int = 0) -> int:
        """Register this opening of the session; from now on only it may write.

        Parameters
        ----------
        bus_s : float
            Time on the bus's clock.
        clock_offset_s : float
            What makes times on that clock seconds since the session began.
        continues : int
            Number of the attempt after which it goes on; 0 for the beginning.
        """
        with self._transaction(new=True):
            run = self._next("runs", "run")
            software = f"adis-gonio {__version__}"
            self._insert("runs", run, utc_now(), float(bus_s), float(clock_offset_s), continues, software)
        self._run = run
        return run

    def add_record(self, kind: str, value: Any, bus_s: float) -> None:
        """Write something that happened."""
        with self._transaction():
            self._record(kind, value, bus_s)

    def add_attempt(self, attempt: Attempt) -> int:
        """Write an attempt with all its scans and moves; on return it is on the disk.

        Scans that were dropped within the dwell stand as a record, which older programs read over.

        Returns
        -------
        int
            Number of the attempt, from 1.
        """
        first = attempt.blocks[0][1] if attempt.blocks else None
        position = attempt.position
        with self._transaction():
            number = self._next("attempts", "attempt")
            self._insert(
                "attempts",
                number,
                self._run,
                attempt.place,
                None if position.angle_deg is None else float(position.angle_deg),
                position.approach,
                position.use,
                attempt.outcome,
                attempt.reason,
                attempt.started_utc,
                float(attempt.started_bus_s),
                float(attempt.ended_bus_s),
                to_json(first.registers if first else ()),
                first.variant if first else "",
                first.gyro_range_dps if first else None,
                attempt.status,
                len(attempt.blocks),
            )
            for sequence, (phase, block) in enumerate(attempt.blocks):
                words, time_s = to_bytes(block), block.time_s.astype("<f8").tobytes()
                self._insert("blocks", number, sequence, phase, len(block), block.lost, words, time_s)
            dropped = sum(block.dropped for phase, block in attempt.blocks if phase == "dwell")
            if dropped:
                self._record("dropped", {"attempt": number, "scans": dropped}, attempt.ended_bus_s)
            for count, move in enumerate(attempt.moves, start=self._next("moves", "move")):
                self._insert(
                    "moves",
                    count,
                    number,
                    float(move.bus_s),
                    None if move.angle_deg is None else float(move.angle_deg),
                    move.approach,
                    to_json(move.aim),
                )
        return number

    def _record(self, kind: str, value: Any, bus_s: float) -> None:
        number = self._next("records", "record")
        self._insert("records", number, self._run, utc_now(), float(bus_s), kind, to_json(value))

    def _next(self, table: str, key: str) -> int:
        (largest,) = self._connection.execute(f"SELECT coalesce(max({key}), 0) FROM {table}").fetchone()
        return int(largest) + 1

    def _insert(self, table: str, *values: Any) -> None:
        marks = ", ".join("?" * (len(values) + 1))
        self._connection.execute(f"INSERT INTO {table} VALUES ({marks})", (*values, checksum(*values)))

    @contextmanager
    def _transaction(self, *, new: bool = False) -> Iterator[None]:
        with database.explained(self.path):
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                if not new:
                    self._require_own_run()
                yield
                self._connection.execute("COMMIT")
            except BaseException:
                # After some errors (a full disk) SQLite has rolled back by itself.
                if self._connection.in_transaction:
                    self._connection.rollback()
                raise

    def _require_own_run(self) -> None:
        (latest,) = self._connection.execute("SELECT max(run) FROM runs").fetchone()
        if not self._run or latest != self._run:
            raise SessionError(f"{self.path}: another program has resumed this session; this one stops")


__all__ = [
    "Archive",
    "ArchiveView",
    "Attempt",
    "Header",
    "Move",
    "Record",
    "StoredAttempt",
    "read_session",
    "utc_now",
]
