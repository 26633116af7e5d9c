"""Covariance of the means of dwells under 1/f noise: against the simulator's noise and against Barnes."""

import numpy as np
import pytest

from adis_gonio.estimation.flicker import MOST_MODES, covariance_of_means, modes, scatter_of_means
from adis_gonio.sim.noise import Flicker


@pytest.mark.parametrize("dwells", [2, 5, 24, 200])
def test_dwells_without_pauses_scatter_as_barnes_says(dwells: int) -> None:
    begin = 7.0 + 3.0 * np.arange(dwells)
    covariance = covariance_of_means(begin, begin + 3.0)
    assert np.trace(covariance) / (dwells - 1) == pytest.approx(scatter_of_means(dwells), rel=1e-9)
    difference = np.zeros(dwells)
    difference[:2] = 1, -1
    assert difference @ covariance @ difference / 2 == pytest.approx(1.0)  # the Allan variance


@pytest.mark.parametrize("pause_s", [0.0, 4.5, 12.0])
def test_means_of_simulated_flicker_have_this_covariance(pause_s: float) -> None:
    draws, dwells, length = 1500, 16, 4.0
    begin = 5.0 + (length + pause_s) * np.arange(dwells)
    begin[9:] += 30.0  # a longer pause
    flicker = Flicker(np.ones(draws), np.random.default_rng(11), step_s=1 / 8)
    means = np.array([flicker.at(b + length * (np.arange(16) + 0.5) / 16).mean(axis=0) for b in begin])
    about = means - means.mean(axis=0)
    expected = covariance_of_means(begin, begin + length)
    values, vectors = np.linalg.eigh(expected)
    seen = np.var(vectors[:, 1:].T @ about, axis=1) / values[1:]
    # 1500 draws scatter by 3.7 %; the noise of the simulator is 1/f to a few per cent (a pole each octave).
    np.testing.assert_allclose(seen, 1.0, atol=0.15)
    assert np.trace(about @ about.T / draws) == pytest.approx(np.trace(expected), rel=0.05)


def test_the_mean_over_all_dwells_has_no_variance() -> None:
    begin = np.array([0.0, 5.0, 9.0, 31.0, 50.0])
    covariance = covariance_of_means(begin, begin + np.array([3.0, 2.0, 4.0, 10.0, 1.0]))
    np.testing.assert_allclose(covariance.sum(axis=0), 0.0, atol=1e-12)
    assert np.linalg.eigvalsh(covariance)[1] > 0.1


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
