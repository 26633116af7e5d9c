"""From a standard uncertainty to an interval: effective degrees of freedom, coverage factor, expansion.

JCGM 100:2008 (GUM), G.4.1 (Welch–Satterthwaite) and G.3.2 (Student's distribution). The one place where
95 % and its quantile are stated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

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


def effective_dof(parts: Sequence[tuple[float, float]]) -> float:
    """Degrees of freedom of a sum of variances, each with its own: (Σ v)² / Σ (v²/ν); inf if unlimited."""
    total = sum(variance for variance, _ in parts)
    doubt = sum(variance**2 / dof for variance, dof in parts if math.isfinite(dof) and variance > 0)
    return total**2 / doubt if doubt > 1e-12 * total**2 else math.inf


def expanded(u: float | None, dof: float) -> tuple[float | None, float | None]:
    """(k, U); (None, None) where u is not known."""
    if u is None or not math.isfinite(u):
        return None, None
    k = coverage_factor(dof)
    return k, k * u
