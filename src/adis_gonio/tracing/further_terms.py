"""Gain by each further term of a model: evidence and held-out error against the number of terms.

The search has scored models of every number of terms. The best one of each number is fitted again and
predicts the held-out dwells with its terms kept. All models are compared on the same dwells.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.numbers import counted, format_number, with_unit
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.tracing.linear_problem import amplitudes
from adis_gonio.tracing.model_search import Model
from adis_gonio.tracing.selection import Selection
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.validation import (
    Fold,
    held_out_alike,
    leave_each_out,
    leaves_too_few,
    residuals_on,
)

MOST_FURTHER = 1
"""Number of terms beyond the chosen model: the search has scored all its extensions by one term."""
_TRIED = 50
"""Number of the best models among which one is sought that predicts other readings."""


@dataclass(frozen=True)
class Scored:
    """The best model of one number of terms, by the search.

    Attributes
    ----------
    fit : Fit
        Fit of the model if the trace has made one; otherwise the model with its amplitudes in the linear
        problem.
    log_evidence : float
        Log evidence relative to the base model, in nats.
    chosen : bool
        True for the model that the search chose.
    """

    fit: Fit
    log_evidence: float
    chosen: bool


@dataclass(frozen=True)
class Bought:
    """The best model of one number of terms, with its held-out error.

    Attributes
    ----------
    terms : tuple of str
        Terms in addition to the base model.
    log_evidence : float
        Log evidence relative to the base model, in nats.
    heldout_rms : float
        Held-out error in the unit of the readings.
    gain, u : float
        Decrease of the held-out error by the last term, and its standard uncertainty over the dwells.
    efficient, chosen : bool
        True if no model of fewer terms has more evidence and a smaller held-out error; True for the model
        that the search chose.
    """

    terms: tuple[str, ...]
    log_evidence: float
    heldout_rms: float
    gain: float
    u: float
    efficient: bool
    chosen: bool


def best_by_terms(selection: Selection, nested: Sequence[Fit]) -> tuple[Scored, ...]:
    """Return the best scored model of each number of terms; the chosen model is the best of its number.

    A model with more terms than the chosen one counts only if it predicts other readings. For example, two
    terms for one axis each predict nothing new if the chosen model has one term for both axes. `nested` are
    the fits of the trace.
    """
    found, chosen, problem = selection.found, tuple(sorted(selection.verdict.best)), selection.found.problem
    by_size: dict[int, list[Model]] = defaultdict(list)
    for model in found.scores:
        if len(model) <= len(chosen) + MOST_FURTHER:
            by_size[len(model)].append(model)
    by_size[len(chosen)] = [chosen]
    made = {frozenset(term.label for term in fit.terms): fit for fit in nested}
    out: list[Scored] = []
    explained = -np.inf
    for size in sorted(by_size):
        for model in heapq.nlargest(_TRIED, by_size[size], key=lambda m: found.scores.get(m, 0.0)):
            half = 0.5 * problem.gain(model) / found.inflation
            if size <= len(chosen) or half > explained + 0.5 * limits.same_prediction:
                explained = half
                terms = [problem.terms[k] for k in model]
                values = zip(terms, amplitudes(problem, model), strict=True)
                begun = selection.base.with_terms(terms, [term.start(own) for term, own in values])
                fit = made.get(frozenset(term.label for term in terms), begun)
                evidence = half - float(found.prices[list(model)].sum())
                out.append(Scored(fit, evidence, model == chosen))
                break
    return tuple(out)


def bought_by_terms(
    models: Sequence[Scored], fold: Fold, checking: Readings | None = None
) -> tuple[Bought, ...]:
    """Return the held-out errors of the best models of each number of terms; empty if no dwell is held out.

    `fold` has the residuals that the trace has computed in its folds. `checking` are the check dwells,
    which are then the held-out dwells. A dwell counts if the chosen model is determined without it.
    """
    fits = [one.fit if one.fit in fold else one.fit.refit() for one in models]
    data = fits[0].data
    # The terms of a fit are kept, and their values are fitted again without the held-out dwells.
    if checking is not None:
        left_out = [[residuals_on(fit, checking)] for fit in fits]
    elif leaves_too_few(fits[-1]):
        left_out = leave_each_out(fits)[0]
    else:
        chosen = [one.chosen for one in models].index(True)
        left_out = held_out_alike([(fold, data, fit) for fit in fits], fits[chosen].terms, [chosen])[0]
    squares = [
        np.concatenate([(part.residual**2).sum(axis=1) for part in parts]) if parts else np.zeros(0)
        for parts in left_out
    ]
    if not squares[0].size:
        return ()
    each = data.axes if data.by_axis else 1
    errors = [float(np.sqrt(own.mean() / each)) for own in squares]
    out: list[Bought] = []
    for k, model in enumerate(models):
        before = max(k - 1, 0)
        # Change of the root mean square by each dwell: a paired difference of two models, to first order.
        per_dwell = (squares[before] / errors[before] - squares[k] / errors[k]) / (2 * each)
        fewer = [one for one in out if one.log_evidence >= model.log_evidence]
        out.append(
            Bought(
                tuple(term.label for term in fits[k].terms),
                model.log_evidence,
                errors[k],
                errors[before] - errors[k],
                float(per_dwell.std(ddof=1) / np.sqrt(len(per_dwell))) if len(per_dwell) > 1 else np.inf,
                not any(one.heldout_rms <= errors[k] for one in fewer),
                model.chosen,
            )
        )
    return tuple(out)


def next_term(bought: Sequence[Bought], unit: str) -> str:
    """Return a sentence on the benefit of one more term than the chosen model has.

    `bought` has the best model of each number of terms, and `unit` is the unit of their held-out errors.
    """
    here = next(k for k, one in enumerate(bought) if one.chosen)
    terms = counted(len(bought[here].terms), "term")
    if here + 1 == len(bought):
        return f"{terms}: the search scored no further one that changes the prediction."
    after = bought[here + 1]
    nats = after.log_evidence - bought[here].log_evidence
    gain = with_unit(format_number(after.gain, 2), unit)
    sized = "less" if after.gain < after.u else "more"
    buys = f"buys {gain} of the left-out error, {sized} than its uncertainty of {format_number(after.u, 2)}"
    if after.gain <= 0:
        buys = "does not lower the left-out error"
    changes = f"{'lowers' if nats < 0 else 'raises'} the log evidence by {format_number(abs(nats), 2)}"
    return f"{terms}: one more {buys} and {changes}."
