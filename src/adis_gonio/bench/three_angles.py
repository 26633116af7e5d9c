"""Positions so far by `adis_gonio.fitting.slips`: a recorded session has the same likelihood."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.numbers import join_words
from adis_gonio.bench.guards import Guard
from adis_gonio.bench.turning import GyroIntegral
from adis_gonio.fitting.slips import Angles, Diagnosis, Increments, PositionFinding, diagnose
from adis_gonio.fitting.slips.diagnosis import LARGEST
from adis_gonio.fitting.slips.finding import MEANINGS
from adis_gonio.model.effects import Conditions
from adis_gonio.record.expectation import UNMODELLED_MG, UNSTATED_FIXTURE_DEG, PriorKnowledge


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
    names = join_words(list(dict.fromkeys(MEANINGS[named.name] for named in found.names)), "or")
    if found.finding == "gravity_wrong":
        return f"the gyro turned as asked and gravity does not fit: {names}"
    if found.finding == "swapped":
        other = next((k for k in (found.position, *found.others) if k != here), here)
        return f"by {by} the part stands where {angles_deg[other]:g}° was asked for, and stood here then"
    where = "" if found.position == here else f" since {_degrees(angles_deg[found.position])}"
    return f"by {by} the part stands {off} from what is asked{where}: {names}"


def _degrees(angle: float | None) -> str:
    return "a dwell that was kept" if angle is None else f"{angle:g}°"


__all__ = ["Stand", "diagnosed", "with_three_angles"]
