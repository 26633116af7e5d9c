"""Geometry of the measurement: what ideal axes see of gravity, in the plane and in space.

Planar: a part turned to the angle ψ = α − θ + δ sees gravity at (cos ψ, sin ψ); the y axis is off the
perpendicular of x by Δφ, so that U_x = K_x G cos ψ + b_x and U_y = K_y G sin(ψ + Δφ) + b_y.

Space: U = diag(K) E g + b with E upper triangular, ones on its diagonal and tan(skew) above it:
U_x = K_x (g_x + tan(skew_xy) g_y + tan(skew_xz) g_z) + b_x, U_y = K_y (g_y + tan(skew_yz) g_z) + b_y,
U_z = K_z g_z + b_z. So g = T (U − b)/K with T = E⁻¹ upper triangular too. The frame is fixed by the z axis
and the plane of y and z, since a rotation of the whole cannot be observed by gravity alone. A skew is, to
second order, 90° minus the angle between two axes, and K_i the sensitivity along the squared-up axis.

Angles are radians, arrays have one row a position.
"""

from __future__ import annotations

import math

import numpy as np

from adis_gonio.model.records import Floats

SKEW_AXES: tuple[tuple[int, int], ...] = ((0, 1), (0, 2), (1, 2))
"""Axes that skew_xy, skew_xz and skew_yz lie between."""


def wrap_rad(angle: Floats) -> Floats:
    """Angle (any shape) in rad brought into [−π, π)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def planar_ideal(psi_rad: Floats, delta_phi_rad: float) -> Floats:
    """Projections (n, 2) of the unit gravity: cos ψ on x, sin(ψ + Δφ) on y."""
    return np.stack([np.cos(psi_rad), np.sin(psi_rad + delta_phi_rad)], axis=-1)


def planar_tangent(psi_rad: Floats, delta_phi_rad: float) -> Floats:
    """∂ planar_ideal / ∂ψ, (n, 2)."""
    return np.stack([-np.sin(psi_rad), np.cos(psi_rad + delta_phi_rad)], axis=-1)


def planar_angle(ideal: Floats, delta_phi_rad: float) -> Floats:
    """Angle ψ (n,) in rad that calibrated readings (n, 2), in units of gravity, show.

    The inverse of `planar_ideal` on the circle; beside it (noise) the direction of the vector with the
    y axis squared up.
    """
    x, y = ideal[..., 0], ideal[..., 1]
    return np.arctan2(y - x * math.sin(delta_phi_rad), x * math.cos(delta_phi_rad))


def axes_matrix(skews_rad: Floats) -> Floats:
    """Matrix E (3, 3) of (skew_xy, skew_xz, skew_yz) in rad; see the module."""
    axes = np.eye(3)
    for (row, column), skew in zip(SKEW_AXES, skews_rad, strict=True):
        axes[row, column] = math.tan(skew)
    return axes


def axes_matrix_derivatives(skews_rad: Floats) -> Floats:
    """∂E/∂skew, (3, 3, 3) with the skew first."""
    derivative = np.zeros((3, 3, 3))
    for k, (row, column) in enumerate(SKEW_AXES):
        derivative[k, row, column] = 1 / math.cos(skews_rad[k]) ** 2
    return derivative


def gains_and_skews(gram: Floats) -> tuple[Floats, Floats]:
    """Gains (d,) and skews (3,) in rad, or (1,) in the plane, of a matrix diag(K) E Eᵀ diag(K) (d, d)."""
    # The Cholesky factor of the reversed matrix, reversed again, is upper triangular.
    upper = np.linalg.cholesky(gram[::-1, ::-1])[::-1, ::-1]
    gains = np.diag(upper).copy()
    unit = upper / gains[:, None]
    pairs = [(i, j) for i in range(len(gram)) for j in range(i + 1, len(gram))]
    return gains, np.array([math.atan(unit[i, j]) for i, j in pairs])
