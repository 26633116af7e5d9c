"""What is said of a selection: findings with their uncertainty, the rest without a name, rivals, notes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adis_gonio.base.uncertainty import NORMAL_95, Value
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Unit
from adis_gonio.fitting.estimation.terms import NamedTerm, NamelessTerm
from adis_gonio.fitting.outputs import outputs_of
from adis_gonio.model.effects import AXES, effect
from adis_gonio.tracing.outcome.between import bases, effects
from adis_gonio.tracing.outcome.cycles import cycles_alike
from adis_gonio.tracing.outcome.result import Finding, Rival, Unnamed
from adis_gonio.tracing.outcome.sets import votes
from adis_gonio.tracing.selection.design import span
from adis_gonio.tracing.selection.scatter import Scatter
from adis_gonio.tracing.selection.select import Selection
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.unnamed.averaging import Averaged


def dof_of(selection: Selection) -> float:
    """Degrees of freedom that show the noise at which uncertainties are stated; inf where it was stated."""
    data = selection.data
    dof = data.noise_dof if data.noise_known else np.inf
    if not data.noise_known or selection.inflation > 1:
        dof = min(dof, max(selection.fit.dof, 1.0))
    return float(dof)


def finding_of(selection: Selection, name: str, averaged: Averaged | None = None) -> Finding:
    """One name of the chosen model, beside what is averaged, with its parameters and its test."""
    from scipy import stats

    problem = selection.problem
    members = [k for k in selection.verdict.best if problem.terms[k].name == name]
    gain, width = _gain(selection, members)
    parameters: dict[str, Value] = {}
    axes: list[str] = []
    cause = ""
    amplitude_of, mixture = effects(selection, name)
    voted, present = votes(selection, name, averaged)
    dof = dof_of(selection)
    fit = selection.fit
    for index, (term, values) in enumerate(zip(fit.terms, fit.values.terms, strict=True)):
        at = fit.slice_of(index).start
        if isinstance(term, NamedTerm) and term.name == name:
            cause = term.effect.cause
            axes += [axis for axis in term.effect.axes if axis not in axes]
            seen = np.abs(fit.candidate(term)).max(axis=(0, 1)) > 0
            unseen = {k for k, shown in zip(term.amplitudes, seen, strict=True) if not shown}
            for k, parameter in enumerate(term.effect.parameters):
                u = float(np.sqrt(fit.covariance[at + k, at + k] * selection.inflation))
                if parameter.name in amplitude_of:  # shapes are fitted: their spread is in the covariance
                    u = mixture.u(u, np.array([float(other == parameter.name) for other in amplitude_of]))
                undetermined = k in unseen
                value = 0.0 if undetermined else float(values[k])
                parameters[parameter.name] = Value(value, None if undetermined else u, parameter.unit, dof)
            for choice in (c for c in term.effect.choices() if c not in term.effect.options):
                parameters[choice] = Value(float(getattr(term.effect, choice)), None, "1")
    # The level is spent by the prior: a name has a far greater share of it than one of thousands of
    # functions without a name (weighted Bonferroni; Genovese, Roeder and Wasserman, Biometrika 93, 2006).
    share = float(np.exp(-sum(problem.cost[k] for k in members)))
    p = float(stats.chi2.sf(gain / selection.inflation, width)) / share
    same = [
        " + ".join(sorted({problem.terms[k].shown_as for k in m}))
        for m in selection.verdict.same.get(selection.verdict.best, [])
        if name not in {problem.terms[k].name for k in m}
    ]
    return Finding(
        effect=name,
        axes=tuple(axes),
        parameters=parameters,
        p_value=min(p, 1.0),
        explains=0.0,  # a share of the steps, which are not known here: see `shares`
        probability=min(voted.get(name, 0.0) * present, 1.0),
        equivalents=tuple(dict.fromkeys(same))[:5],
        cause=cause,
    )


def told_from_zero(finding: Finding) -> bool:
    """True where a value differs from zero by more than its own uncertainty allows."""
    halves = [(abs(v.value), v.U) for v in finding.parameters.values() if v.u]
    return not halves or any(size > limits.told * (half or 0.0) / NORMAL_95 for size, half in halves)


def scatter_finding(scatter: Scatter, explains: float) -> Finding:
    """Scatter from dwell to dwell as an entry of `found`, with its share of the base model's excess."""
    return Finding(
        effect=scatter.kind,
        axes=(),
        parameters={"scatter": Value(scatter.value, scatter.u, scatter.unit)},
        p_value=scatter.p_value,
        explains=explains,
        probability=float(1 / (1 + np.exp(-scatter.log_odds))),
        cause="Readings scatter from dwell to dwell by more than the samples within them do.",
    )


def _gain(selection: Selection, members: Sequence[int]) -> tuple[float, int]:
    """χ² that some terms take beside the others of the model, and their columns."""
    best = selection.verdict.best
    with_all = float((span(selection.problem, best)[1] ** 2).sum())
    others = [k for k in best if k not in members]
    without = float((span(selection.problem, others)[1] ** 2).sum())
    return without - with_all, int(sum(selection.problem.width[k] for k in members))


def unnamed_of(selection: Selection, averaged: Averaged | None) -> Unnamed | None:
    """Nameless terms of the model, or what is averaged in their place."""
    from scipy import stats

    problem, verdict = selection.problem, selection.verdict
    members = [k for k in verdict.best if isinstance(problem.terms[k], NamelessTerm)]
    if members:
        terms = [problem.terms[k] for k in members]
        gain, width = _gain(selection, members)
        share = float(np.exp(-sum(problem.cost[k] for k in members)))
        covariates = tuple(dict.fromkeys(c for term in terms for c in term.covariates))
        forms = [term.form for term in terms if isinstance(term, NamelessTerm)]
        return Unnamed(
            covariates=covariates,
            form="; ".join(forms),
            explains=0.0,
            probability=min(verdict.covariates.get(term.covariates, 0.0) for term in terms),
            p_value=min(1.0, float(stats.chi2.sf(gain / selection.inflation, width)) / share),
        )
    if averaged is not None:
        smooth = averaged.smooth
        return Unnamed(
            covariates=smooth.covariates,
            form=smooth.form,
            explains=0.0,
            probability=averaged.weight,
            p_value=min(1.0, 1 - averaged.weight),
        )
    return None


def rivals_of(selection: Selection) -> tuple[Rival, ...]:
    """Models near the best, the best first."""
    ranked = sorted(selection.verdict.weights.items(), key=lambda item: -item[1])[:8]
    terms = selection.problem.terms
    return tuple(Rival(tuple(terms[k].label for k in model), weight) for model, weight in ranked)


def base_of(selection: Selection) -> dict[str, Value]:
    """Base parameters as `adis_gonio.fit` states them; in the plane with ΔK.

    Their uncertainty holds what other probable models say of them.
    """
    fit = selection.fit
    data = fit.data
    # What a prior alone holds is at its centre exactly; a start angle, which has none, is where it began.
    held = ~data.visible & np.isfinite([parameter.spread for parameter in data.model.parameters])
    base = np.where(held, data.model.nominal, fit.values.base)
    p = len(base)
    covariance = fit.covariance[:p, :p] * selection.inflation
    dof = dof_of(selection)
    mixture = bases(selection)
    # By the same function as `fit`, so that a name has one unit in both.
    outputs = outputs_of(data, np.concatenate([base, np.zeros(data.axes)]))
    hidden = {q.name for q, seen in zip(data.model.parameters, data.visible, strict=True) if not seen}
    out = {}
    for output in outputs:
        if output.name.startswith("bias"):
            continue
        slope = output.gradient[:p]
        u = mixture.u(float(np.sqrt(slope @ covariance @ slope)), slope)
        out[output.name] = Value(output.value, None if output.name in hidden else u, output.unit, dof)
    return out


def zeros_of(selection: Selection, seen: Sequence[Finding] = ()) -> dict[str, Value]:
    """Bias of every axis that no finding states, as `adis_gonio.fit` has it, if the unit is counts.

    An axis without a bias in the model stands at the rough zero by which the readings came into mg: its
    bias is fitted with the other parameters of the model. Empty if the zero of the unit is known.
    """
    data = selection.data
    if data.unit.known:
        return {}
    fit = selection.fit
    axes = tuple(AXES[: data.axes])
    biased = {
        letter
        for term in fit.terms
        if isinstance(term, NamedTerm) and term.name == "bias"
        for letter in term.effect.axes
    }
    lacking = tuple(letter for letter in axes if letter not in biased)
    if lacking:
        zero = NamedTerm("bias", (), 0.0, effect("bias", lacking))
        values = replace(fit.values, terms=(*fit.values.terms, np.zeros(len(lacking))))
        fit = Fit(data, (*fit.terms, zero), values, fit.with_prior).refit()
    stated = {f"bias_{letter}": Value(0.0, None, "mg") for letter in axes}
    for index, term in enumerate(fit.terms):
        if not isinstance(term, NamedTerm) or term.name != "bias":
            continue
        start = fit.slice_of(index).start
        for place, parameter in enumerate(term.effect.parameters, start):
            u = float(np.sqrt(fit.covariance[place, place] * selection.inflation))
            stated[parameter.name] = Value(float(fit.values.parameters[place]), u, "mg", dof_of(selection))
    zeros = in_units_of_file(Finding("bias", axes, stated, 1.0, 0.0, 1.0), data.unit).parameters
    known = {name for finding in seen if finding.effect == "bias" for name in finding.parameters}
    return {name: value for name, value in zeros.items() if name not in known}


def in_units_of_file(finding: Finding, unit: Unit) -> Finding:
    """A bias as the file's reading at zero where that is not known beforehand (counts), as `fit` has it."""
    if unit.known or finding.effect != "bias":
        return finding
    stated = {}
    for name, value in finding.parameters.items():
        axis = AXES.index(name[-1])
        per_mg = float(unit.per_mg[axis])
        u = None if value.u is None else value.u * per_mg
        zero = float(unit.zero[axis])
        stated[name] = Value(zero + value.value * per_mg, u, unit.name, value.dof)
    return replace(finding, parameters=stated)


def notes_of(selection: Selection, scatter: Scatter | None) -> tuple[str, ...]:
    """What has to be said about the noise."""
    data = selection.data
    notes = list(data.notes)
    for cycles, others in cycles_alike(selection):
        listed = ", ".join(str(n) for n in others)
        notes.append(
            f"at the angles of this session {cycles} cycles a turn of the stage look like {listed}"
        )
    if not data.noise_known:
        notes.append(
            "the noise of a reading is not known; it was estimated from the residual, so that adequacy "
            "cannot be tested"
        )
    if scatter is not None:
        what = "stated of the fixture" if scatter.kind == "fixture_scatter" else "shown within the dwells"
        unit = "°" if scatter.unit == "deg" else f" {scatter.unit}"
        notes.append(
            f"dwells scatter by {scatter.value:.2g}{unit} where {scatter.declared:.2g}{unit} was {what}; "
            "no covariate explains it"
        )
    elif data.noise_known and selection.inflation > 1 and not selection.adequate:
        notes.append(
            f"no model explains the residual down to the measured noise; effects were judged against "
            f"{np.sqrt(selection.inflation):.2g} times that noise"
        )
    return tuple(notes)
