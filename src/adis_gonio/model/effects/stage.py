"""Terms of the stage and of how a position was reached.

The stage's terms turn the part: they are angles, added to ψ = α − θ, and appear in a reading multiplied by
its tangential slope. Remount the part by an angle on the table, and compare readings at the same direction
of gravity in the part: the sensor's own terms are the same, a stage's term of n cycles a turn has advanced
by n times that angle. So one cycle changes its sign by a remounting of 180° (the reversal pair that tells
table from sensor), two cycles need 90°.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.model.effects.base import MEMORY, OF_DWELL, ONE_TURN, Conditions, Effect, Parameter
from adis_gonio.model.effects.families import (
    AxisEffect,
    LinearAxisEffect,
    StageEffect,
    by_letters,
)
from adis_gonio.model.records import MG_PER_G

BETWEEN = "measure at angles between those of this session"
_STAGE = "belongs to the stage, not to the sensor"
LEAST_CYCLES = 3
"""Fewest cycles a turn of `stage_periodic`: one and two have names of their own."""
_ROUNDING = 1e-9
"""Least size of a harmonic: less is the rounding of an angle."""
_SAME_PHASE = 1e-6
"""What a mean phase factor may lack of 1: a scatter of 1.4 mrad, which is what angles are rounded to."""


def alike(cycles: int, others: int, angle_rad: Floats) -> bool:
    """True where two numbers of cycles a turn are the same function at these angles, but for a phase.

    With the phase of e^{i(m ∓ n)θ} constant over the angles, m cycles are n cycles: they are an alias. A
    constant is 0 cycles.
    """
    return bool(of_one_phase(np.array([cycles - others, cycles + others]), angle_rad).any())


def of_one_phase(cycles: NDArray[np.int_], angle_rad: Floats) -> NDArray[np.bool_]:
    """Numbers of cycles a turn (m,) whose phase is the same at all of these angles."""
    length = np.abs(np.exp(1j * cycles[:, None] * angle_rad).mean(axis=1))
    return np.asarray(length > 1 - _SAME_PHASE)


class StageEccentricity(StageEffect):
    """One cycle a turn: e/R with e the eccentricity and R the radius of the divided circle."""

    name = "stage_eccentricity"
    cause = "The divided circle of the stage is not centred on its axis: one cycle a turn."
    formula = "ψ += ecc_sin · sin θ + ecc_cos · cos θ"
    separated_by = (
        "Gives mean and second harmonics on both axes together, like `quadratic`, `cross_axis` and "
        "`bias`: remount the part by 180°, the stage's term changes its sign and the sensor's stay."
    )
    remedy = ONE_TURN
    not_corrected = _STAGE
    needs = ("angle_rad",)
    coefficients = (
        Parameter("ecc_sin", "deg", -2.0, 2.0, 0.01),
        Parameter("ecc_cos", "deg", -2.0, 2.0, 0.01),
    )

    def basis(self, conditions: Conditions) -> tuple[Floats, ...]:
        """First harmonic of the declared angle."""
        angle = conditions.covariate("angle_rad")
        return np.sin(angle), np.cos(angle)


class StageEllipticity(StageEffect):
    """Two cycles a turn."""

    name = "stage_ellipticity"
    cause = "The divided circle of the stage is oval, or its bearing is: two cycles a turn."
    formula = "ψ += ell_sin · sin 2θ + ell_cos · cos 2θ"
    separated_by = (
        "Gives first and third harmonics on both axes together, like `scale`, Δφ and `cubic`: remount "
        "the part by 90° (180° does not help: two cycles), or compare the stage with a polygon."
    )
    remedy = "remount the part turned by 90° and repeat some angles"
    not_corrected = _STAGE
    needs = ("angle_rad",)
    coefficients = (
        Parameter("ell_sin", "deg", -2.0, 2.0, 0.01),
        Parameter("ell_cos", "deg", -2.0, 2.0, 0.01),
    )

    def basis(self, conditions: Conditions) -> tuple[Floats, ...]:
        """Second harmonic of the declared angle."""
        angle = conditions.covariate("angle_rad")
        return np.sin(2 * angle), np.cos(2 * angle)


@dataclass(frozen=True)
class StagePeriodic(StageEffect):
    """Any whole number of cycles a turn from three on.

    Attributes
    ----------
    cycles : int
        Cycles a turn; one is `stage_eccentricity`, two are `stage_ellipticity`.

    Notes
    -----
    At N equally spaced angles n cycles, N − n, N + n, … are the same column: a session shows n up to N/2,
    and what it finds may as well be any that folds to it (`alike`).
    """

    cycles: int = 3

    name = "stage_periodic"
    cause = "A worm, a gear or the division of the stage repeats its error a whole number of times a turn."
    formula = "ψ += per_sin · sin cycles·θ + per_cos · cos cycles·θ"
    separated_by = (
        "Gives harmonics cycles ± 1 on both axes together: `cubic` shares cos 3t with two and four cycles; "
        "remount the part by half a cycle, the stage's term changes its sign. Numbers of cycles that fold "
        "to the same at equally spaced angles: measure at angles between those of the session."
    )
    remedy = BETWEEN
    not_corrected = _STAGE
    needs = ("angle_rad",)
    coefficients = (
        Parameter("per_sin", "deg", -2.0, 2.0, 0.01),
        Parameter("per_cos", "deg", -2.0, 2.0, 0.01),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cycles < LEAST_CYCLES:
            raise UsageError(
                f"{self.name}: cycles is {self.cycles}, it can be {LEAST_CYCLES} or more; one cycle a turn "
                "is stage_eccentricity, two are stage_ellipticity"
            )

    def basis(self, conditions: Conditions) -> tuple[Floats, ...]:
        """Harmonic `cycles` of the declared angle."""
        turned = self.cycles * conditions.covariate("angle_rad")
        # At 2·cycles equally spaced angles one of the two is rounding and stands for nothing.
        waves = (np.sin(turned), np.cos(turned))
        return tuple(np.where(np.abs(wave) > _ROUNDING, wave, 0.0) for wave in waves)


class Backlash(StageEffect):
    """The play between the two directions of approach; half of it to either side."""

    name = "backlash"
    cause = "Play in the drive of the stage: the angle depends on the direction of approach."
    formula = "ψ += backlash · approach/2"
    separated_by = (
        "`hysteresis` shifts an axis alike at every angle, backlash only where its reading changes with "
        "the angle: approach several positions from both sides."
    )
    remedy = "approach several positions from both sides"
    not_corrected = _STAGE
    needs = ("approach",)
    coefficients = (Parameter("backlash", "deg", -5.0, 5.0, 0.02),)

    def basis(self, conditions: Conditions) -> tuple[Floats, ...]:
        """Half of the direction of approach."""
        return (0.5 * conditions.covariate("approach"),)


@dataclass(frozen=True)
class PositionSlip(StageEffect):
    """One dwell stands elsewhere than declared.

    Attributes
    ----------
    dwell : int
        Number of the dwell in the order of recording, from 0.
    """

    dwell: int = 1

    name = "position_slip"
    cause = "One position was not where it was declared: the part or the stage slipped, or was misread."
    formula = "ψ += slip in dwell `dwell`"
    separated_by = (
        "Readings of all axes move along the circle; `outlier_dwell` moves them in any direction, so that "
        "the modulus changes: repeat the position."
    )
    remedy = "repeat the position"
    not_corrected = OF_DWELL
    needs = ("order",)
    coefficients = (Parameter("slip", "deg", -190.0, 190.0, 0.1),)

    def basis(self, conditions: Conditions) -> tuple[Floats, ...]:
        """One in the dwell, zero elsewhere."""
        return ((conditions.covariate("order") == self.dwell).astype(float),)


class Hysteresis(LinearAxisEffect):
    """The zero depends on the direction of approach; half of the loop's width to either side."""

    name = "hysteresis"
    cause = "Stress of the last move stays in the sensor or its mount and shifts the zero of an axis."
    formula = "a_i += hysteresis_i · approach/2"
    separated_by = (
        "`backlash` turns the part and so moves a reading only where it changes with the angle: approach "
        "several positions from both sides; with one direction throughout it is a `bias`."
    )
    remedy = "approach several positions from both sides"
    not_corrected = MEMORY
    needs = ("approach",)
    coefficients = (Parameter("hysteresis", "mg", -200.0, 200.0, 0.5),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Half of the direction of approach."""
        return (0.5 * conditions.covariate("approach"),)


class Creep(AxisEffect):
    """The axis answers to a part of its load late, and so goes on creeping after each change of the load.

    With τ da_late/dt = a − a_late, and a_late = a where the session begins, the term is
    creep_i (a_late − a) per g: right after a change of the load by Δa it lacks creep·Δa, and what it lacks
    decays with τ. It is zero where the load has rested, so that it does not compete with the gain. A gain
    that changes with the load itself is `quadratic` or `cubic`; a gain that drifts *after* loading is this.
    `settling` is the same for every dwell and over within it; `hysteresis` knows the direction of the last
    move only.
    """

    name = "creep"
    cause = "The spring or the mount of an axis goes on yielding after the load on it has changed."
    formula = "a_i += creep_i · (a_late,i − a_i)/1000, τ da_late,i/dt = a_i − a_late,i"
    separated_by = (
        "It follows the loads of all dwells before, in proportion: turn by 180°, repeat the position for "
        "several τ, and turn back. `settling` begins anew with every dwell, `bias_drift` and `warm_up` do "
        "not ask where the part has been, `hysteresis` does not decay."
    )
    remedy = "turn by 180°, dwell there for several time constants, and turn back"
    not_corrected = MEMORY
    needs = ("load_history",)
    covariates = ("previous_angle",)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The amplitudes, then the time constant."""
        return (
            *by_letters((Parameter("creep", "mg/g", -100.0, 100.0, 1.0),), self.axes),
            Parameter("tau", "s", 1.0, 36000.0, 120.0, shape=True),
        )

    def _course(self, column: int, tau_s: float, own_mg: Floats, c: Conditions) -> tuple[Floats, Floats]:
        """(a_late − a)/1000 of a column and its derivative by τ, (n,) each."""
        late, by_tau = c.late_load(column, tau_s)
        return (late - own_mg) / MG_PER_G, by_tau / MG_PER_G

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """What the axes still lack, (n, axes) in mg."""
        added = np.zeros(ideal.shape)
        for value, column in zip(values[:-1], self.columns_of(ideal), strict=True):
            course, _ = self._course(column, float(values[-1]), ideal[:, column], conditions)
            added[:, column] = value * course
        return added

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Derivative (n, axes, p): the course by the amplitudes, its slope by τ."""
        design = np.zeros((*ideal.shape, len(values)))
        for k, column in enumerate(self.columns_of(ideal)):
            course, slope = self._course(column, float(values[-1]), ideal[:, column], conditions)
            design[:, column, k] = course
            design[:, column, -1] = values[k] * slope
        return design


class AxisTilt(Effect):
    """The axis of rotation is out of the horizontal by ε.

    Gravity then has G cos ε in the plane of rotation and G sin ε along the axis of rotation. With ρ the
    modulus of the ideal in-plane reading and a_z the reading along the axis (zero in a planar session),

        a_xy becomes (a_xy/ρ)(ρ cos ε − a_z sin ε),  a_z becomes a_z cos ε + ρ sin ε:

    a rotation that keeps the modulus. The in-plane angle does not change at all, whatever ε: both axes lose
    the same part ε²/2 of their gain (0.15 mg at 1°), which is `gravity` or a common `scale`; only z sees ε
    in the first order (17.5 mg at 1°). A part mounted with an axis tilted by λ out of the plane of
    rotation reads G sin ε · λ besides, a constant, which is `bias`. So x and y alone cannot name it.
    """

    name = "axis_tilt"
    covariates = ("reading",)
    cause = "The axis of rotation is not horizontal, so that gravity leaves the plane of rotation."
    formula = "a_x, a_y += (cos ε − 1) a_x, a_y; a_z += ρ sin ε (for a_z = 0), ρ² = a_x² + a_y²"
    separated_by = (
        "In x and y it is a common gain (`gravity`, `scale`), in z a `bias`: level the axis by a spirit "
        "level, or remount the part with z reversed; the term in z changes its sign, a bias does not."
    )
    remedy = "level the stage's axis with a spirit level"
    not_corrected = _STAGE
    by_axis = False

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Angle ε above the horizontal, towards positive readings of z."""
        return (Parameter("tilt", "deg", -45.0, 45.0, 0.5),)

    @staticmethod
    def _parts(ideal: Floats) -> tuple[Floats, Floats, Floats]:
        """Unit vector in the plane (n, 2), its modulus (n, 1) and the reading along the axis (n, 1)."""
        rho = np.hypot(ideal[:, 0], ideal[:, 1])[:, None]
        unit = np.divide(ideal[:, :2], rho, out=np.zeros((len(rho), 2)), where=rho > 0)
        along = ideal[:, 2:3] if ideal.shape[1] > 2 else np.zeros_like(rho)
        return unit, rho, along

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Rotated minus ideal readings, (n, axes) in mg."""
        tilt = np.deg2rad(values[0])
        unit, rho, along = self._parts(ideal)
        # 2 sin²(ε/2) is 1 − cos ε without its cancellation at small angles.
        loss, rise = 2 * np.sin(tilt / 2) ** 2, np.sin(tilt)
        added = np.hstack([unit * (-rho * loss - along * rise), rho * rise - along * loss])
        seen: Floats = added[:, : ideal.shape[1]]
        return seen

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Derivative (n, axes, 1) in mg per degree; zero in x and y at ε = 0 and a_z = 0."""
        tilt = np.deg2rad(values[0])
        unit, rho, along = self._parts(ideal)
        in_plane = unit * (-rho * np.sin(tilt) - along * np.cos(tilt))
        by_radian = np.hstack([in_plane, rho * np.cos(tilt) - along * np.sin(tilt)])
        by_degree: Floats = np.deg2rad(by_radian[:, : ideal.shape[1], None])
        return by_degree
