"""Search for the model of the highest evidence, and the posterior of all models that it scored.

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

Search
    The neighbours of a model are made in two steps. First up to two of its terms are removed, and a bias
    may be added. Then up to one term of any kind, or two named terms, are added. The neighbours contain
    every model with a term added, dropped or exchanged, with two terms merged into one, with a term split
    into two names, and with a function replaced by a bias and two names. When the search ends, all
    neighbours of its best model have been scored, and none has a higher score. (A time limit ends it
    earlier; scores far below the best are not stored.) The search starts at the best single terms and at
    the best model of names alone, scores the neighbours of the best model, and repeats this for each better
    model. The nearest neighbours of a few other good models are scored too, for the posterior. Each set of
    terms is one model, so the search cannot cycle.

Posterior
    Scores are log evidences, so exp(score) gives the posterior odds of the models near the best. Models
    with equal predictions in *this* session count as one model. Its representative is the simplest (fewest
    unnamed terms, fewest columns, then the more common cause); the others are reported as its equivalents.
    A name is accepted if the models that contain it have most of the posterior. Otherwise it is confounded
    with its replacements.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import spent
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.tracing.linear_problem import LinearProblem, Products
from adis_gonio.tracing.thresholds import limits

Model = tuple[int, ...]


@dataclass
class Search:
    """All models of a linear problem that a search has scored, with their scores.

    Attributes
    ----------
    problem : LinearProblem
        Linear problem with all candidate terms.
    prices : (M,) float
        Amount in nats by which each term lowers the score of a model.
    inflation : float
        Factor on the measured noise variance; greater than 1 if no model is adequate.
    scores : dict of model to float
        Log evidence of each model relative to the base model (score 0); a model is a sorted
        tuple of term numbers.
    promise : (M,) float
        Largest rise of the score by each term, over all models to which the search added every term in
        turn.
    """

    problem: LinearProblem
    prices: Floats
    inflation: float = 1.0
    scores: dict[Model, float] = field(default_factory=dict)
    promise: Floats = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def forced(self) -> Model:
        """The terms that are in every model."""
        return tuple(k for k, term in enumerate(self.problem.terms) if term.forced)

    @property
    def best(self) -> Model:
        """The model with the highest score, as a tuple of term numbers."""
        return max(self.scores, key=self.scores.__getitem__)

    def near(self, within: float) -> dict[Model, float]:
        """Return the scores of all models with a score at most `within` nats below the best score."""
        top = max(self.scores.values())
        return {m: s for m, s in self.scores.items() if s >= top - within}

    def explained(self, model: Model) -> float:
        """Return half of the decrease of χ² by a scored model: its score plus the prices of its terms."""
        return self.scores[model] + float(sum(self.prices[k] for k in model))


def price(problem: LinearProblem) -> Floats:
    """Return the price (M,) of each term in nats: the amount by which it lowers a model's score.

    It is the sum of the price of the term's columns and of −ln of its prior probability.
    """
    priced: Floats = problem.column_price + problem.cost
    return priced


def search(
    problem: LinearProblem,
    max_terms: int,
    inflation: float = 1.0,
    explored: int = limits.explored,
    spare: int | None = None,
) -> Search:
    """Score models of up to `max_terms` terms that may explain the readings, and return their scores.

    Parameters
    ----------
    inflation : float
        Factor on the measured noise variance; greater than 1 if no model is adequate.
    explored : int
        Number of the best models whose neighbours (models with a term added, dropped or exchanged) are all
        scored.
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
    found.promise = np.full(len(problem.terms), -np.inf)
    if problem.terms:
        Climb(found, spare, max_terms, explored).run()
    else:
        found.scores[()] = 0.0
    return found


class _Joining:
    """Terms that may extend models: all terms or the named ones, with a cache of products of columns.

    `number` are their numbers among all terms; `opened` are the models that they have already extended.
    """

    def __init__(self, problem: LinearProblem, number: NDArray[np.intp]) -> None:
        self.number = number
        self.problem = problem if len(number) == len(problem.terms) else problem.subset(number)
        self.products = Products(problem, self.problem)
        self.opened: set[Model] = set()


class Climb:
    """Local search: it scores the neighbours of the best models until the best models do not change."""

    def __init__(self, found: Search, spare: int, max_terms: int, explored: int) -> None:
        problem, terms = found.problem, found.problem.terms
        self.found, self.spare, self.max_terms, self.explored = found, spare, max_terms, explored
        self.named = np.array([term.name is not None for term in terms])
        self.every = _Joining(problem, np.arange(len(terms)))
        self.names = _Joining(problem, np.flatnonzero(self.named))
        self.paired: set[Model] = set()
        columns = int(self.names.problem.width.sum())
        self.paired_names = not problem.joint or (explored > 1 and columns <= limits.paired)
        self.bias = problem.widest_bias
        self.nameless = frozenset(np.flatnonzero(~self.named).tolist())
        # The best of all models and of those with names only, by their names and covariates.
        kinds = {key: i for i, key in enumerate(dict.fromkeys((t.name, t.covariates) for t in terms))}
        self.kind = np.array([kinds[term.name, term.covariates] for term in terms], dtype=np.intp)
        self.forced = found.forced
        first = self._score(self.forced, problem.chi2 - problem.gain(self.forced))
        found.scores[self.forced] = self.top = first
        begin = {frozenset(self.kind[list(self.forced)].tolist()): (first, self.forced)}
        self.leads = begin, dict(begin)

    def run(self) -> None:
        """Extend the best single terms, then search with the named terms alone, then with every term."""
        with_bias = () if self.bias is None else (self.bias,)
        for model in dict.fromkeys((self.forced, tuple(sorted({*self.forced, *with_bias})))):
            self.open(model, self.every)
            if not spent():
                self.score_pairs(model, start=True)
        starts = limits.starts if self.explored > 1 else limits.fold_starts
        for model in heapq.nlargest(starts, self.found.scores, key=self.found.scores.__getitem__):
            if spent():
                break
            self.open(model, self.every)
        if self.named.any():
            self._climb(self.names, 1)
        self._climb(self.every, self.explored)

    def _climb(self, joining: _Joining, explored: int) -> None:
        """Score the neighbours of the `explored` best models until these models do not change.

        `joining` are the terms that may extend a model.
        """
        leads = self.leads[joining is self.names]
        done: set[tuple[Model, bool]] = set()
        while not spent():
            (_, best), *others = heapq.nlargest(explored, leads.values())
            if len(self.every.opened) >= limits.openings:
                others = []
            # A model, and whether its farther neighbours are scored.
            steps = [(best, False), (best, True), *((model, False) for _, model in others)]
            if joining is self.names:
                del steps[1]
            step = next((step for step in steps if step not in done), None)
            if step is None:
                break
            done.add(step)
            model, far = step
            for rest in self._reduced(model, far):
                self.open(rest, joining)
                if far:
                    self.score_pairs(rest)

    def _reduced(self, model: Model, far: bool) -> Iterator[Model]:
        """Yield a model and all models that it becomes without one of its terms.

        If `far` is true, also yield the models without two terms, and each model with a bias added.
        """
        free = [k for k in model if k not in self.forced]
        for dropped in range(min(len(free), 1 + far) + 1):
            for kept in itertools.combinations(free, len(free) - dropped):
                rest = tuple(sorted((*self.forced, *kept)))
                yield rest
                biased = any(self.found.problem.terms[k].constant for k in rest)
                if far and self.bias is not None and not biased:
                    yield tuple(sorted((*rest, self.bias)))

    def score_pairs(self, model: Model, *, start: bool = False) -> None:
        """Score all models that extend a model by two named terms.

        A pair is stored if it scores at most `limits.window` nats below the best model. If `start` is True,
        it is compared with the best pair instead.
        """
        found, problem, joining = self.found, self.found.problem, self.names
        if (
            not self.paired_names
            or model in self.paired
            or len(model) + 2 > self.max_terms
            or len(joining.number) < 2
        ):
            return
        self.paired.add(model)
        chi2, rank, pairs = joining.products.pairs(model)
        here = self._score(model, chi2)
        prices, width = found.prices[joining.number], joining.problem.width
        new = np.isin(joining.number, model, invert=True)
        top, kept = -np.inf if start else self.top, []
        for one, gains in pairs:
            others = slice(one.start, None)
            scores = here + 0.5 * gains / found.inflation - prices[others] - prices[one, None]
            room = problem.dof - rank - width[others] - width[one, None] >= self.spare
            scores[~np.triu(room & new[others] & new[one, None], 1)] = -np.inf
            top = max(top, float(scores.max())) if start else top
            wanted = np.argwhere(np.isfinite(scores) & (scores >= top - limits.window))
            kept.append((one.start + wanted, scores[tuple(wanted.T)]))
        added, score = (np.concatenate(parts) for parts in zip(*kept, strict=True))
        high = score >= top - limits.window
        self._keep(model, joining.number[added[high]], score[high])

    def _keep(self, model: Model, added: NDArray[np.intp], scores: Floats) -> None:
        """Store the scores (n,) of a model extended by terms, given by their numbers (n, k) in `added`."""
        wider = np.empty((len(added), len(model) + added.shape[1]), dtype=np.intp)
        wider[:, : len(model)], wider[:, len(model) :] = model, added
        wider.sort(axis=1)
        known = self.found.scores
        fresh = dict(zip(map(tuple, wider.tolist()), scores.tolist(), strict=True))
        if self.found.problem.joint:
            # A bias of all sessions is nearly inside one of each session, and the ridge of the gains then
            # lowers its gain by far more than rounding. The largest score of a model is the most exact.
            fresh = {one: max(score, known.get(one, score)) for one, score in fresh.items()}
        known.update(fresh)
        self.top = max(self.top, float(scores.max(initial=-np.inf)))
        # Of the terms of one kind, all are named or none is, so only the best score of each can lead.
        group = (self.kind[added] * len(self.kind) ** np.arange(added.shape[1])).sum(axis=1)
        order = np.lexsort((-scores, group))
        for k in order[np.diff(group[order], prepend=-1) > 0].tolist():
            one, score = tuple(wider[k].tolist()), float(scores[k])
            kinds = frozenset(self.kind[wider[k]].tolist())
            for leads in self.leads if self.nameless.isdisjoint(one) else self.leads[:1]:
                if kinds not in leads or score > leads[kinds][0]:
                    leads[kinds] = score, one

    def _score(self, model: Model, chi2: float) -> float:
        found = self.found
        explained = 0.5 * (found.problem.chi2 - chi2) / found.inflation
        return explained - sum(float(found.prices[k]) for k in model)

    def open(self, model: Model, joining: _Joining) -> None:
        """Score a model and all models that extend it by one of the `joining` terms."""
        found, problem = self.found, self.found.problem
        if model in joining.opened or len(model) > self.max_terms:
            return
        joining.opened.add(model)
        chi2, rank, gains = joining.products.extensions(model)
        here = self._score(model, chi2)
        if problem.dof - rank >= self.spare:
            self._keep(model, np.zeros((1, 0), dtype=np.intp), np.array([here]))
        if len(model) == self.max_terms:
            return
        number, width = joining.number, joining.problem.width
        gained = 0.5 * gains / found.inflation - found.prices[number]
        room = problem.dof - rank - width >= self.spare
        if not model:
            widest = 0 if self.bias is None else int(problem.width[self.bias])
            room |= self.named[number] & (width <= min(widest, problem.dof))
        gained = np.where(room & (gains > 1e-9), gained, -np.inf)
        gained[np.isin(number, model)] = -np.inf
        if joining is self.every:
            found.promise = np.maximum(found.promise, gained)
        few = min(limits.scored, len(gained))
        floor = min(
            max(self.top - here, float(gained.max())) - limits.window,
            float(np.partition(gained, -few)[-few]),
        )
        wanted = gained >= floor
        if model == self.forced:
            # A single name may score far below many unnamed terms that replace two names at once.
            wanted |= self.named[number]
        kept = np.flatnonzero(wanted & np.isfinite(gained))
        self._keep(model, number[kept, None], here + gained[kept])


Skeleton = tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]


@dataclass(frozen=True)
class ModelPosterior:
    """Posterior probabilities of the scored models.

    Attributes
    ----------
    best : tuple of int
        The most probable model.
    weights : dict of model to float
        Posterior of each class of models with equal predictions, by its simplest model; the sum is 1.
    same : dict of model to list of models
        The other models of each class, by its simplest model.
    names : dict of str to float
        Posterior probability that each effect is present.
    """

    best: Model
    weights: dict[Model, float]
    same: dict[Model, list[Model]]
    names: dict[str, float]


def posterior(found: Search) -> dict[Model, float]:
    """Return the posterior probability of each model with a score near the best, the most probable first.

    Near is at most `limits.weighed` nats below the best, for at most `limits.compared` models. Models with
    equal predictions are counted separately.
    """
    near = found.near(limits.weighed)
    ranked = sorted(near, key=lambda m: -near[m])[: limits.compared]
    raw = {m: math.exp(near[m] - near[ranked[0]]) for m in ranked}
    total = sum(raw.values())
    return {m: w / total for m, w in raw.items()}


def weigh(found: Search) -> ModelPosterior:
    """Return the posterior probabilities of the scored models and of the names that they contain."""
    each = posterior(found)
    same = _classes(found, list(each))
    weights = {m: sum(each[k] for k in (m, *others)) for m, others in same.items()}
    names = presence_probabilities(found.problem.terms, weights)
    # The result reports names and covariates: choose the best set of these, then its best model.
    skeletons: dict[Skeleton, float] = defaultdict(float)
    for model, weight in weights.items():
        skeletons[skeleton(found, model)] += weight
    likely = max(skeletons, key=lambda s: skeletons[s])
    best = max((m for m in weights if skeleton(found, m) == likely), key=lambda m: weights[m])
    return ModelPosterior(best, weights, same, names)


def presence_probabilities(
    terms: Sequence[Term],
    weights: Mapping[Model, float],
    name_of: Callable[[Term], str | None] = lambda term: term.name,
) -> dict[str, float]:
    """Return the probability that each name is present: the weight of the models that contain it.

    `terms` are all candidate terms; `weights` are the posterior probabilities of the models. `name_of`
    returns the name of a term or, for a term that does not count, None.
    """
    names: dict[str, float] = defaultdict(float)
    for model, weight in weights.items():
        for name in {name_of(terms[k]) for k in model} - {None}:
            names[str(name)] += weight
    # A sum of weights may exceed 1 by rounding.
    return {name: min(weight, 1.0) for name, weight in names.items()}


def _classes(found: Search, models: list[Model]) -> dict[Model, list[Model]]:
    """Group models that predict nearly equal readings; map the simplest of each group to the others."""
    problem, terms = found.problem, found.problem.terms
    left = np.array([problem.off(m, problem.target) for m in models])
    norm = (left**2).sum(axis=1)
    distance = norm[:, None] + norm[None, :] - 2 * left @ left.T
    taken = np.zeros(len(models), dtype=bool)
    classes: dict[Model, list[Model]] = {}
    width = [int(sum(problem.width[k] for k in m)) for m in models]
    # The simplest first: fewest unnamed terms, fewest columns, then the most probable. Models whose scores
    # differ by rounding only (sin 4θ and sin 6θ at ten angles) keep the order of the candidates.
    likely = [round(found.scores[m], 6) for m in models]
    order = sorted(
        range(len(models)),
        key=lambda i: (sum(terms[k].name is None for k in models[i]), width[i], -likely[i], models[i]),
    )
    for i in order:
        if not taken[i]:
            members = np.flatnonzero((distance[i] < limits.same_prediction * found.inflation) & ~taken)
            taken[members] = True
            classes[models[i]] = [models[k] for k in members if k != i]
    return classes


def skeleton(found: Search, model: Model) -> Skeleton:
    """Return the names of the effects in a model, and the covariates of its unnamed functions.

    Models that differ only in axes or shapes have equal results.
    """
    terms = [found.problem.terms[k] for k in model]
    return (
        tuple(sorted({term.name for term in terms if term.name is not None})),
        tuple(sorted({term.covariates for term in terms if term.name is None})),
    )
