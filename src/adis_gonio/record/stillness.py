"""Stillness of a sensor: limits from its noise, and the live watch that applies them.

The upper limit of the standard deviation within a window is four times the noise: rotation by hand exceeds
it a hundredfold, the window's own scatter and a building's hum do not. The lower limit catches an axis that
is stuck. If the noise is below half a step of the converter, a constant word is normal and there is no
lower limit. Windows of the live watch overlap by half, so that no short motion falls between two of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import SessionError
from adis_gonio.model.effects.base import AXES

if TYPE_CHECKING:
    from adis_gonio.record.source import Measuring

UPPER = 4.0
"""Upper limit of the standard deviation of a still window, as a multiple of the noise."""
_LOWER = 0.1


@dataclass(frozen=True)
class StillnessLimits:
    """Limits of the standard deviation within a window between which an axis counts as still.

    Attributes
    ----------
    window_samples : int
        Length of the window in samples.
    lower, upper : (axes,) float
        Limits in the unit of the samples; `lower` is zero if a constant word is normal.
    """

    window_samples: int
    lower: Floats
    upper: Floats


def limits_from_noise(noise_sd: Floats, window_samples: int, quantum: Floats | float) -> StillnessLimits:
    """Derive the limits of stillness from the standard deviation of single samples at rest.

    Parameters
    ----------
    noise_sd : (axes,) float
        Standard deviation of samples at rest within a window.
    window_samples : int
        Length of the window in samples.
    quantum : float or (axes,) float
        Step of the converter in the samples' unit; 0 if it is unknown.
    """
    noise = np.asarray(noise_sd, dtype=float)
    step = np.broadcast_to(np.asarray(quantum, dtype=float), noise.shape)
    # Quantization alone gives up to half a step if the value lies between two codes.
    upper = UPPER * np.maximum(noise, step / np.sqrt(12))
    lower = np.where(noise > 0.5 * step, _LOWER * noise, 0.0)
    return StillnessLimits(window_samples, lower, upper)


WINDOW_S = 0.25
LEAST_WINDOW = 32
SETTLINGS_PER_WINDOW = 8
"""Least length of a window in settling times of the filter.

In a shorter window neighbouring samples are correlated.
"""

SHIFT_MG = 5.0
"""Shift of the mean in mg since the beginning of a dwell that counts as motion (0.3° at the horizontal).

Smaller changes are kept in the dwell as effects to be found.
"""

BEGIN_RATIO = 1.5
"""Multiple of the noise below which a dwell may begin, so that ringing after a move has ended.

A dwell is broken off only above the upper limit.
"""

METER_WINDOWS = 8
METER_RATIO = 1.6
EXPECTED_RATIO = 10.0
STUCK_LOOKS = 3


def window_samples(measuring: Measuring) -> int:
    """Return the number of samples in a window of the stillness watch for a configuration."""
    return max(
        LEAST_WINDOW,
        round(WINDOW_S * measuring.sample_rate_hz),
        SETTLINGS_PER_WINDOW * round(measuring.settling_s * measuring.sample_rate_hz),
    )


@dataclass(frozen=True)
class Look:
    """Result for one window of the stillness watch.

    Attributes
    ----------
    end : int
        Number of samples fed up to the end of the window.
    state : {"still", "moving", "stuck"}
        State of the sensor in the window; "stuck" if an axis shows no noise.
    why : str
        The axis that moves or is stuck, with numbers; empty if the sensor is still.
    mean_mg, spread_mg : (3,) float
        Mean and standard deviation of the samples in the window, in mg.
    shifted : bool
        True if the standard deviations are small, but the mean has shifted too much since the dwell began.
    """

    end: int
    state: Literal["still", "moving", "stuck"]
    why: str
    mean_mg: Floats
    spread_mg: Floats
    shifted: bool = False


class _Windows:
    """Cuts samples that arrive in pieces into windows of `length` samples that overlap by half."""

    def __init__(self, length: int) -> None:
        self._length = length
        self._step = max(1, length // 2)
        self._kept = np.empty((0, len(AXES)))
        self.fed = 0

    def feed(self, samples: Floats) -> list[tuple[int, Floats]]:
        """Return the windows (length, 3) that these samples (n, 3) complete.

        Each window comes with the number of samples fed up to its end.
        """
        self._kept = np.concatenate([self._kept, samples])
        self.fed += len(samples)
        first = self.fed - len(self._kept)
        starts = range(0, len(self._kept) - self._length + 1, self._step)
        windows = [(first + k + self._length, self._kept[k : k + self._length]) for k in starts]
        self._kept = self._kept[len(starts) * self._step :]
        return windows


class NoiseMeter:
    """Measures the noise of samples at rest from eight consecutive windows in which the sensor was still.

    The noise is the median of the standard deviations in these windows. The sensor counts as still if none
    of them is more than 1.6 times the median, and if the means of the windows differ by at most twice the
    median.

    Parameters
    ----------
    window : int
        Length of a window in samples.
    expected_mg : float
        Estimate of the noise of a sample behind the filter in mg; ten times this estimate counts as motion.

    Attributes
    ----------
    mean_mg, spread_mg : (3,) float
        Mean of the latest window, and standard deviation within it; 0 before the first window.
    """

    def __init__(self, window: int, expected_mg: float) -> None:
        self._windows = _Windows(window)
        self._expected_mg = expected_mg
        self.least_samples = window * (METER_WINDOWS + 1) // 2
        self._spreads: list[Floats] = []
        self._means: list[Floats] = []
        self.mean_mg, self.spread_mg = np.zeros(len(AXES)), np.zeros(len(AXES))

    def feed(self, accel_mg: Floats) -> Floats | None:
        """Add samples (n, 3) in mg; return their noise (3,) in mg once it is known, until then None.

        Raises
        ------
        SessionError
            An axis is stuck: it does not change at all.
        """
        for _, window in self._windows.feed(accel_mg):
            self.mean_mg, self.spread_mg = window.mean(axis=0), window.std(axis=0, ddof=1)
            self._spreads = [*self._spreads, self.spread_mg][-METER_WINDOWS:]
            self._means = [*self._means, self.mean_mg][-METER_WINDOWS:]
        spreads = np.array(self._spreads)
        if len(spreads) >= STUCK_LOOKS:  # below rounding of float64, so not one LSB of change
            stuck = np.flatnonzero((spreads[-STUCK_LOOKS:] < 1e-6).all(axis=0))
            if stuck.size:
                raise stuck_error(AXES[int(stuck[0])], float(self.mean_mg[stuck[0]]))
        if len(spreads) < METER_WINDOWS:
            return None
        noise: Floats = np.median(spreads, axis=0)
        steady = (spreads <= METER_RATIO * noise).all() and (np.ptp(self._means, axis=0) <= 2 * noise).all()
        return noise if steady and (noise <= EXPECTED_RATIO * self._expected_mg).all() else None


class StillnessWatch:
    """Decides for each window if the sensor is still or moves, or if an axis is stuck.

    Parameters
    ----------
    limits : StillnessLimits
        Limits in mg, from the noise that `NoiseMeter` measured.
    noise_mg : (3,) float
        The measured noise in mg, or the noise of quantization alone if that is larger.
    """

    def __init__(self, limits: StillnessLimits, noise_mg: Floats) -> None:
        self._limits = limits
        self._begin = np.minimum(BEGIN_RATIO * np.asarray(noise_mg, dtype=float), limits.upper)
        self._windows = _Windows(limits.window_samples)
        self._anchor_from: int | None = None
        self._anchor: Floats | None = None
        self._stuck = np.zeros(len(AXES), dtype=int)

    def anchor(self, sample: int | None) -> None:
        """Set the number of the sample at which a dwell begins; None if there is no dwell.

        The means of later windows are compared with the first window of the dwell.
        """
        self._anchor_from, self._anchor = sample, None

    def feed(self, accel_mg: Floats) -> list[Look]:
        """Add samples (n, 3) in mg; return the result of each window that they complete."""
        return [self._look(end, window) for end, window in self._windows.feed(accel_mg)]

    def _look(self, end: int, window: Floats) -> Look:
        """Judge if an axis is stuck, or if the sensor moves or is still, by a window (length, 3) in mg.

        `end` is the number of samples up to the end of the window.
        """
        mean, spread = window.mean(axis=0), window.std(axis=0, ddof=1)
        flat, upper = spread < self._limits.lower, self._limits.upper
        # One flat window may be chance; a stuck axis stays flat.
        self._stuck = np.where(flat, self._stuck + 1, 0)
        if (self._stuck >= STUCK_LOOKS).any():
            k = int(np.argmax(self._stuck))
            return Look(end, "stuck", str(stuck_error(AXES[k], float(mean[k]))), mean, spread)
        limit = upper if self._anchor_from is not None else self._begin
        over = spread / limit
        if (over > 1).any():
            k = int(np.argmax(over))
            why = f"{AXES[k]} varies by {spread[k]:.3g} mg, at rest at most {limit[k]:.3g} mg"
            return Look(end, "moving", why, mean, spread)
        if self._anchor_from is not None and end - self._limits.window_samples >= self._anchor_from:
            if self._anchor is None:
                self._anchor = mean
            # The first window of the dwell is the reference for the shift of later ones.
            shift = np.abs(mean - self._anchor)
            allowed = np.maximum(upper, SHIFT_MG)
            if (shift > allowed).any():
                k = int(np.argmax(shift / allowed))
                why = f"{AXES[k]} has shifted by {shift[k]:.3g} mg since the dwell began"
                return Look(end, "moving", why, mean, spread, shifted=True)
        return Look(end, "still", "", mean, spread)


def stuck_error(axis: str, value_mg: float) -> SessionError:
    """Make the error for an accelerometer axis that is stuck at a reading in mg: it shows no noise."""
    return SessionError(
        f"accelerometer {axis} is stuck at {value_mg:.1f} mg: a live sensor shows its noise;"
        " check the sensor, its wiring and its supply, then resume the session"
    )
