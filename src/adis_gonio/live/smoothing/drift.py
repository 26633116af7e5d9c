"""1/f noise of the accelerometers, as first-order processes of the linear model, and what is slower.

Each octave of 1/f noise has half the square of the Allan floor. The fastest octaves change while the
filter averages: as states they are averaged as they should be, and what is left of them counts in u. Two
octaves make a state: processes with corners a factor of four apart add up to 1/f within some per cent. What
is slower is the same through the seconds that count, and is added to u.
"""

from __future__ import annotations

import math

import numpy as np

from adis_gonio.base.arrays import Floats

OCTAVES = 17
"""Between two hertz and a day, for a calibration of yesterday."""
CORNERS_HZ = 2.0 ** np.array([0.5, -1.5, -3.5])
"""Of the processes: the middles of six octaves from the fastest on."""
COUNT = len(CORNERS_HZ)
_EACH = 2


def slow_mg(floor_mg: float) -> float:
    """Standard deviation, on an axis, of the octaves that no state has."""
    return floor_mg * math.sqrt((OCTAVES - _EACH * COUNT) / 2)


def process_mg2(floor_mg: float) -> float:
    """Variance of each process by the Allan floor."""
    return floor_mg**2 * _EACH / 2


def memory(length_s: float, turn_deg: float) -> Floats:
    """What is left (COUNT,) after a time and a turn.

    The noise stays with the sensor's axes: what lies across gravity becomes, as the part turns, the noise
    of the other axis.
    """
    kept: Floats = np.exp(-2 * np.pi * CORNERS_HZ * length_s)
    return kept * math.cos(math.radians(turn_deg))


__all__ = ["COUNT", "memory", "process_mg2", "slow_mg"]
