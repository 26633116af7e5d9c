"""What makes one plan better than another, as numbers of its information matrix.

The information M (p, p) is that of start angle, gains, Δφ and biases in natural units (1 rad, 1, local
gravity), then of the amplitudes of the effects to beware of, each in units of what a bench sees of it, with
the prior of `advice` (`TYPICALS` of them) about zero. V = M⁻¹ is the covariance, V_b its part of the base.

| name | maximised | known as |
|---|---|---|
| `angle` | −max over the turn of ln gᵀ V_b g, g the slope of the shown angle | G-optimality |
| `parameters` | −ln det V_b, divided by the number of parameters | D-optimality; D_s beside effects |
| `tell-apart` | min over amplitudes of ln(1/V_ee − 1/prior²), plus their mean/100 | maximin D_s, s = 1 |

1/V_ee − 1/prior² is the information on one amplitude that nothing else takes away, neither base model nor
another effect: the square of the standard uncertainties by which an effect of typical size stands out.
Smith 1918, Kiefer and Wolfowitz 1960 (G and D); Atkinson, Donev and Tobias 2007 (D_s); Chaloner and
Verdinelli 1995 (with a prior).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from adis_gonio.base.arrays import Floats

Best = Literal["angle", "parameters", "tell-apart"]
CRITERIA: tuple[Best, ...] = ("angle", "parameters", "tell-apart")
_MEAN = 0.01
"""Weight of the mean beside the smallest, so that of equals the one that shows more stands first."""
_NOTHING = 1e-12
"""Information that counts as none."""

Score = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Criterion:
    """A criterion by its name, on information matrices of one shape.

    Attributes
    ----------
    name : {"angle", "parameters", "tell-apart"}
    base : int
        How many of the parameters are those of the base model.
    gradient : (m, base) float
        Degrees of the shown angle by the base parameters, around the turn.
    precision : (p,) float
        Of the prior.
    """

    name: Best
    base: int
    gradient: Floats
    precision: Floats

    def __call__(self, information: Floats) -> Floats:
        """Scores (k,) of information matrices (k, p, p), priors among them: the more the better."""
        covariance = np.asarray(np.linalg.inv(information))
        if self.name == "angle":
            return np.asarray(-np.log(self._angle_variance(covariance)))
        if self.name == "parameters":
            own = covariance[:, : self.base, : self.base]
            return np.asarray(-np.linalg.slogdet(own)[1] / self.base)
        apart = np.log(self.separations(information) ** 2 + _NOTHING)
        return np.asarray(apart.min(axis=1) + _MEAN * apart.mean(axis=1))

    def _angle_variance(self, covariance: Floats) -> Floats:
        own = covariance[:, : self.base, : self.base]
        return np.asarray(np.einsum("mp,kpq,mq->km", self.gradient, own, self.gradient).max(axis=1))

    def separations(self, information: Floats) -> Floats:
        """Standard uncertainties (k, q) by which each amplitude of typical size stands beside all else."""
        variance = np.einsum("kpp->kp", np.linalg.inv(information))[:, self.base :]
        return np.asarray(np.sqrt(np.maximum(1 / variance - self.precision[self.base :], 0.0)))

    def figure(self, information: Floats) -> float:
        """The criterion in words' units: worst u in degrees; generalised u; least separation."""
        stack = information[None]
        if self.name == "angle":
            return float(np.sqrt(self._angle_variance(np.asarray(np.linalg.inv(stack)))[0]))
        if self.name == "parameters":
            return float(np.exp(-0.5 * self(stack)[0]))
        return float(self.separations(stack)[0].min())


MEANING: dict[Best, str] = {
    "angle": "u of the angle by the fitted parameters, worst place of the turn, in degrees",
    "parameters": "generalised u of the parameters, (det V)^(1/2p) in natural units",
    "tell-apart": "least separation of a typical effect from all others, in standard uncertainties",
}
"""What `Criterion.figure` is."""
