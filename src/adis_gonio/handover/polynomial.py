"""A calibration as the polynomial that a firmware computes.

A scan consists of integers in 1/256 of a step (an LSB of the sensor), so that a mean of many scans keeps
its digits. In units of the standard g::

    free_i  = (scan_i − bias_i) · step_i                     bias in steps
    a_i     = free_i − Σ coefficient · product of factors     solved in a fixed number of passes
    gravity = M a                                             in units of local gravity

Factors are readings a (|a| ≤ 2), their moduli, t = (T − 25 °C)/128 and v = (V − 5 V)/8 (both within ±1).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError
from adis_gonio.calibrate.calibration import Calibration, EffectTerm
from adis_gonio.device.sensor.registers import Kind
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.model.effects import AXES, Conditions
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, REFERENCE_V
from adis_gonio.model.records import MG_PER_G

PARTS = 256
"""Integers per step."""
RANGE_G = 2.0
"""Limit of readings: no goniometer exceeds it, and the arithmetic is designed for it."""
SPAN_C = 128.0
SPAN_V = 8.0
GENERIC_MG = 1.0
"""Step of a sensor without a known LSB."""
GENERIC_C = 1.0
GENERIC_V = 1e-3
MOST_PASSES = 16
SETTLED_G = 2.0**-30
"""Tolerance of the solution: half of the last place of the fixed point."""


@dataclass(frozen=True)
class Monomial:
    """One term of the polynomial: a coefficient in g times factors, added to the reading of an axis.

    Attributes
    ----------
    axis : int
    coefficient : float
    factors : tuple of str
        `x`, `y`, `z`; `|x|`, `|y|`, `|z|`; `t`, `v`.
    """

    axis: int
    coefficient: float
    factors: tuple[str, ...]

    @property
    def of_reading(self) -> bool:
        """True if the term depends on readings, not on temperature and supply alone."""
        return any(factor not in ("t", "v") for factor in self.factors)


@dataclass(frozen=True)
class Input:
    """Conversion of temperature or supply for the polynomial: t or v = (number − zero) · step."""

    zero: int
    step: float


@dataclass(frozen=True)
class Polynomial:
    """The calibration as a polynomial that a firmware can compute.

    Attributes
    ----------
    words : bool
        True if a step of the readings is an LSB of the sensor.
    step_g, bias : tuple of float
        g per 1/256 step, and bias in 1/256 steps, of each axis.
    monomials : tuple of Monomial
    matrix : (axes, axes) float
        Conversion from g to units of local gravity, lower triangular.
    passes : int
        Number of passes after which the solution has settled for all readings within range; 0 if no
        monomial depends on a reading.
    temperature, supply : Input
    """

    words: bool
    step_g: tuple[float, ...]
    bias: tuple[float, ...]
    monomials: tuple[Monomial, ...]
    matrix: Floats
    passes: int
    temperature: Input
    supply: Input

    @property
    def axes(self) -> int:
        """Number of axes of a reading."""
        return len(self.step_g)

    @property
    def needs(self) -> tuple[str, ...]:
        """Conditions that the polynomial depends on: `t` (temperature), `v` (supply)."""
        return tuple(c for c in ("t", "v") if any(c in one.factors for one in self.monomials))


def polynomial_of(calibration: Calibration) -> Polynomial:
    """Convert a calibration to a polynomial that a firmware can compute.

    Raises
    ------
    FitError
        An effect has no such form, effects are too large to be solved for, or gains are far from 1.
    """
    base, bias_mg = calibration.natural(calibration.values)
    axes = calibration.axes
    # Columns of the conversion: calibrated readings of one g along each axis.
    unit = np.eye(axes) * MG_PER_G
    matrix = calibration.measurement.calibrated(base, unit).T
    part = None if calibration.provenance.counts else VARIANTS.get(calibration.provenance.sensor)
    step_mg = np.full(axes, GENERIC_MG if part is None else part.accel_mg_per_lsb) / calibration.per_mg
    monomials = tuple(m for term in calibration.effects for m in _monomials(calibration, term))
    temperature, supply = (
        Input(round(REFERENCE_C / GENERIC_C) * PARTS, GENERIC_C / PARTS / SPAN_C),
        Input(round(REFERENCE_V / GENERIC_V) * PARTS, GENERIC_V / PARTS / SPAN_V),
    )
    if part is not None:
        lsb_c, zero_c, _ = part.lsb(Kind.TEMPERATURE)
        lsb_v, zero_v, _ = part.lsb(Kind.SUPPLY)
        temperature = Input(round((REFERENCE_C - zero_c) / lsb_c * PARTS), lsb_c / PARTS / SPAN_C)
        supply = Input(round((REFERENCE_V - zero_v) / lsb_v * PARTS), lsb_v / PARTS / SPAN_V)
    made = Polynomial(
        words=part is not None,
        step_g=tuple((step_mg / MG_PER_G / PARTS).tolist()),
        bias=tuple((bias_mg / step_mg * PARTS).tolist()),
        monomials=monomials,
        matrix=matrix,
        passes=_passes(monomials),
        temperature=temperature,
        supply=supply,
    )
    if (np.abs(matrix).sum(axis=1) * RANGE_G >= 4.0).any():
        raise FitError(
            "gains are too far from 1 for a fixed-point header: is the unit of the readings right?"
        )
    return made


_TRIALS = 8
"""Readings at which an effect is compared with products of factors."""


def _monomials(calibration: Calibration, term: EffectTerm) -> list[Monomial]:
    """Find the product of factors to which each parameter of an effect is proportional.

    Raises
    ------
    FitError
        The effect is no sum of such products.
    """
    rng, effect = np.random.default_rng(1), term.effect
    ideal = rng.uniform(-1.0, 1.0, (_TRIALS, calibration.axes))
    t, v = rng.uniform(-1.0, 1.0, (2, _TRIALS))
    conditions = Conditions(
        np.zeros(_TRIALS), temperature_c=REFERENCE_C + SPAN_C * t, supply_v=REFERENCE_V + SPAN_V * v
    )
    made = []
    for name, unit in zip(term.parameters, np.eye(len(term.parameters)), strict=True):
        change = effect.reading(unit, ideal * MG_PER_G, conditions) / MG_PER_G
        axis = int(np.abs(change).max(axis=0).argmax())
        own = np.eye(calibration.axes)[axis]
        # The own axis comes first in a product of readings.
        axes = [axis, *(k for k in range(calibration.axes) if k != axis)]
        factors = {"t": t, "v": v} | {AXES[k]: ideal[:, k] for k in axes}
        factors |= {f"|{AXES[k]}|": np.abs(ideal[:, k]) for k in axes}
        for names in _products(factors):
            product = np.prod([factors[one] for one in names], axis=0)
            coefficient = float(change[0, axis] / product[0])
            if coefficient and np.allclose(
                change, np.outer(coefficient * product, own), rtol=1e-9, atol=0.0
            ):
                made.append(Monomial(axis, coefficient * calibration[name].value, names))
                break
        else:
            raise FitError(f"effect {effect.name} has no form for a firmware")
    return made


def _products(factors: Iterable[str]) -> Iterator[tuple[str, ...]]:
    """Names of all products of one to three factors."""
    for count in (1, 2, 3):
        yield from itertools.combinations_with_replacement(factors, count)


def _passes(monomials: tuple[Monomial, ...]) -> int:
    """Number of passes after which the iteration a ← free − Σ(a) has settled.

    Σ is the sum of all terms. Each pass multiplies the error by at most the largest slope of Σ within the
    range of readings.
    """
    largest, slope = np.zeros(3), np.zeros(3)
    for one in monomials:
        # Largest value and slope of this monomial for |a| up to `RANGE_G` and |t|, |v| up to 1.
        powers = [factor for factor in one.factors if factor not in ("t", "v")]
        largest[one.axis] += abs(one.coefficient) * RANGE_G ** len(powers)
        if powers:
            slope[one.axis] += abs(one.coefficient) * len(powers) * RANGE_G ** (len(powers) - 1)
    if not slope.any():
        return 0
    contraction = float(slope.max())
    if contraction >= 0.5 or largest.max() >= 1.0:
        raise FitError("the effects are too large to be corrected in a firmware: check the session")
    # Each pass reduces the error by the contraction.
    passes = math.ceil(math.log(SETTLED_G / float(largest.max())) / math.log(contraction))
    return min(max(passes, 1), MOST_PASSES)
