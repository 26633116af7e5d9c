"""Dialogue with the operator: answers from any thread, and the questions of a running session."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator, Iterator
from enum import StrEnum
from typing import TypeVar

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.bench.events import Event, Guard, GuardRaised, Noted, Paused, Unpaused, Waiting
from adis_gonio.bench.session_bench import SessionBench
from adis_gonio.bench.session_state import Knowledge, Ledger
from adis_gonio.record.archive_tables import JsonDict, utc_now
from adis_gonio.record.blocks import Block, join

T = TypeVar("T")

KEPT_S = 120.0
"""Length in s of the newest scans of a question that are kept if turns are recorded.

It is enough for a turn and the rests before and after it.
"""
MOST_JOINED = 40_000
"""Largest number of scans in a joined block, which has to fit into a row of the archive."""


class Reply(StrEnum):
    """Answers that the operator may give to a question."""

    CONFIRM = "confirm"
    """The sensor is in the requested position, or the stage may go there."""
    SKIP = "skip"
    """The requested position is skipped."""
    REPEAT = "repeat"
    """The last dwell is repeated; the new dwell replaces the old one, which stays in the archive."""
    UNDO = "undo"
    """The newest dwell is withdrawn; it stays in the archive, and its position is asked for again."""
    KEEP = "keep"
    RETAKE = "retake"
    REVERSE = "reverse"
    ACCEPT = "accept"
    """An offer, such as further positions, is accepted."""
    DECLINE = "decline"
    STOP = "stop"


class Operator:
    """Gives the answers and remarks of the operator to a session; may be used from any thread.

    Attributes
    ----------
    stopping, pausing : threading.Event
        Flags that are set to end the session, and while it is paused.
    """

    def __init__(self) -> None:
        self._answers: queue.SimpleQueue[Reply] = queue.SimpleQueue()
        self._remarks: queue.SimpleQueue[JsonDict] = queue.SimpleQueue()
        self._allowed: frozenset[Reply] = frozenset()
        self.stopping = threading.Event()
        self.pausing = threading.Event()

    def open_question(self, answers: frozenset[Reply]) -> None:
        """Open a question with these possible answers, and discard late answers to earlier questions."""
        while not self._answers.empty():
            self._answers.get_nowait()
        self._allowed = answers

    def take_answer(self) -> Reply | None:
        """Remove and return the answer to the open question; None if there is none yet."""
        try:
            answer = self._answers.get_nowait()
        except queue.Empty:
            return None
        self._allowed = frozenset()
        return answer

    def take_remarks(self) -> list[JsonDict]:
        """Remove and return the remarks since the last call, each with its `text` and its time `utc`."""
        return [self._remarks.get_nowait() for _ in range(self._remarks.qsize())]

    def answer(self, answer: Reply | str) -> None:
        """Answer the open question by a reply or its name, such as one of `GuardRaised.answers`.

        Raises
        ------
        UsageError
            The reply is not among the possible answers of the open question.
        """
        if answer == Reply.STOP:
            self.stop()
            return
        if answer not in self._allowed:
            possible = ", ".join(sorted(self._allowed)) or "nothing"
            raise UsageError(f"'{answer}' does not answer the open question (possible: {possible})")
        self._answers.put(Reply(answer))

    def stop(self) -> None:
        """End the session now; it can be resumed. An unfinished dwell is archived as interrupted."""
        self.stopping.set()

    def pause(self) -> None:
        """Pause the session until `unpause`; an unfinished dwell is archived as interrupted."""
        self.pausing.set()

    def unpause(self) -> None:
        """Continue the session after a pause: the open question is asked again."""
        self.pausing.clear()

    def note(self, text: str) -> None:
        """Record the remark `text` in the session, with the time and the present position."""
        if text.strip():
            self._remarks.put({"text": text.strip(), "utc": utc_now()})


class Questions:
    """Asks the operator questions during a session and takes the answers.

    Attributes
    ----------
    bench : SessionBench
        Sensor and stage of the session.
    ledger : Ledger
        Dwells done and decisions made in the session.
    knowledge : Knowledge
        Present knowledge from scans and dwells.
    auto : bool
        True without an operator: every question is answered by its default.
    """

    def __init__(
        self, operator: Operator, bench: SessionBench, ledger: Ledger, knowledge: Knowledge, *, auto: bool
    ) -> None:
        self.bench, self.ledger, self.knowledge, self.auto = bench, ledger, knowledge, auto
        self._operator = operator
        self._scanned: list[Block] = []

    def take_scanned(self) -> list[Block]:
        """Return the scans read during the last question, as a list of blocks.

        The list is empty if no scans were kept: they are kept if turns are recorded. They are joined to
        long blocks, because many short blocks would make the file half as large again.
        """
        seen, self._scanned = self._scanned, []
        size = max(1, MOST_JOINED // max(map(len, seen), default=1))
        return [join(seen[at : at + size]) for at in range(0, len(seen), size)]

    @property
    def stopped(self) -> bool:
        """True if the operator has asked to end the session."""
        return self._witness("stopped", self._operator.stopping.is_set)

    @property
    def interrupted(self) -> bool:
        """True if the operator has asked to end or to pause the session."""
        return self.stopped or self._pausing

    @property
    def _pausing(self) -> bool:
        return self._witness("paused", self._operator.pausing.is_set)

    def _witness(self, name: str, observe: Callable[[], T]) -> T:
        """Return `observe()`, an act of the operator; in a replay return the recorded act of this name."""
        return self.bench.source.witness(name, observe)

    @property
    def why_interrupted(self) -> str:
        """Reason for the archive why a dwell was interrupted: stopped or paused by the operator."""
        return f"{'stopped' if self.stopped else 'paused'} by the operator"

    def ask(
        self, question: Event, answers: set[Reply], default: Reply, place: int | None = None
    ) -> Generator[Event, None, Reply]:
        """Ask a question, wait for the answer and return it; after a pause the question is asked again.

        Parameters
        ----------
        question : Event
            Event that shows the question.
        answers : set of Reply
            Possible answers; repeat and undo are added if there is a dwell and no guard asks.
        default : Reply
            Answer without an operator.
        place : int or None
            Index of the position in the plan that the question is about; None if it is about no position.

        Returns
        -------
        Reply
            The answer; `Reply.STOP` if the operator ends the session.
        """
        if self.ledger.last_place is not None and not isinstance(question, GuardRaised):
            answers = answers | {Reply.REPEAT, Reply.UNDO}
        newest: Floats | None = None
        knowledge, self._scanned = self.knowledge, []
        try:
            while not self.stopped:
                self._operator.open_question(frozenset(answers))
                yield question
                while not self.interrupted:
                    if (answer := self._witness("answer", self._operator.take_answer)) is not None:
                        return Reply(answer)
                    if self.auto:
                        return default
                    yield from self.remarks(place)
                    newest = self._look(newest)
                    target_deg = None if knowledge.target is None else knowledge.target.angle_deg
                    mean, spread = newest.mean(axis=0), newest.std(axis=0, ddof=1)
                    yield knowledge.watching("idle", mean, spread, target_deg, "an answer")
                newest = None
                yield from self.handle_pause(place)
            return Reply.STOP
        finally:
            self._operator.open_question(frozenset())
            self.bench.close_stream()

    def _look(self, before: Floats | None) -> Floats:
        """Read scans and return the newest accelerations (n, 3) in mg, at most one window of them.

        `before` are the accelerations of the last call; None at the first call.
        """
        newest = np.empty((0, 3)) if before is None else before
        for block in self.bench.scans():
            self.knowledge.see(block)
            if self.bench.settings.turns and len(block):
                self._scanned.append(block)
                while float(block.time_s[-1]) - float(self._scanned[0].time_s[-1]) > KEPT_S:
                    del self._scanned[0]
            newest = np.concatenate([newest, block.accel_mg])[-self.bench.window :]
            if len(newest) > 1:
                break
        return newest

    def ask_guard(self, guard: Guard, place: int) -> Generator[Event, None, Reply]:
        """Ask the question of a guard, record the answer and return it.

        `place` is the index of the position in the plan.
        """
        raised = GuardRaised(**vars(guard), place=place, position=self.ledger.plan.positions[place])
        allowed = {Reply(name) for name in guard.answers}
        answer = yield from self.ask(raised, allowed, Reply(guard.default), place)
        asked = {"place": place, "kind": guard.kind, "message": guard.message, "answer": answer}
        self.ledger.note("guard", asked)
        return answer

    def handle_pause(self, place: int | None) -> Iterator[Event]:
        """Record the operator's remarks and, if a pause was requested, wait for its end.

        `place` is the index of the present position in the plan; None if there is none.
        """
        yield from self.remarks(place)
        if not self._pausing:
            return
        self._operator.open_question(frozenset())
        self.bench.close_stream()
        self.ledger.note("paused", place)
        yield Paused()
        while self._pausing and not self.stopped:
            yield from self.remarks(place)
            self._operator.stopping.wait(0.1)  # s on the wall clock until remarks are read again
        self.ledger.note("unpaused", {"place": place})
        yield Unpaused()

    def remarks(self, place: int | None) -> Iterator[Event]:
        """Write the operator's new remarks to the archive, with the position's index `place` (or None)."""
        for remark in self._witness("remarks", self._operator.take_remarks):
            self.ledger.note("remark", remark | {"place": place})
            yield Noted(remark["text"])

    def wait(self, place: int, length_s: float) -> Generator[Event, None, bool]:
        """Wait `length_s` before the dwell of a place; return True if the operator stopped or paused."""
        end_s = self.bench.now_s + length_s
        while length_s > 0 and (left := end_s - self.bench.now_s) > 0:
            if self.interrupted:
                return True
            yield from self.remarks(place)
            yield Waiting(place, length_s - left, length_s)
            self.bench.source.sleep_s(min(left, 1.0))
        return False
