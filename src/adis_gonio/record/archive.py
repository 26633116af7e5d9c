"""The archive: one SQLite file with all data of a session.

| table | a row is |
|---|---|
| `meta` | a fact that is fixed at the beginning: URL, variant, settings, versions (JSON) |
| `runs` | one opening of the session by a program: the first, and one for each time it is resumed |
| `records` | an event: registers read, a configuration, a plan, a problem, the end (JSON) |
| `attempts` | one attempt at a dwell, complete or interrupted, with its times and the reason |
| `blocks` | scans of an attempt: words (uint16) or, of a generic sensor, values (float64); their times |
| `moves` | a move of the stage by the program, at its time on the bus's clock |

Every table refuses UPDATE and DELETE, so that no data is ever changed. Every row ends with a checksum of
its other columns. A file with other tables, or with additional views, triggers or indexes, is refused
before any of its SQL is run; statements have a limit of steps and rows a limit of length. `archive_tables`
declares the type and range of every value. Numbers in blobs are little-endian. Times called `bus_s` are on
the clock of the bus of that run, in s; adding the run's `clock_offset_s` makes them seconds since the
session began. `continues` is the attempt after which a resumed run goes on, 0 for the beginning: a
simulated world is brought back to that point.

Durability: a rollback journal (`journal_mode=DELETE`), so that between commits there is only one file, and
`synchronous=EXTRA`, which syncs the file and, after the journal is deleted, the directory: a commit that
was announced survives a power cut. If a killed program leaves a journal, the next program that opens the
file rolls it back.

A dwell is written in one transaction, with its samples, its moves and the reason of an interruption. It is
complete or not there, and it is announced only when it is on the disk. A kill or a power cut therefore
loses at most the dwell that is being recorded.
"""

from __future__ import annotations

import math
import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from adis_gonio.base import Closing, __version__
from adis_gonio.base.errors import AdisGonioError, DataError, SessionError, one_line
from adis_gonio.base.output import exists_error, flush_names
from adis_gonio.base.shapes import ShapeError, anything, checked_value
from adis_gonio.device.sensor.registers import ACCEL_OUT, BY_NAME
from adis_gonio.device.sensor.settings import ScanBlock
from adis_gonio.record import archive_tables as schema
from adis_gonio.record.blocks import GENERIC, UNITS, Block, ValueBlock
from adis_gonio.record.plans import Plan, Position

MOST_STEPS = 100_000_000
"""Number of SQLite instructions after which a query is stopped; a day-long session takes 10⁶."""
LONGEST_ROW_BYTES = 4_000_000
"""Largest size of a table row in bytes: a block has some ten kilobytes, a plan of 3600 positions 500 kB."""
MOST_TEXT = 4_000_000
"""Largest number of characters in all rows of a query.

Parsed JSON takes up to 30 times its length in memory.
"""

WAIT_S = 30.0
"""Time in s for which a reader waits for a commit, and a writer for readers."""

LONGEST_TEXT = 100

_MAGIC = b"SQLite format 3\x00"


def is_archive(path: Path) -> bool:
    """Return True if the file begins like a session file: SQLite with this program's application id."""
    try:
        with path.open("rb") as file:
            head = file.read(72)
    except OSError:
        return False
    return head[:16] == _MAGIC and int.from_bytes(head[68:72], "big") == schema.APPLICATION_ID


def connect(path: Path, *, write: bool) -> sqlite3.Connection:
    """Open an existing session file as an SQLite connection, for reading or also for writing (`write`).

    Raises
    ------
    DataError
        The file is no session file, is damaged or truncated, or is newer than this program.
    SessionError
        The file cannot be opened here (permissions, busy), or has no session yet.
    """
    _check_file(path)
    connection = _open(path, "rw" if write else "ro")
    try:
        with translated_errors(path):
            try:
                _check_content(path, connection)
            except sqlite3.OperationalError:
                if write:
                    raise
                # A killed writer left a journal; only a writer can roll it back.
                connection.close()
                connection = _open(path, "rw")
                _check_content(path, connection)
            if write:
                make_durable(connection)
    except BaseException:
        connection.close()
        raise
    return connection


def set_aside(path: Path) -> Path:
    """Rename a file to the first unused name of the form `stem.1.suffix`, and return the new name.

    If a killed program left a journal, it is rolled back first: it belongs to the file's present name, and
    SQLite would otherwise apply it to the next file of this name.
    """
    with suppress(AdisGonioError):
        connect(path, write=True).close()
    free = (path.with_name(f"{path.stem}.{k}{path.suffix}") for k in count(1))
    aside = path.rename(next(one for one in free if not one.exists()))
    flush_names(path.parent)  # before the next file of the old name begins
    return aside


def make_durable(connection: sqlite3.Connection) -> None:
    """Set the SQLite options of a connection for writing, so that a power cut loses no committed data."""
    connection.execute("PRAGMA journal_mode = DELETE")
    connection.execute("PRAGMA synchronous = EXTRA")
    connection.execute("PRAGMA foreign_keys = ON")


@contextmanager
def translated_errors(path: Path) -> Iterator[None]:
    """Convert errors of SQLite and of wrong values in the block to errors that name the file."""
    try:
        yield
    except ShapeError as error:
        raise damaged(path, str(error)) from None
    except sqlite3.Error as error:
        raise _explain(path, error) from error
    except UnicodeDecodeError as error:
        raise damaged(path, "text that is not UTF-8") from error


def damaged(path: Path, what: str) -> DataError:
    """Make the error for a file with damaged content; `what` names the damaged content."""
    return DataError(f"{path}: is damaged ({what}); restore it from a copy (it was left as it is)")


def _truncated(path: Path) -> DataError | None:
    """Return the error for a file shorter than its header states; None if it is complete."""
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(32)
    except OSError:
        return None
    page_bytes = int.from_bytes(head[16:18], "big")
    whole = int.from_bytes(head[28:32], "big") * (65536 if page_bytes == 1 else page_bytes)
    if len(head) == 32 and size >= whole:
        return None
    of = f", {size} of {whole} bytes" if len(head) == 32 else ""
    return DataError(f"{path}: is truncated{of}; restore it from a copy (it was left as it is)")


def _excerpt(text: str) -> str:
    """Shorten an SQLite message to one printable line, because it may quote SQL or raw bytes."""
    line = one_line(text)
    return line if len(line) <= LONGEST_TEXT else f"{line[:LONGEST_TEXT]}…"


_LOCKED = f"another program has kept it locked for {WAIT_S:g} s; try again"
_OBSTACLES = {
    "SQLITE_FULL": "the disk is full; make room and resume, all completed dwells are kept",
    "SQLITE_READONLY": "cannot be written ({}); copy it to a place that you may write",
    "SQLITE_BUSY": _LOCKED,
    "SQLITE_LOCKED": _LOCKED,
    "SQLITE_IOERR": "the disk failed ({}); all completed dwells are kept",
}
"""Message for errors of SQLite with a cause outside the file, by the beginning of the error's name.

{} stands for the message of SQLite.
"""


def _explain(path: Path, error: sqlite3.Error) -> DataError | SessionError:
    text = _excerpt(str(error))
    name = getattr(error, "sqlite_errorname", "")
    if name.startswith("SQLITE_NOTADB"):
        return DataError(f"{path}: is no session file")
    if name.startswith(("SQLITE_INTERRUPT", "SQLITE_TOOBIG")):
        return damaged(path, f"it cannot be read within bounds: {text}")
    if name.startswith("SQLITE_CORRUPT") or text.startswith(("no such table", "no such column")):
        return _truncated(path) or damaged(path, text)
    known = (message for prefix, message in _OBSTACLES.items() if name.startswith(prefix))
    return SessionError(f"{path}: {next(known, '{}').format(text)}")


def _open(path: Path, mode: str) -> sqlite3.Connection:
    with translated_errors(path):
        connection = sqlite3.connect(
            f"file:{quote(os.fsencode(path.absolute()))}?mode={mode}",
            uri=True,
            timeout=WAIT_S,
            isolation_level=None,
            check_same_thread=False,
            cached_statements=0,  # a statement kept for another run would go on counting its steps
        )
        connection.set_progress_handler(lambda: 1, MOST_STEPS)
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LONGEST_ROW_BYTES)
        connection.execute("PRAGMA trusted_schema = OFF")
        return connection


def _check_file(path: Path) -> None:
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except FileNotFoundError:
        raise DataError(f"{path}: there is no such file") from None
    except OSError as error:
        raise SessionError(f"{path}: cannot be read: {error.strerror}") from None
    if head and head != _MAGIC[: len(head)]:
        raise DataError(f"{path}: is no session file")
    truncated = _truncated(path) if head and len(head) < len(_MAGIC) else None
    if truncated is not None:
        raise truncated


def _check_content(path: Path, connection: sqlite3.Connection) -> None:
    # This query also rolls back a journal.
    (tables,) = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if not tables and not application:
        raise SessionError(
            f"{path}: has no session yet, it was interrupted at its beginning;"
            " begin a new session with --force"
        )
    if application != schema.APPLICATION_ID:
        raise DataError(f"{path}: is an SQLite file, but no session file")
    if version > schema.SCHEMA_VERSION:
        raise DataError(
            f"{path}: has schema {version}, this program reads up to {schema.SCHEMA_VERSION};"
            " update adis-gonio"
        )
    _refuse_other_objects(path, connection)
    # A damaged tree could hide rows without any error, hence the walk through all pages.
    (found,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if found != "ok":
        raise damaged(path, _excerpt(str(found)))


def _refuse_other_objects(path: Path, connection: sqlite3.Connection) -> None:
    """Raise `DataError` if the file lacks a table of `statements`, or has any other object.

    A view with the name of a table may run without end; a trigger, an index or another table would run
    expressions from the file. A trigger against UPDATE or DELETE may be missing.
    """
    with closing(sqlite3.connect(":memory:")) as model:
        for statement in schema.statements():
            model.execute(statement)
        wanted = _objects(model)
    found = _objects(connection)
    strange = sorted(name for name, made in found.items() if wanted.get(name) != made)
    if strange:
        kind, _ = wanted.get(strange[0], ("part", ""))
        raise damaged(path, f"'{_excerpt(strange[0])}' is no {kind} of a session file")
    missing = [table for table in schema.TABLES if table not in found]
    if missing:
        raise damaged(path, f"no such table: {missing[0]}")


def _objects(connection: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """Return kind and SQL text of each table, view, trigger and index of a database, by name.

    SQLite's internal tables and indexes are left out. Triggers and views are always included, even if their
    names look internal.
    """
    own = "name LIKE 'sqlite\\_%' ESCAPE '\\' AND (type = 'table' OR sql IS NULL)"
    query = f"SELECT name, type, sql FROM sqlite_master WHERE NOT ({own})"
    return {str(name): (str(kind), str(sql)) for name, kind, sql in connection.execute(query)}


class ArchiveView(Closing):
    """A session file that is open for reading; use it as a context manager.

    Attributes
    ----------
    path : Path
        Path of the file.

    Raises
    ------
    DataError
        The file is missing, of another kind, damaged, truncated or newer than this program.
    SessionError
        The file cannot be read here, or has no session yet.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._connection = connect(self.path, write=False)

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """Let all reads in the block see one state of the file, even if another program writes to it."""
        with translated_errors(self.path):
            self._connection.execute("BEGIN")
        try:
            yield
        finally:
            self._connection.rollback()

    @cached_property
    def header(self) -> schema.Header:
        """Header of the session; it is read from the file once, because it never changes."""
        stored = {row["key"]: row["value"] for row in self._rows("meta", "key")}
        with translated_errors(self.path):
            values = checked_value("table meta", schema.META, stored)
        values["plan"] = Plan.from_dict(values["plan"])
        if values["fixture_sigma_deg"] == "free":
            values["fixture_sigma_deg"] = math.inf
        return schema.Header(**values)

    def records(self, kind: str | None = None) -> list[schema.JsonDict]:
        """Return the rows of the table `records`, of one kind or (None) of all kinds, as they were written.

        A row has the number of its `run`, the time `utc` by the wall clock (ISO 8601), the time `bus_s` of
        the event on the bus's clock in s, its `kind`, and its parsed JSON `value`.
        """
        rows = self._rows("records", "record", kind=kind)
        for row in rows:
            with translated_errors(self.path):
                shape = schema.RECORDS.get(row["kind"], anything)
                checked_value(f"record {row['record']}: {row['kind']}", shape, row["value"])
        return rows

    def values(self, kind: str) -> list[Any]:
        """Return the values of the records of a kind, as they were written."""
        return [record["value"] for record in self.records(kind)]

    def last(self, kind: str) -> Any:
        """Return the value of the last record of a kind; None if there is no such record."""
        return next(reversed(self.values(kind)), None)

    def runs(self) -> list[schema.JsonDict]:
        """Return the rows of the table `runs`: one for each time a program opened the session to record."""
        return self._rows("runs", "run")

    def plan(self) -> Plan:
        """Return the plan of the session with all its extensions."""
        extended = self.last("plan")
        return self.header.plan if extended is None else Plan.from_dict(extended)

    def attempts(self) -> list[schema.Attempt]:
        """Return all attempts to record a dwell, complete or not, in the order of their numbers."""
        offsets = {run["run"]: run["clock_offset_s"] for run in self.runs()}
        stored = []
        for row in self._rows("attempts", "attempt"):
            position = Position(row.pop("angle_deg"), row.pop("approach"), row.pop("use"))
            row |= {"number": row.pop("attempt"), "registers": tuple(row["registers"])}
            row["stored_blocks"] = row.pop("blocks")
            offset_s = offsets.get(row["run"], math.nan)
            stored.append(schema.Attempt(position=position, offset_s=offset_s, **row))
        self._refuse_strangers(stored)
        return stored

    def _refuse_strangers(self, stored: list[schema.Attempt]) -> None:
        """Raise `DataError` if an attempt with a valid row contradicts the header, the plan or the runs."""
        header, places = self.header, len(self.plan())
        runs = {run["run"]: run["continues"] for run in self.runs()}
        of_number = {attempt.number: attempt.run for attempt in stored}
        for attempt in stored:
            wrong = ""
            # The columns must exist, occur once each and include the accelerations.
            names, generic = attempt.registers, attempt.variant == GENERIC
            known = set(UNITS) if generic else set(BY_NAME)
            least = ("ax", "ay", "az") if generic else ACCEL_OUT
            scanned = len(set(names)) == len(names) and set(least) <= set(names) <= known
            if attempt.run not in runs:
                wrong = f"run {attempt.run}, which is not there"
            elif attempt.place >= places:
                wrong = f"place {attempt.place} of a plan with {places}"
            elif attempt.stored_blocks and attempt.variant != header.variant:
                wrong = f"samples of '{attempt.variant}', the session is of '{header.variant}'"
            elif attempt.stored_blocks and not scanned:
                wrong = "registers that cannot be scanned together"
            if wrong:
                raise damaged(self.path, f"attempt {attempt.number} has {wrong}")
        for run, after in runs.items():
            # If a run continued itself or a later run, it would have no beginning.
            if after and not of_number.get(after, run) < run:
                raise damaged(self.path, f"run {run} goes on after attempt {after}")

    def dwells(self) -> list[schema.Attempt]:
        """Return the complete dwells in the order of recording, at most one for each position of the plan.

        If a position was repeated, only its last dwell counts. If the operator withdrew this dwell, the
        position has no dwell, and the operator is asked for it again.
        """
        attempts = self.attempts()
        latest = {a.place: a.number for a in attempts if a.outcome == "complete"}
        counted = set(latest.values()) - self.withdrawn()
        return [a for a in attempts if a.number in counted]

    def doubts(self) -> list[schema.JsonDict]:
        """Return the reasons to doubt a result of this session, as mappings with `kind` and `message`.

        There are two sorts of reason. If the operator overruled a guard (a check at the bench) in a dwell
        that is used, `attempt` is the number of the dwell. If a position was skipped because its reading
        contradicted earlier dwells, and all these dwells are used, one of them may be wrong: `place` is
        then the number of the skipped position in the plan, from 0, and `attempt` is None.
        """
        dwells = self.dwells()
        counted, places = {attempt.number for attempt in dwells}, {attempt.place for attempt in dwells}
        kept = [doubt for doubt in self.values("doubt") if doubt["attempt"] in counted]
        skipped = {
            doubt["place"]: doubt
            for doubt in self.values("contradiction")
            if doubt["place"] not in places and counted.issuperset(doubt["dwells"])
        }
        for place in skipped:
            self._require_place(place)
        return kept + [{"attempt": None, **doubt} for doubt in skipped.values()]

    def _require_place(self, place: int) -> int:
        """Return `place`, the number of a position in the plan; `DataError` if the plan is shorter."""
        if place >= len(self.plan()):
            raise damaged(self.path, f"a record names place {place}, which the plan does not have")
        return place

    def offset_writes(self) -> list[schema.JsonDict]:
        """Return the recorded steps of writes to the sensor's offset registers, each a mapping, in order.

        Raises
        ------
        DataError
            The first step of a write lacks the registers, or a later step names other registers.
        """
        steps = [record["value"] | {"utc": record["utc"]} for record in self.records("offsets")]
        written: dict[int, set[str]] = {}
        for step in steps:
            number = step["number"]
            if number not in written and not {"op", "old", "found", "save"} <= step.keys():
                raise damaged(self.path, f"the first step of write {number} is missing")
            names = written.setdefault(number, set(step.get("old", ())))
            if any(set(step.get(part, names)) != names for part in ("old", "new", "found")):
                raise damaged(self.path, f"the steps of write {number} are about other registers")
        return steps

    def withdrawn(self) -> set[int]:
        """Return the numbers of complete attempts that the operator declared invalid afterwards."""
        return set(self.values("withdrawn"))

    def skipped(self) -> set[int]:
        """Return the numbers, from 0, of the plan's positions that were skipped and have no dwell."""
        skipped = set(map(self._require_place, self.values("skipped")))
        return skipped - {a.place for a in self.dwells()}

    def pending(self) -> list[int]:
        """Return the numbers, from 0, of the plan's positions without a dwell that were not skipped."""
        settled = {a.place for a in self.dwells()} | self.skipped()
        return [place for place in range(len(self.plan())) if place not in settled]

    def blocks(self, attempt: schema.Attempt, phase: schema.Phase | None = None) -> list[Block]:
        """Return the blocks of samples of an attempt, of one phase or (None) of all phases.

        Raises
        ------
        DataError
            A block is missing or has a wrong checksum; the message names it.
        """
        of_phase = {} if phase is None else {"phase": phase}
        rows = self._rows("blocks", "sequence", attempt=attempt.number, **of_phase)
        with translated_errors(self.path):
            (stored,) = self._connection.execute(
                "SELECT COUNT(*) FROM blocks WHERE attempt = ?", (attempt.number,)
            ).fetchone()
        if stored != attempt.stored_blocks:
            raise damaged(
                self.path, f"{stored} of {attempt.stored_blocks} blocks of attempt {attempt.number}"
            )
        return [self._block(attempt, row) for row in rows]

    def _block(self, attempt: schema.Attempt, row: schema.JsonDict) -> Block:
        where = f"block {row['sequence']} of attempt {attempt.number}"
        scans, words, time_s = row["scans"], row["words"], row["time_s"]
        generic, columns = attempt.variant == GENERIC, attempt.registers
        if len(time_s) != 8 * scans or len(words) != (8 if generic else 2) * len(columns) * scans:
            raise damaged(self.path, f"{where} does not hold {scans} scans")
        times = np.frombuffer(time_s, "<f8").astype(np.float64)
        # NaN fails every comparison; with `not` it is refused.
        if not (np.abs(times) <= schema.LARGEST_S).all() or (np.diff(times) < 0).any():
            raise damaged(self.path, f"the times of {where} are no numbers that increase")
        shape = scans, len(columns)
        if not generic:
            held = np.frombuffer(words, "<u2").astype(np.uint16).reshape(shape)
            chip = attempt.variant, attempt.gyro_range_dps
            return ScanBlock(columns, held, times, row["lost"], *chip)
        values = np.frombuffer(words, "<f8").astype(np.float64).reshape(shape)
        if not (np.abs(values) <= schema.LARGEST_VALUE).all():
            raise damaged(self.path, f"the samples of {where} are no numbers of a sensor")
        return ValueBlock(columns, values, times, row["lost"])

    def _line(self, attempt: int) -> list[schema.Attempt]:
        """Return the last attempt of each run that led to the attempt with the number `attempt`, in order.

        The list ends with this attempt. The entry of an earlier run is the attempt after which the next run
        continued, which need not be the last one that the earlier run recorded.
        """
        continues = {run["run"]: run["continues"] for run in self.runs()}
        of_number = {stored.number: stored for stored in self.attempts()}
        line: list[schema.Attempt] = []
        while attempt:
            line.insert(0, of_number[attempt])
            attempt = continues[line[0].run]
        return line

    def moves_before(self, attempt: int) -> list[schema.Move]:
        """Return the moves of the stage up to the end of an attempt, in order.

        `attempt` is the number of the attempt. Moves that a resumed run does not build on are left out.
        """
        of_run = {stored.number: stored.run for stored in self.attempts()}
        rows = self._rows("moves", "move")
        return [
            _move(row)
            for last in self._line(attempt)
            for row in rows
            if of_run.get(row["attempt"]) == last.run and row["attempt"] <= last.number
        ]

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._connection.close()

    def _rows(
        self, table: str, order: str, kind: str | None = None, **where: int | str
    ) -> list[schema.JsonDict]:
        """Return the checked rows of a table, each by column name, without checksums.

        `order` names the column by which the rows are sorted, `where` gives values of columns that the rows
        must have, and `kind` limits the table `records` to one kind (None: all kinds).

        All reads go through this method: it checks each value against the type and range that
        `archive_tables` declares, and parses JSON. Records of other kinds than `kind` are left out after
        their checksum was checked.
        """
        checked, characters = [], 0
        conditions = " AND ".join(f"{column} = ?" for column in where) or "1"
        with translated_errors(self.path):
            rows = self._connection.execute(
                f"SELECT * FROM {table} WHERE {conditions} ORDER BY {order}", tuple(where.values())
            )
            # One row at a time: a bad row is refused before the next row is read into memory.
            for number, row in enumerate(rows, start=1):
                if schema.checksum(*row[:-1]) != row[-1]:
                    raise damaged(self.path, f"checksum of row {number} of table {table}")
                if kind is not None and kind != row[-3]:
                    continue
                characters += sum(len(part) for part in row if isinstance(part, str))
                if characters > MOST_TEXT:
                    raise damaged(self.path, f"table {table} holds more than {MOST_TEXT} characters")
                checked.append(schema.checked_row(table, row[:-1], f"row {number} of table {table}: "))
        return checked


def _move(row: schema.JsonDict) -> schema.Move:
    aim, move = row["direction"], schema.Move(row["bus_s"], row["angle_deg"], row["approach"])
    if isinstance(aim, dict):
        return replace(move, turned_deg=aim["turned_deg"])
    return move if aim is None else replace(move, direction=(aim[0], aim[1], aim[2]))


class Archive(ArchiveView):
    """A session file that is open for writing, by one program at a time.

    Call `create` for a new file or `open_existing` to continue a file, then `begin_run`.

    Attributes
    ----------
    path : Path
        Path of the file.
    utc : callable
        Returns the present time as the text that is stored with a run or record.
    run : int
        Number of the present run (opening for recording), from 1; 0 before `begin_run`.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection
        self.utc: Callable[[], str] = schema.utc_now
        self.run = 0

    @classmethod
    def create(cls, path: str | Path, header: schema.Header) -> Archive:
        """Create a session file with this header and open it for writing.

        Raises
        ------
        UsageError
            The file exists already and is not empty.
        SessionError
            The file cannot be created here.
        """
        path = Path(path)
        try:
            path.touch(exist_ok=False)
        except FileExistsError:
            journal = path.with_name(f"{path.name}-journal")
            if not path.is_file() or path.stat().st_size > 0 or journal.exists():
                raise exists_error(path, "resume it or choose another name") from None
        except OSError as error:
            raise SessionError(f"{path}: cannot be made: {error.strerror}") from None
        archive = cls(path, _open(path, "rw"))
        values = dict(vars(header)) | {"plan": header.plan.as_dict(), "settings": dict(header.settings)}
        if header.fixture_sigma_deg is not None and math.isinf(header.fixture_sigma_deg):
            values["fixture_sigma_deg"] = "free"
        values["created_utc"] = header.created_utc or schema.utc_now()
        with archive.closed_on_error():
            with translated_errors(path):
                make_durable(archive._connection)
            with archive._transaction(new=True):
                for statement in schema.statements():
                    archive._connection.execute(statement)
                for key, value in values.items():
                    archive._insert("meta", key, value)
        return archive

    @classmethod
    def open_existing(cls, path: str | Path) -> Archive:
        """Open a session file to continue it; raises the errors of `ArchiveView`."""
        path = Path(path)
        return cls(path, connect(path, write=True))

    def begin_run(self, bus_s: float, clock_offset_s: float, continues: int = 0) -> int:
        """Register a new run (opening for recording), and return its number, from 1.

        Programs that opened the session earlier may no longer write to it.

        Parameters
        ----------
        bus_s : float
            Present time on the bus's clock in s.
        clock_offset_s : float
            Seconds to add to a time on that clock to get the time since the session began.
        continues : int
            Number of the attempt after which the session continues; 0 for the beginning.
        """
        with self._transaction(new=True):
            run = self._next("runs", "run")
            software = f"adis-gonio {__version__}"
            self._insert("runs", run, self.utc(), bus_s, clock_offset_s, continues, software)
        self.run = run
        return run

    def add_record(self, kind: str, value: Any, bus_s: float) -> None:
        """Write a record to the table `records`: kind, value, and time on the bus's clock in s."""
        with self._transaction():
            self._record(kind, value, bus_s)

    def add_attempt(self, attempt: schema.Attempt) -> int:
        """Write an attempt with its scans and moves to the disk, completely or not at all.

        The number of scans dropped within the dwell is written as a separate record, which older programs
        ignore.

        Returns
        -------
        int
            Number of the attempt, from 1.
        """
        row = vars(attempt.position) | vars(attempt) | {"blocks": len(attempt.blocks)}
        for _, first in attempt.blocks[:1]:
            row |= {name: getattr(first, name) for name in ("registers", "variant", "gyro_range_dps")}
        with self._transaction():
            number = self._next("attempts", "attempt")
            row |= {"attempt": number, "run": self.run}
            self._insert("attempts", *(row[column.name] for column in schema.TABLES["attempts"]))
            for sequence, (phase, block) in enumerate(attempt.blocks):
                samples = block.words if isinstance(block, ScanBlock) else block.data
                blobs = [part.astype(part.dtype.newbyteorder("<")) for part in (samples, block.time_s)]
                counts = len(block), block.lost
                self._insert("blocks", number, sequence, phase, *counts, *(b.tobytes() for b in blobs))
            dropped = sum(block.dropped for phase, block in attempt.blocks if phase == "dwell")
            if dropped:
                self._record("dropped", {"attempt": number, "scans": dropped}, attempt.ended_bus_s)
            for count, move in enumerate(attempt.moves, start=self._next("moves", "move")):
                self._insert("moves", count, number, move.bus_s, move.angle_deg, move.approach, move.aim)
        return number

    def _record(self, kind: str, value: Any, bus_s: float) -> None:
        number = self._next("records", "record")
        self._insert("records", number, self.run, self.utc(), bus_s, kind, value)

    def _next(self, table: str, key: str) -> int:
        (largest,) = self._connection.execute(f"SELECT coalesce(max({key}), 0) FROM {table}").fetchone()
        return int(largest) + 1

    def _insert(self, table: str, *values: Any) -> None:
        row = [column.stored(value) for column, value in zip(schema.TABLES[table], values, strict=True)]
        marks = ", ".join("?" * (len(row) + 1))
        self._connection.execute(f"INSERT INTO {table} VALUES ({marks})", (*row, schema.checksum(*row)))

    @contextmanager
    def _transaction(self, *, new: bool = False) -> Iterator[None]:
        with translated_errors(self.path):
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                if not new:
                    self._require_own_run()
                yield
                self._connection.execute("COMMIT")
            except BaseException:
                # After some errors (a full disk) SQLite has already rolled back.
                if self._connection.in_transaction:
                    self._connection.rollback()
                raise

    def _require_own_run(self) -> None:
        (latest,) = self._connection.execute("SELECT max(run) FROM runs").fetchone()
        if not self.run or latest != self.run:
            raise SessionError(f"{self.path}: another program has resumed this session; this program stops")
