"""The `float` arithmetic of the C header, in Python: the same operations in the same order.

Every operation is one of IEEE 754 single precision, which has one right answer, so that a compiler that
keeps to it (no fused multiply-add, no wider registers) gives the same bits. The angle is found without a
library: a quotient, a reduction to |q| ≤ tan 22.5°, and a polynomial (`ATAN`, relative error 2.6e-9).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adis_gonio.handover.polynomial import RANGE_G, Polynomial

Single = NDArray[np.float32]

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
"""Bound of the angle's error in degrees by rounding to single precision: 180° has 1.5e-5 a place."""


@dataclass(frozen=True)
class SinglePrecision:
    """What the header's `float` functions compute."""

    polynomial: Polynomial

    def correct(
        self, scan: ArrayLike, temperature: ArrayLike | None = None, supply: ArrayLike | None = None
    ) -> Single:
        """Gravity (n, axes) in units of local gravity of scans (n, axes) in 1/256 step."""
        p, f = self.polynomial, np.float32
        scan = np.asarray(scan)[:, : p.axes].astype(np.float32)
        limit = f(RANGE_G)
        free = [np.clip((scan[:, i] - f(p.bias[i])) * f(p.step_g[i]), -limit, limit) for i in range(p.axes)]
        n = len(scan)
        factors = {
            "t": _condition(p.temperature.zero, p.temperature.step, temperature, n),
            "v": _condition(p.supply.zero, p.supply.step, supply, n),
        }
        free = [
            np.clip(free[i] - self._sum(i, factors, n, of_reading=False), -limit, limit)
            for i in range(p.axes)
        ]
        ideal = list(free)
        for _ in range(p.passes):
            for k, letter in enumerate("xyz"[: p.axes]):
                factors[letter], factors[f"|{letter}|"] = ideal[k], np.abs(ideal[k])
            ideal = [
                np.clip(free[i] - self._sum(i, factors, n, of_reading=True), -limit, limit)
                for i in range(p.axes)
            ]
        rows = []
        for k in range(p.axes):
            total: Single = np.zeros(n, dtype=np.float32)
            for j in range(k + 1):
                if p.matrix[k, j] != 0.0:
                    total = total + f(p.matrix[k, j]) * ideal[j]
            rows.append(total)
        return np.stack(rows, axis=1)

    def _sum(self, axis: int, factors: dict[str, Single], n: int, *, of_reading: bool) -> Single:
        total = np.zeros(n, dtype=np.float32)
        for one in self.polynomial.monomials:
            if one.axis == axis and one.of_reading is of_reading:
                product = np.full(n, np.float32(one.coefficient))
                for factor in one.factors:
                    product = product * factors[factor]
                total = total + product
        return total

    def angle_deg(
        self,
        scan: ArrayLike,
        temperature: ArrayLike | None = None,
        supply: ArrayLike | None = None,
        plane: tuple[int, int] = (0, 1),
    ) -> Single:
        """Angle (n,) in degrees from the first axis of a plane towards the second."""
        gravity = self.correct(scan, temperature, supply)
        return atan2_deg(gravity[:, plane[1]], gravity[:, plane[0]])


def atan2_deg(y: Single, x: Single) -> Single:
    """Angle (n,) in degrees; 0 where both are zero."""
    f = np.float32
    ay, ax = np.abs(y), np.abs(x)
    high, low = np.maximum(ax, ay), np.minimum(ax, ay)
    with np.errstate(invalid="ignore", divide="ignore"):
        q = _single(low / high)
    far = q > f(TAN_EIGHTH)
    q = _either(far, _single((q - f(1)) / (q + f(1))), q)
    s = _single(q * q)
    tail: Single = np.full(len(q), ATAN[-1], dtype=np.float32)
    for coefficient in ATAN[-2::-1]:
        tail = _single(tail * s + f(coefficient))
    angle = _single((q + q * s * tail) * f(DEGREES))
    angle = _either(far, _single(f(45) + angle), angle)
    angle = _either(ay > ax, _single(f(90) - angle), angle)
    angle = _either(x < 0, _single(f(180) - angle), angle)
    angle = _either(y < 0, -angle, angle)
    return _either(high == 0, np.zeros_like(angle), angle)


def _single(values: ArrayLike) -> Single:
    """The same, which is in single precision already: for the type checker."""
    assert np.asarray(values).dtype == np.float32
    return np.asarray(values, dtype=np.float32)


def _either(mask: NDArray[np.bool_], yes: Single, no: Single) -> Single:
    return np.asarray(np.where(mask, yes, no), dtype=np.float32)


def _condition(zero: int, step: float, given: ArrayLike | None, n: int) -> Single:
    numbers = np.full(n, zero) if given is None else np.asarray(given)
    f = np.float32
    return np.asarray(np.clip((numbers.astype(np.float32) - f(zero)) * f(step), f(-1), f(1)))
