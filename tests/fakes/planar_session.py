"""A planar session by the convention of FORMATS, written out anew: no code of the package is used."""

from __future__ import annotations

import math

import numpy as np

DELTA_K, DELTA_PHI_DEG = 0.01, 0.8
ANGLES = tuple(45 * k for k in range(8))


def readings(angle_deg: float, *, alpha_deg: float = 20.0, gravity: float = 1000.0) -> tuple[float, float]:
    """What x and y read in mg at a declared angle."""
    psi = math.radians(alpha_deg - angle_deg)
    ky = 0.99
    kx = ky * (1 + DELTA_K)
    return (
        kx * gravity * math.cos(psi),
        ky * gravity * math.sin(psi + math.radians(DELTA_PHI_DEG)),
    )


def rows(
    *, turned: int = 1, angles: tuple[float, ...] = ANGLES, samples: int = 40, scale: float = 1.0
) -> list[tuple[float, int, float, int, float, float]]:
    """Rows (time, position, declared angle, approach, ax, ay); `turned` −1: the stage went back."""
    rng = np.random.default_rng(7)
    listed = []
    for k, angle in enumerate(angles):
        x, y = readings(turned * angle)
        noise = rng.normal(0, 1.0, (samples, 2))
        for i in range(samples):
            time = 60.0 * k + 0.01 * i
            a_x, a_y = scale * float(x + noise[i, 0]), scale * float(y + noise[i, 1])
            listed.append((time, k, angle, 1, a_x, a_y))
    return listed


def text(listed, *keys: str) -> str:
    """The rows as a samples CSV."""
    head = [f"# {key}" for key in keys] + ["time_s,position,angle_deg,approach,ax,ay"]
    return (
        "\n".join(
            [
                *head,
                *(
                    ",".join(repr(float(cell)) if isinstance(cell, float) else str(cell) for cell in row)
                    for row in listed
                ),
            ]
        )
        + "\n"
    )
