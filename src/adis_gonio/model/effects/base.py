"""A first-order lag of a recorded series, exact for values that change linearly between records.

What an effect is: a named physical term that the seed paper's model lacks.

An effect says its name, its parameters with units and bounds, what it adds to a reading and the
derivative of that, which covariates it needs, what causes it in one sentence, and what would separate it
from its rivals. The simulated world and the fit run the same objects: the world calls them for single
samples, the fit for whole readings, both as rows of arrays.

Where an effect enters
    `Enters.ATTITUDE`: it turns the part against the stage (an angle in the plane, added to the true
    angle ψ = α − θ); `Enters.READING`: it adds to what an axis reads, as a function of what the axis
    should read and of the conditions; `Enters.SAMPLES`: it changes the samples of a dwell (noise,
    quantization, a tone, saturation), which the world applies sample by sample and the tracing finds
    within the dwells.

Units
    Readings are in mg (thousandths of the standard gravity) for an effect of the accelerometers, in °/s for
    one of the gyros (`Effect.parts`); angles in radians, parameters in the unit that `Parameter.unit` says.

Another package adds an effect by an entry point of group `adis_gonio.effects`.

Families that effects share: linear in their parameters, or amplitudes of one common time course.

An effect of a family gives its basis function once; value and derivative both follow from it, so that they
cannot disagree. Sums are written out, since a matrix product may round differently for another number of
rows, and a world that is asked in other portions must give the same samples.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from enum import StrEnum
from functools import cached_property, lru_cache
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, central_differences
from adis_gonio.base.errors import UsageError


def _scan(factor: Floats, term: Floats) -> Floats:
    """Solve x_k = factor_k · x_{k−1} + term_k, x_{−1} = 0, for all k; (m,) → (m,).

    By doubling (each pass joins the recurrences of twice as many steps): log₂ m passes over arrays, and no
    growing exponentials, since factors are at most 1.
    """
    factor, term = factor.copy(), term.copy()
    reach = 1
    while reach < len(term):
        term[reach:] += factor[reach:] * term[:-reach]
        factor[reach:] *= factor[:-reach].copy()
        reach *= 2
    return term


def lagged(record_s: Floats, record: Floats, time_s: Floats, tau_s: float) -> tuple[Floats, Floats]:
    """Lagged series y with τ dy/dt = x − y and its derivative by τ.

    Parameters
    ----------
    record_s, record : (m,) float
        Increasing times in s, and values x there; y starts at x of the first record. x is linear between
        records and constant outside.
    time_s : (n,) float
        Where to evaluate.
    tau_s : float
        Time constant τ > 0 in s.

    Returns
    -------
    y : (n,) float
        In the unit of x.
    by_tau : (n,) float
        ∂y/∂τ, in that unit per second.

    Raises
    ------
    UsageError
        No record, times that do not increase, or τ ≤ 0.

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
    kept = np.exp(-steps / tau_s)
    lag = np.concatenate([[0.0], _scan(kept, slopes * tau_s * (1 - kept))])
    feed = (lag[:-1] - slopes * tau_s) * kept * steps / tau_s**2 + slopes * (1 - kept)
    lag_by_tau = np.concatenate([[0.0], _scan(kept, feed)])

    # From the record at or before each time on; before the first one nothing has happened yet.
    k = np.clip(np.searchsorted(record_s, time_s, side="right") - 1, 0, len(record_s) - 1)
    h = np.maximum(time_s - record_s[k], 0.0)
    s = np.append(slopes, 0.0)[k]
    r = np.exp(-h / tau_s)
    y = record[k] + s * h - (r * lag[k] + s * tau_s * (1 - r))
    by_tau = -(r * lag_by_tau[k] + (lag[k] - s * tau_s) * r * h / tau_s**2 + s * (1 - r))
    return y, by_tau


AXES = ("x", "y", "z")
COVARIATES = (
    "angle", "approach", "force", "order", "previous_angle", "reading", "rotation", "supply",
    "temperature", "temperature_rate", "time", "variance",
)  # fmt: skip
"""What an effect can follow; the trace compares effects and functions without a name by these words."""
CYCLE = "repeat a few positions about 10 °C warmer, and again after it has cooled"
ONE_TURN = "remount the part turned by 180° and repeat some angles"
MEMORY = "depends on what was before the reading, which a single reading does not show"
OF_DWELL = "belongs to a dwell of the session"
_OF_CONDITION = {
    "angle_rad": "angle",
    "approach": "approach",
    "previous_angle_rad": "previous_angle",
    "temperature_c": "temperature",
    "supply_v": "supply",
    "variance_mg2": "variance",
    "order": "order",
    "force_g": "force",
    "rate_dps": "rotation",
}


class Enters(StrEnum):
    """Where an effect enters."""

    ATTITUDE = "attitude"
    READING = "reading"
    SAMPLES = "samples"


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect.

    Attributes
    ----------
    low, high : float
        Physical bounds in `unit`; a fit outside them is not believed.
    typical : float
        Magnitude that a bench would see; the starting point of a simulation by name.
    shape : bool
        False for an amplitude, which is absent at zero; True for a parameter that says how, where or
        when (a time constant, a frequency, a limit). A shape has no meaning where its amplitude is zero.
    """

    name: str
    unit: str
    low: float
    high: float
    typical: float
    shape: bool = False

    def check(self, value: float) -> float:
        """`value`, or `UsageError` if it lies outside the physical bounds (or is no number)."""
        if not self.low <= value <= self.high:
            raise UsageError(
                f"{self.name} = {value:g} {self.unit} is outside its physical bounds "
                f"{self.low:g} to {self.high:g} {self.unit}"
            )
        return value


@dataclass(frozen=True)
class Conditions:
    """What surrounded each of n rows (samples or readings); None where it was not recorded.

    Attributes
    ----------
    time_s : (n,) float
        Time since the session began.
    angle_rad : (n,) float
        Declared angle of the stage θ.
    order : (n,) float
        Number of the dwell in the order of recording, from 0.
    approach : (n,) float
        Direction of approach, +1, -1 or 0.
    previous_angle_rad : (n,) float
        Declared angle of the dwell before; the first dwell has its own angle.
    time_in_dwell_s : (n,) float
        Time since the move ended.
    temperature_c, supply_v : (n,) float
        Temperature of the die and supply.
    temperature_history : tuple of (m,) float, (m,) float
        Times (increasing, on the clock of `time_s`) and temperatures of the whole session, for effects
        with memory.
    temperatures_c : (n, 3) float
        Temperatures of the dies of the three gyros, of which `temperature_c` is the mean.
    force_g : (n, 3) float
        What the accelerometers read, in g.
    rate_dps : (n, 3) float
        True mean rate of turn in °/s, about the axes of the accelerometers; 0 at rest.
    abs_rate_dps : (n, 3) float
        Mean of the modulus of that rate; None: that of the mean.
    load_history : tuple of (m,) float, (m, axes) float
        The same of what the axes read, in mg.
    variance_mg2 : (n, axes) float
        Variance of the samples within the dwell.

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
        """Covariates of `needs` that were not recorded."""
        return tuple(name for name in needs if getattr(self, name) is None)

    def covariate(self, name: str) -> Floats:
        """Covariate (n,) by name; `UsageError` if it was not recorded."""
        found: Floats | None = getattr(self, name)
        if found is None:
            raise UsageError(f"the session does not record {name}")
        return found

    @cached_property
    def _late(self) -> dict[tuple[int, float], tuple[Floats, Floats]]:
        """What `late_load` has found: candidates have few time constants, each on every choice of axes."""
        return {}

    def late_load(self, axis: int, tau_s: float) -> tuple[Floats, Floats]:
        """Load (n,) of an axis in mg that lags by a time constant, and its derivative by that, in mg/s."""
        if self.load_history is None:
            raise UsageError("the session does not record load_history")
        if (axis, tau_s) not in self._late:
            times, loads = self.load_history
            self._late[axis, tau_s] = lagged(times, loads[:, axis], self.time_s, tau_s)
        return self._late[axis, tau_s]

    def rows(self, index: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Conditions:
        """Conditions of some of the rows; histories stay whole."""
        chosen: dict[str, Any] = {name: rows[index] for name, rows in self._rows().items()}
        return Conditions(
            **chosen, temperature_history=self.temperature_history, load_history=self.load_history
        )


@dataclass(frozen=True)
class Effect(ABC):
    """Base of all effects; frozen, without state: parameters are passed in.

    A subclass names itself by the class attributes below. Fields beside `axes` are choices: whole numbers
    that no gradient can find, such as the dwell that slipped.

    Attributes
    ----------
    axes : tuple of str
        Axes on which it acts; empty for an effect of the stage or of the whole sensor.

    Raises
    ------
    UsageError
        On creation: axes that do not exist, or none or some where that makes no sense.
    """

    axes: tuple[str, ...] = ()

    name: ClassVar[str]
    cause: ClassVar[str]
    """What causes it, in one sentence."""
    formula: ClassVar[str]
    """What it adds, as a line of text; i is an axis, p an axis across it, a a reading in mg."""
    separated_by: ClassVar[str]
    """What its rivals are and which measurement tells it from them."""
    covariates: ClassVar[tuple[str, ...]]
    """What it follows, in words of `COVARIATES`, the leading one first; empty for a constant.

    A class that declares none follows what it names in `needs`; `catalogue` refuses one with neither.
    """
    enters: ClassVar[Enters] = Enters.READING
    needs: ClassVar[tuple[str, ...]] = ()
    """Fields of `Conditions` without which it cannot be computed."""
    by_axis: ClassVar[bool] = True
    """True where it acts on the axes of `axes`; False where it has none to choose."""
    one_axis: ClassVar[bool] = False
    """True where a candidate acts on one axis only, since on several it holds another cause besides."""
    within_dwell: ClassVar[bool] = False
    """True where its trace stands among the samples of a dwell rather than between readings."""
    in_base: ClassVar[bool] = False
    """True if the model that every session fits holds it already."""
    prior: ClassVar[str] = ""
    """Group of common effects: `constant`, `curvature` or `force`; empty for the prior weight 1."""
    remedy: ClassVar[str] = ""
    """What to do by hand where no further position tells it from its rivals."""
    remedy_in_space: ClassVar[str] = ""
    """The remedy if attitudes are free and another one is needed: gravity is in no plane it could leave."""
    correctable: ClassVar[bool] = False
    """True for a function of the reading, the rate, the force, the temperature or the supply."""
    not_corrected: ClassVar[str] = ""
    """Why no later reading can be corrected for it."""
    shown_over: ClassVar[str] = ""
    """Covariate of its figure, if that is not the first of `covariates`."""
    parts: ClassVar[tuple[str, ...]] = ("accelerometer",)
    """Parts of the sensor that it is an effect of, as `Measurement.part` names them."""
    options: ClassVar[dict[str, tuple[int, ...]]] = {}
    """Values that a choice can have in any session; names and units of the parameters tell which it is."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "name" in vars(cls) and not hasattr(cls, "covariates"):
            needed = tuple(_OF_CONDITION[need] for need in cls.needs if need in _OF_CONDITION)
            if needed:
                cls.covariates = needed

    def __post_init__(self) -> None:
        unknown = [axis for axis in self.axes if axis not in AXES]
        if unknown or len(set(self.axes)) != len(self.axes):
            raise UsageError(f"{self.name}: axes {', '.join(self.axes)} are not different ones of x, y, z")
        if self.by_axis and not self.axes:
            raise UsageError(f"{self.name} acts on axes: name at least one of x, y, z")
        if not self.by_axis and self.axes:
            raise UsageError(f"{self.name} is no effect of single axes: create it without axes")
        for choice in self.choices():
            if getattr(self, choice) < 0:
                raise UsageError(f"{self.name}: {choice} must not be negative")

    @classmethod
    def choices(cls) -> tuple[str, ...]:
        """Names of the fields beside `axes`, all whole numbers."""
        return tuple(f.name for f in fields(cls) if f.init and f.name != "axes")

    @classmethod
    def of_part(cls, part: str) -> type[Effect] | None:
        """The effect as the readings of a part have it; None where it is no effect of that part."""
        return cls if part in cls.parts else None

    @property
    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters in a fixed order; those of an axis carry its letter (`bias_x`)."""

    def attitude_rad(self, values: Floats, conditions: Conditions) -> Floats:
        """Angle (n,) in rad that is added to the true angle of the part; `Enters.ATTITUDE` only."""
        return np.zeros(len(conditions))

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """What is added to the readings, (n, axes) in their unit; `Enters.READING` only.

        Parameters
        ----------
        values : (p,) float
            Parameters in the order of `parameters`.
        ideal : (n, axes) float
            What each axis of the sensor should read (after gain and misalignment); two columns x, y or
            three x, y, z.

        Raises
        ------
        UsageError
            A covariate was not recorded, or `ideal` has no column for one of the axes.
        """
        return np.zeros_like(ideal)

    def samples_mg(
        self, values: Floats, samples_mg: Floats, conditions: Conditions, rng: np.random.Generator
    ) -> Floats:
        """Changed samples (n, axes) in mg; `Enters.SAMPLES` only."""
        return samples_mg

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """∂(attitude_rad or reading)/∂parameters.

        By central differences unless an effect overrides it, as every effect of this package does.

        Returns
        -------
        (n, p) float for `Enters.ATTITUDE`, (n, axes, p) float for `Enters.READING`.

        Raises
        ------
        UsageError
            The effect enters by the samples: a reading has no derivative by it.
        """
        if self.enters is Enters.SAMPLES:
            raise UsageError(f"{self.name} changes samples: a reading has no derivative by its parameters")
        typical = np.array([abs(parameter.typical) for parameter in self.parameters])
        step = 1e-4 * np.maximum(np.maximum(np.abs(values), typical), 1e-9)
        if self.enters is Enters.ATTITUDE:
            return central_differences(lambda v: self.attitude_rad(v, conditions), values, step)
        return central_differences(lambda v: self.reading(v, ideal, conditions), values, step)

    def defaults(
        self, given: Mapping[str, float] | None = None, others: Literal["typical", "zero"] = "typical"
    ) -> Floats:
        """Values in order: those given by name, the others typical, or zero where they are amplitudes.

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
                    f"{self.name} has no parameter '{name}'{did_you_mean(name, known)}; "
                    f"it has {', '.join(known)}"
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
        """Columns of (n, 2) or (n, 3) readings that belong to `axes`; `UsageError` if one is missing."""
        columns = [AXES.index(axis) for axis in self.axes]
        if columns and max(columns) >= readings.shape[1]:
            raise UsageError(f"{self.name} acts on {', '.join(self.axes)}, but z was not recorded")
        return columns


def did_you_mean(name: str, known: Sequence[str]) -> str:
    """Piece of a message with the nearest match of a name, empty if nothing is near."""
    near = get_close_matches(name, known, n=1)
    return f" (did you mean '{near[0]}'?)" if near else ""


def by_letters(prototypes: Sequence[Parameter], letters: Sequence[str]) -> tuple[Parameter, ...]:
    """Each prototype once for each of the letters, letters outermost: `k2` becomes `k2_x`, `k2_y`."""
    return _by_letters(tuple(prototypes), tuple(letters))


@lru_cache(maxsize=1024)
def _by_letters(prototypes: tuple[Parameter, ...], letters: tuple[str, ...]) -> tuple[Parameter, ...]:
    return tuple(replace(p, name=f"{p.name}_{suffix}") for suffix in letters for p in prototypes)


@dataclass(frozen=True)
class AxisEffect(Effect):
    """An effect of single axes; by default of the two in the plane of rotation."""

    axes: tuple[str, ...] = ("x", "y")


@dataclass(frozen=True)
class LinearAxisEffect(AxisEffect):
    """Reading i gets Σ_k value_ik · basis_k(i): k coefficients an axis, nothing across axes."""

    coefficients: ClassVar[tuple[Parameter, ...]]
    """One prototype a basis function; the axis' letter is appended to its name."""

    def active(self) -> tuple[Parameter, ...]:
        """Prototypes in use; a choice of the effect may leave some out."""
        return self.coefficients

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The coefficients of the first axis, then those of the next."""
        return by_letters(self.active(), self.axes)

    @abstractmethod
    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Basis functions (n,) of column `axis`, one a coefficient in use."""

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Basis functions (n, axes, p) of the readings; `values` do not matter, the effect is linear."""
        columns = self.columns_of(ideal)
        count = len(self.active())
        design = np.zeros((*ideal.shape, count * len(columns)))
        for k, column in enumerate(columns):
            for j, rows in enumerate(self.basis(column, ideal, conditions)):
                design[:, column, k * count + j] = rows
        return design

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Sum of the basis functions, (n, axes) in mg."""
        added = np.zeros(ideal.shape)
        by_axis = np.reshape(values, (len(self.axes), -1))
        for k, column in enumerate(self.columns_of(ideal)):
            for value, rows in zip(by_axis[k], self.basis(column, ideal, conditions), strict=True):
                added[:, column] += value * rows
        return added


@dataclass(frozen=True)
class CrossEffect(AxisEffect):
    """Reading i gets Σ_p value_ip · basis(a_i, a_p, conditions) over the axes p across it.

    In the plane (`axes` without z) an axis has one partner, the other one of x and y; with z among the
    axes every axis has both others. Parameters carry both letters, `name_ip`.
    """

    coefficient: ClassVar[Parameter]

    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs (axis, axis across it) in the order of the parameters."""
        reach = AXES if "z" in self.axes else AXES[:2]
        return tuple((axis, other) for axis in self.axes for other in reach if other != axis)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One coefficient a pair."""
        return by_letters((self.coefficient,), [axis + other for axis, other in self.pairs()])

    @abstractmethod
    def basis(self, own_mg: Floats, across_mg: Floats, conditions: Conditions) -> Floats:
        """Basis function (n,) of the axis' own ideal reading, the one across and the conditions."""

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Basis functions (n, axes, p) of the readings; `values` do not matter, the effect is linear."""
        self.columns_of(ideal)
        pairs = self.pairs()
        design = np.zeros((*ideal.shape, len(pairs)))
        for k, (axis, other) in enumerate(pairs):
            i, p = AXES.index(axis), AXES.index(other)
            design[:, i, k] = self.basis(ideal[:, i], ideal[:, p], conditions)
        return design

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Sum of the basis functions, (n, axes) in mg."""
        self.columns_of(ideal)
        added = np.zeros(ideal.shape)
        for value, (axis, other) in zip(values, self.pairs(), strict=True):
            i, p = AXES.index(axis), AXES.index(other)
            added[:, i] += value * self.basis(ideal[:, i], ideal[:, p], conditions)
        return added


@dataclass(frozen=True)
class CourseEffect(AxisEffect):
    """Reading i gets value_i · course(shape): an amplitude an axis, one common course with one shape."""

    amplitude: ClassVar[Parameter]
    shape: ClassVar[Parameter]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The amplitudes, then the shape."""
        return (*by_letters((self.amplitude,), self.axes), self.shape)

    @abstractmethod
    def course(self, shape: float, conditions: Conditions) -> tuple[Floats, Floats]:
        """Course (n,) and its derivative (n,) by the shape."""

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Amplitude times course, (n, axes) in mg."""
        course, _ = self.course(float(values[-1]), conditions)
        added = np.zeros(ideal.shape)
        added[:, self.columns_of(ideal)] = course[:, None] * values[:-1]
        return added

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Derivative (n, axes, p): the course by the amplitudes, its slope by the shape."""
        course, slope = self.course(float(values[-1]), conditions)
        design = np.zeros((*ideal.shape, len(values)))
        for k, column in enumerate(self.columns_of(ideal)):
            design[:, column, k] = course
            design[:, column, -1] = values[k] * slope
        return design


def decay(time_s: Floats, tau_s: float) -> tuple[Floats, Floats]:
    """exp(−t/τ) and its derivative by τ, (n,) each."""
    elapsed = time_s / tau_s
    course = np.exp(-elapsed)
    return course, course * elapsed / tau_s


@dataclass(frozen=True)
class StageEffect(Effect):
    """An effect of the stage: the true angle gets Σ_k value_k · basis_k, in degrees."""

    coefficients: ClassVar[tuple[Parameter, ...]]
    enters = Enters.ATTITUDE
    by_axis = False

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One coefficient a basis function."""
        return self.coefficients

    @abstractmethod
    def basis(self, conditions: Conditions) -> tuple[Floats, ...]:
        """Basis functions (n,), without unit."""

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Derivative (n, p) of the angle, in rad per degree of each coefficient."""
        return np.deg2rad(np.stack(self.basis(conditions), axis=-1))

    def attitude_rad(self, values: Floats, conditions: Conditions) -> Floats:
        """Angle (n,) in rad that is added to the true angle of the part."""
        angle = np.zeros(len(conditions))
        for value, rows in zip(values, self.basis(conditions), strict=True):
            angle += np.deg2rad(value) * rows
        return angle
