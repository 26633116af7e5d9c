"""The index: what was found of every session file, in one SQLite file, so that nothing is computed twice.

| table | a row is |
|---|---|
| `files` | a path with its stamp and digest; `gone` where it was not found again |
| `records` | the flat row of a session (`SessionRecord.row`), by the digest of its file |
| `documents` | the record whole, as JSON |

Each record enters in a transaction of its own: whatever interrupts the work, what is in the index is whole.
It holds nothing that the session files do not: a damaged one is set aside and made anew.
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

from adis_gonio.base.errors import DataError
from adis_gonio.base.jsonable import finite
from adis_gonio.fleet.memory.files import Stamp, session_files
from adis_gonio.fleet.memory.record import SessionRecord, file_digest, record_of

NAME = "adis-gonio.index"
"""Of the index in the first folder, where no other file is named."""
APPLICATION_ID = 0x41444749
"""`ADGI` in the file's header."""
VERSION = 1

_ROW = tuple(SessionRecord("").row())
_LOGICAL = ("traced", "adequate", "simulated")  # SQLite has numbers for them
_QUOTED = ", ".join(f'"{name}"' for name in _ROW)  # `when` is a word of SQL
_CREATE = (
    "CREATE TABLE files (path TEXT PRIMARY KEY, sha256 TEXT, size INTEGER, mtime_ns INTEGER,"
    " ctime_ns INTEGER, gone INTEGER NOT NULL DEFAULT 0) WITHOUT ROWID",
    "CREATE INDEX files_by_digest ON files (sha256)",
    f"CREATE TABLE records ({_QUOTED}, PRIMARY KEY (sha256))",
    "CREATE INDEX records_by_serial ON records (serial)",
    "CREATE TABLE documents (sha256 TEXT PRIMARY KEY, document TEXT NOT NULL)",
    f"PRAGMA application_id = {APPLICATION_ID}",
    f"PRAGMA user_version = {VERSION}",
)


@dataclass
class Scan:
    """What looking through folders came to.

    Attributes
    ----------
    computed, known : int
        Files whose results were computed now, and those that were in the index already.
    unreadable : list of SessionRecord
        Files that could not even be read; they are not in the index.
    """

    computed: int = 0
    known: int = 0
    unreadable: list[SessionRecord] = field(default_factory=list)


class Index:
    """Records of sessions, by the digests of their files.

    Attributes
    ----------
    path : Path
        Of its file.
    problems : list of str
        What went wrong with the file, one line each; the index then goes on in memory alone, or anew.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.problems: list[str] = []
        self._connection = self._opened()

    @classmethod
    def of(cls, places: Sequence[str | Path], path: str | Path | None = None) -> Index:
        """The index at `path`, else the one in the first folder.

        Raises
        ------
        DataError
            There is no such folder, or the file is something else than an index.
        """
        if path is None:
            first = Path(places[0])
            if not first.exists():
                raise DataError(f"{first}: there is no such folder")
            path = (first if first.is_dir() else first.parent) / NAME
        return cls(path)

    def __enter__(self) -> Index:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    # -- the file ----------------------------------------------------------------------------------

    def _opened(self) -> sqlite3.Connection:
        try:
            return self._checked()
        except sqlite3.OperationalError as error:
            return self._in_memory(f"{self.path}: cannot be opened ({error})")
        except sqlite3.DatabaseError as error:
            if not self._ours():
                raise DataError(f"{self.path}: is no index of sessions; name another by --index") from None
            aside = self._set_aside()
            self.problems.append(
                f"{self.path}: is damaged ({error}); set aside as {aside.name} and made anew"
            )
            return self._checked()

    def _checked(self) -> sqlite3.Connection:
        connection = _connected(self.path)
        try:
            _prepare(connection, self.path)
        except BaseException:
            connection.close()
            raise
        return connection

    def _ours(self) -> bool:
        """True where the file was an index once: its head says so, or its name where the head is lost."""
        with self.path.open("rb") as file:
            head = file.read(72)
        return int.from_bytes(head[68:72], "big") == APPLICATION_ID or self.path.name == NAME

    def _set_aside(self) -> Path:
        for number in count(1):
            aside = self.path.with_name(f"{self.path.name}.damaged-{number}")
            if not aside.exists():
                return self.path.rename(aside)
        raise AssertionError("unreachable")

    def _in_memory(self, problem: str, known: sqlite3.Connection | None = None) -> sqlite3.Connection:
        """Go on without the file, with what it held; what is found now is shown, but not kept."""
        self.problems.append(
            f"{problem}; what it holds stays, what is new is not kept: make room, or name a file by --index"
        )
        connection = _connected(":memory:")
        if known is None and self.path.exists():
            with suppress(sqlite3.Error), closing(_connected(self.path, "ro")) as there:
                there.backup(connection)
        elif known is not None:
            with suppress(sqlite3.Error):
                known.rollback()
            known.backup(connection)
            known.close()
        _prepare(connection, self.path)
        return connection

    def _write(self, statements: Iterable[tuple[str, Sequence[Any]]]) -> None:
        """All statements or none; a disk that is full or read-only makes the index one in memory."""
        todo = list(statements)
        try:
            self._commit(todo)
        except sqlite3.OperationalError as error:
            self._connection = self._in_memory(
                f"{self.path}: cannot be written ({error})", self._connection
            )
            self._commit(todo)

    def _commit(self, todo: Sequence[tuple[str, Sequence[Any]]]) -> None:
        try:
            self._connection.execute("BEGIN IMMEDIATE")
            for sql, values in todo:
                self._connection.execute(sql, values)
            self._connection.execute("COMMIT")
        except BaseException:
            if self._connection.in_transaction:
                self._connection.rollback()
            raise

    # -- filling it --------------------------------------------------------------------------------

    def scan(self, places: Sequence[str | Path], *, trace: bool = False) -> Scan:
        """Look through folders; compute what is new or has changed since, and leave the rest.

        Parameters
        ----------
        trace : bool
            Look for effects too; records that were made without are made again.
        """
        from adis_gonio.base.budget import told

        paths = list(session_files(places))
        self._mark_gone(places, paths)
        found = Scan()
        for path in told(paths):
            self._take(path, found, trace=trace)
        return found

    def _take(self, path: Path, found: Scan, *, trace: bool) -> None:
        try:
            stamp = Stamp.of(path)
            digest = self._digest_at(path, stamp) or file_digest(path)
        except OSError as error:
            reason = f"{path}: cannot be read: {error.strerror or error}"
            found.unreadable.append(SessionRecord(str(path), status="failed", reason=reason))
            return
        if self._has(digest, trace=trace):
            found.known += 1
            self._write(self._to_file(path, digest, stamp))
            return
        record = record_of(path, trace=trace)
        found.computed += 1
        if record.sha256 is None:
            found.unreadable.append(record)
            return
        # The stamp is older than the content: a file that changed meanwhile is read again next time.
        self._write([*self._to_file(path, record.sha256, stamp), *_to_record(record)])

    def add(self, record: SessionRecord) -> None:
        """Keep a record that was made elsewhere; it needs its digest."""
        self._write(
            [*self._to_file(Path(record.path), record.sha256 or "", Stamp(0, 0, 0)), *_to_record(record)]
        )

    def add_all(self, records: Iterable[SessionRecord]) -> None:
        """Keep many in one transaction."""
        self._write(
            statement
            for record in records
            for statement in (
                *self._to_file(Path(record.path), record.sha256 or "", Stamp(0, 0, 0)),
                *_to_record(record),
            )
        )

    def _digest_at(self, path: Path, stamp: Stamp) -> str | None:
        row = self._connection.execute(
            "SELECT sha256 FROM files WHERE path = ? AND size = ? AND mtime_ns = ? AND ctime_ns = ?",
            (str(path), stamp.size, stamp.mtime_ns, stamp.ctime_ns),
        ).fetchone()
        return None if row is None else str(row[0])

    def _has(self, digest: str, *, trace: bool) -> bool:
        row = self._connection.execute(
            "SELECT traced, status FROM records WHERE sha256 = ?", (digest,)
        ).fetchone()
        return row is not None and (bool(row[0]) or not trace or row[1] == "failed")

    def _to_file(self, path: Path, digest: str, stamp: Stamp) -> list[tuple[str, Sequence[Any]]]:
        """Where a digest is found now; the record of what was there before goes, if it is nowhere else."""
        same = (str(path), digest, stamp.size, stamp.mtime_ns, stamp.ctime_ns)
        orphan = (
            "sha256 = (SELECT sha256 FROM files WHERE path = ?1 AND sha256 <> ?2)"
            " AND NOT EXISTS (SELECT 1 FROM files WHERE files.sha256 = {0}.sha256 AND path <> ?1)"
        )
        return [
            ("DELETE FROM documents WHERE " + orphan.format("documents"), same[:2]),
            ("DELETE FROM records WHERE " + orphan.format("records"), same[:2]),
            ("DELETE FROM files WHERE sha256 = ? AND gone AND path <> ?", (digest, str(path))),
            ("INSERT OR REPLACE INTO files VALUES (?, ?, ?, ?, ?, 0)", same),
        ]

    def _mark_gone(self, places: Sequence[str | Path], paths: Iterable[Path]) -> None:
        """Files below the places that are not there any more: what they held stays in memory."""
        there = {str(path) for path in paths}
        roots = [Path(place).resolve() for place in places]
        held = self._connection.execute("SELECT path FROM files WHERE NOT gone").fetchall()
        lost = [
            path
            for (path,) in held
            if path not in there and any(Path(path).is_relative_to(root) for root in roots)
        ]
        if lost:
            self._write(("UPDATE files SET gone = 1 WHERE path = ?", (path,)) for path in lost)

    # -- reading it --------------------------------------------------------------------------------

    def columns(self, names: Sequence[str]) -> list[tuple[Any, ...]]:
        """Columns of all records' rows, (n,) each, without reading a document."""
        listed = ", ".join(f'"{_ROW[_ROW.index(name)]}"' for name in names)
        rows = self._connection.execute(f"SELECT {listed} FROM records").fetchall()
        return list(zip(*rows, strict=True)) if rows else [() for _ in names]

    def rows(self, **wanted: str | None) -> list[dict[str, Any]]:
        """Flat rows by serial number, operator, stage and date, with `copies` (further paths) and `gone`.

        Parameters
        ----------
        wanted : str or None
            `serial`, `operator`, `stage`: only those.
        """
        terms = {name: text for name, text in wanted.items() if text is not None}
        where = " AND ".join(f"{name} = ?" for name in terms) or "1"
        order = '"serial" IS NULL, "serial", "operator", "stage", "when", path'
        found = self._connection.execute(
            f"SELECT {_QUOTED} FROM records WHERE {where} ORDER BY {order}", tuple(terms.values())
        ).fetchall()
        paths = self._paths()
        rows = []
        for values in found:
            row = dict(zip(_ROW, values, strict=True))
            row |= {name: None if row[name] is None else bool(row[name]) for name in _LOGICAL}
            there = [path for path, gone in paths.get(row["sha256"], []) if not gone]
            row["path"] = there[0] if there else row["path"]
            rows.append(row | {"copies": there[1:], "gone": not there})
        return rows

    def _paths(self) -> Mapping[str, list[tuple[str, bool]]]:
        paths: dict[str, list[tuple[str, bool]]] = {}
        for path, digest, gone in self._connection.execute("SELECT path, sha256, gone FROM files"):
            paths.setdefault(digest, []).append((path, bool(gone)))
        return paths

    def records(self, serial: str | None = None) -> list[SessionRecord]:
        """Records whole, of one serial number or all, in the order of time; the same data counted once."""
        where, values = ("1", ()) if serial is None else ("serial = ?", (serial,))
        found = self._connection.execute(
            f"SELECT document FROM records JOIN documents USING (sha256) WHERE {where}", values
        )
        return list(_once(SessionRecord.from_dict(json.loads(text)) for (text,) in found))

    def serials(self) -> list[str]:
        """Serial numbers that it knows."""
        rows = self._connection.execute(
            "SELECT DISTINCT serial FROM records WHERE serial IS NOT NULL ORDER BY serial"
        )
        return [str(serial) for (serial,) in rows]


def _once(records: Iterable[SessionRecord]) -> Iterator[SessionRecord]:
    """Each data once, by preference with its time: an archive before the CSV exported from it."""
    kept = sorted(records, key=lambda record: record.when is None)
    seen: set[str] = set()
    once = []
    for record in kept:
        if record.data_sha256 is None or record.data_sha256 not in seen:
            once.append(record)
        seen.add(record.data_sha256 or "")
    yield from sorted(once, key=lambda record: (record.when or "", record.path))


def _to_record(record: SessionRecord) -> list[tuple[str, Sequence[Any]]]:
    row = finite(record.row())
    marks = ", ".join("?" * len(_ROW))
    document = json.dumps(finite(record.as_dict()), ensure_ascii=False, separators=(",", ":"))
    return [
        (f"INSERT OR REPLACE INTO records VALUES ({marks})", [row[name] for name in _ROW]),
        ("INSERT OR REPLACE INTO documents VALUES (?, ?)", (record.sha256, document)),
    ]


def _connected(path: str | Path, mode: str = "rwc") -> sqlite3.Connection:
    if path == ":memory:":
        return sqlite3.connect(path, isolation_level=None)
    from urllib.parse import quote

    name = f"file:{quote(os.fsencode(Path(path).absolute()))}?mode={mode}"
    return sqlite3.connect(name, uri=True, timeout=30.0, isolation_level=None)


def _prepare(connection: sqlite3.Connection, path: Path) -> None:
    """Make the tables of a new index; look through those of one that is there."""
    if not _tables(connection):
        connection.execute("BEGIN IMMEDIATE")
        if not _tables(connection):  # another program may have been quicker
            for statement in _CREATE:
                connection.execute(statement)
        connection.execute("COMMIT")
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION_ID:
        raise DataError(f"{path}: is no index of sessions; name another by --index")
    if version != VERSION:
        raise DataError(f"{path}: is an index of version {version}, this program's is {VERSION}: remove it")
    (found,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if found != "ok":
        raise sqlite3.DatabaseError(" ".join(str(found).split())[:80])


def _tables(connection: sqlite3.Connection) -> int:
    return int(connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0])
