"""Search over models by a beam with exchange moves, and the posterior of the scored models.

Score of a model
    The score is ½ (explained χ²) − price of its columns − price of its terms. The price of a column is
    ½ ln(1 + s² n), with n the number of rows over which the column is spread; the price of a term is −ln of
    its share of the prior. exp(score) is then the Bayes factor against the base model, under a Gaussian
    prior of s standard uncertainties on each amplitude, times the model's prior. The sum of these factors
    over all candidates has expectation 1 if there is no effect, so it exceeds 100 in at most 1 % of
    sessions for any set of candidates (Markov). The bound is far from sharp, since candidates are many
    and similar: over sessions of 12 to 48 readings the best score of pure noise exceeds 0 in 0.45 % of
    cases, and its 99 % quantile is −0.7 (−1.4 to −0.2 by session; scripts/trace_level.py). The prior thus
    keeps the family-wise error rate at 1 %.

    Models are sets of terms and each set is scored once, so the search cannot cycle.

Posterior
    Scores are log evidences, so models near the best have posterior odds. Models with equal predictions in
    *this* session count as one model. Its representative is the simplest (fewest unnamed terms, fewest
    columns, then the more common cause); the others are reported as its equivalents. A name is accepted if
    the models that contain it have most of the posterior. Otherwise it is confounded with its replacements.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import spent
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.tracing.linear_problem import LinearProblem, Products, span
from adis_gonio.tracing.thresholds import limits

Model = tuple[int, ...]


@dataclass
class Search:
    """The models of a linear problem that a search has scored.

    Attributes
    ----------
    problem : LinearProblem
    prices : (M,) float
        Price of each term.
    inflation : float
        Factor on the noise variance (greater than 1 if no model is adequate).
    scores : dict of model to float
        Scores against the base model, whose score is 0; a model is a sorted tuple of term numbers.
    opened : dict of model to float
        χ² of the models that were extended by every other term, with all extensions scored.
    promise : (M,) float
        Best score of any model that adds this term to a fully opened model.
    """

    problem: LinearProblem
    prices: Floats
    inflation: float = 1.0
    scores: dict[Model, float] = field(default_factory=dict)
    opened: dict[Model, float] = field(default_factory=dict)
    promise: Floats = field(default_factory=lambda: np.zeros(0))

    @property
    def best(self) -> Model:
        """The model with the highest score, as term numbers."""
        return max(self.scores, key=self.scores.__getitem__)

    def near(self, within: float) -> dict[Model, float]:
        """Return the scores of all models with a score at most `within` nats below the best score."""
        top = max(self.scores.values())
        return {m: s for m, s in self.scores.items() if s >= top - within}

    def explained(self, model: Model) -> float:
        """Return half of the χ² that a scored model explains (its score without the prices)."""
        return self.scores[model] + float(sum(self.prices[k] for k in model))

    def hope(self, model: Model) -> float:
        """Return an upper limit for the rise of a model's score by further terms.

        The limit is half of the residual's χ² in excess of its degrees of freedom.
        """
        left = self.problem.chi2 / self.inflation - 2 * self.explained(model)
        return 0.5 * max(left - self.problem.dof, 0.0)


def price(problem: LinearProblem) -> Floats:
    """Return the price (M,) in nats that each term subtracts from a model's score.

    It is the sum of the price of the term's columns and of −ln of its prior probability.
    """
    priced: Floats = problem.column_price + problem.cost
    return priced


def search(
    problem: LinearProblem,
    max_terms: int,
    inflation: float = 1.0,
    beam: int = limits.beam,
    spare: int | None = None,
) -> Search:
    """Search for models of up to `max_terms` terms that explain the target.

    The best models of each size are extended by every term. The other models of the beam are extended by
    all named terms, and by the unnamed terms that reached the best scores so far.

    Parameters
    ----------
    inflation : float
        Factor on the noise variance (greater than 1 if no model is adequate).
    beam : int
        Number of models of each size that are extended by another term; twice as many for single terms.
    spare : int
        Degrees of freedom that must remain; by default half of the base model's degrees of freedom, since a
        model with more columns than remaining readings could not fail. A single named effect with at most
        as many columns as a bias may use all of them: the six faces of a cube show a bias, or an effect
        that looks like one, and nothing else.
    """
    if spare is None:
        spare = max(problem.dof // 2, 1)
    problem = problem.with_inflation(inflation)
    found = Search(problem, price(problem), inflation)
    found.scores[()] = 0.0
    found.promise = np.full(len(problem.terms), -np.inf)
    if problem.terms:
        Beam(found, spare, max_terms, beam).run()
    return found


@dataclass(frozen=True)
class _Joining:
    """Terms with which models are extended, their numbers in the whole problem, and products."""

    problem: LinearProblem
    number: NDArray[np.intp]
    products: Products


class Beam:
    """A beam search for models, with its present state."""

    def __init__(self, found: Search, spare: int, max_terms: int, width: int) -> None:
        problem = found.problem
        self.found, self.spare, self.max_terms, self.width = found, spare, max_terms, width
        self.every = _Joining(problem, np.arange(len(problem.terms)), Products(problem, problem))
        self.named = np.array([term.name is not None for term in problem.terms])
        self.nameless = frozenset(np.flatnonzero(~self.named).tolist())
        biases = (int(w) for w, t in zip(problem.width, problem.terms, strict=True) if t.constant)
        self.bias_width = max(biases, default=0)
        self.top = 0.0

    def run(self) -> None:
        """Search: extend models size by size, then try exchanging a term in the best models."""
        level: list[Model] = [()]
        for size in range(1, self.max_terms + 1):
            if size > 1 and spent():
                return
            fresh: dict[Model, float] = {}
            for model in level[: limits.widest]:
                fresh.update(self.open(model, self.every))
            if len(level) > limits.widest:
                active = self._active()
                for model in level[limits.widest :]:
                    if spent():
                        break
                    fresh.update(self.open(model, active))
            level = self._next_level(fresh, size)
            if not level:
                break
        self._exchange()

    def open(self, model: Model, joining: _Joining) -> dict[Model, float]:
        """Score all models that extend a model by one of the `joining` terms; return them with scores."""
        found, problem = self.found, self.found.problem
        if model in found.opened:
            return {}
        chi2, z, inside = joining.products.of_model(model)
        found.opened[model] = chi2
        number, width = joining.number, joining.problem.width
        gains = joining.problem.gains_from_products(z, inside)
        gained = 0.5 * gains / found.inflation - found.prices[number]
        here = 0.5 * (problem.chi2 - chi2) / found.inflation - sum(float(found.prices[k]) for k in model)
        room = problem.dof - len(inside) - width >= self.spare
        if not model:
            room |= self.named[number] & (width <= min(self.bias_width, problem.dof))
        gained = np.where(room & (gains > 1e-9), gained, -np.inf)
        for k in model:
            gained[number == k] = -np.inf
        if joining is self.every:
            found.promise = np.maximum(found.promise, gained)
        few = min(limits.scored, len(gained))
        floor = min(
            max(self.top - here, float(gained.max())) - limits.window,
            float(np.partition(gained, -few)[-few]),
        )
        wanted = gained >= floor
        if not model:
            # A single name may score far below many unnamed terms that replace two names at once.
            wanted |= self.named
        kept = np.flatnonzero(wanted & np.isfinite(gained))
        wider = np.empty((len(kept), len(model) + 1), dtype=np.intp)
        wider[:, :-1], wider[:, -1] = model, number[kept]
        wider.sort(axis=1)
        fresh: dict[Model, float] = dict(
            zip(map(tuple, wider.tolist()), (here + gained[kept]).tolist(), strict=True)
        )
        found.scores.update(fresh)
        self.top = max(self.top, *fresh.values()) if fresh else self.top
        return fresh

    def _next_level(self, fresh: dict[Model, float], size: int) -> list[Model]:
        """Return the models to be extended next: the best of this size that may reach the best score."""
        if not fresh:
            return []
        wide = self._widest(fresh, 2 * self.width if size == 1 else self.width)
        level = [m for m in wide if fresh[m] + self.found.hope(m) > self.top - limits.behind]
        if size > 2 and max(fresh.values()) < self.top - limits.behind:
            # One unnamed surface may score above two names that need a third one.
            level = [m for m in level if self._all_named(m)]
        return level

    def _active(self) -> _Joining:
        """Return the terms for extending models: all named terms, and unnamed terms with good scores."""
        found = self.found
        number = np.union1d(np.flatnonzero(self.named), np.argsort(-found.promise)[: limits.active])
        problem = found.problem.subset(number)
        return _Joining(problem, number, Products(found.problem, problem))

    def _widest(self, fresh: dict[Model, float], count: int) -> list[Model]:
        """Return the `count` best models and, among single terms, the best of each name and axes."""
        terms = self.found.problem.terms
        ranked = sorted(fresh, key=fresh.__getitem__, reverse=True)
        kept, rest = ranked[:count], ranked[count:]
        wanted = max(count // limits.names_only - sum(map(self._all_named, kept)), 0)
        kept += itertools.islice(filter(self._all_named, rest), wanted)
        if len(ranked[0]) == 1:
            seen = {_face(terms[m[0]]) for m in kept}
            for model in rest:
                face = _face(terms[model[0]])
                if face is not None and face not in seen:
                    seen.add(face)
                    kept.append(model)
        return kept

    def _all_named(self, model: Model) -> bool:
        return self.nameless.isdisjoint(model)

    def _exchange(self) -> None:
        """Try to exchange each term of the best models for another, until the best model does not change.

        Each model is extended again after one of its terms was removed.
        """
        for _ in range(limits.exchanges):
            best = self.found.best
            for model in _different(self.found, limits.exchanged):
                if spent():
                    return
                for k in range(len(model)):
                    self.open((*model[:k], *model[k + 1 :]), self.every)
                if len(model) < self.max_terms:
                    self.open(model, self.every)
            if self.found.best == best:
                return


def _face(term: Term) -> tuple[str, tuple[str, ...]] | None:
    """Return the name and axes of a term; None for an unnamed term."""
    return (term.effect.name, term.effect.axes) if isinstance(term, NamedTerm) else None


def _different(found: Search, count: int) -> list[Model]:
    """Return up to `count` of the best models, no two with equal names and covariates."""
    seen = set()
    kept: list[Model] = []
    for model in sorted(found.near(limits.voting), key=lambda m: -found.scores[m]):
        terms = [found.problem.terms[k] for k in model]
        face = frozenset((term.name, term.covariates) for term in terms)
        if face not in seen:
            seen.add(face)
            kept.append(model)
        if len(kept) == count:
            break
    return kept


Skeleton = tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]


@dataclass(frozen=True)
class ModelPosterior:
    """Posterior probabilities of the scored models.

    Attributes
    ----------
    best : tuple of int
        The most probable model.
    weights : dict of model to float
        Posterior of each class of models that span the same space, by its representative; sums to 1.
    same : dict of model to list of models
        The other models of each class.
    names : dict of str to float
        Posterior probability that each effect is present.
    covariates : dict of tuple of str to float
        Posterior probability that an unnamed term with these covariates is present.
    """

    best: Model
    weights: dict[Model, float]
    same: dict[Model, list[Model]]
    names: dict[str, float]
    covariates: dict[tuple[str, ...], float]


def posterior(found: Search) -> dict[Model, float]:
    """Return the posterior probability of each model near the best, the most probable first.

    Similar models are counted separately.
    """
    near = found.near(limits.weighed)
    ranked = sorted(near, key=lambda m: -near[m])[: limits.compared]
    raw = {m: math.exp(near[m] - near[ranked[0]]) for m in ranked}
    total = sum(raw.values())
    return {m: w / total for m, w in raw.items()}


def weigh(found: Search) -> ModelPosterior:
    """Return the posterior probabilities of the models, of names and of covariates."""
    terms = found.problem.terms
    each = posterior(found)
    same = _classes(found, list(each))
    weights = {m: sum(each[k] for k in (m, *others)) for m, others in same.items()}
    names, covariates = presence_probabilities(terms, weights)
    # The result reports names and covariates: choose the best set of these, then its best model.
    skeletons: dict[Skeleton, float] = defaultdict(float)
    for model, weight in weights.items():
        skeletons[skeleton(found, model)] += weight
    likely = max(skeletons, key=lambda s: skeletons[s])
    best = max((m for m in weights if skeleton(found, m) == likely), key=lambda m: weights[m])
    return ModelPosterior(best, weights, same, names, covariates)


def presence_probabilities(
    terms: Sequence[Term], weights: Mapping[Model, float]
) -> tuple[dict[str, float], dict[tuple[str, ...], float]]:
    """Return the probability that each name is present, and for each set of covariates a function."""
    names: dict[str, float] = defaultdict(float)
    covariates: dict[tuple[str, ...], float] = defaultdict(float)
    for model, weight in weights.items():
        for name in {terms[k].name for k in model}:
            if name is not None:
                names[name] += weight
        for which in {terms[k].covariates for k in model if terms[k].name is None}:
            covariates[which] += weight
    # A sum of weights may exceed 1 by rounding.
    return (
        {name: min(weight, 1.0) for name, weight in names.items()},
        {which: min(weight, 1.0) for which, weight in covariates.items()},
    )


def _classes(found: Search, models: list[Model]) -> dict[Model, list[Model]]:
    """Group models that predict nearly equal readings; map the simplest of each group to the others."""
    problem, terms = found.problem, found.problem.terms
    left = np.array([span(problem, m)[1] for m in models])
    norm = (left**2).sum(axis=1)
    distance = norm[:, None] + norm[None, :] - 2 * left @ left.T
    taken = np.zeros(len(models), dtype=bool)
    classes: dict[Model, list[Model]] = {}
    width = [int(sum(problem.width[k] for k in m)) for m in models]
    # The simplest first: fewest unnamed terms, fewest columns, then the most probable.
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
    """Return the names and covariates of a model, to compare models regardless of axes and shapes."""
    terms = [found.problem.terms[k] for k in model]
    return (
        tuple(sorted({term.name for term in terms if term.name is not None})),
        tuple(sorted({term.covariates for term in terms if term.name is None})),
    )
