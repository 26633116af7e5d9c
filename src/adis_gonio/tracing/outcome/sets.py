"""Credible sets: for each cause of a model the names that could stand in its place.

A cause is taken out of the model and every candidate put in alone; exp(score) weighs them (the score is the
log Bayes factor with its price, `selection.search`). Variants of a name (axes, shapes, dwells) add up. The
set is the smallest with 95 % of the probability, as SuSiE has it for correlated variables (Wang, Sarkar,
Carbonetto and Stephens, J. R. Stat. Soc. B 82, 2020); functions without a name compete on equal terms.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from adis_gonio.estimation.terms import Term
from adis_gonio.tracing.selection.design import span
from adis_gonio.tracing.selection.select import Selection, beyond_bounds
from adis_gonio.tracing.thresholds import limits


@dataclass(frozen=True)
class CredibleSet:
    """The smallest set of names for one cause that holds 95 % of its probability.

    Attributes
    ----------
    cause : str
        What the model has: a name, or a function without one.
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
    return tuple(set_of(selection, cause) for cause in dict.fromkeys(t.shown_as for t in selection.terms))


def set_of(selection: Selection, cause: str) -> CredibleSet:
    """The set of one cause of the chosen model, by its name or formula."""
    found, problem = selection.found, selection.problem
    members = [k for k in selection.verdict.best if problem.terms[k].shown_as == cause]
    rest = [k for k in selection.verdict.best if k not in members]
    basis, residual = span(problem, rest)
    score = 0.5 * problem.gains(basis, residual) / selection.inflation - found.prices
    score[rest] = -np.inf
    beside = {problem.terms[k].name for k in rest} - {None}
    weight: dict[str, float] = defaultdict(float)
    top = float(score.max())
    if len(members) > 1:
        left = float((span(problem, selection.verdict.best)[1] ** 2).sum())
        own = 0.5 * (float(residual @ residual) - left) / selection.inflation
        own -= float(sum(found.prices[k] for k in members))
        top = max(top, own)
        weight[cause] += float(np.exp(own - top))
    for k in np.flatnonzero(score > top - 12.0).tolist():
        possible = k in members or beyond_bounds(selection.data, problem, [*rest, k]) is None
        if problem.terms[k].name not in beside and possible:
            weight[_word(problem.terms[k])] += float(np.exp(score[k] - top))
    total = sum(weight.values())
    ranked = sorted(weight, key=lambda name: -weight[name])
    names, probability, together = [], [], 0.0
    for name in ranked:
        names.append(name)
        probability.append(weight[name] / total)
        together += probability[-1]
        if together >= limits.set_level:
            break
    # Against nothing, which has the score 0.
    odds = total * float(np.exp(min(top, 700.0)))
    return CredibleSet(cause, tuple(names), tuple(probability), odds / (1 + odds))


def _word(term: Term) -> str:
    return term.name or f"unnamed: {' and '.join(term.covariates)}"
