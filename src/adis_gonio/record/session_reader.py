"""Read a session file as a `Session` for the fits, with the turns between its dwells or its free turn.

Turns between dwells are read on demand, so that a fit without gyros does not need them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.base.errors import DataError
from adis_gonio.base.numbers import counted
from adis_gonio.device.sensor.registers import changed_settings
from adis_gonio.model.records import METADATA, Dwell, Session, StageCurve, Turn
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.archive_tables import Attempt, Header, JsonDict
from adis_gonio.record.blocks import (
    GENERIC,
    WITHOUT_NEWS,
    Alarms,
    Block,
    block_series,
    find_alarms,
    join,
)
from adis_gonio.record.plans import Plan

FREE_TURN = "free-turn"
"""Name of the plan for one continuous turn without declared angles."""
GOES_ON = "the turn goes on"
"""Reason of an attempt that is a piece of a free turn, but not the last piece."""
TURNED = "turned"
"""Reason of an attempt that is a whole turn and no dwell; its scans precede the next dwell."""


def read_turns(path: Path, attempts: Sequence[int]) -> tuple[Turn, ...]:
    """Read the turns between successive dwells of a session file; empty if it is missing or was replaced.

    Parameters
    ----------
    path : Path
        Session file.
    attempts : sequence of int
        Numbers of the attempts that were the session's dwells when it was read, in order.

    Raises
    ------
    DataError
        The file is damaged, truncated or newer than this program.
    """
    if not path.is_file():
        return ()
    with ArchiveView(path) as view, view.snapshot():
        stored = view.attempts()
        plan = view.plan()
        of_number = {attempt.number: attempt for attempt in stored}
        if not set(attempts) <= set(of_number):
            return ()
        made = []
        for k, (before, after) in enumerate(pairwise(of_number[number] for number in attempts)):
            blocks = list(_between(view, stored, before, after))
            # The turn is declared only if the part came from the position before in the plan.
            follows = after.place == before.place + 1
            declared = plan.positions[after.place].turned_deg if follows else None
            made.append(_turn(k, blocks, after, declared))
    return tuple(made)


def _between(
    view: ArchiveView, stored: Sequence[Attempt], before: Attempt, after: Attempt
) -> Iterator[Block]:
    """Yield the scans from the end of the dwell `before` to the beginning of the dwell `after`, in order.

    `stored` are all attempts of the session. Interrupted or repeated dwells between the two dwells are
    included with all their scans. Attempts of an earlier run than the run of `after` are left out, since
    they belong to another stream of samples; this makes a gap. If whole turns were recorded between the
    dwells, only the scans from the last one on are yielded, because each begins and ends at a mark.
    """
    between = [a for a in stored if before.number < a.number < after.number and a.run == after.run]
    whole = [k for k, attempt in enumerate(between) if attempt.reason == TURNED]
    if whole:
        between = between[whole[-1] :]
    elif before.run == after.run:
        yield from view.blocks(before, "after")
    for attempt in between:
        yield from view.blocks(attempt)
    yield from view.blocks(after, "before")


def _turn(number: int, blocks: list[Block], after: Attempt, turned_deg: float | None) -> Turn:
    blocks = [block for block in blocks if len(block)]
    if not blocks:
        return Turn(number, number + 1, np.empty(0), np.empty((0, 3)), turned_deg=turned_deg)
    scans = join(blocks)
    return Turn(
        number,
        number + 1,
        scans.time_s + after.offset_s,
        turned_deg=turned_deg,
        **block_series(scans),
    )


def _turn_attempts(view: ArchiveView) -> tuple[list[Attempt], str]:
    """Return the attempts that are the last complete free turn of a session, and an empty text.

    If no free turn is complete, return the longest one, and the reason why it was broken off.
    """
    chains: list[list[Attempt]] = [[]]
    for attempt in view.attempts():
        if chains[-1] and chains[-1][-1].run != attempt.run:
            chains.append([])
        chains[-1].append(attempt)
        if attempt.reason != GOES_ON:
            chains.append([])
    taken = view.withdrawn()
    chains = [chain for chain in chains if chain and chain[-1].number not in taken]
    whole = [chain for chain in chains if chain[-1].outcome == "complete"]
    if whole:
        return whole[-1], ""
    longest = max(chains, key=lambda c: c[-1].ended_bus_s - c[0].started_bus_s, default=[])
    return longest, longest[-1].reason.replace(GOES_ON, "the program ended") if longest else ""


def read_session(path: str | Path) -> Session:
    """Read a session file and return its complete dwells, in order of recording, as a `Session`.

    A session may be read while another program records it. Samples are in LSB (of a generic sensor in mg)
    and °/s, times in seconds since the session began. `facts` has `configuration`, `registers` (before,
    configured, after), `plan`, `settings`, `url`, `note`, `runs`, `dwells` (times, lost and dropped scans,
    STATUS and alarms of each), `reversed` (True if the stage's angles were taken with the opposite sign),
    `doubts` (guards that were overruled), `remarks` (of the operator), `scanning` (how scans were read),
    `problems`, `advised` (requests of an advisor, round by round), `turned` (the gyros' integrals between
    dwells, as computed on the bench), `offset_writes` (steps of `adis_gonio.bench.writeback` since then),
    `complete`, `started_utc`, `ended_utc` (begin of the last dwell, or of the last piece of a free turn),
    and for simulated sessions `truth`, which no fit may use.

    Raises
    ------
    DataError
        The file is missing, of another kind, damaged, truncated or newer than this program, or has no
        complete dwell.
    SessionError
        The file cannot be read here, or has no session yet.
    """
    with ArchiveView(path) as view, view.snapshot():
        header, plan, stored = view.header, view.plan(), view.dwells()
        pending, skipped = view.pending(), view.skipped()
        if plan.name == FREE_TURN:
            return _free_turn(path, view)
        if not stored:
            raise DataError(f"{path}: no dwell is complete yet; resume the session")
        dropped = _dropped(view)
        joined = [join(view.blocks(attempt, "dwell")) for attempt in stored]
        facts = _facts(view, stored) | {
            "complete": not pending,
            "dwells": [
                {
                    "place": attempt.place,
                    "attempt": attempt.number,
                    "run": attempt.run,
                    "started_utc": attempt.started_utc,
                    "samples": len(scans),
                    "lost": scans.lost,
                    "dropped": dropped.get(attempt.number, 0),
                    "status": attempt.status,
                    "alarms": None if (alarms := find_alarms(scans)) is None else alarms.as_dict(),
                }
                for attempt, scans in zip(stored, joined, strict=True)
            ],
        }
    sign = -1 if facts["reversed"] else 1
    dwells = tuple(_dwell(k, *pair, sign) for k, pair in enumerate(zip(stored, joined, strict=True)))
    turns = partial(read_turns, Path(path).absolute(), [attempt.number for attempt in stored])
    notes = _notes(plan, pending, skipped, facts)
    return _session(path, header, facts, notes, dwells=dwells, plane=plan.plane, turns_from=turns)


def _free_turn(path: str | Path, view: ArchiveView) -> Session:
    """Return the session of one continuous turn, with a note of the reason if it was broken off."""
    attempts, reason = _turn_attempts(view)
    blocks = [(attempt, block) for attempt in attempts for block in view.blocks(attempt)]
    parts = [(attempt, block, block_series(block)) for attempt, block in blocks if len(block)]
    if not parts:
        raise DataError(f"{path}: has no turn yet; resume the session")
    time_s = np.concatenate([block.time_s + attempt.offset_s for attempt, block, _ in parts])
    series: dict[str, Any] = {
        name: np.concatenate([part[name] for _, _, part in parts]) for name in parts[0][2]
    }
    facts = _facts(view, attempts) | {"complete": not reason, "dwells": [], "broken_off": reason}
    notes = [doubt["message"] for doubt in facts["doubts"]]
    if reason:
        length_s = time_s[-1] - time_s[0]
        notes.append(
            f"the turn was broken off after {length_s:.0f} s: {reason}; --resume records a new one"
        )
    dropped = _dropped(view)
    notes += _scan_notes(
        facts,
        sum(block.lost for _, block in blocks),
        sum(dropped.get(attempt.number, 0) for attempt in attempts),
        "during the turn",
    )
    recording = Dwell(0, time_s, **series)
    return _session(path, view.header, facts, notes, dwells=(), recording=recording, free_turn=True)


def _dropped(view: ArchiveView) -> dict[int, int]:
    """Return the number of scans that were left out of each attempt, by its number."""
    return {one["attempt"]: one["scans"] for one in view.values("dropped")}


def _facts(view: ArchiveView, attempts: Sequence[Attempt]) -> JsonDict:
    """Return facts that both sessions of dwells and free turns have, such as settings and plan.

    `attempts` are the dwells of the session, or the pieces of its free turn.
    """
    header, truth = view.header, view.last("truth")
    return {
        "url": header.url,
        "note": header.note,
        # A simulated board that a hand moves gives simulated samples too, although its truth is unknown.
        "simulated": header.simulated or header.url.startswith("sim:"),
        "software": header.software,
        "started_utc": header.created_utc,
        "ended_utc": max(attempt.started_utc for attempt in attempts),
        "settings": dict(header.settings),
        "plan": view.plan().as_dict(),
        "configuration": view.last("configuration"),
        "registers": {when: view.last(f"registers-{when}") for when in ("before", "configured", "after")},
        "runs": view.runs(),
        "problems": view.values("problem"),
        "remarks": view.values("remark"),
        "scanning": view.last("scanning"),
        "offset_writes": view.offset_writes(),
        "advised": view.values("advised"),
        "reversed": bool(view.last("reversed")),
        "doubts": view.doubts() + _changed_registers(view),
        "skipped": sorted(view.skipped()),
        **({"truth": truth} if header.simulated and truth is not None else {}),
    }


def _session(
    path: str | Path, header: Header, facts: JsonDict, notes: Sequence[str], **found: Any
) -> Session:
    """Create the session with the metadata of the header and the data in `found`.

    `found` has keyword arguments of `Session`, such as its dwells.
    """
    return Session(
        sensor=header.variant,
        accel_unit="mg" if header.variant == GENERIC else "lsb",
        stage_curve=None if header.stage_curve is None else StageCurve.of(header.stage_curve),
        **{n: getattr(header, n) for n in ("gravity_mps2", "fixture_sigma_deg", "title", *METADATA)},
        source=str(path),
        notes=(*notes, *describe_later_writes(facts)),
        facts=facts,
        **found,
    )


def describe_later_writes(facts: JsonDict) -> tuple[str, ...]:
    """Return remarks on offsets that were written to the sensor after the recording; empty without writes.

    `facts` are the facts of the session.
    """
    if not facts.get("offset_writes") or not facts["registers"]["configured"]:
        return ()
    recorded = facts["registers"]["configured"]
    from adis_gonio.record.write_journal import describe_writes, operations

    return describe_writes(operations(facts["offset_writes"]), recorded)


def _dwell(number: int, attempt: Attempt, scans: Block, sign: int) -> Dwell:
    return Dwell(
        number,
        scans.time_s + attempt.offset_s,
        angle_deg=None if attempt.position.angle_deg is None else sign * attempt.position.angle_deg,
        approach=sign * attempt.position.approach,
        use=attempt.position.use,
        **block_series(scans),
    )


def _changed_registers(view: ArchiveView) -> list[JsonDict]:
    """Return a list with one reason to doubt the session if registers changed during it; else empty.

    The reason has the form of the entries of `ArchiveView.doubts`.
    """
    then, now = view.last("registers-configured"), view.last("registers-after")
    changed = changed_settings(then or {}, now or {})
    if not changed:
        return []
    # SENS_AVG and SMPL_PRD are never both zeros or both ones: such replies come from a stuck line.
    held = {(now or {}).get(name, 1) for name in ("SENS_AVG", "SMPL_PRD")}
    level = "zeros" if held == {0x0000} else "ones" if held == {0xFFFF} else ""
    listed = ", ".join(f"{name} {before} → {after}" for name, (before, after) in changed.items())
    message = (
        f"the sensor's registers could not be compared at the end of the session: replies were {level}"
        ", the data line (MISO) was stuck; check the line, then measure again"
        if level
        else f"the sensor's settings changed while the session was recorded ({listed}): it restarted, or"
        " somebody wrote to it, and dwells from before and after do not agree"
    )
    return [{"attempt": None, "kind": "registers", "message": message}]


def _doubtful(plan: Plan, doubt: JsonDict) -> str:
    if doubt["kind"] == "registers":
        return str(doubt["message"])
    if doubt["attempt"] is None:
        where = plan.positions[doubt["place"]]
        return f"{where} contradicted dwells before it and was skipped: {doubt['message']}"
    return f"attempt {doubt['attempt']} was kept: {doubt['message']}"


def _notes(plan: Plan, pending: Sequence[int], skipped: set[int], facts: JsonDict) -> tuple[str, ...]:
    notes, dwells = [], facts["dwells"]
    if pending:
        notes.append(
            f"unfinished session: {len(dwells)} of {counted(len(plan), 'position')} of plan"
            f" '{plan.name}' done"
        )
    if facts["reversed"]:
        notes.append("turned the other way: every angle of the plan was taken with the other sign")
    notes += [_doubtful(plan, doubt) for doubt in facts["doubts"]]
    if skipped:
        notes.append(f"skipped: {', '.join(str(plan.positions[place]) for place in sorted(skipped))}")
    lost, dropped = (sum(dwell[name] for dwell in dwells) for name in ("lost", "dropped"))
    notes += _scan_notes(facts, lost, dropped, "within the dwells")
    for number, dwell in enumerate(dwells):
        if dwell["alarms"] is not None:
            where = plan.positions[dwell["place"]]
            notes.append(f"dwell {number} ({where}): {Alarms(**dwell['alarms'])}")
    return tuple(notes)


def _scan_notes(facts: JsonDict, lost: int, dropped: int, where: str) -> list[str]:
    """Return remarks on numbers of lost and dropped scans, and on the way in which scans were read."""
    notes = [f"{counted(lost, 'scan')} lost on the bus {where}"] if lost else []
    notes += [f"{counted(dropped, 'scan')} {where} left out: {WITHOUT_NEWS}"] if dropped else []
    return notes + ([facts["scanning"]["caveat"]] if (facts["scanning"] or {}).get("caveat") else [])
