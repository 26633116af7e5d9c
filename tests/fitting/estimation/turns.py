"""Sessions of a turn with one sample a dwell, for what is said and refused of their readings."""

from __future__ import annotations

import numpy as np

from adis_gonio.model.records import Dwell, Session

EIGHTHS = tuple(45.0 * k for k in range(8))


def turn(
    length: float = 1000.0, sign: float = 1.0, angles: tuple[float, ...] = EIGHTHS, **more: object
) -> Session:
    """One sample a dwell on a turn, readings `length` long: mg, if `more` does not say otherwise."""
    psi = 0.2 - np.radians(angles)
    rows = length * np.stack([np.cos(psi), sign * np.sin(psi)], axis=1)
    dwells = tuple(
        Dwell(k, np.array([10.0 * k]), row[None], angle)
        for k, (row, angle) in enumerate(zip(rows, angles, strict=True))
    )
    facts: dict[str, object] = {"accel_unit": "mg", "sensor": "generic", "reading_u_mg": 0.1}
    return Session(dwells, **{**facts, **more})
