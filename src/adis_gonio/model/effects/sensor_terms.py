"""Static terms of the sensor: what an axis answers to acceleration, along it and across it.

The order is that of the model equation of IEEE Std 1293: E/K1 = K0 + a_i + K2 a_i² + K3 a_i³ + K_ip a_i a_p
+ K_pp a_p² + δ a_p. All typical sizes are estimates; the sheet of the siblings gives non-orthogonality
±0.25° and nonlinearity ±0.2 % of full scale (3.4 mg at 1.7 g, hence K3 ≈ 0.7 mg/g³).
"""

from __future__ import annotations

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.model.effects.base import ONE_TURN, Conditions, Parameter
from adis_gonio.model.effects.families import CrossEffect, LinearAxisEffect
from adis_gonio.model.records import MG_PER_G

_OUT_OF_PLANE = "repeat the session with the part on its side, so that gravity leaves the plane"
_OBLIQUE = (
    "point each axis 45° and 60° off the vertical, up and down (readings of ±0.7 and ±0.5 g), and repeat a "
    "few of the first poses last"
)


class Bias(LinearAxisEffect):
    """A constant: mean term K0 of the tumble."""

    name = "bias"
    cause = "An axis reads other than zero where no acceleration acts along it."
    formula = "a_i += bias_i"
    separated_by = (
        "Two positions cannot see it, opposite ones (0/180°) can; in one plane at 1 g the mean of an even "
        "nonlinearity joins it: positions out of the plane, or several temperatures and times, part them."
    )
    remedy = "repeat a few positions on another day or at another temperature"
    in_base = True
    prior = "constant"
    shown_over = "angle"
    covariates = ()
    coefficients = (Parameter("bias", "mg", -1000.0, 1000.0, 10.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """One."""
        return (np.ones(len(ideal)),)


class Scale(LinearAxisEffect):
    """A relative error of the gain; in every fit of this package it is a base parameter."""

    name = "scale"
    covariates = ("reading",)
    cause = "The sensitivity of an axis differs from its nominal one."
    formula = "a_i += scale_i · a_i"
    separated_by = (
        "It is a base parameter (the gain) in every model; `gravity` changes all gains alike and needs "
        "another place or a known g to be told apart, `cubic` needs the third harmonic."
    )
    remedy = "enter the local gravity, as from --latitude and --height"
    correctable = True
    in_base = True
    coefficients = (Parameter("scale", "1", -0.1, 0.1, 0.001),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """The ideal reading."""
        return (ideal[:, axis],)


class Misalignment(CrossEffect):
    """The linear part of cross-axis sensitivity.

    In the plane the four linear terms (two gains, two misalignments) are the base model's K_x, K_y, α and
    Δφ; in space with free attitudes six of the nine linear terms are gains and skews and the other three
    are a rotation, which nobody can see. So a fit finds it in the base parameters, never beside them.
    """

    name = "misalignment"
    covariates = ("reading",)
    cause = "The sensitive direction of an axis is misaligned towards another axis by a small angle."
    formula = "a_i += misalignment_ip · a_p (angle in radians)"
    separated_by = (
        "In the plane it is the base model's α and Δφ, in space its skews and an unseen rotation; only the "
        "misalignment towards z of a part turned in the xy plane is left, and a turn in another plane "
        "shows it."
    )
    remedy = "repeat the session in another plane"
    correctable = True
    in_base = True
    coefficient = Parameter("misalignment", "deg", -5.0, 5.0, 0.25)

    def basis(self, own_mg: Floats, across_mg: Floats, conditions: Conditions) -> Floats:
        """Reading across, per degree."""
        return np.deg2rad(across_mg)


class CrossAxis(CrossEffect):
    """Cross coupling K_ip: the sensitivity of an axis depends on the acceleration across it.

    The linear part of cross-axis sensitivity is `misalignment`: in every session it lies in the span of the
    base model, so that a second name for it could never be found. What makes cross-axis response visible is
    the product a_i a_p, which gives sin 2t in a tumble.
    """

    name = "cross_axis"
    covariates = ("reading",)
    cause = "Acceleration across an axis deflects its proof mass and so changes its sensitivity (K_ip)."
    formula = "a_i += kip_ip · (a_i/1000)(a_p/1000)"
    separated_by = (
        "Second harmonic sin 2t of an axis, as `stage_eccentricity` gives on both axes in a fixed "
        "proportion: remount the part by 180°, the stage's term changes its sign and the sensor's stays."
    )
    remedy = ONE_TURN
    correctable = True
    shown_over = "angle"
    coefficient = Parameter("kip", "mg/g²", -100.0, 100.0, 1.0)

    def basis(self, own_mg: Floats, across_mg: Floats, conditions: Conditions) -> Floats:
        """Product of the two readings in g²."""
        return own_mg * across_mg / MG_PER_G**2


class Quadratic(LinearAxisEffect):
    """K2: mg at 1 g along the axis."""

    name = "quadratic"
    covariates = ("reading",)
    cause = "The response of an axis is curved: the same change for +1 g and for −1 g (K2)."
    formula = "a_i += k2_i · (a_i/1000)²"
    separated_by = (
        "In one plane at 1 g, a_i² = 1 − a_p²: with a bias in the model it equals `cross_quadratic` of "
        "opposite sign until positions leave the plane; it resembles `asymmetry` (which has a fourth "
        "harmonic: at least 9 positions) and `stage_eccentricity` (remount by 180°)."
    )
    remedy = _OUT_OF_PLANE
    remedy_in_space = _OBLIQUE
    correctable = True
    prior = "curvature"
    coefficients = (Parameter("k2", "mg/g²", -100.0, 100.0, 1.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Square of the reading in g²."""
        return ((ideal[:, axis] / MG_PER_G) ** 2,)


class Cubic(LinearAxisEffect):
    """K3: mg at 1 g along the axis."""

    name = "cubic"
    covariates = ("reading",)
    cause = "The sensitivity of an axis changes alike towards both ends of its range (K3)."
    formula = "a_i += k3_i · (a_i/1000)³"
    separated_by = (
        "Third harmonic cos 3t of an axis (at least 7 positions); `stage_ellipticity` has it too, on both "
        "axes together, and changes its sign when the part is remounted by 90°."
    )
    remedy = "remount the part turned by 90° and repeat some angles"
    remedy_in_space = _OBLIQUE
    correctable = True
    coefficients = (Parameter("k3", "mg/g³", -100.0, 100.0, 0.7),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Cube of the reading in g³."""
        return ((ideal[:, axis] / MG_PER_G) ** 3,)


class Asymmetry(LinearAxisEffect):
    """Gain 1 + A/1000 for positive readings, 1 − A/1000 for negative ones."""

    name = "asymmetry"
    covariates = ("reading",)
    cause = "The gain of an axis differs between positive and negative acceleration."
    formula = "a_i += asymmetry_i · |a_i|/1000"
    separated_by = (
        "All even harmonics, 2/π and 4/(3π) cos 2t first, so that few positions take it for `quadratic`; "
        "readings near zero, where |a| has its kink and a² is flat, tell them apart."
    )
    remedy = "add angles where an axis reads near zero, five degrees apart"
    remedy_in_space = _OBLIQUE
    correctable = True
    coefficients = (Parameter("asymmetry", "mg/g", -100.0, 100.0, 1.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Modulus of the reading in g."""
        return (np.abs(ideal[:, axis]) / MG_PER_G,)


class CrossQuadratic(CrossEffect):
    """K_pp: mg at 1 g across the axis."""

    name = "cross_quadratic"
    covariates = ("reading",)
    cause = "Acceleration across an axis shifts its zero by its square (K_pp)."
    formula = "a_i += kpp_ip · (a_p/1000)²"
    separated_by = (
        "In one plane at 1 g, a_p² = 1 − a_i²: with a bias in the model it equals `quadratic` of opposite "
        "sign; positions out of the plane, where a_i and a_p vary apart, separate them."
    )
    remedy = _OUT_OF_PLANE
    remedy_in_space = _OBLIQUE
    correctable = True
    shown_over = "angle"
    coefficient = Parameter("kpp", "mg/g²", -100.0, 100.0, 1.0)

    def basis(self, own_mg: Floats, across_mg: Floats, conditions: Conditions) -> Floats:
        """Square of the reading across in g²."""
        return (across_mg / MG_PER_G) ** 2


class VibrationRectification(LinearAxisEffect):
    """The mean follows the variance of the dwell."""

    name = "vibration_rectification"
    cause = "An even nonlinearity turns vibration into a shift of the mean."
    formula = "a_i += vre_i · var_i/1000²"
    separated_by = (
        "Only dwells of different vibration show it (mean against variance within the dwells); with equal "
        "variance everywhere it is a `bias`: repeat a position with a source of vibration on and off."
    )
    remedy = "repeat one position with a source of vibration on, and off"
    not_corrected = "follows the variance of many samples, which a single reading does not show"
    needs = ("variance_mg2",)
    coefficients = (Parameter("vre", "mg/g²", -5000.0, 5000.0, 10.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Variance in g²."""
        return (conditions.covariate("variance_mg2")[:, axis] / MG_PER_G**2,)
