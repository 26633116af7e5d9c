"""A calibration as the polynomial that a firmware computes.

A scan consists of integers in 1/256 of a step (an LSB of the sensor), so that a mean of many scans keeps
its digits. In units of the standard g::

    free_i  = (scan_i − bias_i) · step_i                     bias in steps
    a_i     = free_i − Σ coefficient · product of factors     solved in a fixed number of passes
    gravity = M a                                             in units of local gravity

Factors are readings a (|a| ≤ 2), their moduli, t = (T − 25 °C)/128 and v = (V − 5 V)/8 (both within ±1).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError
from adis_gonio.calibrate.calibration import Calibration, EffectTerm
from adis_gonio.device.sensor.registers import Kind
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.model.effects import AXES
from adis_gonio.model.effects.base import CrossEffect
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
    """Scaling of temperature or supply for the polynomial: t or v = (number − zero) · step."""

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


_Form = Callable[[str, str], tuple[float, tuple[str, ...]]]
_MG = 1 / MG_PER_G
_RAD = math.pi / 180

# Factors of each effect (i: own axis, p: the axis across), and the conversion of its parameter to g.
_FORMS: dict[str, tuple[_Form, ...]] = {
    "scale": (lambda i, p: (1.0, (i,)),),
    "misalignment": (lambda i, p: (_RAD, (p,)),),
    "cross_axis": (lambda i, p: (_MG, (i, p)),),
    "quadratic": (lambda i, p: (_MG, (i, i)),),
    "cubic": (lambda i, p: (_MG, (i, i, i)),),
    "asymmetry": (lambda i, p: (_MG, (f"|{i}|",)),),
    "cross_quadratic": (lambda i, p: (_MG, (p, p)),),
    "bias_temperature": (
        lambda i, p: (_MG * SPAN_C, ("t",)),
        lambda i, p: (_MG * SPAN_C**2, ("t", "t")),
        lambda i, p: (_MG * SPAN_C**3, ("t", "t", "t")),
    ),
    "scale_temperature": (lambda i, p: (1e-6 * SPAN_C, ("t", i)),),
    "misalignment_temperature": (lambda i, p: (_RAD * SPAN_C, ("t", p)),),
    "supply_bias": (lambda i, p: (_MG * SPAN_V, ("v",)),),
    "supply_scale": (lambda i, p: (1e-6 * SPAN_V, ("v", i)),),
}


def _monomials(calibration: Calibration, term: EffectTerm) -> list[Monomial]:
    kind = term.effect
    if kind.name not in _FORMS:
        raise FitError(f"effect {kind.name} has no form for a firmware")
    pairs = kind.pairs() if isinstance(kind, CrossEffect) else [(axis, "") for axis in kind.axes]
    each = len(term.parameters) // len(pairs)
    made = []
    for k, name in enumerate(term.parameters):
        own, across = pairs[k // each]
        factor, factors = _FORMS[kind.name][k % each](own, across)
        made.append(Monomial(AXES.index(own), factor * calibration[name].value, factors))
    return made


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
