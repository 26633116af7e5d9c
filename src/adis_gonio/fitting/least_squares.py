"""Least squares with nuisance angles already eliminated, and what it cannot determine.

A problem (`planar`, `spatial`) gives, at parameters β, χ² with every nuisance angle at its optimum, and the
gradient and information with the nuisance directions projected out of each position's rows: that is the
Schur complement, so the cost is linear in the number of positions. Here is what is common: damped
Gauss-Newton (Levenberg-Marquardt) on these, and the search for directions without information.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from adis_gonio.errors import FitError
from adis_gonio.model.records import Floats

LIMIT = 0.1
"""Largest standard uncertainty, in natural units (1 rad, a gain of 1, 1 g), of a direction that counts as
determined. At 0.1 terms of second order are a tenth of the first: beyond it neither the value nor a
linearised uncertainty means anything, and physically a bias of 100 mg or a gain off by 10 % is no news."""

_PRIOR = 0.5

_PARTICIPATES = 1e-4
"""Least squared share of a parameter in the undetermined space for it to be counted as affected."""


@dataclass(frozen=True)
class Reduced:
    """A problem at some parameters, with the nuisance projected out.

    Attributes
    ----------
    cost : float
        χ².
    gradient : (p,) float
        −½ of the derivative of χ².
    fisher : (p, p) float
        Information of the parameters: half the second derivative, to first order in the model.
    """

    cost: float
    gradient: Floats
    fisher: Floats


class Problem(Protocol):
    """What `solve` needs; parameters are in natural units (see `LIMIT`)."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        ...

    def evaluate(self, beta: Floats) -> Reduced:
        """χ² and its derivatives at β; raises `FitError` where β has no meaning."""
        ...


BLOCK = 2048
"""Positions that are worked on at once: few enough for their arrays to stay in the cache."""


def sum_of(parts: Sequence[Reduced]) -> Reduced:
    """One problem whose positions are those of all parts."""
    return Reduced(
        math.fsum(part.cost for part in parts),
        np.sum([part.gradient for part in parts], axis=0),
        np.sum([part.fisher for part in parts], axis=0),
    )


def whitener_of(covariance: Floats) -> Floats:
    """Inverse Cholesky factors (n, d, d): what they multiply has the unit matrix as covariance."""
    lower = np.linalg.cholesky(covariance)
    return np.asarray(np.linalg.inv(lower), dtype=np.float64)


def blocks(n: int) -> list[slice]:
    """Rows of each block of n positions."""
    return [slice(start, min(start + BLOCK, n)) for start in range(0, n, BLOCK)]


@dataclass(frozen=True)
class Solution:
    """Minimum of a problem.

    Attributes
    ----------
    beta : (p,) float
        All parameters; those held keep their starting value.
    free : (p,) bool
        False for those held.
    cost : float
        χ² at the minimum.
    fisher : (p, p) float
        Information of all parameters, held ones too.
    """

    beta: Floats
    free: NDArray[np.bool_]
    cost: float
    fisher: Floats


@dataclass(frozen=True)
class Determination:
    """A solution, what had to be held, and what is left undetermined.

    Attributes
    ----------
    held : tuple of int
        Parameters held at their nominal value because the session cannot see them.
    null : (p, k) float
        Orthonormal directions that remain without information.
    """

    solution: Solution
    held: tuple[int, ...]
    null: Floats


def solve(problem: Problem, start: Floats, free: NDArray[np.bool_], iterations: int = 200) -> Solution:
    """Minimum of χ² over the free parameters.

    Raises
    ------
    FitError
        If it does not converge within `iterations` steps.
    """
    beta = start.copy()
    now = problem.evaluate(beta)
    damping = 1e-9
    for _ in range(iterations):
        hessian = now.fisher[np.ix_(free, free)]
        gradient = now.gradient[free]
        diagonal = np.maximum(np.diag(hessian), 1e-12 * max(float(hessian.diagonal().max()), 1e-300))
        while True:
            step = np.linalg.lstsq(hessian + damping * np.diag(diagonal), gradient, rcond=1e-15)[0]
            predicted = float(step @ gradient)
            # The decrease still in reach is what matters: 1e-12 in χ² is 1e-6 of a standard uncertainty.
            done = predicted <= 1e-12 + 1e-14 * now.cost or float(np.abs(step).max()) < 1e-13
            trial = beta.copy()
            trial[free] += step
            try:
                then = problem.evaluate(trial)
            except FitError:
                then = None
            if then is not None and (then.cost <= now.cost or (done and then.cost <= now.cost + 1e-9)):
                beta, now, damping = trial, then, max(damping / 10, 1e-12)
                break
            if done:
                break
            damping = max(damping * 10, 1e-9)
            if damping > 1e12:
                done = True
                break
        if done:
            return Solution(beta, free, now.cost, now.fisher)
    raise FitError(
        f"the fit did not converge in {iterations} steps; check the units, the declared angles and gravity"
    )


def determine(
    problem: Problem, start: Floats, free: NDArray[np.bool_], may_hold: Sequence[Sequence[int]]
) -> Determination:
    """Fit, and find what the session cannot determine.

    Directions whose information is too small (`LIMIT`) are looked for in the spectrum of the information
    matrix. As long as there are any, the first group of `may_hold` of which a parameter takes part in them
    gives up those parameters: they are held at their starting values. What remains then is `null`.
    """
    held: list[int] = []
    groups = list(may_hold)
    while True:
        mask = free.copy()
        mask[held] = False
        try:
            solution = solve(problem, start, mask)
        except FitError:
            # A valley without a bottom: with a wide prior it has one, and its floor shows what is lost.
            floor = _floor_of_valley(problem, start, mask)
            if floor is None:
                if not groups:
                    raise
                # The valley is the noise's own (the six faces of a cube show no skew but by their tilts).
                held += [k for k in groups.pop(0) if mask[k]]
                continue
            solution = floor
        null = _null_space(solution.fisher, mask)
        share = (null**2).sum(axis=1)
        if not null.shape[1] or not groups:
            return Determination(solution, tuple(held), null)
        held += [k for k in groups.pop(0) if mask[k] and share[k] > _PARTICIPATES]


def _floor_of_valley(problem: Problem, start: Floats, free: NDArray[np.bool_]) -> Solution | None:
    """Solution with a wide prior, if it shows an undetermined direction; its information without."""
    try:
        solution = solve(_WithPrior(problem, start), start, free)
    except FitError:
        return None
    solution = replace(solution, fisher=problem.evaluate(solution.beta).fisher)
    return solution if _null_space(solution.fisher, free).shape[1] else None


class _WithPrior:
    """A problem with a prior of `_PRIOR` natural units about its start on every parameter."""

    def __init__(self, problem: Problem, start: Floats) -> None:
        self._problem = problem
        self._start = start
        self.names = problem.names

    def evaluate(self, beta: Floats) -> Reduced:
        """χ² and its derivatives with the prior added."""
        bare = self._problem.evaluate(beta)
        away = (beta - self._start) / _PRIOR**2
        return Reduced(
            bare.cost + float(away @ (beta - self._start)),
            bare.gradient - away,
            bare.fisher + np.eye(len(beta)) / _PRIOR**2,
        )


def _null_space(fisher: Floats, free: NDArray[np.bool_]) -> Floats:
    index = np.flatnonzero(free)
    values, vectors = np.linalg.eigh(fisher[np.ix_(index, index)])
    poor = values < max(1 / LIMIT**2, 1e-14 * float(values[-1]) if len(values) else 0.0)
    null = np.zeros((len(free), int(poor.sum())))
    null[index] = vectors[:, poor]
    return null


def covariance(fisher: Floats, free: NDArray[np.bool_], null: Floats) -> Floats:
    """Covariance (p, p) of the parameters, zero for those held and along `null`.

    Only functions of the parameters whose gradient is orthogonal to `null` may be propagated with it.
    """
    p = len(free)
    basis = np.eye(p)[:, free]
    if null.shape[1]:
        outside = np.eye(p) - null @ null.T
        left, values, _ = np.linalg.svd(outside @ basis, full_matrices=False)
        basis = left[:, values > 0.5]
    inner = basis.T @ fisher @ basis
    scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    inverse = np.linalg.inv(inner / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray(basis @ inverse @ basis.T)


def is_determined(gradient: Floats, null: Floats) -> bool:
    """True where a function with this gradient (p,) does not change along `null`."""
    size = float(gradient @ gradient)
    along = gradient @ null
    return float(along @ along) <= _PARTICIPATES * size


def shift_by_held(fisher: Floats, free: NDArray[np.bool_], null: Floats, held: int) -> Floats:
    """∂β/∂(held parameter), (p,): how the fitted parameters follow the value that one is held at."""
    return np.asarray(-covariance(fisher, free, null) @ fisher[:, held])


def in_words(null: Floats, names: Sequence[str]) -> list[str]:
    """Each undetermined direction as a combination of parameters, in natural units."""
    words = []
    for direction in null.T:
        order = np.argsort(-np.abs(direction))
        parts = [k for k in order.tolist() if abs(direction[k]) > 0.1]
        lead = math.copysign(1.0, direction[parts[0]])
        if len(parts) == 1:
            words.append(names[parts[0]])
            continue
        terms = [f"{lead * direction[k]:+.2f}·{names[k]}" for k in parts]
        words.append(" ".join(terms).removeprefix("+"))
    return words
