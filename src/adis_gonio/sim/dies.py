"""Temperatures of the three gyros' dies, which are what the three thermometers feel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from adis_gonio.model.effects.base import AXES
from adis_gonio.model.effects.lag import lagged
from adis_gonio.sim.inputs import Floats
from adis_gonio.sim.settings import WorldSettings

_STEP_S = 1.0
_FORGOTTEN = 12.0
"""Time constants after which nothing is left of what was before."""


class Dies:
    """Each die follows the part with a lag of its own, and is warmer by a gradient that power-on builds up.

    Parameters
    ----------
    settings : WorldSettings
        Those that begin with `die_`, and `powered_s`.
    """

    def __init__(self, settings: WorldSettings) -> None:
        self._powered_s = settings.powered_s
        self._gradient_c = np.array([getattr(settings, f"die_gradient_{axis}_c") for axis in AXES])
        self._gradient_tau_s = settings.die_gradient_tau_s
        self._lag_s = np.array([getattr(settings, f"die_lag_{axis}_s") for axis in AXES])
        self._begin_s = -min(settings.powered_s, float(np.ceil(_FORGOTTEN * self._lag_s.max())))

    @property
    def alike(self) -> bool:
        """True where every die has the part's temperature."""
        return not (self._gradient_c.any() or self._lag_s.any())

    def temperature_c(self, time_s: Floats, part_c: Callable[[Floats], Floats]) -> Floats:
        """Temperatures (n, 3) at times (n,) of a part whose own temperature is known at any time."""
        result = np.repeat(part_c(time_s)[:, None], 3, axis=1)
        if self.alike:
            return result
        if self._lag_s.any():
            steps = int(np.ceil((float(time_s.max()) - self._begin_s) / _STEP_S)) + 1
            record_s = self._begin_s + _STEP_S * np.arange(max(steps, 1) + 1, dtype=np.float64)
            record = part_c(record_s)
            for k, tau_s in enumerate(self._lag_s):
                if tau_s:
                    result[:, k] = lagged(record_s, record, time_s, float(tau_s))[0]
        on_s = np.maximum(time_s + self._powered_s, 0.0)
        warmer: Floats = -np.expm1(-on_s / self._gradient_tau_s)[:, None] * self._gradient_c
        return result + warmer
