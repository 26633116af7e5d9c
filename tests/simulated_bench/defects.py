"""Known defects of the past, put back one by one: what the bench has to find.

Each is a replacement of one function, as the package once was or would be without the mended mechanism.
`Watch` notes without any defect in which commands of a story the replacement could have had an effect: a
defect needs to be played only in stories that reach it.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import wraps
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest import mock

import numpy as np

from adis_gonio.base import output
from adis_gonio.bench import dwell_recorder
from adis_gonio.bench.session_bench import SessionBench
from adis_gonio.bench.writeback import offset_writer
from adis_gonio.device.bus.contract import SpiBus
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.faces.cli import calibrate_command
from adis_gonio.faces.serve import iio_device
from adis_gonio.record import archive, archive_tables
from adis_gonio.record.source import ChipSource
from simulated_bench.stories import AFRESH, CALIBRATE, OUTAGE

if TYPE_CHECKING:
    from simulated_bench.bench import Ended
    from simulated_bench.stories import Play, Step, Story


SESSIONS = (CALIBRATE, AFRESH)
REPORTS = ("export", "bringup")
WRITES = ("write", "write --save", "undo")
LONG_S = 20.0
"""Time in s after which a program that waits for rest gives up, or less."""


@dataclass(frozen=True)
class Look:
    """A command without defects that has just ended.

    Attributes
    ----------
    fired : set of str
        Defects whose function was called and did there what its replacement does not do.
    """

    fired: set[str]
    play: Play
    step: Step
    ended: Ended

    @property
    def failed(self) -> bool:
        """True if the command was killed or did not end with status 0."""
        return self.ended.how != "exit" or self.ended.status != 0

    @property
    def cut(self) -> bool:
        """True if the computer lost its power in a command like this or right after it."""
        return self.ended.how == "cut" or self.step in _before_outages(self.play.story)

    @property
    def forged(self) -> bool:
        """True if a stranger changes the session file in this story."""
        return _is_forged(self.play.story)

    @property
    def shaken(self) -> bool:
        """True if the part did not come to rest for long, as the program says or the story."""
        long = any(fault.kind == "shake" and fault.size >= LONG_S for fault in self.step.line)
        return long or "not still within" in self.ended.err

    @property
    def clumsy(self) -> bool:
        """True if the operator makes mistakes, or a guard has objected."""
        return (
            self.play.story.only != "none" or self.play.bench.operator.guards > 0 or self.ended.status == 1
        )


def _writes(story: Story) -> bool:
    return any(step.command in WRITES for step in story.steps)


def _dies(story: Story) -> bool:
    """True if the program is killed or the power is cut."""
    return any(
        (step.disk is not None and step.disk.kind in ("kill", "cut")) or _has(step, "kill")
        for step in story.steps
    )


def _before_outages(story: Story) -> list[Step]:
    """Steps right after which the power fails."""
    return [one for one, after in pairwise(story.steps) if after.command == OUTAGE]


def _is_cut(story: Story, *commands: str) -> bool:
    """True if the computer loses its power in or right after a command, or one of some commands."""
    within = [step for step in story.steps if step.disk is not None and step.disk.kind == "cut"]
    return any(not commands or step.command in commands for step in (*within, *_before_outages(story)))


def _is_cut_again(story: Story) -> bool:
    """True if the computer loses its power in a session after another."""
    later = [step for step in story.steps if step.command in SESSIONS][1:]
    return _is_cut(replace(story, steps=tuple(later)))


def _begins_after_death(story: Story) -> bool:
    """True if a session may begin afresh after the program died."""
    deaths = [k for k, step in enumerate(story.steps) if step.crashes]
    again = [k for k, step in enumerate(story.steps) if step.command == AFRESH]
    return bool(deaths) and (bool(again and again[-1] > deaths[0]) or _is_forged(story))


def _fails(story: Story) -> bool:
    return story.only != "none" or any(step.faults for step in story.steps)


def _is_forged(story: Story) -> bool:
    return any(step.command.startswith("forged") for step in story.steps)


def _has(step: Step, *kinds: str) -> bool:
    return any(fault.kind in kinds for fault in step.line)


def _always(result: Any, error: BaseException | None, args: tuple[Any, ...]) -> bool:
    return True


def _objects(result: Any, error: BaseException | None, args: tuple[Any, ...]) -> bool:
    return isinstance(error, Exception)


def _speaks(result: Any, error: BaseException | None, args: tuple[Any, ...]) -> bool:
    return error is not None or bool(result)


@dataclass(frozen=True)
class Defect:
    """A defect: what the program did, and the attribute that is replaced.

    Attributes
    ----------
    more : tuple of (target, name, new)
        Further protections against the same harm, which back the first one up.
    differs : callable or None
        Gets result, error and arguments of a call of a sound function; False if the replacement would
        have done the same. None: calls are not watched.
    place : tuple of (target, name) or None
        The function that is watched in the place of the replaced ones.
    reached : callable
        Gets a `Look`; False if the replacement has no effect in such a command.
    needs : callable
        Gets a `Story`; False if the replacement can have no effect in it, which need not be played then.
    """

    text: str
    target: Any
    name: str
    new: Any
    more: tuple[tuple[Any, str, Any], ...] = ()
    differs: Callable[[Any, BaseException | None, tuple[Any, ...]], bool] | None = _always
    place: tuple[Any, str] | None = None
    reached: Callable[[Look], bool] = lambda look: True
    needs: Callable[[Story], bool] = lambda story: True


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
    self.operation = offset_writer.replace(self.operation, steps=(*self.operation.steps, step))
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


def _forgetful_recording(self: Any, recording: Any) -> Any:
    broken = yield from self._scan(recording)
    if broken is None:
        recording.status, recording.settings_lost = self._check_sensor()
        self._bench.checkpoint()
    return broken


def _take_by_old_noise(self: Any, place: int) -> Any:
    limits = self._knowledge.limits
    yield from _TAKE(self, place)
    self._knowledge.limits = limits


_TAKE = dwell_recorder.DwellRecorder.take


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
    latest = {a.place: a.number for a in self.attempts() if a.stored_blocks}
    return [a for a in self.attempts() if a.number in latest.values()]


def _pools(result: Any, error: BaseException | None, args: tuple[Any, ...]) -> bool:
    """True if interrupted dwells would count."""
    return error is not None or [a.number for a in result] != [a.number for a in _pool_interrupted(*args)]


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


def _published(self: iio_device.Sampler, block: Any, since_1970_ns: int) -> None:
    """A scan is not compared with SENS_AVG."""
    numbers = block.numbers()[:, 1:-1]
    self.newest = dict(zip(iio_device.DEFAULT_SCAN, numbers[-1].tolist(), strict=True))
    time_ns = np.rint(block.time_s * 1e9).astype(np.int64) + since_1970_ns
    self._on_scans(numbers, time_ns)


DEFECTS: dict[str, Defect] = {
    "restart": Defect(
        "a restart or a changed register between two dwells is not noticed",
        SessionBench, "settings_lost", lambda self: "",
        differs=_speaks,
    ),
    "no mark": Defect(
        "a restart that changes no other register is not noticed",
        ChipSource, "mark_restart", lambda self: None,
        reached=lambda look: "restart" in look.fired,
    ),
    "mark left": Defect(
        "the mark of a killed session stays in the alarm level",
        Adis16354, "forget_mark", lambda self: None,
        reached=lambda look: any(e.how != "exit" or e.status for e in look.play.outcome.ended),
    ),
    "loan kept": Defect(
        "a session leaves its mark and data-ready in the registers", ChipSource, "give_back", _kept_loan
    ),
    "self-test": Defect(
        "a session runs while the manual self-test shifts all readings",
        ChipSource, "refuse_self_test", lambda self: None,
        more=((Adis16354, "_check_variant", lambda self, found: None),),
        differs=_speaks,
        needs=lambda story: any(s.command == "self-test on" or _has(s, "control") for s in story.steps),
    ),
    "other settings": Defect(
        "a resumed session does not compare the registers with those before",
        SessionBench, "require_same_settings", lambda self, archive, now: None,
        differs=_speaks,
    ),
    "short replies": Defect(
        "the replies of a bus are not counted", SpiBus, "_checked", _unchecked,
        differs=_objects,
        needs=lambda story: any(_has(step, "short") for step in story.steps),
    ),
    "not durable": Defect(
        "a dwell is announced before it is on the disk", archive, "make_durable", _not_durable,
        reached=lambda look: look.cut,
        needs=_is_cut,
    ),
    "hot journal": Defect(
        "the journal of a killed program makes the file unreadable",
        archive, "connect", _connect_strictly,
        reached=lambda look: look.play.journal or look.forged,
        needs=lambda story: _dies(story) or _is_forged(story),
    ),
    "journal orphaned": Defect(
        "a session set aside loses its journal", archive, "set_aside", _set_aside,
        reached=lambda look: look.play.journal, needs=_begins_after_death,
    ),
    "aside forgotten": Defect(
        "a power cut undoes the renaming of a session set aside, after the next one has begun",
        archive, "flush_names", lambda folder: None,
        reached=lambda look: look.cut,
        needs=_is_cut_again,
    ),
    "samples lost": Defect(
        "the row of a dwell is written without its samples",
        archive.Archive, "add_attempt", _rows_only
    ),
    "interruption lost": Defect(
        "the scans of a dwell that a bus error ends are not kept",
        dwell_recorder.DwellRecorder, "_record", _forgetful_recording,
        place=(dwell_recorder.DwellRecorder, "_interrupted"),
        needs=_fails,
    ),
    "interrupted counts": Defect(
        "interrupted dwells count like complete ones", archive.ArchiveView, "dwells", _pool_interrupted,
        differs=_pools,
        needs=_fails,
    ),
    "half a report": Defect(
        "a report is written in place, so that a power cut leaves a half", output, "replacing", _in_place,
        reached=lambda look: look.step.faults > 0 or look.cut,
        needs=lambda story: _is_cut(story, *REPORTS)
        or any(step.faults and step.command in REPORTS for step in story.steps),
    ),
    "no fsync": Defect(
        "a report is renamed before it is on the disk", output, "_flushed", lambda path: None,
        reached=lambda look: look.cut,
        needs=lambda story: _is_cut(story, *REPORTS),
    ),
    "late journal": Defect(
        "the journal of a write is written at its end", offset_writer.Logbook, "note", _late_note,
        reached=lambda look: look.failed or look.step.faults > 0,
        needs=_writes,
    ),
    "not set back": Defect(
        "an interrupted write leaves the new numbers without a word",
        offset_writer.OffsetWriter, "_restore", _restored_nothing,
        needs=lambda story: any(step.faults and step.command in WRITES for step in story.steps),
    ),
    "said saved": Defect(
        "numbers are said to be saved that are only in the registers",
        offset_writer, "held_offsets", _reported_saved,
        differs=lambda result, error, args: error is None and result.registers == "new",
        needs=_writes,
    ),
    "unexplained": Defect(
        "offsets are written although the registers hold unexplained numbers",
        offset_writer.OffsetWriter, "_require_explained", _always_explained,
        differs=_speaks,
        needs=_writes,
    ),
    "doubts unsaid": Defect(
        "an incomplete or doubtful session ends with status 0",
        calibrate_command, "_status", _status_without_doubts,
        differs=_speaks,
        needs=_fails,
    ),
    "no guards": Defect(
        "a part that was not moved, or moved the wrong way, is not noticed",
        dwell_recorder.DwellRecorder, "judges_places", False,
        differs=None, reached=lambda look: look.clumsy,
        needs=_fails,
    ),
    "records replaced": Defect(
        "a record replaces the earlier one of its kind", archive.Archive, "add_record", _update_rows
    ),
    "endless wait": Defect(
        "a part that never comes to rest is waited for without end",
        dwell_recorder, "WINDOWS_TO_STILLNESS", math.inf,
        differs=None, reached=lambda look: look.shaken,
        needs=lambda story: story.only != "none" or any(_has(step, "shake") for step in story.steps),
    ),
    "old noise": Defect(
        "a session keeps its first noise if the sensor no longer comes to rest by it",
        dwell_recorder.DwellRecorder, "take", _take_by_old_noise,
        differs=None, reached=lambda look: "no dwell was possible" in look.ended.err,
        needs=lambda story: not story.motor
        and (story.only != "none" or any(step.line and step.command in SESSIONS for step in story.steps)),
    ),
    "forged values": Defect(
        "a value with a fitting checksum is taken without a check of its type and range",
        archive_tables, "checked_row", _values_unchecked,
        (
            (archive_tables, "checked_value", lambda name, shape, value: value),
            (archive, "checked_value", lambda name, shape, value: value),
            (archive.ArchiveView, "_refuse_strangers", lambda self, stored: None),
        ),
        differs=_objects,
        needs=_is_forged,
    ),
    "forged schema": Defect(
        "a session file may hold other tables, views and triggers",
        archive, "_refuse_other_objects", lambda path, connection: None,
        differs=_objects,
        needs=_is_forged,
    ),
    "dead line served": Defect(
        "serve publishes words of a dead line, and fails with a traceback if no scan of a block is new",
        iio_device.Sampler, "_publish", _published, reached=lambda look: bool(look.step.line),
        needs=lambda story: any(s.command == "serve" and s.line for s in story.steps),
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


class Watch:
    """Notes while it is entered which defects a story reaches, without putting any back."""

    def __init__(self) -> None:
        self.reached: set[str] = set()
        self._fired: set[str] = set()

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Observe the functions that the defects replace."""
        with ExitStack() as stack:
            for name, one in DEFECTS.items():
                replaced = [(one.target, one.name), *((target, name) for target, name, _ in one.more)]
                for target, attribute in replaced if one.place is None else [one.place]:
                    if one.differs is not None:
                        observed = self._observed(name, getattr(target, attribute), one.differs)
                        stack.enter_context(mock.patch.object(target, attribute, observed))
            yield

    def ended(self, play: Play, step: Step, ended: Ended) -> None:
        """Judge a command that has ended."""
        look, self._fired = Look(self._fired, play, step, ended), set()
        for name, one in DEFECTS.items():
            if (one.differs is None or name in look.fired) and one.reached(look):
                self.reached.add(name)

    def _observed(self, name: str, sound: Callable[..., Any], differs: Callable[..., bool]) -> Any:
        @wraps(sound)
        def observed(*args: Any, **options: Any) -> Any:
            try:
                result = sound(*args, **options)
            except BaseException as error:
                if differs(None, error, args):
                    self._fired.add(name)
                raise
            if name not in self._fired and differs(result, None, args):
                self._fired.add(name)
            return result

        return observed
