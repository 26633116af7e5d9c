"""Held-out evidence against single effects of a chosen model.

About the fitted state the model is linear, so that a fold is left out by linear algebra: with X the
whitened columns, the held-out rows have error e = y_b − X_b β₋b with covariance
V = 1 + X_b (X₋bᵀ X₋b)⁻¹ X_bᵀ (Cook and Weisberg, Residuals and Influence in Regression, 1982). Directions
in which V says that the larger model cannot predict the fold (a parameter that only these rows determine)
are no evidence and are left out for both models; the rest is compared under a loss that grows slowly, so
that no single row decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adis_gonio.estimation.fit import Fit
from adis_gonio.model.records import Floats
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.validation.leaving_out import folds


@dataclass(frozen=True)
class HeldOutGain:
    """What one effect gains on folds that took no part.

    Attributes
    ----------
    gain : float
        Pooled fall of the robust loss in units of χ²; negative for a loss.
    spread : float
        Root of the sum of squares of the folds' gains: the standard deviation of `gain` if it is zero.
    """

    gain: float
    spread: float

    @property
    def contradicted(self) -> bool:
        """True where the folds speak against the effect, not merely fail to confirm it."""
        return self.gain < -max(limits.least_loss, limits.contradicted * self.spread)

    @property
    def confirmed(self) -> bool:
        """True where the folds together speak for the effect."""
        return self.gain > limits.confirmed * self.spread


def contradicting(gains: Mapping[str, HeldOutGain]) -> dict[str, HeldOutGain]:
    """Designs that contradict an effect.

    A design that leaves out what alone shows the effect has next to nothing to say, and its few χ² of
    noise do not count against the hundred that another design gains.
    """
    most = max((held_out.gain for held_out in gains.values()), default=0.0)
    return {
        design: held_out
        for design, held_out in gains.items()
        if held_out.contradicted and -held_out.gain > limits.small_loss * most
    }


def held_out_gains(fit: Fit, members: Sequence[int], inflation: float = 1.0) -> dict[str, HeldOutGain]:
    """Gain of the terms `members` of a fitted model beside its others, by fold design.

    Parameters
    ----------
    members : sequence of int
        Positions in `fit.terms`.
    inflation : float
        Factor on the noise variance.
    """
    base, blocks, target = fit.linear()
    root = np.sqrt(inflation)
    target = target / root
    whole = np.concatenate([base, *blocks], axis=1) / root
    without = np.concatenate([base, *(b for k, b in enumerate(blocks) if k not in members)], axis=1) / root
    rows = len(target) // len(fit.data)
    out = {}
    for name, masks in folds(fit.data).items():
        gains = np.array([_fold(whole, without, target, np.repeat(mask, rows)) for mask in masks])
        out[name] = HeldOutGain(float(gains.sum()), float(np.sqrt((gains**2).sum())))
    return out


def _fold(whole: Floats, without: Floats, target: Floats, left: NDArray[np.bool_]) -> float:
    error, variance = _predicted(whole, target, left)
    values, directions = np.linalg.eigh(variance)
    directions = directions[:, values < limits.predicted]
    if not directions.shape[1]:
        return 0.0
    other, other_variance = _predicted(without, target, left)
    return _loss(other, other_variance, directions) - _loss(error, variance, directions)


def _predicted(columns: Floats, target: Floats, left: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Held-out error and its covariance by a fit to the other rows."""
    size = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(size > 0, size, 1.0)
    u, s, vt = np.linalg.svd(scaled[~left], full_matrices=False)
    # What the other rows do not determine keeps a large variance instead of a silent zero.
    s_safe = np.maximum(s, 1e-6 * max(float(s[0]), 1e-300))
    carried = scaled[left] @ (vt.T / s_safe)
    missing = scaled[left] - scaled[left] @ vt.T @ vt  # more parameters than rows
    error = target[left] - carried @ (u.T @ target[~left])
    variance = np.eye(int(left.sum())) + carried @ carried.T + 1e12 * missing @ missing.T
    return error, variance


def _loss(error: Floats, variance: Floats, directions: Floats) -> float:
    scale = np.einsum("ik,ij,jk->k", directions, variance, directions)
    squares = (directions.T @ error) ** 2 / scale
    return float((limits.robust**2 * np.log1p(squares / limits.robust**2)).sum())
