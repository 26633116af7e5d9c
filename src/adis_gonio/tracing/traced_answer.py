"""The answer of a traced session: the recommended method together with the effects of its trace."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.conformity import ErrorCurve
from adis_gonio.base.numbers import counted
from adis_gonio.base.uncertainty import Value, factor_over
from adis_gonio.fitting.answer import (
    Answer,
    DwellPrediction,
    Recommendation,
    Score,
    predicted,
    predicts_worse,
    scores_of,
    with_notes,
)
from adis_gonio.fitting.determination import NoiseAssumptions
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.fit_result import FitResult, outputs_of
from adis_gonio.fitting.uncertainty import MODEL, BudgetRow, ShownAngle, budget_of, response_of, sources_of
from adis_gonio.tracing.trace_result import TraceResult

TRACED = "trace"
"""Name under which the traced model is listed in the scores."""


@dataclass(frozen=True)
class TracedAnswer(Answer):
    """Answer to the user from a traced model, which has effects that no method of the fit contains.

    Attributes
    ----------
    traced : TraceResult
        Trace with the final model that is recommended.
    """

    traced: TraceResult
    shows_another_method = False
    """False: the answer shows the traced model, which is the recommended model."""
    doubts = ()
    """Doubts about the model: none, since the model contains the effects that would raise doubts."""
    scored_as = TRACED
    """Name under which the table of scores lists the shown model: `trace`."""

    @property
    def model_parameters(self) -> dict[str, Value]:
        """Parameters of the base model by name, with their values in the traced model."""
        return dict(self.traced.base)

    @property
    def parameters(self) -> dict[str, Value]:
        """Parameters of the base model and of all found effects by name."""
        found = dict(self.traced.base)
        for finding in self.traced.found:
            found |= finding.parameters
        return found

    def _angle(self) -> dict[str, Value]:
        if not self.traced.fits[-1].data.planar:
            return {}
        score = self.scores[TRACED].angle_rms_deg
        return {"angle": shown_angle(self.traced, math.nan if score is None else score)}

    def error_curves(self) -> tuple[ErrorCurve | None, ErrorCurve]:
        """Return the angle's error over the turn, without and with the calibration by the traced model.

        The first curve is None if the sensor's scale is unknown.
        """
        from adis_gonio.tracing.trace_calibrations import calibration_of_trace

        return calibration_of_trace(self.traced).error_curves()

    @cached_property
    def budget(self) -> dict[str, tuple[BudgetRow, ...]]:
        """Uncertainty budgets of ΔK, Δφ and the angle by the traced model; empty for attitudes in space."""
        return budgets_of_trace(self.traced, self.values)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on the shown values, such as the temperature at which they are valid."""
        temperature = self.reference_temperature_c
        if temperature is None:
            return self._excess
        return (f"Parameters are valid at {temperature:.1f} °C.", *self._excess)

    @property
    def reference_temperature_c(self) -> float | None:
        """Temperature in °C at which the parameters are valid; None if unknown."""
        return self.traced.reference_temperature_c

    def facts(self) -> list[str]:
        """Return a line with the residual of the traced model."""
        after = self.traced.after
        return [f"residual {after.residual_rms:.3g} {after.unit} rms"]


def answer_with_trace(result: FitResult, trace: TraceResult | None) -> Answer:
    """Return the answer of a fitted and traced session, with the result of the recommended method.

    Parameters
    ----------
    result : FitResult
        Result of the fit by any method.
    trace : TraceResult, optional
        Trace of the fitted session.

    Returns
    -------
    Answer
        A `TracedAnswer` if the trace added effects and its model predicts as well as the best method;
        otherwise the answer of the fit.
    """
    plain = Answer.of(result, own=False)
    comparison = plain.comparison
    if trace is None or not trace.fits or result.session is None:
        return plain
    likely = next((r for r in comparison.results if r.method == "ml"), comparison.best)
    # Effects of the traced model that this fit lacks; most fits contain biases.
    biased = any(name.startswith("bias_") for name in likely.parameters)
    steps = dict.fromkeys(step.effect for step in trace.steps)
    names = tuple(name for name in steps if not (biased and name == "bias"))
    if not names:
        return replace(plain, recommended=_confirmed(comparison.recommended, trace))
    found = {**comparison.predictions, TRACED: _of_trace(result.session, trace)}
    scores = scores_of(found)
    reason = _reason(trace, found, scores, comparison.recommended.method)
    if reason is None:
        return replace(plain, scores=scores)
    return TracedAnswer(
        with_notes(likely, result),
        comparison,
        Recommendation(likely.method, reason, names),
        scores,
        traced=trace,
    )


def _confirmed(recommended: Recommendation, trace: TraceResult) -> Recommendation:
    """Return the recommendation of a method, with a remark that the trace found no additional effect."""
    if trace.stopped is not None and not trace.stopped.checked:
        return recommended
    said = {
        "adequate": "no effect that this model lacks",
        "not adequate": "its model not adequate, and no effect to add",
        "not tested": "no effect to add; this session cannot test whether the model is adequate",
    }[trace.adequacy]
    return replace(recommended, why=f"{recommended.why}; the trace finds {said}")


def _of_trace(session: Readings, trace: TraceResult) -> DwellPrediction:
    """Return the prediction of each dwell by the traced model, which is refitted without this dwell."""
    final = trace.fits[-1]
    used = np.isin(session.position, final.data.position) & ~session.check
    data = replace(session, fixture_rad=final.data.fixture_rad, links=None)
    return predicted(data, used, final, lambda out: final.again(data.rows(used & ~out)))


def _reason(
    trace: TraceResult, found: dict[str, DwellPrediction], scores: dict[str, Score], best: str
) -> str | None:
    """Return the reason to recommend the traced model; None if it predicts worse or was not validated.

    `found` and `scores` are the predictions and errors of all models, `best` is the recommended method.
    """
    if trace.stopped is not None and not trace.stopped.checked:
        return None
    if predicts_worse(found[TRACED], found[best]):
        return None
    own, other = scores[TRACED], scores[best]
    if own.angle_rms_deg is not None and other.angle_rms_deg is not None:
        errors = f"{own.angle_rms_deg:.2g}° rms", f"{other.angle_rms_deg:.2g}°"
    elif own.residual_rms_mg is not None and other.residual_rms_mg is not None:
        errors = f"{own.residual_rms_mg:.2g} mg rms", f"{other.residual_rms_mg:.2g} mg"
    else:
        return None
    said = f"{errors[0]} over {counted(own.dwells, 'dwell')} left out, {errors[1]} without"
    state = "explains the residual" if trace.adequate else "is the best that the trace found"
    return f"the model with these effects {state} and predicts as well or better ({said})"


def shown_angle(traced: TraceResult, error_deg: float) -> Value:
    """Return an angle error in degrees with the standard uncertainty of an angle by the traced model.

    `error_deg` is the angle error. The uncertainty is the root mean square over the dwells.
    """
    final = traced.fits[-1]
    reading = final.data.covariance.mean(axis=0)
    shown = ShownAngle.at_dwells(final)
    variances = traced.inflation * shown.variances(final.covariance, reading)
    u = math.sqrt(float(variances.mean()))
    return Value(error_deg, u, "deg", traced.dof, factor_over(variances, traced.dof))


def budgets_of_trace(traced: TraceResult, values: Mapping[str, Value]) -> dict[str, tuple[BudgetRow, ...]]:
    """Return the uncertainty budgets of `delta_k`, `delta_phi` and `angle` by the traced model.

    `values` are the values of these quantities; a value without u has no budget. The result is empty for
    attitudes in space. The part of u that is not explained by the sources of the readings is assigned to
    the choice of the model: a residual larger than the noise, and other models of equal probability.
    """
    final = traced.fits[-1]
    data = final.data
    if not data.planar:
        return {}
    # If the noise was not stated, `inflation` is its estimate.
    scale = 1.0 if data.noise_known else math.sqrt(traced.inflation)
    noise = NoiseAssumptions(scale=scale, sigma_rad=data.fixture_rad, dof=traced.dof)
    response = response_of(final, final.covariance, np.ones(len(final.covariance)))
    sources = sources_of(data, noise, final, response)
    slopes = {name: (row[None], None) for name, row in _gradients(final).items()}
    shown = ShownAngle.at_dwells(final)
    found = {}
    for name, (gradient, reading) in {**slopes, "angle": (shown.gradient, shown.reading)}.items():
        if name in values and values[name].u is not None:
            found[name] = _completed(budget_of(sources, gradient, reading), values[name])
    return found


def _gradients(fit: Fit) -> dict[str, Floats]:
    """Return the gradients (p,) of `delta_k` and `delta_phi` (in degrees) by all parameters of a fit."""
    width, base = len(fit.values.parameters), fit.values.base
    outputs = outputs_of(fit.data, np.concatenate([base, np.zeros(fit.data.axes)]))
    return {
        one.name: np.pad(one.gradient[: len(base)], (0, width - len(base)))
        for one in outputs
        if one.name in {"delta_k", "delta_phi"}
    }


def _completed(rows: tuple[BudgetRow, ...], value: Value) -> tuple[BudgetRow, ...]:
    """Return the rows of an uncertainty budget that sum to the variance of a value.

    The remainder is assigned to the choice of the model.
    """
    total = (value.u or 0.0) ** 2
    known = sum(row.contribution**2 for row in rows if row.source != MODEL)
    rest = math.sqrt(max(total - known, 0.0))
    total = known + rest**2
    done = []
    for row in rows:
        if row.source == MODEL:
            row = replace(
                row,
                kind="A",
                u=None,
                sensitivity=None,
                contribution=rest,
                dof=value.dof,
                note="residual beyond the noise, and other models as probable as this one",
            )
        done.append(replace(row, share=row.contribution**2 / total if total else 0.0))
    return tuple(done)
