"""Terms: what can be added to the base model, named or nameless, in one shape for search and fit.

A term is a group of columns ∂reading/∂parameter (or ∂angle/∂parameter). A *named* term is an effect of the
catalogue on some axes; its shapes (time constants) stand on a grid for the search and are free in the fit.
A *nameless* term is a point of the grammar: where it enters × what it depends on.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.model.effects import AXES, Conditions, Effect, Enters
from adis_gonio.model.records import MG_PER_G

Where = Literal["bias", "gain", "misalignment", "angle"]


@dataclass(frozen=True)
class Term(ABC):
    """Base of all terms.

    Attributes
    ----------
    label : str
        Unique in a session; no fact is read out of it.
    covariates : tuple of str
        What it depends on.
    cost : float
        Price of having chosen it among all, in nats: −ln of its share of the prior.
    """

    label: str
    covariates: tuple[str, ...]
    cost: float

    @property
    def name(self) -> str | None:
        """Name of the catalogue; None for a nameless term."""
        return None

    @property
    def shown_as(self) -> str:
        """Name, or formula with a mark that it has none: for readers, never for decisions."""
        return self.name or self.label

    @property
    def dwell(self) -> int | None:
        """Dwell on which alone it acts; None for all others."""
        return None

    @property
    def constant(self) -> bool:
        """True for a named bias, which every sensor has."""
        return False

    @property
    def prior_sd(self) -> float | None:
        """Prior standard deviation of each value about zero; None where the data alone decide."""
        return None

    @property
    @abstractmethod
    def enters_angle(self) -> bool:
        """True where it turns the part, False where it adds to readings."""

    @abstractmethod
    def columns(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Columns by its amplitudes: (n, axes, d) in the readings' unit, or (n, d) in rad."""

    @abstractmethod
    def start(self, amplitudes: Floats) -> Floats:
        """Values (p,) of all its parameters at the amplitudes (d,) that the search found."""

    @abstractmethod
    def added(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """What it adds: (n, axes) in the readings' unit, or (n,) in rad."""

    @abstractmethod
    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """∂added/∂values: (n, axes, p) or (n, p)."""

    def amplitude_index(self, values: Floats) -> list[int]:
        """Indices of the amplitudes among the values (p,)."""
        return list(range(len(values)))

    def bounds(self) -> Floats | None:
        """Bounds (p, 2) of the values; None without any."""
        return None

    def limited(self, old: Floats, new: Floats) -> Floats:
        """Values after a step, brought back to what is possible."""
        return new


@dataclass(frozen=True)
class NamedTerm(Term):
    """An effect of the catalogue with its shapes at one point of their grid.

    Attributes
    ----------
    effect : Effect
    shapes : tuple of (int, float)
        Index among the parameters, and value, of each shape.
    spread : float or None
        Prior standard deviation of each value about zero.
    begins : float
        Amplitude that is known roughly beforehand, about which the linear problem is to stand; 0 for none.
    """

    effect: Effect
    shapes: tuple[tuple[int, float], ...] = ()
    spread: float | None = None
    begins: float = 0.0

    @property
    def name(self) -> str | None:
        """Name of the catalogue."""
        return self.effect.name

    @property
    def constant(self) -> bool:
        """True for an effect of the group `constant` (`Effect.prior`)."""
        return self.effect.prior == "constant"

    @property
    def prior_sd(self) -> float | None:
        """As `spread`."""
        return self.spread

    @property
    def enters_angle(self) -> bool:
        """True for effects of the stage."""
        return self.effect.enters is Enters.ATTITUDE

    @property
    def dwell(self) -> int | None:
        """Dwell that the effect was made for."""
        return getattr(self.effect, "dwell", None)

    @cached_property
    def amplitudes(self) -> list[int]:
        """Indices of the amplitudes among the parameters."""
        fixed = {index for index, _ in self.shapes}
        return [k for k in range(len(self.effect.parameters)) if k not in fixed]

    def amplitude_index(self, values: Floats) -> list[int]:
        """As `amplitudes`."""
        return self.amplitudes

    def columns(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Derivative by the amplitudes at amplitude zero."""
        values = self.start(np.zeros(len(self.amplitudes)))
        return self.effect.derivative(values, ideal, conditions)[..., self.amplitudes]

    def start(self, amplitudes: Floats) -> Floats:
        """Amplitudes found, shapes of the grid."""
        values = np.zeros(len(self.amplitudes) + len(self.shapes))
        values[self.amplitudes] = amplitudes
        for index, shape in self.shapes:
            values[index] = shape
        return values

    def added(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """As the effect says."""
        if self.enters_angle:
            return self.effect.attitude_rad(values, conditions)
        return self.effect.reading(values, ideal, conditions)

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """As the effect says."""
        return self.effect.derivative(values, ideal, conditions)

    @cached_property
    def _bounds(self) -> Floats:
        return np.array([[p.low, p.high] for p in self.effect.parameters])

    def bounds(self) -> Floats:
        """Physical bounds of the catalogue."""
        return self._bounds

    @cached_property
    def amplitude_spread(self) -> Floats:
        """Prior standard deviation of each amplitude (d,): its bounds are two of it."""
        low, high = self._bounds[self.amplitudes].T
        return np.asarray((high - low) / 4)

    def limited(self, old: Floats, new: Floats) -> Floats:
        """Within the bounds; a shape may at most double or halve in one step: the slope is only local."""
        new = new.copy()
        for index, _ in self.shapes:
            new[index] = np.clip(new[index], 0.5 * old[index], 2 * old[index])
        low, high = self.bounds().T
        return np.asarray(np.clip(new, low, high))


ROUNDING = 1e-9
"""Least size of a function, which reaches to about 1."""


@dataclass(frozen=True)
class Basis:
    """Basis functions of a nameless term: of the conditions, or of the readings axis by axis.

    Attributes
    ----------
    form : str
        Formula in words of the covariates.
    covariates : tuple of str
    common : callable or None
        Conditions → (n, q): the same on every axis.
    by_axis : callable or None
        (stimulus (n, axes), axis) → (n, q): functions of what an axis answers to, in g for accelerometers.
    approximates : bool
        True for polynomials and harmonics that stand for a function without a formula.
    with_constant : bool
        True where a constant stands beside the function.
    """

    form: str
    covariates: tuple[str, ...]
    common: Callable[[Conditions], Floats] | None = None
    by_axis: Callable[[Floats, int], Floats] | None = None
    approximates: bool = False
    with_constant: bool = False
    _last: list[tuple[Conditions, Floats]] = field(
        default_factory=list, init=False, repr=False, compare=False
    )

    def over(self, conditions: Conditions) -> Floats:
        """`common` at the conditions (n, q); kept for the next term, since many share a basis.

        The fifth harmonic's sine on a grid of 36° is rounding and stands for nothing there: it is zero,
        lest a fit find an amplitude of 10¹⁴ for it that other angles then show.
        """
        assert self.common is not None
        if not self._last or self._last[0][0] is not conditions:
            rows = self.common(conditions)
            rows = np.where(np.abs(rows).max(axis=0) > ROUNDING, rows, 0.0)
            self._last[:] = [(conditions, rows)]
        return self._last[0][1]


def in_g(ideal: Floats, conditions: Conditions) -> Floats:
    """What the gains of accelerometers multiply: the ideal readings (n, axes) in g."""
    return ideal / MG_PER_G


def side_by_side(blocks: Sequence[tuple[int | slice, Floats]], shape: tuple[int, ...]) -> Floats:
    """Columns (n, axes, P) of blocks: axes (one, or all) and their columns (n, q) or (n, axes, q)."""
    out = np.zeros((*shape, sum(rows.shape[-1] for _, rows in blocks)))
    start = 0
    for axes, rows in blocks:
        out[:, axes, start : start + rows.shape[-1]] = rows
        start += rows.shape[-1]
    return out


@dataclass(frozen=True)
class NamelessTerm(Term):
    """A point of the grammar.

    Attributes
    ----------
    where : {"bias", "gain", "misalignment", "angle"}
        A misalignment turns the axis against the others: its bias follows basis times other reading.
    axes : tuple of int
        Axes on which it acts, each with its own amplitudes; empty for the angle.
    basis : Basis
    shrinkage : float or None
        Prior standard deviation of each amplitude: the functions are then features of a Gaussian process.
    stimulus : callable
        (ideal, conditions) → (n, axes): what gains multiply, as `Measurement.stimulus`.
    """

    where: Where
    axes: tuple[int, ...]
    basis: Basis
    tangent_rad: float = field(default=1e-3, repr=False)
    shrinkage: float | None = None
    stimulus: Callable[[Floats, Conditions], Floats] = field(default=in_g, repr=False, compare=False)

    @property
    def prior_sd(self) -> float | None:
        """As `shrinkage`."""
        return self.shrinkage

    @property
    def enters_angle(self) -> bool:
        """True for functions that turn the part."""
        return self.where == "angle"

    @property
    def shown_as(self) -> str:
        """Formula, marked as having no name."""
        return f"unnamed: {self.form}"

    @property
    def form(self) -> str:
        """Formula in words."""
        letters = ", ".join(AXES[k] for k in self.axes)
        head = {
            "bias": f"bias of {letters}",
            "gain": f"gain of {letters}",
            "misalignment": f"misalignment of {letters}",
            "angle": "true angle",
        }[self.where]
        return f"{head} follows {self.basis.form}"

    def columns(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Basis functions; amplitudes in the readings' unit, for a gain at full stimulus; angle in mrad."""
        if self.where == "angle":
            return self.tangent_rad * self.basis.over(conditions)
        driven = self.stimulus(ideal, conditions)
        blocks = [(axis, self.on_axis(axis, driven, conditions)) for axis in self.axes]
        return side_by_side(blocks, ideal.shape)

    def on_axis(self, axis: int, driven: Floats, conditions: Conditions) -> Floats:
        """Columns (n, q) of an axis, where gains multiply `driven` (n, axes)."""
        basis = self.basis
        if basis.common is not None:
            rows = basis.over(conditions)
        else:
            assert basis.by_axis is not None
            rows = basis.by_axis(driven, axis)
        if self.where == "gain":
            return rows * driven[:, axis, None]
        if self.where == "misalignment":
            others = [j for j in range(driven.shape[1]) if j != axis]
            return np.concatenate([rows * driven[:, j, None] for j in others], axis=1)
        return rows

    def start(self, amplitudes: Floats) -> Floats:
        """The amplitudes: there are no shapes."""
        return np.array(amplitudes, dtype=float)

    def added(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Columns times amplitudes."""
        total: Floats = self.columns(ideal, conditions) @ values
        return total

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """The columns: a nameless term is linear."""
        return self.columns(ideal, conditions)
