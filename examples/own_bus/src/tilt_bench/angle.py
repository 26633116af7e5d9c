"""The goniometer's host code: an angle from two accelerometers.

With the convention of adis-gonio, U_x = K_x G cos(psi) + b_x and U_y = K_y G sin(psi + dphi) + b_y, so
that the coefficients of a calibration turn two readings into the angle psi between the part and gravity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from adis_gonio import Adis16354


@dataclass(frozen=True)
class Coefficients:
    """What a calibration found; those of a perfect part by default."""

    delta_k: float = 0.0
    delta_phi_deg: float = 0.0
    bias_x_mg: float = 0.0
    bias_y_mg: float = 0.0


class NotLevelError(ValueError):
    """The two axes see too little of gravity for an angle."""


class Goniometer:
    """Angle of a part on a sensor."""

    LEAST_MG = 500.0

    def __init__(self, sensor: Adis16354, coefficients: Coefficients = Coefficients()) -> None:
        self._sensor = sensor
        self._c = coefficients

    def angle_deg(self, scans: int = 256) -> float:
        """Angle psi in degrees; the median of the scans, so that a few wrong words do not move it."""
        block = self._sensor.read_scans(scans, ["XACCL_OUT", "YACCL_OUT"])
        values = block.values()
        x, y = (sorted(values[:, k])[scans // 2] for k in (0, 1))
        c = self._c
        x, y = (x - c.bias_x_mg) / (1 + c.delta_k), y - c.bias_y_mg
        phi = math.radians(c.delta_phi_deg)
        cosine, sine = x, (y - x * math.sin(phi)) / math.cos(phi)
        if math.hypot(cosine, sine) < self.LEAST_MG:
            raise NotLevelError(f"{math.hypot(cosine, sine):.0f} mg in the plane: its axis stands upright")
        return math.degrees(math.atan2(sine, cosine))
