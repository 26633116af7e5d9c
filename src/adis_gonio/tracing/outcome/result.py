"""What a trace says: findings, steps, rivals, the unnamed rest, errors before and after, advice."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from adis_gonio.base.budget import Budget
from adis_gonio.base.errors import FitError
from adis_gonio.base.tables import html_table, lines_of, parameter_frame
from adis_gonio.base.values import Detectable, Value, finite_or_none
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.parts import ACCELEROMETER, GYRO
from adis_gonio.fitting.slips.finding import PositionFinding, listed
from adis_gonio.model.effects.environment import REFERENCE_C
from adis_gonio.record.provenance import Provenance
from adis_gonio.tracing.outcome.sets import CredibleSet
from adis_gonio.tracing.within.finding import WithinFinding

if TYPE_CHECKING:
    from pandas import DataFrame

    from adis_gonio.calibrate import Calibration, GyroCalibration


@dataclass(frozen=True)
class ErrorFigures:
    """How well a model does.

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

    residual_rms: float
    heldout_rms: float | None
    angle_rms_deg: float | None
    chi2_per_dof: float | None
    heldout_by_axis: dict[str, float] | None = None
    heldout_kept: float | None = None
    unit: str = "mg"

    def as_dict(self) -> dict[str, Any]:
        """The keys of `error.before`; errors by axis where there are any."""
        by_axis, unit = self.heldout_by_axis, self.unit
        return {
            f"residual_rms_{unit}": finite_or_none(self.residual_rms),
            f"heldout_rms_{unit}": finite_or_none(self.heldout_rms),
            "angle_rms_deg": finite_or_none(self.angle_rms_deg),
            "chi2_per_dof": finite_or_none(self.chi2_per_dof),
            **({} if by_axis is None else {f"heldout_by_axis_{unit}": dict(by_axis)}),
            **({} if self.heldout_kept is None else {f"heldout_kept_{unit}": self.heldout_kept}),
        }


@dataclass(frozen=True)
class Finding:
    """One named effect that the trace added.

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

    def as_dict(self) -> dict[str, Any]:
        """One entry of `found`."""
        return {
            "effect": self.effect,
            "axes": list(self.axes),
            "parameters": {name: value.as_dict() for name, value in self.parameters.items()},
            "p_value": self.p_value,
            "explains": self.explains,
            "probability": self.probability,
            "equivalents": list(self.equivalents),
            "cause": self.cause,
        }


@dataclass(frozen=True)
class Unnamed:
    """Structure that has no name.

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

    def as_dict(self) -> dict[str, Any]:
        """The value of `unnamed`."""
        return {
            "covariates": list(self.covariates),
            "form": self.form,
            "explains": self.explains,
            "probability": self.probability,
            "p_value": self.p_value,
        }


@dataclass(frozen=True)
class Step:
    """One term as it came in."""

    effect: str
    error: ErrorFigures

    def as_dict(self) -> dict[str, Any]:
        """One entry of `steps`."""
        return {"effect": self.effect, **self.error.as_dict()}


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
        return {
            "angle_deg": self.angle_deg,
            "direction": None if self.direction is None else list(self.direction),
            "approach": self.approach,
            "wait_s": self.wait_s,
            "temperature_c": self.temperature_c,
            "supply_v": self.supply_v,
            "separation": finite_or_none(self.separation),
            "information": finite_or_none(self.information),
            "purpose": self.purpose,
            "separates": [list(self.one), list(self.other)],
            "sentence": self.sentence,
        }


@dataclass(frozen=True)
class Stopped:
    """What the time limit did to a trace.

    Attributes
    ----------
    limit_s, elapsed_s : float
        The limit, and the time after which the trace ended.
    left_out : tuple of str
        Stages that ended early or were not begun.
    checked : bool
        Whether validation was complete: what is called found then stands. Nothing is, where it was not.
    """

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

    def as_dict(self) -> dict[str, Any]:
        """The value of `stopped`."""
        return {
            "limit_s": self.limit_s,
            "elapsed_s": self.elapsed_s,
            "left_out": list(self.left_out),
            "checked": self.checked,
            "sentence": self.sentence,
        }


@dataclass(frozen=True)
class Rival:
    """A model near the best: its terms, and its posterior."""

    terms: tuple[str, ...]
    probability: float

    def as_dict(self) -> dict[str, Any]:
        """One entry of `rivals`."""
        return {"terms": list(self.terms), "probability": self.probability}


@dataclass(frozen=True)
class TraceResult:
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
            from adis_gonio.tracing.calibrations import calibration_of_gyro_trace

            return calibration_of_gyro_trace(self)
        if self.part != ACCELEROMETER:
            raise FitError(f"no calibration is made of a trace of the part {self.part}")
        from adis_gonio.tracing.calibrations import calibration_of_trace

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
            named = {finding.effect for finding in self.found}
            return REFERENCE_C if {"bias_temperature", "thermal_lag"} & named else None
        return float(recorded.mean())

    def summary(self) -> str:
        """What was found and what it brings, as `trace` begins, and the parameters of the effects."""
        from adis_gonio.tracing import summary as words

        return "\n".join([words.headline(self), words.gains(self), *lines_of(self._of_effects)])

    def __str__(self) -> str:
        return self.summary()

    @property
    def _of_effects(self) -> list[tuple[str, dict[str, Any]]]:
        return [(name, one.as_dict()) for found in self.found for name, one in found.parameters.items()]

    @property
    def _parameters(self) -> list[tuple[str, dict[str, Any]]]:
        return [*((name, value.as_dict()) for name, value in self.base.items()), *self._of_effects]

    def _repr_html_(self) -> str:
        """Base parameters and those of the effects found as a table, for notebooks."""
        return html_table(self.summary(), self._parameters)

    def to_pandas(self) -> DataFrame:
        """The same as a data frame with the columns value, u, dof, k, U and unit (extra: pandas)."""
        return parameter_frame(self._parameters)

    def as_dict(self) -> dict[str, Any]:
        """The JSON document of `trace`."""
        other = {} if self.part == ACCELEROMETER else {"part": self.part}
        return {
            **other,
            "adequate": self.adequate,
            "adequacy": self.adequacy,
            "found": [finding.as_dict() for finding in self.found],
            "steps": [step.as_dict() for step in self.steps],
            "sets": [one.as_dict() for one in self.sets],
            "confounded": [list(names) for names in self.confounded],
            "unnamed": None if self.unnamed is None else self.unnamed.as_dict(),
            "error": {"before": self.before.as_dict(), "after": self.after.as_dict()},
            "detectable": {name: value.as_dict() for name, value in self.detectable.items()},
            "next": list(self.advice),
            "measurements": [measurement.as_dict() for measurement in self.measurements],
            "rivals": [rival.as_dict() for rival in self.rivals],
            "base": {name: value.as_dict() for name, value in self.base.items()},
            "reasons": dict(self.reasons),
            "notes": list(self.notes),
            "within": [finding.as_dict() for finding in self.within],
            "heldout_design": self.heldout_design,
            "reference_temperature_c": self.reference_temperature_c,
            "stopped": None if self.stopped is None else self.stopped.as_dict(),
            "overrides": dict(self.overrides),
            **listed(self.position_findings),
        }


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
