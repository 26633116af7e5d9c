"""The Allan deviation and its degrees of freedom against allantools."""

import math

import allantools
import numpy as np
import pytest

from adis_gonio.fitting.allan.spectral_likelihood import LEAST_DIFFERENCES, curve, overlapping

PERIOD_S = 0.01
NOISES = {
    "white": (0, [0, 0.05**2, 0, 0]),
    "flicker": (-1, [0, 0, 0.05**2, 0]),
    "walk": (-2, [0, 0, 0, 0.05**2]),
}


def test_it_is_that_of_allantools():
    values = np.random.default_rng(1).standard_normal((5000, 2)).cumsum(axis=0)
    times, found = overlapping([values])
    taus = PERIOD_S * np.array(times)
    for axis in range(2):
        at, expected, _, counts = allantools.oadev(
            values[:, axis], rate=1 / PERIOD_S, data_type="freq", taus=taus
        )
        kept = counts >= LEAST_DIFFERENCES
        assert at[kept] == pytest.approx(taus[: kept.sum()])
        assert found[: kept.sum(), axis] == pytest.approx(expected[kept], rel=1e-9)


def test_records_are_pooled_by_their_differences_and_no_difference_spans_two():
    rng = np.random.default_rng(2)
    one, other = rng.standard_normal((300, 1)), rng.normal(50, 1, (300, 1))
    times, found = overlapping([one, other])
    squares = [overlapping([part])[1][0, 0] ** 2 for part in (one, other)]
    assert found[0, 0] == pytest.approx(math.sqrt(np.mean(squares)))
    assert times[-1] * 2 + LEAST_DIFFERENCES <= 300


@pytest.mark.parametrize("name", NOISES)
def test_degrees_of_freedom_are_those_of_greenhall_and_riley(name):
    alpha, squares = NOISES[name]
    n = 8192
    record = np.random.default_rng(3).standard_normal(n)
    found = curve([record], np.array(squares), 0, PERIOD_S, np.zeros(1))
    for tau, dof in zip(found.tau_s, found.dof, strict=True):
        m = round(tau / PERIOD_S)
        if m >= 32:  # shorter ones depend on how the noise is sampled
            expected = allantools.edf_greenhall(alpha, d=2, m=m, N=n + 1, overlapping=True, modified=False)
            assert dof == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("white", lambda tau: 0.05 / np.sqrt(tau)),
        ("flicker", lambda tau: 0.05 + 0 * tau),
        ("walk", lambda tau: 0.05 * np.sqrt(tau / 3)),
    ],
)
def test_the_fitted_curve_is_that_of_the_standard_at_long_times(name, expected):
    record = np.random.default_rng(3).standard_normal(1 << 14)
    found = curve([record], np.array(NOISES[name][1]), 0, PERIOD_S, np.zeros(1))
    late = found.tau_s > 0.3
    assert found.model[late] == pytest.approx(expected(found.tau_s[late]), rel=0.01)


def test_the_curve_behind_the_filter_is_what_filtered_noise_has():
    rng = np.random.default_rng(6)
    window = np.convolve(np.ones(16), np.ones(16)) / 256
    record = np.convolve(0.05 / math.sqrt(PERIOD_S) * rng.standard_normal(1 << 17), window, "valid")
    found = curve([record], np.array([0, 0.05**2, 0, 0]), 4, PERIOD_S, np.zeros(1))
    z = np.log(found.deviation / found.model) * np.sqrt(2 * found.dof)
    assert np.abs(z).max() < 4
    inside = (found.low <= found.model) & (found.model <= found.high)
    assert inside.mean() > 0.7
