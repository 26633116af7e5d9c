"""The population trace: from the evidence of many sessions to the causes that they have in common.

evidence ─ units ─▶ candidates ─▶ selection ─▶ accepted causes, and the sessions that they affect

An accepted cause has a distribution of amplitudes over the sessions: share of affected sessions, mean and
spread.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences, log_sum_exp
from adis_gonio.base.errors import UsageError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import counted, format_percent
from adis_gonio.base.uncertainty import POPULATION_SET, Value
from adis_gonio.fleet.population_likelihood import (
    LEAST_UNITS,
    MOST_OF_KNOWN,
    ChosenCause,
    Kind,
    Population,
    SelectionStep,
    candidates_of,
    group_at,
    memberships,
    mixed,
    parameters_of,
    units_of,
)
from adis_gonio.fleet.session_evidence import SessionEvidence
from adis_gonio.tracing.thresholds import limits


class Affected(JsonRecord):
    """A session that is probably affected by a cause.

    `source` is its file, `serial` the sensor, `digest` the SHA-256 of the file, and `probability` the
    probability that the cause affects the session.
    """

    source: str
    serial: str
    digest: str
    probability: float


class Common(JsonRecord):
    """A cause that several sessions of a population have in common.

    The JSON document is one entry of `found`, `sets` or `unnamed`.

    Attributes
    ----------
    effects : tuple of str
        Names of the cause that the data cannot distinguish, the most probable first; a single name if it is
        certain. Empty for an unnamed cause.
    depends_on : str
        Quantity that an unnamed cause depends on; empty for a named cause.
    variant : str
        Most probable form of the cause: degree, cycles per turn or time constant (see `Column`).
    axes : tuple of str
        Axes on which the cause acts.
    posterior : mapping of str to float
        Probability of each name, if there is a further cause; unnamed causes are `unnamed: …`.
    by, value : str
        Group of sessions that shows the cause: `all`, or a grouping such as `stage` with its value.
    groups : mapping of str to float
        Probability of each group of sessions, if the cause is right.
    sessions : int
        Number of sessions of the group that could show the cause.
    share : mapping of str to float
        Share of these sessions that are affected (`value`), with its 95 % interval (`low`, `high`). If
        the sign is not common, only the shape of the normal distribution separates share and spread; the
        interval then begins at the share of sessions that are affected with certainty.
    mean : mapping of str to Value
        Mean amplitude of affected sessions by parameter; zero if the sign is not common.
    spread : mapping of str to float
        Standard deviation of the amplitudes about the mean, in the parameter's unit.
    relative : bool
        True if the amplitudes are similar relative to each session's uncertainty rather than in their
        unit; `mean` and `spread` are then for an affected session of median uncertainty.
    p_value : float
        Upper bound of the probability of this evidence without a further cause in any session.
    heldout_gain : float
        Rise of the log likelihood by the cause, on sessions that took no part in its choice.
    affected : tuple of Affected
        Sessions affected with a probability above one half, the most probable first.
    """

    effects: tuple[str, ...]
    depends_on: str
    variant: str
    axes: tuple[str, ...]
    posterior: Mapping[str, float]
    by: str
    value: str
    groups: Mapping[str, float]
    sessions: int
    share: Mapping[str, float]
    mean: Mapping[str, Value]
    spread: Mapping[str, float]
    relative: bool
    p_value: float
    heldout_gain: float
    affected: tuple[Affected, ...] = ()

    @property
    def common_sign(self) -> bool:
        """True if the affected sessions have amplitudes of one sign (a mean amplitude other than zero)."""
        return any(value.value != 0 for value in self.mean.values())

    def sentence(self) -> str:
        """Describe the cause, its size, and the share of affected sessions in one sentence."""
        what = " or ".join(self.effects) if self.effects else f"something that follows {self.depends_on}"
        axes = f" of {', '.join(self.axes)}" if self.axes else ""
        where = "" if self.by == "all" else f" of {self.by} {self.value}"
        sign = "of one sign" if self.common_sign else "of either sign"
        sizes, share = "; ".join(self._size(name) for name in self.mean), self.share
        affected, low, high = (format_percent(share[name]) for name in ("value", "low", "high"))
        return (
            f"{what}{axes}: in {affected} ({low} to {high}) of"
            f" {counted(self.sessions, 'session')}{where}, {sign} ({sizes});"
            f" p < {max(self.p_value, 1e-99):.1g}, on held-out sessions the log likelihood gains"
            f" {self.heldout_gain:.1f}"
        )

    def _size(self, name: str) -> str:
        value, spread = self.mean[name], self.spread[name]
        if not self.common_sign:
            return f"{name} about {spread:.2g} {value.unit}"
        sure = "" if value.U is None else f" ± {value.U:.1g}"
        return f"{name} {value.value:.3g}{sure} {value.unit}, scattering by {spread:.1g}"


class PopulationResult(JsonRecord):
    """Result of a population trace: the causes that many sessions have in common.

    Attributes
    ----------
    sessions : int
        Number of sessions.
    found : tuple of Common
        Causes with one name.
    sets : tuple of Common
        Causes with several names that the data cannot distinguish.
    unnamed : tuple of Common
        Causes that are unnamed functions, or may be unnamed functions.
    missing : mapping of str to str
        Effects for which no session gives evidence, with the reason.
    open : mapping of str to str
        Causes that were rejected, with the reason.
    inflation : mapping of str to float
        `median` and `largest` factor by which the noise variance of a session is enlarged to explain its
        residual.
    notes : tuple of str
        Remarks for the user, one sentence each.
    """

    sessions: int
    found: tuple[Common, ...]
    sets: tuple[Common, ...]
    unnamed: tuple[Common, ...]
    missing: Mapping[str, str]
    open: Mapping[str, str]
    inflation: Mapping[str, float]
    notes: tuple[str, ...] = ()

    def summary(self) -> tuple[str, ...]:
        """Return lines of text: a heading, then one line for each cause, rejected cause and note."""
        lines = [f"Population of {counted(self.sessions, 'session')}:"]
        for title, every in (
            ("found", self.found),
            ("one of several names", self.sets),
            ("unnamed", self.unnamed),
        ):
            lines += [f"  {title}: {one.sentence()}" for one in every]
        if not (self.found or self.sets or self.unnamed):
            lines.append("  no common cause found")
        lines += [f"  {name} was rejected: {reason}" for name, reason in self.open.items()]
        lines += [f"  {note}" for note in self.notes]
        return tuple(lines)


MOST_PARTS = 4
"""Largest number of causes that are searched for in a population."""
FOREMOST = 0.02
"""Share of the sessions (at least one) that are left out of a test of each cause.

They are the sessions that favour the cause most; it must also be likely without them.
"""


def trace_population(evidence: Sequence[SessionEvidence]) -> PopulationResult:
    """Find the causes that sessions have in common, even if each is too weak in one session.

    Parameters
    ----------
    evidence : sequence of SessionEvidence
        Evidence of each session, in any order; sessions with equal digests count once.

    Raises
    ------
    UsageError
        Fewer than five different sessions.
    """
    once = list({one.digest or f"{k}": one for k, one in enumerate(evidence)}.values())
    if len(once) < LEAST_UNITS:
        raise UsageError(
            f"a population trace needs at least {LEAST_UNITS} different sessions, here are {len(once)}"
        )
    units = units_of(once)
    population = Population(units, candidates_of(units.columns), memberships(units))
    steps, open_ = _chosen(population)
    steps, dropped = _keep_supported(population, steps)
    open_ |= dropped
    commons = [_common(population, [one.part for one in steps if one is not step], step) for step in steps]
    notes = []
    if len(once) < len(evidence):
        notes.append(f"{len(evidence) - len(once)} sessions occur twice and count once")
    inflated = float(np.median(units.inflation))
    shown = {column.cause for column in units.columns if column.named}
    if inflated > 1.2:
        notes.append(
            f"residuals scatter more than the stated noise, by a factor of {inflated:.2g} in variance in"
            " the median session; the result takes this into account"
        )
    return PopulationResult(
        sessions=len(units),
        found=tuple(one for one in commons if len(one.effects) == 1),
        sets=tuple(one for one in commons if len(one.effects) > 1),
        unnamed=tuple(one for one in commons if not one.effects),
        # Effects for which no session gives evidence.
        missing={
            name: why for one in units.evidence for name, why in one.missing.items() if name not in shown
        },
        open=open_,
        inflation={"median": inflated, "largest": float(units.inflation.max())},
        notes=tuple(notes),
    )


def _chosen(population: Population) -> tuple[list[SelectionStep], dict[str, str]]:
    """Select causes one by one until no further cause is probable.

    Returns the selection steps, each with the most likely distribution of amplitudes, and a mapping from
    the cause of the last step to the reason if it was rejected, otherwise an empty mapping.
    """
    steps: list[SelectionStep] = []
    for _ in range(MOST_PARTS):
        parts = [step.part for step in steps]
        step = population.step(parts)
        if step.log_evidence < -math.log(limits.adequate):
            break
        step = replace(step, part=population.refine(parts, step.part))
        label = _label(step.part.candidate.kind)
        if step.heldout <= 0:
            return steps, {label: "held-out sessions do not agree with it"}
        seen = population.units.seen(step.part.candidate.index) & step.part.group.inside
        few = max(1, math.ceil(FOREMOST * int(seen.sum())))
        if population.without_foremost(parts, step.part, few) <= 0:
            return steps, {label: f"it depends on {few} of the sessions alone: trace these"}
        steps.append(step)
    return steps, {}


def _keep_supported(
    population: Population, steps: Sequence[SelectionStep]
) -> tuple[list[SelectionStep], dict[str, str]]:
    """Drop each cause that is explained by causes that were found later.

    Returns the remaining steps, and the reason for each dropped cause.
    """
    kept = list(steps)
    dropped: dict[str, str] = {}
    for step in steps[:-1]:
        others = [one.part for one in kept if one is not step]
        candidate, place = step.part.candidate, step.part.group
        own = population.scores(others, [candidate])[0][0, population.groups.index(place)]
        if own + candidate.log_prior + place.log_prior < -math.log(limits.adequate):
            kept = [one for one in kept if one is not step]
            dropped[_label(step.part.candidate.kind)] = "causes that were found later explain it"
    return kept, dropped


def _label(kind: Kind) -> str:
    return kind[0] if kind[1] else f"unnamed: {kind[0]}"


def _common(population: Population, others: Sequence[ChosenCause], step: SelectionStep) -> Common:
    """Return the result on one cause: its names, its share of the sessions, its amplitudes, its sessions.

    `others` are the other causes of the population, `step` is the step that chose this cause.
    """
    part, units = step.part, population.units
    kind = part.candidate.kind
    ranked = sorted(step.posterior.items(), key=lambda entry: -entry[1])
    # An unnamed function may contain a named one, so the name must be probable itself.
    by_name = kind[1] and sum(p for one, p in ranked if one[1]) >= limits.sure
    # The fewest causes whose probabilities add up to `POPULATION_SET`.
    last = np.searchsorted(np.cumsum([probability for _, probability in ranked]), POPULATION_SET)
    names = [one for one, _ in ranked[: last + 1]]
    share, low, high = share_of(population, others, part)
    mean, spread = means_of(population, others, part)
    probable = population.affected(others, part)
    if (part.amplitudes.mean == 0).all():
        # Without a common sign, many small amplitudes look like few large ones.
        seen = units.seen(part.candidate.index) & part.group.inside
        low = min(low, float((probable[seen] > 0.5).mean()))
    order = [i for i in np.argsort(-probable) if probable[i] > 0.5]
    return Common(
        effects=tuple(name for name, named in names if named) if by_name else (),
        depends_on="" if by_name else _dependence(names, kind),
        variant=part.candidate.variant,
        axes=tuple(part.candidate.axes),
        posterior={_label(one): probability for one, probability in ranked if probability > 1e-3},
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
        affected=tuple(
            Affected(one.source, one.serial, one.digest, float(probable[i]))
            for i, one in ((i, units.evidence[i]) for i in order)
        ),
    )


def _dependence(names: Sequence[Kind], best: Kind) -> str:
    """Return the quantity that an unnamed cause depends on, with possible named causes in brackets.

    `names` are the causes that the data cannot distinguish, `best` is the most probable of them.
    """
    nameless = [name for name, named in names if not named]
    also = [name for name, named in names if named]
    what = best[0] if not best[1] else nameless[0]
    return what + (f" (or {', '.join(also)})" if also else "")


_LEVELS = (0.025, 0.975)
_SHARES = np.concatenate([np.linspace(0.005, 0.2, 40), np.linspace(0.21, 1.0, 80)])
_FACTORS = np.geomspace(0.4, 2.5, 9)
"""Factors by which the most probable mean and spread of a cause are multiplied for a grid of trials.

The posterior of the share of affected sessions is averaged over this grid.
"""

_STEP = 0.05
"""Step of the derivatives by the parameters of a distribution (`parameters_of`)."""


def share_of(
    population: Population, others: Sequence[ChosenCause], part: ChosenCause
) -> tuple[float, float, float]:
    """Estimate the share of sessions that a cause affects, with its 95 % interval.

    `part` is the cause, `others` are the other causes in the model. Returns the posterior mean and both
    ends of the 95 % interval, for a uniform prior.
    """
    # Only sessions of the group that could show the cause.
    inside = part.group.inside & population.units.seen(part.candidate.index)
    given = population.given_others(others, part).inside(inside)
    log_posterior = []
    centred = bool((part.amplitudes.mean == 0).all())
    means = (np.ones(1) if centred else _FACTORS)[:, None] * part.amplitudes.mean
    for spread in part.amplitudes.spread * _FACTORS:
        factors = given.log_factors(means, spread)
        log_posterior += [mixed(factors, share, MOST_OF_KNOWN).sum(axis=0) for share in _SHARES]
    by_share = log_sum_exp(np.reshape(log_posterior, (len(_FACTORS), len(_SHARES), -1)), axis=(0, 2))
    # Normalise the posterior on the uneven grid of shares, and read off its quantiles.
    density = np.exp(by_share - by_share.max())
    weight = density * np.gradient(_SHARES)
    weight /= weight.sum()
    cumulative = np.cumsum(weight)
    low, high = (float(np.interp(level, cumulative, _SHARES)) for level in _LEVELS)
    return float(weight @ _SHARES), low, high


def means_of(
    population: Population, others: Sequence[ChosenCause], part: ChosenCause
) -> tuple[dict[str, Value], dict[str, float]]:
    """Return the mean amplitude of a cause with its uncertainty, and the spread over the sessions.

    Both are given by parameter in the parameter's unit. `part` is the cause, `others` are the other causes
    in the model. The uncertainty follows from the curvature of the log likelihood in share, spread and mean
    together.
    """
    size, u = _sizes(population, others, part), _uncertainty(population, others, part)
    means, spreads = (part.amplitudes.mean * size).tolist(), (part.amplitudes.spread * size).tolist()
    us = [None] * len(size) if u is None else (u * size).tolist()
    columns = [population.units.columns[k] for k in part.candidate.index]
    mean = {c.parameter: Value(m, own, c.unit) for c, m, own in zip(columns, means, us, strict=True)}
    return mean, {c.parameter: spread for c, spread in zip(columns, spreads, strict=True)}


def _sizes(population: Population, others: Sequence[ChosenCause], part: ChosenCause) -> Floats:
    """Return the factors (d,) that convert the scaled amplitudes of a cause to the unit of each column.

    A scaled amplitude is in units of the typical standard uncertainty over all sessions. If amplitudes are
    relative to each session's own uncertainty, the factor is the median of this uncertainty over the
    affected sessions, because the sessions of one stage may be much noisier than the rest. `part` is the
    cause, `others` are the other causes in the model.
    """
    units, index = population.units, list(part.candidate.index)
    typical = units.typical[index]
    if not part.amplitudes.relative:
        return typical
    likely = population.affected(others, part) > 0.5
    chosen = likely if likely.any() else part.group.inside
    out = typical.copy()
    for k, column in enumerate(index):
        length = units.length[chosen, column]
        if (length > 0).any():
            # `length` is typical/u without the column's weight, so the weight is applied here once.
            out[k] *= units.columns[column].weight * np.median(1 / length[length > 0])
    return out


def _uncertainty(population: Population, others: Sequence[ChosenCause], part: ChosenCause) -> Floats | None:
    """Return the standard uncertainty of the mean amplitudes (d,) of a cause.

    Its unit is the typical standard uncertainty of one session. Returns None if the mean is fixed at zero,
    or if the likelihood has no maximum as a function of the mean. `part` is the cause, `others` are the
    other causes in the model.
    """
    start = part.amplitudes
    at = parameters_of(start)
    if len(at) == 2:
        return None
    given = population.given_others(others, part).inside(part.group.inside)

    def slope(parameters: Floats) -> Floats:
        return central_differences(
            lambda own: given.gain(group_at(own, start), MOST_OF_KNOWN).sum(), parameters, _STEP
        )

    # Parameters: logit of the share, log of the spread, mean.
    hessian = -central_differences(slope, at, _STEP)
    # A share at its bound or a spread near zero has no curvature: it stays fixed.
    free = np.diagonal(hessian) > 1e-2
    free[2:] = True
    try:
        covariance = np.linalg.inv(hessian[np.ix_(free, free)])
    except np.linalg.LinAlgError:
        return None
    variance = np.diagonal(covariance)[int(free[:2].sum()) :]
    return np.sqrt(variance) if (variance > 0).all() else None
