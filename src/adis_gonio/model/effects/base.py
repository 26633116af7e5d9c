"""What an effect is: a named physical term that the seed paper's model lacks.

An effect says its name, its parameters with units and bounds, what it adds to a reading and the
derivative of that, which covariates it needs, what causes it in one sentence, and what would separate it
from its rivals. The simulated world and the fit run the same objects: the world calls them for single
samples, the fit for whole readings, both as rows of arrays.

Where an effect enters
    `Enters.ATTITUDE`: it turns the part against the stage (an angle in the plane, added to the true
    angle); `Enters.READING`: it adds to what an axis reads, as a function of what the axis should read
    and of the conditions; `Enters.SAMPLES`: it changes the samples of a dwell (noise, quantization, a
    tone, saturation), which the world applies sample by sample and the tracing finds within the dwells.

Units
    Readings are in mg (thousandths of the standard gravity), angles in radians, parameters in the unit that
    `Parameter.unit` says.

Another package adds an effect by an entry point of group `adis_gonio.effects`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from adis_gonio.model.records import Floats

AXES = ("x", "y", "z")


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
    """

    name: str
    unit: str
    low: float
    high: float
    typical: float


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
        Times and temperatures of the whole session, for effects with memory.
    variance_mg2 : (n, axes) float
        Variance of the samples within the dwell.
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
    variance_mg2: Floats | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    def lacks(self, needs: Sequence[str]) -> tuple[str, ...]:
        """Covariates of `needs` that were not recorded."""
        return tuple(name for name in needs if getattr(self, name) is None)


@dataclass(frozen=True)
class Effect(ABC):
    """Base of all effects; frozen, without state: parameters are passed in.

    Attributes
    ----------
    axes : tuple of str
        Axes on which it acts; empty for an effect of the stage, which acts on the attitude.
    """

    axes: tuple[str, ...] = ()

    name: str = field(init=False, default="")
    cause: str = field(init=False, default="")
    separated_by: str = field(init=False, default="")
    enters: Enters = field(init=False, default=Enters.READING)
    needs: tuple[str, ...] = field(init=False, default=())

    @property
    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters in a fixed order; those of an axis carry its letter (`bias_x`)."""

    def attitude_rad(self, values: Floats, conditions: Conditions) -> Floats:
        """Angle (n,) in rad that is added to the true angle of the part; `Enters.ATTITUDE` only."""
        return np.zeros(len(conditions))

    def reading_mg(self, values: Floats, ideal_mg: Floats, conditions: Conditions) -> Floats:
        """What is added to the readings, (n, axes) in mg; `Enters.READING` only.

        Parameters
        ----------
        values : (p,) float
            Parameters in the order of `parameters`.
        ideal_mg : (n, axes) float
            What each axis of the sensor should read (after gain and misalignment), in mg; two columns
            x, y or three x, y, z.
        """
        return np.zeros_like(ideal_mg)

    def samples_mg(
        self, values: Floats, samples_mg: Floats, conditions: Conditions, rng: np.random.Generator
    ) -> Floats:
        """Changed samples (n, axes) in mg; `Enters.SAMPLES` only."""
        return samples_mg

    def derivative(self, values: Floats, ideal_mg: Floats, conditions: Conditions) -> Floats:
        """∂(attitude_rad or reading_mg)/∂parameters.

        Returns
        -------
        (n, p) float for `Enters.ATTITUDE`, (n, axes, p) float for `Enters.READING`.
            By central differences unless an effect overrides it; most are linear in their parameters.
        """
        columns = []
        for k, parameter in enumerate(self.parameters):
            step = 1e-4 * max(abs(values[k]), abs(parameter.typical), 1e-9)
            up, down = values.copy(), values.copy()
            up[k] += step
            down[k] -= step
            if self.enters is Enters.ATTITUDE:
                difference = self.attitude_rad(up, conditions) - self.attitude_rad(down, conditions)
            else:
                difference = self.reading_mg(up, ideal_mg, conditions) - self.reading_mg(
                    down, ideal_mg, conditions
                )
            columns.append(difference / (2 * step))
        return np.stack(columns, axis=-1)

    def defaults(self, given: Mapping[str, float] | None = None) -> Floats:
        """Values in order: those given by name, else each parameter's typical one."""
        given = given or {}
        return np.array([given.get(p.name, p.typical) for p in self.parameters])
