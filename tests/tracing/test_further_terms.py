"""What each further term of a model buys, from the models that the search has scored."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.tracing.trace import TraceRun
from adis_gonio.tracing.what_if import BestOfSize, best_by_size, heldout_by_size
from tracing.small_problems import U, ideal_mg, labelled, read, surroundings

LABELS = ("bias[xy]", "quadratic[x]", "cubic[x]", "bias_drift[x]", "asymmetry[y]")


def session(seed: int = 2) -> Readings:
    """A turn with a bias on both axes and a curvature of x."""
    c = surroundings(seed=seed)
    mean = ideal_mg(c)
    noise = np.random.default_rng([seed, 9]).normal(0, U, mean.shape)
    curved = np.outer((mean[:, 0] / 1000) ** 2, [1.0, 0.0])
    return read(c, mean + np.array([4.0, -6.0]) + noise + curved)


@pytest.fixture(scope="module")
def run() -> TraceRun:
    data = session()
    run = TraceRun(data, 5, ())
    run.terms = labelled(data, *LABELS)
    run.result = run.traced()
    return run


@pytest.fixture(scope="module")
def bought(run: TraceRun) -> list[BestOfSize]:
    return run.result.further_terms()


def test_the_model_of_each_number_is_the_best_of_all_models_of_this_number(run: TraceRun) -> None:
    found = run.selection.found
    problem = found.problem
    for size, (fit, evidence) in enumerate(best_by_size(run.selection, run.fits)):
        heights = {}
        for model in itertools.combinations(range(len(problem.terms)), size):
            prices = sum(found.prices[k] for k in model)
            heights[frozenset(problem.terms[k].label for k in model)] = 0.5 * problem.gain(model) - prices
        assert frozenset(term.label for term in fit.terms) == max(heights, key=heights.__getitem__)
        assert evidence == pytest.approx(max(heights.values()), abs=1e-6)
    assert [one.chosen for one in run.result.further_terms()] == [False, False, True, False]


def test_errors_are_those_of_leaving_each_fold_out_by_hand(run: TraceRun, bought) -> None:
    errors = [run.result.before.heldout_rms, *(step.error.heldout_rms for step in run.result.steps)]
    assert [bought[0].heldout_rms, bought[2].heldout_rms] == pytest.approx([errors[0], errors[2]], rel=1e-3)
    assert bought[2].gain == pytest.approx(bought[1].heldout_rms - bought[2].heldout_rms)
    assert bought[2].gain > 2 * bought[2].u
    assert abs(bought[3].gain) < 3 * bought[3].u
    assert [one.efficient for one in bought] == [True, True, True, False]


def test_the_uncertainty_of_a_gain_is_its_scatter_over_sessions() -> None:
    gains, stated = [], []
    for seed in range(12):  # their scatter is known to 21 %
        data = session(seed)
        run = TraceRun(data, 2, ())
        run.terms = labelled(data, *LABELS[:2])
        run.search()
        run.nest(run.selection)
        last = heldout_by_size(run.selection, run.fits, run.fold)[2]
        gains.append(last.gain)
        stated.append(last.u)
    assert 0.5 < np.std(gains) / np.median(stated) < 2
