"""The journal of writes in a session's archive, and the state of a sensor by its journal.

The journal records writes to the sensor's offset registers. Every step is a record of kind `offsets`,
written **before** an action (`planned`, `saving`) or **after** it (`written`, `verified`, `saved`, `done`,
`set-back`). A power cut therefore finds the journal at most one step behind the sensor, and the registers,
ENDURANCE (the chip's counter of flash updates) and the journal together determine the state:

| registers | explanation |
|---|---|
| old | a power cut before anything was saved (at power-on the sensor loads its flash copies), or an undo |
| new | a write; in flash if ENDURANCE went up by one since `saving` |
| half | the program ended between two bytes or two registers, without a power cut |
| other | another program wrote them, or it is another sensor |
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field, replace
from enum import StrEnum
from typing import Any, Literal

from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import join_words
from adis_gonio.device.sensor.registers import ACCEL_OFF, BY_NAME, GYRO_OFF
from adis_gonio.model.records import Session

Numbers = Mapping[str, int]
"""Contents of offset registers by name, as signed numbers in LSB."""

KIND = "offsets"
"""Kind of the records in the archive that make up the journal."""

INTERRUPTED = (
    "a write of offsets was interrupted, so the state of the sensor is unknown; run `adis-gonio write` "
    "with --status, then finish it or --undo"
)


class WriteStep(StrEnum):
    """Steps of a write operation, in their order; `DONE` and `SET_BACK` end the operation.

    Numbers that are in flash already are recorded as `SAVED` without `SAVING`. An autonull begins with
    `SAVING`, since the sensor saves it automatically, and the record of `SAVED` has the numbers that it
    found.
    """

    PLANNED = "planned"
    WRITTEN = "written"
    VERIFIED = "verified"
    SAVING = "saving"
    SAVED = "saved"
    DONE = "done"
    SET_BACK = "set-back"


class Operation(JsonRecord):
    """One write, undo or autonull of offset registers, as recorded in the journal.

    Attributes
    ----------
    number : int
        Number of the operation, from 1.
    op : {"write", "undo", "autonull"}
        Kind of the operation; an autonull lets the sensor find the offsets itself.
    old, new : dict of str to int
        Register contents before the write and contents to write, by name in LSB. An undo has the numbers of
        the write that it undoes; in an autonull `new` equals `old` until saving has ended.
    found : dict of str to int
        Register contents at its start, or the old numbers if the registers were half written; a write that
        is broken off restores them.
    save : bool
        True if saving to flash was requested.
    steps : tuple of WriteStep
        Recorded steps.
    endurance : int or None
        ENDURANCE (counter of flash updates) when saving began; None if it did not begin.
    endurance_after : int or None
        ENDURANCE when saving had ended; None if it did not end.
    utc : str
        Time of the last record, ISO 8601, UTC.
    beside : dict of str to int
        Contents of the offset registers of the other half of the sensor (gyros or accelerometers) when
        saving began; a flash update saves them too.
    """

    document_keys = ("number", "op", "utc")

    number: int
    op: Literal["write", "undo", "autonull"]
    old: dict[str, int]
    new: dict[str, int]
    found: dict[str, int]
    save: bool
    steps: tuple[WriteStep, ...]
    endurance: int | None = None
    endurance_after: int | None = None
    utc: str = ""
    beside: dict[str, int] = field(default_factory=dict)

    @property
    def open(self) -> bool:
        """True if the operation was not completed."""
        return self.steps[-1] not in (WriteStep.DONE, WriteStep.SET_BACK)

    def concerns(self, names: Sequence[str]) -> bool:
        """True if the operation writes at least one of the named registers."""
        return any(name in names for name in self.old)

    @property
    def target_of_saving(self) -> dict[str, int]:
        """Register contents that the flash update of the operation saves, by name."""
        return self.old if self.op == "undo" else self.new

    @property
    def saved(self) -> bool:
        """True if the journal records that the operation wrote the flash."""
        return WriteStep.SAVED in self.steps

    @property
    def target(self) -> dict[str, int]:
        """Register contents after the operation, by name."""
        return self.found if self.steps[-1] is WriteStep.SET_BACK else self.target_of_saving


def operations(entries: Iterable[Mapping[str, Any]]) -> tuple[Operation, ...]:
    """Combine the records of a session's write journal to operations, in the order of their beginning.

    An operation is one `write`, `write --undo` or null, from its plan to its end. Each of its steps left a
    record with the number of the operation.

    `entries` are the records, as `Session.facts["offset_writes"]` has them.
    """
    found: dict[int, Operation] = {}
    for entry in entries:
        number, step = int(entry["number"]), WriteStep(entry["step"])
        before = found.get(number) or Operation(
            number, entry["op"], dict(entry["old"]), {}, dict(entry["found"]), bool(entry["save"]), ()
        )
        numbers: dict[str, Any] = {name: dict(entry[name]) for name in ("new", "beside") if name in entry}
        counts = {name: entry[name] for name in ("endurance", "endurance_after") if name in entry}
        utc = str(entry.get("utc", ""))
        found[number] = replace(before, steps=(*before.steps, step), utc=utc, **numbers, **counts)
    return tuple(found.values())


def operations_of(session: Session, names: Sequence[str] = ACCEL_OFF) -> tuple[Operation, ...]:
    """Return the operations on the named registers in a session's archive; empty without a journal."""
    known = operations(session.facts.get("offset_writes") or ())
    return tuple(operation for operation in known if operation.concerns(names))


def describe_writes(known: Sequence[Operation], recorded: Numbers) -> tuple[str, ...]:
    """Return remarks on offsets that were written after the recording.

    There is at most one remark for the accelerometers and one for the gyros. `known` are the operations of
    the journal, `recorded` the register contents during the recording.
    """
    own = [tuple(one for one in known if one.concerns(names)) for names in (ACCEL_OFF, GYRO_OFF)]
    remarks = (*_remarks(own[0], recorded, "biases"), *_remarks(own[1], recorded, "zero rates"))
    return tuple(dict.fromkeys(remarks))


def _remarks(known: Sequence[Operation], recorded: Numbers, what: str) -> tuple[str, ...]:
    if not known:
        return ()
    if known[-1].open:
        return (INTERRUPTED,)
    held = known[-1].target
    now = {name: number for name, number in held.items() if number != recorded.get(name)}
    if not now:
        return ()
    changes = ", ".join(f"{name} {recorded.get(name, 'unknown')} → {n}" for name, n in now.items())
    flash = {**recorded, **next((one.target_of_saving for one in reversed(known) if one.saved), {})}
    lost = [f"{name} {flash.get(name, 'unknown')}" for name, n in held.items() if n != flash.get(name)]
    kept = (
        f"not saved to flash: a power cycle brings back {join_words(lost)}, so use `adis-gonio write` with "
        "--save, or with --undo before the export"
        if lost
        else "saved to flash"
    )
    return (
        f"offsets were written to the sensor since ({changes}): the {what} here were recorded before, "
        f"and exported coefficients hold only while the part holds the offsets written; they are {kept}",
    )


def find_undoable(known: Sequence[Operation]) -> Operation | None:
    """Return the operation that `--undo` would revert; None if there is none.

    It is the last write or autonull among the operations `known` that is not undone yet.
    """
    for operation in reversed(known):
        if operation.op != "undo" and operation.steps[-1] is not WriteStep.SET_BACK:
            return operation
        if operation.op == "undo" and not operation.open:
            return None
    return None


RegisterState = Literal["old", "new", "half", "other"]


class HeldOffsets(JsonRecord):
    """State of the sensor's offset registers, compared with the journal.

    Attributes
    ----------
    registers : {"untouched", "old", "new", "half", "other"}
        State of all registers together: contents from before (`old`) or after (`new`) the last operation,
        half written, or other contents; `untouched` if the journal has no operation.
    saved : bool or None
        True if, by the journal, the flash has the present contents of the registers; None if unknown.
    open : bool
        True if an operation was not completed.
    axes : dict of str to str
        State of each register by name, one of the above.
    operation : Operation or None
        The last operation; None if the journal has none.
    text : str
        One line with all of this.
    """

    registers: str
    saved: bool | None
    open: bool
    axes: dict[str, RegisterState]
    operation: Operation | None
    text: str


def held_offsets(
    known: Sequence[Operation], now: Numbers, endurance: int, others: Sequence[Operation] = ()
) -> HeldOffsets:
    """Compare register contents and ENDURANCE with the journal and return the state of the sensor.

    Parameters
    ----------
    known, others : sequence of Operation
        Operations on these registers, and on the registers of the other half of the sensor (gyros or
        accelerometers); a flash update saves both.
    now : mapping of str to int
        Present register contents by name.
    endurance : int
        Present content of ENDURANCE, the counter of flash updates.
    """
    if not known:
        text = f"this session has not written {join_words(tuple(now))}"
        return HeldOffsets("untouched", None, False, {}, None, text)
    last = known[-1]
    if last.op == "autonull" and not last.saved:
        last = replace(last, new={name: now[name] for name in last.old})  # the numbers found by the part
        known = (*known[:-1], last)
    axes = {name: _state(name, now[name], last.old[name], last.new[name]) for name in last.new}
    # Registers that the operation leaves unchanged count as both old and new.
    both: list[tuple[RegisterState, Numbers]] = [("new", last.new), ("old", last.old)]
    if last.op != "write" and not (last.op == "autonull" and last.saved):
        both.reverse()
    mixed: RegisterState = "other" if "other" in axes.values() else "half"
    alike = (state for state, held in both if all(now[name] == n for name, n in held.items()))
    registers = next(alike, mixed)
    flash = _in_flash(known, now, endurance, others)
    saved = None if flash is None else all(flash.get(name) == now[name] for name in last.new)
    if registers == "old" and flash == {}:
        saved = None  # unknown: the old numbers were there before the write
    since = _written_since((*known, *others), endurance)
    flashed = f"; {since}" if since else _flash(registers, flash, last)
    return HeldOffsets(registers, saved, last.open, axes, last, _words(registers, flashed, axes, last))


def flash_untouched(
    known: Sequence[Operation], now: Numbers, endurance: int, others: Sequence[Operation] = ()
) -> bool:
    """Return True if the flash certainly has the contents from before the first write of the session.

    `known` are the operations on the registers `now`, `others` the operations on the other half of the
    sensor; `endurance` is the present content of ENDURANCE.
    """
    return not known or _in_flash(known, now, endurance, others) in ({}, known[-1].old)


def _state(name: str, now: int, old: int, new: int) -> RegisterState:
    if now in (old, new):
        return "new" if now == new else "old"
    row = BY_NAME[name]
    # A register is written low byte first: a program that ends in between leaves one old and one new byte.
    halves = {row.word(a) & 0x00FF | row.word(b) & 0xFF00 for a, b in ((old, new), (new, old))}
    return "half" if row.word(now) in halves else "other"


def _in_flash(
    known: Sequence[Operation], now: Numbers, endurance: int, others: Sequence[Operation]
) -> dict[str, int] | None:
    """Return the register contents that these operations saved in flash; {} if none did; None if unknown.

    `known` are the operations on the registers `now`, `others` the operations on the other half of the
    sensor; `endurance` is the present content of ENDURANCE.
    """
    flash: dict[str, int] | None = {}
    names = tuple(known[-1].old)
    for operation in sorted((*known, *others), key=lambda one: one.number):
        own = operation in known
        asked = operation.target_of_saving if own else {name: operation.beside.get(name) for name in names}
        certain = None if None in asked.values() else {name: int(n or 0) for name, n in asked.items()}
        if operation.saved:
            flash = certain
        elif WriteStep.SAVING in operation.steps and operation.endurance is not None:
            written = endurance - operation.endurance
            if operation is known[-1] and written == 1 and all(now[k] == asked[k] for k in asked):
                flash = certain
            elif written:
                # After a dip of the supply just before the flash write, the other numbers may be in flash.
                flash = None
    return None if _written_since((*known, *others), endurance) else flash


def _written_since(known: Sequence[Operation], endurance: int) -> str:
    """Return a clause for a message if another program has written the flash since the last save.

    `known` are the operations of the journal, `endurance` is the present content of ENDURANCE. The clause
    is empty if ENDURANCE has the value that the last save left, and without a save.
    """
    saves = [one for one in known if one.saved]
    after = max(saves, key=lambda one: one.number).endurance_after if saves else None
    if after in (None, endurance) or any(one.open for one in known):
        return ""
    why = "written since" if endurance > after else "another part, or a new simulated one"
    return f"ENDURANCE is {endurance} and was {after} after the save: {why}"


def _words(registers: str, flashed: str, axes: Mapping[str, RegisterState], last: Operation) -> str:
    begun = f"; the {last.op} broke off after '{last.steps[-1]}'" if last.open else ""
    if registers in ("new", "old"):
        return f"the sensor holds the {registers} offsets{flashed}{begun}"
    each = ", ".join(f"{name} {state}" for name, state in axes.items())
    if registers == "half":
        finish = "write again to finish, --undo to set back"
        return f"the sensor holds a part of the new offsets ({each}){begun}: {finish}"
    return f"the sensor holds neither the old nor the new offsets ({each}): changed since, or another part"


def _flash(registers: str, flash: dict[str, int] | None, last: Operation) -> str:
    """Return the clause of a message that states if the offsets in the registers are also in flash.

    `registers` is the state of the registers (`HeldOffsets.registers`), `flash` the result of `_in_flash`,
    and `last` the last operation.
    """
    held, other = (last.new, last.old) if registers == "new" else (last.old, last.new)
    if flash is None:
        return ", and whether these or the others are in flash is not known"
    if flash == held:
        return ", saved to flash"
    if flash == other:
        return ", the others are in flash: they come back with the next power-on"
    if registers == "new":
        return ", not saved: they are lost with the power"
    if not last.open and last.target == last.new:
        return ": the new ones were not saved, and the power was off since"
    return ""
