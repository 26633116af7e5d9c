"""What-if: a trace with terms that the user puts into every model, and without names that he excludes.

A request changes the list of candidates, so that search and folds need no rules of their own: a forced
candidate (`NamedTerm.forced`) is in every model, an excluded name is not in the list, and a closed set has
forced candidates only. The result compares the base model, the best model of a free trace and the asked
model. The log evidence of a model is its restricted likelihood after a refit, minus the prices of its
terms, which contain the prior probability of the model. All models are judged by the noise of the best
model, except for scatter that the asked model itself needs.

The gain by each further term is stated too, as evidence and held-out error against the number of terms. The
search has scored models of every number of terms. The best one of each number is fitted again and predicts
the held-out dwells with its terms kept. All models are compared on the same dwells.
"""

from __future__ import annotations

import heapq
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.budget import current
from adis_gonio.base.errors import UsageError
from adis_gonio.base.jsonable import HIDDEN, INLINE, JsonRecord, key
from adis_gonio.base.uncertainty import Detectable, Value
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.model.effects import AXES, catalogue, effect
from adis_gonio.model.effects.formula import formula_effect
from adis_gonio.tracing import validation
from adis_gonio.tracing.findings import differs_from_zero, finding_of
from adis_gonio.tracing.linear_problem import amplitudes, linearise, span
from adis_gonio.tracing.model_search import Model, price
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.scatter import log_evidence, price_of_scatter
from adis_gonio.tracing.selection import Selection
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.trace_result import ErrorFigures

if TYPE_CHECKING:
    from adis_gonio.tracing.trace import TraceRun

_ALIKE = 1e-9
"""Range of a column, as a share of its largest value, below which it is a constant."""


class AskedTerm(JsonRecord):
    """A term that the user put into the model, with its fitted values; one entry of `forced` in the JSON.

    Attributes
    ----------
    effect, axes
        Name of the effect or formula, and the letters of its axes.
    parameters : mapping of str to Value
        Fitted parameters by name.
    differs_from_zero : bool
        True if one of the parameters differs from zero by two standard uncertainties.
    """

    effect: str
    axes: tuple[str, ...]
    parameters: dict[str, Value]
    differs_from_zero: bool


class ComparedModel(JsonRecord):
    """One of the compared models.

    Attributes
    ----------
    terms : tuple of str
        Terms in addition to the base model.
    error : ErrorFigures
        Errors of the model.
    log_evidence : float
        Log evidence relative to the base model, in nats. It contains the model's prior.
    prior : float
        Prior probability of the model relative to the base model: the product of its terms' shares.
    """

    terms: tuple[str, ...]
    error: ErrorFigures = field(metadata=INLINE)
    log_evidence: float
    prior: float


class AskedModel(JsonRecord):
    """A user's request for a trace: terms that every model has, and names that no model has.

    Attributes
    ----------
    include : tuple of str
        An effect with axes and choices (`quadratic:x`, `bias_temperature:xyz,degree=2`; without axes all
        axes), or a formula (`mine_x = (T - 25)**2 * gx`).
    exclude : tuple of str
        Names of effects.
    only : bool
        True if the model has the included terms and no other.
    """

    include: tuple[str, ...] = field(default=(), metadata=key("with"))
    exclude: tuple[str, ...] = field(default=(), metadata=key("without"))
    only: bool = False

    def __bool__(self) -> bool:
        return bool(self.include or self.exclude or self.only)

    @classmethod
    def of(cls, include: str | Sequence[str], exclude: str | Sequence[str], only: bool) -> AskedModel:
        """Make a request; raise `UsageError` if an excluded name is unknown or in every model.

        The arguments are the attributes of the class; a single term or name may be given as one text.
        """
        terms, names = ((one,) if isinstance(one, str) else tuple(one) for one in (include, exclude))
        if only and names:
            raise UsageError("--only leaves out everything that --with does not name: omit --without")
        for name in names:
            kind = type(effect(name))
            if kind.in_base and kind.prior != "constant":
                raise UsageError(f"--without {name}: it is a base parameter of every model")
            if kind.within_dwell:
                raise UsageError(f"--without {name}: it is looked for within the dwells, not in the model")
        return cls(terms, names, only)

    def candidates(self, data: Readings, terms: Sequence[Term], max_effects: int) -> tuple[list[Term], int]:
        """Apply the request to `terms`; return the resulting candidates and the largest number of terms.

        `max_effects` is the largest number of terms besides the included ones.

        Raises
        ------
        UsageError
            A term is unknown, needs a covariate that the session lacks, or cannot be distinguished from the
            base model or another included term.
        """
        forced = forced_terms(data, self.include)
        both = [term.name for term in forced if term.name in self.exclude]
        if both:
            raise UsageError(f"--with and --without name the same effect: {both[0]}")
        labels = {term.label for term in forced}
        free = [] if self.only else terms
        kept = [term for term in free if term.name not in self.exclude and term.label not in labels]
        return [*forced, *kept], len(forced) + (0 if self.only else max_effects)


class WhatIf(JsonRecord):
    """Comparison of the model that a user asked for with the base model and the best model.

    The JSON document is the value of `what_if`.

    Attributes
    ----------
    request : AskedModel
        Terms that are in every model, and excluded names, as the user wrote them.
    odds : float
        Ratio of the probabilities of the asked model and the best model; `log_odds` is its logarithm.
    prior_odds : float
        Ratio of the priors of these models, which `odds` contains.
    before, best, asked : ComparedModel
        The base model, the best model of a trace without the request, and the asked model.
    forced : tuple of AskedTerm
        The included terms with their values.
    fits : tuple of 2 Fit
        Fits of the best and of the asked model.
    """

    request: AskedModel = field(metadata=INLINE)
    odds: float
    log_odds: float
    prior_odds: float
    before: ComparedModel
    best: ComparedModel
    asked: ComparedModel
    forced: tuple[AskedTerm, ...]
    fits: tuple[Fit, Fit] = field(metadata=HIDDEN, repr=False, compare=False)


FREE = AskedModel()
"""The request of a trace that the user does not restrict."""


def forced_terms(data: Readings, texts: Sequence[str]) -> list[NamedTerm]:
    """Return the terms that texts such as `quadratic:x` name, each marked as forced.

    If a text leaves the form open (degree, dwell, time constant), the most probable form is chosen, given
    the terms before it and a bias.
    """
    named, missing = named_terms(data)
    biases = sorted((term for term in named if term.constant), key=lambda term: len(term.effect.axes))
    about = Fit.begin(data).refit()
    chosen: list[NamedTerm] = []
    for text in texts:
        formula = "=" in text.partition(":")[0]
        variants = [_formula(data, about, text)] if formula else _variants(data, text, named, missing)
        # Choose the variant with the highest evidence in addition to the terms before and a bias.
        problem = linearise(about, [*chosen, *variants, *biases[-1:]])
        number = {term.label: k for k, term in enumerate(problem.terms)}
        before = [number[term.label] for term in chosen]
        basis = span(problem, before)[0]
        apart = []
        for k in (number[term.label] for term in variants if term.label in number):
            outside = problem.block(k) - basis @ (basis.T @ problem.block(k))
            full = problem.width[k] == len(problem.back_of(k))
            if full and np.linalg.svd(outside, compute_uv=False)[-1] ** 2 > limits.independent:
                apart.append(k)
        if not apart:
            base = f"the base model ({', '.join(one.name for one in data.model.parameters)})"
            others = " or ".join([base, *(term.label for term in chosen)])
            raise UsageError(f"--with {text}: this session cannot distinguish it from {others}")
        members = [*before, *(number[bias.label] for bias in biases[-1:] if bias.label in number)]
        gained = 0.5 * problem.gains(*span(problem, members)) - price(problem)
        label = problem.terms[max(apart, key=lambda k: float(gained[k]))].label
        chosen.append(replace(next(term for term in variants if term.label == label), forced=True))
    return chosen


def _formula(data: Readings, about: Fit, text: str) -> NamedTerm:
    """Return the term of the formula `text`; `UsageError` if the session cannot give its column."""
    made = formula_effect(text, data.model.unit)
    if made.name in catalogue():
        raise UsageError(f"formula '{text}': {made.name} is an effect of the catalogue; take another name")
    reason = ""
    try:
        columns = made.derivative(np.zeros(len(made.axes)), about.ideal, data.conditions)
        column = columns[:, AXES.index(made.axes[0]), 0]
        wrong = np.flatnonzero(~np.isfinite(column))
        if wrong.size:
            reason = f"it has no finite value at position {data.position[wrong[0]]}"
        elif np.ptp(column) <= _ALIKE * np.abs(column).max():
            where = "zero" if not column.any() else f"constant, as is bias:{''.join(made.axes)},"
            reason = f"it is {where} at every position"
    except UsageError as error:
        reason = str(error)
    if reason:
        raise UsageError(f"formula '{text}': {reason}")
    label = f"{made.name}[{''.join(made.axes)}]"
    return NamedTerm(label, made.covariates, -math.log(limits.effect_share), made)


def _variants(
    data: Readings, text: str, named: Sequence[NamedTerm], missing: dict[str, Detectable]
) -> list[NamedTerm]:
    """Return the candidates of the catalogue that a text such as `bias_temperature:xy,degree=2` allows.

    `named` are all named candidates; `missing` has the reason of each effect without a candidate.
    """
    name, _, listed = (part.strip() for part in text.partition(":"))
    kind = type(effect(name))
    if name in missing:
        raise UsageError(f"--with {text}: {missing[name].reason.replace('_', ' ')}")
    mine = [term for term in named if term.name == name]
    axes, choices = "", {}
    for item in filter(None, (item.strip() for item in listed.split(","))):
        word, equals, value = (part.strip() for part in item.partition("="))
        if equals:
            choices[word] = value
        else:
            axes = item
    widest = max((len(term.effect.axes) for term in mine), default=0)
    found = [
        term
        for term in mine
        if (set(term.effect.axes) == set(axes) if axes else len(term.effect.axes) == widest)
        and all(
            word in kind.choices() and str(getattr(term.effect, word)) == choices[word] for word in choices
        )
    ]
    if not found:
        possible = dict.fromkeys("".join(term.effect.axes) for term in mine if term.effect.axes)
        chosen = {f"{word}={getattr(term.effect, word)}": None for word in kind.choices() for term in mine}
        listed = ", ".join([*possible, *list(chosen)[:12]]) or "none"
        raise UsageError(f"--with {text}: this session has no such candidate of {name}; it has {listed}")
    return found


def compare(free: TraceRun, asked: TraceRun, request: AskedModel) -> WhatIf:
    """Compare the asked model with the base model and the best model of the free trace."""
    best = free.selection
    price_here = 0.0 if free.scatter is None else price_of_scatter(best.data)

    def evidence(run: TraceRun, fit: Fit, prices: float) -> float:
        if run.scatter is not None and run is not free:
            return log_evidence(fit, prices + price_of_scatter(fit.data), run.selection.inflation)
        here = fit if fit.data is best.data else replace(fit, data=best.data).refit()
        return log_evidence(here, prices + price_here, best.inflation)

    base = evidence(free, best.base, 0.0)
    errors = _errors(free, asked)
    models = [ComparedModel((), errors[0], 0.0, 1.0)]
    for run, error in zip((free, asked), errors[1:], strict=True):
        selection = run.selection
        model = list(selection.verdict.best)
        prior = math.exp(-float(selection.problem.cost[model].sum()))
        labels = tuple(term.label for term in selection.terms)
        height = evidence(run, selection.fit, selection.price) - base
        models.append(ComparedModel(labels, error, height, prior))
    log_odds = models[2].log_evidence - models[1].log_evidence
    found = [finding_of(asked.final, name, asked.averaged) for name in dict.fromkeys(asked.forced)]
    return WhatIf(
        request=request,
        odds=math.exp(min(log_odds, 700.0)),
        log_odds=log_odds,
        prior_odds=models[2].prior / models[1].prior,
        before=models[0],
        best=models[1],
        asked=models[2],
        forced=tuple(AskedTerm(f.effect, f.axes, f.parameters, differs_from_zero(f)) for f in found),
        fits=(free.final.fit, asked.final.fit),
    )


def _errors(free: TraceRun, asked: TraceRun) -> list[ErrorFigures]:
    """Return the errors of the base model, the best and the asked model, on the same held-out dwells.

    Terms that were searched are chosen again in each fold. If the model was shortened, its terms are kept.
    """
    figures = [free.figures[0], free.figures[-1], asked.figures[-1]]
    few = any(validation.leaves_too_few(run.selection.fit) for run in (free, asked))
    if free.checking is not None or few or current().left_out:
        return figures
    data = free.selection.data
    searched = [(run, run.fits[-1] if run.shortened else None) for run in (free, asked)]
    models = [(run.fold, run.selection.data, fit) for run, fit in ((free, free.fits[0]), *searched)]
    lefts, _ = validation.held_out_alike(models, free.selection.terms, (1, 2))
    return [
        replace(figure, heldout_kept=None, **validation.heldout_errors(data, left))
        for figure, left in zip(figures, lefts, strict=True)
    ]


MOST_FURTHER = 1
"""Number of terms beyond the chosen model: the search has scored all its extensions by one term."""
_TRIED = 50
"""Number of the best models among which one is sought that predicts other readings."""


@dataclass(frozen=True)
class BestOfSize:
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


def best_by_size(selection: Selection, nested: Sequence[Fit]) -> list[tuple[Fit, float]]:
    """Return the best scored model of each number of terms, with its log evidence in nats.

    The evidence is relative to the base model. The chosen model counts as the best of its number of terms.
    A model that the trace has not fitted takes its amplitudes from the linear problem.

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
    out: list[tuple[Fit, float]] = []
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
                out.append((fit, evidence))
                break
    return out


def heldout_by_size(
    selection: Selection, nested: Sequence[Fit], fold: validation.Fold, checking: Readings | None = None
) -> list[BestOfSize]:
    """Return the held-out errors of the best models of each number of terms; empty if no dwell is held out.

    `nested` are the fits of the trace; `fold` has the residuals that it has computed in its folds.
    `checking` are the check dwells, which are then the held-out dwells. A dwell counts if the chosen model
    is determined without it.
    """
    models = best_by_size(selection, nested)
    fits = [fit if fit in fold else fit.refit() for fit, _ in models]
    is_chosen = [len(fit.terms) == len(selection.terms) for fit in fits]
    data = fits[0].data
    # The terms of a fit are kept, and their values are fitted again without the held-out dwells.
    if checking is not None:
        left_out = [[validation.residuals_on(fit, checking)] for fit in fits]
    elif validation.leaves_too_few(fits[-1]):
        left_out = validation.leave_each_out(fits)[0]
    else:
        chosen = is_chosen.index(True)
        left_out = validation.held_out_alike(
            [(fold, data, fit) for fit in fits], fits[chosen].terms, [chosen]
        )[0]
    squares = [
        np.concatenate([(part.residual**2).sum(axis=1) for part in parts]) if parts else np.zeros(0)
        for parts in left_out
    ]
    if not squares[0].size:
        return []
    each = data.axes if data.by_axis else 1
    errors = [float(np.sqrt(own.mean() / each)) for own in squares]
    out: list[BestOfSize] = []
    for k, (_, evidence) in enumerate(models):
        before = max(k - 1, 0)
        # Change of the root mean square by each dwell: a paired difference of two models, to first order.
        per_dwell = (squares[before] / errors[before] - squares[k] / errors[k]) / (2 * each)
        u = float(per_dwell.std(ddof=1) / np.sqrt(len(per_dwell))) if len(per_dwell) > 1 else np.inf
        gain, terms = errors[before] - errors[k], tuple(term.label for term in fits[k].terms)
        efficient = not any(o.log_evidence >= evidence and o.heldout_rms <= errors[k] for o in out)
        out.append(BestOfSize(terms, evidence, errors[k], gain, u, efficient, is_chosen[k]))
    return out
