"""The stage on which the sensor is mounted: its direction at any time, and the errors of its mechanics.

In the plane the sensor turns about its horizontal Z axis. The true angle is ψ = α − θ + δ with the declared
angle θ and the error δ that each move draws (fixture, N(0, σ)) plus half the backlash by the direction of
approach, minus the slip of the sensor in its fixture; X then reads G cos ψ and Y G sin ψ. In space the
stage turns the sensor until an ideal sensor would read a given unit vector, in units of G.

A move takes time; the sensor rings after it. The speed of a motor rises and falls as a half sine; a hand
follows `hand.HandMove`. Full turns by hand (`hand.HandTurn`) have no declared angle.

On a table (`turn_about`) the sensor keeps its attitude and turns about an axis; if this axis is vertical,
the direction of gravity in the sensor does not change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_radians
from adis_gonio.base.errors import UsageError
from adis_gonio.sim.hand import Course, HandMove, HandTurn, turned_back
from adis_gonio.sim.settings import WorldSettings

_SHORTEST_MOVE_S = 0.3
_KNOTS = 33
"""Number of points that tabulate a move by half a turn.

With 33 points a turn of 180° deviates from its chords by (π²/64)²/8 = 0.3 %.
"""


@dataclass(frozen=True)
class Motion:
    """Orientation, rate and circumstances of the sensor at n times.

    Attributes
    ----------
    direction : (n, 3) float
        Readings of an ideal sensor, in units of local gravity.
    rate_dps : (n, 3) float
        Rate of turn of the sensor about its axes.
    shaking_mg : (n, 3) float
        Linear acceleration of the sensor by a shaking hand.
    ringing_mg : (n,) float
        Acceleration along X and Y by the ringing after a move.
    angle_rad, previous_angle_rad : (n,) float
        Declared angle θ, and the declared angle of the previous dwell.
    order, approach : (n,) float
        Number of the dwell, and direction of approach. Moves are counted: the positions before and after
        the first move both have number 0.
    time_in_dwell_s : (n,) float
        Time since the last move ended; 0 during a move.
    """

    direction: Floats
    rate_dps: Floats
    shaking_mg: Floats
    ringing_mg: Floats
    angle_rad: Floats
    previous_angle_rad: Floats
    order: Floats
    approach: Floats
    time_in_dwell_s: Floats


_UPRIGHT = np.array([0.0, 0.0, 1.0])
"""Axis (3,) of the stage in the sensor, about which it turns in the plane."""


@dataclass(frozen=True)
class _Leg:
    """A move of the stage with the rest after it: a turn of the sensor about an axis.

    Times are in s and angles in rad. `begin` (3,) is the direction of gravity in the sensor before the turn
    by `turn_rad` about `axis` (3,). `from_rad` and `to_rad` are the declared angles before and after the
    move, NaN in space; `error_rad` is the error of the angle after it. `order` is the number of the move,
    `approach` the direction of its end, and `previous_rad` the declared angle of the previous dwell.

    `hand` is a free turn by hand, or a move by hand between two positions; None for a move by a motor.
    """

    start_s: float
    end_s: float
    begin: Floats
    axis: Floats
    turn_rad: float
    from_rad: float
    to_rad: float
    error_rad: float
    order: int
    approach: int
    previous_rad: float
    hand: HandTurn | HandMove | None = None

    @property
    def knots(self) -> int:
        """Number of points at which `Stage.course` tabulates this move."""
        halves = max(round(abs(self.turn_rad) / np.pi), 1)
        # The speed of a move by hand is not even, so that it needs more points.
        return _KNOTS * halves * (8 if isinstance(self.hand, HandMove) else 1)

    def direction(self, turned_rad: Floats) -> Floats:
        """Return the directions (n, 3) of gravity in the sensor after turns (n,) in rad of this move."""
        return turned_back(self.begin[None], self.axis, turned_rad)

    @property
    def target(self) -> Floats:
        """Direction (3,) of gravity in the sensor at the end of the turn."""
        return np.asarray(self.direction(np.array([self.turn_rad]))[0])


class Stage:
    """Motion of the stage with the sensor over time, extended by one move at a time.

    Parameters
    ----------
    settings : WorldSettings
        Settings of the mechanics.
    alpha_rad : float
        Angle of the sensor at the stage's zero.
    rng : Generator
        Draws an angle error for each move.
    hands, moves : Generator, optional
        Draw the full turns by hand, and the moves by hand from position to position; None makes new
        generators.
    """

    def __init__(
        self,
        settings: WorldSettings,
        alpha_rad: float,
        rng: np.random.Generator,
        hands: np.random.Generator | None = None,
        moves: np.random.Generator | None = None,
    ) -> None:
        self._settings = settings
        self._hands = np.random.default_rng(0) if hands is None else hands
        self._movements = np.random.default_rng(0) if moves is None else moves
        self._alpha = alpha_rad
        self._rng = rng
        self._moves = 0
        error, never = self._error(0), -np.inf
        begin = self._direction(alpha_rad + error)
        self._legs = [_Leg(never, never, begin, _UPRIGHT, 0.0, 0.0, 0.0, error, 0, 0, 0.0)]
        self._starts = np.array([never])
        self._mark_error = 0.0
        self._tabulated: list[tuple[Floats, Floats]] = []
        self._course: tuple[Floats, Floats] | None = None

    @property
    def angle_deg(self) -> float:
        """Declared angle in degrees to which the last move went; NaN after a move in space."""
        return float(np.degrees(self._legs[-1].to_rad))

    @property
    def error_deg(self) -> float:
        """True minus declared angle (δ) of the stage at the present position, in degrees.

        A fit does not know this error.
        """
        return float(np.degrees(self._legs[-1].error_rad))

    @property
    def free_start_deg(self) -> float | None:
        """Angle of the sensor at rest before the last free turn, in degrees; None without a free turn."""
        for leg in reversed(self._legs):
            if isinstance(leg.hand, HandTurn):
                return float(np.degrees(wrap_radians(self._alpha - leg.from_rad + leg.error_rad)))
        return None

    @property
    def still_at_s(self) -> float:
        """Time in s at which the last move ends."""
        return self._legs[-1].end_s

    def move_to(self, start_s: float, angle_deg: float, approach: int = 0) -> float:
        """Begin a move in the plane to a declared angle; return the time in s at which it ends.

        Parameters
        ----------
        start_s : float
            Time at which the move begins.
        angle_deg : float
            Declared angle.
        approach : int
            +1 or -1: arrive with the declared angle rising or falling, with an overshoot if necessary; 0:
            by the shortest turn.

        Raises
        ------
        UsageError
            The angle is not finite, the approach not one of -1, 0, 1, or the last move still runs.
        """
        if not np.isfinite(angle_deg) or approach not in (-1, 0, 1):
            raise UsageError(f"move to {angle_deg}° with approach {approach}: give an angle and -1, 0 or 1")
        self._count_move(start_s)
        last, target = self._legs[-1], float(np.radians(angle_deg))
        if self._moves == 1:
            self._previous_rad = target
        if np.isnan(last.to_rad):
            error = self._error(approach)
            vector = self._direction(self._alpha - target + error)
            return self._turn_towards(start_s, vector, target, error, approach)
        natural = int(np.sign(target - last.to_rad))
        if approach and natural != approach:
            past = target - approach * float(np.radians(self._settings.overshoot_deg))
            start_s = self._swing(start_s, past, last.error_rad, approach)
        approach = approach or natural
        return self._swing(start_s, target, self._error(approach), approach)

    def orient(self, start_s: float, vector: Floats) -> float:
        """Begin a turn in space to a direction of gravity; return the time in s at which it ends.

        Parameters
        ----------
        start_s : float
            Time at which the turn begins.
        vector : (3,) float
            Reading of an ideal sensor at the new attitude, up to a factor; level with Z up is (0, 0, -1).

        Raises
        ------
        UsageError
            The vector is no direction, or the last move still runs.
        """
        wanted = np.asarray(vector, np.float64)
        norm = float(np.linalg.norm(wanted))
        if wanted.shape != (3,) or not np.isfinite(norm) or norm == 0:
            raise UsageError(f"orient to {vector}: give three numbers that are a direction")
        self._count_move(start_s)
        sigma = np.radians(self._settings.fixture_sigma_deg)
        # Tilt the wanted direction by a random small rotation.
        tilted = wanted / norm + np.cross(sigma * self._rng.standard_normal(3), wanted / norm)
        return self._turn_towards(start_s, tilted / np.linalg.norm(tilted), float("nan"), 0.0, 0)

    def turn_freely(self, start_s: float, turns: int = 1) -> float:
        """Begin turns by hand without declared angles; return the time in s at which they end.

        Parameters
        ----------
        start_s : float
            Time at which the turns begin.
        turns : int
            Number of turns of `hand_turn_deg`, all within `hand_turn_s`.

        Raises
        ------
        UsageError
            The last move still runs, or the sensor is not at an angle of the stage.
        """
        last = self._legs[-1]
        if np.isnan(last.to_rad):
            raise UsageError(
                "the part is at an attitude in space: turn it to an angle of the stage before a free turn"
            )
        self._count_move(start_s)
        hand = HandTurn(self._settings, self._hands, turns)
        to_rad = last.to_rad + hand.total_rad
        approach = 1 if to_rad >= last.to_rad else -1
        return self._turn(start_s, _UPRIGHT, hand.total_rad, to_rad, last.error_rad, approach, hand)

    def turn_about(self, start_s: float, angle_deg: float, axis: Floats | None = None) -> float:
        """Begin to turn the sensor about an axis through it; return the time in s at which the turn ends.

        A whole turn leaves the attitude unchanged. Before and after it the sensor is aligned with a mark,
        each time with a new error (`mark_sigma_deg`), so that the true angle differs slightly from the
        declared angle.

        Parameters
        ----------
        start_s : float
            Time at which the turn begins.
        angle_deg : float
            Angle to turn by, which may be several turns; positive is right-handed about the axis.
        axis : (3,) float or None
            Axis in the sensor; None is the vertical, upwards: positive is then counter-clockwise, seen from
            above, as on a level table.

        Raises
        ------
        UsageError
            The angle is not finite, the axis is not three numbers that are a direction, or the last move
            still runs.
        """
        about = -self._legs[-1].target if axis is None else np.asarray(axis, np.float64)
        norm = float(np.linalg.norm(about))
        if not np.isfinite(angle_deg) or about.shape != (3,) or not np.isfinite(norm) or norm == 0:
            raise UsageError(
                f"turn by {angle_deg}° about {axis}: give an angle and three numbers of an axis"
            )
        self._count_move(start_s)
        drawn = self._settings.mark_sigma_deg * float(self._movements.standard_normal())
        before, self._mark_error = self._mark_error, float(np.radians(drawn))
        turn = float(np.radians(angle_deg)) + self._mark_error - before
        approach, hand = int(np.sign(turn)), self._hand_over(turn)
        return self._turn(start_s, about / norm, turn, float("nan"), 0.0, approach, hand)

    def at(self, time_s: Floats) -> Motion:
        """Return direction of gravity, rate and conditions of the sensor at increasing times (n,) in s."""
        index = np.searchsorted(self._starts, time_s, side="right") - 1
        first, last = int(index[0]), int(index[-1])
        if first == last:
            return self._along(self._legs[first], time_s)
        cuts = np.searchsorted(index, np.arange(first + 1, last + 1))
        legs = zip(self._legs[first : last + 1], np.split(time_s, cuts), strict=True)
        parts = [self._along(leg, times) for leg, times in legs if len(times)]
        return Motion(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))

    def course(self) -> tuple[Floats, Floats]:
        """Return m times in s, (m,), and the directions of gravity (m, 3) then, for linear interpolation.

        The sensor rests before the first time and after the last one; without any move there is one time, 0
        s.
        """
        # Each leg is tabulated once: a later move changes none before it.
        for leg in self._legs[len(self._tabulated) :]:
            moves = leg.end_s > leg.start_s
            knots = np.linspace(leg.start_s, leg.end_s, leg.knots) if moves else np.zeros(0)
            self._tabulated.append((knots, self._along(leg, knots).direction))
            self._course = None
        if self._course is None:
            knots, directions = map(np.concatenate, zip(*self._tabulated, strict=True))
            knots, first = np.unique(knots, return_index=True)
            self._course = knots, directions[first]
        return self._course if len(self._course[0]) else (np.zeros(1), self.at(np.zeros(1)).direction)

    # -- making legs ------------------------------------------------------------------------------

    def _count_move(self, start_s: float) -> None:
        if start_s < self.still_at_s:
            raise UsageError(f"the stage moves until {self.still_at_s} s; wait for it")
        self._moves += 1
        self._previous_rad = self._legs[-1].to_rad

    def _error(self, approach: int) -> float:
        drawn = self._settings.fixture_sigma_deg * float(self._rng.standard_normal())
        slipped = self._moves > self._settings.part_slip_position  # the first move goes to position 0
        slip = self._settings.part_slip_deg if slipped else 0.0
        return float(np.radians(drawn + approach * self._settings.backlash_deg / 2 - slip))

    def _direction(self, psi: float | Floats, wobble: float | Floats = 0.0) -> Floats:
        """Return the direction of gravity (3,) or (n, 3) in the sensor at the angle ψ in the plane.

        `psi` is a number or (n,) in rad. `wobble`, also in rad, is added to the tilt of the stage's axis.
        """
        tilt = np.radians(self._settings.axis_tilt_deg) + wobble
        parts = np.cos(psi) * np.cos(tilt), np.sin(psi) * np.cos(tilt), np.sin(tilt)
        return np.stack(np.broadcast_arrays(*parts), axis=-1)

    def _hand_over(self, span_rad: float, *, one_way: bool = False, free: bool = False) -> HandMove | None:
        """Draw a movement by hand through an angle in rad; None if a motor moves the stage.

        `one_way` is True if the mark must be reached from one side, `free` if only the hand holds the
        sensor.
        """
        if not self._settings.hand_moves or abs(span_rad) < 1e-6:
            return None
        return HandMove(self._settings, self._movements, span_rad, one_way=one_way, free=free)

    def _swing(self, start_s: float, target: float, error: float, approach: int) -> float:
        """Append a move in the plane to the declared angle `target` in rad; return the time of its end."""
        last = self._legs[-1]
        span = target - last.to_rad
        hand = self._hand_over(span, one_way=bool(approach))
        # The error changes from its old to its new value during the move.
        turn = span - (error - last.error_rad)
        return self._turn(start_s, _UPRIGHT, turn, target, error, approach, hand)

    def _turn_towards(self, start_s: float, to: Floats, theta: float, error: float, approach: int) -> float:
        """Append the shortest turn to the direction `to` (3,); return the time in s at which it ends."""
        base = self._legs[-1].target
        axis = np.cross(to, base)
        size = float(np.linalg.norm(axis))
        turn = float(np.arctan2(size, base @ to))
        if size < 1e-9:
            # Equal or opposite directions have no plane: any axis at right angles to them will do.
            axis = np.cross(np.cross(base, np.eye(3)[int(np.argmin(np.abs(base)))]), base)
        self._mark_error = 0.0
        hand = self._hand_over(turn, free=True)
        return self._turn(start_s, axis / np.linalg.norm(axis), turn, theta, error, approach, hand)

    def _turn(
        self,
        start_s: float,
        axis: Floats,
        turn_rad: float,
        to_rad: float,
        error_rad: float,
        approach: int,
        hand: HandTurn | HandMove | None,
    ) -> float:
        """Append a turn to the trajectory; return the time in s at which it ends.

        `_Leg` explains the parameters.
        """
        last = self._legs[-1]
        from_rad = to_rad if np.isnan(last.to_rad) else last.to_rad
        # The time of a motor follows from the declared angle, in space from the turn.
        span_rad = to_rad - last.to_rad
        span_deg = abs(float(np.degrees(turn_rad if np.isnan(span_rad) else span_rad)))
        length_s = max(_SHORTEST_MOVE_S, span_deg / self._settings.move_speed_dps)
        end_s = start_s + (length_s if hand is None else hand.length_s)
        where = (last.target, axis, turn_rad, from_rad, to_rad, error_rad)
        order = max(self._moves - 1, 0)
        self._legs.append(_Leg(start_s, end_s, *where, order, approach, self._previous_rad, hand))
        self._starts = np.append(self._starts, start_s)
        return end_s

    # -- following legs ---------------------------------------------------------------------------

    def _along(self, leg: _Leg, time_s: Floats) -> Motion:
        if isinstance(leg.hand, HandTurn):
            return self._by_hand(leg, leg.hand, time_s)
        since_start = time_s - leg.start_s
        done, speed = _course(leg, time_s)
        direction, rate = leg.direction(leg.turn_rad * done), (leg.turn_rad * speed)[:, None] * leg.axis
        shaking = np.zeros(direction.shape)
        if leg.hand is not None:
            direction, rate = leg.hand.add_stray(since_start, direction, rate)
            shaking = leg.hand.shaking_mg(since_start)
        theta = leg.from_rad + (leg.to_rad - leg.from_rad) * done
        ringing = self._ringing(time_s - leg.end_s)
        return _motion(leg, time_s, direction, np.degrees(rate), shaking, ringing, theta)

    def _by_hand(self, leg: _Leg, hand: HandTurn, time_s: Floats) -> Motion:
        since = time_s - leg.start_s
        turned = hand.turned(since)
        wobble, wobbling = hand.tilt(since, turned)
        theta = leg.from_rad + turned[0]
        psi = self._alpha - theta + leg.error_rad
        direction = self._direction(psi, wobble)
        # Rates for which gravity in the part follows the direction: d' = -rate x d.
        rate = np.stack([-wobbling * np.sin(psi), wobbling * np.cos(psi), turned[1]], axis=1)
        still = np.zeros(len(time_s))
        return _motion(leg, time_s, direction, np.degrees(rate), hand.shaking_mg(since), still, theta)

    def _ringing(self, since: Floats) -> Floats:
        """Return the vibration (n,) in mg after a move: a decaying sine for 20 time constants.

        `since` (n,) is the time in s since the move stopped.
        """
        settings = self._settings
        if not settings.vibration_mg or not len(since) or since[0] > 20 * settings.vibration_decay_s:
            return np.zeros(len(since))
        rings = (since > 0) & (since <= 20 * settings.vibration_decay_s)
        after = np.where(rings, since, 0.0)
        wave = np.sin(2 * np.pi * settings.vibration_hz * after)
        return np.where(
            rings, settings.vibration_mg * np.exp(-after / settings.vibration_decay_s) * wave, 0.0
        )


def _motion(leg: _Leg, time_s: Floats, *course: Floats) -> Motion:
    """Return the `Motion` of the sensor during and after a move.

    `leg` is the move. `course` has the values at the times (n,) in s of those fields of `Motion` that
    change during a move: all from `direction` to `angle_rad`. The other fields follow from the move.
    """
    facts = (np.full(len(time_s), float(fact)) for fact in (leg.previous_rad, leg.order, leg.approach))
    since = time_s - leg.end_s if np.isfinite(leg.end_s) else time_s
    return Motion(*(*course, *facts, np.maximum(since, 0.0)))


def _course(leg: _Leg, time_s: Floats) -> Course:
    """Return the completed share (n,) of the move `leg` at times (n,) in s, and its derivative (n,) per s.

    The share is 0 at the start of the move and 1 from its end on.
    """
    n = len(time_s)
    moving = time_s - leg.end_s < 0
    if not moving.any():
        return np.ones(n), np.zeros(n)
    if isinstance(leg.hand, HandMove):
        turned = leg.hand.turned(time_s - leg.start_s)
        done, speed = (value / leg.hand.span_rad for value in turned)
    else:
        duration = leg.end_s - leg.start_s
        part = np.pi * (time_s - leg.start_s) / duration
        done = (1 - np.cos(part)) / 2
        speed = np.pi / (2 * duration) * np.sin(part)
    return np.where(moving, done, 1.0), np.where(moving, speed, 0.0)
