"""What an operator says to a running session, from any thread, and how the session asks and hears it."""

from __future__ import annotations

import queue
import threading
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.bench.events import Event, GuardRaised, Noted, Paused, Unpaused, Waiting, Watching
from adis_gonio.bench.guards import Guard
from adis_gonio.bench.session_bench import SessionBench
from adis_gonio.bench.session_state import Knowledge, Ledger
from adis_gonio.record.archive_tables import utc_now
from adis_gonio.record.blocks import Block, join

PAUSE_STEP_S = 0.1
"""Between two looks for remarks during a pause, on the wall clock."""

KEPT_S = 120.0
"""What was scanned while a question stands is kept so long, where turns are kept: a turn and its rests."""

WAIT_STEP_S = 1.0
"""Between two looks at the clock and the operator during a wait."""


class Reply(StrEnum):
    """Answers to a question."""

    CONFIRM = "confirm"
    SKIP = "skip"
    REPEAT = "repeat"
    UNDO = "undo"
    KEEP = "keep"
    RETAKE = "retake"
    REVERSE = "reverse"
    ACCEPT = "accept"
    DECLINE = "decline"
    STOP = "stop"


@dataclass(frozen=True)
class Remark:
    """A note of the operator.

    Attributes
    ----------
    utc : str
        Wall clock at which it was given.
    """

    text: str
    utc: str


class Inbox:
    """What an operator has said and the session has not heard yet; safe between threads.

    Attributes
    ----------
    stopping, pausing, going_on : threading.Event
        Set while the session is to end, to stand still, not to stand still any more.
    """

    def __init__(self) -> None:
        self._answers: queue.SimpleQueue[Reply] = queue.SimpleQueue()
        self._remarks: queue.SimpleQueue[Remark] = queue.SimpleQueue()
        self._allowed: frozenset[Reply] = frozenset()
        self.stopping = threading.Event()
        self.pausing = threading.Event()
        self.going_on = threading.Event()

    @property
    def interrupting(self) -> bool:
        """True where the session is to end or to stand still."""
        return self.stopping.is_set() or self.pausing.is_set()

    def answer(self, answer: Reply | str) -> None:
        """Put an answer in; `UsageError` where it is none to the question that stands."""
        if answer not in self._allowed:
            asked = ", ".join(sorted(self._allowed)) or "nothing"
            raise UsageError(f"'{answer}' answers no question that stands (open: {asked})")
        self._answers.put(Reply(answer))

    def remark(self, text: str) -> None:
        """Put a remark in."""
        self._remarks.put(Remark(text, utc_now()))

    def open(self, answers: frozenset[Reply]) -> None:
        """Let a question stand: what was said to another one is forgotten."""
        while not self._answers.empty():
            self._answers.get_nowait()
        self._allowed = answers

    def given(self) -> Reply | None:
        """The answer to the question that stands; None while there is none."""
        try:
            answer = self._answers.get_nowait()
        except queue.Empty:
            return None
        self._allowed = frozenset()
        return answer

    def said(self) -> list[Remark]:
        """Remarks that have not been taken yet."""
        remarks = []
        while not self._remarks.empty():
            remarks.append(self._remarks.get_nowait())
        return remarks


class Operator:
    """The operator's side of a session; every method may be called from any thread."""

    def __init__(self) -> None:
        self._inbox = Inbox()

    def answer(self, answer: Reply | str) -> None:
        """Answer the question that stands, by the answer's name; one of `GuardRaised.answers`, say.

        Raises
        ------
        UsageError
            It is no answer to a question that stands.
        """
        if answer == Reply.STOP:
            self.stop()
            return
        self._inbox.answer(answer)

    def confirm(self) -> None:
        """The part is (or the stage may go) where it was asked to be."""
        self.answer(Reply.CONFIRM)

    def skip(self) -> None:
        """Leave this position out."""
        self.answer(Reply.SKIP)

    def repeat(self) -> None:
        """Do the last dwell again; the new one takes its place, the old one stays in the archive."""
        self.answer(Reply.REPEAT)

    def undo(self) -> None:
        """Withdraw the newest dwell: it stays in the archive, marked, and its position is asked again."""
        self.answer(Reply.UNDO)

    def keep(self) -> None:
        """Keep what a guard stopped at, as it is; what cannot be right is told at the end."""
        self.answer(Reply.KEEP)

    def retake(self) -> None:
        """Go back to the position that a guard stopped at: it is asked for again."""
        self.answer(Reply.RETAKE)

    def reverse(self) -> None:
        """The stage's angles count the other way: take the whole session so."""
        self.answer(Reply.REVERSE)

    def accept(self) -> None:
        """Go on with what was offered."""
        self.answer(Reply.ACCEPT)

    def decline(self) -> None:
        """Leave what was offered."""
        self.answer(Reply.DECLINE)

    def stop(self) -> None:
        """End the session now; a dwell in hand is archived as interrupted. It can be resumed."""
        self._inbox.stopping.set()

    def pause(self) -> None:
        """Close the stream and judge nothing until `unpause`; a dwell in hand is archived as broken off."""
        self._inbox.going_on.clear()
        self._inbox.pausing.set()

    def unpause(self) -> None:
        """Go on after a pause: the question is put again."""
        self._inbox.pausing.clear()
        self._inbox.going_on.set()

    def note(self, text: str) -> None:
        """Keep a remark with the session, with its time and place."""
        if text.strip():
            self._inbox.remark(text.strip())


class Questions:
    """Asks, and hears.

    Attributes
    ----------
    bench, ledger, knowledge
        Of the session.
    auto : bool
        Nobody is there to ask: every question has its default for an answer.
    """

    def __init__(
        self, inbox: Inbox, bench: SessionBench, ledger: Ledger, knowledge: Knowledge, *, auto: bool
    ) -> None:
        self.bench, self.ledger, self.knowledge, self.auto = bench, ledger, knowledge, auto
        self._inbox = inbox
        self._seen: list[Block] = []

    def take_seen(self) -> list[Block]:
        """What was scanned while the last question stood, where turns are kept; once.

        As one block: rows of the file that hold a few scans each would take half as much again.
        """
        seen, self._seen = self._seen, []
        return [join(seen)] if seen else []

    def _keep(self, block: Block) -> None:
        """Keep scans of a turn that is under way."""
        if not self.bench.settings.turns or not len(block):
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
        if self.ledger.last_place is not None and not isinstance(question, GuardRaised):
            answers = answers | {Reply.REPEAT, Reply.UNDO}
        newest: Floats | None = None
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
                    newest = self._look(newest)
                    yield self._watching(newest)
                newest = None
                yield from self.heed(place)
            return Reply.STOP
        finally:
            self._inbox.open(frozenset())
            self.bench.close_stream()

    def _look(self, before: Floats | None) -> Floats:
        """The newest accelerations (n, 3), at most a window of them, while a question stands."""
        newest = np.empty((0, 3)) if before is None else before
        for block in self.bench.scans():
            self.knowledge.see(block)
            self._keep(block)
            newest = np.concatenate([newest, block.accel_mg])[-self.bench.window :]
            if len(newest) > 1:
                break
        return newest

    def _watching(self, newest: Floats) -> Watching:
        view = self.knowledge.view
        target_deg = None if view.target is None else view.target.angle_deg
        mean, spread = newest.mean(axis=0), newest.std(axis=0, ddof=1)
        return view.watching("idle", mean, spread, target_deg, "an answer")

    def ask_guard(
        self, guard: Guard, place: int, shown: Guard | None = None
    ) -> Generator[Event, None, Reply]:
        """Put what a guard stopped at, in the words of `shown` if given; write the answer down."""
        shown, position = shown or guard, self.ledger.plan.positions[place]
        raised = GuardRaised(
            guard.kind, shown.message, place, position, shown.values, guard.answers, guard.default
        )
        allowed = {Reply(name) for name in guard.answers}
        answer = yield from self.ask(raised, allowed, Reply(guard.default), place)
        asked = {"place": place, "kind": guard.kind, "message": guard.message, "answer": answer}
        self.ledger.note("guard", asked)
        return answer

    def heed(self, place: int | None) -> Iterator[Event]:
        """Keep what the operator has remarked, and pause where that was asked for."""
        yield from self.remarks(place)
        if not self._inbox.pausing.is_set():
            return
        self._inbox.open(frozenset())
        self.bench.close_stream()
        self.ledger.note("paused", place)
        yield Paused(place)
        while self._inbox.pausing.is_set() and not self.stopped:
            yield from self.remarks(place)
            self._inbox.going_on.wait(PAUSE_STEP_S)
        self.ledger.note("unpaused", {"place": place})
        yield Unpaused(place)

    def remarks(self, place: int | None) -> Iterator[Event]:
        """Keep what the operator has remarked."""
        for remark in self._inbox.said():
            self.ledger.note("remark", {"text": remark.text, "utc": remark.utc, "place": place})
            yield Noted(remark.text)

    def wait(self, place: int, length_s: float) -> Generator[Event, None, bool]:
        """Wait before a dwell; True where the operator stopped or paused it."""
        end_s = self.bench.now_s + length_s
        while length_s > 0 and (left := end_s - self.bench.now_s) > 0:
            if self.interrupted:
                return True
            yield from self.remarks(place)
            yield Waiting(place, length_s - left, length_s)
            self.bench.source.sleep_s(min(left, WAIT_STEP_S))
        return False


__all__ = ["Inbox", "Operator", "Questions", "Remark", "Reply"]
