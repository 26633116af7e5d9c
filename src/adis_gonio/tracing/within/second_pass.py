"""The second pass of a trace: what the samples inside the dwells show, and what follows from it.

Rule for `found`
    A finding inside the dwells counts among `TraceResult.found` if its form is the catalogue's (`tone`,
    `settling`, `noise_change`, `saturation`, `quantization`), its probability is that from which any cause
    is called found (`certain`), it stands in at least `_CLAIMED_DWELLS` dwells (a limit in one), and the
    dwells were recorded as such. Where they were cut out of a continuous recording by stillness nothing is
    known about how the part was put down and held: what is seen there may be a hand, so that it stays a
    remark.
    `explains` is 0 for such a finding: the residual of the means is what the first pass explains, and
    nothing is added to its model.

Its probability
    These tests need no model of what they find, so that there is a p-value and no likelihood. Where
    something is, p follows the density ξ p^(ξ−1) of an unknown ξ below 1 (Sellke, Bayarri and Berger, The
    American Statistician 55:62, 2001); the prior share is that of any effect.

Everything else stays in `TraceResult.within` and reaches the user by its sentence and its advice.

The trace's second pass: what the samples inside the dwells show.

Spikes and stuck values first, then spectral lines, changes of the scatter, courses that all dwells share,
events in single dwells; each is taken out of the samples before the next is looked for. Every test is
calibrated against the session's own noise, whatever its spectrum; a session without anything shows a
finding with a probability of at most `FOUND_WITHIN`, all tests together. What is looked for in a dwell
depends on its length: nothing in one sample, drift from 6, spikes and lines from 32 samples.

Smallest `tone`, `noise_change` and `settling` that the samples inside the dwells would have shown.

Each is the amplitude at which the search of that name would find the effect in these very samples with a
probability of 90 %, at the level and against the noise that it uses itself. It belongs to the worst axis.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import optimize, special, stats

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import FOUND_WITHIN, Detectable
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.model.effects import catalogue
from adis_gonio.model.records import Session
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.trace_result import Finding, TraceResult
from adis_gonio.tracing.within.courses import LEAST_DWELLS, LEAST_SAMPLES, courses, grid, projections
from adis_gonio.tracing.within.events import events
from adis_gonio.tracing.within.faults import quantization, saturation, spikes, stuck
from adis_gonio.tracing.within.samples import (
    SEARCHES,
    Samples,
    WithinFinding,
    positions_text,
    samples_of,
    scatter,
)
from adis_gonio.tracing.within.tones import TAPER_LOSS, Density, tones
from adis_gonio.tracing.within.variances import LEAST_DWELLS as LEAST_LOUD
from adis_gonio.tracing.within.variances import TESTS, heterogeneous, levels_of, noise_change, step_of

_CLAIMED_DWELLS = 4
"""Least dwells of a finding that counts among `found`."""
_MOST_OUT = 0.2
"""Share of the dwells up to which those that stand out are to blame, and not the model."""


def with_second_pass(session: Session, data: Readings, result: TraceResult) -> TraceResult:
    """The trace of a session's readings with what its samples show.

    Parameters
    ----------
    session : Session
    data : Readings
        Of this session.
    result : TraceResult
        Of these observations.
    """
    samples = samples_of(session, data)
    within, shown = ((), {}) if samples is None else look_within(samples)
    if samples is not None:
        codes = (saturation(session, data), quantization(session, samples, correlation_reach(samples)))
        within = (*(finding for finding in codes if finding is not None), *within)
    claimed = {finding.effect for finding in result.found}
    more = tuple(
        _claim(finding)
        for finding in _first_of_each(within)
        if stands(finding) and finding.effect not in claimed and not session.cut_by_stillness
    )
    single, notes = _deviating_dwells(data, result)
    advice = (*_of_single_dwells(data, result), *single, *(f.advice for f in within if f.advice))
    return replace(
        result,
        found=(*result.found, *more),
        within=within,
        detectable={**result.detectable, **shown},
        advice=tuple(dict.fromkeys((*advice, *result.advice))),
        notes=(*result.notes, *notes),
    )


def stands(finding: WithinFinding) -> bool:
    """True where a finding inside dwells recorded as such counts among `found`; see the module."""
    return (
        finding.effect is not None
        and probability(finding.p_value) >= limits.certain
        and (len(finding.positions) >= _CLAIMED_DWELLS or finding.kind == "limit")
    )


def probability(p_value: float) -> float:
    """Posterior probability of what a test of this p-value found; see the module."""
    depth = -math.log(max(p_value, 1e-300))
    # ∫ ξ p^(ξ−1) dξ from 0 to 1, against the uniform density where nothing is.
    evidence = (math.expm1(depth) - depth) / depth**2 if depth > 1e-6 else 0.5
    odds = limits.effect_share / (1 - limits.effect_share) * evidence
    return odds / (1 + odds)


def _first_of_each(within: tuple[WithinFinding, ...]) -> list[WithinFinding]:
    """One finding an effect: of several lines the most significant one."""
    best: dict[str | None, WithinFinding] = {}
    for finding in within:
        if finding.effect not in best or finding.p_value < best[finding.effect].p_value:
            best[finding.effect] = finding
    return [finding for effect, finding in best.items() if effect is not None]


def _claim(finding: WithinFinding) -> Finding:
    assert finding.effect is not None
    return Finding(
        effect=finding.effect,
        axes=finding.axes,
        parameters=dict(finding.parameters),
        p_value=finding.p_value,
        explains=0.0,
        probability=probability(finding.p_value),
        cause=catalogue()[finding.effect].cause,
    )


def _of_single_dwells(data: Readings, result: TraceResult) -> list[str]:
    """Dwells that the first pass found to be off: they stay in the model, and are to be repeated."""
    lines = []
    training = data.rows(~data.check)
    orders = training.conditions.order
    told = {found.position for found in result.position_findings}
    for term in result.fits[-1].terms if result.fits else ():
        if term.dwell is None or orders is None:
            continue
        at = [k for k, order in enumerate(orders) if round(float(order)) == term.dwell]
        if at and training.position[at[0]] not in told:
            word = "slipped" if term.name == "position_slip" else "is off"
            lines.append(
                f"repeat position {training.position[at[0]]}: it {word} against all others; its reading "
                f"was not dropped, {term.name} accounts for it"
            )
    return lines


def _deviating_dwells(data: Readings, result: TraceResult) -> tuple[list[str], list[str]]:
    """Dwells that the final model fits far worse than the others: advice, and notes that they were kept.

    Their squared whitened residual is compared with the median of all (a few such dwells do not move it),
    never with less than the noise that was measured; 1 % for all dwells together.
    """
    if not result.fits or len(result.fits[-1].data) < _CLAIMED_DWELLS or not data.noise_known:
        return [], []
    residual, training = result.fits[-1].residual, result.fits[-1].data
    squares = (residual**2).sum(axis=1)
    rows = residual.shape[1]
    usual = max(float(np.median(squares)) / float(stats.chi2.median(rows)), 1.0)
    far = squares > usual * float(stats.chi2.isf(FOUND_WITHIN / len(squares), rows))
    # Where many stand out it is the model that is not adequate, not the dwells.
    if not far.any() or far.mean() > _MOST_OUT:
        return [], []
    named = positions_text(tuple(int(p) for p in training.position[far]), 0)
    size = float(np.sqrt(squares[far].max() / rows))
    return (
        [f"repeat {named}: far from the final model, the others are not"],
        [
            f"{named}: up to {size:.1f} standard uncertainties (rms over the axes) from the final model, "
            "more than chance among its dwells; kept in the fit"
        ],
    )


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
    size = _detectable_size(FOUND_WITHIN / SEARCHES / tests / 2, dwells - 1)
    slope = (norm[:, None] * z).sum(axis=0) / energy
    scatter = ((z - norm[:, None] * slope)[usable] ** 2).sum(axis=0) / (dwells - 1)
    return Detectable(float(np.sqrt(scatter.max() / energy)) * size, "mg", "settling")


def _detectable_size(p: float, dof: int) -> float:
    """Size in units of its u, which the session's scatter gives, at which 90 % exceed the limit at p."""
    return float(stats.t.isf(p, dof) + stats.t.isf(1 - _POWER, dof))


def _noncentral(p: float, dof: int) -> float:
    """Size of a t variable, in its standard deviations, that exceeds its limit of one side at p."""
    limit = float(stats.t.isf(p, dof))

    def missing(size: float) -> float:
        return float(stats.nct.sf(limit, dof, size)) - _POWER

    return float(optimize.brentq(missing, 0.0, 10 * limit + 50, xtol=1e-6))
