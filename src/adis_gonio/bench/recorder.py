"""Base class of recorders of dwells and turns, and the recorder of a free turn.

A plan chooses its recorder (`runner.RECORDERS`): dwells at positions, one free turn, or dwells between
whole turns on a table. All other parts of a session are common.

A free turn is one continuous recording, from a rest through turns to a rest. Its plan has one place, and
the whole recording is its dwell. Every few seconds a piece is archived as an attempt with the reason
`GOES_ON`; the last attempt is complete or has the reason of the interruption. A kill or a power cut loses
one piece at most. A resumed session asks for a new turn, and `record.session_reader` chooses
the best one.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from typing import ClassVar

from adis_gonio.base.arrays import wrap_degrees
from adis_gonio.base.errors import AdisGonioError, SessionError, UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.bench.dialogue import Questions
from adis_gonio.bench.events import Event, Problem, StageMoved, TurnDone, TurnProgress
from adis_gonio.bench.session_bench import SessionBench
from adis_gonio.device.sensor.settings import Status
from adis_gonio.model.records import Sweeps
from adis_gonio.record.archive_tables import Attempt, Move, Outcome, Phase
from adis_gonio.record.blocks import Block
from adis_gonio.record.plans import Plan, Position
from adis_gonio.record.session_reader import FREE_TURN, GOES_ON

BROKEN_STREAM = "the stream of scans ended"


class FollowedTurn(ABC):
    """A turn in progress: its angle is followed while its scans are recorded.

    Attributes
    ----------
    place, position : int, Position
        Index of the position in the plan, and the position.
    phase : {"dwell", "before"}
        Phase of its scans in the archive.
    rest_before_s : float
        Rest before the turn begins, in s.
    piece_s : float
        Length of the pieces in which the recording is archived, in s.
    limit_s : float
        Longest time of the recording, in s.
    turns : int
        Number of requested full turns.
    began : (str, float)
        Beginning of the piece that is not archived yet: UTC, and time on the bus's clock in s.
    blocks, moves : list
        Scans and moves that are not archived yet.
    sweeps : Sweeps
        Turn so far, counter-clockwise positive: present angle, full turns and travel.
    rate_dps : float
        Present rate, counter-clockwise positive.
    samples, lost, length_s : int, int, float
        Number of samples so far, of scans lost, and time since the beginning in s.
    """

    phase: ClassVar[Phase] = "dwell"
    rest_before_s: ClassVar[float]
    piece_s: ClassVar[float] = math.inf

    def __init__(
        self, place: int, position: Position, turns: int, limit_s: float, began: tuple[str, float]
    ) -> None:
        self.place, self.position, self.turns, self.limit_s = place, position, turns, limit_s
        self.blocks: list[Block] = []
        self.moves: list[Move] = []
        self.began = began
        self.sweeps = Sweeps()
        self.samples = self.lost = 0
        self.length_s = self.written_s = self.rate_dps = 0.0
        self._first_s: float | None = None

    @abstractmethod
    def see(self, block: Block) -> None:
        """Update the turn by a block with at least one scan."""

    @abstractmethod
    def begin(self, bench: SessionBench) -> bool:
        """Start the turn of the stage; return False if the stage cannot turn and a hand has to."""

    @property
    @abstractmethod
    def full(self) -> bool:
        """True if the requested turns were made."""

    @property
    @abstractmethod
    def ended(self) -> str | None:
        """None during the recording; at its end an error message, which is empty if all is well."""

    def add(self, block: Block) -> None:
        """Add a block of scans to the recording, and update the turn by it."""
        self.blocks.append(block)
        self.samples += len(block)
        self.lost += block.lost
        if len(block):
            self._first_s = float(block.time_s[0]) if self._first_s is None else self._first_s
            self.length_s = float(block.time_s[-1]) - self._first_s
            self.see(block)

    def progress(self, *, begun: bool) -> TurnProgress:
        """Return the event that shows the present state of the turn.

        `begun` is True once the rest before the turn is over.
        """
        return TurnProgress(
            ("after" if self.full else "turn") if begun else "rest",
            self.length_s,
            self.limit_s,
            self.samples,
            self.lost,
            self.sweeps.angle_deg,
            self.rate_dps,
            min(self.sweeps.full + 1, self.turns),
            self.turns,
        )

    def done(self) -> TurnDone:
        """Return the event for the end of the turn."""
        seen = self.sweeps
        return TurnDone(
            seen.angle_deg, self.length_s, self.samples, self.lost, seen.full, seen.travelled_deg
        )


class Recorder(ABC):
    """Base of recorders, which record the positions of a plan into the archive.

    Parameters
    ----------
    questions : Questions
        Dialogue with the operator; it holds the bench and the archive of the session.

    Attributes
    ----------
    judges_places : bool
        True if the guards check each position by gravity.
    """

    judges_places: ClassVar[bool] = True

    def __init__(self, questions: Questions) -> None:
        self._questions = questions
        self._bench, self._ledger, self._knowledge = questions.bench, questions.ledger, questions.knowledge

    @abstractmethod
    def take(self, place: int) -> Iterator[Event]:
        """Record the dwell or turn at index `place` of the plan."""

    @contextmanager
    def _archiving(self, write: Callable[[str], object]) -> Iterator[None]:
        """Context that archives the scans so far if an error ends it; `write` does so with the reason."""
        try:
            yield
        except BaseException as error:
            write(str(error) if isinstance(error, AdisGonioError) else "the program ended")
            raise

    def _check_sensor(self) -> tuple[Status | None, str]:
        """End the stream after a recording; return STATUS and the message of `SessionBench.settings_lost`.

        The message is empty if the settings of the sensor have not changed.
        """
        self._bench.close_stream()
        self._ledger.scanning(self._bench.scanning)
        return self._bench.source.status(), self._bench.settings_lost()

    def _follow(self, turn: FollowedTurn) -> Generator[Event, None, str]:
        """Record a turn until it ends; return the reason if it was broken off, else an empty text."""
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
        """Write the scans of a turn that are not yet archived as an attempt; return its number.

        `outcome` and `reason` are stored with the attempt; `status` is the content of STATUS, None if it
        was not read.
        """
        now_s = self._bench.now_s
        blocks = [(turn.phase, block) for block in turn.blocks]
        number = self._ledger.archive.add_attempt(
            Attempt(
                turn.place, turn.position, outcome, *turn.began, now_s, blocks, turn.moves, reason, status
            )
        )
        turn.blocks, turn.moves, turn.written_s = [], [], turn.length_s
        turn.began = self._bench.utc(), now_s
        return number


DURATION_S = 60.0
TURNS = 2
"""Default number of turns; with two turns each angle is seen twice, which separates drift."""
FASTEST_DPS = 45.0
"""Largest mean rate in °/s; a hand that changes its grip reaches twice its mean."""
REST_S = 3.0
"""Rest before the turns and after them, in s."""

PLACE = Position(None, 0)


def free_turn_plan(turns: int = TURNS, duration_s: float = DURATION_S) -> Plan:
    """Return a plan of a free turn: `turns` full turns in one recording of at most `duration_s`.

    Raises
    ------
    UsageError
        There is no turn, or the turns would be too fast.
    """
    if turns < 1:
        raise UsageError(f"turns is {turns}: take 1 or more")
    least_s = 360.0 * turns / FASTEST_DPS + 2 * REST_S
    if not least_s <= duration_s < math.inf:
        raise UsageError(
            f"{counted(turns, 'turn')} in {duration_s:g} s, rests included, cannot be slow: take"
            f" {least_s:.0f} s or more (--duration), or fewer turns"
        )
    return Plan(FREE_TURN, (PLACE,), turns=turns)


class FreeTurn(FollowedTurn):
    """A turn by hand in the plane, followed by the angle of gravity.

    Parameters
    ----------
    place : int
        Index of the position in the plan.
    turns : int
        Number of requested full turns.
    limit_s : float
        Longest time of the recording, in s.
    began : (str, float)
        Beginning of the recording: UTC, and time on the bus's clock in s.
    """

    rest_before_s = REST_S
    piece_s = 5.0

    def __init__(self, place: int, turns: int, limit_s: float, began: tuple[str, float]) -> None:
        super().__init__(place, PLACE, turns, limit_s, began)
        self._before: float | None = None
        self._course: list[tuple[float, float]] = []

    def see(self, block: Block) -> None:
        """Update the turn by the angle of gravity in a block."""
        x, y, _ = block.accel_mg.mean(axis=0)
        # Gravity turns backwards in the part: with the minus, counter-clockwise is positive.
        angle = -math.degrees(math.atan2(y, x))
        if self._before is not None:
            self.sweeps.see(self.sweeps.angle_deg + wrap_degrees(angle - self._before))
        self._before = angle
        now = float(block.time_s[-1])
        self._course = [(t, a) for t, a in self._course if t > now - REST_S]
        self._course.append((now, self.sweeps.angle_deg))
        (t0, a0), (t1, a1) = self._course[0], self._course[-1]
        self.rate_dps = (a1 - a0) / (t1 - t0) if t1 > t0 else 0.0

    def begin(self, bench: SessionBench) -> bool:
        """Start the turn of the stage; return False if the stage cannot turn and a hand has to."""
        if bench.stage is None or not hasattr(bench.stage, "turn_freely"):
            return False
        bench.stage.turn_freely(self.turns)
        return True

    @property
    def full(self) -> bool:
        """True if all requested full turns were made."""
        return self.sweeps.full >= self.turns

    @property
    def resting(self) -> bool:
        """True if the sensor has turned by less than 0.5° within `REST_S`."""
        angles = [angle for _, angle in self._course]
        long_enough = bool(angles) and self._course[-1][0] - self._course[0][0] > 0.9 * REST_S
        return long_enough and max(angles) - min(angles) < 0.5

    @property
    def ended(self) -> str | None:
        """None during the recording; empty at its end.

        The recording ends after `limit_s`, or earlier if the requested turns were made and the sensor
        rests.
        """
        return "" if self.length_s >= self.limit_s or (self.full and self.resting) else None


class FreeTurnRecorder(Recorder):
    """Records a free turn as the dwell of a plan with a single position.

    `Settings.dwell_s` limits the time of the recording; it ends earlier when the turns were made and the
    sensor rests.
    """

    judges_places = False

    def take(self, place: int) -> Iterator[Event]:
        """Record the free turn and archive it as the dwell of `place`, the index of its position (0)."""
        bench, ledger = self._bench, self._ledger
        turn = FreeTurn(place, max(ledger.plan.turns, 1), bench.settings.dwell_s, bench.moment())
        with self._archiving(lambda why: self._write(turn, "interrupted", why)):
            why = yield from self._follow(turn)
            status, changed = self._check_sensor()
        if why or changed:
            self._write(turn, "interrupted", why or changed)
        if why:
            yield ledger.problem(Problem("stillness", f"the turn was broken off: {why}", place))
            return
        if changed:
            raise SessionError(changed)
        number = self._write(turn, "complete", "", None if status is None else status.word)
        ledger.use_attempt(place, number)
        ledger.recorded_s = turn.length_s  # the recording ends with the turns
        yield turn.done()
        if not turn.full:
            few = f"it went {turn.sweeps.span_deg:.0f}°, no full turn: undo it and turn all around"
            if turn.sweeps.full:
                few = (
                    f"{turn.sweeps.full} of {counted(turn.turns, 'turn')} seen: used with the uncertainty"
                    " that gives; undo it and turn again, or ask for --turns 1"
                )
            yield ledger.problem(Problem("stillness", few, place))
        if turn.lost:
            yield ledger.problem(Problem("lost", f"{turn.lost} scans lost during the turn", place))
