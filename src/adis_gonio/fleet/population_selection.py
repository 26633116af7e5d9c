"""Forward selection of the causes of a population, on the joint evidence of all sessions.

A candidate is a cause on some axes with its share of the prior. Each step compares every candidate in every
group of sessions, given the causes that were chosen before. A chosen cause may or may not be present in a
session, with an unknown amplitude; both are averaged out, so that a candidate gains nothing from readings
that a chosen cause explains.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, log_sum_exp
from adis_gonio.fleet.population_likelihood import (
    MOST,
    MOST_OF_KNOWN,
    Block,
    Given,
    Group,
    Units,
    grid_of,
    log_factor,
)
from adis_gonio.fleet.session_evidence import Column
from adis_gonio.model.effects import catalogue
from adis_gonio.tracing.named_candidates import prior_weight
from adis_gonio.tracing.thresholds import limits


@dataclass(frozen=True)
class Candidate:
    """A cause that may affect sessions, in one form (degree, cycles or time constant) and on certain axes.

    Attributes
    ----------
    cause : str
        Name of the effect in the catalogue, or the quantity that an unnamed function depends on.
    named : bool
        True if the catalogue has the cause; False for an unnamed function.
    variant : str
        Form of the cause (not the type of the sensor): degree, cycles per turn or time constant (see
        `Column`).
    axes : str
        Letters of the axes; empty for an effect of the stage, which acts on no single axis.
    index : tuple of int
        Indices of its columns (amplitudes) among the columns of the population.
    log_prior : float
        Log of its prior probability.
    """

    cause: str
    named: bool
    variant: str
    axes: str
    index: tuple[int, ...]
    log_prior: float

    @property
    def kind(self) -> tuple[str, bool]:
        """The name of the cause, and True if it is named in the catalogue of effects."""
        return self.cause, self.named


def candidates_of(columns: Sequence[Column]) -> list[Candidate]:
    """List every cause on each axis and on all axes together, with its prior probability.

    The priors are equal to those in the trace of one session. The prior probability of a name is divided
    evenly among the forms of the cause, or in proportion to 1/n among the numbers n of cycles per turn.
    `columns` are the amplitudes on which sessions give evidence.
    """
    by_kind: dict[tuple[str, bool], list[int]] = defaultdict(list)
    for k, column in enumerate(columns):
        by_kind[column.cause, column.named].append(k)
    named = [kind for kind in by_kind if kind[1]]
    weight = {kind: prior_weight(catalogue()[kind[0]]) for kind in named}
    out = []
    for kind, index in by_kind.items():
        if kind[1]:
            share = (1 - limits.nameless_share) * weight[kind] / sum(weight.values())
        else:
            share = limits.nameless_share / (len(by_kind) - len(named))
        blocks = list(_blocks(kind[0] if kind[1] else "", index, columns))
        parts = [
            1 / int(form.removeprefix("cycles=")) if form.startswith("cycles=") else 1.0
            for form, _, _ in blocks
        ]
        for (variant, axes, own), part in zip(blocks, parts, strict=True):
            out.append(Candidate(*kind, variant, axes, own, math.log(share * part / sum(parts))))
    return out


def _blocks(
    name: str, index: Sequence[int], columns: Sequence[Column]
) -> Iterator[tuple[str, str, tuple[int, ...]]]:
    """Yield the form, the axes and the column indices of each candidate of a cause.

    `name` is the name in the catalogue, empty for an unnamed cause; `index` are the indices of its columns.
    """
    variants: dict[str, dict[str, list[int]]] = defaultdict(lambda: defaultdict(list))
    for k in index:
        variants[columns[k].variant][columns[k].axes].append(k)
    alone = bool(name) and catalogue()[name].one_axis
    below: dict[str, list[int]] = defaultdict(list)
    for variant in sorted(variants):
        by_axis = variants[variant]
        if variant.startswith("degree="):  # a polynomial includes its lower powers
            for letter, own in by_axis.items():
                below[letter] += own
            by_axis = {letter: list(below[letter]) for letter in by_axis}
        for letter, own in by_axis.items():
            yield variant, letter, tuple(own)
        if len(by_axis) > 1 and not alone:
            yield variant, "".join(sorted(by_axis)), tuple(itertools.chain(*by_axis.values()))


FOLDS = 5
"""Number of folds into which the sessions are divided for cross-validation."""
LEAST_UNITS = 5
"""Smallest number of sessions of a population or a group."""
GROUPINGS = ("stage", "operator", "serial", "sensor")
"""Groupings of the sessions; a cause may be common to all sessions with one value of a grouping."""
WHOLE = 0.5
"""Prior share of causes that act in all sessions.

The remaining prior is for causes in the sessions of one stage, operator, serial number or type of sensor.
"""

Kind = tuple[str, bool]


@dataclass(frozen=True)
class Membership:
    """A group of sessions: all, or those with one stage, operator, serial number or type of sensor.

    Attributes
    ----------
    by : str
        Grouping: `all`, `stage`, `operator`, `serial` or `sensor`.
    value : str
        Common value of these sessions, such as the name of the stage; empty for all sessions.
    inside : (n,) bool
        True for the sessions of the group.
    log_prior : float
        Log of the prior probability that a cause acts in this group.
    """

    by: str
    value: str
    inside: NDArray[np.bool_]
    log_prior: float


def memberships(units: Units) -> list[Membership]:
    """List the groups of sessions in which a cause may act.

    These are all sessions, and the sessions of each value of `GROUPINGS` if they are at least
    `LEAST_UNITS`.
    """
    n = len(units)
    found: list[list[tuple[str, str, NDArray[np.bool_]]]] = []
    for name in GROUPINGS:
        values = np.array([getattr(one, name) for one in units.evidence])
        masks = [(name, str(value), values == value) for value in sorted(set(values.tolist()) - {""})]
        kept = [group for group in masks if LEAST_UNITS <= group[2].sum() < n]
        if kept:
            found.append(kept)
    whole = Membership("all", "", np.ones(n, dtype=bool), np.log(WHOLE) if found else 0.0)
    return [
        whole,
        *(
            Membership(name, value, inside, float(np.log((1 - WHOLE) / len(found) / len(kept))))
            for kept in found
            for name, value, inside in kept
        ),
    ]


@dataclass(frozen=True)
class ChosenCause:
    """A cause in the model: the candidate, the group of sessions in which it acts, and its amplitudes.

    `amplitudes` is the distribution of the amplitudes over the affected sessions of the group.
    """

    candidate: Candidate
    group: Membership
    amplitudes: Group


@dataclass(frozen=True)
class Scores:
    """Evidence for adding each of k candidates, in each of g groups, to the present model.

    Attributes
    ----------
    log_evidence : (k, g) float
        Log evidence for the model with the candidate in the group, against the present model, averaged over
        the grid of distributions.
    trained : (k, g, folds) float
        Log evidence without the sessions of a fold.
    best : (k, g) int
        Index of the most probable distribution of the grid.
    """

    log_evidence: Floats
    trained: Floats
    best: NDArray[np.intp]


@dataclass(frozen=True)
class SelectionStep:
    """One step of the forward selection of causes: the added cause, and the evidence for it.

    Attributes
    ----------
    part : ChosenCause
        Best candidate of the most probable cause, with the best distribution of the grid.
    log_evidence : float
        Log evidence for any further cause, against the present model, averaged over all candidates by their
        prior.
    posterior : mapping of (cause, named) to float
        Probability of each cause, if there is a further cause; the sum is 1.
    places : mapping of (by, value) to float
        Probability of each group of sessions, if the cause is right.
    heldout : float
        Log score of the sessions of each fold, for the cause that the other folds choose, added up over the
        folds.
    """

    part: ChosenCause
    log_evidence: float
    posterior: Mapping[Kind, float]
    places: Mapping[tuple[str, str], float]
    heldout: float


class Population:
    """Evidence of many sessions, their possible causes, and the groups in which a cause may act."""

    def __init__(self, units: Units, candidates: Sequence[Candidate], groups: Sequence[Membership]) -> None:
        self.units = units
        self.candidates = list(candidates)
        self.groups = list(groups)
        self.fold = np.arange(len(units)) % FOLDS
        # Rows that add up the units of each fold of each group.
        inside = np.stack([group.inside for group in groups])
        folds = self.fold[None, :] == np.arange(FOLDS)[:, None]
        self._sums = (inside[:, None, :] & folds[None, :, :]).reshape(-1, len(units)).astype(float)

    def given(self, parts: Sequence[ChosenCause], candidate: Candidate, *, relative: bool = False) -> Given:
        """Return the evidence on a candidate, with the amplitudes of other causes averaged out.

        The causes `parts` may each be present or absent in a session. `relative` is true for amplitudes in
        each session's standard uncertainty.
        """
        weights, blocks = [], []
        # Every combination of present and absent parts, with its probability in each unit.
        for present in itertools.product((False, True), repeat=len(parts)):
            log_prior = np.zeros(len(self.units))
            for part, there in zip(parts, present, strict=True):
                share = min(part.amplitudes.share, 1 - 1e-9)
                inside = part.group.inside
                log_prior += np.where(
                    inside, np.log(share if there else 1 - share), -np.inf if there else 0.0
                )
            chosen = [part for part, there in zip(parts, present, strict=True) if there]
            weight, block = self._block_given(chosen, candidate.index, log_prior, relative)
            weights.append(weight)
            blocks.append(block)
        every = np.stack(weights)
        return Given(every - log_sum_exp(every, axis=0), tuple(blocks))

    def given_others(self, parts: Sequence[ChosenCause], part: ChosenCause) -> Given:
        """Return the evidence on the amplitudes of the cause `part`, averaged over the causes `parts`."""
        return self.given(parts, part.candidate, relative=part.amplitudes.relative)

    def _block_given(
        self, chosen: Sequence[ChosenCause], index: Sequence[int], log_prior: Floats, relative: bool
    ) -> tuple[Floats, Block]:
        """Return score and information of the columns `index` if the causes `chosen` are present.

        The amplitudes of these causes are averaged out. `log_prior` (n,) is the log prior of the
        combination. Returned with the block is the log probability (n,) of the combination, not normalised.
        `relative` is true for amplitudes in each session's standard uncertainty.
        """
        held = [k for part in chosen for k in part.candidate.index]
        in_own = [part.amplitudes.relative for part in chosen for _ in part.candidate.index]
        both = self.units.joint([*held, *index], [*in_own, *([relative] * len(index))])
        a = len(held)
        own = Block(both.score[:, a:], both.information[:, a:, a:])
        if not chosen:
            return log_prior, own
        mean = np.concatenate([part.amplitudes.mean for part in chosen])
        spread = np.concatenate(
            [np.full(len(part.candidate.index), part.amplitudes.spread) for part in chosen]
        )
        first = Block(both.score[:, :a], both.information[:, :a, :a])
        across = both.information[:, :a, a:]
        # Schur complement: the chosen amplitudes are integrated over their distribution.
        precision = first.information + np.diag(spread**-2.0)
        linear = (first.score + mean / spread**2)[:, :, None]
        solved = np.linalg.solve(precision, np.concatenate([linear, across], axis=2))
        score = own.score - (across.transpose(0, 2, 1) @ solved[:, :, :1])[:, :, 0]
        information = own.information - across.transpose(0, 2, 1) @ solved[:, :, 1:]
        return log_prior + log_factor(first, mean, spread), Block(score, information)

    def by_unit(self, parts: Sequence[ChosenCause], candidate: Candidate, most: float = MOST) -> Floats:
        """Return the log likelihood ratio (n, 2 h) of each session, with a candidate against without it.

        `parts` are the causes that are already in the model. There is one column for each distribution of
        the candidate's grid. The log Bayes factor of a session is limited to `most`.
        """
        grid = grid_of(len(candidate.index))
        both = [self.given(parts, candidate, relative=relative) for relative in (False, True)]
        return np.concatenate([given.gains(grid, most) for given in both], axis=1)

    def scores(self, parts: Sequence[ChosenCause], only: Sequence[Candidate] | None = None) -> Scores:
        """Return the evidence for adding each candidate, in every group, to the present model.

        `parts` are the causes in the present model. `only` are the candidates; None takes all.
        """
        candidates = self.candidates if only is None else only
        shape = (len(candidates), len(self.groups))
        evidence, best = np.zeros(shape), np.zeros(shape, dtype=np.intp)
        trained = np.zeros((*shape, FOLDS))
        for k, candidate in enumerate(candidates):
            prior = grid_of(len(candidate.index)).log_priors
            # Sum of the gains by group and fold, then over all folds, and over all folds but one.
            by_fold = (self._sums @ self.by_unit(parts, candidate)).reshape(len(self.groups), FOLDS, -1)
            whole = by_fold.sum(axis=1)
            evidence[k] = log_sum_exp(whole + prior, axis=1)
            best[k] = (whole + prior).argmax(axis=1)
            trained[k] = log_sum_exp(whole[:, None] - by_fold + prior, axis=2)
        return Scores(evidence, trained, best)

    def step(self, parts: Sequence[ChosenCause]) -> SelectionStep:
        """Find the most probable cause to add to the model with the causes `parts`."""
        # Posterior over candidates and groups, then the best candidate of the most probable cause.
        scores = self.scores(parts)
        own_prior = np.array([candidate.log_prior for candidate in self.candidates])
        prior = own_prior[:, None] + np.array([group.log_prior for group in self.groups])
        weighed = scores.log_evidence + prior
        any_ = float(log_sum_exp(weighed.ravel()))
        share = np.exp(weighed - any_)  # posterior of each candidate in each group
        posterior: dict[Kind, float] = defaultdict(float)
        for k, candidate in enumerate(self.candidates):
            posterior[candidate.kind] += float(share[k].sum())
        kind = max(posterior, key=lambda one: posterior[one])
        own = [k for k, candidate in enumerate(self.candidates) if candidate.kind == kind]
        flat, g = divmod(int(weighed[own].argmax()), len(self.groups))
        chosen = own[flat]
        candidate, group = self.candidates[chosen], self.groups[g]
        # The log score of the sessions of each fold, predicted from the others with the cause they choose.
        heldout = 0.0
        for fold in range(FOLDS):
            trained = scores.trained[:, :, fold]
            best = int((trained + prior).argmax())
            heldout += float((scores.log_evidence - trained).ravel()[best])
        places = share[own].sum(axis=0) / share[own].sum()
        grid = grid_of(len(candidate.index))
        start = grid.group(int(scores.best[chosen, g]))
        return SelectionStep(
            part=ChosenCause(candidate, group, start),
            log_evidence=any_,
            posterior=dict(posterior),
            places={(one.by, one.value): float(p) for one, p in zip(self.groups, places, strict=True)},
            heldout=heldout,
        )

    def refine(self, parts: Sequence[ChosenCause], part: ChosenCause) -> ChosenCause:
        """Find the most likely distribution of the amplitudes of the cause `part`.

        The other causes `parts` stay fixed. Returns the cause with this distribution.
        """
        from scipy.optimize import minimize

        likely = self.by_unit(parts, part.candidate, MOST_OF_KNOWN)[part.group.inside].sum(axis=0)
        start = grid_of(len(part.candidate.index)).group(int(likely.argmax()))
        given = self.given_others(parts, replace(part, amplitudes=start)).inside(part.group.inside)

        def at(amplitudes: Group) -> float:
            return float(given.gain(amplitudes, MOST_OF_KNOWN).sum())

        # Refine from the best distribution of the grid.
        found = minimize(  # type: ignore[call-overload]
            lambda p: -at(group_at(p, start)),
            parameters_of(start),
            method="Nelder-Mead",
            options={"maxfev": 150 + 50 * len(start.mean), "xatol": 0.02, "fatol": 0.02},
        )
        best = group_at(found.x, start)
        return replace(part, amplitudes=best if at(best) > at(start) else start)

    def affected(self, parts: Sequence[ChosenCause], part: ChosenCause) -> Floats:
        """Return the probability (n,) that the cause `part` affects each session.

        `parts` are the other causes, with the distributions of their amplitudes.
        """
        share = min(part.amplitudes.share, 1 - 1e-9)
        odds = np.log(share) - np.log1p(-share) + self.given_others(parts, part).log_factor(part.amplitudes)
        return np.where(part.group.inside, 1 / (1 + np.exp(-np.clip(odds, -500, 500))), 0.0)

    def without_foremost(self, parts: Sequence[ChosenCause], part: ChosenCause, count: int) -> float:
        """Return the rise of the log likelihood by the cause `part`, without its strongest sessions.

        `parts` are the other causes. The `count` sessions that favour the cause most are omitted from the
        sum.
        """
        own = np.sort(self.given_others(parts, part).gain(part.amplitudes)[part.group.inside])
        return float(own[: max(len(own) - count, 0)].sum())


def parameters_of(group: Group) -> Floats:
    """Convert a distribution of amplitudes to unbounded parameters for an optimiser.

    They are the logit of the share, the log of the spread and, if it is not zero, the mean (d,).
    """
    odds = np.log(group.share / max(1 - group.share, 1e-3))
    centred = bool((group.mean == 0).all())
    return np.array([odds, np.log(group.spread), *([] if centred else group.mean)])


def group_at(parameters: Floats, like: Group) -> Group:
    """Convert unbounded parameters back to a distribution of amplitudes.

    `parameters` (m,) are the logit of the share, the log of the spread and, if it is not fixed, the mean.

    The distribution `like` gives the mean if it is not among the parameters, and the flag `relative`.
    """
    share = 1 / (1 + np.exp(-np.clip(parameters[0], -8, 12)))
    spread = float(np.exp(np.clip(parameters[1], -4, 5)))
    mean = like.mean if len(parameters) == 2 else parameters[2:]
    return Group(float(share), mean, spread, like.relative)
