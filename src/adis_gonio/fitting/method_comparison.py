"""Comparison of the methods on all dwells of a session, and the recommended method.

Each method predicts every dwell without having seen it: dwells that were fitted are left out of a new fit.
A method that saw two readings of twenty-four has small residuals at those two; here it has to predict all
of them. If a closed form needs a dwell that is left out, it runs at the next quarter of the turn: 90° and
180° instead of 0° and 90° are the same method with another start angle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import counted
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.fit_result import FitResult, differences_of_angle, start_angle
from adis_gonio.fitting.methods import METHOD_TABLE, applicable_to, default_method, fit_of

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
    found = predictions(session, results)
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
        error = (
            f"{own.angle_rms_deg:.2g}° rms"
            if own.angle_rms_deg is not None
            else f"{own.residual_rms_mg:.2g} mg rms"
        )
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
    wanted = ("delta_k", "delta_phi") if "delta_k" in result or "delta_phi" in result else ()
    us = [e.u for e in result.parameters if not wanted or e.name in wanted]
    if any(u is None or not math.isfinite(u) for u in us):
        return math.inf
    return math.exp(sum(math.log(max(u or 0.0, 1e-300)) for u in us) / max(len(us), 1))


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


def predictions(session: Readings, results: Sequence[FitResult]) -> dict[str, DwellPrediction]:
    """Return the prediction errors of every dwell by each method, from fits without this dwell."""
    return {result.method: _of_method(session, result) for result in results}


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


def _of_method(session: Readings, result: FitResult) -> DwellPrediction:
    made = result.origin
    assert made is not None
    used = np.isin(session.position, result.positions) & ~session.check

    def again(left_out: NDArray[np.bool_]) -> Fit:
        rest = session.rows(~session.check & ~left_out)
        return METHOD_TABLE[result.method].refit(made.noise.applied(rest), made)

    return predicted(made.noise.applied(session), used, made.fit, again)


def predicted(
    data: Readings,
    used: NDArray[np.bool_],
    fit: Fit,
    again: Callable[[NDArray[np.bool_]], Fit],
) -> DwellPrediction:
    """Return the prediction errors of all dwells, each by a fit that does not use this dwell.

    Parameters
    ----------
    data : Readings
        All dwells of the session, with the estimated noise.
    used : (n,) bool
        True for the dwells that `fit` used; `fit` predicts the others.
    again : callable
        Function that repeats the fit without the dwells at which its argument (n,) is True. If it raises
        `FitError`, the prediction errors of these dwells are NaN.
    """
    n = len(data)
    columns = 2 if data.planar else 1
    angle, residual = np.full(n, np.nan), np.full((n, columns), np.nan)
    for left_out in held_out_groups(used):
        if used[left_out].any():
            try:
                model = again(np.isin(np.arange(n), left_out))
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
