"""Which causes a population has: forward selection on the joint evidence of all sessions.

A step weighs every candidate in every group of sessions beside what was chosen before. What was chosen may
or may not be present in a unit, and its amplitude there is not known: both are averaged out, so that a
candidate which another one explains has nothing left to explain.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.fleet.population.candidates import Candidate
from adis_gonio.fleet.population.mixture import (
    MOST,
    MOST_OF_KNOWN,
    Block,
    Group,
    gains,
    grid_of,
    log_factor,
    log_sum,
    mixed,
)
from adis_gonio.fleet.population.units import Units

FOLDS = 5
"""Parts of the units; each takes no part in what is checked on it."""
LEAST_UNITS = 5
"""Fewest sessions of which something is said in common."""
WHOLE = 0.5
"""Prior share of all sessions against those of one stage, operator, serial number or variant."""

Kind = tuple[str, bool]


@dataclass(frozen=True)
class Membership:
    """Sessions that share something.

    Attributes
    ----------
    by : str
        `all`, `stage`, `operator`, `serial` or `sensor`.
    value : str
        What they share; empty for all.
    inside : (n,) bool
    log_prior : float
    """

    by: str
    value: str
    inside: NDArray[np.bool_]
    log_prior: float


def memberships(units: Units, by: Sequence[str]) -> list[Membership]:
    """All sessions, and those of each value of what they are grouped by."""
    n = len(units)
    found: list[list[tuple[str, str, NDArray[np.bool_]]]] = []
    for name in by:
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
    """A cause that was chosen: where, and how its amplitudes are distributed."""

    candidate: Candidate
    group: Membership
    amplitudes: Group


@dataclass(frozen=True)
class Scores:
    """Candidates (k) in groups (g) beside a model.

    Attributes
    ----------
    log_evidence : (k, g) float
        Of each candidate in each group against the model, averaged over the grid.
    trained, foreseen : (k, g, folds) float
        The same without a fold, and what is then foreseen of the fold.
    best : (k, g) int
        Distribution of the grid of greatest likelihood.
    """

    log_evidence: Floats
    trained: Floats
    foreseen: Floats
    best: NDArray[np.intp]


@dataclass(frozen=True)
class SelectionStep:
    """One step of the selection.

    Attributes
    ----------
    part : ChosenCause
        Best candidate of the most probable cause, its distribution that of the grid.
    log_evidence : float
        Of any cause at all against the model before, averaged over all candidates by their prior.
    posterior : mapping of (cause, named) to float
        Given that there is any cause; sums to 1.
    places : mapping of (by, value) to float
        The same of the group, given the cause.
    heldout : float
        Log score of the units of each fold by the cause that the other folds choose.
    """

    part: ChosenCause
    log_evidence: float
    posterior: Mapping[Kind, float]
    places: Mapping[tuple[str, str], float]
    heldout: float


class Population:
    """Units with their candidates and groups."""

    def __init__(self, units: Units, candidates: Sequence[Candidate], groups: Sequence[Membership]) -> None:
        self.units = units
        self.candidates = list(candidates)
        self.groups = list(groups)
        self.fold = np.arange(len(units)) % FOLDS
        inside = np.stack([group.inside for group in groups])
        folds = self.fold[None, :] == np.arange(FOLDS)[:, None]
        self._sums = (inside[:, None, :] & folds[None, :, :]).reshape(-1, len(units)).astype(float)

    def beside(
        self, parts: Sequence[ChosenCause], index: Sequence[int], relative: bool = False
    ) -> list[tuple[Floats, Block]]:
        """Log probability (n,) of each combination of parts, and the block (columns) left beside it."""
        own = self.units.joint(index, relative)
        if not parts:
            return [(np.zeros(len(self.units)), own)]
        out = []
        for present in itertools.product((False, True), repeat=len(parts)):
            log_prior = np.zeros(len(self.units))
            for part, there in zip(parts, present, strict=True):
                share = min(part.amplitudes.share, 1 - 1e-9)
                inside = part.group.inside
                log_prior += np.where(
                    inside, np.log(share if there else 1 - share), -np.inf if there else 0.0
                )
            chosen = [part for part, there in zip(parts, present, strict=True) if there]
            out.append(self._given(chosen, index, own, log_prior, relative))
        norm = log_sum(np.stack([weight for weight, _ in out]), axis=0)
        return [(weight - norm, block) for weight, block in out]

    def _given(
        self,
        chosen: Sequence[ChosenCause],
        index: Sequence[int],
        own: Block,
        log_prior: Floats,
        relative: bool,
    ) -> tuple[Floats, Block]:
        """The block where some parts are present, their amplitudes averaged out."""
        if not chosen:
            return log_prior, own
        held = [k for part in chosen for k in part.candidate.index]
        mean = np.concatenate([part.amplitudes.mean for part in chosen])
        spread = np.concatenate(
            [np.full(len(part.candidate.index), part.amplitudes.spread) for part in chosen]
        )
        in_own = [part.amplitudes.relative for part in chosen for _ in part.candidate.index]
        both = self.units.joint([*held, *index], [*in_own, *([relative] * len(index))])
        a = len(held)
        first = Block(both.score[:, :a], both.information[:, :a, :a])
        across = both.information[:, :a, a:]
        precision = first.information + np.diag(spread**-2.0)
        linear = (first.score + mean / spread**2)[:, :, None]
        solved = np.linalg.solve(precision, np.concatenate([linear, across], axis=2))
        score = own.score - (across.transpose(0, 2, 1) @ solved[:, :, :1])[:, :, 0]
        information = own.information - across.transpose(0, 2, 1) @ solved[:, :, 1:]
        return log_prior + log_factor(first, mean, spread), Block(score, information)

    def by_unit(self, parts: Sequence[ChosenCause], candidate: Candidate, most: float = MOST) -> Floats:
        """Log gain (n, 2 h) of each unit at each distribution of the candidate's grid."""
        grid = grid_of(len(candidate.index))
        out = []
        for relative in (False, True):
            blocks = self.beside(parts, candidate.index, relative)
            rows = [weight[:, None] + gains(block, grid, most) for weight, block in blocks]
            out.append(rows[0] if len(rows) == 1 else log_sum(np.stack(rows), axis=0))
        return np.concatenate(out, axis=1)

    def scores(self, parts: Sequence[ChosenCause], only: Sequence[Candidate] | None = None) -> Scores:
        """All candidates, or some, in all groups beside a model."""
        candidates = self.candidates if only is None else only
        shape = (len(candidates), len(self.groups))
        evidence, best = np.zeros(shape), np.zeros(shape, dtype=np.intp)
        trained, foreseen = np.zeros((*shape, FOLDS)), np.zeros((*shape, FOLDS))
        for k, candidate in enumerate(candidates):
            prior = grid_of(len(candidate.index)).log_priors
            by_fold = (self._sums @ self.by_unit(parts, candidate)).reshape(len(self.groups), FOLDS, -1)
            whole = by_fold.sum(axis=1)
            evidence[k] = log_sum(whole + prior, axis=1)
            best[k] = (whole + prior).argmax(axis=1)
            trained[k] = log_sum(whole[:, None] - by_fold + prior, axis=2)
            foreseen[k] = evidence[k][:, None] - trained[k]
        return Scores(evidence, trained, foreseen, best)

    def step(self, parts: Sequence[ChosenCause]) -> SelectionStep:
        """The most probable further cause."""
        scores = self.scores(parts)
        prior = self.log_prior
        weighed = scores.log_evidence + prior
        any_ = float(log_sum(weighed.ravel()))
        share = np.exp(weighed - any_)
        posterior: dict[Kind, float] = defaultdict(float)
        for k, candidate in enumerate(self.candidates):
            posterior[candidate.kind] += float(share[k].sum())
        kind = max(posterior, key=lambda one: posterior[one])
        own = [k for k, candidate in enumerate(self.candidates) if candidate.kind == kind]
        flat, g = divmod(int(weighed[own].argmax()), len(self.groups))
        chosen = own[flat]
        candidate, group = self.candidates[chosen], self.groups[g]
        places = share[own].sum(axis=0) / share[own].sum()
        grid = grid_of(len(candidate.index))
        start = grid.group(int(scores.best[chosen, g]))
        return SelectionStep(
            part=ChosenCause(candidate, group, start),
            log_evidence=any_,
            posterior=dict(posterior),
            places={(one.by, one.value): float(p) for one, p in zip(self.groups, places, strict=True)},
            heldout=_heldout(scores, prior),
        )

    @property
    def log_prior(self) -> Floats:
        """Of each candidate in each group (k, g)."""
        own = np.array([candidate.log_prior for candidate in self.candidates])
        return np.asarray(own[:, None] + np.array([group.log_prior for group in self.groups]))

    def sharpened(self, parts: Sequence[ChosenCause], part: ChosenCause) -> ChosenCause:
        """The part with the distribution of greatest likelihood beside the others."""
        from scipy.optimize import minimize

        likely = self.by_unit(parts, part.candidate, MOST_OF_KNOWN)[part.group.inside].sum(axis=0)
        start = grid_of(len(part.candidate.index)).group(int(likely.argmax()))
        blocks = [
            (weight[part.group.inside], Block(b.score[part.group.inside], b.information[part.group.inside]))
            for weight, b in self.beside(parts, part.candidate.index, start.relative)
        ]

        def at(amplitudes: Group) -> float:
            rows = [
                w
                + mixed(log_factor(b, amplitudes.mean, amplitudes.spread), amplitudes.share, MOST_OF_KNOWN)
                for w, b in blocks
            ]
            return float(log_sum(np.stack(rows), axis=0).sum())

        found = minimize(  # type: ignore[call-overload]
            lambda p: -at(group_at(p, start)),
            parameters_of(start),
            method="Nelder-Mead",
            options={"maxfev": 150 + 50 * len(start.mean), "xatol": 0.02, "fatol": 0.02},
        )
        best = group_at(found.x, start)
        return replace(part, amplitudes=best if at(best) > at(start) else start)

    def affected(self, parts: Sequence[ChosenCause], part: ChosenCause) -> Floats:
        """Probability (n,) that each unit is affected by a part, given the others."""
        amplitudes = part.amplitudes
        share = min(amplitudes.share, 1 - 1e-9)
        with_, without = [], []
        for weight, block in self.beside(parts, part.candidate.index, part.amplitudes.relative):
            factor = log_factor(block, amplitudes.mean, amplitudes.spread)
            with_.append(weight + np.log(share) + factor)
            without.append(weight + np.log1p(-share))
        odds = log_sum(np.stack(with_), axis=0) - log_sum(np.stack(without), axis=0)
        return np.where(part.group.inside, 1 / (1 + np.exp(-np.clip(odds, -500, 500))), 0.0)

    def without_foremost(self, parts: Sequence[ChosenCause], part: ChosenCause, count: int) -> float:
        """Log likelihood that a part adds, without the units that add most to it."""
        amplitudes = part.amplitudes
        rows = [
            w + mixed(log_factor(b, amplitudes.mean, amplitudes.spread), amplitudes.share)
            for w, b in self.beside(parts, part.candidate.index, part.amplitudes.relative)
        ]
        own = np.sort(log_sum(np.stack(rows), axis=0)[part.group.inside])
        return float(own[: max(len(own) - count, 0)].sum())


def parameters_of(group: Group) -> Floats:
    """Unbounded parameters: logit of the share, log of the spread, and the mean where it is not zero."""
    odds = np.log(group.share / max(1 - group.share, 1e-3))
    centred = bool((group.mean == 0).all())
    return np.array([odds, np.log(group.spread), *([] if centred else group.mean)])


def group_at(parameters: Floats, like: Group) -> Group:
    """The reverse of `parameters_of`."""
    share = 1 / (1 + np.exp(-np.clip(parameters[0], -8, 12)))
    spread = float(np.exp(np.clip(parameters[1], -4, 5)))
    mean = like.mean if len(parameters) == 2 else parameters[2:]
    return Group(float(share), mean, spread, like.relative)


def _heldout(scores: Scores, prior: Floats) -> float:
    """What each fold's units say of the cause that the other folds choose."""
    gain = 0.0
    for fold in range(FOLDS):
        chosen = int((scores.trained[:, :, fold] + prior).argmax())
        gain += float(scores.foreseen[:, :, fold].ravel()[chosen])
    return gain
