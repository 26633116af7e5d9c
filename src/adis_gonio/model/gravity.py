"""Local gravity: from latitude and height, and whether a stated one can be right."""

from __future__ import annotations

import math

from adis_gonio.base.errors import UsageError

# WGS 84 (NGA.STND.0036): gravity at the equator, Somigliana's constant, first eccentricity squared,
# semi-major axis, flattening, and m = ω²a²b/GM.
_EQUATOR_MPS2 = 9.7803253359
_K = 0.001931852652458
_E2 = 0.00669437999014
_A_M = 6378137.0
_F = 1 / 298.257223563
_M = 0.00344978650684

ON_EARTH_MPS2 = (9.7, 9.9)
"""What a stated gravity lies within: 9.764 (Huascarán) to 9.834 (Arctic Ocean), with room."""
_SLIPS = {0.01: "cm/s² (Gal)", 1e-5: "mGal", 9.80665: "g", 9.80665e-3: "mg", 0.3048: "ft/s²"}


def checked_gravity_mps2(value: float, *, anywhere: bool = False) -> float:
    """A stated local gravity in m/s², if there is such a place on Earth.

    Parameters
    ----------
    anywhere : bool
        Another place will do too, unless the number is that of the Earth in another unit.

    Raises
    ------
    UsageError
        It lies outside `ON_EARTH_MPS2`; the message names the unit in which it would be right.
    """
    low, high = ON_EARTH_MPS2
    slips = [f"; {value:g} {unit} are {value * k:.6g} m/s²" for k, unit in _SLIPS.items()]
    fits = [text for k, text in zip(_SLIPS, slips, strict=True) if low <= value * k <= high]
    if low <= value <= high or (anywhere and not fits and 0 < value < math.inf):
        return value
    raise UsageError(
        f"gravity is {value:g}: give m/s², {low:g} to {high:g} on Earth{fits[0] if fits else ''}; "
        f"for another place say so by writing the unit, {value:g}mps2"
    )


def normal_gravity_mps2(latitude_deg: float, height_m: float = 0.0) -> float:
    """Normal gravity of the WGS 84 ellipsoid in m/s² (Somigliana's formula, second order in height).

    Real gravity differs by tens of mGal (1e-5 m/s² each): enough for ΔK and Δφ, which do not depend on
    it, and an uncertainty of some 3e-5 for the scale factors.

    Raises
    ------
    UsageError
        Latitude outside ±90°, height outside -500 to 9000 m.
    """
    if not -90 <= latitude_deg <= 90:
        raise UsageError(f"latitude is {latitude_deg:g}: take -90 to 90 degrees")
    if not -500 <= height_m <= 9000:
        raise UsageError(f"height is {height_m:g}: take -500 to 9000 m")
    s2 = math.sin(math.radians(latitude_deg)) ** 2
    surface = _EQUATOR_MPS2 * (1 + _K * s2) / math.sqrt(1 - _E2 * s2)
    h = height_m / _A_M
    return surface * (1 - 2 * (1 + _F + _M - 2 * _F * s2) * h + 3 * h * h)
