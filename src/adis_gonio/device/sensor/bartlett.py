"""The chip's digital filter as its noise shows it: a Bartlett window, two cascaded boxcars (DS, A)."""

from __future__ import annotations

import numpy as np

from adis_gonio.base.arrays import Floats


def filter_weights(m: int) -> Floats:
    """Weights of the filter: two cascaded boxcars of 2^M taps (DS, A)."""
    box = np.full(1 << min(m, 6), 1.0 / (1 << min(m, 6)))
    return np.convolve(box, box)


def white_noise_gain(m: int) -> float:
    """Gain for white noise, rms: 1, 0.612, 0.415 … (DS, A)."""
    return float(np.sqrt(np.sum(filter_weights(m) ** 2)))


def filter_response(m: int, frequency: Floats) -> Floats:
    """|H|² of the filter at frequencies in cycles a sample."""
    taps = 1 << m
    with np.errstate(invalid="ignore", divide="ignore"):
        box = np.sin(np.pi * frequency * taps) / (taps * np.sin(np.pi * frequency))
    return np.where(frequency == 0, 1.0, box**4)


def rounding_covariance(m: int, sigma: float) -> Floats:
    """Autocovariance (lags,) of the rounding of filtered noise, in LSB²; zero beyond.

    A slow signal is rounded the same way for several samples: the error is not white. With ρ the signal's
    correlation and σ its rms in LSB the error's is Σ exp(−4π²n²σ²(1 − ρ)) / (2π²n²) (Widrow and Kollár,
    Quantization Noise, for Gaussian signals of half an LSB and more).

    Parameters
    ----------
    sigma : float
        Rms before the filter, in LSB.
    """
    weights = filter_weights(m)
    rho = np.correlate(weights, weights, "full")[len(weights) - 1 :]
    turn = (2 * np.pi * sigma * white_noise_gain(m)) ** 2 * (1 - rho / rho[0])
    order = np.arange(1, 65)[:, None]
    error = np.sum(np.exp(-(order**2) * turn) / (2 * np.pi**2 * order**2), axis=0)
    error[0] = 1 / 12
    return np.asarray(error, np.float64)


def rounding_spectrum(m: int, sigma: float, frequency: Floats) -> Floats:
    """Level (n,) in a periodogram of the rounding of filtered noise, in LSB².

    Parameters
    ----------
    sigma : float
        As in `rounding_covariance`.
    frequency : (n,) float
        In cycles a sample.
    """
    error = rounding_covariance(m, sigma)
    level: Floats = (
        error[0] + 2 * np.cos(2 * np.pi * np.outer(frequency, np.arange(1, len(error)))) @ error[1:]
    )
    return np.maximum(level, 0.0)
