"""A calibration as something to use: from readings to gravity and angle, with uncertainty; as a file."""

from adis_gonio.calibrate.calibration import AngleReading, Calibration, EffectTerm
from adis_gonio.calibrate.coefficients import Coefficient, NotCorrected
from adis_gonio.calibrate.gyro_calibration import GyroCalibration, Rates

__all__ = [
    "AngleReading",
    "Calibration",
    "Coefficient",
    "EffectTerm",
    "GyroCalibration",
    "NotCorrected",
    "Rates",
]
