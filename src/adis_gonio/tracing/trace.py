"""`trace`: residual → missing effect → corrected model → error before and after.

Session ─ readings ─▶ candidates ─▶ selection ─▶ validation ─▶ outcome
└─ unnamed ─┘
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from adis_gonio.errors import FitError
from adis_gonio.estimation.fit import Fit
from adis_gonio.estimation.readings import Readings, readings_of
from adis_gonio.estimation.terms import Term
from adis_gonio.model.records import Session
from adis_gonio.tracing.candidates.grammar import nameless_terms
from adis_gonio.tracing.candidates.named import named_terms
from adis_gonio.tracing.outcome.detect import detectable
from adis_gonio.tracing.outcome.findings import (
    base_of,
    finding_of,
    notes_of,
    rivals_of,
    scatter_finding,
    told_from_zero,
    unnamed_of,
)
from adis_gonio.tracing.outcome.naming import judge
from adis_gonio.tracing.outcome.openings import undecided
from adis_gonio.tracing.outcome.result import ErrorFigures, Step, TraceResult
from adis_gonio.tracing.outcome.sets import credible_sets
from adis_gonio.tracing.selection.scatter import with_scatter
from adis_gonio.tracing.selection.select import select
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.unnamed.averaging import average
from adis_gonio.tracing.validation.checked import unexpected
from adis_gonio.tracing.validation.errors import Fold, error_figures, guarding, in_order
from adis_gonio.tracing.validation.survival import checkable, never_worse, surviving, without


def trace(session: Session, max_effects: int = 6) -> TraceResult:
    """Trace the residual of a session to the effects that the seed paper's model lacks.

    Parameters
    ----------
    session : Session
        Planar (declared angles) or in space (`plane` none); one dwell with temperature is traced sample by
        sample (`adis_gonio.one_pose`).
    max_effects : int
        Most terms that the model may take on.

    Raises
    ------
    DataError
        As `adis_gonio.estimation.readings_of`.
    FitError
        Fewer readings than base parameters.
    """
    if len([dwell for dwell in session.dwells if len(dwell)]) == 1:
        from adis_gonio.one_pose.series import trace_series

        return trace_series(session, max_effects)
    from adis_gonio.dwells.second_pass import with_second_pass

    data = readings_of(session)
    try:
        result = trace_readings(data, max_effects)
    except FitError as error:
        raise FitError(f"{session.source}: {error}" if session.source else str(error)) from error
    return with_second_pass(session, data, result)


def trace_readings(data: Readings, max_effects: int = 6) -> TraceResult:
    """Trace readings; see `trace`."""
    from adis_gonio.advice.words import advise  # next door, and it looks in here

    training, checking = data.training, data.checking
    _enough(training)
    named, missing = named_terms(training)
    terms: list[Term] = [*named, *nameless_terms(training)]
    measured = training
    selection, scatter = with_scatter(select(training, terms, max_effects), terms, max_effects)
    if scatter is not None:
        data = scatter.applied(data)
        checking = data.checking
    names = checkable(judge(selection), selection)
    selection, names, dropped = surviving(selection, names)
    if scatter is not None or not selection.adequate:
        could = undecided(selection)
        if len(could) > 1:
            names = replace(names, confounded=(*names.confounded, could))

    averaged = average(selection)
    fold = Fold.of(selection, terms, averaged, max_effects)
    fits, steps = in_order(selection, averaged)
    figures, design = error_figures(selection, measured, checking, fits, fold)
    reported = figures[-1].heldout_rms_mg if checking is None else None
    count, names, cut = never_worse(names, steps, guarding(selection, fits, fold), reported)
    if count < len(steps):
        # Longer models have their figures already; those of the shorter one hold for it as they are.
        fits, steps, figures = fits[: count + 1], steps[:count], figures[: count + 1]
        kept = [k for k in selection.verdict.best if selection.problem.terms[k] in fits[-1].terms]
        selection = selection.with_model(kept)
        dropped, averaged = {**dropped, **cut}, None
    final = selection if averaged is None else selection.with_fit(averaged.fit)
    findings = [finding_of(final, name) for name in names.stand]
    weak = {
        finding.effect: f"its own test beside the others is p = {finding.p_value:.2g}"
        for finding in findings
        if finding.p_value > limits.significant
    }
    if figures[-1].heldout_rms_mg is None:
        weak |= {
            finding.effect: "no dwell could be left out to check it by"
            for finding in findings
            if finding.effect != "bias"
        }
    weak |= {
        finding.effect: "its values are no larger than their own uncertainty"
        for finding in findings
        if finding.effect not in weak and not told_from_zero(finding)
    }
    names = without(replace(names, open={**names.open, **weak}), weak)
    notes = list(notes_of(selection, scatter))
    adequate = final.adequate and scatter is None and (final.fit.dof > 0 or not training.noise_known)
    if adequate and checking is not None and averaged is None and training.noise_known:
        p = unexpected(final.fit, checking, final.inflation)
        if p < limits.adequate:
            adequate = False
            notes.append(
                f"the {len(checking)} check dwells do not agree with the model that explains the others "
                f"(p = {p:.2g}): something is in them that the others do not show"
            )
    open_still = replace(selection, adequate=adequate)
    sets = tuple(one for one in credible_sets(selection) if one.present >= limits.present)
    seen = tuple(finding for finding in findings if finding.effect not in weak)
    if scatter is not None:
        seen = (*seen, scatter_finding(scatter, _left_to_scatter(fits, figures)))
    advice, measurements = advise(data, open_still, terms, names.confounded)
    return TraceResult(
        adequate=adequate,
        found=seen,
        sets=sets,
        steps=tuple(Step(label, error) for label, error in zip(steps, figures[1:], strict=True)),
        confounded=names.confounded,
        unnamed=unnamed_of(selection, averaged),
        before=figures[0],
        after=figures[-1],
        detectable=detectable(selection.found, selection.verdict.best, missing),
        advice=advice,
        measurements=measurements,
        rivals=rivals_of(selection),
        base=base_of(final),
        reasons={**names.open, **dropped},
        notes=tuple(notes),
        heldout_design=design,
        fits=(*fits[:-1], final.fit),
        inflation=final.inflation,
    )


def _left_to_scatter(fits: Sequence[Fit], figures: Sequence[ErrorFigures]) -> float:
    """Share of the base model's excess over the measured noise that the final model leaves."""
    excess = [
        fit.dof * max((figure.chi2_per_dof or 1.0) - 1.0, 0.0)
        for fit, figure in zip(fits, figures, strict=True)
    ]
    return min(excess[-1] / max(excess[0], 1e-12), 1.0)


def _enough(data: Readings) -> None:
    base = len(data.model.parameters)
    rows = len(data) * (1 if data.free else 2)
    if rows < base:
        raise FitError(
            f"{len(data)} positions give {rows} equations for {base} base parameters; measure at least "
            f"{-(-base // max(rows // len(data), 1))} positions"
        )
