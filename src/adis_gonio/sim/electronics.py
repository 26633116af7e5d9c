"""What the chip itself does to its gyros and accelerometers, beyond what its registers say.

CHIP.md has MSC_CTRL[7:6], the ranges and the autonulls, but nothing of how well they do: all figures here
are estimates (D) and stay parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from adis_gonio.base.arrays import Floats
from adis_gonio.sim.rules import PRECISION_S


@dataclass(frozen=True)
class Electronics:
    """A chip's own figures.

    Attributes
    ----------
    range_gain : mapping of int to float
        Gain of the gyros by range in °/s, relative to ±300 °/s; one that is not named has 1.
    gyro_saturation : float
        Where the gyros are cut off, in units of the range; the registers end at twice the range.
    g_compensation : (3, 3) float or None
        What MSC_CTRL[7] takes off the gyros, °/s per g that the chip's own accelerometers read; None takes
        the family's figure for the own axis.
    origin_compensation : float
        Share of what the accelerometers' places add that MSC_CTRL[6] takes off.
    autonull_s, precision_autonull_s : float
        Over which time the autonulls average; 0 takes the filter's present output.
    """

    range_gain: dict[int, float] = field(default_factory=dict)
    gyro_saturation: float = math.inf
    g_compensation: Floats | None = None
    origin_compensation: float = 1.0
    autonull_s: float = 0.0
    precision_autonull_s: float = PRECISION_S


IDEAL = Electronics()


@runtime_checkable
class BringsElectronics(Protocol):
    """Surroundings that say what the chip in them is like."""

    @property
    def electronics(self) -> Electronics:
        """Of that chip."""
