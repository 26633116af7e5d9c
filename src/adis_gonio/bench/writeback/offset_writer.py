"""The write-back, without a user interface.

    writer = OffsetWriter(sensor, "today.session", WriteSettings(save=True), tell=print)
    plan = writer.plan()      # checks only; writes neither to the sensor nor to the file
    writer.write()            # or writer.undo()

Every step is recorded in the archive's journal (see `write_journal`) before or after it is done. If a write
is interrupted by an error, a Ctrl-C or a failed check, the old numbers are restored if the sensor still
answers, and a message reports the state of the sensor.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from adis_gonio.base.errors import AdisGonioError, ChipError, SessionError, UsageError, VerifyError
from adis_gonio.bench.session_bench import SessionBench
from adis_gonio.bench.writeback.offset_checks import (
    PRECISE_S,
    Accelerometers,
    Agreement,
    Gyros,
    Rest,
    compare_effect,
    measure,
)
from adis_gonio.bench.writeback.offset_plan import WritePlan, recorded_offsets
from adis_gonio.device.sensor.driver import FLASH_LIFE, FLASH_UPDATE_S, Adis16354, Undo
from adis_gonio.device.sensor.registers import SUPPLY_LIMITS_V, registers
from adis_gonio.model.records import Session
from adis_gonio.record.archive import Archive, ArchiveView, is_archive
from adis_gonio.record.plans import Position
from adis_gonio.record.session_reader import read_session
from adis_gonio.record.source import Settings
from adis_gonio.record.write_journal import (
    KIND,
    HeldOffsets,
    Operation,
    WriteStep,
    find_undoable,
    flash_untouched,
    held_offsets,
    operations_of,
)


class Logbook:
    """Journal of one operation of a write-back: each entry is on the disk when `note` returns.

    Parameters
    ----------
    archive : Archive
        Open file of the session.
    operation : Operation
        The operation (write, undo or autonull); its steps are updated.
    now_s : callable
        Returns the time in s on the bus's clock.
    """

    def __init__(self, archive: Archive, operation: Operation, now_s: Callable[[], float]) -> None:
        self._archive, self.operation, self._now_s = archive, operation, now_s

    def note(self, step: WriteStep, **facts: Any) -> None:
        """Write a step of the operation to the archive, with facts such as `endurance`.

        Raises
        ------
        SessionError
            The file cannot be written, or another program continues the session.
        """
        self._archive.add_record(
            KIND, {"number": self.operation.number, "step": step, **facts}, self._now_s()
        )
        known = {name: facts[name] for name in ("endurance", "endurance_after") if name in facts}
        self.operation = replace(self.operation, steps=(*self.operation.steps, step), **known)


def load(path: Path) -> Session:
    """Load the session of an archive to which its biases can be written back.

    Raises
    ------
    SessionError
        The file is no archive, which the journal needs, or the session is not from the chip.
    DataError
        The file is missing, damaged or newer than this program, or has no complete dwell.
    """
    if path.is_file() and not is_archive(path):
        raise SessionError(
            f"{path}: is no session file, which keeps the undo of a write: run calibrate first"
        )
    session = read_session(path)
    recorded_offsets(session)
    return session


Tell = Callable[[str], None]


@dataclass(frozen=True)
class WriteSettings:
    """Options of a write-back.

    Attributes
    ----------
    save : bool
        True to save to flash when the write is verified.
    angle_deg : float or None
        Declared angle of the sensor; a stage that the program can move goes there. With None and such a
        stage the first angle of the session is used; without a stage only the magnitude of gravity is
        compared.
    dwell_s, patience_s : float
        Length of the dwells before and after in s, and time to wait for rest.
    method : str or None
        Method of the fit; None for the best method for the session.
    doubtful : bool
        True to write even if there are doubts about the fit.
    gyros : bool
        True to cancel the zero rates of the gyros instead of the biases of the accelerometers.
    """

    save: bool = False
    angle_deg: float | None = None
    dwell_s: float = 5.0
    patience_s: float = 60.0
    method: str | None = None
    doubtful: bool = False
    gyros: bool = False


@dataclass(frozen=True)
class WriteResult:
    """Result of a write-back.

    Attributes
    ----------
    standing : HeldOffsets
        Present state of the sensor's offset registers, compared with the journal.
    endurance_before, endurance_after : int
        Content of ENDURANCE, the counter of flash updates, before and after the write-back.
    checks : tuple of Agreement
        Comparisons, which all agree.
    autonull : Agreement or None
        Comparison of the chip's autonull with the session; None without an autonull.
    nulled : dict of str to int
        Numbers that the autonull wrote to the offset registers, by name; empty without an autonull.
    """

    standing: HeldOffsets
    endurance_before: int
    endurance_after: int
    checks: tuple[Agreement, ...] = ()
    autonull: Agreement | None = None
    nulled: dict[str, int] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the result in JSON form."""
        null = {} if self.autonull is None else {"autonull": {"new": self.nulled} | self.autonull.as_dict()}
        return {
            "state": self.standing.as_dict(),
            "endurance": {"before": self.endurance_before, "after": self.endurance_after},
            "checks": [check.as_dict() for check in self.checks],
            **null,
        }


class OffsetWriter:
    """Writes the biases (or the zero rates) of a session to the sensor of the session.

    Parameters
    ----------
    sensor : Adis16354
        Open sensor; it stays open.
    path : path
        Session file; the journal is written to it.
    settings : WriteSettings or None
        Options; None for the defaults.
    tell : callable
        Called with one line for each step.

    Raises
    ------
    DataError, SessionError
        The file is no session file, has no contents of registers, or began with another sensor.
    """

    def __init__(
        self,
        sensor: Adis16354,
        path: str | Path,
        settings: WriteSettings | None = None,
        *,
        tell: Tell = lambda text: None,
    ) -> None:
        self.sensor, self.path, self.settings = sensor, Path(path), settings or WriteSettings()
        self.session = load(self.path)
        self._tell = tell
        with ArchiveView(self.path) as view:
            self._bench = SessionBench(sensor, Settings.from_dict(view.header.settings))
            self._bench.require_same_sensor(view)
            own, angles = self.settings, [position.angle_deg for position in view.plan().positions]
        self._angle_deg = own.angle_deg
        if own.angle_deg is None and self._bench.stage is not None and self.session.plane == "xy":
            self._angle_deg = next((angle for angle in angles if angle is not None), None)
        if own.gyros and own.method is not None:
            raise UsageError(f"{self.path.name}: --method is for accelerometers; leave it out")
        self._part: Gyros | Accelerometers = (
            Gyros(self.session) if own.gyros else Accelerometers(self.session, own.method, self._angle_deg)
        )
        recorded_offsets(self.session, self._part.registers)
        self._planned: tuple[WritePlan, Rest] | None = None
        self._checks: list[Agreement] = []

    # -- looking --------------------------------------------------------------------------------------

    @property
    def known(self) -> tuple[Operation, ...]:
        """Earlier operations in the journal on the registers that this object writes."""
        return operations_of(self.session, self._part.registers)

    @property
    def others(self) -> tuple[Operation, ...]:
        """Earlier operations in the journal on the offset registers that this object does not write."""
        return operations_of(self.session, self._part.others)

    def standing(self) -> HeldOffsets:
        """Return the state of the sensor's offsets, from its registers, ENDURANCE and the journal."""
        now, endurance = self._read()
        return held_offsets(self.known, now, endurance, self.others)

    def plan(self) -> WritePlan:
        """Plan the new numbers, and measure a dwell before the write; no register is written.

        Raises
        ------
        SessionError
            The session gives no bias; the registers have numbers that session and journal do not explain;
            the sensor at rest does not agree with the session; or there are doubts about the fit and the
            settings do not allow to write in spite of doubts (`WriteSettings.doubtful`).
        ChipError
            The supply is out of range, or the flash is to be written and is worn out.
        FitError
            The session cannot be fitted, or the sensor is not in the session's plane.
        """
        now, endurance = self._read()
        plan = self._part.plan(now)
        for remark in self._part.remarks:
            self._tell(f"gyros: {remark}")
        if plan.doubts and not self.settings.doubtful:
            raise SessionError(
                f"{self.path}: the fit is not reliable enough ({'; '.join(plan.doubts)}); see `adis-gonio "
                "trace`, or write anyway with --even-if-inadequate"
            )
        earlier = find_undoable(self.known)
        if earlier is not None and earlier.new != plan.new:
            raise SessionError(
                f"{self.path}: other offsets of this session were written before"
                f" ({_format_numbers(earlier.new)}; now {_format_numbers(plan.new)}); --undo them first"
            )
        self._require_explained(now)
        if self.settings.save and endurance >= FLASH_LIFE:
            raise ChipError(f"ENDURANCE is {endurance}: the flash is made for {FLASH_LIFE} writes")
        if self._bench.stage is not None and self._angle_deg is not None:
            self._bench.move_to(Position(self._angle_deg))  # only once: two moves would not end alike
        before = self._measure("at rest, before")
        check = self._part.expected(plan, before)
        self._tell(str(check))
        if not check.agrees:
            raise SessionError(
                f"this does not look like the part of {self.path.name}, {check}; another part, or another"
                " angle of the stage?"
            )
        self._planned, self._checks = (plan, before), [check]
        return plan

    # -- doing ----------------------------------------------------------------------------------------

    def write(self) -> WriteResult:
        """Carry out the plan: write, read back, verify by a dwell, and save if requested.

        Raises
        ------
        UsageError
            `plan` was not called, or is used up.
        VerifyError
            A register was read back with another number, or the outputs did not change as planned.
        SessionError, ChipError, BusError, KeyboardInterrupt
            The write was interrupted. The message ends with the state of the sensor.
        """
        planned, self._planned = self._planned, None
        if planned is None:
            raise UsageError("make a plan first: plan() checks the numbers before they are written")
        plan, before = planned
        now, endurance = self._read()
        if {name: now[name] for name in plan.now} != plan.now:
            raise SessionError("the offset registers have changed since the plan was made; plan again")
        standing = held_offsets(self.known, now, endurance, self.others)
        in_flash = standing.registers == "new" and standing.saved is True
        saves = self.settings.save and not in_flash
        if not plan.changes and not saves and not standing.open:
            self._tell("nothing is to be written: the registers hold it already")
            return WriteResult(standing, endurance, endurance, tuple(self._checks))
        earlier = find_undoable(self.known)
        held = {name: now[name] for name in plan.new}
        old = earlier.old if earlier else held
        found = old if standing.registers == "half" else held
        operation = Operation(0, "write", old, plan.new, found, saves, ())
        with self._journal(operation, plan=plan.as_dict()) as journal, self._reporting_state():
            try:
                if plan.changes:
                    self._put(plan)
                journal.note(WriteStep.WRITTEN)
                if plan.changes:
                    self._verify(plan, before)
                journal.note(WriteStep.VERIFIED, checks=[check.as_dict() for check in self._checks])
                if in_flash:
                    journal.note(WriteStep.SAVED, endurance=endurance, endurance_after=endurance)
                elif saves:
                    self._save(journal, plan.new)
                journal.note(WriteStep.DONE)
            except BaseException as error:
                self._restore(journal, str(error) or type(error).__name__)
                raise
        return self._outcome(endurance)

    def undo(self) -> WriteResult:
        """Restore the old offsets; save them to flash if the new ones are there or saving was requested.

        Raises
        ------
        SessionError
            There is no write to undo, or the registers have numbers that the journal does not explain.
        VerifyError, ChipError, BusError
            The undo was interrupted; it can be repeated.
        """
        earlier = find_undoable(self.known)
        if earlier is None:
            raise SessionError(f"{self.path}: no write is active, so there is nothing to undo")
        now, endurance = self._read()
        standing = held_offsets(self.known, now, endurance, self.others)
        if standing.registers == "other":
            raise SessionError(f"{self.path}: {standing.text}; nothing was written")
        saves = self.settings.save or not flash_untouched(self.known, now, endurance, self.others)
        if saves:
            self._require_supply(self.sensor.quantity("SUPPLY_OUT").value)
        operation = Operation(0, "undo", earlier.old, earlier.new, earlier.old, saves, ())
        with self._journal(operation) as journal, self._reporting_state():
            back = Undo(self.sensor, registers(earlier.old), _words(earlier.old))
            back.put_back()
            if back.unrestored or not self._has_numbers(earlier.old):
                raise VerifyError(f"{', '.join(back.unrestored) or 'the registers'} could not be set back")
            journal.note(WriteStep.WRITTEN)
            self._tell(f"set back and read back: {_format_numbers(earlier.old)}")
            if saves:
                self._save(journal, earlier.old)
            journal.note(WriteStep.DONE)
        return self._outcome(endurance)

    def autonull(self) -> WriteResult:
        """Run the chip's precision autonull of its gyros (30 s); undo it if it disagrees with the session.

        The sensor must be at rest. The autonull includes the effect of force in this pose, and so does the
        zero rate of the session with which it is compared. The sensor saves the result to flash
        automatically, with all registers that have a flash copy; an undo writes the flash once more.

        Raises
        ------
        UsageError
            `plan` was not called, is used up, or is a plan of the accelerometers.
        VerifyError
            The autonull disagrees by more than the uncertainty. The message has the difference and the
            state of the sensor.
        SessionError, ChipError, BusError, KeyboardInterrupt
            The autonull was interrupted. The message ends with the state of the sensor.
        """
        planned, self._planned = self._planned, None
        part = self._part
        if planned is None or not isinstance(part, Gyros):
            raise UsageError("make a plan of the gyros first: plan() measures the dwell for the comparison")
        plan, before = planned
        now, endurance = self._read()
        if endurance + 1 >= FLASH_LIFE:
            raise ChipError(f"ENDURANCE is {endurance}: the flash is made for {FLASH_LIFE} writes")
        self._require_supply(before.supply_v)
        operation = Operation(0, "autonull", now, now, now, True, ())
        with self._journal(operation) as journal:
            journal.note(WriteStep.SAVING, endurance=endurance, beside=self._numbers(self._part.others))
            with self._reporting_state():
                self.sensor.precision_autonull()
                nulled, after = self._read()
                journal.note(WriteStep.SAVED, new=nulled, endurance_after=after)
                journal.note(WriteStep.DONE)
        self.session = load(self.path)
        rate = self.sensor.configuration().sample_rate_hz
        found = part.compare_autonull(plan, before, nulled, PRECISE_S * rate)
        self._tell(f"the chip's autonull gives {_format_numbers(nulled)}; {found}")
        if not found.agrees:
            undone = self.undo()
            raise VerifyError(
                f"the chip's autonull is not kept: it differs from the session by {found.excess};"
                f" {undone.standing.text}"
            )
        return replace(self._outcome(endurance), autonull=found, nulled=nulled)

    # -- steps ----------------------------------------------------------------------------------------

    def _put(self, plan: WritePlan) -> None:
        for axis in plan.axes:
            if axis.new != axis.now:
                self.sensor.write(axis.register, axis.new)
        if not self._has_numbers(plan.new):
            raise VerifyError(
                f"the registers were read back with other numbers than {_format_numbers(plan.new)}"
            )
        self._tell(f"written and read back: {_format_numbers(plan.new)}")
        self.sensor.bus.sleep_s(self.sensor.configuration().settling_s)

    def _verify(self, plan: WritePlan, before: Rest) -> None:
        """Compare a dwell after the write with the dwell `before` it and with the session.

        Raises
        ------
        VerifyError
            The outputs did not change as planned.
        """
        after = self._measure("at rest, after")
        done = plan.carried_out
        checks = [compare_effect(self._part, plan, before, after), self._part.expected(done, after)]
        for check in checks:
            self._tell(str(check))
            if not check.agrees:
                raise VerifyError(f"{check}: not as planned")
        self._checks += checks

    def _save(self, journal: Logbook, numbers: dict[str, int]) -> None:
        """Save the registers to flash; check before and after it that they have these numbers."""
        self._require_supply(self.sensor.quantity("SUPPLY_OUT").value)
        now, endurance = self._read()
        _require(now, numbers, "changed by themselves before they were saved")
        journal.note(WriteStep.SAVING, endurance=endurance, beside=self._numbers(self._part.others))
        after = self.sensor.save_to_flash()
        now, _ = self._read()
        _require(now, numbers, "changed while they were saved")
        journal.note(WriteStep.SAVED, endurance_after=after)
        self._tell(f"saved to flash: ENDURANCE {endurance} before, {after} after")

    @contextlib.contextmanager
    def _reporting_state(self) -> Iterator[None]:
        """Context that adds the sensor's state to the message of an error, and prints it after Ctrl-C."""
        try:
            yield
        except BaseException as error:
            if isinstance(error, AdisGonioError):
                raise type(error)(f"{error}; {self._state_text()}") from error
            self._tell(self._state_text())
            raise

    def _restore(self, journal: Logbook, why: str) -> None:
        """Undo the write after an error or Ctrl-C, unless the new offsets are already in flash.

        `why` is the reason for the journal.
        """
        # Two blocks: a second Ctrl-C in the first block must not prevent the restoring in the second.
        with contextlib.suppress(KeyboardInterrupt, AdisGonioError):
            self._complete_saved(journal)
        with contextlib.suppress(KeyboardInterrupt, AdisGonioError):
            if journal.operation.open:
                found = journal.operation.found
                back = Undo(self.sensor, registers(found), _words(found))
                with contextlib.suppress(KeyboardInterrupt):
                    back.put_back()
                if not back.unrestored and self._has_numbers(found):
                    journal.note(WriteStep.SET_BACK, why=why)

    def _complete_saved(self, journal: Logbook) -> None:
        """Complete the journal of a stopped write if flash and registers already have the new offsets."""
        if WriteStep.SAVING not in journal.operation.steps:
            return
        self.sensor.bus.sleep_s(FLASH_UPDATE_S)
        now, endurance = self._read()
        new = journal.operation.new
        if endurance != journal.operation.endurance and all(now[name] == new[name] for name in new):
            if WriteStep.SAVED not in journal.operation.steps:
                journal.note(WriteStep.SAVED, endurance_after=endurance)
            journal.note(WriteStep.DONE)

    # -- inside ---------------------------------------------------------------------------------------

    def _outcome(self, endurance: int) -> WriteResult:
        self.session = load(self.path)
        now, after = self._read()
        standing = held_offsets(self.known, now, after, self.others)
        return WriteResult(standing, endurance, after, tuple(self._checks))

    def _state_text(self) -> str:
        """Return a text on the present state of the sensor's offsets, or that it cannot be read."""
        try:
            self.session = load(self.path)
            return self.standing().text
        except AdisGonioError:
            return (
                "the state of the sensor cannot be read now; `adis-gonio write` with --status"
                " reports it later"
            )

    def _measure(self, what: str) -> Rest:
        self._tell(f"{what}: {self.settings.dwell_s:g} s")
        own = self.settings
        rest = measure(self.sensor, own.dwell_s, own.patience_s, gyros=own.gyros)
        self._require_supply(rest.supply_v)
        return rest

    def _read(self) -> tuple[dict[str, int], int]:
        """Read the offset registers and ENDURANCE; return the numbers by name, and the count.

        Both are read twice, since a dip of the supply may falsify one reading.
        """
        numbers = self._numbers((*self._part.registers, "ENDURANCE"))
        endurance = numbers.pop("ENDURANCE")
        return numbers, endurance

    def _numbers(self, names: Sequence[str]) -> dict[str, int]:
        rows = registers(names)
        words = self.sensor.read_checked(rows)
        return {row.name: row.number(word) for row, word in zip(rows, words, strict=True)}

    def _has_numbers(self, numbers: dict[str, int]) -> bool:
        now, _ = self._read()
        return all(now[name] == number for name, number in numbers.items())

    def _require_explained(self, now: dict[str, int]) -> None:
        """Raise `SessionError` if a register has a number that session and journal do not explain.

        `now` are the present numbers of the registers by name.
        """
        recorded, known = recorded_offsets(self.session, self._part.registers), self.known
        standing = held_offsets(known, now, 0)
        written = set(known[-1].new) if known and standing.registers in ("old", "new", "half") else set()
        for name, number in recorded.items():
            if name not in written and now[name] != number:
                raise SessionError(
                    f"{name} was {number} when {self.path.name} was recorded and is {now[name]}: another"
                    f" part or changed since; if it is this one, set it back: registers URL {name}={number}"
                )

    @staticmethod
    def _require_supply(supply_v: float) -> None:
        low, high = SUPPLY_LIMITS_V
        if not low <= supply_v <= high:
            raise ChipError(f"the supply is {supply_v:.2f} V, the part needs {low} to {high} V")

    @contextlib.contextmanager
    def _journal(self, planned: Operation, **facts: Any) -> Iterator[Logbook]:
        last = max((one.number for one in (*self.known, *self.others)), default=0)
        operation = replace(planned, number=last + 1)
        with Archive.open_existing(self.path) as archive:
            now_s = self.sensor.bus.now_s()
            dwell = max((attempt.number for attempt in archive.dwells()), default=0)
            archive.begin_run(now_s, self._bench.clock_offset(archive, now_s), dwell)
            journal = Logbook(archive, operation, self.sensor.bus.now_s)
            known = {name: getattr(operation, name) for name in ("op", "old", "new", "found", "save")}
            journal.note(WriteStep.PLANNED, **known, url=self.sensor.bus.url, **facts)
            yield journal


def _words(numbers: dict[str, int]) -> dict[str, int]:
    return {row.name: row.word(numbers[row.name]) for row in registers(numbers)}


def _format_numbers(numbers: dict[str, int]) -> str:
    return ", ".join(f"{name} = {number}" for name, number in numbers.items())


def _require(now: dict[str, int], numbers: dict[str, int], what: str) -> None:
    if odd := [name for name, number in numbers.items() if now[name] != number]:
        raise VerifyError(f"{', '.join(odd)} {what}; check the supply")
