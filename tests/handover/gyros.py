"""Gyro calibrations with known numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace

from adis_gonio.calibrate import Calibration, GyroCalibration
from adis_gonio.record.provenance import Covered

AXES = "xyz"
ZERO = {"gyro_bias_x": 1.21, "gyro_bias_y": -0.73, "gyro_bias_z": 0.38}
FULL = {
    **ZERO,
    "gyro_scale_x": 1.012, "gyro_scale_y": 0.991, "gyro_scale_z": 1.004,
    "gyro_misalignment_xy": 0.31, "gyro_misalignment_xz": -0.22, "gyro_misalignment_yx": 0.17,
    "gyro_misalignment_yz": -0.41, "gyro_misalignment_zx": 0.05, "gyro_misalignment_zy": 0.26,
    "g_sensitivity_xx": 0.052, "g_sensitivity_xy": -0.031, "g_sensitivity_xz": 0.018,
    "g_sensitivity_yx": 0.011, "g_sensitivity_yy": 0.047, "g_sensitivity_yz": -0.24,
    "g_sensitivity_zx": -0.006, "g_sensitivity_zy": 0.013, "g_sensitivity_zz": 0.058,
}  # fmt: skip
EVERY = {
    **FULL,
    "g2_sensitivity_xx": 0.004, "g2_sensitivity_xy": -0.003, "g2_sensitivity_zz": 0.007,
    "gyro_bias_temperature_x": 0.011, "gyro_bias_temperature_y": -0.017, "gyro_bias_temperature_z": 0.004,
    "gyro_bias_temperature2_x": 2.1e-4, "gyro_bias_temperature3_y": -1.7e-6,
    "gyro_scale_temperature_x": 130.0, "gyro_scale_temperature_z": -210.0,
    "gyro_supply_x": 0.25, "gyro_supply_y": -0.21,
}  # fmt: skip
UNITS = {
    "gyro_bias_temperature": "dps/°C", "gyro_bias_temperature2": "dps/°C²",
    "gyro_bias_temperature3": "dps/°C³", "gyro_scale_temperature": "ppm/°C", "gyro_supply": "dps/V",
    "gyro_bias": "dps", "gyro_scale": "1", "gyro_misalignment": "deg", "g_sensitivity": "dps/g",
    "g2_sensitivity": "dps/g²",
}  # fmt: skip
U = {
    "dps": 2e-3,
    "1": 1e-4,
    "deg": 0.01,
    "dps/g": 3e-3,
    "dps/g²": 1e-3,
    "dps/°C": 1e-4,
    "dps/°C²": 1e-6,
    "dps/°C³": 1e-8,
    "ppm/°C": 5.0,
    "dps/V": 0.01,
}


@dataclass(frozen=True)
class Estimated:
    """An estimate as fits have them."""

    value: float
    u: float | None
    unit: str
    dof: float | None = None


def estimates(values: dict[str, float]) -> dict[str, Estimated]:
    units = {name: UNITS[name.rpartition("_")[0]] for name in values}
    return {name: Estimated(value, U[units[name]], units[name]) for name, value in values.items()}


def gyros(values: dict[str, float], **about) -> GyroCalibration:
    """Of parameters that are known up to small uncertainties."""
    about = {
        "offsets_lsb": (12, -5, 0),
        "temperature_c": Covered(28.0, 24.0, 33.0),
        "supply_v": Covered(5.02, 5.0, 5.05),
        **about,
    }
    return GyroCalibration.of(estimates(values), **about)


def with_gyros(calibration: Calibration, values: dict[str, float], **about) -> Calibration:
    return replace(calibration, gyro=gyros(values, **about))
