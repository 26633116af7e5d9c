"""Effects of the gyros: terms of a reading in addition to the true rate and a constant zero rate.

Readings are in °/s, forces are the readings of the accelerometers in g, Ω are the true rates of turn about
the axes of the accelerometers. Typical sizes are estimates, except two from the data sheet of the
ADIS16350: a g-sensitivity of 0.05 °/s/g and a supply sensitivity of 0.25 °/s/V.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from adis_gonio.base.arrays import Floats, unit_directions
from adis_gonio.model.effects.base import (
    AXES,
    CYCLE,
    AxisEffect,
    Conditions,
    LinearAxisEffect,
    Parameter,
)
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, BiasTemperature, SupplyBias, WarmUp
from adis_gonio.model.effects.stage_terms import OutlierDwell

_OTHER_ORDER = "repeat the first poses last, or all in another order: a drift goes on, a force comes back"
WHOLE_TURNS = "turn the part by whole turns about each axis, to both sides (plan gyro-turns)"


class OfGyro:
    """Mixin of the effects that act on the readings of the gyros."""

    parts: ClassVar[tuple[str, ...]] = ("gyro",)


@dataclass(frozen=True)
class GyroBiasTemperature(OfGyro, BiasTemperature):
    """The zero rate follows the temperature: a polynomial of degree 1 to 3 in T − 25 °C.

    T is the temperature of the gyro's own die if all three dies were recorded, else the mean temperature.

    Formula: ω_i += gyro_bias_temperature_i · ΔT + …2_i · ΔT² + …3_i · ΔT³ to `degree`, ΔT = T_i − 25 °C

    Separated by: If the temperature only rises it looks like `gyro_drift` or `gyro_warm_up`: let it fall
    again. `gyro_scale_temperature` shows in turns alone.

    Attributes
    ----------
    degree : int
        Highest power, 1 to 3.
    """

    cause = "The zero rate of a gyro moves with the temperature of its die."
    remedy = CYCLE
    coefficients = (
        Parameter("gyro_bias_temperature", "dps/°C", -1.0, 1.0, 0.02),
        Parameter("gyro_bias_temperature2", "dps/°C²", -0.05, 0.05, 0.0005),
        Parameter("gyro_bias_temperature3", "dps/°C³", -0.0025, 0.0025, 0.00001),
    )


@dataclass(frozen=True)
class GSensitivity(OfGyro, LinearAxisEffect):
    """Force along each of the three axes shifts the zero rate: nine coefficients of three gyros.

    Formula: ω_i += g_sensitivity_ix · f_x + g_sensitivity_iy · f_y + g_sensitivity_iz · f_z

    Separated by: If each pose is visited once, a change with the force may equal a change with time: repeat
    the first poses last. `g2_sensitivity` does not change its sign with the force.

    Attributes
    ----------
    force : int
        0: the force along all three axes acts; 1, 2, 3: only the force along x, y, z. With one axis the
        effect has one coefficient for each gyro, as many as a drift. The trace can then compare it with a
        drift, which it resembles if the force changes steadily from pose to pose.
    """

    force: int = 0

    cause = "Acceleration bends the vibrating structure of a gyro, which reads it as a rate of turn."
    remedy = _OTHER_ORDER
    prior = "force"
    needs = ("force_g",)
    options: ClassVar[dict[str, tuple[int, ...]]] = {"force": (0, 1, 2, 3)}
    coefficients = (Parameter("g_sensitivity", "dps/g", -2.0, 2.0, 0.05),)

    @property
    def _along(self) -> list[int]:
        return [self.force - 1] if self.force else [0, 1, 2]

    def letters(self) -> tuple[str, ...]:
        """Return both letters of each gyro and force axis, the gyro's letter first."""
        return tuple(own + AXES[k] for own in self.axes for k in self._along)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the components (n,) of the force in g along the axes that the choice `force` selects."""
        return tuple(conditions.covariate("force_g")[:, self._along].T)


@dataclass(frozen=True)
class G2Sensitivity(OfGyro, LinearAxisEffect):
    """The squared force along one axis shifts the zero rate.

    At rest the squares of the three components of the force add up to 1 g² and cannot all be distinguished
    from the zero rate. An effect therefore has only one axis of the force.

    Formula: ω_i += g2_sensitivity_ij · f_j², j the axis `force`

    Separated by: At rest the three squares add up to 1 g², so one square looks like minus the sum of the
    two others: use poses between the axes, or vibration.

    Attributes
    ----------
    force : int
        Axis of the force, 0 to 2 for x to z.
    """

    force: int = 2

    cause = (
        "The zero rate of a gyro moves with the square of a force, alike for both signs (rectification)."
    )
    remedy = "point two axes at once along gravity (±0.7 g), and repeat the first poses last"
    needs = ("force_g",)
    options: ClassVar[dict[str, tuple[int, ...]]] = {"force": (0, 1, 2)}
    coefficients = (Parameter("g2_sensitivity", "dps/g²", -2.0, 2.0, 0.02),)

    def letters(self) -> tuple[str, ...]:
        """Return both letters for each gyro, the gyro's letter first and then the force's letter."""
        return tuple(axis + AXES[self.force] for axis in self.axes)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the square (n,) of the force component along the axis `force`, in g²."""
        return (conditions.covariate("force_g")[:, self.force] ** 2,)


class GyroScale(OfGyro, LinearAxisEffect):
    """The scale factor of a gyro has a relative error.

    A fit states `gyro_scale_i` = 1 + gyro_scale_error_i.

    Formula: ω_i += gyro_scale_error_i · Ω_i, Ω the true rate

    Separated by: Only turns show it: a whole turn about each axis in both senses. `gyro_scale_temperature`
    needs turns at two temperatures.
    """

    cause = "The sensitivity of a gyro differs from its nominal one."
    remedy = WHOLE_TURNS
    needs = ("rate_dps",)
    coefficients = (Parameter("gyro_scale_error", "1", -0.2, 0.2, 0.01),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the true rate of turn (n,) about the gyro's axis in °/s."""
        return (conditions.covariate("rate_dps")[:, axis],)


class GyroScaleTemperature(OfGyro, LinearAxisEffect):
    """The gain of a gyro changes in proportion to the temperature of its die.

    Formula: ω_i += gyro_scale_temperature_i · 10⁻⁶ · (T_i − 25 °C) · Ω_i

    Separated by: It shows in turns alone, `gyro_bias_temperature` also at rest: make the same turn at two
    temperatures.
    """

    cause = "The sensitivity of a gyro changes with the temperature of its die."
    remedy = "turn the part by whole turns at two temperatures, 10 °C apart"
    needs = ("rate_dps", "temperature_c")
    covariates = ("temperature",)
    coefficients = (Parameter("gyro_scale_temperature", "ppm/°C", -5000.0, 5000.0, 100.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the true rate times (T − 25 °C), (n,), scaled by 10⁻⁶ for a coefficient in ppm/°C."""
        above = conditions.die_c(axis) - REFERENCE_C
        return (1e-6 * above * conditions.covariate("rate_dps")[:, axis],)


class GyroMisalignment(OfGyro, AxisEffect):
    """The axis of a gyro is misaligned towards other axes; its direction remains a unit vector.

    With s_p the sine of the misalignment towards axis p the direction is (√(1 − Σ s_p²), s_p, …):
    1° reduces the gain by 1.5·10⁻⁴, which ten turns show.

    Formula: ω_i += Σ_p sin(gyro_misalignment_ip) · Ω_p − (1 − √(1 − Σ_p sin²)) · Ω_i

    Separated by: Only a turn about the axis towards which the gyro leans shows it: one whole turn about
    each of the three axes.
    """

    cause = "The axis of a gyro is misaligned towards another axis of the accelerometers by a small angle."
    remedy = WHOLE_TURNS
    needs = ("rate_dps",)
    coefficients = (Parameter("gyro_misalignment", "deg", -10.0, 10.0, 0.5),)

    def _pairs(self) -> list[tuple[int, int]]:
        own = [AXES.index(axis) for axis in self.axes]
        return [(i, p) for i in own for p in range(len(AXES)) if p != i]

    def letters(self) -> tuple[str, ...]:
        """Return both letters for each gyro and each of the other two axes, the gyro's letter first."""
        return tuple(AXES[i] + AXES[p] for i, p in self._pairs())

    def _directions(self, values: Floats) -> Floats:
        angles = np.zeros((3, 3))
        angles[tuple(np.transpose(self._pairs()))] = np.deg2rad(values)
        return unit_directions(np.sin(angles))

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the change of the gyro readings by the misalignments, (n, 3) in °/s."""
        rate, added = conditions.covariate("rate_dps"), np.zeros(ideal.shape)
        off = self._directions(values) - np.eye(3)
        for i in self.columns_of(ideal):
            for p in range(3):
                added[:, i] += off[i, p] * rate[:, p]
        return added

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative of the gyro readings by the angles, (n, 3, p) in °/s per degree."""
        rate, axes = conditions.covariate("rate_dps"), self._directions(values)
        design, cosines = np.zeros((*ideal.shape, len(values))), np.cos(np.deg2rad(values))
        for k, (i, p) in enumerate(self._pairs()):
            slope = rate[:, p] - axes[i, p] / axes[i, i] * rate[:, i]
            design[:, i, k] = np.deg2rad(cosines[k] * slope)
        return design


@dataclass(frozen=True)
class GyroDrift(OfGyro, LinearAxisEffect):
    """The zero rate changes evenly, with time or from dwell to dwell.

    Formula: ω_i += gyro_drift_i · t/60, or gyro_step_i · number of the dwell (`steps` 1)

    Separated by: If each pose is visited once, a change with time may equal a change with the force: repeat
    the first poses last. For `gyro_bias_temperature` let the temperature fall.

    Attributes
    ----------
    steps : int
        0: in proportion to time; 1: by an equal step from each dwell to the next, however long it takes,
        as by handling.
    """

    steps: int = 0

    cause = "The zero rate of a gyro moves evenly with time, or from one handling of the part to the next."
    remedy = _OTHER_ORDER
    not_corrected = "follows the clock of the session; the zero rate applies to its start"
    covariates = ("time",)
    options: ClassVar[dict[str, tuple[int, ...]]] = {"steps": (0, 1)}
    coefficients = (
        Parameter("gyro_drift", "dps/min", -5.0, 5.0, 0.005),
        Parameter("gyro_step", "dps/dwell", -2.0, 2.0, 0.01),
    )

    def active(self) -> tuple[Parameter, ...]:
        """Return the coefficient in use: drift per minute, or per dwell if `steps` is 1."""
        return (self.coefficients[self.steps],)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the minutes (n,) since the session's start; the dwells' numbers if `steps` is 1."""
        return (conditions.covariate("order") if self.steps else conditions.time_s / 60.0,)


class GyroWarmUp(OfGyro, WarmUp):
    """The zero rate settles exponentially after power-on.

    Formula: ω_i += gyro_warm_up_i · exp(−t/τ), t from the session's start

    Separated by: In a session shorter than τ it looks like `gyro_drift`, and if the temperature is recorded
    like `gyro_bias_temperature`: switch off and on within the session.
    """

    cause = "The zero rate of a gyro settles while the part heats itself after power-on."
    remedy = "switch the sensor off, let it cool, and repeat a few poses after switching on"
    not_corrected = "follows the clock of the session; the zero rate applies to the warm part"
    coefficients = (Parameter("gyro_warm_up", "dps", -10.0, 10.0, 0.2),)


class GyroSupply(OfGyro, SupplyBias):
    """The zero rate changes in proportion to the supply voltage.

    Formula: ω_i += gyro_supply_i · (V − 5 V)

    Separated by: A supply that sinks while the part warms looks like `gyro_bias_temperature` or
    `gyro_drift`: change the supply by hand in one pose.
    """

    cause = "The zero rate of a gyro moves with the supply voltage."
    remedy = "change the supply by hand in one pose, such as from 4.8 to 5.2 V"
    coefficients = (Parameter("gyro_supply", "dps/V", -10.0, 10.0, 0.25),)


class GyroAsymmetry(OfGyro, LinearAxisEffect):
    """The scale factor of a gyro is 1 + A for positive rates of turn, 1 − A for negative rates.

    Formula: ω_i += gyro_asymmetry_i · |Ω_i|

    Separated by: Turns in one sense alone show it as a gain (`gyro_scale`): turn in both senses.
    """

    cause = "The gain of a gyro differs between the two senses of turning."
    remedy = "turn the part by as many whole turns to the one side as to the other"
    not_corrected = "differs between the two senses of turning, which no gain corrects"
    needs = ("rate_dps",)
    coefficients = (Parameter("gyro_asymmetry", "1", -0.1, 0.1, 0.001),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the absolute value (n,) of the true rate of turn about the gyro's axis in °/s."""
        rate = conditions.covariate("rate_dps")
        modulus = np.abs(rate) if conditions.abs_rate_dps is None else conditions.abs_rate_dps
        return (modulus[:, axis],)


class GyroOutlierDwell(OfGyro, OutlierDwell):
    """The gyro readings of one dwell deviate by any amount; the catalogue's `outlier_dwell` for gyros."""

    coefficients = (Parameter("offset", "dps", -300.0, 300.0, 0.1),)
