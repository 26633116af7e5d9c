"""Credible sets: for each cause of a model the names that could stand in its place.

Every scored model near the best votes with its posterior for what it has in the place of a cause: for the
cause itself; or, where it lacks that cause, for what it has beyond the chosen model, as far as that can add
what the cause adds; or for none. So a surface that does the work of two names counts against both. Variants
of a name (axes, shapes, dwells) add up. The set is the smallest with 95 % of the votes, as SuSiE has it for
correlated variables (Wang, Sarkar, Carbonetto and Stephens, J. R. Stat. Soc. B 82, 2020); functions without
a name compete on equal terms.

A name beside a function without one of the same kind may be a piece of that unknown cause, and votes for
it; where that function is an average over processes, by their probability.
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
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.tracing.outcome.naming import related, unknown_of
from adis_gonio.tracing.selection.design import LinearProblem, span
from adis_gonio.tracing.selection.search import Model
from adis_gonio.tracing.selection.select import Selection
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.unnamed.averaging import Averaged


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
