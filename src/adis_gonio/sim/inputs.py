"""What the chip's sensing elements feel: the border between the chip and the world around it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from adis_gonio.base.arrays import Floats


@dataclass(frozen=True)
class Inputs:
    """Analog inputs at n internal updates, in the sense in which the registers say them.

    Attributes
    ----------
    accel_mg : (n, 3) float
        Accelerations x, y, z in mg (thousandths of 9.80665 m/s²); level with Z up, z is -1000.
    gyro_dps : (n, 3) float
        Rates of turn in °/s, right-handed about the drawn axes.
    temperature_c : (n, 3) float
        Temperatures of the dies of the three gyros in °C.
    supply_v, aux_v : (n,) float
        Supply and auxiliary input in V.
    place_mg : (n, 3) float or None
        How much of `accel_mg` comes from the accelerometers' places within the part; None where nothing.
    """

    accel_mg: Floats
    gyro_dps: Floats
    temperature_c: Floats
    supply_v: Floats
    aux_v: Floats
    place_mg: Floats | None = None


class Surroundings(Protocol):
    """What a chip is put into."""

    def sample(self, time_s: Floats) -> Inputs:
        """Inputs at increasing times (n,) in s; each call goes on where the last one ended.

        How the updates are divided into calls must not change the values.
        """
