"""What a session knows of its positions: declared angles, gravity's readings, the gyro between them."""

from __future__ import annotations

from dataclasses import dataclass

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.slips.halts import Halts
from adis_gonio.model.effects import Conditions


@dataclass(frozen=True)
class Increments:
    """How far the part was turned from each dwell to the next, by the gyro about the axis of rotation.

    Attributes
    ----------
    angle_rad : (n - 1,) float
        Integral of the rate less its zero, in the direction of declared angles; NaN where nobody watched
        the whole turn.
    u_rad : (n - 1,) float
        Standard uncertainty by noise and by what the zero does between the dwells; without gain and
        g-sensitivity, which the turns share.
    force_gs : (n - 1, 2) float
        Integral over the turn of what X and Y read less the course between the two dwells, in g·s: what a
        g-sensitivity of 1 rad/s/g adds to the angle.
    halts : tuple of (Halts or None)
        Where the part rested on its way, n - 1 of them; None where only the whole turn is known. Empty: of
        no turn.
    """

    angle_rad: Floats
    u_rad: Floats
    force_gs: Floats
    halts: tuple[Halts | None, ...] = ()


@dataclass(frozen=True)
class Angles:
    """n dwells of a turn in the plane, in the order in which they were recorded.

    Attributes
    ----------
    position : (n,) int
        Numbers of the dwells.
    declared_rad : (n,) float
        Declared angles; NaN where none is.
    reading_mg : (n, 2) float
        Means of X and Y.
    covariance_mg2 : (n, 2, 2) float
    conditions : Conditions
        What surrounded the dwells, for the effects that may be in the readings besides.
    gravity_mg : float
        Local gravity.
    fixture_rad : float or None
        Standard uncertainty of a declared angle; None where it is not stated.
    bias_mg : float
        Standard deviation of a bias of this sensor before it is measured.
    turns : Increments or None
        None without gyros.
    """

    position: tuple[int, ...]
    declared_rad: Floats
    reading_mg: Floats
    covariance_mg2: Floats
    conditions: Conditions
    gravity_mg: float
    fixture_rad: float | None
    bias_mg: float
    turns: Increments | None = None

    def __len__(self) -> int:
        return len(self.position)
