"""The answer of a fitted session: the recommended method, its values and the text that shows them.

>>> import adis_gonio
>>> from adis_gonio.fitting.answer import Answer
>>> print(Answer.of(adis_gonio.fit("session.csv")).text())  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

from adis_gonio.base.jsonable import json_object
from adis_gonio.base.numbers import HEAD, QuantityRow, counted
from adis_gonio.base.tables import align_columns, fold_text
from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.result import FitResult
from adis_gonio.fitting.scores import Score
from adis_gonio.fitting.standing import Recommendation, Standing
from adis_gonio.fitting.tables import budget_table, parameter_row, score_table
from adis_gonio.fitting.uncertainty_budget import BudgetRow

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
        Method and, if a trace ran and its model predicts as well, the effects that the trace found.
    scores : mapping of str to Score
        Of all methods on the same dwells.
    """

    result: FitResult
    standing: Standing
    recommended: Recommendation
    scores: dict[str, Score]

    @classmethod
    def of(cls, result: FitResult, *, own: bool = True) -> Self:
        """Answer of a session that was fitted.

        Parameters
        ----------
        result : FitResult
            Result of any method.
        own : bool
            Show this result, else the recommended one.
        """
        standing = result.standing
        if standing is None:
            raise ValueError("this result was not made by adis_gonio.fit: its session is not known")
        shown = result if own else with_notes(standing.best, result)
        return cls(shown, standing, standing.recommended, standing.scores)

    @cached_property
    def values(self) -> dict[str, Value]:
        """What is wanted: `delta_k`, `delta_phi` and `angle`; in space gains, skews and biases."""
        found = {**self.model_parameters, **self._angle()}
        if "delta_k" in found or "delta_phi" in found:
            return {name: found[name] for name in ("delta_k", "delta_phi", "angle") if name in found}
        return {name: value for stem in _SPATIAL for name, value in found.items() if name.startswith(stem)}

    @property
    def parameters(self) -> dict[str, Value]:
        """All parameters of the answer by name."""
        return self.model_parameters

    @property
    def model_parameters(self) -> dict[str, Value]:
        """Parameters of the base model by name."""
        return {e.name: e.stated for e in self.result.parameters}

    @property
    def shows_another_method(self) -> bool:
        """True if the method that is shown is not the recommended one."""
        return self.result.method != self.recommended.method

    def _angle(self) -> dict[str, Value]:
        """Error of the angle that the model shows, if angles are declared."""
        return {} if self.result.angle is None else {"angle": self.result.angle}

    @cached_property
    def budget(self) -> dict[str, tuple[BudgetRow, ...]]:
        """Uncertainty budget of `values` in the plane."""
        return self.result.budget

    @property
    def title(self) -> str:
        """`ml with bias, quadratic`."""
        if self.shows_another_method:
            return f"{self.result.method} (recommended is {self.recommended.method})"
        effects = self.recommended.effects
        return self.recommended.method + (f" with {', '.join(effects)}" if effects else "")

    @property
    def why(self) -> str:
        """Why this method, one sentence; why another one is recommended, where it was asked for."""
        text = self.recommended.why
        if self.shows_another_method:
            return f"Why {self.recommended.method}: {text}."
        return f"{text[:1].upper()}{text[1:]}."

    @property
    def doubts(self) -> tuple[str, ...]:
        """Sentence that leads the answer if the model does not describe the session; else empty."""
        return self.result.doubts

    @property
    def lines(self) -> list[QuantityRow]:
        """The headline's table: quantity, unit, value, u, U, k."""
        return [QuantityRow.of(name, value) for name, value in self.values.items()]

    @property
    def remarks(self) -> tuple[str, ...]:
        """What has to be said of the values, such as a gravity or zero that they refer to."""
        temperature = self.reference_temperature_c
        if temperature is None or {"delta_k", "delta_phi"} & set(self.values):
            return ()
        return (f"Parameters hold at {temperature:.1f} °C, the mean of the session.",)

    @property
    def reference_temperature_c(self) -> float | None:
        """Temperature at which the parameters hold."""
        return self.result.reference_temperature_c

    def text(self, width: int = 80) -> str:
        """The headline in plain text of at most `width` columns."""
        return "\n".join([*self.doubt_lines(width), *self.headline(width)])

    def doubt_lines(self, width: int = 80) -> list[str]:
        """Lines of `doubts`, of at most `width` columns."""
        return [line for doubt in self.doubts for line in fold_text(doubt, width)]

    def headline(self, width: int = 80) -> list[str]:
        """Lines of the method, the values and the reason for the method."""
        return [
            f"Answer by method {self.title}",
            *align_columns([HEAD, *(line.cells for line in self.lines)]),
            *fold_text(self.why, width, indent=2),
            *(line for remark in self.remarks for line in fold_text(remark, width, indent=2)),
        ]

    def as_dict(self) -> dict[str, Any]:
        """JSON document of `fit` with what this answer adds: scores, the recommendation, the values."""
        return self.result.as_dict() | json_object(
            recommended=self.recommended,
            scores=self.scores,
            answer=self.values,
            budget=self.budget,
            reference_temperature_c=self.reference_temperature_c,
        )

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

    @property
    def scored_as(self) -> str:
        """Name of the answer's model among the scores."""
        return self.result.method

    def score_rows(self) -> tuple[list[str], list[list[str]]]:
        """Head and rows of all methods on the same dwells, the answer's first."""
        return score_table(self.scores, self.scored_as)

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
        r = self.result
        if r.dof:
            left = f"residual {r.residual_rms_mg:.3g} mg rms, χ² {r.chi2:.1f} at {r.dof} degrees of freedom"
        else:
            left = "no degree of freedom is left to test the model by"
        return [left, *([] if r.links is None else [r.links.line])]

    def warnings(self, *, everything: bool = False) -> list[str]:
        """Warnings of the method that is shown, without its doubts; of all methods, with their names."""
        if not everything:
            return [text for text in self.result.warnings if text not in self.result.doubts]
        said: dict[str, list[str]] = {}
        for result in self.standing.results:
            for warning in result.warnings:
                said.setdefault(warning, []).append(result.method)
        return [*self.result.session_notes, *(f"{', '.join(m)}: {w}" for w, m in said.items())]


def with_notes(best: FitResult, given: FitResult) -> FitResult:
    """The recommended result with the session's notes before its own warnings, as `fit` gives it."""
    if best.method == given.method:
        return given
    notes = given.session_notes
    return replace(
        best,
        warnings=(*best.doubts, *notes, *best.warnings),
        session_notes=notes,
        session=given.session,
        position_findings=given.position_findings,
        links=given.links,
    )
