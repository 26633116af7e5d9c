"""Recorder of gyro turns: on a level table, whole turns from a mark back to it, about each axis.

With the X, the Y and the Z arrow up: a dwell, some whole turns counter-clockwise, a dwell, as many turns
clockwise, a dwell, and another dwell with the arrow down. The turn between two dwells is recorded too: an
attempt with the reason `TURNED` has the scans of the turn, the dwell after it is a normal attempt. Each
turn is judged by the gyros as soon as the sensor rests again, so that a bad turn can be repeated at once. A
kill loses only the unfinished turn; a resumed session asks for it again.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from dataclasses import replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import SessionError, UsageError
from adis_gonio.base.numbers import signed
from adis_gonio.bench.dialogue import Reply
from adis_gonio.bench.dwell_recorder import DwellRecorder
from adis_gonio.bench.events import DwellInterrupted, Event, Guard, GuardKind, Problem, Vector
from adis_gonio.bench.guards import angle_between_deg
from adis_gonio.bench.guidance import turn_sense
from adis_gonio.bench.recorder import FollowedTurn
from adis_gonio.bench.session_bench import SessionBench
from adis_gonio.device.sensor.driver import DEFAULT_SCAN
from adis_gonio.fitting.gyros.turn_integration import Integral, Path, Sampling, integrate
from adis_gonio.model.effects.base import AXES
from adis_gonio.record.blocks import Block, block_series, join
from adis_gonio.record.plans import GYRO_TURNS, Plan, Position
from adis_gonio.record.session_reader import TURNED

ALL_THERMOMETERS = (*DEFAULT_SCAN, "YTEMP_OUT", "ZTEMP_OUT")
"""Registers of a scan with the temperature of each gyro's die."""

TURNS = 5
"""Default number of turns each way, ten about an axis; in more turns the zero rate would drift."""
MOST_TURNS = 20
"""Largest number of turns each way: with an error of the gain, more could not be counted reliably."""
REST_S = 1.0
"""Rest before the turn and after it, in s."""
PATIENCE_S = 300.0
MOVING_DPS = 2.0
"""Mean rate of a block in °/s below which the sensor rests."""
OFF_SHARE, OFF_DEG = 0.03, 5.0
"""Largest deviation from whole turns that a gyro explains: share of the turn (gain), and degrees (zero)."""

_UP = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
_DOWN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""Readings of an ideal sensor in G with its X, Y or Z arrow up (`_UP`), or down (`_DOWN`)."""


def gyro_turns_plan(turns: int = TURNS, faces: int = 6) -> Plan:
    """Return a plan of gyro turns: with each arrow up, `turns` whole turns in both senses.

    Parameters
    ----------
    faces : {6, 3}
        6: also each arrow down, at rest, which separates zero rates from g-sensitivities and gives the
        accelerometers' biases, needed for the direction of an axis. 3: each arrow up only.

    Raises
    ------
    UsageError
        The number of turns or of faces is not allowed.
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


class GyroTurn(FollowedTurn):
    """A turn on a table, followed by the gyros.

    Parameters
    ----------
    place, position : int, Position
        Index of the position in the plan, and the position.
    wanted_deg : float
        Requested turn, counter-clockwise positive.
    rest : Block
        Scans of the dwell before, which give the zero rates and the vertical.
    began : (str, float)
        Beginning of the recording: UTC, and time on the bus's clock in s.

    Attributes
    ----------
    angle_deg : (3,) float
        Turn so far about the sensor's axes.
    moved : bool
        True once the sensor has moved.
    rest_s : float
        Duration of the present rest in s.
    """

    phase = "before"
    rest_before_s = REST_S

    def __init__(
        self, place: int, position: Position, wanted_deg: float, rest: Block, began: tuple[str, float]
    ) -> None:
        super().__init__(place, position, round(abs(wanted_deg) / 360.0), PATIENCE_S, began)
        rates, force = _rates_and_force(rest)
        self.wanted_deg, self._zero = wanted_deg, rates.mean(axis=0)
        self._up = -force.mean(axis=0) / np.linalg.norm(force.mean(axis=0))
        self._last_s: float | None = None
        self.angle_deg: Floats = np.zeros(3)
        self.moved, self.rest_s = False, 0.0

    @property
    def full(self) -> bool:
        """True if the sensor has turned by the requested angle, or lacks less than 30° of it."""
        return self.moved and abs(self.sweeps.angle_deg) > abs(self.wanted_deg) - 30.0

    @property
    def ended(self) -> str | None:
        """None while the turn goes on; empty at its end; an error message if it never began.

        A whole turn ends after `REST_S` seconds of rest. If the sensor stopped earlier, the turn ends after
        6 seconds of rest.
        """
        if self.moved and self.rest_s >= (REST_S if self.full else 6.0):
            return ""
        return f"no whole turn within {PATIENCE_S:.0f} s" if self.length_s >= PATIENCE_S else None

    def begin(self, bench: SessionBench) -> bool:
        """Start the turn of the stage; return False if the stage cannot turn and a hand has to."""
        move = bench.begin_turn(self.wanted_deg)
        self.moves += [] if move is None else [move]
        return move is not None

    @property
    def across_deg(self) -> Floats:
        """Turn (3,) so far about the sensor's axes without its part about the vertical, in degrees."""
        return np.asarray(self.angle_deg - self.sweeps.angle_deg * self._up)

    def see(self, block: Block) -> None:
        """Integrate the rates of a block and update the turn."""
        shown, time = _rates_and_force(block)[0], block.time_s
        if self._last_s is None:
            self._last_s = float(time[0])
        span = float(time[-1]) - self._last_s
        # Integral (3,) of the rates over the block, then its part about the vertical.
        moved = np.diff(np.concatenate([[self._last_s], time])) @ (shown - self._zero)
        self.angle_deg = self.angle_deg + moved
        self.sweeps.see(float(self.angle_deg @ self._up))
        self.rate_dps = float(moved @ self._up) / span if span > 0 else 0.0
        moves = span > 0 and float(np.linalg.norm(moved)) / span > MOVING_DPS
        self.moved |= moves
        self.rest_s = 0.0 if moves else self.rest_s + span
        self._last_s = float(time[-1])


def _rates_and_force(block: Block) -> tuple[Floats, Floats]:
    rates = block_series(block).get("gyro")
    if rates is None:
        raise UsageError("gyro turns need the gyros: this sensor's samples have none")
    return rates, block.accel_mg


class GyroTurnsRecorder(DwellRecorder):
    """Records dwells, and the turns on a table before some of them."""

    judges_places = False  # whole turns end where they began

    def take(self, place: int) -> Iterator[Event]:
        """Record the turn, if any, that the plan requests at index `place`, and the dwell after it."""
        position = self._ledger.plan.positions[place]
        if position.turned_deg is None:
            yield from self._lay(place)
        elif (yield from self._turn(place, position.turned_deg)):
            yield from super().take(place)

    def _lay(self, place: int) -> Iterator[Event]:
        """Record a dwell in a new attitude, and check that the requested arrow points up or down."""
        yield from super().take(place)
        asked = self._ledger.plan.positions[place].direction
        number = self._ledger.done.get(place)
        if number is None or asked is None or self._questions.auto:
            return
        guard = judge_face(self._rest(place).accel_mg.mean(axis=0), asked)
        if guard is None:
            return
        answer = yield from self._questions.ask_guard(guard, place)
        if answer in (Reply.RETAKE, Reply.SKIP):
            yield self._knowledge.withdraw(place)
        if answer is Reply.SKIP:
            self._ledger.skip(place)

    def _rest(self, place: int) -> Block:
        """Read the scans of the dwell at a place (index in the plan) from the archive."""
        archive, number = self._ledger.archive, self._ledger.done[place]
        attempt = next(a for a in archive.attempts() if a.number == number)
        return join(archive.blocks(attempt, "dwell"))

    def _turn(self, place: int, wanted_deg: float) -> Generator[Event, None, bool]:
        """Record a turn by `wanted_deg` before the dwell of `place`.

        Returns True if the dwell can be recorded then.
        """
        before = place - 1
        if before not in self._ledger.done:
            message = "the rest before this turn was skipped, so that the zero rates are unknown"
            yield self._ledger.problem(Problem("stillness", message, place))
            self._ledger.skip(place)
            return False
        rest = self._rest(before)
        position = self._ledger.plan.positions[place]
        turn = GyroTurn(place, position, wanted_deg, rest, self._bench.moment())
        with self._archiving(lambda why: self._write(turn, "interrupted", why)):
            why = yield from self._follow(turn)
        blocks = turn.blocks
        number = self._write(turn, "interrupted", why or TURNED)
        if why:
            yield DwellInterrupted(place, position, number, 0, why)
            if self._questions.auto and not self._questions.interrupted:
                raise SessionError(f"{position}: {why}; check the table and the gyros, then resume")
            return False
        yield replace(turn.done(), turns=round(abs(turn.sweeps.angle_deg) / 360.0))
        return (yield from self._judged(turn, rest, blocks))

    def _judged(self, turn: GyroTurn, rest: Block, blocks: list[Block]) -> Generator[Event, None, bool]:
        """Judge a turn and ask about a bad one; return True if it is good or is kept.

        `rest` has the scans of the dwell before, `blocks` the scans of the turn.
        """
        place, guard = turn.place, judge_whole_turn(turn, found_in(rest, blocks, self._sampling(rest)))
        if guard is None:
            return True
        if self._questions.auto:
            yield self._ledger.problem(Problem(guard.kind, guard.message, place))
            return True
        answer = yield from self._questions.ask_guard(guard, place)
        if answer is Reply.SKIP:
            self._ledger.skip(place)
        return answer is Reply.KEEP

    def _sampling(self, rest: Block) -> Sampling:
        measured = self._bench.configuration.as_dict()
        rates = _rates_and_force(rest)[0]
        # The variance of means over 0.1 s is accurate enough for this judgement.
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
    """Integrate the rates of a turn over its scans; return the reason as text if that is not possible.

    `rest` has the scans of the dwell before, `blocks` the scans of the turn.
    """
    scans = join([block for block in blocks if len(block)])
    rates, force = _rates_and_force(scans)
    zero, lay = (series.mean(axis=0) for series in _rates_and_force(rest))
    if not (np.diff(scans.time_s) > 0).all():
        return "the times of its scans do not rise"
    twice = np.ones((2, 1))
    return integrate(Path(scans.time_s, rates, 1e-3 * force, twice * zero, twice * 1e-3 * lay), sampling)


def judge_face(accel_mg: Floats, asked: Vector) -> Guard | None:
    """Check that the requested arrow points up or down within 30°; return None if it does.

    `accel_mg` (3,) is the reading at rest, `asked` the reading of an ideal sensor with this arrow up or
    down.
    """
    off = angle_between_deg(accel_mg, asked)
    if off <= 30.0:
        return None
    axis = "XYZ"[int(np.argmax(np.abs(asked)))]
    face = "up" if min(asked) < 0 else "down"
    message = f"the {axis} arrow does not point {face}: {off:.0f}° off; lay the part on another face"
    return Guard("upside_down", message, {"off_deg": off})


def judge_whole_turn(turn: GyroTurn, found: Integral | str) -> Guard | None:
    """Check that a turn was whole, about the vertical and in the requested sense; None if it was.

    `found` is the integral of the turn, or the reason as text why it cannot be computed.
    """
    wanted_deg, turned = turn.wanted_deg, turn.sweeps.angle_deg
    values = {"asked_deg": wanted_deg, "gyro_deg": turned}
    if isinstance(found, str):
        kind: GuardKind = "shock" if turn.moved else "not_moved"
        if "range" in found:
            kind = "over_range"
        return Guard(kind, f"{found}; bring it back to the mark and turn again", values, spoils=True)
    if np.linalg.norm(turn.across_deg) > max(0.2 * abs(turned), 2 * OFF_DEG):
        about = AXES[int(np.argmax(np.abs(turn.across_deg)))]
        message = f"turned about {about}, not about the vertical: leave the part flat on the table"
        return Guard("wrong_axis", message, values, spoils=True)
    off = turned - 360.0 * round(turned / 360.0)
    limit = OFF_SHARE * abs(turned) + OFF_DEG
    values |= {"off_deg": off, "limit_deg": limit}
    if abs(off) > limit or abs(turned) < 180.0:
        message = (
            f"the gyro turned {signed(turned, 0)}°, {signed(off, 0)}° off a whole number of turns"
            f" (its gain explains {limit:.0f}° at most): bring the part back to the mark and turn again"
        )
        return Guard("wrong_angle", message, values, spoils=True)
    if turned * wanted_deg < 0:
        message = (
            f"turned {signed(turned, 0)}°, {turn_sense(turned)}; {turn_sense(wanted_deg)} was requested"
        )
        return Guard("reversed", message, values)
    return None
