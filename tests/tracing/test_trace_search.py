"""The guarantee of the search: no neighbour of the best model scores higher."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import numpy as np
import pytest

from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.model.effects import effect
from adis_gonio.tracing import linear_problem
from adis_gonio.tracing.grammar import nameless_terms
from adis_gonio.tracing.linear_problem import LinearProblem, Products, linearise
from adis_gonio.tracing.model_search import Model, Search, price, search
from adis_gonio.tracing.named_candidates import named_terms
from tracing.small_problems import named, observations, single

HIDDEN = (
    [(effect("quadratic", ("x",)), {"k2_x": 1.2}), (effect("cubic", ("y",)), {"k3_y": 2.5})],
    [(effect("bias"), {"bias_x": 5.0, "bias_y": -4.0}), (effect("backlash", ()), {"backlash": 0.05})],
    [
        (effect("bias"), {"bias_x": 0.8, "bias_y": 0.5}),
        (effect("bias_temperature", ("x",)), {"tempco_x": 0.1}),
        (effect("supply_bias", ("y",)), {"supply_y": 6.0}),
    ],
    [],
)


def problem_of(data: Readings, chosen: int | None = None, seed: int = 0) -> LinearProblem:
    """Return the problem of a session with all candidates, or with `chosen` of them drawn at random."""
    terms = [*named_terms(data)[0], *nameless_terms(data)]
    problem = linearise(Fit.begin(data).refit(), terms)
    if chosen is None:
        return problem
    alone = problem.gains(np.zeros((len(problem.target), 0)), problem.target) - 2 * price(problem)
    names = np.array([term.name is not None for term in problem.terms])
    rng = np.random.default_rng(seed)
    # Most of the candidates score high by themselves, so that a wrong one is tempting.
    best = np.argsort(-alone)[: 4 * chosen]
    drawn = (
        [rng.choice(best[names[best]], chosen // 2, replace=False)] if names[best].sum() > chosen else []
    )
    drawn.append(rng.choice(best, chosen // 2, replace=False))
    drawn.append(rng.choice(np.flatnonzero(names), chosen // 2, replace=False))
    return problem.subset(np.unique(np.concatenate(drawn)))


def score(problem: LinearProblem, model: Iterable[int]) -> float:
    """Score of one model, computed by itself."""
    numbers = list(model)
    return 0.5 * problem.gain(numbers) - float(price(problem)[numbers].sum())


def neighbours(found: Search, max_terms: int) -> Iterator[Model]:
    """Yield all models that the best model becomes by one move, or by two merged moves."""
    terms = found.problem.terms
    every = range(len(terms))
    names = [k for k in every if terms[k].name is not None]
    best = found.best
    for dropped in range(min(len(best), 2) + 1):
        for rest in itertools.combinations(best, len(best) - dropped):
            yield rest
            if len(rest) < max_terms:
                yield from ((*rest, k) for k in every if k not in rest)
            if len(rest) + 2 <= max_terms and dropped < 2:
                yield from ((*rest, *pair) for pair in itertools.combinations(names, 2))


@pytest.mark.parametrize("hidden", range(len(HIDDEN)))
@pytest.mark.parametrize("seed", range(2))
def test_of_few_candidates_the_best_model_is_that_of_all_models(hidden: int, seed: int) -> None:
    problem = problem_of(observations(HIDDEN[hidden], seed=seed), 30, seed)
    models = itertools.chain.from_iterable(
        itertools.combinations(range(len(problem.terms)), size) for size in range(4)
    )
    found = search(problem, 3)
    wide = problem.dof - max(problem.dof // 2, 1)
    best = max(score(problem, m) for m in models if problem.width[list(m)].sum() <= wide)
    assert score(problem, found.best) == pytest.approx(best, rel=1e-6)
    # Gains of nearly equal columns are computed with a ridge of 1e-4.
    assert found.scores[found.best] == pytest.approx(best, rel=2e-5)


@pytest.mark.parametrize("hidden", [1, 2, 3])
def test_no_neighbour_of_the_best_model_of_all_candidates_scores_higher(hidden: int) -> None:
    problem = problem_of(observations(HIDDEN[hidden], seed=40 + hidden, n=16))
    found = search(problem, 4)
    top = found.scores[found.best]
    assert top == pytest.approx(score(problem, found.best), rel=1e-6)
    wide = problem.dof - max(problem.dof // 2, 1)
    for model in neighbours(found, 4):
        if sum(int(problem.width[k]) for k in model) <= wide:
            assert score(problem, model) <= top + 1e-6 * abs(top) + 1e-6, model


def test_two_names_that_one_function_imitates_are_found() -> None:
    # The function fits better than each name, and both names together better than the function.
    rng = np.random.default_rng(5)
    one, two, other = np.linalg.qr(rng.normal(size=(40, 3)))[0].T
    function = one + two + 0.15 * other
    rows = [one, two, function / np.linalg.norm(function)]
    terms = [named("cubic", 4.0), named("warm_up", 4.0), named(None, 6.0)]
    found = search(single(20 * (one + two), rows, terms), 3)
    assert found.scores[0,] < found.scores[2,] < found.scores[0, 1]
    assert found.best == (0, 1)


def test_a_function_with_a_constant_is_replaced_by_a_bias_and_two_names() -> None:
    rng = np.random.default_rng(6)
    bias, one, two, other = np.linalg.qr(rng.normal(size=(40, 4)))[0].T
    function = 2 * bias + one + two + 0.12 * other
    rows = [bias, one, two, function / np.linalg.norm(function)]
    terms = [named("bias", 2.0), named("cubic", 4.0), named("warm_up", 4.0), named(None, 6.0)]
    problem = single(30 * (2 * bias + one + two), rows, terms)
    found = search(problem, 3, explored=1)
    assert found.best == (0, 1, 2)


def test_many_openings_stop_the_search_around_others_than_the_best(monkeypatch) -> None:
    from adis_gonio.tracing.thresholds import limits

    problem = problem_of(observations(HIDDEN[0], seed=3), 30, 3)
    every = search(problem, 3)
    monkeypatch.setattr(limits, "openings", 0)
    few = search(problem, 3)
    assert few.best == every.best
    assert len(few.scores) < len(every.scores)


@pytest.mark.parametrize("most", [1, 500, 1 << 20])
def test_pairs_score_as_one_term_after_the_other_in_chunks_of_any_size(monkeypatch, most) -> None:
    monkeypatch.setattr(linear_problem, "_PAIR_PRODUCTS", most)
    problem = problem_of(observations(HIDDEN[2], seed=8), 40, 8)
    products = Products(problem, problem)
    for model in [(), (3,), (1, 6)]:
        chi2, rank, chunks = products.pairs(model)
        gains = np.full((len(problem.terms), len(problem.terms)), -np.inf)
        for one, part in chunks:
            gains[one, one.start :] = part
        assert rank == sum(int(problem.width[k]) for k in model)
        assert chi2 == pytest.approx(problem.chi2 - problem.gain(model))
        for a in set(range(len(problem.terms))) - set(model):
            chi2_a, z, inside = products.of_model((*model, a))
            both = chi2 - chi2_a + problem.gains_from_products(z, inside)
            others = [b for b in range(a + 1, len(problem.terms)) if b not in model]
            if np.isfinite(gains[a, others]).any():
                # Both limit the gain along a direction that is nearly in the model, in two ways.
                np.testing.assert_allclose(gains[a, others], both[others], rtol=5e-3)
                assert np.median(gains[a, others] / both[others]) == pytest.approx(1.0, abs=1e-5)
