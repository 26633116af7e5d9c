"""Find the parameters, and combinations of parameters, that a session does not determine.

Parameters are expressed in natural units (1 rad, a gain of 1, a bias of local gravity), and their standard
uncertainty is compared with the largest allowed one (`limits`). The declared angles of the stage count as
information, however large the fixture's uncertainty is: it makes the start angle less certain, but not
unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

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
_SPREAD = 0.5
"""Prior standard deviation (natural units) of a bias during the search for undetermined directions: with it
a flat valley of χ² has a minimum, where the undetermined directions can be found."""
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
        """Fit the free parameters to readings with other noise, starting from the present values."""
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
        term = _bias(data, _SPREAD * data.gravity_mg)
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
