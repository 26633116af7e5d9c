"""Intervals and scatter: against scipy's distributions and against counting."""

import math

import numpy as np
import pytest
from scipy import stats

from adis_gonio.base.arrays import robust_sd
from adis_gonio.base.uncertainty import (
    Detectable,
    Value,
    coverage_factor,
    effective_dof,
    expanded,
    factor_over,
    wilson,
)


@pytest.mark.parametrize(("hits", "n"), [(0, 7), (1, 7), (3, 7), (7, 7), (95, 100)])
def test_wilsons_interval_is_scipys(hits, n):
    known = stats.binomtest(hits, n).proportion_ci(0.95, method="wilson")
    assert wilson(hits, n) == pytest.approx((known.low, known.high), abs=1e-12)
    one_sd = stats.binomtest(hits, n).proportion_ci(1 - 2 * stats.norm.sf(1.0), method="wilson")
    assert wilson(hits, n, 1.0) == pytest.approx((one_sd.low, one_sd.high), abs=1e-12)


def test_of_nothing_any_share_is_possible_and_the_ends_are_exact():
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(0, 30)[0] == 0.0
    assert wilson(30, 30)[1] == 1.0


def test_below_one_degree_of_freedom_k_is_that_of_one():
    assert coverage_factor(0.2) == coverage_factor(1.0) == pytest.approx(stats.t.ppf(0.975, 1))


def test_a_source_without_variance_takes_no_degrees_of_freedom():
    assert effective_dof([(4.0, 9.0), (0.0, 1.0)]) == pytest.approx(9.0)
    assert effective_dof([(4.0, math.inf), (1e-13, 1.0)]) == math.inf
    assert effective_dof([]) == math.inf


@pytest.mark.parametrize("u", [None, math.nan, math.inf])
def test_what_has_no_u_has_neither_k_nor_an_interval_nor_degrees_of_freedom(u):
    assert expanded(u, 5.0) == (None, None)
    document = Value(1.5, u, "mg", 5.0).as_dict()
    assert document == {"value": 1.5, "u": None, "dof": None, "k": None, "U": None, "unit": "mg"}


def test_a_factor_that_is_given_stands_before_students():
    value = Value(1.5, 0.2, "mg", 5.0, factor=2.0)
    assert (value.k, value.U) == (2.0, 0.4)
    assert pytest.approx(0.2 * stats.t.ppf(0.975, 5)) == Value(1.5, 0.2, "mg", 5.0).U
    assert Value(math.inf, 0.2, "mg").as_dict()["value"] is None
    assert Detectable(math.inf, "mg", "x", "why").as_dict() == {
        "amplitude": None, "unit": "mg", "parameter": "x", "reason": "why",
    }  # fmt: skip


@pytest.mark.parametrize("dof", [1.0, 3.0, 12.0, math.inf])
def test_one_factor_for_places_of_unequal_variance_holds_95_per_cent_of_draws(dof):
    variances = np.array([0.1, 1.0, 1.0, 9.0])
    rng = np.random.default_rng(8)
    size = (200_000, len(variances))
    drawn = rng.standard_normal(size) if math.isinf(dof) else rng.standard_t(dof, size)
    k = factor_over(variances, dof)
    inside = np.abs(drawn * np.sqrt(variances)) <= k * math.sqrt(variances.mean())
    assert inside.mean() == pytest.approx(0.95, abs=5 * math.sqrt(0.95 * 0.05 / inside.size))


def test_variances_that_are_nothing_or_all_alike_keep_students_factor():
    assert factor_over(np.zeros(3), 4.0) == coverage_factor(4.0)
    assert factor_over(np.full(3, 7.0), 4.0) == coverage_factor(4.0)


def test_the_robust_scatter_is_scipys_and_ten_values_in_a_hundred_far_off_hardly_change_it():
    values = np.random.default_rng(2).normal(40.0, 3.0, 501)
    for far in (0.0, 1e6):
        values[:50] += far
        assert robust_sd(values) == pytest.approx(stats.median_abs_deviation(values, scale="normal"))
    assert robust_sd(values) < 1.5 * 3.0
