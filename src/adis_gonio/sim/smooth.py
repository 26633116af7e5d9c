"""Smooth movement in pieces: grips, sums of sines, products, each with its exact derivatives.

Figures of hands are estimates (D); where they come from is said in `hand`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats

Course = tuple[Floats, Floats, Floats]
"""A function of time (n,) with its first and second derivative."""

SEGMENT_DEG = (40.0, 120.0)
"""How far a grip goes."""
PAUSE_S = (0.2, 0.9)
"""How long the next grip takes."""
SUBMOVEMENT_HZ = (0.5, 3.0)
TREMOR_HZ = (8.0, 12.0)
SWAY_HZ = (0.05, 0.5)
RISE_S = 0.5
"""The hand takes hold, and lets go, within this time."""
_LINES = 12


@dataclass(frozen=True)
class Sines:
    """Sines of random frequency and phase with a root mean square of 1 in all."""

    omega: Floats
    phase: Floats

    @classmethod
    def drawn(cls, rng: np.random.Generator, band_hz: tuple[float, float]) -> Sines:
        """Sines of frequencies in a band."""
        omega = 2 * np.pi * rng.uniform(*band_hz, _LINES)
        return cls(omega, rng.uniform(0, 2 * np.pi, _LINES))

    def at(self, time_s: Floats) -> Course:
        """Value and its two derivatives (n,)."""
        value, first, second = (np.zeros(len(time_s)) for _ in range(3))
        size = np.sqrt(2 / _LINES)
        for omega, phase in zip(self.omega, self.phase, strict=True):
            sine, cosine = np.sin(omega * time_s + phase), np.cos(omega * time_s + phase)
            value += size * sine
            first += size * omega * cosine
            second -= size * omega**2 * sine
        return value, first, second

    @property
    def mean_square_rate(self) -> float:
        """Of the first derivative."""
        return float((self.omega**2).mean())


def grips(turn_deg: float, rng: np.random.Generator) -> Floats:
    """Spans (k,) of the grips in degrees, as they come: together at least as far as asked for."""
    spans: list[float] = []
    while sum(spans) < turn_deg:
        spans.append(float(rng.uniform(*SEGMENT_DEG)))
    return np.array(spans)


def minimum_jerk(time_s: Floats, begin_s: float, length_s: float, span: float) -> Course:
    """A movement over a span that begins and ends at rest (Flash & Hogan 1985)."""
    value, first, second = rise((time_s - begin_s) / length_s)
    return span * value, span / length_s * first, span / length_s**2 * second


def hold(time_s: Floats, length_s: float) -> Course:
    """How firmly a hand holds from 0 s to `length_s`, 0 to 1; 0 before and after."""
    up, down = rise(time_s / RISE_S), rise((length_s - time_s) / RISE_S)
    scale = 1 / RISE_S
    up = (up[0], up[1] * scale, up[2] * scale**2)
    down = (down[0], -down[1] * scale, down[2] * scale**2)
    return product(up, down)


def rise(x: Floats) -> Course:
    """Minimum-jerk step from 0 to 1 with two derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return (
        x**3 * (10 - 15 * x + 6 * x**2),
        30 * x**2 * (1 - x) ** 2,
        60 * x * (1 - x) * (1 - 2 * x),
    )


def product(f: Course, g: Course) -> Course:
    """Product of two functions with two derivatives."""
    return f[0] * g[0], f[1] * g[0] + f[0] * g[1], f[2] * g[0] + 2 * f[1] * g[1] + f[0] * g[2]
