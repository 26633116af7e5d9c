"""Gaussian process of the residual with a length scale a covariate (scikit-learn); gives no names."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ..circumstances import Circumstances, Floats
from .common import Prepared, predictions, tuned


def covariates(c: Circumstances, a: Floats) -> dict[str, Floats]:
    """Covariates of a session by word, (n, columns) each, of standard deviation 1."""
    out = {"time": c.time_s[:, None], "pause": c.pause_s[:, None]}
    if c.plane:
        out["angle"] = np.column_stack([np.cos(c.angle_rad), np.sin(c.angle_rad)])
    else:
        out["reading"] = a
    if not np.isnan(c.temp_c).any():
        out["temperature"] = c.temp_c[:, None]
    if not np.isnan(c.supply_v).any():
        out["supply"] = c.supply_v[:, None]
    if np.ptp(c.approach) > 0:
        out["approach"] = c.approach[:, None]
    return {k: (v - v.mean(axis=0)) / np.maximum(v.std(axis=0), 1e-9) for k, v in out.items()}


def residual(prepared: Prepared) -> Floats:
    """Residual of the base model in units of its noise, (n, rows a dwell); NaN in check dwells."""
    linear, c = prepared.linear, prepared.linear.c
    values, _ = prepared.white.solve(np.zeros((len(linear.e), 0)))
    left = (linear.e - linear.base @ values) / np.sqrt(np.diag(linear.covariance))
    out = left.reshape(-1, c.n).T
    out[c.check] = np.nan
    return out


def bent(prepared: Prepared, bend: Floats) -> dict[str, Any]:
    """Predictions of the check dwells by the base model and a function of the covariates.

    `bend` (n, rows a dwell) is that function at every dwell, in units of the noise.
    """
    linear = prepared.linear
    values, _ = prepared.white.solve(np.zeros((len(linear.e), 0)))
    left = linear.e - linear.base @ values - bend.T.ravel() * np.sqrt(np.diag(linear.covariance))
    return predictions(linear.c, linear, prepared.filled, left, prepared.hidden)


def answer(directory: Path) -> dict[str, Any]:
    """Covariates without which the marginal likelihood falls; predictions with the process added."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    prepared = Prepared(directory, single_dwells=False)
    c = prepared.linear.c
    y = residual(prepared)
    use = ~c.check
    words = covariates(c, prepared.linear.ideal_g)

    def fit(kept: list[str]) -> tuple[float, Any, Any]:
        x = np.hstack([words[k] for k in kept])
        kernel = ConstantKernel(1.0, (1e-2, 1e3)) * RBF(np.ones(x.shape[1]), (0.2, 50)) + WhiteKernel(
            1.0, (0.5, 3.0)
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = GaussianProcessRegressor(kernel, n_restarts_optimizer=0, random_state=0).fit(
                x[use], y[use]
            )
        return float(model.log_marginal_likelihood_value_), model, x

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        flat = GaussianProcessRegressor(WhiteKernel(1.0, (0.5, 3.0))).fit(np.zeros((use.sum(), 1)), y[use])
    kept: list[str] = []
    level, model, x = float(flat.log_marginal_likelihood_value_), None, None
    while len(kept) < 3:
        trials = {w: fit([*kept, w]) for w in words if w not in kept}
        word = max(trials, key=lambda w: trials[w][0])
        if 2 * (trials[word][0] - level) < tuned("gaussian_process")["gain"]:
            break
        kept.append(word)
        level, model, x = trials[word]
    out = prepared.answer([])
    out["covariates"] = sorted(kept)
    best = 2 * (level - float(flat.log_marginal_likelihood_value_))
    out["something"] = (
        float(1 / (1 + np.exp(-np.clip(best / 2 - np.log(10), -50, 50)))) if kept else out["something"]
    )
    if model is not None:
        out["heldout"] = bent(prepared, np.reshape(model.predict(x), (c.n, -1)))
    return out
