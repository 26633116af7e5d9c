"""Samples inside dwells whose truth is known: filtered, rounded noise, with what a test adds to it.

The signals are made in numpy; the product provides their record and the search that is tested.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from adis_gonio.tracing.within.samples import Samples, WithinFinding
from adis_gonio.tracing.within.second_pass import look_within

Floats = NDArray[np.float64]
Added = Callable[[int, Floats, np.random.Generator], Floats]
"""Dwell, time in the session (n,), generator -> what is added (n, axes), ahead of the converter."""


def bartlett(filter_m: int) -> Floats:
    """Weights of two boxcars of 2^M taps, one after the other."""
    taps = 2**filter_m
    return np.convolve(np.ones(taps), np.ones(taps)) / taps**2


def flicker(rng: np.random.Generator, n: int, density: float) -> Floats:
    """1/f noise (n,), two-sided density `density`/f a sample; cut from a longer course."""
    size = 4 * n
    frequency = np.fft.rfftfreq(size)
    frequency[0] = 1.0
    lines = rng.normal(size=len(frequency)) + 1j * rng.normal(size=len(frequency))
    lines *= np.sqrt(density / frequency * size / 2)
    lines[0] = 0.0
    return np.fft.irfft(lines, size)[:n]


def draw(
    rng: np.random.Generator,
    *,
    dwells: int = 24,
    n: int | Sequence[int] = 500,
    axes: int = 2,
    filter_m: int = 2,
    noise_mg: float = 4.0,
    lsb_mg: float = 0.4672,
    flicker_mg2: float = 0.0,
    period_s: float = 0.01,
    jitter: float = 0.0,
    added: Added | None = None,
) -> Samples:
    """Samples of some dwells, 3 s apart, each about a place of its own between two codes."""
    window = bartlett(filter_m)
    lengths = [n] * dwells if isinstance(n, int) else list(n)
    values, times, now = [], [], 0.0
    for k, length in enumerate(lengths):
        steps = period_s * (1 + jitter * rng.uniform(-1, 1, length))
        time = now + np.cumsum(steps)
        white = rng.normal(0, noise_mg, (length + len(window) - 1, axes))
        rows = np.stack([np.convolve(white[:, a], window, "valid") for a in range(axes)], axis=1)
        if flicker_mg2:
            rows += np.stack([flicker(rng, length, flicker_mg2) for _ in range(axes)], axis=1)
        if added is not None:
            rows += added(k, time, rng)
        rows += rng.uniform(-1000, 1000, axes)
        if lsb_mg:
            rows = np.round(rows / lsb_mg) * lsb_mg
        values.append(rows)
        times.append(time)
        now = float(time[-1]) + 3.0
    return Samples(
        position=np.arange(len(lengths)),
        time_s=tuple(times),
        values=tuple(values),
        quantum=np.full(axes, lsb_mg if lsb_mg else 1e-9),
        reading=np.array([rows.mean(axis=0) for rows in values]),
    )


def kinds(samples: Samples) -> list[str]:
    """Kinds of all findings in the order in which they were found."""
    return [finding.kind for finding in look_within(samples)[0]]


def only(samples: Samples, kind: str) -> WithinFinding | None:
    """The first finding of a kind."""
    return next((finding for finding in look_within(samples)[0] if finding.kind == kind), None)
