"""What an effect is: a named physical term that the seed paper's model lacks.

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
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from difflib import get_close_matches
from enum import StrEnum
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, central_differences
from adis_gonio.base.errors import UsageError
from adis_gonio.model.effects.lag import lagged

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
