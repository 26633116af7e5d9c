"""Simulated turns whose plan lets a simple course of the stage look like many cycles a turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adis_gonio.model.records import Dwell, Session

Floats = NDArray[np.float64]
GOLDEN_DEG = 137.50776405


def planar(
    rng: np.random.Generator, angles_deg: Floats, error_deg: Floats, approach: Floats | None = None
) -> Session:
    """A session at these angles with an error of the stage's angle (n,), a bias, and noise of 0.1 mg."""
    psi = np.radians(rng.uniform(0, 360) - angles_deg + error_deg)
    gains = 1 + rng.normal(0, 0.004, 2)
    readings = 1000 * gains * np.stack([np.cos(psi), np.sin(psi + rng.normal(0, 0.003))], axis=1)
    readings += rng.uniform(-30, 30, 2) + 0.1 * rng.normal(size=readings.shape)
    dwells = [
        Dwell(
            k,
            np.array([30.0 * k]),
            readings[k : k + 1],
            angle_deg=float(angle),
            approach=0 if approach is None else int(approach[k]),
        )
        for k, angle in enumerate(angles_deg)
    ]
    return Session(
        tuple(dwells), accel_unit="mg", fixture_sigma_deg=0.003, reading_u_mg=0.1, sensor="generic"
    )


def growing_eccentricity(seed: int) -> Session:
    """48 golden-angle positions; an eccentricity of the stage that grows in proportion to time.

    In this order 55 θ advances by 2° from dwell to dwell, so that it is slow in time.
    """
    rng = np.random.default_rng((seed, 1))
    angles = np.mod(GOLDEN_DEG * np.arange(48), 360)
    size, phase = rng.uniform(0.02, 0.06), rng.uniform(0, 2 * np.pi)
    return planar(rng, angles, size * np.linspace(0, 1, 48) * np.cos(np.radians(angles) + phase))


def one_sided_eccentricity(seed: int) -> Session:
    """Two interleaved passes of 24 positions; the sides of approach differ by an eccentricity.

    At 48 equal steps with alternating sides, approach × cos θ equals 23 or 25 cycles a turn.
    """
    rng = np.random.default_rng((seed, 2))
    up, down = np.arange(0, 360, 15.0), np.arange(7.5, 360, 15.0)[::-1]
    angles = np.concatenate([up, down])
    approach = np.repeat([1, -1], 24)
    size, phase = rng.uniform(0.01, 0.03), rng.uniform(0, 2 * np.pi)
    return planar(rng, angles, size * approach * np.cos(np.radians(angles) + phase), approach)


def loose_fixture(seed: int) -> Session:
    """48 to 60 positions whose angles scatter two to six times as much as declared."""
    rng = np.random.default_rng((seed, 3))
    count = int(rng.choice([48, 60]))
    angles = np.mod(GOLDEN_DEG * np.arange(count), 360) if seed % 2 else np.arange(count) * 360 / count
    return planar(rng, angles, 0.003 * rng.uniform(2, 6) * rng.normal(size=count))


def worm(seed: int) -> Session:
    """48 golden-angle positions; a worm of the stage repeats its error 36 times a turn."""
    rng = np.random.default_rng((seed, 4))
    angles = np.mod(GOLDEN_DEG * np.arange(48), 360)
    size, phase = rng.uniform(0.01, 0.03), rng.uniform(0, 2 * np.pi)
    return planar(rng, angles, size * np.cos(36 * np.radians(angles) + phase))
