"""Covariance of the means of dwells under 1/f noise: against the simulator's noise and against Barnes."""

import math

import numpy as np
import pytest

from adis_gonio.fitting import fit
from adis_gonio.fitting.estimation.spectrum import MOST_MODES, covariance_of_means, modes, scatter_of_means
from adis_gonio.model.records import Dwell, Session
from adis_gonio.sim.noise import Flicker


@pytest.mark.parametrize("dwells", [2, 5, 24, 200])
def test_dwells_without_pauses_scatter_as_barnes_says(dwells: int) -> None:
    begin = 7.0 + 3.0 * np.arange(dwells)
    covariance = covariance_of_means(begin, begin + 3.0)
    about = np.eye(dwells) - 1 / dwells
    assert np.trace(about @ covariance) / (dwells - 1) == pytest.approx(scatter_of_means(dwells), rel=1e-9)
    difference = np.zeros(dwells)
    difference[:2] = 1, -1
    assert difference @ covariance @ difference / 2 == pytest.approx(1.0)  # the Allan variance


@pytest.mark.parametrize("pause_s", [0.0, 12.0])
def test_means_of_simulated_flicker_have_this_covariance(pause_s: float) -> None:
    draws, dwells, length = 1500, 16, 4.0
    begin = 5.0 + (length + pause_s) * np.arange(dwells)
    begin[9:] += 30.0  # a longer pause
    flicker = Flicker(np.ones(draws), np.random.default_rng(11), step_s=1 / 8)
    means = np.array([flicker.at(b + length * (np.arange(16) + 0.5) / 16).mean(axis=0) for b in begin])
    about = means - means.mean(axis=0)
    centre = np.eye(dwells) - 1 / dwells
    expected = centre @ covariance_of_means(begin, begin + length) @ centre
    values, vectors = np.linalg.eigh(expected)
    seen = np.var(vectors[:, 1:].T @ about, axis=1) / values[1:]
    # 1500 draws scatter by 3.7 %; the noise of the simulator is 1/f to a few per cent (a pole each octave).
    np.testing.assert_allclose(seen, 1.0, atol=0.15)
    assert np.trace(about @ about.T / draws) == pytest.approx(np.trace(expected), rel=0.05)


def test_means_differ_from_what_is_found_in_twice_the_time_as_is_said() -> None:
    draws, dwells, length = 1500, 8, 4.0
    begin = 6.0 * np.arange(dwells)
    twice = 2 * (float(begin[-1]) + length)
    flicker = Flicker(np.ones(draws), np.random.default_rng(12), step_s=1 / 4)
    series = flicker.at((np.arange(round(twice * 4)) + 0.5) / 4).reshape(-1, draws)
    means = np.array([series[round(4 * b) : round(4 * (b + length))].mean(axis=0) for b in begin])
    off = means - series.mean(axis=0)
    expected = covariance_of_means(begin, begin + length)
    # Late dwells are nearer to the time after the session than early ones, and differ less from its mean.
    assert expected[-1, -1] < 0.8 * expected[0, 0]
    for weights in (np.eye(dwells)[0], np.eye(dwells)[-1], np.full(dwells, 1 / dwells)):
        # 1500 draws scatter by 3.7 %; the noise of the simulator is 1/f to a few per cent.
        assert np.var(weights @ off) == pytest.approx(weights @ expected @ weights, rel=0.15)


def test_the_mean_of_a_session_differs_from_twice_its_length_by_half_the_allan_variance() -> None:
    begin = 3.0 * np.arange(7)
    covariance = covariance_of_means(begin, begin + 3.0)
    assert covariance.mean() == pytest.approx(0.5)
    assert np.linalg.eigvalsh(covariance)[0] > 0.1


def test_dwells_whose_times_begin_anew_are_taken_one_after_the_other() -> None:
    begin = 3.0 * np.arange(6)
    expected = covariance_of_means(begin, begin + 3.0)
    np.testing.assert_allclose(covariance_of_means(np.zeros(6), np.full(6, 3.0)), expected, atol=1e-9)
    np.testing.assert_allclose(covariance_of_means(begin, begin), expected, atol=1e-9)


def test_few_dwells_keep_all_modes_and_many_the_slowest() -> None:
    begin = 7.5 * np.arange(24)
    covariance = covariance_of_means(begin, begin + 3)
    factor, left = modes(covariance)
    np.testing.assert_allclose(factor @ factor.T, covariance, atol=1e-9)
    assert left.max() < 1e-9
    begin = 7.5 * np.arange(3 * MOST_MODES)
    covariance = covariance_of_means(begin, begin + 3)
    factor, left = modes(covariance)
    assert factor.shape == (3 * MOST_MODES, MOST_MODES)
    np.testing.assert_allclose((factor**2).sum(axis=1) + left, np.diagonal(covariance), rtol=1e-9)
    drift = begin - begin.mean()
    slow = drift @ factor
    assert slow @ slow == pytest.approx(drift @ covariance @ drift, rel=1e-4)


BIAS_MG = np.array([12.0, -7.0])
DWELLS, LENGTH_S, STEP_S, RATE_HZ = 24, 4.0, 7.5, 32.0


def sessions_in_flicker(draws: int, seed: int) -> list[tuple[Session, np.ndarray, np.ndarray]]:
    """Planar sessions, and their biases as means over twice the session and over the session itself."""
    rng = np.random.default_rng(seed)
    duration = (DWELLS - 1) * STEP_S + LENGTH_S
    grid_s = (np.arange(round(2 * duration * 8)) + 0.5) / 8
    flicker = Flicker(np.full(2 * draws, 0.2), rng, step_s=1 / 8).at(grid_s).reshape(-1, draws, 2)
    theta = 2 * math.pi * np.arange(DWELLS) / DWELLS
    within = (np.arange(round(LENGTH_S * RATE_HZ)) + 0.5) / RATE_HZ
    made = []
    for own in flicker.transpose(1, 0, 2):
        dwells = []
        for k, psi in enumerate(0.4 - theta + rng.normal(0, math.radians(0.02), DWELLS)):
            time = k * STEP_S + within
            noise = np.stack([np.interp(time, grid_s, own[:, axis]) for axis in (0, 1)], axis=1)
            ideal = 1000 * np.array([math.cos(psi), math.sin(psi + 0.003)])
            accel = ideal + BIAS_MG + noise + rng.normal(0, 1.0, noise.shape)
            dwells.append(Dwell(k, time, accel, math.degrees(theta[k])))
        session = Session(tuple(dwells), sensor="generic", accel_unit="mg", fixture_sigma_deg=0.02)
        twice, once = own.mean(axis=0), own[: len(own) // 2].mean(axis=0)
        made.append((session, BIAS_MG + twice, BIAS_MG + once))
    return made


def test_u_of_a_bias_is_for_its_mean_over_twice_the_session() -> None:
    off, near = [], []
    for session, twice, once in sessions_in_flicker(60, 7):
        result = fit(session, method="ml")
        for name, defined, own in zip(("bias_x", "bias_y"), twice, once, strict=True):
            bias = result[name]
            off.append(abs(bias.value - defined) / bias.U)
            near.append((bias.value - own) / bias.u)
    # 120 biases: the standard deviation of the share is 2 %.
    assert np.mean(np.array(off) <= 1) == pytest.approx(0.95, abs=0.045)
    # Sessions repeated at once scatter like the deviation from the mean over the session itself.
    assert 0.3 < np.std(near) < 0.6
