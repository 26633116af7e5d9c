"""Which method's answer is recommended, by what the data determine and by scores on the same readings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import counted
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.methods import applicable_to, default_method, fit_of
from adis_gonio.fitting.result import FitResult
from adis_gonio.fitting.scores import DwellPrediction, Score, predictions, scores_of

BEYOND = 3.0
"""Standard errors of the paired difference of squared errors beyond which one method predicts better."""
ALIKE = 0.01
"""Relative difference of uncertainties below which they do not count."""


@dataclass(frozen=True)
class Recommendation(JsonRecord):
    """The method whose answer to take, and why, in one sentence.

    The JSON document is the value of `recommended`.
    """

    document_keys = ("method", "effects", "why")

    method: str
    why: str
    effects: tuple[str, ...] = ()


@dataclass(frozen=True)
class Standing:
    """All methods of a session beside each other.

    Attributes
    ----------
    results : tuple of FitResult
        In the order of `METHODS`.
    failures : mapping of str to str
        Why other methods give nothing.
    predictions : mapping of str to DwellPrediction
        What each says of every dwell without having seen it.
    scores : mapping of str to Score
    recommended : Recommendation
    """

    results: tuple[FitResult, ...]
    failures: dict[str, str]
    predictions: dict[str, DwellPrediction]
    scores: dict[str, Score]
    recommended: Recommendation

    @property
    def best(self) -> FitResult:
        """The recommended method's result."""
        return next(result for result in self.results if result.method == self.recommended.method)


def standing_of(session: Readings) -> Standing:
    """Every method that a session supports, scored and judged; worked out once and kept with the readings.

    Raises
    ------
    FitError
        If no method gives a result.
    """
    kept: Standing | None = vars(session).get("_standing")
    if kept is None:
        kept = _worked_out(session)
        vars(session)["_standing"] = kept
    return kept


def _worked_out(session: Readings) -> Standing:
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
    return Standing(
        tuple(results), failures, found, scores, recommend(results, found, scores, default_method(training))
    )


def recommend(
    results: Sequence[FitResult],
    found: Mapping[str, DwellPrediction],
    scores: Mapping[str, Score],
    preferred: str,
) -> Recommendation:
    """Choose a method.

    1. Where a method determines the biases, those that take them as zero are out.
       So is `paper` where another is left: its u leaves out the error of its own equation 5.
    2. Of the rest, those that predict the session's dwells as well as the best one.
    3. Of these, the one with the smallest uncertainty of ΔK and Δφ; among equals `preferred`.
    """
    sighted = [result for result in results if "bias_x" in result]
    able = sighted or list(results)
    able = [result for result in able if result.method != "paper"] or able
    scored = bool(scores) and all(scores[result.method].dwells for result in able)
    good = able
    if scored:
        first = min(able, key=lambda r: _rms(scores[r.method]))
        good = [r for r in able if not surely_worse(found[r.method], found[first.method])]
    least = min(_doubt(result) for result in good)
    equal = [result for result in good if _doubt(result) <= least * (1 + ALIKE)]
    names = [result.method for result in equal]
    chosen = preferred if preferred in names else names[-1]
    result = next(result for result in equal if result.method == chosen)
    return Recommendation(chosen, _why(result, results, good, scores, scored))


def _squares(prediction: DwellPrediction) -> Floats:
    """Squared error of each dwell, of the angle where it is declared."""
    if np.isfinite(prediction.angle_rad).any():
        return np.asarray(prediction.angle_rad**2)
    return np.asarray((prediction.residual_mg**2).mean(axis=1))


def _rms(score: Score) -> float:
    return float(score.residual_rms_mg or 0.0) if score.angle_rms_deg is None else score.angle_rms_deg


def surely_worse(one: DwellPrediction, best: DwellPrediction) -> bool:
    """True where the squared errors of `one` are larger by more than `BEYOND` standard errors."""
    base = _squares(best)
    difference = _squares(one) - base
    difference = difference[np.isfinite(difference)]
    if len(difference) < 3:
        return False
    scatter = float(difference.std(ddof=1)) / math.sqrt(len(difference))
    mean = float(difference.mean())
    return mean > BEYOND * scatter and mean > 1e-3 * float(np.nanmean(base))


def _doubt(result: FitResult) -> float:
    """Product of the uncertainties of what is wanted: smaller is surer."""
    wanted = ("delta_k", "delta_phi") if "delta_k" in result or "delta_phi" in result else ()
    us = [e.u for e in result.parameters if not wanted or e.name in wanted]
    if any(u is None or not math.isfinite(u) for u in us):
        return math.inf
    return math.exp(sum(math.log(max(u or 0.0, 1e-300)) for u in us) / max(len(us), 1))


def _why(
    result: FitResult,
    results: Sequence[FitResult],
    good: Sequence[FitResult],
    scores: Mapping[str, Score],
    scored: bool,
) -> str:
    if len(results) == 1:
        return "the only method that this session supports"
    reasons = []
    if "bias_x" in result and any("bias_x" not in other for other in results):
        reasons.append("it determines the biases")
    elif "bias_x" not in result:
        reasons.append("no method sees the biases in these positions, which are taken as zero")
    if scored:
        own = scores[result.method]
        said = (
            f"{own.angle_rms_deg:.2g}° rms"
            if own.angle_rms_deg is not None
            else f"{own.residual_rms_mg:.2g} mg rms"
        )
        how = "as well as any" if len(good) > 1 else "best"
        reasons.append(
            f"it predicts the {counted(own.dwells, 'dwell')} {how}, each left out of its fit ({said})"
        )
    else:
        reasons.append("no dwell can be left out to compare the methods by")
    if len(good) > 1 and _doubt(result) < math.inf:
        reasons.append("no other is surer of ΔK and Δφ")
    return "; ".join(reasons)
