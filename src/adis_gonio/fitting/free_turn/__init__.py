"""One slow continuous turn without declared angles: angle and calibration from gyro and gravity."""

from __future__ import annotations

from adis_gonio.fitting.free_turn.result import METHOD, FreeTurnResult, fit_free_turn, is_free_turn

__all__ = ["METHOD", "FreeTurnResult", "fit_free_turn", "is_free_turn"]
