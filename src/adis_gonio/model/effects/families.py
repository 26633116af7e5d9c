"""Families that effects share: linear in their parameters, or amplitudes of one common time course.

An effect of a family gives its basis function once; value and derivative both follow from it, so that they
cannot disagree. Sums are written out, since a matrix product may round differently for another number of
rows, and a world that is asked in other portions must give the same samples.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.model.effects.base import AXES, Conditions, Effect, Enters, Parameter


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
