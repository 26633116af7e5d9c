"""A calibration as something to use: from readings to gravity and angle, with uncertainty; as a file."""

from adis_gonio.calibration.calibration import (
    AngleReading,
    Calibration,
    Coefficient,
    EffectTerm,
    NotCorrected,
)
from adis_gonio.calibration.gyros import GyroCalibration, Rates
from adis_gonio.calibration.loading import load_calibration

__all__ = [
    "AngleReading",
    "Calibration",
    "Coefficient",
    "EffectTerm",
    "GyroCalibration",
    "NotCorrected",
    "Rates",
    "load_calibration",
]
