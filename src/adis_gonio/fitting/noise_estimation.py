"""Noise of readings and declared angles that is not stated and has to be estimated from the session.

* Readings of unknown noise: one common standard deviation, such that χ² equals its degrees of freedom.
* A fixture without a stated uncertainty: the standard deviation σ_f of the declared angles is estimated by
  restricted maximum likelihood, if the residual has at least two degrees of freedom.
* A residual that the noise within the dwells does not explain (χ² above its 99.9 % quantile): the model
  lacks an effect. An extra standard deviation is added to every reading, again such that χ² equals its
  degrees of freedom (Mandel and Paule 1970). It keeps the intervals valid and limits the weight of the
  quietest dwell. The reported χ² is computed with the measured noise, so that the misfit remains visible.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from adis_gonio.fitting.determination import Determination, determine, information
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings

_EXCESS = 1e-3
_LEAST_SCALE = 1e-5
"""Least standard deviation (mg) of a reading that is estimated: a smaller residual shows only rounding
errors."""
_LARGEST_SCALE = 1e4
_LARGEST_SIGMA_RAD = 0.2


@dataclass(frozen=True)
class NoiseAssumptions:
    """Noise that a fit assumes for the readings and the declared angles.

    Attributes
    ----------
    scale : float
        Standard deviation (mg) of readings of unknown noise; 1 if the noise is known.
    extra_mg : float
        Standard deviation added to every reading, because the measured noise does not explain the residual.
    sigma_rad : float
        Standard uncertainty of a declared angle; inf for free attitudes.
    dof, sigma_dof, scale_dof : float
        Degrees of freedom of `extra_mg`, `sigma_rad` and `scale`; inf if not estimated.
    known : bool
        False if the noise of a reading is neither stated nor estimable.
    notes : tuple of str
        Remarks for the result.
    """

    scale: float = 1.0
    extra_mg: float = 0.0
    sigma_rad: float = math.inf
    dof: float = math.inf
    sigma_dof: float = math.inf
    scale_dof: float = math.inf
    known: bool = True
    notes: tuple[str, ...] = ()

    def applied(self, readings: Readings) -> Readings:
        """Return a copy of the readings with this noise in their covariance and their declared angles."""
        # Readings of unknown noise have a placeholder of 1 mg, scaled here.
        covariance = readings.own_covariance * self.scale**2 + self.extra_mg**2 * np.eye(readings.axes)
        return replace(readings, own_covariance=covariance, fixture_rad=self.sigma_rad)


@dataclass(frozen=True)
class Settled:
    """A fit of base model and biases, with an estimate of the noise that the session does not state.

    `determination` is the fit and `noise` the estimate. `chi2` and `dof` (χ² of the fit and its degrees of
    freedom) are computed with the measured or stated noise; if it is unknown, with the estimate, and are
    then no test of the model.
    """

    determination: Determination
    noise: NoiseAssumptions
    chi2: float
    dof: int


def settle(readings: Readings) -> Settled:
    """Fit base model and biases to readings, and estimate the noise that the session does not state."""
    open_sigma = not readings.fixture_stated and readings.planar and not readings.free
    noise = NoiseAssumptions(sigma_rad=readings.fixture_rad)
    determination = determine(readings)
    dof = determination.dof
    follow = _Follow(readings, determination)

    if not readings.noise_known:
        noise = _unknown_readings(follow, noise, dof, open_sigma)
        determination = follow.determination(noise)
        return Settled(determination, noise, determination.fit.chi2, dof)
    if open_sigma:
        noise = _unknown_fixture(follow, noise, dof)
        determination = follow.determination(noise)
    chi2 = determination.fit.chi2
    if dof > 0 and chi2 > chi2_quantile(dof, _EXCESS):
        low, high = 1e-7 * readings.gravity_mg, readings.gravity_mg
        # Solve χ²(extra) = dof for the additional standard deviation.
        extra = scale_at_dof(lambda s: follow(replace(noise, extra_mg=s)).chi2, dof, low, high)
        ratio = math.sqrt(chi2 / dof)
        note = (
            f"the residual is {ratio:.3g} times what the noise of the readings explains (chi2 "
            f"{chi2:.4g}, dof {dof}): the model does not describe this session; each u includes "
            f"{extra:.3g} mg of scatter on every reading and the catalogue's effects that the data allow"
        )
        noise = replace(noise, extra_mg=extra, dof=float(dof), notes=(*noise.notes, note))
        determination = follow.determination(noise)
    return Settled(determination, noise, chi2, dof)


class _Follow:
    """Repeats a fit of one session for several assumptions on its noise.

    Each fit starts from the values of the last one. Parameters that the first fit kept fixed stay fixed.
    """

    def __init__(self, readings: Readings, first: Determination) -> None:
        self.readings = readings
        self.first = first
        self.last = first

    def __call__(self, noise: NoiseAssumptions) -> Fit:
        fit = self.last.refitted(noise.applied(self.readings))
        self.last = replace(self.last, fit=fit)
        return fit

    def determination(self, noise: NoiseAssumptions) -> Determination:
        """Return a fit with `noise` that finds again which parameters the readings determine."""
        return determine(noise.applied(self.readings), self.first.held)


def _unknown_readings(
    follow: _Follow, noise: NoiseAssumptions, dof: int, open_sigma: bool
) -> NoiseAssumptions:
    notes = ["fixture_sigma_deg is not stated: declared angles were taken as exact"] if open_sigma else []
    if dof <= 0:
        notes.append(
            "the noise of a reading is unknown and there are too few positions to estimate it: no "
            "uncertainty can be given; state reading_u_mg, keep the samples of each dwell, or measure "
            "more positions"
        )
        return replace(noise, known=False, notes=tuple(notes))
    scale = scale_at_dof(lambda s: follow(replace(noise, scale=s)).chi2, dof, _LEAST_SCALE, _LARGEST_SCALE)
    if scale <= _LEAST_SCALE:
        notes.append(
            "the noise of a reading is unknown and the model fits all readings exactly: no "
            "uncertainty can be given; state reading_u_mg, or keep the samples of each dwell"
        )
        return replace(noise, known=False, notes=tuple(notes))
    notes.append(
        f"reading_u_mg is not stated: all readings were given {scale:.3g} mg, estimated from the residual "
        f"({dof} degrees of freedom); chi2 is therefore no test of the model"
    )
    return replace(noise, scale=scale, scale_dof=float(dof), notes=tuple(notes))


def _unknown_fixture(follow: _Follow, noise: NoiseAssumptions, dof: int) -> NoiseAssumptions:
    """Estimate the standard deviation σ_f of the declared angles by restricted maximum likelihood.

    `follow` fits the session again with other noise. `dof` are the degrees of freedom of the residual. With
    fewer than 2, or if the residual shows no such deviation, the result is `noise` with a note.
    """
    if dof < 2:
        note = (
            "fixture_sigma_deg is not stated and too few positions show it: declared angles were taken as "
            "exact, uncertainties leave the fixture out"
        )
        return replace(noise, notes=(note,))
    from scipy.optimize import minimize_scalar

    def deviance(log_sigma: float) -> float:
        sigma = math.exp(log_sigma)
        fit = follow(replace(noise, sigma_rad=sigma))
        free = follow.first.free
        # Whitened tangent: σ² times its square is the variance of a dwell from its angle.
        along = fit.data.root @ fit.tangent
        carried = np.where(np.isfinite(fit.data.fixture), (along**2).sum(axis=(1, 2)), 0.0)
        # Log determinants of the covariance and of the information: restricted likelihood.
        spread = np.log1p(sigma**2 * carried).sum()
        # Directions that the positions do not show have only rounding errors.
        known = np.linalg.eigvalsh(information(fit)[np.ix_(free, free)])
        return fit.chi2 + float(spread + np.log(np.maximum(known, 1e-15 * known.max())).sum())

    low, high = math.log(1e-6), math.log(_LARGEST_SIGMA_RAD)
    found = minimize_scalar(deviance, bounds=(low, high), method="bounded", options={"xatol": 0.02})
    # No clear gain over an exact fixture.
    if float(found.fun) > deviance(low) - 0.1:
        return replace(
            noise,
            notes=(
                "fixture_sigma_deg is not stated; the residual shows none, declared angles count as exact",
            ),
        )
    sigma = math.exp(float(found.x))
    note = f"fixture_sigma_deg is not stated: {math.degrees(sigma):.3g}° was estimated from the residual"
    declared = int(np.isfinite(follow.readings.angle_rad).sum())
    return replace(noise, sigma_rad=sigma, sigma_dof=float(max(declared - 3, 1)), notes=(note,))


def chi2_quantile(dof: int, level: float) -> float:
    """Return the value that χ² with `dof` degrees of freedom exceeds with the probability `level`."""
    from scipy.special import chdtri

    return float(chdtri(dof, level))


def scale_at_dof(cost: Callable[[float], float], dof: int, low: float, high: float) -> float:
    """Return the standard deviation at which χ² equals its degrees of freedom `dof`.

    `cost` returns χ² for a standard deviation and decreases with it. Without a solution between `low` and
    `high`, the nearer of the two is returned.
    """
    from scipy.optimize import brentq

    @cache  # a refit starts at the last values, so a second call could give another result
    def gap(log_s: float) -> float:
        return math.log(max(cost(math.exp(log_s)), 1e-300) / dof)

    # χ² decreases with s, so that a sign change brackets the solution.
    a, b = math.log(low), math.log(high)
    if gap(a) <= 0:
        return low
    if gap(b) >= 0:
        return high
    return math.exp(float(brentq(gap, a, b, xtol=1e-4, rtol=1e-8)))
