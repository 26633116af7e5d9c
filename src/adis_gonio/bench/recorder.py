"""The base of the recorders of a session, and a turn that is followed while its scans come in.

A plan chooses its recorder (`recorder_of`): dwells at positions, one free turn, or dwells between the whole
turns of gyros. The session around it is the same.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator
from typing import ClassVar

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.bench.bench import SessionBench
from adis_gonio.bench.dialogue import Questions
from adis_gonio.bench.events import Event, StageMoved, TurnDone, TurnProgress
from adis_gonio.record.archive_tables import Attempt, Move, Outcome, Phase, utc_now
from adis_gonio.record.blocks import Block
from adis_gonio.record.plans import GYRO_TURNS, Plan, Position
from adis_gonio.record.session_reader import FREE_TURN, GOES_ON

BROKEN_STREAM = "the stream of scans ended"


class FollowedTurn(ABC):
    """A turn as its scans come in.

    Attributes
    ----------
    phase : {"dwell", "before"}
        Phase of its scans in the archive.
    rest_before_s : float
        Rest before the turn begins.
    piece_s : float
        Length of the pieces in which it goes into the archive.
    limit_s : float
        Longest time of the recording.
    turns : int
        Full turns to make.
    blocks, moves : list
        Scans and moves that are not in the archive yet.
    turned_deg, rate_dps : float
        Counter-clockwise positive: since the beginning, and now.
    turns_made : int
        Full turns so far.
    travelled_deg : float
        Length of the whole way, there and back.
    rest_s, peak_dps : float
        As in `TurnProgress`.
    """

    phase: ClassVar[Phase] = "dwell"
    rest_before_s: ClassVar[float]
    piece_s: ClassVar[float] = math.inf

    def __init__(self, place: int, position: Position, turns: int, limit_s: float, now_s: float) -> None:
        self.place, self.position, self.turns, self.limit_s = place, position, turns, limit_s
        self.blocks: list[Block] = []
        self.moves: list[Move] = []
        self.began = utc_now(), now_s
        self.samples = self.lost = self.turns_made = 0
        self.length_s = self.written_s = self.rest_s = self.peak_dps = 0.0
        self.turned_deg = self.rate_dps = self.travelled_deg = 0.0
        self._first_s: float | None = None

    @abstractmethod
    def see(self, block: Block) -> None:
        """Follow the turn through scans, of which there is at least one."""

    @abstractmethod
    def begin(self, bench: SessionBench) -> bool:
        """Let the stage begin to turn; False where nothing can be turned."""

    @property
    @abstractmethod
    def full(self) -> bool:
        """True once the turns were made."""

    @property
    @abstractmethod
    def ended(self) -> str | None:
        """None while the recording goes on; at its end an error message, empty if there is none."""

    def add(self, block: Block) -> None:
        """Take scans."""
        self.blocks.append(block)
        self.samples += len(block)
        self.lost += block.lost
        if len(block):
            self._first_s = float(block.time_s[0]) if self._first_s is None else self._first_s
            self.length_s = float(block.time_s[-1]) - self._first_s
            self.see(block)

    def progress(self, *, begun: bool) -> TurnProgress:
        """The event of a look at it."""
        return TurnProgress(
            ("after" if self.full else "turn") if begun else "rest",
            self.length_s,
            self.limit_s,
            self.samples,
            self.lost,
            self.turned_deg,
            self.rate_dps,
            min(self.turns_made + 1, self.turns),
            self.turns,
            self.rest_s,
            self.peak_dps,
        )

    def done(self, number: int) -> TurnDone:
        """The event of its end, when it is in the archive as an attempt."""
        return TurnDone(
            number,
            self.turned_deg,
            self.length_s,
            self.samples,
            self.lost,
            self.turns_made,
            self.travelled_deg,
        )


class Recorder(ABC):
    """Records the places of a plan into the archive and the ledger.

    Attributes
    ----------
    one_recording : bool
        True where the session is one continuous recording and visits no positions.
    judges_places : bool
        True where each place is judged by gravity.
    """

    one_recording: ClassVar[bool] = False
    judges_places: ClassVar[bool] = True

    def __init__(self, questions: Questions) -> None:
        self._questions = questions
        self._bench, self._ledger, self._knowledge = questions.bench, questions.ledger, questions.knowledge

    @abstractmethod
    def take(self, place: int) -> Iterator[Event]:
        """Record a place."""

    def _record_turn(self, turn: FollowedTurn) -> Generator[Event, None, str]:
        """Record a turn until it ends and return why it was broken off, or nothing.

        If an error ends it, the scans so far are archived.
        """
        try:
            return (yield from self._follow(turn))
        except BaseException as error:
            self._write(turn, "interrupted", why_broken_off(error))
            raise

    def _follow(self, turn: FollowedTurn) -> Generator[Event, None, str]:
        begun = False
        for block in self._bench.scans():
            turn.add(block)
            if turn.length_s - turn.written_s >= turn.piece_s:
                self._write(turn, "interrupted", GOES_ON)
            self._knowledge.see(block)
            if not begun and turn.length_s >= turn.rest_before_s:
                begun = True
                if turn.begin(self._bench):
                    yield StageMoved(turn.position)
            yield turn.progress(begun=begun)
            if self._questions.interrupted:
                return self._questions.why_interrupted
            yield from self._questions.remarks(turn.place)
            if (ended := turn.ended) is not None:
                return ended
        return BROKEN_STREAM

    def _write(self, turn: FollowedTurn, outcome: Outcome, reason: str, status: int | None = None) -> int:
        """Archive the remaining scans of a turn as an attempt, and return its number."""
        now_s = self._bench.now_s
        blocks = [(turn.phase, block) for block in turn.blocks]
        number = self._ledger.archive.add_attempt(
            Attempt(
                turn.place, turn.position, outcome, *turn.began, now_s, blocks, turn.moves, reason, status
            )
        )
        turn.blocks, turn.moves, turn.written_s = [], [], turn.length_s
        turn.began = utc_now(), now_s
        return number


def why_broken_off(error: BaseException) -> str:
    """Reason of an attempt that an error ended."""
    return str(error) if isinstance(error, AdisGonioError) else "the program ended"


def recorder_of(plan: Plan) -> type[Recorder]:
    """The recorder that a plan takes."""
    if plan.name == GYRO_TURNS:
        from adis_gonio.bench.gyro_turns import GyroTurnsRecorder

        return GyroTurnsRecorder
    if plan.name == FREE_TURN:
        from adis_gonio.bench.free_turn import FreeTurnRecorder

        return FreeTurnRecorder
    from adis_gonio.bench.dwelling import DwellRecorder

    return DwellRecorder
