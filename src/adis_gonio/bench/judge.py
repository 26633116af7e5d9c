"""What the guards have to remember of a session: the dwells so far, and the turn since the last one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.bench.events import TurnMeasured
from adis_gonio.bench.guards import (
    Guard,
    Reading,
    angle_between_deg,
    judge_level,
    judge_pose,
    judge_start,
    judge_turn,
)
from adis_gonio.bench.three_angles import Stand, diagnosed, with_three_angles
from adis_gonio.bench.turning import GyroIntegral, Turning
from adis_gonio.record.blocks import Block
from adis_gonio.record.expectation import Expectation, PriorKnowledge, turned_deg
from adis_gonio.record.plans import Position


@dataclass(frozen=True)
class _Taken:
    """A dwell: where it was asked, its mean (3,) in mg, and whether it was doubted and kept."""

    place: int
    position: Position
    mean_mg: Floats
    doubted: bool
    turn: GyroIntegral | None = None
    since: int | None = None
    """Place of the dwell from which `turn` was watched."""


class Judge:
    """Judges where the part is, position by position.

    Parameters
    ----------
    planar : bool
        False where attitudes are free.
    spread : PriorKnowledge
        What may be off in a sane part; a fixture of infinite uncertainty is not judged.
    sense : {1, -1}
        -1 in a session that is taken as reversed.
    longest_gap_s : float
        As `Turning`.
    """

    def __init__(self, spread: PriorKnowledge, *, planar: bool, sense: int, longest_gap_s: float) -> None:
        self._spread = spread
        self._planar = planar
        self.sense = sense
        self._taken: list[_Taken] = []
        self._longest_gap_s = longest_gap_s
        self.turning = Turning(longest_gap_s)
        self._turned: tuple[GyroIntegral | None, int | None] = (None, None)
        self._rebuild()

    def settled(self, position: Position, accel_mg: Floats) -> Guard | None:
        """What cannot be right where the part has come to rest; None where all can be."""
        if not self._planar or position.angle_deg is None:
            return self._pose(position, accel_mg)
        level = judge_level(accel_mg, self._spread.gravity_mg, self._spread.bias_mg)
        if level is not None:
            return level
        if not self._expected.begun:
            return judge_start(accel_mg, position.angle_deg, self.sense)
        before, turn = self._taken[-1], self.turning.turn()
        self._turned = (turn, before.place)
        reversed_off = self._other.off(accel_mg, position.angle_deg) if self._may_be_reversed else None
        guard = judge_turn(
            Reading(
                self._asked_deg(position),
                position.angle_deg,
                turned_deg(before.mean_mg, accel_mg, self.sense),
                self._expected.off(accel_mg, position.angle_deg),
                reversed_off,
                turn,
                self.sense,
            )
        )
        stands = self._stands(position, accel_mg)
        return with_three_angles(guard, diagnosed(stands, self._spread, self.sense), stands, self.sense)

    def turned(self, place: int, position: Position, accel_mg: Floats) -> TurnMeasured | None:
        """The turn since the dwell before; None before the first."""
        if not self._taken:
            return None
        before, turn = self._taken[-1], self.turning.turn()
        u_deg = None if turn is None else turn.u_deg
        if not self._planar or position.angle_deg is None:
            by_gyro = None if turn is None else float(np.linalg.norm(turn.angle_deg))
            return TurnMeasured(place, None, by_gyro, u_deg, angle_between_deg(before.mean_mg, accel_mg))
        by_gyro = None if turn is None else self.sense * float(turn.angle_deg[2])
        gravity = turned_deg(before.mean_mg, accel_mg, self.sense)
        return TurnMeasured(place, self._asked_deg(position), by_gyro, u_deg, gravity)

    def done(self, place: int, position: Position, scans: Block, *, doubted: bool) -> None:
        """Learn from a complete dwell; one that was doubted and kept teaches nothing but where it was."""
        mean = np.asarray(scans.accel_mg.mean(axis=0))
        self._taken.append(_Taken(place, position, mean, doubted, *self._turned))
        self._turned = (None, None)
        self._learn(self._taken[-1])
        self.turning.rest(scans)

    def last_turn(self) -> tuple[int, GyroIntegral] | None:
        """Turn into the newest dwell, and the place from which it was watched; None where nobody did."""
        last = self._taken[-1] if self._taken else None
        return None if last is None or last.turn is None or last.since is None else (last.since, last.turn)

    def forget_turn(self) -> None:
        """Nobody has watched the part since the last dwell."""
        self.turning = Turning(self._longest_gap_s)

    def withdraw(self, place: int) -> None:
        """Forget the dwell of a place, as far as it taught something; the part is still where it is."""
        last = self._taken[-1].place == place if self._taken else False
        kept = [entry for entry in self._taken if entry.place != place]
        if last:
            kept.append(_doubtful(self._taken[-1]))
        self._taken = kept
        self._rebuild()

    def reverse(self) -> None:
        """Take the session as turned the other way, and what was measured so far with it."""
        self.sense = -self.sense
        self._rebuild()

    def angle_deg(self, accel_mg: Floats) -> float | None:
        """Live angle by gravity as the stage counts, within ±180°; None with free attitudes."""
        return self._expected.angle_deg(accel_mg) if self._planar else None

    def tolerance_deg(self, accel_mg: Floats, angle_deg: float) -> float | None:
        """Distance from a stage angle within which a reading there is not questioned.

        It shrinks as dwells show the part's gains, biases and misalignment; None before the first dwell.
        """
        if not self._planar or not self._expected.begun:
            return None
        return self._expected.off(accel_mg, angle_deg).limit_deg

    def _stands(self, position: Position, accel_mg: Floats) -> list[Stand]:
        """Where the part stood in all dwells, and stands now."""
        stands: list[Stand] = []
        before: _Taken | None = None
        for taken in self._taken:
            angle = None if taken.doubted else taken.position.angle_deg
            watched = taken.turn if before is not None and taken.since == before.place else None
            stands.append(Stand(angle, taken.mean_mg, watched, taken.position.approach))
            before = taken
        return [*stands, Stand(position.angle_deg, accel_mg, self._turned[0], position.approach)]

    def _rebuild(self) -> None:
        self._expected = Expectation(self._spread, self.sense)
        self._other = Expectation(self._spread, -self.sense)
        self._may_be_reversed = True
        for taken in self._taken:
            self._learn(taken)

    def _learn(self, taken: _Taken) -> None:
        angle = taken.position.angle_deg
        if taken.doubted or angle is None or not self._planar:
            return
        self._may_be_reversed &= self._other.off(taken.mean_mg, angle).allowed
        self._expected.add(taken.mean_mg, angle)
        self._other.add(taken.mean_mg, angle)

    def _asked_deg(self, position: Position) -> float:
        """Turn from the dwell before to a position, the short way."""
        before = self._taken[-1].position.angle_deg or 0.0
        asked = wrap_degrees((position.angle_deg or 0.0) - before)
        return 180.0 if asked == -180.0 else asked

    def _pose(self, position: Position, accel_mg: Floats) -> Guard | None:
        before = self._taken[-1] if self._taken else None
        return judge_pose(
            accel_mg,
            _direction(position),
            None if before is None else before.mean_mg,
            None if before is None else _direction(before.position),
        )


def _direction(position: Position) -> Floats | None:
    return None if position.direction is None else np.array(position.direction)


def _doubtful(taken: _Taken) -> _Taken:
    return replace(taken, place=-1, doubted=True)


__all__ = ["Judge"]
