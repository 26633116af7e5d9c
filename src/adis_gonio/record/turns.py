"""Turns of a session file: those between its dwells, and a free turn out of its pieces.

Turns between dwells are read when somebody asks for them: a fit without gyros costs nothing more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from adis_gonio.model.records import Dwell, Turn
from adis_gonio.record.blocks import Block, die_temperatures, join, session_columns, session_series
from adis_gonio.record.rows import StoredAttempt
from adis_gonio.record.view import ArchiveView

FREE_TURN = "free-turn"
"""Name of the plan."""
GOES_ON = "the turn goes on"
"""Reason of an attempt that is a piece of a free turn and not its last."""
TURNED = "turned"
"""Reason of an attempt that is a whole turn, and not a dwell; its scans are those before the next dwell."""


@dataclass(frozen=True)
class ArchivedTurns:
    """Reads the turns between the dwells of a session file.

    Attributes
    ----------
    path : Path
    attempts : tuple of int
        Attempts that are the session's dwells, in order: those of the time when it was read.
    """

    path: Path
    attempts: tuple[int, ...]

    def __call__(self) -> tuple[Turn, ...]:
        """Turns, one less than dwells; none where the file is not there any more or is another by now.

        Raises
        ------
        DataError
            As `ArchiveView`.
        """
        if not self.path.is_file():
            return ()
        with ArchiveView(self.path) as view, view.snapshot():
            stored = view.attempts()
            plan = view.plan()
            of_number = {attempt.number: attempt for attempt in stored}
            if not set(self.attempts) <= set(of_number):
                return ()
            dwells = [of_number[number] for number in self.attempts]
            made = []
            for k, (before, after) in enumerate(pairwise(dwells)):
                blocks = list(_between(view, stored, before, after))
                declared = plan.positions[after.place].turned_deg if after.place < len(plan) else None
                # A mark is reached from the place before it alone: of anything else nobody says how far.
                declared = declared if after.place == before.place + 1 else None
                made.append(_turn(k, blocks, after, declared))
        return tuple(made)


def _between(
    view: ArchiveView, stored: Sequence[StoredAttempt], before: StoredAttempt, after: StoredAttempt
) -> Iterator[Block]:
    """Scans from the end of a dwell to the beginning of another, in order.

    Attempts in between (interrupted ones, dwells that were repeated) belong to it with all their scans.
    Those of another run than the second dwell's are of another stream: left out, and the gap tells. Whole
    turns begin and end at a mark: the last one that was made counts, without what was tried before.
    """
    between = [a for a in stored if before.number < a.number < after.number and a.run == after.run]
    whole = [k for k, attempt in enumerate(between) if attempt.reason == TURNED]
    if whole:
        for attempt in between[whole[-1] :]:
            yield from view.blocks(attempt)
        yield from _part(view, after, last=False)
        return
    if before.run == after.run:
        yield from _part(view, before, last=True)
    for attempt in between:
        yield from view.blocks(attempt)
    yield from _part(view, after, last=False)


def _part(view: ArchiveView, attempt: StoredAttempt, *, last: bool) -> Iterator[Block]:
    yield from view.blocks(attempt, "after" if last else "before")


def _turn(number: int, blocks: list[Block], after: StoredAttempt, turned_deg: float | None) -> Turn:
    blocks = [block for block in blocks if len(block)]
    if not blocks:
        return Turn(number, number + 1, np.empty(0), np.empty((0, 3)), turned_deg=turned_deg)
    scans = join(blocks)
    return Turn(
        number,
        number + 1,
        scans.time_s + after.offset_s,
        turned_deg=turned_deg,
        temperatures_c=die_temperatures(scans),
        **session_series(session_columns(scans)),
    )


def recording_of(view: ArchiveView) -> tuple[Dwell | None, str]:
    """The whole of the last complete turn, else of the longest one, and what broke that one off.

    None where nothing was recorded.
    """
    chains: list[list[StoredAttempt]] = [[]]
    for attempt in view.attempts():
        if chains[-1] and chains[-1][-1].run != attempt.run:
            chains.append([])
        chains[-1].append(attempt)
        if attempt.reason != GOES_ON:
            chains.append([])
    taken = view.withdrawn()
    chains = [chain for chain in chains if chain and chain[-1].number not in taken]
    whole = [chain for chain in chains if chain[-1].outcome == "complete"]
    best = (
        whole[-1]
        if whole
        else max(chains, key=lambda c: c[-1].ended_bus_s - c[0].started_bus_s, default=None)
    )
    if best is None:
        return None, "nothing was recorded"
    reason = "" if whole else best[-1].reason.replace(GOES_ON, "the program ended")
    blocks = [(attempt, block) for attempt in best for block in view.blocks(attempt) if len(block)]
    return (_joined(blocks) if blocks else None), reason


def _joined(blocks: Sequence[tuple[StoredAttempt, Block]]) -> Dwell:
    columns = [session_columns(block) for _, block in blocks]
    whole = {name: np.concatenate([c[name] for c in columns]) for name in columns[0]}
    time_s = np.concatenate([block.time_s + attempt.offset_s for attempt, block in blocks])
    return Dwell(0, time_s, **session_series(whole))
