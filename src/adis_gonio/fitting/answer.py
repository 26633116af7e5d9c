"""The answer of a fitted session: methods compared, the recommended one, its values and their text.

>>> import adis_gonio
>>> from adis_gonio.fitting.answer import Answer
>>> print(Answer.of(adis_gonio.fit("session.csv")).text())  # doctest: +SKIP

Each method predicts every dwell without having seen it: dwells that were fitted are left out of a new fit.
A method that saw two readings of twenty-four has small residuals at those two; here it has to predict all
of them. If a closed form needs a dwell that is left out, it runs at the next quarter of the turn: 90° and
180° instead of 0° and 90° are the same method with another start angle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.conformity import ErrorCurve
from adis_gonio.base.errors import FitError
from adis_gonio.base.jsonable import JsonRecord, json_object
from adis_gonio.base.numbers import (
    DASH,
    HEAD,
    NAMES,
    QuantityRow,
    counted,
    format_number,
    format_percent,
    format_uncertain,
    format_unit,
    with_unit,
)
from adis_gonio.base.tables import align_columns, fold_text
from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.fit_result import MAIN, FitResult, differences_of_angle, start_angle
from adis_gonio.fitting.methods import METHOD_TABLE, applicable_to, default_method, fit_of
from adis_gonio.fitting.slips.session_positions import sentences_of
from adis_gonio.fitting.uncertainty import FIXTURE, FLICKER, REPEATABILITY, BudgetRow

BEYOND = 3.0
"""Threshold on the difference of two methods' mean squared errors over the same dwells, in standard errors
of this difference. Above it one method predicts better."""
ALIKE = 0.01
"""Relative difference of two methods' uncertainties below which they count as equal."""


class Recommendation(JsonRecord):
    """The recommended method, its effects beyond the base model, and the reason (`why`) in one sentence.

    Its JSON document is the value of `recommended` in a result.
    """

    document_keys = ("method", "effects", "why")

    method: str
    why: str
    effects: tuple[str, ...] = ()


@dataclass(frozen=True)
class MethodComparison:
    """Results of all methods for a session, their scores, and the recommended method.

    Attributes
    ----------
    results : tuple of FitResult
        Result of each method that fits the session, in the order of `METHODS`.
    failures : mapping of str to str
        Reasons why other methods give no result, by method.
    predictions : mapping of str to DwellPrediction
        Errors with which each method predicts every dwell by a fit without this dwell, by method.
    scores : mapping of str to Score
        Errors of each method on the dwells that all methods predict.
    recommended : Recommendation
        The recommended method, and the reason.
    """

    results: tuple[FitResult, ...]
    failures: dict[str, str]
    predictions: dict[str, DwellPrediction]
    scores: dict[str, Score]
    recommended: Recommendation

    @property
    def best(self) -> FitResult:
        """Result of the recommended method."""
        return next(result for result in self.results if result.method == self.recommended.method)


def compare_methods(session: Readings) -> MethodComparison:
    """Fit, score and compare all methods that a session supports.

    Raises
    ------
    FitError
        If no method gives a result.
    """
    training = session.training
    results: list[FitResult] = []
    failures: dict[str, str] = {}
    for method in applicable_to(training):
        try:
            results.append(fit_of(session, method))
        except FitError as error:
            failures[method] = str(error)
    if not results:
        results.append(fit_of(session))
    found = {result.method: prediction_of(session, result) for result in results}
    scores = scores_of(found)
    return MethodComparison(
        tuple(results), failures, found, scores, recommend(results, found, scores, default_method(training))
    )


def recommend(
    results: Sequence[FitResult],
    found: Mapping[str, DwellPrediction],
    scores: Mapping[str, Score],
    preferred: str,
) -> Recommendation:
    """Choose the method to recommend from the results and prediction errors of all methods.

    `found` and `scores` have the prediction errors of each dwell and their summary, by method.

    1. If a method determines the biases, methods that take them as zero are excluded. `paper` is also
       excluded if another method remains, because its u omits the error of its equation 5.
    2. Remaining methods that predict the session's dwells clearly worse than the best one are excluded.
    3. The recommended method has the smallest uncertainty of ΔK and Δφ of the remaining methods. If several
       methods have equal uncertainties, `preferred` is recommended.
    """
    sighted = [result for result in results if "bias_x" in result]
    able = sighted or list(results)
    able = [result for result in able if result.method != "paper"] or able
    scored = bool(scores) and all(scores[result.method].dwells for result in able)
    good = able
    if scored:
        first = min(able, key=lambda r: _rms(scores[r.method]))
        good = [r for r in able if not predicts_worse(found[r.method], found[first.method])]
    least = min(_mean_u(result) for result in good)
    equal = [result for result in good if _mean_u(result) <= least * (1 + ALIKE)]
    names = [result.method for result in equal]
    chosen = preferred if preferred in names else names[-1]
    result = next(result for result in equal if result.method == chosen)
    if len(results) == 1:
        return Recommendation(chosen, "the only method that this session supports")
    reasons = []
    if "bias_x" in result and any("bias_x" not in other for other in results):
        reasons.append("it determines the biases")
    elif "bias_x" not in result:
        reasons.append("no method sees the biases in these positions, which are taken as zero")
    if scored:
        own = scores[result.method]
        error = f"{format_number(_rms(own), 2)}{' mg' if own.angle_rms_deg is None else '°'} rms"
        how = "and none is shown to predict them better" if len(good) > 1 else "the best"
        reasons.append(
            f"it predicts the {counted(own.dwells, 'dwell')}, each left out of its fit, with {error}, {how}"
        )
    else:
        reasons.append("no dwell can be left out to compare the methods by")
    if len(good) > 1 and _mean_u(result) < math.inf:
        reasons.append("no other gives a smaller u of ΔK and Δφ")
    return Recommendation(chosen, "; ".join(reasons))


def _squares(prediction: DwellPrediction) -> Floats:
    """Return the squared prediction error (n,) of each dwell.

    It is the error of the angle if any angle is declared, otherwise of the reading, as the mean over the
    axes.
    """
    if np.isfinite(prediction.angle_rad).any():
        return np.asarray(prediction.angle_rad**2)
    return np.asarray((prediction.residual_mg**2).mean(axis=1))


def _rms(score: Score) -> float:
    return float(score.residual_rms_mg or 0.0) if score.angle_rms_deg is None else score.angle_rms_deg


def predicts_worse(one: DwellPrediction, best: DwellPrediction) -> bool:
    """Return True if the prediction `one` is clearly worse than the prediction `best` of the same dwells.

    The mean squared error must be larger by more than `BEYOND` standard errors of the difference, and by
    0.1 %.
    """
    base = _squares(best)
    # Paired differences: both methods predict the same dwells.
    difference = _squares(one) - base
    difference = difference[np.isfinite(difference)]
    if len(difference) < 3:
        return False
    scatter = float(difference.std(ddof=1)) / math.sqrt(len(difference))
    mean = float(difference.mean())
    return mean > BEYOND * scatter and mean > 1e-3 * float(np.nanmean(base))


def _mean_u(result: FitResult) -> float:
    """Return the geometric mean of the standard uncertainties of a result's main parameters.

    It ranks the methods. The main parameters are ΔK and Δφ, in space all parameters. The mean is inf if one
    uncertainty is unknown.
    """
    wanted = MAIN & result.parameters.keys() or result.parameters
    us = [result[name].u for name in wanted]
    if any(u is None or not math.isfinite(u) for u in us):
        return math.inf
    return math.exp(sum(math.log(max(u or 0.0, 1e-300)) for u in us) / len(us))


MOST_FOLDS = 40
"""Largest number of folds in the comparison: up to this many dwells are left out one by one, more dwells in
groups."""


@dataclass(frozen=True)
class DwellPrediction:
    """Errors with which a method predicts n dwells; NaN if unknown.

    `angle_rad` (n,) are errors of the angle, `residual_mg` (n, r) of the readings. There are r = 2 axes in
    the plane; in space r = 1, the error of the norm.
    """

    angle_rad: Floats
    residual_mg: Floats


class Score(JsonRecord):
    """Prediction errors of a method, on the dwells that all compared methods predict.

    The JSON document is one entry of `scores`.

    Attributes
    ----------
    angle_rms_deg, angle_max_deg : float or None
        Root mean square and largest size of the angle by the calibrated goniometer minus the declared
        angle; None without declared angles.
    residual_rms_mg, residual_max_mg : float or None
        Root mean square and largest size of the reading minus the model, at the attitude that fits the
        dwell best within the fixture's tolerance; in space the residual of the norm.
    dwells : int
        Number of dwells that all compared methods predict; if it is 0, the other figures are None.
    """

    angle_rms_deg: float | None
    angle_max_deg: float | None
    residual_rms_mg: float | None
    residual_max_mg: float | None
    dwells: int


def scores_of(found: Mapping[str, DwellPrediction]) -> dict[str, Score]:
    """Return the errors of each method on the dwells that all methods predict.

    `found` are the prediction errors by method.
    """
    if not found:
        return {}
    # Compare all methods on the dwells that each of them can predict.
    common = np.all([np.isfinite(p.residual_mg).all(axis=1) for p in found.values()], axis=0)
    return {name: _score(prediction, common) for name, prediction in found.items()}


def _score(prediction: DwellPrediction, rows: NDArray[np.bool_]) -> Score:
    count = int(rows.sum())
    if not count:
        return Score(None, None, None, None, 0)
    residual = prediction.residual_mg[rows]
    angle = np.degrees(prediction.angle_rad[rows])
    angle = angle[np.isfinite(angle)]
    return Score(
        float(np.sqrt((angle**2).mean())) if angle.size else None,
        float(np.abs(angle).max()) if angle.size else None,
        float(np.sqrt((residual**2).mean())),
        float(np.abs(residual).max()),
        count,
    )


def prediction_of(session: Readings, result: FitResult) -> DwellPrediction:
    """Return the errors with which a method predicts each dwell by a fit that does not use this dwell."""
    made = result.origin
    assert made is not None
    used = np.isin(session.position, result.positions) & ~session.check

    def refit_without(left_out: NDArray[np.bool_]) -> Fit:
        rest = session.rows(~session.check & ~left_out)
        return METHOD_TABLE[result.method].refit(made.noise.applied(rest), made)

    return predicted(made.noise.applied(session), used, made.fit, refit_without)


def predicted(
    data: Readings,
    used: NDArray[np.bool_],
    fit: Fit,
    refit_without: Callable[[NDArray[np.bool_]], Fit],
) -> DwellPrediction:
    """Return the prediction errors of all dwells, each by a fit that does not use this dwell.

    Parameters
    ----------
    data : Readings
        All dwells of the session, with the estimated noise.
    used : (n,) bool
        True for the dwells that `fit` used; `fit` predicts the others.
    refit_without : callable
        Function that repeats the fit without the dwells at which its argument (n,) is True. If it raises
        `FitError`, the prediction errors of these dwells are NaN.
    """
    n = len(data)
    columns = 2 if data.planar else 1
    angle, residual = np.full(n, np.nan), np.full((n, columns), np.nan)
    for left_out in held_out_groups(used):
        if used[left_out].any():
            try:
                model = refit_without(np.isin(np.arange(n), left_out))
            except FitError:
                continue
        else:
            model = fit
        there = model.on(replace(data.rows(left_out), fitted=model.data.fitted))
        if data.planar:
            angle[left_out] = differences_of_angle(there, start_angle(model))
            residual[left_out] = there.misfit
        else:  # in space only the length of gravity is known for each dwell
            norm = np.linalg.norm(there.gravity, axis=1, keepdims=True) - 1
            residual[left_out] = norm * data.gravity_mg
    return DwellPrediction(angle, residual)


def held_out_groups(used: NDArray[np.bool_]) -> Iterator[NDArray[np.intp]]:
    """Yield the groups of dwells, as row numbers, that cross-validation leaves out together.

    Dwells that the method does not use (False in `used`) form one group.
    """
    inside, outside = np.flatnonzero(used), np.flatnonzero(~used)
    if len(outside):
        yield outside
    folds = min(MOST_FOLDS, len(inside))
    for first in range(folds):
        yield inside[first::folds]


_SPATIAL = ("scale", "skew", "bias")


@dataclass(frozen=True)
class Answer:
    """The answer of a fit for the user: the shown result, all scores, a recommendation, and their text.

    Attributes
    ----------
    result : FitResult
        Result of the method that is shown in full.
    comparison : MethodComparison
        Comparison of all methods.
    recommended : Recommendation
        Recommended method. If a trace found effects and its model predicts left-out dwells as well as the
        best method, it is `ml` with these effects.
    scores : mapping of str to Score
        Errors of each method on the same dwells, by the method's name.
    """

    result: FitResult
    comparison: MethodComparison
    recommended: Recommendation
    scores: dict[str, Score]

    @classmethod
    def of(cls, result: FitResult, *, own: bool = True) -> Self:
        """Make the answer for a fitted session.

        Parameters
        ----------
        result : FitResult
            Result of any method.
        own : bool
            True to show `result`, False to show the recommended result of the session.
        """
        comparison = result.comparison
        if comparison is None:
            raise ValueError("this result was not made by adis_gonio.fit: its session is not known")
        shown = result if own else with_notes(comparison.best, result)
        return cls(shown, comparison, comparison.recommended, comparison.scores)

    @cached_property
    def values(self) -> dict[str, Value]:
        """Main results by name: `delta_k`, `delta_phi`, `angle`; in space scale factors, skews and biases.

        `angle` is the error of the calibrated angle. A result that the session does not determine is
        absent.
        """
        found = {**self.model_parameters, **self._angle()}
        if "delta_k" in found or "delta_phi" in found:
            return {name: found[name] for name in ("delta_k", "delta_phi", "angle") if name in found}
        return {name: value for stem in _SPATIAL for name, value in found.items() if name.startswith(stem)}

    @property
    def parameters(self) -> dict[str, Value]:
        """All parameters of the shown result, by name: the parameters of its model."""
        return self.model_parameters

    @property
    def model_parameters(self) -> dict[str, Value]:
        """Parameters of the base model (without further effects), by name."""
        return self.result.parameters

    @property
    def shows_another_method(self) -> bool:
        """True if the user chose a method that is not the recommended one."""
        return self.result.method != self.recommended.method

    def _angle(self) -> dict[str, Value]:
        """Error of the calibrated angle as an entry `angle` of the main results; empty in space."""
        return {} if self.result.angle is None else {"angle": self.result.angle}

    def error_curves(self) -> tuple[ErrorCurve | None, ErrorCurve]:
        """Return the error of the angle over the turn, without and with the calibration by this answer.

        The first is None if the sensor's scale is unknown.
        """
        return self.result.error_curves()

    @cached_property
    def budget(self) -> dict[str, tuple[BudgetRow, ...]]:
        """Uncertainty budget of each main result of a planar session, by name; empty in space."""
        return self.result.budget

    @property
    def title(self) -> str:
        """Name of the shown method, with the recommended effects, such as `ml with bias, quadratic`.

        For another method than the recommended one it names both: `paper (recommended is ml)`.
        """
        if self.shows_another_method:
            return f"{self.result.method} (recommended is {self.recommended.method})"
        effects = self.recommended.effects
        return self.recommended.method + (f" with {', '.join(effects)}" if effects else "")

    @property
    def why(self) -> str:
        """Reason for the recommended method, as one sentence."""
        text = self.recommended.why
        if self.shows_another_method:
            return f"Why {self.recommended.method}: {text}."
        return f"{text[:1].upper()}{text[1:]}."

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings to print first: wrong positions, and a residual larger than the measured noise."""
        return (*sentences_of(self.result.position_findings), *self.result.doubts)

    @property
    def lines(self) -> list[QuantityRow]:
        """Rows of the headline's table, one for each main result: quantity, unit, value, u, U, k."""
        return [QuantityRow.of(name, value) for name, value in self.values.items()]

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on the main results, such as the temperature at which they are valid; often none."""
        temperature = self.reference_temperature_c
        if temperature is None or MAIN & self.values.keys():
            return self._excess
        return (f"Parameters are valid at {temperature:.1f} °C, the mean of the session.", *self._excess)

    @property
    def _excess(self) -> tuple[str, ...]:
        """Sentence for the user if the rms error of the angle is larger than its U; otherwise empty."""
        angle = self.values.get("angle")
        if angle is None or angle.U is None or not angle.value > angle.U:
            return ()
        # Errors that one dwell has and that average out over the dwells of the fit, in degrees.
        single = [
            math.degrees(row.u / 1000) if row.unit == "mg" else row.u
            for row in self.budget.get("angle", ())
            if row.source in (REPEATABILITY, FLICKER, FIXTURE) and row.u and math.isfinite(row.u)
        ]
        placed = f"{format_number(math.hypot(*single), 2)}°"
        if angle.value <= math.hypot(angle.U, *(2 * u for u in single)):
            return (
                "The rms error of the angle is the error of single dwells, which contains noise and"
                f" placement on the stage (u {placed}). U and a statement of conformity are about the"
                " calibrated angle, in which they average out.",
            )
        return (
            "The rms error of the angle, on dwells that the fit did not use, is larger than U and the error"
            f" of a single dwell (u {placed}) explain. With few positions such a fit is weak; with many"
            " positions U is too small, and a statement of conformity is not safe.",
        )

    @property
    def reference_temperature_c(self) -> float | None:
        """Temperature at which the parameters are valid; None if the session has no temperatures."""
        return self.result.reference_temperature_c

    def text(self, width: int = 80) -> str:
        """Return the headline in plain text of at most `width` columns, after the lines of its doubts."""
        return "\n".join([*self.doubt_lines(width), *self.headline(width)])

    def doubt_lines(self, width: int = 80) -> list[str]:
        """Return the doubts about the result as sentences, folded to lines of at most `width` columns."""
        return [line for doubt in self.doubts for line in fold_text(doubt, width)]

    def headline(self, width: int = 80) -> list[str]:
        """Return lines of text that show the method, the main results, and the reason for the method."""
        return [
            f"Answer by method {self.title}",
            *align_columns([HEAD, *self.lines]),
            *fold_text(self.why, width, indent=2),
            *(line for remark in self.remarks for line in fold_text(remark, width, indent=2)),
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document that `adis-gonio fit --json` prints.

        It has the scores, the recommendation and the values of this result.
        """
        return self.result.as_dict() | json_object(
            recommended=self.recommended,
            scores=self.scores,
            answer=self.values,
            budget=self.budget,
            reference_temperature_c=self.reference_temperature_c,
        )

    # -- tables and lines of text -----------------------------------------------------------------

    def budget_rows(self) -> tuple[list[str], Rows]:
        """Return the head and the rows of the budget's table: one row for each source of uncertainty.

        A row gives the share of the source in the variance of each main result. Both lists are empty
        without a budget.
        """
        if not self.budget:
            return [], []
        names = [name if name == "angle" else NAMES.get(name, name) for name in self.budget]
        rows = []
        for each in zip(*self.budget.values(), strict=True):
            first = each[0]
            u = DASH if first.u is None else with_unit(format_number(first.u, 2), first.unit)
            shares = [format_share(row.share) for row in each]
            rows.append([first.source, first.kind, first.distribution, u, *shares])
        return ["source", "type", "distribution", "u of source", *names], rows

    @property
    def scored_as(self) -> str:
        """Name under which the shown model is listed in the scores."""
        return self.result.method

    def score_rows(self) -> tuple[list[str], Rows]:
        """Return the head and the rows of the table of scores: the errors of each method.

        All methods are scored on the same dwells. The shown method comes first; columns without a number
        are omitted.
        """
        order = sorted(self.scores, key=lambda name: name != self.scored_as)
        columns = {
            "angle, rms / °": [self.scores[name].angle_rms_deg for name in order],
            "largest / °": [self.scores[name].angle_max_deg for name in order],
            "residual, rms / mg": [self.scores[name].residual_rms_mg for name in order],
            "largest / mg": [self.scores[name].residual_max_mg for name in order],
        }
        shown = {head: column for head, column in columns.items() if any(c is not None for c in column)}
        rows = [[name, *(format_number(c[k]) for c in shown.values())] for k, name in enumerate(order)]
        return ["method", *shown], rows

    @property
    def scored_on(self) -> str:
        """Sentence that names the dwells used to compute the scores."""
        dwells = max((score.dwells for score in self.scores.values()), default=0)
        if not dwells:
            return "Methods cannot be compared: no dwell can be left out of a fit."
        same = counted(dwells, "dwell")
        return f"Errors of every method on the same {same}, each left out of its fit:"

    def facts(self) -> list[str]:
        """Return lines of text on the fit: its residual and, if gyro turns link the poses, these links."""
        r = self.result
        if r.dof:
            left = f"residual {r.residual_rms_mg:.3g} mg rms, χ² {r.chi2:.1f} at {r.dof} degrees of freedom"
        else:
            left = "no degree of freedom remains for a test of the model"
        return [left, *([] if r.links is None else [r.links.line])]

    def warnings(self, *, everything: bool = False) -> list[str]:
        """Return the warnings of the shown method, without its doubts.

        With `everything`, return the notes on the session and the warnings of all methods instead, each
        with the names of the methods that give it.
        """
        if not everything:
            return [text for text in self.result.warnings if text not in self.doubts]
        methods: dict[str, list[str]] = {}
        for result in self.comparison.results:
            for warning in result.warnings:
                methods.setdefault(warning, []).append(result.method)
        return [*self.result.session_notes, *(f"{', '.join(m)}: {w}" for w, m in methods.items())]


def with_notes(best: FitResult, given: FitResult) -> FitResult:
    """Return a copy of the recommended result `best` with the notes and findings on the session added.

    They come from `given`, another result of the same session; its notes precede the warnings of `best`.
    """
    if best.method == given.method:
        return given
    notes = given.session_notes
    return replace(
        best,
        warnings=(*best.doubts, *notes, *best.warnings),
        session_notes=notes,
        session=given.session,
        provenance=given.provenance,
        overrides=given.overrides,
        position_findings=given.position_findings,
        links=given.links,
    )


Rows = list[list[str]]


def parameter_row(name: str, value: Value) -> list[str]:
    """Return the cells of a table row for one parameter: name, unit, value, u, U, k, ν.

    ν are the degrees of freedom of u.
    """
    return [*QuantityRow.of(name, value), format_dof(value.dof) if value.u is not None else "–"]


def format_dof(dof: float) -> str:
    """Format degrees of freedom: `∞` if infinite, `> 10⁴` above this number."""
    if math.isinf(dof):
        return "∞"
    return "> 10⁴" if dof > 1e4 else f"{dof:.{0 if dof >= 10 else 1}f}"


def method_tables(results: Sequence[FitResult], most: int) -> Iterator[tuple[list[str], Rows]]:
    """Yield head and rows of tables that compare the parameters of all methods, as value ± U.

    Each table has one column per method, and at most `most` methods; ΔK and Δφ come first.
    """
    units = {name: one.unit for result in results for name, one in result.parameters.items()}
    names = sorted(units, key=lambda name: name not in ("delta_k", "delta_phi"))
    for start in range(0, len(results), most):
        part = results[start : start + most]
        rows = []
        for name in names:
            shown = (format_uncertain(r[name].value, r[name].U) if name in r else "" for r in part)
            rows.append([NAMES.get(name, name), format_unit(units[name]), *shown])
        rows.append(["residual, rms", "mg", *(f"{r.residual_rms_mg:.3f}" if r.dof else DASH for r in part)])
        rows.append(["χ² / dof", "", *(f"{r.chi2:.1f} / {r.dof}" if r.dof else "none left" for r in part)])
        yield ["parameter", "unit", *(f"{result.method}, ± U" for result in part)], rows


def format_share(fraction: float) -> str:
    """Format a share of a variance (a fraction, 0 to 1) in percent; zero becomes a dash."""
    return format_percent(fraction) if fraction > 0 else DASH
