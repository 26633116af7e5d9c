"""The angle that a calibrated goniometer shows: how it follows the parameters and the reading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit

PLACES = 72
"""Angles of a turn over which the uncertainty of a shown angle is averaged."""


@dataclass(frozen=True)
class ShownAngle:
    """Slopes of the shown angle at m places of the turn.

    Attributes
    ----------
    gradient : (m, p) float
        Degrees by the parameters: base and biases in natural units, or all of a fit in its own.
    reading : (m, 2) float
        Degrees per mg of the reading.
    """

    gradient: Floats
    reading: Floats

    @classmethod
    def around(cls, fit: Fit) -> ShownAngle:
        """All around the turn, by base parameters and biases, at the values of a planar fit.

        Angle ψ = atan2(v, u) with u = (U_x − b_x)/(G K_x), v = ((U_y − b_y)/(G K_y) − u sin Δφ)/cos Δφ;
        shown is α − ψ. Where no angle is declared there is no α, and the angle is that of gravity to X.
        """
        gradient = gradient_of_base(fit.values.base, zero=bool(fit.data.visible[0]))
        return cls(gradient, -np.degrees(_by_reading(fit, _around())))

    @classmethod
    def at_dwells(cls, fit: Fit) -> ShownAngle:
        """At the dwells of a planar fit, by all of its parameters, those of its terms among them."""
        psi = fit.values.base[0] + fit.turn_rad + fit.values.attitude
        slope = _by_reading(fit, psi)
        gradient = np.einsum("na,nap->np", slope, fit.columns)
        return cls(np.degrees(gradient), -np.degrees(slope))

    def variances(self, covariance: Floats, reading_mg2: Floats) -> Floats:
        """Variance (m,) in degrees² at each place."""
        by_parameters = np.einsum("mp,pq,mq->m", self.gradient, covariance, self.gradient)
        by_reading = np.einsum("ma,ab,mb->m", self.reading, reading_mg2, self.reading)
        return np.asarray(by_parameters + by_reading)


def gradient_of_base(base: Floats, *, zero: bool) -> Floats:
    """Degrees (PLACES, 6) of a shown angle by α, K_x, K_y, Δφ and biases (of gravity 1).

    Parameters
    ----------
    base : (4,) float
        Base parameters of the plane.
    zero : bool
        True where angles are declared, so that α is part of what is shown.
    """
    _, k_x, k_y, skew = base
    psi = _around()
    x, y = np.cos(psi), np.sin(psi + skew)
    by_x, by_y = _by_axis(psi, skew)
    gradient = np.zeros((PLACES, len(base) + 2))
    gradient[:, 0] = 1.0 if zero else 0.0
    gradient[:, 1] = by_x * x / k_x
    gradient[:, 2] = by_y * y / k_y
    gradient[:, 3] = x * (x - y * math.sin(skew)) / math.cos(skew) ** 2
    gradient[:, 4], gradient[:, 5] = by_x / k_x, by_y / k_y
    return np.asarray(np.degrees(gradient))


def _around() -> Floats:
    return np.linspace(0, 2 * math.pi, PLACES, endpoint=False)


def _by_axis(psi: Floats, skew: float) -> tuple[Floats, Floats]:
    """∂ψ/∂(U_x/(G K_x)) and ∂ψ/∂(U_y/(G K_y))."""
    return -np.sin(psi) - np.cos(psi) * math.tan(skew), np.cos(psi) / math.cos(skew)


def _by_reading(fit: Fit, psi: Floats) -> Floats:
    """∂ψ/∂reading (m, 2) in rad per mg."""
    _, k_x, k_y, skew = fit.values.base
    by_x, by_y = _by_axis(psi, float(skew))
    return np.asarray(np.stack([by_x / k_x, by_y / k_y], axis=1) / fit.data.gravity_mg)
