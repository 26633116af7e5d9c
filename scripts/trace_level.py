"""Level and speed of the search of `trace`.

    python scripts/trace_level.py --sessions 24 --draws 400

Level: pure noise is drawn in the whitened problem of simulated sessions, and the best score of any
candidate recorded. A candidate is added where its score is above 0, so that the share of positive best
scores is the family-wise error rate; the 99 % quantile says how far the prices
are from 1 %.

Speed: the selection among all candidates against one scipy `least_squares` fit of base and candidate
for each, on a session of 48 readings.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.tracing.grammar import nameless_terms
from adis_gonio.tracing.linear_problem import LinearProblem, linearise
from adis_gonio.tracing.model_search import price, search
from adis_gonio.tracing.named_candidates import named_terms
from tracing.small_problems import observations
from tracing.test_trace_engine import QUADRATIC


def problem_of(data: Readings) -> tuple[LinearProblem, list[Term]]:
    """Linear problem of a session about its base fit, with all candidates."""
    terms: list[Term] = [*named_terms(data)[0], *nameless_terms(data)]
    return linearise(Fit.begin(data).refit(), terms), terms


def best_scores(problem: LinearProblem, draws: int, rng: np.random.Generator) -> Floats:
    """Best score of any single candidate in each of `draws` residuals of pure noise."""
    noise = rng.standard_normal((len(problem.target), draws))
    prices, best = price(problem), np.full(draws, -np.inf)
    for each in np.array_split(np.arange(draws), max(draws // 50, 1)):
        squares = (problem.columns.T @ noise[:, each]) ** 2
        gains = np.add.reduceat(squares, problem.shared.first, axis=0)
        best[each] = (0.5 * gains - prices[:, None]).max(axis=0)
    return best


def refit_by_scipy(data: Readings, term: Term) -> float:
    """Seconds of one fit of base parameters and one candidate by scipy, angles given."""
    from dataclasses import replace

    from scipy.optimize import least_squares

    start = Fit.begin(data).refit()
    columns = term.columns(start.ideal, data.conditions).shape[-1]

    def residual(x: Floats) -> Floats:
        at = replace(start, values=replace(start.values, base=x[:4]))
        return at.with_terms((term,), (term.start(x[4:]),)).residual.ravel()

    begun = time.perf_counter()
    least_squares(residual, np.concatenate([start.values.base, np.zeros(columns)]), x_scale="jac")
    return time.perf_counter() - begun


def main() -> int:
    """Print level and speed; exit status 1 where a target is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sessions", type=int, default=24)
    parser.add_argument("--draws", type=int, default=400)
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    scores = []
    for k in range(options.sessions):
        data = observations(seed=k, n=int(rng.choice([12, 16, 24, 36, 48])), shuffled=bool(k % 2))
        scores.append(best_scores(problem_of(data)[0], options.draws, rng))
    together = np.concatenate(scores)
    rate = float((together > 0).mean())
    quantiles = [float(np.quantile(one, 0.99)) for one in scores]
    print(
        f"best score of noise: 99 % quantile {np.quantile(together, 0.99):+.2f} "
        f"({min(quantiles):+.2f} to {max(quantiles):+.2f} a session), above 0 in {rate:.2%}"
    )

    data = observations([QUADRATIC], n=48)
    begun = time.perf_counter()
    problem, terms = problem_of(data)
    search(problem, 6)
    ours = time.perf_counter() - begun
    sample = rng.choice(len(problem.terms), 40, replace=False)
    theirs = float(np.mean([refit_by_scipy(data, problem.terms[k]) for k in sample])) * len(problem.terms)
    print(
        f"selection among {len(terms)} candidates, pairs included: {ours:.2f} s; one scipy fit each: "
        f"{theirs:.0f} s; ratio {theirs / ours:.0f}"
    )
    return int(rate > 0.01 or theirs < 50 * ours)


if __name__ == "__main__":
    sys.exit(main())
