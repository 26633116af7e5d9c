"""Errors on dwells that took no part: `check` dwells, else folds with the selection inside the fold.

Folds are made of whole dwells: every fifth one; where positions repeat so that no fold leaves a gap of
angles, blocks of time; and all dwells about one body axis. Plain leave-one-out flatters a model where poses
repeat: another dwell of the same pose stands in for the one that was left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, wrap_radians
from adis_gonio.base.budget import check, told
from adis_gonio.fitting.estimation.fit import Fit, foreseen
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.tracing.thresholds import limits

BY_AXIS = "body axes"
BLOCKS_OF_TIME = "blocks of time"


@dataclass(frozen=True)
class Left:
    """What a model leaves on dwells that took no part.

    Attributes
    ----------
    residual : (n, axes) float
        Reading minus model at the attitude that fits this dwell best within the fixture's tolerance.
    angle_rad : (n,) float or None
        Angle by the calibrated goniometer minus declared angle.
    predicted : (n,) bool
        Dwells of which the model that was fitted without them knows where they lie.
    """

    residual: Floats
    angle_rad: Floats | None
    predicted: NDArray[np.bool_]

    def rows(self, index: NDArray[np.bool_]) -> Left:
        """Some of the dwells."""
        turned = None if self.angle_rad is None else self.angle_rad[index]
        if turned is not None and np.isnan(turned).any():
            turned = None
        return Left(self.residual[index], turned, self.predicted[index])


@dataclass(frozen=True)
class Chosen:
    """A model fitted without the dwells of a fold.

    Attributes
    ----------
    fit : Fit
        What predicts the dwells that are left out.
    by : Fit
        The one by which is judged what it knows: the choice behind an average, which has no columns of its
        own; else the same.
    """

    fit: Fit
    by: Fit


def leave(fit: Fit, data: Readings) -> Left:
    """Residuals of a fitted model on other dwells."""
    there = fit.on(data)
    turned = fit.angle_error_rad(data)
    return Left(there.misfit, turned, np.ones(len(data), dtype=bool))


def rms(residual: Floats, by_axis: bool) -> float:
    """Root mean square: over the readings of all axes, or of the norm's residual (`Readings.by_axis`)."""
    squares = residual**2
    return float(np.sqrt(squares.mean() if by_axis else squares.sum(axis=1).mean()))


def folds(data: Readings) -> dict[str, list[NDArray[np.bool_]]]:
    """Fold designs that apply: name → masks (n,) of the dwells that are left out."""
    n = len(data)
    count = min(limits.folds, n) if n > limits.alone else n
    order = np.arange(n)
    # A fixed shuffle, so that no fold holds every fifth angle of a turn only.
    shuffled = np.random.default_rng(5).permutation(n)
    designs = {"whole dwells": [shuffled % count == k for k in range(count)]}
    blocks = [order * limits.blocks // n == k for k in range(limits.blocks)]
    if n >= 2 * limits.blocks and _poses_repeat(data, blocks):
        designs[BLOCKS_OF_TIME] = blocks
    by_axis = _about_axes(data)
    if by_axis and 3 * int(determined(data, by_axis).sum()) >= n:
        designs[BY_AXIS] = by_axis
    return designs


def _about_axes(data: Readings) -> list[NDArray[np.bool_]]:
    """Masks (n,) of the dwells whose gravity lies nearest each end of each body axis.

    In one plane only where positions repeat, since a turn whose positions are all different has no dwell
    that stands in for another, and a quarter of it that is missing is another session.
    """
    if data.planar:
        theta = data.conditions.angle_rad
        if theta is None:
            return []
        apart = np.abs(wrap_radians(theta[:, None] - theta[None, :]))
        if 2 * int(((apart < np.deg2rad(limits.repeated_deg)).sum(axis=1) > 1).sum()) < len(data):
            return []
    pose = data.model.pose(data.mean, data.conditions)
    if pose is None:
        return []
    nearest = np.abs(pose).argmax(axis=1)
    up = np.take_along_axis(pose, nearest[:, None], axis=1)[:, 0] > 0
    groups = 2 * nearest + up
    return [groups == group for group in np.unique(groups)]


def counting(
    data: Readings, designs: Mapping[str, list[NDArray[np.bool_]]], model: Sequence[Term]
) -> dict[str, NDArray[np.bool_]]:
    """Dwells (n,) that count as predicted under each design, with a model of all dwells.

    Under the designs that leave out whole ranges of angle or time these are the dwells that the others
    predict by the base model and, where the model has functions without a name, by these: a quarter of a
    turn that was left out says nothing of a function that has harmonics there, nor does the first dwell of
    a jump that only it has seen.
    """
    nameless = [term for term in model if term.name is None]
    every = np.ones(len(data), dtype=bool)
    counts = {}
    for name, masks in designs.items():
        counts[name] = every
        if name == BY_AXIS or (nameless and name == BLOCKS_OF_TIME):
            counts[name] = determined(data, masks, nameless)
            if name == BY_AXIS:
                counts[name] &= data.model.by_pose(data.conditions)
            if 3 * int(counts[name].sum()) < len(data):
                del counts[name]
    return counts


def determined(
    data: Readings, masks: Sequence[NDArray[np.bool_]], beside: Sequence[Term] = ()
) -> NDArray[np.bool_]:
    """Dwells (n,) that the dwells outside their fold predict by the base model with a bias on each axis.

    With X the whitened columns, the prediction of held-out rows has covariance 1 + X_b (X₋bᵀ X₋b)⁻¹ X_bᵀ in
    units of the noise. A dwell counts up to a variance of four; beyond, its error is that of a fit
    that has never seen the axis, not of the model.

    Parameters
    ----------
    beside : sequence of Term
        Terms whose columns are determined as well.
    """
    begun = Fit.begin(data)
    zero = np.tile(data.model.size * np.eye(data.axes), (len(data), 1, 1))
    more = [begun.candidate(term) for term in beside]
    columns = begun.white_by_dwell(np.concatenate([begun.base_columns, zero, *more], axis=2))
    out = np.zeros(len(data), dtype=bool)
    for mask in masks:
        out[mask] = foreseen(columns[~mask].reshape(-1, columns.shape[2]), columns[mask], limits.predicted)
    return out


def _poses_repeat(data: Readings, blocks: list[NDArray[np.bool_]]) -> bool:
    """True where every dwell left out has a neighbour: 2.5 steps of angle, in space 45° away."""
    if not data.planar:
        unit = data.model.pose(data.mean, data.conditions)
        if unit is None:
            return False
        near = np.arccos(np.clip(unit @ unit.T, -1, 1)) < np.pi / 4
        return all(bool(near[np.ix_(b, ~b)].any(axis=1).all()) for b in blocks)
    theta = data.conditions.angle_rad
    if theta is None:
        return False
    turn = 2 * np.pi
    step = turn / max(len(np.unique(np.round(np.mod(theta, turn), 3))), 1)
    for block in blocks:
        gap = wrap_radians(theta[block][:, None] - theta[~block][None, :])
        if not (np.abs(gap).min(axis=1) < 2.5 * step).all():
            return False
    return True


def cross_validate(
    data: Readings,
    designs: dict[str, list[NDArray[np.bool_]]],
    fit: Callable[[Readings], Chosen],
) -> dict[str, Left]:
    """Left-out residuals of all dwells under each design; `fit` selects and fits on the other dwells."""
    out = {}
    folds_in_all, begun = sum(map(len, designs.values())), 0
    for name, masks in designs.items():
        residual = np.full(data.mean.shape, np.nan)
        turned = np.full(len(data), np.nan)
        predicted = np.ones(len(data), dtype=bool)
        for mask in told(masks, begun, folds_in_all):
            check()
            answer = fit(data.rows(~mask))
            predicted[mask] = answer.by.foresees(data.rows(mask), limits.predicted)
            left = leave(answer.fit, data.rows(mask))
            residual[mask] = left.residual
            if left.angle_rad is not None:
                turned[mask] = left.angle_rad
        begun += len(masks)
        out[name] = Left(residual, turned, predicted)
    return out


def counted(left: Mapping[str, Left], counts: Mapping[str, NDArray[np.bool_]]) -> list[Left]:
    """Left-out residuals of the dwells that count, design by design."""
    return [left[name].rows(own) for name, own in counts.items()]


def less_unknown(
    counts: Mapping[str, NDArray[np.bool_]], anew: Mapping[str, Left]
) -> dict[str, NDArray[np.bool_]]:
    """Dwells that count, less those that a model chosen without them does not pretend to know.

    Without the quarter of a turn that shows it, or a fifth of a few poses, another effect is chosen that
    fits the rest as well, and whose parameters leave what is missing open by many mg: its covariance says
    so. Designs that have less than a third of the dwells left do not apply, unless none does.
    """
    out = {}
    for name, own in counts.items():
        rest = own & anew[name].predicted
        if 3 * int(rest.sum()) >= len(rest):
            out[name] = rest
    return out or dict(counts)
