"""The chip's digital filter: a Bartlett window made of two cascaded boxcars (CHIP.md, A).

Samples are integers in fixed point, so that sums are exact however a run of samples is divided.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]

MOST_M = 6


def taps(m: int) -> int:
    """Taps N of each boxcar."""
    return 1 << m


def history_rows(m: int) -> int:
    """Earlier samples that the filter reaches back to: 2N - 2."""
    return 2 * taps(m) - 2


def bartlett_sums(samples: Integers, m: int) -> Integers:
    """Weighted sums of a Bartlett window, N² times its mean.

    Parameters
    ----------
    samples : (2N - 2 + n, k) int
        Samples, the first 2N - 2 of them history.
    m : int
        SENS_AVG[2:0]; N = 2^M.

    Returns
    -------
    (n, k) int
        Sums with weights 1, 2, … N, … 2, 1.
    """
    n = taps(m)
    if n == 1:
        return samples
    return _boxcar(_boxcar(samples, n), n)


def _boxcar(samples: Integers, n: int) -> Integers:
    total = np.cumsum(samples, axis=0)
    sums = total[n - 1 :].copy()
    sums[1:] -= total[:-n]
    return sums
