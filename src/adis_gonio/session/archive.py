"""The archive: one SQLite file that holds all of a session; see `database` for its tables.

A dwell enters in one transaction, with its samples, its moves and what interrupted it: it is there whole or
not at all, and it is announced only once it is on the disk. A kill or a power cut at any moment therefore
loses at most the dwell in hand.
"""

from __future__ import annotations

import json
import math
import sqlite3
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np

from adis_gonio import __version__
from adis_gonio.errors import DataError, SessionError
from adis_gonio.model.records import Dwell, Session
from adis_gonio.sensor.decoding import ScanBlock, join
from adis_gonio.sensor.registers import ACCEL_OUT, GYRO_OUT, TEMP_OUT
from adis_gonio.session import database
from adis_gonio.session.plans import Plan, Position

Phase = Literal["before", "dwell", "after"]
Outcome = Literal["complete", "interrupted"]

JsonDict = dict[str, Any]


@dataclass(frozen=True)
class Move:
    """A move of the stage by the program, at `bus_s` on the clock of the bus."""

    bus_s: float
    angle_deg: float
    approach: int


@dataclass(frozen=True)
class Attempt:
    """One try at a dwell.

    Attributes
    ----------
    place : int
        Which position of the plan, from 0.
    outcome : {"complete", "interrupted"}
    reason : str
        What interrupted it; empty for a complete dwell.
    started_utc : str
        Wall clock, ISO 8601, UTC.
    started_bus_s, ended_bus_s : float
        Clock of the bus.
    blocks : sequence of (phase, ScanBlock)
        Every scan that was read, in order; those of phase `dwell` are the dwell's samples.
    moves : sequence of Move
        What moved the stage for it.
    status : int or None
        Word of STATUS after it.
    """

    place: int
    position: Position
    outcome: Outcome
    started_utc: str
    started_bus_s: float
    ended_bus_s: float
    blocks: Sequence[tuple[Phase, ScanBlock]]
    moves: Sequence[Move] = ()
    reason: str = ""
    status: int | None = None


@dataclass(frozen=True)
class StoredAttempt:
    """Row of `attempts`: an attempt without its samples.

    Attributes
    ----------
    number : int
        Number of the attempt, from 1, in the order in which they were made.
    run : int
        Which opening of the session it belongs to.
    offset_s : float
        Added to times on the bus's clock it gives seconds since the session began.
    """

    number: int
    run: int
    offset_s: float
    place: int
    position: Position
    outcome: Outcome
    reason: str
    started_utc: str
    started_bus_s: float
    ended_bus_s: float
    registers: tuple[str, ...]
    variant: str
    gyro_range_dps: int | None
    status: int | None


@dataclass(frozen=True)
class Record:
    """Row of `records`."""

    run: int
    utc: str
    bus_s: float
    kind: str
    value: Any


@dataclass(frozen=True)
class Header:
    """What stands from the beginning of a session.

    Attributes
    ----------
    url, variant : str
        Bus and part.
    plan : Plan
        The plan to begin with; an extension is a record.
    settings : mapping
        JSON form of the runner's settings.
    simulated : bool
        True where the bus has a world whose truth is known.
    """

    url: str
    variant: str
    plan: Plan
    settings: Mapping[str, Any]
    gravity_mps2: float
    fixture_sigma_deg: float | None
    title: str = ""
    note: str = ""
    simulated: bool = False
    created_utc: str = ""
    software: str = field(default=f"adis-gonio {__version__}")


def utc_now() -> str:
    """Wall clock, ISO 8601, UTC, to the millisecond."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class ArchiveView:
    """Read access to a session file; `Archive` adds writing. Use it as a context manager.

    Raises
    ------
    DataError
        The file is missing, of another kind, damaged, truncated or newer than this program.
    SessionError
        It cannot be read here, or holds no session yet.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._connection = database.connect(self.path, write=False)

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """Let all reads inside see the same state, whatever another program writes meanwhile."""
        with database.explained(self.path):
            self._connection.execute("BEGIN")
        try:
            yield
        finally:
            self._connection.rollback()

    def header(self) -> Header:
        """What stands from the beginning."""
        rows = self._rows("SELECT key, value FROM meta")
        try:
            values = {key: json.loads(value) for key, value in rows}
            values["plan"] = Plan.from_dict(values["plan"])
            if values["fixture_sigma_deg"] == "free":
                values["fixture_sigma_deg"] = math.inf
            return Header(**values)
        except (KeyError, TypeError, ValueError) as error:
            raise self._damaged("meta", error) from None

    def records(self, kind: str | None = None) -> list[Record]:
        """Records of one kind, or all, in order."""
        rows = self._rows(
            "SELECT run, utc, bus_s, kind, value FROM records"
            " WHERE ?1 IS NULL OR kind = ?1 ORDER BY record",
            kind,
        )
        try:
            return [
                Record(run, utc, bus_s, name, json.loads(value)) for run, utc, bus_s, name, value in rows
            ]
        except ValueError as error:
            raise self._damaged("records", error) from None

    def last(self, kind: str) -> Any:
        """Value of the last record of a kind; None where there is none."""
        records = self.records(kind)
        return records[-1].value if records else None

    def runs(self) -> list[JsonDict]:
        """Openings of the session, in order."""
        names = ("run", "started_utc", "bus_s", "clock_offset_s", "continues", "software")
        rows = self._rows(f"SELECT {', '.join(names)} FROM runs ORDER BY run")
        return [dict(zip(names, row, strict=True)) for row in rows]

    def plan(self) -> Plan:
        """Plan in force: the first one, or its last extension."""
        extended = self.last("plan")
        return self.header().plan if extended is None else Plan.from_dict(extended)

    def attempts(self) -> list[StoredAttempt]:
        """All attempts, in order."""
        rows = self._rows(
            "SELECT attempt, attempts.run, clock_offset_s, place, angle_deg, approach, use, outcome,"
            " reason, attempts.started_utc, started_bus_s, ended_bus_s, registers, variant, gyro_range_dps,"
            " status"
            " FROM attempts JOIN runs USING (run) ORDER BY attempt"
        )
        try:
            return [_stored(row) for row in rows]
        except ValueError as error:
            raise self._damaged("attempts", error) from None

    def dwells(self) -> list[StoredAttempt]:
        """Complete dwells in the order in which they were recorded; of a repeated one the last."""
        latest = {a.place: a.number for a in self.attempts() if a.outcome == "complete"}
        return [a for a in self.attempts() if latest.get(a.place) == a.number and a.outcome == "complete"]

    def skipped(self) -> set[int]:
        """Places that the operator skipped and that have no dwell."""
        return {record.value for record in self.records("skipped")} - {a.place for a in self.dwells()}

    def pending(self) -> list[int]:
        """Places of the plan that have neither a dwell nor were skipped, in order."""
        settled = {a.place for a in self.dwells()} | self.skipped()
        return [place for place in range(len(self.plan())) if place not in settled]

    def blocks(self, attempt: StoredAttempt, phase: Phase | None = None) -> list[ScanBlock]:
        """Scans of an attempt, of one phase or all, block by block, as they were read.

        Raises
        ------
        DataError
            A block's checksum does not fit its content; the message names dwell and block.
        """
        rows = self._rows(
            "SELECT sequence, scans, lost, words, time_s, crc32 FROM blocks"
            " WHERE attempt = ?1 AND (?2 IS NULL OR phase = ?2) ORDER BY sequence",
            attempt.number,
            phase,
        )
        result = []
        for sequence, scans, lost, words, time_s, crc in rows:
            if zlib.crc32(time_s, zlib.crc32(words)) != crc:
                raise DataError(
                    f"{self.path}: block {sequence} of attempt {attempt.number} is damaged (checksum);"
                    " restore the file from a copy (it was left as it is)"
                )
            result.append(
                ScanBlock(
                    attempt.registers,
                    np.frombuffer(words, "<u2").astype(np.uint16).reshape(scans, len(attempt.registers)),
                    np.frombuffer(time_s, "<f8").astype(np.float64),
                    lost,
                    attempt.variant,
                    attempt.gyro_range_dps,
                )
            )
        return result

    def moves_before(self, attempt: int) -> list[Move]:
        """Moves of the stage that led up to an attempt's end, in order.

        Where a run went back to an earlier attempt, what came after that one in the run before is not
        part of the line that leads here.
        """
        runs = {run["run"]: run["continues"] for run in self.runs()}
        of_run = {a.number: a.run for a in self.attempts()}
        line: list[Move] = []
        while attempt:
            run = of_run[attempt]
            rows = self._rows(
                "SELECT moves.bus_s, moves.angle_deg, moves.approach FROM moves"
                " JOIN attempts USING (attempt)"
                " WHERE run = ? AND attempt <= ? ORDER BY move",
                run,
                attempt,
            )
            line = [Move(*row) for row in rows] + line
            attempt = runs[run]
        return line

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _damaged(self, table: str, error: Exception) -> DataError:
        return DataError(
            f"{self.path}: is damaged (table {table}: {error});"
            " restore it from a copy (it was left as it is)"
        )

    def _rows(self, sql: str, *values: Any) -> list[tuple[Any, ...]]:
        with database.explained(self.path):
            return self._connection.execute(sql, values).fetchall()


class Archive(ArchiveView):
    """A session file that a session is being written to; one writer at a time.

    `create` begins a new file, `open_existing` goes on with one; then `begin_run`.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection
        self._run = 0

    @classmethod
    def create(cls, path: str | Path, header: Header) -> Archive:
        """Begin a new session file.

        Raises
        ------
        SessionError
            The file exists already, or cannot be made here.
        """
        path = Path(path)
        archive = cls(path, database.create(path))
        values = dict(vars(header)) | {"plan": header.plan.as_dict(), "settings": dict(header.settings)}
        if header.fixture_sigma_deg is not None and math.isinf(header.fixture_sigma_deg):
            values["fixture_sigma_deg"] = "free"
        values["created_utc"] = header.created_utc or utc_now()
        try:
            with archive._transaction(new=True):
                for statement in database.statements():
                    archive._connection.execute(statement)
                archive._connection.executemany(
                    "INSERT INTO meta VALUES (?, ?)", [(key, _json(value)) for key, value in values.items()]
                )
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
            cursor = self._connection.execute(
                "INSERT INTO runs (started_utc, bus_s, clock_offset_s, continues, software)"
                " VALUES (?, ?, ?, ?, ?)",
                (utc_now(), bus_s, clock_offset_s, continues, f"adis-gonio {__version__}"),
            )
            run = int(cursor.lastrowid or 0)
        self._run = run
        return run

    def add_record(self, kind: str, value: Any, bus_s: float) -> None:
        """Write something that happened."""
        with self._transaction():
            self._connection.execute(
                "INSERT INTO records (run, utc, bus_s, kind, value) VALUES (?, ?, ?, ?, ?)",
                (self._run, utc_now(), bus_s, kind, _json(value)),
            )

    def add_attempt(self, attempt: Attempt) -> int:
        """Write an attempt with all its scans and moves; on return it is on the disk.

        Returns
        -------
        int
            Number of the attempt, from 1.
        """
        first = attempt.blocks[0][1] if attempt.blocks else None
        with self._transaction():
            cursor = self._connection.execute(
                "INSERT INTO attempts (run, place, angle_deg, approach, use, outcome, reason, started_utc,"
                " started_bus_s, ended_bus_s, registers, variant, gyro_range_dps, status)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (
                    self._run,
                    attempt.place,
                    attempt.position.angle_deg,
                    attempt.position.approach,
                    attempt.position.use,
                    attempt.outcome,
                    attempt.reason,
                    attempt.started_utc,
                    attempt.started_bus_s,
                    attempt.ended_bus_s,
                    _json(first.registers if first else ()),
                    first.variant if first else "",
                    first.gyro_range_dps if first else None,
                    attempt.status,
                ),
            )
            number = int(cursor.lastrowid or 0)
            self._connection.executemany(
                "INSERT INTO blocks VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                [_block_row(number, k, phase, block) for k, (phase, block) in enumerate(attempt.blocks)],
            )
            self._connection.executemany(
                "INSERT INTO moves (attempt, bus_s, angle_deg, approach) VALUES (?, ?, ?, ?)",
                [(number, move.bus_s, move.angle_deg, move.approach) for move in attempt.moves],
            )
        return number

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


def _stored(row: tuple[Any, ...]) -> StoredAttempt:
    number, run, offset_s, place, angle_deg, approach, use, *rest, registers, part, gyro_range, status = row
    outcome, reason, started_utc, started_bus_s, ended_bus_s = rest
    return StoredAttempt(
        number,
        run,
        offset_s,
        place,
        Position(angle_deg, approach, use),
        outcome,
        reason,
        started_utc,
        started_bus_s,
        ended_bus_s,
        tuple(json.loads(registers)),
        part,
        gyro_range,
        status,
    )


def _block_row(attempt: int, sequence: int, phase: Phase, block: ScanBlock) -> tuple[Any, ...]:
    words = block.words.astype("<u2").tobytes()
    time_s = block.time_s.astype("<f8").tobytes()
    crc = zlib.crc32(time_s, zlib.crc32(words))
    return attempt, sequence, phase, len(block), block.lost, words, time_s, crc


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, default=_plain)


def _plain(value: Any) -> Any:
    """JSON form of numpy's scalars and arrays, which a truth may contain."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} has no JSON form")


def read_session(path: str | Path) -> Session:
    """Read a session file: its complete dwells, in the order in which they were recorded.

    A session may be read while another program records it. Samples are in LSB and °/s, times in seconds
    since the session began. `facts` holds `configuration`, `registers` (before, configured, after),
    `plan`, `settings`, `url`, `note`, `runs`, `dwells` (times, lost scans, STATUS of each), `problems`,
    `complete`, and for simulated sessions alone `truth`, which no fit may use.

    Raises
    ------
    DataError
        The file is missing, of another kind, damaged, truncated or newer than this program, or has no
        complete dwell.
    SessionError
        It cannot be read here, or holds no session yet.
    """
    with ArchiveView(path) as view, view.snapshot():
        header, plan, stored = view.header(), view.plan(), view.dwells()
        pending, skipped = view.pending(), view.skipped()
        if not stored:
            raise DataError(f"{path}: no dwell is complete yet; resume the session")
        joined = [join(view.blocks(attempt, "dwell")) for attempt in stored]
        facts: JsonDict = {
            "url": header.url,
            "note": header.note,
            "simulated": header.simulated,
            "software": header.software,
            "started_utc": header.created_utc,
            "settings": dict(header.settings),
            "plan": plan.as_dict(),
            "configuration": view.last("configuration"),
            "registers": {
                when: view.last(f"registers-{when}") for when in ("before", "configured", "after")
            },
            "runs": view.runs(),
            "problems": [record.value for record in view.records("problem")],
            "complete": not pending,
            "skipped": sorted(skipped),
            "dwells": [_facts_of(a, scans) for a, scans in zip(stored, joined, strict=True)],
        }
        truth = view.last("truth")
    if header.simulated and truth is not None:
        facts["truth"] = truth
    dwells = tuple(_dwell(k, *pair) for k, pair in enumerate(zip(stored, joined, strict=True)))
    return Session(
        dwells,
        sensor=header.variant,
        gravity_mps2=header.gravity_mps2,
        fixture_sigma_deg=header.fixture_sigma_deg,
        plane=plan.plane,
        title=header.title,
        source=str(path),
        notes=_notes(plan, pending, skipped, facts["dwells"]),
        facts=facts,
    )


def _dwell(number: int, attempt: StoredAttempt, scans: ScanBlock) -> Dwell:
    def has(names: Sequence[str]) -> bool:
        return all(name in scans.registers for name in names)

    return Dwell(
        number,
        scans.time_s + attempt.offset_s,
        scans.select(ACCEL_OUT).numbers().astype(np.float64),
        angle_deg=attempt.position.angle_deg,
        approach=attempt.position.approach,
        use=attempt.position.use,
        gyro=scans.gyro_dps if has(GYRO_OUT) and scans.gyro_range_dps else None,
        temperature_c=scans.temperature_c if any(name in scans.registers for name in TEMP_OUT) else None,
        supply_v=scans.supply_v if has(("SUPPLY_OUT",)) else None,
    )


def _facts_of(attempt: StoredAttempt, scans: ScanBlock) -> JsonDict:
    return {
        "place": attempt.place,
        "attempt": attempt.number,
        "run": attempt.run,
        "started_utc": attempt.started_utc,
        "samples": len(scans),
        "lost": scans.lost,
        "status": attempt.status,
    }


def _notes(
    plan: Plan, pending: Sequence[int], skipped: set[int], dwells: Sequence[JsonDict]
) -> tuple[str, ...]:
    notes = []
    if pending:
        notes.append(
            f"unfinished session: {len(dwells)} of {len(plan)} positions of plan '{plan.name}' are done"
        )
    if skipped:
        notes.append(f"skipped: {', '.join(str(plan.positions[place]) for place in sorted(skipped))}")
    lost = sum(dwell["lost"] for dwell in dwells)
    if lost:
        notes.append(f"{lost} scans were lost on the bus within the dwells")
    return tuple(notes)


__all__ = [
    "Archive",
    "ArchiveView",
    "Attempt",
    "Header",
    "Move",
    "Record",
    "StoredAttempt",
    "read_session",
]
