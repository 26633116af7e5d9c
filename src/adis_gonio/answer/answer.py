"""The one answer: the recommended method, with the effects that a trace found, and what it says.

>>> import adis_gonio
>>> from adis_gonio.answer import Answer
>>> print(Answer.of(adis_gonio.fit("session.csv")).text())  # doctest: +SKIP
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from adis_gonio.answer.of_trace import budgets_of_trace, shown_angle
from adis_gonio.answer.tables import budget_table, parameter_row, score_table
from adis_gonio.answer.wording import Line, lines_as_text, wrapped
from adis_gonio.counting import counted
from adis_gonio.estimation.readings import Readings
from adis_gonio.estimation.values import Value
from adis_gonio.fitting.result import FitResult
from adis_gonio.fitting.scores import DwellPrediction, Score, predicted, scores_of
from adis_gonio.fitting.standing import Recommendation, Standing, surely_worse
from adis_gonio.fitting.uncertainty_budget import BudgetRow
from adis_gonio.tracing.outcome.result import TraceResult

TRACED = "trace"
"""Name of the traced model among the scores."""
_SPATIAL = ("scale", "skew", "bias")


@dataclass(frozen=True)
class Answer:
    """What a session says, in one place.

    Attributes
    ----------
    result : FitResult
        Of the method that is shown in full.
    standing : Standing
        All methods beside each other.
    recommended : Recommendation
        Method and, where a trace ran and its model predicts as well, the effects that it found.
    scores : mapping of str to Score
        Of all methods, and of the traced model (`trace`), on the same dwells.
    traced : TraceResult or None
        The trace, where its model is the one that is recommended.
    """

    result: FitResult
    standing: Standing
    recommended: Recommendation
    scores: dict[str, Score]
    traced: TraceResult | None = field(default=None, repr=False)

    @classmethod
    def of(cls, result: FitResult, trace: TraceResult | None = None, *, own: bool = True) -> Answer:
        """Answer of a session that was fitted.

        Parameters
        ----------
        result : FitResult
            Any method's; it is shown itself where `own`, else the recommended one is.
        trace : TraceResult, optional
            Of the same session.
        """
        standing = result.standing
        if standing is None:
            raise ValueError("this result was not made by adis_gonio.fit: its session is not known")
        shown = result if own else _with_notes(standing.best, result)
        plain = cls(shown, standing, standing.recommended, standing.scores)
        if trace is None or not trace.fits or result.session is None:
            return plain
        likely = next((r for r in standing.results if r.method == "ml"), standing.best)
        names = _beyond(likely, trace)
        if not names:
            return replace(plain, recommended=_confirmed(standing.recommended, trace))
        prediction = _of_trace(result.session, trace)
        if prediction is None:
            return plain
        found = {**standing.predictions, TRACED: prediction}
        scores = scores_of(found)
        reason = _reason(trace, found, scores, standing.recommended.method)
        if reason is None:
            return replace(plain, scores=scores)
        return replace(
            plain,
            result=_with_notes(likely, result),
            recommended=Recommendation(likely.method, reason, names),
            scores=scores,
            traced=trace,
        )

    @cached_property
    def values(self) -> dict[str, Value]:
        """What is wanted: `delta_k`, `delta_phi` and `angle`; in space gains, skews and biases."""
        if self.traced is not None:
            found = {**self.traced.base, **self._angle_of_trace()}
        else:
            found = self.parameters
            if self.result.angle is not None:
                found["angle"] = self.result.angle
        if "delta_k" in found or "delta_phi" in found:
            return {name: found[name] for name in ("delta_k", "delta_phi", "angle") if name in found}
        return {name: value for stem in _SPATIAL for name, value in found.items() if name.startswith(stem)}

    @property
    def parameters(self) -> dict[str, Value]:
        """All parameters of the answer by name: of the method, or of the traced model with its effects."""
        if self.traced is None:
            return {e.name: e.stated for e in self.result.parameters}
        found = dict(self.traced.base)
        for finding in self.traced.found:
            found |= finding.parameters
        return found

    def _angle_of_trace(self) -> dict[str, Value]:
        traced = self.traced
        if traced is None or not traced.fits[-1].data.planar:
            return {}
        score = self.scores[TRACED].angle_rms_deg
        return {"angle": shown_angle(traced, math.nan if score is None else score)}

    @cached_property
    def budget(self) -> dict[str, tuple[BudgetRow, ...]]:
        """Uncertainty budget of `values` in the plane."""
        if self.traced is None:
            return self.result.budget
        return budgets_of_trace(self.traced, self.values)

    @property
    def title(self) -> str:
        """`ml with bias, quadratic`."""
        if self.traced is None and self.result.method != self.recommended.method:
            return f"{self.result.method} (recommended is {self.recommended.method})"
        effects = self.recommended.effects
        return self.recommended.method + (f" with {', '.join(effects)}" if effects else "")

    @property
    def why(self) -> str:
        """Why this method, one sentence; why another one is recommended, where it was asked for."""
        text = self.recommended.why
        if self.traced is None and self.result.method != self.recommended.method:
            return f"Why {self.recommended.method}: {text}."
        return f"{text[:1].upper()}{text[1:]}."

    @property
    def doubts(self) -> tuple[str, ...]:
        """Sentence that leads the answer if the model does not describe the session; else empty."""
        if self.traced is not None or not self.result.extra_mg:
            return ()
        return (
            "The model does not describe this session: the residual is larger than the noise."
            " Run adis-gonio trace to find the missing effect.",
        )

    @property
    def lines(self) -> list[Line]:
        """The headline's table: quantity, unit, value, u, U, k."""
        return [Line.of(name, value) for name, value in self.values.items()]

    @property
    def remarks(self) -> tuple[str, ...]:
        """What has to be said of the values, such as a gravity or zero that they refer to."""
        temperature = self.reference_temperature_c
        said = []
        if self.traced is not None and self.traced.reference_temperature_c is not None:
            said.append(f"Parameters hold at {self.traced.reference_temperature_c:.1f} °C.")
        elif temperature is not None and not {"delta_k", "delta_phi"} & set(self.values):
            said.append(f"Parameters hold at {temperature:.1f} °C, the mean of the session.")
        return tuple(said)

    @property
    def reference_temperature_c(self) -> float | None:
        """Temperature at which the parameters hold."""
        if self.traced is not None and self.traced.reference_temperature_c is not None:
            return self.traced.reference_temperature_c
        return self.result.reference_temperature_c

    def text(self, width: int = 80) -> str:
        """The headline in plain text of at most `width` columns."""
        return "\n".join(
            [
                *(line for doubt in self.doubts for line in wrapped(doubt, width)),
                f"Answer by method {self.title}",
                *lines_as_text(self.lines),
                *wrapped(self.why, width, indent=2),
                *(line for remark in self.remarks for line in wrapped(remark, width, indent=2)),
            ]
        )

    def as_dict(self) -> dict[str, Any]:
        """JSON document of `fit` with what this answer adds: scores, the recommendation, the values."""
        return {
            **self.result.as_dict(),
            "recommended": self.recommended.as_dict(),
            "scores": {name: score.as_dict() for name, score in self.scores.items()},
            "answer": {name: value.as_dict() for name, value in self.values.items()},
            "budget": {name: [row.as_dict() for row in rows] for name, rows in self.budget.items()},
            "reference_temperature_c": self.reference_temperature_c,
        }

    @property
    def has_more(self) -> bool:
        """True where there are parameters beside the headline's."""
        return len(self.parameter_rows()) > len([name for name in self.values if name != "angle"])

    # -- what faces show, as texts -----------------------------------------------------------------

    def parameter_rows(self) -> list[list[str]]:
        """All parameters: name, unit, value, u, U, k, ν."""
        return [parameter_row(name, value) for name, value in self.parameters.items()]

    def budget_rows(self) -> tuple[list[str], list[list[str]]]:
        """Head and rows of the uncertainty budget; empty without one."""
        return budget_table(self.budget)

    def score_rows(self) -> tuple[list[str], list[list[str]]]:
        """Head and rows of all methods on the same dwells, the answer's first."""
        return score_table(self.scores, TRACED if self.traced is not None else self.result.method)

    @property
    def scored_on(self) -> str:
        """What the scores are of."""
        dwells = max((score.dwells for score in self.scores.values()), default=0)
        if not dwells:
            return "Methods cannot be compared: no dwell can be left out of a fit."
        same = counted(dwells, "dwell")
        return f"Every method on the same {same}, each left out of the fit where it was in it:"

    def facts(self) -> list[str]:
        """What the recommended fit left, in a line or two."""
        links = self.result.links if self.traced is None else None
        return [*self._left(), *([] if links is None else [links.line])]

    def _left(self) -> list[str]:
        r = self.result
        if self.traced is not None:
            after = self.traced.after
            return [f"residual {after.residual_rms:.3g} {after.unit} rms"]
        if not r.dof:
            return ["no degree of freedom is left to test the model by"]
        return [f"residual {r.residual_rms_mg:.3g} mg rms, χ² {r.chi2:.1f} at {r.dof} degrees of freedom"]

    def warnings(self, *, everything: bool = False) -> list[str]:
        """Warnings of the method that is shown; of all methods, with their names, where asked for."""
        if not everything:
            return list(self.result.warnings)
        said: dict[str, list[str]] = {}
        for result in self.standing.results:
            for warning in result.warnings:
                said.setdefault(warning, []).append(result.method)
        return [*self.result.session_notes, *(f"{', '.join(m)}: {w}" for w, m in said.items())]


def _beyond(likely: FitResult, trace: TraceResult) -> tuple[str, ...]:
    """Effects of the traced model that a fit does not hold itself: biases are in most."""
    biased = any(e.name.startswith("bias_") for e in likely.parameters)
    names = dict.fromkeys(step.effect for step in trace.steps)
    return tuple(name for name in names if not (biased and name == "bias"))


def _confirmed(recommended: Recommendation, trace: TraceResult) -> Recommendation:
    """The recommendation with what a trace that added nothing to its model says of it."""
    if trace.stopped is not None and not trace.stopped.checked:
        return recommended
    said = {
        "adequate": "no effect missing",
        "not adequate": "its model not adequate, and no effect to add",
        "not tested": "no effect to add; this session cannot test whether the model is adequate",
    }[trace.adequacy]
    return replace(recommended, why=f"{recommended.why}; the trace finds {said}")


def _with_notes(best: FitResult, given: FitResult) -> FitResult:
    """The recommended result with the session's notes before its own warnings, as `fit` gives it."""
    if best.method == given.method:
        return given
    notes = given.session_notes
    return replace(
        best,
        warnings=(*notes, *best.warnings),
        session_notes=notes,
        session=given.session,
        position_findings=given.position_findings,
        links=given.links,
    )


def _of_trace(session: Readings, trace: TraceResult) -> DwellPrediction | None:
    """Predictions of the traced model, its effects kept and their values fitted anew without each dwell."""
    final = trace.fits[-1]
    if not session.planar and not final.data.planar and final.data.axes != session.axes:
        return None
    used = np.isin(session.position, final.data.position) & ~session.check
    data = replace(session, fixture_rad=final.data.fixture_rad, links=None)
    return predicted(data, used, final, lambda out: final.again(data.rows(used & ~out)))


def _reason(
    trace: TraceResult, found: dict[str, DwellPrediction], scores: dict[str, Score], best: str
) -> str | None:
    """Why the traced model is the answer; None where it is not."""
    if trace.stopped is not None and not trace.stopped.checked:
        return None
    if surely_worse(found[TRACED], found[best]):
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
