"""Uncertainties where neighbouring dwells share 1/f noise: against the scatter of many drawn sessions."""

from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.fitting import fit
from adis_gonio.fitting.estimation import readings as module
from adis_gonio.fitting.estimation.readings import Readings, flicker_parts, from_means, readings_of
from adis_gonio.fitting.estimation.spectrum import covariance_of_means, scatter_of_means, spans
from adis_gonio.fitting.methods import fit_readings
from adis_gonio.model.effects import Conditions
from adis_gonio.model.records import Dwell, Session

G = 1000.0
U_MG, FLICKER_MG, FIXTURE_RAD = 0.03, 0.1, 1e-5
DWELLS = 12


def dwells(count: int = DWELLS, length_s: float = 3.0, samples: int = 7) -> list[Dwell]:
    period = length_s / samples
    return [
        Dwell(position=k, time_s=k * length_s + period * np.arange(samples), accel=np.zeros((samples, 2)))
        for k in range(count)
    ]


def modes_of(*parts: Dwell) -> Readings:
    """Readings of dwells under 1/f noise, whatever their samples."""
    flicker = np.full(2, FLICKER_MG**2)
    many = np.array([k for k, part in enumerate(parts) if len(part) > 1])
    own, shared = flicker_parts(*spans([parts[k].time_s for k in many]), flicker)
    slow = np.zeros((len(parts), *shared.shape[1:]))
    slow[many] = shared
    covariance = np.tile(U_MG**2 * np.eye(2), (len(parts), 1, 1))
    covariance[many] += own[:, :, None] * np.eye(2)
    mean = np.zeros((len(parts), 2))
    return from_means(mean, covariance, Conditions(time_s=np.arange(float(len(parts)))), slow=slow)


def drawn(rng: np.random.Generator, root: np.ndarray, *, shared: bool = True) -> Readings:
    """Readings of one turn in order, with noise of covariance root rootᵀ on each axis."""
    theta = 2 * np.pi * np.arange(DWELLS) / DWELLS
    psi = 0.2 - theta
    ideal = np.stack([1.01 * np.cos(psi), np.sin(psi + 0.005)], axis=1)
    mean = G * ideal + [8.0, -5.0]
    mean = mean + root @ rng.normal(size=(DWELLS, 2)) + U_MG * rng.normal(size=(DWELLS, 2))
    made = replace(modes_of(*dwells()), mean=mean, angle_rad=theta, fixture_rad=FIXTURE_RAD)
    if shared:
        return made
    own = U_MG**2 + FLICKER_MG**2 * scatter_of_means(DWELLS)
    none = made.slow[:, :, :0]
    return replace(made, own_covariance=np.tile(own * np.eye(2), (DWELLS, 1, 1)), slow=none)


NAMES = ("delta_k", "delta_phi", "scale_x", "scale_y", "bias_x", "bias_y")


def flicker_root() -> np.ndarray:
    """A root of the covariance of the dwells' means."""
    begin = 3.0 * np.arange(DWELLS)
    values, vectors = np.linalg.eigh(covariance_of_means(begin, begin + 3.0))
    return FLICKER_MG * vectors * np.sqrt(np.maximum(values, 0.0))


@pytest.mark.parametrize("method", ["ml", "mmpm"])
def test_u_is_the_noise_of_the_means_carried_through_the_fit(method: str) -> None:
    """By differences of fits: the noise that a reading has goes into each result by its slope."""
    root = flicker_root()
    readings = drawn(np.random.default_rng(5), root)
    stated = fit_readings(readings, method)
    assert not stated.extra_mg

    def values(move: np.ndarray) -> np.ndarray:
        found = fit_readings(replace(readings, mean=readings.mean + move.reshape(-1, 2)), method)
        return np.array([found[name].value for name in NAMES])

    step = 0.01
    slopes = np.array([values(move) - values(-move) for move in step * np.eye(2 * DWELLS)]) / (2 * step)
    noise = np.kron(root @ root.T + U_MG**2 * np.eye(DWELLS), np.eye(2))
    u = np.sqrt(np.diagonal(slopes.T @ noise @ slopes))
    # As noise of each reading's own the variance of the gains would be a fifth more.
    np.testing.assert_allclose([stated[name].u for name in NAMES], u, rtol=0.02)


def test_noise_of_each_dwells_own_understates_the_gains() -> None:
    rng = np.random.default_rng(5)
    theirs = fit_readings(drawn(rng, np.zeros((DWELLS, DWELLS)), shared=False), "mmpm")
    shared = fit_readings(drawn(rng, np.zeros((DWELLS, DWELLS))), "mmpm")
    assert shared["scale_x"].u > 1.08 * theirs["scale_x"].u


def test_what_is_shared_is_the_covariance_of_the_means_with_that_of_the_time_after() -> None:
    slow = modes_of(*dwells()).slow[:, 0, :DWELLS]
    begin = 3.0 * np.arange(DWELLS)
    np.testing.assert_allclose(
        slow @ slow.T / FLICKER_MG**2, covariance_of_means(begin, begin + 3.0), atol=1e-9
    )


def test_averages_of_a_known_part_without_a_stated_noise_share_its_noise() -> None:
    begin = np.arange(24.0)
    values, vectors = np.linalg.eigh(covariance_of_means(begin, begin + 1.0))
    root = FLICKER_MG * vectors * np.sqrt(np.maximum(values, 0.0))
    rng = np.random.default_rng(6)
    angle = np.radians(15.0 * begin)
    ideal = np.stack([1.01 * np.cos(0.2 - angle), np.sin(0.205 - angle)], axis=1)
    off = []
    for _ in range(60):
        accel = G * ideal + [8.0, -5.0] + root @ rng.normal(size=(24, 2)) + U_MG * rng.normal(size=(24, 2))
        means = [
            Dwell(position=k, time_s=np.array([30.0 * k]), accel=accel[k : k + 1], angle_deg=15.0 * k)
            for k in range(24)
        ]
        session = Session(means, sensor="adis16354", accel_unit="mg", fixture_sigma_deg=0.0)
        result = fit(session, method="mmpm")
        truth = {"scale_x": 1.01, "scale_y": 1.0, "bias_x": 8.0, "bias_y": -5.0}
        off.append([(result[name].value - true) / result[name].u for name, true in truth.items()])
    # As noise of each reading alone the scatter is 2.5 to 2.7 u.
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(off), axis=0)), 0.95, atol=0.3)


def test_single_samples_have_no_part_in_it() -> None:
    mixed = modes_of(*dwells(4), Dwell(position=9, time_s=np.array([90.0]), accel=np.zeros((1, 2))))
    assert not mixed.slow[-1].any()
    assert mixed.slow[:-1].any()


def test_thousands_of_dwells_are_left_to_noise_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_SHARED", 5)
    alone = modes_of(*dwells(6))
    assert not alone.slow.size
    own = U_MG**2 + FLICKER_MG**2 * scatter_of_means(6)
    np.testing.assert_allclose(alone.own_covariance[:, 0, 0], own)
    assert modes_of(*dwells(5)).slow.size


def test_some_of_the_readings_keep_what_they_share() -> None:
    readings = drawn(np.random.default_rng(1), np.zeros((DWELLS, DWELLS)))
    some = np.array([1, 4, 6])
    np.testing.assert_array_equal(readings.rows(some).slow, readings.slow[some])


def test_a_session_is_reduced_once_and_its_readings_kept_with_it() -> None:
    rng = np.random.default_rng(2)
    made = tuple(
        Dwell(k, 3.0 * k + 0.1 * np.arange(20), rng.normal([1000.0, 0.0], 1.0, (20, 2))) for k in range(3)
    )
    session = Session(made, accel_unit="mg", sensor="generic", fixture_sigma_deg=np.inf)
    assert readings_of(session) is readings_of(session)
    again = replace(session, reading_u_mg=1.0)
    assert readings_of(again) is not readings_of(session)
