"""The disk of the simulated bench: counts operations of the program, and fails or ends the program at one.

While `hooked` is in force, SQL statements and calls that change a file of one folder are operations with
numbers. A `DiskFault` acts at one of them:

| kind | effect |
|---|---|
| `kill` | the program is gone: nothing after this point changes a file or reaches the sensor |
| `cut` | like `kill`, and the computer loses its power: unsynced data and names may be lost or torn |
| `full`, `read-only`, `broken` | this operation and all later ones that write fail |
| `slow` | this operation and the next 20 take 2 s each |
| `interrupt` | Ctrl-C comes after this operation |

A commit is one operation, but a power cut or a kill within it leaves a rollback journal and a part of the
database's pages, as SQLite's file format defines them. Durability follows the documents of SQLite: with
`synchronous` below EXTRA the last commit may be undone by a power cut, and below FULL any commit; a commit
with EXTRA also flushes the names of the folder. A change of a name is atomic, and a power cut may undo it
until the folder is flushed: the file then has its old name, unless another file took this name meanwhile.
Data that was not flushed reaches the disk before the next command, unless the power fails right before it.
"""

from __future__ import annotations

import errno
import os
import signal
import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

SLOW_S, SLOW_OPERATIONS = 2.0, 20
WRITING = ("INSERT", "CREATE", "COMMIT", "BEGIN IMMEDIATE", "PRAGMA journal_mode", "PRAGMA application_id")
FAILURES = {
    "full": ("SQLITE_FULL", "database or disk is full", errno.ENOSPC),
    "read-only": ("SQLITE_READONLY", "attempt to write a readonly database", errno.EROFS),
    "broken": ("SQLITE_IOERR_WRITE", "disk I/O error", errno.EIO),
}
SIDES = ("before", "within", "after")
_MAGIC = bytes.fromhex("d9d505f920a163d7")
TEARING = ("COMMIT", "write file")
"""Operations that write content to the disk, so that a kill or a power cut can come in their middle."""
_SECTOR = 512


class Killed(BaseException):
    """The program was killed; no handler of the program may catch this."""


class OvertimeError(BaseException):
    """A command waited for longer than any operator would; no handler of the program catches this."""


def press_ctrl_c() -> None:
    """Call the handler of Ctrl-C that the program has now; no signal of the system is sent."""
    handler = signal.getsignal(signal.SIGINT)
    if callable(handler):
        handler(signal.SIGINT, None)


@dataclass(frozen=True)
class DiskFault:
    """One fault of the disk, or the end of the program at an operation of the disk.

    Attributes
    ----------
    kind : str
        See the module.
    operation : int
        Number of the operation, from 1.
    side : str
        `before`, `within` or `after`; only for `kill` and `cut`. `within` is in the middle of this
        operation, or of the next one that writes content to the disk and so takes time.
    """

    kind: str
    operation: int
    side: str = "before"


class Disk:
    """The files of a folder, as the program sees them.

    Parameters
    ----------
    folder : Path
    rng : Generator
        Draws the pages and bytes that reach the disk before a power cut.
    advance : callable
        Lets seconds pass on the clock of the bench.

    Attributes
    ----------
    labels : list of str
        The operations of the present command.
    acted : str
        The operation at which the fault acted, or empty.
    """

    def __init__(self, folder: Path, rng: np.random.Generator, advance: Callable[[float], None]) -> None:
        self.folder, self._rng, self._advance = folder, rng, advance
        self.fault: DiskFault | None = None
        self.labels: list[str] = []
        self.acted = ""
        self.dead = False
        self._after_death: dict[str, bytes] | None = None
        self._synced: dict[str, bytes] = {}
        self._renamed: list[tuple[str, str, bytes | None]] = []
        self._uncertain: dict[str, bytes] = {}

    def begin(self, fault: DiskFault | None) -> None:
        """Begin a command; all earlier writes have reached the disk meanwhile."""
        self.fault, self.labels, self.acted, self.dead, self._after_death = fault, [], "", False, None
        self.rest()

    def end(self) -> None:
        """After a kill or a cut, give the folder the content that the next program finds."""
        if self._after_death is None:
            return
        self._put(self._after_death)
        self._after_death = None
        if self.fault is not None and self.fault.kind == "cut":
            self.rest()

    def lose_power(self) -> None:
        """Lose the power right after a command: what it has not flushed is uncertain."""
        self._put(self._after_cut(self._files(), {}))
        self.rest()

    def rest(self) -> None:
        """All that was written reaches the disk."""
        self._synced, self._renamed, self._uncertain = self._files(), [], {}

    def _put(self, files: dict[str, bytes]) -> None:
        for path in self.folder.iterdir():
            path.unlink()
        for name, content in files.items():
            (self.folder / name).write_bytes(content)

    def die(self, *, cut: bool = False, torn: dict[str, bytes] | None = None) -> None:
        """End the program here; `torn` are files in the middle of an operation."""
        files = self._files() | (torn or {})
        if cut:
            files = self._after_cut(files, torn or {})
        self._after_death, self.dead = files, True
        raise Killed

    def _files(self) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in sorted(self.folder.iterdir()) if path.is_file()}

    def _after_cut(self, files: dict[str, bytes], torn: dict[str, bytes]) -> dict[str, bytes]:
        """Content of the files after a power cut: data and names that were not synced are uncertain."""
        for name, content in self._uncertain.items():
            if self._rng.random() < 0.5:
                files[name] = content
        for name in sorted(files):
            databases = name.endswith((".session", "-journal")) or name in torn
            if databases or files[name] == self._synced.get(name):
                continue
            files[name] = files[name][: int(self._rng.integers(len(files[name]) + 1))]
        for source, name, before in reversed(self._renamed):
            if self._rng.random() < 0.5:
                continue
            content = files.pop(name, None)
            if before is not None:
                files[name] = before
            if content is not None:
                files.setdefault(source, content)
        return files

    # -- operations ------------------------------------------------------------------------------------

    def operate(self, label: str, act: Callable[[], Any], path: Path | None = None, *, writes: bool) -> Any:
        """Carry out an operation of the program, unless the fault forbids it."""
        if self.dead:
            raise Killed
        self.labels.append(label)
        number, fault = len(self.labels), self.fault
        takes_time = label in TEARING
        ends = fault is not None and fault.kind in ("kill", "cut")
        within = ends and fault is not None and fault.side == "within"
        due = fault is not None and (
            number == fault.operation if not within else number >= fault.operation and takes_time
        )
        if due:
            self.acted = label
        if fault is not None and number >= fault.operation:
            if fault.kind in FAILURES and writes:
                self.acted = self.acted or label
                self._fail(fault.kind, label, path)
            if fault.kind == "slow" and number < fault.operation + SLOW_OPERATIONS:
                self._advance(SLOW_S)
        ends &= due
        if ends and fault is not None and fault.side == "before":
            self.die(cut=fault.kind == "cut")
        before = self._files() if ends and within else {}
        result = act()
        if ends and fault is not None:
            torn = self._torn(before, self._files()) if within else None
            self.die(cut=fault.kind == "cut", torn=torn)
        if due and fault is not None and fault.kind == "interrupt":
            press_ctrl_c()
        return result

    def _fail(self, kind: str, label: str, path: Path | None) -> None:
        name, text, number = FAILURES[kind]
        if path is not None and path.suffix != ".session":
            raise OSError(number, os.strerror(number), str(path))
        if label.startswith(("create ", "open ", "rename ", "replace ")):
            raise OSError(number, os.strerror(number), str(path))
        error = sqlite3.OperationalError(text)
        error.sqlite_errorname = name
        raise error

    def _torn(self, before: dict[str, bytes], after: dict[str, bytes]) -> dict[str, bytes]:
        """Files in the middle of the operation that made `after` of `before`."""
        torn: dict[str, bytes] = {}
        for name, content in after.items():
            old = before.get(name, b"")
            if content == old or name.endswith("-journal"):
                continue
            if name.endswith(".session"):
                torn |= self._torn_commit(name, old, content)
            else:
                torn[name] = content[: int(self._rng.integers(len(content) + 1))]
        return torn

    def _torn_commit(self, name: str, old: bytes, new: bytes) -> dict[str, bytes]:
        """Database and rollback journal in the middle of a commit."""
        size = struct.unpack(">H", new[16:18])[0] or 4096
        pages = [new[k : k + size] for k in range(0, len(new), size)]
        olds = [old[k : k + size] for k in range(0, len(old), size)]
        changed = [k for k, page in enumerate(olds) if k >= len(pages) or page != pages[k]]
        journal = rollback_journal({k + 1: olds[k] for k in changed}, len(olds), size)
        if not old or self._rng.random() < 0.3:  # before the journal was synced the database is untouched
            cut = int(self._rng.integers(len(journal) + 1)) if old else 0
            return {name: old, f"{name}-journal": journal[:cut]}
        mixed = [
            page if self._rng.random() < 0.5 else (olds[k] if k < len(olds) else bytes(size))
            for k, page in enumerate(pages)
        ]
        return {name: b"".join(mixed), f"{name}-journal": journal}

    # -- hooks ------------------------------------------------------------------------------------------

    @contextmanager
    def hooked(self) -> Iterator[None]:
        """Let statements and file calls of the program be operations of this disk."""
        with ExitStack() as stack:
            replace = stack.enter_context
            connect = sqlite3.connect

            def connected(database: str, *args: Any, **options: Any) -> sqlite3.Connection:
                if database == ":memory:":
                    return connect(database, *args, **options)
                if self.dead:
                    raise Killed
                connection = connect(database, *args, **options, factory=_Connection)
                connection.disk = self
                return connection

            replace(mock.patch.object(sqlite3, "connect", connected))
            for name in ("replace", "rename", "unlink", "remove"):
                replace(mock.patch.object(os, name, self._hook(name, getattr(os, name))))
            replace(mock.patch.object(os, "fsync", self._hooked_fsync(os.fsync)))
            replace(mock.patch.object(os, "open", self._hooked_open(os.open)))
            replace(mock.patch.object(Path, "write_bytes", self._hooked_write(Path.write_bytes)))
            replace(mock.patch.object(Path, "touch", self._hooked_touch(Path.touch)))
            yield

    def _own(self, path: Any) -> Path | None:
        """A path inside the folder; None for any other."""
        try:
            whole = Path(os.fsdecode(path)).absolute()
        except TypeError:
            return None
        return whole if whole.parent == self.folder else None

    def _hook(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def hooked(path: Any, *rest: Any, **options: Any) -> Any:
            own = self._own(path)
            if own is None:
                return real(path, *rest, **options)
            target = self._own(rest[0]) if rest else None
            before = target.read_bytes() if target is not None and target.exists() else None
            content = self._synced.get(own.name)

            def act() -> None:
                real(path, *rest, **options)
                if target is not None:
                    self._renamed.append((own.name, target.name, before))
                    self._synced.pop(target.name, None)
                    if content is not None:
                        self._synced[target.name] = content

            return self.operate(
                f"{name} {own.name.partition('.part-')[2] or own.name}", act, own, writes=True
            )

        return hooked

    def _hooked_fsync(self, real: Callable[[int], None]) -> Callable[[int], None]:
        def hooked(number: int) -> None:
            path = Path(f"/proc/self/fd/{number}").readlink()
            own = self._own(path)
            if path == self.folder.resolve():
                self._renamed = []  # names are on the disk

            def act() -> None:
                real(number)
                if own is not None:
                    self._synced[own.name] = own.read_bytes()

            if own is None:
                act()
            else:
                self.operate("fsync", act, own, writes=True)

        return hooked

    def _hooked_open(self, real: Callable[..., int]) -> Callable[..., int]:
        def hooked(path: Any, flags: int, *rest: Any, **options: Any) -> int:
            own = self._own(path) if flags & os.O_CREAT else None
            if own is None:
                return real(path, flags, *rest, **options)
            return self.operate(
                "create file", lambda: real(path, flags, *rest, **options), own, writes=True
            )

        return hooked

    def _hooked_write(self, real: Callable[..., int]) -> Callable[..., int]:
        def hooked(path: Path, data: bytes) -> int:
            own = self._own(path)
            if own is None:
                return real(path, data)

            def act() -> int:
                self._synced.pop(own.name, None)
                return real(path, data)

            return self.operate("write file", act, own, writes=True)

        return hooked

    def _hooked_touch(self, real: Callable[..., None]) -> Callable[..., None]:
        def hooked(path: Path, *rest: Any, **options: Any) -> None:
            own = self._own(path)
            if own is None:
                return real(path, *rest, **options)
            return self.operate("create session", lambda: real(path, *rest, **options), own, writes=True)

        return hooked

    def committed(self, path: str, before: bytes, synchronous: int) -> None:
        """Note what a power cut may make of a commit, by the setting `synchronous` of its connection."""
        name = Path(path).name
        if synchronous >= 3:
            self._uncertain.pop(name, None)
            self._renamed = []
        elif synchronous == 2:
            self._uncertain[name] = before
        else:
            self._uncertain.setdefault(name, before)


class _Connection(sqlite3.Connection):
    """A connection that reports its statements to the disk."""

    disk: Disk

    def execute(self, sql: str, parameters: Any = (), /) -> sqlite3.Cursor:
        disk = self.disk
        words = " ".join(sql.split())
        if words.startswith(("SELECT", "PRAGMA quick_check", "PRAGMA user_version", "PRAGMA trusted")):
            if disk.dead:
                raise Killed
            return super().execute(sql, parameters)
        run = super().execute
        if words == "COMMIT":
            return disk.operate("COMMIT", lambda: self._commit(run), writes=True)
        words = words.partition(" VALUES")[0].partition(" (")[0]
        return disk.operate(words, lambda: run(sql, parameters), writes=words.startswith(WRITING))

    def _commit(self, run: Callable[..., sqlite3.Cursor]) -> sqlite3.Cursor:
        (_, _, path) = run("PRAGMA database_list").fetchone()
        (level,) = run("PRAGMA synchronous").fetchone()
        before = Path(path).read_bytes()
        cursor = run("COMMIT")
        self.disk.committed(path, before, level)
        return cursor


def rollback_journal(pages: dict[int, bytes], database_pages: int, page_bytes: int) -> bytes:
    """Return a synced rollback journal with the original pages, by the file format of SQLite.

    Parameters
    ----------
    pages : dict of int to bytes
        Original content by page number, from 1.
    database_pages : int
        Pages of the database before the transaction.
    """
    nonce = 0x5EED
    head = struct.pack(">8sIIIII", _MAGIC, len(pages), nonce, database_pages, _SECTOR, page_bytes)
    journal = head.ljust(_SECTOR, b"\0")
    for number, page in pages.items():
        sum_ = nonce + sum(page[k] for k in range(page_bytes - 200, 0, -200))
        journal += struct.pack(">I", number) + page + struct.pack(">I", sum_ & 0xFFFFFFFF)
    return journal
