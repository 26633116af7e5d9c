"""Known defects of the past, put back one by one: what the bench has to find.

Each is a replacement of one function, as the package once was or would be without the mended mechanism.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from adis_gonio.base import output
from adis_gonio.bench import dwell_recorder, runner
from adis_gonio.bench.session_bench import SessionBench
from adis_gonio.bench.writeback import offset_writer
from adis_gonio.device.bus.contract import SpiBus
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.faces.cli import calibrate_command
from adis_gonio.record import archive, archive_tables
from adis_gonio.record.source import ChipSource


@dataclass(frozen=True)
class Defect:
    """A defect: what the program did, and the attribute that is replaced.

    Attributes
    ----------
    more : tuple of (target, name, new)
        Further protections against the same harm, which back the first one up.
    """

    text: str
    target: Any
    name: str
    new: Any
    more: tuple[tuple[Any, str, Any], ...] = ()


def _set_aside(path: Path) -> Path:
    return path.rename(path.with_name(f"{path.stem}.1{path.suffix}"))


def _not_durable(connection: sqlite3.Connection) -> None:
    connection.execute("PRAGMA journal_mode = DELETE")
    connection.execute("PRAGMA synchronous = OFF")


def _connect_strictly(path: Path, *, write: bool) -> sqlite3.Connection:
    """Without the second try that rolls back the journal of a killed writer."""
    connection = archive._open(path, "rw" if write else "ro")
    with archive.translated_errors(path):
        archive._check_content(path, connection)
        if write:
            archive.make_durable(connection)
    return connection


@contextmanager
def _in_place(path: str | Path) -> Iterator[Path]:
    yield Path(path)


def _restored_nothing(self: Any, journal: Any, why: str) -> None:
    """An interrupted write leaves the registers as they are."""


def _late_note(self: Any, step: Any, **facts: Any) -> None:
    """The journal is written at the end of a write only."""
    waiting = self.__dict__.setdefault("waiting", [])
    waiting.append((step, facts))
    self.operation = offset_writer.replace(self.operation, steps=(*self.steps, step))
    if step is offset_writer.WriteStep.DONE:
        for one, known in waiting:
            _NOTE(self, one, **known)


_NOTE = offset_writer.Logbook.note


def _unchecked(self: SpiBus, replies: Any, count: int) -> Any:
    return replies


def _rows_only(self: archive.Archive, attempt: Any) -> int:
    """The row of a dwell is written without its samples."""
    return _ADD(self, archive.replace(attempt, blocks=[]))


_ADD = archive.Archive.add_attempt


def _forgetful_recording(self: Any, recording: Any, rested_mg: Any) -> Any:
    broken = yield from self._record(recording, rested_mg)
    if broken is None:
        self._check_sensor(recording)
    return broken


def _always_explained(self: Any, now: Any) -> None:
    """Any numbers in the registers are taken for those of the session."""


def _status_without_doubts(session: Any, *, complete: bool) -> int:
    return 0


def _kept_loan(self: ChipSource) -> None:
    self._loan = self._marked = None


def _reported_saved(*args: Any, **options: Any) -> Any:
    held = _HELD(*args, **options)
    return offset_writer.replace(held, saved=True) if held.registers == "new" else held


_HELD = offset_writer.held_offsets


def _pool_interrupted(self: archive.ArchiveView) -> list[Any]:
    """Interrupted dwells count like complete ones."""
    latest = {a.place: a.number for a in self.attempts() if a.blocks}
    return [a for a in self.attempts() if a.number in latest.values()]


def _update_rows(self: archive.Archive, kind: str, value: Any, bus_s: float) -> None:
    """A record of a kind replaces the earlier one."""
    with self._transaction():
        names = self._connection.execute(
            "SELECT name FROM sqlite_master WHERE type = 'trigger' AND tbl_name = 'records'"
        ).fetchall()
        for (name,) in names:
            self._connection.execute(f"DROP TRIGGER {name}")
        self._connection.execute("DELETE FROM records WHERE kind = ?", (kind,))
        self._record(kind, value, bus_s)


def _values_unchecked(table: str, row: Any, where: str) -> dict[str, Any]:
    """The checksum of a row is taken for the proof that its values are sound."""
    pairs = zip(archive_tables.TABLES[table], row, strict=True)
    return {column.name: json.loads(value) if column.json else value for column, value in pairs}


DEFECTS: dict[str, Defect] = {
    "restart": Defect(
        "a restart or a changed register between two dwells is not noticed",
        SessionBench, "settings_lost", lambda self: "",
    ),
    "no mark": Defect(
        "a restart that changes no other register is not noticed",
        ChipSource, "mark_restart", lambda self: None
    ),
    "mark left": Defect(
        "the mark of a killed session stays in the alarm level",
        Adis16354, "forget_mark", lambda self: None
    ),
    "loan kept": Defect(
        "a session leaves its mark and data-ready in the registers", ChipSource, "give_back", _kept_loan
    ),
    "self-test": Defect(
        "a session runs while the manual self-test shifts all readings",
        ChipSource, "refuse_self_test", lambda self: None,
    ),
    "other settings": Defect(
        "a resumed session does not compare the registers with those before",
        SessionBench, "require_same_settings", lambda self, archive, now: None,
    ),
    "short replies": Defect(
        "the replies of a bus are not counted", SpiBus, "_checked", _unchecked
    ),
    "not durable": Defect(
        "a dwell is announced before it is on the disk", archive, "make_durable", _not_durable
    ),
    "hot journal": Defect(
        "the journal of a killed program makes the file unreadable",
        archive, "connect", _connect_strictly
    ),
    "journal orphaned": Defect(
        "a session set aside loses its journal", archive, "set_aside", _set_aside
    ),
    "samples lost": Defect(
        "the row of a dwell is written without its samples",
        archive.Archive, "add_attempt", _rows_only
    ),
    "interruption lost": Defect(
        "the scans of a dwell that a bus error ends are not kept",
        dwell_recorder.DwellRecorder, "_record_or_keep", _forgetful_recording,
    ),
    "interrupted counts": Defect(
        "interrupted dwells count like complete ones", archive.ArchiveView, "dwells", _pool_interrupted
    ),
    "half a report": Defect(
        "a report is written in place, so that a power cut leaves a half", output, "replacing", _in_place
    ),
    "no fsync": Defect(
        "a report is renamed before it is on the disk", output, "_flushed", lambda path: None
    ),
    "late journal": Defect(
        "the journal of a write is written at its end", offset_writer.Logbook, "note", _late_note
    ),
    "not set back": Defect(
        "an interrupted write leaves the new numbers without a word",
        offset_writer.OffsetWriter, "_restore", _restored_nothing,
    ),
    "said saved": Defect(
        "numbers are said to be saved that are only in the registers",
        offset_writer, "held_offsets", _reported_saved,
    ),
    "unexplained": Defect(
        "offsets are written although the registers hold unexplained numbers",
        offset_writer.OffsetWriter, "_require_explained", _always_explained,
    ),
    "doubts unsaid": Defect(
        "an incomplete or doubtful session ends with status 0",
        calibrate_command, "_status", _status_without_doubts
    ),
    "no guards": Defect(
        "a part that was not moved, or moved the wrong way, is not noticed",
        runner.SessionRunner, "judges_places", False,
    ),
    "records replaced": Defect(
        "a record replaces the earlier one of its kind", archive.Archive, "add_record", _update_rows
    ),
    "endless wait": Defect(
        "a part that never comes to rest is waited for without end",
        dwell_recorder, "WINDOWS_TO_STILLNESS", math.inf,
    ),
    "forged values": Defect(
        "a value with a fitting checksum is taken without a check of its type and range",
        archive, "checked_row", _values_unchecked,
        (
            (archive, "checked_value", lambda name, shape, value: value),
            (archive.ArchiveView, "_refuse_strangers", lambda self, stored: None),
        ),
    ),
    "forged schema": Defect(
        "a session file may hold other tables, views and triggers",
        archive, "_refuse_other_objects", lambda path, connection: None,
    ),
}  # fmt: skip
"""Defects by a short name."""


@contextmanager
def put_back(name: str) -> Iterator[None]:
    """Let the package have a defect."""
    one = DEFECTS[name]
    with ExitStack() as stack:
        for target, attribute, new in ((one.target, one.name, one.new), *one.more):
            stack.enter_context(mock.patch.object(target, attribute, new))
        yield
