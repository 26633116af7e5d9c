"""Smallest `tone`, `noise_change` and `settling` that the samples inside the dwells would have shown.

Each is the amplitude at which the search of that name would find the effect in these very samples with a
probability of 90 %, at the level and against the noise that it uses itself. It belongs to the worst axis.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import optimize, special, stats

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import FOUND_WITHIN, Detectable
from adis_gonio.tracing.within.courses import LEAST_DWELLS, LEAST_SAMPLES, grid, projections
from adis_gonio.tracing.within.density import TAPER_LOSS, Density
from adis_gonio.tracing.within.finding import SEARCHES
from adis_gonio.tracing.within.samples import Samples
from adis_gonio.tracing.within.variances import LEAST_DWELLS as LEAST_LOUD
from adis_gonio.tracing.within.variances import TESTS, levels_of, step_of

_POWER = 0.9
_TAPERED = 2 / 3 * 0.95
"""(Σw)²/(n Σw²) of Hann's taper, and what a frequency between two points of the grid loses on average."""
_LARGEST = 1e6


def sensitivity(samples: Samples, density: Density | None) -> dict[str, Detectable]:
    """Smallest amplitude of each effect inside the dwells, by name.

    Parameters
    ----------
    samples : Samples
        Without what was found in them.
    density : Density or None
        Of their noise.
    """
    return {
        "tone": _tone(samples, density),
        "noise_change": _noise_change(samples, density),
        "settling": _settling(samples),
        "saturation": Detectable(
            None, "mg", "limit", "a limit that is reached shows as a pile of samples there"
        ),
        "quantization": Detectable(
            None,
            "mg",
            "lsb",
            "a step that noise hides is part of a reading's noise, a larger one would show",
        ),
    }


def _tone(samples: Samples, density: Density | None) -> Detectable:
    """A line in all dwells, at a middling frequency: against the F variable of the pooled ordinates.

    An amplitude A adds c A² n/4S to an ordinate of n samples, S the density, c what the taper leaves, so
    that the sum of d ordinates is half a noncentral χ² of 2d degrees of freedom.
    """
    if density is None:
        return Detectable(None, "mg", "tone", "the dwells are too short for a spectrum")
    searched = density.searched
    dwells, points, axes = density.relative.shape
    if points < 1:
        return Detectable(None, "mg", "tone", "the dwells are too short for a spectrum")
    p = FOUND_WITHIN / SEARCHES / (2.0 * points * axes)
    counts = float(np.median(samples.counts[density.dwells]))
    worst = 0.0
    for axis in range(axes):
        effective = float(density.effective[axis])
        freedom = 2 * effective * float(np.median(density.width[searched])) / TAPER_LOSS
        height = float(stats.f.isf(p, 2 * effective, freedom))

        def missing(excess: float, height: float = height) -> float:
            power = stats.ncx2.sf(2 * dwells * height, 2 * dwells, 2 * dwells * excess)
            return float(power) - _POWER

        excess = float(optimize.brentq(missing, 1e-6, _LARGEST, xtol=1e-6))
        noise = float(np.median(density.level[:, axis])) * float(np.median(density.bound[searched, axis]))
        worst = max(worst, float(np.sqrt(4 * noise * excess / (_TAPERED * counts))))
    return Detectable(worst, "mg", "tone")


def _noise_change(samples: Samples, density: Density | None) -> Detectable:
    """White noise that joins in the middle of the session: against the tests of one change, F or t."""
    if density is None or len(density.dwells) < LEAST_LOUD:
        return Detectable(None, "mg", "extra", f"needs {LEAST_LOUD} dwells long enough for a spectrum")
    dwells = len(density.dwells)
    p = FOUND_WITHIN / SEARCHES / (2 * TESTS * samples.axes * (dwells - 1))
    worst = 0.0
    for axis in range(samples.axes):
        own = levels_of(samples, density, axis)
        half = float(own.dof.sum()) / 2
        ratio = float(stats.f.isf(p, half, half) / stats.f.isf(_POWER, half, half))
        # What joins scatters by itself: by its degrees of freedom, whatever these few dwells show.
        chance = math.sqrt(float(special.polygamma(1, np.median(own.level_dof) / 2)) * 4 / dwells)
        away = _noncentral(p, dwells - 2) * max(step_of(own.course, own.level_dof, dwells // 2)[1], chance)
        quiet = float(np.median(own.level)) * density.base[density.searched, axis]
        seen = (own.common * (ratio - 1), _joining(quiet, away))
        worst = max(worst, math.sqrt(min(seen)))
    return Detectable(worst, "mg", "extra")


def _joining(quiet: Floats, away: float) -> float:
    """Variance of white noise in mg² that raises the level of half of the dwells by `away` (a logarithm).

    The level is in units of the density (points,) of all dwells, which what joins changes as well.
    """

    def missing(log_variance: float) -> float:
        loud = quiet + math.exp(log_variance)
        base = quiet
        for _ in range(8):
            base = (quiet / np.median(quiet / base) + loud / np.median(loud / base)) / 2
        return float(np.log(np.mean(loud / base) / np.mean(quiet / base))) - away

    low, high = float(np.log(quiet.min())) - 20, float(np.log(quiet.max())) + 50
    return math.exp(optimize.brentq(missing, low, high, xtol=1e-3)) if missing(high) > 0 else math.inf


def _settling(samples: Samples) -> Detectable:
    """Settling alike in all dwells, of the middle time constant: against the t test between the dwells."""
    usable = samples.counts >= LEAST_SAMPLES
    constants = [tau for tau in grid(samples, usable) if tau is not None] if usable.any() else []
    dwells = int(usable.sum())
    if dwells < LEAST_DWELLS or not constants:
        return Detectable(
            None, "mg", "settling", f"needs {LEAST_DWELLS} dwells of {LEAST_SAMPLES} samples or more"
        )
    z, norm = projections(samples, usable, constants[len(constants) // 2])
    energy = float((norm**2).sum())
    tests = (len(constants) + 1) * 2 * samples.axes
    size = _standing_out(FOUND_WITHIN / SEARCHES / tests / 2, dwells - 1)
    slope = (norm[:, None] * z).sum(axis=0) / energy
    scatter = ((z - norm[:, None] * slope)[usable] ** 2).sum(axis=0) / (dwells - 1)
    return Detectable(float(np.sqrt(scatter.max() / energy)) * size, "mg", "settling")


def _standing_out(p: float, dof: int) -> float:
    """Size in units of its u, which the session's scatter gives, at which 90 % exceed the limit at p."""
    return float(stats.t.isf(p, dof) + stats.t.isf(1 - _POWER, dof))


def _noncentral(p: float, dof: int) -> float:
    """Size of a t variable, in its standard deviations, that exceeds its limit of one side at p."""
    limit = float(stats.t.isf(p, dof))

    def missing(size: float) -> float:
        return float(stats.nct.sf(limit, dof, size)) - _POWER

    return float(optimize.brentq(missing, 0.0, 10 * limit + 50, xtol=1e-6))
