"""What is known of the gyros' errors before the part is watched: as a calibration says, or as parts are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from adis_gonio.base.arrays import Floats

ZERO_DPS = 3.0
"""Zero rate of a gyro that nobody has calibrated (D)."""
TURN_ON_DPS = 0.2
"""What a calibrated zero may have become since: another start, another temperature (D)."""
SCALE = 0.01
"""Relative error of a gain that nobody has calibrated (D: the sheets at hand have none)."""
G_DPS_PER_G = 0.05
"""Sensitivity to acceleration (CHIP, B)."""
WALK_DPS_PER_RT_S = 0.003
"""Random walk of a zero (D): an Allan floor of 0.015 °/s within half a minute."""


class GyroCorrection(Protocol):
    """What a calibration of the gyros does: `calibration.GyroCalibration`, for one."""

    def correct(self, rate_dps: Floats, force_g: Floats, temperature_c: Floats | None) -> Floats:
        """Rates (n, 3) in °/s without the calibrated errors."""


@dataclass(frozen=True)
class GyroKnowledge:
    """Standard uncertainties of what is left of a gyro's errors about the axis that is watched.

    Attributes
    ----------
    zero_dps, scale, g_dps_per_g : float
        Of zero rate, gain, and sensitivity to acceleration along each axis of the plane.
    walk_dps_per_rt_s : float
        Random walk of the zero rate.
    calibration : GyroCorrection or None
        Corrects rates first.
    """

    zero_dps: float = ZERO_DPS
    scale: float = SCALE
    g_dps_per_g: float = G_DPS_PER_G
    walk_dps_per_rt_s: float = WALK_DPS_PER_RT_S
    calibration: GyroCorrection | None = None

    @classmethod
    def of(cls, calibration: GyroCorrection | None, u: Mapping[str, float | None] | None) -> GyroKnowledge:
        """By a calibration and its standard uncertainties by name (`gyro_bias_z`, `gyro_scale_z`, …).

        What it does not state is as in a part that nobody has calibrated.
        """
        if calibration is None:
            return cls()
        told = {name: value for name, value in (u or {}).items() if value is not None}
        zero = told.get("gyro_bias_z", TURN_ON_DPS)
        across = [told.get(f"g_sensitivity_z{axis}", G_DPS_PER_G) for axis in "xy"]
        return cls(
            math.hypot(zero, TURN_ON_DPS),
            told.get("gyro_scale_z", SCALE),
            max(across),
            calibration=calibration,
        )

    def corrected(self, rate_dps: Floats, accel_mg: Floats, temperature_c: float | None) -> Floats:
        """A rate (3,) without the calibrated errors."""
        if self.calibration is None:
            return rate_dps
        warm = None if temperature_c is None else np.array([temperature_c])
        return np.asarray(self.calibration.correct(rate_dps[None], accel_mg[None] / 1000.0, warm)[0])


__all__ = ["GyroCorrection", "GyroKnowledge"]
