"""How far an angle is off that a later state of the sensor shows by an earlier calibration.

First order in the differences of the parameters: with ψ the angle, g the local gravity and
δ = later − earlier,

    e(ψ) = −½ sin 2ψ δΔK + cos²ψ δΔφ + (cos ψ δb_y − sin ψ δb_x) / g

since an angle depends on the ratio of the gains alone (K_x = K_y (1 + ΔK)) and X is the reference of Δφ.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

PARAMETERS = ("delta_k", "delta_phi", "bias_x", "bias_y")
_TURN = np.arange(0.0, 360.0, 1.0)


def slopes_deg(gravity_mps2: float = STANDARD_GRAVITY_MPS2) -> Floats:
    """Error of the angle in degrees by a unit of each of `PARAMETERS` (1, deg, mg, mg), (360, 4)."""
    psi = np.radians(_TURN)
    gravity_mg = 1000.0 * gravity_mps2 / STANDARD_GRAVITY_MPS2
    cos, sin = np.cos(psi), np.sin(psi)
    return np.column_stack(
        [
            np.degrees(-sin * cos),
            cos**2,
            np.degrees(-sin / gravity_mg),
            np.degrees(cos / gravity_mg),
        ]
    )


def worst_deg(
    difference: Mapping[str, float], u: Mapping[str, float], k: float, gravity_mps2: float
) -> tuple[float, float]:
    """Largest |error| over the turn, and largest |error| + U.

    Parameters
    ----------
    difference, u : mapping of str to float
        Of `PARAMETERS`, later minus earlier, with its standard uncertainty; what is left out is 0. The
        parameters' covariances are left out.
    k : float
        Coverage factor of U.
    """
    slopes = slopes_deg(gravity_mps2)
    by = np.array([difference.get(name, 0.0) for name in PARAMETERS])
    spread = np.array([u.get(name, 0.0) for name in PARAMETERS])
    error = np.abs(slopes @ by)
    return float(error.max()), float((error + k * np.sqrt(slopes**2 @ spread**2)).max())
