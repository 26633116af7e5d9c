"""Shapes of the grammar: functions of one covariate in normal form (−1 to 1), made from their places."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from adis_gonio.base.arrays import Floats

Shape = Callable[[Floats], Floats]


def line(u: Floats) -> Floats:
    """U."""
    return u


def power(exponent: int) -> Shape:
    """Power of u."""

    def raised(u: Floats) -> Floats:
        out = u.copy()
        for _ in range(exponent - 1):
            out = out * u
        return out

    return raised


def step(place: float) -> Shape:
    """0 up to a place, 1 beyond."""
    return lambda u: np.where(u > place, 1.0, 0.0)


def knee(place: float, sign: float) -> Shape:
    """0 on one side of a place, a line on the other."""
    return lambda u: np.maximum(sign * (u - place), 0)


def growth(rate: float) -> Shape:
    """exp(rate u), at most 1 inside."""
    return lambda u: np.exp(rate * u - abs(rate))


def approach(time_constant: float, sign: float) -> Shape:
    """Exponential from (sign −1) or towards (sign 1) an end; in lengths of the session."""
    return lambda u: np.exp((sign * (u + 1) / 2 - (sign > 0)) / time_constant)


def bump(place: float, width: float) -> Shape:
    """Gaussian bell."""
    return lambda u: np.exp(-0.5 * ((u - place) / width) ** 2)


def ring_bump(centre_rad: float, width_rad: float) -> Shape:
    """Bell on the circle."""
    return lambda t: np.exp((np.cos(t - centre_rad) - 1) / width_rad**2)


def multiple(function: Callable[..., Floats], times: int) -> Shape:
    """function(times · u)."""
    return lambda u: np.asarray(function(times * u))


def legendre(degree: int) -> Shape:
    """Legendre polynomial."""
    coefficients = np.zeros(degree + 1)
    coefficients[degree] = 1.0
    return lambda u: np.asarray(np.polynomial.legendre.legval(u, coefficients))
