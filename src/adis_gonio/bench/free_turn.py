"""The session of a free turn: one continuous recording, from a rest through turns to a rest.

It is a `SessionRunner` with one place to go to, whose dwell is the whole recording. Every few seconds what
was recorded goes into the archive as a piece: attempts whose reason is `GOES_ON`, ended by one that is
complete or says what broke it off. A kill or a power cut loses one piece at most, a session that is resumed
asks for a new turn, and `turn_pieces.recording_of` gives the best that there is.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from typing import Literal, Protocol, runtime_checkable

from adis_gonio.base.arrays import wrap_degrees
from adis_gonio.base.errors import SessionError, UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.bench.bench import SessionBench
from adis_gonio.bench.dwelling import BROKEN_STREAM, TakesDwells, why_broken_off
from adis_gonio.bench.events import Event, Problem, StageMoved, TurnDone, TurnProgress
from adis_gonio.bench.knowledge import Knowledge
from adis_gonio.bench.ledger import Ledger
from adis_gonio.bench.questions import Questions
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.model.sweeps import Sweeps
from adis_gonio.record.blocks import Block
from adis_gonio.record.plans import GYRO_TURNS, Plan, Position
from adis_gonio.record.rows import Attempt, Outcome, utc_now
from adis_gonio.record.turn_pieces import FREE_TURN, GOES_ON

DURATION_S = 60.0
TURNS = 2
"""Each angle is then seen twice, and drift told from calibration."""
FASTEST_DPS = 45.0
"""Mean rate that may be asked for: a hand that takes new grips goes at twice its mean."""
REST_S = 3.0
"""Rest before the turns and after them."""
PIECE_S = 5.0
"""What a kill loses at most."""
RESTING_DEG = 0.5
"""Less than this in `REST_S` is rest."""
State = Literal["rest", "turn", "after"]

PLACE = Position(None, 0)


def free_turn_plan(turns: int = TURNS, duration_s: float = DURATION_S) -> Plan:
    """The plan of a free turn: `turns` full ones within one recording of at most `duration_s`.

    Raises
    ------
    UsageError
        No turn, or more than a hand can make slowly in the time.
    """
    if turns < 1:
        raise UsageError(f"turns is {turns}: take 1 or more")
    rate_dps = 360.0 * turns / (duration_s - 2 * REST_S)
    if not 0 < rate_dps <= FASTEST_DPS:
        least_s = 360.0 * turns / FASTEST_DPS + 2 * REST_S
        raise UsageError(
            f"{counted(turns, 'turn')} in {duration_s:g} s, rests included, cannot be slow: take"
            f" {least_s:.0f} s or more (--duration), or fewer turns"
        )
    return Plan(FREE_TURN, (PLACE,), turns=turns)


@runtime_checkable
class TurningStage(Protocol):
    """A stage that a program can turn all around as a hand would, one time or several."""

    def turn_freely(self, turns: int = 1) -> float:
        """Begin, and return the time at which it ends."""


class FreeTurn:
    """The angle of gravity as the turn goes on, and when it is done.

    Attributes
    ----------
    wanted : int
        Full turns to make.
    sweeps : Sweeps
    """

    def __init__(self, wanted: int) -> None:
        self.wanted = wanted
        self.sweeps = Sweeps()
        self._before: float | None = None
        self._course: list[tuple[float, float]] = []

    def see(self, block: Block) -> None:
        """Take scans."""
        if not len(block):
            return
        x, y, _ = block.accel_mg.mean(axis=0)
        # Gravity goes backwards through the part: positive is counter-clockwise, as the stage counts.
        angle = -math.degrees(math.atan2(y, x))
        if self._before is not None:
            step = wrap_degrees(angle - self._before)
            self.sweeps.see(self.sweeps.angle_deg + step)
        self._before = angle
        now = float(block.time_s[-1])
        self._course = [(t, a) for t, a in self._course if t > now - REST_S] + [(now, self.turned_deg)]

    @property
    def turned_deg(self) -> float:
        """From the start to here, with its sign."""
        return self.sweeps.angle_deg

    @property
    def full(self) -> bool:
        """True once as many full turns were made as were wanted."""
        return self.sweeps.full >= self.wanted

    @property
    def resting(self) -> bool:
        """True where nothing has turned for `REST_S`."""
        angles = [angle for _, angle in self._course]
        long_enough = self._course[-1][0] - self._course[0][0] > 0.9 * REST_S if self._course else False
        return long_enough and max(angles) - min(angles) < RESTING_DEG

    @property
    def rate_dps(self) -> float:
        """Over the last `REST_S`."""
        (t0, a0), (t1, a1) = self._course[0], self._course[-1]
        return (a1 - a0) / (t1 - t0) if t1 > t0 else 0.0


class FreeTurnRunner(SessionRunner):
    """Runs the session of a free turn; begin it with `free_turn_plan()`.

    `Settings.dwell_s` is the longest time of the recording; it ends earlier once the turns were made
    and the part has rested after them.
    """

    _length_s = 0.0

    @property
    def one_recording(self) -> bool:
        """True: one continuous recording."""
        return True

    def _new_dwelling(self) -> TakesDwells:
        return TurnTaking(self._bench, self._ledger, self._knowledge, self._questions)


class TurnTaking:
    """Records the whole turn as the dwell of the one place."""

    def __init__(
        self, bench: SessionBench, ledger: Ledger, knowledge: Knowledge, questions: Questions
    ) -> None:
        self._bench = bench
        self._ledger = ledger
        self._knowledge = knowledge
        self._questions = questions

    def take(self, place: int) -> Iterator[Event]:
        """Record a turn."""
        bench, ledger = self._bench, self._ledger
        pieces = _Pieces(bench, ledger, place)
        try:
            why = yield from self._follow(pieces)
        except BaseException as error:
            pieces.write("interrupted", why_broken_off(error))
            raise
        bench.close_stream()
        ledger.scanning(bench.scanning)
        if why:
            pieces.write("interrupted", why)
            yield ledger.problem(Problem("stillness", f"the turn was broken off: {why}", place))
            return
        status = bench.source.status()
        settings = bench.settings_lost()
        if settings:
            pieces.write("interrupted", settings)
            raise SessionError(settings)
        number = pieces.write("complete", "", None if status is None else status.word)
        ledger.count(place, number)
        ledger.recorded_s = pieces.length_s  # it ends with the turns
        turn = pieces.turn
        yield TurnDone(
            number, turn.turned_deg, pieces.length_s, pieces.samples, pieces.lost,
            turn.sweeps.full, turn.sweeps.travelled_deg,
        )  # fmt: skip
        if not turn.full:
            yield ledger.problem(Problem("stillness", _too_few(turn), place))
        if pieces.lost:
            yield ledger.problem(Problem("lost", f"{pieces.lost} scans lost during the turn", place))

    def _follow(self, pieces: _Pieces) -> Generator[Event, None, str]:
        """Record the turn; what broke it off, or nothing."""
        bench, turn, moved = self._bench, pieces.turn, False
        length_s = bench.settings.dwell_s
        for block in bench.scans():
            pieces.add(block)
            self._knowledge.see(block)
            if not moved and pieces.length_s >= REST_S:
                moved = True
                if isinstance(bench.stage, TurningStage):
                    bench.stage.turn_freely(turn.wanted)
                    yield StageMoved(PLACE)
            reached: State = "after" if turn.full else "turn"
            yield TurnProgress(
                reached if moved else "rest",
                pieces.length_s,
                length_s,
                pieces.samples,
                pieces.lost,
                turn.turned_deg,
                turn.rate_dps,
                min(turn.sweeps.full + 1, turn.wanted),
                turn.wanted,
            )
            if self._questions.interrupted:
                return self._questions.why_interrupted
            yield from self._questions.remarks(pieces.place)
            if pieces.length_s >= length_s or (turn.full and turn.resting):
                return ""
        return BROKEN_STREAM


def _too_few(turn: FreeTurn) -> str:
    """What is said where fewer full turns were seen than were asked for."""
    if not turn.sweeps.full:
        return f"it went {turn.sweeps.span_deg:.0f}°, no full turn: undo it and turn all around"
    return (
        f"{turn.sweeps.full} of {counted(turn.wanted, 'turn')} seen: used with the uncertainty that gives;"
        " undo it and turn again, or ask for --turns 1"
    )


class _Pieces:
    """What was recorded and goes to the archive piece by piece."""

    def __init__(self, bench: SessionBench, ledger: Ledger, place: int) -> None:
        self.place, self.turn = place, FreeTurn(max(ledger.plan.turns, 1))
        self.samples = self.lost = 0
        self.length_s = 0.0
        self._bench, self._ledger = bench, ledger
        self._first_s: float | None = None
        self._since_s = 0.0
        self._blocks: list[Block] = []
        self._began = utc_now(), bench.now_s

    def add(self, block: Block) -> None:
        """Take scans; those of a whole piece are written."""
        self._blocks.append(block)
        self.turn.see(block)
        self.samples += len(block)
        self.lost += block.lost
        if len(block):
            now = float(block.time_s[-1])
            self._first_s = float(block.time_s[0]) if self._first_s is None else self._first_s
            self.length_s = now - self._first_s
        if self.length_s - self._since_s >= PIECE_S:
            self.write("interrupted", GOES_ON)

    def write(self, outcome: Outcome, reason: str, status: int | None = None) -> int:
        """Write what is not yet in the archive; number of the attempt."""
        now = self._bench.now_s
        attempt = Attempt(
            self.place, PLACE, outcome, *self._began, now,
            [("dwell", block) for block in self._blocks], [], reason, status,
        )  # fmt: skip
        number = self._ledger.archive.add_attempt(attempt)
        self._blocks, self._since_s = [], self.length_s
        self._began = utc_now(), now
        return number


def runner_of(plan: Plan) -> type[SessionRunner]:
    """Which runner a plan takes."""
    if plan.name == GYRO_TURNS:
        from adis_gonio.bench.gyro_turns import GyroTurnsRunner

        return GyroTurnsRunner
    return FreeTurnRunner if plan.name == FREE_TURN else SessionRunner


__all__ = ["DURATION_S", "FREE_TURN", "TURNS", "FreeTurnRunner", "free_turn_plan", "runner_of"]
