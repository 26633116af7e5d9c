"""Units, stages and operators that stand out from the fleet.

A *unit* is compared with the other units by a robust z: its distance from their median over what scatter
and its own u explain. A *stage* or an *operator* is compared by ranks (normal scores) of a quantity over
the units that it had, and by how many of them showed an effect (hypergeometric tail). All tests of a fleet
share one probability of naming anything falsely (Bonferroni). Whoever stands out most is named and taken
out before the others are compared, so that nobody is odd for being unlike the odd one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri, stdtr
from scipy.stats import hypergeom, rankdata

from adis_gonio.base.arrays import MAD_TO_SD, Floats, robust_sd
from adis_gonio.base.levels import OUTLYING

FEWEST_UNITS = 5
"""Units from which on one can stand out from the others."""
FEWEST = 3
"""Sessions or units that a group needs, and the rest of the fleet too."""
_MAD_EFFICIENCY = 0.37
"""A robust z of n values has the tails of Student's distribution with about so many times n − 1 degrees of
freedom: the median absolute deviation knows the scatter as well as that share of the values would by their
standard deviation."""

Codes = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Test:
    """One comparison.

    Attributes
    ----------
    kind : str
        `unit`, `stage` or `operator`.
    code : int
        Number of the group.
    quantity : str
        A parameter, or `effect NAME`.
    z : float
        Robust z, or the normal deviate of as small a probability.
    p_value : float
        Two-sided for parameters; for effects of as many or more.
    value, others : float
        Median of the group and of the others; for effects the share that shows it.
    n : int
        Sessions (of a unit) or units (of a stage or operator) that it has.
    """

    kind: str
    code: int
    quantity: str
    z: float
    p_value: float
    value: float
    others: float
    n: int


@dataclass(frozen=True)
class FamilyOfTests:
    """All groups of a kind by one quantity.

    Attributes
    ----------
    count : int
        Tests that it takes.
    find : callable
        From the largest p-value that counts to the tests that pass it.
    """

    count: int
    find: Callable[[float], list[Test]]


def outlying(comparisons: Sequence[FamilyOfTests]) -> tuple[int, list[Test]]:
    """Number of tests, and the tests that pass the level `OUTLYING` over all of them; oddest first."""
    total = sum(one.count for one in comparisons)
    passed = [test for one in comparisons if one.count for test in one.find(OUTLYING / total)]
    return total, sorted(
        passed, key=lambda test: (test.p_value, -abs(test.z), test.kind, test.quantity, test.code)
    )


def by_unit(quantity: str, values: Floats, u: Floats, unit: Codes) -> FamilyOfTests:
    """Every unit against all units, by the median of its sessions.

    Parameters
    ----------
    values, u, unit : (n,)
        One entry a session; unit negative where unknown: such a session is a unit of its own.
    """
    good = np.isfinite(values)
    codes = _own(unit)[good]
    names, index, count = np.unique(codes, return_inverse=True, return_counts=True)

    def find(level: float) -> list[Test]:
        median = _medians(values[good], index)
        # Sessions of a unit may share their error: its own u is not reduced by their number.
        doubt = np.sqrt(np.bincount(index, np.nan_to_num(u[good]) ** 2) / count)
        z, centre = robust_z(median, doubt)
        p = 2 * stdtr(_MAD_EFFICIENCY * (len(names) - 1), -np.abs(z))
        return [
            Test("unit", int(names[k]), quantity, z[k], p[k], median[k], centre, int(count[k]))
            for k in np.flatnonzero(p < level)
        ]

    return FamilyOfTests(len(names) if len(names) >= FEWEST_UNITS else 0, find)


def robust_z(values: Floats, u: Floats) -> tuple[Floats, float]:
    """Distances (n,) from the median over √(τ² + u²), and the median.

    τ makes the median distance that of a normal distribution; it is 0 where u alone explains as much.
    """
    centre = float(np.median(values))
    away = np.abs(values - centre)

    def unusual(tau: float) -> float:
        return float(np.median(away / np.sqrt(tau**2 + u**2))) - 1 / MAD_TO_SD

    most = robust_sd(values)  # without any u
    least = 1e-6 * most
    if most == 0.0:
        tau = 0.0
    elif unusual(least) <= 0:
        tau = least
    else:
        tau = float(brentq(unusual, least, 1.001 * most))
    scale = np.sqrt(tau**2 + u**2)
    return np.divide(values - centre, scale, out=np.zeros_like(values), where=scale > 0), centre


def by_rank(kind: str, quantity: str, values: Floats, group: Codes, unit: Codes) -> FamilyOfTests:
    """Every stage or operator against the others, by ranks of its units' medians."""
    good = np.isfinite(values) & (group >= 0)
    x, code = _by_unit(values[good], group[good], _own(unit)[good])
    return _Stepwise(kind, quantity, x, code, _normal_scores, np.median).comparison


def by_share(kind: str, effect: str, found: Flags, group: Codes, unit: Codes) -> FamilyOfTests:
    """Every group by how many of its units show an effect in half of their sessions or more.

    For units themselves (`kind` is `unit`) their sessions are counted.
    """
    good = group >= 0
    shown, code = found[good].astype(float), group[good]
    if kind != "unit":
        shown, code = _by_unit(shown, code, _own(unit)[good])
        shown = (shown >= 0.5).astype(float)
    return _Stepwise(kind, f"effect {effect}", shown, code, _hypergeometric, np.mean).comparison


def _own(unit: Codes) -> Codes:
    """Numbers of the units, another one for each session whose unit is not known."""
    return np.where(unit >= 0, unit, -1 - np.arange(len(unit)))


def _by_unit(values: Floats, group: Codes, unit: Codes) -> tuple[Floats, Codes]:
    """Median of each unit in each group, and that group: many sessions of a unit are no many witnesses."""
    if not len(values):
        return values, group
    pairs, index = np.unique(np.stack([group, unit]), axis=1, return_inverse=True)
    return _medians(values, np.asarray(index).ravel()), pairs[0]


def _medians(values: Floats, index: Codes) -> Floats:
    """Median of each group; `index` (n,) numbers them from 0 on without gaps."""
    x = values[np.lexsort((values, index))]
    count = np.bincount(index)
    first = np.cumsum(count) - count
    return np.asarray(0.5 * (x[first + (count - 1) // 2] + x[first + count // 2]))


def _normal_scores(values: Floats, index: Codes, count: Codes) -> tuple[Floats, Floats]:
    """Van der Waerden's z of each group against the rest, and its two-sided p-value."""
    n = len(values)
    score = ndtri(rankdata(values) / (n + 1))
    score -= score.mean()
    variance = count * (n - count) / (n * (n - 1)) * float(score @ score)
    z = np.divide(
        np.bincount(index, score), np.sqrt(variance), out=np.zeros(len(count)), where=variance > 0
    )
    return z, 2 * ndtr(-np.abs(z))


def _hypergeometric(values: Floats, index: Codes, count: Codes) -> tuple[Floats, Floats]:
    """Probability of as many or more by chance, and the normal deviate of it."""
    here = np.bincount(index, values)
    p = np.minimum(hypergeom.sf(here - 1, len(values), int(values.sum()), count), 1.0)
    return -ndtri(np.maximum(p, 1e-300)), p


@dataclass(frozen=True)
class _Stepwise:
    """Compare all groups with the rest, take out the oddest, compare the others."""

    kind: str
    quantity: str
    values: Floats
    code: Codes
    score: Callable[[Floats, Codes, Codes], tuple[Floats, Floats]]
    middle: Callable[[Floats], Any]

    @property
    def comparison(self) -> FamilyOfTests:
        count = np.unique(self.code, return_counts=True)[1]
        return FamilyOfTests(int(_able(count).sum()), self.find)

    def find(self, level: float) -> list[Test]:
        values, code = self.values, self.code
        tests: list[Test] = []
        while True:
            names, index, count = np.unique(code, return_inverse=True, return_counts=True)
            able = _able(count)
            if not able.any():
                return tests
            z, p = self.score(values, index, count)
            # Of two that differ from each other alone, the smaller is the odd one.
            k = int(np.lexsort((names, count, np.where(able, p, 2.0)))[0])
            if not p[k] < level:
                return tests
            own = index == k
            middles = float(self.middle(values[own])), float(self.middle(values[~own]))
            tests.append(Test(self.kind, int(names[k]), self.quantity, z[k], p[k], *middles, int(count[k])))
            values, code = values[~own], code[~own]


def _able(count: Codes) -> Flags:
    return np.asarray((count >= FEWEST) & (count.sum() - count >= FEWEST))
