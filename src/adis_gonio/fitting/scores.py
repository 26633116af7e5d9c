"""How well each method predicts the same readings: every dwell of the session, left out if it was fitted.

A method that saw two readings of twenty-four has small residuals at those two; here it has to predict all
of them, each without its own help. Where a closed form cannot do without a dwell it is run at the next
place of the turn: 90° and 180° in the place of 0° and 90° are the same method with another start angle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, mean_direction, wrap_radians
from adis_gonio.base.errors import FitError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.fitting.closed_form import model_without
from adis_gonio.fitting.determination import Determination
from adis_gonio.fitting.estimation.fit import Fit, Values
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.result import FitResult
from adis_gonio.model.measurement import PlanarTurn

MOST_FOLDS = 40
"""Dwells are left out one by one up to so many; beyond, every so many-th together."""


@dataclass(frozen=True)
class DwellPrediction:
    """What a model says of dwells: errors of the angle (n,), rad, residuals (n, r), mg; NaN unknown."""

    angle_rad: Floats
    residual_mg: Floats


@dataclass(frozen=True)
class Score(JsonRecord):
    """Errors of a method over the dwells on which all methods are compared.

    The JSON document is one entry of `scores`.

    Attributes
    ----------
    angle_rms_deg, angle_max_deg : float or None
        Angle computed by the calibrated goniometer minus declared angle; None without declared angles.
    residual_rms_mg, residual_max_mg : float or None
        Reading minus model at the attitude that fits the dwell best within the fixture's tolerance; in
        space the residual of the norm.
    dwells : int
        How many; with none the other figures are None.
    """

    angle_rms_deg: float | None
    angle_max_deg: float | None
    residual_rms_mg: float | None
    residual_max_mg: float | None
    dwells: int


def predictions(session: Readings, results: Sequence[FitResult]) -> dict[str, DwellPrediction]:
    """What each method says of every dwell of a session, by parameters that never saw it."""
    return {result.method: _of_method(session, result) for result in results}


def scores_of(found: Mapping[str, DwellPrediction]) -> dict[str, Score]:
    """Scores over the dwells that every one of the models predicts."""
    if not found:
        return {}
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
        if made.determination is not None:
            return _likelihood_without(made.noise.applied(rest), made.fit, made.determination)
        return model_without(result.method, rest, made.noise)

    return predicted(made.noise.applied(session), used, made.fit, again)


def predicted(
    data: Readings,
    used: NDArray[np.bool_],
    fit: Fit,
    again: Callable[[NDArray[np.bool_]], Fit],
) -> DwellPrediction:
    """Predictions of all dwells by `fit`, those `used` by `again(rows that are left)`.

    Parameters
    ----------
    data : Readings
        All dwells of the session, with the noise that was settled.
    again : callable
        Fit without some rows (n,) bool; `FitError` where the others do not determine it: NaN then.
    """
    n = len(data)
    columns = 2 if data.planar else 1
    angle, residual = np.full(n, np.nan), np.full((n, columns), np.nan)
    for left_out in _folds(used):
        if used[left_out].any():
            try:
                model = again(_mask(n, left_out))
            except FitError:
                continue
        else:
            model = fit
        angle[left_out], residual[left_out] = errors_of(model, data.rows(left_out))
    return DwellPrediction(angle, residual)


def errors_of(model: Fit, rows: Readings) -> tuple[Floats, Floats]:
    """Errors of the angle (n,) in rad and residuals (n, r) in mg of dwells that a model never saw."""
    there = model.on(replace(rows, fitted=model.data.fitted))
    if not rows.planar:
        norm = np.linalg.norm(_calibrated(there), axis=1, keepdims=True) - 1
        return np.full(len(rows), np.nan), norm * rows.gravity_mg
    shown = _shown(there)
    zero = float(model.values.base[0])
    if not model.data.visible[0]:
        own = _shown(model)
        own = own[np.isfinite(own)]
        zero = mean_direction(own) if own.size else math.nan
    return -wrap_radians(shown - zero), there.misfit


def _shown(fit: Fit) -> Floats:
    """Start angle (n,) in rad that each reading alone shows; NaN where no angle is declared."""
    gravity = _calibrated(fit)
    turn = fit.turn_rad if isinstance(fit.data.model, PlanarTurn) else np.zeros(len(fit.data))
    declared = np.isfinite(fit.data.angle_rad)
    return np.where(declared, np.arctan2(gravity[:, 1], gravity[:, 0]) - turn, np.nan)


def _calibrated(fit: Fit) -> Floats:
    """Gravity (n, axes) that the calibrated sensor computes from each reading alone."""
    beside = np.zeros(fit.data.mean.shape)
    for index, term in enumerate(fit.terms):
        if not term.enters_angle:
            beside = beside + fit.added(index)
    return fit.data.model.calibrated(fit.values.base, fit.data.mean - beside)


def _likelihood_without(rest: Readings, fit: Fit, found: Determination) -> Fit:
    """`ml` of the dwells that are left, from the values of all."""
    values = Values(fit.values.base, _attitude(fit, rest), fit.values.terms)
    start = replace(found, fit=Fit(rest, fit.terms, values, with_prior=False))
    again = start.refitted(replace(rest, fitted=fit.data.fitted))
    if not start.determined_by(again):
        raise FitError("the other dwells do not determine the parameters")
    return again


def _attitude(fit: Fit, rest: Readings) -> Floats:
    at = {position: k for k, position in enumerate(fit.data.position.tolist())}
    return np.asarray(fit.values.attitude[[at[position] for position in rest.position.tolist()]])


def _folds(used: NDArray[np.bool_]) -> Iterator[NDArray[np.intp]]:
    """Groups of dwells that are left out together; those that took no part as one."""
    inside, outside = np.flatnonzero(used), np.flatnonzero(~used)
    if len(outside):
        yield outside
    folds = min(MOST_FOLDS, len(inside))
    for first in range(folds):
        yield inside[first::folds]


def _mask(n: int, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
    mask = np.zeros(n, dtype=bool)
    mask[rows] = True
    return mask
