"""Sinusoids in a record at rest (a vibrating table, hum): taken off, and their surroundings masked."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.uncertainty import LINE_IN_NOISE

MOST = 12
_LOWEST = 24
"""Cycles a record below which a line cannot be told from slow noise."""
_WIDTH = 48
"""Ordinates on either side from which the level is taken."""
_LEAKS = 4
"""Ordinates on either side that a line reaches behind Hann's window."""


@dataclass(frozen=True)
class SpectralLine(JsonRecord):
    """A sinusoid of a record.

    Attributes
    ----------
    frequency_hz : float
        As it is sampled: a vibration above half of the rate shows as its alias.
    amplitude : float
        In the unit of the samples, behind the sensor's filter.
    """

    frequency_hz: float
    amplitude: float


def without_lines(
    record: Floats, period_s: float, highest: float
) -> tuple[Floats, list[SpectralLine], NDArray[np.intp]]:
    """The record without its sinusoids, those, and the DCT-II ordinates about them.

    Parameters
    ----------
    record : (n,) float
        Without a line.
    highest : float
        Cycles a sample up to which sinusoids are looked for.
    """
    found: list[SpectralLine] = []
    masked: list[NDArray[np.intp]] = []
    taken = np.zeros(len(record) // 2 + 1, dtype=bool)
    while len(found) < MOST:
        peak = _peak(record, highest, taken)
        if peak is None:
            break
        place, ratio = peak
        record, amplitude = _taken_off(record, place)
        reach = _LEAKS + int(min(math.sqrt(ratio) / 16, len(record) / 256))
        middle = round(place)
        taken[max(0, middle - reach) : middle + reach + 1] = True
        masked.append(np.arange(2 * (middle - reach), 2 * (middle + reach) + 1))
        found.append(SpectralLine(place / len(record) / period_s, amplitude))
    return record, found, np.concatenate(masked) if masked else np.zeros(0, np.intp)


def _peak(record: Floats, highest: float, taken: NDArray[np.bool_]) -> tuple[float, float] | None:
    """Cycles a record of the strongest line, and how far it stands above the noise."""
    n = len(record)
    last = int(highest * n)
    if last - _LOWEST < 4 * _WIDTH:
        return None
    lines = fft.rfft(record * signal.windows.hann(n, sym=False))[: last + 2]
    power = lines.real**2 + lines.imag**2
    level = _level(power[_LOWEST:last])
    # What is left of a line that was taken off does not count again.
    ratio = np.where(taken[_LOWEST:last], 0.0, power[_LOWEST:last] / level)
    at = int(ratio.argmax())
    # Exponential about its level, which is the mean of some ninety neighbours.
    if ratio[at] < 1.35 * math.log(len(ratio) / LINE_IN_NOISE):
        return None
    k = at + _LOWEST
    side = 1 if power[k + 1] > power[k - 1] else -1
    towards = math.sqrt(power[k + side] / power[k])
    return k + side * max(0.0, (2 * towards - 1) / (towards + 1)), float(ratio[at])


def _level(power: Floats) -> Floats:
    """Level of the noise at each ordinate: the higher one of the medians on both sides, as a mean."""
    step = _WIDTH // 4
    cells = power[: len(power) // step * step].reshape(-1, step)
    medians = np.median(np.lib.stride_tricks.sliding_window_view(cells, 4, axis=0), axis=(1, 2)) / math.log(
        2
    )
    cell = np.minimum(np.arange(len(power)) // step, len(cells) - 1)
    before = np.clip(cell - 4, 0, len(medians) - 1)
    after = np.clip(cell + 1, 0, len(medians) - 1)
    # On a slope (the filter's, slow noise) the higher side counts.
    level: Floats = np.maximum(np.maximum(medians[before], medians[after]), 1e-300)
    return level


def _taken_off(record: Floats, place: float) -> tuple[Floats, float]:
    phase = 2 * np.pi * place / len(record) * np.arange(len(record))
    columns = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    values = np.linalg.solve(columns.T @ columns, columns.T @ record)
    return np.asarray(record - columns @ values, np.float64), float(np.hypot(*values))
