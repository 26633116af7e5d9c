"""What the pass inside the dwells says it would have seen, put in: who looks whether it does.

Used by a test, and with more sessions by scripts/within_statistics.py.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.tracing.within.courses import grid
from adis_gonio.tracing.within.samples import Samples
from adis_gonio.tracing.within.second_pass import look_within
from adis_gonio.tracing.within.tones import density_of
from tracing.dwell_samples import Added, draw

SORTS = {
    "24 dwells of 5 s": {},
    "six long dwells, three axes": {"dwells": 6, "n": 1200, "axes": 3},
    "1/f noise, no filter": {"flicker_mg2": 0.05, "filter_m": 0},
}


def tone(size: float, dwells: int, axes: int, hertz: float) -> Added:
    def added(k: int, time: Floats, rng: np.random.Generator) -> Floats:
        rows = np.zeros((len(time), axes))
        rows[:, 0] = size * np.cos(2 * np.pi * hertz * time + rng.uniform(0, 2 * np.pi))
        return rows

    return added


def noise_change(size: float, dwells: int, axes: int, _: float) -> Added:
    def added(k: int, time: Floats, rng: np.random.Generator) -> Floats:
        rows = np.zeros((len(time), axes))
        rows[:, 0] = rng.normal(0, size * (k >= dwells // 2), len(time))
        return rows

    return added


def settling(size: float, dwells: int, axes: int, tau: float) -> Added:
    def added(k: int, time: Floats, rng: np.random.Generator) -> Floats:
        rows = np.zeros((len(time), axes))
        rows[:, 0] = size * np.exp(-(time - time[0]) / tau)
        return rows

    return added


EFFECTS = {"tone": tone, "noise_change": noise_change, "settling": settling}


def finder(name: str, sort: str) -> Callable[[float, int], bool]:
    """Whether an effect of so much of the stated amplitude is found in the session of a seed.

    The amplitude is what this session says it would have shown; the effect is put into its very samples.
    """
    options = SORTS[sort]

    def found(share: float, seed: int) -> bool:
        quiet = draw(np.random.default_rng([seed, 4]), **options)
        amplitude = look_within(quiet)[1][name].amplitude
        assert amplitude is not None
        hidden = EFFECTS[name](share * amplitude, len(quiet), quiet.axes, middling(name, quiet))
        own = np.random.default_rng([seed, 5])  # so that the noise is the same
        samples = draw(
            np.random.default_rng([seed, 4]), added=lambda k, time, _: hidden(k, time, own), **options
        )
        return any(finding.kind == name for finding in look_within(samples)[0])

    return found


def middling(name: str, quiet: Samples) -> float:
    """Frequency in Hz, or time constant in s, of which the figure speaks."""
    if name == "tone":
        density = density_of(quiet)
        assert density is not None
        bound = density.bound[density.searched, 0]
        at = int(np.argmin(np.abs(bound - np.median(bound)))) + density.searched.start
        return float(density.frequency[at] / quiet.period_s)
    constants = [tau for tau in grid(quiet, quiet.counts >= 6) if tau is not None]
    return constants[len(constants) // 2]
