"""Estimators and their uncertainty: `fit(session, method)`; pure numpy, no files, no devices."""

from __future__ import annotations

from adis_gonio.fitting.methods import METHODS, applicable_methods, fit, fit_readings
from adis_gonio.fitting.result import Estimate, FitResult

__all__ = [
    "METHODS",
    "Estimate",
    "FitResult",
    "applicable_methods",
    "fit",
    "fit_readings",
]
