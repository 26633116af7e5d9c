"""Smallest error of each position that a session would show, by simulation.

The accepted faults are removed from the session, and faults of several sizes are added to simulated errors.
"""

from __future__ import annotations

import math

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.slips.position_model import (
    Increments,
    Name,
    Pattern,
    Whitened,
    combined,
    patterns_of,
)
from adis_gonio.fitting.slips.session_positions import CERTAIN, search_faults

POWER = 0.99
"""Share of simulated sessions in which an error must be found to count as detectable."""
SIZES_DEG = np.geomspace(0.02, 90.0, 120)
"""Sizes in degrees of the simulated position errors, from which the smallest detectable one is chosen."""
_DRAWN = 200
"""Number of simulated sessions for the smallest detectable error."""


def detectable_deg(readings: Readings, turns: Increments, name: Name) -> dict[int, float]:
    """Return the smallest error in degrees at each position that 99 % of simulated sessions show.

    A session shows it if the probability of a fault called `name`, given the session, exceeds `CERTAIN`. An
    error of each size is put into sessions simulated with the scatter of this one. Only names with one free
    size count, and only one fault at a time. A value is inf if no size is shown.
    """
    searched = search_faults(readings, turns)
    if searched is None:
        return {}
    rows, grid, accepted, _ = searched
    known = combined(rows, accepted)
    every = patterns_of(rows, known.error_rad)
    patterns = [p for p in every if name in p.names and p.columns.shape[1] == 1]
    if not patterns:
        return {}
    residual = rows.observed(known.error_rad, known.zero_rad)[:, None]
    expected = (rows.design @ rows.prior_mean)[:, None]
    likely = []
    for scatter in grid:
        white = Whitened.of(rows, scatter, known.columns)
        likely.append(float(white.weight(white.white(residual - expected))[0]))
    none = known.columns[:, :0]
    accounts = [Whitened.of(rows, scatter, none) for scatter in grid]
    root = np.linalg.inv(accounts[int(np.argmax(likely))].inverse)
    drawn = root @ np.random.default_rng(0).standard_normal((len(root), _DRAWN))
    whitened = [(account, account.white(drawn)) for account in accounts]
    found = {}
    for pattern in patterns:
        shown = _odds(pattern, name, whitened) >= math.log(CERTAIN / (1 - CERTAIN))
        # The smallest size from which on every larger one is shown often enough.
        enough = (shown.mean(axis=1) >= POWER)[::-1].cumprod()[::-1].astype(np.bool_)
        least = float(SIZES_DEG[enough.argmax()]) if enough.any() else math.inf
        found[int(readings.position[pattern.dwells[0]])] = least
    return found


def _odds(pattern: Pattern, name: Name, drawn: list[tuple[Whitened, Floats]]) -> Floats:
    """Return the log odds (sizes, sessions) of a fault with this name against none, by simulation.

    Each session has this fault in each size; `drawn` are the sessions' ordinary errors and noise.
    """
    log_prior, amplitude = pattern.names[name]
    assert amplitude is not None
    sizes = np.radians(SIZES_DEG)[:, None]
    faulty, none = np.full((2, len(sizes), drawn[0][1].shape[1]), -np.inf)
    for account, z in drawn:
        # A fault of each size changes whitened rows by −size · v.
        v = account.white(pattern.columns[:, 0])
        vv, vz = float(v @ v), v @ z
        clean = account.weight(z)
        none = np.logaddexp(none, clean - sizes * vz - 0.5 * sizes**2 * vv)
        # Estimated size in each session, and the gain in likelihood by fitting it.
        seen = sizes + vz / vv
        own = amplitude(seen.ravel(), np.full(seen.size, 1 / math.sqrt(vv))).reshape(seen.shape)
        faulty = np.logaddexp(faulty, clean + 0.5 * vz**2 / vv + log_prior + own)
    return np.asarray(faulty - none)
