"""True rotation of the sensor between two dwells, as a rotation vector in the accelerometers' frame.

Gravity on both sides
    If the axis is not upright, the rotation is the angle between the two directions of gravity about the
    axis, up to whole turns, and the gyro counts these. On a stage (plane xy) the axis is z of the frame,
    and ψ decreases as the part turns forward; declared angles improve ψ by the fixture's uncertainty. In
    space the axis is the gyro's own, so the angle about it is measured and its direction is not.
Declared angle
    On a level table the axis is vertical, and gravity does not depend on the angle. The operator declares
    it: from a mark back to the mark the rotation is a whole number of turns, which is exact up to the error
    of meeting the mark. The gyro counts the turns beyond the declared angle. Along the axis the
    accelerometers' reading is constant during the turn: they read c + a cos θ + b sin θ (the table's tilt)
    + d ω² + e dω/dt (a part away from the axis), c along it.

A rotation vector equals the integral of the rate if the axis is constant in the part, as on a stage and
on a table. In space a turn about an axis that wanders by more than `STRAIGHT` allows is refused.
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
"""Standard uncertainty of setting a part against a mark or a stop (an estimate, D)."""
FARTHEST_DEG = 90.0
"""Largest distance from a declared angle; a gain error of 2 % in ten turns is less."""
LEAST_REFERENCE_DEG = 20.0
"""Smallest turn, in degrees, from which a scale factor is determined."""
LEAST_INCLINED = math.sin(math.radians(15))
"""Smallest sine of the angle between the axis of a turn and gravity for a reference by gravity."""
STRAIGHT = math.cos(math.radians(5))
"""Least mean cosine between the rate and the axis of a turn in space."""
_BLOCKS = 400


@dataclass(frozen=True)
class Reference:
    """True rotation of the sensor in a turn, known from gravity or declared.

    Attributes
    ----------
    kind : {"gravity", "declared"}
    angle_deg : (3,) float
        Rotation vector, right-handed about the accelerometers' axes.
    covariance_deg2 : (3, 3) float
        Its covariance; an unobserved component has a standard uncertainty of `UNSEEN` times the angle.
    modes_deg : (3, k) float or None
        Change of the rotation by one standard uncertainty of each of k errors that turns share.
    """

    kind: Literal["gravity", "declared"]
    angle_deg: Floats
    covariance_deg2: Floats
    modes_deg: Floats | None = None


UNSEEN = 0.2
"""Relative standard uncertainty of an unobserved component: every gyro is more accurate."""


def reference_on_stage(integral: Integral, psi_deg: tuple[float, float], u_deg: float) -> Reference | str:
    """True rotation about the stage's axis, from the angle ψ of gravity before and after the turn.

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
        return f"the gyro turned {seen:.1f}°, by gravity {angle:.1f}°: not about the stage's axis"
    if abs(angle) < LEAST_REFERENCE_DEG:
        return f"a turn of {angle:.1f}° is too short; a gain needs {LEAST_REFERENCE_DEG:g}° or more"
    return Reference("gravity", np.array([0.0, 0.0, angle]), np.diag([0.0, 0.0, u_deg**2]))


def reference_in_space(integral: Integral, gravity: tuple[Floats, Floats], u_rad: float) -> Reference | str:
    """True rotation about the axis that the gyros show, with its angle from gravity before and after.

    Parameters
    ----------
    u_rad : float
        Standard uncertainty of each direction of gravity.
    """
    size = float(np.linalg.norm(integral.turned_deg))
    if size < LEAST_REFERENCE_DEG:
        return f"a turn of {size:.1f}° is too short; a gain needs {LEAST_REFERENCE_DEG:g}° or more"
    travelled = float(np.linalg.norm(integral.mean_abs_dps)) * integral.length_s
    if size < STRAIGHT * travelled:
        return "it was not turned about one axis; turn about one axis at a time"
    axis = integral.turned_deg / size
    # Components of both unit vectors of gravity across the axis.
    across = [g / np.linalg.norm(g) - axis * (axis @ g) / np.linalg.norm(g) for g in gravity]
    inclined = min(float(np.linalg.norm(a)) for a in across)
    if inclined < LEAST_INCLINED:
        return "the axis was upright, so gravity does not show the angle; declare it (turned_deg)"
    # A direction fixed in space moves backwards in the part: from the second direction to the first.
    part = math.degrees(
        math.atan2(float(axis @ np.cross(across[1], across[0])), float(across[1] @ across[0]))
    )
    turns = round((size - part) / 360.0)
    angle = part + 360.0 * turns
    if abs(angle - size) > max(10.0, 0.1 * size):
        return f"the gyro turned {size:.1f}°, by gravity {angle:.1f}°: not about one axis, or a slip"
    u_deg = math.degrees(math.sqrt(2) * u_rad / inclined)
    along = np.outer(axis, axis)
    # Along the axis the uncertainty by gravity, across it the large one of an unobserved component.
    covariance = u_deg**2 * along + (UNSEEN * angle) ** 2 * (np.eye(3) - along)
    return Reference("gravity", angle * axis, covariance)


def reference_as_declared(
    integral: Integral,
    declared_deg: float,
    steady: Floats,
    u_mark_deg: float,
    axis_rad2: Floats,
    consecutive: int = 1,
) -> Reference | str:
    """True rotation about the vertical by a declared angle, such as whole turns from mark to mark.

    Parameters
    ----------
    declared_deg : float
        Angle, positive counter-clockwise seen from above, up to whole turns.
    steady : (3,) float
        Constant part of the calibrated accelerometers' reading during the turn: opposite to the upward
        axis, in any unit.
    u_mark_deg : float
        Standard uncertainty of meeting the mark, each time.
    axis_rad2 : (3, 3) float
        Covariance of that direction by errors of this turn alone; its component along the direction does
        not count.
    consecutive : int
        Number of consecutive declared turns. One ends where the next begins, so an error of the
        mark between them is in both, and twice in their difference.
    """
    up = -steady / np.linalg.norm(steady)
    seen = float(up @ integral.turned_deg)
    angle = declared_deg + 360.0 * round((seen - declared_deg) / 360.0)
    if abs(angle) < LEAST_REFERENCE_DEG or abs(seen - angle) > min(
        FARTHEST_DEG, max(10.0, 0.1 * abs(angle))
    ):
        where = (
            "no whole number of turns" if declared_deg % 360 == 0 else f"not {declared_deg:g}° as declared"
        )
        return (
            f"the gyro turned {seen:.0f}° about the vertical, which is {where}: begin and end at the marks,"
            " or correct turned_deg"
        )
    if float(np.linalg.norm(integral.turned_deg - seen * up)) > 0.2 * abs(seen):
        return "it was not turned about the vertical; leave it flat on the table"
    along = np.outer(up, up)
    across = np.eye(3) - along
    # Two marks per turn; a mark between consecutive turns counts in both.
    mark = 2 * u_mark_deg**2 * (2 - 1 / consecutive)
    covariance = mark * along + angle**2 * across @ axis_rad2 @ across
    return Reference("declared", angle * up, covariance)


def steady_force(path: Path, begin_s: float, end_s: float) -> tuple[Floats, Floats]:
    """Constant component of the accelerometers' reading while the sensor turns about one axis.

    Returns
    -------
    (3,) and (3, 3) float
        In the unit of `Path.force_g`, and its covariance by the residual's noise at frequency zero,
        because a hand's shaking is not white.
    """
    rows = (path.time_s >= begin_s) & (path.time_s <= end_s)
    time, force = path.time_s[rows], path.force_g[rows]
    rate = path.rate_dps[rows] - path.zero_dps.mean(axis=0)
    turned = np.trapezoid(rate, time, axis=0)
    # Rate about the axis of the whole turn, and its integral.
    spin = np.radians(rate @ (turned / np.linalg.norm(turned)))
    angle = np.concatenate([[0.0], np.cumsum((spin[1:] + spin[:-1]) / 2 * np.diff(time))])
    starts = np.unique(np.linspace(0, len(time), _BLOCKS, endpoint=False).astype(np.intp))
    counts = np.diff(np.append(starts, len(time)))

    def mean(series: Floats) -> Floats:
        sums = np.add.reduceat(series, starts, axis=0)
        return np.asarray((sums.T / counts).T)

    # Least squares on means of blocks: constant, tilt of the table, and both terms of a lever arm.
    speed = mean(spin)
    jerk = np.gradient(speed, mean(time))
    terms = [np.cos(angle), np.sin(angle), spin**2]
    design = np.column_stack([np.ones(len(starts)), *(mean(term) for term in terms), jerk])
    size = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    seen = mean(force)
    found = np.linalg.lstsq(design / size, seen, rcond=1e-8)[0] / size[:, None]
    residual = seen - design @ found
    inverse = np.linalg.pinv((design / size).T @ (design / size))[0, 0] / size[0] ** 2
    noise, n = noise_of_means([residual]), len(residual)
    covariance = n**2 / (n - design.shape[1]) * inverse * noise.covariance[0] + np.diag(noise.flicker)
    return np.asarray(found[0]), covariance
