"""Random small sessions, and how a trace of each ends."""

from __future__ import annotations

import json

import numpy as np

from adis_gonio import trace
from adis_gonio.base.errors import AdisGonioError
from adis_gonio.model.records import Dwell, Session


def odd_session(seed: int) -> Session:
    """A random small session: one to nine dwells, any columns, any order."""
    rng = np.random.default_rng((seed, 77))
    n, m = int(rng.integers(1, 10)), int(rng.choice([1, 2, 7, 60]))
    planar = bool(rng.random() < 0.5)
    angles = rng.choice([0.0, 45.0, 90.0, 180.0, 270.0, 33.0], n)
    has_angle, has_temperature, has_supply = rng.random(3) < [0.8, 0.5, 0.3]
    dwells = []
    for k in range(n):
        psi = np.radians(10 - angles[k])
        unit = np.array([np.cos(psi), np.sin(psi), 0.0])
        if not planar:
            unit = rng.standard_normal(3)
            unit /= np.linalg.norm(unit)
        noise = rng.choice([0.0, 0.3, 5.0]) * rng.standard_normal((m, 3))
        accel = 1000 * unit + rng.choice([0.0, 20.0]) + noise
        time = 10.0 * k + 0.1 * np.arange(m)
        dwells.append(
            Dwell(
                k,
                time,
                accel[:, : 2 if planar and rng.random() < 0.5 else 3],
                angle_deg=float(angles[k]) if planar and has_angle else None,
                temperature_c=25 + rng.choice([0.0, 1.0]) * time / 10 if has_temperature else None,
                supply_v=np.full(m, 5.0) if has_supply else None,
                use="check" if rng.random() < 0.15 else "fit",
            )
        )
    if planar:
        width = min(d.accel.shape[1] for d in dwells)
        dwells = [Dwell(**{**d.__dict__, "accel": d.accel[:, :width]}) for d in dwells]
    return Session(
        tuple(dwells),
        accel_unit=str(rng.choice(["mg", "counts"])),
        plane="xy" if planar else "none",
        sensor="generic",
        fixture_sigma_deg=[0.01, 0.0, None, np.inf][int(rng.integers(4))],
        reading_u_mg=0.3 if rng.random() < 0.5 else None,
    )


def ending(seed: int) -> str:
    """Trace the session of a seed; return the text of the package's error, or an empty text.

    Raises
    ------
    Exception
        If the trace ends in any other error, or its JSON has a number that is not finite.
    """
    try:
        json.dumps(trace(odd_session(seed)).as_dict(), allow_nan=False)
    except AdisGonioError as error:
        return str(error)
    return ""
