"""Findings of a chosen model: parameters with uncertainty, explained shares, unnamed part, rivals, notes.

Share of each finding
    The excess of a model is the amount by which its χ² exceeds its degrees of freedom or, if the noise is
    unknown, the square of its residual. The share of an added effect is the decrease of the excess when it
    is added, as a fraction of the base model's excess. The shares of all effects add up to the total
    explained fraction, at most 100 %.

Uncertainty over all probable models
    The covariance of one model assumes that this model is right. In another model of equal probability an
    effect may act on one axis only (its amplitude on the other axis is then zero) or another effect may
    explain a part of its contribution, and models with equal predictions may have different gains. The
    stated u is chosen so that value ± 1.96 u holds 95 % of the mixture of all probable models, each normal
    about its own value (Hoeting, Madigan, Raftery and Volinsky, Bayesian model averaging, Statistical
    Science 14, 1999). The degrees of freedom of the noise are stated separately.

Values at the middle of the session
    At the start of a session a bias is strongly correlated with a drift and with the amplitude of a
    warm-up; only their sum is well determined. At the middle of the session the sum is known as well as
    the readings.

Cycles of the stage that a session cannot distinguish
    At N equally spaced angles n, N − n, N + n, … cycles a turn have equal columns. Only the smallest number
    is a candidate; `cycles_alike` lists the others. At other angles each number is a candidate.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import COVERED, NORMAL_95, Detectable, Value
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Unit
from adis_gonio.fitting.estimation.terms import NamedTerm, NamelessTerm, Term
from adis_gonio.fitting.fit_result import outputs_of
from adis_gonio.fitting.uncertainty import missing_curvature
from adis_gonio.model.effects import AXES, Conditions, Parameter, catalogue, effect
from adis_gonio.model.effects.stage_terms import StagePeriodic, alike
from adis_gonio.tracing.averaging import AveragedFit, AveragedTerm, middle_s
from adis_gonio.tracing.credible_sets import cause_name, probability_of, votes
from adis_gonio.tracing.linear_problem import LinearProblem, amplitudes, span
from adis_gonio.tracing.model_search import Model, Search, posterior
from adis_gonio.tracing.named_candidates import SplitEffect
from adis_gonio.tracing.scatter import Scatter
from adis_gonio.tracing.selection import Selection
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.trace_result import ErrorFigures, Finding, Rival, Unnamed


def dof_of(selection: Selection) -> float:
    """Return the degrees of freedom of the noise estimate behind the uncertainties.

    They are infinite if the noise was stated instead of estimated.
    """
    data = selection.data
    dof = data.noise_dof if data.noise_known else np.inf
    if not data.noise_known or selection.inflation > 1:
        dof = min(dof, max(selection.fit.dof, 1.0))
    return float(dof)


def finding_of(
    selection: Selection, name: str, averaged: AveragedFit | None = None, judged: Selection | None = None
) -> Finding:
    """Return the finding for the effect `name` of the chosen model: its parameters, test and probability.

    Parameters
    ----------
    selection : Selection
        Chosen model with its fit.
    averaged : AveragedFit, optional
        Average that replaces the unnamed part of the model.
    judged : Selection, optional
        Selection with the posterior that gives the probability; by default `selection`.
    """
    problem = selection.problem
    members = [k for k in selection.verdict.best if problem.terms[k].name == name]
    parameters: dict[str, Value] = {}
    axes: list[str] = []
    cause = ""
    amplitude_of, mixture = effect_mixture(selection, name)
    fit = selection.fit
    biases = biases_at_middle(fit) if name == "bias" and not fit.data.model.origins else {}
    each = np.eye(len(fit.values.parameters))
    for index, (term, values) in enumerate(zip(fit.terms, fit.values.terms, strict=True)):
        at = fit.slice_of(index).start
        if isinstance(term, NamedTerm) and term.name == name:
            cause = term.effect.cause
            axes += [axis for axis in term.effect.axes if axis not in axes]
            seen = np.abs(fit.candidate(term)).max(axis=(0, 1)) > 0
            unseen = {k for k, shown in zip(term.amplitudes, seen, strict=True) if not shown}
            for k, parameter in enumerate(term.effect.parameters):
                fitted, slope = biases.get(parameter.name, (float(values[k]), each[at + k]))
                u = float(np.sqrt(slope @ fit.covariance @ slope * selection.inflation))
                if parameter.name in amplitude_of:  # the covariance contains the spread of fitted shapes
                    u = mixture.u(u, np.array([float(other == parameter.name) for other in amplitude_of]))
                value, known = (0.0, None) if k in unseen else (fitted, u)
                # Sessions may show two courses of one name; a single session keeps the last one.
                stated = parameter.name
                if stated in parameters and selection.data.model.origins:
                    stated += " (second)"
                parameters[stated] = Value(value, known, parameter.unit, dof_of(selection))
            for choice in (c for c in term.effect.choices() if c not in term.effect.options):
                parameters[choice] = Value(float(getattr(term.effect, choice)), None, "1")
    same = [
        " + ".join(sorted({problem.terms[k].shown_as for k in m}))
        for m in selection.verdict.same.get(selection.verdict.best, [])
        if name not in {problem.terms[k].name for k in m}
    ]
    return Finding(
        effect=name,
        axes=tuple(axes),
        parameters=parameters,
        p_value=_p_value(selection, members),
        explains=0.0,  # known when the steps are (`trace.shown_findings`)
        probability=probability_of(judged or selection, name, averaged),
        equivalents=tuple(dict.fromkeys(same))[:5],
        cause=cause,
    )


def probability_of_equals(selection: Selection, name: str, averaged: AveragedFit | None = None) -> float:
    """Return the probability of the other names that predict the same in the place of an effect `name`.

    They are in models with equal predictions that have as many causes as the chosen model. `averaged` is
    the average that replaces the unnamed part of the model, if any.
    """
    verdict, terms = selection.verdict, selection.problem.terms
    ours = {terms[k].name for k in verdict.best}
    equal: set[str | None] = set()
    for model in verdict.same.get(verdict.best, []):
        theirs = {terms[k].name for k in model}
        if name not in theirs and len(theirs) == len(ours):
            equal |= theirs - ours
    share, present = votes(selection, name, averaged)
    return sum(part for other, part in share.items() if other in equal) * present


def differs_from_zero(finding: Finding) -> bool:
    """Return True if a parameter of a finding differs from zero by more than its expanded uncertainty."""
    least = limits.significance / NORMAL_95
    halves = [(abs(v.value), v.U or 0.0) for v in finding.parameters.values() if v.u]
    return not halves or any(size > least * half for size, half in halves)


def scatter_finding(scatter: Scatter, explains: float) -> Finding:
    """Return dwell-to-dwell scatter as a finding; `explains` is its share of the base model's excess χ²."""
    parameters = {"scatter": Value(scatter.value, scatter.u, scatter.unit)}
    probability = float(1 / (1 + np.exp(-scatter.log_odds)))
    cause = "Readings scatter from dwell to dwell by more than the samples within them do."
    return Finding(scatter.kind, (), parameters, scatter.p_value, explains, probability, cause=cause)


def _p_value(selection: Selection, members: Sequence[int]) -> float:
    """Return the p-value of the model's terms `members`, divided by their prior probability; at most 1.

    The prior distributes the test level: a name has a far greater share of it than one of thousands of
    unnamed functions (weighted Bonferroni; Genovese, Roeder and Wasserman, Biometrika 93, 2006).
    """
    from scipy.special import chdtrc

    problem, best = selection.problem, selection.verdict.best
    others = [k for k in best if k not in members]
    with_all, without = (float((span(problem, model)[1] ** 2).sum()) for model in (best, others))
    width = int(sum(problem.width[k] for k in members))
    p = float(chdtrc(width, (without - with_all) / selection.inflation))
    return min(1.0, p / float(np.exp(-sum(problem.cost[k] for k in members))))


def unnamed_of(
    selection: Selection, averaged: AveragedFit | None, judged: Selection | None = None
) -> Unnamed | None:
    """Return the unnamed part of the result: structure in the readings that no named effect explains.

    It consists of the model's unnamed terms or, if there are none, of the average `averaged`. The result is
    None without both. If there are several unnamed terms, its probability is the smallest of their
    probabilities, computed as in the credible sets. `judged` has the posterior for this, by default
    `selection`.
    """
    members = [k for k in selection.verdict.best if selection.problem.terms[k].name is None]
    terms = [term for k in members if isinstance(term := selection.problem.terms[k], NamelessTerm)]
    if terms:
        covariates = tuple(dict.fromkeys(c for term in terms for c in term.covariates))
        form = "; ".join(term.form for term in terms)
        causes = map(cause_name, terms)
        probability = min(probability_of(judged or selection, cause, averaged) for cause in causes)
        p_value = _p_value(selection, members)
    elif averaged is not None:
        covariates, form = averaged.smooth.covariates, averaged.smooth.form
        probability = averaged.weight
        p_value = min(1.0, 1 - probability)
    else:
        return None
    return Unnamed(covariates, form, 0.0, probability, p_value)


def rivals_of(selection: Selection) -> tuple[Rival, ...]:
    """Return the models of high posterior probability for the result, the most probable first."""
    ranked = sorted(selection.verdict.weights.items(), key=lambda item: -item[1])[:8]
    terms = selection.problem.terms
    return tuple(Rival(tuple(terms[k].label for k in model), weight) for model, weight in ranked)


def base_of(selection: Selection) -> dict[str, Value]:
    """Return the base parameters of the final fit by name, in the units of results; in the plane also ΔK.

    Their uncertainty covers the values in other probable models and, for several sessions, the error by an
    effect of the reading that is too weak to be found (`missing_curvature`).
    """
    fit = selection.fit
    data = fit.data
    # A parameter determined only by its prior is at the centre of that prior; a start angle has no prior
    # and keeps its initial value.
    held = ~data.visible & np.isfinite([parameter.spread for parameter in data.model.parameters])
    base = np.where(held, data.model.nominal, fit.values.base)
    p = len(base)
    covariance = fit.covariance[:p, :p] * selection.inflation
    if data.model.origins:
        covariance = covariance + missing_curvature(fit, selection.inflation)[:p, :p]
    dof = dof_of(selection)
    mixture = base_mixture(selection)
    # The function that `fit` uses, so that each name has one unit in both results.
    out: dict[str, Value] = {}
    for where, own in data.model.sessions:
        # Parameters of one session; parameters of its part may be in `out` already.
        names = [data.model.parameters[k] for k in own]
        hidden = {
            q.name.split("@")[0] for q, seen in zip(names, data.visible[own], strict=True) if not seen
        }
        owner = {q.name.split("@")[0]: q.name for q in names}
        here = replace(data, measurement=where)
        for output in outputs_of(here, np.concatenate([base[own], np.zeros(data.axes)])):
            if output.name.startswith("bias"):
                continue
            # ΔK is named after the part or session whose gains it compares.
            name = owner.get(output.name) or output.name + owner["scale_x"].removeprefix("scale_x")
            slope = np.zeros(p)
            slope[own] = output.gradient[: len(names)]
            u = mixture.u(float(np.sqrt(slope @ covariance @ slope)), slope)
            out[name] = Value(output.value, None if output.name in hidden else u, output.unit, dof)
    return out


def zeros_of(selection: Selection) -> dict[str, Value]:
    """Return the reading of each axis without acceleration, for readings in counts.

    The result is empty if the unit of the readings is known. An axis without a bias in the model is at the
    approximate zero that was used to convert the readings to mg. Its bias is fitted together with the other
    parameters.
    """
    data = selection.data
    if data.unit.known:
        return {}
    fit = selection.fit
    lacking = tuple(letter for letter in AXES[: data.axes] if letter not in bias_places(fit))
    if lacking:
        zero = NamedTerm("bias", (), 0.0, effect("bias", lacking))
        values = replace(fit.values, terms=(*fit.values.terms, np.zeros(len(lacking))))
        fit = Fit(data, (*fit.terms, zero), values, fit.with_prior).refit()
    stated: dict[str, Value] = {}
    for name, (bias, slope) in sorted(biases_at_middle(fit).items()):
        u = float(np.sqrt(slope @ fit.covariance @ slope * selection.inflation))
        stated[name] = Value(bias, u, "mg", dof_of(selection))
    return in_units_of_file(Finding("bias", (), stated, 1.0, 0.0, 1.0), data.unit).parameters


def bias_places(fit: Fit) -> dict[str, int]:
    """Return the place of each fitted bias among the parameters of a fit, by the letter of its axis."""
    return {
        letter: fit.slice_of(index).start + k
        for index, term in enumerate(fit.terms)
        if isinstance(term, NamedTerm) and term.constant
        for k, letter in enumerate(term.effect.axes)
    }


def in_units_of_file(finding: Finding, unit: Unit) -> Finding:
    """Return a bias finding in counts: the reading of each axis without acceleration.

    Other findings are unchanged, and so is a bias if `unit`, the unit of the readings, is a known unit.
    """
    if unit.known or finding.effect != "bias":
        return finding
    stated = {}
    for name, value in finding.parameters.items():
        axis = AXES.index(name[-1])
        per_mg, zero = float(unit.per_mg[axis]), float(unit.zero[axis])
        u = None if value.u is None else value.u * per_mg
        stated[name] = Value(zero + value.value * per_mg, u, unit.name, value.dof)
    return replace(finding, parameters=stated)


def notes_of(selection: Selection, scatter: Scatter | None) -> tuple[str, ...]:
    """Return notes on the noise, on dwell-to-dwell scatter, and on stage errors that look alike.

    `scatter` is None if there is no dwell-to-dwell scatter.
    """
    data = selection.data
    notes = list(data.notes)
    for cycles, others in cycles_alike(selection):
        listed = ", ".join(str(n) for n in others)
        notes.append(
            f"at the angles of this session {cycles} cycles a turn of the stage look like {listed}"
        )
    if not data.noise_known:
        notes.append(
            "the noise of a reading is unknown; it was estimated from the residual, so adequacy cannot be "
            "tested"
        )
    if scatter is not None:
        what = "stated of the fixture" if scatter.kind == "fixture_scatter" else "the noise of a reading"
        unit = "°" if scatter.unit == "deg" else f" {scatter.unit}"
        notes.append(
            f"dwells scatter by {scatter.value:.2g}{unit}, but {scatter.declared:.2g}{unit} was {what}; "
            "no covariate explains it"
        )
    elif data.noise_known and selection.inflation > 1 and not selection.adequate:
        notes.append(
            "no model explains the residual down to the noise of the readings; effects were judged against"
            f" {np.sqrt(selection.inflation):.2g} times that noise"
        )
    return tuple(notes)


def excesses(fits: Sequence[Fit], figures: Sequence[ErrorFigures]) -> list[float]:
    """Return the excess of each nested model: its χ² minus its degrees of freedom, at least 0.

    If the noise is unknown, the excess is the mean square of the residual. `fits` are the nested models,
    `figures` their errors.
    """
    if any(figure.chi2_per_dof is None for figure in figures):
        return [figure.residual_rms**2 for figure in figures]
    return [
        fit.dof * max((figure.chi2_per_dof or 1.0) - 1.0, 0.0)
        for fit, figure in zip(fits, figures, strict=True)
    ]


def shares(steps: Sequence[str], excess: Sequence[float]) -> dict[str, float]:
    """Return by effect the share of the base model's excess χ² that adding the effect removes.

    `excess` is the excess χ² of each nested model, the base model first. The `steps` are the names of the
    effects in the order in which they were added. An effect that increases the excess has the share 0.
    """
    found = dict.fromkeys(steps, 0.0)
    falls = -np.diff(np.minimum.accumulate(excess)) / (excess[0] or 1.0)
    for name, fall in zip(steps, falls.tolist(), strict=True):
        found[name] += fall
    return found


@dataclass(frozen=True)
class Mixture:
    """Parameter values of M probable models, for an uncertainty that covers the choice of the model.

    Attributes
    ----------
    away : (M, p) float
        Values in each model minus the reported values.
    weight : (M,) float
        Posterior weights of the models.
    """

    away: Floats
    weight: Floats

    def u(self, within: float, along: Floats) -> float:
        """Return the standard uncertainty of a linear combination of parameters over all probable models.

        `along` (p,) are the coefficients of the combination; `within` is its standard uncertainty if the
        model is known.
        """
        from scipy.optimize import brentq
        from scipy.special import ndtr

        away = self.away @ along
        if not within > 0 or not np.abs(away).max(initial=0.0) > 0:
            return within

        def missing(half: float) -> float:
            inside = ndtr((half - away) / within) - ndtr((-half - away) / within)
            return float(self.weight @ inside) - COVERED

        return float(brentq(missing, 0.0, float(np.abs(away).max()) + 3 * within)) / NORMAL_95


def base_mixture(selection: Selection) -> Mixture:
    """Return the base parameters in each probable model (minus the reported ones) with the models' weights.

    If an average replaces the unnamed functions, the covariance of its fit already contains the differences
    between them. Models with the named effects of the chosen model then have the reported values.
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
        # Residual of the linear problem after the terms of this model.
        left[:, row] = target - added
    stated = fit.base_step(fit.residual.reshape(-1, 1))
    return Mixture((fit.base_step(left) - stated).T, np.array(list(each.values())))


def effect_mixture(selection: Selection, name: str) -> tuple[list[str], Mixture]:
    """Return the names of an effect's amplitudes, and their values in all probable models with the effect.

    `name` is the effect. A bias has its value at the middle of the session (`biases_at_middle`). Models
    with other shapes or dwells are excluded: shapes are fitted, and the covariance contains their spread.
    If the chosen model has a bias, models without a bias are excluded too. Every sensor has a bias, and
    without it two curvatures can compensate each other with unrealistic amplitudes.
    """
    problem, verdict = selection.problem, selection.verdict
    needed = _names(problem, verdict.best) & {"bias"}
    kind = _kind(problem.terms, verdict.best, name)
    own = _amplitudes_of(selection, verdict.best, name)
    away, weights = [np.zeros(len(own))], [1e-12]  # the chosen model, in case no model qualifies
    for model, weight in posterior(selection.found).items():
        if _kind(problem.terms, model, name) == kind and needed <= _names(problem, model):
            values = _amplitudes_of(selection, model, name)
            away.append(np.array([values.get(parameter, 0.0) - own[parameter] for parameter in own]))
            weights.append(weight)
    return list(own), Mixture(np.array(away), np.array(weights) / sum(weights))


def _names(problem: LinearProblem, model: Sequence[int]) -> frozenset[str]:
    return frozenset(name for name in (problem.terms[k].name for k in model) if name is not None)


def _kind(terms: Sequence[Term], model: Sequence[int], name: str) -> tuple[object, ...]:
    """Return the shape parameters and choices (dwell, degree) of the effect `name` in a model.

    Two models have the effect in one form if their results are equal. The result is empty if the model
    lacks the effect. `terms` are all candidate terms, `model` the numbers of the model's terms.
    """
    return tuple(
        (term.shapes, tuple(getattr(term.effect, choice) for choice in term.effect.choices()))
        for term in map(terms.__getitem__, model)
        if isinstance(term, NamedTerm) and term.name == name
    )


def _amplitudes_of(selection: Selection, model: Sequence[int], name: str) -> dict[str, float]:
    """Return an effect's amplitudes in a model by parameter name, from a linear fit of this model.

    A bias contains the terms that depend on time alone, at the middle of a single session.
    """
    problem, data = selection.problem, selection.data
    middle = Conditions(time_s=np.array([middle_s(selection.fit)]))
    out: dict[str, float] = defaultdict(float)
    for k, own in zip(model, amplitudes(problem, model), strict=True):
        term = problem.terms[k]
        if isinstance(term, NamedTerm) and term.name == name:
            for index, value in zip(term.amplitudes, own, strict=True):
                out[term.effect.parameters[index].name] += float(value)
        elif name == "bias" and follows_clock(term) and not (term.enters_angle or data.model.origins):
            added = term.columns(np.zeros((1, data.axes)), middle)[0] @ own
            for letter, value in zip(AXES, added, strict=False):
                out[f"bias_{letter}"] += float(value)
    return out


def follows_clock(term: Term) -> bool:
    """Return True if time since the start of the session is the only covariate of a term."""
    if isinstance(term, AveragedTerm):  # it lists only the covariates of its most probable member
        return all(follows_clock(member) for _, member, _ in term.members)
    needs = term.effect.needs if isinstance(term, NamedTerm) else ()
    return term.covariates == ("time",) and not needs


def clock_at_middle(fit: Fit, ideal: Floats, *, turned: bool = False) -> tuple[Floats, Floats]:
    """Return the contribution of all terms that depend on time alone to a reading at mid-session.

    Parameters
    ----------
    ideal : (axes,) float
        Readings of an ideal sensor.
    turned : bool
        If true, return the contribution to the angle instead, in rad.

    Returns
    -------
    added : (axes,) or () float
        Contribution, in the unit of the readings or in rad.
    gradient : (axes, p) or (p,) float
        Derivative by all parameters of the fit.
    """
    middle = Conditions(time_s=np.array([middle_s(fit)]))
    added = np.zeros(() if turned else ideal.shape)
    gradient = np.zeros((*added.shape, len(fit.values.parameters)))
    for index, (term, own) in enumerate(zip(fit.terms, fit.values.terms, strict=True)):
        if follows_clock(term) and term.enters_angle == turned:
            added = added + term.added(own, ideal[None], middle)[0]
            gradient[..., fit.slice_of(index)] += term.derivative(own, ideal[None], middle)[0]
    return added, gradient


def biases_at_middle(fit: Fit) -> dict[str, tuple[float, Floats]]:
    """Return the value of each fitted bias at the middle of the session, and its derivative (p,), by name.

    Several sessions have no common middle.
    """
    stated = {}
    added, slopes = clock_at_middle(fit, np.zeros(fit.data.axes))
    for letter, place in bias_places(fit).items():
        axis = AXES.index(letter)
        slopes[axis, place] += 1.0
        stated[f"bias_{letter}"] = float(fit.values.parameters[place] + added[axis]), slopes[axis]
    return stated


def cycles_alike(selection: Selection) -> list[tuple[int, tuple[int, ...]]]:
    """Return the cycles per turn of each periodic stage error, with other numbers that fit as well."""
    problem, best = selection.problem, selection.verdict.best
    angle = selection.data.conditions.angle_rad
    periodic = {
        k: term.effect.cycles
        for k, term in enumerate(problem.terms)
        if isinstance(term, NamedTerm) and isinstance(term.effect, StagePeriodic)
    }
    out = []
    for own in [k for k in best if k in periodic]:
        assert angle is not None
        basis, residual = span(problem, [k for k in best if k != own])
        score = 0.5 * problem.gains(basis, residual) / selection.inflation - selection.found.prices
        weight = np.exp([score[k] - score[own] for k in periodic])
        likely = weight >= (1 - limits.set_level) * weight.sum()
        cycles = {n for n, shown in zip(periodic.values(), likely, strict=True) if shown}
        cycles |= {
            n for n in range(periodic[own], limits.most_cycles + 1) if alike(n, periodic[own], angle)
        }
        if others := sorted(cycles - {periodic[own]}):
            out.append((periodic[own], tuple(others[:5])))
    return out


_POWER_90 = 1.2815515655446004
"""Quantile of the normal distribution at 90 %."""


def detectable(
    found: Search, model: Model, missing: dict[str, Detectable], part: str = "accelerometer"
) -> dict[str, Detectable]:
    """Return the smallest amplitude of each effect that the search would find with 90 % probability.

    `model` is the chosen model; `missing` has the entry of each effect that is not a candidate, and `part`
    is `accelerometer` or `gyro`. A column c of an effect, projected off base and model, has a score z ~
    N(|c| a, 1) for an amplitude a. The effect is added if z² > 2 × its price, hence a = (√(2 price) +
    1.28)/|c|, where 1.28 is the 90 % quantile of N(0, 1). The result is the worst of several axes and the
    median of several shapes or dwells.
    """
    problem = found.problem
    inside = {problem.terms[k].name for k in model}

    @cache
    def basis_without(name: str | None) -> Floats:
        """Return an orthonormal basis (rows, k) of the model's columns without the effect `name`.

        None leaves no effect out.
        """
        return span(problem, [m for m in model if name is None or problem.terms[m].name != name])[0]

    figures: dict[tuple[str, Parameter], list[float]] = defaultdict(list)
    for k, term in enumerate(problem.terms):
        if not isinstance(term, NamedTerm) or len(term.effect.axes) > 1:
            continue
        if isinstance(term.effect, SplitEffect):  # the amplitude that all sessions would show
            continue
        name = term.effect.name
        # Change of the whitened readings by one unit of each amplitude, projected off base and model.
        back, basis = problem.back_of(k), basis_without(name if name in inside else None)
        columns = problem.block(k) @ (1 / back if back.size == 1 else np.linalg.pinv(back))
        lengths = np.linalg.norm(columns - basis @ (basis.T @ columns), axis=0)
        # Threshold of the score, plus the quantile for 90 % power.
        reach = (np.sqrt(2 * max(float(found.prices[k]), 0.5)) + _POWER_90) * np.sqrt(found.inflation)
        for index, length in zip(term.amplitudes, lengths, strict=True):
            amplitude = float(reach / length) if length > 1e-9 else np.inf
            figures[name, term.effect.parameters[index]].append(amplitude)
    medians = {key: float(np.median(values)) for key, values in figures.items()}
    out = dict(missing)
    for name in dict.fromkeys(name for name, _ in medians):
        key = max((key for key in medians if key[0] == name), key=medians.__getitem__)
        seen = bool(np.isfinite(medians[key]))
        reason = "" if seen else "lies in what is fitted already"
        out[name] = Detectable(medians[key] if seen else None, key[1].unit, key[1].name, reason)
    for name in catalogue(part):
        out.setdefault(
            name, Detectable(None, "", "", "lies in the base model: this session cannot show it")
        )
    return out
