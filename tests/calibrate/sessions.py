"""Sessions, and readings of a sensor whose truth is known, by an implementation apart from the package's.

`read_mg` writes the forward model out once more, number by number, with a root finder nowhere near it.
"""

from __future__ import annotations

import math

import numpy as np

from adis_gonio.model import Dwell, Session

G_MG = 1000.0


def read_mg(
    gravity: np.ndarray,
    *,
    gains: tuple[float, ...],
    axes: np.ndarray,
    bias: tuple[float, ...],
    k2: tuple[float, ...] = (0.0, 0.0, 0.0),
    tempco: tuple[float, ...] = (0.0, 0.0, 0.0),
    scale_tempco: tuple[float, ...] = (0.0, 0.0, 0.0),
    temperature_c: float = 25.0,
) -> np.ndarray:
    """Readings (n, axes) in mg of gravity (n, axes) in g: every term in a line of its own."""
    rows = []
    for g in gravity:
        row = []
        for i in range(len(g)):
            a = G_MG * gains[i] * sum(axes[i][j] * g[j] for j in range(len(g)))
            warmer = temperature_c - 25.0
            a_seen = a + bias[i]
            a_seen += k2[i] * (a / 1000) ** 2
            a_seen += tempco[i] * warmer
            a_seen += scale_tempco[i] * 1e-6 * warmer * a
            row.append(a_seen)
        rows.append(row)
    return np.array(rows)


def plane_axes(delta_phi_deg: float) -> np.ndarray:
    """X along x; Y reads sin(ψ + Δφ) = sin ψ cos Δφ + cos ψ sin Δφ."""
    phi = math.radians(delta_phi_deg)
    return np.array([[1.0, 0.0], [math.sin(phi), math.cos(phi)]])


def turn(psi_deg: np.ndarray) -> np.ndarray:
    """Gravity (n, 2) at ψ from X."""
    psi = np.radians(psi_deg)
    return np.column_stack([np.cos(psi), np.sin(psi)])


def planar_session(
    rng: np.random.Generator,
    *,
    alpha_deg: float = 3.0,
    gains: tuple[float, float] = (1.01, 0.99),
    delta_phi_deg: float = 0.4,
    bias: tuple[float, float] = (12.0, -7.0),
    noise_mg: float = 0.2,
    samples: int = 200,
    angles_deg: tuple[float, ...] = tuple(range(0, 360, 30)),
    unit: str = "mg",
    **truth: tuple[float, float],
) -> Session:
    """A turn in the plane with white noise."""
    dwells = []
    for k, theta in enumerate(angles_deg):
        ideal = read_mg(
            turn(np.array([alpha_deg - theta])),
            gains=gains,
            axes=plane_axes(delta_phi_deg),
            bias=bias,
            **truth,
        )
        accel = ideal + noise_mg * rng.standard_normal((samples, 2))
        if unit == "counts":
            accel = accel * 2.5 + 300.0
        time_s = k * 10.0 + np.arange(samples) / 100.0
        dwells.append(Dwell(k, time_s, accel, angle_deg=float(theta)))
    return Session(
        tuple(dwells),
        sensor="generic",
        accel_unit=unit,
        fixture_sigma_deg=0.001,
        title="a turn",
        source="a.csv",
    )


def spatial_session(rng: np.random.Generator, *, gains, skews_deg, bias, noise_mg=0.2, poses=30) -> Session:
    """Poses in space with white noise."""
    dwells = []
    for k, g in enumerate(directions(rng, poses)):
        ideal = read_mg(g[None, :], gains=gains, axes=space_axes(*skews_deg), bias=bias)
        accel = ideal + noise_mg * rng.standard_normal((200, 3))
        dwells.append(Dwell(k, k * 10.0 + np.arange(200) / 100.0, accel))
    return Session(
        tuple(dwells), sensor="generic", accel_unit="mg", fixture_sigma_deg=math.inf, plane="none"
    )


def directions(rng: np.random.Generator, n: int) -> np.ndarray:
    """Unit vectors (n, 3), evenly over the sphere."""
    g = rng.standard_normal((n, 3))
    return g / np.linalg.norm(g, axis=1, keepdims=True)


def space_axes(xy_deg: float, xz_deg: float, yz_deg: float) -> np.ndarray:
    """Directions by Gram's matrix: X·Y = sin(skew_xy) …, its Cholesky factor has X along x, Y in xy."""
    s = [math.sin(math.radians(value)) for value in (xy_deg, xz_deg, yz_deg)]
    return np.linalg.cholesky(np.array([[1, s[0], s[1]], [s[0], 1, s[2]], [s[1], s[2], 1]]))
