"""What a trace says: findings, steps, rivals, the unnamed rest, errors before and after, advice."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from adis_gonio.base.budget import Budget
from adis_gonio.base.errors import FitError
from adis_gonio.base.jsonable import (
    HIDDEN,
    INLINE,
    NAMED_BY_UNIT,
    OPTIONAL,
    JsonRecord,
    finite,
    json_object,
)
from adis_gonio.base.tables import Entries, ParameterTable, lines_of
from adis_gonio.base.uncertainty import Detectable, Value
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.parts import ACCELEROMETER, GYRO
from adis_gonio.fitting.slips.position_diagnosis import PositionFinding, listed
from adis_gonio.model.effects import catalogue
from adis_gonio.model.effects.sensor_terms import REFERENCE_C
from adis_gonio.record.provenance import Provenance
from adis_gonio.tracing.credible_sets import CredibleSet
from adis_gonio.tracing.within.samples import WithinFinding

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration, GyroCalibration


@dataclass(frozen=True)
class ErrorFigures(JsonRecord):
    """How well a model does.

    The JSON document is the keys of `error.before`.

    Attributes
    ----------
    residual_rms : float
        Residual of the dwells that were fitted, in `unit`.
    heldout_rms : float or None
        Reading minus model at the attitude that fits the dwell best, over dwells that took no part.
    angle_rms_deg : float or None
        Angle from the reading by the calibrated goniometer minus declared angle, over these dwells.
    chi2_per_dof : float or None
        None where the noise of a reading is not known or no degree of freedom is left.
    heldout_by_axis : mapping of str to float or None
        The held-out error axis by axis, where one pose is traced sample by sample, or axes have nothing in
        common (gyros).
    heldout_kept : float or None
        Of the final model, where `heldout_rms` is that of effects chosen anew in each fold: the same
        dwells left out with its effects kept and only their values fitted anew.
    unit : str
        Of the readings: it ends the names in the JSON (`residual_rms_mg`).
    """

    residual_rms: float = field(metadata=NAMED_BY_UNIT)
    heldout_rms: float | None = field(metadata=NAMED_BY_UNIT)
    angle_rms_deg: float | None
    chi2_per_dof: float | None
    heldout_by_axis: dict[str, float] | None = field(default=None, metadata=NAMED_BY_UNIT | OPTIONAL)
    heldout_kept: float | None = field(default=None, metadata=NAMED_BY_UNIT | OPTIONAL)
    unit: str = field(default="mg", metadata=HIDDEN)


@dataclass(frozen=True)
class Finding(JsonRecord):
    """One named effect that the trace added.

    The JSON document is one entry of `found`.

    Attributes
    ----------
    effect : str
    axes : tuple of str
    parameters : mapping of str to Value
    p_value : float
        Of the effect in the final model (group score test), times the number of candidates, at most 1.
    explains : float
        Fraction of the base model's excess residual; 0 for an effect that stands inside the dwells only.
    probability : float
        Posterior that the effect is present; of one inside the dwells 1 less its p-value.
    equivalents : tuple of str
        Models that predict the same in this session.
    cause : str
        In one sentence.
    """

    effect: str
    axes: tuple[str, ...]
    parameters: dict[str, Value]
    p_value: float
    explains: float
    probability: float
    equivalents: tuple[str, ...] = ()
    cause: str = ""


@dataclass(frozen=True)
class Unnamed(JsonRecord):
    """Structure that has no name.

    The JSON document is the value of `unnamed`.

    Attributes
    ----------
    covariates : tuple of str
        What it depends on: angle, time, order, temperature, temperature_rate, supply, approach,
        previous_angle, reading, variance.
    form : str
        Formula in words.
    explains : float
        Fraction of the base model's excess residual.
    probability : float
        Posterior of these covariates.
    p_value : float
    """

    covariates: tuple[str, ...]
    form: str
    explains: float
    probability: float
    p_value: float


@dataclass(frozen=True)
class Step(JsonRecord):
    """One term as it came in. The JSON document is one entry of `steps`."""

    effect: str
    error: ErrorFigures = field(metadata=INLINE)


Purpose = Literal["decide", "cover"]


@dataclass(frozen=True)
class NextDwell:
    """One more dwell that is worth while.

    Attributes
    ----------
    angle_deg : float or None
        Angle to declare; None in space.
    direction : tuple of 3 float or None
        In space: what an ideal sensor would read there, in units of G.
    approach : {1, -1, 0}
        Direction of travel in which the angle is reached; 0 does not matter.
    wait_s : float
        How long to wait before it, beside the usual time between two dwells.
    temperature_c, supply_v : float or None
        Temperature and supply that are wanted; None as they are.
    separation : float
        Expected difference of the two in standard uncertainties of what is measured, beyond what the
        measurements before it part already.
    information : float
        Expected information about what is true, in nats, given the measurements before it.
    purpose : {"decide", "cover"}
        Which of the models near the best is true, or whether something is there that the session could
        not have shown.
    one, other : tuple of str
        What is told apart: effects that only one of the two models has. One of them may be empty.
    sentence : str
    """

    angle_deg: float | None
    direction: tuple[float, float, float] | None
    approach: int
    wait_s: float
    temperature_c: float | None
    supply_v: float | None
    separation: float
    information: float
    purpose: Purpose
    one: tuple[str, ...]
    other: tuple[str, ...]
    sentence: str = ""

    def as_dict(self) -> dict[str, Any]:
        """One entry of `measurements`."""
        return json_object(
            angle_deg=self.angle_deg,
            direction=self.direction,
            approach=self.approach,
            wait_s=self.wait_s,
            temperature_c=self.temperature_c,
            supply_v=self.supply_v,
            separation=self.separation,
            information=self.information,
            purpose=self.purpose,
            separates=[self.one, self.other],
            sentence=self.sentence,
        )


@dataclass(frozen=True)
class Stopped(JsonRecord):
    """What the time limit did to a trace.

    The JSON document is the value of `stopped`.

    Attributes
    ----------
    limit_s, elapsed_s : float
        The limit, and the time after which the trace ended.
    left_out : tuple of str
        Stages that ended early or were not begun.
    checked : bool
        Whether validation was complete: what is called found then stands. Nothing is, where it was not.
    """

    document_keys = ("limit_s", "elapsed_s", "left_out", "checked", "sentence")

    limit_s: float
    elapsed_s: float
    left_out: tuple[str, ...]
    checked: bool

    @classmethod
    def of(cls, budget: Budget, *, checked: bool) -> Stopped:
        """What a budget has left out."""
        return cls(budget.limit_s, budget.elapsed_s, tuple(budget.left_out), checked)

    @property
    def sentence(self) -> str:
        """One sentence."""
        if self.checked:
            outcome = "what is called found was checked"
        else:
            outcome = "this is the best model so far, not validated, and nothing is called found"
        limit = f"The time limit of {self.limit_s:g} s ended the trace"
        return f"{limit}: {outcome}; left out: {', '.join(self.left_out)}."


@dataclass(frozen=True)
class Rival(JsonRecord):
    """A model near the best: its terms, and its posterior. The JSON document is one entry of `rivals`."""

    terms: tuple[str, ...]
    probability: float


@dataclass(frozen=True)
class TraceResult(ParameterTable):
    """The trace of a session.

    Attributes
    ----------
    adequate : bool
        The final model leaves no more than the noise that was measured within the dwells; False if this
        was not tested (see `adequacy`).
    found : tuple of Finding
    steps : tuple of Step
    confounded : tuple of tuple of str
        Effects, or an effect and nameless forms, that this session cannot tell apart.
    unnamed : Unnamed or None
    before, after : ErrorFigures
    detectable : mapping of str to Detectable
    advice : tuple of str
    rivals : tuple of Rival
        Models near the best, the best first.
    base : mapping of str to Value
        Base parameters of the final model.
    reasons : mapping of str to str
        Why an effect is confounded or not called found.
    notes : tuple of str
    within : tuple of WithinFinding
        What the samples inside the dwells show.
    heldout_design : str
        How dwells were left out.
    sets : tuple of CredibleSet
        For each cause of the model the names that could stand in its place.
    measurements : tuple of NextDwell
        Advice in figures, for a program or a running session: further dwells, in the order in which they
        are worth while.
    fits : tuple of Fit
        The base model, then the model after each step, fitted; no part of the JSON, nor of a comparison.
        Empty where one pose is traced sample by sample.
    inflation : float
        Factor on the noise variance at which uncertainties are stated.
    stopped : Stopped or None
        What the time limit left out, where it ended the trace.
    provenance : Provenance or None
        Where the readings come from; None where no session was given.
    overrides : mapping
        What was stated otherwise than in the session's file, old and new (`session.overrides`).
    position_findings : tuple of PositionFinding
        Positions that are not where they were declared (`adis_gonio.fitting.slips`).
    """

    adequate: bool
    found: tuple[Finding, ...]
    steps: tuple[Step, ...]
    confounded: tuple[tuple[str, ...], ...]
    unnamed: Unnamed | None
    before: ErrorFigures
    after: ErrorFigures
    detectable: dict[str, Detectable]
    advice: tuple[str, ...]
    rivals: tuple[Rival, ...] = ()
    base: dict[str, Value] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    within: tuple[WithinFinding, ...] = ()
    heldout_design: str = ""
    sets: tuple[CredibleSet, ...] = ()
    measurements: tuple[NextDwell, ...] = ()
    fits: tuple[Fit, ...] = field(default=(), repr=False, compare=False)
    inflation: float = 1.0
    stopped: Stopped | None = None
    provenance: Provenance | None = field(default=None, repr=False, compare=False)
    overrides: dict[str, Any] = field(default_factory=dict)
    position_findings: tuple[PositionFinding, ...] = ()

    def __repr__(self) -> str:
        found = ", ".join(finding.effect for finding in self.found) or "no effect"
        return f"TraceResult(found {found}; {self.adequacy})"

    @property
    def tested(self) -> bool:
        """True if the session has readings to spare and a known noise, so that its model could fail."""
        return self.after.chi2_per_dof is not None

    @property
    def adequacy(self) -> Literal["adequate", "not adequate", "not tested"]:
        """Outcome of the test of the final model against the noise within the dwells."""
        if not self.tested:
            return "not tested"
        return "adequate" if self.adequate else "not adequate"

    def calibration(self) -> Calibration | GyroCalibration:
        """What turns readings into angles by the final model; of gyros, into rates of turn.

        Effects that are functions of the reading (of gyros: the rate and the force), the temperature or the
        supply are corrected; what belongs to the bench is listed as not corrected.

        Raises
        ------
        UsageError
            The result was made from readings, not from a session.
        FitError
            One pose only, a trace that its time limit ended before it was checked, or another part.
        SessionError
            A write of offsets to the sensor was interrupted.
        """
        if self.part == GYRO:
            from adis_gonio.fitting.gyros.gyro_fit import gyro_calibration_as_it_is
            from adis_gonio.tracing.trace_calibrations import estimates_of_gyro_trace

            return gyro_calibration_as_it_is(estimates_of_gyro_trace(self), self.provenance)
        if self.part != ACCELEROMETER:
            raise FitError(f"no calibration is made of a trace of the part {self.part}")
        from adis_gonio.tracing.trace_calibrations import calibration_of_trace

        return calibration_of_trace(self)

    @property
    def part(self) -> str:
        """Part of the sensor that was traced."""
        return self.fits[-1].data.model.part if self.fits else ACCELEROMETER

    @property
    def dof(self) -> float:
        """Degrees of freedom of the noise at which uncertainties are stated; inf where unlimited."""
        return next((value.dof for value in self.base.values() if value.u is not None), math.inf)

    @property
    def reference_temperature_c(self) -> float | None:
        """Temperature at which the parameters hold.

        25 °C where an effect of the temperature is in the model, else the mean of the dwells; None where it
        was not recorded.
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
        """What was found and what it brings, as `trace` begins, and the parameters of the effects."""
        from adis_gonio.tracing import trace_summary as words

        return "\n".join([words.headline(self), words.gains(self), *lines_of(self._of_effects)])

    def __str__(self) -> str:
        return self.summary()

    @property
    def _of_effects(self) -> list[tuple[str, dict[str, Any]]]:
        return [(name, one.as_dict()) for found in self.found for name, one in found.parameters.items()]

    def caption_and_parameters(self) -> tuple[str, Entries]:
        """Summary, and the parameters of the base model and the effects."""
        return self.summary(), [*finite(self.base).items(), *self._of_effects]

    def as_dict(self) -> dict[str, Any]:
        """The JSON document of `trace`."""
        other = {} if self.part == ACCELEROMETER else {"part": self.part}
        return json_object(
            **other,
            adequate=self.adequate,
            adequacy=self.adequacy,
            found=self.found,
            steps=self.steps,
            sets=self.sets,
            confounded=self.confounded,
            unnamed=self.unnamed,
            error={"before": self.before, "after": self.after},
            detectable=self.detectable,
            next=self.advice,
            measurements=self.measurements,
            rivals=self.rivals,
            base=self.base,
            reasons=self.reasons,
            notes=self.notes,
            within=self.within,
            heldout_design=self.heldout_design,
            reference_temperature_c=self.reference_temperature_c,
            stopped=self.stopped,
            overrides=self.overrides,
            **listed(self.position_findings),
        )


__all__ = [
    "Detectable",
    "ErrorFigures",
    "Finding",
    "Rival",
    "Step",
    "Stopped",
    "TraceResult",
    "Unnamed",
    "Value",
    "WithinFinding",
]
