"""Uncertainty of a value over all probable models.

The covariance of one model takes for granted that it is the right one. In another that is as probable an
effect may act on one axis only (the amplitude of the other is then zero), or stand beside something that
shares its direction, and models that predict the same may differ by a gain. A stated u is such that value
± 1.96 u holds 95 % of the mixture of all of them (Hoeting, Madigan, Raftery and Volinsky, Bayesian model
averaging, Statistical Science 14, 1999), each normal about its own value; the degrees of freedom that show
the noise stand apart from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import COVERED, NORMAL_95
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.tracing.selection.design import LinearProblem, amplitudes
from adis_gonio.tracing.selection.posterior import posterior
from adis_gonio.tracing.selection.select import Selection
from adis_gonio.tracing.unnamed.averaging import AveragedFit


@dataclass(frozen=True)
class Mixture:
    """Probable models: how far the values (M, p) of each are from the stated ones, and its weight (M,)."""

    away: Floats
    weight: Floats

    def u(self, within: float, along: Floats) -> float:
        """Standard uncertainty of `along` (p,) · values; `within` is that of one model."""
        from scipy.optimize import brentq
        from scipy.special import ndtr

        away = self.away @ along
        if not within > 0 or not np.abs(away).max(initial=0.0) > 0:
            return within

        def missing(half: float) -> float:
            inside = ndtr((half - away) / within) - ndtr((-half - away) / within)
            return float(self.weight @ inside) - COVERED

        return float(brentq(missing, 0.0, float(np.abs(away).max()) + 3 * within)) / NORMAL_95


def bases(selection: Selection) -> Mixture:
    """Base parameters of the probable models.

    What stands in the place of nameless functions is an average that holds its own spread: then models with
    the same names count as the one that is stated.
    """
    problem, fit = selection.problem, selection.fit
    each = posterior(selection.found)
    _, _, target = fit.linear()
    named = _names(problem, selection.verdict.best)
    averaged = isinstance(fit, AveragedFit)
    columns: dict[int, Floats] = {}
    left = np.repeat(fit.residual.reshape(-1, 1), len(each), axis=1)
    for row, model in enumerate(each):
        if model == selection.verdict.best or (averaged and _names(problem, model) == named):
            continue
        added = np.zeros(len(target))
        for k, own in zip(model, amplitudes(problem, model), strict=True):
            if k not in columns:
                columns[k] = fit.white(fit.candidate(problem.terms[k]))
            added = added + columns[k] @ own
        left[:, row] = target - added
    stated = fit.base_step(fit.residual.reshape(-1, 1))
    return Mixture((fit.base_step(left) - stated).T, np.array(list(each.values())))


def effects(selection: Selection, name: str) -> tuple[list[str], Mixture]:
    """Amplitudes of an effect, by parameter, in the probable models that hold it.

    Models whose shapes or dwells are others are left out: shapes are fitted, and their spread is in the
    covariance. So are, where the chosen model has a bias, those without one: every sensor has one, and two
    curvatures that predict the same stand against each other with amplitudes that no part has.
    """
    problem, verdict = selection.problem, selection.verdict
    needed = _names(problem, verdict.best) & {"bias"}
    kind = _kind(problem.terms, verdict.best, name)
    own = _amplitudes_of(problem, verdict.best, name)
    away, weights = [np.zeros(len(own))], [1e-12]  # where none holds it, the one that is stated
    for model, weight in posterior(selection.found).items():
        if _kind(problem.terms, model, name) == kind and needed <= _names(problem, model):
            values = _amplitudes_of(problem, model, name)
            away.append(np.array([values.get(parameter, 0.0) - own[parameter] for parameter in own]))
            weights.append(weight)
    return list(own), Mixture(np.array(away), np.array(weights) / sum(weights))


def _names(problem: LinearProblem, model: Sequence[int]) -> frozenset[str]:
    return frozenset(name for name in (problem.terms[k].name for k in model) if name is not None)


def _kind(terms: Sequence[Term], model: Sequence[int], name: str) -> tuple[object, ...]:
    """Shapes and choices of an effect in a model; the empty tuple where it is not in it."""
    mine = [terms[k] for k in model if terms[k].name == name]
    return tuple(
        (term.shapes, tuple(getattr(term.effect, choice) for choice in term.effect.choices()))
        for term in mine
        if isinstance(term, NamedTerm)
    )


def _amplitudes_of(problem: LinearProblem, model: Sequence[int], name: str) -> dict[str, float]:
    """Amplitudes of an effect in a model of the linear problem, by parameter."""
    out: dict[str, float] = {}
    for k, own in zip(model, amplitudes(problem, model), strict=True):
        term = problem.terms[k]
        if isinstance(term, NamedTerm) and term.name == name:
            for index, value in zip(term.amplitudes, own, strict=True):
                out[term.effect.parameters[index].name] = float(value)
    return out
