"""Each stated smallest amplitude inside the dwells is found nine times out of ten, a third of it is not."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from adis_gonio.dwells import density_of, look_within, search_within
from adis_gonio.dwells.courses import grid
from tracing.dwell_samples import draw

SORTS = {
    "24 dwells of 5 s": {},
    "six long dwells, three axes": {"dwells": 6, "n": 1200, "axes": 3},
    "1/f noise, no filter": {"flicker_mg2": 0.05, "filter_m": 0},
}


def tone(size: float, dwells: int, axes: int, hertz: float):
    def added(k, time, rng):
        rows = np.zeros((len(time), axes))
        rows[:, 0] = size * np.cos(2 * np.pi * hertz * time + rng.uniform(0, 2 * np.pi))
        return rows

    return added


def noise_change(size: float, dwells: int, axes: int, _: float):
    def added(k, time, rng):
        rows = np.zeros((len(time), axes))
        rows[:, 0] = rng.normal(0, size * (k >= dwells // 2), len(time))
        return rows

    return added


def settling(size: float, dwells: int, axes: int, tau: float):
    def added(k, time, rng):
        rows = np.zeros((len(time), axes))
        rows[:, 0] = size * np.exp(-(time - time[0]) / tau)
        return rows

    return added


EFFECTS = {"tone": tone, "noise_change": noise_change, "settling": settling}


@pytest.mark.parametrize("sort", list(SORTS))
@pytest.mark.parametrize("name", list(EFFECTS))
def test_the_stated_amplitude_is_found_and_a_third_of_it_is_not(name: str, sort: str) -> None:
    options = SORTS[sort]
    quiet = draw(np.random.default_rng(99), **options)
    entry = look_within(quiet)[1][name]
    assert entry.amplitude is not None
    usable = quiet.counts >= 6
    constants = [tau for tau in grid(quiet, usable) if tau is not None]
    shape = constants[len(constants) // 2]
    if name == "tone":
        density = density_of(quiet)
        base = density.base[density.searched, 0]
        middling = int(np.argmin(np.abs(base - np.median(base)))) + density.searched.start
        shape = density.frequency[middling] / quiet.period_s

    def found(share: float, seed: int) -> bool:
        added = EFFECTS[name](share * entry.amplitude, len(quiet), quiet.axes, shape)
        samples = draw(np.random.default_rng([seed, 4]), added=added, **options)
        return any(finding.kind == name for finding in search_within(samples))

    # Eleven or more of 15 have 98.7 % at a power of 90 %, 5.9 % at 50 %; two or fewer of 10 have 5.5 %.
    # The power rises slowly where it is tested against the scatter of six dwells.
    assert at_least(11, 15, (found(1.0, seed) for seed in range(15)))
    assert at_least(8, 10, (not found(0.33, seed) for seed in range(10)))


def at_least(count: int, of: int, hits: Iterator[bool]) -> bool:
    """Whether so many of these are hits; looks no further than it takes to tell."""
    seen = missed = 0
    for hit in hits:
        seen, missed = seen + hit, missed + (not hit)
        if seen >= count or missed > of - count:
            return seen >= count
    return False


def test_dwells_that_are_too_short_say_so() -> None:
    shown = look_within(draw(np.random.default_rng(1), n=4, filter_m=0))[1]
    assert set(shown) >= set(EFFECTS)
    assert all(entry.amplitude is None and entry.reason for entry in shown.values())
