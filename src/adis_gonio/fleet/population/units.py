"""All sessions of a population on one set of columns, with noise that suits each of them.

A session's own χ² says whether its stated noise is right. Ratios χ²/ν scatter by √(2/ν) when it is; what
they scatter beyond is the sessions' own. Each is drawn towards the common one by as much (moderated
variances: Smyth, Stat. Appl. Genet. Mol. Biol. 3, 2004), a ratio that the common one cannot explain is
taken as it is, and none is less than 1 where the noise was stated: a population with noise stated too small
must not look like one with an effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.fleet.population.columns import Column
from adis_gonio.fleet.population.evidence import SessionEvidence
from adis_gonio.fleet.population.mixture import Block

_FOREIGN = 1e-3
"""Probability below which a session's χ² is none of the common noise."""


@dataclass(frozen=True)
class Units:
    """Sessions of a population.

    Attributes
    ----------
    evidence : tuple of SessionEvidence
    columns : tuple of Column
        All that any session can see.
    inflation : (n,) float
        Factor on each session's noise variance.
    typical : (m,) float
        Median standard uncertainty of each amplitude over the sessions that see it, in its unit; times
        `Column.weight`.
    z : (n, m) float
        Scores, inflated noise taken into account; zero where a session cannot see a column.
    length : (n, m) float
        1/u of each amplitude in units of `typical`; zero where a session cannot see it.
    directions : (n, k, m) float32
        As in `SessionEvidence`, padded with zeros.
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
        """Sessions (n,) that see any of the columns."""
        return np.asarray((self.length[:, list(index)] > 0).any(axis=1))

    def joint(self, index: Sequence[int], relative: Sequence[bool] | bool = False) -> Block:
        """Score and information by some of the columns.

        Amplitudes are in `typical`, or, where `relative`, in each session's own standard uncertainty.
        """
        chosen = list(index)
        length = self.length[:, chosen]
        alike = (length > 0) * np.array([self.columns[k].weight for k in chosen])
        length = np.where(np.broadcast_to(relative, len(chosen)), alike, length)
        ways = self.directions[:, :, chosen].astype(float)
        gram = ways.transpose(0, 2, 1) @ ways
        return Block(self.z[:, chosen] * length, gram * length[:, :, None] * length[:, None, :])


def units_of(evidence: Sequence[SessionEvidence]) -> Units:
    """Sessions side by side, in an order that does not depend on the one they come in."""
    evidence = sorted(evidence, key=lambda one: (one.digest, one.source))
    keys = sorted({key for one in evidence for key in one.keys})
    number = {key: k for k, key in enumerate(keys)}
    n, m = len(evidence), len(keys)
    rank = max((len(one.directions) for one in evidence), default=0)
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
    return Units(
        tuple(evidence),
        columns,
        inflation,
        typical,
        z,
        length * typical,
        directions,
    )


def inflations(evidence: Sequence[SessionEvidence]) -> Floats:
    """Factor (n,) on each session's noise variance; of two directions of the readings the larger."""
    known = np.array([one.noise_known for one in evidence], dtype=bool)
    ways = max((len(one.scatter) for one in evidence), default=1)
    out = np.zeros(len(evidence))
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
    """Ratios drawn towards the common one by what they scatter beyond χ²."""
    from scipy.stats import chi2

    ratio = np.maximum(ratio, 1e-12)
    common = float(np.median(ratio / _median_of(dof)))
    foreign = chi2.sf(ratio * dof / common, dof) < _FOREIGN
    own = np.asarray(~foreign)
    if own.sum() >= 3:
        common = max(float((ratio[own] * dof[own]).sum() / dof[own].sum()), 1e-12)
        between = float(np.mean((ratio[own] / common - 1) ** 2 - 2 / dof[own]))
    else:
        between = np.inf
    prior = 2 / between if between > 2e-3 else 1e3
    drawn = (prior * common + dof * ratio) / (prior + dof)
    return np.where(foreign, ratio, drawn)


def _median_of(dof: Floats) -> Floats:
    """Median of χ²/ν (Wilson and Hilferty)."""
    return np.asarray(np.maximum(1 - 2 / (9 * dof), 0.1) ** 3)
