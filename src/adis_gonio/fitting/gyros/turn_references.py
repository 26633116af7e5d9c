"""What the part truly turned between two dwells, as a rotation vector in the accelerometers' frame.

Gravity on both sides
    Where the axis does not stand upright, the angle between the two gravities about it is how far the part
    turned, but for whole turns, which the gyro itself counts. On a stage (plane xy) the axis is z of the
    frame, and ψ falls as the part turns on; declared angles add what the fixture is worth. In space the
    axis is the gyro's own: the angle about it is observed, its direction is not.
Whole turns
    On a level table the axis is vertical and gravity shows nothing of the angle. From a mark back to the
    mark it is a whole number of turns: exact without any reference, but for how well the mark is met. The
    direction of the axis is that in which the accelerometers stay the same while the part turns: they read
    c + a cos θ + b sin θ (the table's tilt) + d ω² + e dω/dt (a part away from the axis), c along it.

A rotation vector is the integral of the rate as it stands where the axis stays the same in the part, as on
a stage and on a table. A turn about an axis that wanders more than `STRAIGHT` allows is refused in space.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.spectrum import noise_of_means
from adis_gonio.fitting.gyros.turn_integration import Integral, Path

MARK_U_DEG = 0.1
"""Standard uncertainty with which a part is set against a mark or a stop (an estimate, D)."""
NOT_WHOLE = 0.25
"""Turns from the nearest whole number beyond which a turn is not whole; a gain of 2 % in ten is less."""
LEAST_REFERENCE_DEG = 20.0
"""Less tells too little about a gain."""
LEAST_INCLINED = math.sin(math.radians(15))
"""Sine between the axis and gravity from which gravity tells the angle."""
STRAIGHT = math.cos(math.radians(5))
"""Least mean cosine between the rate and the axis of a turn in space."""
_BLOCKS = 400


@dataclass(frozen=True)
class Reference:
    """A true rotation.

    Attributes
    ----------
    kind : {"gravity", "whole turns"}
    angle_deg : (3,) float
        Rotation vector, right-handed about the accelerometers' axes.
    covariance_deg2 : (3, 3) float
        Of it; an infinite variance would be no number: what is not observed has `UNSEEN`² of the angle.
    turns : int
        Whole turns in it, with their sign.
    modes_deg : (3, k) float or None
        What k errors that turns share add to it, one standard uncertainty each.
    """

    kind: Literal["gravity", "whole turns"]
    angle_deg: Floats
    covariance_deg2: Floats
    turns: int
    modes_deg: Floats | None = None


UNSEEN = 0.2
"""Relative standard uncertainty of what a reference does not observe: no gyro is so far off."""


def on_stage(integral: Integral, psi_deg: tuple[float, float], u_deg: float) -> Reference | str:
    """Turn about the stage's axis, from the angles ψ of gravity in both dwells.

    Parameters
    ----------
    psi_deg : pair of float
        Angle of gravity from X to Y before and after.
    u_deg : float
        Standard uncertainty of their difference.
    """
    seen = float(integral.turned_deg[2])
    part = psi_deg[0] - psi_deg[1]
    turns = round((seen - part) / 360.0)
    angle = part + 360.0 * turns
    if abs(seen - angle) > max(10.0, 0.1 * abs(angle)):
        return f"the gyro turned {seen:.1f}° where gravity says {angle:.1f}°: not about the stage's axis"
    if abs(angle) < LEAST_REFERENCE_DEG:
        return f"a turn of {angle:.1f}° is too short; {LEAST_REFERENCE_DEG:g}° or more tell a gain"
    return Reference("gravity", np.array([0.0, 0.0, angle]), np.diag([0.0, 0.0, u_deg**2]), turns)


def in_space(integral: Integral, gravity: tuple[Floats, Floats], u_rad: float) -> Reference | str:
    """Turn about the gyro's own axis, its angle from gravity (3,) before and after in the part.

    Parameters
    ----------
    u_rad : float
        Standard uncertainty of each direction of gravity.
    """
    size = float(np.linalg.norm(integral.turned_deg))
    if size < LEAST_REFERENCE_DEG:
        return f"a turn of {size:.1f}° is too short; {LEAST_REFERENCE_DEG:g}° or more tell a gain"
    travelled = float(np.linalg.norm(integral.mean_abs_dps)) * integral.length_s
    if size < STRAIGHT * travelled:
        return "it was not turned about one axis; turn about one axis at a time"
    axis = integral.turned_deg / size
    across = [g / np.linalg.norm(g) - axis * (axis @ g) / np.linalg.norm(g) for g in gravity]
    inclined = min(float(np.linalg.norm(a)) for a in across)
    if inclined < LEAST_INCLINED:
        return "the axis stood upright, where gravity tells nothing of the angle; declare whole turns"
    # What is fixed in space goes backwards in the part: from the second direction to the first.
    part = math.degrees(
        math.atan2(float(axis @ np.cross(across[1], across[0])), float(across[1] @ across[0]))
    )
    turns = round((size - part) / 360.0)
    angle = part + 360.0 * turns
    if abs(angle - size) > max(10.0, 0.1 * size):
        return f"the gyro turned {size:.1f}° where gravity says {angle:.1f}°: not about one axis, or a slip"
    u_deg = math.degrees(math.sqrt(2) * u_rad / inclined)
    along = np.outer(axis, axis)
    covariance = u_deg**2 * along + (UNSEEN * angle) ** 2 * (np.eye(3) - along)
    return Reference("gravity", angle * axis, covariance, turns)


def whole_turns(
    integral: Integral, steady: Floats, u_mark_deg: float, axis_rad2: Floats, alike: int = 1
) -> Reference | str:
    """Whole turns about the vertical, from a mark back to it.

    Parameters
    ----------
    steady : (3,) float
        What calibrated accelerometers read that does not change as the part turns: against the upward
        axis, any unit.
    u_mark_deg : float
        Standard uncertainty with which the mark is met, each time.
    axis_rad2 : (3, 3) float
        Covariance of that direction, of what is this turn's own; what lies along it does not count.
    alike : int
        Turns there and back that follow one another. Where one ends the next begins: an error of the mark
        in between is in both, which takes it twice into their difference.
    """
    up = -steady / np.linalg.norm(steady)
    seen = float(up @ integral.turned_deg)
    turns = round(seen / 360.0)
    if turns == 0 or abs(seen / 360.0 - turns) > NOT_WHOLE:
        return (
            f"the gyro turned {seen:.0f}° about the vertical, which is no whole number of turns: begin and"
            " end at the mark"
        )
    if float(np.linalg.norm(integral.turned_deg - seen * up)) > 0.2 * abs(seen):
        return "it was not turned about the vertical; leave it flat on the table"
    angle = 360.0 * turns
    along = np.outer(up, up)
    across = np.eye(3) - along
    mark = 2 * u_mark_deg**2 * (2 - 1 / alike)
    covariance = mark * along + angle**2 * across @ axis_rad2 @ across
    return Reference("whole turns", angle * up, covariance, turns)


def steady_force(path: Path, begin_s: float, end_s: float) -> tuple[Floats, Floats]:
    """What the accelerometers read that stays the same while the part turns about one axis.

    Returns
    -------
    (3,) and (3, 3) float
        In the unit of `Path.force_g`, and its covariance by the noise at frequency zero of what is left: a
        hand's shaking is not white.
    """
    rows = (path.time_s >= begin_s) & (path.time_s <= end_s)
    time, force = path.time_s[rows], path.force_g[rows]
    rate = path.rate_dps[rows] - path.zero_dps.mean(axis=0)
    turned = np.trapezoid(rate, time, axis=0)
    spin = np.radians(rate @ (turned / np.linalg.norm(turned)))
    angle = np.concatenate([[0.0], np.cumsum((spin[1:] + spin[:-1]) / 2 * np.diff(time))])
    starts = np.unique(np.linspace(0, len(time), _BLOCKS, endpoint=False).astype(np.intp))
    counts = np.diff(np.append(starts, len(time)))

    def mean(series: Floats) -> Floats:
        sums = np.add.reduceat(series, starts, axis=0)
        return np.asarray((sums.T / counts).T)

    speed = mean(spin)
    jerk = np.gradient(speed, mean(time))
    terms = [np.cos(angle), np.sin(angle), spin**2]
    design = np.column_stack([np.ones(len(starts)), *(mean(term) for term in terms), jerk])
    size = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    seen = mean(force)
    found = np.linalg.lstsq(design / size, seen, rcond=1e-8)[0] / size[:, None]
    left = seen - design @ found
    inverse = np.linalg.pinv((design / size).T @ (design / size))[0, 0] / size[0] ** 2
    noise = noise_of_means([left])
    used = len(left) / (len(left) - design.shape[1])
    covariance = used * len(left) * inverse * noise.covariance[0] + np.diag(noise.flicker)
    return np.asarray(found[0]), covariance
