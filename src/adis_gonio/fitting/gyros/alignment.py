"""How the gyros' triad stands to that of the accelerometers, and how square it is in itself.

The directions D of the gyros (rows, in the accelerometers' frame) are a rotation of the whole and what the
three axes are misaligned with one another: D = S R with a symmetric S (polar decomposition). The rotation
vector is what a part's mounting or its board does; the angles between the axes, as skews (90° minus the
angle), are those of the triad itself and do not depend on the frame.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences
from adis_gonio.base.uncertainty import Value
from adis_gonio.model.measurement import SKEW_AXES

AXES = "xyz"
MISALIGNMENTS = tuple((k, j) for k in range(3) for j in range(3) if k != j)
_STEP_DEG = 1e-4


def directions(misalignment_deg: Floats) -> Floats:
    """Unit vectors (3, 3) of the gyros by the misalignment (3, 3) of each towards the others' axes."""
    sines = np.sin(np.radians(misalignment_deg)) * (1 - np.eye(3))
    return np.asarray(sines + np.diag(np.sqrt(1 - (sines**2).sum(axis=1))))


def rotation_and_skews_deg(misalignment_deg: Floats) -> Floats:
    """Rotation vector (3) of the triad and its three skews xy, xz, yz, in degrees."""
    rows = directions(misalignment_deg)
    left, _, right = np.linalg.svd(rows)
    # Rows of the nearest square triad; as a rotation of the frame's axes onto them its transpose.
    turned = (left @ right).T
    axial = np.array(
        [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
    )
    sine, cosine = float(np.linalg.norm(axial)) / 2, (float(np.trace(turned)) - 1) / 2
    angle = math.atan2(sine, cosine)
    vector = axial / 2 * (angle / sine if sine > 1e-12 else 1.0)
    skews = [math.asin(float(rows[i] @ rows[j])) for i, j in SKEW_AXES]
    return np.asarray(np.degrees(np.concatenate([vector, skews])))


def alignment(
    parameters: Mapping[str, Value], covariance: Floats, names: Sequence[str]
) -> dict[str, Value] | None:
    """`triad_rotation_x…` and `gyro_skew_xy…` in degrees with u, from the gyros' misalignments.

    Parameters
    ----------
    parameters : mapping of str to Value
        Of a gyro fit.
    covariance : (p, p) float
        Of them, in the order of `names`.

    Returns
    -------
    mapping or None
        None unless all six misalignments are determined.
    """
    names_of_angles = [f"gyro_misalignment_{AXES[k]}{AXES[j]}" for k, j in MISALIGNMENTS]
    if any(name not in parameters for name in names_of_angles):
        return None
    rows = [list(names).index(name) for name in names_of_angles]
    misalignments = np.zeros((3, 3))
    for (k, j), name in zip(MISALIGNMENTS, names_of_angles, strict=True):
        misalignments[k, j] = parameters[name].value
    own = np.zeros((len(MISALIGNMENTS), 3, 3))
    for row, place in enumerate(MISALIGNMENTS):
        own[row][place] = 1.0
    slope = central_differences(rotation_and_skews_deg, misalignments, _STEP_DEG, own)
    variance = slope @ covariance[np.ix_(rows, rows)] @ slope.T
    dof = min(parameters[name].dof or math.inf for name in names_of_angles)
    found = rotation_and_skews_deg(misalignments)
    stated = [f"triad_rotation_{axis}" for axis in AXES]
    stated += [f"gyro_skew_{AXES[i]}{AXES[j]}" for i, j in SKEW_AXES]
    return {
        name: Value(float(found[k]), math.sqrt(max(float(variance[k, k]), 0.0)), "deg", dof)
        for k, name in enumerate(stated)
    }
