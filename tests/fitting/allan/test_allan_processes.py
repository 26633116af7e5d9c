"""Densities, ordinates and likelihood against dense algebra and quadrature written anew here."""

import math

import numpy as np
import pytest
from scipy import fft, integrate, optimize, stats

from adis_gonio.device.sensor.settings import filter_weights
from adis_gonio.fitting.allan.spectral_likelihood import (
    KINDS,
    Likelihood,
    line,
    ordinates,
    profile,
    variances,
    variograms,
)

PERIOD_S = 0.02
NOTHING = np.zeros(0, np.intp)


def density(kind, frequency, period_s):
    """Two-sided density a sample at cycles a sample, per squared coefficient, unfiltered."""
    return {
        "quantization": 4 * np.sin(np.pi * frequency) ** 2 / period_s**2,
        "white": 1 / period_s,
        "flicker": 1 / (4 * math.log(2) * frequency),
        "walk": period_s / (4 * np.sin(np.pi * frequency) ** 2),
    }[kind]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("filter_m", [0, 2])
def test_variograms_are_the_integrals_of_the_densities(kind, filter_m):
    taps = 1 << filter_m
    found = variograms(filter_m, 40, PERIOD_S)[:, KINDS.index(kind)]

    def change(frequency, lag):
        box = np.sin(np.pi * frequency * taps) / (taps * np.sin(np.pi * frequency))
        return 2 * box**4 * density(kind, frequency, PERIOD_S) * (1 - np.cos(2 * np.pi * frequency * lag))

    for lag in (1, 7, 39):
        expected, _ = integrate.quad(change, 1e-12, 0.5, args=(lag,), limit=500)
        assert found[lag] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("kind", "within"), [("quantization", 1e-9), ("white", 1e-9), ("flicker", 2e-3), ("walk", 1e-9)]
)
def test_ordinates_have_the_variances_of_the_dense_transform(kind, within):
    n = 300
    gamma = variograms(0, n, PERIOD_S)[:, KINDS.index(kind)]
    dense = -gamma[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))]
    basis = fft.dct(np.eye(n), type=2, norm="ortho", axis=0)[1:]
    transformed = basis @ dense @ basis.T
    found = variances(0, n, np.arange(1.0, n), PERIOD_S)[:, KINDS.index(kind)]
    assert found == pytest.approx(np.diagonal(transformed), rel=within)
    scale = np.sqrt(np.diagonal(transformed))
    correlation = transformed / np.outer(scale, scale) - np.eye(n - 1)
    if kind != "quantization":  # whose lowest ordinates are the record's two ends
        assert np.abs(correlation).max() < (0.13 if kind == "flicker" else 1e-8)


def test_the_line_is_the_transform_of_a_line():
    n = 57
    assert line(n, np.arange(1.0, n)) == pytest.approx(
        fft.dct(np.arange(float(n)), type=2, norm="ortho")[1:], abs=1e-9
    )


def test_white_noise_and_walk_have_the_maximum_of_the_dense_restricted_likelihood():
    rng = np.random.default_rng(8)
    n, white, walk = 400, 0.05, 0.06
    record = white / math.sqrt(PERIOD_S) * rng.standard_normal(n)
    record += walk * math.sqrt(PERIOD_S) * np.cumsum(rng.standard_normal(n)) + 0.003 * np.arange(n)
    data = ordinates(record, 0, PERIOD_S, np.zeros(1), NOTHING)
    likelihood = Likelihood(data, without=(0, 2))
    theta, _ = likelihood.best()

    trend = np.stack([np.ones(n), np.linspace(-1, 1, n)], axis=1)
    steps = np.minimum.outer(np.arange(n), np.arange(n)) * PERIOD_S

    def loss(logs):
        v = np.exp(logs[0]) / PERIOD_S * np.eye(n) + np.exp(logs[1]) * steps
        inverse = np.linalg.inv(v)
        inner = trend.T @ inverse @ trend
        left = record - trend @ np.linalg.solve(inner, trend.T @ inverse @ record)
        return np.linalg.slogdet(v)[1] + np.linalg.slogdet(inner)[1] + left @ inverse @ left

    dense = optimize.minimize(
        loss, np.log([white**2, walk**2]), method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-8}
    )
    # Ordinates above the lowest are means of bins.
    assert theta[[1, 3]] == pytest.approx(np.exp(dense.x), rel=0.01)
    low, high = (loss(np.log([theta[1], theta[3] * factor])) for factor in (0.97, 1.03))
    assert dense.fun <= min(low, high)


def test_the_interval_of_white_noise_alone_is_that_of_a_chi_square():
    rng = np.random.default_rng(2)
    n = 400
    record = rng.standard_normal(n)
    likelihood = Likelihood(ordinates(record, 0, 1.0, np.zeros(1), NOTHING), without=(0, 2, 3))
    theta, deviance = likelihood.best()
    found = profile(likelihood, theta, deviance, 1, "angle_random_walk", "dps/√Hz")
    fitted = np.polyval(np.polyfit(np.arange(n), record, 1), np.arange(n))
    squares = float(np.sum((record - fitted) ** 2))
    assert found.likeliest == pytest.approx(math.sqrt(squares / (n - 2)), rel=1e-6)
    assert found.dof == pytest.approx(n - 2, rel=1e-6)
    equal_tails = np.sqrt(squares / stats.chi2.ppf([0.975, 0.025], n - 2))
    assert (found.low, found.high) == pytest.approx(equal_tails, rel=2e-3)


def test_a_coefficient_on_its_boundary_is_refused_at_half_the_chi_square_chance():
    rng = np.random.default_rng(4)
    p_values = []
    for _ in range(300):
        record = rng.standard_normal(256)
        likelihood = Likelihood(ordinates(record, 0, 1.0, np.zeros(1), NOTHING), without=(0, 2))
        theta, deviance = likelihood.best()
        absent = likelihood.maximum(theta.copy(), {3: 0.0})[1]
        p_values.append(0.5 * stats.chi2.sf(max(absent - deviance, 0), 1) if theta[3] > 0 else 1.0)
    # At the nominal 10 % level; the boundary mixture is asymptotic, so the claim is "at most".
    assert stats.binom.sf(sum(p < 0.1 for p in p_values) - 1, 300, 0.1) > 0.001
    assert len(filter_weights(0)) == 1


class SearchThatMayStopEarly:
    """A likelihood of θ[1] = 1 ± 0.1. Its maximum depends a little on the start of the search."""

    scale = np.ones(4)
    best = np.array([0.0, 1.0, 0.0, 0.0])

    def maximum(self, start, fixed):
        theta = self.best.copy()
        theta[1] = fixed[1]
        return theta, ((fixed[1] - 1) / 0.1) ** 2 + 0.2 * (start[1] > 1)

    def u_squared(self, theta, index):
        return 0.1


def test_an_interval_does_not_depend_on_where_a_search_stopped():
    one = SearchThatMayStopEarly()
    found = profile(one, one.best, 0.0, 1, "angle_random_walk", "dps/√Hz")
    assert (found.low, found.high) == pytest.approx((np.sqrt(0.804), np.sqrt(1.196)), abs=2e-3)
