"""Credible sets: for each cause of a model the names that could stand in its place.

Every scored model near the best votes with its posterior for what it has in the place of a cause: for the
cause itself, or for what it has beyond the chosen model where it lacks that cause, or for none. So a
surface that does the work of two names counts against both. Variants of a name (axes, shapes, dwells) add
up. The set is the smallest with 95 % of the votes, as SuSiE has it for correlated variables (Wang, Sarkar,
Carbonetto and Stephens, J. R. Stat. Soc. B 82, 2020); functions without a name compete on equal terms.

A name beside a function without one of the same kind may be a piece of that unknown cause, and votes for
it.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from adis_gonio.estimation.terms import Term
from adis_gonio.tracing.outcome.naming import related
from adis_gonio.tracing.selection.select import Selection
from adis_gonio.tracing.thresholds import limits


@dataclass(frozen=True)
class CredibleSet:
    """The smallest set of names for one cause that holds 95 % of its probability.

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

    cause: str
    names: tuple[str, ...]
    probability: tuple[float, ...]
    present: float

    def as_dict(self) -> dict[str, Any]:
        """One entry of `sets`."""
        return {
            "names": list(self.names),
            "probability": list(self.probability),
            "present": self.present,
        }


def credible_sets(selection: Selection) -> tuple[CredibleSet, ...]:
    """A set for each cause of the chosen model, in the order of its terms."""
    return tuple(set_of(selection, cause) for cause in dict.fromkeys(map(_word, selection.terms)))


def set_of(selection: Selection, cause: str) -> CredibleSet:
    """The set of one cause of the chosen model: a name, or a function without one by its covariates."""
    problem = selection.problem
    near = selection.found.near(limits.voting)
    top = max(near.values())
    ours = {_word(problem.terms[k]) for k in selection.verdict.best}
    weight: dict[str, float] = defaultdict(float)
    none = 0.0
    for model, score in near.items():
        vote = math.exp(score - top)
        choice = _choice([problem.terms[k] for k in model], cause, ours)
        for word in choice:
            weight[word] += vote / len(choice)
        none += 0.0 if choice else vote
    if not weight:
        return CredibleSet(cause, (cause,), (1.0,), 0.0)
    total = sum(weight.values())
    names, probability = _smallest({word: w / total for word, w in weight.items()}, limits.set_level)
    return CredibleSet(cause, names, probability, total / (total + none))


def _choice(model: Sequence[Term], cause: str, ours: Iterable[str]) -> list[str]:
    """What a model has in the place of a cause of the chosen one, which has `ours`."""
    mine = [term for term in model if _word(term) == cause]
    if not mine:
        return list(dict.fromkeys(word for word in map(_word, model) if word not in ours))
    unknown = [u for u in model if u.name is None and any(t.name and related(t, u) for t in mine)]
    return list(dict.fromkeys(map(_word, unknown))) or [cause]


def _smallest(share: dict[str, float], level: float) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Names, the most probable first, until they have `level` together."""
    names: list[str] = []
    probability: list[float] = []
    for name in sorted(share, key=lambda name: -share[name]):
        names.append(name)
        probability.append(share[name])
        if sum(probability) >= level:
            break
    return tuple(names), tuple(probability)


def _word(term: Term) -> str:
    return term.name or f"unnamed: {' and '.join(term.covariates)}"
