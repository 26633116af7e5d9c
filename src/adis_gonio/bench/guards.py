"""Guards: checks for errors at the bench, such as a wrong position or a disturbed dwell.

Each check of this module returns a `Guard` (a question with its numbers), or None if all is well. The
limits follow from the sensor's noise, the sensor's data sheet and the fixture (`record.plans`), so that a
good sensor is not questioned. `Judge` compares declared angles, gravity and the integral of the gyros.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.base.numbers import format_uncertain, signed
from adis_gonio.base.uncertainty import NORMAL_95
from adis_gonio.bench.events import RETAKE, Guard, GuardKind, Problem, TurnMeasured, Vector
from adis_gonio.model.effects.base import AXES
from adis_gonio.record.blocks import Block, block_series, count_alarms
from adis_gonio.record.plans import GAIN_LIMIT, Expectation, K, Position, PriorKnowledge, turned_deg
from adis_gonio.record.stillness import SHIFT_MG

_STEPS: tuple[tuple[Literal["temperature", "supply"], str, str, float], ...] = (
    ("temperature", "temperature_c", "°C", 1.0),
    ("supply", "supply_v", "V", 0.05),
)
"""Conditions that may step within a dwell: kind, quantity of a block, unit, largest change in a second.

The change of the temperature is ten times the fastest self-heating by the data sheet (5 °C in one minute),
the change of the supply a tenth of the specified range.
"""


def _other_axis(turn: GyroIntegral) -> str | None:
    """Return the axis of the largest turn; None if it is z or within the gyros' uncertainty."""
    size = np.abs(turn.angle_deg)
    most = int(np.argmax(size))
    if most == 2 or size[most] <= math.degrees(SHIFT_MG / 1000.0) + K * turn.u_deg:
        return None
    return AXES[most]


def judge_pose(
    accel_mg: Floats, asked: Vector | None, before_mg: Floats | None, before_asked: Vector | None
) -> Guard | None:
    """Check that an attitude in space is new, and not upside down; return None if it is plausible.

    `accel_mg` and `before_mg` are the readings (3,) now and at the pose before, `asked` and `before_asked`
    the requested directions; None means that there is no pose before, or no requested direction.

    A sensor that was not moved is found first, since this would spoil the result. Such a sensor often also
    seems upside down, which would be allowed.
    """
    if before_mg is not None:
        turned = angle_between_deg(accel_mg, before_mg)
        wanted = 90.0 if asked is None or before_asked is None else angle_between_deg(asked, before_asked)
        if turned <= max(math.degrees(SHIFT_MG / 1000.0), 0.1 * wanted):
            message = (
                f"the part has not moved: {turned:.2f}° since the pose before,"
                f" about {wanted:.0f}° was requested"
            )
            return Guard("not_moved", message, {"gravity_deg": turned, "asked_deg": wanted}, spoils=True)
    if asked is None:
        return None
    off = angle_between_deg(accel_mg, asked)
    if off <= 120.0:
        return None
    x, y, z = (float(value) for value in accel_mg)
    message = (
        f"the part is upside down: {off:.0f}° from the requested attitude"
        f" (x {signed(x, 0)}, y {signed(y, 0)}, z {signed(z, 0)} mg;"
        " an axis reads + if its arrow points down); any new attitude is allowed"
    )
    values = {"off_deg": off, "x_mg": x, "y_mg": y, "z_mg": z}
    return Guard("upside_down", message, values, default="keep")


def angle_between_deg(a: Sequence[float] | Floats, b: Sequence[float] | Floats) -> float:
    """Return the angle between the directions `a` and `b` (3,) in degrees, 0 to 180."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    cosine = float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))
    return math.degrees(math.acos(min(1.0, max(-1.0, cosine))))


def judge_shift(accel_mg: Floats, before_mg: Floats, limit_mg: Floats) -> Guard | None:
    """Check that the sensor rests as it did before its dwell was disturbed; return None if it does.

    `accel_mg` and `before_mg` are the readings (3,) now and then, `limit_mg` the largest allowed shift
    (3,).
    """
    shift = np.abs(accel_mg - before_mg)
    limit = np.maximum(limit_mg, SHIFT_MG)
    k = int(np.argmax(shift / limit))
    if shift[k] <= limit[k]:
        return None
    return drift_guard(
        f"{AXES[k]} has shifted by {shift[k]:.3g} mg since the dwell began",
        {"shift_mg": float(shift[k]), "limit_mg": float(limit[k])},
    )


def drift_guard(why: str, values: dict[str, float] | None = None) -> Guard:
    """Return the question for a sensor that has moved since a dwell began.

    `why` describes the motion; `values` has the numbers of the message by name, None without numbers.
    """
    message = f"{why}: the part or the stage has moved on; clamp it and take the position again"
    return Guard("drift", message, values or {})


def judge_dwell(scans: Block, problems: Sequence[Problem]) -> list[Guard]:
    """Return the questions about a complete dwell: alarms, supply, and sudden changes of temperature.

    `problems` are the problems that were found in the dwell; only problems of the kinds `supply`,
    `temperature` and `alarm` give a question. Changes of temperature and supply are found in the scans.
    """
    guards = []
    kinds: dict[str, GuardKind] = {"supply": "supply", "temperature": "temperature", "alarm": "over_range"}
    found = [problem for problem in problems if problem.kind in kinds]
    if found:
        # A supply out of range also sets EA: it is the cause and comes first.
        found.sort(key=lambda problem: list(kinds).index(problem.kind))
        message = "; ".join(problem.message for problem in found)
        guards.append(Guard(kinds[found[0].kind], message, {"scans": float(count_alarms(scans))}))
    series, asked = block_series(scans), {problem.kind for problem in found}
    for kind, column, unit, limit in _STEPS:
        if column not in series or kind in asked or (kind == "supply" and guards):
            continue
        step = greatest_step(scans.time_s, series[column])
        if step > limit:
            message = (
                f"the {kind} has stepped by {step:.2g} {unit} within the dwell"
                f" (at most {limit:g} {unit} a second)"
            )
            name = column.rpartition("_")[2]
            guards.append(Guard(kind, message, {f"step_{name}": step, f"limit_{name}": limit}))
    return guards


def greatest_step(time_s: Floats, values: Floats) -> float:
    """Return the largest change of `values` (n,) within a second, estimated from short means.

    `time_s` (n,) are the times of the values. The means are over half a second, or over quarters of a dwell
    of less than two seconds.
    """
    width_s = min(0.5, float(time_s[-1] - time_s[0]) / 4)
    if width_s <= 0:
        return 0.0
    # Means over slots of equal width; a slot with one sample is left out.
    slot = ((time_s - time_s[0]) / width_s).astype(int)
    means = np.array([values[slot == k].mean() for k in np.unique(slot) if (slot == k).sum() > 1])
    # Compare each window with the window after the next: a step may lie within the window between them.
    return float(np.abs(means[2:] - means[:-2]).max()) if len(means) > 2 else 0.0


SCALE_ERROR = 0.01
"""Assumed relative standard uncertainty of a gyro's gain (an estimate, D: the data sheets state none)."""
INSTABILITY_DPS = 0.015
"""Assumed change of a gyro's bias between dwells in °/s (the simulator's default, D)."""
G_SENSITIVITY_DPS = 0.05 * math.sqrt(2)
"""Change of a gyro's zero rate in °/s by a quarter turn.

It is the g-sensitivity, 0.05 °/s/g (sibling's data sheet, B), times the change of gravity in g.
"""
GYRO_NOISE_DPS = 0.6
"""Noise of a gyro's sample in °/s (sibling's data sheet, B); the average over the turn has less."""


@dataclass(frozen=True)
class GyroIntegral:
    """Integral of the rates of the three gyros.

    Attributes
    ----------
    angle_deg : (3,) float
        Angles turned about x, y, z of the sensor, right-handed about the drawn axes.
    u_deg : float
        Standard uncertainty of each angle.
    """

    angle_deg: Floats
    u_deg: float


class Turning:
    """Integrates the gyros from one dwell to the next.

    Parameters
    ----------
    longest_gap_s : float
        Longest time without samples in s; after a longer gap the turn is unknown.
    dwell : Block or None
        Scans of the dwell from whose end the turn is integrated; their mean rate is the zero rate of the
        gyros in this turn. With None the turn is unknown.
    """

    def __init__(self, longest_gap_s: float, dwell: Block | None = None) -> None:
        self._longest_gap_s = longest_gap_s
        rates = None if dwell is None else block_series(dwell).get("gyro")
        self._bias = None if rates is None else rates.mean(axis=0)
        self._last_s = 0.0 if dwell is None else float(dwell.time_s[-1])
        self._last, self._angle = np.zeros(3), np.zeros(3)
        self._travel = self._length_s = self._period_s = 0.0
        self._broken = False

    def see(self, block: Block) -> None:
        """Integrate the rates of the next samples; samples of the ended dwell are skipped."""
        rates = block_series(block).get("gyro")
        if self._bias is None or rates is None or not len(block):
            return
        new = block.time_s > self._last_s
        if not new.any():
            return
        # Trapezoidal rule, continued from the last sample of the block before.
        time_s = np.concatenate([[self._last_s], block.time_s[new]])
        turning = np.concatenate([[self._last], rates[new] - self._bias])
        steps_s = np.diff(time_s)
        self._broken |= bool(steps_s.max() > self._longest_gap_s)
        means = (turning[1:] + turning[:-1]) / 2
        self._angle = self._angle + (means * steps_s[:, None]).sum(axis=0)
        # The travel is summed over blocks, so that noise does not add to it.
        self._travel += float(np.abs((means * steps_s[:, None]).sum(axis=0)).max())
        self._length_s += float(time_s[-1] - time_s[0])
        self._period_s = float(np.median(steps_s))
        self._last_s, self._last = float(time_s[-1]), turning[-1]

    def turn(self) -> GyroIntegral | None:
        """Return the angles turned since the last dwell; None if the turn is unknown.

        It is unknown after a gap of more than `longest_gap_s` between samples, without samples since the
        dwell, and before the first dwell with gyros.
        """
        if self._bias is None or self._broken or not self._length_s:
            return None
        wander = math.hypot(INSTABILITY_DPS, G_SENSITIVITY_DPS) * self._length_s
        noise = GYRO_NOISE_DPS * math.sqrt(self._period_s * self._length_s)
        return GyroIntegral(self._angle, math.hypot(wander, noise, SCALE_ERROR * self._travel))


@dataclass(frozen=True)
class _JudgedDwell:
    """A recorded dwell of a session.

    `place` is the index of its position in the plan, `position` this position, and `mean_mg` (3,) its mean
    reading. `doubted` is True if the operator overruled a guard.
    """

    place: int
    position: Position
    mean_mg: Floats
    doubted: bool


class Judge:
    """Judges the position of the sensor at each dwell by the dwells before it.

    Parameters
    ----------
    planar : bool
        False if attitudes are free.
    spread : PriorKnowledge
        Uncertainties of a good sensor and of its fixture, which must be finite.
    sense : {1, -1}
        −1 in a reversed session (the stage counts angles the other way than the plan).
    longest_gap_s : float
        Longest time in s without samples in a turn; after a longer gap the angle by the gyros is unknown.
    """

    def __init__(self, spread: PriorKnowledge, *, planar: bool, sense: int, longest_gap_s: float) -> None:
        self._spread = spread
        self._planar = planar
        self.sense = sense
        self._taken: list[_JudgedDwell] = []
        self._longest_gap_s = longest_gap_s
        self.turning = Turning(longest_gap_s)
        self._rebuild()

    def settled(self, place: int, position: Position, accel_mg: Floats) -> Guard | None:
        """Check by the reading `accel_mg` (3,) at rest that the sensor is at a position.

        `place` is the index of the position in the plan. Returns the question to the operator, or None if
        the position is plausible.
        """
        if not self._planar or position.angle_deg is None:
            mean_mg, asked = None, None
            if self._taken and self._taken[-1].place != place:
                mean_mg, asked = self._taken[-1].mean_mg, self._taken[-1].position.direction
            return judge_pose(accel_mg, position.direction, mean_mg, asked)
        guard = self._judge_level(accel_mg)
        if guard is None and self._expected.begun:
            return self._judge_turn(position, position.angle_deg, accel_mg)
        return guard or self._judge_start(position.angle_deg, accel_mg)

    def _judge_level(self, accel_mg: Floats) -> Guard | None:
        """Check that the axis of rotation (the sensor's Z) is horizontal; return None if it is."""
        z, gravity_mg = float(accel_mg[2]), self._spread.gravity_mg
        # The first part is the tilt that changes a reading as much as the gain limit.
        limit = gravity_mg * math.sin(math.acos(1 - GAIN_LIMIT)) + K * self._spread.bias_mg
        if abs(z) <= limit:
            return None
        tilt = math.degrees(math.asin(min(1.0, abs(z) / gravity_mg)))
        way = "up" if z < 0 else "down"
        message = (
            f"z reads {signed(z, 0)} mg: the Z arrow points {way}, {tilt:.0f}° out of the horizontal;"
            f" it is the axis of rotation and has to be horizontal (at most {limit:.0f} mg)"
        )
        values = {"z_mg": z, "limit_mg": limit, "tilt_deg": tilt}
        return Guard("wrong_axis", message, values, spoils=True)

    def _judge_start(self, asked_deg: float, accel_mg: Floats) -> Guard | None:
        """Check that the sensor is placed as drawn at the first position; return None if it is.

        Any start angle is allowed; a question is returned if the angle of the reading is more than 90° from
        the requested angle.
        """
        x, y = float(accel_mg[0]), float(accel_mg[1])
        off = wrap_degrees(-self.sense * math.degrees(math.atan2(y, x)) - asked_deg)
        if abs(off) <= 90.0:
            return None
        message = (
            f"the part is upside down: {signed(off, 0)}° from the drawing by gravity"
            f" (x {signed(x, 0)}, y {signed(y, 0)} mg); any start angle is allowed,"
            " so it may stay if the stage shows the requested angle"
        )
        return Guard("upside_down", message, {"off_deg": off, "x_mg": x, "y_mg": y}, default="keep")

    def _judge_turn(self, position: Position, here_deg: float, accel_mg: Floats) -> Guard | None:
        """Check that the sensor was turned in the plane as requested; return None if it was.

        `here_deg` is the angle of the position.
        """
        off, turn = self._expected.off(accel_mg, here_deg), self.turning.turn()
        if off.allowed:
            return None
        asked_deg = self._asked_deg(position)
        gravity_deg = turned_deg(self._taken[-1].mean_mg, accel_mg, self.sense)
        values = {
            "asked_deg": asked_deg,
            "gravity_deg": gravity_deg,
            "off_deg": off.off_deg,
            "limit_deg": off.limit_deg,
        }
        wanted = f"{signed(asked_deg)}°"
        seen = f"{signed(gravity_deg, 2)}° by gravity"
        if turn is not None:
            along = self.sense * float(turn.angle_deg[2])
            values |= {"gyro_deg": along, "gyro_u_deg": turn.u_deg}
            seen += f", {format_uncertain(along, NORMAL_95 * turn.u_deg, 'deg', sign=True)} by the gyro"
            if (about := _other_axis(turn)) is not None:
                x, y, z = (float(angle) for angle in turn.angle_deg)
                values |= {"gyro_x_deg": x, "gyro_y_deg": y, "gyro_z_deg": z}
                message = (
                    f"turned about {about} (x {signed(x, 1)}°, y {signed(y, 1)}°,"
                    f" z {signed(z, 1)}° by the gyros); {wanted} about z was requested"
                )
                return Guard("wrong_axis", message, values, spoils=True)
        if abs(gravity_deg) <= math.degrees(SHIFT_MG / 1000.0):
            message = f"the part has not moved: {seen}; {wanted} was requested"
            return Guard("not_moved", message, values, spoils=True)
        if abs(wrap_degrees(gravity_deg + asked_deg)) <= off.limit_deg:
            message, answers = f"turned the wrong way: {seen}; {wanted} was requested", RETAKE
            # No dwell excludes that the stage counts the other way.
            if self._may_be_reversed and self._other.off(accel_mg, here_deg).allowed:
                message += "; if the stage counts the other way, reverse the whole session"
                answers = ("retake", "reverse", "keep", "skip")
            return Guard("reversed", message, values, answers, spoils=True)
        message = (
            f"{signed(off.off_deg, 2)}° off {here_deg:g}° ({seen}, {wanted} requested);"
            f" part and fixture explain {off.limit_deg:.2f}° at most"
        )
        return Guard("wrong_angle", message, values, spoils=True)

    def turned(self, place: int, position: Position, accel_mg: Floats) -> TurnMeasured | None:
        """Return the turn from the last dwell to the present position; None before the first dwell.

        `place` is the index of the present position in the plan, `accel_mg` the present reading.
        """
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
        """Take a complete dwell into account; a doubted dwell does not change the model of the sensor.

        `place` is the index of its position in the plan; `doubted` is True if a guard was overruled.
        """
        mean = np.asarray(scans.accel_mg.mean(axis=0))
        self._taken.append(_JudgedDwell(place, position, mean, doubted))
        self._learn(self._taken[-1])
        self.turning = Turning(self._longest_gap_s, scans)

    def withdraw(self, place: int) -> None:
        """Forget the dwell of a place (index in the plan).

        If it is the newest dwell, the next turn is still measured from its position.
        """
        kept = [entry for entry in self._taken if entry.place != place]
        if self._taken and self._taken[-1].place == place:
            kept.append(replace(self._taken[-1], doubted=True))
        self._taken = kept
        self._rebuild()

    def reverse(self) -> None:
        """Change the sign of all angles of the session, including the dwells so far."""
        self.sense = -self.sense
        self._rebuild()

    def angle_deg(self, accel_mg: Floats) -> float | None:
        """Return the stage angle that the reading `accel_mg` (3,) shows, within ±180°.

        The result is None if attitudes are free.
        """
        return self._expected.angle_deg(accel_mg) if self._planar else None

    def tolerance_deg(self, accel_mg: Floats, angle_deg: float) -> float | None:
        """Return the largest deviation in degrees from the stage angle `angle_deg` that no guard doubts.

        `accel_mg` (3,) is the present reading. The deviation becomes smaller when dwells have shown the
        sensor's gains, biases and misalignment. The result is None before the first dwell.
        """
        if not self._planar or not self._expected.begun:
            return None
        return self._expected.off(accel_mg, angle_deg).limit_deg

    def _rebuild(self) -> None:
        self._expected = Expectation(self._spread, self.sense)
        self._other = Expectation(self._spread, -self.sense)
        self._may_be_reversed = True
        for taken in self._taken:
            self._learn(taken)

    def _learn(self, taken: _JudgedDwell) -> None:
        angle = taken.position.angle_deg
        if taken.doubted or angle is None or not self._planar:
            return
        self._may_be_reversed &= self._other.off(taken.mean_mg, angle).allowed
        self._expected.add(taken.mean_mg, angle)
        self._other.add(taken.mean_mg, angle)

    def _asked_deg(self, position: Position) -> float:
        """Return the requested turn in degrees from the last dwell to a position, by the shorter way."""
        before = self._taken[-1].position.angle_deg or 0.0
        asked = wrap_degrees((position.angle_deg or 0.0) - before)
        return 180.0 if asked == -180.0 else asked
