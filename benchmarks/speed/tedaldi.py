"""The accelerometer part of Tedaldi, Pretto and Menegatti (ICRA 2014): the norm of every rest is g.

a° = T K (a + b), T upper triangular with ones on the diagonal (equation 5 of the paper), K diagonal; the
nine numbers minimise Σ (g² − |a°|²)² by Levenberg-Marquardt (equation 10), from T = K = 1 and b = 0. The
paper repeats it over thresholds of its detector of rests; here the rests are given.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Floats = NDArray[np.float64]


def matrix(p: Floats) -> Floats:
    """T K (3, 3) of the nine numbers (three angles, three gains, three zeros)."""
    turn = np.array([[1.0, -p[0], p[1]], [0.0, 1.0, -p[2]], [0.0, 0.0, 1.0]])
    product: Floats = turn * p[3:6]
    return product


def calibrate(mean: Floats, gravity: float) -> tuple[Floats, Floats]:
    """Matrix (3, 3) and bias (3,): gravity = matrix @ (mean − bias), of means (n, 3)."""
    unit = mean / gravity

    def residual(p: Floats) -> Floats:
        left: Floats = 1.0 - np.sum(((unit + p[6:]) @ matrix(p).T) ** 2, axis=1)
        return left

    found = least_squares(residual, np.array([0.0, 0, 0, 1, 1, 1, 0, 0, 0]), method="lm").x
    return matrix(found), -gravity * found[6:]
