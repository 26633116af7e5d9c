"""Which amplitude in which share of the sessions the population would have shown."""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fleet.population.mixture import MEANS, RELATIVE_SPREAD, SHARES, Block, log_factor, mixed
from adis_gonio.fleet.population.result import Reach
from adis_gonio.fleet.population.selection import Population
from adis_gonio.tracing.thresholds import limits

ASKED = (0.1, 0.3, 1.0)
"""Shares of the sessions that are asked about."""
_POWER_90 = 1.2815515655446004
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(15)
_SIZES = np.geomspace(0.1, 30.0, 26)
"""Amplitudes that are tried, in typical standard uncertainties."""


def reach_of(population: Population) -> dict[str, Reach]:
    """By effect the smallest amplitude found with 90 % power, on the worst of its axes.

    The expected gain and its variance are those of units drawn from the very distribution; what the search
    costs is the prior of candidate and grid.
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
    """Smallest mean amplitude whose evidence exceeds a price in 90 % of populations."""
    low, high = 0, len(_SIZES)
    while low < high:  # power grows with the amplitude
        middle = (low + high) // 2
        gain, variance = _expected(block, share, float(_SIZES[middle]))
        if gain - _POWER_90 * math.sqrt(variance) > price:
            high = middle
        else:
            low = middle + 1
    return float(_SIZES[low]) if low < len(_SIZES) else None


def _expected(block: Block, share: float, size: float) -> tuple[float, float]:
    """Mean and variance of the log likelihood gain of a population so distributed, by quadrature."""
    g = block.information[:, 0, 0]
    spread = RELATIVE_SPREAD * size
    weight = _WEIGHTS / _WEIGHTS.sum()
    first = second = 0.0
    for part, mean, variance in (
        (1 - share, np.zeros_like(g), g),
        (share, g * size, g + g**2 * spread**2),
    ):
        score: Floats = mean[:, None] + np.sqrt(variance)[:, None] * _NODES
        flat = Block(score.reshape(-1, 1), np.repeat(g, len(_NODES))[:, None, None])
        value = mixed(log_factor(flat, np.array([size]), spread), share).reshape(score.shape)
        first = first + part * (value @ weight)
        second = second + part * (value**2 @ weight)
    by_unit = np.asarray(first)
    return float(by_unit.sum()), float((np.asarray(second) - by_unit**2).sum())
