"""The archive as an SQLite file: how it is created, opened, recognised and checked.

| table | a row is |
|---|---|
| `meta` | a fact that is fixed at the beginning: URL, variant, settings, versions (JSON) |
| `runs` | one opening of the session by a program: the first, and one for each time it is resumed |
| `records` | an event: registers read, a configuration, a plan, a problem, the end (JSON) |
| `attempts` | one attempt at a dwell, complete or interrupted, with its times and the reason |
| `blocks` | scans of an attempt: words (uint16), of a generic sensor values (float64); times (float64) |
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
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from itertools import count
from pathlib import Path
from urllib.parse import quote

from adis_gonio.base.errors import AdisGonioError, DataError, SessionError, one_line
from adis_gonio.base.output import exists_error
from adis_gonio.record.archive_tables import APPLICATION_ID, SCHEMA_VERSION, TABLES, statements

MOST_STEPS = 100_000_000
"""Instructions of SQLite's machine after which a statement is stopped; a session of a day takes 10⁶."""
LONGEST_ROW_BYTES = 4_000_000
"""Limit of a row: a block has some ten kilobytes, a plan of 3600 positions half a megabyte."""
MOST_TEXT = 4_000_000
"""Limit of characters in the rows of a query; parsed JSON takes up to 30 times its length in memory."""

WAIT_S = 30.0
"""Time in s for which a reader waits for a commit, and a writer for readers."""

LONGEST_TEXT = 100

_MAGIC = b"SQLite format 3\x00"


def is_archive(path: Path) -> bool:
    """True if the first bytes are those of a session file: SQLite with this program's application id."""
    try:
        with path.open("rb") as file:
            head = file.read(72)
    except OSError:
        return False
    return head[:16] == _MAGIC and int.from_bytes(head[68:72], "big") == APPLICATION_ID


def connect(path: Path, *, write: bool) -> sqlite3.Connection:
    """Open an existing session file.

    Raises
    ------
    DataError
        Not a session file, damaged, truncated or newer than this program.
    SessionError
        It cannot be opened here (permissions, busy), or has no session yet.
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


def create(path: Path) -> sqlite3.Connection:
    """Open a new, empty file for a session; the caller runs `statements()` in its first transaction.

    Raises
    ------
    UsageError
        The file exists already.
    SessionError
        It cannot be created here.
    """
    try:
        path.touch(exist_ok=False)
    except FileExistsError:
        if not path.is_file() or path.stat().st_size > 0 or path.with_name(f"{path.name}-journal").exists():
            raise exists_error(path, "resume it or choose another name") from None
    except OSError as error:
        raise SessionError(f"{path}: cannot be made: {error.strerror}") from None
    connection = _open(path, "rw")
    try:
        with translated_errors(path):
            make_durable(connection)
    except BaseException:
        connection.close()
        raise
    return connection


def set_aside(path: Path) -> Path:
    """Rename a file to the first free name of the form `stem.1.suffix`, and return that name.

    If a killed program left a journal, it is rolled back first: it belongs to the file's present name, and
    SQLite would otherwise apply it to the next file of this name.
    """
    with suppress(AdisGonioError):
        connect(path, write=True).close()
    free = (path.with_name(f"{path.stem}.{k}{path.suffix}") for k in count(1))
    return path.rename(next(one for one in free if not one.exists()))


def make_durable(connection: sqlite3.Connection) -> None:
    """Set the SQLite options of a writer, so that a power cut loses nothing; see the module's text."""
    connection.execute("PRAGMA journal_mode = DELETE")
    connection.execute("PRAGMA synchronous = EXTRA")
    connection.execute("PRAGMA foreign_keys = ON")


@contextmanager
def translated_errors(path: Path) -> Iterator[None]:
    """Convert errors of SQLite in the block to one-line errors of this package that name the file."""
    try:
        yield
    except sqlite3.Error as error:
        raise _explain(path, error) from error
    except UnicodeDecodeError as error:
        raise damaged(path, "text that is not UTF-8") from error


def damaged(path: Path, what: str) -> DataError:
    """Make the error for a file with damaged content; `what` names the content."""
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


def _explain(path: Path, error: sqlite3.Error) -> DataError | SessionError:
    text = _excerpt(str(error))
    name = getattr(error, "sqlite_errorname", "")
    if name.startswith("SQLITE_NOTADB"):
        return DataError(f"{path}: is no session file")
    if name.startswith(("SQLITE_INTERRUPT", "SQLITE_TOOBIG")):
        return damaged(path, f"it cannot be read within bounds: {text}")
    if name.startswith("SQLITE_CORRUPT") or text.startswith(("no such table", "no such column")):
        return _truncated(path) or damaged(path, text)
    if name.startswith("SQLITE_FULL"):
        return SessionError(
            f"{path}: the disk is full; make room and resume, all completed dwells are kept"
        )
    if name.startswith("SQLITE_READONLY"):
        return SessionError(f"{path}: cannot be written ({text}); copy it to a place that you may write")
    if name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
        return SessionError(f"{path}: another program has kept it locked for {WAIT_S:g} s; try again")
    if name.startswith("SQLITE_IOERR"):
        return SessionError(f"{path}: the disk failed ({text}); all completed dwells are kept")
    return SessionError(f"{path}: {text}")


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
    if application != APPLICATION_ID:
        raise DataError(f"{path}: is an SQLite file, but no session file")
    if version > SCHEMA_VERSION:
        raise DataError(
            f"{path}: has schema {version}, this program reads up to {SCHEMA_VERSION}; update adis-gonio"
        )
    _refuse_other_objects(path, connection)
    # A damaged tree could hide rows without any error, hence the walk through all pages.
    (found,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if found != "ok":
        raise damaged(path, _excerpt(str(found)))


def _refuse_other_objects(path: Path, connection: sqlite3.Connection) -> None:
    """Raise `DataError` if the file has other tables than `statements`, or any other object.

    A view with the name of a table may run without end; a trigger, an index or another table would run
    expressions from the file. A trigger against UPDATE or DELETE may be missing.
    """
    with closing(sqlite3.connect(":memory:")) as model:
        for statement in statements():
            model.execute(statement)
        wanted = _objects(model)
    found = _objects(connection)
    strange = sorted(name for name, made in found.items() if wanted.get(name) != made)
    if strange:
        kind, _ = wanted.get(strange[0], ("part", ""))
        raise damaged(path, f"'{_excerpt(strange[0])}' is no {kind} of a session file")
    missing = [table for table in TABLES if table not in found]
    if missing:
        raise damaged(path, f"no such table: {missing[0]}")


def _objects(connection: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """Kind and SQL text of each table, view, trigger and index of a database, by name.

    SQLite's internal tables and indexes are left out.

    Triggers and views are always included, even if their names look internal.
    """
    own = "name LIKE 'sqlite\\_%' ESCAPE '\\' AND (type = 'table' OR sql IS NULL)"
    query = f"SELECT name, type, sql FROM sqlite_master WHERE NOT ({own})"
    return {str(name): (str(kind), str(sql)) for name, kind, sql in connection.execute(query)}
