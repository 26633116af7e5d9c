"""What an operator says to a running session: answers, notes, pause and stop, from any thread."""

from __future__ import annotations

import queue
import threading
from dataclasses import dataclass
from enum import StrEnum

from adis_gonio.base.errors import UsageError
from adis_gonio.record.rows import utc_now


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
