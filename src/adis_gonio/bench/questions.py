"""Putting questions to the operator, and hearing what is said unasked: remarks, pause, stop."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator

import numpy as np

from adis_gonio.bench.answers import Inbox, Reply
from adis_gonio.bench.bench import SessionBench
from adis_gonio.bench.events import Event, GuardRaised, Noted, Paused, Unpaused, Waiting, Watching
from adis_gonio.bench.knowledge import Knowledge
from adis_gonio.bench.ledger import Ledger
from adis_gonio.record.blocks import Block, join

PAUSE_STEP_S = 0.1
"""Between two looks for remarks during a pause, on the wall clock."""

KEPT_S = 120.0
"""What was scanned while a question stands is kept so long, where turns are kept: a turn and its rests."""

WAIT_STEP_S = 1.0
"""Between two looks at the clock and the operator during a wait."""


class Questions:
    """Asks, and hears.

    Parameters
    ----------
    auto : bool
        Nobody is there to ask: every question has its default for an answer.
    """

    def __init__(
        self, inbox: Inbox, bench: SessionBench, ledger: Ledger, knowledge: Knowledge, *, auto: bool
    ) -> None:
        self.auto = auto
        self._inbox = inbox
        self._bench = bench
        self._ledger = ledger
        self._knowledge = knowledge
        self._seen: list[Block] = []

    def take_seen(self) -> list[Block]:
        """What was scanned while the last question stood, where turns are kept; once.

        As one block: rows of the file that hold a few scans each would take half as much again.
        """
        seen, self._seen = self._seen, []
        return [join(seen)] if seen else []

    def _keep(self, block: Block) -> None:
        """Keep scans of a turn that is under way."""
        if not self._bench.settings.turns or not len(block):
            return
        self._seen.append(block)
        while float(block.time_s[-1]) - float(self._seen[0].time_s[-1]) > KEPT_S:
            del self._seen[0]

    @property
    def stopped(self) -> bool:
        """True once the session is to end."""
        return self._inbox.stopping.is_set()

    @property
    def interrupted(self) -> bool:
        """True where the session is to end or to stand still."""
        return self._inbox.interrupting

    @property
    def why_interrupted(self) -> str:
        """The reason of a dwell that this broke off."""
        return f"{'stopped' if self.stopped else 'paused'} by the operator"

    def ask(
        self, question: Event, answers: set[Reply], default: Reply, place: int | None = None
    ) -> Generator[Event, None, Reply]:
        """Put a question until it is answered; after a pause it is put again."""
        if self._ledger.last_place is not None and not isinstance(question, GuardRaised):
            answers = answers | {Reply.REPEAT, Reply.UNDO}
        idle: _Idle | None = None
        self._seen = []
        try:
            while not self.stopped:
                self._inbox.open(frozenset(answers))
                yield question
                while not self.interrupted:
                    if (answer := self._inbox.given()) is not None:
                        return answer
                    if self.auto:
                        return default
                    yield from self.remarks(place)
                    idle = idle or _Idle(self._bench, self._knowledge, self._keep)
                    yield idle.look()
                idle = None
                yield from self.heed(place)
            return Reply.STOP
        finally:
            self._inbox.open(frozenset())
            self._bench.close_stream()

    def heed(self, place: int | None) -> Iterator[Event]:
        """Keep what the operator has remarked, and pause where that was asked for."""
        yield from self.remarks(place)
        if not self._inbox.pausing.is_set():
            return
        self._inbox.open(frozenset())
        self._bench.close_stream()
        self._ledger.note("paused", place)
        yield Paused(place)
        while self._inbox.pausing.is_set() and not self.stopped:
            yield from self.remarks(place)
            self._inbox.going_on.wait(PAUSE_STEP_S)
        self._ledger.note("unpaused", {"place": place})
        yield Unpaused(place)

    def remarks(self, place: int | None) -> Iterator[Event]:
        """Keep what the operator has remarked."""
        for remark in self._inbox.said():
            self._ledger.note("remark", {"text": remark.text, "utc": remark.utc, "place": place})
            yield Noted(remark.text)

    def wait(self, place: int, length_s: float) -> Generator[Event, None, bool]:
        """Wait before a dwell; True where the operator stopped or paused it."""
        end_s = self._bench.now_s + length_s
        while length_s > 0 and (left := end_s - self._bench.now_s) > 0:
            if self.interrupted:
                return True
            yield from self.remarks(place)
            yield Waiting(place, length_s - left, length_s)
            self._bench.source.sleep_s(min(left, WAIT_STEP_S))
        return False


class _Idle:
    """The newest samples while a question stands."""

    def __init__(self, bench: SessionBench, knowledge: Knowledge, keep: Callable[[Block], None]) -> None:
        self._keep = keep
        self._stream = bench.scans()
        self._window = bench.window
        self._knowledge = knowledge
        self._kept = np.empty((0, 3))

    def look(self) -> Watching:
        for block in self._stream:
            self._knowledge.see(block)
            self._keep(block)
            self._kept = np.concatenate([self._kept, block.accel_mg])[-self._window :]
            if len(self._kept) > 1:
                break
        view = self._knowledge.view
        return view.watching(
            "idle",
            self._kept.mean(axis=0),
            self._kept.std(axis=0, ddof=1),
            None if view.target is None else view.target.angle_deg,
            "an answer",
        )


__all__ = ["Questions"]
