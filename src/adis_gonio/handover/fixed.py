"""The fixed-point arithmetic of the C header, in Python: bit-equal to what the compiled header gives.

Readings in g are whole numbers in Q29 (2⁻²⁹ g, ±4 g in 32 bits), products are formed in 64 bits and rounded
back to the nearest. Every coefficient has the format that uses its 30 bits (`Scaled`). With readings within
±2 g a product of three is at most 2³², times a coefficient below 2³⁰: 2⁶² at most.

The angle is found by a CORDIC of 28 steps on a vector brought to 2²⁸ … 2²⁹. Its error is at most 7 µ°: 28
truncations of one unit (3.6), those of x and the table (1.5), what the last step leaves (0.5), the rounding
to a µ° (0.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adis_gonio.handover.polynomial import RANGE_G, Monomial, Polynomial

Whole = NDArray[np.int64]

Q = 29
ONE = 1 << Q
LIMIT = int(RANGE_G * ONE)
CORDIC_STEPS = 28
TURN_BITS = 32
"""An angle inside is a whole number, 2³² to a turn."""
HALF_TURN_UDEG = 180_000_000
CORDIC_UDEG = 7
"""Bound of the angle's error by CORDIC in µ°."""
BITS = 30


@dataclass(frozen=True)
class Scaled:
    """A constant as `number` · 2^−`shift`."""

    number: int
    shift: int

    @classmethod
    def of(cls, value: float, most_shift: int = 62) -> Scaled:
        """The format that uses 30 bits; zero and what is far below them becomes 0."""
        if value == 0.0:
            return cls(0, Q)
        shift = min(BITS - math.frexp(value)[1], most_shift)
        return cls(round(math.ldexp(value, shift)), shift)


@dataclass(frozen=True)
class FixedTerm:
    """A monomial with its coefficient scaled."""

    monomial: Monomial
    coefficient: Scaled


@dataclass(frozen=True)
class FixedPoint:
    """The constants of the header, and what it computes.

    Attributes
    ----------
    step : tuple of Scaled
        g per 1/256 step.
    bias : tuple of int
        In Q29 g; larger than 32 bits where counts have a far zero.
    terms : tuple of FixedTerm
    matrix : tuple of tuple of Scaled
    temperature, supply : (int, Scaled)
        Zero and step.
    passes : int
    """

    step: tuple[Scaled, ...]
    bias: tuple[int, ...]
    terms: tuple[FixedTerm, ...]
    matrix: tuple[tuple[Scaled, ...], ...]
    temperature: tuple[int, Scaled]
    supply: tuple[int, Scaled]
    passes: int

    @classmethod
    def of(cls, polynomial: Polynomial) -> FixedPoint:
        """Constants of a polynomial."""
        p = polynomial
        return cls(
            step=tuple(Scaled.of(step) for step in p.step_g),
            bias=tuple(round(math.ldexp(b * s, Q)) for b, s in zip(p.bias, p.step_g, strict=True)),
            terms=tuple(FixedTerm(one, Scaled.of(one.coefficient)) for one in p.monomials),
            matrix=tuple(tuple(Scaled.of(float(entry)) for entry in row) for row in p.matrix),
            temperature=(p.temperature.zero, Scaled.of(p.temperature.step)),
            supply=(p.supply.zero, Scaled.of(p.supply.step)),
            passes=p.passes,
        )

    def correct(self, scan: Whole, temperature: Whole | None = None, supply: Whole | None = None) -> Whole:
        """Gravity (n, axes) in 2⁻²⁹ of local gravity.

        Parameters
        ----------
        scan : (n, axes) int
            Readings in 1/256 step.
        temperature, supply : (n,) int, optional
            In 1/256 step; by default 25 °C and 5 V.
        """
        axes = len(self.step)
        scan = np.asarray(scan, dtype=np.int64)[:, :axes]
        free = np.stack(
            [
                _clamped(
                    _shifted(scan[:, i] * self.step[i].number, self.step[i].shift - Q) - self.bias[i], LIMIT
                )
                for i in range(axes)
            ],
            axis=1,
        )
        factors = {
            "t": _condition(self.temperature, temperature, len(scan)),
            "v": _condition(self.supply, supply, len(scan)),
        }
        steady = np.zeros(free.shape, dtype=np.int64)
        for term in self.terms:
            if not term.monomial.of_reading:
                steady[:, term.monomial.axis] += _term(term, factors)
        free = _clamped(free - steady, LIMIT)
        ideal = free
        for _ in range(self.passes):
            for k, letter in enumerate("xyz"[:axes]):
                factors[letter] = ideal[:, k]
                factors[f"|{letter}|"] = np.abs(ideal[:, k])
            moving = np.zeros(free.shape, dtype=np.int64)
            for term in self.terms:
                if term.monomial.of_reading:
                    moving[:, term.monomial.axis] += _term(term, factors)
            ideal = _clamped(free - moving, LIMIT)
        return np.stack([self._row(k, ideal) for k in range(axes)], axis=1)

    def _row(self, k: int, ideal: Whole) -> Whole:
        total = np.zeros(len(ideal), dtype=np.int64)
        for j, entry in enumerate(self.matrix[k][: k + 1]):
            if entry.number:
                total = total + _shifted(ideal[:, j] * entry.number, entry.shift)
        return total

    def angle_udeg(
        self,
        scan: Whole,
        temperature: Whole | None = None,
        supply: Whole | None = None,
        plane: tuple[int, int] = (0, 1),
    ) -> Whole:
        """Angle (n,) in µ° from the first axis of a plane towards the second."""
        gravity = self.correct(scan, temperature, supply)
        return atan2_udeg(gravity[:, plane[1]], gravity[:, plane[0]])


def cordic_table() -> list[int]:
    """atan(2⁻ⁱ) in 2⁻³² of a turn."""
    return [round(math.atan2(1, 1 << i) / (2 * math.pi) * (1 << TURN_BITS)) for i in range(CORDIC_STEPS)]


def atan2_udeg(y: Whole, x: Whole) -> Whole:
    """Angle (n,) in µ° of vectors of whole numbers below 2³¹; 0 where both are zero."""
    ay, ax = np.abs(np.asarray(y, dtype=np.int64)), np.abs(np.asarray(x, dtype=np.int64))
    none = (ax == 0) & (ay == 0)
    for _ in range(TURN_BITS):
        small = (np.maximum(ax, ay) < ONE >> 1) & ~none
        ax, ay = np.where(small, 2 * ax, ax), np.where(small, 2 * ay, ay)
    for _ in range(3):
        large = np.maximum(ax, ay) >= ONE
        ax, ay = np.where(large, ax >> 1, ax), np.where(large, ay >> 1, ay)
    turn = np.zeros(len(ax), dtype=np.int64)
    for i, step in enumerate(cordic_table()):
        sign, size = np.sign(ay), np.abs(ay)
        ax, ay = ax + (size >> i), ay - sign * (ax >> i)
        turn = turn + sign * step
    # From 2³² a turn to 360 000 000 µ°.
    udeg = _shifted(turn * (2 * HALF_TURN_UDEG >> 3), TURN_BITS - 3)
    udeg = np.where(np.asarray(x) < 0, HALF_TURN_UDEG - udeg, udeg)
    return np.where(none, 0, np.where(np.asarray(y) < 0, -udeg, udeg))


def _shifted(values: Whole, bits: int) -> Whole:
    """Values divided by 2^bits and rounded to the nearest, halves upwards."""
    return (values + (1 << (bits - 1))) >> bits if bits > 0 else values << -bits


def _clamped(values: Whole, limit: int) -> Whole:
    return np.clip(values, -limit, limit)


def _condition(constants: tuple[int, Scaled], given: Whole | None, n: int) -> Whole:
    zero, step = constants
    numbers = np.full(n, zero, dtype=np.int64) if given is None else np.asarray(given, dtype=np.int64)
    return _clamped(_shifted((numbers - zero) * step.number, step.shift - Q), ONE)


def _term(term: FixedTerm, factors: dict[str, Whole]) -> Whole:
    first, *rest = term.monomial.factors
    product = factors[first]
    for factor in rest:
        product = _shifted(product * factors[factor], Q)
    return _shifted(product * term.coefficient.number, term.coefficient.shift)
