"""Slips, mistyped and swapped positions: declared angle against gravity's and the gyro's."""

from __future__ import annotations

from adis_gonio.fitting.slips.angles import Angles, Increments
from adis_gonio.fitting.slips.diagnosis import Diagnosis, diagnose
from adis_gonio.fitting.slips.finding import PositionFinding

__all__ = ["Angles", "Diagnosis", "Increments", "PositionFinding", "diagnose"]
