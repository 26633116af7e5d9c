"""Probability of a session's data under each possible fault, averaged over calibration and scatter.

It is the marginal likelihood of a linear Gaussian model. The unknown parameters of the calibration, of
the gyro and of the catalogue's effects have priors and are integrated in closed form. The scatter of
positions and readings beyond their stated uncertainty is averaged over a grid. The gyro's gain, its
g-sensitivity and the fixture are therefore nuisance parameters of one likelihood, and none of them is a
threshold.

The ordinary errors of a session are its errors without any fault: scatter of the set positions, scatter of
the readings beyond their noise, effects of the catalogue and slow changes (`ScatterPoint`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_radians
from adis_gonio.fitting.slips.position_model import PUSH_MG, Name, Pattern, Rows, common_zero

NOWHERE_RAD = 10.0
"""Standard deviation, in rad, of the error of an undeclared angle: so large that the angle is unknown."""
MORE_RAD = tuple(math.radians(value) for value in (0.0, 0.05, 0.2, 0.8))
"""Possible scatter of positions, in rad, in addition to the stated uncertainty of a declared angle; without
a stated uncertainty the scatter itself (0 stands for 0.01°)."""
MORE_STATED, MORE_UNSTATED = (0.8, 0.12, 0.06, 0.02), (0.25, 0.25, 0.25, 0.25)
LEAST_RAD = math.radians(0.01)
ROUGH = (0.0, 0.001, 0.005)
"""Possible standard deviations of readings in addition to their noise, as a share of gravity."""
ROUGH_PRIOR = (0.6, 0.3, 0.1)
LARGER = (1.0, 8.0)
"""Possible factors on the typical sizes of the catalogue's effects, common to all effects."""
LARGER_PRIOR = (0.7, 0.3)
WANDERS = ((math.radians(0.1), 0.0), (math.radians(0.5), 0.0), (0.0, 0.002))
"""Possible slow changes during a session: rotation of the part in its mount by the end (standard deviation
of a random walk, rad), and drift of the bias of an axis (as a share of gravity)."""
WANDERS_PRIOR = 0.02
"""Prior probability of each entry of `WANDERS`."""
NEGLIGIBLE = 40.0
"""Difference of log probability (nats) to the best fault, above which the case of a useless gyro is not
computed for all faults."""
GYRO_FAILS = 0.01
"""Prior probability that the gyro is useless: another unit, another axis, dead."""


@dataclass(frozen=True)
class ScatterPoint:
    """Assumed standard deviations of the errors that a session without a wrong position has.

    Attributes
    ----------
    position_rad : float
        Standard deviation of the set positions, in rad.
    reading : float
        Standard deviation of the readings, as a share of gravity.
    effects : float
        Factor on the typical amplitudes of the catalogue's effects.
    log_prior : float
        Natural logarithm of the prior probability of this assumption.
    turns_rad, drifts : float
        Standard deviation, at the end of the session, of a slow turn of the part (rad) and of a slow change
        of the readings (share of gravity).
    """

    position_rad: float
    reading: float
    effects: float
    log_prior: float
    turns_rad: float = 0.0
    drifts: float = 0.0


def scatters(fixture_rad: float | None) -> list[ScatterPoint]:
    """Return a grid of possible standard deviations of the errors that a session without a fault has.

    Each point of the grid has its prior probability.

    `fixture_rad` is the stated standard uncertainty of a declared angle; None if it is not stated.
    """
    more = MORE_UNSTATED if fixture_rad is None else MORE_STATED
    stated = LEAST_RAD if fixture_rad is None else max(fixture_rad, LEAST_RAD / 10)
    # Without a random walk: all combinations of the three scatters.
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
class KnownFaults:
    """Faults that are already accepted, in addition to which the next fault is searched.

    Attributes
    ----------
    error_rad : (n,) float
        Error of each position by these faults, at the sizes at which the model is linearised.
    zero_rad : float
        Start angle α, estimated after these faults are corrected.
    columns : (m, q) float
        Changes of the rows of the linear model by the free sizes of these faults.
    """

    error_rad: Floats
    zero_rad: float
    columns: Floats

    @classmethod
    def of(cls, rows: Rows, accepted: Sequence[Pattern]) -> KnownFaults:
        """Combine the faults that were accepted so far.

        Without any, all declared angles are taken as correct.
        """
        error = sum((p.error_rad for p in accepted), np.zeros(len(rows)))
        zero = common_zero(wrap_radians(rows.seen_rad + error)[rows.declared])
        none = np.zeros((len(rows.by_error), 0))
        return cls(error, zero, np.hstack([none, *(p.columns for p in accepted)]))

    def residual(self, rows: Rows) -> Floats:
        """Return the residual (m,) of each row of the linear model, given these faults."""
        return rows.observed(self.error_rad, self.zero_rad)


@dataclass(frozen=True)
class Whitened:
    """Rows of the linear model, scaled to unit covariance under one assumption on the ordinary errors.

    Ordinary errors are the errors that a session without a fault has. The assumption is one point of the
    grid over which probabilities are averaged. The sizes of the known faults are free.

    Attributes
    ----------
    rows : Rows
        Rows of the linear model, not scaled.
    scatter : ScatterPoint
        Assumption on the ordinary errors.
    design : (m, p + q) float
        Columns of all values with a prior: calibration, effects, and sizes of known faults.
    prior_sd : (p + q,) float
        Prior standard deviation of the value of each column of `design`.
    root, inverse : (m, m) float
        Cholesky factor of the total covariance of the rows, and its inverse.
    """

    rows: Rows
    scatter: ScatterPoint
    design: Floats
    prior_sd: Floats
    root: Floats
    inverse: Floats

    @classmethod
    def at_each(cls, rows: Rows, grid: Sequence[ScatterPoint], known: Floats) -> Iterator[Whitened]:
        """Yield the whitened rows for each point of the grid.

        The columns of `known` (m, q) are changes of the rows by free sizes of known faults.
        """
        design = np.hstack([rows.design, known])
        free = np.full((len(grid), known.shape[1]), np.pi)
        larger = np.array([[scatter.effects] for scatter in grid])
        prior_sd = np.hstack([rows.prior_sd * np.where(rows.effect, larger, 1.0), free])
        # Together, since one call costs more than a small matrix; of large ones a few fill the memory.
        step = max(1, _TOGETHER // design.shape[0] ** 2)
        for start in range(0, len(grid), step):
            part = slice(start, start + step)
            spread = design * prior_sd[part, None, :]
            covariance = _noise(rows, grid[part]) + spread @ spread.transpose(0, 2, 1)
            root = np.linalg.cholesky(covariance)
            for one in zip(grid[part], prior_sd[part], root, np.linalg.inv(root), strict=True):
                scatter, own, *roots = one
                yield cls(rows, scatter, design, own, *roots)

    def weight(self, z: Floats) -> Floats:
        """Return ln (prior · likelihood) (k,) of this point of the grid, for k sets of residuals.

        `z` (m, k) are the residuals of each set, whitened at this point.
        """
        scale = -np.log(np.diag(self.root)).sum() - 0.5 * len(self.root) * math.log(2 * math.pi)
        return np.asarray(scale + self.scatter.log_prior - 0.5 * (z * z).sum(axis=0))

    def white(self, values: Floats) -> Floats:
        """Whiten changes (m, …) of the rows: mix the rows so that their covariance is the identity."""
        return np.asarray(self.inverse @ values)


_TOGETHER = 10**6
"""Largest number of matrix elements that are factorised in one call."""


def _noise(rows: Rows, grid: Sequence[ScatterPoint]) -> Floats:
    """Return the covariance (g, m, m) of the rows from noise and ordinary errors at g grid points."""
    n = len(rows)
    every = [(s.position_rad, s.reading, s.turns_rad, s.drifts) for s in grid]
    position, reading, turns, drifts = np.array(every).T[:, :, None]
    # e without a fault scatters around the declared angle, or anywhere without one.
    turned = rows.by_error * np.where(rows.declared, position, NOWHERE_RAD)[:, None, :]
    noise = rows.noise + turned @ turned.transpose(0, 2, 1)
    own = np.arange(2 * n)
    noise[:, own, own] += reading**2
    # Random walks over the session: of the part in its mount, and of the zeros of both axes.
    walk = np.minimum(rows.course[:, None], rows.course)
    noise += turns[:, :, None] ** 2 * (rows.by_error @ walk @ rows.by_error.T)
    readings = np.tile(walk, (2, 2)) * (rows.reading[: 2 * n] @ rows.reading[: 2 * n].T)
    noise[:, : 2 * n, : 2 * n] += drifts[:, :, None] ** 2 * readings
    return np.asarray(noise)


@dataclass(frozen=True)
class Weighed:
    """Log probabilities of each possible fault and of no further fault.

    Attributes
    ----------
    none : float
        ln of the probability that there is no further fault, not normalized.
    named : mapping of (int, Name) to float
        ln of the probability, not normalized, of each possible fault under each of its possible names. A
        key is the index of the fault and the name.
    scatter : ScatterPoint
        Most probable assumption on the ordinary errors, under the most probable fault or none.
    """

    none: float
    named: dict[tuple[int, Name], float]
    scatter: ScatterPoint

    @property
    def best(self) -> int | None:
        """Index of the fault that is most probable in total over its names.

        None if no fault is more probable than the absence of a further fault.
        """
        whole: dict[int, float] = {}
        for (k, _), value in self.named.items():
            whole[k] = float(np.logaddexp(whole.get(k, -math.inf), value))
        chosen = max(whole, key=whole.__getitem__, default=None)
        return None if chosen is None or whole[chosen] <= self.none else chosen


def weigh(
    rows: Rows, grid: Sequence[ScatterPoint], patterns: Sequence[Pattern], known: KnownFaults
) -> Weighed:
    """Return the log probability of each further fault, given the known faults.

    `rows` are the linearised equations of the session, `grid` the assumptions on its ordinary errors over
    which the probability is averaged, `patterns` the possible faults. The probability is the sum of two
    cases: the gyro works, or the gyro is useless.
    """
    table, keys = _weighed(rows, grid, patterns, known)
    logs = np.logaddexp.reduce(table, axis=1)
    if len(rows.turn):
        logs = logs + math.log(1 - GYRO_FAILS)
        # A useless gyro shows any angle, and its turns have a uniform density.
        bare = rows.without_gyro()
        share = math.log(GYRO_FAILS) - len(rows.turn) * math.log(2 * math.pi)
        cut = replace(known, columns=known.columns[: len(bare.by_error)])
        top = int(np.argmax(logs))
        one = patterns if top == 0 else [patterns[keys[top - 1][0]]]
        first, _ = _weighed(bare, grid, one[:1], cut)
        if share + float(np.logaddexp.reduce(first, axis=1).max()) >= float(logs.max()) - NEGLIGIBLE:
            without, _ = _weighed(bare, grid, patterns, cut)
            logs = np.logaddexp(logs, share + np.logaddexp.reduce(without, axis=1))
    named = {key: float(value) for key, value in zip(keys, logs[1:], strict=True)}
    best = int(np.argmax(table[int(np.argmax(logs))]))
    return Weighed(float(logs[0]), named, grid[best])


def _weighed(
    rows: Rows, grid: Sequence[ScatterPoint], patterns: Sequence[Pattern], known: KnownFaults
) -> tuple[Floats, list[tuple[int, Name]]]:
    """Return ln (prior · likelihood) (1 + k, g) of each further fault under each of its names.

    The columns are the g points of the grid.
    Row 0 is for no further fault. The second result are the k pairs of fault index and name that rows 1, 2,
    … belong to.
    """
    m = len(rows.by_error)
    shifted = [rows.observed(known.error_rad + p.error_rad, p.zero_rad) for p in patterns]
    residual = np.stack([known.residual(rows), *shifted], axis=1)
    # First and second free direction of each pattern, zero without one.
    first, second = np.zeros((2, m, 1 + len(patterns)))
    for k, pattern in enumerate(patterns, 1):
        free = pattern.columns[:m]
        if free.shape[1] > 0:
            first[:, k] = free[:, 0]
        if free.shape[1] > 1:
            second[:, k] = free[:, 1]
    twice = second.any(axis=0)
    keys = [(k, name) for k, pattern in enumerate(patterns) for name in pattern.names]
    plain = np.empty((1 + len(patterns), len(grid)))
    moments = np.empty((5, 1 + len(patterns), len(grid)))
    columns = np.hstack([residual - (rows.design @ rows.prior_mean)[:, None], first, second[:, twice]])
    w = np.zeros_like(first)
    for g, white in enumerate(Whitened.at_each(rows, grid, known.columns)):
        z, v, w[:, twice] = np.split(white.white(columns), [first.shape[1], 2 * first.shape[1]], axis=1)
        plain[:, g] = white.weight(z)
        for k, (a, b) in enumerate(((v, v), (v, z), (w, w), (w, z), (v, w))):
            moments[k, :, g] = (a * b).sum(axis=0)
    named = [plain[1 + k] + _of_name(patterns[k], name, moments[:, 1 + k]) for k, name in keys]
    return np.vstack([plain[:1], *named]), keys


def _of_name(pattern: Pattern, name: Name, moments: Floats) -> Floats:
    """Return the log prior of a fault under a name, plus the gain in log likelihood by its size.

    The result has one value for each point of the grid.

    Parameters
    ----------
    moments : (5, grid) float
        Scalar products of the whitened directions v and w and the residual z: vv, vz, ww, wz, vw.
    """
    log_prior, amplitude = pattern.names[name]
    vv, vz, ww, wz, vw = moments
    if pattern.columns.shape[1] == 2:
        return np.asarray(log_prior + _pushes(vv, vz, ww, wz, vw))
    if amplitude is None or not vv.any():  # without the gyro its error is not observed
        return np.full(len(vv), log_prior)
    # If only the size of the pattern's linearisation is wrong, the residual is column · step.
    step = vz / vv
    found = amplitude(pattern.amplitude + step, 1 / np.sqrt(vv))
    return np.asarray(log_prior + 0.5 * vz * step + found)


def _pushes(vv: Floats, vz: Floats, ww: Floats, wz: Floats, vw: Floats) -> Floats:
    """Return the gain in log likelihood if the two amplitudes of a fault are free instead of zero.

    The vectors v and w are the changes of the whitened rows per unit of each amplitude, and z is the
    whitened residual. The arguments are scalar products of them: `vw` is v · w, and so on. The likelihood
    is averaged over several prior standard deviations of the amplitudes.
    """
    inverse = (1000.0 / np.array(PUSH_MG)[:, None]) ** 2
    # Two by two normal equations for each prior size, solved by hand.
    a, d = vv + inverse, ww + inverse
    det = a * d - vw * vw
    fit = (d * vz * vz - 2 * vw * vz * wz + a * wz * wz) / det
    gains = 0.5 * fit - 0.5 * np.log(det) + np.log(inverse)
    return np.asarray(np.logaddexp.reduce(gains, axis=0) - math.log(len(gains)))
