"""From scored models to names: what stands, what cannot be told apart, what has no name.

Scores are log evidences, so that models near the best have posterior odds. Models that span the same space
of *this* session are one model: the representative is the one with fewest nameless terms and then the
highest prior (the simpler and more common cause), the others are its equivalents. A name stands where the
models that hold it have `CERTAIN` of the posterior; it is confounded with whatever takes its place in the
others.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass

from adis_gonio.tracing.search import Model, Search

CERTAIN = 0.55
"""Posterior probability from which a name is called found."""
WINDOW = 7.0
"""Models are weighed down to exp(−7), a thousandth, of the best."""


Skeleton = tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]


@dataclass(frozen=True)
class Verdict:
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


def weigh(found: Search) -> Verdict:
    """Posterior of models, names and covariates."""
    terms = found.problem.terms
    tolerance = 1e-6 + 1e-9 * found.problem.chi2
    classes: dict[tuple[int, int], list[Model]] = defaultdict(list)
    for model in found.near(WINDOW + 6.0):
        explained = found.explained(model)
        width = int(sum(found.problem.width[k] for k in model))
        classes[(width, round(explained / (20 * tolerance)))].append(model)
    same: dict[Model, list[Model]] = {}
    for members in classes.values():
        members.sort(key=lambda m: (sum(terms[k].name is None for k in m), -found.scores[m]))
        same[members[0]] = members[1:]
    top = max(found.scores[m] for m in same)
    raw = {m: math.exp(found.scores[m] - top) for m in same if found.scores[m] > top - WINDOW}
    total = sum(raw.values())
    weights = {m: w / total for m, w in raw.items()}
    names: dict[str, float] = defaultdict(float)
    covariates: dict[tuple[str, ...], float] = defaultdict(float)
    for model, weight in weights.items():
        for name in {terms[k].name for k in model}:
            if name is not None:
                names[name] += weight
        for which in {terms[k].covariates for k in model if terms[k].name is None}:
            covariates[which] += weight
    # What is reported is names and covariates: the best of these first, then the best model that has them.
    skeletons: dict[Skeleton, float] = defaultdict(float)
    for model, weight in weights.items():
        skeletons[skeleton(found, model)] += weight
    likely = max(skeletons, key=lambda s: skeletons[s])
    best = max((m for m in weights if skeleton(found, m) == likely), key=lambda m: weights[m])
    return Verdict(best, weights, same, dict(names), dict(covariates))


def skeleton(found: Search, model: Model) -> Skeleton:
    """Names and covariates of a model, without axes, shapes and forms."""
    terms = [found.problem.terms[k] for k in model]
    return (
        tuple(sorted({term.name for term in terms if term.name is not None})),
        tuple(sorted({term.covariates for term in terms if term.name is None})),
    )
