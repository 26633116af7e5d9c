"""The second pass of a trace: search the samples inside the dwells.

Order of the searches
    Spikes and stuck values, spectral lines, changes of the scatter, slopes and settling that all dwells
    share, events in single dwells. Each finding is removed from the samples before the next search. Every
    test is calibrated by the session's own noise of any spectrum. The probability of any finding in a
    session without effects is at most `FOUND_WITHIN` for all tests together. The searches depend on the
    length of a dwell: none for one sample, drift from 6 samples, spikes and lines from 32 samples.

Rule for `found`
    A finding counts among `TraceResult.found` if it has the form of a named effect (`tone`, `settling`,
    `noise_change`, `saturation`, `quantization`), if its probability reaches the threshold of any cause
    (`certain`), if it occurs in at least `_CLAIMED_DWELLS` dwells (for a limit of the range one dwell
    suffices), and if each dwell was recorded by itself. If dwells were cut out of a continuous recording, a
    finding may come from a hand that places the part, so it remains a remark. `explains` is 0: the finding
    adds nothing to the model of the readings.

Probability
    The tests need no model of an effect, so there is a p-value but no likelihood. If an effect is
    present, p has the density ξ p^(ξ−1) with an unknown ξ below 1 (Sellke, Bayarri and Berger, The
    American Statistician 55:62, 2001). The prior share is equal for all effects.

Sensitivity
    The smallest detectable `tone`, `noise_change` and `settling`: the amplitude that the search would find
    in these samples with a probability of 90 %, with its error level and the noise present, on the worst
    axis.

All other findings remain in `TraceResult.within`, with their sentence and advice.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import optimize, special

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import FOUND_WITHIN, Detectable
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.model.effects import catalogue
from adis_gonio.model.records import Session
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.trace_result import Finding, TraceResult
from adis_gonio.tracing.within.courses import LEAST_DWELLS, LEAST_SAMPLES, Course, courses, events, grid
from adis_gonio.tracing.within.faults import (
    LEAST_LOUD,
    TESTS,
    levels_of,
    noise_change,
    quantization,
    saturation,
    spikes,
    step_of,
    stuck,
)
from adis_gonio.tracing.within.samples import (
    SEARCHES,
    Samples,
    WithinFinding,
    samples_of,
    scatter,
)
from adis_gonio.tracing.within.tones import TAPER_LOSS, Density, findings_of, moving_lines, tones

_CLAIMED_DWELLS = 4
"""Smallest number of dwells with a finding for it to count as found."""


def with_second_pass(session: Session, data: Readings, result: TraceResult) -> TraceResult:
    """Return the trace of a session's readings with the findings inside the dwells added.

    Parameters
    ----------
    session : Session
        Session with the samples of the dwells.
    data : Readings
        Readings of this session.
    result : TraceResult
        Trace of these readings.
    """
    samples = samples_of(session, data)
    within, shown = ((), {}) if samples is None else look_within(samples)
    if samples is not None:
        codes = (saturation(session, data), quantization(samples, correlation_reach(samples)))
        within = (*(finding for finding in codes if finding is not None), *within)
    claimed = {finding.effect for finding in result.found}
    best: dict[str, WithinFinding] = {}
    for finding in within:
        effect = finding.effect
        if effect is not None and (effect not in best or finding.p_value < best[effect].p_value):
            best[effect] = finding
    more = tuple(
        Finding(
            effect=effect,
            axes=finding.axes,
            parameters=dict(finding.parameters),
            p_value=finding.p_value,
            explains=0.0,
            probability=probability(finding.p_value),
            cause=catalogue()[effect].cause,
        )
        for effect, finding in best.items()
        if counts_as_found(finding) and effect not in claimed and not session.cut_by_stillness
    )
    advice = (*_of_single_dwells(data, result), *(f.advice for f in within if f.advice))
    return replace(
        result,
        found=(*result.found, *more),
        within=within,
        detectable={**result.detectable, **shown},
        advice=tuple(dict.fromkeys((*advice, *result.advice))),
    )


def counts_as_found(finding: WithinFinding) -> bool:
    """Return True if a finding inside the dwells is certain enough to count in `TraceResult.found`.

    It must be a named effect with a probability of at least `limits.certain`, in at least `_CLAIMED_DWELLS`
    dwells (for a limit of the range in one).
    """
    return (
        finding.effect is not None
        and probability(finding.p_value) >= limits.certain
        and (len(finding.positions) >= _CLAIMED_DWELLS or finding.kind == "limit")
    )


def probability(p_value: float) -> float:
    """Return the posterior probability that a finding with this p-value is real.

    The docstring of the module gives the prior and the density of p-values of real effects.
    """
    depth = -math.log(max(p_value, 1e-300))
    # ∫ ξ p^(ξ−1) dξ from 0 to 1, against the uniform density under the null hypothesis.
    evidence = (math.expm1(depth) - depth) / depth**2 if depth > 1e-6 else 0.5
    odds = limits.effect_share / (1 - limits.effect_share) * evidence
    return odds / (1 + odds)


def _of_single_dwells(data: Readings, result: TraceResult) -> list[str]:
    """Return advice to repeat each dwell for which the model has an effect of this dwell alone."""
    lines = []
    training = data.rows(~data.check)
    orders = training.conditions.order
    reported = {found.position for found in result.position_findings}
    for term in result.fits[-1].terms if result.fits else ():
        if term.dwell is None or orders is None:
            continue
        at = [k for k, order in enumerate(orders) if round(float(order)) == term.dwell]
        if at and training.position[at[0]] not in reported:
            word = "slipped" if term.enters_angle else "is off"
            lines.append(
                f"repeat position {training.position[at[0]]}: it {word} against all others; its reading "
                f"was not dropped, {term.name} accounts for it"
            )
    return lines


_CORRELATED = 0.2
_FARTHEST = 64


def look_within(samples: Samples) -> tuple[tuple[WithinFinding, ...], dict[str, Detectable]]:
    """Search inside the dwells; return the findings and the smallest detectable amplitudes by effect."""
    spread = scatter(samples)
    reach = correlation_reach(samples)
    frozen = stuck(samples, spread, reach)
    wild, samples = spikes(samples, spread, reach)
    moving, samples, density = moving_lines(samples)
    lines, samples, density = tones(samples, density)
    change = noise_change(samples, density)
    shared, samples = courses(samples)
    # The scatter differs between dwells on the axes of this finding.
    unlike = [] if change is None else [samples.letters.index(axis) for axis in change.axes]
    single = events(samples, unlike, reach)
    every = [frozen, wild, *findings_of(moving, samples), *lines, change, *shared, *single]
    return tuple(finding for finding in every if finding is not None), sensitivity(samples, density)


def correlation_reach(samples: Samples) -> int:
    """Return the lag, in samples, beyond which the correlation of a dwell's samples is below a limit.

    The limit is `_CORRELATED`. The lag is at most `_FARTHEST`.
    """
    longest = min(_FARTHEST, int(samples.counts.max()) // 4)
    total = np.zeros(longest + 1)
    for rows in samples.values:
        if len(rows) <= 2 * longest:
            continue
        centred = rows - rows.mean(axis=0)
        power = max(float((centred**2).mean()), 1e-300)
        for lag in range(longest + 1):
            total[lag] += float((centred[: len(rows) - lag] * centred[lag:]).mean()) / power
            # Once the correlation is low in one dwell, it is low in the others too.
            if lag and total[lag] < 0.5 * _CORRELATED * total[0]:
                break
    if total[0] <= 0:
        return 1
    low = np.flatnonzero(total / total[0] < _CORRELATED)
    return max(1, int(low[0]) if low.size else longest)


_POWER = 0.9
_TAPERED = 2 / 3 * 0.95
"""Loss of a tone's power by Hann's taper, (Σw)²/(n Σw²), and between two frequencies of the grid."""
_LARGEST = 1e6


def sensitivity(samples: Samples, density: Density | None) -> dict[str, Detectable]:
    """Return by effect the smallest amplitude that the search inside the dwells would find.

    Parameters
    ----------
    samples : Samples
        Samples with the effects of all findings subtracted.
    density : Density or None
        Spectral density of the samples' noise; None if the dwells are too short for a spectrum.
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
    """Return the smallest amplitude of a sine in all dwells that the search would have found.

    The limit comes from the F-test of the spectrum pooled over the dwells. `density` is the noise density
    of the dwells; with None (dwells too short) the result gives this reason.

    An amplitude A adds c A² n/4S to an ordinate of n samples, with density S and loss c by the taper, so
    that the sum of d ordinates is half a noncentral χ² variable with 2d degrees of freedom.
    """
    if density is None or not density.relative.size:
        return Detectable(None, "mg", "tone", "the dwells are too short for a spectrum")
    searched = density.searched
    dwells, points, axes = density.relative.shape
    p = FOUND_WITHIN / SEARCHES / (2.0 * points * axes)
    counts = float(np.median(samples.counts[density.dwells]))
    worst = 0.0
    for axis in range(axes):
        effective = float(density.effective[axis])
        freedom = 2 * effective * float(np.median(density.width[searched])) / TAPER_LOSS
        height = float(special.fdtri(2 * effective, freedom, 1 - p))

        def missing(excess: float, height: float = height) -> float:
            power = 1 - special.chndtr(2 * dwells * height, 2 * dwells, 2 * dwells * excess)
            return float(power) - _POWER

        excess = float(optimize.brentq(missing, 1e-6, _LARGEST, xtol=1e-6))
        noise = float(np.median(density.level[:, axis])) * float(np.median(density.bound[searched, axis]))
        worst = max(worst, float(np.sqrt(4 * noise * excess / (_TAPERED * counts))))
    return Detectable(worst, "mg", "tone")


def _noise_change(samples: Samples, density: Density | None) -> Detectable:
    """Return the smallest white noise, added from mid-session on, that the search would have found.

    Two tests look for one change of the noise between dwells: the F-test of the variance and the t-test
    of the level. The amplitude is None if there are too few dwells.
    """
    if density is None or len(density.dwells) < LEAST_LOUD:
        return Detectable(None, "mg", "extra", f"needs {LEAST_LOUD} dwells long enough for a spectrum")
    dwells = len(density.dwells)
    p = FOUND_WITHIN / SEARCHES / (2 * TESTS * samples.axes * (dwells - 1))
    worst = 0.0
    for axis in range(samples.axes):
        own = levels_of(samples, density, axis)
        half = float(own.dof.sum()) / 2
        ratio = float(special.fdtri(half, half, 1 - p) / special.fdtri(half, half, 1 - _POWER))
        # The added noise scatters too, according to its degrees of freedom.
        chance = math.sqrt(float(special.polygamma(1, np.median(own.level_dof) / 2)) * 4 / dwells)
        away = _noncentral(p, dwells - 2) * max(step_of(own.course, own.level_dof, dwells // 2)[1], chance)
        quiet = float(np.median(own.level)) * density.base[density.searched, axis]
        seen = (own.common * (ratio - 1), _joining(quiet, away))
        worst = max(worst, math.sqrt(min(seen)))
    return Detectable(worst, "mg", "extra")


def _joining(quiet: Floats, away: float) -> float:
    """Return the variance in mg² of white noise that raises the level of half of the dwells by `away` nats.

    `quiet` (points,) is the spectral density without the added noise. The level of a dwell is its mean
    power in units of the density of all dwells, which the added noise changes too. The result is infinite
    if no variance raises the level so much.
    """
    middle = len(quiet) // 2, (len(quiet) - 1) // 2

    def median(values: Floats) -> float:
        # Of a thousand points, without the checks for NaN and empty arrays that take np.median longer.
        found = np.partition(values, middle)
        return float(found[middle[0]] + found[middle[1]]) / 2

    def missing(log_variance: float) -> float:
        loud = quiet + math.exp(log_variance)
        base = quiet
        for _ in range(8):
            base = (quiet / median(quiet / base) + loud / median(loud / base)) / 2
        return float(np.log(np.mean(loud / base) / np.mean(quiet / base))) - away

    low, high = float(np.log(quiet.min())) - 20, float(np.log(quiet.max())) + 50
    return math.exp(optimize.brentq(missing, low, high, xtol=1e-3)) if missing(high) > 0 else math.inf


def _settling(samples: Samples) -> Detectable:
    """Return the smallest amplitude of a settling, common to all dwells, that the search would have found.

    The time constant is the middle of the searched grid; the limit comes from the t-test over the dwells.
    """
    usable = samples.counts >= LEAST_SAMPLES
    constants = [tau for tau in grid(samples, usable) if tau is not None] if usable.any() else []
    dwells = int(usable.sum())
    if dwells < LEAST_DWELLS or not constants:
        return Detectable(
            None, "mg", "settling", f"needs {LEAST_DWELLS} dwells of {LEAST_SAMPLES} samples or more"
        )
    course = Course.of(samples, usable, constants[len(constants) // 2], by_move=False)
    tests = (len(constants) + 1) * 2 * samples.axes
    # Size in units of its u that exceeds the two-sided limit with a probability of 90 %.
    p = FOUND_WITHIN / SEARCHES / tests / 2
    size = -float(special.stdtrit(dwells - 1, p) + special.stdtrit(dwells - 1, 1 - _POWER))
    return Detectable(float(np.sqrt((course.noise / course.energy).max())) * size, "mg", "settling")


def _noncentral(p: float, dof: int) -> float:
    """Return the true value, in standard uncertainties, that a t-test detects with 90 % probability.

    The test is one-sided, at significance level `p`. `dof` are the degrees of freedom of the test.
    """
    limit = -float(special.stdtrit(dof, p))

    def missing(size: float) -> float:
        # Far beyond the limit the function returns NaN instead of 0.
        return 1 - float(np.nan_to_num(special.nctdtr(dof, size, limit))) - _POWER

    return float(optimize.brentq(missing, 0.0, 10 * limit + 50, xtol=1e-6))
