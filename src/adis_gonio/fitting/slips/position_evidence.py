"""How probable the rows are under each pattern, calibration and scatter averaged over.

The marginal likelihood of a linear Gaussian model: what is unknown of the calibration, of the gyro and of
the catalogue's effects has a prior and is integrated in closed form; how far positions and readings scatter
beyond what is stated is averaged over a grid. So the gyro's gain, its g-sensitivity and the fixture are
nuisances of one likelihood, and none of them is a threshold.

How large an error has to be for a session to show it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_radians
from adis_gonio.fitting.slips.position_faults import PUSH_MG, Name, Pattern, patterns_of
from adis_gonio.fitting.slips.position_model import Rows, common_zero

NOWHERE_RAD = 10.0
"""Standard deviation of the error of an angle that is not declared."""
MORE_RAD = tuple(math.radians(value) for value in (0.0, 0.05, 0.2, 0.8))
"""Scatter of positions beyond a stated fixture, and what it is where none is stated (0: 0.01°)."""
MORE_STATED, MORE_UNSTATED = (0.8, 0.12, 0.06, 0.02), (0.25, 0.25, 0.25, 0.25)
LEAST_RAD = math.radians(0.01)
ROUGH = (0.0, 0.001, 0.005)
"""Scatter of readings beyond their noise, in g."""
ROUGH_PRIOR = (0.6, 0.3, 0.1)
LARGER = (1.0, 8.0)
"""Factor on the size of the catalogue's effects."""
LARGER_PRIOR = (0.7, 0.3)
WANDERS = ((math.radians(0.1), 0.0), (math.radians(0.5), 0.0), (0.0, 0.002))
"""What a part that turns slowly in its mount has turned by the end of a session (standard deviation of a
random walk), and what the zero of an axis has moved, in g."""
WANDERS_PRIOR = 0.02
"""Of each of them."""
NEGLIGIBLE = 40.0
"""Nats below the best at which an account is not worked out for all patterns."""
GYRO_FAILS = 0.01
"""Prior probability that a session's gyro says nothing at all: another unit, another axis, dead."""


@dataclass(frozen=True)
class ScatterPoint:
    """One point of the grid, with the logarithm of its prior."""

    position_rad: float
    reading: float
    effects: float
    log_prior: float
    turns_rad: float = 0.0
    drifts: float = 0.0


def scatters(fixture_rad: float | None) -> list[ScatterPoint]:
    """The grid."""
    more = MORE_UNSTATED if fixture_rad is None else MORE_STATED
    stated = LEAST_RAD if fixture_rad is None else max(fixture_rad, LEAST_RAD / 10)
    at_rest = math.log(1 - len(WANDERS) * WANDERS_PRIOR)
    still = [
        ScatterPoint(math.hypot(stated, a), b, c, math.log(pa * pb * pc) + at_rest)
        for (a, pa), (b, pb), (c, pc) in itertools.product(
            zip(MORE_RAD, more, strict=True),
            zip(ROUGH, ROUGH_PRIOR, strict=True),
            zip(LARGER, LARGER_PRIOR, strict=True),
        )
    ]
    wandering = [
        ScatterPoint(math.hypot(stated, a), 0.0, LARGER[0], math.log(pa * WANDERS_PRIOR), turns, drifts)
        for (a, pa), (turns, drifts) in itertools.product(zip(MORE_RAD, more, strict=True), WANDERS)
    ]
    return still + wandering


@dataclass(frozen=True)
class Beside:
    """Faults that are taken as known, beside which the next one is looked for.

    Attributes
    ----------
    error_rad : (n,) float
        Errors that they bring, at the sizes at which they were looked at.
    zero_rad : float
        α without them.
    known : (m, q) float
        Directions in which their sizes are free.
    """

    error_rad: Floats
    zero_rad: float
    known: Floats

    @classmethod
    def of(cls, rows: Rows, accepted: Sequence[Pattern]) -> Beside:
        """Of patterns that were accepted; of none the session as it is declared."""
        error = sum((p.error_rad for p in accepted), np.zeros(len(rows)))
        zero = common_zero(wrap_radians(rows.seen_rad + error)[rows.declared])
        return cls(
            error, zero, np.hstack([np.zeros((len(rows.stands), 0)), *(p.columns for p in accepted)])
        )

    def left(self, rows: Rows) -> Floats:
        """What is left (m,) of the rows."""
        return rows.observed(self.error_rad, self.zero_rad)


@dataclass(frozen=True)
class Whitened:
    """Rows under one scatter, beside errors that are taken as known but for their size.

    Attributes
    ----------
    known : (m, q) float
        Directions in which those errors are free.
    """

    rows: Rows
    scatter: ScatterPoint
    known: Floats

    @cached_property
    def design(self) -> Floats:
        """All columns with a prior (m, p + q)."""
        return np.hstack([self.rows.design, self.known])

    @cached_property
    def prior_sd(self) -> Floats:
        """Of their values."""
        sd = self.rows.prior_sd * np.where(self.rows.effect, self.scatter.effects, 1.0)
        return np.concatenate([sd, np.full(self.known.shape[1], np.pi)])

    @cached_property
    def position_sd(self) -> Floats:
        """Standard deviation (n,) of e where nothing is wrong."""
        return np.where(self.rows.declared, self.scatter.position_rad, NOWHERE_RAD)

    @cached_property
    def noise(self) -> Floats:
        """Covariance (m, m) without the columns."""
        n = len(self.rows)
        turned = self.rows.stands * self.position_sd
        added = np.zeros(len(self.rows.stands))
        added[: 2 * n] = self.scatter.reading**2
        noise = self.rows.noise + turned @ turned.T + np.diag(added)
        if not (self.scatter.turns_rad or self.scatter.drifts):
            return np.asarray(noise)
        walk = np.minimum(self.rows.course[:, None], self.rows.course)
        noise = noise + self.scatter.turns_rad**2 * self.rows.stands @ walk @ self.rows.stands.T
        readings = np.tile(walk, (2, 2)) * (self.rows.reading[: 2 * n] @ self.rows.reading[: 2 * n].T)
        noise[: 2 * n, : 2 * n] += self.scatter.drifts**2 * readings
        return np.asarray(noise)

    @cached_property
    def root(self) -> Floats:
        """Cholesky factor of the covariance of the rows."""
        spread = self.design * self.prior_sd
        return np.asarray(np.linalg.cholesky(self.noise + spread @ spread.T))

    @cached_property
    def log_scale(self) -> float:
        """Ln of the density at zero."""
        root = self.root
        return float(-np.log(np.diag(root)).sum() - 0.5 * len(root) * math.log(2 * math.pi))

    def weight(self, z: Floats) -> Floats:
        """Ln of the scatter's prior times the likelihood of whitened rows, (m, k) → (k,)."""
        return np.asarray(self.log_scale + self.scatter.log_prior - 0.5 * (z * z).sum(axis=0))

    @cached_property
    def _inverse(self) -> Floats:
        from scipy.linalg import solve_triangular  # late: a bench that only records starts without it

        return np.asarray(solve_triangular(self.root, np.eye(len(self.root)), lower=True))

    def white(self, values: Floats) -> Floats:
        """Values (m, …) with unit covariance."""
        return np.asarray(self._inverse @ values)

    def mean_of(self, values: Floats) -> Floats:
        """What the columns would read (m, …) at their prior mean, taken off."""
        mean = self.rows.design @ self.rows.prior_mean
        return np.asarray(values - mean[:, None])


@dataclass(frozen=True)
class Weighed:
    """Patterns weighed against none.

    Attributes
    ----------
    none : float
        ln of the probability that nothing more is wrong, not normalized.
    named : mapping of (int, Name) to float
        The same of each pattern, by its number, under each of its names.
    scatter : ScatterPoint
        The grid's most probable point under the best of them.
    """

    none: float
    named: dict[tuple[int, Name], float]
    scatter: ScatterPoint

    @property
    def likeliest(self) -> tuple[int, Name]:
        """The most probable pattern and name of all; there has to be one."""
        return max(self.named, key=self.named.__getitem__)

    @property
    def best(self) -> tuple[int, Name] | None:
        """The most probable pattern under all its names, with the best of them; None: no more is wrong."""
        whole: dict[int, float] = {}
        for (k, _), value in self.named.items():
            whole[k] = float(np.logaddexp(whole.get(k, -math.inf), value))
        if not whole:
            return None
        chosen = max(whole, key=whole.__getitem__)
        if whole[chosen] <= self.none:
            return None
        names = {name: value for (k, name), value in self.named.items() if k == chosen}
        return chosen, max(names, key=names.__getitem__)


def weigh(rows: Rows, grid: Sequence[ScatterPoint], patterns: Sequence[Pattern], beside: Beside) -> Weighed:
    """Weigh patterns beside what is known already, with the gyro and without."""
    table, keys = _weighed(rows, grid, patterns, beside)
    logs = np.logaddexp.reduce(table, axis=1)
    if len(rows.turn):
        logs = _or_without_gyro(rows, grid, patterns, beside, logs + math.log(1 - GYRO_FAILS), keys)
    named = {key: float(value) for key, value in zip(keys, logs[1:], strict=True)}
    best = int(np.argmax(table[int(np.argmax(logs))]))
    return Weighed(float(logs[0]), named, grid[best])


def _or_without_gyro(
    rows: Rows,
    grid: Sequence[ScatterPoint],
    patterns: Sequence[Pattern],
    beside: Beside,
    logs: Floats,
    keys: list[tuple[int, Name]],
) -> Floats:
    """The same (1 + names,) where the gyro may say nothing: it then shows any angle."""
    bare = rows.without_gyro()
    share = math.log(GYRO_FAILS) - len(rows.turn) * math.log(2 * math.pi)
    cut = replace(beside, known=beside.known[: len(bare.stands)])
    top = int(np.argmax(logs))
    one = patterns if top == 0 else [patterns[keys[top - 1][0]]]
    first, _ = _weighed(bare, grid, one[:1], cut)
    if share + float(np.logaddexp.reduce(first, axis=1).max()) < float(logs.max()) - NEGLIGIBLE:
        return logs
    table, _ = _weighed(bare, grid, patterns, cut)
    return np.asarray(np.logaddexp(logs, share + np.logaddexp.reduce(table, axis=1)))


def _weighed(
    rows: Rows, grid: Sequence[ScatterPoint], patterns: Sequence[Pattern], beside: Beside
) -> tuple[Floats, list[tuple[int, Name]]]:
    """Ln of prior times likelihood (1 + names, grid): of no pattern, then of each pattern and name."""
    m = len(rows.stands)
    error = beside.error_rad
    left = np.stack(
        [beside.left(rows), *(rows.observed(error + p.error_rad, p.zero_rad) for p in patterns)], axis=1
    )
    first = np.zeros((m, 1 + len(patterns)))
    second = np.zeros((m, 1 + len(patterns)))
    for k, pattern in enumerate(patterns):
        free = pattern.columns[:m]
        if free.shape[1] > 0:
            first[:, 1 + k] = free[:, 0]
        if free.shape[1] > 1:
            second[:, 1 + k] = free[:, 1]
    twice = second.any(axis=0)
    keys = [(k, name) for k, pattern in enumerate(patterns) for name in pattern.names]
    plain = np.empty((1 + len(patterns), len(grid)))
    moments = np.empty((5, 1 + len(patterns), len(grid)))
    for g, scatter in enumerate(grid):
        white = Whitened(rows, scatter, beside.known)
        z, v = white.white(white.mean_of(left)), white.white(first)
        w = np.zeros_like(v)
        w[:, twice] = white.white(second[:, twice])
        plain[:, g] = white.weight(z)
        for k, (a, b) in enumerate(((v, v), (v, z), (w, w), (w, z), (v, w))):
            moments[k, :, g] = (a * b).sum(axis=0)
    named = [plain[1 + k] + _of_name(patterns[k], name, moments[:, 1 + k]) for k, name in keys]
    return np.vstack([plain[:1], *named]), keys


def _of_name(pattern: Pattern, name: Name, moments: Floats) -> Floats:
    """Ln of the prior and of what the free directions add to the likelihood, over the grid.

    Parameters
    ----------
    moments : (5, grid) float
        Of the whitened directions v and w and what is left, z: vv, vz, ww, wz, vw.
    """
    log_prior, amplitude = pattern.names[name]
    vv, vz, ww, wz, vw = moments
    if pattern.columns.shape[1] == 2:
        return np.asarray(log_prior + _pushes(vv, vz, ww, wz, vw))
    if amplitude is None or not vv.any():  # without the gyro nothing shows what it did
        return np.full(len(vv), log_prior)
    # What is left is column · step where the pattern is right but for the size looked at.
    step = vz / vv
    found = amplitude(pattern.amplitude + step, 1 / np.sqrt(vv))
    return np.asarray(log_prior + 0.5 * vz * step + found)


def _pushes(vv: Floats, vz: Floats, ww: Floats, wz: Floats, vw: Floats) -> Floats:
    """Ln of the likelihood gained by two free directions with Gaussian priors of several sizes."""
    inverse = (1000.0 / np.array(PUSH_MG)[:, None]) ** 2
    a, d = vv + inverse, ww + inverse
    det = a * d - vw * vw
    fit = (d * vz * vz - 2 * vw * vz * wz + a * wz * wz) / det
    gains = 0.5 * fit - 0.5 * np.log(det) + np.log(inverse)
    return np.asarray(np.logaddexp.reduce(gains, axis=0) - math.log(len(gains)))


POWER = 0.99
"""Share of sessions that show it."""
SIZES_DEG = np.geomspace(0.02, 90.0, 120)
"""Errors that are tried."""
_DRAWN = 200
"""Sessions that are imagined for it."""


@dataclass(frozen=True)
class Detectability:
    """A session with what was found in it taken out, and faults of each size put in.

    Attributes
    ----------
    position : tuple of int
        Numbers of the dwells.
    """

    position: tuple[int, ...]
    rows: Rows
    grid: tuple[ScatterPoint, ...]
    beside: Beside

    def detectable_deg(self, name: Name, certain: float) -> dict[int, float]:
        """Smallest error at each position whose posterior reaches `certain` with 99 % power, in degrees.

        By sessions imagined under the scatter of this one, in each of which an error of each size is put.
        Of names with one free size; other faults at the same time are not thought of.
        """
        every = patterns_of(self.rows, self.beside.error_rad)
        patterns = [p for p in every if name in p.names and p.columns.shape[1] == 1]
        if not patterns:
            return {}
        likely = [self._likelihood(scatter) for scatter in self.grid]
        own = Whitened(self.rows, self.grid[int(np.argmax(likely))], self.beside.known[:, :0])
        drawn = own.root @ np.random.default_rng(0).standard_normal((len(own.root), _DRAWN))
        accounts = [Whitened(self.rows, scatter, self.beside.known[:, :0]) for scatter in self.grid]
        white = [(account, account.white(drawn)) for account in accounts]
        found = {}
        for pattern in patterns:
            shown = self._odds(pattern, name, white) >= math.log(certain / (1 - certain))
            enough = (shown.mean(axis=1) >= POWER)[::-1].cumprod()[::-1].astype(np.bool_)
            least = float(SIZES_DEG[enough.argmax()]) if enough.any() else math.inf
            found[self.position[pattern.dwells[0]]] = least
        return found

    def _likelihood(self, scatter: ScatterPoint) -> float:
        """Ln of prior times likelihood of the session under a scatter."""
        white = Whitened(self.rows, scatter, self.beside.known)
        z = white.white(white.mean_of(self.beside.left(self.rows)[:, None]))
        return float(white.weight(z)[0])

    def _odds(self, pattern: Pattern, name: Name, drawn: list[tuple[Whitened, Floats]]) -> Floats:
        """Log odds (sizes, sessions) of the pattern under the name against none."""
        log_prior, amplitude = pattern.names[name]
        assert amplitude is not None
        sizes = np.radians(SIZES_DEG)[:, None]
        faulty, none = np.full((2, len(sizes), drawn[0][1].shape[1]), -np.inf)
        for account, z in drawn:
            v = account.white(pattern.columns[:, 0])
            vv, vz = float(v @ v), v @ z
            clean = account.weight(z)
            none = np.logaddexp(none, clean - sizes * vz - 0.5 * sizes**2 * vv)
            seen = sizes + vz / vv
            own = amplitude(seen.ravel(), np.full(seen.size, 1 / math.sqrt(vv))).reshape(seen.shape)
            faulty = np.logaddexp(faulty, clean + 0.5 * vz**2 / vv + log_prior + own)
        return np.asarray(faulty - none)
