"""Distribution of the amplitude of a cause over the sessions (share, mean, spread); detectable amplitude.

The amplitude is detectable if a population of sessions would show it with 90 % probability.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences, log_sum_exp
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.uncertainty import Value
from adis_gonio.fleet.population_likelihood import (
    MEANS,
    MOST_OF_KNOWN,
    RELATIVE_SPREAD,
    SHARES,
    Block,
    log_factor,
    mixed,
)
from adis_gonio.fleet.population_selection import ChosenCause, Population, group_at, parameters_of
from adis_gonio.tracing.thresholds import limits

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


ASKED = (0.1, 0.3, 1.0)
"""Shares of affected sessions for which the detectable amplitude is computed."""
_POWER_90 = 1.2815515655446004
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(15)
_SIZES = np.geomspace(0.1, 30.0, 26)
"""Amplitudes that are tried for the detectable amplitude, in typical standard uncertainties."""


class Reach(JsonRecord):
    """Smallest amplitude of an effect that a population of sessions would have shown.

    The JSON document is one value of `detectable`.

    Attributes
    ----------
    amplitude : mapping of str to float
        Smallest amplitude found with 90 % probability, by the share of affected sessions (`0.1`, `0.3`,
        `1`); None if no amplitude that was tried suffices.
    unit, parameter : str
        Unit of the amplitude, and name of the parameter with this amplitude.
    """

    amplitude: Mapping[str, float | None]
    unit: str
    parameter: str


def reach_of(population: Population) -> dict[str, Reach]:
    """Return the smallest amplitude of each effect that the population would show, on the worst axis.

    The probability of showing it is 90 %. The log likelihood has to rise by more than the price of the
    search, which follows from the priors of candidates and grid. Its rise is an expected value over
    sessions drawn from the distribution of amplitudes.
    """
    units = population.units
    by_name: dict[str, list[tuple[str, str, dict[str, float | None]]]] = defaultdict(list)
    single = [c for c in population.candidates if c.named and len(c.index) == 1]
    double = [c for c in population.candidates if c.named and not c.axes and len(c.index) == 2]
    chosen: dict[tuple[str, str], list[int]] = defaultdict(list)
    for k, candidate in enumerate([*single, *double]):
        chosen[candidate.cause, candidate.axes].append(k)
    every = [*single, *double]
    for (name, _), members in chosen.items():
        candidate = every[members[len(members) // 2]]
        column = candidate.index[0]
        block = units.joint([column])
        # Log evidence that the cause must exceed: level, priors, and the grid of distributions.
        price = -math.log(limits.adequate) - candidate.log_prior - population.groups[0].log_prior
        price += math.log(2 * len(MEANS) * 2 * len(SHARES)) * (1 if len(candidate.index) == 1 else 1.5)
        found = {f"{share:g}": _smallest(block, share, price) for share in ASKED}
        scaled = {
            key: None if size is None else float(size * units.typical[column])
            for key, size in found.items()
        }
        by_name[name].append((units.columns[column].parameter, units.columns[column].unit, scaled))
    out = {}
    for name, rows in by_name.items():
        parameter, unit, scaled = max(rows, key=lambda row: sum(v or math.inf for v in row[2].values()))
        out[name] = Reach(scaled, unit, parameter)
    return out


def _smallest(block: Block, share: float, price: float) -> float | None:
    """Return the smallest mean amplitude that 90 % of populations would show.

    `block` has the sessions' information on the amplitude, `share` is the share of affected sessions. A
    population shows an amplitude if the log likelihood rises by more than `price`. The tried amplitudes are
    `_SIZES`; the result is None if none of them suffices.
    """
    low, high = 0, len(_SIZES)
    while low < high:  # bisection: power grows with the amplitude
        middle = (low + high) // 2
        gain, variance = _expected(block, share, float(_SIZES[middle]))
        if gain - _POWER_90 * math.sqrt(variance) > price:
            high = middle
        else:
            low = middle + 1
    return float(_SIZES[low]) if low < len(_SIZES) else None


def _expected(block: Block, share: float, size: float) -> tuple[float, float]:
    """Return the expected rise of a population's log likelihood by one more cause, and its variance.

    The share `share` of the sessions is affected, with the mean amplitude `size` in typical standard
    uncertainties; `block` has the sessions' information on the amplitude. The expectation is by
    Gauss–Hermite quadrature over the scores of the sessions.
    """
    g = block.information[:, 0, 0]
    spread = RELATIVE_SPREAD * size
    weight = _WEIGHTS / _WEIGHTS.sum()
    first = second = 0.0
    # Mixture of unaffected and affected sessions; their scores are normal.
    for part, mean, variance in ((1 - share, np.zeros_like(g), g), (share, g * size, g + g**2 * spread**2)):
        score: Floats = mean[:, None] + np.sqrt(variance)[:, None] * _NODES
        flat = Block(score.reshape(-1, 1), np.repeat(g, len(_NODES))[:, None, None])
        value = mixed(log_factor(flat, np.array([size]), spread), share).reshape(score.shape)
        first = first + part * (value @ weight)
        second = second + part * (value**2 @ weight)
    by_unit = np.asarray(first)
    return float(by_unit.sum()), float((np.asarray(second) - by_unit**2).sum())
