"""Where the part is: by the dwells so far, the turn since the last one, and three angles of each place.

The turn is the integral of the gyros. Declared angles, gravity and turns are compared by
`adis_gonio.fitting.slips`, so that a recorded session has the same likelihood.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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
from adis_gonio.fitting.slips import Angles, Diagnosis, Increments, PositionFinding, diagnose
from adis_gonio.fitting.slips.position_diagnosis import LARGEST, MEANINGS
from adis_gonio.model.effects import Conditions
from adis_gonio.record.blocks import Block, session_columns
from adis_gonio.record.expectation import (
    UNMODELLED_MG,
    UNSTATED_FIXTURE_DEG,
    Expectation,
    PriorKnowledge,
    turned_deg,
)
from adis_gonio.record.plans import Position

SCALE_ERROR = 0.01
"""Relative error of a gyro's gain (an estimate, D: the sheets at hand have none)."""
INSTABILITY_DPS = 0.015
"""What a gyro's bias does between dwells (the simulator's default, D)."""
G_SENSITIVITY_DPS = 0.05 * math.sqrt(2)
"""Gyro g-sensitivity, 0.05 °/s/g (CHIP, B), times the change of gravity's part at a quarter turn."""
GYRO_NOISE_DPS = 0.6
"""Of a sample (CHIP, B); averaging over the turn lowers it."""


@dataclass(frozen=True)
class GyroIntegral:
    """Integral of the three gyros.

    Attributes
    ----------
    angle_deg : (3,) float
        About x, y, z of the part, right-handed about the drawn axes.
    u_deg : float
        Standard uncertainty of each.
    zero_u_deg : float
        The part of it that noise and the zero have, without the gain.
    """

    angle_deg: Floats
    u_deg: float
    zero_u_deg: float


class Turning:
    """Follows the part from one dwell to the next.

    Parameters
    ----------
    longest_gap_s : float
        Time without samples after which nobody knows how the part was turned.
    """

    def __init__(self, longest_gap_s: float) -> None:
        self._longest_gap_s = longest_gap_s
        self._bias: Floats | None = None
        self._last_s = 0.0
        self._last = np.zeros(3)
        self._angle = np.zeros(3)
        self._travel = 0.0
        self._length_s = 0.0
        self._period_s = 0.0
        self._broken = False

    def rest(self, dwell: Block) -> None:
        """A dwell has ended: its mean is the gyros' zero, and the next turn begins."""
        rates = _rates(dwell)
        self._broken = rates is None or not len(dwell)
        if rates is None or not len(dwell):
            return
        self._bias = rates.mean(axis=0)
        self._last_s, self._last = float(dwell.time_s[-1]), np.zeros(3)
        self._angle, self._travel, self._length_s = np.zeros(3), 0.0, 0.0

    def see(self, block: Block) -> None:
        """Follow the part through the next samples; those that a dwell holds already are passed over."""
        rates = _rates(block)
        if self._bias is None or rates is None or not len(block):
            return
        new = block.time_s > self._last_s
        if not new.any():
            return
        time_s = np.concatenate([[self._last_s], block.time_s[new]])
        turning = np.concatenate([[self._last], rates[new] - self._bias])
        steps_s = np.diff(time_s)
        self._broken |= bool(steps_s.max() > self._longest_gap_s)
        means = (turning[1:] + turning[:-1]) / 2
        self._angle = self._angle + (means * steps_s[:, None]).sum(axis=0)
        # Blocks of samples, so that noise does not add up as travel.
        self._travel += float(np.abs((means * steps_s[:, None]).sum(axis=0)).max())
        self._length_s += float(time_s[-1] - time_s[0])
        self._period_s = float(np.median(steps_s))
        self._last_s, self._last = float(time_s[-1]), turning[-1]

    def turn(self) -> GyroIntegral | None:
        """The turn so far; None where it was not watched throughout."""
        if self._bias is None or self._broken or not self._length_s:
            return None
        wander = math.hypot(INSTABILITY_DPS, G_SENSITIVITY_DPS) * self._length_s
        noise = GYRO_NOISE_DPS * math.sqrt(self._period_s * self._length_s)
        zero = math.hypot(wander, noise)
        return GyroIntegral(self._angle, math.hypot(zero, SCALE_ERROR * self._travel), zero)


def _rates(block: Block) -> Floats | None:
    columns = session_columns(block)
    if not all(name in columns for name in ("gx", "gy", "gz")):
        return None
    return np.column_stack([columns[name] for name in ("gx", "gy", "gz")])


@dataclass(frozen=True)
class Stand:
    """Where the part stood, or stands now.

    Attributes
    ----------
    angle_deg : float or None
        As the stage counts; None of a dwell that was doubted and kept.
    mean_mg : (2 or more,) float
    turn : GyroIntegral or None
        By the gyros, since the stand before; None where nobody watched it from there.
    approach : int
        Direction from which it was reached, as the stage counts; 0 unknown.
    """

    angle_deg: float | None
    mean_mg: Floats
    turn: GyroIntegral | None
    approach: int = 0


def diagnosed(stands: Sequence[Stand], spread: PriorKnowledge, sense: int) -> Diagnosis:
    """What the three angles say of all stands; the last one is where the part is now."""
    stands = stands[-LARGEST:]
    n = len(stands)
    reading = math.hypot(spread.reading_mg, UNMODELLED_MG)
    declared = np.array(
        [np.nan if s.angle_deg is None else sense * math.radians(s.angle_deg) for s in stands]
    )
    order = np.arange(n, dtype=float)
    turns = [stand.turn for stand in stands[1:]]
    increments = Increments(
        np.radians([np.nan if turn is None else float(turn.angle_deg[2]) for turn in turns]),
        np.radians([np.nan if turn is None else turn.zero_u_deg for turn in turns]),
        np.zeros((n - 1, 2)),
    )
    fixture = UNSTATED_FIXTURE_DEG if spread.fixture_deg is None else spread.fixture_deg
    return diagnose(
        Angles(
            tuple(range(n)),
            declared,
            np.array([stand.mean_mg[:2] for stand in stands]),
            np.tile(reading**2 * np.eye(2), (n, 1, 1)),
            Conditions(
                time_s=order,
                angle_rad=declared,
                order=order,
                approach=np.array([float(sense * stand.approach) for stand in stands]),
            ),
            spread.gravity_mg,
            math.radians(fixture),
            spread.bias_mg,
            increments,
        )
    )


def with_three_angles(
    guard: Guard | None, found: Diagnosis, stands: Sequence[Stand], sense: int
) -> Guard | None:
    """The guard with what all three angles say; a guard of their own where the present place is accused."""
    here = min(len(stands), LARGEST) - 1
    last = next((one for one in found.findings if here in (one.position, *one.others)), None)
    if last is None:
        return guard
    before = [stand.angle_deg for stand in stands[-LARGEST:]]
    told = _told(last, here, before, sense)
    if guard is None:
        return Guard("wrong_angle", told, _values(last, sense), spoils=True)
    if guard.kind != "wrong_angle":
        return guard
    return replace(guard, message=f"{guard.message}; {told}", values=guard.values | _values(last, sense))


def _values(found: PositionFinding, sense: int) -> dict[str, float]:
    return {
        "found_deg": sense * found.error_deg[0],
        "found_u_deg": found.error_deg[1],
        "probability": found.probability,
    }


def _told(found: PositionFinding, here: int, angles_deg: Sequence[float | None], sense: int) -> str:
    by = "gravity" if found.gyro_deg is None else "gravity and gyro"
    off = f"{sense * found.error_deg[0]:+.2f}° ± {found.error_deg[1]:.2f}°"
    names = " or ".join(dict.fromkeys(MEANINGS[named.name] for named in found.names))
    if found.finding == "gravity_wrong":
        return f"the gyro turned as asked and gravity does not fit: {names}"
    if found.finding == "swapped":
        other = next((k for k in (found.position, *found.others) if k != here), here)
        return f"by {by} the part stands where {angles_deg[other]:g}° was asked for, and stood here then"
    angle = angles_deg[found.position]
    since = "a dwell that was kept" if angle is None else f"{angle:g}°"
    where = "" if found.position == here else f" since {since}"
    return f"by {by} the part stands {off} from what is asked{where}: {names}"


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
            kept.append(replace(self._taken[-1], place=-1, doubted=True))
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


__all__ = ["Judge"]
