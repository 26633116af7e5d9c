"""`trace`: residual → missing effect → corrected model → error before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adis_gonio.errors import FitError
from adis_gonio.model.records import Floats, Session
from adis_gonio.tracing.advice import advise
from adis_gonio.tracing.averaging import Averaged, average
from adis_gonio.tracing.design import Problem, amplitudes, span
from adis_gonio.tracing.detect import detectable
from adis_gonio.tracing.gates import contradicting, held_out_gains
from adis_gonio.tracing.grammar import nameless_terms, of_one_dwell
from adis_gonio.tracing.heldout import (
    Fitted,
    Left,
    bounded,
    counted,
    counting,
    cross_validate,
    folds,
    leave,
    less_unknown,
    rms,
)
from adis_gonio.tracing.named import named_terms
from adis_gonio.tracing.naming import Names, describe, judge
from adis_gonio.tracing.observations import Observations, observe
from adis_gonio.tracing.openings import undecided
from adis_gonio.tracing.remainder import dependence
from adis_gonio.tracing.result import ErrorFigures, Finding, Rival, Step, TraceResult, Unnamed, Value
from adis_gonio.tracing.second_pass import with_second_pass
from adis_gonio.tracing.selection import ADEQUATE, Selection, adequacy, fit_model, select
from adis_gonio.tracing.state import Refit, State, begin, refit
from adis_gonio.tracing.terms import NamedTerm, NamelessTerm, Term
from adis_gonio.tracing.verdict import CERTAIN

BASE_PLANAR = (("alpha", "degree"), ("scale_x", "1"), ("scale_y", "1"), ("delta_phi", "degree"))
BASE_SPACE = (
    ("scale_x", "1"),
    ("skew_xy", "1"),
    ("scale_y", "1"),
    ("skew_xz", "1"),
    ("skew_yz", "1"),
    ("scale_z", "1"),
)
WORSE = 1.05
"""Largest held-out error of the final model in units of the base model's."""
LEAST_WEIGHT = 0.05
"""Least posterior of a model that counts in the uncertainty of an effect: rarer ones lie beyond 95 %."""
SIGNIFICANT = 0.01
"""Largest p-value, multiplied by the candidates, of an effect that is called found."""
LEAST_CHECKS = 2
"""Least degrees of freedom that a model has to leave for its names to stand."""
LEAST_DWELLS = 5
"""Least dwells of which some are left out to judge effects one by one."""
LEAST_CHOICE = 9
"""Least dwells of which some are left out of the selection as well: of seven or eight the others often
choose another name, which says nothing of the one that all of them show."""


def trace(session: Session, max_effects: int = 6) -> TraceResult:
    """Trace the residual of a session to the effects that the seed paper's model lacks.

    Parameters
    ----------
    session : Session
        Planar (declared angles) or in space (`plane` none); one dwell with temperature is traced sample by
        sample (`adis_gonio.tracing.series`).
    max_effects : int
        Most terms that the model may take on.

    Raises
    ------
    DataError
        As `adis_gonio.fitting.reduce_session`.
    FitError
        Fewer readings than base parameters.
    """
    if len([dwell for dwell in session.dwells if len(dwell)]) == 1:
        from adis_gonio.tracing.series import trace_series

        return trace_series(session, max_effects)
    data = observe(session)
    try:
        result = trace_observations(data, max_effects)
    except FitError as error:
        raise FitError(f"{session.source}: {error}" if session.source else str(error)) from error
    return with_second_pass(session, data, result)


def trace_observations(data: Observations, max_effects: int = 6) -> TraceResult:
    """Trace readings; see `trace`."""
    training = data.rows(~data.check)
    checking = data.rows(data.check) if data.check.any() else None
    _enough(training)
    training = replace(training, fitted=training.base_seen)
    named, missing = named_terms(training)
    terms: list[Term] = [*named, *nameless_terms(training)]
    selection = select(training, terms, max_effects)
    names = _checked(judge(selection), selection)
    selection, names, dropped = _surviving(training, selection, names)

    if not selection.adequate:
        could = undecided(selection)
        if len(could) > 1:
            names = replace(names, confounded=(*names.confounded, could))

    nested = _in_order(training, selection)
    labels = [describe(model[-1]) for model in nested[1:]]
    averaged = average(training, selection)
    if averaged is not None and len(averaged.named) == len(selection.model):
        nested.append(averaged.model)
        labels.append(describe(averaged.model[-1]))
    rival = _Fold(_active_terms(selection, terms), averaged, max_effects)
    figures, design = _figures(training, checking, selection, nested, rival)
    guard = _guarding(training, checking, selection, nested, figures, rival)
    count, names, cut = _never_worse(names, labels, guard)
    if count < len(nested) - 1:
        # Longer models have their figures already; those of the shorter one hold for it as they are.
        kept = [k for k in selection.verdict.best if selection.problem.terms[k] in nested[count]]
        selection = _with_model(training, selection, kept)
        nested, figures = nested[: count + 1], figures[: count + 1]
        dropped, averaged = {**dropped, **cut}, None
    unnamed = _unnamed(training, selection, averaged)
    final = selection if averaged is None else _with_average(training, selection, averaged)
    findings = [_finding(final, name, _student(training, final)) for name in names.stand]
    weak = {
        finding.effect: f"its own test beside the others is p = {finding.p_value:.2g}"
        for finding in findings
        if finding.p_value > SIGNIFICANT
    }
    if figures[-1].heldout_rms_mg is None:
        weak |= {
            finding.effect: "no dwell could be left out to check it by"
            for finding in findings
            if finding.effect != "bias"
        }
    found = tuple(finding for finding in findings if finding.effect not in weak)
    names = _without(replace(names, open={**names.open, **weak}), weak)
    seen = detectable(selection.found, selection.verdict.best, missing)
    rivals = _rivals(selection)
    open_still = replace(selection, adequate=final.adequate)
    advice, measurements = advise(data, training, open_still, terms, names.confounded)
    return TraceResult(
        adequate=final.adequate and (final.fit.dof > 0 or not training.known),
        found=found,
        steps=tuple(
            Step(label, error) for label, error in zip(labels[: len(nested) - 1], figures[1:], strict=True)
        ),
        confounded=names.confounded,
        unnamed=unnamed,
        before=figures[0],
        after=figures[-1],
        detectable=seen,
        advice=advice,
        measurements=measurements,
        rivals=rivals,
        base=_base(training, final.fit, final.inflation),
        reasons={**names.open, **dropped},
        notes=_notes(data, selection),
        heldout_design=design,
        model=final.model,
        state=final.fit.state,
    )


def _enough(data: Observations) -> None:
    if not len(data):
        raise FitError("every dwell is for checking: there is none to fit")
    base = 4 if data.planar else 6
    rows = len(data) * (1 if np.isinf(data.fixture_rad) else 2)
    if rows < base:
        raise FitError(
            f"{len(data)} positions give {rows} equations for {base} base parameters; measure at least "
            f"{-(-base // max(rows // len(data), 1))} positions"
        )


def _checked(names: Names, selection: Selection) -> Names:
    """Names less those of a model that leaves fewer than `LEAST_CHECKS`: it would fit whatever was there.

    A bias stands: every sensor has one, and nothing need prove it against none at all.
    """
    dof = selection.fit.dof
    if dof >= LEAST_CHECKS:
        return names
    open_ = [name for name in names.stand if name != "bias"]
    reasons = dict.fromkeys(open_, f"the model leaves {dof} readings to check it by: too few")
    return _without(replace(names, open={**names.open, **reasons}), reasons)


def _surviving(
    data: Observations, selection: Selection, names: Names
) -> tuple[Selection, Names, dict[str, str]]:
    """Take away effects that held-out dwells contradict, the worst first, each judged beside the others.

    Uncertain names go as well where dwells do not confirm them.
    """
    reasons: dict[str, str] = {}
    if len(data) < LEAST_DWELLS:
        return selection, names, reasons
    while selection.model:
        worst: tuple[float, str, str] | None = None
        for name in dict.fromkeys(describe(term) for term in selection.model):
            members = [k for k, term in enumerate(selection.model) if describe(term) == name]
            gains = held_out_gains(data, selection.model, selection.fit, members, selection.inflation)
            for design, held_out in contradicting(gains).items():
                if worst is None or held_out.gain < worst[0]:
                    worst = (held_out.gain, name, design)
        if worst is None:
            break
        gain, name, design = worst
        reasons[name] = f"contradicted by dwells that took no part ({design}: χ² rises by {-gain:.1f})"
        kept = [k for k in selection.verdict.best if describe(selection.problem.terms[k]) != name]
        selection = _with_model(data, selection, kept)
    selection, unconfirmed = _confirmed(data, selection, names)
    return selection, _without(names, reasons), {**reasons, **unconfirmed}


def _confirmed(data: Observations, selection: Selection, names: Names) -> tuple[Selection, dict[str, str]]:
    """Take uncertain effects out of the model where neither the folds nor adequacy ask for them."""
    reasons: dict[str, str] = {}
    for name in names.open:
        if selection.verdict.names.get(name, 0.0) >= CERTAIN or not selection.adequate:
            continue
        members = [k for k, term in enumerate(selection.model) if term.name == name]
        if not members:
            continue
        gains = held_out_gains(data, selection.model, selection.fit, members, selection.inflation)
        weak = [design for design, held_out in gains.items() if not held_out.confirmed]
        kept = [k for k in selection.verdict.best if selection.problem.terms[k].name != name]
        trial = _with_model(data, selection, kept) if weak else selection
        if weak and trial.adequate:
            selection = trial
            reasons[name] = f"{names.open[name]}, and dwells that took no part do not confirm it"
    return selection, reasons


def _with_model(data: Observations, selection: Selection, chosen: Sequence[int]) -> Selection:
    """The same selection with another model, refitted in full."""
    problem, model = selection.problem, tuple(chosen)
    fit = fit_model(data, problem, model, selection.base.state)
    adequate = adequacy(fit.chi2, fit.dof, data.noise_dof) >= ADEQUATE if data.known else True
    return replace(
        selection,
        verdict=replace(selection.verdict, best=model),
        model=tuple(problem.terms[k] for k in model),
        fit=fit,
        adequate=adequate,
    )


def _with_average(data: Observations, selection: Selection, averaged: Averaged) -> Selection:
    """The same selection with the averaged model in place of the chosen one."""
    fit = averaged.fit
    adequate = adequacy(fit.chi2, fit.dof, data.noise_dof) >= ADEQUATE if data.known else True
    return replace(selection, model=averaged.model, fit=fit, adequate=adequate)


def _without(names: Names, reasons: dict[str, str]) -> Names:
    """Names less those that were taken away, which stand under `confounded`."""
    more = tuple((name,) for name in reasons if name in names.stand)
    stand = tuple(name for name in names.stand if name not in reasons)
    return Names(stand, names.open, tuple(dict.fromkeys((*names.confounded, *more))))


def _never_worse(
    names: Names, labels: Sequence[str], errors: Sequence[float | None]
) -> tuple[int, Names, dict[str, str]]:
    """Longest nested model whose held-out error is at most `WORSE` that of the base model.

    Returns its number, the names that are left, and the reasons of the others.
    """
    last = len(labels)
    base = errors[0]
    if base is None:
        return last, names, {}
    for count in range(last, -1, -1):
        error = errors[count]
        if error is not None and error <= WORSE * base:
            break
    cut = set(labels) - set(labels[:count])
    after = errors[last]
    assert after is not None
    reasons = dict.fromkeys(
        sorted(cut), f"the held-out error would go from {base:.3g} to {after:.3g} mg with it"
    )
    return count, _without(names, reasons), reasons


def _keeping(terms: Sequence[Term], start: State):  # type: ignore[no-untyped-def]
    def fit(data: Observations) -> tuple[Sequence[Term], Refit]:
        begun = begin(data)
        return terms, refit(data, terms, State(begun.base, begun.delta_rad, begun.unit, start.values), 8)

    return fit


def _in_order(data: Observations, selection: Selection) -> list[tuple[Term, ...]]:
    """Nested models from the base to the chosen one, the term of the largest gain first."""
    left = list(selection.verdict.best)
    model: list[int] = []
    nested: list[tuple[Term, ...]] = [()]
    while left:
        chi2 = {k: float((span(selection.problem, [*model, k])[1] ** 2).sum()) for k in left}
        best = min(chi2, key=lambda k: chi2[k])
        model.append(best)
        left.remove(best)
        nested.append(tuple(selection.problem.terms[k] for k in model))
    return nested


def _figures(
    data: Observations,
    checking: Observations | None,
    selection: Selection,
    nested: list[tuple[Term, ...]],
    fold: _Fold,
) -> tuple[list[ErrorFigures], str]:
    """Error figures of the base model, each step and the final model."""
    fits = [refit(data, model, state) for model, state in _starts(selection, nested, fold)]
    if fold.averaged is not None:
        nested, fits = [*nested[:-1], fold.averaged.model], [*fits[:-1], fold.averaged.fit]
    if checking is not None:
        lefts = [[leave(checking, bounded(data, m, f), f.state)] for m, f in zip(nested, fits, strict=True)]
        design = f"{len(checking)} check dwells"
    elif _few(data, fits[-1].state):
        lefts, design = _figures_of_few(data, nested, fits)
    else:
        designs = folds(data)
        counts = counting(data, designs, selection.model)
        anew = cross_validate(data, designs, fold.chosen_anew) if len(nested) > 1 else {}
        counts = less_unknown(counts, anew) if anew else counts
        designs = {name: designs[name] for name in counts}
        design = "; ".join(f"{name} ({len(masks)} folds)" for name, masks in designs.items())
        lefts = []
        for model, fitted in zip(nested[:-1] if len(nested) > 1 else nested, fits, strict=False):
            kept = cross_validate(data, designs, _keeping(model, fitted.state))
            lefts.append(counted(kept, counts))
        if len(nested) > 1:
            lefts.append(counted(anew, counts))
            design += "; effects chosen anew in each fold"
            if fold.averaged is None:
                keeping = _keeping(nested[-1], fits[-1].state)
                parts = counted(cross_validate(data, designs, keeping), counts)
                error = rms(np.concatenate([part.residual_mg for part in parts]), data.planar)
                design += f", {error:.3g} mg with those found kept"
    figures = []
    for fitted, left in zip(fits, lefts, strict=True):
        residual = [part.residual_mg for part in left]
        turned = [part.angle_rad for part in left if part.angle_rad is not None]
        figures.append(
            ErrorFigures(
                residual_rms_mg=rms(data.mean_mg - fitted.prediction.predicted_mg, data.planar),
                heldout_rms_mg=rms(np.concatenate(residual), data.planar) if residual else None,
                angle_rms_deg=_rms_deg(turned),
                chi2_per_dof=fitted.chi2 / fitted.dof if data.known and fitted.dof > 0 else None,
            )
        )
    return figures, design


def _parameters(data: Observations, state: State) -> int:
    return int(data.base_seen.sum()) + sum(len(values) for values in state.values)


def _few(data: Observations, state: State) -> bool:
    """True where no dwell can be left out of the selection: few, or the others do not fix the model."""
    rows = (len(data) - 1) * (1 if np.isinf(data.fixture_rad) else 2)
    return len(data) < LEAST_CHOICE or rows < _parameters(data, state)


def _figures_of_few(
    data: Observations, nested: list[tuple[Term, ...]], fits: Sequence[Refit]
) -> tuple[list[list[Left]], str]:
    """Each dwell left out alone with the effects kept, where the others determine the final model.

    The others are too few to choose effects from: only the values are fitted anew.
    """
    singles = [np.arange(len(data)) == k for k in range(len(data))]
    model, state = nested[-1], fits[-1].state
    columns = _parameters(data, state)
    rest = [_keeping(model, state)(data.rows(~mask))[1] for mask in singles]
    if any(fit.prediction.residual.size - fit.dof < columns for fit in rest):
        return [[] for _ in nested], (
            f"the model has {columns} parameters: {len(data) - 1} dwells do not determine it, so that none "
            "could be left out"
        )
    design = f"each of {len(data)} dwells in turn, effects kept: the others are too few to choose any from"
    designs = {design: singles}
    every = {design: np.ones(len(data), dtype=bool)}
    return [
        counted(cross_validate(data, designs, _keeping(model, fitted.state)), every)
        for model, fitted in zip(nested, fits, strict=True)
    ], design


def _guarding(
    data: Observations,
    checking: Observations | None,
    selection: Selection,
    nested: list[tuple[Term, ...]],
    figures: Sequence[ErrorFigures],
    fold: _Fold,
) -> list[float | None]:
    """Held-out errors of the nested models by which the final one is chosen.

    Where there are `check` dwells these must not choose, so that folds of the others do.
    """
    if checking is None:
        return [figure.heldout_rms_mg for figure in figures]
    if _few(data, selection.fit.state) or len(nested) == 1:
        return [None for _ in nested]
    out: list[float | None] = []
    designs = folds(data)
    counts = counting(data, designs, selection.model)
    # A form that was found on all dwells knows those that are left out; an average more so.
    anew = cross_validate(data, designs, fold.chosen_anew) if fold.averaged is not None else {}
    counts = less_unknown(counts, anew) if anew else counts
    for k, (model, state) in enumerate(_starts(selection, nested, fold)):
        last = bool(anew) and k == len(nested) - 1
        left = anew if last else cross_validate(data, designs, _keeping(model, state))
        parts = counted(left, counts)
        out.append(rms(np.concatenate([part.residual_mg for part in parts]), data.planar))
    return out


def _starts(
    selection: Selection, nested: list[tuple[Term, ...]], fold: _Fold
) -> list[tuple[tuple[Term, ...], State]]:
    """Nested models with the state from which each is refitted; the averaged one without its average."""
    values = dict(zip((t.label for t in selection.model), selection.fit.state.values, strict=True))
    starts = []
    for model in nested:
        known = tuple(term for term in model if term.label in values)
        state = replace(selection.base.state, values=tuple(values[t.label] for t in known))
        starts.append((known, state))
    return starts


def _rms_deg(turned: list[Floats]) -> float | None:
    if not turned:
        return None
    wrapped = np.mod(np.concatenate(turned) + np.pi, 2 * np.pi) - np.pi
    return float(np.degrees(np.sqrt((wrapped**2).mean())))


def _active_terms(selection: Selection, terms: Sequence[Term]) -> list[Term]:
    """Candidates inside a fold: what showed promise anywhere, and the best of each name and axes."""
    promise, candidates = selection.found.promise, selection.problem.terms
    ranked = [candidates[k] for k in np.argsort(-promise)]
    active = {term.label for term in ranked[:150]} | {term.label for term in selection.model}
    seen = set()
    for term in ranked:
        if isinstance(term, NamedTerm) and (term.effect.name, term.effect.axes) not in seen:
            seen.add((term.effect.name, term.effect.axes))
            active.add(term.label)
    return [term for term in terms if term.label in active]


@dataclass(frozen=True)
class _Fold:
    """What is done anew where dwells are left out.

    Attributes
    ----------
    terms : sequence of Term
        Candidates inside a fold.
    averaged : Averaged or None
        The average on all dwells.
    max_effects : int
    """

    terms: Sequence[Term]
    averaged: Averaged | None
    max_effects: int

    def chosen_anew(self, rows: Observations) -> Fitted:
        """Model and refit of the dwells that are kept."""
        terms = [term for term in self.terms if not of_one_dwell(term, rows.conditions)]
        chosen = select(rows, terms, self.max_effects, beam=6, rounds=2)
        if self.averaged is not None:
            again = average(rows, chosen, self.averaged.candidates)
            if again is not None:
                return again.model, again.fit, chosen.model, chosen.fit
        return chosen.model, chosen.fit, chosen.model, chosen.fit


def _student(data: Observations, selection: Selection) -> float:
    """Factor by which value ± 1.96 u covers 95 % although few degrees of freedom show the noise."""
    from scipy import stats

    dof = data.noise_dof if data.known else np.inf
    if not data.known or selection.inflation > 1:
        dof = min(dof, max(selection.fit.dof, 1.0))
    return 1.0 if np.isinf(dof) else float(stats.t.ppf(0.975, max(dof, 1.0)) / stats.norm.ppf(0.975))


def _finding(selection: Selection, name: str, student: float = 1.0) -> Finding:
    from scipy import stats

    problem = selection.problem
    members = [k for k in selection.verdict.best if problem.terms[k].name == name]
    gain, width = _gain(selection, members)
    parameters: dict[str, Value] = {}
    axes: list[str] = []
    cause = ""
    at = len(selection.fit.state.base)
    between = between_models(selection, name)
    for term, values in zip(selection.model, selection.fit.state.values, strict=True):
        if isinstance(term, NamedTerm) and term.name == name:
            cause = term.effect.cause
            axes += [axis for axis in term.effect.axes if axis not in axes]
            for k, parameter in enumerate(term.effect.parameters):
                within = selection.fit.covariance[at + k, at + k] * selection.inflation
                u = student * float(np.sqrt(within + between.get(parameter.name, 0.0)))
                parameters[parameter.name] = Value(float(values[k]), u, parameter.unit)
            for choice in term.effect.choices():
                parameters[choice] = Value(float(getattr(term.effect, choice)), None, "1")
        at += len(values)
    p = float(stats.chi2.sf(gain / selection.inflation, width)) * len(problem.terms)
    same = [
        " + ".join(sorted({describe(problem.terms[k]) for k in m}))
        for m in selection.verdict.same.get(selection.verdict.best, [])
        if name not in {problem.terms[k].name for k in m}
    ]
    return Finding(
        effect=name,
        axes=tuple(axes),
        parameters=parameters,
        p_value=min(p, 1.0),
        explains=_explains(selection, gain),
        probability=selection.verdict.names.get(name, 1.0),
        equivalents=tuple(dict.fromkeys(same))[:5],
        cause=cause,
    )


def between_models(selection: Selection, name: str) -> dict[str, float]:
    """Variance of an effect's amplitudes between the probable models that hold it, by parameter.

    The covariance of one model takes for granted that it is the right one. In another that is as probable
    the effect may act on one axis only (the amplitude of the other is then zero) or stand beside something
    that shares its direction. Models whose shapes or dwells are others are left out: shapes are fitted, and
    their spread is in the covariance.
    """
    problem, verdict = selection.problem, selection.verdict
    kind = _kind(problem.terms, verdict.best, name)
    own = _amplitudes_of(problem, verdict.best, name)
    spread = dict.fromkeys(own, 0.0)
    total = 0.0
    for model, weight in verdict.weights.items():
        if weight < LEAST_WEIGHT or _kind(problem.terms, model, name) != kind:
            continue
        values = _amplitudes_of(problem, model, name)
        total += weight
        for parameter in own:
            spread[parameter] += weight * (values.get(parameter, 0.0) - own[parameter]) ** 2
    return {parameter: value / total for parameter, value in spread.items()} if total else {}


def _kind(terms: Sequence[Term], model: Sequence[int], name: str) -> tuple[object, ...]:
    """Shapes and choices of an effect in a model; the empty tuple where it is not in it."""
    mine = [terms[k] for k in model if terms[k].name == name]
    return tuple(
        (term.shapes, tuple(getattr(term.effect, choice) for choice in term.effect.choices()))
        for term in mine
        if isinstance(term, NamedTerm)
    )


def _amplitudes_of(problem: Problem, model: Sequence[int], name: str) -> dict[str, float]:
    """Amplitudes of an effect in a model of the linear problem, by parameter."""
    out: dict[str, float] = {}
    for k, own in zip(model, amplitudes(problem, model), strict=True):
        term = problem.terms[k]
        if isinstance(term, NamedTerm) and term.name == name:
            for index, value in zip(term.amplitude_index, own, strict=True):
                out[term.effect.parameters[index].name] = float(value)
    return out


def _gain(selection: Selection, members: Sequence[int]) -> tuple[float, int]:
    """χ² that some terms take beside the others of the model, and their columns."""
    best = selection.verdict.best
    with_all = float((span(selection.problem, best)[1] ** 2).sum())
    others = [k for k in best if k not in members]
    without = float((span(selection.problem, others)[1] ** 2).sum())
    return without - with_all, int(sum(selection.problem.width[k] for k in members))


def _explains(selection: Selection, gain: float) -> float:
    excess = selection.problem.chi2 - selection.problem.dof * min(selection.inflation, 1.0)
    return float(np.clip(gain / max(excess, 1e-12), 0.0, 1.0))


def _unnamed(data: Observations, selection: Selection, averaged: Averaged | None) -> Unnamed | None:
    """Nameless terms of the model; else what the residual of an inadequate model depends on."""
    from scipy import stats

    problem, verdict = selection.problem, selection.verdict
    members = [k for k in verdict.best if isinstance(problem.terms[k], NamelessTerm)]
    if members:
        terms = [problem.terms[k] for k in members]
        gain, width = _gain(selection, members)
        covariates = tuple(dict.fromkeys(c for term in terms for c in term.covariates))
        forms = [term.form for term in terms if isinstance(term, NamelessTerm)]
        return Unnamed(
            covariates=covariates,
            form="; ".join(forms),
            explains=_explains(selection, gain),
            probability=min(verdict.covariates.get(term.covariates, 0.0) for term in terms),
            p_value=min(1.0, float(stats.chi2.sf(gain / selection.inflation, width)) * len(problem.terms)),
        )
    if averaged is not None:
        smooth = averaged.smooth
        return Unnamed(
            covariates=smooth.covariates,
            form=smooth.form,
            explains=_explains(selection, selection.fit.chi2 - averaged.fit.chi2),
            probability=averaged.weight,
            p_value=min(1.0, 1 - averaged.weight),
        )
    if selection.adequate or not data.known:
        return None
    return dependence(data, selection)


def _rivals(selection: Selection) -> tuple[Rival, ...]:
    ranked = sorted(selection.verdict.weights.items(), key=lambda item: -item[1])[:8]
    terms = selection.problem.terms
    return tuple(Rival(tuple(terms[k].label for k in model), weight) for model, weight in ranked)


def _base(data: Observations, fit: Refit, inflation: float) -> dict[str, Value]:
    scale = np.sqrt(inflation)
    out = {}
    for k, (name, unit) in enumerate(BASE_PLANAR if data.planar else BASE_SPACE):
        factor = 180 / np.pi if unit == "degree" else 1.0
        u = float(np.sqrt(fit.covariance[k, k])) * scale * factor
        out[name] = Value(float(fit.state.base[k]) * factor, u if data.base_seen[k] else None, unit)
    return out


def _notes(data: Observations, selection: Selection) -> tuple[str, ...]:
    notes = list(data.notes)
    if not data.known:
        notes.append(
            "the noise of a reading is not known; it was estimated from the residual, so that adequacy "
            "cannot be tested"
        )
    elif selection.inflation > 1 and not selection.adequate:
        notes.append(
            f"no model explains the residual down to the measured noise; effects were judged against "
            f"{np.sqrt(selection.inflation):.2g} times that noise"
        )
    return tuple(notes)
