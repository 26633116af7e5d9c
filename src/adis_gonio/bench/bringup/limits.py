"""Where every limit of the bring-up comes from: one probability of a false alarm for a whole board.

A sound board is to be accused less often than once in 10 000. The probability is divided by the largest
number of comparisons of a run (Bonferroni), so that the comparisons need not be independent. Each limit
is the quantile of the distribution that the compared figure has on a sound board: normal for means,
chi-square for variances, exponential for the bins of a periodogram. What is not random on a sound board
(a stuck line, a lost edge) has no limit: there one occurrence is enough.
"""

from __future__ import annotations

import math

FALSE_ALARM = 1e-4
"""Probability that a sound board is accused of anything."""
MOST_TESTS = 256
"""Comparisons that a run may make."""


class AlarmBudget:
    """Shares the probability of a false alarm out."""

    def __init__(self, total: float = FALSE_ALARM, tests: int = MOST_TESTS) -> None:
        self.total = total
        self.tests = tests
        self.spent = 0

    def alpha(self) -> float:
        """Probability of a false alarm of one more comparison.

        Raises
        ------
        RuntimeError
            All are spent: the number of tests is a promise about the code.
        """
        if self.spent >= self.tests:
            raise RuntimeError(f"more than {self.tests} comparisons: the false alarm rate does not hold")
        self.spent += 1
        return self.total / self.tests

    def z(self) -> float:
        """Limit of |x − μ| / u, two-sided, of a normal figure."""
        from scipy.special import ndtri

        return float(-ndtri(self.alpha() / 2))

    def variance_ratio(self, dof: float) -> tuple[float, float]:
        """Limits of s²/σ² with `dof` degrees of freedom, two-sided."""
        from scipy.special import gammainccinv, gammaincinv

        tail, shape = self.alpha() / 2, dof / 2
        return float(gammaincinv(shape, tail)) / shape, float(gammainccinv(shape, tail)) / shape

    def highest_bin(self, bins: int) -> float:
        """Limit of the largest of `bins` bins of a periodogram over their mean."""
        return math.log(bins / self.alpha())


def at_most(errors: int, trials: int, confidence: float = 0.95) -> float:
    """Upper limit of a probability after `errors` in `trials` (Clopper and Pearson)."""
    from scipy.special import betaincinv

    return 1.0 if errors >= trials else float(betaincinv(errors + 1, trials - errors, confidence))
