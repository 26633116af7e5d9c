"""Readings of several sessions in a plane, drawn with parts, stages and effects that are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.model.effects import Conditions, Effect, Enters
from adis_gonio.model.measurement import PlanarTurn, SessionOrigin

Present = Sequence[tuple[Effect, Sequence[float]]]
U_MG, FIXTURE_DEG, DWELLS = 0.2, 0.02, 24
SESSION_MG = 1.0
"""Scatter of a bias between sessions."""


def draw_part(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Gains and Δφ (3,), and biases in mg (2,) of a part."""
    return np.array([*rng.normal(1, 0.01, 2), np.deg2rad(rng.normal(0, 0.3))]), rng.normal(0, 10, 2)


def draw_session(
    rng: np.random.Generator, part: tuple[np.ndarray, np.ndarray], present: Present = ()
) -> Readings:
    """One session of a part with effects at these values; noise and fixture are stated rightly."""
    n = DWELLS
    theta, time = np.deg2rad(rng.permutation(n) * 360 / n), 60.0 * np.arange(n) + 5
    conditions = Conditions(
        time_s=time,
        angle_rad=theta,
        order=np.arange(float(n)),
        approach=rng.choice([-1.0, 1.0], n),
        previous_angle_rad=np.concatenate([theta[:1], theta[:-1]]),
        temperature_c=25 + 3 * (1 - np.exp(-time / 600)) + rng.normal(0, 0.05, n),
    )
    gains, bias = part
    base = np.array([rng.uniform(0, 2 * np.pi), *gains])
    turn, sigma = -theta, np.deg2rad(FIXTURE_DEG)
    for one, values in present:
        if one.enters is Enters.ATTITUDE:
            turn = turn + one.attitude_rad(np.array(values), conditions)
    ideal = PlanarTurn(1000.0).ideal(base, sigma * rng.normal(size=n), turn)
    mean = ideal + bias + SESSION_MG * rng.normal(size=2) + U_MG * rng.normal(size=(n, 2))
    for one, values in present:
        if one.enters is Enters.READING:
            mean = mean + one.reading(np.array(values), ideal, conditions)
    covariance = np.tile(U_MG**2 * np.eye(2), (n, 1, 1))
    return from_means(mean, covariance, conditions, fixture_rad=sigma)


def origins(count: int, parts: int = 1, stages: int = 1) -> list[SessionOrigin]:
    """Names of sessions that take parts and stages in turn."""
    return [SessionOrigin(f"s{k}", f"part{k % parts}", f"stage{k % stages}") for k in range(count)]


def draw_fleet(
    rng: np.random.Generator, count: int, parts: int = 1, present: Present = ()
) -> tuple[list[Readings], list[SessionOrigin]]:
    """Sessions of parts on one stage, all with the same effects."""
    every = [draw_part(rng) for _ in range(parts)]
    return [draw_session(rng, every[k % parts], present) for k in range(count)], origins(count, parts)
