"""Arguments of a calibration's methods: shape, unit, numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.base.numbers import join_words
from adis_gonio.calibrate.coefficients import checked_numbers
from adis_gonio.record.provenance import Covered

if TYPE_CHECKING:
    from adis_gonio.calibrate.calibration import Calibration

LEAST_LENGTH = 0.02
"""Length of a reading in units of gravity below which no angle could be told: 1 g given in g or in m/s²
is shorter (0.001 and 0.0098)."""
MOST_LENGTH = 2.0
"""Median length of many readings in units of gravity above which they are another unit: 1 g is 2140 LSB."""
MANY = 8
"""Readings whose median no single shock moves."""


def checked_readings(accel: ArrayLike, calibration: Calibration) -> tuple[Floats, bool]:
    """Readings (n, axes), and whether one reading without an axis of its own was given.

    Raises
    ------
    UsageError
        Wrong shape, no numbers, NaN or infinity, another unit.
    """
    given = checked_numbers("readings", accel, plural=True)
    axes, unit = calibration.axes, calibration.unit
    wanted = (2, 3) if axes == 2 else (3,)
    if given.ndim not in (1, 2) or given.shape[-1] not in wanted:
        columns = join_words([*map(str, wanted)], "or")
        raise UsageError(
            f"readings have shape {given.shape}; give (n, {columns}) in {unit}, one row a reading"
        )
    readings = np.atleast_2d(given)[:, :axes]
    bad = np.flatnonzero(~np.isfinite(readings).all(axis=1))
    if bad.size:
        raise UsageError(f"reading {int(bad[0])} holds NaN or infinity; leave lost scans out")
    _refuse_other_units(readings, calibration)
    return readings, given.ndim == 1


def _refuse_other_units(readings: Floats, calibration: Calibration) -> None:
    if calibration.provenance.counts or not len(readings):
        return
    length = float(np.median(np.linalg.norm(readings, axis=1))) / calibration.gravity_mg
    if length < LEAST_LENGTH:
        raise UsageError(
            f"readings are {length * calibration.gravity_mg:.3g} long where gravity is about 1000: give mg "
            "(1 g = 1000, 1 m/s² = 101.97)"
        )
    if length > MOST_LENGTH and len(readings) >= MANY:
        raise UsageError(
            f"readings are {length * calibration.gravity_mg:.4g} long where gravity is about 1000: give "
            "mg, not words of the sensor (ScanBlock.accel_mg)"
        )


def checked_condition(
    name: str, given: ArrayLike | None, n: int, covered: Covered | None, needs: set[str]
) -> Floats | None:
    """Condition (n,) as given, else the session's mean where an effect needs it.

    Raises
    ------
    UsageError
        No numbers, wrong length, NaN or infinity.
    """
    if given is None:
        return None if name not in needs or covered is None else np.full(n, covered.mean)
    values = checked_numbers(name, given)
    if values.ndim > 1 or values.size not in (1, n):
        raise UsageError(
            f"{name} has shape {values.shape}; give one number, or one for each of {n} readings"
        )
    if not np.isfinite(values).all():
        raise UsageError(f"{name} holds NaN or infinity")
    return np.broadcast_to(values.reshape(-1), (n,)).copy()
