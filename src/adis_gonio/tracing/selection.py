"""Selection of effects: choose a linearised model, refit the full model, linearise and choose again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import spent
from adis_gonio.base.jsonable import ComputedOnce
from adis_gonio.fitting.estimation.fit import Fit, adequacy
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import NamedTerm, NamelessTerm, Term
from adis_gonio.tracing.linear_problem import LinearProblem, amplitudes, linearise, span
from adis_gonio.tracing.model_search import ModelPosterior, Search, search, weigh
from adis_gonio.tracing.thresholds import limits


@dataclass(frozen=True)
class Selection(ComputedOnce):
    """A chosen model, with the search that found it and the test of its residual.

    Attributes
    ----------
    problem : LinearProblem
        Linear problem about the values of the last fit.
    found : Search
        All models that the search has scored.
    verdict : ModelPosterior
        Posterior of these models, and the chosen one.
    base, fit : Fit
        Base model and chosen model, fitted by nonlinear least squares.
    inflation : float
        Factor on the measured noise variance with which effects were chosen; 1 if the model is adequate.
    adequate : bool
        True if the residual is not larger than the measured noise.
    """

    problem: LinearProblem
    found: Search
    verdict: ModelPosterior
    base: Fit
    fit: Fit
    inflation: float
    adequate: bool

    @property
    def data(self) -> Readings:
        """Readings to which the chosen model was fitted."""
        return self.fit.data

    @property
    def price(self) -> float:
        """Price of the terms of the chosen model in nats (`model_search.price`)."""
        return float(sum(self.found.prices[k] for k in self.verdict.best))

    @property
    def terms(self) -> tuple[Term, ...]:
        """Terms that the chosen model adds to the base model."""
        return self.fit.terms

    def promising(self, terms: Sequence[Term]) -> list[Term]:
        """Return the promising terms among `terms`.

        They are the `limits.fold_active` terms that raised the score of any model most, the terms of the
        chosen model, and the best term of each effect on each combination of axes.
        """
        active = promising_labels(self.problem.terms, self.found.promise, limits.fold_active)
        active |= {term.label for term in self.terms}
        return [term for term in terms if term.label in active]

    def without_functions(self, refuted: Sequence[Term]) -> Selection:
        """Return a selection of the best model without unnamed functions of the refuted terms' covariates.

        `refuted` are unnamed functions that make the prediction of held-out dwells worse.
        """
        gone = {term.covariates for term in refuted}
        terms = self.problem.terms
        scores = {
            model: score
            for model, score in self.found.scores.items()
            if not any(terms[k].name is None and terms[k].covariates in gone for k in model)
        }
        found = replace(self.found, scores=scores)
        verdict = weigh(found)
        return replace(self, found=found, verdict=verdict).with_model(verdict.best)

    def with_model(self, chosen: Sequence[int]) -> Selection:
        """Return a copy of the selection with another model; `chosen` has the numbers of its terms.

        The model is fitted again.
        """
        model = tuple(chosen)
        return replace(
            self.with_fit(fit_model(self.problem, model, self.base)),
            verdict=replace(self.verdict, best=model),
        )

    def with_fit(self, fit: Fit) -> Selection:
        """Return a copy of the selection with another fit of the chosen model."""
        known = fit.data.noise_known
        adequate = adequacy(fit.chi2, fit.dof, fit.data.noise_dof) >= limits.adequate if known else True
        inflation = 1.0 if known and adequate else self.inflation
        return replace(self, fit=fit, adequate=adequate, inflation=inflation)


def promising_labels(
    terms: Sequence[Term], promise: Floats, count: int, *, by_sharing: bool = False
) -> set[str]:
    """Return the labels of the `count` terms of the largest promise, and of the best term of each effect.

    The best term is of each effect on each combination of axes and, if `by_sharing`, for each grouping of
    sessions; then every bias is kept. `promise` (M,) has a number for each of the `terms`.
    """
    ranked = [terms[k] for k in np.argsort(-promise)]
    labels = {term.label for term in ranked[:count]}
    seen: set[tuple[object, ...]] = set()
    for term in ranked:
        if isinstance(term, NamedTerm):
            kind = type(term.effect) if by_sharing else term.effect.name
            key = kind, term.effect.axes, term.label if by_sharing and term.constant else ""
            if key not in seen:
                seen.add(key)
                labels.add(term.label)
    return labels


def fit_model(problem: LinearProblem, chosen: Sequence[int], about: Fit) -> Fit:
    """Fit a model by nonlinear least squares from its amplitudes in the linear problem.

    `chosen` are its term numbers; `about` is a fit with the data and the starting base parameters.
    """
    terms = [problem.terms[k] for k in chosen]
    values = [term.start(a) for term, a in zip(terms, amplitudes(problem, chosen), strict=True)]
    return about.with_terms(terms, values).refit()


def select(
    data: Readings,
    terms: Sequence[Term],
    max_terms: int,
    explored: int = limits.explored,
    rounds: int = limits.rounds,
) -> Selection:
    """Choose a model for these readings, and fit it.

    Parameters
    ----------
    data : Readings
        Readings without `check` dwells.
    terms : sequence of Term
        All candidate terms.
    max_terms : int
        Largest number of terms of the model.
    explored : int
        Number of best models for which all neighbours are scored.
    rounds : int
        Largest number of rounds of choosing and refitting.
    """
    base = Fit.begin(data).refit()
    about = _start_with_slips(base, terms) if max_terms else base
    inflation = 1.0 if data.noise_known else max(base.chi2 / max(base.dof, 1), 1e-12)
    before: tuple[str, ...] | None = None
    for _ in range(rounds):
        biases = linearise(about, [term for term in terms if term.constant])
        bias = _large_bias(biases, base, about)
        if bias is not None:
            # A constant far larger than the rest of the residual must not become part of a function's form.
            terms = [t for t in terms if not (isinstance(t, NamelessTerm) and t.basis.with_constant)]
            if not about.terms and max_terms:
                # The square of a large bias, b²/2G, may be many times the noise. Candidates are therefore
                # judged about a fit with the bias; otherwise they would be chosen to explain the
                # linearisation error.
                about = fit_model(biases, [bias], about)
        problem = linearise(about, terms)
        found, inflation = _search_with_noise(data, problem, max_terms, explored, inflation)
        problem = found.problem
        verdict, fit = _refit_best(problem, weigh(found), about, base.chi2)
        labels = tuple(sorted(term.label for term in fit.terms))
        linear = problem.chi2 - 2 * inflation * found.explained(verdict.best)
        settled = abs(linear - fit.chi2) < 1.0 * inflation or labels == before
        about, before = fit, labels
        if (
            data.noise_known
            and inflation > 1
            and adequacy(fit.chi2, fit.dof, data.noise_dof) >= limits.adequate
        ):
            # The additional noise was an error of the linear problem, not of the model.
            inflation, settled = 1.0, False
        if settled or spent():
            break
    p = adequacy(fit.chi2, fit.dof, data.noise_dof) if data.noise_known else 1.0
    if p < limits.adequate:
        inflation = max(inflation, fit.chi2 / fit.dof)  # state uncertainties by the final residual
    return Selection(problem, found, verdict, base, fit, inflation, p >= limits.adequate)


def _start_with_slips(base: Fit, terms: Sequence[Term]) -> Fit:
    """Return a fit of the base model with approximate slips of the part and a bias, to linearise about it.

    `base` is returned unchanged if no candidate in `terms` is a slip of known size. A slip that is too
    large for the linearised model would look like an outlier on both axes. If the model is linearised about
    the approximate slip and bias instead, the linearisation is accurate.
    """
    orders = base.data.conditions.order
    here = set() if orders is None else set(np.round(orders).tolist())
    named = [term for term in terms if isinstance(term, NamedTerm)]
    slips = [term for term in named if term.begins and term.dwell in here]
    if not slips:
        return base
    biases = [term for term in named if term.constant and term.prior_sd is None]
    widest = max(biases, key=lambda term: len(term.effect.axes), default=None)
    model = slips if widest is None else [*slips, widest]
    return base.with_terms(
        model, [term.start(np.full(len(term.amplitudes), term.begins)) for term in model]
    ).refit()


def _refit_best(
    problem: LinearProblem, verdict: ModelPosterior, about: Fit, most: float
) -> tuple[ModelPosterior, Fit]:
    """Refit the best model; if its χ² exceeds `most`, the base model's χ², try the next best models.

    A model that contains the base model cannot have a larger χ². Such a refit has diverged: it
    started at amplitudes that only the linearised model allows.
    """
    ranked = sorted(verdict.weights, key=lambda m: -verdict.weights[m])
    for chosen in dict.fromkeys([verdict.best, *ranked[:4]]):
        fit = fit_model(problem, chosen, about)
        if fit.chi2 <= most * (1 + 1e-6):
            return replace(verdict, best=chosen), fit
    return verdict, fit_model(problem, verdict.best, about)


def _search_with_noise(
    data: Readings, problem: LinearProblem, max_terms: int, explored: int, inflation: float
) -> tuple[Search, float]:
    """Return a search and its noise factor; if no model is adequate, search again with a larger noise.

    The unexplained part is then treated as noise of unknown origin (Birge's ratio), so that a name must be
    significant against it. `inflation` is the first noise factor. `max_terms` and `explored` are as in
    `search`.
    """
    found = search(problem, max_terms, inflation, explored)
    for _ in range(4):
        best = found.best
        basis, residual = span(found.problem, best)
        chi2, dof = float(residual @ residual), problem.dof - basis.shape[1]
        ratio = chi2 / max(dof, 1)
        if data.noise_known:
            if dof <= 0 or adequacy(chi2 / inflation, dof, data.noise_dof) >= limits.adequate:
                return found, inflation
        elif abs(ratio / inflation - 1) < 0.05:
            return found, inflation
        inflation = max(ratio, 1.0) if data.noise_known else max(ratio, 1e-12)
        again = search(problem, max_terms, inflation, explored)
        if again.best == best:
            return again, inflation
        found = again
    return found, inflation


def _large_bias(problem: LinearProblem, base: Fit, about: Fit) -> int | None:
    """Return the term number of the bias if it alone explains nearly all of the excess χ², else None.

    Nearly all is the share `limits.mostly_bias`. The excess is the χ² of the base model beyond its degrees
    of freedom. `base` is the fit of the base model; `about` is the fit at which `problem` is linearised.
    """
    widest = problem.widest_bias
    if widest is None:
        return None

    def mostly(excess: float, left: float) -> bool:
        return excess > 0 and left < (1 - limits.mostly_bias) * excess

    left = float((problem.off([widest], problem.target) ** 2).sum())
    if mostly(problem.chi2 - problem.dof, left - problem.dof):
        return widest
    if about.terms or problem.dof <= int(problem.width[widest]):
        return None
    # A bias that is too large for the linear problem shows in a refit only.
    trial = fit_model(problem, [widest], base)
    return widest if mostly(base.chi2 - base.dof, trial.chi2 - trial.dof) else None
