"""The gyros' part of the C header: constants, and what its functions compute, in Python.

Rates are whole numbers of 1/256 of 0.018315 °/s, the part's finest LSB, so that one header serves every
range. In °/s, with f the raw readings of the accelerometers in g (within ±2 g), t = (T − 25 °C)/128 and
v = (V − 5 V)/8::

    free_i = rate_i − b_i − Σ coefficient · product of f, t, v        what is left of the turn
    free_i = free_i / (1 + κ_i t)                                     where a gain follows the temperature
    ω      = M free,  M = (K D)⁻¹

Fixed point: rates in Q20 (2⁻²⁰ °/s, ±1024 °/s in 31 bits), products in 64 bits, rounded to the nearest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adis_gonio.base.errors import FitError
from adis_gonio.calibrate.calibration import Calibration
from adis_gonio.calibrate.gyro_calibration import GYRO_OFFSET_DPS, GyroCalibration, kind_of
from adis_gonio.handover.fixed import ONE, FixedPoint, Q, Scaled, Whole, _clamped, _condition, _shifted
from adis_gonio.handover.polynomial import PARTS, RANGE_G, SPAN_C, SPAN_V, Polynomial, polynomial_of
from adis_gonio.model.effects import AXES

Single = NDArray[np.float32]

RATE_Q = 20
LIMIT_DPS = 1000.0
"""Rates beyond are taken as this: the largest word of the part is 600 °/s."""
LIMIT = int(LIMIT_DPS * (1 << RATE_Q))
STEP_DPS = GYRO_OFFSET_DPS / PARTS
"""Of a number in the header's struct."""
FIXED_UDPS = 30
"""Bound of the fixed point's error in a rate up to 300 °/s, in 1e-6 °/s."""
FLOAT_DPS = 3e-4
"""Bound of the float's error in a rate up to 300 °/s: single precision has 3e-5 a place there."""
MOST_SHIFT = 62 - (Q - RATE_Q)
LEAST_GAIN, MOST_GAIN = 0.5, 2.0


@dataclass(frozen=True)
class RateTerm:
    """Part of what a gyro reads without a turn: coefficient in °/s, and the factors of it.

    Factors are `fx`, `fy`, `fz` (g), `t`, `v`.
    """

    axis: int
    coefficient: float
    factors: tuple[str, ...]


@dataclass(frozen=True)
class RatePolynomial:
    """What the header computes of the gyros.

    Attributes
    ----------
    bias : tuple of float
        °/s.
    terms : tuple of RateTerm
    warm : tuple of float
        κ of each gyro, per unit of t; zeros where no gain follows the temperature.
    matrix : (3, 3) float
        M.
    step_g : tuple of float
        g per 1/256 step of the accelerometers x, y, z, without their calibration.
    accelerometers : Polynomial
        Whose temperature and supply these use.
    """

    bias: tuple[float, ...]
    terms: tuple[RateTerm, ...]
    warm: tuple[float, ...]
    matrix: NDArray[np.float64]
    step_g: tuple[float, ...]
    accelerometers: Polynomial

    @property
    def needs(self) -> tuple[str, ...]:
        """Factors (`fx` …, `t`, `v`) that it depends on."""
        used = {factor for term in self.terms for factor in term.factors}
        used |= {"t"} if any(self.warm) else set()
        return tuple(name for name in (*(f"f{axis}" for axis in AXES), "t", "v") if name in used)


_FORMS: dict[str, tuple[float, tuple[str, ...]]] = {
    "gyro_bias_temperature": (SPAN_C, ("t",)),
    "gyro_bias_temperature2": (SPAN_C**2, ("t", "t")),
    "gyro_bias_temperature3": (SPAN_C**3, ("t", "t", "t")),
    "gyro_supply": (SPAN_V, ("v",)),
}


def rate_polynomial_of(calibration: Calibration, gyro: GyroCalibration) -> RatePolynomial:
    """The gyros' polynomial of a calibration.

    Raises
    ------
    FitError
        The accelerometers are in counts of unknown scale, or gains are far from 1.
    """
    polynomial = polynomial_of(calibration)
    if calibration.provenance.counts:
        raise FitError("accelerometers in counts of unknown scale say no force for the gyros")
    gains = np.linalg.svd(gyro.sensitivity, compute_uv=False)
    if gains.min() < LEAST_GAIN or gains.max() > MOST_GAIN:
        raise FitError("gains of the gyros are too far from 1 for a fixed-point header")
    terms, warm = [], [0.0, 0.0, 0.0]
    for one in gyro.parameters:
        kind, axes = kind_of(one.name) or "", one.name.rpartition("_")[2]
        own = AXES.index(axes[0])
        if one.value == 0.0:
            continue
        if kind in _FORMS:
            span, factors = _FORMS[kind]
            terms.append(RateTerm(own, one.value * span, factors))
        elif kind in ("g_sensitivity", "g2_sensitivity"):
            power = 1 if kind == "g_sensitivity" else 2
            terms.append(RateTerm(own, one.value, (f"f{axes[1]}",) * power))
        elif kind == "gyro_scale_temperature":
            warm[own] = 1e-6 * one.value * SPAN_C
    if max(map(abs, warm)) > 0.5:
        raise FitError("a gyro's gain follows the temperature too much: look for what is wrong")
    step = polynomial.step_g[0]
    return RatePolynomial(
        bias=tuple(gyro.bias_dps.tolist()),
        terms=tuple(terms),
        warm=tuple(warm),
        matrix=np.asarray(np.linalg.inv(gyro.sensitivity), np.float64),
        step_g=(step, step, step),
        accelerometers=polynomial,
    )


@dataclass(frozen=True)
class FixedRates:
    """The constants in fixed point, and what the header computes with them."""

    polynomial: RatePolynomial

    @property
    def step(self) -> Scaled:
        """°/s per number."""
        return Scaled.of(STEP_DPS)

    @property
    def bias(self) -> tuple[int, ...]:
        """In Q20 °/s."""
        return tuple(round(math.ldexp(b, RATE_Q)) for b in self.polynomial.bias)

    def coefficient(self, term: RateTerm) -> Scaled:
        """Such that coefficient · product in Q29 shifted gives Q20: its shift holds the nine bits."""
        own = Scaled.of(term.coefficient, MOST_SHIFT)
        return Scaled(own.number, own.shift + Q - RATE_Q)

    @property
    def warm(self) -> tuple[int, ...]:
        """κ in Q29 per t."""
        return tuple(round(math.ldexp(k, Q)) for k in self.polynomial.warm)

    @property
    def matrix(self) -> tuple[tuple[Scaled, ...], ...]:
        """M."""
        return tuple(tuple(Scaled.of(float(entry)) for entry in row) for row in self.polynomial.matrix)

    @property
    def force_step(self) -> Scaled:
        """A 1/256 step in g."""
        return Scaled.of(self.polynomial.step_g[0])

    def rates_udps(
        self,
        rates: ArrayLike,
        scan: ArrayLike,
        temperature: Whole | None = None,
        supply: Whole | None = None,
    ) -> Whole:
        """Rates (n, 3) in 1e-6 °/s.

        Parameters
        ----------
        rates, scan : (n, 3) int
            Gyros in 1/256 of 0.018315 °/s, accelerometers in 1/256 step.
        temperature, supply : (n,) int, optional
            In 1/256 step; by default 25 °C and 5 V.
        """
        given = np.asarray(rates, dtype=np.int64)
        factors = self._factors(np.asarray(scan, dtype=np.int64), temperature, supply)
        step, free = self.step, []
        for i in range(3):
            raw = _clamped(_shifted(given[:, i] * step.number, step.shift - RATE_Q), LIMIT)
            still = np.full(len(given), self.bias[i], dtype=np.int64)
            for term in self.polynomial.terms:
                if term.axis == i:
                    still = still + self._term(term, factors)
            own = _clamped(raw - still, LIMIT)
            if self.polynomial.warm[i]:
                gain = ONE + _shifted(factors["t"] * self.warm[i], Q)
                own = _clamped(_quotient(own << Q, gain), LIMIT)
            free.append(own)
        return np.stack([self._row(row, free) for row in self.matrix], axis=1)

    def _factors(self, scan: Whole, temperature: Whole | None, supply: Whole | None) -> dict[str, Whole]:
        fixed = FixedPoint.of(self.polynomial.accelerometers)
        step = self.force_step
        made = {
            f"f{axis}": _clamped(_shifted(scan[:, k] * step.number, step.shift - Q), int(RANGE_G * ONE))
            for k, axis in enumerate(AXES)
        }
        made["t"] = _condition(fixed.temperature, temperature, len(scan))
        made["v"] = _condition(fixed.supply, supply, len(scan))
        return made

    def _term(self, term: RateTerm, factors: dict[str, Whole]) -> Whole:
        first, *rest = term.factors
        product = factors[first]
        for factor in rest:
            product = _shifted(product * factors[factor], Q)
        own = self.coefficient(term)
        return _shifted(product * own.number, own.shift)

    def _row(self, row: tuple[Scaled, ...], free: list[Whole]) -> Whole:
        total = np.zeros(len(free[0]), dtype=np.int64)
        for entry, own in zip(row, free, strict=True):
            if entry.number:
                total = total + _shifted(own * entry.number, entry.shift)
        return _shifted(_clamped(total, 2 * LIMIT - 1) * 15625, RATE_Q - 6)  # 15625 / 2¹⁴ = 1e6 / 2²⁰


@dataclass(frozen=True)
class SingleRates:
    """What the header's `float` function computes, operation by operation."""

    polynomial: RatePolynomial

    def rates_dps(
        self,
        rates: ArrayLike,
        scan: ArrayLike,
        temperature: ArrayLike | None = None,
        supply: ArrayLike | None = None,
    ) -> Single:
        """Rates (n, 3) in °/s; arguments as of `FixedRates.rates_udps`."""
        f, p = np.float32, self.polynomial
        given = np.asarray(rates).astype(np.float32)
        force = np.asarray(scan).astype(np.float32)
        n = len(given)
        high = f(RANGE_G)
        factors: dict[str, Single] = {
            f"f{axis}": np.clip(force[:, k] * f(p.step_g[k]), -high, high) for k, axis in enumerate(AXES)
        }
        for name, own, told in (
            ("t", p.accelerometers.temperature, temperature),
            ("v", p.accelerometers.supply, supply),
        ):
            numbers = np.full(n, own.zero) if told is None else np.asarray(told)
            factors[name] = np.clip((numbers.astype(np.float32) - f(own.zero)) * f(own.step), f(-1), f(1))
        free = [self._free(i, given[:, i], factors) for i in range(3)]
        rows = []
        for k in range(3):
            total: Single = np.zeros(n, dtype=np.float32)
            for j in range(3):
                if p.matrix[k, j] != 0.0:
                    total = total + f(p.matrix[k, j]) * free[j]
            rows.append(total)
        return np.stack(rows, axis=1)

    def _free(self, axis: int, given: Single, factors: dict[str, Single]) -> Single:
        f, limit = np.float32, np.float32(LIMIT_DPS)
        still: Single = np.full(len(given), f(self.polynomial.bias[axis]))
        for term in self.polynomial.terms:
            if term.axis == axis:
                product: Single = np.full(len(given), f(term.coefficient))
                for factor in term.factors:
                    product = product * factors[factor]
                still = still + product
        own: Single = np.clip(np.clip(given * f(STEP_DPS), -limit, limit) - still, -limit, limit)
        if self.polynomial.warm[axis]:
            own = own / (f(1) + factors["t"] * f(self.polynomial.warm[axis]))
        return own


def _quotient(over: Whole, under: Whole) -> Whole:
    """Quotient towards zero, as C99 divides."""
    return np.sign(over) * (np.abs(over) // under)
