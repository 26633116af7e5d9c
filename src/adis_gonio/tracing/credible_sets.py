"""Names that are accepted, credible sets of names for each cause, and names that remain undecided.

Credible sets
    Each probable model votes, weighted by its posterior, for its explanation of one cause in the chosen
    model. If it contains the cause, it votes for the cause. If not, it votes for its additional terms, to
    the degree that they can reproduce the contribution of the cause, or for no cause. A function of two
    covariates that replaces two names therefore counts against both. The votes for all forms of a name
    (axes, shapes, dwells) are added. The set is the smallest one with 95 % of the votes, as in SuSiE for
    correlated variables (Wang, Sarkar, Carbonetto and Stephens, J. R. Stat. Soc. B 82, 2020). Unnamed
    functions count in the same way as names.

    If a model contains a name and an unnamed function of related covariates, the name may describe only a
    part of an unnamed cause, so the model votes for the function. If an average replaces the unnamed
    functions, a share of the votes for the name goes to the Gaussian process of the average. The share is
    the total probability of the processes in the average.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import HIDDEN, JsonRecord
from adis_gonio.base.numbers import format_percent, join_words
from adis_gonio.fitting.estimation.terms import NamelessTerm, Term
from adis_gonio.tracing.averaging import AveragedFit
from adis_gonio.tracing.linear_problem import LinearProblem, span
from adis_gonio.tracing.model_search import Model, posterior, skeleton
from adis_gonio.tracing.selection import Selection
from adis_gonio.tracing.thresholds import limits

SLOW = {"time", "order", "temperature", "temperature_rate", "supply", "variance", "line_frequency"}
"""Covariates that change from dwell to dwell (slow ones); all others depend on the position."""


@dataclass(frozen=True)
class Names:
    """The named effects of the chosen model, divided into accepted and rejected ones.

    Attributes
    ----------
    accepted : tuple of str
        Names that are accepted.
    rejected : mapping of str to str
        Names that are not accepted, each with the reason.
    confounded : tuple of tuple of str
        Groups of effects or unnamed functions that the session cannot distinguish.
    """

    accepted: tuple[str, ...]
    rejected: dict[str, str]
    confounded: tuple[tuple[str, ...], ...]


def judge(selection: Selection, averaged: AveragedFit | None = None) -> Names:
    """Judge each named effect of the chosen model; return the accepted and the rejected names.

    A name is accepted if the models that contain it have most of the posterior (`certain`), and the model
    has no unnamed term with covariates of the kind of this name (slow, or dependent on the position). With
    such a term the name may describe only a part of an unnamed cause.

    Parameters
    ----------
    averaged : AveragedFit, optional
        Average that replaces the unnamed part of the model.
    """
    verdict, terms = selection.verdict, selection.problem.terms
    model = [terms[k] for k in verdict.best]
    unknown = unknown_of(selection, averaged)
    accepted: list[str] = []
    rejected: dict[str, str] = {}
    confounded: list[tuple[str, ...]] = []
    for name in dict.fromkeys(term.name for term in model if term.name is not None):
        mine = [term for term in model if term.name == name]
        rivals = [u for u in unknown if any(related(term, u) for term in mine)]
        probability = verdict.names.get(name, 0.0)
        if probability < limits.certain:
            rejected[name] = f"models without it have {format_percent(1 - probability)} of the posterior"
        elif rivals:
            rejected[name] = "may be a piece of the same unnamed cause"
            confounded.append((name, *(u.shown_as for u in rivals)))
        else:
            accepted.append(name)
    confounded += _replacements(selection)
    return Names(tuple(accepted), rejected, tuple(dict.fromkeys(confounded)))


def unknown_of(selection: Selection, averaged: AveragedFit | None) -> list[NamelessTerm]:
    """Return the unnamed terms that may be the cause instead of a name.

    They are the unnamed terms of the chosen model. If the model has none, the result is the most probable
    Gaussian process of `averaged`, or empty if `averaged` is None.
    """
    terms = [selection.problem.terms[k] for k in selection.verdict.best]
    own = [term for term in terms if isinstance(term, NamelessTerm)]
    return own if own or averaged is None else [averaged.smooth]


def related(term: Term, unknown: Term) -> bool:
    """Return True if a named and an unnamed term may describe parts of a single cause.

    This is possible if their covariates are of one kind (slow, or dependent on the position). `term` is
    the named term, `unknown` the unnamed one.
    """
    if not term.covariates:
        return False
    if term.dwell is not None:
        return True  # an effect of one dwell may be a piece of any cause
    slow, of_unknown = ({c in SLOW for c in one.covariates} for one in (term, unknown))
    return bool(slow & of_unknown)


def _replacements(selection: Selection) -> list[tuple[str, ...]]:
    """Return groups of effects: of the chosen model, and of another probable model that replaces them.

    A group has first the effects that only the chosen model contains, then the effects that the other model
    contains instead.
    """
    verdict = selection.verdict
    best = verdict.best
    top = verdict.weights.get(best, max(verdict.weights.values()))
    out: list[tuple[str, ...]] = []
    rivals = [m for m, w in verdict.weights.items() if m != best and w >= limits.near * top]
    rivals += [m for m in verdict.same.get(best, []) if len(m) <= len(best)]
    for rival in sorted(rivals, key=lambda m: -selection.found.scores[m]):
        if skeleton(selection.found, rival) == skeleton(selection.found, best):
            continue
        ours, theirs = _parts(selection, best), _parts(selection, rival)
        lost = [part for part in ours if part not in theirs]
        gained = [part for part in theirs if part not in ours]
        names = [ours[part] for part in lost]
        named = any((*names, *(theirs[part] for part in gained)))
        sure = all(verdict.names.get(name, 0.0) > limits.sure for name in names if name is not None)
        same = rival in verdict.same.get(best, [])
        if lost and gained and named and (same or not sure):
            out.append((*lost, *gained))
        if len(out) >= 5:
            break
    return out


def _parts(selection: Selection, model: Model) -> dict[str, str | None]:
    """Map the texts of a model's causes, without axes, to their names; None for an unnamed function."""
    terms = (selection.problem.terms[k] for k in model)
    return {term.shown_as: term.name for term in terms}


class CredibleSet(JsonRecord):
    """Smallest set of names that together have 95 % of the probability of being one cause in the model.

    The JSON document is one entry of `sets`.

    Attributes
    ----------
    cause : str
        Name that the model has for the cause, or the covariates of an unnamed function.
    names : tuple of str
        Possible names of the cause, the most probable first; an unnamed function is named by its
        covariates.
    probability : tuple of float
        Probability of each name.
    present : float
        Probability that the cause, or any replacement of it, is present.
    """

    cause: str = field(metadata=HIDDEN)
    names: tuple[str, ...]
    probability: tuple[float, ...]
    present: float


def credible_sets(selection: Selection, averaged: AveragedFit | None = None) -> tuple[CredibleSet, ...]:
    """Return the credible set of each cause in the chosen model, in the order of the model's terms.

    `averaged` is the average that replaces the unnamed part of the model, if any.
    """
    causes = dict.fromkeys(map(cause_name, selection.terms))
    return tuple(set_of(selection, cause, averaged) for cause in causes)


def merge_by_function(sets: Sequence[CredibleSet], likelier: Mapping[str, str]) -> tuple[CredibleSet, ...]:
    """Keep one set for named causes that one unnamed function explains with higher probability.

    It is the first set among the sets of these causes.

    Parameters
    ----------
    sets : sequence of CredibleSet
        Sets of all causes.
    likelier : mapping of str to str
        For each of these named causes, the unnamed function. All other causes keep their sets.
    """
    leads = [likelier.get(one.cause, one.cause) for one in sets]
    return tuple(one for k, one in enumerate(sets) if leads[k] not in leads[:k])


def set_of(selection: Selection, cause: str, averaged: AveragedFit | None = None) -> CredibleSet:
    """Return the credible set of one cause, given as its name or as an unnamed function's covariates.

    `averaged` is the average that replaces the unnamed part of the model, if any.
    """
    share, present = votes(selection, cause, averaged)
    ranked = sorted(share, key=lambda name: -share[name])
    count = 1 + int(np.searchsorted(np.cumsum([share[name] for name in ranked]), limits.set_level))
    return CredibleSet(cause, tuple(ranked[:count]), tuple(share[name] for name in ranked[:count]), present)


def votes(
    selection: Selection, cause: str, averaged: AveragedFit | None = None
) -> tuple[dict[str, float], float]:
    """Return the probability of each possible name of a cause, and the probability that it is present.

    `cause` is its name in the chosen model. Each probable model counts for the name that it contains, with
    its own probability.

    Parameters
    ----------
    averaged : AveragedFit, optional
        Average that replaces the unnamed part of the chosen model.
    """
    counted, none = selection.once(_count_votes, cause)
    weight = defaultdict(float, counted)
    total = sum(weight.values())
    if not total > 0:
        return {cause: 1.0}, 0.0
    own = [term for k in selection.verdict.best if (term := selection.problem.terms[k]).name == cause]
    # A named cause may be a part of the process that describes an unnamed function of related covariates.
    if averaged is not None and any(
        unknown is averaged.smooth and related(term, unknown)
        for unknown in unknown_of(selection, averaged)
        for term in own
    ):
        piece = weight[cause] * averaged.weight
        weight[cause] -= piece
        weight[cause_name(averaged.smooth)] += piece
    return {word: w / total for word, w in weight.items()}, total / (total + none)


def _count_votes(selection: Selection, cause: str) -> tuple[dict[str, float], float]:
    """Return the sums of the models' votes: for each possible name of a cause, and for its absence."""
    near = selection.found.near(limits.voting)
    top = max(near.values())
    place = _Place.of(selection, cause)
    weight: dict[str, float] = defaultdict(float)
    none = 0.0
    for model, score in near.items():
        vote = math.exp(score - top)
        choice = place.choice(model)
        for word, part in choice.items():
            weight[word] += vote * part
        none += vote * (1 - sum(choice.values()))
    return weight, none


def owners_of(selection: Selection, cause: str, owner: Callable[[Term], str]) -> dict[str, float]:
    """Return the probabilities that a cause, if present, belongs to the stage, each part or each session.

    `cause` is its name in the chosen model. `owner` returns for a term one of these possibilities. Each
    probable model counts, with its probability, for the possibility of its term for the cause.
    """
    place, terms = _Place.of(selection, cause), selection.problem.terms
    weight: dict[str, float] = defaultdict(float)
    for model, probability in posterior(selection.found).items():
        for word, part in place.choice(model).items():
            owners = {owner(terms[k]) for k in model if cause_name(terms[k]) == word}
            for one in owners:
                weight[one] += probability * part / len(owners)
    total = sum(weight.values())
    return {one: weight[one] / total for one in sorted(weight, key=lambda one: -weight[one])}


def probability_of(selection: Selection, cause: str, averaged: AveragedFit | None = None) -> float:
    """Return the probability that a cause of the chosen model is present and that its name is right.

    `averaged` is the average that replaces the unnamed part of the model, if any.
    """
    share, present = votes(selection, cause, averaged)
    return min(share.get(cause, 0.0) * present, 1.0)


@dataclass(frozen=True)
class _Place:
    """One cause in the chosen model, with the means to find the names that other models have instead.

    Attributes
    ----------
    problem : LinearProblem
        Linear problem in which the models were chosen.
    cause : str
        Name of the cause, or the covariates of an unnamed function.
    ours : frozenset of str
        Names of all causes of the chosen model, this one included.
    added : (rows,) float
        Contribution of the cause to the prediction, scaled to unit length; zero if the model lacks the
        cause.
    """

    problem: LinearProblem
    cause: str
    ours: frozenset[str]
    added: Floats

    @classmethod
    def of(cls, selection: Selection, cause: str) -> _Place:
        problem, best = selection.problem, selection.verdict.best
        rest = [k for k in best if cause_name(problem.terms[k]) != cause]
        # The residual without the cause minus the residual with it is its contribution.
        added = span(problem, rest)[1] - span(problem, best)[1]
        ours = frozenset(cause_name(problem.terms[k]) for k in best)
        return cls(problem, cause, ours, added / max(float(np.linalg.norm(added)), 1e-300))

    def choice(self, model: Model) -> dict[str, float]:
        """Return the names that a model has instead of this cause, with shares that sum to at most 1.

        If the model lacks several causes, each of its additional terms is shared among them, in proportion
        to the part of the cause's contribution that it reproduces.
        """
        terms = [self.problem.terms[k] for k in model]
        mine = [term for term in terms if cause_name(term) == self.cause]
        if mine:
            unknown = [u for u in terms if u.name is None and any(t.name and related(t, u) for t in mine)]
            words = set(map(cause_name, unknown)) or {self.cause}
            return dict.fromkeys(words, 1 / len(words))
        fresh = [k for k in model if cause_name(self.problem.terms[k]) not in self.ours]
        kept = [k for k in model if k not in fresh]
        words = {cause_name(self.problem.terms[k]) for k in fresh}
        lost = self.ours - set(map(cause_name, terms))
        # If the model lacks several causes, its additional terms vote only for the reproduced part.
        whole = self._explained(fresh, kept) if fresh and len(lost) > 1 else 1.0
        if len(words) <= 1:
            return dict.fromkeys(words, whole)
        part: dict[str, float] = defaultdict(float)
        for k in fresh:
            part[cause_name(self.problem.terms[k])] += self._explained([k], kept) + 1e-12
        return {word: whole * share / sum(part.values()) for word, share in part.items()}

    def _explained(self, fresh: Sequence[int], kept: Sequence[int]) -> float:
        """Return the share (0 to 1) of the cause's contribution that some terms of a model reproduce.

        `fresh` are the numbers of the terms whose cause the chosen model lacks, `kept` the numbers of the
        other terms.
        """
        outside = self.problem.off([*fresh, *kept], self.added)
        return float((self.added**2).sum() - (outside**2).sum())


def cause_name(term: Term) -> str:
    """Return the name of an effect, or a text with the covariates of an unnamed function."""
    return term.name or f"unnamed: {join_words(term.covariates)}"


def undecided(selection: Selection, count: int = 5) -> tuple[str, ...]:
    """Return at most `count` named effects that could explain the residual of a model that is not adequate.

    Each effect is added alone and tested by an F-test at 10 %. The noise is taken from the residual, since
    the noise measured within the dwells does not explain it. If any effect passes, the result has all
    effects with at least 1/`limits.open_alike` of the largest probability; the probabilities of all forms
    of a name (axes, shapes) are summed. The most probable comes first. None of these names is accepted.
    """
    from scipy.special import fdtrc

    problem: LinearProblem = selection.problem
    basis, residual = span(problem, selection.verdict.best)
    chi2 = float(residual @ residual)
    dof = problem.dof - basis.shape[1]
    gains = problem.gains(basis, residual)
    likely: dict[str, float] = defaultdict(float)
    least_p = 1.0
    inside = {problem.terms[k].name for k in selection.verdict.best}
    for k, term in enumerate(problem.terms):
        width = int(problem.width[k])
        if term.name is None or term.name in inside or term.dwell is not None or dof - width < 1:
            continue
        # F statistic of the added columns; the noise is the remaining residual.
        left = max(chi2 - float(gains[k]), 1e-12 * chi2)
        p = float(fdtrc(width, dof - width, max(float(gains[k]), 0.0) / width / (left / (dof - width))))
        least_p = min(least_p, p)
        # Likelihood with the noise fitted, times the prior: (χ² after / χ² before)^(−dof/2) · exp(−price).
        price = float(problem.cost[k] + problem.column_price[k])
        likely[term.name] += math.exp(-0.5 * dof * math.log(left / chi2) - price)
    if least_p >= limits.open_level:
        return ()
    most = max(likely.values())
    alike = [name for name, odds in likely.items() if odds * limits.open_alike > most]
    return tuple(sorted(alike, key=lambda name: -likely[name])[:count])
