"""Local gravity from latitude and height."""

from __future__ import annotations

import math

from adis_gonio.errors import UsageError

# WGS 84 (NGA.STND.0036): gravity at the equator, Somigliana's constant, first eccentricity squared,
# semi-major axis, flattening, and m = ω²a²b/GM.
_EQUATOR_MPS2 = 9.7803253359
_K = 0.001931852652458
_E2 = 0.00669437999014
_A_M = 6378137.0
_F = 1 / 298.257223563
_M = 0.00344978650684


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


EARTH_MPS2 = (9.75, 9.84)
"""Gravity on Earth: `normal_gravity_mps2` from the equator at 9000 m to a pole at -500 m, outwards."""

_OTHER_UNITS = {"g": 9.80665, "cm/s² (Gal)": 0.01, "mGal": 1e-5, "mg": 9.80665e-3, "ft/s²": 0.3048}


def require_gravity(gravity_mps2: float) -> None:
    """Raise `UsageError` where local gravity is none of the Earth's, with the unit that was meant."""
    low, high = EARTH_MPS2
    if low <= gravity_mps2 <= high:
        return
    meant = [unit for unit, size in _OTHER_UNITS.items() if low <= size * gravity_mps2 <= high]
    hint = f"; {gravity_mps2:g} looks like {meant[0]}" if meant else ""
    raise UsageError(
        f"gravity_mps2 is {gravity_mps2:g}: local gravity in m/s² is {low} to {high} on Earth{hint}"
    )
