"""How a cause that was found is distributed: share of sessions, mean and spread of its amplitudes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import Value
from adis_gonio.fleet.population.mixture import MOST_OF_KNOWN, Group, log_factor, log_sum, mixed
from adis_gonio.fleet.population.selection import ChosenCause, Population, group_at, parameters_of

_LEVELS = (0.025, 0.975)
_SHARES = np.concatenate([np.linspace(0.005, 0.2, 40), np.linspace(0.21, 1.0, 80)])
_FACTORS = np.geomspace(0.4, 2.5, 9)
"""Means and spreads about the most probable ones over which the share is averaged."""


def share_of(
    population: Population, others: Sequence[ChosenCause], part: ChosenCause
) -> tuple[float, float, float]:
    """Posterior mean of the share of affected sessions, and its 95 % interval; uniform prior."""
    inside = part.group.inside & population.units.seen(part.candidate.index)
    blocks = population.beside(others, part.candidate.index, part.amplitudes.relative)
    log_posterior = []
    centred = bool((part.amplitudes.mean == 0).all())
    for spread in part.amplitudes.spread * _FACTORS:
        for factor in (1.0,) if centred else _FACTORS:
            factors = [
                (weight[inside], log_factor(block, factor * part.amplitudes.mean, spread)[inside])
                for weight, block in blocks
            ]
            log_posterior.append([_at(factors, share) for share in _SHARES])
    by_share = log_sum(np.array(log_posterior), axis=0)
    density = np.exp(by_share - by_share.max())
    weight = density * np.gradient(_SHARES)
    weight /= weight.sum()
    cumulative = np.cumsum(weight)
    low, high = (float(np.interp(level, cumulative, _SHARES)) for level in _LEVELS)
    return float(weight @ _SHARES), low, high


def _at(factors: Sequence[tuple[Floats, Floats]], share: float) -> float:
    rows = [weight + mixed(factor, share, MOST_OF_KNOWN) for weight, factor in factors]
    return float(log_sum(np.stack(rows), axis=0).sum())


def means_of(
    population: Population, others: Sequence[ChosenCause], part: ChosenCause
) -> tuple[dict[str, Value], dict[str, float]]:
    """Mean amplitude with its uncertainty, and spread, by parameter in its unit.

    The uncertainty is that of the curvature of the log likelihood in share, spread and mean together.
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
    """What an amplitude of one is in the unit of each column (d,).

    Where amplitudes are alike against each session's own uncertainty it is the median of that over the
    sessions that are affected: those of one stage may be noisier by far than the rest.
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
            # A length is typical/u without the weight of the column, which a size takes once.
            out[k] *= units.columns[column].weight * np.median(1 / length[length > 0])
    return out


def _uncertainty(population: Population, others: Sequence[ChosenCause], part: ChosenCause) -> Floats | None:
    """Of the mean (d,) in typical uncertainties; None where it is zero or the curvature says nothing."""
    start = part.amplitudes
    at = parameters_of(start)
    if len(at) == 2:
        return None
    inside = part.group.inside
    blocks = population.beside(others, part.candidate.index, part.amplitudes.relative)

    def value(parameters: Floats) -> float:
        group: Group = group_at(parameters, start)
        factors = [
            (weight[inside], log_factor(block, group.mean, group.spread)[inside])
            for weight, block in blocks
        ]
        return _at(factors, group.share)

    hessian = _curvature(value, at)
    # A share at its end, or a spread near zero, has no curvature of its own: it is held.
    free = np.diagonal(hessian) > 1e-2
    free[2:] = True
    try:
        covariance = np.linalg.inv(hessian[np.ix_(free, free)])
    except np.linalg.LinAlgError:
        return None
    variance = np.diagonal(covariance)[int(free[:2].sum()) :]
    return np.sqrt(variance) if (variance > 0).all() else None


def _curvature(value, at: Floats, step: float = 0.05) -> Floats:  # type: ignore[no-untyped-def]
    """−∂² of a function by central differences, (p, p)."""
    count = len(at)
    moves = step * np.eye(count)
    out = np.zeros((count, count))
    for i in range(count):
        for j in range(i, count):
            corners = [a * b * value(at + a * moves[i] + b * moves[j]) for a in (1, -1) for b in (1, -1)]
            out[i, j] = out[j, i] = -sum(corners) / (4 * step**2)
    return out
