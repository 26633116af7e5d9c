"""Find slipped, mistyped and swapped positions: compare declared angles with gravity and the gyro."""

from __future__ import annotations

from adis_gonio.fitting.slips.position_diagnosis import Diagnosis, PositionFinding, diagnose
from adis_gonio.fitting.slips.position_model import Angles, Increments

__all__ = ["Angles", "Diagnosis", "Increments", "PositionFinding", "diagnose"]
