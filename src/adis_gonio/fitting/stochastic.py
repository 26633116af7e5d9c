"""How sure readings and declared angles are, where the session itself has to say.

* A reading without a stated uncertainty: one common standard deviation, such that χ² equals its degrees of
  freedom.
* A fixture without a stated uncertainty: the σ_f of greatest restricted likelihood, if there is redundancy.
* A residual beyond what the noise within the dwells explains (χ² above its 99.9 % quantile): the model
  lacks something. An extra standard deviation on every reading, again such that χ² equals its degrees of
  freedom (Mandel and Paule 1970), keeps the intervals honest and the weights from trusting the quietest
  dwell; the reported χ² stays that of the measured noise, so that the misfit shows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from adis_gonio.fitting.least_squares import Determination, Problem, Solution, determine, solve
from adis_gonio.fitting.planar import PlanarProblem
from adis_gonio.fitting.readings import Readings
from adis_gonio.model.records import Floats

_NORMAL_95 = 1.959963984540054
_EXCESS = 1e-3
_LARGEST_SIGMA_RAD = 0.2


@dataclass(frozen=True)
class Noise:
    """What is assumed about readings and angles, in natural units (local gravity, rad).

    Attributes
    ----------
    scale : float
        Factor on the placeholder of readings whose uncertainty nothing states.
    extra : float
        Standard deviation added to every reading.
    sigma_rad : float
        Standard uncertainty of a declared angle; inf free.
    dof : float
        Degrees of freedom of `scale` or `extra`, inf where neither was estimated.
    sigma_dof : float
        The same of `sigma_rad`.
    known : bool
        False where the noise of a reading is neither stated nor estimable.
    notes : tuple of str
        What the result has to say.
    """

    scale: float = 1.0
    extra: float = 0.0
    sigma_rad: float = math.inf
    dof: float = math.inf
    sigma_dof: float = math.inf
    known: bool = True
    notes: tuple[str, ...] = ()

    def covariance(self, natural: Floats, readings: Readings) -> Floats:
        """Covariance (n, axes, axes) of readings whose measured part is `natural`."""
        factor = np.where(readings.known, 1.0, self.scale**2)
        covered = natural * factor[:, None, None]
        return np.asarray(covered + self.extra**2 * np.eye(natural.shape[1]))

    def for_intervals(self, natural: Floats, readings: Readings) -> tuple[Floats, float]:
        """Covariance and σ_f that make ± 1.96 u cover 95 % in spite of their few degrees of freedom."""
        dof = np.minimum(readings.dof, self.dof)
        factor = _student(dof) ** 2
        return self.covariance(natural, readings) * factor[:, None, None], self.sigma_rad * float(
            _student(np.array([self.sigma_dof]))[0]
        )


def _student(dof: Floats) -> Floats:
    from scipy.special import stdtrit

    # Below one degree of freedom no interval exists; one is the worst that is stated.
    factor = stdtrit(np.clip(dof, 1.0, 1e9), 0.975) / _NORMAL_95
    return np.where(np.isinf(dof), 1.0, factor)


class Family(Protocol):
    """A base model on given readings: builds its problem for any noise."""

    readings: Readings
    natural_covariance: Floats
    gravity_mg: float
    start: Floats
    free: NDArray[np.bool_]
    may_hold: tuple[tuple[int, ...], ...]

    def problem(self, covariance: Floats, sigma_rad: float) -> Problem:
        """Problem under a covariance of the readings and a fixture uncertainty."""
        ...

    def rows(self) -> int:
        """Rows that carry information."""
        ...


def problem_of(family: Family, noise: Noise) -> Problem:
    """Problem of a family under an assumption on the noise."""
    return family.problem(noise.covariance(family.natural_covariance, family.readings), noise.sigma_rad)


@dataclass(frozen=True)
class Settled:
    """A fit with its noise settled; `chi2` is that of the measured noise."""

    determination: Determination
    noise: Noise
    chi2: float
    dof: int


def settle(family: Family) -> Settled:
    """Fit a family and settle what the session leaves open about its noise."""
    readings = family.readings
    stated = readings.fixture_sigma_rad
    noise = Noise(sigma_rad=math.inf if stated is None else stated)
    open_sigma = (
        stated is None and bool(np.isfinite(readings.angle_rad).any()) and readings.mean.shape[1] == 2
    )
    if open_sigma:
        noise = replace(noise, sigma_rad=0.0)
    determination = determine(problem_of(family, noise), family.start, family.free, family.may_hold)
    dof = family.rows() - int(determination.solution.free.sum()) + determination.null.shape[1]
    follow = _Follow(family, determination)

    if not readings.known.all():
        noise = _unknown_readings(follow, noise, dof, open_sigma)
        determination = follow.determination(noise)
        return Settled(determination, noise, determination.solution.cost, dof)
    if open_sigma:
        noise = _unknown_fixture(follow, noise, dof)
        determination = follow.determination(noise)
    chi2 = determination.solution.cost
    if dof > 0 and chi2 > _chi2_quantile(dof):
        extra = _equal_to_dof(lambda s: follow(replace(noise, extra=s)).cost, dof, 1e-7, 1.0)
        ratio = math.sqrt(chi2 / dof)
        note = (
            f"the residual is {ratio:.3g} times what the noise within the dwells explains (chi2 "
            f"{chi2:.4g}, dof {dof}): the model lacks something; {extra * family.gravity_mg:.3g} mg were "
            "added to every reading so that the uncertainties hold"
        )
        noise = replace(noise, extra=extra, dof=float(dof), notes=(*noise.notes, note))
        determination = follow.determination(noise)
    return Settled(determination, noise, chi2, dof)


class _Follow:
    """Refits from the last solution, with the same parameters held."""

    def __init__(self, family: Family, first: Determination) -> None:
        self.family = family
        self.first = first
        self.last = first.solution.beta

    def __call__(self, noise: Noise) -> Solution:
        solution = solve(problem_of(self.family, noise), self.last, self.first.solution.free)
        self.last = solution.beta
        return solution

    def determination(self, noise: Noise) -> Determination:
        """Fit under `noise` with what is determined looked at again."""
        again = determine(
            problem_of(self.family, noise), self.last, self.first.solution.free, self.family.may_hold
        )
        return replace(again, held=tuple(sorted({*self.first.held, *again.held})))


def _unknown_readings(follow: _Follow, noise: Noise, dof: int, open_sigma: bool) -> Noise:
    notes = ["fixture_sigma_deg is not stated: declared angles were taken as exact"] if open_sigma else []
    if dof <= 0:
        notes.append(
            "nothing states the noise of a reading and no position is left over to show it: no uncertainty "
            "can be given; state reading_u_mg, keep the samples of each dwell, or measure more positions"
        )
        return replace(noise, known=False, notes=tuple(notes))
    scale = _equal_to_dof(lambda s: follow(replace(noise, scale=s)).cost, dof, 1e-5, 1e4)
    known = "all readings" if not follow.family.readings.known.any() else "the readings without one"
    notes.append(
        f"reading_u_mg is not stated: {known} were given {scale:.3g} mg, estimated from the residual "
        f"({dof} degrees of freedom); chi2 says nothing about the model then"
    )
    return replace(noise, scale=scale, dof=float(dof), notes=tuple(notes))


def _unknown_fixture(follow: _Follow, noise: Noise, dof: int) -> Noise:
    """Restricted maximum likelihood for σ_f."""
    if dof < 2:
        note = (
            "fixture_sigma_deg is not stated and too few positions show it: declared angles were taken as "
            "exact, uncertainties leave the fixture out"
        )
        return replace(noise, notes=(note,))
    from scipy.optimize import minimize_scalar

    def deviance(log_sigma: float) -> float:
        sigma = math.exp(log_sigma)
        problem = problem_of(follow.family, replace(noise, sigma_rad=sigma))
        assert isinstance(problem, PlanarProblem)
        solution = solve(problem, follow.last, follow.first.solution.free)
        follow.last = solution.beta
        index = np.ix_(solution.free, solution.free)
        spread = np.log1p(sigma**2 * problem.tangent_information(solution.beta)).sum()
        return solution.cost + float(spread + np.linalg.slogdet(solution.fisher[index])[1])

    low, high = math.log(1e-6), math.log(_LARGEST_SIGMA_RAD)
    found = minimize_scalar(deviance, bounds=(low, high), method="bounded", options={"xatol": 0.02})
    if float(found.fun) > deviance(low) - 0.1:
        return replace(
            noise,
            notes=(
                "fixture_sigma_deg is not stated; the residual shows none, declared angles count as exact",
            ),
        )
    sigma = math.exp(float(found.x))
    note = f"fixture_sigma_deg is not stated: {math.degrees(sigma):.3g}° was estimated from the residual"
    declared = int(np.isfinite(follow.family.readings.angle_rad).sum())
    return replace(noise, sigma_rad=sigma, sigma_dof=float(max(declared - 3, 1)), notes=(note,))


def _chi2_quantile(dof: int) -> float:
    from scipy.special import chdtri

    return float(chdtri(dof, _EXCESS))


def _equal_to_dof(cost: Callable[[float], float], dof: int, low: float, high: float) -> float:
    """Standard deviation at which a falling χ² equals its degrees of freedom; else an end of the range."""
    from scipy.optimize import brentq

    def gap(log_s: float) -> float:
        return math.log(max(cost(math.exp(log_s)), 1e-300) / dof)

    a, b = math.log(low), math.log(high)
    if gap(a) <= 0:
        return low
    if gap(b) >= 0:
        return high
    return math.exp(float(brentq(gap, a, b, xtol=1e-4, rtol=1e-8)))
