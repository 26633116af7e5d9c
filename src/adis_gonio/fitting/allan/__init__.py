"""Noise of a sensor at rest: random walks, bias instability, quantization, with u, and the Allan plot."""

from adis_gonio.fitting.allan.allan_fit import AllanResult, AxisNoise, fit_allan
from adis_gonio.fitting.allan.spectral_likelihood import AllanCurve, NoiseParameter, overlapping

__all__ = ["AllanCurve", "AllanResult", "AxisNoise", "NoiseParameter", "fit_allan", "overlapping"]
