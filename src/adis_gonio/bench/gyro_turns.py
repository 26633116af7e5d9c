"""The session of gyro turns: on a level table, whole turns from a mark back to it, about each axis.

With the X, the Y and the Z arrow up: a dwell, some whole turns counter-clockwise, a dwell, as many
clockwise, a dwell, and another with the arrow down. It is a `SessionRunner` whose way from
one dwell to the next is recorded: an attempt whose reason is `TURNED` holds the turn, the dwell after it is
an attempt like any other. What has been done is judged by the gyros as soon as the part rests again, so
that a turn that is no good is made again at once. A kill loses the turn in hand; resumed, the session asks
for it again.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from dataclasses import replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.bench.answers import Reply
from adis_gonio.bench.dwelling import BROKEN_STREAM, Dwelling, TakesDwells, why_broken_off
from adis_gonio.bench.events import (
    DwellInterrupted,
    Event,
    GuardKind,
    GuardRaised,
    Problem,
    StageMoved,
    TurnDone,
    TurnProgress,
)
from adis_gonio.bench.guards import Guard, angle_between_deg
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor.driver import DEFAULT_SCAN
from adis_gonio.fitting.gyros.integral import Integral, Path, Sampling, integrate
from adis_gonio.record.blocks import Block, join, session_columns
from adis_gonio.record.plans import GYRO_TURNS, Plan, Position
from adis_gonio.record.rows import Attempt, Move, Phase, utc_now
from adis_gonio.record.turns import TURNED

ALL_THERMOMETERS = (*DEFAULT_SCAN, "YTEMP_OUT", "ZTEMP_OUT")
"""What a scan holds so that each gyro has the temperature of its own die."""

TURNS = 5
"""Each way: ten turns about an axis. More take so long that the zero rate wanders (docs/gyro_turns.md)."""
MOST_TURNS = 20
"""A gain of 1 % off is a fifth of a turn: more could not be counted."""
REST_S = 1.0
"""Rest before the turn and after it."""
STOPPED_S = 6.0
"""Rest within the turn after which it counts as ended, whole or not."""
PATIENCE_S = 300.0
OFF_SHARE, OFF_DEG = 0.03, 5.0
"""What a gyro's gain and zero rate may make of whole turns."""
FACE_DEG = 30.0
"""From the attitude that was asked for."""
_TILT_SHARE = 0.2
_ALMOST_DEG = 30.0

_UP = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
_DOWN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""What an ideal sensor reads with its X, Y, Z arrow up, or down."""


def gyro_turns_plan(turns: int = TURNS, faces: int = 6) -> Plan:
    """Each arrow up, with so many whole turns both ways.

    Parameters
    ----------
    faces : {6, 3}
        Each arrow down as well, at rest, which tells zero rates from g-sensitivities and finds the
        accelerometers' biases, by which the direction of an axis is known; or up alone.

    Raises
    ------
    UsageError
        No turn, more than can be counted, or another number of faces.
    """
    if faces not in (3, 6):
        raise UsageError(f"positions is {faces}: take 6 (each arrow up and down) or 3 (each up)")
    if not 1 <= turns <= MOST_TURNS:
        raise UsageError(f"turns is {turns}: take 1 to {MOST_TURNS} each way, such as {TURNS}")
    places: list[Position] = []
    for up, down in zip(_UP, _DOWN, strict=True):
        places.append(Position(None, 0, direction=up))
        places += [Position(None, 0, turned_deg=sign * 360.0 * turns) for sign in (1.0, -1.0)]
        if faces == 6:
            places.append(Position(None, 0, direction=down))
    return Plan(GYRO_TURNS, tuple(places), "none")


class GyroTurnsRunner(SessionRunner):
    """Runs a session of gyro turns; begin it with `gyro_turns_plan()`."""

    @property
    def judges_places(self) -> bool:
        """False: a dwell after whole turns lies where the one before did."""
        return False

    def _new_dwelling(self) -> TakesDwells:
        return TurnedDwelling(self._bench, self._ledger, self._knowledge, self._questions)


class Tracked:
    """The turn by the gyros as it goes on.

    Parameters
    ----------
    rest : Block
        The dwell before.
    moving_dps : float
        Mean of a block below which the part rests.

    Attributes
    ----------
    angle_deg : (3,) float
        About the part's axes.
    rest_s : float
        How long it has rested by now.
    peak_dps : float
        Largest rate that a gyro has shown.
    """

    def __init__(self, rest: Block, moving_dps: float = 2.0) -> None:
        rates, force = _rates_and_force(rest)
        self._zero, self._moving = rates.mean(axis=0), moving_dps
        self._up = -force.mean(axis=0) / np.linalg.norm(force.mean(axis=0))
        self._last_s: float | None = None
        self.angle_deg: Floats = np.zeros(3)
        self.rest_s = self.rate_dps = self.travelled_deg = self.length_s = 0.0
        self.longest_gap_s = self.peak_dps = 0.0
        self.begun = False

    @property
    def turned_deg(self) -> float:
        """About the vertical, counter-clockwise from above positive."""
        return float(self.angle_deg @ self._up)

    @property
    def across_deg(self) -> float:
        """About any other axis."""
        return float(np.linalg.norm(self.angle_deg - self.turned_deg * self._up))

    @property
    def about(self) -> str:
        """The part's axis that was turned about most."""
        return "xyz"[int(np.argmax(np.abs(self.angle_deg)))]

    def see(self, block: Block) -> None:
        """Take scans."""
        if not len(block):
            return
        shown, time = _rates_and_force(block)[0], block.time_s
        rates = shown - self._zero
        self.peak_dps = max(self.peak_dps, float(np.abs(shown).max()))
        if self._last_s is None:
            self._last_s = float(time[0])
        steps = np.diff(np.concatenate([[self._last_s], time]))
        span = float(time[-1]) - self._last_s
        self.longest_gap_s = max(self.longest_gap_s, float(steps.max()))
        moved = steps @ rates
        self.angle_deg = self.angle_deg + moved
        self.rate_dps = float(moved @ self._up) / span if span > 0 else 0.0
        self.travelled_deg += float(np.linalg.norm(moved))
        self.length_s += span
        moves = span > 0 and float(np.linalg.norm(moved)) / span > self._moving
        self.begun |= moves
        self.rest_s = 0.0 if moves else self.rest_s + span
        self._last_s = float(time[-1])


def _rates_and_force(block: Block) -> tuple[Floats, Floats]:
    columns = session_columns(block)
    if "gx" not in columns:
        raise UsageError("gyro turns need the gyros: this sensor's samples hold none")
    rates = np.column_stack([columns[name] for name in ("gx", "gy", "gz")])
    return rates, block.accel_mg


class TurnedDwelling(Dwelling):
    """Dwells of which some come after a turn that is recorded."""

    def take(self, place: int) -> Iterator[Event]:
        """Make the dwell of a place, and first the turn to it where one is asked for."""
        position = self._ledger.plan.positions[place]
        if position.turned_deg is None:
            yield from self._lay(place)
        elif (yield from self._turn(place, position.turned_deg)):
            yield from super().take(place)

    def _lay(self, place: int) -> Iterator[Event]:
        """A dwell at the beginning of a set-up, with the right face down."""
        yield from super().take(place)
        asked = self._ledger.plan.positions[place].direction
        number = self._ledger.done.get(place)
        if number is None or asked is None or self._questions.auto:
            return
        off = angle_between_deg(self._rest(place).accel_mg.mean(axis=0), asked)
        if off <= FACE_DEG:
            return
        axis = "XYZ"[int(np.argmax(np.abs(asked)))]
        face = "up" if min(asked) < 0 else "down"
        message = f"the {axis} arrow does not point {face}: {off:.0f}° off; lay the part on another face"
        guard = Guard("upside_down", message, {"off_deg": off}, ("retake", "keep", "skip"), spoils=False)
        answer = yield from self._ask(guard, place)
        if answer is Reply.RETAKE:
            yield self._knowledge.withdraw(place)
        elif answer is Reply.SKIP:
            yield self._knowledge.withdraw(place)
            self._ledger.skip(place)

    def _rest(self, place: int) -> Block:
        """Scans of the dwell of a place."""
        archive, number = self._ledger.archive, self._ledger.done[place]
        attempt = next(a for a in archive.attempts() if a.number == number)
        return join(archive.blocks(attempt, "dwell"))

    def _turn(self, place: int, wanted_deg: float) -> Generator[Event, None, bool]:
        """Record a turn; True where the dwell after it may follow."""
        before = place - 1
        if before not in self._ledger.done:
            message = "the rest before this turn was skipped: nothing tells the zero of the gyros"
            yield self._ledger.problem(Problem("stillness", message, place))
            self._ledger.skip(place)
            return False
        rest = self._rest(before)
        blocks: list[Block] = []
        began, moves = (utc_now(), self._bench.now_s), list[Move]()
        tracked = Tracked(rest)
        try:
            why = yield from self._follow(place, wanted_deg, tracked, blocks, moves)
        except BaseException as error:
            self._store(place, blocks, began, moves, why_broken_off(error))
            raise
        if why:
            number = self._store(place, blocks, began, moves, why)
            yield DwellInterrupted(place, self._ledger.plan.positions[place], number, 0, why)
            return False
        number = self._store(place, blocks, began, moves, TURNED)
        lost = sum(block.lost for block in blocks)
        samples = sum(len(block) for block in blocks)
        turns = round(abs(tracked.turned_deg) / 360.0)
        yield TurnDone(
            number, tracked.turned_deg, tracked.length_s, samples, lost, turns, tracked.travelled_deg
        )
        return (yield from self._judged(place, wanted_deg, tracked, rest, blocks))

    def _follow(
        self, place: int, wanted_deg: float, tracked: Tracked, blocks: list[Block], moves: list[Move]
    ) -> Generator[Event, None, str]:
        """Record until the part has turned and rests again; what broke it off, or nothing."""
        bench, asked = self._bench, False
        turns = round(abs(wanted_deg) / 360.0)
        for block in bench.scans():
            blocks.append(block)
            tracked.see(block)
            self._knowledge.see(block)
            if not asked and tracked.length_s >= REST_S:
                asked = True
                move = bench.begin_turn(wanted_deg)
                if move is not None:
                    moves.append(move)
                    yield StageMoved(self._ledger.plan.positions[place])
            done = tracked.begun and abs(tracked.turned_deg) > abs(wanted_deg) - _ALMOST_DEG
            yield TurnProgress(
                "after" if done else "turn" if asked else "rest",
                tracked.length_s,
                PATIENCE_S,
                sum(map(len, blocks)),
                sum(block.lost for block in blocks),
                tracked.turned_deg,
                tracked.rate_dps,
                min(int(abs(tracked.turned_deg) / 360.0) + 1, turns),
                turns,
                tracked.rest_s,
                tracked.peak_dps,
            )
            if self._questions.interrupted:
                return self._questions.why_interrupted
            yield from self._questions.remarks(place)
            if tracked.begun and tracked.rest_s >= (REST_S if done else STOPPED_S):
                return ""
            if tracked.length_s >= PATIENCE_S:
                return f"no whole turn within {PATIENCE_S:.0f} s"
        return BROKEN_STREAM

    def _store(
        self,
        place: int,
        blocks: list[Block],
        began: tuple[str, float],
        moves: list[Move],
        reason: str,
    ) -> int:
        position = self._ledger.plan.positions[place]
        kept: list[tuple[Phase, Block]] = [("before", block) for block in blocks]
        return self._ledger.archive.add_attempt(
            Attempt(place, position, "interrupted", *began, self._bench.now_s, kept, moves, reason)
        )

    def _judged(
        self, place: int, wanted_deg: float, tracked: Tracked, rest: Block, blocks: list[Block]
    ) -> Generator[Event, None, bool]:
        """True where the turn is good, or kept as it is."""
        guard = judge_whole_turn(wanted_deg, tracked, found_in(rest, blocks, self._sampling(rest)))
        if guard is None:
            return True
        if self._questions.auto:
            problem = Problem(guard.kind, f"{guard.message}", place)
            yield self._ledger.problem(problem)
            return True
        answer = yield from self._ask(guard, place)
        if answer is Reply.REVERSE:
            self._ledger.extend(_the_other_way(self._ledger.plan, place))
        elif answer is Reply.SKIP:
            self._ledger.skip(place)
        return answer in (Reply.KEEP, Reply.REVERSE)

    def _ask(self, guard: Guard, place: int) -> Generator[Event, None, Reply]:
        position = self._ledger.plan.positions[place]
        raised = GuardRaised(
            guard.kind, guard.message, place, position, guard.values, guard.answers, guard.default
        )
        allowed = {Reply(name) for name in guard.answers}
        answer = yield from self._questions.ask(raised, allowed, Reply(guard.default), place)
        self._ledger.note(
            "guard", {"place": place, "kind": guard.kind, "message": guard.message, "answer": answer}
        )
        return answer

    def _sampling(self, rest: Block) -> Sampling:
        measured = self._bench.configuration.as_dict()
        rates = _rates_and_force(rest)[0]
        # Of a dwell of seconds the variance of means of a tenth of one is near enough for a judgement.
        size = max(8, round(0.1 / self._bench.period_s))
        means = rates[: len(rates) // size * size].reshape(-1, size, 3).mean(axis=1)
        return Sampling(
            self._bench.period_s,
            int(measured.get("filter_m") or 0),
            float(measured.get("gyro_range_dps") or math.inf),
            np.diag(means.var(axis=0) * size),
            np.zeros(3),
        )


def found_in(rest: Block, blocks: list[Block], sampling: Sampling) -> Integral | str:
    """Integral of a turn from its scans; where there can be none, why not."""
    blocks = [block for block in blocks if len(block)]
    scans = join(blocks)
    rates, force = _rates_and_force(scans)
    zero, lay = (series.mean(axis=0) for series in _rates_and_force(rest))
    if not (np.diff(scans.time_s) > 0).all():
        return "the times of its scans do not rise"
    twice = np.ones((2, 1))
    return integrate(Path(scans.time_s, rates, 1e-3 * force, twice * zero, twice * 1e-3 * lay), sampling)


def judge_whole_turn(wanted_deg: float, tracked: Tracked, found: Integral | str) -> Guard | None:
    """What cannot be right of a turn that was to be whole."""
    turned = tracked.turned_deg
    values = {"asked_deg": wanted_deg, "gyro_deg": turned}
    if isinstance(found, str):
        kind: GuardKind = "shock" if tracked.begun else "not_moved"
        if "range" in found:
            kind = "over_range"
        return Guard(kind, f"{found}; bring it back to the mark and turn again", values, spoils=True)
    if tracked.across_deg > max(_TILT_SHARE * abs(turned), 2 * OFF_DEG):
        message = f"turned about {tracked.about}, not about the vertical: leave the part flat on the table"
        return Guard("wrong_axis", message, values, spoils=True)
    off = turned - 360.0 * round(turned / 360.0)
    limit = OFF_SHARE * abs(turned) + OFF_DEG
    values |= {"off_deg": off, "limit_deg": limit}
    if abs(off) > limit or abs(turned) < 180.0:
        message = (
            f"the gyro turned {turned:+.0f}°, {off:+.0f}° off a whole number of turns (its gain explains"
            f" {limit:.0f}° at most): bring the part back to the mark and turn again"
        )
        return Guard("wrong_angle", message, values, spoils=True)
    if turned * wanted_deg < 0:
        message = (
            f"turned {turned:+.0f}°, {way(turned)}; {way(wanted_deg)} was asked: it serves as well if the"
            " next one goes the other way"
        )
        return Guard("reversed", message, values, ("retake", "reverse", "keep", "skip"), "reverse")
    return None


def way(angle_deg: float) -> str:
    """Sense of a turn, seen from above."""
    return "counter-clockwise" if angle_deg > 0 else "clockwise"


def _the_other_way(plan: Plan, place: int) -> Plan:
    """The plan with the turns of a set-up from a place on the other way round."""
    positions, k = list(plan.positions), place
    while k < len(positions) and (turned := positions[k].turned_deg) is not None:
        positions[k] = replace(positions[k], turned_deg=-turned)
        k += 1
    return replace(plan, positions=tuple(positions))


__all__ = ["GYRO_TURNS", "TURNS", "GyroTurnsRunner", "gyro_turns_plan"]
