"""An unknown cause in addition to every model, for sessions in which no model is adequate.

If no model explains the residual, the models are compared although all of them are wrong, and one of them
would get nearly all of the posterior. The misfit is then modelled as a random function: a Gaussian process
that is a sum of a smooth function of each covariate and of a function of all covariates together. It is a
part of the noise of the readings, with the size of the greatest evidence. A name or a covariate has to
stand out against it (Kennedy and O'Hagan, Bayesian calibration of computer models, J. R. Stat. Soc. B 63,
2001).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.tracing.linear_problem import LinearProblem, span
from adis_gonio.tracing.model_search import Model, search, weigh
from adis_gonio.tracing.selection import Selection
from adis_gonio.tracing.session_blocks import orthonormal

LENGTH, WIDTH = 0.3, 0.65
"""Distances over which the correlation of the process decays: in a covariate, in the direction of gravity.
The first is in units of the covariate's range, the second is a distance between unit vectors."""
SIZES = np.geomspace(0.5, 500.0, 31)
"""Standard deviations of the process that are tried, in standard uncertainties of a reading."""
MOST_ROWS = 600
"""Largest number of whitened readings for which the covariance of the process is computed."""


def beside_unknown_cause(selection: Selection, max_terms: int) -> Selection:
    """Return a selection with the posterior of its models in competition with an unknown cause.

    The unknown cause is a Gaussian process in all covariates. The chosen model and its fit stay. A
    selection that is adequate, or with unknown noise, is returned unchanged. `max_terms` is the largest
    number of terms of a model.
    """
    data, problem = selection.data, selection.problem
    if selection.adequate or not data.noise_known or len(problem.target) > MOST_ROWS or not max_terms:
        return selection
    features = unknown_features(selection.fit)
    best = selection.verdict.best
    model: Model = tuple(k for k in best if problem.terms[k].constant)
    for _ in range(2):  # the size in addition to the bias alone, then to the best model
        beside = problem.with_covariance(features * likeliest_size(problem, model, features))
        found = search(beside, max_terms)
        model = found.best
    verdict = replace(weigh(found), best=best)
    return replace(selection, problem=beside, found=found, verdict=verdict)


def unknown_features(fit: Fit) -> Floats:
    """Return whitened features (rows, k) of an unknown cause: F Fᵀ is the covariance of the process.

    The Gaussian process has a standard deviation of one standard uncertainty of a reading. The features are
    projected off the base model.
    """
    c = fit.data.conditions
    unit = fit.ideal / np.linalg.norm(fit.ideal, axis=1)[:, None]
    kernels = [np.exp((unit @ unit.T - 1) / WIDTH**2)]
    for values in (c.time_s, c.temperature_c, c.supply_v):
        if values is not None and np.ptp(values) > 0:
            apart = (values[:, None] - values) / np.ptp(values)
            kernels.append(np.exp(-0.5 * (apart / LENGTH) ** 2))
    kernel = 0.5 * np.mean(kernels, axis=0) + 0.5 * np.prod(kernels, axis=0)
    values, vectors = np.linalg.eigh(kernel)
    root = vectors * np.sqrt(np.maximum(values, 0.0) * fit.data.variance_of_mean.mean())
    n, axes = fit.ideal.shape
    # The same process for each axis, independent of the other axes.
    columns = np.einsum("ab,nk->nabk", np.eye(axes), root).reshape(n, axes, -1)
    base = orthonormal(fit.white(fit.base_columns))
    white = fit.white(columns)
    return white - base @ (base.T @ white)


def likeliest_size(problem: LinearProblem, model: Model, features: Floats) -> float:
    """Return the size of the unknown cause with the greatest restricted likelihood, of the sizes to try.

    The size is the standard deviation of the unknown cause, in standard uncertainties of a reading. The
    unknown cause acts in addition to the terms of `model`. At size 1 it has the covariance F Fᵀ of
    `features` F.
    """
    basis, residual = span(problem, model)
    rest = features - basis @ (basis.T @ features)
    values, vectors = np.linalg.eigh(rest @ rest.T)
    grown = 1 + np.outer(SIZES**2, np.maximum(values, 0.0))
    loss = ((vectors.T @ residual) ** 2 / grown + np.log(grown)).sum(axis=1)
    return float(SIZES[np.argmin(loss)])
