"""The store: the result of every session file by the file's digest, so that nothing is computed twice.

The store is one SQLite file. The commands `archive`, `history` and `due` keep it in the first given folder.
The command `fleet` uses it as its journal.

| table | a row is |
|---|---|
| `files` | a path with its length, times and digest |
| `records` | the record of a session as JSON, by the digest of its file, with the options that made it |

Each record is written in a separate transaction, so that an interruption leaves whole records only. The
store contains no data that cannot be computed again from the session files.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from adis_gonio.base import Closing
from adis_gonio.base.errors import DataError, OutputError
from adis_gonio.base.jsonable import finite
from adis_gonio.base.numbers import counted
from adis_gonio.fleet.session_record import Job, Options, Repeated, SessionRecord, once
from adis_gonio.record.provenance import digest_of_file

NAME = "adis-gonio.index"
"""File name that the store has in the first folder."""
APPLICATION_ID = 0x41444749
"""Number in the file's header that identifies a store: the letters `ADGI`."""
VERSION = 3
IN_MEMORY = ":memory:"

_CREATE = (
    "CREATE TABLE files (path TEXT PRIMARY KEY, sha256 TEXT, stamp TEXT) WITHOUT ROWID",
    "CREATE INDEX files_by_digest ON files (sha256)",
    "CREATE TABLE records (sha256 TEXT PRIMARY KEY, serial TEXT, options TEXT, record TEXT NOT NULL)",
    "CREATE INDEX records_by_serial ON records (serial)",
    f"PRAGMA application_id = {APPLICATION_ID}",
    f"PRAGMA user_version = {VERSION}",
)
_AT_PATH = (
    "INSERT INTO files (path, sha256, stamp) VALUES (?1, ?2, ?3) ON CONFLICT (path)"
    " DO UPDATE SET sha256 = ?2, stamp = coalesce(?3, stamp)"
)
_REPLACED = (
    "DELETE FROM records WHERE sha256 = (SELECT sha256 FROM files WHERE path = ?1 AND sha256 <> ?2)"
    " AND NOT EXISTS (SELECT 1 FROM files WHERE files.sha256 = records.sha256 AND path <> ?1)"
)


class Store(Closing):
    """Stores the record of every session file, found by the digest of the file.

    Parameters
    ----------
    path : str or Path
        File of the store, created if it does not exist; `IN_MEMORY` keeps the store in memory.
    strict : bool
        True makes the store the journal of a fleet: only results with equal options and version are used
        again. False makes it an index: a stored result is used for any options that it fulfils.

    Raises
    ------
    DataError
        The file is no store, is damaged, or has another version.
    OutputError
        The file cannot be opened or written.
    """

    def __init__(self, path: str | Path, *, strict: bool = False) -> None:
        self.path = Path(path)
        self.strict = strict
        self._connection = self._opened()

    @classmethod
    def of(cls, places: Sequence[str | Path], path: str | Path | None = None) -> Store:
        """Open the store at `path` or, if it is None, in the first folder of `places`."""
        first = Path(places[0])
        return cls(path or (first if first.is_dir() else first.parent) / NAME)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    @property
    def sessions(self) -> int:
        """Number of sessions with a record in the store."""
        return int(self._connection.execute("SELECT count(*) FROM records").fetchone()[0])

    # -- the file ----------------------------------------------------------------------------------

    def _opened(self) -> sqlite3.Connection:
        try:
            with ExitStack() as undo:
                connection = undo.enter_context(
                    closing(sqlite3.connect(self.path, timeout=30.0, isolation_level=None))
                )
                self._prepare(connection)
                undo.pop_all()
        except sqlite3.OperationalError as error:
            raise self._unusable("opened", error) from error
        except sqlite3.DatabaseError as error:
            # The header shows that this program made the file or, if the header is damaged, the name.
            with self.path.open("rb") as file:
                head = file.read(72)
            if int.from_bytes(head[68:72], "big") != APPLICATION_ID and self.path.name != NAME:
                raise self._foreign() from None
            raise DataError(
                f"{self.path}: is damaged ({error}); remove it, and its sessions are computed again"
            ) from error
        return connection

    def _prepare(self, connection: sqlite3.Connection) -> None:
        """Make the tables of a new store; check the file of an existing store.

        Raises `DataError` for a file of another program or version, and `sqlite3.DatabaseError` for a
        damaged file.
        """
        if not _tables(connection):
            with connection:
                connection.execute("BEGIN IMMEDIATE")
                if not _tables(connection):  # another program may have created them
                    for statement in _CREATE:
                        connection.execute(statement)
        (application,) = connection.execute("PRAGMA application_id").fetchone()
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if application != APPLICATION_ID:
            raise self._foreign()
        if version != VERSION:
            raise DataError(
                f"{self.path}: is an index of version {version}, this program's is {VERSION}: remove it"
            )
        (found,) = connection.execute("PRAGMA quick_check(1)").fetchone()
        if found != "ok":
            raise sqlite3.DatabaseError(" ".join(str(found).split())[:80])

    @property
    def _option(self) -> str:
        """Option of the command line that names another file for the store."""
        return "--journal" if self.strict else "--index"

    def _foreign(self) -> DataError:
        return DataError(f"{self.path}: is no index of sessions; name another file by {self._option}")

    def _unusable(self, verb: str, error: sqlite3.Error, held: str = "") -> OutputError:
        return OutputError(
            f"{self.path}: cannot be {verb}: {error}{held}: make room or name another file by"
            f" {self._option}, and repeat the command to continue from there"
        )

    def _write(self, statements: Iterable[tuple[str, Sequence[Any]]]) -> None:
        """Execute all SQL statements, each given with its arguments, or none.

        Raises
        ------
        OutputError
            The file cannot be written, such as on a full disk; the store is unchanged.
        """
        try:
            with self._connection:
                self._connection.execute("BEGIN IMMEDIATE")
                for sql, values in statements:
                    self._connection.execute(sql, values)
        except sqlite3.OperationalError as error:
            held = f"; it holds {counted(self.sessions, 'session')}"
            raise self._unusable("written", error, held) from error

    # -- writing -----------------------------------------------------------------------------------

    def digest_of(self, path: str | Path) -> str:
        """Return the SHA-256 of a file, which is read only if its length or times have changed.

        The path of the file is recorded in the store.

        The record of the file's former content is deleted unless another file has that content.

        Raises
        ------
        OSError
            The file cannot be read.
        """
        now = Path(path).stat()
        stamp = f"{now.st_size} {now.st_mtime_ns} {now.st_ctime_ns}"
        known = self._connection.execute(
            "SELECT sha256 FROM files WHERE path = ? AND stamp = ?", (str(path), stamp)
        ).fetchone()
        if known is not None:
            return str(known[0])
        digest = digest_of_file(path)
        self._write([(_REPLACED, (str(path), digest)), (_AT_PATH, (str(path), digest, stamp))])
        return digest

    def keep(self, *records: SessionRecord, options: Options | None = None) -> None:
        """Write records to the store with the options that made them; a record without a digest is skipped.

        Raises
        ------
        OutputError
            The records cannot be written; the store is unchanged.
        """
        key = None if options is None else options.key
        todo: list[tuple[str, Sequence[Any]]] = []
        for record in records:
            if record.sha256 is not None:
                # The old stamp stays, so that a file that changed meanwhile is read again.
                todo.append((_AT_PATH, (record.path, record.sha256, None)))
                text = json.dumps(finite(record.as_dict()), ensure_ascii=False, separators=(",", ":"))
                values = (record.sha256, record.serial, key, text)
                todo.append(("INSERT OR REPLACE INTO records VALUES (?, ?, ?, ?)", values))
        self._write(todo)

    # -- reading -----------------------------------------------------------------------------------

    def found(self, job: Job, options: Options) -> SessionRecord | None:
        """Return the stored record of a job, with the path of the job; None if the job has to be computed.

        It has to be computed if there is no record, if a requested trace is missing in the record, or if
        the store is strict and the record was made with other options or another version.
        """
        row = self._connection.execute(
            "SELECT options, record FROM records WHERE sha256 = ?", (job.digest,)
        ).fetchone()
        if row is None or (self.strict and row[0] != options.key):
            return None
        record = SessionRecord.from_dict(json.loads(row[1]))
        if options.trace and not (self.strict or record.traced or record.status == "failed"):
            return None
        return replace(record, path=job.path)

    def rows(self, **wanted: str | None) -> list[dict[str, Any]]:
        """Return the records as flat rows, sorted by serial number, operator, stage and date.

        Each row also has `copies` (other paths of equal files) and `gone` (True if no file is there now).

        Parameters
        ----------
        wanted : str or None
            Filters `serial`, `operator` and `stage`: only records with this value; None for all.
        """
        paths: dict[str, list[str]] = {}
        for path, digest in self._connection.execute("SELECT path, sha256 FROM files"):
            if Path(path).exists():
                paths.setdefault(digest, []).append(path)
        rows = []
        for record in self._records(wanted.get("serial")):
            if all(text is None or getattr(record, name) == text for name, text in wanted.items()):
                first, *copies = paths.get(record.sha256 or "") or [""]
                row = record.row() | {"copies": copies, "gone": not first}
                rows.append(row | {"path": first or record.path})
        # Rows without a serial number come last.
        order = ("serial", "operator", "stage", "when", "path")
        return sorted(rows, key=lambda row: (row["serial"] is None, *(row[name] or "" for name in order)))

    def records(self, serial: str | None = None) -> list[SessionRecord]:
        """Return the records of one sensor, by serial number, or of all sensors, sorted by time.

        `serial` is None for all sensors. Files with equal data give one record.
        """
        return sorted(once(self._records(serial))[0], key=lambda record: record.when or "")

    def copies(self, serial: str) -> list[Repeated]:
        """Return the files of a sensor that do not count, because another file has equal data."""
        return once(self._records(serial))[1]

    def _records(self, serial: str | None) -> list[SessionRecord]:
        where, values = ("1", ()) if serial is None else ("serial = ?", (serial,))
        found = self._connection.execute(f"SELECT record FROM records WHERE {where}", values)
        return [SessionRecord.from_dict(json.loads(text)) for (text,) in found]

    def serials(self) -> list[str]:
        """Return the serial numbers of all sensors with a record in the store, sorted."""
        rows = self._connection.execute(
            "SELECT DISTINCT serial FROM records WHERE serial IS NOT NULL ORDER BY serial"
        )
        return [str(serial) for (serial,) in rows]


def _tables(connection: sqlite3.Connection) -> int:
    return int(connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0])
