"""A continuous recording as weighted means in windows: what the estimate works with.

Windows are Hann windows that overlap by half. Their weights add up to the same everywhere, so that nothing
slow is lost, and what shakes faster than their hop (tremor at 8 to 12 Hz) hardly reaches a mean: noise of
the means is then noise of the low frequencies that the parameters follow. White noise correlates neighbours
by 1/6; `LONG_RUN` is what that makes of the variance of slow things.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats

HOP_S = 0.25
"""Distance of the windows' centres; each is two of them long."""
MOST_WINDOWS = 480
"""A longer recording has longer windows: the cost of an estimate has a bound."""
LONG_RUN = 4 / 3
"""Spectral density at zero of means in neighbouring windows, over their variance: 1 + 2/6."""
LEAST_FILLED = 0.5
"""Part of a window's samples without which it is left out."""
GAP_PERIODS = 5.0
"""Missing samples over which the gyro is not trusted to have seen the turn."""


@dataclass(frozen=True)
class TurnRecording:
    """Samples of one continuous recording.

    Attributes
    ----------
    time_s : (n,) float
        From the first sample on.
    accel_mg : (n, 2 or 3) float
    rate : (n, 3) float
        Gyros in rad/s.
    temperature_c : (n,) float or None
    smear_s : float
        Root of the second moment of the sensor's own filter.
    """

    time_s: Floats
    accel_mg: Floats
    rate: Floats
    temperature_c: Floats | None = None
    smear_s: float = 0.0

    @property
    def period_s(self) -> float:
        """Of the samples."""
        return float(np.median(np.diff(self.time_s)))

    @property
    def length_s(self) -> float:
        """Of the recording."""
        return float(self.time_s[-1])

    def integral(self, values: Floats) -> Floats:
        """Integral (n,) of a series from the first sample on, by trapezoids."""
        steps = np.diff(self.time_s) * (values[1:] + values[:-1]) / 2
        return np.concatenate([[0.0], np.cumsum(steps)])


class Windows:
    """Hann windows over a recording.

    Attributes
    ----------
    centre_s : (m,) float
    gap_s : (m - 1,) float
        Time without samples between neighbouring centres.
    """

    def __init__(self, series: TurnRecording) -> None:
        from scipy.sparse import csr_matrix

        time_s, period = series.time_s, series.period_s
        hop = max(HOP_S, 8 * period, series.length_s / MOST_WINDOWS)
        count = int(series.length_s / hop) - 1
        low = np.clip(np.floor(time_s / hop).astype(np.intp), 0, None)
        rows, columns, weights = [], [], []
        for step in (-1, 0):
            row = low + step
            phase = (time_s - (row + 1) * hop) / hop
            inside = (row >= 0) & (row < count)
            rows.append(row[inside])
            columns.append(np.flatnonzero(inside))
            weights.append(0.5 * (1 + np.cos(np.pi * phase[inside])))
        matrix: Any = csr_matrix(
            (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))),
            shape=(max(count, 0), len(time_s)),
        )
        filled = np.asarray(matrix.sum(axis=1)).ravel() * period / hop
        keep = filled > LEAST_FILLED
        self._matrix: Any = matrix[keep].multiply(1 / (filled[keep] * hop / period)[:, None]).tocsr()
        self.hop_s = hop
        self.centre_s: Floats = np.asarray((np.arange(count) + 1) * hop, np.float64)[keep]
        steps = np.diff(time_s)
        missing = np.where(steps > GAP_PERIODS * period, steps, 0.0)
        lost = np.concatenate([[0.0], np.cumsum(missing)])
        self.gap_s: Floats = np.diff(np.interp(self.centre_s, time_s, lost))

    def __len__(self) -> int:
        return len(self.centre_s)

    def mean(self, values: NDArray[Any]) -> NDArray[Any]:
        """Weighted means (m, …) of samples (n, …)."""
        return np.asarray(self._matrix @ values)
