"""The trace's second pass: what the samples inside the dwells show.

Spikes and stuck values first, then spectral lines, changes of the scatter, courses that all dwells share,
events in single dwells; each is taken out of the samples before the next is looked for. Every test is
calibrated against the session's own noise, whatever its spectrum; a session without anything shows a
finding with a probability of at most `FOUND_WITHIN`, all tests together. What is looked for in a dwell
depends on its length: nothing in one sample, drift from 6, spikes and lines from 32 samples.
"""

from __future__ import annotations

import numpy as np

from adis_gonio.base.uncertainty import Detectable
from adis_gonio.tracing.within.courses import courses
from adis_gonio.tracing.within.density import density_of
from adis_gonio.tracing.within.events import events
from adis_gonio.tracing.within.faults import spikes, stuck
from adis_gonio.tracing.within.finding import Kind, Place, View, WithinFinding
from adis_gonio.tracing.within.samples import Samples, samples_of, scatter
from adis_gonio.tracing.within.sensitivity import sensitivity
from adis_gonio.tracing.within.tones import tones
from adis_gonio.tracing.within.variances import heterogeneous, noise_change

_CORRELATED = 0.2
_FARTHEST = 64


def search_within(samples: Samples) -> tuple[WithinFinding, ...]:
    """Findings inside the dwells, as `TraceResult.within` lists them."""
    return look_within(samples)[0]


def look_within(samples: Samples) -> tuple[tuple[WithinFinding, ...], dict[str, Detectable]]:
    """Findings inside the dwells, and the smallest amplitudes that they would have shown."""
    spread = scatter(samples)
    reach = correlation_reach(samples)
    frozen = stuck(samples, spread, reach)
    wild, samples = spikes(samples, spread, reach)
    lines, samples, density = tones(samples)
    change = noise_change(samples, density)
    shared, samples = courses(samples)
    single = events(samples, heterogeneous(change, samples), reach)
    every = [frozen, wild, *lines, change, *shared, *single]
    return tuple(finding for finding in every if finding is not None), sensitivity(samples, density)


def correlation_reach(samples: Samples) -> int:
    """Samples after which neighbours correlate by less than `_CORRELATED`; at most `_FARTHEST`."""
    longest = min(_FARTHEST, int(samples.counts.max()) // 4)
    total = np.zeros(longest + 1)
    for rows in samples.values:
        if len(rows) <= 2 * longest:
            continue
        centred = rows - rows.mean(axis=0)
        power = max(float((centred**2).mean()), 1e-300)
        for lag in range(longest + 1):
            total[lag] += float((centred[: len(rows) - lag] * centred[lag:]).mean()) / power
            # Once it is low in one dwell the others agree: no need to go on.
            if lag and total[lag] < 0.5 * _CORRELATED * total[0]:
                break
    if total[0] <= 0:
        return 1
    low = np.flatnonzero(total / total[0] < _CORRELATED)
    return max(1, int(low[0]) if low.size else longest)


__all__ = [
    "Kind",
    "Place",
    "Samples",
    "View",
    "WithinFinding",
    "density_of",
    "look_within",
    "samples_of",
    "search_within",
]
