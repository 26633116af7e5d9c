"""From a standard uncertainty to an interval: effective degrees of freedom, coverage factor, expansion.

JCGM 100:2008 (GUM), G.4.1 (Welch–Satterthwaite) and G.3.2 (Student's distribution). The one place where
95 % and its quantile are stated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from adis_gonio.base.arrays import Floats

COVERED = 0.95
"""Probability that an expanded uncertainty U stands for."""
NORMAL_95 = 1.959963984540054
"""Coverage factor at unlimited degrees of freedom."""


def coverage_factor(dof: float) -> float:
    """K of 95 %: Student's quantile at `dof`; below one degree of freedom that of one, the worst stated."""
    if math.isinf(dof):
        return NORMAL_95
    from scipy.special import stdtrit

    return float(stdtrit(max(dof, 1.0), 0.5 * (1 + COVERED)))


def wilson(hits: float, n: int, z: float = NORMAL_95) -> tuple[float, float]:
    """Wilson's interval (1927), of 95 % unless told, of a probability; 0 to 1 where n is 0."""
    if n == 0:
        return 0.0, 1.0
    share = hits / n
    middle = (share + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
    return (0.0 if hits == 0 else middle - half), (1.0 if hits == n else middle + half)


def effective_dof(parts: Sequence[tuple[float, float]]) -> float:
    """Degrees of freedom of a sum of variances, each with its own: (Σ v)² / Σ (v²/ν); inf if unlimited."""
    total = sum(variance for variance, _ in parts)
    doubt = sum(variance**2 / dof for variance, dof in parts if math.isfinite(dof) and variance > 0)
    return total**2 / doubt if doubt > 1e-12 * total**2 else math.inf


def expanded(u: float | None, dof: float, factor: float | None = None) -> tuple[float | None, float | None]:
    """(k, U), k by `factor` where it is given; (None, None) where u is not known."""
    if u is None or not math.isfinite(u):
        return None, None
    k = coverage_factor(dof) if factor is None else factor
    return k, k * u


def factor_over(variances: Floats, dof: float) -> float:
    """K of 95 % for an error whose variance (m,) differs from place to place, by the root of their mean.

    Student's distribution with `dof` at each place: where some are far surer than others, the mixture has
    longer tails than any of them.
    """
    from scipy.optimize import brentq
    from scipy.special import stdtr

    mean = float(variances.mean())
    if not mean > 0 or float(np.ptp(variances)) < 1e-9 * mean:
        return coverage_factor(dof)
    spread = np.sqrt(np.maximum(variances, 1e-12 * mean) / mean)
    nu = min(max(dof, 1.0), 1e9)

    def missing(k: float) -> float:
        return float((1 - 2 * stdtr(nu, -k / spread)).mean()) - COVERED

    return float(brentq(missing, 0.0, coverage_factor(dof) * float(spread.max())))
