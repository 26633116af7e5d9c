"""What has to hold after every command at the bench, whatever went wrong: the one list is `INVARIANTS`."""

from __future__ import annotations

import json
import os
import re
import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.device.sensor import DEFAULT_SCAN, REGISTERS
from adis_gonio.device.sensor.registers import ACCEL_OFF, BY_NAME, READING_BITS
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.write_journal import Operation, operations
from fakes.faulty_chip import FAULTS
from simulated_bench.bench import BUSY, LATE, NOISE, SHAKE, SHORT, Bench, Ended

if TYPE_CHECKING:
    from simulated_bench.stories import Step, Story

SESSION = "a.session"
LARGEST_FILE = 40_000_000
MOST_GROWTH = 400_000_000
"""Largest growth of the program in bytes over a story: its modules and caches need less than half."""
MOST_FILES = 24
LSB_MG = 0.4672
HONEST = frozenset(
    {"shake", "bump", "unplug", "walk_away", "nonsense", "pause", "note", "quit", "undo", "repeat"}
)
"""Mistakes after which the declared angles still hold."""
FAR = 3.0
"""Units of U beyond which no value of an honest session may be: 6 standard deviations."""
NOTHING = {"1": 1.0, "deg": 60.0}
"""U by unit beyond which an answer says nothing."""
COLDER_C = 0.5
SLACK_S = 0.1
"""Longest time in s between a word of the part and the time of its scan."""
STIMULUS = BY_NAME["MSC_CTRL"].field("positive").mask | BY_NAME["MSC_CTRL"].field("negative").mask
PASSING = frozenset({BUSY, SHORT, LATE, NOISE, SHAKE})
"""Faults that are over at once, so that a command that fails by one of them can still use the line."""
TAMPERING = frozenset(FAULTS) - {"stuck-high", "stuck-low", "dip"}
"""Faults that change registers of the part."""


@dataclass
class Found:
    """What a check found: violations, and the error of each value of an answer in units of its U."""

    wrong: list[str] = field(default_factory=list)
    off: dict[str, float] = field(default_factory=dict)
    lied: bool = False


class Record:
    """What the judge knows from earlier steps.

    Attributes
    ----------
    rows : dict of str to list
        Rows of all tables of the session file after the last step.
    tampered : bool
        A fault has changed registers of the part.
    forged, sound : bool
        A stranger has changed the session file; the program can still read it.
    base, found : tuple of int
        Offsets of the part before any write of the session, and before the present command.
    controls_before : dict of str to int
        Control registers before the present command.
    by_hand : tuple of int or None
        Offsets that somebody wrote by hand during the session.
    """

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.rows: dict[str, list[Any]] = {}
        self.aside: dict[str, list[Any]] = {}
        self.tampered = self.forged = self.sound = False
        self.base = self.found = self.offsets()
        self.by_hand: tuple[int, ...] | None = None
        self.loaned, self.controls_before = self.borrowed(), self.controls()
        self.files, self.memory = _open_files(), _memory_bytes()

    def offsets(self) -> tuple[int, int, int]:
        """Offsets of the accelerometers in the part's registers."""
        memory = self.bench.chip.inner.memory
        return tuple(_signed(memory[name]) for name in ACCEL_OFF)

    def flash(self) -> tuple[int, int, int]:
        """Offsets of the accelerometers in the part's flash."""
        return tuple(_signed(self.bench.chip.inner.memory._flash[name]) for name in ACCEL_OFF)

    def borrowed(self) -> dict[str, int]:
        """Registers that a command borrows and gives back."""
        memory = self.bench.chip.inner.memory
        return {name: memory[name] for name in ("ALM_MAG1", "ALM_MAG2")}

    def controls(self) -> dict[str, int]:
        """All control registers of the part that keep what is written to them."""
        memory = self.bench.chip.inner.memory
        return {row.name: memory[row.name] for row in REGISTERS if row.writable and row.readable}

    def forget(self) -> None:
        """A new session begins in a new file."""
        self.aside, self.rows = self.rows, {}
        self.base, self.forged, self.by_hand = self.offsets(), False, None

    def note_hand(self) -> None:
        """Somebody has tried to write other offsets to the part."""
        if self.readable() and self.offsets() != self.base:
            self.by_hand = self.offsets()
        self.base = self.offsets()

    def note_power(self) -> None:
        """The part has lost its power, and with it numbers that were written by hand and not saved."""
        if not self.written():
            self.base = self.offsets()

    def note_forgery(self) -> None:
        """A stranger has changed the session file: from here on its rows are as they are now."""
        self.rows, self.forged = _rows(self.bench.folder / SESSION), True
        self.sound = not _why_unreadable(self.bench.folder)

    def written(self) -> bool:
        """True if the session has written offsets to the part."""
        return any(row[4] == "offsets" for row in self.rows.get("records", []))

    def readable(self) -> bool:
        """True if the session file holds a session."""
        return "attempts" in self.rows and bool(self.rows["attempts"])


@dataclass(frozen=True)
class Case:
    """A command that has ended, with all that the invariants ask."""

    record: Record
    ended: Ended
    step: Step
    story: Story
    before: dict[str, list[Any]]
    after: dict[str, list[Any]]
    found: Found

    @property
    def bench(self) -> Bench:
        return self.record.bench

    @property
    def document(self) -> dict[str, Any] | None:
        """The JSON that the command printed; None without one."""
        try:
            return json.loads(self.ended.out)
        except ValueError:
            return None

    @property
    def ran(self) -> bool:
        """True if the command came to an exit status."""
        return self.ended.how == "exit"


# -- the list ------------------------------------------------------------------------------------------


def every_failure_is_one_line(case: Case) -> str:
    """No traceback; an exit status of the contract; a failure says something."""
    ended = case.ended
    if ended.how == "traceback" or "Traceback (most recent call last)" in ended.err:
        return f"traceback: {ended.err[-1500:]}"
    if case.ran and ended.status not in (0, 1, 130):
        return f"exit status {ended.status}: {ended.last_line}"
    if case.ran and ended.status == 1 and not ended.last_line and ended.words[0] != "bringup":
        return "a failure without a word"
    return ""


def every_wait_ends(case: Case) -> str:
    """No command waits for ever, and a careful operator is not asked for ever.

    A forged session may ask for a dwell of a year, which Ctrl-C ends.
    """
    if case.record.forged and case.ended.how == "overtime":
        return ""
    return f"{case.ended.how}: {case.ended.last_line}" if case.ended.how in ("overtime", "dead end") else ""


def nothing_recorded_is_lost(case: Case) -> str:
    """Every row of the archive stays as it was, and every dwell that was announced is in it."""
    for table, rows in case.before.items():
        if case.after.get(table, [])[: len(rows)] != rows:
            return f"table {table} had {len(rows)} rows, which are changed or gone"
    if case.ran and case.step.disk is None:
        for table, written in _rows_written(case.bench.disk.labels).items():
            gained = len(case.after.get(table, [])) - len(case.before.get(table, []))
            if gained < written:
                return f"{written} rows of table {table} were written, {gained} are there"
    if case.ended.words[0] != "calibrate":
        return ""
    kept = case.after.get("attempts", [])[len(case.before.get("attempts", [])) :]
    complete = sum(row[6] == "complete" for row in kept)
    announced = len(re.findall(r"^ +x +\S+ +y +\S+ +z +\S+ mg", case.ended.err, re.MULTILINE))
    if announced > complete:
        return f"{announced} dwells were announced, {complete} are in the archive"
    broken = case.ended.err.count("interrupted:")
    if broken > len(kept) - complete:
        return f"{broken} dwells were interrupted, {len(kept) - complete} of them are in the archive"
    return ""


def a_session_set_aside_is_whole(case: Case) -> str:
    """`calibrate --force` keeps the earlier session under another name, with every row."""
    wanted, case.record.aside = case.record.aside, {}
    kept = [_rows(path) for path in case.bench.folder.glob("a*.session")] if wanted else []
    return "" if not wanted or wanted in kept else "the session that was set aside is not whole"


def the_session_can_be_read(case: Case) -> str:
    """The session file is whole after any command, or the program has not begun a session in it."""
    path = case.bench.folder / SESSION
    if case.record.forged and not case.record.sound:
        return ""
    if not path.exists() or not case.after.get("meta"):
        return "the session is gone" if case.before.get("meta") else ""
    why = _why_unreadable(case.bench.folder)
    return f"the session cannot be read: {why}" if why else ""


def no_accepted_word_is_wrong(case: Case) -> str:
    """Each word of a dwell that counts is the word that the chip sent at that time."""
    if case.ended.words[0] != "calibrate" or case.record.forged or not case.after.get("attempts"):
        return ""
    new = len(case.before.get("attempts", []))
    sent = {
        time: row
        for block in case.bench.delivered
        for time, row in zip(block.time_s, block.words, strict=True)
    }
    windows = [w for w in case.bench.chip.windows if w.end_s - w.begin_s > 0.005]
    with _copied(case.bench.folder) as copy, ArchiveView(copy) as view:
        for attempt in view.dwells():
            if attempt.number <= new:
                continue
            for block in view.blocks(attempt, "dwell"):
                for window in windows:
                    inside = (block.time_s >= window.begin_s) & (block.time_s < window.end_s - 0.003)
                    if inside.any():
                        return f"dwell {attempt.number} has {inside.sum()} scans of a dead line ({window})"
                for time, row in zip(block.time_s, block.words, strict=True):
                    if time in sent and len(sent[time]) == len(row) and (sent[time] != row).any():
                        return f"dwell {attempt.number} has other words at {time} s than the bus gave"
    return ""


def dwells_are_measured_alike(case: Case) -> str:
    """All dwells that count have the same settings of the part, and no restart came between them unseen."""
    if case.ended.words[0] != "calibrate" or case.record.forged or not case.after.get("attempts"):
        return ""
    first, restarts = None, {}
    with _copied(case.bench.folder) as copy, ArchiveView(copy) as view:
        for dwell in view.dwells():
            blocks = view.blocks(dwell, "dwell")
            if not blocks:
                return f"dwell {dwell.number} counts without samples"
            for held in case.bench.held_between(blocks[0].time_s[0], blocks[-1].time_s[-1]):
                settings = dict(zip(READING_BITS, held.words, strict=True))
                first = first or settings
                changed = [name for name in settings if settings[name] != first[name]]
                if changed:
                    return f"dwell {dwell.number} has another {changed[0]} than the dwells before"
                if settings["MSC_CTRL"] & STIMULUS:
                    return f"the manual self-test shifted the readings of dwell {dwell.number}"
                if held.restarts != restarts.setdefault(dwell.run, held.restarts):
                    return f"the part restarted before dwell {dwell.number}, and the session went on"
    return ""


def the_last_scans_before_an_error_are_kept(case: Case) -> str:
    """The scans that came before an error ended a session are in the archive."""
    ended, delivered = case.ended, case.bench.delivered
    told_by_itself = case.ran and ended.status != 0 and case.step.disk is None
    if ended.words[0] != "calibrate" or not case.story.motor or not told_by_itself or case.record.forged:
        return ""
    new = case.after.get("attempts", [])[len(case.before.get("attempts", [])) :]
    if not delivered or not any(
        row[6] == "complete" for row in new
    ):  # the scans were for the noise at rest
        return ""
    last_s = delivered[-2:][0].time_s[0]  # the driver may have refused the last block
    with _copied(case.bench.folder) as copy, ArchiveView(copy) as view:
        attempts = view.attempts()[-len(new) :]
        kept = any(block.time_s[-1] >= last_s for a in attempts for block in view.blocks(a))
    return "" if kept else f"the scans from {last_s:.2f} s on are not in the archive"


def every_client_is_answered(case: Case) -> str:
    """A client of `serve` gets an answer to every request, or the end of its connection."""
    if case.ended.how in ("killed", "cut"):
        return ""
    return next((client.complaint for client in case.bench.clients if client.complaint), "")


def clients_get_words_of_the_sensor_only(case: Case) -> str:
    """Each number that a client of `serve` gets is one that the part sent about that time."""
    sent = case.bench.chip.inner.sent
    if case.ended.words[0] != "serve" or not sent:
        return ""
    frames, replies, times = (np.concatenate(one) for one in zip(*sent, strict=True))
    slack_s = SLACK_S + sum(fault.size for fault in case.step.line if fault.kind == LATE)
    numbers: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for name in DEFAULT_SCAN:
        row = BY_NAME[name]
        asked = np.flatnonzero(frames[:-1] >> 8 & 0x3E == row.address)
        content = replies[asked + 1].astype(np.int64) & (1 << row.bits) - 1
        sign = row.signed << row.bits - 1
        numbers[name] = (times[asked], (content ^ sign) - sign)
    for client in case.bench.clients:
        for time_s, name, number in client.raws:
            if not _was_sent(numbers[name], np.array([number]), np.array([time_s]), 1.0 + slack_s).all():
                return f"client {client.number} was told {name} = {number} at {time_s:.3f} s"
        for names, rows, times_s in client.scans:
            for k, name in enumerate(names):
                found = _was_sent(numbers[name], rows[:, k], times_s, slack_s)
                if not found.all():
                    bad = int(np.argmin(found))
                    count = f"{int((~found).sum())} of {len(found)} scans"
                    where = f"{name} = {rows[bad, k]} at {times_s[bad]:.4f} s"
                    return f"client {client.number} got {where}, {count}"
    return ""


def _was_sent(
    sent: tuple[np.ndarray, np.ndarray], numbers: np.ndarray, times_s: np.ndarray, slack_s: float
) -> np.ndarray:
    """True (n,) for each number that is among those sent within a slack before or after its time."""
    first, last = (np.searchsorted(sent[0], times_s + sign * slack_s) for sign in (-1, 1))
    return np.array([n in sent[1][a:b] for n, a, b in zip(numbers, first, last, strict=True)], bool)


def registers_are_as_before_or_as_planned(case: Case) -> str:
    """What a command borrows it gives back; of offsets the next invariant speaks."""
    record = case.record
    if case.ended.words[0] == "serve" and case.ended.status == 0 and not _changed_by_a_fault(case):
        now = record.controls()
        other = {name: word for name, word in now.items() if word != record.controls_before[name]}
        return f"serve leaves registers behind: {other}" if other else ""
    if record.tampered or case.ended.status != 0 or case.step.line:
        return ""
    if case.ended.words[0] == "calibrate" and record.borrowed() != record.loaned:
        return f"registers are left behind: {record.borrowed()}, before {record.loaned}"
    return ""


def the_journal_says_what_the_part_holds(case: Case) -> str:
    """After any write the offsets are old or new as the journal says, in the registers and in the flash."""
    record, now = case.record, case.record.offsets()
    if record.tampered or record.forged or not case.after.get("records"):
        return ""
    steps = [json.loads(row[5]) for row in case.after["records"] if row[4] == "offsets"]
    known = operations(steps)
    planned = [record.base, record.flash(), *(_numbers(one.new, record.base) for one in known)]
    if now not in planned and case.ran and not case.step.faults:
        return f"the part holds {now}, which nothing in the journal plans: {planned}"
    if now not in planned[:2] and not known:
        return f"the part holds {now} instead of {record.base}, and there is no journal"
    for one in known:
        if _numbers(one.old, record.base) != record.base:
            return f"the journal says that {one.old} was there before, it was {record.base}"
    noted = len(case.after["records"]) > len(case.before.get("records", []))
    open_write = case.ended.words[0] == "write" and noted and known[-1].open
    if open_write and case.ran and _could_set_back(case.step, known[-1]):
        return f"a write that was interrupted is neither done nor set back: {known[-1]}"
    if noted and case.ended.words[0] == "write" and record.found == record.by_hand != now:
        return f"a write took the place of numbers that somebody wrote by hand: {record.by_hand}"
    return _report_is_true(case, now, planned)


def _could_set_back(step: Step, last: Operation) -> bool:
    """True if line and disk were sound after a write that one fault stopped; an undo can be repeated."""
    passing = all(fault.kind in PASSING for fault in step.line)
    sound = step.disk is None or step.disk.kind in ("interrupt", "slow")
    return step.faults == 0 or (step.faults == 1 and passing and sound and last.op != "undo")


def _report_is_true(case: Case, now: tuple[int, ...], planned: list[tuple[int, ...]]) -> str:
    """Compare what `write` reports with registers and flash of the part."""
    record, document = case.record, case.document
    if case.ended.words[0] != "write" or case.ended.status != 0 or document is None:
        return ""
    state = document["state"]
    holds = {"untouched": record.base, "old": record.base, "new": planned[-1]}.get(state["registers"])
    if holds is not None and now != holds:
        return f"it says that the registers are {state['registers']}, they hold {now}: {planned}"
    if state["saved"] is True and record.flash() != now:
        return f"it says that the numbers are saved, the flash holds {record.flash()}, the registers {now}"
    if state["saved"] is False and record.flash() == now:
        return f"it says that the numbers are not saved, the flash holds them: {now}"
    if document.get("done") and state["registers"] == "new":
        return _offsets_cancel_the_biases(case, now)
    return ""


def _offsets_cancel_the_biases(case: Case, now: tuple[int, ...]) -> str:
    plan = case.document["plan"] if case.document else None
    if plan is None or _lies(case):
        return ""
    with _copied(case.bench.folder) as copy, ArchiveView(copy) as view:
        truth = case.bench.truth([attempt.ended_bus_s for attempt in view.dwells()])
    for axis in plan["axes"]:
        k = "xyz".index(axis["axis"])
        rest_mg = truth[f"bias_{axis['axis']}"] + LSB_MG * now[k]
        if abs(rest_mg) > LSB_MG + 6 * axis["bias_u_mg"]:
            return f"after the write a bias of {rest_mg:.2f} mg remains on {axis['axis']}"
    return ""


def status_0_means_a_right_answer(case: Case) -> str:
    """Exit status 0 comes with values inside their U as often as U promises, and never far outside."""
    ended, document = case.ended, case.document
    if ended.words[0] not in ("calibrate", "fit") or ended.status != 0 or case.record.forged:
        return ""
    if document is None:
        return "status 0 without an answer"
    try:
        with _copied(case.bench.folder) as copy, ArchiveView(copy) as view:
            complete = not view.pending() and not view.doubts()
            dwells, skipped, places = view.dwells(), view.skipped(), set(range(len(view.plan())))
    except AdisGonioError as error:
        return f"status 0 of a session that cannot be read: {error}"
    complete &= places <= skipped | {row[2] for row in case.after["attempts"] if row[6] == "complete"}
    if ended.words[0] == "calibrate" and not complete:
        return "calibrate ends with status 0, but the session is not complete or has doubts"
    if not complete:
        return ""
    truth = case.bench.truth([(a.started_bus_s + a.ended_bus_s) / 2 for a in dwells])
    names = [n for n in ("delta_k", "delta_phi") if n in document["answer"]]
    names = names or ["scale_x", "scale_y", "skew_xy"]
    for name in names:
        value = document["answer"].get(name) or document["parameters"].get(name)
        if value is not None and value["U"] is not None:
            case.found.off[name] = (value["value"] - truth[name]) / value["U"]
            if value["U"] > NOTHING[value["unit"]]:
                return f"status 0 with an answer that says nothing: {name} ± {value['U']:.3g}"
    case.found.lied = _lies(case)
    far = {name: round(off, 1) for name, off in case.found.off.items() if abs(off) > FAR}
    return f"status 0 with values at {far} U from the truth" if far and not case.found.lied else ""


def the_live_angle_is_right(case: Case) -> str:
    """Every corrected angle at rest is inside a few U of the true angle, at the session's temperature."""
    drift_c = abs(case.story.drift_c_per_h * case.bench.now_s / 3600)
    if drift_c > COLDER_C:  # u of the live angle does not hold the temperature
        return ""
    if case.ended.words[0] != "angle" or _lies(case) or case.record.tampered or case.step.line:
        return ""
    if case.record.forged:
        return ""
    stage = case.bench.world.stage
    for line in case.ended.out.splitlines():
        reading = json.loads(line)
        if (
            reading["corrected_deg"] is None
            or reading["u_deg"] is None
            or stage.still_at_s > case.ended.began_s
        ):
            continue
        off = (reading["corrected_deg"] - stage.angle_deg + 180) % 360 - 180
        if case.bench.part.direction is None and abs(off) > 6 * (reading["u_deg"] + 0.05):
            found = f"{reading['corrected_deg']:.3f}° ± {reading['u_deg']:.3f}°"
            return f"the angle is {found}, true is {stage.angle_deg:.3f}°"
    return ""


def memory_and_files_are_bounded(case: Case) -> str:
    """Neither the program nor a file grows without end, and a command leaves no file open."""
    grown = _memory_bytes() - case.record.memory
    if grown > MOST_GROWTH:
        return f"the program has grown by {grown / 1e6:.0f} MB"
    paths = list(case.bench.folder.iterdir())
    # A stranger may have made a session large, also one that was set aside since.
    strange = any(step.command.startswith("forged") for step in case.story.steps)
    own = [path for path in paths if not (strange and path.suffix == ".session")]
    large = [path.name for path in own if path.stat().st_size > LARGEST_FILE]
    if large or len(paths) > MOST_FILES:
        return f"files without bounds: {large or sorted(path.name for path in paths)}"
    opened = _open_files()
    if case.ran and opened > case.record.files + 2:
        return f"{opened} files are open, {case.record.files} before"
    return ""


def reports_are_whole(case: Case) -> str:
    """A report that exists is whole: the old one or the new one."""
    for path in case.bench.folder.iterdir():
        if ".part-" in path.name:
            continue
        if path.suffix == ".json":
            try:
                json.loads(path.read_bytes())
            except ValueError:
                return f"{path.name} is half a report ({path.stat().st_size} bytes)"
        if path.suffix == ".html" and not path.read_bytes().rstrip().endswith(b"</html>"):
            return f"{path.name} is half a page ({path.stat().st_size} bytes)"
    return ""


INVARIANTS: tuple[Callable[[Case], str], ...] = (
    every_failure_is_one_line,
    every_wait_ends,
    nothing_recorded_is_lost,
    a_session_set_aside_is_whole,
    the_session_can_be_read,
    no_accepted_word_is_wrong,
    every_client_is_answered,
    clients_get_words_of_the_sensor_only,
    dwells_are_measured_alike,
    the_last_scans_before_an_error_are_kept,
    registers_are_as_before_or_as_planned,
    the_journal_says_what_the_part_holds,
    status_0_means_a_right_answer,
    the_live_angle_is_right,
    memory_and_files_are_bounded,
    reports_are_whole,
)


def check(record: Record, ended: Ended, step: Step, story: Story) -> Found:
    """Check every invariant after a command; update the record."""
    found = Found()
    before, after = record.rows, _rows(record.bench.folder / SESSION)
    case = Case(record, ended, step, story, before, after, found)
    record.tampered |= _changed_by_a_fault(case)
    for invariant in INVARIANTS:
        wrong = invariant(case)
        if wrong:
            found.wrong.append(f"{invariant.__name__.replace('_', ' ')}: {wrong}")
    record.rows = after
    return found


# -- looking -------------------------------------------------------------------------------------------


def _changed_by_a_fault(case: Case) -> bool:
    return any(fault.kind in TAMPERING for fault in case.step.line)


def _lies(case: Case) -> bool:
    return not HONEST.issuperset(case.bench.operator.person.blunders)


@contextmanager
def _copied(folder: Path, name: str = SESSION) -> Iterator[Path]:
    """Copy the session file with its journal, so that a look changes nothing; yield the copy's path."""
    with tempfile.TemporaryDirectory(dir=folder.parent) as copies:
        for path in folder.glob(f"{name}*"):
            shutil.copy(path, copies)
        yield Path(copies) / name


def _rows(path: Path) -> dict[str, list[Any]]:
    """All rows of a session file by table, as the next program would find them; empty without one."""
    if not path.exists():
        return {}
    with _copied(path.parent, path.name) as copy:
        connection = sqlite3.connect(copy)
        try:
            tables = [
                name
                for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            ]
            return {
                name: connection.execute(f"SELECT * FROM {name} ORDER BY rowid").fetchall()
                for name in tables
            }
        except (sqlite3.DatabaseError, UnicodeDecodeError):  # then the earlier rows are missed
            return {}
        finally:
            connection.close()


def _why_unreadable(folder: Path) -> str:
    """Message of the package if it cannot read the session file; else empty."""
    try:
        with _copied(folder) as copy, ArchiveView(copy) as view:
            for attempt in view.attempts():
                view.blocks(attempt)
    except AdisGonioError as error:
        return str(error)
    except Exception as error:  # of a defect that was put back
        return f"{type(error).__name__}: {error}"
    return ""


def _rows_written(labels: Sequence[str]) -> Counter[str]:
    """Number of rows by table that a command wrote in transactions that it committed."""
    written: Counter[str] = Counter()
    waiting: list[str] = []
    for label in labels:
        if label.startswith("INSERT INTO "):
            waiting.append(label.split()[2])
        elif label == "COMMIT":
            written.update(waiting)
        if label.startswith(("BEGIN", "COMMIT")):
            waiting = []
    return written


def _numbers(found: dict[str, int], otherwise: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(found.get(name, number) for name, number in zip(ACCEL_OFF, otherwise, strict=True))


def _signed(word: int) -> int:
    return (word & 0xFFF) - ((word & 0x800) << 1)


def _open_files() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


def _memory_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
