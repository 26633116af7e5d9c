"""The noise processes of IEEE Std 952-1997, Annex C, as a sampled and filtered record shows them.

Coefficients are squared standard deviations, so that every density is linear in them. With T the sampling
period, the Allan variance at τ and the two-sided density at f of each, per squared coefficient:

==============  ==================  ======================
process         Allan variance      density
==============  ==================  ======================
quantization Q  3/τ²                T (2πf)²
white N         1/τ                 1
flicker F       1                   1/(4 ln 2 · f)
walk K          τ/3                 1/(2πf)²
==============  ==================  ======================

F is the floor of the Allan deviation, 0.664 times the standard's B. The likelihood works in the basis of
the DCT-II without its first vector: there white noise and a random walk of any mean are independent
exactly, since those vectors are the eigenvectors of the differences' normal matrix; correlations of flicker
are at most 0.12, those of the squares that a likelihood uses 0.015.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import special

from adis_gonio.base.arrays import Floats
from adis_gonio.device.sensor.settings import filter_response, filter_weights

Kind = Literal["quantization", "white", "flicker", "walk"]
KINDS: tuple[Kind, ...] = get_args(Kind)

FLOOR_OF_B = math.sqrt(2 * math.log(2) / math.pi)
"""Floor of the Allan deviation over the standard's coefficient of bias instability."""
_FLICKER_ALLAN = 4 * math.log(2)
"""Allan variance of noise with the two-sided density h/f, in units of h."""
_TABLE = 256


def variances(filter_m: int, n: int, k: Floats, period_s: float) -> Floats:
    """Variances (len(k), 4) of the DCT-II ordinates k of n samples, per squared coefficient of `KINDS`."""
    angle = np.pi * k / n
    frequency = k / (2 * n)
    passed = filter_response(filter_m, frequency)
    white = ordinate_variances(_autocovariance(filter_weights(filter_m)), n, k)
    angles = ordinate_variances(_autocovariance(np.convolve(filter_weights(filter_m), [1.0, -1.0])), n, k)
    flicker = passed * _edge(k) / frequency / _FLICKER_ALLAN
    walk = passed / (4 * np.sin(angle / 2) ** 2)
    return np.stack([angles / period_s**2, white / period_s, flicker, walk * period_s], axis=1)


def ordinate_variances(autocovariance: Floats, n: int, k: Floats) -> Floats:
    """Variances (len(k),) of DCT-II ordinates k of n samples of a process that forgets after some lags.

    Exact, ends included: Σ_t φ_k(t) φ_k(t+l) = ((n − l) cos(la) − sin(la)/sin(a))/n with a = πk/n.
    """
    angle = np.pi * k / n
    total = np.full(len(k), autocovariance[0])
    for lag in range(1, min(len(autocovariance), n)):
        turned = lag * angle
        shape = (1 - lag / n) * np.cos(turned) - np.sin(turned) / (n * np.sin(angle))
        total += 2 * autocovariance[lag] * shape
    return np.asarray(np.maximum(total, 0.0), np.float64)


def line(n: int, k: Floats) -> Floats:
    """DCT-II ordinates k of the line 0, 1, … n − 1: even ones are zero."""
    angle = np.pi * k / n
    odd = -math.sqrt(2 / n) * np.cos(angle / 2) / (2 * np.sin(angle / 2) ** 2)
    return np.where(k % 2 == 1, odd, 0.0)


def variograms(filter_m: int, lags: int, period_s: float) -> Floats:
    """Half the mean squared difference (lags, 4) at lags 0, 1, …, per squared coefficient of `KINDS`."""
    own = _autocovariance(filter_weights(filter_m))
    reach = len(own) - 1
    lag = np.arange(lags + reach + 1)
    both = np.concatenate([own[:0:-1], own])
    made = np.empty((lags, len(KINDS)))
    angles = _autocovariance(np.convolve(filter_weights(filter_m), [1.0, -1.0]))
    made[:, 0] = angles[0] - _padded(angles, lags)
    made[:, 1] = own[0] - _padded(own, lags)
    for column, values in ((2, 2 * _cin(np.pi * lag) / _FLICKER_ALLAN), (3, lag / 2)):
        mirrored = np.concatenate([values[reach:0:-1], values])
        filtered = np.convolve(mirrored, both, "valid")[:lags]
        made[:, column] = filtered - filtered[0]
    return made * [1 / period_s**2, 1 / period_s, 1.0, period_s]


def _autocovariance(weights: Floats) -> Floats:
    return np.asarray(np.correlate(weights, weights, "full")[len(weights) - 1 :], np.float64)


def _padded(values: Floats, size: int) -> Floats:
    held = values[:size]
    return np.concatenate([held, np.zeros(size - len(held))])


def _cin(x: NDArray[np.floating[Any]]) -> Floats:
    """∫ (1 − cos t)/t dt from 0 to x."""
    inside = np.maximum(x, 1e-9)
    value = np.log(inside) + np.euler_gamma - special.sici(inside)[1]
    return np.where(x > 0, value, 0.0)


@lru_cache(maxsize=1)
def _edge_table() -> Floats:
    """Variance of flicker's ordinates 1 … `_TABLE` times their frequency: the ends of the record count.

    From the variogram 2h Cin(πl) of h/|f| below half the sampling rate, on a record so long that
    its length does not matter.
    """
    n = 8 * _TABLE
    lag = np.arange(1, n)
    gamma = 2 * _cin(np.pi * lag)
    table = np.empty(_TABLE)
    for k in range(1, _TABLE + 1):
        angle = np.pi * k / n
        shape = (n - lag) * np.cos(lag * angle) - np.sin(lag * angle) / np.sin(angle)
        table[k - 1] = -2 / n * (gamma @ shape) * k / (2 * n)
    return table


def _edge(k: Floats) -> Floats:
    table = _edge_table()
    inside = np.clip(k, 1, _TABLE).astype(np.intp) - 1
    return np.where(k <= _TABLE, table[inside], 1 - (1 - table[-1]) * _TABLE / np.maximum(k, 1))
