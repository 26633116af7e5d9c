"""When a sensor counts as still: limits of the standard deviation within a window of samples.

Both limits come from the sensor's own noise, not from a table. The upper limit is four times that:
rotation by hand exceeds it a hundredfold, the window's own scatter and a building's hum do not. The lower
limit catches data that only look still because they are stuck: a working converter shows its noise. Where
the noise is below half a step a constant word is normal and there is no lower limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats

UPPER = 4.0
"""Upper limit in units of the noise."""
_LOWER = 0.1


@dataclass(frozen=True)
class StillnessLimits:
    """Standard deviations within a window between which an axis counts as still.

    Attributes
    ----------
    window_samples : int
        Length of the window.
    lower, upper : (axes,) float
        Limits in the unit of the samples; `lower` is zero where a constant word is normal.
    """

    window_samples: int
    lower: Floats
    upper: Floats


def limits_from_noise(noise_sd: Floats, window_samples: int, quantum: Floats | float) -> StillnessLimits:
    """Limits from the standard deviation of single samples at rest.

    Parameters
    ----------
    noise_sd : (axes,) float
        Standard deviation of samples at rest within a window.
    window_samples : int
        Length of the window in samples.
    quantum : float or (axes,) float
        Step of the converter in the samples' unit; 0 unknown.
    """
    noise = np.asarray(noise_sd, dtype=float)
    step = np.broadcast_to(np.asarray(quantum, dtype=float), noise.shape)
    # Quantization alone shows as up to half a step where the value sits between two codes.
    upper = UPPER * np.maximum(noise, step / np.sqrt(12))
    lower = np.where(noise > 0.5 * step, _LOWER * noise, 0.0)
    return StillnessLimits(window_samples, lower, upper)
