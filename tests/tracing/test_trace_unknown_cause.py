"""An unknown cause beside every model, if no model is adequate."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.tracing.credible_sets import probability_of
from adis_gonio.tracing.linear_problem import linearise, span
from adis_gonio.tracing.model_search import Search
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.scatter import compete_with_unknown, likeliest_size, unknown_features
from adis_gonio.tracing.selection import Selection, select
from adis_gonio.tracing.trace import trace_readings
from tracing.small_problems import U, function, ideal_mg, noisy, read, surroundings, turn


def rough(seed: int, size: float = 1.0) -> np.ndarray:
    """A function of time and angle together that no candidate below has, (24, 2) in mg."""
    c = surroundings()
    rng = np.random.default_rng(seed)
    waves = [
        rng.normal(size=2) * np.sin(a * c.angle_rad[:, None] + b * c.time_s[:, None] / 300 + p)
        for a, b, p in zip(rng.integers(1, 4, 8), rng.normal(0, 2, 8), rng.uniform(0, 6, 8), strict=True)
    ]
    return size * np.sum(waves, axis=0)


@cache
def selection(seed: int) -> Selection:
    """A selection that is not adequate, of names and two functions."""
    c = surroundings()
    data = noisy(c, seed)
    data = replace(data, mean=data.mean + rough(seed))
    terms: list[Term] = [
        *named_terms(data)[0],
        function("sine in time", lambda c: np.sin(c.time_s / 300), ("time",)),
        function("sine of the angle", lambda c: np.sin(3 * c.angle_rad), ("angle",)),
    ]
    return select(data, terms, 3)


def test_scores_beside_a_process_are_those_of_generalised_least_squares() -> None:
    data = noisy(surroundings(), 3)
    fit = Fit.begin(data).refit()
    problem = linearise(fit, named_terms(data)[0])
    features = 5 * unknown_features(fit)
    beside = problem.with_covariance(features)
    inverse = np.linalg.inv(np.eye(len(problem.target)) + features @ features.T)
    assert beside.chi2 == pytest.approx(problem.target @ inverse @ problem.target)
    for k in (0, 7, 20):
        columns, prior = problem.block(k), problem.prior_of(k)
        along = columns.T @ inverse @ problem.target
        gain = along @ np.linalg.solve(columns.T @ inverse @ columns + prior, along)
        assert beside.gain((k,)) == pytest.approx(gain, rel=1e-6)


def test_the_process_has_one_standard_uncertainty_and_nothing_that_the_base_model_explains() -> None:
    data = noisy(surroundings(), 3)
    fit = Fit.begin(data).refit()
    features = unknown_features(fit)
    assert np.abs(fit.white(fit.base_columns).T @ features).max() < 1e-6 * np.abs(fit.jacobian).max()
    # The base model explains a part of it.
    assert 0.8 < np.sum(features**2) / len(features) < 1.0


def test_the_size_of_the_process_is_found() -> None:
    data = noisy(surroundings(), 4)
    fit = Fit.begin(data).refit()
    features = unknown_features(fit)
    rng = np.random.default_rng(4)
    sizes = []
    for _ in range(20):
        problem = linearise(fit, [])
        target = rng.normal(size=len(problem.target)) + 20 * features @ rng.normal(size=features.shape[1])
        target = span(replace(problem, target=target), ())[1]
        sizes.append(likeliest_size(replace(problem, target=target), (), features))
    assert np.median(sizes) == pytest.approx(20, rel=0.3)


def test_an_adequate_selection_is_judged_by_its_own_noise() -> None:
    data = noisy(turn(), 5)
    chosen = select(data, named_terms(data)[0], 2)
    assert chosen.adequate
    assert compete_with_unknown(chosen, 2) is chosen


def test_a_wrong_name_for_an_unknown_cause_is_less_certain_beside_it() -> None:
    certain = {False: 0, True: 0}
    for seed in range(8):
        chosen = selection(seed)
        assert not chosen.adequate
        judged = compete_with_unknown(chosen, 3)
        assert judged.verdict.best == chosen.verdict.best
        assert isinstance(judged.found, Search)
        for beside, one in ((False, chosen), (True, judged)):
            names = {term.name for term in one.terms if term.name not in (None, "bias")}
            certain[beside] += sum(probability_of(one, str(name)) > 0.95 for name in names)
    assert certain[True] <= certain[False] / 4


def test_a_large_effect_beside_an_unknown_cause_keeps_its_name() -> None:
    c = surroundings()
    data = noisy(c, 9)
    curved = np.outer(ideal_mg(c)[:, 0] ** 2 / 1e6, [25.0, 0.0])
    data = replace(data, mean=data.mean + rough(9) + curved)
    chosen = select(data, named_terms(data)[0], 3)
    assert not chosen.adequate
    judged = compete_with_unknown(chosen, 3)
    assert probability_of(judged, "quadratic") > 0.9


def test_a_trace_states_the_unnamed_part_with_the_probability_of_its_set() -> None:
    c = surroundings()
    data = noisy(c, 21)
    jump = np.outer(c.order >= 13, [0.9, 0.0])
    result = trace_readings(replace(data, mean=data.mean + jump))
    assert result.unnamed is not None
    (one,) = [one for one in result.sets if one.cause.startswith("unnamed")]
    stated = dict(zip(one.names, one.probability, strict=True))[one.cause]
    assert result.unnamed.probability == pytest.approx(stated * one.present)


def test_eight_dwells_state_no_function() -> None:
    c = turn(8)
    wave = np.outer(3 * np.cos(3 * c.angle_rad), [1.0, 0.0])
    result = trace_readings(read(c, ideal_mg(c) + wave + np.random.default_rng(1).normal(0, U, (8, 2))))
    assert not [one for one in result.sets if one.names[0].startswith("unnamed")]
    assert result.unnamed is None or result.unnamed.probability <= 0.55
