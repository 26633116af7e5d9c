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

from adis_gonio.base.uncertainty import Detectable
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.model.effects import catalogue
from adis_gonio.model.records import Session
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.trace_result import Finding, TraceResult
from adis_gonio.tracing.within import courses, faults, tones
from adis_gonio.tracing.within.samples import Samples, WithinFinding, samples_of, scatter

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
    if samples is not None and (limit := faults.saturation(session, data)) is not None:
        within = (limit, *within)
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
    orders = training.conditions.covariate("order")
    reported = {found.position for found in result.position_findings}
    for term in result.fits[-1].terms:
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
    coarse = faults.quantization(samples, reach)
    frozen = faults.stuck(samples, spread, reach)
    wild, samples = faults.spikes(samples, spread, reach)
    moving, samples, density = tones.moving_lines(samples)
    steady, samples, density = tones.steady_lines(samples, density)
    change = faults.noise_change(samples, density)
    shared, samples = courses.courses(samples)
    # The scatter differs between dwells on the axes of this finding.
    unlike = [] if change is None else [samples.letters.index(axis) for axis in change.axes]
    single = courses.events(samples, unlike, reach)
    lines = tones.findings_of([*moving, *steady], samples)
    every = [coarse, frozen, wild, *lines, change, *shared, *single]
    shown = {
        "tone": tones.smallest_tone(samples, density),
        "noise_change": faults.smallest_noise_change(samples, density),
        "settling": courses.smallest_settling(samples),
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
    return tuple(finding for finding in every if finding is not None), shown


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
