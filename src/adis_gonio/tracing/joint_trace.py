"""Trace several sessions of one part, board or stage as one model.

The readings of all sessions are stacked (`stack`) and traced like one session. Gains, skews and Δφ
belong to the part, the start angle to the session, and the amplitudes of an effect to all sessions or to
groups of them, by evidence (`adis_gonio.tracing.named_candidates`)::

    sessions → readings, one by one → stack → screening → trace → share of each session

The field `serial` of a session identifies its part, the field `stage` its stage. All sessions without a
`serial` count as sessions of one part, and all sessions without a `stage` as sessions on one stage.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import field, fields, replace
from pathlib import PurePath
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, solvable
from adis_gonio.base.budget import limited_to, with_progress
from adis_gonio.base.errors import AdisGonioError, FitError, UsageError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import counted
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.fitting.slips.session_positions import failure_message, positions_of
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import JointMeasurement, SessionOrigin
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import digest_of
from adis_gonio.tracing.credible_sets import cause_name, owners_of
from adis_gonio.tracing.linear_problem import Products, linearise, span
from adis_gonio.tracing.model_search import presence_probabilities, price
from adis_gonio.tracing.named_candidates import SplitEffect
from adis_gonio.tracing.selection import Selection, promising_labels, select
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.trace import TraceRun, correct_slips
from adis_gonio.tracing.trace_result import NextDwell, TraceResult
from adis_gonio.tracing.validation import held_out_alike, rms
from adis_gonio.tracing.within.samples import samples_of
from adis_gonio.tracing.within.tones import strongest_frequency

GROUPS_LEFT_OUT = 10
"""Most groups of sessions that are left out in turn."""


class SessionShare(JsonRecord):
    """One session of a joint trace: its share of the evidence, and its result alone.

    The JSON document is one entry of `sessions`.

    Attributes
    ----------
    session, part, stage : str
        Name of the session, serial number of its part and name of its stage; empty if not stated.
    dwells : int
        Number of its dwells.
    evidence : mapping of str to float
        Log likelihood in nats that its readings add for each cause of the model.
    alone : mapping of str to float
        Effects that its readings alone would show, with their probabilities; unnamed functions begin with
        `unnamed:`. The candidates are the terms that scored well in the joint trace.
    heldout_before_mg, heldout_after_mg : float or None
        Held-out error of its dwells by the base model and by the joint model, if a fifth of all dwells is
        left out in turn.
    session_before_mg, session_after_mg : float or None
        The same errors if the whole session is left out. One half of its dwells then gives its own
        parameters (start angle, its own amplitudes) for the other half.
    """

    session: str
    part: str
    stage: str
    dwells: int
    evidence: Mapping[str, float]
    alone: Mapping[str, float]
    heldout_before_mg: float | None = None
    heldout_after_mg: float | None = None
    session_before_mg: float | None = None
    session_after_mg: float | None = None


class JointResult(TraceResult):
    """Result of a joint trace: the result of a trace, with the share of each session.

    Attributes
    ----------
    sessions : tuple of SessionShare
        The sessions in the given order.
    owners : mapping of str to mapping of str to float
        For each cause, the probability of each owner of its amplitudes if the cause is present: `stage`,
        `part`, `all parts` or `session`.
    """

    document_keys: ClassVar[tuple[str, ...]] = (*TraceResult.document_keys, "sessions", "owners")

    sessions: tuple[SessionShare, ...] = ()
    owners: dict[str, dict[str, float]] = field(default_factory=dict)

    def calibration(self) -> Any:
        """Raise `FitError`: a calibration is of one session."""
        raise FitError("a joint trace gives no calibration: fit or trace one session of the part")


@solvable
def trace_sessions(
    sessions: Sequence[Session], max_effects: int = 6, time_limit: float | None = None
) -> JointResult:
    """Trace the residual of several sessions to the effects that the base model lacks, as one model.

    Parameters
    ----------
    sessions : sequence of Session
        Two sessions or more, all in a plane or all in space, with accelerometer readings of known unit.
    max_effects : int
        Largest number of terms added to the base model.
    time_limit : float, optional
        Seconds after which the trace ends at the next safe point with the best model found by then.

    Raises
    ------
    DataError, FitError
        A session has no readings, or too few.
    UsageError
        Fewer than two sessions, two with the same samples, sessions that cannot be joined, or a time
        limit that is not positive.
    """
    first: dict[str, str] = {}
    for one in sessions:
        digest = digest_of(one)
        if digest in first:
            raise UsageError(
                f"{one.source} holds the same samples as {first[digest]}: give only one of them"
            )
        first[digest] = one.source
    if len(sessions) < 2:
        raise UsageError("a joint trace needs two sessions or more; use `trace` for one session")
    names = [PurePath(one.source).name.split(".")[0] or one.title or "session" for one in sessions]
    if len(set(names)) < len(names):  # a name occurs twice: each gets the number of its session
        names = [f"{name}-{k}" for k, name in enumerate(names, 1)]
    origins = [
        SessionOrigin(name, one.serial, one.stage) for name, one in zip(names, sessions, strict=True)
    ]
    with limited_to(time_limit):
        return trace_stacked([reduced(one) for one in sessions], origins, max_effects)


def reduced(session: Session) -> Readings:
    """Return the readings of one session for a joint trace, with angles corrected for lasting slips.

    If a spectral line moves through the session, its frequency is among the conditions.
    """
    try:
        data = correct_slips(readings_of(session), positions_of(session))
    except FitError as error:
        raise FitError(failure_message(session, error)) from error
    if (~data.check).sum() < 2:  # one half of its dwells has to predict the other half
        raise FitError(f"{session.source or 'session'}: a joint trace needs two positions to fit or more")
    samples = samples_of(session, data)
    line_hz = None if samples is None else strongest_frequency(samples, data.position)
    return replace(data, conditions=replace(data.conditions, line_hz=line_hz))


def trace_stacked(
    readings: Sequence[Readings], origins: Sequence[SessionOrigin], max_effects: int = 6
) -> JointResult:
    """Trace readings of several sessions as one model.

    Parameters
    ----------
    readings : sequence of Readings
        Readings of each session.
    origins : sequence of SessionOrigin
        Part and stage of each session.
    max_effects : int
        Largest number of terms added to the base model.
    """
    run = JointRun(stack(readings, origins), max_effects)
    result = run.traced()
    return result if isinstance(result, JointResult) else JointResult(**vars(result))


class JointRun(TraceRun):
    """A trace of stacked readings in progress."""

    def __init__(self, data: Readings, max_effects: int) -> None:
        super().__init__(data, max_effects, ())
        self.terms = screen(self.measured, self.terms, max_effects)

    def advice(self, selection: Selection) -> tuple[tuple[str, ...], tuple[NextDwell, ...]]:
        """Return no advice: the next dwells belong to one session."""
        return (), ()

    def finished(self) -> TraceResult:
        """Return the result of a completed trace, with the sessions' shares and the causes' owners."""
        result = super().finished()
        origins = self.data.model.origins
        parts, stages = ({getattr(one, name) for one in origins} for name in ("part", "stage"))
        several = len(parts) > 1
        unstated = " (sessions that do not state one share it)" if "" in parts | stages else ""
        note = (
            f"{counted(len(origins), 'session')} of {counted(len(parts), 'part')} on"
            f" {counted(len(stages), 'stage')}, by `serial` and `stage` of the files{unstated}"
        )
        return JointResult(
            **vars(replace(result, notes=(*result.notes, note))),
            sessions=self._shares(),
            owners={
                one.cause: owners_of(self.selection, one.cause, lambda t: owner_of(t, several=several))
                for one in self.sets
            },
        )

    def _shares(self) -> tuple[SessionShare, ...]:
        """Return for each session its evidence on each cause, its own causes, and its held-out errors."""
        data = self.measured
        session = _session(data)
        # Log likelihood in nats that each cause of the model adds in each session.
        problem, best = self.selection.problem, self.selection.verdict.best
        of_row = np.repeat(session, len(problem.target) // len(data))
        _, full = span(problem, best)
        evidence: dict[str, list[float]] = {}
        for cause in dict.fromkeys(cause_name(problem.terms[k]) for k in best):
            _, without = span(problem, [k for k in best if cause_name(problem.terms[k]) != cause])
            gain = 0.5 * (without**2 - full**2) / self.selection.inflation
            evidence[cause] = [float(gain[of_row == k].sum()) for k in range(len(data.model.origins))]
        compared = self.fits[0], self.fits[-1]
        models = [(self.fold, self.selection.data, fit) for fit in compared]
        dwells = [left[0].residual for left in held_out_alike(models, compared[1].terms)[0]]
        whole = [left_out_sessions(fit) for fit in compared]
        by_axis = data.by_axis
        out = []
        for k, origin in enumerate(with_progress(data.model.origins)):
            rows = session == k
            errors = [rms(residual[rows], by_axis) for residual in (*dwells, *whole)]
            gained = {cause: own[k] for cause, own in evidence.items()}
            names = (origin.label, origin.part, origin.stage)
            out.append(SessionShare(*names, int(rows.sum()), gained, self._causes_alone(rows), *errors))
        return tuple(out)

    def _causes_alone(self, rows: NDArray[np.bool_]) -> dict[str, float]:
        """Return the causes that one session alone would show, with their probabilities.

        `rows` (n,) is the mask of its dwells. The candidates are the terms that scored well in the joint
        trace.
        """
        own = replace(self.measured.rows(rows), fitted=None)
        whole = [
            term
            for term in self.fold.terms
            if not (isinstance(term, NamedTerm) and isinstance(term.effect, SplitEffect))
        ]
        try:
            chosen = select(own, whole, self.max_effects, limits.fold_explored, limits.fold_rounds)
        except AdisGonioError:
            return {}
        present = presence_probabilities(chosen.problem.terms, chosen.verdict.weights, cause_name)
        ranked = sorted(present.items(), key=lambda item: -item[1])
        return {cause: p for cause, p in ranked if p >= limits.open_level}


def _session(data: Readings) -> NDArray[np.intp]:
    session = data.conditions.session
    return np.zeros(len(data), dtype=np.intp) if session is None else session.astype(np.intp)


def owner_of(term: Term, *, several: bool) -> str:
    """Return the owner of a term's amplitudes: `stage`, `part`, `all parts` or `session`.

    `several` is True if the sessions are of several parts.
    """
    if isinstance(term, NamedTerm) and isinstance(term.effect, SplitEffect):
        return term.effect.sharing.by
    if term.enters_angle:
        return "stage"
    return "all parts" if several else "part"


def screen(data: Readings, terms: Sequence[Term], max_terms: int) -> list[Term]:
    """Return the most promising candidates, since a search with all candidates takes long.

    Beginning with a bias, the best term is added to the model up to `max_terms` times. The function keeps
    the `limits.screened` candidates that would improve any of these models most, the best candidate of each
    effect on each combination of axes, and every bias.
    """
    begun = Fit.begin(data).refit()
    free = [term for term in terms if term.constant and term.prior_sd is None]
    if not free:
        return list(terms)
    bias = max((t for t in free if isinstance(t, NamedTerm)), key=lambda term: len(term.amplitudes))
    about = begun.with_terms([bias], [np.zeros(len(bias.amplitudes))]).refit()
    problem = linearise(about, terms)
    prices, products = price(problem), Products(problem, problem)
    model = [k for k, term in enumerate(problem.terms) if term is bias]
    promise = np.full(len(problem.terms), -np.inf)
    for _ in range(max_terms):
        gains = 0.5 * products.extensions(model)[2] - prices
        promise = np.maximum(promise, gains)
        best = int(gains.argmax())
        if gains[best] <= 0:
            break
        model.append(best)
    kept = promising_labels(problem.terms, promise, limits.screened, by_sharing=True)
    return [term for term in terms if term.label in kept]


def left_out_sessions(fit: Fit) -> Floats:
    """Return residuals (n, axes) of each session under the model fitted to the other sessions.

    Parameters that the other sessions do not show (a start angle, the session's own amplitudes) are fitted
    to one half of its dwells, every second one, to predict the other half.
    """
    data = fit.data
    session = _session(data)
    # Every second dwell of each session, by its number in the session.
    halves = (np.arange(len(data)) - np.searchsorted(session, session)) % 2 == 0
    groups = min(len(data.model.origins), GROUPS_LEFT_OUT)
    out = np.full(data.mean.shape, np.nan)
    for group in range(groups):
        inside = session % groups == group
        trained = fit.again(data.rows(~inside))
        unseen = np.asarray(~np.abs(trained.jacobian).any(axis=0))
        for near, far in ((inside & halves, inside & ~halves), (inside & ~halves, inside & halves)):
            # Fit the unseen parameters to the near half; the remaining parameters stay fixed.
            begun = Fit.begin(data.rows(near))
            base = np.where(unseen[: len(begun.values.base)], begun.values.base, trained.values.base)
            own = replace(trained, values=replace(trained.values, base=base)).on(begun.data)
            own = own.refit(within=np.eye(len(unseen))[:, unseen]) if unseen.any() else own
            out[far] = own.on(data.rows(far)).misfit
    return out


def stack(each: Sequence[Readings], origins: Sequence[SessionOrigin]) -> Readings:
    """Join the readings `each` of several sessions; the sessions of one part share base parameters.

    `origins` has part, stage and label of each session. The rows keep the number of their session
    (`Conditions.session`). Noise that dwells share is independent between sessions. A covariate that a
    session did not record is dropped.

    Raises
    ------
    UsageError
        Sessions of different kinds, in counts, with different uncertainties of the declared angles, or only
        some with a known noise.
    """
    first = each[0]
    for one, origin in zip(each, origins, strict=True):
        for same, what in (
            (one.axes == first.axes, "one plane and attitudes in space"),
            (one.fixture_rad == first.fixture_rad, "different uncertainties of the declared angles"),
            (one.unit.known, "readings in counts"),
            (one.noise_known == first.noise_known, "readings with and without a known noise"),
        ):
            if not same:
                raise UsageError(
                    f"{origin.label}: a joint trace cannot join {what}; trace this session alone, or state"
                    " one --fixture, --unit or reading_u_mg for all"
                )
    if len(each) == 1:
        return first
    session = np.repeat(np.arange(len(each)), [len(one) for one in each])
    joined: dict[str, Any] = {}
    by_row = ("mean", "own_covariance", "dof", "angle_rad", "check", "position", "samples")
    for name in (*by_row, "quantization", "flicker"):
        rows = [getattr(one, name) for one in each]
        # Averaged readings do not state the parts of their noise.
        joined[name] = None if any(own is None for own in rows) else np.concatenate(rows)
    return replace(
        first,
        **joined,
        conditions=_conditions([one.conditions for one in each], session),
        slow=_modes([one.slow for one in each], range(len(each))),
        stage=_modes([one.stage for one in each], [one.stage or k for k, one in enumerate(origins)]),
        flicker_shown=any(one.flicker_shown for one in each),
        pooled=all(one.pooled for one in each),
        notes=tuple(dict.fromkeys(note for one in each for note in one.notes)),
        measurement=JointMeasurement([one.model for one in each], origins, session),
        converter=None,
        links=None,
        fitted=None,
    )


def _conditions(each: Sequence[Conditions], session: NDArray[np.intp]) -> Conditions:
    """Join the conditions of several sessions; `session` (n,) is the number of the session of each dwell.

    The order of the dwells is counted through all sessions, and histories (such as temperatures over time)
    are put on one common clock. A condition that a session did not record is dropped.
    """
    made: dict[str, Any] = {}
    for name in (one.name for one in fields(Conditions)):
        values = [getattr(one, name) for one in each]
        if any(value is None for value in values):
            continue
        if name.endswith("_history"):
            clocks = [replace(one, session=np.full(len(one), float(k))) for k, one in enumerate(each)]
            shifts = [one.clock_s[0] - one.time_s[0] for one in clocks]
            times = np.concatenate([time + shift for (time, _), shift in zip(values, shifts, strict=True)])
            made[name] = times, np.concatenate([value for _, value in values])
        else:
            made[name] = np.concatenate(values)
    made["session"] = session.astype(float)
    if "order" in made:
        made["order"] = np.arange(float(len(session)))
    return Conditions(**made)


def _modes(each: Sequence[Floats], owners: Iterable[Hashable]) -> Floats:
    """Join the modes (n, axes, k) of errors that the dwells of each session share.

    A mode is an independent error that acts on several readings. Sessions with one owner of the modes (such
    as a stage) share them if they have equally many.
    """
    n, start = sum(map(len, each)), 0
    blocks: dict[tuple[Hashable, int], Floats] = {}
    for modes, owner in zip(each, owners, strict=True):
        block = blocks.setdefault((owner, modes.shape[2]), np.zeros((n, *modes.shape[1:])))
        block[start : start + len(modes)] = modes
        start += len(modes)
    return np.concatenate([*blocks.values()], axis=2)
