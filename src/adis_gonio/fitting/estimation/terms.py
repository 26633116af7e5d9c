"""Terms: additions to the base model, named or unnamed, with one interface for search and fit.

A term is a group of columns ∂reading/∂parameter (or ∂angle/∂parameter). A *named* term is an effect of the
catalogue on some axes; its shapes (time constants) are taken from a grid in the search and are free in the
fit. A *nameless* term is a combination of the grammar: the place at which it enters × its covariates.
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
        Unique in a session; for display only.
    covariates : tuple of str
        Covariates that it depends on.
    cost : float
        Cost of choosing it among all terms, in nats: −ln of its prior probability.
    """

    label: str
    covariates: tuple[str, ...]
    cost: float

    @property
    def name(self) -> str | None:
        """Name in the catalogue; None for an unnamed term."""
        return None

    @property
    def shown_as(self) -> str:
        """Name, or the formula of an unnamed term: for display, never for decisions."""
        return self.name or self.label

    @property
    def dwell(self) -> int | None:
        """The only dwell on which it acts; None if it acts on all dwells."""
        return None

    @property
    def constant(self) -> bool:
        """True for a named bias, which every sensor has."""
        return False

    @property
    def prior_sd(self) -> float | None:
        """Prior standard deviation of each value about zero; None without a prior."""
        return None

    @property
    @abstractmethod
    def enters_angle(self) -> bool:
        """True if it turns the part, False if it adds to the readings."""

    @abstractmethod
    def columns(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Derivative by its amplitudes: (n, axes, d) in the readings' unit, or (n, d) in rad."""

    @abstractmethod
    def start(self, amplitudes: Floats) -> Floats:
        """Values (p,) of all parameters for amplitudes (d,) from the search."""

    @abstractmethod
    def added(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Contribution to the readings (n, axes) in their unit, or to the angle (n,) in rad."""

    @abstractmethod
    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """∂added/∂values: (n, axes, p) or (n, p)."""

    def amplitude_index(self, values: Floats) -> list[int]:
        """Indices of the amplitudes among the values (p,)."""
        return list(range(len(values)))

    def bounds(self) -> Floats | None:
        """Bounds (p, 2) of the values; None without bounds."""
        return None

    def limited(self, old: Floats, new: Floats) -> Floats:
        """Limit the values after a step to the allowed range."""
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
        Rough amplitude about which the linear problem is expanded; 0 if none is known.
    """

    effect: Effect
    shapes: tuple[tuple[int, float], ...] = ()
    spread: float | None = None
    begins: float = 0.0

    @property
    def name(self) -> str | None:
        """Name in the catalogue."""
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
        """Dwell of an effect that acts on one dwell."""
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
        """Values (p,) of the amplitudes (d,), with the shapes of the grid."""
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
        """Prior standard deviation of each amplitude (d,): a quarter of the width of its bounds."""
        low, high = self._bounds[self.amplitudes].T
        return np.asarray((high - low) / 4)

    def limited(self, old: Floats, new: Floats) -> Floats:
        """Limit values to their bounds, and a shape to half or twice its value: its slope is only local."""
        new = new.copy()
        for index, _ in self.shapes:
            new[index] = np.clip(new[index], 0.5 * old[index], 2 * old[index])
        low, high = self.bounds().T
        return np.asarray(np.clip(new, low, high))


ROUNDING = 1e-9
"""Largest value of a basis function below which it counts as zero; others reach to about 1."""


@dataclass(frozen=True)
class Basis:
    """Basis functions of an unnamed term: of the conditions, or of the readings axis by axis.

    Attributes
    ----------
    form : str
        Formula, in the words for the covariates.
    covariates : tuple of str
    common : callable or None
        Conditions → (n, q), equal on every axis.
    by_axis : callable or None
        (stimulus (n, axes), axis) → (n, q): functions of the stimulus, in g for accelerometers.
    approximates : bool
        True for polynomials and harmonics that approximate a function of unknown form.
    with_constant : bool
        True if a constant is fitted in addition to the function.
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
        """Values of `common` at the conditions (n, q), kept for the next term because terms share bases.

        A function that is only rounding error at these conditions is set to zero, such as the sine of the
        fifth harmonic at multiples of 36°. Otherwise a fit could give it an amplitude of 10¹⁴.
        """
        assert self.common is not None
        if not self._last or self._last[0][0] is not conditions:
            rows = self.common(conditions)
            rows = np.where(np.abs(rows).max(axis=0) > ROUNDING, rows, 0.0)
            self._last[:] = [(conditions, rows)]
        return self._last[0][1]


def in_g(ideal: Floats, conditions: Conditions) -> Floats:
    """Stimulus of accelerometers: the ideal readings (n, axes) in g."""
    return ideal / MG_PER_G


def join_columns(blocks: Sequence[tuple[int | slice, Floats]], shape: tuple[int, ...]) -> Floats:
    """Columns (n, axes, P) from blocks: the axis or axes, and their columns (n, q) or (n, axes, q)."""
    out = np.zeros((*shape, sum(rows.shape[-1] for _, rows in blocks)))
    start = 0
    for axes, rows in blocks:
        out[:, axes, start : start + rows.shape[-1]] = rows
        start += rows.shape[-1]
    return out


@dataclass(frozen=True)
class NamelessTerm(Term):
    """An unnamed term: one combination of the grammar.

    Attributes
    ----------
    where : {"bias", "gain", "misalignment", "angle"}
        A misalignment turns the axis against the others: it adds the basis times the other readings.
    axes : tuple of int
        Axes on which it acts, with separate amplitudes; empty for the angle.
    basis : Basis
    shrinkage : float or None
        Prior standard deviation of each amplitude, if the functions are features of a Gaussian process.
    stimulus : callable
        (ideal, conditions) → (n, axes): the quantity that gains multiply, as `Measurement.stimulus`.
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
        """True for a function that turns the part."""
        return self.where == "angle"

    @property
    def shown_as(self) -> str:
        """Formula after the word "unnamed"."""
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
        """Basis functions. Amplitudes are in the readings' unit (of a gain at full stimulus) or in mrad."""
        if self.where == "angle":
            return self.tangent_rad * self.basis.over(conditions)
        driven = self.stimulus(ideal, conditions)
        blocks = [(axis, self.on_axis(axis, driven, conditions)) for axis in self.axes]
        return join_columns(blocks, ideal.shape)

    def on_axis(self, axis: int, driven: Floats, conditions: Conditions) -> Floats:
        """Columns (n, q) of an axis; `driven` (n, axes) is the quantity that gains multiply."""
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
        """The amplitudes, since there are no shapes."""
        return np.array(amplitudes, dtype=float)

    def added(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Columns times amplitudes."""
        return np.asarray(self.columns(ideal, conditions) @ values)

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """The columns, since an unnamed term is linear."""
        return self.columns(ideal, conditions)
