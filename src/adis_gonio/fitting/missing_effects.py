"""Effects of the catalogue as a source of uncertainty, for a model that does not describe its session.

If the residual is larger than the noise, some effect is missing, and it also moves the fitted parameters.
Each amplitude θ of the catalogue is given a normal prior about zero. Its standard deviation is the typical
size in the catalogue times one common factor s ≥ 1, which maximizes the likelihood of the residual r:

    r ~ N(0, 1 + s² W Wᵀ),  W = whitened columns of typical size, without the part that the fit describes

The posterior of θ then has the second moment M + μ μᵀ with M = (s⁻² + Wᵀ W)⁻¹ and μ = M Wᵀ r. The fit
leaves the effects out, so the error that they cause has this second moment, and not the variance M alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.model.effects import AXES, Enters, catalogue

_DESCRIBED = 1e-6
"""Relative size of a column's remainder below which it is a combination of the parameters' columns."""
_LARGEST_FACTOR = 1e4


def missing_effects(fit: Fit) -> Floats:
    """Return inputs (n, axes, k) in mg, each at one standard uncertainty, that the model lacks.

    Parameters
    ----------
    fit : Fit
        The model that does not describe the session, on readings whose noise has the scatter of the
        residual in it: scatter without any structure is the rival explanation.
    """
    columns = np.concatenate([*_columns(fit), np.zeros((*fit.data.mean.shape, 0))], axis=2)
    white = fit.white(columns)
    size = np.linalg.norm(white, axis=0)
    remaining = _without(white, fit.jacobian)
    shown = np.linalg.norm(remaining, axis=0) > _DESCRIBED * size
    columns, remaining = columns[:, :, shown], remaining[:, shown]
    if not columns.shape[2]:
        return columns
    residual = _without(fit.residual.reshape(-1, 1), fit.jacobian)[:, 0]
    # In the basis of the singular vectors the amplitudes are independent.
    left, singular, right = np.linalg.svd(remaining, full_matrices=False)
    along = left.T @ residual
    factor = _factor(singular**2, along**2)
    # Directions of θ that the residual does not show keep the prior s².
    precision = factor**-2 + singular**2
    mean = right.T @ (singular * along / precision)
    moment = factor**2 * np.eye(columns.shape[2])
    moment += (right.T * (1 / precision - factor**2)) @ right + np.outer(mean, mean)
    values, vectors = np.linalg.eigh(moment)
    return np.asarray(columns @ (vectors * np.sqrt(np.maximum(values, 0.0))))


def _columns(fit: Fit) -> Iterator[Floats]:
    """Yield columns (n, axes, d) of each effect that acts on readings of this session, at typical size."""
    data = fit.data
    for kind in catalogue(data.model.part).values():
        beside_readings = kind.enters is Enters.SAMPLES or kind.within_dwell
        # A choice is a discrete number (a dwell, a degree): the scatter of the readings stands for these.
        if beside_readings or kind.choices() or data.conditions.lacks(kind.needs):
            continue
        effect = kind(AXES[: data.axes] if kind.by_axis else ())
        parameters = effect.parameters
        shapes = tuple((k, p.typical) for k, p in enumerate(parameters) if p.shape)
        term = NamedTerm(effect.name, (), 0.0, effect, shapes)
        yield fit.candidate(term) * np.array([parameters[k].typical for k in term.amplitudes])


def _without(rows: Floats, columns: Floats) -> Floats:
    """Rows (m, d) less the part that a linear combination of columns (m, p) describes."""
    return np.asarray(rows - columns @ np.linalg.lstsq(columns, rows, rcond=1e-9)[0])


def _factor(strength: Floats, power: Floats) -> float:
    """Factor s, 1 to 10⁴, on the sizes of independent amplitudes that maximizes the likelihood.

    Parameters
    ----------
    strength, power : (k,) float
        Squares of the singular values, and of the residual along the singular vectors.
    """
    from scipy.optimize import minimize_scalar

    def deviance(log_factor: float) -> float:
        variance = 1 + math.exp(2 * log_factor) * strength
        return float((np.log(variance) + power / variance).sum())

    bounds = (0.0, math.log(_LARGEST_FACTOR))
    return math.exp(float(minimize_scalar(deviance, bounds=bounds, method="bounded").x))
