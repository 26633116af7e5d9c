"""Find slipped, mistyped and swapped positions: compare declared angles with gravity and the gyro."""

from __future__ import annotations

from adis_gonio.fitting.slips.position_model import Increments
from adis_gonio.fitting.slips.session_positions import Diagnosis, PositionFinding, diagnose

__all__ = ["Diagnosis", "Increments", "PositionFinding", "diagnose"]
