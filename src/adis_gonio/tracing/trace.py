"""`trace`: residual → missing effect → corrected model → error before and after.

Session ─ readings ─▶ candidates ─▶ selection ─▶ validation ─▶ outcome
└─ unnamed ─┘
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from adis_gonio.base.budget import attempt, current, spent, within
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.base.values import Detectable
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.parts import ACCELEROMETER, known_part, readings_of_part
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.fitting.slips import Diagnosis
from adis_gonio.fitting.slips.of_session import in_context, positions_of
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import provenance_of
from adis_gonio.tracing.candidates.grammar import nameless_terms
from adis_gonio.tracing.candidates.named import named_terms
from adis_gonio.tracing.outcome.clock import bias_at_middle
from adis_gonio.tracing.outcome.detect import detectable
from adis_gonio.tracing.outcome.findings import (
    base_of,
    finding_of,
    in_units_of_file,
    notes_of,
    rivals_of,
    scatter_finding,
    told_from_zero,
    unnamed_of,
    zeros_of,
)
from adis_gonio.tracing.outcome.naming import judge
from adis_gonio.tracing.outcome.openings import undecided
from adis_gonio.tracing.outcome.positions import as_the_angles_leave, as_the_part_stood, with_positions
from adis_gonio.tracing.outcome.result import ErrorFigures, Finding, NextDwell, Step, Stopped, TraceResult
from adis_gonio.tracing.outcome.sets import CredibleSet, credible_sets, one_a_function
from adis_gonio.tracing.outcome.shares import excesses, shares, unnamed_with_share, with_shares
from adis_gonio.tracing.selection.scatter import Scatter, with_scatter
from adis_gonio.tracing.selection.select import Selection, select
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.unnamed.averaging import Averaged, average
from adis_gonio.tracing.validation.checked import unexpected
from adis_gonio.tracing.validation.errors import Fold, error_figures, guarding, in_order, without_folds
from adis_gonio.tracing.validation.survival import checkable, never_worse, refuted, without

UNCHECKED = "the time limit ended the trace before this was checked"
"""Reason of whatever is in a model that was not validated."""
ZERO_OF_COUNTS = Detectable(None, "", "", "lies in the base model: counts have no zero of their own")
"""Of a bias in counts, which stands among the base parameters where it is not found beside them."""


def trace(
    session: Session,
    max_effects: int = 6,
    time_limit: float | None = None,
    part: str = ACCELEROMETER,
) -> TraceResult:
    """Trace the residual of a session to the effects that the seed paper's model lacks.

    Parameters
    ----------
    session : Session
        Planar (declared angles) or in space (`plane` none); one dwell with temperature is traced sample by
        sample (`adis_gonio.tracing.one_pose`).
    max_effects : int
        Most terms that the model may take on.
    time_limit : float, optional
        Seconds after which the trace ends at the next safe point with the best model so far
        (`TraceResult.stopped`); by default none, so that the answer does not depend on the machine.
    part : {"accelerometer", "gyro"}
        Part of the sensor whose readings are traced.

    Raises
    ------
    DataError
        As `adis_gonio.fitting.estimation.readings_of`.
    FitError
        Fewer readings than base parameters.
    UsageError
        A time limit that is not positive, or a part that no sensor has.
    """
    known_part(part)
    if session.free_turn and not session.dwells:
        raise FitError(
            f"{session.source or 'session'}: a free turn has no positions whose residuals a trace could"
            " follow; use fit, or measure positions (calibrate --plan tumble) and trace those"
        )
    if time_limit is None:
        result = _trace(session, max_effects, part)
    elif not time_limit > 0:
        raise UsageError(f"a time limit of {time_limit:g} s: give a positive number of seconds")
    else:
        with within(current().limited(time_limit)):
            result = _trace(session, max_effects, part)
    overrides = session.facts.get("overrides", {})
    return replace(result, provenance=provenance_of(session), overrides=overrides)


def _trace(session: Session, max_effects: int, part: str) -> TraceResult:
    own = part == ACCELEROMETER  # samples within dwells are looked at for these alone
    if own and len([dwell for dwell in session.dwells if len(dwell)]) == 1:
        from adis_gonio.tracing.one_pose.series import trace_series

        return _stamped(trace_series(session, max_effects), checked=True)
    from adis_gonio.tracing.within.second_pass import with_second_pass

    positions = positions_of(session) if own else Diagnosis()
    data = as_the_part_stood(readings_of_part(session, part), positions)
    try:
        result = trace_readings(data, max_effects, positions)
    except FitError as error:
        raise FitError(in_context(session, error)) from error
    result = with_positions(result, data, positions)
    checked = result.stopped is None or result.stopped.checked
    if own:
        result = attempt(
            "the samples inside the dwells", lambda: with_second_pass(session, data, result), result
        )
    return _stamped(result, checked=checked)


def _stamped(result: TraceResult, *, checked: bool) -> TraceResult:
    """The result with what the time limit left out."""
    budget = current()
    return replace(result, stopped=Stopped.of(budget, checked=checked)) if budget.left_out else result


def trace_readings(data: Readings, max_effects: int = 6, positions: Diagnosis | None = None) -> TraceResult:
    """Trace readings; see `trace`.

    Parameters
    ----------
    positions : Diagnosis, optional
        What is known of the positions before: effects of one dwell that cannot be, sizes of gross slips.
    """
    from adis_gonio.tracing.advice.words import advise  # next door, and it looks in here

    training, checking = data.training, data.checking
    _enough(training)
    named, missing = named_terms(training)
    if positions is not None:
        named = as_the_angles_leave(named, training, positions)
    terms: list[Term] = [*named, *nameless_terms(training)]
    measured = training
    selection, scatter = _searched(training, terms, max_effects)
    if scatter is not None:
        data = scatter.applied(data)
        checking = data.checking
    guarded = _guarded(selection, terms, max_effects)
    selection, averaged, fits, steps = guarded.selection, guarded.averaged, guarded.fits, guarded.steps
    names = checkable(judge(selection, averaged), selection)
    if scatter is not None or not selection.adequate:
        could = undecided(selection)
        if len(could) > 1:
            names = replace(names, confounded=(*names.confounded, could))
    figures, design = attempt(
        "the error on left-out dwells, effects chosen anew",
        lambda: error_figures(guarded.selection, measured, checking, guarded.fits, guarded.fold),
        without_folds(fits, measured, checking),
    )
    if current().left_out:
        final = selection if averaged is None else selection.with_fit(averaged.fit)
        open_ = [*steps, *([] if scatter is None else [scatter.kind])]
        return _unfinished(final, fits, steps, figures, design, open_)
    reported = _reported(figures) if checking is None else None
    count, names, cut = never_worse(names, steps, guarded.errors, reported, training.model.unit)
    if count < len(steps):
        # Longer models have their figures already; those of the shorter one hold for it as they are.
        fits, steps, figures = fits[: count + 1], steps[:count], figures[: count + 1]
        kept = [k for k in selection.verdict.best if selection.problem.terms[k] in fits[-1].terms]
        selection = selection.with_model(kept)
        averaged = None
    final = selection if averaged is None else selection.with_fit(averaged.fit)
    findings = [finding_of(final, name, averaged) for name in names.stand]
    places = credible_sets(selection, averaged)
    sets = tuple(one for one in places if one.present >= limits.certain)
    likelier = _likelier(sets, terms)
    weak = _weak([bias_at_middle(final, finding) for finding in findings], figures[-1], likelier, places)
    names = without(replace(names, open={**names.open, **weak}), weak)
    notes = list(notes_of(selection, scatter))
    adequate = final.adequate and scatter is None and (final.fit.dof > 0 or not training.noise_known)
    if adequate and checking is not None and averaged is None and training.noise_known:
        disagreement = _disagreement(final, checking)
        notes += disagreement
        adequate = not disagreement
    open_still = replace(selection, adequate=adequate)
    of_step = shares(steps, excesses(fits, figures))
    seen = _seen([f for f in findings if f.effect not in weak], data, scatter, of_step)
    nothing: tuple[tuple[str, ...], tuple[NextDwell, ...]] = ((), ())
    advice, measurements = attempt(
        "what to measure next", lambda: advise(data, open_still, terms, names.confounded), nothing
    )
    zeros = zeros_of(final, seen)
    return TraceResult(
        adequate=adequate and training.noise_known,
        found=seen,
        sets=one_a_function(sets, likelier),
        steps=tuple(Step(label, error) for label, error in zip(steps, figures[1:], strict=True)),
        confounded=names.confounded,
        unnamed=unnamed_with_share(unnamed_of(selection, averaged), of_step),
        before=figures[0],
        after=figures[-1],
        detectable={
            **detectable(selection.found, selection.verdict.best, missing, training.model.part),
            **({"bias": ZERO_OF_COUNTS} if len(zeros) == data.axes else {}),
        },
        advice=advice,
        measurements=measurements,
        rivals=rivals_of(selection),
        base={**base_of(final), **zeros},
        reasons={**names.open, **cut},
        notes=tuple(notes),
        heldout_design=design,
        fits=(*fits[:-1], final.fit),
        inflation=final.inflation,
    )


@dataclass(frozen=True)
class _Guarded:
    """A model, its nested models with their held-out errors, and what is done anew in a fold."""

    selection: Selection
    averaged: Averaged | None
    fold: Fold
    fits: list[Fit]
    steps: list[str]
    errors: list[float | None]

    @classmethod
    def of(cls, selection: Selection, terms: Sequence[Term], max_effects: int) -> _Guarded:
        averaged = attempt("the average of functions without a name", lambda: average(selection), None)
        fold = Fold.of(selection, terms, averaged, max_effects)
        fits, steps = in_order(selection, averaged)
        unguarded: list[float | None] = [None for _ in fits]
        errors = attempt(
            "the choice of the longest model that is never worse",
            lambda: guarding(selection, fits, fold),
            unguarded,
        )
        return cls(selection, averaged, fold, fits, steps, errors)


def _guarded(selection: Selection, terms: Sequence[Term], max_effects: int) -> _Guarded:
    """The best model whose functions without a name stand on left-out dwells.

    A function that these refute leaves the posterior: names that it stood before are judged then.
    """
    guarded = _Guarded.of(selection, terms, max_effects)
    while gone := refuted(guarded.selection, guarded.fits, guarded.errors):
        if current().left_out:
            break
        guarded = _Guarded.of(guarded.selection.without_functions(gone), terms, max_effects)
    return guarded


def _seen(
    findings: Sequence[Finding], data: Readings, scatter: Scatter | None, of_step: dict[str, float]
) -> tuple[Finding, ...]:
    """Findings in the file's units with their shares, and the scatter that takes what they leave."""
    seen = with_shares([in_units_of_file(finding, data.unit) for finding in findings], of_step)
    if scatter is None:
        return seen
    return (*seen, scatter_finding(scatter, max(1.0 - sum(of_step.values()), 0.0)))


def _searched(
    training: Readings, terms: Sequence[Term], max_effects: int
) -> tuple[Selection, Scatter | None]:
    """The chosen model, under more noise where that is the better account."""
    current().tell("the search for effects")
    first = select(training, terms, max_effects)
    if spent():
        current().leave_out("the end of the search for effects")
    plain: tuple[Selection, Scatter | None] = (first, None)
    selection, scatter = attempt(
        "scatter from dwell to dwell as a cause", lambda: with_scatter(first, terms, max_effects), plain
    )
    return selection, scatter


def _reported(figures: Sequence[ErrorFigures]) -> tuple[float, float] | None:
    """Held-out errors that stand in the result for the base model and the final one."""
    first, last = figures[0].heldout_rms, figures[-1].heldout_rms
    return None if first is None or last is None else (first, last)


def _likelier(sets: Sequence[CredibleSet], terms: Sequence[Term]) -> dict[str, str]:
    """What is likelier in the place of a name, where that is a function without one."""
    names = {term.name for term in terms}
    return {one.cause: one.names[0] for one in sets if one.names[0] not in names and one.cause in names}


def _weak(
    findings: Sequence[Finding],
    final: ErrorFigures,
    likelier: Mapping[str, str],
    places: Sequence[CredibleSet],
) -> dict[str, str]:
    """Names that do not stand after all, with the reason."""
    weak = {}
    empty = {one.cause: 1 - one.present for one in places if one.present < limits.certain}
    for finding in findings:
        if finding.effect in likelier:
            weak[finding.effect] = f"in its place is likelier: {likelier[finding.effect]}"
        elif finding.effect in empty:
            # Models that predict the same are one model; one that does so without it has nothing there.
            weak[finding.effect] = f"models with nothing in its place have {empty[finding.effect]:.0%}"
        elif final.heldout_rms is None and finding.effect != "bias":
            weak[finding.effect] = "no dwell could be left out to check it by"
        elif not told_from_zero(finding):
            weak[finding.effect] = "its values are no larger than their own uncertainty"
    return weak


def _disagreement(final: Selection, checking: Readings) -> list[str]:
    """What is to be said where dwells that took no part do not agree with the model of the others."""
    p = unexpected(final.fit, checking, final.inflation)
    if p >= limits.adequate:
        return []
    return [
        f"the {len(checking)} check dwells do not agree with the model that explains the others "
        f"(p = {p:.2g}): something is in them that the others do not show"
    ]


def _unfinished(
    final: Selection,
    fits: Sequence[Fit],
    steps: Sequence[str],
    figures: Sequence[ErrorFigures],
    design: str,
    open_: Sequence[str],
) -> TraceResult:
    """The best model so far of a trace that was not validated: its figures, and nothing found."""
    return TraceResult(
        adequate=False,
        found=(),
        steps=tuple(Step(label, error) for label, error in zip(steps, figures[1:], strict=True)),
        confounded=(),
        unnamed=None,
        before=figures[0],
        after=figures[-1],
        detectable={},
        advice=("trace again with more time, or without a limit",),
        rivals=rivals_of(final),
        base=base_of(final),
        reasons=dict.fromkeys(open_, UNCHECKED),
        heldout_design=design,
        fits=(*fits[:-1], final.fit),
        inflation=final.inflation,
        stopped=Stopped.of(current(), checked=False),
    )


def _enough(data: Readings) -> None:
    base = len(data.model.parameters)
    rows = len(data) * data.equations_each
    if rows < base:
        raise FitError(
            f"{counted(len(data), 'position')}: {rows} equations for {base} base parameters; measure at"
            f" least {counted(-(-base // max(rows // len(data), 1)), 'position')}"
        )
    if len(data) < 2:
        raise FitError("one reading alone has nothing to be compared with; measure more positions")
