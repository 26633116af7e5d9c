"""The hierarchical likelihood of one cause over many sessions.

A unit is affected with probability w; its amplitudes are then θ ~ N(μ, τ² 1), else zero: alike in their
unit, or alike against what each session can show (amplitudes that differ by orders of magnitude between
sessions of unlike length and noise; half of the prior each). With score s and information G of a unit,

    ln B(μ, τ) = sᵀμ − ½ μᵀGμ + ½ (s − Gμ)ᵀ (G + 1/τ²)⁻¹ (s − Gμ) − ½ ln |1 + τ² G|

is its Bayes factor for being affected, in closed form, and Σ ln(1 − w + w B) the log likelihood of the
population (empirical Bayes: Efron, Large-Scale Inference, 2010, ch. 2). Averaged over a grid of (w, μ, τ)
that was fixed before the data it is an e-value: its expectation is 1 where nobody is affected, so that it
exceeds 1/p with probability p at most (Markov; Vovk and Wang, Ann. Stat. 49, 2021), for any number of
units.
One unit counts as at most `MOST` to one: a factor that is cut is still an e-value.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats

MOST = float(np.log(1000.0))
"""Log of the largest Bayes factor of one unit: a gross session is a matter of that session."""
MOST_OF_KNOWN = 100.0
"""The same where the distribution of a cause that stands is estimated."""
SHARES = (0.03, 0.1, 0.2, 0.35, 0.6, 1.0)
"""Shares w of the units: below 3 % there is nothing common."""
SPREADS = (0.35, 0.7, 1.4, 2.8, 5.6, 11.0)
"""Spreads τ about zero (sign not common), in typical standard uncertainties."""
MEANS = (0.35, 0.7, 1.4, 2.8, 5.6, 11.0)
"""Lengths of the mean μ where the sign is common; the spread is then a third of it."""
RELATIVE_SPREAD = 1 / 3


@dataclass(frozen=True)
class Block:
    """Score (n, d) and information (n, d, d) of n units by the amplitudes of one cause, scaled."""

    score: Floats
    information: Floats

    @property
    def width(self) -> int:
        """Amplitudes."""
        return int(self.score.shape[1])


@dataclass(frozen=True)
class Group:
    """How the amplitudes of affected units are distributed: N(mean (d,), spread² 1), in a share of them.

    They are in the typical standard uncertainty of all sessions, or, where `relative`, in each one's own.
    """

    share: float
    mean: Floats
    spread: float
    relative: bool = False


def log_factor(block: Block, mean: Floats, spread: float | Floats) -> Floats:
    """Log Bayes factor (n,) of each unit, not cut."""
    return log_factors(block, mean[None], spread)[:, 0]


def log_factors(block: Block, means: Floats, spread: float | Floats) -> Floats:
    """The same (n, h) for several means (h, d); the spread may be one for each amplitude (d,)."""
    score, information = block.score, block.information
    shifted = score[:, None, :] - means @ information  # (n, h, d)
    along = 0.5 * ((score[:, None, :] + shifted) * means).sum(axis=2)
    wide = np.broadcast_to(np.asarray(spread, dtype=float), (block.width,))
    if block.width == 1:
        denominator = 1 + wide[0] ** 2 * information[:, 0]
        square = shifted[:, :, 0] ** 2 * (wide[0] ** 2 / denominator)
        return np.asarray(along + 0.5 * (square - np.log(denominator)))
    precision = information + np.diag(wide**-2.0)
    solved = np.linalg.solve(precision, shifted.transpose(0, 2, 1)).transpose(0, 2, 1)
    size = np.linalg.slogdet(precision)[1] + 2 * np.log(wide).sum()
    return np.asarray(along + 0.5 * (shifted * solved).sum(axis=2) - 0.5 * size[:, None])


@dataclass(frozen=True)
class Grid:
    """Distributions (h of them) that were thought of before the data, with their prior.

    Attributes
    ----------
    mean : (h, d) float
    spread, share, log_prior : (h,) float
        The prior is that of either unit of the amplitudes: half of it stands for each.
    """

    mean: Floats
    spread: Floats
    share: Floats
    log_prior: Floats

    def group(self, k: int) -> Group:
        """One of them; from h on the relative ones."""
        relative, k = divmod(k, len(self.share))
        return Group(float(self.share[k]), self.mean[k], float(self.spread[k]), bool(relative))

    @property
    def log_priors(self) -> Floats:
        """Of all (2 h,), the relative ones after the others."""
        return np.tile(self.log_prior - np.log(2), 2)


def grid_of(width: int) -> Grid:
    """Half of the prior has no common sign, half has one."""
    still = [(np.zeros(width), spread, 0.5 / len(SPREADS)) for spread in SPREADS]
    ways = _ways(width)
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


def _ways(width: int) -> list[Floats]:
    """Directions of a common mean: each amplitude to either side; of two also both together."""
    ways = [sign * row for row in np.eye(width) for sign in (1.0, -1.0)]
    if width == 2:
        ways += [np.array(signs) / np.sqrt(2) for signs in itertools.product((1.0, -1.0), repeat=2)]
    return ways


def gains(block: Block, grid: Grid, most: float = MOST) -> Floats:
    """Log likelihood ln(1 − w + w B) of each unit (n,) at each distribution (h,) of the grid."""
    h = len(grid.share) // len(SHARES)
    factors = np.empty((len(block.score), h))
    for spread in np.unique(grid.spread[:h]):
        rows = np.flatnonzero(grid.spread[:h] == spread)
        factors[:, rows] = log_factors(block, grid.mean[rows], float(spread))
    return np.concatenate([mixed(factors, share, most) for share in SHARES], axis=1)


def mixed(log_factor: Floats, share: float, most: float = MOST) -> Floats:
    """Log likelihood ln(1 − w + w B) with ln B cut at `most`."""
    cut = np.minimum(log_factor, most)
    if share >= 1:
        return np.asarray(cut)
    return np.asarray(np.logaddexp(np.log1p(-share), np.log(share) + cut))


def log_sum(values: Floats, axis: int | None = None) -> Floats:
    """Log of a sum of exponentials."""
    top = np.max(values, axis=axis, keepdims=True)
    out: Floats = np.log(np.exp(values - top).sum(axis=axis)) + np.squeeze(top, axis=axis)
    return out
