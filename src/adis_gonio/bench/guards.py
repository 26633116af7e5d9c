"""What cannot be right on the bench, judged from means, turns and samples; no screen, no sensor.

Each judgement gives a `Guard`, a question with its numbers, or None. Limits are those of the sensor's own
noise, of the part's data sheet and of the fixture (`expectation`), so that a sane part is not questioned.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, get_args

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.base.numbers import counted
from adis_gonio.bench.events import GuardKind
from adis_gonio.model.effects.base import AXES
from adis_gonio.record.blocks import Block, session_columns
from adis_gonio.record.expectation import GAIN_LIMIT, K, Off
from adis_gonio.record.stillness import SHIFT_MG

if TYPE_CHECKING:
    from adis_gonio.bench.events import Problem
    from adis_gonio.bench.judge import GyroIntegral

GUARD_KINDS: tuple[str, ...] = get_args(GuardKind)

TILT_LIMIT_DEG = math.degrees(math.acos(1 - GAIN_LIMIT))
"""Tilt of the rotation axis out of the horizontal that costs as much reading as a gain may be off."""
NOT_MOVED_SHARE = 0.1
"""In space: a pose a tenth of the way to the one asked for shows nothing new."""
OTHER_WAY_UP_DEG = 120.0
"""In space: nearer than this to the opposite of what was asked is meant the other way up (the attitudes
between, 60° to 120°, are free to choose)."""
STEP_WINDOW_S = 1.0
TEMPERATURE_STEP_C = 1.0
"""Change within a second: ten times the fastest self-heating that CHIP tells of (5 °C in one minute)."""
SUPPLY_STEP_V = 0.05
"""Change within a second: a tenth of the specified range of 4.75 to 5.25 V."""

RETAKE: tuple[str, ...] = ("retake", "keep", "skip")


@dataclass(frozen=True)
class Guard:
    """A question to the operator.

    Attributes
    ----------
    values : dict of str to float
        Numbers behind the message; names end in their unit.
    answers, default
        As in `events.GuardRaised`.
    spoils : bool
        True where a result that holds this dwell as it is cannot be right.
    """

    kind: GuardKind
    message: str
    values: dict[str, float] = field(default_factory=dict)
    answers: tuple[str, ...] = RETAKE
    default: str = "retake"
    spoils: bool = False

    @property
    def contradicts(self) -> bool:
        """True where either the part's place or a dwell before is wrong."""
        return self.kind in ("not_moved", "reversed", "wrong_axis", "wrong_angle")


def insistent(guard: Guard, times: int) -> Guard:
    """The same guard when it stops at one place for the n-th time: perhaps what was before is wrong."""
    if times < 2 or not guard.contradicts:
        return guard
    hint = (
        f"stopped here {times} times: if the part stands right now, a dwell before does not, or the part"
        " has slipped since; take the position again and undo what was before"
    )
    return replace(guard, message=f"{guard.message}; {hint}", values=guard.values | {"times": float(times)})


@dataclass(frozen=True)
class Reading:
    """What is known when the part has come to rest at a position in the plane.

    Attributes
    ----------
    asked_deg, here_deg : float
        Turn that was asked for since the dwell before, and the angle asked for.
    gravity_deg : float
        Turn by gravity since the dwell before, within ±180°.
    off, off_reversed : Off
        From the angle asked for, if the stage counts as the session has it, or the other way.
    turn : GyroIntegral or None
        By the gyros.
    sense : int
        -1 in a session that is taken as reversed.
    """

    asked_deg: float
    here_deg: float
    gravity_deg: float
    off: Off
    off_reversed: Off | None
    turn: GyroIntegral | None
    sense: int = 1


def judge_turn(reading: Reading) -> Guard | None:
    """Whether the part was turned as asked, in the plane."""
    if reading.off.allowed:
        return None
    values = {
        "asked_deg": reading.asked_deg,
        "gravity_deg": reading.gravity_deg,
        "off_deg": reading.off.off_deg,
        "limit_deg": reading.off.limit_deg,
    }
    gyro, about = "", None
    if reading.turn is not None:
        along = reading.sense * float(reading.turn.angle_deg[2])
        values |= {"gyro_deg": along, "gyro_u_deg": reading.turn.u_deg}
        gyro = f", {along:+.1f}° ± {reading.turn.u_deg:.1f}° by the gyro"
        about = _other_axis(reading.turn)
    if about is not None and reading.turn is not None:
        x, y, z = (float(angle) for angle in reading.turn.angle_deg)
        values |= {"gyro_x_deg": x, "gyro_y_deg": y, "gyro_z_deg": z}
        message = (
            f"turned about {about} (x {x:+.1f}°, y {y:+.1f}°, z {z:+.1f}° by the gyros);"
            f" {reading.asked_deg:+g}° about z were asked"
        )
        return Guard("wrong_axis", message, values, spoils=True)
    seen = f"{reading.gravity_deg:+.2f}° by gravity{gyro}"
    if abs(reading.gravity_deg) <= math.degrees(SHIFT_MG / 1000.0):
        message = f"the part has not moved: {seen}; {reading.asked_deg:+g}° were asked"
        return Guard("not_moved", message, values, spoils=True)
    if abs(wrap_degrees(reading.gravity_deg + reading.asked_deg)) <= reading.off.limit_deg:
        return _reversed(reading, values, seen)
    message = (
        f"{reading.off.off_deg:+.2f}° off {reading.here_deg:g}° ({seen}, {reading.asked_deg:+g}° asked);"
        f" part and fixture explain {reading.off.limit_deg:.2f}° at most"
    )
    return Guard("wrong_angle", message, values, spoils=True)


def _reversed(reading: Reading, values: dict[str, float], seen: str) -> Guard:
    message = f"turned the wrong way: {seen}; {reading.asked_deg:+g}° were asked"
    answers = RETAKE
    if reading.off_reversed is not None and reading.off_reversed.allowed:
        message += "; if the stage counts the other way, take the whole session as reversed"
        answers = ("retake", "reverse", "keep", "skip")
    return Guard("reversed", message, values, answers, spoils=True)


def _other_axis(turn: GyroIntegral) -> str | None:
    """The axis that was turned about most, where it is not z and more than the gyros' uncertainty."""
    size = np.abs(turn.angle_deg)
    most = int(np.argmax(size))
    if most == 2 or size[most] <= math.degrees(SHIFT_MG / 1000.0) + K * turn.u_deg:
        return None
    return AXES[most]


def judge_level(accel_mg: Floats, gravity_mg: float, bias_mg: float) -> Guard | None:
    """Whether the axis of rotation, the part's Z, lies horizontal."""
    z = float(accel_mg[2])
    limit = gravity_mg * math.sin(math.radians(TILT_LIMIT_DEG)) + K * bias_mg
    if abs(z) <= limit:
        return None
    tilt = math.degrees(math.asin(min(1.0, abs(z) / gravity_mg)))
    way = "up" if z < 0 else "down"
    message = (
        f"z reads {z:+.0f} mg: the Z arrow points {way}, {tilt:.0f}° out of the horizontal;"
        f" it is the axis of rotation and lies horizontal (at most {limit:.0f} mg)"
    )
    values = {"z_mg": z, "limit_mg": limit, "tilt_deg": tilt}
    return Guard("wrong_axis", message, values, spoils=True)


def judge_start(accel_mg: Floats, asked_deg: float, sense: int) -> Guard | None:
    """Whether the part stands as drawn at the first position; any start angle serves, so it may stay."""
    x, y = float(accel_mg[0]), float(accel_mg[1])
    angle = -sense * math.degrees(math.atan2(y, x))
    off = wrap_degrees(angle - asked_deg)
    if abs(off) <= 90.0:
        return None
    message = (
        f"the part is the other way up than drawn: {off:+.0f}° by gravity (x {x:+.0f}, y {y:+.0f} mg);"
        " any start angle serves, so it may stay if the stage reads what is asked"
    )
    return Guard("upside_down", message, {"off_deg": off, "x_mg": x, "y_mg": y}, default="keep")


def judge_pose(
    accel_mg: Floats, asked: Floats | None, before_mg: Floats | None, before_asked: Floats | None
) -> Guard | None:
    """Whether a free attitude is new, and not the opposite of what was suggested.

    What spoils comes first: a part that nobody has moved is often the other way up as well, which may stay.
    """
    if before_mg is not None:
        turned = angle_between_deg(accel_mg, before_mg)
        wanted = 90.0 if asked is None or before_asked is None else angle_between_deg(asked, before_asked)
        if turned <= max(math.degrees(SHIFT_MG / 1000.0), NOT_MOVED_SHARE * wanted):
            message = (
                f"the part has not moved: {turned:.2f}° since the pose before,"
                f" about {wanted:.0f}° were asked"
            )
            return Guard("not_moved", message, {"gravity_deg": turned, "asked_deg": wanted}, spoils=True)
    if asked is None:
        return None
    off = angle_between_deg(accel_mg, asked)
    if off <= OTHER_WAY_UP_DEG:
        return None
    x, y, z = (float(value) for value in accel_mg)
    message = (
        f"the part is the other way up than asked: {off:.0f}° off (x {x:+.0f}, y {y:+.0f},"
        f" z {z:+.0f} mg; an axis reads + where its arrow points down); any new attitude serves"
    )
    values = {"off_deg": off, "x_mg": x, "y_mg": y, "z_mg": z}
    return Guard("upside_down", message, values, default="keep")


def angle_between_deg(a: Sequence[float] | Floats, b: Sequence[float] | Floats) -> float:
    """Angle between two directions."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    cosine = float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))
    return math.degrees(math.acos(min(1.0, max(-1.0, cosine))))


def judge_shift(accel_mg: Floats, before_mg: Floats, limit_mg: Floats) -> Guard | None:
    """Whether the part rests where it did before a dwell was disturbed."""
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
    """The part moves on, or rests elsewhere, after a dwell began."""
    message = f"{why}: the part or the stage has moved on; clamp it and take the position again"
    return Guard("drift", message, values or {})


def shock_guard(why: str, times: int) -> Guard:
    """A dwell was disturbed again and again."""
    return Guard(
        "shock",
        f"{counted(times, 'dwell')} in a row were disturbed: {why}; find what shakes the part",
        {"times": float(times)},
    )


def stuck_guard(why: str) -> Guard:
    """An axis does not change."""
    return Guard("stuck", why, answers=("retake", "skip"), spoils=True)


def judge_dwell(scans: Block, problems: Sequence[Problem]) -> list[Guard]:
    """What happened within a complete dwell: faults by its own words, and steps of its surroundings."""
    guards = []
    kinds: dict[str, GuardKind] = {"supply": "supply", "alarm": "over_range"}
    found = [problem for problem in problems if problem.kind in kinds]
    if found:
        # A supply out of range raises EA as well: it is the cause, and comes first.
        found.sort(key=lambda problem: list(kinds).index(problem.kind))
        message = "; ".join(problem.message for problem in found)
        alarms = 0 if scans.alarm is None else int(scans.alarm.sum())
        guards.append(Guard(kinds[found[0].kind], message, {"scans": float(alarms)}))
    columns = session_columns(scans)
    if "temp_c" in columns:
        step = greatest_step(scans.time_s, columns["temp_c"])
        if step > TEMPERATURE_STEP_C:
            message = (
                f"the temperature has stepped by {step:.2g} °C within the dwell"
                f" (at most {TEMPERATURE_STEP_C:g} °C a second)"
            )
            values = {"step_c": step, "limit_c": TEMPERATURE_STEP_C}
            guards.append(Guard("temperature", message, values))
    if "supply_v" in columns and not guards:
        step = greatest_step(scans.time_s, columns["supply_v"])
        if step > SUPPLY_STEP_V:
            message = (
                f"the supply has stepped by {step:.2g} V within the dwell"
                f" (at most {SUPPLY_STEP_V:g} V a second)"
            )
            guards.append(Guard("supply", message, {"step_v": step, "limit_v": SUPPLY_STEP_V}))
    return guards


def greatest_step(time_s: Floats, values: Floats) -> float:
    """Greatest change within a second, by means of half a second; a shorter dwell is taken in quarters."""
    width_s = min(STEP_WINDOW_S / 2, float(time_s[-1] - time_s[0]) / 4)
    if width_s <= 0:
        return 0.0
    slot = ((time_s - time_s[0]) / width_s).astype(int)
    means = np.array([values[slot == k].mean() for k in np.unique(slot) if (slot == k).sum() > 1])
    # From a window to the one after next: a step falls within the one between, at worst.
    return float(np.abs(means[2:] - means[:-2]).max()) if len(means) > 2 else 0.0


__all__ = ["GUARD_KINDS", "Guard", "Reading", "judge_dwell", "judge_level", "judge_pose", "judge_turn"]
