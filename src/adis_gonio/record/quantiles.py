"""Quantiles of many numbers in constant memory: a histogram whose bins are a thousandth wide."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats

_SHIFT = 52 - 10
"""Bits of a float64 below its ten leading digits: numbers that share the rest share a bin."""


class Quantiles:
    """Numbers of zero or more, fed in pieces; any quantile of them to 0.1 %.

    A bin answers with the mean of what fell into it, so that numbers which are all alike come back as they
    are. Memory grows with the logarithm of the largest over the smallest number only.
    """

    def __init__(self) -> None:
        self.zeros = 0
        self._first = 0
        self._count = np.zeros(0, dtype=np.int64)
        self._sum = np.zeros(0)

    @property
    def positive(self) -> int:
        """How many numbers above zero were fed."""
        return int(self._count.sum())

    def feed(self, values: Floats) -> None:
        """Take numbers (n,); none is negative."""
        some = values[values > 0]
        self.zeros += len(values) - len(some)
        if not len(some):
            return
        places: NDArray[np.int64] = np.ascontiguousarray(some, dtype=np.float64).view(np.int64) >> _SHIFT
        low, high = int(places.min()), int(places.max()) + 1
        self._reach(low, high)
        here = slice(low - self._first, high - self._first)
        self._count[here] += np.bincount(places - low, minlength=high - low)
        self._sum[here] += np.bincount(places - low, weights=some, minlength=high - low)

    def quantile(self, share: float, *, below: float = np.inf, with_zeros: bool = False) -> float:
        """Value below which a share of the numbers lies.

        Parameters
        ----------
        share : float
            0 to 1.
        below : float
            Numbers above it take no part.
        with_zeros : bool
            Whether zeros take part.

        Raises
        ------
        ValueError
            No number takes part.
        """
        mean = self._sum / np.maximum(self._count, 1)
        count = np.where(mean <= below, self._count, 0)
        zeros = self.zeros if with_zeros else 0
        total = int(count.sum()) + zeros
        if not total:
            raise ValueError("no numbers")
        rank = share * (total - 1)
        if rank < zeros:
            return 0.0
        return float(mean[np.searchsorted(np.cumsum(count), rank - zeros, side="right")])

    def _reach(self, low: int, high: int) -> None:
        """Make room for bins `low` to `high` (exclusive)."""
        if not len(self._count):
            self._first = low
        before = max(self._first - low, 0)
        after = max(high - self._first - len(self._count), 0)
        if before or after:
            self._count = np.pad(self._count, (before, after))
            self._sum = np.pad(self._sum, (before, after))
            self._first -= before
