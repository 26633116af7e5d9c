"""Result of a trace: findings, steps, rivals, unnamed part, errors before and after, advice."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import field
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from adis_gonio.base.budget import Budget
from adis_gonio.base.jsonable import (
    HIDDEN,
    INLINE,
    NAMED_BY_UNIT,
    OPTIONAL,
    JsonRecord,
    finite,
    key,
)
from adis_gonio.base.tables import Entries, ParameterTable, lines_of
from adis_gonio.base.uncertainty import Detectable, Value
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import ACCELEROMETER, GYRO
from adis_gonio.fitting.slips.session_positions import PositionFinding, listed
from adis_gonio.model.effects import catalogue
from adis_gonio.model.effects.sensor_terms import REFERENCE_C
from adis_gonio.record.provenance import Provenance
from adis_gonio.tracing.credible_sets import CredibleSet
from adis_gonio.tracing.within.samples import WithinFinding

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration, GyroCalibration
    from adis_gonio.tracing.trace_figures import Views
    from adis_gonio.tracing.what_if import BestOfSize, WhatIf


class ErrorFigures(JsonRecord):
    """Errors of a model, as root mean squares: on fitted dwells, on held-out dwells, and of the angle.

    The JSON document is the keys of `error.before`.

    Attributes
    ----------
    residual_rms : float
        Residual of the fitted dwells: reading minus model, in `unit`.
    heldout_rms : float or None
        Reading minus model at the attitude that fits the dwell best, over the held-out dwells; None if no
        dwell was held out.
    angle_rms_deg : float or None
        Angle computed from the reading minus declared angle, over the held-out dwells; None without
        declared angles or held-out dwells.
    chi2_per_dof : float or None
        χ² of the residual against the measured noise, per degree of freedom. None if the noise of a
        reading is unknown or no degree of freedom remains.
    heldout_by_axis : mapping of str to float or None
        Held-out error of each axis, for a single pose and for gyros (no common attitude of their axes);
        None for other sessions.
    heldout_kept : float or None
        Held-out error of the final model if its effects are kept in each fold and only their values are
        fitted again; None if not computed. `heldout_rms` then refers to effects that were chosen again in
        each fold.
    unit : str
        Unit of the readings, which ends the JSON names (`residual_rms_mg`).
    """

    residual_rms: float = field(metadata=NAMED_BY_UNIT)
    heldout_rms: float | None = field(metadata=NAMED_BY_UNIT)
    angle_rms_deg: float | None
    chi2_per_dof: float | None
    heldout_by_axis: dict[str, float] | None = field(default=None, metadata=NAMED_BY_UNIT | OPTIONAL)
    heldout_kept: float | None = field(default=None, metadata=NAMED_BY_UNIT | OPTIONAL)
    unit: str = field(default="mg", metadata=HIDDEN)


class Finding(JsonRecord):
    """A named effect that the trace added to the model.

    The JSON document is one entry of `found`.

    Attributes
    ----------
    effect : str
        Name of the effect in the catalogue.
    axes : tuple of str
        Letters of the axes on which it acts; empty for an effect without axes.
    parameters : mapping of str to Value
        Parameters of the effect by name.
    p_value : float
        p-value of the group score test in the final model, times the number of candidates, at most 1.
    explains : float
        Share of the base model's excess χ² (beyond its degrees of freedom) that the effect removes; 0 for
        an effect that was found only inside dwells.
    probability : float
        Posterior probability that the effect is present; for an effect found only inside dwells, computed
        from the p-value.
    equivalents : tuple of str
        Other models with equal predictions in this session, as texts.
    cause : str
        Cause of the effect in one sentence.
    """

    effect: str
    axes: tuple[str, ...]
    parameters: dict[str, Value]
    p_value: float
    explains: float
    probability: float
    equivalents: tuple[str, ...] = ()
    cause: str = ""


class Unnamed(JsonRecord):
    """Structure in the residual that no named effect explains.

    The JSON document is the value of `unnamed`.

    Attributes
    ----------
    covariates : tuple of str
        Covariates that the structure depends on: angle, time, order, temperature, temperature_rate,
        supply, approach, previous_angle, reading, variance.
    form : str
        Formula in words.
    explains : float
        Share of the base model's excess χ² (beyond its degrees of freedom) that the structure explains.
    probability : float
        Posterior probability that the residual depends on these covariates.
    p_value : float
        p-value of the structure, corrected for the number of functions that were tried.
    """

    covariates: tuple[str, ...]
    form: str
    explains: float
    probability: float
    p_value: float


class Step(JsonRecord):
    """An effect added to the model; one entry of `steps` in the JSON.

    Attributes
    ----------
    effect : str
        Name of the effect, or description of an unnamed function.
    error : ErrorFigures
        Errors of the model after the effect was added.
    """

    effect: str
    error: ErrorFigures = field(metadata=INLINE)


Purpose = Literal["decide", "cover"]


class NextDwell(JsonRecord):
    """A proposed dwell after the session, which separates two hypotheses about the model.

    The JSON document is one entry of `measurements`. A place that may be proposed has the defaults of the
    fields from `separation` on.

    Attributes
    ----------
    angle_deg : float or None
        Angle to declare; None in space.
    direction : tuple of 3 float or None
        In space: reading of an ideal sensor there, in units of local gravity; None in a plane.
    approach : {1, -1, 0}
        Direction from which the angle is to be reached: +1 from below, -1 from above, 0 from either.
    wait_s : float
        Waiting time before the dwell, in addition to the usual time between two dwells.
    separation : float
        Expected difference of the reading between the two hypotheses, in standard uncertainties of the
        measurement, beyond the difference that earlier proposed dwells show.
    information : float
        Expected information about the true model in nats, given the earlier proposed dwells.
    purpose : {"decide", "cover"}
        To decide which of the probable models is true, or to look for an effect that this session could
        not have shown.
    separates : tuple of 2 tuple of str
        Effects that only the first of the two hypotheses contains, and effects of only the second; one of
        the two may be empty.
    sentence : str
        The proposal in words.
    """

    angle_deg: float | None
    direction: tuple[float, float, float] | None
    approach: int = 0
    wait_s: float = 0.0
    separation: float = 0.0
    information: float = 0.0
    purpose: Purpose = "decide"
    separates: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    sentence: str = ""


class Stopped(JsonRecord):
    """Record that the time limit ended a trace early.

    The JSON document is the value of `stopped`.

    Attributes
    ----------
    limit_s, elapsed_s : float
        The time limit, and the time after which the trace ended, both in s.
    left_out : tuple of str
        Names of the stages that ended early or did not begin.
    checked : bool
        True if the validation was completed; else the result contains no findings.
    """

    document_keys = ("limit_s", "elapsed_s", "left_out", "checked", "sentence")

    limit_s: float
    elapsed_s: float
    left_out: tuple[str, ...]
    checked: bool

    @classmethod
    def of(cls, budget: Budget, *, checked: bool) -> Stopped:
        """Return the record of the stages that a time limit (`budget`) has ended or skipped.

        `checked` is True if the validation was completed.
        """
        return cls(budget.limit_s, budget.elapsed_s, tuple(budget.left_out), checked)

    @property
    def sentence(self) -> str:
        """A sentence that reports the time limit and the stages that it ended or skipped."""
        if self.checked:
            outcome = "what is called found was checked"
        else:
            outcome = "this is the best model so far, not validated, and nothing is called found"
        limit = f"The time limit of {self.limit_s:g} s ended the trace"
        return f"{limit}: {outcome}; left out: {', '.join(self.left_out)}."


class Rival(JsonRecord):
    """Another probable model; one entry of `rivals` in the JSON.

    Attributes
    ----------
    terms : tuple of str
        Terms that the model adds to the base model.
    probability : float
        Posterior probability of the model.
    """

    terms: tuple[str, ...]
    probability: float


class TraceResult(ParameterTable):
    """Result of tracing a session.

    Attributes
    ----------
    adequate : bool
        True if the residual of the final model agrees with the noise measured within the dwells; False if
        this was not tested (see `adequacy`).
    found : tuple of Finding
        Named effects that were found.
    steps : tuple of Step
        Terms added to the base model, in this order.
    before, after : ErrorFigures
        Errors of the base model and of the final model.
    confounded : tuple of tuple of str
        Effects, or an effect and unnamed forms, that this session cannot distinguish.
    unnamed : Unnamed or None
        Structure in the residual that no named effect explains; None if there is none.
    detectable : mapping of str to Detectable
        For each effect, the smallest amplitude that would have been found with 90 % probability.
    advice : tuple of str
        Sentences about further measurements.
    rivals : tuple of Rival
        Models of high posterior probability, the most probable first.
    base : mapping of str to Value
        Base parameters of the final model.
    reasons : mapping of str to str
        For each effect that is confounded or rejected, the reason.
    notes : tuple of str
        Remarks on noise, positions and dwells, one sentence each.
    within : tuple of WithinFinding
        Findings in the samples inside the dwells.
    heldout_design : str
        Description of the dwells that were held out to measure the error.
    sets : tuple of CredibleSet
        For each cause in the model, the names that could replace it.
    measurements : tuple of NextDwell
        Proposed further dwells for a program or a running session, in order of priority.
    fits : tuple of Fit
        Fit of the base model, then of the model after each step; not in the JSON and not compared. Empty
        for a single pose.
    views : Views or None
        Data of the residual figures of a single pose; None for other sessions, whose figures come from
        `fits`. Not in the JSON and not compared.
    further_terms : callable
        Returns a list of `BestOfSize`: the best model of each number of terms, with its held-out error. Not
        in the JSON and not compared.
    inflation : float
        Factor on the measured noise variance for the stated uncertainties; above 1 if it does not explain
        the residual.
    stopped : Stopped or None
        Stages that the time limit ended or skipped; None if the trace was completed.
    provenance : Provenance or None
        Origin of the readings; None if no session was given.
    overrides : mapping
        Metadata that replaced values of the session's file, old and new (`session.overrides`).
    position_findings : tuple of PositionFinding
        Positions that differ from their declaration (`adis_gonio.fitting.slips`).
    what_if : WhatIf or None
        Comparison with the best model; None if the user put no term into the model and took none out.
    """

    document_keys: ClassVar[tuple[str, ...]] = (
        *("adequate", "adequacy", "found", "steps", "sets", "confounded", "unnamed", "error", "detectable"),
        *("advice", "measurements", "rivals", "base", "reasons", "notes", "within", "heldout_design"),
        *("reference_temperature_c", "stopped", "overrides", "what_if"),
    )

    adequate: bool
    found: tuple[Finding, ...]
    steps: tuple[Step, ...]
    before: ErrorFigures
    after: ErrorFigures
    confounded: tuple[tuple[str, ...], ...] = ()
    unnamed: Unnamed | None = None
    detectable: dict[str, Detectable] = field(default_factory=dict)
    advice: tuple[str, ...] = field(default=(), metadata=key("next"))
    rivals: tuple[Rival, ...] = ()
    base: dict[str, Value] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    within: tuple[WithinFinding, ...] = ()
    heldout_design: str = ""
    sets: tuple[CredibleSet, ...] = ()
    measurements: tuple[NextDwell, ...] = ()
    fits: tuple[Fit, ...] = field(default=(), repr=False, compare=False)
    views: Views | None = field(default=None, repr=False, compare=False)
    further_terms: Callable[[], list[BestOfSize]] = field(default=list, repr=False, compare=False)
    inflation: float = 1.0
    stopped: Stopped | None = None
    provenance: Provenance | None = field(default=None, repr=False, compare=False)
    overrides: dict[str, Any] = field(default_factory=dict)
    position_findings: tuple[PositionFinding, ...] = ()
    what_if: WhatIf | None = field(default=None, metadata=OPTIONAL)

    def __repr__(self) -> str:
        found = ", ".join(finding.effect for finding in self.found) or "no effect"
        return f"TraceResult(found {found}; {self.adequacy})"

    @property
    def tested(self) -> bool:
        """True if the final model could be tested against the measured noise.

        This needs a known noise and more readings than parameters.
        """
        return self.after.chi2_per_dof is not None

    @property
    def adequacy(self) -> Literal["adequate", "not adequate", "not tested"]:
        """Verdict that states if the final model's residual agrees with the noise within the dwells."""
        if not self.tested:
            return "not tested"
        return "adequate" if self.adequate else "not adequate"

    def calibration(self) -> Calibration | GyroCalibration:
        """Return the calibration by the final model: of readings to angles, or of gyro readings to rates.

        Effects that depend only on the reading (for gyros: the rate and the force), the temperature or the
        supply are corrected. Effects of the bench are listed as not corrected.

        Raises
        ------
        UsageError
            The result was made from readings, not from a session.
        FitError
            The trace is of a single pose, or was ended by its time limit before validation.
        SessionError
            A write of offsets to the sensor was interrupted.
        """
        from adis_gonio.tracing import trace_calibrations

        if self.part == GYRO:
            return trace_calibrations.gyro_calibration_of_trace(self)
        return trace_calibrations.calibration_of_trace(self)

    @property
    def part(self) -> str:
        """The traced part of the sensor: `accelerometer` or `gyro`."""
        return self.fits[-1].data.model.part if self.fits else ACCELEROMETER

    @property
    def dof(self) -> float:
        """Degrees of freedom of the noise estimate behind the uncertainties; inf if the noise is known."""
        return next((value.dof for value in self.base.values() if value.u is not None), math.inf)

    @property
    def reference_temperature_c(self) -> float | None:
        """Temperature in °C at which the parameters are valid; None if it was not recorded.

        It is 25 °C if the model contains an effect of temperature, else the mean temperature of the dwells.
        """
        if any("temperature" in c for fit in self.fits[-1:] for term in fit.terms for c in term.covariates):
            return REFERENCE_C
        recorded = self.fits[-1].data.conditions.temperature_c if self.fits else None
        if recorded is None:
            known = catalogue()
            named = [known[finding.effect] for finding in self.found if finding.effect in known]
            return REFERENCE_C if any("temperature" in kind.covariates for kind in named) else None
        return float(recorded.mean())

    def summary(self) -> str:
        """Return a text with the outcome, the errors before and after, and the effects' parameters."""
        from adis_gonio.tracing import trace_summary as words

        return "\n".join([words.headline(self), words.gains(self), *lines_of(self._of_effects)])

    def __str__(self) -> str:
        return self.summary()

    @property
    def _of_effects(self) -> list[tuple[str, dict[str, Any]]]:
        return [(name, one.as_dict()) for found in self.found for name, one in found.parameters.items()]

    def caption_and_parameters(self) -> tuple[str, Entries]:
        """Return the summary as a caption, and the parameters of the base model and the effects."""
        return self.summary(), [*finite(self.base).items(), *self._of_effects]

    @property
    def error(self) -> dict[str, ErrorFigures]:
        """Errors of the base model (`before`) and of the final model (`after`)."""
        return {"before": self.before, "after": self.after}

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document that the command `trace` prints."""
        other = {} if self.part == ACCELEROMETER else {"part": self.part}
        return {**other, **super().as_dict(), **listed(self.position_findings)}
