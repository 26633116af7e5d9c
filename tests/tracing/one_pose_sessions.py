"""Simulated sessions of one pose: a course of the zero, with or without a cause in the catalogue.

Own physics in numpy; nothing here imports the search.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adis_gonio.model.records import Dwell, Session

Floats = NDArray[np.float64]

CAUSELESS = ("white", "jump", "two jumps", "telegraph", "random walk", "flicker")
CAUSES = {
    "drift": "bias_drift",
    "warm-up": "warm_up",
    "temperature": "bias_temperature",
    "lag": "thermal_lag",
}
"""Kinds of sessions with a cause, and the name of each cause in the catalogue."""


def flicker(rng: np.random.Generator, count: int, slope: float = 0.5) -> Floats:
    """Noise (n,) with a spectrum proportional to f^(−2 slope), by filtering white noise; unit variance."""
    spectrum = np.fft.rfft(rng.normal(size=4 * count))
    frequency = np.fft.rfftfreq(4 * count)
    frequency[0] = np.inf
    noise = np.fft.irfft(spectrum / frequency**slope)[:count]
    return np.asarray((noise - noise.mean()) / noise.std())


def temperature_course(rng: np.random.Generator, x: Floats) -> Floats:
    """Temperature in °C along a session, x from 0 to 1: a self-heating, a slow wander, or cycles."""
    kind = rng.integers(3)
    if kind == 0:
        course = rng.uniform(2, 8) * (1 - np.exp(-x / rng.uniform(0.1, 0.4)))
    elif kind == 1:
        course = np.interp(x, np.linspace(0, 1, 9), np.cumsum(rng.normal(0, 1.5, 9)))
    else:
        course = rng.uniform(3, 10) * np.sin(2 * np.pi * (rng.uniform(0.8, 3) * x + rng.random()))
    return 25 + course + 0.02 * rng.normal(size=len(x))


def course_of(kind: str, rng: np.random.Generator, x: Floats, temperature: Floats) -> Floats:
    """Course (n,) of the zero, of about unit size, for a session of this kind."""
    if kind in {"jump", "two jumps"}:
        places = rng.uniform(0.1, 0.9, 1 if kind == "jump" else 2)
        return np.asarray(sum(np.where(x > place, rng.choice([-1.0, 1.0]), 0.0) for place in places))
    if kind == "telegraph":
        flips = rng.random(len(x)) < 6 / len(x)
        return np.where(np.cumsum(flips) % 2 > 0, 1.0, 0.0)
    if kind == "random walk":
        walk = np.cumsum(rng.normal(size=len(x)))
        return np.asarray(walk / np.sqrt(len(x)) * 2)
    if kind == "flicker":
        return flicker(rng, len(x))
    if kind == "drift":
        return np.asarray(2 * x)
    if kind == "warm-up":
        return np.asarray(2 * np.exp(-x / rng.uniform(0.05, 0.2)))
    if kind == "temperature":
        return np.asarray(2 * (temperature - temperature.mean()) / np.ptp(temperature))
    if kind == "lag":
        late = temperature.copy()
        share = 1 / (len(x) * rng.uniform(0.02, 0.1))
        for k in range(1, len(x)):
            late[k] = late[k - 1] + share * (temperature[k] - late[k - 1])
        return np.asarray(2 * (late - temperature) / np.ptp(late - temperature))
    return np.zeros(len(x))


def one_pose(kind: str, seed: int, beside: float = 0.0) -> Session:
    """Return a session of one pose whose zero has a course of this kind.

    The course is 1 to 4 mg large on one to three axes, and the noise of a sample 0.5 to 2 mg. `beside` is
    the size in mg of flicker noise beneath the course.
    """
    rng = np.random.default_rng((seed, *kind.encode()))
    count = int(rng.integers(1500, 5000))
    spacing = float(rng.choice([0.1, 0.5, 2.0]))
    x = np.linspace(0, 1, count)
    temperature = temperature_course(rng, x)
    sizes = rng.uniform(1, 4, 3) * rng.choice([-1, 1], 3) * (np.arange(3) < rng.integers(1, 4))
    rng.shuffle(sizes)
    own = kind in {"random walk", "flicker"}  # each axis has its own noise
    courses = [course_of(kind, rng, x, temperature) for _ in range(3 if own else 1)]
    accel = np.array([4.0, -9.0, -998.0]) + rng.uniform(0.5, 2.0) * rng.normal(size=(count, 3))
    for axis in range(3):
        accel[:, axis] += sizes[axis] * courses[axis % len(courses)]
        accel[:, axis] += beside * flicker(rng, count)
    dwell = Dwell(0, spacing * np.arange(count), accel, temperature_c=temperature)
    return Session((dwell,), accel_unit="mg", plane=None, sensor="generic")
