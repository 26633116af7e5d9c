"""Effects of the sensor and its surroundings: response, temperature, supply, time, local gravity.

The static terms have the order of the model equation of IEEE Std 1293: E/K1 = K0 + a_i + K2 a_i² + K3 a_i³
+ K_ip a_i a_p + K_pp a_p² + δ a_p. All typical sizes are estimates. The data sheet of the ADIS16350 gives
non-orthogonality ±0.25° and nonlinearity ±0.2 % of full scale (3.4 mg at 1.7 g, hence K3 ≈ 0.7 mg/g³).
Estimates for the ADIS16354: 0.5 mg/°C and 40 ppm/°C like the ADIS16355; self-heating of a few degrees
with a time constant of minutes; a gain that changes with the supply a hundred times less than the gain of a
fully ratiometric sensor (which changes by 200 000 ppm/V at 5 V); a drift of the gain that changes a reading
of 1 g as much as the drift of the bias.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.model.effects.base import (
    CYCLE,
    MEMORY,
    ONE_TURN,
    Conditions,
    CourseEffect,
    CrossEffect,
    Effect,
    LinearAxisEffect,
    Parameter,
    decay,
)
from adis_gonio.model.records import MG_PER_G

_OUT_OF_PLANE = "repeat the session with the part on its side, so that gravity leaves the plane"
_OBLIQUE = (
    "point each axis 45° and 60° off the vertical, up and down (readings of ±0.7 and ±0.5 g), and repeat a "
    "few of the first poses last"
)


class Bias(LinearAxisEffect):
    """The reading has a constant error: the term K0 of the usual accelerometer model.

    Formula: a_i += bias_i

    Separated by: Opposite positions (0° and 180°) show it; 0° and 90° alone do not. An even nonlinearity
    adds to it in one plane: use positions out of the plane.
    """

    cause = "An axis does not read zero without acceleration along it."
    remedy = "repeat a few positions on another day or at another temperature"
    in_base = True
    prior = "constant"
    shown_over = "angle"
    covariates = ()
    coefficients = (Parameter("bias", "mg", -1000.0, 1000.0, 10.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the constant basis function: ones, (n,)."""
        return (np.ones(len(ideal)),)


class Scale(LinearAxisEffect):
    """The gain has a relative error; in every fit of this package it is a base parameter.

    Formula: a_i += scale_i · a_i

    Separated by: It is the gain of every model. `gravity` changes all gains alike; `cubic` also has a third
    harmonic.
    """

    covariates = ("reading",)
    cause = "The sensitivity of an axis differs from its nominal one."
    remedy = "enter the local gravity by --gravity"
    in_base = True
    coefficients = (Parameter("scale", "1", -0.1, 0.1, 0.001),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the ideal reading (n,) of the axis in mg."""
        return (ideal[:, axis],)


class Misalignment(CrossEffect):
    """An axis is misaligned towards another one: the linear part of its cross-axis sensitivity.

    In the plane the four linear terms (two gains, two misalignments) are the base parameters K_x, K_y, α
    and Δφ; in space with free attitudes six of the nine linear terms are gains and skews, and the other
    three are a rotation, which gravity cannot show. A fit therefore finds this effect in the base
    parameters.

    Formula: a_i += misalignment_ip · a_p (angle in radians)

    Separated by: The base model has it as α, Δφ or skews, except the misalignment towards z in the xy
    plane: turn in another plane.
    """

    cause = "The sensitive direction of an axis is misaligned towards another axis by a small angle."
    remedy = "repeat the session in another plane"
    in_base = True
    coefficients = (Parameter("misalignment", "deg", -5.0, 5.0, 0.25),)

    def basis(self, own_mg: Floats, across_mg: Floats, conditions: Conditions) -> Floats:
        """Return the ideal reading (n,) of the other axis, times π/180, for a coefficient in degrees."""
        return np.deg2rad(across_mg)


class CrossAxis(CrossEffect):
    """The sensitivity of an axis depends on the acceleration across it, by the coefficient K_ip.

    The linear part of cross-axis sensitivity is `misalignment`, which the base model contains in every
    session. The remaining part of the cross-axis response is the product a_i a_p, which gives sin 2t in a
    tumble with the angle t.

    Formula: a_i += kip_ip · (a_i/1000)(a_p/1000)

    Separated by: `stage_eccentricity` has the same harmonic sin 2t on both axes: remount the part by 180°,
    and only the stage's term changes its sign.
    """

    cause = "Acceleration across an axis deflects its proof mass and so changes its sensitivity (K_ip)."
    remedy = ONE_TURN
    shown_over = "angle"
    coefficients = (Parameter("kip", "mg/g²", -100.0, 100.0, 1.0),)

    def basis(self, own_mg: Floats, across_mg: Floats, conditions: Conditions) -> Floats:
        """Return the product (n,) of the ideal readings of the affected and the other axis, in g²."""
        return own_mg * across_mg / MG_PER_G**2


class Quadratic(LinearAxisEffect):
    """The response has a quadratic nonlinearity: K2 is the error in mg at 1 g along the axis.

    Formula: a_i += k2_i · (a_i/1000)²

    Separated by: In one plane it equals `cross_quadratic` of opposite sign plus a bias: use positions out
    of the plane. `asymmetry` also has a fourth harmonic, which 9 positions show; for `stage_eccentricity`
    remount the part by 180°.
    """

    covariates = ("reading",)
    cause = "The response of an axis is curved: the same change for +1 g and for −1 g (K2)."
    remedy = _OUT_OF_PLANE
    remedy_in_space = _OBLIQUE
    prior = "curvature"
    coefficients = (Parameter("k2", "mg/g²", -100.0, 100.0, 1.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the square (n,) of the axis' ideal reading, in g²."""
        return ((ideal[:, axis] / MG_PER_G) ** 2,)


class Cubic(LinearAxisEffect):
    """The response has a cubic nonlinearity: coefficient K3 is the error in mg at 1 g along the axis.

    Formula: a_i += k3_i · (a_i/1000)³

    Separated by: It has a third harmonic, which 7 positions show. `stage_ellipticity` has it on both axes:
    remount by 90°, and only the stage's term changes its sign.
    """

    covariates = ("reading",)
    cause = "The sensitivity of an axis changes alike towards both ends of its range (K3)."
    remedy = "remount the part turned by 90° and repeat some angles"
    remedy_in_space = _OBLIQUE
    coefficients = (Parameter("k3", "mg/g³", -100.0, 100.0, 0.7),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the cube (n,) of the axis' ideal reading, in g³."""
        return ((ideal[:, axis] / MG_PER_G) ** 3,)


class Asymmetry(LinearAxisEffect):
    """The scale factor is 1 + A/1000 for positive readings, 1 − A/1000 for negative readings, A in mg/g.

    Formula: a_i += asymmetry_i · |a_i|/1000

    Separated by: With few positions it looks like `quadratic`: add readings near zero, where |a| has its
    kink.
    """

    covariates = ("reading",)
    cause = "The gain of an axis differs between positive and negative acceleration."
    remedy = "add angles with readings of an axis near zero, five degrees apart"
    remedy_in_space = _OBLIQUE
    coefficients = (Parameter("asymmetry", "mg/g", -100.0, 100.0, 1.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the absolute value (n,) of the axis' ideal reading, in g."""
        return (np.abs(ideal[:, axis]) / MG_PER_G,)


class CrossQuadratic(CrossEffect):
    """The squared acceleration across an axis shifts its bias, by K_pp in mg at 1 g.

    Formula: a_i += kpp_ip · (a_p/1000)²

    Separated by: In one plane it equals `quadratic` of opposite sign plus a bias: use positions out of the
    plane.
    """

    cause = "Acceleration across an axis shifts its bias by its square (K_pp)."
    remedy = _OUT_OF_PLANE
    remedy_in_space = _OBLIQUE
    shown_over = "angle"
    coefficients = (Parameter("kpp", "mg/g²", -100.0, 100.0, 1.0),)

    def basis(self, own_mg: Floats, across_mg: Floats, conditions: Conditions) -> Floats:
        """Return the square (n,) of the ideal reading of the other axis, in g²."""
        return (across_mg / MG_PER_G) ** 2


class VibrationRectification(LinearAxisEffect):
    """The mean reading shifts in proportion to the vibration (variance of the samples) during the dwell.

    Formula: a_i += vre_i · var_i/1000²

    Separated by: With equal vibration in all dwells it is a `bias`: repeat a position with a source of
    vibration on and off.
    """

    cause = "An even nonlinearity turns vibration into a shift of the mean."
    remedy = "repeat one position with a source of vibration on, and off"
    not_corrected = "follows the variance of many samples, which a single reading does not show"
    needs = ("variance_mg2",)
    coefficients = (Parameter("vre", "mg/g²", -5000.0, 5000.0, 10.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the variance (n,) of the samples within each dwell (vibration along the axis), in g²."""
        return (conditions.covariate("variance_mg2")[:, axis] / MG_PER_G**2,)


REFERENCE_C = 25.0
"""Temperature in °C at which temperature effects are zero; the chip's temperature word is 0 there."""
REFERENCE_V = 5.0
"""Supply in V at which supply effects are zero: the nominal supply."""


@dataclass(frozen=True)
class BiasTemperature(LinearAxisEffect):
    """The bias follows the temperature: a polynomial of degree 1 to 3 in T − 25 °C, by default a line.

    Formula: a_i += tempco_i · ΔT + tempco2_i · ΔT² + tempco3_i · ΔT³ up to `degree`, ΔT = T − 25 °C

    Separated by: If the temperature only rises it looks like `bias_drift` or `warm_up`: let it fall again.
    `scale_temperature` grows with the reading.

    Attributes
    ----------
    degree : int
        Highest power, 1 to 3.
    """

    degree: int = 1

    cause = "The bias of an axis changes with the temperature of the die."
    remedy = CYCLE
    needs = ("temperature_c",)
    coefficients = (
        Parameter("tempco", "mg/°C", -20.0, 20.0, 0.5),
        Parameter("tempco2", "mg/°C²", -1.0, 1.0, 0.01),
        Parameter("tempco3", "mg/°C³", -0.05, 0.05, 0.0001),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.degree <= len(self.coefficients):
            raise UsageError(f"{self.name}: degree is {self.degree}, it can be 1, 2 or 3")

    def active(self) -> tuple[Parameter, ...]:
        """Return the coefficients of the powers 1 to `degree`, without the axis letter."""
        return self.coefficients[: self.degree]

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the powers 1 to `degree` of the temperature above 25 °C, each (n,)."""
        above = conditions.die_c(axis) - REFERENCE_C
        return tuple(above**power for power in range(1, self.degree + 1))


class ScaleTemperature(LinearAxisEffect):
    """The gain changes in proportion to the temperature.

    Formula: a_i += scale_tempco_i · 10⁻⁶ · (T − 25 °C) · a_i

    Separated by: `bias_temperature` does not change its sign with the reading: measure +1 g and −1 g at the
    same temperatures. For `scale_drift` let the temperature rise and fall.
    """

    cause = "The sensitivity of an axis changes with the temperature of the die."
    remedy = CYCLE
    needs = ("temperature_c",)
    coefficients = (Parameter("scale_tempco", "ppm/°C", -2000.0, 2000.0, 40.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the ideal reading times (T − 25 °C), (n,), scaled by 10⁻⁶ for a coefficient in ppm/°C."""
        return (1e-6 * (conditions.covariate("temperature_c") - REFERENCE_C) * ideal[:, axis],)


class MisalignmentTemperature(CrossEffect):
    """The direction of an axis follows the temperature of the die.

    In the plane, misalignments of x and y together equal a misalignment of one axis and a turn of the whole
    part, which its mount may cause. A candidate of the trace therefore has one misaligned axis; if both are
    misaligned, the trace adds two candidates.

    Formula: a_i += misalignment_tempco_ip · (T − 25 °C) · a_p (angle in radians)

    Separated by: `scale_temperature` shows if the axis is along gravity, this effect if it is across:
    measure several angles at two temperatures.
    """

    cause = "The misalignment of an axis changes with the temperature of the die."
    remedy = CYCLE
    needs = ("temperature_c",)
    one_axis = True
    coefficients = (Parameter("misalignment_tempco", "deg/°C", -0.1, 0.1, 0.002),)

    def basis(self, own_mg: Floats, across_mg: Floats, conditions: Conditions) -> Floats:
        """Return the ideal reading of the other axis times (T − 25 °C), (n,), for a coefficient in °/°C."""
        return np.deg2rad(across_mg * (conditions.covariate("temperature_c") - REFERENCE_C))


class ThermalLag(CourseEffect):
    """The bias follows the temperature of an element that warms later than the thermometer.

    With τ dT_lag/dt = T − T_lag and T_lag = T at the first record of the session, the term is
    lag_i (T_lag − T). It is zero at constant temperature, so that it does not compete with
    `bias_temperature`; a bias that follows only T_lag has lag_i = tempco_i.

    Formula: a_i += lag_i · (T_lag − T), τ dT_lag/dt = T − T_lag

    Separated by: `bias_temperature` is equal on the way up and down: heat and cool at different rates
    through the same temperature.
    """

    cause = "The element that shifts the bias warms later than the die with the thermometer."
    remedy = "heat and let cool at different speeds, with a dwell every few minutes"
    not_corrected = MEMORY
    shown_over = "temperature_lag"
    needs = ("temperature_c", "temperature_history")
    coefficients = (Parameter("lag", "mg/°C", -50.0, 50.0, 0.5),)
    common = (Parameter("tau", "s", 1.0, 36000.0, 300.0, shape=True),)

    def course(self, shape: float, conditions: Conditions) -> tuple[Floats, Floats]:
        """Return the lagged minus the present temperature (n,) in °C, and its derivative by τ in °C/s."""
        late, by_tau = conditions.late("temperature_history", None, shape)
        return late - conditions.covariate("temperature_c"), by_tau


class SupplyBias(LinearAxisEffect):
    """The bias changes in proportion to the supply voltage.

    Formula: a_i += supply_i · (V − 5 V)

    Separated by: A supply that sinks while the part warms looks like `bias_temperature` or `bias_drift`:
    change the supply by hand at one position.
    """

    cause = "The bias of an axis changes with the supply voltage."
    remedy = "change the supply by hand at one position, such as from 4.8 to 5.2 V"
    needs = ("supply_v",)
    coefficients = (Parameter("supply", "mg/V", -500.0, 500.0, 5.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the supply voltage minus 5 V, (n,) in V."""
        return (conditions.covariate("supply_v") - REFERENCE_V,)


class SupplyScale(LinearAxisEffect):
    """The gain changes in proportion to the supply voltage.

    Formula: a_i += supply_scale_i · 10⁻⁶ · (V − 5 V) · a_i

    Separated by: `supply_bias` does not change its sign with the reading: measure +1 g and −1 g at the same
    voltages, changed by hand.
    """

    cause = "The sensitivity of an axis changes with the supply voltage."
    remedy = "change the supply by hand at +1 g and at −1 g, such as from 4.8 to 5.2 V"
    needs = ("supply_v",)
    coefficients = (Parameter("supply_scale", "ppm/V", -500000.0, 500000.0, 2000.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the ideal reading times (supply − 5 V), (n,), scaled by 10⁻⁶ for ppm/V."""
        return (1e-6 * (conditions.covariate("supply_v") - REFERENCE_V) * ideal[:, axis],)


class BiasDrift(LinearAxisEffect):
    """The bias changes evenly with time.

    Formula: a_i += drift_i · t/60, t from the session's start

    Separated by: If each position is visited once, a change with time may equal a change with the angle:
    repeat positions in another order. For `bias_temperature` let the temperature fall; for `warm_up`
    measure longer.
    """

    cause = "The bias of an axis changes evenly with time (ageing, relaxing stress, creep of the mount)."
    remedy = "repeat some positions in another order, and once more after a break"
    covariates = ("time",)
    coefficients = (Parameter("drift", "mg/min", -50.0, 50.0, 0.05),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the time (n,) since the start of the session, in minutes."""
        return (conditions.time_s / 60.0,)


class ScaleDrift(LinearAxisEffect):
    """The gain changes evenly with time.

    Formula: a_i += scale_drift_i · 10⁻⁶ · t/60 · a_i, t from the session's start

    Separated by: `bias_drift` does not change its sign with the reading: measure +1 g and −1 g early and
    late. For `scale_temperature` let the temperature rise and fall.
    """

    cause = "The sensitivity of an axis moves evenly with time (ageing, a reference that drifts)."
    remedy = "repeat +1 g and −1 g of an axis early and late, and once more after a break"
    not_corrected = "follows the clock of the session; the gain applies to its start"
    covariates = ("time",)
    coefficients = (Parameter("scale_drift", "ppm/min", -50000.0, 50000.0, 50.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the ideal reading times minutes since the start, (n,), scaled by 10⁻⁶ for ppm/min."""
        return (1e-6 * conditions.time_s / 60.0 * ideal[:, axis],)


class WarmUp(CourseEffect):
    """The bias settles exponentially after power-on.

    Formula: a_i += warm_up_i · exp(−t/τ), t from the session's start

    Separated by: In a session shorter than τ it looks like `bias_drift`. If the temperature is recorded, it
    can also look like `bias_temperature`. A second session after a cold start tells them apart.
    """

    cause = "The bias of an axis settles while the part heats itself after power-on."
    remedy = "switch the sensor off, let it cool, and repeat a few positions after switching on"
    not_corrected = "follows the clock of the session; the bias applies to the warm part"
    covariates = ("time",)
    coefficients = (Parameter("warm_up", "mg", -200.0, 200.0, 2.0),)
    common = (Parameter("tau", "s", 1.0, 36000.0, 300.0, shape=True),)

    def course(self, shape: float, conditions: Conditions) -> tuple[Floats, Floats]:
        """Return the decay exp(−t/τ) since the session's start, (n,), and its derivative by τ."""
        return decay(conditions.time_s, shape)


class Gravity(Effect):
    """All axes have one relative error, because local gravity differs from the declared gravity.

    With g the local gravity and g′ the declared gravity of the session, the readings are (g/g′) times the
    ideal ones: `gravity` = g/g′ − 1. On the Earth's surface g lies between 9.764 and 9.834 m/s².

    Formula: a_i += gravity · a_i on every axis

    Separated by: It equals a common error of all gains; ΔK and Δφ do not depend on it. A measured g
    separates it from `scale`.
    """

    covariates = ("reading",)
    cause = "Local gravity differs from the declared gravity of the session."
    remedy = "enter the local gravity by --gravity"
    not_corrected = "belongs to the place: state its gravity; no angle depends on it"
    in_base = True
    by_axis = False
    parameters = (Parameter("gravity", "1", -0.01, 0.01, 0.001),)

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the change of the readings by the error of gravity, (n, axes) in mg."""
        return ideal * float(values[0])

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative of the readings by the error of gravity, (n, axes, 1) in mg."""
        return ideal[:, :, None].copy()
