"""The second pass of a trace: what the samples inside the dwells show, and what follows from it.

Rule for `found`
    A finding inside the dwells counts among `TraceResult.found` if its form is the catalogue's (`tone`,
    `settling`, `noise_change`, `saturation`, `quantization`), its probability is that from which any cause
    is called found (`certain`), it stands in at least `LEAST_DWELLS` dwells (a limit in one), and the
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
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import stats

from adis_gonio.base.uncertainty import FOUND_WITHIN
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.model.effects import catalogue
from adis_gonio.model.records import Session
from adis_gonio.tracing.outcome.result import Finding, TraceResult
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.within import WithinFinding, correlation_reach, look_within, samples_of
from adis_gonio.tracing.within.codes import quantization, saturation
from adis_gonio.tracing.within.finding import positions_text

LEAST_DWELLS = 4
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
    single, notes = _standing_out(data, result)
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
        and (len(finding.positions) >= LEAST_DWELLS or finding.kind == "limit")
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


def _standing_out(data: Readings, result: TraceResult) -> tuple[list[str], list[str]]:
    """Dwells that the final model fits far worse than the others: advice, and notes that they were kept.

    Their squared whitened residual is compared with the median of all (a few such dwells do not move it),
    never with less than the noise that was measured; 1 % for all dwells together.
    """
    if not result.fits or len(result.fits[-1].data) < LEAST_DWELLS or not data.noise_known:
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
