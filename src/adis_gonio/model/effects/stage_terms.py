"""Effects of the stage, of the approach to a position, of single dwells, and of samples within dwells.

The terms of the stage turn the sensor. They are angles, added to ψ = α − θ (start angle minus angle of the
stage), and change a reading in proportion to its derivative by this angle. Remounting the sensor on the
table, turned by an angle, separates stage and sensor: if readings with the same direction of gravity in the
sensor are compared, the sensor's terms are unchanged, but the phase of a term of the stage with n cycles a
turn has advanced by n times that angle. One cycle therefore changes its sign by a remounting of 180° (the
reversal pair that separates table and sensor), two cycles need 90°.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.model.effects.base import (
    MEMORY,
    OF_DWELL,
    ONE_TURN,
    AxisEffect,
    Conditions,
    CourseEffect,
    Effect,
    Enters,
    LinearAxisEffect,
    Parameter,
    StageEffect,
    decay,
)
from adis_gonio.model.records import MG_PER_G

BETWEEN = "measure at angles between the angles of this session"
_STAGE = "belongs to the stage, not to the sensor"
LEAST_CYCLES = 3
"""Smallest number of cycles per turn of `stage_periodic`; one and two cycles are other effects."""
_ROUNDING = 1e-9
"""Values of a sine or cosine below this count as zero: they are rounding errors."""


def alike(cycles: int, others: int, angle_rad: Floats) -> bool:
    """Return True if m cycles per turn cannot be distinguished from n cycles at the angles of a session.

    m is `cycles` and n is `others`; 0 cycles are a constant. At these angles θ, sine and cosine of mθ are
    then combinations of sine and cosine of nθ. This is so if the phase of e^{i(m ∓ n)θ} is constant over
    the angles, for one of the two signs.
    """
    return bool(of_one_phase(np.array([cycles - others, cycles + others]), angle_rad).any())


def of_one_phase(cycles: NDArray[np.int_], angle_rad: Floats) -> NDArray[np.bool_]:
    """Return for each number c of cycles per turn (m,) True if cθ is equal at all angles θ, up to 2π.

    `cycles` (m,) are the numbers, `angle_rad` (n,) are the angles θ.
    """
    length = np.abs(np.exp(1j * cycles[:, None] * angle_rad).mean(axis=1))
    # Phases that scatter by 1.4 mrad, as by rounded angles, count as equal.
    return np.asarray(length > 1 - 1e-6)


@dataclass(frozen=True)
class StageHarmonic(StageEffect):
    """Base class of angle errors of the stage with a whole number of cycles per turn."""

    not_corrected = _STAGE
    needs = ("angle_rad",)
    cycles: ClassVar[int]

    def basis(self, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the sine and cosine, each (n,), of `cycles` times the declared angle."""
        turned = self.cycles * conditions.covariate("angle_rad")
        # At 2·cycles equally spaced angles one of the two contains only rounding errors.
        waves = (np.sin(turned), np.cos(turned))
        return tuple(np.where(np.abs(wave) > _ROUNDING, wave, 0.0) for wave in waves)


def _waves(stem: str) -> tuple[Parameter, Parameter]:
    """Return the amplitudes of sine and cosine in degrees, such as `ecc_sin` and `ecc_cos`."""
    sine, cosine = (Parameter(f"{stem}_{wave}", "deg", -2.0, 2.0, 0.01) for wave in ("sin", "cos"))
    return sine, cosine


class StageEccentricity(StageHarmonic):
    """The divided circle is off-centre: an angle error with one cycle a turn.

    Its amplitude in rad is eccentricity divided by radius of the circle.

    Formula: ψ += ecc_sin · sin θ + ecc_cos · cos θ

    Separated by: It looks like `quadratic` and `cross_axis` on both axes together: remount the part by
    180°, and only the stage's term changes its sign.
    """

    cause = "The divided circle of the stage is not centred on its axis: one cycle a turn."
    remedy = ONE_TURN
    cycles = 1
    parameters = _waves("ecc")


class StageEllipticity(StageHarmonic):
    """The divided circle is oval: an angle error of the stage with two cycles a turn.

    Formula: ψ += ell_sin · sin 2θ + ell_cos · cos 2θ

    Separated by: It looks like `scale`, Δφ and `cubic` on both axes together: remount the part by 90°, or
    compare the stage with a polygon.
    """

    cause = "The divided circle of the stage is oval, or its bearing is: two cycles a turn."
    remedy = "remount the part turned by 90° and repeat some angles"
    cycles = 2
    parameters = _waves("ell")


@dataclass(frozen=True)
class StagePeriodic(StageHarmonic):
    """The stage has an angle error with any whole number of cycles a turn, three or more.

    Formula: ψ += per_sin · sin cycles·θ + per_cos · cos cycles·θ

    Separated by: Remount the part by half a cycle, and only the stage's term changes its sign. Unequal
    angles distinguish numbers of cycles.

    Attributes
    ----------
    cycles : int
        Cycles a turn; one is `stage_eccentricity`, two are `stage_ellipticity`.

    Notes
    -----
    At N equally spaced angles, errors with n, N − n, N + n, … cycles a turn cannot be distinguished
    (`alike`). A session therefore shows only numbers up to N/2, and a number that is found stands for all
    of these.
    """

    cycles: int = 3  # type: ignore[misc]  # a choice of this effect alone

    cause = "A worm, a gear or the division of the stage repeats its error a whole number of times a turn."
    remedy = BETWEEN
    parameters = _waves("per")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cycles < LEAST_CYCLES:
            raise UsageError(
                f"{self.name}: cycles is {self.cycles}, it can be {LEAST_CYCLES} or more; one cycle a turn "
                "is stage_eccentricity, two are stage_ellipticity"
            )


class Backlash(StageEffect):
    """The drive of the stage has play: the angle depends on the direction of approach.

    The parameter is the difference of the angles between both directions; half of it is added to either
    side.

    Formula: ψ += backlash · approach/2

    Separated by: `hysteresis` shifts an axis alike at every angle, backlash only if the reading changes
    with the angle: approach several positions from both sides.
    """

    cause = "Play in the drive of the stage: the angle depends on the direction of approach."
    remedy = "approach several positions from both sides"
    not_corrected = _STAGE
    needs = ("approach",)
    parameters = (Parameter("backlash", "deg", -5.0, 5.0, 0.02),)

    def basis(self, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the direction of approach divided by 2, (n,): +½ from below, −½ from above, or 0."""
        return (0.5 * conditions.covariate("approach"),)


@dataclass(frozen=True)
class PositionSlip(StageEffect):
    """One dwell is at another angle than declared.

    Formula: ψ += slip in dwell `dwell`

    Separated by: Readings move along the circle; `outlier_dwell` also changes their length: repeat the
    position.

    Attributes
    ----------
    dwell : int
        Number of the dwell in the order of recording, from 0.
    """

    dwell: int = 1

    cause = "One position differs from its declared angle: the part or the stage slipped, or was misread."
    remedy = "repeat the position"
    not_corrected = OF_DWELL
    needs = ("order",)
    parameters = (Parameter("slip", "deg", -190.0, 190.0, 0.1),)

    def basis(self, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the indicator (n,): 1 for rows of the slipped dwell, 0 for all other rows."""
        return ((conditions.covariate("order") == self.dwell).astype(float),)


class Hysteresis(LinearAxisEffect):
    """The bias depends on the direction of approach.

    The parameter is the difference of the biases between both directions; half of it is added to either
    side.

    Formula: a_i += hysteresis_i · approach/2

    Separated by: `backlash` moves a reading only if it changes with the angle: approach several positions
    from both sides.
    """

    cause = "Stress of the last move stays in the sensor or its mount and shifts the bias of an axis."
    remedy = "approach several positions from both sides"
    not_corrected = MEMORY
    needs = ("approach",)
    coefficients = (Parameter("hysteresis", "mg", -200.0, 200.0, 0.5),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the direction of approach divided by 2, (n,): +½ from below, −½ from above, or 0."""
        return (0.5 * conditions.covariate("approach"),)


class Creep(CourseEffect):
    """Part of the response to a load is late, so that the reading creeps after each change of the load.

    With τ da_late/dt = a − a_late, and a_late = a at the beginning of the session, the term is creep_i
    (a_late − a) per g: after a change of the load by Δa the reading lacks creep·Δa, and the lack decays
    with τ. It is zero under a constant load, so that it does not compete with the gain. A gain that changes
    with the load itself is `quadratic` or `cubic`; a gain that drifts *after* a change of the load is
    `creep`. `settling` is equal in every dwell and ends within it; `hysteresis` depends only on the
    direction of the last move.

    Formula: a_i += creep_i · (a_late,i − a_i)/1000, τ da_late,i/dt = a_i − a_late,i

    Separated by: It follows the loads of all earlier dwells: turn by 180°, repeat the position for several
    τ, and turn back. `settling` begins again with every dwell.
    """

    cause = "The spring or the mount of an axis continues to yield after a change of its load."
    remedy = "turn by 180°, dwell there for several time constants, and turn back"
    not_corrected = MEMORY
    needs = ("load_history",)
    covariates = ("previous_angle",)
    coefficients = (Parameter("creep", "mg/g", -100.0, 100.0, 1.0),)
    common = (Parameter("tau", "s", 1.0, 36000.0, 120.0, shape=True),)

    def courses(self, shape: float, ideal: Floats, conditions: Conditions) -> list[tuple[Floats, Floats]]:
        """Return for each axis the lagged minus the present load in g, (n,), and its derivative by `shape`.

        `shape` is the time constant of the lag in s.
        """
        late = [
            (column, *conditions.late("load_history", column, shape)) for column in self.columns_of(ideal)
        ]
        return [((load - ideal[:, k]) / MG_PER_G, by_tau / MG_PER_G) for k, load, by_tau in late]


class AxisTilt(Effect):
    """The axis of rotation is tilted out of the horizontal by ε.

    Gravity then has G cos ε in the plane of rotation and G sin ε along the axis of rotation. With ρ the
    modulus of the ideal in-plane reading and a_z the reading along the axis (zero in a planar session),

        a_xy becomes (a_xy/ρ)(ρ cos ε − a_z sin ε),  a_z becomes a_z cos ε + ρ sin ε:

    a rotation that keeps the modulus. The in-plane angle does not depend on ε: both axes lose the fraction
    ε²/2 of their gain (0.15 mg at 1°), which looks like `gravity` or a common `scale`. Only z shows ε in
    first order (17.5 mg at 1°). A part mounted with an axis tilted by λ out of the plane of rotation also
    reads G sin ε · λ, a constant, which looks like `bias`. x and y alone therefore cannot identify it.

    Formula: a_x, a_y += (cos ε − 1) a_x, a_y; a_z += ρ sin ε (for a_z = 0), ρ² = a_x² + a_y²

    Separated by: In x and y it is a common gain, in z a `bias`: level the axis, or remount the part with z
    reversed.
    """

    covariates = ("reading",)
    cause = "The axis of rotation is not horizontal, so that gravity leaves the plane of rotation."
    remedy = "level the stage's axis with a spirit level"
    not_corrected = _STAGE
    by_axis = False
    parameters = (Parameter("tilt", "deg", -45.0, 45.0, 0.5),)
    """The tilt ε of the axis of rotation, positive if it raises the reading of z."""

    @staticmethod
    def _parts(ideal: Floats) -> tuple[Floats, Floats, Floats]:
        """Split readings into in-plane unit vector (n, 2), in-plane modulus (n, 1) and z reading (n, 1)."""
        rho = np.hypot(ideal[:, 0], ideal[:, 1])[:, None]
        unit = np.divide(ideal[:, :2], rho, out=np.zeros((len(rho), 2)), where=rho > 0)
        along = ideal[:, 2:3] if ideal.shape[1] > 2 else np.zeros_like(rho)
        return unit, rho, along

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the change of the readings by the tilt: rotated minus ideal readings, (n, axes) in mg."""
        tilt = np.deg2rad(values[0])
        unit, rho, along = self._parts(ideal)
        # 2 sin²(ε/2) is 1 − cos ε without its cancellation at small angles.
        loss, rise = 2 * np.sin(tilt / 2) ** 2, np.sin(tilt)
        added = np.hstack([unit * (-rho * loss - along * rise), rho * rise - along * loss])
        seen: Floats = added[:, : ideal.shape[1]]
        return seen

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative of the readings by the tilt, (n, axes, 1) in mg per degree.

        In x and y it is zero at ε = 0 and a_z = 0.
        """
        tilt = np.deg2rad(values[0])
        unit, rho, along = self._parts(ideal)
        in_plane = unit * (-rho * np.sin(tilt) - along * np.cos(tilt))
        by_radian = np.hstack([in_plane, rho * np.cos(tilt) - along * np.sin(tilt)])
        return np.asarray(np.deg2rad(by_radian[:, : ideal.shape[1], None]))


@dataclass(frozen=True)
class SampleEffect(AxisEffect):
    """Base class of effects that change single samples, and thereby the readings."""

    covariates = ("reading",)
    enters = Enters.SAMPLES
    within_dwell = True

    def samples_mg(
        self, values: Floats, samples_mg: Floats, conditions: Conditions, rng: Generator
    ) -> Floats:
        """Return a copy of the samples (n, axes) in mg, with the columns of `axes` changed."""
        changed = samples_mg.copy()
        columns = self.columns_of(samples_mg)
        changed[:, columns] = self.change(values, samples_mg[:, columns], conditions, rng)
        return changed

    @abstractmethod
    def change(self, values: Floats, own_mg: Floats, conditions: Conditions, rng: Generator) -> Floats:
        """Return the changed samples of the axes in `axes`, (n, len(axes)) in mg.

        `own_mg` (n, len(axes)) are the samples before the change; `rng` is the source of random numbers.
        """


class Saturation(SampleEffect):
    """Samples are clipped at ± a limit, the end of the range.

    Formula: sample_i = clip(sample_i, −limit, limit)

    Separated by: Samples pile up at one extreme value; `quantization` piles them up on every step.
    """

    cause = "The output stops at the end of the range."
    common = (Parameter("limit", "mg", 1.0, 20000.0, 1700.0, shape=True),)
    """The limit at which samples are clipped. The typical value is 1.7 g, the range of the ADIS16354; its
    14-bit numbers end at 3.83 g."""

    def change(self, values: Floats, own_mg: Floats, conditions: Conditions, rng: Generator) -> Floats:
        """Return the samples clipped to ± the limit, (n, len(axes)) in mg."""
        return np.clip(own_mg, -values[0], values[0])


class Quantization(SampleEffect):
    """Samples are rounded to multiples of a converter's step (LSB).

    Formula: sample_i = lsb · round(sample_i/lsb)

    Separated by: The samples are multiples of one step; with noise of a step or more the mean is free of
    it: lower the filter setting, or tilt by a fraction of a step.
    """

    cause = "The converter gives whole steps; if noise is below a step the mean follows a staircase."
    common = (Parameter("lsb", "mg", 0.0, 100.0, 0.4672),)
    """The size of the converter's LSB; 0 leaves the samples unrounded."""

    def change(self, values: Floats, own_mg: Floats, conditions: Conditions, rng: Generator) -> Floats:
        """Return the samples rounded to multiples of the LSB, (n, len(axes)) in mg."""
        step = float(values[0])
        return np.round(own_mg / step) * step if step > 0 else own_mg


class Tone(SampleEffect):
    """The samples contain a sine wave (a spectral line), with one phase on all axes.

    Formula: sample_i += tone_i · sin(2π f t + phase)

    Separated by: It is a line in the spectrum. A line that moves with the sample rate is an alias: record
    at two rates.
    """

    cause = "A machine or the mains shakes the table: a spectral line within the dwells."
    coefficients = (Parameter("tone", "mg", -2000.0, 2000.0, 5.0),)
    common = (
        Parameter("frequency", "Hz", 1e-3, 2000.0, 50.0, shape=True),
        Parameter("phase", "deg", -360.0, 360.0, 0.0, shape=True),
    )
    """Frequency, and phase at time 0 of the session."""

    def change(self, values: Floats, own_mg: Floats, conditions: Conditions, rng: Generator) -> Floats:
        """Return the samples plus the sine wave, (n, len(axes)) in mg."""
        *amplitudes, frequency, phase = values
        turn = 2 * np.pi * frequency * conditions.time_s + np.deg2rad(phase)
        line: Floats = np.sin(turn)[:, None] * np.array(amplitudes)
        return own_mg + line


class NoiseChange(SampleEffect):
    """The samples contain additional white noise from some time of the session on.

    Formula: sample_i += extra_i · N(0, 1) for t ≥ start

    Separated by: The variance within dwells changes and the mean does not; `vibration_rectification` moves
    the mean with it.
    """

    cause = "From a moment on the samples scatter more: a loose contact, a machine, a supply."
    not_corrected = OF_DWELL
    coefficients = (Parameter("extra", "mg", 0.0, 1000.0, 5.0),)
    """Standard deviation of the added noise."""
    common = (Parameter("start", "s", 0.0, 1e6, 60.0, shape=True),)
    """Time in the session at which the noise begins."""

    def change(self, values: Floats, own_mg: Floats, conditions: Conditions, rng: Generator) -> Floats:
        """Return the samples plus the noise that is added from the start time on, (n, len(axes)) in mg."""
        joined = (conditions.time_s >= values[-1])[:, None]
        noise: Floats = joined * rng.standard_normal(own_mg.shape) * values[:-1]
        return own_mg + noise


class Settling(CourseEffect):
    """Each dwell begins with an exponential decay of equal amplitude and time constant.

    In the means of equally long dwells it is a constant. The trace therefore looks for it in the samples of
    the dwells, with a row of `Conditions` for each sample. The mean of exp(−t/τ) over a dwell is not
    exp(−mean t/τ).

    Formula: a_i += settling_i · exp(−t/τ), t from the end of the move

    Separated by: It begins again with every dwell, unlike `bias_drift` and `warm_up`; in the means it is a
    `bias`: wait longer in some dwells.
    """

    covariates = ("reading",)
    cause = "After each move the sensor, its mount or the stage settles exponentially."
    remedy = "wait longer before some of the dwells"
    needs = ("time_in_dwell_s",)
    within_dwell = True
    coefficients = (Parameter("settling", "mg", -1000.0, 1000.0, 2.0),)
    common = (Parameter("tau", "s", 1e-3, 3600.0, 1.0, shape=True),)

    def course(self, shape: float, conditions: Conditions) -> tuple[Floats, Floats]:
        """Return the decay exp(−t/τ) since the end of the move, (n,), and its derivative by τ."""
        return decay(conditions.covariate("time_in_dwell_s"), shape)


@dataclass(frozen=True)
class OutlierDwell(LinearAxisEffect):
    """The readings of one dwell deviate by any amount.

    Formula: a_i += offset_i in dwell `dwell`

    Separated by: `position_slip` keeps the length of the reading; a jump of the bias stays in all later
    dwells: repeat the position.

    Attributes
    ----------
    dwell : int
        Number of the dwell in the order of recording, from 0.
    """

    dwell: int = 1

    cause = "One dwell was disturbed: a touch, a shock, a failure of the supply."
    remedy = "repeat the position"
    not_corrected = OF_DWELL
    needs = ("order",)
    coefficients = (Parameter("offset", "mg", -4000.0, 4000.0, 5.0),)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the indicator (n,): 1 for rows of the disturbed dwell, 0 for all other rows."""
        return ((conditions.covariate("order") == self.dwell).astype(float),)
