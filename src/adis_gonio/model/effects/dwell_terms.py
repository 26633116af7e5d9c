"""Terms that stand within dwells or in a single dwell: converter, vibration, settling, outliers."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.model.effects.base import OF_DWELL, Conditions, Effect, Enters, Parameter
from adis_gonio.model.effects.families import AxisEffect, CourseEffect, LinearAxisEffect, by_letters, decay


@dataclass(frozen=True)
class SampleEffect(AxisEffect):
    """An effect that changes the samples of its axes; readings feel it only by way of them."""

    enters = Enters.SAMPLES
    within_dwell = True

    def samples_mg(
        self, values: Floats, samples_mg: Floats, conditions: Conditions, rng: np.random.Generator
    ) -> Floats:
        """Samples (n, axes) in mg with those of `axes` changed; the array given is left alone."""
        changed = samples_mg.copy()
        columns = self.columns_of(samples_mg)
        changed[:, columns] = self.change(values, samples_mg[:, columns], conditions, rng)
        return changed

    @abstractmethod
    def change(
        self, values: Floats, own_mg: Floats, conditions: Conditions, rng: np.random.Generator
    ) -> Floats:
        """Changed samples of the axes of the effect, (n, len(axes)) in mg."""


class Saturation(SampleEffect):
    """Samples stop at ± the limit."""

    name = "saturation"
    covariates = ("reading",)
    cause = "The output stops at the end of the range."
    formula = "sample_i = clip(sample_i, −limit, limit)"
    separated_by = (
        "Samples pile up at one extreme value; a `quantization` piles them up on every step, a smooth "
        "nonlinearity nowhere. At rest it needs vibration or bias of 0.7 g: see the samples, not the mean."
    )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The limit: 1.7 g is the range of the ADIS16354, its word ends at 3.83 g."""
        return (Parameter("limit", "mg", 1.0, 20000.0, 1700.0, shape=True),)

    def change(
        self, values: Floats, own_mg: Floats, conditions: Conditions, rng: np.random.Generator
    ) -> Floats:
        """Clipped samples."""
        return np.clip(own_mg, -values[0], values[0])


class Quantization(SampleEffect):
    """Samples stand on multiples of a step."""

    name = "quantization"
    covariates = ("reading",)
    cause = "The converter gives whole steps; where noise is below a step the mean follows a staircase."
    formula = "sample_i = lsb · round(sample_i/lsb)"
    separated_by = (
        "The distances of the samples are multiples of one step; with noise of a step or more the mean is "
        "free of it: turn the filter down, or tilt by a fraction of a step (0.027° at the horizontal)."
    )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The step; 0 is none."""
        return (Parameter("lsb", "mg", 0.0, 100.0, 0.4672),)

    def change(
        self, values: Floats, own_mg: Floats, conditions: Conditions, rng: np.random.Generator
    ) -> Floats:
        """Rounded samples."""
        step = float(values[0])
        return np.round(own_mg / step) * step if step > 0 else own_mg


class Tone(SampleEffect):
    """One spectral line, of one phase on all axes."""

    name = "tone"
    covariates = ("reading",)
    cause = "A machine or the mains shakes the table: a spectral line within the dwells."
    formula = "sample_i += tone_i · sin(2π f t + phase)"
    separated_by = (
        "A line in the spectrum that white or flicker noise has not; samples at a rate f_s show "
        "k f_s ± f at the same place, and a line that moves with the rate is such an alias: record at two "
        "rates. `vibration_rectification` may follow its strength."
    )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Amplitudes, frequency and phase (at time 0 of the session)."""
        return (
            *by_letters((Parameter("tone", "mg", -2000.0, 2000.0, 5.0),), self.axes),
            Parameter("frequency", "Hz", 1e-3, 2000.0, 50.0, shape=True),
            Parameter("phase", "deg", -360.0, 360.0, 0.0, shape=True),
        )

    def change(
        self, values: Floats, own_mg: Floats, conditions: Conditions, rng: np.random.Generator
    ) -> Floats:
        """Samples with the line."""
        *amplitudes, frequency, phase = values
        turn = 2 * np.pi * frequency * conditions.time_s + np.deg2rad(phase)
        line: Floats = np.sin(turn)[:, None] * np.array(amplitudes)
        return own_mg + line


class NoiseChange(SampleEffect):
    """White noise joins from a moment on, on top of the sensor's own."""

    name = "noise_change"
    covariates = ("reading",)
    cause = "From a moment on the samples scatter more: a loose contact, a machine, a supply."
    formula = "sample_i += extra_i · N(0, 1) for t ≥ start"
    separated_by = (
        "The variance within dwells changes and the mean does not; `tone` puts it into one line of the "
        "spectrum, `outlier_dwell` moves a mean, `vibration_rectification` moves the mean with it."
    )
    not_corrected = OF_DWELL

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Standard deviations of the noise that joins, and the moment in the session's time."""
        return (
            *by_letters((Parameter("extra", "mg", 0.0, 1000.0, 5.0),), self.axes),
            Parameter("start", "s", 0.0, 1e6, 60.0, shape=True),
        )

    def change(
        self, values: Floats, own_mg: Floats, conditions: Conditions, rng: np.random.Generator
    ) -> Floats:
        """Samples with the noise that joins."""
        joined = (conditions.time_s >= values[-1])[:, None]
        noise: Floats = joined * rng.standard_normal(own_mg.shape) * values[:-1]
        return own_mg + noise


class Settling(CourseEffect):
    """Each dwell begins with the same exponential.

    At the level of readings it is a constant where dwells are equally long, so it is looked for within the
    dwells: rows of `Conditions` are then samples. The mean of exp(−t/τ) over a dwell is not exp(−mean t/τ).
    """

    name = "settling"
    covariates = ("reading",)
    cause = "After each move the sensor, its mount or the stage settles exponentially."
    formula = "a_i += settling_i · exp(−t/τ), t from the end of the move"
    separated_by = (
        "It begins anew with every dwell, which `bias_drift` and `warm_up` do not; in the readings it is "
        "a `bias`: look at the samples, or wait longer in some dwells."
    )
    remedy = "wait longer before some of the dwells"
    needs = ("time_in_dwell_s",)
    within_dwell = True
    amplitude = Parameter("settling", "mg", -1000.0, 1000.0, 2.0)
    shape = Parameter("tau", "s", 1e-3, 3600.0, 1.0, shape=True)

    def course(self, shape: float, conditions: Conditions) -> tuple[Floats, Floats]:
        """exp(−t/τ) and its derivative by τ."""
        return decay(conditions.covariate("time_in_dwell_s"), shape)


@dataclass(frozen=True)
class OutlierDwell(LinearAxisEffect):
    """One dwell is off by any amount.

    Attributes
    ----------
    dwell : int
        Number of the dwell in the order of recording, from 0.
    """

    dwell: int = 1

    name = "outlier_dwell"
    cause = "One dwell was disturbed: a touch, a shock, a failure of the supply."
    formula = "a_i += offset_i in dwell `dwell`"
    separated_by = (
        "`position_slip` keeps the modulus of the reading, an outlier need not; a jump of the bias stays "
        "for all later dwells: repeat the position."
    )
    remedy = "repeat the position"
    not_corrected = OF_DWELL
    needs = ("order",)
    coefficients = (Parameter("offset", "mg", -4000.0, 4000.0, 5.0),)
    elsewhere: ClassVar[dict[str, type[Effect]]] = {}
    """The same of other parts, whose readings have another unit."""

    @classmethod
    def of_part(cls, part: str) -> type[Effect] | None:
        """Its own class, or that of another part."""
        return super().of_part(part) or cls.elsewhere.get(part)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """One in the dwell, zero elsewhere."""
        return ((conditions.covariate("order") == self.dwell).astype(float),)
