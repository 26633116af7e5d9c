"""Sessions of rests with gyros whose noise is known, made without the package's simulator."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adis_gonio.model.records import Dwell, Session
from allan_statistics import Case, samples

RATE_HZ = 100
NOISY = Case({"white": 0.05, "flicker": 0.06}, 1 << 12, 0)


def rests(count: int, seconds: float, *, gyros: bool = True, noisy: Case = NOISY) -> Session:
    """Positions about Z, 90° apart."""
    rng = np.random.default_rng(3)
    dwells = []
    for position in range(count):
        n = round(seconds * RATE_HZ)
        turn = np.radians(90 * position)
        gravity = 1000 * np.array([np.cos(turn), -np.sin(turn), 0])
        gyro = samples(noisy, 10 + position)[:n] if gyros else None
        time_s = 100.0 * position + np.arange(n) / RATE_HZ
        dwells.append(Dwell(position, time_s, gravity + rng.normal(0, 2, (n, 3)), gyro=gyro))
    return Session(tuple(dwells), facts={"configuration": {"filter_m": noisy.filter_m}})


def rests_csv(path: Path) -> Path:
    """A CSV of two long rests, written to a path."""
    head = (
        "# accel_unit: mg\n# gyro_unit: dps\n# reading_u_mg: 0.1\n# filter_m: 0\n"
        "time_s,position,angle_deg,ax,ay,az,gx,gy,gz"
    )
    rows = [
        [time, dwell.position, 90 * dwell.position, *accel, *gyro]
        for dwell in rests(2, 40).dwells
        if dwell.gyro is not None
        for time, accel, gyro in zip(dwell.time_s, dwell.accel, dwell.gyro, strict=True)
    ]
    np.savetxt(path, rows, "%.6g", ",", header=head, comments="")
    return path
