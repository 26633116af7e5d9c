"""Parts that a hand turns about Z: faults of gyro, bench and hand, and what the chip makes of samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.sim.sampling import bartlett_sums

FILTER_M = 2


def part_of(
    rng: np.random.Generator,
    turn: Callable[[np.random.Generator], Mapping[str, float]],
    vibration_mg: tuple[float, float],
) -> dict[str, float]:
    """Settings of one part, its gyro and the hand that turns it.

    Parameters
    ----------
    turn : callable
        Draws how far it turns, in which time.
    vibration_mg : (float, float)
        Least and largest of the hand's vibration.
    """
    return {
        "lever_x_mm": rng.normal(0, 40),
        "lever_y_mm": rng.normal(0, 40),
        "gyro_scale_z": 1 + rng.normal(0, 0.01),
        "gyro_misalignment_zx_deg": rng.normal(0, 0.3),
        "gyro_misalignment_zy_deg": rng.normal(0, 0.3),
        "gyro_g_sensitivity_zx_dps_per_g": rng.normal(0, 0.05),
        "gyro_g_sensitivity_zy_dps_per_g": rng.normal(0, 0.05),
        "gyro_rate_walk_dps_per_rt_s": 0.002,
        **turn(rng),
        "hand_unevenness": rng.uniform(0.05, 0.25),
        "hand_tremor_dps": rng.uniform(0.3, 2.0),
        "hand_vibration_mg": rng.uniform(*vibration_mg),
        "axis_wobble_deg": rng.uniform(0.0, 0.04),
    }


def words(values: Floats, lsb: float) -> Floats:
    """What the chip's filter makes of samples (n, axes), in whole steps of `lsb`."""
    fine = np.rint(values * 1024 / lsb).astype(np.int64)
    history = np.repeat(fine[:1], 2 * 2**FILTER_M - 2, axis=0)
    sums = bartlett_sums(np.concatenate([history, fine]), FILTER_M)
    return np.asarray(np.rint(sums / (1024 * 4**FILTER_M)) * lsb)
