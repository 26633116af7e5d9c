"""The bound of scripts/information_bound.py, held to likelihoods, formulas and draws of other making."""

import math

import numpy as np
import pytest

import efficiency
import information_bound as bound
from adis_gonio.fitting import fit
from adis_gonio.model.records import Dwell, Session
from adis_gonio.sim.noise import Flicker

TRUTH = np.array([0.7, 1.004, 0.995, 0.006, 12.0, -20.0])
ANGLES = np.radians(np.arange(0, 360, 45.0))


def log_likelihood(parameters, readings_mg, noise_mg, sigma):
    """Of sessions (s, n, 2): each dwell's angle integrated out on a grid, mean over the sessions."""
    alpha, k_x, k_y, phi, b_x, b_y = parameters
    away = sigma * np.linspace(-5, 5, 161)
    psi = alpha - ANGLES[:, None] + away
    misfit = (readings_mg[:, :, 0, None] - 1000 * k_x * np.cos(psi) - b_x) ** 2
    misfit += (readings_mg[:, :, 1, None] - 1000 * k_y * np.sin(psi + phi) - b_y) ** 2
    exponent = -misfit / (2 * noise_mg**2) - away**2 / (2 * sigma**2)
    most = exponent.max(axis=2)
    return float((most + np.log(np.exp(exponent - most[..., None]).sum(axis=2))).sum(axis=1).mean())


@pytest.mark.parametrize("fixture_deg", [0.01, 0.1])
def test_the_bound_is_the_inverse_curvature_of_the_integrated_likelihood(fixture_deg):
    rng = np.random.default_rng(4)
    sigma, noise = math.radians(fixture_deg), 0.2
    alpha, k_x, k_y, phi, b_x, b_y = TRUTH
    psi = alpha - ANGLES + rng.normal(0, sigma, (150, 8))
    clean = np.stack([1000 * k_x * np.cos(psi) + b_x, 1000 * k_y * np.sin(psi + phi) + b_y], axis=2)
    readings = clean + rng.normal(0, noise, clean.shape)
    # Along directions in which the bound says that the parameters are of unit variance and independent.
    half = np.linalg.cholesky(bound.planar_bound(TRUTH, ANGLES, noise, sigma).covariance)
    step = 0.3

    def at(*moves):
        return log_likelihood(TRUTH + half @ (step * np.sum(moves, axis=0)), readings, noise, sigma)

    eye = np.eye(6)
    curvature = [
        [(at(a, b) - at(a, -b) - at(-a, b) + at(-a, -b)) / (4 * step**2) for b in eye] for a in eye
    ]
    # 150 sessions of eight dwells leave a per cent of chance at 0.1°, where the noise is not normal.
    assert -np.array(curvature) == pytest.approx(np.eye(6), abs=0.02)


def test_poses_tell_by_the_length_of_their_readings_alone():
    gravity = efficiency.spread_over_sphere(14)
    perfect = np.array([1.0] * 3 + [0.0] * 6)
    found = bound.spatial_bound(perfect, gravity, 0.2).covariance
    x, y, z = gravity.T
    # d|U| by gains, skews and biases of a perfect part.
    rows = np.stack([1000 * c for c in (x * x, y * y, z * z, x * y, x * z, y * z)] + [x, y, z], axis=1)
    assert found == pytest.approx(np.linalg.inv(rows.T @ rows / 0.2**2), rel=1e-5, abs=1e-12)


def test_the_errors_of_the_attaining_estimator_have_the_covariance_of_the_bound():
    rng = np.random.default_rng(5)
    sigma = math.radians(0.03)
    flicker = efficiency.flicker_covariance(15.0 * np.arange(8), 10.0, 0.1)
    made = bound.planar_bound(TRUTH, ANGLES, 0.2, sigma, flicker_mg2=flicker)
    root = np.linalg.cholesky(flicker)
    errors = []
    for _ in range(4000):
        slow = (root @ rng.standard_normal((8, 2))).T
        nuisance = np.concatenate([rng.normal(0, sigma, 8), slow.ravel()])
        errors.append(made.error(rng.normal(0, 0.2, 16), nuisance))
    half = np.linalg.inv(np.linalg.cholesky(made.covariance))
    assert np.cov(half @ np.array(errors).T) == pytest.approx(np.eye(6), abs=5 * math.sqrt(2 / 4000))


def test_the_written_out_covariance_of_flicker_is_that_of_the_simulator():
    rng = np.random.default_rng(6)
    channels, dwells = 1000, 6
    begin, length = 15.0 * np.arange(dwells), 10.0
    times = begin[:, None] + np.arange(0, length, 1 / 16)
    flicker = Flicker(np.full(channels, 0.1), rng).at(times.ravel())
    means = flicker.reshape(dwells, -1, channels).mean(axis=1)
    stated = efficiency.flicker_covariance(begin, length, 0.1)
    seen = means @ means.T / channels
    # An element of a sample covariance scatters by √((σ_ii σ_jj + σ_ij²)/N).
    scatter = np.sqrt((np.outer(np.diag(stated), np.diag(stated)) + stated**2) / channels)
    assert (np.abs(seen - stated) < 4.5 * scatter).all()
    # What a fit sees are differences of dwells, a thirtieth of that variance.
    apart, said = (
        np.diff(means, axis=0).var(axis=1),
        [stated[k, k] + stated[k + 1, k + 1] - 2 * stated[k, k + 1] for k in range(dwells - 1)],
    )
    assert apart == pytest.approx(said, rel=4.5 * math.sqrt(2 / channels))


def test_a_fit_states_the_bound_of_the_parameters_and_of_the_angle():
    rng = np.random.default_rng(7)
    sigma, noise = math.radians(0.05), 0.2
    angles = np.radians(np.arange(0, 360, 30.0))
    readings = bound.planar_mg(TRUTH, rng.normal(0, sigma, 12) - angles) + rng.normal(0, noise, (12, 2))
    dwells = tuple(
        Dwell(k, np.array([15.0 * k]), readings[k : k + 1], float(np.degrees(angles[k]))) for k in range(12)
    )
    session = Session(dwells, sensor="generic", accel_unit="mg", fixture_sigma_deg=0.05, reading_u_mg=noise)
    result = fit(session, "ml")
    least = bound.planar_bound(TRUTH, angles, noise, sigma)
    unit = {"alpha": 180 / math.pi, "delta_phi": 180 / math.pi}
    for k, name in enumerate(bound.PLANAR):
        stated = math.sqrt(least.covariance[k, k]) * unit.get(name, 1.0)
        assert result[name].u == pytest.approx(stated, rel=0.003), name
    own, reading, _ = bound.angle_bound(TRUTH, least.covariance, np.radians(np.arange(2.5, 360, 5)), noise)
    assert result.shown_angle.u == pytest.approx(math.degrees(math.sqrt((own + reading).mean())), rel=0.003)
