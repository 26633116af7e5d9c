"""Calibrations, which convert readings to gravity, angle or rate with uncertainty, and their files."""

from adis_gonio.calibrate.calibration import Calibration, Coefficient, EffectTerm, NotCorrected
from adis_gonio.calibrate.gyro_calibration import GyroCalibration

__all__ = ["Calibration", "Coefficient", "EffectTerm", "GyroCalibration", "NotCorrected"]
