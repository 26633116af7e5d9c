"""The hierarchical likelihood of one cause over many sessions.

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
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, log_sum_exp
from adis_gonio.fleet.session_evidence import Column, SessionEvidence

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
class Block:
    """Score (n, d) and information (n, d, d) of n sessions with respect to the d amplitudes of one cause.

    The score is the derivative of the log likelihood at amplitude zero, and the information is minus its
    second derivative. Both are for amplitudes in the scaled unit of `Units.joint`: typical standard
    uncertainties.
    """

    score: Floats
    information: Floats


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


def log_factor(block: Block, mean: Floats, spread: float | Floats) -> Floats:
    """Return the log Bayes factor (n,) of each session, affected against unaffected.

    It is not bounded, so one session can outweigh all others.

    `mean` (d,) and `spread` are the mean and the standard deviation of the amplitudes of affected sessions.
    `block` has score and information of the sessions on the amplitudes.
    """
    return log_factors(block, mean[None], spread)[:, 0]


def log_factors(block: Block, means: Floats, spread: float | Floats) -> Floats:
    """Return log Bayes factors (n, h) of n sessions, affected against unaffected.

    They are given for h mean amplitudes `means` (h, d) of affected sessions. The spread of the amplitudes
    may be one number, or one per amplitude (d,). `block` has score and information of the sessions on the
    amplitudes.
    """
    score, information = block.score, block.information
    shifted = score[:, None, :] - means @ information  # s − Gμ, (n, h, d)
    along = 0.5 * ((score[:, None, :] + shifted) * means).sum(axis=2)
    wide = np.broadcast_to(np.asarray(spread, dtype=float), score.shape[1:])
    if score.shape[1] == 1:  # scalars instead of matrices
        denominator = 1 + wide[0] ** 2 * information[:, 0]
        square = shifted[:, :, 0] ** 2 * (wide[0] ** 2 / denominator)
        return np.asarray(along + 0.5 * (square - np.log(denominator)))
    # Gaussian integral over the amplitudes: quadratic form and determinant of (G + 1/τ²).
    precision = information + np.diag(wide**-2.0)
    solved = np.linalg.solve(precision, shifted.transpose(0, 2, 1)).transpose(0, 2, 1)
    size = np.linalg.slogdet(precision)[1] + 2 * np.log(wide).sum()
    return np.asarray(along + 0.5 * (shifted * solved).sum(axis=2) - 0.5 * size[:, None])


@dataclass(frozen=True)
class Grid:
    """A grid of h trial distributions of a cause's amplitudes, with their prior.

    It is chosen before the data are seen.

    Attributes
    ----------
    mean : (h, d) float
        Mean amplitudes of each distribution.
    spread, share, log_prior : (h,) float
        Standard deviation of the amplitudes, share of affected sessions, and log of the prior. Each
        distribution is used twice, with half of its prior: for amplitudes in their unit, and for relative
        amplitudes.
    """

    mean: Floats
    spread: Floats
    share: Floats
    log_prior: Floats

    def group(self, k: int) -> Group:
        """Return distribution k of the grid; from k = h on, the amplitudes are relative (see `Group`)."""
        relative, k = divmod(k, len(self.share))
        return Group(float(self.share[k]), self.mean[k], float(self.spread[k]), bool(relative))

    @property
    def log_priors(self) -> Floats:
        """Log prior (2 h,) of all distributions: h with amplitudes in their unit, then h relative ones."""
        return np.tile(self.log_prior - np.log(2), 2)


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
    every = [*still, *moved]
    h = len(every)
    return Grid(
        np.tile([mean for mean, _, _ in every], (len(SHARES), 1)).reshape(-1, width),
        np.tile([spread for _, spread, _ in every], len(SHARES)),
        np.repeat(SHARES, h),
        np.tile(np.log([part for _, _, part in every]), len(SHARES)) - np.log(len(SHARES)),
    )


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
    blocks : tuple of Block
        Score and information on the amplitudes for each combination.
    """

    weights: Floats
    blocks: tuple[Block, ...]

    def inside(self, rows: NDArray[np.bool_]) -> Given:
        """Return the evidence of the sessions in the mask `rows` (n,)."""
        blocks = tuple(Block(one.score[rows], one.information[rows]) for one in self.blocks)
        return Given(self.weights[:, rows], blocks)

    def log_factors(self, means: Floats, spread: float) -> Floats:
        """Return log Bayes factors (n, h) of the sessions, affected against unaffected.

        `means` (h, d) are mean amplitudes of affected sessions, `spread` is their standard deviation.
        """
        pairs = zip(self.weights, self.blocks, strict=True)
        return log_sum_exp(
            np.stack([own[:, None] + log_factors(one, means, spread) for own, one in pairs]), axis=0
        )

    def log_factor(self, group: Group) -> Floats:
        """Return the log Bayes factor (n,) of each session for one distribution of the amplitudes."""
        return self.log_factors(group.mean[None], group.spread)[:, 0]

    def gain(self, group: Group, most: float = MOST) -> Floats:
        """Return the log likelihood ratio (n,) of each session, with the cause against without it.

        The log Bayes factor of a session is limited to `most`.
        """
        return mixed(self.log_factor(group), group.share, most)

    def gains(self, grid: Grid, most: float = MOST) -> Floats:
        """Return the log likelihood ratio (n, h) of each session at each distribution of a grid."""
        h = len(grid.share) // len(SHARES)
        factors = np.empty((self.weights.shape[1], h))
        for spread in np.unique(grid.spread[:h]):  # all means of one spread in one call
            rows = np.flatnonzero(grid.spread[:h] == spread)
            factors[:, rows] = self.log_factors(grid.mean[rows], float(spread))
        cut = np.minimum(factors, most)
        excess = np.expm1(cut)
        return np.concatenate([cut if w >= 1 else np.log1p(w * excess) for w in SHARES], axis=1)


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

    def joint(self, index: Sequence[int], relative: Sequence[bool] | bool = False) -> Block:
        """Return score and information of all sessions for the columns `index`.

        Amplitudes are in units of the typical standard uncertainty over all sessions or, if `relative` is
        true (for all columns or for each), of the standard uncertainty in each session.
        """
        chosen = list(index)
        length = self.length[:, chosen]
        alike = (length > 0) * np.array([self.columns[k].weight for k in chosen])
        length = np.where(np.broadcast_to(relative, len(chosen)), alike, length)
        ways = self.directions[:, :, chosen].astype(float)
        gram = ways.transpose(0, 2, 1) @ ways  # correlations of the scores, (n, d, d)
        return Block(self.z[:, chosen] * length, gram * length[:, :, None] * length[:, None, :])


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
    ways = max((len(one.scatter) for one in evidence), default=1)
    out = np.zeros(len(evidence))
    # Direction by direction, and separately for stated and estimated noise.
    for way in range(ways):
        has = np.array([len(one.scatter) > way and one.scatter[way].dof > 0.5 for one in evidence])
        ratio = np.ones(len(evidence))
        dof = np.zeros(len(evidence))
        for i in np.flatnonzero(has).tolist():
            scatter = evidence[i].scatter[way]
            ratio[i], dof[i] = scatter.chi2 / scatter.dof, scatter.dof
        for rows in (known & has, ~known & has):
            if rows.any():
                out[rows] = np.maximum(out[rows], _moderated(ratio[rows], dof[rows]))
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
