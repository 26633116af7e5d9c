"""Mean rates of turn as readings: what three gyros see of a dwell at rest, or of a turn between two dwells.

Gyros are right-handed about the drawn axes, in the frame of the accelerometers (`model.measurement`), and
read in °/s::

    rate = K D ω + b + G f + …

ω is the true rate, K gains and D unit directions, b the zero rate, G the linear g-sensitivity and f what
the accelerometers **read** in g (level with Z up: z = −1). The base model is a perfect gyro with a zero
rate; everything else is an effect (`model.effects.gyro_terms`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.model.measurement import BaseParameter, Measurement

if TYPE_CHECKING:
    from adis_gonio.model.effects.base import Conditions

FULL_DPS = 100.0
"""Rate of a brisk turn by hand, at which amplitudes of functions without a name are stated."""


@dataclass(frozen=True)
class MeanRate(Measurement):
    """The mean rate over a dwell or a turn; its "attitude" is the true mean rate (n, 3) in °/s.

    That is known (`Conditions.rate_dps`): nothing about an interval is free.
    """

    parameters = tuple(BaseParameter(f"gyro_bias_{axis}", "dps", 0.0, spread=math.inf) for axis in "xyz")
    axes = 3
    freedom = 0
    part: ClassVar[str] = "gyro"
    unit: ClassVar[str] = "dps"
    full: ClassVar[float] = FULL_DPS
    driven_by: ClassVar[tuple[str, ...]] = ("force", "rotation")
    named_forms: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "time": ("bias",),
        "temperature": ("bias", "gain"),
        "supply": ("bias",),
    }

    @property
    def constant(self) -> bool:
        """The zero rates are a constant on each axis."""
        return True

    def stimulus(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Rates of turn (n, 3) in hundreds of °/s; none at rest, whatever the zero rate."""
        if conditions.rate_dps is None:
            return np.zeros_like(ideal)
        return conditions.rate_dps / self.full

    def pose(self, reading: Floats, conditions: Conditions) -> Floats | None:
        """Direction (n, 3) of what the accelerometers read."""
        if conditions.force_g is None:
            return None
        length = np.linalg.norm(conditions.force_g, axis=1, keepdims=True)
        return np.asarray(conditions.force_g / np.maximum(length, 1e-12))

    def by_pose(self, conditions: Conditions) -> NDArray[np.bool_]:
        """Intervals at rest: turns about an axis are the only ones that show its gain."""
        if conditions.rate_dps is None:
            return super().by_pose(conditions)
        return np.asarray(~conditions.rate_dps.any(axis=1))

    def begin(
        self, reading: Floats, turn_rad: Floats, declared: NDArray[np.bool_], conditions: Conditions
    ) -> tuple[Floats, Floats]:
        """The mean of what is not rotation, and the true rates."""
        rate = np.zeros_like(reading) if conditions.rate_dps is None else conditions.rate_dps
        still = ~rate.any(axis=1)
        rest = reading[still] if still.any() else reading - rate
        return rest.mean(axis=0), rate

    def ideal(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """True rate plus zero rate (n, 3) in °/s."""
        return np.asarray(attitude + base)

    def tangent(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Nothing is free: (n, 3, 0)."""
        return np.zeros((len(attitude), self.axes, 0))

    def columns(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """∂ideal/∂base: ones, (n, 3, 3)."""
        return np.tile(np.eye(self.axes), (len(attitude), 1, 1))

    def moved(self, attitude: Floats, step: Floats) -> Floats:
        """The rates as they were."""
        return attitude

    def calibrated(self, base: Floats, reading: Floats) -> Floats:
        """Rates (n, 3) in °/s without the zero rates."""
        return np.asarray(reading - base)
