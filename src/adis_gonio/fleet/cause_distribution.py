"""Distribution of the amplitude of a cause over the sessions: share of affected sessions, mean, spread."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences, log_sum_exp
from adis_gonio.base.uncertainty import Value
from adis_gonio.fleet.population_likelihood import MOST_OF_KNOWN, mixed
from adis_gonio.fleet.population_selection import ChosenCause, Population, group_at, parameters_of

_LEVELS = (0.025, 0.975)
_SHARES = np.concatenate([np.linspace(0.005, 0.2, 40), np.linspace(0.21, 1.0, 80)])
_FACTORS = np.geomspace(0.4, 2.5, 9)
"""Factors by which the most probable mean and spread of a cause are multiplied for a grid of trials.

The posterior of the share of affected sessions is averaged over this grid.
"""

_STEP = 0.05
"""Step of the derivatives by the parameters of a distribution (`parameters_of`)."""


def share_of(
    population: Population, others: Sequence[ChosenCause], part: ChosenCause
) -> tuple[float, float, float]:
    """Estimate the share of sessions that a cause affects, with its 95 % interval.

    `part` is the cause, `others` are the other causes in the model. Returns the posterior mean and both
    ends of the 95 % interval, for a uniform prior.
    """
    # Only sessions of the group that could show the cause.
    inside = part.group.inside & population.units.seen(part.candidate.index)
    given = population.given_others(others, part).inside(inside)
    log_posterior = []
    centred = bool((part.amplitudes.mean == 0).all())
    means = (np.ones(1) if centred else _FACTORS)[:, None] * part.amplitudes.mean
    for spread in part.amplitudes.spread * _FACTORS:
        factors = given.log_factors(means, spread)
        log_posterior += [mixed(factors, share, MOST_OF_KNOWN).sum(axis=0) for share in _SHARES]
    by_share = log_sum_exp(np.reshape(log_posterior, (len(_FACTORS), len(_SHARES), -1)), axis=(0, 2))
    # Normalise the posterior on the uneven grid of shares, and read off its quantiles.
    density = np.exp(by_share - by_share.max())
    weight = density * np.gradient(_SHARES)
    weight /= weight.sum()
    cumulative = np.cumsum(weight)
    low, high = (float(np.interp(level, cumulative, _SHARES)) for level in _LEVELS)
    return float(weight @ _SHARES), low, high


def means_of(
    population: Population, others: Sequence[ChosenCause], part: ChosenCause
) -> tuple[dict[str, Value], dict[str, float]]:
    """Return the mean amplitude of a cause with its uncertainty, and the spread over the sessions.

    Both are given by parameter in the parameter's unit. `part` is the cause, `others` are the other causes
    in the model. The uncertainty follows from the curvature of the log likelihood in share, spread and mean
    together.
    """
    units, start = population.units, part.amplitudes
    size = _sizes(population, others, part)
    columns = [units.columns[k] for k in part.candidate.index]
    u = _uncertainty(population, others, part)
    mean = {
        column.parameter: Value(
            float(start.mean[k] * size[k]), None if u is None else float(u[k] * size[k]), column.unit
        )
        for k, column in enumerate(columns)
    }
    return mean, {column.parameter: float(start.spread * size[k]) for k, column in enumerate(columns)}


def _sizes(population: Population, others: Sequence[ChosenCause], part: ChosenCause) -> Floats:
    """Return the factors (d,) that convert the scaled amplitudes of a cause to the unit of each column.

    A scaled amplitude is in units of the typical standard uncertainty over all sessions. If amplitudes are
    relative to each session's own uncertainty, the factor is the median of this uncertainty over the
    affected sessions, because the sessions of one stage may be much noisier than the rest. `part` is the
    cause, `others` are the other causes in the model.
    """
    units, index = population.units, list(part.candidate.index)
    typical = units.typical[index]
    if not part.amplitudes.relative:
        return typical
    likely = population.affected(others, part) > 0.5
    chosen = likely if likely.any() else part.group.inside
    out = typical.copy()
    for k, column in enumerate(index):
        length = units.length[chosen, column]
        if (length > 0).any():
            # `length` is typical/u without the column's weight, so the weight is applied here once.
            out[k] *= units.columns[column].weight * np.median(1 / length[length > 0])
    return out


def _uncertainty(population: Population, others: Sequence[ChosenCause], part: ChosenCause) -> Floats | None:
    """Return the standard uncertainty of the mean amplitudes (d,) of a cause.

    Its unit is the typical standard uncertainty of one session. Returns None if the mean is fixed at zero,
    or if the likelihood has no maximum as a function of the mean. `part` is the cause, `others` are the
    other causes in the model.
    """
    start = part.amplitudes
    at = parameters_of(start)
    if len(at) == 2:
        return None
    given = population.given_others(others, part).inside(part.group.inside)

    def slope(parameters: Floats) -> Floats:
        return central_differences(
            lambda own: given.gain(group_at(own, start), MOST_OF_KNOWN).sum(), parameters, _STEP
        )

    # Parameters: logit of the share, log of the spread, mean.
    hessian = -central_differences(slope, at, _STEP)
    # A share at its bound or a spread near zero has no curvature: it stays fixed.
    free = np.diagonal(hessian) > 1e-2
    free[2:] = True
    try:
        covariance = np.linalg.inv(hessian[np.ix_(free, free)])
    except np.linalg.LinAlgError:
        return None
    variance = np.diagonal(covariance)[int(free[:2].sum()) :]
    return np.sqrt(variance) if (variance > 0).all() else None
