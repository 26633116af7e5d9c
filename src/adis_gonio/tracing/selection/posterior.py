"""From scored models to names: what stands, what cannot be told apart, what has no name.

Scores are log evidences, so that models near the best have posterior odds. Models that predict the same in
*this* session are one model: the representative is the simplest (fewest nameless terms, fewest columns,
then the more common cause), the others are its equivalents and are reported beside it. A name stands
where the models that hold it have most of the posterior; else it is confounded with whatever takes
its place.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.tracing.selection.design import span
from adis_gonio.tracing.selection.search import Model, Search
from adis_gonio.tracing.thresholds import limits

Skeleton = tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]


@dataclass(frozen=True)
class ModelPosterior:
    """What the scored models say.

    Attributes
    ----------
    best : tuple of int
        The model to go on with: the most probable one.
    weights : dict of model to float
        Posterior of each class of models that span the same space, by its representative; sums to 1.
    same : dict of model to list of models
        Other models of each class.
    names : dict of str to float
        Posterior that an effect is present.
    covariates : dict of tuple of str to float
        Posterior that a nameless term of these covariates is present.
    """

    best: Model
    weights: dict[Model, float]
    same: dict[Model, list[Model]]
    names: dict[str, float]
    covariates: dict[tuple[str, ...], float]


def posterior(found: Search) -> dict[Model, float]:
    """Posterior of each model near the best by itself, however alike two of them are; sums to 1.

    The most probable first.
    """
    near = found.near(limits.weighed)
    ranked = sorted(near, key=lambda m: -near[m])[: limits.compared]
    raw = {m: math.exp(near[m] - near[ranked[0]]) for m in ranked}
    total = sum(raw.values())
    return {m: w / total for m, w in raw.items()}


def weigh(found: Search) -> ModelPosterior:
    """Posterior of models, names and covariates."""
    terms = found.problem.terms
    each = posterior(found)
    same = _classes(found, list(each))
    weights = {m: sum(each[k] for k in (m, *others)) for m, others in same.items()}
    names, covariates = _present(terms, weights)
    # What is reported is names and covariates: the best of these first, then the best model that has them.
    skeletons: dict[Skeleton, float] = defaultdict(float)
    for model, weight in weights.items():
        skeletons[skeleton(found, model)] += weight
    likely = max(skeletons, key=lambda s: skeletons[s])
    best = max((m for m in weights if skeleton(found, m) == likely), key=lambda m: weights[m])
    return ModelPosterior(best, weights, same, names, covariates)


def _present(
    terms: Sequence[Term], weights: Mapping[Model, float]
) -> tuple[dict[str, float], dict[tuple[str, ...], float]]:
    """Probability that each name, and a nameless term of each choice of covariates, is there."""
    names: dict[str, float] = defaultdict(float)
    covariates: dict[tuple[str, ...], float] = defaultdict(float)
    for model, weight in weights.items():
        for name in {terms[k].name for k in model}:
            if name is not None:
                names[name] += weight
        for which in {terms[k].covariates for k in model if terms[k].name is None}:
            covariates[which] += weight
    # A sum of weights may end above 1 by rounding.
    return (
        {name: min(weight, 1.0) for name, weight in names.items()},
        {which: min(weight, 1.0) for which, weight in covariates.items()},
    )


def _classes(found: Search, models: list[Model]) -> dict[Model, list[Model]]:
    """Models by what they predict: those whose predictions hardly differ are one."""
    problem, terms = found.problem, found.problem.terms
    left = np.array([span(problem, m)[1] for m in models])
    norm = (left**2).sum(axis=1)
    distance = norm[:, None] + norm[None, :] - 2 * left @ left.T
    taken = np.zeros(len(models), dtype=bool)
    classes: dict[Model, list[Model]] = {}
    width = [int(sum(problem.width[k] for k in m)) for m in models]
    # The simplest first: least nameless, least columns, then the most probable.
    order = sorted(
        range(len(models)),
        key=lambda i: (sum(terms[k].name is None for k in models[i]), width[i], -found.scores[models[i]]),
    )
    for i in order:
        if not taken[i]:
            members = np.flatnonzero((distance[i] < limits.same_prediction * found.inflation) & ~taken)
            taken[members] = True
            classes[models[i]] = [models[k] for k in members if k != i]
    return classes


def skeleton(found: Search, model: Model) -> Skeleton:
    """Names and covariates of a model, without axes, shapes and forms."""
    terms = [found.problem.terms[k] for k in model]
    return (
        tuple(sorted({term.name for term in terms if term.name is not None})),
        tuple(sorted({term.covariates for term in terms if term.name is None})),
    )
