"""The table of variants: one row contains all differences between the parts of the family."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor.registers import Kind

GYRO_LSB_DPS: dict[int, float] = {300: 0.07326, 150: 0.03663, 75: 0.018315}
"""°/s per LSB by range in °/s (DS, A)."""

RANGE_CODE: dict[int, int] = {300: 4, 150: 2, 75: 1}
"""SENS_AVG[10:8] by range in °/s (DS, A)."""

LEAST_M: dict[int, int] = {300: 0, 150: 2, 75: 4}
"""Least filter setting M that a range allows (DS, A)."""


@dataclass(frozen=True)
class Performance:
    """Typical errors of a sensor, for the simulator; for the ADIS16354 all are estimates (D).

    Attributes
    ----------
    noise_mg, bias_instability_mg, initial_bias_mg : float
        Noise of an unfiltered sample (rms), floor of the Allan deviation, and standard deviation of the
        bias, in mg.
    noise_density_pole_hz : float
        Pole of the analog front end in Hz.
    scale_error_typical : float
        Standard deviation of a sensitivity's relative error.
    non_orthogonality_deg : float
        Limit of the angle between axes, in degrees.
    bias_tempco_mg_per_c, scale_tempco_ppm_per_c : float
        Temperature coefficients.
    gyro_noise_dps : float
        Noise of an unfiltered gyro sample (rms) in °/s.
    gyro_g_sensitivity_dps_per_g, gyro_supply_sensitivity_dps_per_v : float
        Sensitivity of a gyro to acceleration and supply.
    gyro_instability_dps : float
        Floor of the gyros' Allan deviation in °/s.
    """

    noise_mg: float
    bias_instability_mg: float
    initial_bias_mg: float
    noise_density_pole_hz: float
    scale_error_typical: float
    non_orthogonality_deg: float
    bias_tempco_mg_per_c: float
    scale_tempco_ppm_per_c: float
    gyro_noise_dps: float = 0.6
    gyro_g_sensitivity_dps_per_g: float = 0.05
    gyro_supply_sensitivity_dps_per_v: float = 0.25
    gyro_instability_dps: float = 0.015

    @property
    def noise(self) -> Floats:
        """White noise (rms) of an unfiltered sample of the six axes: (6,), three in mg and three in °/s."""
        return np.array([self.noise_mg] * 3 + [self.gyro_noise_dps] * 3)

    @property
    def floor(self) -> Floats:
        """Floor of the Allan deviation of the six axes: (6,), three in mg and three in °/s."""
        return np.array([self.bias_instability_mg] * 3 + [self.gyro_instability_dps] * 3)

    @property
    def skew_u_rad(self) -> float:
        """Standard uncertainty in rad of an unmeasured skew, uniform within ± the non-orthogonality."""
        return math.radians(self.non_orthogonality_deg) / math.sqrt(3)


@dataclass(frozen=True)
class Variant:
    """A sensor type of the family, with its scales and typical errors."""

    name: str
    accel_mg_per_lsb: float
    accel_range_g: float
    source: str
    confidence: str
    performance: Performance

    @property
    def one_g_lsb(self) -> float:
        """Accelerometer reading in LSB at standard gravity."""
        return 1000.0 / self.accel_mg_per_lsb

    def lsb(self, kind: Kind, gyro_range_dps: int = 300) -> tuple[float, float, str]:
        """For a kind of register: size of an LSB, value at number zero, and unit.

        The value in the unit is `zero + lsb * number`.
        """
        if kind is Kind.GYRO:
            return GYRO_LSB_DPS[gyro_range_dps], 0.0, "°/s"
        if kind in (Kind.ACCEL, Kind.ACCEL_OFFSET):
            return self.accel_mg_per_lsb, 0.0, "mg"
        return _LSB[kind]


_LSB: dict[Kind, tuple[float, float, str]] = {
    Kind.GYRO_OFFSET: (0.018315, 0.0, "°/s"),
    Kind.TEMPERATURE: (0.1453, 25.0, "°C"),
    Kind.SUPPLY: (1.8315e-3, 0.0, "V"),
    Kind.AUX_ADC: (0.6105e-3, 0.0, "V"),
    Kind.AUX_DAC: (2.5 / 4095, 0.0, "V"),
    Kind.COUNT: (1.0, 0.0, ""),
    Kind.FIELDS: (1.0, 0.0, ""),
}

VARIANTS: dict[str, Variant] = {
    variant.name: variant
    for variant in (
        Variant(
            "adis16354", 0.4672, 1.7, "three independent public code bases", "A",
            Performance(4.7, 0.1, 10.0, 350.0, 0.001, 0.25, 0.5, 40.0),
        ),
        Variant(
            "adis16350", 2.522, 10.0, "DS", "A",
            Performance(35.0, 0.7, 40.0, 350.0, 0.01, 0.25, 4.0, 100.0),
        ),
        Variant(
            "adis16355", 2.522, 10.0, "DS", "A",
            Performance(35.0, 0.7, 40.0, 350.0, 0.01, 0.25, 0.5, 40.0),
        ),
    )
}  # fmt: skip


def variant(name: str | Variant) -> Variant:
    """Return the variant with this name (`adis16354`, also `16354`); `UsageError` lists the known ones."""
    if isinstance(name, Variant):
        return name
    key = name.strip().lower()
    found = VARIANTS.get(key) or VARIANTS.get(f"adis{key}")
    if found is None:
        raise UsageError(f"no variant is called '{name}'; known: {', '.join(VARIANTS)}")
    return found
