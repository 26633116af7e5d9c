"""The hierarchical likelihood of a cause over many sessions, and the selection of causes by it.

A unit (a session) is affected with probability w. The amplitudes of an affected unit are θ ~ N(μ, τ² 1),
the amplitudes of other units are zero. μ and τ are either in the unit of the amplitudes or relative to each
session's standard uncertainty (for amplitudes that differ by orders of magnitude between sessions); each
has half of the prior. With score s and information G of a unit,

    ln B(μ, τ) = sᵀμ − ½ μᵀGμ + ½ (s − Gμ)ᵀ (G + 1/τ²)⁻¹ (s − Gμ) − ½ ln |1 + τ² G|

gives its Bayes factor B for being affected, in closed form, and Σ ln(1 − w + w B) is the log likelihood of
the population (empirical Bayes: Efron, Large-Scale Inference, 2010, ch. 2). Averaged over a grid of (w, μ,
τ) that was fixed before the data, the likelihood ratio of the population is an e-value: its expectation is
1 if no unit is affected, so that it exceeds 1/p with probability p at most (Markov; Vovk and Wang, Ann.
Stat. 49, 2021), for any number of units. The Bayes factor of one unit is limited to exp(`MOST`); with the
limit it is still an e-value.

The noise of each session is checked by its own χ². Ratios χ²/ν scatter by √(2/ν) if the stated noise is
right; any additional scatter is a difference between sessions. Each ratio is shrunk towards the common
ratio accordingly (moderated variances: Smyth, Stat. Appl. Genet. Mol. Biol. 3, 2004). A ratio that the
common ratio cannot explain is used unchanged. No ratio is less than 1 if the noise was stated, so that
noise stated too small does not look like an effect.

Causes are selected one after another. A candidate is a cause on some axes with its share of the prior. Each
step compares every candidate in every group of sessions, given the causes that were chosen before. A chosen
cause may or may not be present in a session, with an unknown amplitude; both are averaged out, so that a
candidate gains nothing from readings that a chosen cause explains.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, log_sum_exp
from adis_gonio.fleet.session_evidence import Column, SessionEvidence
from adis_gonio.model.effects import catalogue
from adis_gonio.tracing.named_candidates import prior_weight
from adis_gonio.tracing.thresholds import limits

MOST = float(np.log(1000.0))
"""Largest log Bayes factor of one session, so that an extreme session proves no common cause."""
MOST_OF_KNOWN = 100.0
"""Largest log Bayes factor of one session for a cause that is already accepted.

It is used to estimate the distribution of the amplitudes of this cause.
"""
SHARES = (0.03, 0.1, 0.2, 0.35, 0.6, 1.0)
"""Shares w of affected sessions to try.

A cause in fewer than 3 % of the sessions is not common.
"""
SPREADS = (0.35, 0.7, 1.4, 2.8, 5.6, 11.0)
"""Standard deviations τ to try for amplitudes that scatter about zero.

They are in typical standard uncertainties.
"""
MEANS = (0.35, 0.7, 1.4, 2.8, 5.6, 11.0)
"""Lengths of the mean μ to try for amplitudes of one sign, in typical standard uncertainties.

The spread is a third of the length.
"""
RELATIVE_SPREAD = 1 / 3


@dataclass(frozen=True)
class Group:
    """Distribution of the amplitudes of a cause: normal with `mean` (d,) and `spread` on every axis.

    The share `share` of the sessions is affected. The unit of mean and spread is the typical standard
    uncertainty over all sessions or, if `relative` is true, the standard uncertainty of each session.
    """

    share: float
    mean: Floats
    spread: float
    relative: bool = False


def log_factors(score: Floats, information: Floats, means: Floats, spread: float | Floats) -> Floats:
    """Return log Bayes factors (…, n, h) of n sessions, affected against unaffected.

    They are not bounded, so one session can outweigh all others.

    Parameters
    ----------
    score, information : (…, n, d) float, (…, n, d, d) float
        Derivative of the log likelihood by d amplitudes at zero, and minus its second derivative.
    means : (h, d) float
        Mean amplitudes of affected sessions, of which each gives a factor.
    spread : float or (d,) float
        Standard deviation of the amplitudes of affected sessions.
    """
    shifted = score[..., None, :] - means @ information  # s − Gμ, (…, n, h, d)
    along = 0.5 * ((score[..., None, :] + shifted) * means).sum(axis=-1)
    wide = np.broadcast_to(np.asarray(spread, dtype=float), means.shape[1:])
    if len(wide) == 1:  # scalars instead of matrices
        denominator = 1 + wide[0] ** 2 * information[..., 0]
        square = shifted[..., 0] ** 2 * (wide[0] ** 2 / denominator)
        return np.asarray(along + 0.5 * (square - np.log(denominator)))
    # Gaussian integral over the amplitudes: quadratic form and determinant of (G + 1/τ²).
    precision = information + np.diag(wide**-2.0)
    solved = np.linalg.solve(precision, shifted.swapaxes(-1, -2)).swapaxes(-1, -2)
    size = np.linalg.slogdet(precision)[1] + 2 * np.log(wide).sum()
    return np.asarray(along + 0.5 * (shifted * solved).sum(axis=-1) - 0.5 * size[..., None])


@dataclass(frozen=True)
class Grid:
    """A grid of trial distributions of a cause's amplitudes, with their prior.

    It is chosen before the data are seen. It combines h distributions with each of `SHARES`, first for
    amplitudes in their unit, then for relative amplitudes: m = 2 · 6 · h.

    Attributes
    ----------
    mean, spread : (h, d) float, (h,) float
        Mean amplitudes and standard deviation of the amplitudes of affected sessions.
    log_prior : (m,) float
        Log of the prior of each combination.
    """

    mean: Floats
    spread: Floats
    log_prior: Floats

    def group(self, k: int) -> Group:
        """Return combination k of the grid."""
        relative, share, at = np.unravel_index(k, (2, len(SHARES), len(self.spread)))
        return Group(SHARES[share], self.mean[at], float(self.spread[at]), bool(relative))


@cache
def grid_of(width: int) -> Grid:
    """Make the grid of trial distributions for a cause with `width` amplitudes.

    Half of the prior is for amplitudes that scatter about zero, half for amplitudes with a common sign.
    """
    # No common sign: zero mean and several spreads.
    still = [(np.zeros(width), spread, 0.5 / len(SPREADS)) for spread in SPREADS]
    # Each axis, with either sign, and the four diagonal directions of two amplitudes.
    ways = [sign * row for row in np.eye(width) for sign in (1.0, -1.0)]
    if width == 2:
        ways += [np.array(signs) / np.sqrt(2) for signs in itertools.product((1.0, -1.0), repeat=2)]
    # Common sign: a mean along each direction, with a third of its length as spread.
    moved = [
        (size * way, size * RELATIVE_SPREAD, 0.5 / len(MEANS) / len(ways)) for size in MEANS for way in ways
    ]
    means, spreads, parts = map(np.array, zip(*still, *moved, strict=True))
    copies = 2 * len(SHARES)
    return Grid(means, spreads, np.tile(np.log(parts / copies), copies))


def mixed(log_factor: Floats, share: float, most: float = MOST) -> Floats:
    """Return the log likelihood ratio ln(1 − w + w B) of sessions that are affected with probability w.

    `log_factor` is ln B, with the Bayes factor B of a session, affected against unaffected; it is limited
    to `most`. `share` is w.
    """
    cut = np.minimum(log_factor, most)
    return cut if share >= 1 else np.asarray(np.log1p(share * np.expm1(cut)))


@dataclass(frozen=True)
class Given:
    """Evidence of n sessions on the amplitudes of one cause, averaged over the amplitudes of other causes.

    Attributes
    ----------
    weights : (c, n) float
        Log probability of each of c combinations of present and absent other causes, in each session.
    score, information : (c, n, d) float, (c, n, d, d) float
        Score and information on the d amplitudes for each combination (`Units.joint`).
    """

    weights: Floats
    score: Floats
    information: Floats

    def inside(self, rows: NDArray[np.bool_]) -> Given:
        """Return the evidence of the sessions in the mask `rows` (n,)."""
        return Given(self.weights[:, rows], self.score[:, rows], self.information[:, rows])

    def log_factors(self, means: Floats, spread: float) -> Floats:
        """Return log Bayes factors (n, h) of the sessions, affected against unaffected.

        `means` (h, d) are mean amplitudes of affected sessions, `spread` is their standard deviation.
        """
        each = log_factors(self.score, self.information, means, spread)
        return log_sum_exp(self.weights[..., None] + each, axis=0)

    def log_factor(self, group: Group) -> Floats:
        """Return the log Bayes factor (n,) of each session for one distribution of the amplitudes."""
        return self.log_factors(group.mean[None], group.spread)[:, 0]

    def gain(self, group: Group, most: float = MOST) -> Floats:
        """Return the log likelihood ratio (n,) of each session, with the cause against without it.

        The log Bayes factor of a session is limited to `most`.
        """
        return mixed(self.log_factor(group), group.share, most)

    def gains(self, grid: Grid, most: float = MOST) -> Floats:
        """Return the log likelihood ratio (n, m/2) of each session at each distribution of a grid.

        The amplitudes of the grid count as relative if the amplitudes of this evidence are relative.
        """
        factors = np.empty((self.weights.shape[1], len(grid.spread)))
        for spread in np.unique(grid.spread):  # all means of one spread in one call
            rows = np.flatnonzero(grid.spread == spread)
            factors[:, rows] = self.log_factors(grid.mean[rows], float(spread))
        return np.concatenate([mixed(factors, share, most) for share in SHARES], axis=1)


_FOREIGN = 1e-3
"""Probability of a session's χ² below which the session does not have the common noise."""


@dataclass(frozen=True)
class Units:
    """The evidence of all n sessions of a population, as arrays.

    Attributes
    ----------
    evidence : tuple of SessionEvidence
        Evidence of each session.
    columns : tuple of Column
        All m columns that at least one session determines; a column is one amplitude of a possible effect.
    inflation : (n,) float
        Factor by which each session's noise variance is enlarged.
    typical : (m,) float
        Typical standard uncertainty of each amplitude in its unit: the median over the sessions that
        determine it, times `Column.weight`.
    z : (n, m) float
        Score of each session and column divided by its standard deviation, with the enlarged noise; zero if
        a session does not determine a column.
    length : (n, m) float
        1/u of each amplitude, with u in units of `typical`; zero if a session does not determine it.
    directions : (n, k, m) float32
        For each session and column, a unit vector of k components; the scalar product of two vectors is the
        correlation of the two scores. k is the largest number of any session; shorter vectors are padded
        with zeros.
    """

    evidence: tuple[SessionEvidence, ...]
    columns: tuple[Column, ...]
    inflation: Floats
    typical: Floats
    z: Floats
    length: Floats
    directions: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.evidence)

    def seen(self, index: Sequence[int]) -> NDArray[np.bool_]:
        """Return a mask (n,) of the sessions that determine at least one of the columns `index`."""
        return np.asarray((self.length[:, list(index)] > 0).any(axis=1))

    def joint(self, index: Sequence[int], relative: Sequence[bool] | bool = False) -> tuple[Floats, Floats]:
        """Return score (n, d) and information (n, d, d) of all sessions for the d columns `index`.

        The score is the derivative of the log likelihood at amplitude zero, and the information is minus
        its second derivative. Amplitudes are in units of the typical standard uncertainty over all
        sessions or, if `relative` is true (for all columns or for each), of the standard uncertainty in
        each session.
        """
        chosen = list(index)
        length = self.length[:, chosen]
        alike = (length > 0) * np.array([self.columns[k].weight for k in chosen])
        length = np.where(np.broadcast_to(relative, len(chosen)), alike, length)
        ways = self.directions[:, :, chosen].astype(float)
        gram = ways.transpose(0, 2, 1) @ ways  # correlations of the scores, (n, d, d)
        return self.z[:, chosen] * length, gram * length[:, :, None] * length[:, None, :]


def units_of(evidence: Sequence[SessionEvidence]) -> Units:
    """Collect the evidence of all sessions in arrays; the order of the argument does not matter."""
    evidence = sorted(evidence, key=lambda one: (one.digest, one.source))
    keys = sorted({key for one in evidence for key in one.keys})
    number = {key: k for k, key in enumerate(keys)}
    n, m = len(evidence), len(keys)
    rank = max((len(one.directions) for one in evidence), default=0)
    # One row per session; columns that it does not determine stay zero.
    z, length = np.zeros((n, m)), np.zeros((n, m))
    directions = np.zeros((n, rank, m), dtype=np.float32)
    inflation = inflations(evidence)
    for i, one in enumerate(evidence):
        own = [number[key] for key in one.keys]
        root = np.sqrt(inflation[i])
        z[i, own] = one.z / root
        length[i, own] = one.length / root
        directions[i, : len(one.directions), own] = one.directions.T
    columns = tuple(Column.of(key) for key in keys)
    weight = np.array([column.weight for column in columns])
    typical = np.array([1 / np.median(column[column > 0]) for column in length.T]) * weight
    return Units(tuple(evidence), columns, inflation, typical, z, length * typical, directions)


def inflations(evidence: Sequence[SessionEvidence]) -> Floats:
    """Return the factor (n,) by which each session's noise variance is enlarged to explain the residuals.

    If the readings have two directions, along the turn and across it, the larger factor is used.
    """
    known = np.array([one.noise_known for one in evidence], dtype=bool)
    out = np.zeros(len(evidence))
    # χ² and its degrees of freedom in at most two directions; zero without a direction.
    scatter = np.zeros((len(evidence), 2, 2))
    for row, one in zip(scatter, evidence, strict=True):
        row[: len(one.scatter)] = one.scatter
    # Direction by direction, and separately for stated and estimated noise.
    for chi2, dof in scatter.transpose(1, 2, 0):
        for rows in (known & (dof > 0.5), ~known & (dof > 0.5)):
            if rows.any():
                out[rows] = np.maximum(out[rows], _moderated(chi2[rows] / dof[rows], dof[rows]))
    return np.where(known, np.maximum(out, 1.0), np.where(out > 0, out, 1.0))


def _moderated(ratio: Floats, dof: Floats) -> Floats:
    """Shrink the ratios χ²/ν (n,) of the sessions towards their common ratio.

    The more the ratios scatter beyond the scatter of χ² itself, the less they are shrunk. A ratio that the
    common ratio cannot explain is returned unchanged. `dof` (n,) are the degrees of freedom ν.
    """
    from scipy.stats import chi2

    ratio = np.maximum(ratio, 1e-12)
    common = float(np.median(ratio * dof / chi2.median(dof)))
    foreign = chi2.sf(ratio * dof / common, dof) < _FOREIGN
    own = np.asarray(~foreign)
    if own.sum() >= 3:
        common = max(float((ratio[own] * dof[own]).sum() / dof[own].sum()), 1e-12)
        between = float(np.mean((ratio[own] / common - 1) ** 2 - 2 / dof[own]))
    else:
        between = np.inf
    prior = 2 / between if between > 2e-3 else 1e3
    # Mean of common and own ratio, weighted by their degrees of freedom.
    drawn = (prior * common + dof * ratio) / (prior + dof)
    return np.where(foreign, ratio, drawn)


Kind = tuple[str, bool]
"""Cause of the catalogue and True, or the quantity that an unnamed function depends on and False."""


@dataclass(frozen=True)
class Candidate:
    """A cause that may affect sessions, in one form (degree, cycles or time constant) and on certain axes.

    Attributes
    ----------
    kind : Kind
        The cause.
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

    kind: Kind
    variant: str
    axes: str
    index: tuple[int, ...]
    log_prior: float


def candidates_of(columns: Sequence[Column]) -> list[Candidate]:
    """List every cause on each axis and on all axes together, with its prior probability.

    The priors are equal to those in the trace of one session. The prior probability of a name is divided
    evenly among the forms of the cause, or in proportion to 1/n among the numbers n of cycles per turn.
    `columns` are the amplitudes on which sessions give evidence.
    """
    by_kind: dict[Kind, list[int]] = defaultdict(list)
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
            out.append(Candidate(kind, variant, axes, own, math.log(share * part / sum(parts))))
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
    parts = [
        Membership(name, value, inside, float(np.log((1 - WHOLE) / len(found) / len(kept))))
        for kept in found
        for name, value, inside in kept
    ]
    return [whole, *parts]


@dataclass(frozen=True)
class ChosenCause:
    """A cause in the model: the candidate, the group of sessions in which it acts, and its amplitudes.

    `amplitudes` is the distribution of the amplitudes over the affected sessions of the group.
    """

    candidate: Candidate
    group: Membership
    amplitudes: Group


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
        # Every combination of present and absent causes, with its probability in each session.
        cases = itertools.product((False, True), repeat=len(parts))
        found = [self._case(parts, present, candidate.index, relative) for present in cases]
        weights, score, information = map(np.stack, zip(*found, strict=True))
        return Given(weights - log_sum_exp(weights, axis=0), score, information)

    def given_others(self, parts: Sequence[ChosenCause], part: ChosenCause) -> Given:
        """Return the evidence on the amplitudes of the cause `part`, averaged over the causes `parts`."""
        return self.given(parts, part.candidate, relative=part.amplitudes.relative)

    def _case(
        self, parts: Sequence[ChosenCause], present: Sequence[bool], index: Sequence[int], relative: bool
    ) -> tuple[Floats, Floats, Floats]:
        """Return the evidence on the columns `index` if some of the causes `parts` are present.

        `present` states for each cause if it is present; the amplitudes of present causes are averaged out.
        `relative` is true for amplitudes in each session's standard uncertainty. Returns the log
        probability (n,) of this case, not normalised, and score and information of the d columns, (n, d)
        and (n, d, d).
        """
        log_weight = np.zeros(len(self.units))
        for part, there in zip(parts, present, strict=True):
            share = min(part.amplitudes.share, 1 - 1e-9)
            inside, outside = (np.log(share), -np.inf) if there else (np.log(1 - share), 0.0)
            log_weight += np.where(part.group.inside, inside, outside)
        chosen = list(itertools.compress(parts, present))
        held = [k for part in chosen for k in part.candidate.index]
        in_own = [part.amplitudes.relative for part in chosen for _ in part.candidate.index]
        score, information = self.units.joint([*held, *index], [*in_own, *([relative] * len(index))])
        a = len(held)
        own = score[:, a:], information[:, a:, a:]
        if not chosen:
            return log_weight, *own
        mean = np.concatenate([part.amplitudes.mean for part in chosen])
        spread = np.repeat(
            [part.amplitudes.spread for part in chosen], [len(part.candidate.index) for part in chosen]
        )
        first, across = information[:, :a, :a], information[:, :a, a:]
        log_weight += log_factors(score[:, :a], first, mean[None], spread)[:, 0]
        # Schur complement: the chosen amplitudes are integrated over their distribution.
        linear = (score[:, :a] + mean / spread**2)[:, :, None]
        right = np.concatenate([linear, across], axis=2)
        solved = across.transpose(0, 2, 1) @ np.linalg.solve(first + np.diag(spread**-2.0), right)
        return log_weight, own[0] - solved[:, :, 0], own[1] - solved[:, :, 1:]

    def by_unit(self, parts: Sequence[ChosenCause], candidate: Candidate, most: float = MOST) -> Floats:
        """Return the log likelihood ratio (n, m) of each session, with a candidate against without it.

        `parts` are the causes that are already in the model. There is one column for each distribution of
        the candidate's grid. The log Bayes factor of a session is limited to `most`.
        """
        grid = grid_of(len(candidate.index))
        both = [self.given(parts, candidate, relative=relative) for relative in (False, True)]
        return np.concatenate([given.gains(grid, most) for given in both], axis=1)

    def scores(
        self, parts: Sequence[ChosenCause], candidates: Sequence[Candidate]
    ) -> tuple[Floats, Floats, NDArray[np.intp]]:
        """Return the evidence for adding each candidate, in every group, to the present model.

        `parts` are the causes in the present model, `candidates` are the k candidates.

        Returns
        -------
        log_evidence : (k, g) float
            Log evidence for the model with the candidate in each of g groups, against the present model,
            averaged over the grid of distributions.
        trained : (k, g, folds) float
            Log evidence without the sessions of a fold.
        best : (k, g) int
            Index of the most probable distribution of the grid.
        """
        shape = (len(candidates), len(self.groups))
        evidence, best = np.zeros(shape), np.zeros(shape, dtype=np.intp)
        trained = np.zeros((*shape, FOLDS))
        for k, candidate in enumerate(candidates):
            prior = grid_of(len(candidate.index)).log_prior
            # Sum of the gains by group and fold, then over all folds, and over all folds but one.
            by_fold = (self._sums @ self.by_unit(parts, candidate)).reshape(len(self.groups), FOLDS, -1)
            whole = by_fold.sum(axis=1)
            evidence[k] = log_sum_exp(whole + prior, axis=1)
            best[k] = (whole + prior).argmax(axis=1)
            trained[k] = log_sum_exp(whole[:, None] - by_fold + prior, axis=2)
        return evidence, trained, best

    def step(self, parts: Sequence[ChosenCause]) -> SelectionStep:
        """Find the most probable cause to add to the model with the causes `parts`."""
        # Posterior over candidates and groups, then the best candidate of the most probable cause.
        evidence, trained, best = self.scores(parts, self.candidates)
        own_prior = np.array([candidate.log_prior for candidate in self.candidates])
        prior = own_prior[:, None] + np.array([group.log_prior for group in self.groups])
        weighed = evidence + prior
        any_ = float(log_sum_exp(weighed.ravel()))
        share = np.exp(weighed - any_)  # posterior of each candidate in each group
        posterior: dict[Kind, float] = defaultdict(float)
        for candidate, probable in zip(self.candidates, share.sum(axis=1).tolist(), strict=True):
            posterior[candidate.kind] += probable
        kind = max(posterior, key=lambda one: posterior[one])
        own = [k for k, candidate in enumerate(self.candidates) if candidate.kind == kind]
        flat, g = divmod(int(weighed[own].argmax()), len(self.groups))
        candidate = self.candidates[own[flat]]
        # The log score of the sessions of each fold, predicted from the others with the cause they choose.
        guesses = (trained + prior[..., None]).reshape(-1, FOLDS).argmax(axis=0)
        gains = (evidence[..., None] - trained).reshape(-1, FOLDS)
        places = share[own].sum(axis=0) / share[own].sum()
        start = grid_of(len(candidate.index)).group(int(best[own[flat], g]))
        return SelectionStep(
            part=ChosenCause(candidate, self.groups[g], start),
            log_evidence=any_,
            posterior=dict(posterior),
            places={(one.by, one.value): float(p) for one, p in zip(self.groups, places, strict=True)},
            heldout=float(gains[guesses, np.arange(FOLDS)].sum()),
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
