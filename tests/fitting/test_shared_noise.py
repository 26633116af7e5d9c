"""Uncertainties where neighbouring dwells share 1/f noise: against the scatter of many drawn sessions."""

import numpy as np
import pytest

from adis_gonio.fitting import readings as module
from adis_gonio.estimation.flicker import covariance_of_means, scatter_of_means
from adis_gonio.fitting.methods import fit_readings
from adis_gonio.estimation.readings import Readings, shared_by
from adis_gonio.model.geometry import planar_ideal
from adis_gonio.model.records import Dwell

G = 1000.0
U_MG, FLICKER_MG, FIXTURE_RAD = 0.03, 0.1, 1e-5
DWELLS = 12


def dwells(count: int = DWELLS, length_s: float = 3.0, samples: int = 7) -> list[Dwell]:
    period = length_s / samples
    return [
        Dwell(position=k, time_s=k * length_s + period * np.arange(samples), accel=np.zeros((samples, 2)))
        for k in range(count)
    ]


def drawn(rng: np.random.Generator, root: np.ndarray, shared: np.ndarray | None) -> Readings:
    """Readings of one turn in order, with noise of covariance root rootᵀ on each axis."""
    theta = 2 * np.pi * np.arange(DWELLS) / DWELLS
    mean = G * planar_ideal(0.2 - theta, 0.005) * [1.01, 1.0] + [8.0, -5.0]
    mean = mean + root @ rng.normal(size=(DWELLS, 2)) + U_MG * rng.normal(size=(DWELLS, 2))
    own = U_MG**2 + FLICKER_MG**2 * scatter_of_means(DWELLS)
    return Readings(
        mean=mean,
        covariance=np.tile(own * np.eye(2), (DWELLS, 1, 1)),
        dof=np.full(DWELLS, np.inf),
        angle_rad=theta,
        position=np.arange(DWELLS),
        samples=np.full(DWELLS, 7),
        known=np.ones(DWELLS, dtype=bool),
        unit="mg",
        gravity_mg=G,
        fixture_sigma_rad=FIXTURE_RAD,
        flicker=np.full(2, FLICKER_MG**2),
        shared=shared,
    )


@pytest.mark.parametrize("method", ["ml", "mmpm", "four-position"])
def test_what_results_scatter_by_is_what_they_state(method: str) -> None:
    begin = 3.0 * np.arange(DWELLS)
    values, vectors = np.linalg.eigh(covariance_of_means(begin, begin + 3.0) + 0.5)
    root = FLICKER_MG * vectors * np.sqrt(np.maximum(values, 0.0))
    rng = np.random.default_rng(5)
    shared = shared_by(dwells())
    names = ("delta_k", "delta_phi", "scale_x", "scale_y", "bias_x", "bias_y")
    results = [fit_readings(drawn(rng, root, shared), method) for _ in range(700)]
    found = np.array([[r[name].value for name in names] for r in results])
    stated = np.array([[r[name].u for name in names] for r in results])
    ratio = found.var(axis=0, ddof=1) / (stated**2).mean(axis=0)
    # 700 draws scatter by 5.3 %; as noise of each reading's own the gains' variance would be a fifth more.
    np.testing.assert_allclose(ratio, 1.0, atol=0.19)


def test_noise_of_each_dwells_own_understates_the_gains() -> None:
    rng = np.random.default_rng(5)
    theirs = fit_readings(drawn(rng, np.zeros((DWELLS, DWELLS)), None), "mmpm")
    shared = fit_readings(drawn(rng, np.zeros((DWELLS, DWELLS)), shared_by(dwells())), "mmpm")
    assert shared["scale_x"].u > 1.08 * theirs["scale_x"].u


def test_what_is_shared_has_the_trace_of_the_covariance_and_no_part_in_single_samples() -> None:
    shared = shared_by(dwells())
    assert shared is not None
    assert np.trace(shared) == pytest.approx(0.5 * DWELLS - scatter_of_means(DWELLS))
    mixed = [*dwells(4), Dwell(position=9, time_s=np.array([90.0]), accel=np.zeros((1, 2)))]
    out = shared_by(mixed)
    assert out is not None
    assert not out[-1].any()
    assert not out[:, -1].any()


def test_thousands_of_dwells_are_left_to_noise_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_SHARED", 5)
    assert shared_by(dwells(6)) is None
    assert shared_by(dwells(5)) is not None


def test_some_of_the_readings_keep_what_they_share() -> None:
    readings = drawn(np.random.default_rng(1), np.zeros((DWELLS, DWELLS)), shared_by(dwells()))
    some = np.array([1, 4, 6])
    chosen = readings.select(some)
    assert readings.shared is not None
    np.testing.assert_array_equal(chosen.shared, readings.shared[np.ix_(some, some)])
