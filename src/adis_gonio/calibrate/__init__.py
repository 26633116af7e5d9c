"""Calibrations, which convert readings to gravity, angle or rate with uncertainty, and their files."""

from adis_gonio.calibrate.calibration import (
    AngleReading,
    Calibration,
    Coefficient,
    EffectTerm,
    NotCorrected,
)
from adis_gonio.calibrate.gyro_calibration import GyroCalibration, Rates

__all__ = [
    "AngleReading", "Calibration", "Coefficient", "EffectTerm", "GyroCalibration", "NotCorrected",
    "Rates",
]  # fmt: skip
