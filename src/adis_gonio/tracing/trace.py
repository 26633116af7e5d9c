"""Trace a session: residual → missing effect → corrected model → error before and after.

The stages of the trace and their modules::

    session → readings → candidates → selection → validation → findings → advice
                  named_candidates, grammar ┘           └ averaging (unnamed part)

The declared angle, gravity and the gyros give three estimates of each position. An effect of a single dwell
(`position_slip`, `outlier_dwell`) that these angles rule out is not a candidate. If they show a
`position_slip` that is too large for the linear problem, its candidate starts at that size. A large slip
that lasts for all following dwells is corrected before the search, and the result reports it. A smaller
lasting slip competes, as a step of the true angle, with other causes that turn the part.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from adis_gonio.base.arrays import solvable
from adis_gonio.base.budget import attempt, current, limited_to, spent
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.numbers import counted, format_p, format_percent, signed
from adis_gonio.base.uncertainty import Detectable
from adis_gonio.fitting.estimation.readings import ACCELEROMETER, Readings, known_part, readings_of_part
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.fitting.slips.session_positions import (
    PositionFinding,
    failure_message,
    positions_of,
    sentences_of,
)
from adis_gonio.model.effects import catalogue
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import provenance_of
from adis_gonio.tracing import findings, validation
from adis_gonio.tracing.averaging import average
from adis_gonio.tracing.credible_sets import CredibleSet, credible_sets, judge, merge_by_function, undecided
from adis_gonio.tracing.grammar import nameless_terms
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.scatter import Scatter, compete_with_unknown, with_scatter
from adis_gonio.tracing.selection import Selection, select
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.trace_result import (
    ErrorFigures,
    Finding,
    NextDwell,
    Step,
    Stopped,
    TraceResult,
    Unnamed,
)
from adis_gonio.tracing.what_if import FREE, AskedModel, compare, heldout_by_size

UNCHECKED = "the time limit ended the trace before this was checked"
"""Reason that the result gives for each term of a model that was not validated."""
ZERO_OF_COUNTS = Detectable(None, "", "", "lies in the base model: counts have no zero of their own")
"""Entry of `detectable` for a bias of readings in counts, which is a base parameter and no finding."""


@solvable
def trace(
    session: Session,
    max_effects: int = 6,
    time_limit: float | None = None,
    part: str = ACCELEROMETER,
    include: str | Sequence[str] = (),
    exclude: str | Sequence[str] = (),
    only: bool = False,
) -> TraceResult:
    """Trace the residual of a session to the effects that the base model lacks.

    Parameters
    ----------
    session : Session
        Planar (declared angles) or in space (`plane` none); a session of one dwell with temperature is
        traced over time (`adis_gonio.tracing.one_pose`).
    max_effects : int
        Largest number of terms added to the base model.
    time_limit : float, optional
        Seconds after which the trace ends at the next safe point with the best model found by then
        (`TraceResult.stopped`). By default there is no limit, so the result does not depend on the machine.
    part : {"accelerometer", "gyro"}
        The traced readings: of the accelerometers or the gyros.
    include : str or sequence of str
        What if these terms are in the model: effects such as `quadratic:x`, or formulas such as
        `mine_x = (T - 25)**2 * gx` (`tracing.what_if`). The result compares the model with the best model
        (`TraceResult.what_if`).
    exclude : str or sequence of str
        What if the model has none of the effects with these names.
    only : bool
        True: the model has the terms of `include` and no other.

    Raises
    ------
    DataError
        No readings can be made from the dwells (see `adis_gonio.fitting.estimation.readings.readings_of`).
    FitError
        Fewer readings than base parameters.
    UsageError
        A time limit that is not positive, a part that no sensor has, or a term or name of a what-if that is
        unknown or that the session cannot show.
    """
    known_part(part)
    request = AskedModel.of(include, exclude, only)
    if session.free_turn and not session.dwells:
        raise FitError(
            f"{session.source or 'session'}: a free turn has no positions with residuals that a trace could"
            " follow; use fit, or measure positions (calibrate --plan tumble) and trace those"
        )
    with limited_to(time_limit):
        result = _trace(session, max_effects, part, request)
    overrides = session.facts.get("overrides", {})
    return replace(result, provenance=provenance_of(session), overrides=overrides)


def _trace(session: Session, max_effects: int, part: str, request: AskedModel) -> TraceResult:
    """Trace a session within the time limit that is in force; see `trace` for the parameters."""
    own = part == ACCELEROMETER  # only accelerometer samples are searched inside the dwells
    if own and len([dwell for dwell in session.dwells if len(dwell)]) == 1:
        from adis_gonio.tracing.one_pose import trace_series

        if request:
            raise UsageError(
                f"{session.source or 'session'}: --with, --without and --only need dwells in several poses"
            )
        return with_time_left_out(trace_series(session, max_effects), checked=True)
    from adis_gonio.tracing.within.second_pass import with_second_pass

    positions = positions_of(session) if own else ()
    data = correct_slips(readings_of_part(session, part), positions)
    try:
        result = trace_readings(data, max_effects, positions, request)
    except FitError as error:
        raise FitError(failure_message(session, error)) from error
    result = with_positions(result, data, positions)
    checked = result.stopped is None or result.stopped.checked
    if own:
        result = attempt(
            "the samples inside the dwells", lambda: with_second_pass(session, data, result), result
        )
    return with_time_left_out(result, checked=checked)


def with_time_left_out(result: TraceResult, *, checked: bool) -> TraceResult:
    """Return the result with a record of the stages that the time limit ended or skipped, if any.

    `checked` is True if the validation of the result was completed.
    """
    budget = current()
    return replace(result, stopped=Stopped.of(budget, checked=checked)) if budget.left_out else result


def trace_readings(
    data: Readings,
    max_effects: int = 6,
    positions: Sequence[PositionFinding] = (),
    request: AskedModel = FREE,
) -> TraceResult:
    """Trace readings to the causes of their residual.

    Parameters
    ----------
    data : Readings
        Readings of all dwells.
    max_effects : int
        Largest number of terms added to the base model.
    positions : sequence of PositionFinding
        Wrong positions found before: effects of single dwells to exclude, sizes of large slips.
    request : AskedModel
        Terms and names that the user puts into the model or takes out of it.
    """
    if not request:
        return TraceRun(data, max_effects, positions).traced()
    asked = TraceRun(data, max_effects, positions, request)  # this first: it checks the request
    free = TraceRun(data, max_effects, positions)
    free.traced()
    return replace(asked.traced(), what_if=compare(free, asked, request))


class TraceRun:
    """A trace of readings in progress; each method is one stage.

    Attributes
    ----------
    data, measured : Readings
        `data` has the readings of all dwells; their noise includes the dwell-to-dwell scatter, if there is
        any. `measured` has the readings without check dwells, with the measured noise.
    terms, missing : list of Term, mapping of str to Detectable
        Candidate terms; for each effect that is not a candidate, the reason.
    selection, scatter : Selection, Scatter or None
        The chosen model; the dwell-to-dwell scatter under which it was chosen, None without scatter.
    averaged : AveragedFit or None
        Average over unnamed functions, used instead of the chosen unnamed function; None if not needed.
    fits, steps, errors, figures
        Nested fits from the base model to the chosen model; the name of the term added at each step; the
        held-out errors that choose the longest acceptable model; the error figures of the result.
    forced, closed : list of str, bool
        Names of the terms that the user put into every model; True if no other term is searched.
    shortened : bool
        True if the result has fewer terms than the chosen model.
    names : Names
        Accepted, rejected and confounded names of the model.
    findings : list of Finding
        Findings for the accepted names.
    """

    def __init__(
        self,
        data: Readings,
        max_effects: int,
        positions: Sequence[PositionFinding],
        request: AskedModel = FREE,
    ) -> None:
        self.data, self.measured, self.max_effects = data, data.training, max_effects
        refuse_too_few(self.measured)
        named, self.missing = named_terms(self.measured)
        named = restrict_candidates(named, self.measured, positions)
        self.terms: list[Term] = [*named, *nameless_terms(self.measured)]
        self.closed = request.only
        if request:
            self.terms, self.max_effects = request.candidates(self.measured, self.terms, max_effects)
            gone = catalogue(data.model.part) if request.only else request.exclude
            self.missing |= dict.fromkeys(gone, Detectable(None, "", "", "left out of the model as asked"))
        self.forced = [term.name for term in self.terms if term.forced and term.name is not None]

    def traced(self) -> TraceResult:
        """Go through all stages and return the result."""
        self.search()
        self.drop_harmful_functions()
        self.judge_names()
        self.measure_errors()
        if current().left_out:
            return self.unfinished()
        self.shorten()
        self.judge_findings()
        return self.finished()

    @property
    def final(self) -> Selection:
        """The selection for the result: the chosen model, with averaged unnamed functions if any."""
        return self.selection if self.averaged is None else self.selection.with_fit(self.averaged)

    @property
    def judged(self) -> Selection:
        """The chosen model, with the posterior probabilities by which its causes are accepted or rejected.

        If no model is adequate, an unknown cause competes with all models in this posterior.
        """
        judge, best = self.weighed, self.selection.verdict.best
        verdict = replace(judge.verdict, best=best)
        return replace(self.selection, problem=judge.problem, found=judge.found, verdict=verdict)

    def search(self) -> None:
        """Choose a model of the readings; include dwell-to-dwell scatter if this is more probable."""
        current().tell("the search for effects")
        first = select(self.measured, self.terms, self.max_effects)
        if spent():
            current().leave_out("the end of the search for effects")
        found: tuple[Selection, Scatter | None] = (first, None)
        if not self.closed:
            found = attempt(
                "scatter from dwell to dwell as a cause",
                lambda: with_scatter(first, self.terms, self.max_effects),
                found,
            )
        self.selection, self.scatter = found
        if self.scatter is not None:
            self.data = self.scatter.applied(self.data)
        self.checking = self.data.checking

    def drop_harmful_functions(self) -> None:
        """Remove unnamed functions that make the prediction of held-out dwells worse, and choose again.

        A removed function has no posterior probability any more, so the names that it competed with gain.
        If the best model without the functions predicts held-out dwells worse than the shorter model with
        them, the functions stay, and the model will be shortened.
        """
        self.nest(self.selection)
        while gone := validation.harmful_functions(self.selection, self.fits, self.errors):
            if current().left_out:
                break
            before = dict(vars(self))
            least = min(self.errors[len(self.forced) :], default=math.inf)
            self.nest(self.selection.without_functions(gone))
            if self.errors and self.errors[-1] > limits.worse * least:
                vars(self).update(before)
                break

    def nest(self, selection: Selection) -> None:
        """Store a selection, fit its nested models (each one term longer), and compute held-out errors."""
        self.selection = selection
        self.averaged = attempt(
            "the average of functions without a name",
            lambda: None if self.closed else average(selection),
            None,
        )
        # Inside a fold, the candidates are the terms that scored well on all dwells.
        promising = selection.promising(self.terms)
        self.fold = validation.Fold(promising, self.averaged, self.max_effects)
        self.fits, self.steps = validation.nest_fits(selection, self.averaged)
        self.errors: list[float] = attempt(
            "the choice of the longest model that is never worse",
            lambda: validation.guard_errors(selection, self.fits, self.fold),
            [],
        )

    def judge_names(self) -> None:
        """Accept or reject each named effect of the model by its probability.

        If the model is not adequate, also list the effects that could explain the unexplained part.
        """
        self.weighed = self.selection
        if self.scatter is None and not self.final.adequate:
            self.weighed = attempt(
                "an unknown cause as an alternative",
                lambda: compete_with_unknown(self.selection, self.max_effects),
                self.selection,
            )
        self.names = validation.reject_unchecked(judge(self.weighed, self.averaged), self.selection)
        if self.scatter is not None or not self.selection.adequate:
            could = undecided(self.selection)
            if len(could) > 1:
                self.names = replace(self.names, confounded=(*self.names.confounded, could))

    def measure_errors(self) -> None:
        """Compute the errors of the nested models on held-out dwells.

        The effects of the final model are chosen again without each fold.
        """
        self.figures, self.design = attempt(
            "the error on held-out dwells, effects chosen again",
            lambda: validation.error_figures(
                self.selection, self.measured, self.checking, self.fits, self.fold
            ),
            validation.without_folds(self.fits, self.measured, self.checking),
        )

    def shorten(self) -> None:
        """Cut the model to the longest nested model with a held-out error that is not worse.

        Not worse means at most `limits.worse` times the held-out error of any shorter model.
        """
        least, unit = len(self.forced), self.measured.model.unit
        reported = reported_errors(self.figures[least:]) if self.checking is None else None
        count, self.names = validation.cut_worse_steps(
            self.names, self.steps, self.errors, reported, unit, least
        )
        self.shortened = count < len(self.steps)
        if self.shortened:
            # All nested models already have their figures, so the longer ones are only dropped.
            self.fits, self.figures = self.fits[: count + 1], self.figures[: count + 1]
            self.steps = self.steps[:count]
            terms, inside = self.selection.problem.terms, self.fits[-1].terms
            self.selection = self.selection.with_model(
                [k for k in self.selection.verdict.best if terms[k] in inside]
            )
            self.averaged = None

    def judge_findings(self) -> None:
        """Turn accepted names into findings, reject weak findings, and test the model on `check` dwells."""
        final, noise_known = self.final, self.measured.noise_known
        judged = self.judged
        # Counts have no zero of their own: their bias is a base parameter, and not a finding.
        # A forced term was asked for, and not found.
        own = {*self.forced, *(() if self.data.unit.known else ("bias",))}
        accepted = [n for n in self.names.accepted if n not in own]
        seen = [findings.finding_of(final, name, self.averaged, judged) for name in accepted]
        places = credible_sets(judged, self.averaged)
        known = {term.name for term in self.terms}
        self.sets = tuple(
            one
            for one in places
            if one.cause not in self.forced
            and one.present >= limits.certain
            and (one.names[0] in known or self.functions_checked)
        )
        self.likelier = likelier_functions(self.sets, self.terms)
        equals = {name: findings.probability_of_equals(judged, name, self.averaged) for name in accepted}
        weak = weak_names(seen, self.figures[-1], self.likelier, equals)
        self.names = validation.reject_names(self.names, weak)
        self.findings = [finding for finding in seen if finding.effect not in weak]
        self.notes = list(findings.notes_of(self.selection, self.scatter))
        plain = all(term.constant for term in final.terms)
        tested = final.fit.dof >= (1 if plain else limits.least_checks) or not noise_known
        self.adequate = final.adequate and self.scatter is None and tested
        if self.adequate and self.checking is not None and noise_known:
            disagreement = disagreement_of(final, self.checking)
            self.notes += disagreement
            self.adequate = not disagreement

    @property
    def functions_checked(self) -> bool:
        """True if there are at least `limits.least_choice` dwells, so that folds can check functions."""
        return len(self.measured) >= limits.least_choice

    def unnamed(self, of_step: Mapping[str, float]) -> Unnamed | None:
        """Return the unnamed part of the model as a record for the result; None without such a part.

        `of_step` has the share of the base model's excess χ² that each step removes. If no fold could check
        the unnamed part, its probability is limited to the threshold for accepting a name.
        """
        found = findings.unnamed_of(self.selection, self.averaged, self.judged)
        if found is None:
            return None
        known, most = catalogue(), 1.0 if self.functions_checked else limits.certain
        explains = sum((share for name, share in of_step.items() if name not in known), 0.0)
        return replace(found, explains=explains, probability=min(found.probability, most))

    def finished(self) -> TraceResult:
        """Return the result of a completed trace, with advice for the next session."""
        selection, final = self.selection, self.final
        of_step = findings.shares(self.steps, findings.excesses(self.fits, self.figures))
        seen = shown_findings(self.findings, self.data, self.scatter, of_step)
        nothing: tuple[tuple[str, ...], tuple[NextDwell, ...]] = ((), ())
        open_still = replace(selection, adequate=self.adequate)
        advice, measurements = attempt(
            "what to measure next",
            lambda: self.advice(open_still),
            nothing,
        )
        zeros = findings.zeros_of(final)
        part = self.measured.model.part
        return self._result(
            adequate=self.adequate and self.measured.noise_known,
            found=seen,
            sets=merge_by_function(self.sets, self.likelier),
            confounded=self.names.confounded,
            unnamed=self.unnamed(of_step),
            detectable={
                **findings.detectable(selection.found, selection.verdict.best, self.missing, part),
                **({"bias": ZERO_OF_COUNTS} if len(zeros) == self.data.axes else {}),
            },
            advice=advice,
            measurements=measurements,
            base={**findings.base_of(final), **zeros},
            further_terms=partial(heldout_by_size, selection, self.fits, self.fold, self.checking),
            reasons=self.names.rejected,
            notes=tuple(self.notes),
        )

    def advice(self, selection: Selection) -> tuple[tuple[str, ...], tuple[NextDwell, ...]]:
        """Return advice for the next session, as sentences and as proposed dwells.

        `selection` has the chosen model, and states if it is adequate.
        """
        from adis_gonio.tracing.proposals import advise

        return advise(self.data, selection, self.terms, self.names.confounded)

    def unfinished(self) -> TraceResult:
        """Return the result of a trace that was not validated: errors of the best model, no findings."""
        open_ = [*self.steps, *([] if self.scatter is None else [self.scatter.kind])]
        return self._result(
            adequate=False,
            found=(),
            advice=("trace again with more time, or without a limit",),
            base=findings.base_of(self.final),
            reasons=dict.fromkeys(open_, UNCHECKED),
            stopped=Stopped.of(current(), checked=False),
        )

    def _result(self, **others: Any) -> TraceResult:
        """Return a result with the steps, errors and fits of the nested models.

        `others` are the remaining fields of `TraceResult`.
        """
        final, steps = self.final, zip(self.steps, self.figures[1:], strict=True)
        return TraceResult(
            steps=tuple(Step(label, error) for label, error in steps),
            before=self.figures[0],
            after=self.figures[-1],
            rivals=findings.rivals_of(self.selection),
            heldout_design=self.design,
            fits=(*self.fits[:-1], final.fit),
            inflation=final.inflation,
            **others,
        )


def shown_findings(
    found: Sequence[Finding], data: Readings, scatter: Scatter | None, of_step: dict[str, float]
) -> tuple[Finding, ...]:
    """Return the findings for the result, in the file's units and with the share that each explains.

    `of_step` are these shares by effect. Scatter, if any, is the last finding, with the remaining share.
    """
    stated = (findings.in_units_of_file(finding, data.unit) for finding in found)
    seen = tuple(replace(finding, explains=of_step.get(finding.effect, 0.0)) for finding in stated)
    if scatter is None:
        return seen
    return (*seen, findings.scatter_finding(scatter, max(1.0 - sum(of_step.values()), 0.0)))


def reported_errors(figures: Sequence[ErrorFigures]) -> tuple[float, float] | None:
    """Return the held-out errors of the base model and of the final model; None if not measured.

    `figures` are the errors of the nested models, the base model first.
    """
    first, last = figures[0].heldout_rms, figures[-1].heldout_rms
    return None if first is None or last is None else (first, last)


def likelier_functions(sets: Sequence[CredibleSet], terms: Sequence[Term]) -> dict[str, str]:
    """Map each named cause to the unnamed function that is more probable in its place, if any.

    `sets` are the credible sets of the causes, `terms` all candidate terms.
    """
    names = {term.name for term in terms}
    return {one.cause: one.names[0] for one in sets if one.names[0] not in names and one.cause in names}


def weak_names(
    found: Sequence[Finding], final: ErrorFigures, likelier: Mapping[str, str], equals: Mapping[str, float]
) -> dict[str, str]:
    """Return the effects that must not be reported as found, each with the reason.

    Parameters
    ----------
    found : sequence of Finding
        Findings for the accepted names.
    final : ErrorFigures
        Errors of the final model.
    likelier : mapping of str to str
        For each name that an unnamed function replaces with higher probability, this function.
    equals : mapping of str to float
        For each name, the probability of the other names that predict the same in its place.
    """
    weak = {}
    for finding in found:
        probability = finding.probability + equals.get(finding.effect, 0.0)
        if finding.effect in likelier:
            weak[finding.effect] = f"more probable in its place: {likelier[finding.effect]}"
        elif probability < limits.certain:
            # Models with equal predictions count as one model, which may have this name although most of
            # them have a function or nothing in its place.
            weak[finding.effect] = (
                f"other names or none in its place have {format_percent(1 - probability)}"
            )
        elif final.heldout_rms is None and finding.effect != "bias":
            weak[finding.effect] = "no dwell could be held out to check it"
        elif not findings.differs_from_zero(finding):
            weak[finding.effect] = "its values are no larger than their own uncertainty"
    return weak


def disagreement_of(final: Selection, checking: Readings) -> list[str]:
    """Return a note if the check dwells contradict the final model, in a list; else an empty list."""
    p = validation.disagreement_p_value(final.fit, checking, final.inflation)
    if p >= limits.adequate:
        return []
    return [
        f"the {len(checking)} check dwells do not agree with the model that explains the others "
        f"({format_p(p)}): they show an effect that the others do not"
    ]


def refuse_too_few(data: Readings) -> None:
    """Raise `FitError` if there are fewer equations than base parameters."""
    base = len(data.model.parameters)
    rows = len(data) * data.equations_each
    if rows < base:
        raise FitError(
            f"{counted(len(data), 'position')}: {rows} equations for {base} base parameters; measure at"
            f" least {counted(-(-base // max(rows // len(data), 1)), 'position')}"
        )
    if len(data) < 2:
        raise FitError("one reading alone has nothing to be compared with; measure more positions")


_MOVED = frozenset({"mistyped", "misset", "swapped"})


def correct_slips(data: Readings, positions: Sequence[PositionFinding]) -> Readings:
    """Return readings whose declared angles are corrected for large slips that last for the later dwells.

    The stage's dial and its errors are unaffected by a slip, so `Conditions.angle_rad` does not change.
    `positions` has the slips that were found.
    """
    moved_deg = np.zeros(len(data))
    for found in _large_slips(data, positions):
        moved_deg[np.isin(data.position, [found.position, *found.others])] += found.error_deg[0]
    return replace(data, angle_rad=data.angle_rad + np.radians(moved_deg)) if moved_deg.any() else data


def _large_slips(data: Readings, positions: Sequence[PositionFinding]) -> list[PositionFinding]:
    """Return the slips that last for the later dwells and are too large for the linearised model.

    The criterion is in `_out_of_reach`.
    """
    return [f for f in positions if f.finding == "slipped" and _out_of_reach(data, f)]


def _out_of_reach(data: Readings, found: PositionFinding) -> bool:
    """Return True if the declared angle of a dwell is too wrong for the linearised model.

    If a dwell is off by δ, its reading along the declared direction is G (1 − cos δ) shorter than the
    linear term predicts (2 mg at 4°). The error is too large if that difference exceeds the reading's
    uncertainty.
    """
    shorter = data.gravity_mg * (1 - math.cos(math.radians(found.error_deg[0])))
    return shorter > math.sqrt(float(np.median(data.variance_of_mean)))


def restrict_candidates(
    terms: Sequence[NamedTerm], data: Readings, positions: Sequence[PositionFinding]
) -> list[NamedTerm]:
    """Return the candidates `terms` without effects of single dwells that the found positions exclude.

    The candidates of large slips get the size of the slip as the start value of the fit.

    A dwell with a correct reading is not a candidate for `outlier_dwell`. A dwell at its declared
    position is not a candidate for `position_slip`.
    """
    order = data.conditions.order
    if order is None:
        return list(terms)
    of_position = dict(zip(data.position.tolist(), order.tolist(), strict=True))
    # Keys: whether the effect turns the sensor (a slip) or changes the reading (an outlier), and its dwell.
    excluded: set[tuple[bool, int | None]] = set()
    begins: dict[tuple[bool, int | None], float] = {}
    for found in positions:
        if found.position not in of_position:
            continue  # a check dwell
        names = {named.name for named in found.names}
        number = int(of_position[found.position])
        if found.finding in _MOVED and "gravity_wrong" not in names:
            excluded.add((False, number))
        if names == {"gravity_wrong"}:
            excluded.add((True, number))
        if found.finding in _MOVED and _out_of_reach(data, found):
            # ψ = α − θ: a part turned further by e has a slip of −e.
            begins[True, number] = -found.error_deg[0]
    return [
        replace(term, begins=begins.get(key, 0.0))
        for term in terms
        if (key := (term.enters_angle, term.dwell)) not in excluded
    ]


def with_positions(
    result: TraceResult, data: Readings, positions: tuple[PositionFinding, ...]
) -> TraceResult:
    """Return the result with the findings on wrong positions, and advice to correct these first."""
    if not positions:
        return result
    corrected = [
        f"traced as the part stood: {signed(found.error_deg[0], 2)}° from position {found.position} on,"
        " whose uncertainty is not in these figures"
        for found in _large_slips(data, positions)
    ]
    mended = [found.correction for found in positions if found.correction is not None]
    repeated = [
        f"{found.position} to {found.others[-1]}" if found.others else str(found.position)
        for found in positions
        if found.correction is None
    ]
    advice = []
    if mended:
        each = dict.fromkeys(part for text in mended for part in text.split(","))
        advice.append(f"look at what was written down; then trace again with --angles {','.join(each)}")
    if repeated:
        advice.append(f"repeat position {', '.join(repeated)}")
    return replace(
        result,
        position_findings=positions,
        notes=(*result.notes, *sentences_of(positions), *corrected),
        advice=(*advice, *result.advice),
    )
