"""Polynomials of a calibration, and their constants in fixed point for a firmware.

The polynomial of a calibration is the form in which a firmware corrects readings.

A scan consists of integers in 1/256 of a step (an LSB of the sensor), so that a mean of many scans keeps
its digits. A reading of axis i is corrected in three steps, in units of the standard g::

    free_i  = (scan_i − bias_i) · step_i                     bias in steps
    a_i     = free_i − Σ coefficient · product of factors     solved in a fixed number of passes
    gravity = M a                                             in units of local gravity

The sum contains one term for each parameter of an effect. The factors of a term are ideal readings a (|a| ≤
2), their moduli, the temperature t = (T − 25 °C)/128 and the supply v = (V − 5 V)/8, both within ±1. The
matrix M removes gains and misalignments.

Readings in g are integers in Q29 (2⁻²⁹ g, ±4 g in 32 bits). Products are formed in 64 bits and rounded to
the nearest. Every coefficient is an integer of 30 bits and a shift (`Scaled`). A product of three readings
within ±2 g is at most 2³² after rounding, so that its product with a coefficient is at most 2⁶².

The angle is found by a CORDIC of 28 steps on a vector scaled to 2²⁸ … 2²⁹. Its error is at most 7 µ°: 28
truncations of one unit (3.6), truncations of x and the table (1.5), the remainder of the last step (0.5),
the rounding to a µ° (0.5).

In `float` the header finds the angle without a library: a quotient, a reduction to |q| ≤ tan 22.5°, and a
polynomial (`ATAN`, relative error 3.2e-9).

Rates of the gyros are integers of 1/256 of 0.018315 °/s, the sensor's finest LSB, so that one header serves
every range. In °/s, with f the raw readings of the accelerometers in g (within ±2 g), t = (T − 25 °C)/128
and v = (V − 5 V)/8::

    free_i = rate_i − b_i − Σ coefficient · product of f, t, v        the rate of turn alone
    free_i = free_i / (1 + κ_i t)                                     if a gain follows the temperature
    ω      = M free,  M = (K D)⁻¹

In fixed point rates are in Q20 (2⁻²⁰ °/s, ±1024 °/s in 31 bits).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError
from adis_gonio.calibrate.calibration import Calibration, EffectTerm
from adis_gonio.calibrate.gyro_calibration import GYRO_OFFSET_DPS, KIND_OF, GyroCalibration
from adis_gonio.device.sensor.registers import VARIANTS, Kind
from adis_gonio.model.effects import AXES, Conditions
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, REFERENCE_V
from adis_gonio.model.records import MG_PER_G

PARTS = 256
"""Number of integers per step of a reading (LSB of the sensor)."""
RANGE_G = 2.0
"""Limit of readings in g: no goniometer exceeds it, and the arithmetic is designed for it."""
SPAN_C = 128.0
SPAN_V = 8.0
GENERIC_MG = 1.0
"""Step in mg of the readings of a sensor without a known LSB."""
GENERIC_C = 1.0
GENERIC_V = 1e-3
MOST_PASSES = 16
SETTLED_G = 2.0**-30
"""Tolerance in g of the iterative solution: half of the last place of the fixed point."""


@dataclass(frozen=True)
class Monomial:
    """One term of the polynomial: a coefficient in g times factors, added to the reading of an axis.

    Attributes
    ----------
    axis : int
        Axis of the reading.
    coefficient : float
        Coefficient in g.
    factors : tuple of str
        Readings `x`, `y`, `z`; their moduli `|x|`, `|y|`, `|z|`; temperature `t`; supply `v`.
    """

    axis: int
    coefficient: float
    factors: tuple[str, ...]

    @property
    def of_reading(self) -> bool:
        """True if the term depends on the readings to be corrected, and not only on inputs (`Input`)."""
        return any(factor.strip("|") in AXES for factor in self.factors)


@dataclass(frozen=True)
class Input:
    """Conversion of a further reading, such as the temperature, to a factor of the polynomial.

    The factor is (number − `zero`) · `step`, limited to ± `limit`. The number is the reading in 1/256 LSB.
    """

    zero: int
    step: float
    limit: float = 1.0


@dataclass(frozen=True)
class Polynomial:
    """A calibration of accelerometers or gyros as a polynomial that a firmware can compute.

    Attributes
    ----------
    words : bool
        True if a step of the readings is an LSB of the sensor; False if the sensor's LSB is unknown.
    q : int
        Binary digits behind the point of a reading in fixed point.
    limit : float
        Largest magnitude of a reading in g or °/s.
    step, bias : tuple of float
        Of each axis: size in g or °/s of one integer of a reading, and bias (zero rate) in these integers.
    monomials : tuple of Monomial
        Terms of all effects, with coefficients in g or °/s.
    matrix : (axes, axes) float
        Matrix that converts the readings, free of bias and effects, to units of local gravity (lower
        triangular) or to rates of turn in °/s.
    inputs : mapping of str to Input
        Conversions of temperature `t`, supply `v`, and for gyros of the forces `fx`, `fy`, `fz` in g.
    passes : int
        Number of passes after which the iterative solution has settled for all readings within range; 0 if
        no monomial depends on a reading.
    warm : tuple of float
        Relative change κ of each axis's scale factor per unit of t.
    """

    words: bool
    q: int
    limit: float
    step: tuple[float, ...]
    bias: tuple[float, ...]
    monomials: tuple[Monomial, ...]
    matrix: Floats
    inputs: Mapping[str, Input]
    passes: int = 0
    warm: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def axes(self) -> int:
        """Number of axes of a reading."""
        return len(self.step)

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the inputs that the polynomial depends on."""
        used = {factor for one in self.monomials for factor in one.factors}
        used |= {"t"} if any(self.warm) else set()
        return tuple(name for name in self.inputs if name in used)


def polynomial_of(calibration: Calibration) -> Polynomial:
    """Convert a calibration to a polynomial that a firmware can compute.

    Raises
    ------
    FitError
        An effect has no such form; effects are too large for the iterative solution (1 g, or a slope of
        0.5); or gains are so far from 1 that numbers would exceed the fixed point.
    """
    base, bias_mg = calibration.natural(calibration.values)
    axes = calibration.axes
    # Columns of the conversion: calibrated readings of one g along each axis.
    unit = np.eye(axes) * MG_PER_G
    matrix = calibration.measurement.calibrated(base, unit).T
    part = None if calibration.provenance.counts else VARIANTS.get(calibration.provenance.sensor)
    step_mg = np.full(axes, GENERIC_MG if part is None else part.accel_mg_per_lsb) / calibration.per_mg
    monomials = tuple(m for term in calibration.effects for m in _monomials(calibration, term))
    lsb_c, zero_c, lsb_v, zero_v = GENERIC_C, 0.0, GENERIC_V, 0.0
    if part is not None:
        (lsb_c, zero_c, _), (lsb_v, zero_v, _) = part.lsb(Kind.TEMPERATURE), part.lsb(Kind.SUPPLY)
    temperature = Input(round((REFERENCE_C - zero_c) / lsb_c * PARTS), lsb_c / PARTS / SPAN_C)
    supply = Input(round((REFERENCE_V - zero_v) / lsb_v * PARTS), lsb_v / PARTS / SPAN_V)
    made = Polynomial(
        words=part is not None,
        q=Q,
        limit=RANGE_G,
        step=tuple((step_mg / MG_PER_G / PARTS).tolist()),
        bias=tuple((bias_mg / step_mg * PARTS).tolist()),
        monomials=monomials,
        matrix=matrix,
        inputs={"t": temperature, "v": supply},
        passes=_passes(monomials),
    )
    if (np.abs(matrix).sum(axis=1) * RANGE_G >= 4.0).any():
        raise FitError(
            "gains are too far from 1 for a fixed-point header: is the unit of the readings right?"
        )
    _check_words(made)
    return made


def _check_words(made: Polynomial) -> None:
    """Raise `FitError` if readings within the range exceed the 32 bits of a number in the header."""
    largest = np.abs(made.bias) + made.limit / np.array(made.step)
    if (largest >= 2.0**31).any():
        raise FitError(
            f"readings up to {largest.max() / PARTS:.3g} counts exceed the 24 bits of a header's scan:"
            " subtract their zero, or record them in a larger unit"
        )


_TRIALS = 8
"""Number of random readings at which an effect is compared with products of factors."""


def _monomials(calibration: Calibration, term: EffectTerm) -> list[Monomial]:
    """Return the monomials of an effect: for each parameter a product of factors with its coefficient.

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
        # All products of one to three factors.
        counts = (1, 2, 3)
        products = (itertools.combinations_with_replacement(factors, count) for count in counts)
        for names in itertools.chain.from_iterable(products):
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


def _passes(monomials: tuple[Monomial, ...]) -> int:
    """Return the number of passes after which the iteration a ← free − Σ(a) has settled.

    It is at most `MOST_PASSES`, and 0 if no monomial depends on a reading. `free` is the reading without
    bias, Σ the sum of all monomials, and a the ideal reading that is sought. Each pass multiplies the error
    of a by at most the largest slope of Σ within the range of readings.

    Raises
    ------
    FitError
        The effects are too large for the iteration.
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


Q = 29
ONE = 1 << Q
CORDIC_STEPS = 28
TURN_BITS = 32
"""Bits of an internal angle, which is an integer with 2³² per turn."""
CORDIC_UDEG = 7
"""Bound in µ° of the angle's error by CORDIC."""
FIXED_UDEG = 12
"""Bound in µ° of the error of a fixed-point angle at 0.5 g: CORDIC, rounded coefficients and readings."""
BITS = 30

ATAN = (
    -0.3333333134651184,
    0.1999955028295517,
    -0.1426423192024231,
    0.10746298730373383,
    -0.06459376215934753,
)
"""(atan q − q)/q³ in powers of q², fitted at Chebyshev's points of 0 to tan² 22.5°."""
TAN_EIGHTH = 0.41421356
DEGREES = 57.29578
FLOAT_DEG = 4e-5
"""Bound of the angle's error in degrees by single precision (last place at 180°: 1.5e-5)."""

RATE_Q = 20
LIMIT_DPS = 1000.0
"""Limit of rates in °/s: the largest word of the sensor is 600 °/s."""
MOST_RATE = 2 * int(LIMIT_DPS * (1 << RATE_Q)) - 1
"""Largest corrected rate in 2⁻²⁰ °/s."""
STEP_DPS = GYRO_OFFSET_DPS / PARTS
"""Step in °/s of an integer rate in the header's struct."""
FIXED_UDPS = 30
"""Bound in 1e-6 °/s of the error of a fixed-point rate up to 300 °/s."""
FLOAT_DPS = 3e-4
"""Bound in °/s of the error of a rate in `float` up to 300 °/s (last place there: 3e-5)."""
LEAST_GAIN, MOST_GAIN = 0.5, 2.0


@dataclass(frozen=True)
class Scaled:
    """A constant of the C header as the integer `number` times 2^−`shift`."""

    number: int
    shift: int

    @classmethod
    def of(cls, value: float, most_shift: int = 62) -> Scaled:
        """Return a constant as an integer of 30 bits and a shift; a value far below the range becomes 0.

        `most_shift` is the largest shift.
        """
        if value == 0.0:
            return cls(0, Q)
        shift = min(BITS - math.frexp(value)[1], most_shift)
        return cls(round(math.ldexp(value, shift)), shift)


def cordic_table() -> list[int]:
    """Return the angles atan(2⁻ⁱ) of the CORDIC steps, in 2⁻³² of a full turn."""
    return [round(math.atan2(1, 1 << i) / (2 * math.pi) * (1 << TURN_BITS)) for i in range(CORDIC_STEPS)]


# -- gyros -------------------------------------------------------------------------------------------


_FORMS: dict[str, tuple[float, tuple[str, ...]]] = {
    "gyro_bias_temperature": (SPAN_C, ("t",)),
    "gyro_bias_temperature2": (SPAN_C**2, ("t", "t")),
    "gyro_bias_temperature3": (SPAN_C**3, ("t", "t", "t")),
    "gyro_supply": (SPAN_V, ("v",)),
    "g_sensitivity": (1.0, ("f",)),
    "g2_sensitivity": (1.0, ("f", "f")),
}
"""Unit and factors of the monomial of each gyro parameter by kind; `f` is the force along its axis."""


def rate_polynomial_of(calibration: Calibration, gyro: GyroCalibration) -> Polynomial:
    """Convert the calibration of the gyros to a polynomial that a firmware can compute.

    `calibration` belongs to the accelerometers; from it the step of the force in the polynomial follows.

    Raises
    ------
    FitError
        The accelerometers are in counts of unknown scale, or gains of the gyros are outside `LEAST_GAIN` to
        `MOST_GAIN`.
    """
    polynomial = polynomial_of(calibration)
    if calibration.provenance.counts:
        raise FitError("accelerometers in counts of unknown scale give no force for the gyros")
    gains = np.linalg.svd(gyro.sensitivity, compute_uv=False)
    if gains.min() < LEAST_GAIN or gains.max() > MOST_GAIN:
        raise FitError("gains of the gyros are too far from 1 for a fixed-point header")
    terms, warm = [], [0.0, 0.0, 0.0]
    for one in gyro.parameters:
        kind, axes = KIND_OF[one.name], one.name.rpartition("_")[2]
        own = AXES.index(axes[0])
        if kind == "gyro_scale_temperature":
            warm[own] = 1e-6 * one.value * SPAN_C
        elif kind in _FORMS and one.value:
            span, factors = _FORMS[kind]
            named = tuple(f"f{axes[1]}" if factor == "f" else factor for factor in factors)
            terms.append(Monomial(own, one.value * span, named))
    if max(map(abs, warm)) > 0.5:
        raise FitError("a gyro's gain follows the temperature too much: check the session")
    made = Polynomial(
        words=polynomial.words,
        q=RATE_Q,
        limit=LIMIT_DPS,
        step=(STEP_DPS,) * 3,
        bias=tuple((gyro.bias_dps / STEP_DPS).tolist()),
        monomials=tuple(terms),
        matrix=np.asarray(np.linalg.inv(gyro.sensitivity), np.float64),
        inputs={f"f{axis}": Input(0, polynomial.step[0], RANGE_G) for axis in AXES}
        | dict(polynomial.inputs),
        warm=tuple(warm),
    )
    _check_words(made)
    return made
