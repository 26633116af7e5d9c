"""`trace_population`: evidence of many sessions → the causes that they have in common.

evidence ─ units ─▶ candidates ─▶ selection ─▶ what stands, and where
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adis_gonio.base.errors import UsageError
from adis_gonio.base.uncertainty import POPULATION_SET
from adis_gonio.fleet.population.candidates import candidates_of
from adis_gonio.fleet.population.distribution import means_of, share_of
from adis_gonio.fleet.population.evidence import SessionEvidence
from adis_gonio.fleet.population.reach import reach_of
from adis_gonio.fleet.population.result import Affected, Common, PopulationResult
from adis_gonio.fleet.population.selection import (
    LEAST_UNITS,
    ChosenCause,
    Kind,
    Population,
    SelectionStep,
    memberships,
)
from adis_gonio.fleet.population.units import Units, units_of
from adis_gonio.tracing.thresholds import limits

GROUPINGS = ("stage", "operator", "serial", "sensor")
"""What sessions can share."""
MOST_PARTS = 4
"""Most causes of one population."""
FOREMOST = 0.02
"""Share of the sessions, at least one, without which a common cause still has to be likely."""


def trace_population(
    evidence: Sequence[SessionEvidence], *, by: Sequence[str] = GROUPINGS
) -> PopulationResult:
    """Name the causes that are common to sessions, though too weak in each.

    Parameters
    ----------
    evidence : sequence of SessionEvidence
        Of each session, in any order; the same session (by its digest) counts once.
    by : sequence of str
        What sessions may share: `stage`, `operator`, `serial`, `sensor`.

    Raises
    ------
    UsageError
        Fewer than five different sessions, or a grouping that there is not.
    """
    wrong = [name for name in by if name not in GROUPINGS]
    if wrong:
        raise UsageError(f"sessions cannot be grouped by '{wrong[0]}'; there are {', '.join(GROUPINGS)}")
    once = list({one.digest or f"{k}": one for k, one in enumerate(evidence)}.values())
    if len(once) < LEAST_UNITS:
        raise UsageError(
            f"a population trace of {len(once)} different sessions: it needs {LEAST_UNITS} at least"
        )
    units = units_of(once)
    population = Population(units, candidates_of(units.columns), memberships(units, by))
    steps, open_ = _chosen(population)
    steps, dropped = _standing(population, steps)
    open_ |= dropped
    commons = _merged(population, steps)
    notes = []
    if len(once) < len(evidence):
        notes.append(f"{len(evidence) - len(once)} sessions stood twice and count once")
    inflated = float(np.median(units.inflation))
    if inflated > 1.2:
        notes.append(
            f"residuals scatter more than their stated noise: by a factor of {inflated:.2g} in variance in"
            " the median session, which is taken into account"
        )
    return PopulationResult(
        sessions=len(units),
        found=tuple(one for one in commons if len(one.effects) == 1),
        sets=tuple(one for one in commons if len(one.effects) > 1),
        unnamed=tuple(one for one in commons if not one.effects),
        detectable=reach_of(population),
        missing=_missing(units),
        open=open_,
        inflation={"median": inflated, "largest": float(units.inflation.max())},
        notes=tuple(notes),
    )


def _chosen(population: Population) -> tuple[list[SelectionStep], dict[str, str]]:
    """Steps of the forward selection, each sharpened, and why the last one is none."""
    steps: list[SelectionStep] = []
    for _ in range(MOST_PARTS):
        parts = [step.part for step in steps]
        step = population.step(parts)
        if step.log_evidence < -math.log(limits.adequate):
            break
        step = replace(step, part=population.sharpened(parts, step.part))
        reason = _objection(population, parts, step)
        if reason:
            return steps, {_word(step.part.candidate.kind): reason}
        steps.append(step)
    return steps, {}


def _objection(population: Population, parts: Sequence[ChosenCause], step: SelectionStep) -> str:
    """Why a step that the likelihood asks for is not taken; empty where nothing speaks against it."""
    if step.heldout <= 0:
        return "sessions that took no part do not agree with it"
    seen = population.units.seen(step.part.candidate.index) & step.part.group.inside
    few = max(1, math.ceil(FOREMOST * int(seen.sum())))
    if population.without_foremost(parts, step.part, few) <= 0:
        return f"it stands on {few} of the sessions alone: trace these"
    return ""


def _standing(
    population: Population, steps: Sequence[SelectionStep]
) -> tuple[list[SelectionStep], dict[str, str]]:
    """Steps that the others do not explain after all."""
    kept = list(steps)
    dropped: dict[str, str] = {}
    for step in list(steps)[:-1]:
        others = [one.part for one in kept if one is not step]
        if not others or step not in kept:
            continue
        own = population.scores(others, [step.part.candidate]).log_evidence
        least = -math.log(limits.adequate)
        group = population.groups.index(step.part.group)
        if own[0, group] + step.part.candidate.log_prior + step.part.group.log_prior < least:
            kept = [one for one in kept if one is not step]
            dropped[_word(step.part.candidate.kind)] = "causes that were found after it explain it"
    return kept, dropped


def _word(kind: Kind) -> str:
    return kind[0] if kind[1] else f"unnamed: {kind[0]}"


def _merged(population: Population, steps: Sequence[SelectionStep]) -> list[Common]:
    """One entry a cause: a second axis of the same name belongs to the first."""
    commons: dict[tuple[str, str, str], Common] = {}
    for k, step in enumerate(steps):
        others = [one.part for j, one in enumerate(steps) if j != k]
        common = _common(population, others, step)
        key = (
            common.effects[0] if common.effects else f"unnamed: {common.depends_on}",
            common.by,
            common.value,
        )
        first = commons.get(key)
        if first is None:
            commons[key] = common
        else:
            axes = tuple(sorted({*first.axes, *common.axes}))
            commons[key] = replace(
                first,
                axes=axes,
                mean={**common.mean, **first.mean},
                spread={**common.spread, **first.spread},
            )
    return list(commons.values())


def _common(population: Population, others: Sequence[ChosenCause], step: SelectionStep) -> Common:
    part, units = step.part, population.units
    kind = part.candidate.kind
    ranked = sorted(step.posterior.items(), key=lambda entry: -entry[1])
    # A function without a name may hold a named one as a part: it has to be likely itself to take the name.
    told = kind[1] and sum(p for one, p in ranked if one[1]) >= limits.sure
    names, sum_ = [], 0.0
    for one, probability in ranked:
        names.append(one)
        sum_ += probability
        if sum_ >= POPULATION_SET:
            break
    share, low, high = share_of(population, others, part)
    mean, spread = means_of(population, others, part)
    probable = population.affected(others, part)
    if (part.amplitudes.mean == 0).all():
        # Without a common sign many small amplitudes and few large ones look alike.
        seen = units.seen(part.candidate.index) & part.group.inside
        low = min(low, float((probable[seen] > 0.5).mean()))
    order = [int(i) for i in np.argsort(-probable) if probable[i] > 0.5]
    return Common(
        effects=tuple(name for name, named in names if named) if told else (),
        depends_on="" if told else _depends(names, kind),
        variant=part.candidate.variant,
        axes=tuple(part.candidate.axes),
        posterior={_word(one): probability for one, probability in ranked if probability > 1e-3},
        by=part.group.by,
        value=part.group.value,
        groups={" ".join(filter(None, place)): p for place, p in step.places.items() if p > 1e-3},
        sessions=int((units.seen(part.candidate.index) & part.group.inside).sum()),
        share={"value": share, "low": low, "high": high},
        mean=mean,
        spread=spread,
        relative=part.amplitudes.relative,
        p_value=min(1.0, math.exp(-step.log_evidence)),
        heldout_gain=step.heldout,
        affected=tuple(_unit(units, i, float(probable[i])) for i in order),
    )


def _depends(names: Sequence[Kind], best: Kind) -> str:
    """What a cause without a name depends on; names that it may be stand in brackets."""
    nameless = [name for name, named in names if not named]
    also = [name for name, named in names if named]
    what = best[0] if not best[1] else nameless[0]
    return what + (f" (or {', '.join(also)})" if also else "")


def _unit(units: Units, index: int, probability: float) -> Affected:
    one = units.evidence[index]
    return Affected(one.source, one.serial, one.digest, probability)


def _missing(units: Units) -> dict[str, str]:
    """Effects that no session shows."""
    shown = {column.cause for column in units.columns if column.named}
    return {
        name: reason for one in units.evidence for name, reason in one.missing.items() if name not in shown
    }
