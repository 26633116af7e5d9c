"""Which names of the chosen model stand, and what they are confounded with.

Credible sets: for each cause of a model the names that could stand in its place.

Every scored model near the best votes with its posterior for what it has in the place of a cause: for the
cause itself; or, where it lacks that cause, for what it has beyond the chosen model, as far as that can add
what the cause adds; or for none. So a surface that does the work of two names counts against both. Variants
of a name (axes, shapes, dwells) add up. The set is the smallest with 95 % of the votes, as SuSiE has it for
correlated variables (Wang, Sarkar, Carbonetto and Stephens, J. R. Stat. Soc. B 82, 2020); functions without
a name compete on equal terms.

A name beside a function without one of the same kind may be a piece of that unknown cause, and votes for
it; where that function is an average over processes, by their probability.

Effects that could each explain what an inadequate model leaves: what this session cannot decide.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import HIDDEN, JsonRecord
from adis_gonio.base.numbers import join_words
from adis_gonio.fitting.estimation.terms import NamelessTerm, Term
from adis_gonio.tracing.averaging import Averaged
from adis_gonio.tracing.linear_problem import LinearProblem, span
from adis_gonio.tracing.model_search import Model, skeleton
from adis_gonio.tracing.selection import Selection
from adis_gonio.tracing.thresholds import limits

SLOW = {"time", "order", "temperature", "temperature_rate", "supply", "variance"}
"""Covariates that move on from dwell to dwell; the others follow the position."""


@dataclass(frozen=True)
class Names:
    """Names of the chosen model.

    Attributes
    ----------
    stand : tuple of str
        Names that are found.
    open : mapping of str to str
        Names that are not, with the reason.
    confounded : tuple of tuple of str
    """

    stand: tuple[str, ...]
    open: dict[str, str]
    confounded: tuple[tuple[str, ...], ...]


def judge(selection: Selection, averaged: Averaged | None = None) -> Names:
    """Names that stand.

    A name stands if the models that hold it have most of the posterior (`certain`), and no nameless term of
    the same kind of covariate (slow or of position) stands in the same model: that name may be a piece of
    the unknown cause.

    Parameters
    ----------
    averaged : Averaged, optional
        What stands beside the names of a model without nameless terms.
    """
    verdict, terms = selection.verdict, selection.problem.terms
    model = [terms[k] for k in verdict.best]
    unknown = unknown_of(selection, averaged)
    stand: list[str] = []
    pending: dict[str, str] = {}
    confounded: list[tuple[str, ...]] = []
    for name in dict.fromkeys(term.name for term in model if term.name is not None):
        mine = [term for term in model if term.name == name]
        beside = [u for u in unknown if any(related(term, u) for term in mine)]
        probability = verdict.names.get(name, 0.0)
        if probability < limits.certain:
            pending[name] = f"models without it have {1 - probability:.0%} of the posterior"
        elif beside:
            pending[name] = "may be a piece of the same unnamed cause"
            confounded.append((name, *(u.shown_as for u in beside)))
        else:
            stand.append(name)
    confounded += _replacements(selection)
    return Names(tuple(stand), pending, tuple(dict.fromkeys(confounded)))


def unknown_of(selection: Selection, averaged: Averaged | None) -> list[NamelessTerm]:
    """Functions without a name beside which names are judged: the model's own, else what is averaged."""
    terms = [selection.problem.terms[k] for k in selection.verdict.best]
    own = [term for term in terms if isinstance(term, NamelessTerm)]
    return own if own or averaged is None else [averaged.smooth]


def related(term: Term, unknown: Term) -> bool:
    """True where a named and a nameless term may be pieces of one cause."""
    if not term.covariates:
        return False
    if term.dwell is not None:
        return True  # one dwell may be a piece of anything
    return bool(_kinds(term.covariates) & _kinds(unknown.covariates))


def _kinds(covariates: Sequence[str]) -> set[bool]:
    return {covariate in SLOW for covariate in covariates}


def _replacements(selection: Selection) -> list[tuple[str, ...]]:
    """What takes the place of names in models near the best, and in models that predict the same."""
    verdict = selection.verdict
    best = verdict.best
    top = verdict.weights[best]
    out: list[tuple[str, ...]] = []
    rivals = [m for m, w in verdict.weights.items() if m != best and w >= limits.near * top]
    rivals += [m for m in verdict.same.get(best, []) if len(m) <= len(best)]
    for rival in sorted(rivals, key=lambda m: -selection.found.scores[m]):
        if skeleton(selection.found, rival) == skeleton(selection.found, best):
            continue
        ours, theirs = _parts(selection, best), _parts(selection, rival)
        lost = [p for p in ours if p not in theirs]
        gained = [p for p in theirs if p not in ours]
        named = any(part.name is not None for part in (*lost, *gained))
        sure = all(verdict.names.get(p.name, 0.0) > limits.sure for p in lost if p.name is not None)
        same = rival in verdict.same.get(best, [])
        if lost and gained and named and (same or not sure):
            out.append(tuple(part.shown_as for part in (*lost, *gained)))
        if len(out) >= 5:
            break
    return out


@dataclass(frozen=True)
class _Part:
    """Name of an effect, or a nameless function, whatever its axes."""

    name: str | None
    shown_as: str


def _parts(selection: Selection, model: Model) -> list[_Part]:
    terms = (selection.problem.terms[k] for k in model)
    return list(dict.fromkeys(_Part(term.name, term.shown_as) for term in terms))


@dataclass(frozen=True)
class CredibleSet(JsonRecord):
    """The smallest set of names for one cause that holds 95 % of its probability.

    The JSON document is one entry of `sets`.

    Attributes
    ----------
    cause : str
        What the model has: a name, or a function without one by its covariates.
    names : tuple of str
        The most probable first; a function without a name by its covariates.
    probability : tuple of float
        Of each name.
    present : float
        Probability that there is any cause at all in this place.
    """

    cause: str = field(metadata=HIDDEN)
    names: tuple[str, ...]
    probability: tuple[float, ...]
    present: float


def credible_sets(selection: Selection, averaged: Averaged | None = None) -> tuple[CredibleSet, ...]:
    """A set for each cause of the chosen model, in the order of its terms."""
    causes = dict.fromkeys(map(_word, selection.terms))
    return tuple(set_of(selection, cause, averaged) for cause in causes)


def one_a_function(sets: Sequence[CredibleSet], likelier: Mapping[str, str]) -> tuple[CredibleSet, ...]:
    """The sets, but one for all causes that are likelier pieces of one function without a name.

    Parameters
    ----------
    likelier : mapping of str to str
        That function, by the cause in whose place it is likelier.
    """
    leads = [likelier.get(one.cause, one.cause) for one in sets]
    return tuple(one for k, one in enumerate(sets) if leads[k] not in leads[:k])


def set_of(selection: Selection, cause: str, averaged: Averaged | None = None) -> CredibleSet:
    """The set of one cause of the chosen model: a name, or a function without one by its covariates."""
    share, present = votes(selection, cause, averaged)
    names: list[str] = []
    for name in sorted(share, key=lambda name: -share[name]):
        names.append(name)
        if sum(share[name] for name in names) >= limits.set_level:
            break
    return CredibleSet(cause, tuple(names), tuple(share[name] for name in names), present)


def votes(
    selection: Selection, cause: str, averaged: Averaged | None = None
) -> tuple[dict[str, float], float]:
    """Share of each name in the place of a cause, and the probability that there is any cause.

    Parameters
    ----------
    averaged : Averaged, optional
        What stands beside the names of the chosen model.
    """
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
    total = sum(weight.values())
    if not total > 0:
        return {cause: 1.0}, 0.0
    if averaged is not None and _piece(selection, cause, averaged):
        piece = weight[cause] * averaged.weight
        weight[cause] -= piece
        weight[_word(averaged.smooth)] += piece
    return {word: w / total for word, w in weight.items()}, total / (total + none)


@dataclass(frozen=True)
class _Place:
    """The place of a cause in the chosen model, which has the words `ours`.

    `added` (rows,) is what the cause adds there, of unit length; zero where that model has no such cause.
    """

    problem: LinearProblem
    cause: str
    ours: frozenset[str]
    added: Floats

    @classmethod
    def of(cls, selection: Selection, cause: str) -> _Place:
        problem, best = selection.problem, selection.verdict.best
        rest = [k for k in best if _word(problem.terms[k]) != cause]
        added = span(problem, rest)[1] - span(problem, best)[1]
        ours = frozenset(_word(problem.terms[k]) for k in best)
        return cls(problem, cause, ours, added / max(float(np.linalg.norm(added)), 1e-300))

    def choice(self, model: Model) -> dict[str, float]:
        """What a model has in this place, with shares that sum to at most 1; empty where it has nothing.

        Where it lacks several causes its others stand in the place of each by as much as they add of it.
        """
        terms = [self.problem.terms[k] for k in model]
        mine = [term for term in terms if _word(term) == self.cause]
        if mine:
            unknown = [u for u in terms if u.name is None and any(t.name and related(t, u) for t in mine)]
            words = set(map(_word, unknown)) or {self.cause}
            return dict.fromkeys(words, 1 / len(words))
        fresh = [k for k in model if _word(self.problem.terms[k]) not in self.ours]
        kept = [k for k in model if k not in fresh]
        words = {_word(self.problem.terms[k]) for k in fresh}
        lost = self.ours - set(map(_word, terms))
        whole = self._explained(fresh, kept) if fresh and len(lost) > 1 else 1.0
        if len(words) <= 1:
            return dict.fromkeys(words, whole)
        part: dict[str, float] = defaultdict(float)
        for k in fresh:
            part[_word(self.problem.terms[k])] += self._explained([k], kept) + 1e-12
        return {word: whole * share / sum(part.values()) for word, share in part.items()}

    def _explained(self, fresh: Sequence[int], kept: Sequence[int]) -> float:
        """Share of what the cause adds that some terms can add beside those that stay."""
        basis, _ = span(self.problem, [*fresh, *kept])
        return float(((basis.T @ self.added) ** 2).sum())


def _piece(selection: Selection, cause: str, averaged: Averaged) -> bool:
    """True where a cause may be a piece of what is averaged; a model's own function votes by itself."""
    terms = [selection.problem.terms[k] for k in selection.verdict.best]
    return any(
        unknown is averaged.smooth and related(term, unknown)
        for unknown in unknown_of(selection, averaged)
        for term in terms
        if term.name == cause
    )


def _word(term: Term) -> str:
    return term.name or f"unnamed: {join_words(term.covariates)}"


def undecided(selection: Selection, count: int = 5) -> tuple[str, ...]:
    """Names that, added alone, take a significant part of an inadequate model's residual (F-test at 10 %).

    The noise is then the residual itself, since what was measured within the dwells does not explain it.
    Where one does, others count that are nearly as likely, all variants of a name together and each by its
    share of the prior. The most likely comes first. None of them is claimed.
    """
    from scipy import stats

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
        left = max(chi2 - float(gains[k]), 1e-12 * chi2)
        p = float(stats.f.sf(float(gains[k]) / width / (left / (dof - width)), width, dof - width))
        least_p = min(least_p, p)
        price = float(problem.cost[k] + problem.column_price[k])
        likely[term.name] += math.exp(-0.5 * dof * math.log(left / chi2) - price)
    if least_p >= limits.open_level:
        return ()
    most = max(likely.values())
    alike = [name for name, odds in likely.items() if odds * limits.open_alike > most]
    return tuple(sorted(alike, key=lambda name: -likely[name])[:count])
