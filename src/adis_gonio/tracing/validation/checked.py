"""Whether dwells that took no part scatter as the noise says: the test behind the figure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit, adequacy
from adis_gonio.fitting.estimation.readings import Readings


def unexpected(fit: Fit, others: Readings, inflation: float = 1.0) -> float:
    """p-value of the residuals of dwells that took no part.

    About the fit a reading is predicted with the covariance 1 + X C Xᵀ of its noise and of the parameters
    (Cook and Weisberg, Residuals and Influence in Regression, 1982, chapter 2). What dwells share is taken
    as noise of each one's own.
    """
    alone = replace(others, own_covariance=others.covariance, slow=None)
    there = fit.on(alone)
    residual = there.residual.ravel() / np.sqrt(inflation)
    rows = there.jacobian
    size = min(rows.shape[1], len(fit.covariance))
    carried = rows[:, :size] @ _root(fit.covariance[:size, :size])
    spread = np.eye(len(rows)) + carried @ carried.T
    distance = float(residual @ np.linalg.solve(spread, residual))
    return adequacy(distance, there.equations, others.noise_dof)


def _root(covariance: Floats) -> Floats:
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
