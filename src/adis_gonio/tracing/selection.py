"""The loop: choose effects in the linear problem, refit in full, choose again about the new state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adis_gonio.tracing.design import Problem, amplitudes, linearise, span
from adis_gonio.tracing.observations import Observations
from adis_gonio.tracing.search import Search, search
from adis_gonio.tracing.state import Refit, State, begin, refit
from adis_gonio.tracing.terms import NamedTerm, NamelessTerm, Term
from adis_gonio.tracing.verdict import Verdict, weigh

ADEQUATE = 0.01
"""Level of the test of adequacy."""
ROUNDS = 4
MOSTLY = 0.97
"""Share of the excess from which constants count as a bias of their own, not as part of another function:
the constant is then more than five times what varies."""


@dataclass(frozen=True)
class Selection:
    """What was chosen and how well it does.

    Attributes
    ----------
    problem : Problem
        About the final state.
    found : Search
    verdict : Verdict
    model : tuple of Term
        Terms of the chosen model.
    base, fit : Refit
        Base model and chosen model, refitted in full.
    inflation : float
        Factor on the noise variance under which effects were chosen: 1 where the model is adequate.
    adequate : bool
    """

    problem: Problem
    found: Search
    verdict: Verdict
    model: tuple[Term, ...]
    base: Refit
    fit: Refit
    inflation: float
    adequate: bool


def adequacy(chi2: float, dof: float, noise_dof: float) -> float:
    """p-value of a residual against the noise that was measured within the dwells."""
    from scipy import stats

    if dof <= 0:
        return 1.0
    if np.isinf(noise_dof):
        return float(stats.chi2.sf(chi2, dof))
    return float(stats.f.sf(chi2 / dof, dof, max(noise_dof, 1.0)))


def fit_model(data: Observations, problem: Problem, chosen: Sequence[int], state: State) -> Refit:
    """Full refit of a model of the linear problem, from the amplitudes that it has there."""
    model = [problem.terms[k] for k in chosen]
    values = tuple(term.start(a) for term, a in zip(model, amplitudes(problem, chosen), strict=True))
    return refit(data, model, State(state.base, state.delta_rad, state.unit, values))


def select(
    data: Observations,
    terms: Sequence[Term],
    max_terms: int,
    beam: int = 30,
    rounds: int = ROUNDS,
) -> Selection:
    """Choose terms for these readings (all of them: `check` dwells are the caller's business)."""
    base = refit(data, (), begin(data))
    fit, state = base, base.state
    model: tuple[Term, ...] = ()
    inflation = 1.0 if data.known else max(base.chi2 / max(base.dof, 1), 1e-12)
    before: tuple[str, ...] | None = None
    for _ in range(rounds):
        problem = linearise(data, model, state, terms)
        constants = _mostly_bias(problem)
        if constants is not None:
            # A constant that is far larger than what is left beside it is no part of a function's form.
            terms = [term for term in terms if not (isinstance(term, NamelessTerm) and term.with_constant)]
            if not model and max_terms:
                # Its square, b²/2G, may be many times the noise: candidates are judged about the state
                # that has it, or they would be chosen for what the linear problem leaves of it.
                state = fit_model(data, problem, [constants], state).state
                model = (problem.terms[constants],)
            problem = linearise(data, model, state, terms)
        while True:
            found = search(problem, max_terms, inflation, beam)
            found, inflation = _inflated(data, problem, found, max_terms, beam, inflation)
            verdict = weigh(found)
            impossible = _impossible(problem, verdict.best)
            if not impossible:
                break
            terms = [term for term in terms if term.label not in impossible]
            problem = problem.only(
                np.array([k for k, t in enumerate(problem.terms) if t.label not in impossible], np.intp)
            )
        verdict, fit = _fitted(data, problem, verdict, state, base.chi2)
        model = tuple(problem.terms[k] for k in verdict.best)
        labels = tuple(sorted(term.label for term in model))
        linear = problem.chi2 - 2 * inflation * found.explained(verdict.best)
        settled = abs(linear - fit.chi2) < 1.0 * inflation or labels == before
        state, before = fit.state, labels
        if data.known and inflation > 1 and adequacy(fit.chi2, fit.dof, data.noise_dof) >= ADEQUATE:
            # What asked for more noise was the linear problem's error, not the model's.
            inflation, settled = 1.0, False
        if settled:
            break
    p = adequacy(fit.chi2, fit.dof, data.noise_dof) if data.known else 1.0
    if p < ADEQUATE:
        inflation = max(inflation, fit.chi2 / fit.dof)  # uncertainties by what the final model leaves
    return Selection(problem, found, verdict, model, base, fit, inflation, p >= ADEQUATE)


def _fitted(
    data: Observations, problem: Problem, verdict: Verdict, state: State, most: float
) -> tuple[Verdict, Refit]:
    """Full refit of the best model, or of the next one if it ends above the χ² of the base model.

    A model that holds the base model cannot be worse, so that such a refit has run away from amplitudes
    that only the linear problem allows.
    """
    ranked = sorted(verdict.weights, key=lambda m: -verdict.weights[m])
    for chosen in dict.fromkeys([verdict.best, *ranked[:4]]):
        fit = fit_model(data, problem, chosen, state)
        if fit.chi2 <= most * (1 + 1e-6):
            return replace(verdict, best=chosen), fit
    return verdict, fit_model(data, problem, verdict.best, state)


def _impossible(problem: Problem, chosen: Sequence[int]) -> set[str]:
    """Labels of the effects of a model whose amplitudes are beyond their physical bounds.

    Where a covariate hardly moves (a temperature that is constant but for its noise) a column is a constant
    with a little noise on it, which can fit better than the constant with an amplitude that no part has.
    """
    out = set()
    for k, own in zip(chosen, amplitudes(problem, chosen), strict=True):
        term = problem.terms[k]
        if isinstance(term, NamedTerm):
            values, (low, high) = term.start(own), term.bounds().T
            if ((values < low) | (values > high)).any():
                out.add(term.label)
    return out


def _inflated(
    data: Observations, problem: Problem, found: Search, max_terms: int, beam: int, inflation: float
) -> tuple[Search, float]:
    """Search again with more noise where not even the best model is adequate.

    What no model explains is then treated as noise of unknown origin (Birge's ratio), so that names have to
    stand out of it.
    """
    for _ in range(4):
        best = found.best
        basis, residual = span(problem, best)
        chi2, dof = float(residual @ residual), problem.dof - basis.shape[1]
        ratio = chi2 / max(dof, 1)
        if data.known:
            if dof <= 0 or adequacy(chi2 / inflation, dof, data.noise_dof) >= ADEQUATE:
                return found, inflation
        elif abs(ratio / inflation - 1) < 0.05:
            return found, inflation
        inflation = max(ratio, 1.0) if data.known else max(ratio, 1e-12)
        again = search(problem, max_terms, inflation, beam)
        if again.best == best:
            return again, inflation
        found = again
    return found, inflation


def _mostly_bias(problem: Problem) -> int | None:
    """Number of the bias on most axes, where it alone explains nearly all of the base model's excess."""
    constants = [k for k, term in enumerate(problem.terms) if term.name == "bias"]
    if not constants:
        return None
    widest = max(constants, key=lambda k: problem.width[k])
    left = float((span(problem, [widest])[1] ** 2).sum()) - problem.dof
    excess = problem.chi2 - problem.dof
    return widest if excess > 0 and left < (1 - MOSTLY) * excess else None
