"""Values with their uncertainty, and the significance levels and coverage factors of all results.

The methods are JCGM 100:2008 (GUM), G.4.1 (Welch–Satterthwaite) and G.3.2 (Student's distribution). A
change of a level changes results. `adis_gonio.tracing.thresholds` has the numbers of the trace's search,
and `adis_gonio.bench.bringup.bringup_step` those for commissioning a sensor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import HIDDEN, JsonRecord
from adis_gonio.base.numbers import format_uncertain

INADEQUATE = 0.01
"""p-value of χ² below which the residual of a model is too large for the measured noise."""
FOUND_WITHIN = 0.01
"""Probability of any finding within the dwells of an undisturbed session (family-wise)."""
OUTLYING = 0.01
"""Probability that any unit, stage or operator is reported as outlying if none is (family-wise)."""
DRIFTING = 0.05
"""Probability that any quantity of a stable sensor is reported to drift over its history (Bonferroni)."""
SLOW_NOISE = 0.025
"""One-sided p-value below which a noise process counts as present: its 95 % interval excludes zero."""
LINE_IN_NOISE = 1e-4
"""Probability that noise alone shows a spectral line in a recording of the sensor at rest."""
LINK_REFUSED = 1e-3
"""p-value below which links (turns recorded by the gyros) contradict the poses shown by gravity."""
COMMON_DIVISOR = 1e-6
"""Probability of a common divisor of all differences between samples below which it is not chance."""
POSITION_QUESTIONED = 1e-4
"""Probability that a correct position is reported as doubtful: 1 % for a hundred positions together."""
CREDIBLE_SET = 0.95
"""Total probability that the credible set of names for a cause in one session has at least."""
POPULATION_SET = 0.99
"""Total probability that the credible set of names for a population of sessions has at least."""


COVERED = 0.95
"""Probability of the interval of an expanded uncertainty U."""
NORMAL_95 = 1.959963984540054
"""Coverage factor for 95 % if the degrees of freedom are unlimited."""


def coverage_factor(dof: float) -> float:
    """Return the coverage factor k for 95 %: the quantile of Student's distribution with `dof`.

    `dof` are the degrees of freedom; fewer than 1 count as 1.
    """
    if math.isinf(dof):
        return NORMAL_95
    from scipy.special import stdtrit

    return float(stdtrit(max(dof, 1.0), 0.5 * (1 + COVERED)))


def wilson(hits: float, n: int, z: float = NORMAL_95) -> tuple[float, float]:
    """Return Wilson's confidence interval (1927) of the probability of an event with `hits` in `n` trials.

    `z` is the coverage factor, by default for 95 %. The interval is 0 to 1 if n is 0.
    """
    if n == 0:
        return 0.0, 1.0
    share = hits / n
    middle = (share + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
    return (0.0 if hits == 0 else middle - half), (1.0 if hits == n else middle + half)


def effective_dof(parts: Sequence[tuple[float, float]]) -> float:
    """Return the effective degrees of freedom of a sum of variances (Welch–Satterthwaite).

    They are (Σ v)² / Σ (v²/ν) for `parts` of (variance v, degrees of freedom ν), and may be infinite.
    """
    total = sum(variance for variance, _ in parts)
    doubt = sum(variance**2 / dof for variance, dof in parts if math.isfinite(dof) and variance > 0)
    return total**2 / doubt if doubt > 1e-12 * total**2 else math.inf


def expanded(u: float | None, dof: float, factor: float | None = None) -> tuple[float | None, float | None]:
    """Return the coverage factor k and the expanded uncertainty U = k·u; both are None if u is unknown.

    k is `factor` if given, else computed from the degrees of freedom `dof`.
    """
    if u is None or not math.isfinite(u):
        return None, None
    k = coverage_factor(dof) if factor is None else factor
    return k, k * u


def factor_over(variances: Floats, dof: float) -> float:
    """Return the factor k such that 95 % of errors with different variances lie within ±k times their rms.

    `variances` (m,) are the variances of m errors, such as of an angle at m places, all equally frequent;
    the rms is the root of their mean. Each error has Student's distribution with `dof` degrees of freedom.
    """
    from scipy.special import stdtr

    mean = float(variances.mean())
    if not mean > 0 or float(np.ptp(variances)) < 1e-9 * mean:
        return coverage_factor(dof)
    spread = np.sqrt(np.maximum(variances, 1e-12 * mean) / mean)
    nu = min(max(dof, 1.0), 1e9)

    # Bisection: the covered share rises with k, and scipy.optimize takes long to import.
    low, high = 0.0, coverage_factor(dof) * float(spread.max())
    for _ in range(60):
        k = (low + high) / 2
        if float((1 - 2 * stdtr(nu, -k / spread)).mean()) < COVERED:
            low = k
        else:
            high = k
    return high


@dataclass(frozen=True)
class Value:
    """A value with its standard uncertainty.

    Attributes
    ----------
    value : float
        The value in `unit`.
    u : float or None
        Standard uncertainty; None if not determined.
    unit : str
        Unit of value and u.
    dof : float
        Degrees of freedom of u; infinite if u is exactly known.
    """

    value: float
    u: float | None
    unit: str
    dof: float = math.inf
    factor: float | None = None
    """Coverage factor for 95 % if the error does not have Student's distribution with `dof`; else None."""

    def __str__(self) -> str:
        """Format the value with its expanded uncertainty U and unit, such as `1.08 ± 0.26 mg`."""
        return format_uncertain(self.value, self.U, self.unit)

    @property
    def k(self) -> float | None:
        """Coverage factor k of 95 %: the stated factor, or Student's quantile; None if u is unknown."""
        return expanded(self.u, self.dof, self.factor)[0]

    @property
    def U(self) -> float | None:  # noqa: N802 (GUM)
        """Expanded uncertainty U = k·u: value ± U contains the truth with a probability of 95 %.

        It is None if u is unknown.
        """
        return expanded(self.u, self.dof, self.factor)[1]

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object with the keys value, u, dof, k, U and unit.

        Entries that are unknown or infinite are None.
        """
        k, expanded_u = expanded(self.u, self.dof, self.factor)
        return {
            "value": finite_or_none(self.value),
            "u": finite_or_none(self.u),
            "dof": finite_or_none(self.dof) if k is not None else None,
            "k": k,
            "U": expanded_u,
            "unit": self.unit,
        }


def finite_or_none(value: float | None) -> float | None:
    """Return a number, or None for infinity or NaN, which JSON cannot represent."""
    return None if value is None or not math.isfinite(value) else float(value)


class Detectable(JsonRecord):
    """Smallest amplitude of an effect that a session can detect with 90 % probability.

    Its JSON document is one value of `detectable` in a result.

    Attributes
    ----------
    amplitude : float or None
        None if the session cannot detect the effect at any amplitude.
    unit : str
        Unit of the amplitude.
    parameter : str
        Name of the effect's parameter that has this amplitude.
    reason : str
        Reason if `amplitude` is None, else empty.
    lacking : tuple of str
        Names of the conditions that the effect needs and the session did not record.
    """

    amplitude: float | None
    unit: str
    parameter: str
    reason: str = ""
    lacking: tuple[str, ...] = field(default=(), metadata=HIDDEN)
