"""Find the parameters that a session does not determine, and the noise that it does not state.

Parameters are expressed in natural units (1 rad, a gain of 1, a bias of local gravity), and their standard
uncertainty is compared with the largest allowed one (`limits`). The declared angles of the stage count as
information, however large the fixture's uncertainty is: it makes the start angle less certain, but not
unknown.

Noise of readings and declared angles that is not stated is estimated from the session:

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.numbers import signed
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.model.effects import AXES
from adis_gonio.model.measurement import SENSOR_SPREAD, Measurement

LIMIT = 0.1
"""Largest standard uncertainty with which a gain (1 is perfect) or a bias (as a share of local gravity)
counts as determined. At 0.1 terms of second order are a tenth of the first-order terms. Above it neither
the value nor a linearised uncertainty is meaningful, and a bias within 100 mg or a gain within 10 % is
known without a measurement.
"""
ANYWHERE_RAD = math.pi / math.sqrt(3)
"""Largest standard uncertainty (rad) of the start angle that counts as determined: the standard deviation
of an angle that may be anywhere on a turn. Turning the whole part in its fixture changes no reading, so the
declared zero of the stage alone determines the start angle."""
TYPICAL = 0.05
"""Prior standard deviation (natural units) of a bias during the search for undetermined directions, and
standard uncertainty along such a direction. With it a flat valley of χ² has a minimum near the nominal
values. Far from there, terms of second order would change the gains and biases that count as determined.
"""
_ZERO_SPREAD = 0.5
"""The prior standard deviation for readings in counts, whose zero has no nominal value."""
_PARTICIPATES = 1e-4
"""Share of a parameter's squared direction that lies in the undetermined space, above which the parameter
counts as undetermined."""
_ITERATIONS = 200
_CONVERGED = 1e-12
"""Decrease of χ² in a step below which a fit has converged: a step of 1e-6 standard uncertainties."""


@dataclass(frozen=True)
class Determination:
    """A fit of base model and biases, with a list of everything that the readings do not determine.

    Attributes
    ----------
    fit : Fit
        Fit of base model and bias, without the undetermined directions.
    free : (p,) bool
        False for fixed parameters, and for parameters that affect no dwell.
    held : tuple of int
        Parameters fixed at their nominal value because the session does not determine them.
    null : (p, k) float
        Orthonormal directions in the space of the parameters (natural units) that the readings do not
        determine.
    """

    fit: Fit
    free: NDArray[np.bool_]
    held: tuple[int, ...]
    null: Floats

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters: base parameters, then biases."""
        return names_of(self.fit.data.model)

    @property
    def dof(self) -> int:
        """Degrees of freedom of the residual of the fit: equations minus determined parameters."""
        return int(self.fit.equations - self.free.sum() + self.null.shape[1])

    @property
    def fisher(self) -> Floats:
        """Fisher information (p, p) of all parameters in natural units."""
        return information(self.fit)

    def determined_by(self, fit: Fit) -> bool:
        """Return True if the readings of `fit` determine as many parameters as the readings of this object.

        Independent combinations of parameters are counted; more are allowed, too.
        """
        return bool(_null_space(fit, self.free).shape[1] <= self.null.shape[1])

    def refitted(self, data: Readings) -> Fit:
        """Fit the free parameters to readings with other noise, starting from the values of this fit."""
        fit = replace(self.fit, data=data)
        return fit.refit(_ITERATIONS, _CONVERGED, _directions(fit, self.free, self.null))


def names_of(model: Measurement) -> tuple[str, ...]:
    """Return the names of all parameters of a model with biases: base parameters, then biases."""
    return (*model.names, *(f"bias_{axis}" for axis in AXES[: model.axes]))


def natural_units(data: Readings) -> Floats:
    """Return the factor (p,) that converts each parameter from natural units to units of a fit.

    It is 1 for base parameters and local gravity in mg for biases.
    """
    return np.array([1.0] * len(data.model.parameters) + [data.gravity_mg] * data.axes)


def limits(data: Readings) -> Floats:
    """Return the largest standard uncertainty (p,) at which each parameter counts as determined.

    It is in natural units. The limit of the angle between two axes is the spread of this angle among
    sensors on the market.
    """
    most = {"alpha": ANYWHERE_RAD, "delta_phi": SENSOR_SPREAD}
    return np.array([most.get(name, LIMIT) for name in names_of(data.model)])


def information(fit: Fit) -> Floats:
    """Return the Fisher information (p, p) of the readings, for parameters in `natural_units`.

    It excludes the priors of the parameters.
    """
    scaled = fit.jacobian * natural_units(fit.data)
    return np.asarray(scaled.T @ scaled)


def determine(data: Readings, held: Sequence[int] = ()) -> Determination:
    """Fit base model and bias, and find what the session cannot determine.

    Directions with too little information (`limits`) are eigenvectors of the information matrix in natural
    units. While there are such directions, parameters that they affect are fixed at their nominal values:
    biases in the plane, skews in space. The directions that remain after that are `null`.

    Parameters
    ----------
    held : sequence of int
        Indices of the parameters that are fixed at their nominal value in any case.
    """
    free = np.concatenate([data.visible, np.ones(data.axes, dtype=bool)])
    if not data.planar:
        free[:] = True  # undetermined parameters of poses are found below and reported
        data = replace(data, fitted=np.ones(len(data.model.parameters), dtype=bool))
    free[list(held)] = False
    kind = "bias" if data.planar else "skew"
    may_hold = [k for k, name in enumerate(names_of(data.model)) if name.startswith(kind)]
    if data.planar and not data.unit.known:
        may_hold = []  # a zero in counts has no nominal value to hold it at
    out = list(held)
    while True:
        # A prior on the bias keeps this search from running along directions without information.
        spread = TYPICAL if data.unit.known else _ZERO_SPREAD
        term = _bias(data, spread * data.gravity_mg)
        rough = Fit.begin(data).with_terms((term,), (np.zeros(data.axes),))
        rough = rough.refit(_ITERATIONS, 1e-6, _directions(rough, free, np.zeros((len(free), 0))))
        null = _null_space(rough, free)
        # Parameters that may be held and that take part in an undetermined direction.
        lost = [k for k in may_hold if free[k] and (null[k] ** 2).sum() > _PARTICIPATES]
        if not lost:
            break
        out += lost
        free[lost] = False
    fit = Fit(data, (_bias(data),), rough.values, with_prior=False)
    fit = fit.refit(_ITERATIONS, _CONVERGED, _directions(fit, free, null))
    return Determination(fit, free, tuple(sorted(out)), null)


def _bias(data: Readings, spread: float | None = None) -> NamedTerm:
    return NamedTerm.offset(AXES[: data.axes], spread)


def _directions(fit: Fit, free: NDArray[np.bool_], null: Floats) -> Floats:
    """Return k independent directions (p, k) in which a fit may change the p parameters.

    They are in units of the fit. They exclude parameters that are not `free`, and the undetermined
    directions `null` (p, j).
    """
    return np.asarray(natural_units(fit.data)[:, None] * _complement(free, null))


def _complement(free: NDArray[np.bool_], null: Floats) -> Floats:
    """Return an orthonormal basis (p, k) of all changes of `free` parameters orthogonal to `null`."""
    basis = np.eye(len(free))[:, free]
    if not null.shape[1]:
        return basis
    # Project the undetermined directions out of the free ones.
    left, values, _ = np.linalg.svd(basis - null @ (null.T @ basis), full_matrices=False)
    return np.asarray(left[:, values > 0.5])


def _null_space(fit: Fit, free: NDArray[np.bool_]) -> Floats:
    index = np.flatnonzero(free)
    most = limits(fit.data)[index]
    # Scaled by the limits, an eigenvalue below 1 is an uncertainty above the limit.
    values, vectors = np.linalg.eigh(information(fit)[np.ix_(index, index)] * np.outer(most, most))
    poor = values < max(1.0, 1e-14 * float(values[-1]) if len(values) else 0.0)
    null = np.zeros((len(free), int(poor.sum())))
    # Back to natural units, orthonormal again.
    null[index] = np.linalg.qr(most[:, None] * vectors[:, poor])[0]
    return null


def covariance(fisher: Floats, free: NDArray[np.bool_], null: Floats) -> Floats:
    """Return the covariance (p, p) of the parameters in natural units.

    `fisher` (p, p) is their Fisher information. The undetermined directions `null` are left out: the result
    is valid only for functions with a gradient orthogonal to them. It is zero for parameters that are not
    `free`.
    """
    basis = _complement(free, null)
    # Invert the information within the determined directions, scaled to a unit diagonal.
    inner = basis.T @ fisher @ basis
    scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    inverse = np.linalg.inv(inner / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray(basis @ inverse @ basis.T)


def is_determined(gradient: Floats, null: Floats) -> bool:
    """Return True if the readings determine a function of the parameters with this gradient (p,).

    This is so if the function is constant along the undetermined directions `null`, all in natural units.
    """
    size = float(gradient @ gradient)
    along = gradient @ null
    return float(along @ along) <= _PARTICIPATES * size


def shift_by_held(determination: Determination, held: int) -> Floats:
    """Return the derivative (p,) of the fitted parameters by the value of the fixed parameter `held`.

    `held` is the index of the parameter; all parameters are in natural units.
    """
    fisher = determination.fisher
    return np.asarray(-covariance(fisher, determination.free, determination.null) @ fisher[:, held])


def format_directions(null: Floats, names: Sequence[str]) -> list[str]:
    """Format each undetermined direction as text: a combination of parameters in natural units.

    The directions are the columns of `null` (p, k).
    """
    words = []
    for direction in null.T:
        # Largest components first; the first one gets a positive sign.
        order = np.argsort(-np.abs(direction))
        parts = [k for k in order.tolist() if abs(direction[k]) > 0.1]
        lead = math.copysign(1.0, direction[parts[0]])
        if len(parts) == 1:
            words.append(names[parts[0]])
            continue
        terms = [f"{signed(lead * direction[k], 2)}·{names[k]}" for k in parts]
        words.append(" ".join(terms).removeprefix("+"))
    return words


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
    first = determination = determine(readings)
    dof = first.dof

    if not readings.noise_known:
        # All that the residual shows counts as noise of each reading, because a part can have less 1/f
        # noise than its figure. Only the errors of the stage are shared.
        alone = replace(readings, slow=readings.slow[:, :, :0])
        noise = _unknown_readings(first, alone, noise, open_sigma)
        determination = determine(noise.applied(readings), first.held)
        return Settled(determination, noise, determination.fit.chi2, dof)
    if open_sigma:
        noise = _unknown_fixture(first, readings, noise)
        determination = determine(noise.applied(readings), first.held)
    chi2 = determination.fit.chi2
    if dof > 0 and chi2 > chi2_quantile(dof, _EXCESS):
        low, high = 1e-7 * readings.gravity_mg, readings.gravity_mg
        # Solve χ²(extra) = dof for the additional standard deviation.
        extra = scale_at_dof(
            lambda s: first.refitted(replace(noise, extra_mg=s).applied(readings)).chi2, dof, low, high
        )
        ratio = math.sqrt(chi2 / dof)
        note = (
            f"the residual is {ratio:.3g} times what the noise of the readings explains (chi2 "
            f"{chi2:.4g}, dof {dof}): the model does not describe this session; each u includes "
            f"{extra:.3g} mg of scatter on every reading and the catalogue's effects that the data allow"
        )
        noise = replace(noise, extra_mg=extra, dof=float(dof), notes=(*noise.notes, note))
        determination = determine(noise.applied(readings), first.held)
    return Settled(determination, noise, chi2, dof)


def _unknown_readings(
    first: Determination, readings: Readings, noise: NoiseAssumptions, open_sigma: bool
) -> NoiseAssumptions:
    """Return the noise with the standard deviation of the readings, estimated from the residual.

    `first` is a fit of the readings with any noise; `open_sigma` is True if no uncertainty of the declared
    angles is stated. Without an estimate the noise is unknown, with a note.
    """
    dof = first.dof
    notes = ["fixture_sigma_deg is not stated: declared angles were taken as exact"] if open_sigma else []
    why, scale = "there are too few positions to estimate it", 0.0
    if dof > 0:
        why, limits_mg = "the model fits all readings exactly", (_LEAST_SCALE, _LARGEST_SCALE)
        scale = scale_at_dof(
            lambda s: first.refitted(replace(noise, scale=s).applied(readings)).chi2, dof, *limits_mg
        )
    scale_dof = float(dof)
    if scale > _LEAST_SCALE and readings.planar and 0 < noise.sigma_rad < math.inf:
        scale, scale_dof = _estimate_scale(first, readings, noise, scale)
    if scale <= _LEAST_SCALE:
        notes.append(
            f"the noise of a reading is unknown and {why}: no uncertainty can be given; state reading_u_mg,"
            " keep the samples of each dwell, or measure more positions"
        )
        return replace(noise, known=False, notes=tuple(notes))
    notes.append(
        f"reading_u_mg is not stated: all readings were given {scale:.3g} mg, estimated from the residual "
        f"({scale_dof:.3g} degrees of freedom); chi2 is therefore no test of the model"
    )
    return replace(noise, scale=scale, scale_dof=scale_dof, notes=tuple(notes))


def _estimate_scale(
    first: Determination, readings: Readings, noise: NoiseAssumptions, start_mg: float
) -> tuple[float, float]:
    """Estimate the scatter of the readings in mg if the scatter of the declared angles is stated.

    The scatter of the angles is part of χ², but shows little of the readings' noise, so that the
    restricted likelihood decides, and its curvature gives the degrees of freedom. `start_mg`, at which χ²
    equals its degrees of freedom, is returned with these degrees if the likelihood has no maximum within a
    factor of 1000. The angles may scatter some hundred times more than the readings.
    """
    from scipy.optimize import minimize_scalar

    def deviance(log_scale: float) -> float:
        return _deviance(first, readings, replace(noise, scale=math.exp(log_scale)))

    middle, span = math.log(start_mg), math.log(1000.0)
    found = minimize_scalar(
        deviance, bounds=(middle - span, middle + span), method="bounded", options={"xatol": 0.01}
    )
    at, step = float(found.x), 0.1
    # χ²/s² + 2 ν ln s has the second derivative 4 ν by ln s at its minimum.
    seen = (deviance(at - step) + deviance(at + step) - 2 * float(found.fun)) / (4 * step**2)
    if abs(at - middle) > span - 2 * step or seen < 0.5:  # six positions show 1 within rounding
        return start_mg, float(first.dof)
    return math.exp(at), min(seen, float(first.dof))


def _deviance(first: Determination, readings: Readings, noise: NoiseAssumptions) -> float:
    """Return −2 ln of the restricted likelihood of planar readings with this noise, up to a constant."""
    fit, free = first.refitted(noise.applied(readings)), first.free
    # Whitened tangent: σ² times its square is the variance of a dwell from its angle.
    along = fit.data.root @ fit.tangent
    carried, fixture = (along**2).sum(axis=(1, 2)), fit.data.fixture
    bound = np.isfinite(fixture)
    # Log determinants of the covariance and of the information: restricted likelihood.
    spread = np.where(bound, np.log1p(np.where(bound, fixture, 0.0) ** 2 * carried), np.log(carried)).sum()
    # Directions that the positions do not show have only rounding errors.
    known = np.linalg.eigvalsh(information(fit)[np.ix_(free, free)])
    own = 2 * fit.data.mean.size * math.log(noise.scale)
    return fit.chi2 + float(own + spread + np.log(np.maximum(known, 1e-15 * known.max())).sum())


def _unknown_fixture(first: Determination, readings: Readings, noise: NoiseAssumptions) -> NoiseAssumptions:
    """Estimate the standard deviation σ_f of the declared angles by restricted maximum likelihood.

    `first` is a fit of the readings with any noise. If its residual has fewer than 2 degrees of freedom, or
    shows no such deviation, the result is `noise` with a note.
    """
    if first.dof < 2:
        note = (
            "fixture_sigma_deg is not stated and too few positions show it: declared angles were taken as "
            "exact, uncertainties leave the fixture out"
        )
        return replace(noise, notes=(note,))
    from scipy.optimize import minimize_scalar

    def deviance(log_sigma: float) -> float:
        return _deviance(first, readings, replace(noise, sigma_rad=math.exp(log_sigma)))

    low, high = math.log(1e-6), math.log(_LARGEST_SIGMA_RAD)
    found = minimize_scalar(deviance, bounds=(low, high), method="bounded", options={"xatol": 0.02})
    # No clear gain over an exact fixture.
    if float(found.fun) > deviance(low) - 0.1:
        note = "fixture_sigma_deg is not stated; the residual shows none, declared angles count as exact"
        return replace(noise, notes=(note,))
    sigma = math.exp(float(found.x))
    note = f"fixture_sigma_deg is not stated: {math.degrees(sigma):.3g}° was estimated from the residual"
    declared = int(np.isfinite(readings.angle_rad).sum())
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

    @cache  # brentq computes both ends again
    def gap(log_s: float) -> float:
        return math.log(max(cost(math.exp(log_s)), 1e-300) / dof)

    # χ² decreases with s, so that a sign change brackets the solution.
    a, b = math.log(low), math.log(high)
    if gap(a) <= 0:
        return low
    if gap(b) >= 0:
        return high
    return math.exp(float(brentq(gap, a, b, xtol=1e-4, rtol=1e-8)))
