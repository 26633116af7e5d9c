"""Results as they come, one line of JSON each: what was done is never done again.

The file is only added to. A last line that was torn by a crash or a full disk is cut off when the journal
is opened again; whatever else is not a journal is refused and left as it is.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from adis_gonio.base.errors import DataError, OutputError, SessionError
from adis_gonio.base.jsonable import finite
from adis_gonio.base.numbers import counted
from adis_gonio.fleet.work import Document

_HEAD = b'{"adis_gonio": "fleet journal 1"}\n'


class Journal:
    """Documents by key (`Job.key`), kept on the disk before anybody is told of them.

    Attributes
    ----------
    path : Path
    documents : mapping of str to Document
        What it held when it was opened, and what was kept since.

    Raises
    ------
    OutputError
        It cannot be read or written.
    DataError
        The file is something else.
    SessionError
        Another run is writing to it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.documents: dict[str, Document] = {}
        try:
            self._file = self.path.open("a+b")
        except OSError as error:
            raise self._unwritten(error) from error
        try:
            self._lock()
            self._end = self._read()
            self._file.truncate(self._end)
        except OSError as error:
            self._file.close()
            raise self._unwritten(error) from error
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def keep(self, key: str, document: Document) -> None:
        """Add a result; it is on the disk when this returns.

        Raises
        ------
        OutputError
            It could not be: the journal is what it was before.
        """
        line = json.dumps({"key": key, "document": finite(document)}, ensure_ascii=False, allow_nan=False)
        self._append((_HEAD if self._end == 0 else b"") + line.encode() + b"\n")
        self.documents[key] = document

    def _append(self, data: bytes) -> None:
        try:
            # Unbuffered: what a full disk refused must not come out when the file is closed.
            _write_whole(self._file.fileno(), data)
            os.fsync(self._file.fileno())
        except OSError as error:
            self._cut()
            raise self._unwritten(error) from error
        self._end += len(data)

    def _cut(self) -> None:
        with suppress(OSError):  # else the torn line is cut off when the journal is opened again
            self._file.truncate(self._end)

    def _read(self) -> int:
        """Take in what is there; the length (bytes) of its whole lines."""
        self._file.seek(0)
        head = self._file.readline()
        if head != _HEAD:
            if _HEAD.startswith(head):  # empty, or torn within its first line
                return 0
            raise DataError(f"{self.path}: is no journal of fleet; name another file with --journal")
        end = len(head)
        for number, line in enumerate(self._file, 2):
            entry = _entry(line)
            if entry is None:
                if not line.endswith(b"\n"):
                    break
                raise DataError(
                    f"{self.path}: line {number} is damaged; remove it, and its session is done again"
                )
            self.documents[entry[0]] = entry[1]
            end += len(line)
        return end

    def _lock(self) -> None:
        try:
            import fcntl
        except ImportError:  # Windows: two runs at once are the operator's affair
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise SessionError(
                f"{self.path}: another run is writing to it; wait for its end, or name another by --journal"
            ) from error

    def _unwritten(self, error: OSError) -> OutputError:
        held = f"; it holds {counted(len(self.documents), 'session')}" if self.documents else ""
        return OutputError(
            f"{self.path}: cannot be written: {error.strerror or error}{held}:"
            " make room, and the same command goes on from there"
        )


def _write_whole(descriptor: int, data: bytes) -> None:
    while data:
        data = data[os.write(descriptor, data) :]


def _entry(line: bytes) -> tuple[str, Document] | None:
    if not line.endswith(b"\n"):
        return None
    try:
        held: Any = json.loads(line)
        return str(held["key"]), dict(held["document"])
    except (ValueError, KeyError, TypeError):
        return None
