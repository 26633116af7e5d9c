"""The line against an independent estimator, and the coverage of its U."""

import re

import numpy as np
import pytest

from adis_gonio.fleet.sensor_history import Track, drift_of, drift_sentences


def test_without_scatter_between_sessions_it_is_the_weighted_line_of_polyfit():
    rng = np.random.default_rng(1)
    day = np.sort(rng.uniform(0, 2000, 12))
    u = rng.uniform(0.5, 2, 12)
    value = 3 + 0.01 * day + 0.3 * u * rng.normal(size=12)  # calmer than u: no scatter is left
    found = drift_of(day, value, u, "mg")
    (slope, level), covariance = np.polyfit(day, value, 1, w=1 / u, cov="unscaled")
    assert found.between == 0
    assert found.slope.value == pytest.approx(slope * 365.25)
    assert found.slope.u == pytest.approx(covariance[0, 0] ** 0.5 * 365.25)
    assert found.level.value == pytest.approx(level + slope * found.reference_day)
    assert found.slope.unit == "mg/a"


def test_with_scatter_it_is_statsmodels_at_the_variance_that_explains_the_residual():
    api = pytest.importorskip("statsmodels.api")
    rng = np.random.default_rng(2)
    day, u = np.sort(rng.uniform(0, 2000, 15)), rng.uniform(0.5, 2, 15)
    value = 0.002 * day + rng.normal(0, np.hypot(u, 4))
    found = drift_of(day, value, u, "mg")
    fit = api.WLS(value, api.add_constant(day), weights=1 / (u**2 + found.between**2)).fit()
    assert fit.scale == pytest.approx(1, rel=1e-6)  # what Paule and Mandel ask for
    assert found.slope.value == pytest.approx(fit.params[1] * 365.25)
    assert found.slope.u == pytest.approx(fit.bse[1] * 365.25, rel=1e-6)
    assert found.p_value == pytest.approx(fit.pvalues[1], rel=1e-6)
    assert found.between == pytest.approx(4, rel=0.6)


@pytest.mark.parametrize(("between", "low", "high"), [(0.0, 0.95, 1.0), (3.0, 0.925, 0.975)])
def test_u_covers_the_true_drift(between, low, high):
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(700):
        day, u = np.sort(rng.uniform(0, 3000, 8)), rng.uniform(0.7, 1.3, 8)
        found = drift_of(day, 0.003 * day + rng.normal(0, np.hypot(u, between)), u, "mg")
        inside.append(abs(found.slope.value - 0.003 * 365.25) <= found.slope.U)
    assert low <= np.mean(inside) <= high


def test_scatter_beyond_u_is_told_by_birges_ratio():
    rng = np.random.default_rng(4)
    day, u = np.linspace(0, 3000, 200), np.ones(200)
    quiet = drift_of(day, rng.normal(0, 1, 200), u, "mg")
    loud = drift_of(day, rng.normal(0, 3, 200), u, "mg")
    assert quiet.birge == pytest.approx(1, abs=0.15)
    assert quiet.birge_p > 0.001
    assert loud.birge == pytest.approx(3, abs=0.5)
    assert loud.birge_p < 1e-6


@pytest.mark.parametrize("day", [[0.0], [0.0, 10.0], [5.0, 5.0, 5.0]])
def test_a_line_needs_three_sessions_at_different_times(day):
    assert drift_of(np.array(day), np.zeros(len(day)), np.ones(len(day)), "mg") is None


def test_a_scatter_beyond_all_doubt_is_no_probability_of_zero():
    day, value = np.arange(8.0) * 90, np.array([0, 9, 1, 8, 0, 9, 1, 8.0])
    drift = drift_of(day, value, np.full(8, 0.01), "mg")
    track = Track("bias_x", "mg", tuple(range(8)), day, (), drift)
    text = " ".join(drift_sentences(track)).replace("\N{NO-BREAK SPACE}", " ").replace("\u202f", " ")
    assert "p < 10⁻¹²" in text
    assert re.search(r"scatter by [\d.]+ mg, beyond their u", text)
