"""Scatter that a few values far off do not change."""

from __future__ import annotations

import numpy as np

from adis_gonio.base.arrays import Floats

MAD_TO_SD = 1.482602218505602
"""Standard deviation of a normal distribution over its median absolute deviation."""


def robust_sd(values: Floats) -> float:
    """Standard deviation by the median absolute deviation, that of a normal distribution."""
    return float(MAD_TO_SD * np.median(np.abs(values - np.median(values))))
