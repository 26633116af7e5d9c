"""Search over models: all terms, then pairs, then wider, by a beam with exchange moves.

A model's score is ½ (χ² that it explains) − price of its columns − price of its terms. With the price of a
column ½ ln(1 + s² n), n the rows over which it is spread, and that of a term −ln of its share of the prior,
exp(score) is the Bayes factor of the model against the base model under a Gaussian prior of s standard
uncertainties on each amplitude, times its prior. A sum of such factors over all candidates has
expectation 1 where there is no effect, so that it exceeds 100 in at most 1 % of sessions whatever the
candidates are (Markov). That bound is far from sharp, since candidates are many and alike: over sessions
of 12 to 48 readings the best score of pure noise is above 0 in 0.45 %, and its 99 % quantile is −0.7 (−1.4
to −0.2 a session; scripts/trace_level.py), so that this prior holds the family-wise error rate at 1 %.

Models are sets and every set is scored once, so that the search cannot go round in circles.

From scored models to names: what stands, what cannot be told apart, what has no name.

Scores are log evidences, so that models near the best have posterior odds. Models that predict the same in
*this* session are one model: the representative is the simplest (fewest nameless terms, fewest columns,
then the more common cause), the others are its equivalents and are reported beside it. A name stands
where the models that hold it have most of the posterior; else it is confounded with whatever takes
its place.
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
    """Scored models of a problem.

    Attributes
    ----------
    problem : LinearProblem
    prices : (M,) float
        Price of each term.
    inflation : float
        Factor on the noise variance (greater than 1 where no model is adequate).
    scores : dict of model to float
        Scores against the base model, which has 0; models are sorted tuples of term numbers.
    opened : dict of model to float
        χ² of models whose extensions by one term have been scored.
    promise : (M,) float
        Best score that each term added to any model that was opened with all terms.
    """

    problem: LinearProblem
    prices: Floats
    inflation: float = 1.0
    scores: dict[Model, float] = field(default_factory=dict)
    opened: dict[Model, float] = field(default_factory=dict)
    promise: Floats = field(default_factory=lambda: np.zeros(0))

    @property
    def best(self) -> Model:
        """Model of the highest score."""
        return max(self.scores, key=self.scores.__getitem__)

    def near(self, within: float) -> dict[Model, float]:
        """Scores of all models within so many nats of the best."""
        top = max(self.scores.values())
        return {m: s for m, s in self.scores.items() if s >= top - within}

    def explained(self, model: Model) -> float:
        """χ² over 2 that a scored model explains."""
        return self.scores[model] + float(sum(self.prices[k] for k in model))

    def hope(self, model: Model) -> float:
        """The most that further terms could add: half of χ² beyond its degrees of freedom."""
        left = self.problem.chi2 / self.inflation - 2 * self.explained(model)
        return 0.5 * max(left - self.problem.dof, 0.0)


def price(problem: LinearProblem) -> Floats:
    """Price of each term (M,) in nats: its columns and its share of the prior."""
    priced: Floats = problem.column_price + problem.cost
    return priced


def search(
    problem: LinearProblem,
    max_terms: int,
    inflation: float = 1.0,
    beam: int = limits.beam,
    spare: int | None = None,
) -> Search:
    """Models of up to `max_terms` terms that explain the target.

    The best models of each size are extended by every term, the others of the beam by the terms that showed
    promise there and by all names.

    Parameters
    ----------
    inflation : float
        Factor on the noise variance (greater than 1 where no model is adequate).
    beam : int
        Models that are opened at each size; pairs are opened from twice as many terms.
    spare : int
        Degrees of freedom that a model has to leave; by default half of those beside the base model,
        since a model with more columns than checks could not fail. One effect of the catalogue alone, of
        no more columns than a bias, may use them all: six faces of a cube show a bias (or what imitates it)
        and no more.
    """
    if spare is None:
        spare = max(problem.dof // 2, 1)
    problem = problem.under(inflation)
    found = Search(problem, price(problem), inflation)
    found.scores[()] = 0.0
    found.promise = np.full(len(problem.terms), -np.inf)
    if problem.terms:
        _Beam(found, spare, max_terms, beam).run()
    return found


@dataclass(frozen=True)
class _Joining:
    """Terms that models are extended by: their problem, their numbers in the whole one, products."""

    problem: LinearProblem
    number: NDArray[np.intp]
    products: Products


class _Beam:
    """A search on its way."""

    def __init__(self, found: Search, spare: int, max_terms: int, width: int) -> None:
        problem = found.problem
        self.found, self.spare, self.max_terms, self.width = found, spare, max_terms, width
        self.every = _Joining(problem, np.arange(len(problem.terms)), Products(problem, problem))
        self.named = np.array([term.name is not None for term in problem.terms])
        self.nameless = frozenset(np.flatnonzero(~self.named).tolist())
        biases = (int(w) for w, t in zip(problem.width, problem.terms, strict=True) if t.name == "bias")
        self.bias_width = max(biases, default=0)
        self.top = 0.0

    def run(self) -> None:
        """Open level after level, then the neighbours of the best."""
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
        """Score every model that has one term more."""
        found, problem = self.found, self.found.problem
        if model in found.opened:
            return {}
        chi2, z, inside = joining.products.beside(model)
        found.opened[model] = chi2
        number, width = joining.number, joining.problem.width
        gains = joining.problem.taken(z, inside)
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
            # Alone a named term may be far behind many nameless ones that do the work of two named ones.
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
        """Models of a size that are opened: the best of those that may still come near the best of all."""
        if not fresh:
            return []
        wide = self._widest(fresh, 2 * self.width if size == 1 else self.width)
        level = [m for m in wide if fresh[m] + self.found.hope(m) > self.top - limits.behind]
        if size > 2 and max(fresh.values()) < self.top - limits.behind:
            # One nameless surface may be ahead of two names that want a third beside them.
            level = [m for m in level if self._all_named(m)]
        return level

    def _active(self) -> _Joining:
        """The terms that all models of the beam are extended by."""
        found = self.found
        number = np.union1d(np.flatnonzero(self.named), np.argsort(-found.promise)[: limits.active])
        problem = found.problem.only(number)
        return _Joining(problem, number, Products(found.problem, problem))

    def _widest(self, fresh: dict[Model, float], count: int) -> list[Model]:
        """Best models, and the best of each name on each choice of axes, in order of score."""
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
        """Open the neighbours of the best models (one term less) until none is better."""
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
    """Name and axes; None for a nameless term."""
    return (term.effect.name, term.effect.axes) if isinstance(term, NamedTerm) else None


def _different(found: Search, count: int) -> list[Model]:
    """Best models near the best, no two of the same names and covariates."""
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
