"""What is known of three gyros before a session's links are looked at: a data sheet, or a calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.gyros.attitude import PARAMETERS
from adis_gonio.model.effects.base import AXES

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration

SHEET_GAIN = 0.02
"""Limit of a gain's error (CHIP: sensitivity ±2 %)."""
SHEET_FRAME_DEG = 0.5
"""Limit of the angle between a triad and the package (CHIP), of the gyros' and of the accelerometers'."""
SHEET_ASYMMETRY = 0.002
"""Limit of what a gain depends on the sign of the rate by (CHIP: nonlinearity ±0.2 % of full scale)."""
UNKNOWN_GAIN, UNKNOWN_MISALIGNMENT_DEG, UNKNOWN_G_DPS = 0.05, 2.0, 0.1
"""Standard uncertainties of gyros without a data sheet: estimates (D)."""
_STEP = 1e-6


@dataclass(frozen=True)
class GyroPrior:
    """Parameters of three gyros in the order of `attitude.PARAMETERS`, with their covariance."""

    values: Floats
    covariance: Floats

    @cached_property
    def root(self) -> Floats:
        """Root (21, q) of the covariance."""
        size, axes = np.linalg.eigh(self.covariance)
        kept = size > 1e-12 * max(float(size[-1]), 1e-300)
        return np.asarray(axes[:, kept] * np.sqrt(size[kept]))

    @classmethod
    def of_sheet(cls, sensor: str) -> GyroPrior:
        """Perfect gyros, as uncertain as their data sheet leaves them: rectangles within its limits.

        Gains and misalignments of each gyro, and a rotation of the whole triad against the
        accelerometers', whose own place in the package is as uncertain.
        """
        values = np.concatenate([np.eye(3).ravel(), np.zeros(PARAMETERS - 9)])
        figures = VARIANTS[sensor].performance if sensor in VARIANTS else None
        gain, misalignment, turned = (
            UNKNOWN_GAIN,
            math.radians(UNKNOWN_MISALIGNMENT_DEG),
            math.radians(UNKNOWN_MISALIGNMENT_DEG),
        )
        per_g = UNKNOWN_G_DPS
        if figures is not None:
            gain = SHEET_GAIN / math.sqrt(3)
            misalignment = figures.skew_u_rad
            turned = math.radians(SHEET_FRAME_DEG) * math.sqrt(2 / 3)
            per_g = figures.gyro_g_sensitivity_dps_per_g
        own = np.where(np.eye(3, dtype=bool), gain, misalignment).ravel() ** 2
        own = np.concatenate([own, np.full(9, per_g**2), np.full(3, SHEET_ASYMMETRY**2 / 3)])
        covariance = np.diag(own)
        for i, j in ((0, 1), (0, 2), (1, 2)):
            apart = np.zeros(PARAMETERS)
            apart[3 * i + j], apart[3 * j + i] = turned, -turned
            covariance += np.outer(apart, apart)
        return cls(values, covariance)

    def calibrated(self, gyros: GyroCalibration) -> GyroPrior:
        """The same where a calibration knows better; what it does not determine stays."""
        values, covariance = self.values.copy(), self.covariance.copy()
        known = _known(gyros)
        matrix = np.zeros((len(gyros.parameters),) * 2) if gyros.covariance is None else gyros.covariance
        begin = gyros.values
        slope = central_differences(lambda values: _stated(gyros, values), begin, _STEP)
        values[known] = _stated(gyros, begin)[known]
        # What both say of is said by the calibration alone.
        covariance[known, :] = covariance[:, known] = 0.0
        covariance[np.ix_(known, known)] = (slope @ matrix @ slope.T)[np.ix_(known, known)]
        return GyroPrior(values, covariance)

    def with_g_sensitivity(self, gram: Floats, product: Floats, variance: Floats) -> GyroPrior:
        """The same with what zero rates of dwells say of the g-sensitivity, gyro by gyro.

        Parameters
        ----------
        gram, product : (3, 3) float
            Forces times forces, and times rates (a column a gyro), less their means.
        variance : (3,) float
            Of a zero rate, by gyro.
        """
        values, covariance = self.values.copy(), self.covariance.copy()
        for gyro in range(3):
            rows = slice(9 + 3 * gyro, 12 + 3 * gyro)
            prior = covariance[rows, rows]
            # Posterior of a linear model: (P⁻¹ + G/σ²)⁻¹, without the inverse of a P that may be singular.
            after = np.linalg.solve(np.eye(3) + prior @ gram / variance[gyro], prior)
            values[rows] = values[rows] + after @ (product[:, gyro] - gram @ values[rows]) / variance[gyro]
            covariance[rows, rows] = (after + after.T) / 2
        return replace(self, values=values, covariance=covariance)


def _stated(gyros: GyroCalibration, values: Floats) -> Floats:
    """Parameters (21,) by the values of a calibration."""
    held = dict(zip((one.name for one in gyros.parameters), values.tolist(), strict=True))
    misalignment = np.array([[held.get(f"gyro_misalignment_{i}{j}", 0.0) for j in AXES] for i in AXES])
    sines = np.sin(np.radians(misalignment)) * (1 - np.eye(3))
    gains = np.array([held.get(f"gyro_scale_{i}", 1.0) for i in AXES])
    rows = gains[:, None] * (sines + np.diag(np.sqrt(1 - (sines**2).sum(axis=1))))
    per_g = np.array([[held.get(f"g_sensitivity_{i}{j}", 0.0) for j in AXES] for i in AXES])
    return np.concatenate([rows.ravel(), per_g.ravel(), np.zeros(3)])


def _known(gyros: GyroCalibration) -> list[int]:
    """Places among the parameters of what the calibration determines."""
    found = []
    for i, gyro in enumerate(AXES):
        for j, axis in enumerate(AXES):
            name = f"gyro_scale_{gyro}" if i == j else f"gyro_misalignment_{gyro}{axis}"
            if name in gyros:
                found.append(3 * i + j)
            if f"g_sensitivity_{gyro}{axis}" in gyros:
                found.append(9 + 3 * i + j)
    return sorted(found)
