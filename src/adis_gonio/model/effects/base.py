"""Effects: named physical terms that the base model lacks.

An effect states its name, its parameters with units and bounds, the term that it adds to a reading and its
derivative, the covariates that it needs, and its cause in one sentence. Its docstring has a paragraph
`Formula:` with the term, in which i is an axis, p another axis and a_i the reading of axis i in mg, and a
paragraph `Separated by:` with the effects that change the readings alike and the measurement that separates
them; `scripts/effects_page.py` prints both. Simulation and fit use the same classes. Each row of an array
is a single sample in the simulation, and a reading (the mean of a dwell) in the fit.

Place of an effect in the model
    `Enters.ATTITUDE`: the effect turns the sensor against the stage (an angle in the plane, added to the
    true angle ψ = α − θ); `Enters.READING`: it adds to the reading of an axis, as a function of the ideal
    reading and of the conditions; `Enters.SAMPLES`: it changes the samples of a dwell (noise,
    quantization, a tone, saturation). The simulation applies it sample by sample, and the trace finds it
    within the dwells.

Units
    Readings are in mg (thousandths of the standard gravity) for an effect of the accelerometers, in °/s for
    an effect of the gyros (`Effect.parts`); angles in radians, parameters in `Parameter.unit`.

Effects with equations of one form have a common base class. In one form the term is linear in all
parameters; in the other it is an amplitude for each axis times a common function of time. A subclass
defines only the basis functions or the function of time, from which the base class computes the term and
its derivative. Sums are written out, because a matrix product may round differently for another number of
rows, and a simulation must give the same samples however the times are grouped into calls.

Another package adds an effect by an entry point of group `adis_gonio.effects`.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from functools import lru_cache
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, central_differences
from adis_gonio.base.errors import UsageError
from adis_gonio.base.jsonable import ComputedOnce


def _scan(factor: Floats, term: Floats) -> Floats:
    """Solve the recurrence x_k = factor_k · x_{k−1} + term_k with x_{−1} = 0; return all x_k, (m,).

    It works by doubling (each pass joins the recurrences of twice as many steps): log₂ m passes over
    arrays, and no growing exponentials, since factors are at most 1.
    """
    factor, term = factor.copy(), term.copy()
    reach = 1
    while reach < len(term):
        term[reach:] += factor[reach:] * term[:-reach]
        factor[reach:] *= factor[:-reach].copy()
        reach *= 2
    return term


def lagged(record_s: Floats, record: Floats, time_s: Floats, tau_s: float) -> tuple[Floats, Floats]:
    """Return the series y that follows x with a lag, τ dy/dt = x − y, and the derivative of y by τ.

    Parameters
    ----------
    record_s, record : (m,) float
        Increasing times in s, and values x at these times; y starts at x of the first record. x is linear
        between records and constant outside.
    time_s : (n,) float
        Times of the result.
    tau_s : float
        Time constant τ > 0 in s.

    Returns
    -------
    y : (n,) float
        Lagged values in the unit of x.
    by_tau : (n,) float
        ∂y/∂τ in the unit of x per second.

    Raises
    ------
    UsageError
        The series x is empty, its times do not increase, or τ ≤ 0.

    Notes
    -----
    The lag e = x − y obeys de/dt = s − e/τ with x's slope s. Over a step h, with r = exp(−h/τ):
    e' = r e + s τ (1 − r), and ∂e'/∂τ = r ∂e/∂τ + (e − s τ) r h/τ² + s (1 − r).
    """
    if not len(record_s) or len(record_s) != len(record) or (np.diff(record_s) <= 0).any():
        raise UsageError("a history needs one value a time, and times that increase")
    if not tau_s > 0:
        raise UsageError(f"a time constant is greater than 0, not {tau_s:g} s")

    steps = np.diff(record_s)
    slopes = np.diff(record) / steps
    # Lag and its derivative at each record, by the recurrences in the notes.
    kept = np.exp(-steps / tau_s)
    lag = np.concatenate([[0.0], _scan(kept, slopes * tau_s * (1 - kept))])
    feed = (lag[:-1] - slopes * tau_s) * kept * steps / tau_s**2 + slopes * (1 - kept)
    lag_by_tau = np.concatenate([[0.0], _scan(kept, feed)])

    # From the record at or before each time on; before the first one nothing has happened yet.
    k = np.clip(np.searchsorted(record_s, time_s, side="right") - 1, 0, len(record_s) - 1)
    h = np.maximum(time_s - record_s[k], 0.0)
    s = np.append(slopes, 0.0)[k]
    r = np.exp(-h / tau_s)
    # Continue from that record with the slope after it.
    y = record[k] + s * h - (r * lag[k] + s * tau_s * (1 - r))
    by_tau = -(r * lag_by_tau[k] + (lag[k] - s * tau_s) * r * h / tau_s**2 + s * (1 - r))
    return y, by_tau


AXES = ("x", "y", "z")
COVARIATES = (
    "angle", "approach", "force", "line_frequency", "order", "previous_angle", "reading", "rotation",
    "supply", "temperature", "temperature_rate", "time", "variance",
)  # fmt: skip
"""Names of the covariates on which an effect may depend; the trace compares effects by these names."""
CYCLE = "repeat a few positions about 10 °C warmer, and again after it has cooled"
ONE_TURN = "remount the part turned by 180° and repeat some angles"
MEMORY = "depends on the history before the reading, which a single reading does not show"
OF_DWELL = "belongs to a dwell of the session"
_OF_CONDITION = {
    "angle_rad": "angle",
    "approach": "approach",
    "previous_angle_rad": "previous_angle",
    "temperature_c": "temperature",
    "supply_v": "supply",
    "line_hz": "line_frequency",
    "variance_mg2": "variance",
    "order": "order",
    "force_g": "force",
    "rate_dps": "rotation",
}
_SHOWN = {"force", "reading", "rotation", "supply", "temperature"}
"""Covariates that each later reading shows, so that it can be corrected for a function of them."""


class Enters(StrEnum):
    """The quantity that an effect changes: the sensor's attitude, its readings, or its samples."""

    ATTITUDE = "attitude"
    READING = "reading"
    SAMPLES = "samples"


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect: its name, unit, bounds and typical value.

    Attributes
    ----------
    name, unit : str
        Name of the parameter, and unit of its values.
    low, high : float
        Physical bounds of the value in `unit`; a fitted value outside them is not plausible.
    typical : float
        Magnitude that is typical on a bench, in `unit`; the value in a simulation if no other is given.
    shape : bool
        False for an amplitude: the effect is absent if it is zero. True for a time constant, a frequency
        or a limit, which has no meaning if the amplitude is zero.
    """

    name: str
    unit: str
    low: float
    high: float
    typical: float
    shape: bool = False

    def check(self, value: float) -> float:
        """Return `value`; raise `UsageError` if it is not a number within the physical bounds."""
        if not self.low <= value <= self.high:
            raise UsageError(
                f"{self.name} = {value:g} {self.unit} is outside its physical bounds "
                f"{self.low:g} to {self.high:g} {self.unit}"
            )
        return value


APART_S = 1e9
"""Time between the begins of two sessions on the clock of their histories; any lag ends within it."""


def _late(conditions: Conditions, history: str, axis: int | None, tau_s: float) -> tuple[Floats, Floats]:
    times, values = conditions.covariate(history)
    return lagged(times, values if axis is None else values[:, axis], conditions.clock_s, tau_s)


@dataclass(frozen=True)
class Conditions(ComputedOnce):
    """Circumstances of each of n rows (samples or readings); a field that was not recorded is None.

    Attributes
    ----------
    time_s : (n,) float
        Time since the beginning of the session.
    angle_rad : (n,) float
        Declared angle of the stage θ.
    order : (n,) float
        Number of the dwell in the order of recording, from 0.
    approach : (n,) float
        Direction from which the position was reached: +1 from below, -1 from above, 0 unknown.
    previous_angle_rad : (n,) float
        Declared angle of the dwell before; the first dwell has its own angle.
    time_in_dwell_s : (n,) float
        Time of a sample since the end of the move to its position.
    temperature_c, supply_v : (n,) float
        Temperature of the die in °C, and supply voltage in V.
    temperature_history : tuple of (m,) float, (m,) float
        Times (increasing, on the clock of `time_s`) and temperatures in °C of the whole session, for
        effects with memory.
    temperatures_c : (n, 3) float
        Temperatures in °C of the dies of the three gyros; `temperature_c` is their mean.
    force_g : (n, 3) float
        Readings of the accelerometers, in g.
    rate_dps : (n, 3) float
        True mean rate of turn in °/s, about the axes of the accelerometers; 0 at rest.
    abs_rate_dps : (n, 3) float
        Mean modulus of the rate of turn in °/s; None to use the modulus of `rate_dps`.
    load_history : tuple of (m,) float, (m, axes) float
        Times and readings (in mg) of the whole session, for effects with memory of the load.
    variance_mg2 : (n, axes) float
        Variance of the samples within each dwell, in mg².
    line_hz : (n,) float
        Frequency in Hz of a spectral line that moves through the session, at each dwell.
    session : (n,) float
        Number of the session, from 0, if the rows are of several sessions; otherwise None. The clocks of
        `time_s` then begin with each session, and the times of the histories are on `clock_s`.

    Raises
    ------
    UsageError
        A covariate has not as many rows as `time_s`.
    """

    time_s: Floats
    angle_rad: Floats | None = None
    order: Floats | None = None
    approach: Floats | None = None
    previous_angle_rad: Floats | None = None
    time_in_dwell_s: Floats | None = None
    temperature_c: Floats | None = None
    supply_v: Floats | None = None
    temperature_history: tuple[Floats, Floats] | None = None
    load_history: tuple[Floats, Floats] | None = None
    variance_mg2: Floats | None = None
    temperatures_c: Floats | None = None
    force_g: Floats | None = None
    rate_dps: Floats | None = None
    abs_rate_dps: Floats | None = None
    line_hz: Floats | None = None
    session: Floats | None = None

    def __post_init__(self) -> None:
        for name, rows in self._rows().items():
            if len(rows) != len(self.time_s):
                raise UsageError(f"conditions: {name} has {len(rows)} rows, time_s has {len(self.time_s)}")

    def __len__(self) -> int:
        return len(self.time_s)

    def _rows(self) -> dict[str, Floats]:
        every = {f.name: getattr(self, f.name) for f in fields(self) if not f.name.endswith("_history")}
        return {name: rows for name, rows in every.items() if rows is not None}

    def lacks(self, needs: Sequence[str]) -> tuple[str, ...]:
        """Return those names of fields in `needs` that the session did not record."""
        return tuple(name for name in needs if getattr(self, name) is None)

    def covariate(self, name: str) -> Floats:
        """Return a recorded covariate (n,) or (n, k) by its field name; else raise `UsageError`."""
        found: Floats | None = getattr(self, name)
        if found is None:
            raise UsageError(f"the session does not record {name}")
        return found

    def die_c(self, axis: int) -> Floats:
        """Return the temperature (n,) in °C of the die of an axis; of all dies if only their mean is known.

        Raises
        ------
        UsageError
            The session does not record the temperature.
        """
        mean = self.covariate("temperature_c")
        return mean if self.temperatures_c is None else self.temperatures_c[:, axis]

    def late(self, history: str, axis: int | None, tau_s: float) -> tuple[Floats, Floats]:
        """Return a recorded quantity (n,) lagged with time constant τ, and its derivative by τ, (n,) per s.

        `history` is the field with the quantity, such as `temperature_history`; `axis` is the column of a
        history that has one column for each axis, else None. A search repeats a few time constants.
        """
        return self.once(_late, history, axis, tau_s)

    @property
    def clock_s(self) -> Floats:
        """Times (n,) on the clock of the histories, on which sessions are `APART_S` apart."""
        return self.time_s if self.session is None else self.time_s + APART_S * self.session

    def rows(self, index: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Conditions:
        """Return the conditions of the selected rows; the histories stay complete."""
        chosen: dict[str, Any] = {name: rows[index] for name, rows in self._rows().items()}
        return replace(self, **chosen)


@dataclass(frozen=True)
class Effect(ABC):
    """Base class of all effects; an effect is immutable, and its parameter values are passed in.

    A subclass sets the class attributes below. Fields other than `axes` are choices: whole numbers that a
    fit cannot estimate, such as the number of the dwell that slipped. A search tries their values one by
    one.

    Attributes
    ----------
    axes : tuple of str
        Axes on which the effect acts; empty for an effect of the stage or of the whole sensor.

    Raises
    ------
    UsageError
        On creation: unknown axes, no axes for an effect of axes, or axes for an effect without axes.
    """

    axes: tuple[str, ...] = ()

    name: ClassVar[str]
    """Name in the catalogue; by default from the name of the class, such as `cross_axis` of `CrossAxis`."""
    cause: ClassVar[str]
    """Physical cause of the effect, in one sentence; a base class has none."""
    covariates: ClassVar[tuple[str, ...]]
    """Covariates of the effect in words of `COVARIATES`, the most important first; empty for a constant.
    By default they follow from `needs`; `catalogue` refuses an effect that declares neither."""
    enters: ClassVar[Enters] = Enters.READING
    needs: ClassVar[tuple[str, ...]] = ()
    """Names of the fields of `Conditions` without which the effect cannot be computed."""
    by_axis: ClassVar[bool] = True
    """True if the effect acts on the axes in `axes`, False if it has no choice of axes."""
    one_axis: ClassVar[bool] = False
    """True if the trace tries single axes only: on several axes it would include another cause."""
    within_dwell: ClassVar[bool] = False
    """True if the effect shows in the samples within a dwell, and not in differences between dwells."""
    in_base: ClassVar[bool] = False
    """True if a fit of a session already contains the effect: bias, scale, misalignment, gravity."""
    prior: ClassVar[str] = ""
    """Group that sets the effect's prior weight in a trace: `constant`, `curvature` or `force`.
    Empty for the weight 1."""
    remedy: ClassVar[str] = ""
    """Advice to the operator if no further position separates the effect from others that look alike."""
    remedy_in_space: ClassVar[str] = ""
    """Advice that replaces `remedy` for free attitudes, if `remedy` needs a plane of rotation."""
    not_corrected: ClassVar[str] = ""
    """Reason why later readings cannot be corrected for the effect; empty if none is stated."""
    correctable: ClassVar[bool] = False
    """True if later readings can be corrected for the effect from the conditions of each reading.
    This is so if its covariates are all in `_SHOWN` and `not_corrected` states no reason against it."""
    shown_over: ClassVar[str] = ""
    """Covariate on the x axis of the effect's figure; empty for the first of `covariates`."""
    parts: ClassVar[tuple[str, ...]] = ("accelerometer",)
    """Parts of the sensor that show the effect: `accelerometer`, `gyro`."""
    options: ClassVar[dict[str, tuple[int, ...]]] = {}
    """Values that the trace tries, by the name of the choice. The list of an effect's parameters shows the
    value."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if not {"name", "cause"} & vars(cls).keys():
            return
        if "name" not in vars(cls):
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", cls.__name__).lower()
        needed = tuple(_OF_CONDITION[need] for need in cls.needs if need in _OF_CONDITION)
        if needed and "covariates" not in vars(cls):
            cls.covariates = needed
        known = set(getattr(cls, "covariates", ()))
        shown = cls.enters is Enters.READING and not cls.within_dwell and bool(known)
        cls.correctable = shown and known <= _SHOWN and not cls.not_corrected

    def __post_init__(self) -> None:
        unknown = [axis for axis in self.axes if axis not in AXES]
        if unknown or len(set(self.axes)) != len(self.axes):
            raise UsageError(f"{self.name}: axes {', '.join(self.axes)} are not different ones of x, y, z")
        if self.by_axis and not self.axes:
            raise UsageError(f"{self.name} acts on axes: name at least one of x, y, z")
        if not self.by_axis and self.axes:
            raise UsageError(f"{self.name} is no effect of single axes: create it without axes")
        for choice in self.choices():
            value = getattr(self, choice)
            if value < 0 or value not in self.options.get(choice, (value,)):
                allowed = ", ".join(map(str, self.options.get(choice, ("0 or more",))))
                raise UsageError(f"{self.name}: {choice} is {value}, it can be {allowed}")

    @classmethod
    def choices(cls) -> tuple[str, ...]:
        """Names of the fields of the effect other than `axes`; their values are whole numbers."""
        return tuple(f.name for f in fields(cls) if f.init and f.name != "axes")

    @property
    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters in a fixed order; a parameter of one axis ends in the axis letter (`bias_x`)."""

    def attitude_rad(self, values: Floats, conditions: Conditions) -> Floats:
        """Return the angle (n,) in rad that the effect adds to the true angle; 0 if it acts on readings."""
        return np.zeros(len(conditions))

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the terms added to the readings, (n, axes) in their unit; zero unless `enters` is READING.

        Parameters
        ----------
        values : (p,) float
            Values of the parameters, in the order of `parameters`.
        ideal : (n, axes) float
            Ideal reading of each axis (after gain and misalignment); two columns x, y or three x, y, z.

        Raises
        ------
        UsageError
            A covariate was not recorded, or `ideal` has no column for one of the axes.
        """
        return np.zeros_like(ideal)

    def samples_mg(
        self, values: Floats, samples_mg: Floats, conditions: Conditions, rng: np.random.Generator
    ) -> Floats:
        """Return samples (n, axes) in mg with the effect, from `samples_mg` (n, axes) without it.

        They are unchanged unless the effect acts on samples (`enters` is SAMPLES). `values` (p,) are the
        parameters; `rng` is the source of random numbers.
        """
        return samples_mg

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative of `attitude_rad` or of `reading` with respect to the parameters.

        It is computed by central differences unless an effect overrides it, as every effect of this
        package does.

        Returns
        -------
        (n, p) float for `Enters.ATTITUDE`, (n, axes, p) float for `Enters.READING`.

        Raises
        ------
        UsageError
            The effect changes samples, so that a reading has no derivative by its parameters.
        """
        if self.enters is Enters.SAMPLES:
            raise UsageError(f"{self.name} changes samples: a reading has no derivative by its parameters")
        typical = np.array([abs(parameter.typical) for parameter in self.parameters])
        # Step relative to the value or its typical size, never 0.
        step = 1e-4 * np.maximum(np.maximum(np.abs(values), typical), 1e-9)
        if self.enters is Enters.ATTITUDE:
            return central_differences(lambda v: self.attitude_rad(v, conditions), values, step)
        return central_differences(lambda v: self.reading(v, ideal, conditions), values, step)

    def defaults(
        self, given: Mapping[str, float] | None = None, others: Literal["typical", "zero"] = "typical"
    ) -> Floats:
        """Return the values (p,) of all parameters in order; a value that is not given is typical.

        `given` has values by name of the parameter. With others="zero", an amplitude that is not given is
        zero, and only a shape parameter (such as a time constant) that is not given is typical.

        Raises
        ------
        UsageError
            A name is no parameter of the effect, or a value lies outside its physical bounds.
        """
        given = given or {}
        known = [parameter.name for parameter in self.parameters]
        for name in given:
            if name not in known:
                raise UsageError(
                    f"{self.name} has no parameter '{name}'; it has {', '.join(known) or 'none'}"
                )
        return np.array(
            [
                parameter.check(given[parameter.name])
                if parameter.name in given
                else (parameter.typical if others == "typical" or parameter.shape else 0.0)
                for parameter in self.parameters
            ]
        )

    def columns_of(self, readings: Floats) -> list[int]:
        """Return the column numbers of `axes` in readings (n, 2) or (n, 3).

        It raises `UsageError` if z is one of the axes and was not recorded.
        """
        columns = [AXES.index(axis) for axis in self.axes]
        if columns and max(columns) >= readings.shape[1]:
            raise UsageError(f"effect {self.name} acts on {', '.join(self.axes)}, but z was not recorded")
        return columns


@lru_cache(maxsize=1024)
def by_letters(prototypes: tuple[Parameter, ...], letters: tuple[str, ...]) -> tuple[Parameter, ...]:
    """Return a copy of each parameter for each axis letter: `k2` becomes `k2_x`, `k2_y`.

    `prototypes` are the parameters without a letter, `letters` the letters to append. All parameters of
    one letter are together.
    """
    return tuple(replace(p, name=f"{p.name}_{suffix}") for suffix in letters for p in prototypes)


@dataclass(frozen=True)
class AxisEffect(Effect):
    """Base class of effects that act on each of their axes independently; by default on x and y."""

    axes: tuple[str, ...] = ("x", "y")

    coefficients: ClassVar[tuple[Parameter, ...]] = ()
    """Parameters that each axis has; their names lack the axis, since `letters` are appended to them."""
    common: ClassVar[tuple[Parameter, ...]] = ()
    """Parameters common to all axes, such as a time constant."""

    def active(self) -> tuple[Parameter, ...]:
        """Return the coefficients in use; a choice of the effect, such as `degree`, may omit some."""
        return self.coefficients

    def letters(self) -> tuple[str, ...]:
        """Return the letters, such as `x`, to append to the coefficients' names, one text for each group.

        A group has all active coefficients. The parameters are group after group in this order.
        """
        return self.axes

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters: the active coefficients of the first axis, of the second, …, then the common ones."""
        return (*by_letters(self.active(), self.letters()), *self.common)


class LinearEffect(AxisEffect):
    """Base class of axis effects that are linear in their amplitudes: reading = derivative × amplitudes.

    The amplitudes are all parameters but those in `common`.
    """

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the terms added to the readings, Σ amplitude · basis function, (n, axes) in their unit."""
        added, design = np.zeros(ideal.shape), self.derivative(values, ideal, conditions)
        for k in range(len(values) - len(self.common)):
            added += values[k] * design[..., k]
        return added


@dataclass(frozen=True)
class LinearAxisEffect(LinearEffect):
    """Base class of effects that add Σ_k value_ik · basis_k(i) to the reading of axis i alone."""

    @abstractmethod
    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the basis functions (n,) for column `axis` of the readings, one per parameter."""

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative of the readings (n, axes, p): basis functions, whatever the `values`."""
        design = np.zeros((*ideal.shape, len(self.parameters)))
        place = 0  # the parameters of an axis are together
        for column in self.columns_of(ideal):
            for rows in self.basis(column, ideal, conditions):
                design[:, column, place] = rows
                place += 1
        return design


@dataclass(frozen=True)
class CrossEffect(LinearEffect):
    """Base class of effects that add Σ_p value_ip · basis(a_i, a_p, conditions) to the reading of axis i.

    The sum is over the other axes p, and a are the ideal readings in mg. In the plane (`axes` without z)
    each of x and y has the other as its partner; with z each axis has two partners. Names of parameters end
    in both letters, `name_ip`.
    """

    covariates = ("reading",)

    def letters(self) -> tuple[str, ...]:
        """Return the pairs of letters, the axis and the other axis, in the order of the parameters."""
        reach = AXES if "z" in self.axes else AXES[:2]
        return tuple(axis + other for axis in self.axes for other in reach if other != axis)

    @abstractmethod
    def basis(self, own_mg: Floats, across_mg: Floats, conditions: Conditions) -> Floats:
        """Return the basis function (n,) of an axis and one of the other axes.

        `own_mg` and `across_mg` are the ideal readings (n,) of the axis and of the other axis, in mg.
        """

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative of the readings (n, axes, p): basis functions, whatever the `values`."""
        self.columns_of(ideal)
        pairs = self.letters()
        design = np.zeros((*ideal.shape, len(pairs)))
        for k, pair in enumerate(pairs):
            i, p = (AXES.index(letter) for letter in pair)
            design[:, i, k] = self.basis(ideal[:, i], ideal[:, p], conditions)
        return design


@dataclass(frozen=True)
class CourseEffect(LinearEffect):
    """Base class of effects that add an amplitude times a function of time to the reading of each axis.

    The term of axis i is value_i · course(shape), with one amplitude value_i for each axis and one shape
    parameter (such as a time constant) for all axes. A course is a function of time or of another
    condition, with a value for each of n rows (samples or dwells).
    """

    def course(self, shape: float, conditions: Conditions) -> tuple[Floats, Floats]:
        """Return the function of time (n,) that all axes share, and its derivative (n,) by `shape`."""
        raise NotImplementedError

    def courses(self, shape: float, ideal: Floats, conditions: Conditions) -> list[tuple[Floats, Floats]]:
        """Return for each of `axes` its function of time (n,), and the derivative (n,) by `shape`."""
        return [self.course(shape, conditions)] * len(self.axes)

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative of the readings (n, axes, p) by the amplitudes and the shape."""
        design = np.zeros((*ideal.shape, len(values)))
        courses = self.courses(float(values[-1]), ideal, conditions)
        for k, (column, (course, slope)) in enumerate(zip(self.columns_of(ideal), courses, strict=True)):
            design[:, column, k] = course
            design[:, column, -1] = values[k] * slope
        return design


def decay(time_s: Floats, tau_s: float) -> tuple[Floats, Floats]:
    """Return exp(−t/τ) at times t (n,) and its derivative by τ, each (n,)."""
    elapsed = time_s / tau_s
    course = np.exp(-elapsed)
    return course, course * elapsed / tau_s


@dataclass(frozen=True)
class StageEffect(Effect):
    """Base class of effects of the stage that add Σ_k value_k · basis_k, in degrees, to the true angle.

    `parameters` has one coefficient in degrees for each basis function.
    """

    enters = Enters.ATTITUDE
    by_axis = False

    @abstractmethod
    def basis(self, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the dimensionless basis functions (n,) of the angle, one for each parameter."""

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative (n, p) of the true angle by the coefficients, in rad per degree."""
        return np.deg2rad(np.stack(self.basis(conditions), axis=-1))

    def attitude_rad(self, values: Floats, conditions: Conditions) -> Floats:
        """Return the angle (n,) in rad that the stage's error adds to the true angle of the sensor."""
        angle = np.zeros(len(conditions))
        for value, rows in zip(values, self.basis(conditions), strict=True):
            angle += np.deg2rad(value) * rows
        return angle
