"""Terms: additions to the base model, named or unnamed, with one interface for search and fit.

A term is a group of columns ∂reading/∂parameter (or ∂angle/∂parameter). A *named* term is an effect of the
catalogue on some axes; its shapes (time constants) are taken from a grid in the search and are free in the
fit. An *unnamed* term is a combination of the grammar: the place at which it enters × its covariates.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.model.effects import AXES, Conditions, Effect, Enters, catalogue, constant_effect
from adis_gonio.model.records import MG_PER_G

Where = Literal["bias", "gain", "misalignment", "angle"]


@dataclass(frozen=True)
class Term(ABC):
    """Base class of the terms of a model: named effects of the catalogue, and unnamed functions.

    Attributes
    ----------
    label : str
        Text for display, unique in a session.
    covariates : tuple of str
        Covariates that the term depends on.
    cost : float
        Cost of choosing the term among all terms, in nats: −ln of its prior probability.
    prior_sd : float or None
        Prior standard deviation of each amplitude about zero; None without a prior. It is finite if the
        functions of an unnamed term are features of a Gaussian process.
    forced : bool
        True if a search includes the term in every model; possible only for a `NamedTerm`.
    """

    label: str
    covariates: tuple[str, ...]
    cost: float
    prior_sd: float | None = field(default=None, kw_only=True)
    forced: bool = field(default=False, kw_only=True)

    @property
    def name(self) -> str | None:
        """Name of the effect in the catalogue; None for an unnamed term."""
        return None

    @property
    def shown_as(self) -> str:
        """Name, or the formula of an unnamed term, for display only."""
        return self.name or self.label

    @property
    def dwell(self) -> int | None:
        """Number of the only dwell on which the term acts; None if it acts on all dwells."""
        return None

    @property
    def constant(self) -> bool:
        """True for an error of constant size in all readings of an axis, such as a bias."""
        return False

    @property
    @abstractmethod
    def enters_angle(self) -> bool:
        """True if the term changes the angle of the sensor, False if it adds to the readings."""

    @abstractmethod
    def columns(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative of the readings or the angle by the amplitudes, at amplitude zero.

        `ideal` (n, axes) are the readings by the base model. The shape is (n, axes, d) in the readings'
        unit, or (n, d) in rad for an angle.
        """

    @abstractmethod
    def start(self, amplitudes: Floats) -> Floats:
        """Return starting values (p,) of all parameters of the term, for given amplitudes (d,)."""

    @abstractmethod
    def added(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the contribution to the readings (n, axes) in their unit, or to the angle (n,) in rad.

        `values` (p,) are all parameters of the term, `ideal` (n, axes) the readings by the base model.
        """

    @abstractmethod
    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative of the contribution by the p values: (n, axes, p), or (n, p) for an angle.

        `ideal` (n, axes) are the readings by the base model.
        """

    def amplitude_index(self, values: Floats) -> list[int]:
        """Return the indices of the amplitudes among the values (p,), without shape parameters."""
        return list(range(len(values)))

    def limited(self, old: Floats, new: Floats) -> Floats:
        """Return the new values, limited to the range that one step of a fit may reach from `old`."""
        return new


@dataclass(frozen=True)
class NamedTerm(Term):
    """An effect of the catalogue with given values of its shape parameters.

    Attributes
    ----------
    effect : Effect
        The effect of the catalogue.
    shapes : tuple of (int, float)
        Index among the effect's parameters, and fixed value, of each shape parameter such as a time
        constant.
    begins : float
        Rough amplitude about which the linear problem is expanded; 0 if none is known.
    """

    effect: Effect
    shapes: tuple[tuple[int, float], ...] = ()
    begins: float = 0.0

    @classmethod
    def offset(cls, axes: Sequence[str], prior_sd: float | None = None) -> NamedTerm:
        """Make the term of a constant offset of each of these axes.

        `prior_sd` is the prior standard deviation of each offset; None without a prior.
        """
        constant = constant_effect(axes)
        return cls(constant.name, (), 0.0, constant, prior_sd=prior_sd)

    @property
    def name(self) -> str | None:
        """Name of the effect in the catalogue, never None for a named term."""
        return self.effect.name

    @property
    def constant(self) -> bool:
        """True for an effect that the catalogue lists as constant, such as a bias."""
        return self.effect.prior == "constant"

    @property
    def enters_angle(self) -> bool:
        """True for effects of the stage, which change the angle of the sensor."""
        return self.effect.enters is Enters.ATTITUDE

    @property
    def dwell(self) -> int | None:
        """Number of the dwell for an effect that acts on one dwell only; otherwise None."""
        return getattr(self.effect, "dwell", None)

    @cached_property
    def amplitudes(self) -> list[int]:
        """Indices of the amplitudes among the parameters, without shape parameters."""
        fixed = {index for index, _ in self.shapes}
        return [k for k in range(len(self.effect.parameters)) if k not in fixed]

    def amplitude_index(self, values: Floats) -> list[int]:
        """Return the indices of the amplitudes among all parameters of the term; `values` has no effect."""
        return self.amplitudes

    def columns(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative of the readings or the angle by the amplitudes, at amplitude zero."""
        values = self.start(np.zeros(len(self.amplitudes)))
        return self.effect.derivative(values, ideal, conditions)[..., self.amplitudes]

    def start(self, amplitudes: Floats) -> Floats:
        """Return starting values (p,) with the given amplitudes (d,) and this term's shape parameters."""
        values = np.zeros(len(self.amplitudes) + len(self.shapes))
        values[self.amplitudes] = amplitudes
        for index, shape in self.shapes:
            values[index] = shape
        return values

    def added(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the contribution of the effect to the readings (n, axes), or to the angle (n,) in rad."""
        if self.enters_angle:
            return self.effect.attitude_rad(values, conditions)
        return self.effect.reading(values, ideal, conditions)

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative of the effect's contribution to the readings or the angle by its values."""
        return self.effect.derivative(values, ideal, conditions)

    @cached_property
    def bounds(self) -> Floats:
        """Limits (p, 2) of the values, as the catalogue states them for this effect."""
        return np.array([[p.low, p.high] for p in self.effect.parameters])

    @cached_property
    def amplitude_spread(self) -> Floats:
        """Prior standard deviation (d,) of each amplitude.

        It is `prior_sd` or, without a prior, a quarter of the range of the amplitude in the catalogue.
        """
        if self.prior_sd is not None:
            return np.full(len(self.amplitudes), self.prior_sd)
        low, high = self.bounds[self.amplitudes].T
        return np.asarray((high - low) / 4)

    def limited(self, old: Floats, new: Floats) -> Floats:
        """Limit the new values to their bounds, and each shape parameter to half to twice its old value.

        The derivative by a shape parameter is valid only near the old value.
        """
        new = new.copy()
        for index, _ in self.shapes:
            new[index] = np.clip(new[index], 0.5 * old[index], 2 * old[index])
        low, high = self.bounds.T
        return np.asarray(np.clip(new, low, high))


def typical_terms(
    part: str, axes: int, conditions: Conditions, without: Collection[str]
) -> Iterator[NamedTerm]:
    """Yield a term for each effect of the catalogue that can act on readings under these conditions.

    Effects within a dwell, effects with a discrete choice in `without` (such as `dwell`), and effects with
    unrecorded conditions are left out. Shape parameters have their typical values.

    Parameters
    ----------
    part : {"accelerometer", "gyro"}
        Sensors that the readings come from.
    axes : int
        Number of axes of a reading.
    """
    for kind in catalogue(part).values():
        if kind.enters is Enters.SAMPLES or kind.within_dwell or conditions.lacks(kind.needs):
            continue
        if not set(without).isdisjoint(kind.choices()):
            continue
        effect = kind(AXES[:axes] if kind.by_axis else ())
        shapes = tuple((k, p.typical) for k, p in enumerate(effect.parameters) if p.shape)
        yield NamedTerm(effect.name, (), 0.0, effect, shapes)


ROUNDING = 1e-9
"""Largest size of a basis function over the dwells at which it is a rounding error and counts as zero;
other functions reach about 1."""


@dataclass(frozen=True)
class Basis:
    """Basis functions of an unnamed term: of the conditions, or of each axis's stimulus.

    The stimulus of an axis is the quantity that its gain multiplies, such as acceleration.

    Attributes
    ----------
    form : str
        Formula for display, with words for the covariates.
    covariates : tuple of str
        Covariates that the functions depend on.
    common : callable or None
        From `Conditions` to values (n, q) that are equal on every axis; None for functions by axis.
    by_axis : callable or None
        From the stimulus (n, axes), in g for accelerometers, and an axis to values (n, q); None for common
        functions.
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
        """Return values (n, q) of the basis functions that all axes share, at the conditions of n rows.

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
    """Convert ideal readings (n, axes) of accelerometers from mg to g; the conditions are not used.

    An error of a scale factor is multiplied by the result.
    """
    return ideal / MG_PER_G


def join_columns(blocks: Sequence[tuple[int | slice, Floats]], shape: tuple[int, ...]) -> Floats:
    """Place blocks of columns side by side in an array (n, axes, P) with the given shape (n, axes).

    Each block is (axis or axes, columns): (n, q) for one axis or (n, axes, q); other axes get zeros.
    """
    out = np.zeros((*shape, sum(rows.shape[-1] for _, rows in blocks)))
    start = 0
    for axes, rows in blocks:
        out[:, axes, start : start + rows.shape[-1]] = rows
        start += rows.shape[-1]
    return out


@dataclass(frozen=True)
class NamelessTerm(Term):
    """An unnamed term: basis functions that change a bias, a scale factor, a misalignment or the angle.

    Attributes
    ----------
    where : {"bias", "gain", "misalignment", "angle"}
        Quantity that the term changes. A misalignment turns the axis against the others: it adds the basis
        times the other readings.
    axes : tuple of int
        Axes on which it acts, with separate amplitudes; empty for the angle.
    basis : Basis
        Basis functions of the term.
    tangent_rad : float
        Change of the angle in rad per unit of amplitude of a basis function, for a term of the angle.
    stimulus : callable
        From ideal readings and conditions to the quantity (n, axes) that gains multiply.
    """

    where: Where
    axes: tuple[int, ...]
    basis: Basis
    tangent_rad: float = field(default=1e-3, repr=False)
    stimulus: Callable[[Floats, Conditions], Floats] = field(default=in_g, repr=False, compare=False)

    @property
    def enters_angle(self) -> bool:
        """True if the term changes the angle of the sensor, False if it adds to the readings."""
        return self.where == "angle"

    @property
    def shown_as(self) -> str:
        """Text for display: the word "unnamed" and the formula."""
        return f"unnamed: {self.form}"

    @property
    def form(self) -> str:
        """Formula in words: the quantity that changes, its axes, and the basis functions."""
        letters = ", ".join(AXES[k] for k in self.axes)
        head = {
            "bias": f"bias of {letters}",
            "gain": f"gain of {letters}",
            "misalignment": f"misalignment of {letters}",
            "angle": "true angle",
        }[self.where]
        return f"{head} follows {self.basis.form}"

    def columns(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative by the amplitudes: the basis functions applied to each axis or the angle.

        Amplitudes are in the unit of the readings or, for the angle, in mrad. For a scale error or
        misalignment they are per unit of the stimulus (1 g for accelerometers).
        """
        if self.where == "angle":
            return self.tangent_rad * self.basis.over(conditions)
        driven = self.stimulus(ideal, conditions)
        blocks = [(axis, self.on_axis(axis, driven, conditions)) for axis in self.axes]
        return join_columns(blocks, ideal.shape)

    def on_axis(self, axis: int, driven: Floats, conditions: Conditions) -> Floats:
        """Return the derivatives (n, q) of the readings of one axis by the amplitudes of this term.

        If the term is a scale error, the basis functions are multiplied by the stimulus `driven` (n, axes).
        """
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
        """Return starting values: the amplitudes, because an unnamed term has no shape parameters."""
        return np.array(amplitudes, dtype=float)

    def added(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the contribution to the readings or the angle: columns times amplitudes."""
        return np.asarray(self.columns(ideal, conditions) @ values)

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative of the contribution by the amplitudes: `columns`, as the term is linear."""
        return self.columns(ideal, conditions)
