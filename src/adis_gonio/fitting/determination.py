"""What a session determines: directions without information, and what is held for want of it.

Parameters are compared in natural units (1 rad, a gain of 1, a bias of local gravity), and their standard
uncertainty with what it may be at most (`limits`). The stage's declared angles are information like any
other: a wide fixture makes the start angle less sure and not unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.model.effects import AXES, effect
from adis_gonio.model.measurement import SENSOR_SPREAD

LIMIT = 0.1
"""Largest standard uncertainty of a gain (of 1) and a bias (of local gravity) that counts as determined. At
0.1 terms of second order are a tenth of the first: beyond it neither the value nor a linearised uncertainty
means anything, and physically a bias of 100 mg or a gain off by 10 % is no news."""
ANYWHERE_RAD = math.pi / math.sqrt(3)
"""The same of the start angle: standard deviation of an angle that is anywhere on a turn. A part that is
turned as a whole reads the same, exactly: what the stage says of its zero holds as far as that."""
_SPREAD = 0.5
"""Prior standard deviation (natural units) of a bias while directions are looked for: a valley without a
bottom has one with it, and its floor shows what is lost."""
_PARTICIPATES = 1e-4
"""Least squared share of a parameter in the undetermined space for it to be counted as affected."""
_ITERATIONS = 200
_CONVERGED = 1e-12
"""Fall of χ² at which a fit has converged: 1e-6 of a standard uncertainty."""


@dataclass(frozen=True)
class Determination:
    """The base model with a bias, fitted; what had to be held, and what is left undetermined.

    Attributes
    ----------
    fit : Fit
    free : (p,) bool
        False for parameters that are held, and for those that no dwell shows.
    held : tuple of int
        Parameters held at their nominal value because the session cannot see them.
    null : (p, k) float
        Orthonormal directions, in natural units, that remain without information.
    """

    fit: Fit
    free: NDArray[np.bool_]
    held: tuple[int, ...]
    null: Floats

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return names_of(self.fit.data)

    @property
    def fisher(self) -> Floats:
        """Information (p, p) of all parameters in natural units."""
        return information(self.fit)

    def on(self, data: Readings) -> Determination:
        """The same values under other noise."""
        return replace(self, fit=replace(self.fit, data=data))

    def determined_by(self, fit: Fit) -> bool:
        """True where the readings of `fit` determine as much as those that were looked at."""
        return bool(_null_space(fit, self.free).shape[1] <= self.null.shape[1])

    def refitted(self, data: Readings) -> Fit:
        """Fit of the same free parameters under other noise, from these values."""
        fit = replace(self.fit, data=data)
        return fit.refit(_ITERATIONS, _CONVERGED, _directions(fit, self.free, self.null))


def names_of(data: Readings) -> tuple[str, ...]:
    """Names of the base parameters and the biases."""
    return (*data.model.names, *(f"bias_{axis}" for axis in AXES[: data.axes]))


def natural_units(data: Readings) -> Floats:
    """Size (p,) of each parameter in the units of a fit: 1 for the base, local gravity (mg) for a bias."""
    return np.array([1.0] * len(data.model.parameters) + [data.gravity_mg] * data.axes)


def limits(data: Readings) -> Floats:
    """Largest standard uncertainty (p,), in natural units, at which a parameter is determined.

    That of an angle between two axes is what is known of any part that is sold as a sensor.
    """
    most = {"alpha": ANYWHERE_RAD, "delta_phi": SENSOR_SPREAD}
    return np.array([most.get(name, LIMIT) for name in names_of(data)])


def information(fit: Fit) -> Floats:
    """Information (p, p) of the readings alone, in natural units."""
    scaled = fit.jacobian * natural_units(fit.data)
    return np.asarray(scaled.T @ scaled)


def determine(data: Readings, held: Sequence[int] = ()) -> Determination:
    """Fit base model and bias, and find what the session cannot determine.

    Directions whose information is too small (`limits`) are looked for in the spectrum of the information
    matrix in these units. As long as there are any, parameters that a session may lack (in the plane the
    biases, in space the skews) and that take part in them are held at their nominal values. What remains
    then is `null`.

    Parameters
    ----------
    held : sequence of int
        Parameters that are held already.
    """
    free = np.concatenate([data.visible, np.ones(data.axes, dtype=bool)])
    if not data.planar:
        free[:] = True  # what a pose cannot show is looked for here, and said
        data = replace(data, fitted=np.ones(len(data.model.parameters), dtype=bool))
    free[list(held)] = False
    may_hold = _may_hold(data)
    out = list(held)
    while True:
        rough = _start(data)
        rough = rough.refit(_ITERATIONS, 1e-6, _directions(rough, free, np.zeros((len(free), 0))))
        null = _null_space(rough, free)
        lost = [k for k in may_hold if free[k] and (null[k] ** 2).sum() > _PARTICIPATES]
        if not lost:
            break
        out += lost
        free[lost] = False
    fit = Fit(data, (_bias(data),), rough.values, with_prior=False)
    fit = fit.refit(_ITERATIONS, _CONVERGED, _directions(fit, free, null))
    return Determination(fit, free, tuple(sorted(out)), null)


def _may_hold(data: Readings) -> list[int]:
    names = names_of(data)
    if not data.planar:
        return [k for k, name in enumerate(names) if name.startswith("skew")]
    # A zero in counts has no nominal value that it could be held at.
    return [k for k, name in enumerate(names) if name.startswith("bias")] if data.unit.known else []


def _bias(data: Readings, spread: float | None = None) -> NamedTerm:
    axes = tuple(AXES[: data.axes])
    return NamedTerm("bias", (), 0.0, effect("bias", axes), spread=spread)


def _start(data: Readings) -> Fit:
    term = _bias(data, _SPREAD * data.gravity_mg)
    return Fit.begin(data).having((term,), (np.zeros(data.axes),))


def _directions(fit: Fit, free: NDArray[np.bool_], null: Floats) -> Floats:
    """Directions (p, k), in the fit's units, in which parameters may move."""
    return np.asarray(natural_units(fit.data)[:, None] * _complement(free, null))


def _complement(free: NDArray[np.bool_], null: Floats) -> Floats:
    """Orthonormal basis (p, k) of the free parameters beside `null`."""
    basis = np.eye(len(free))[:, free]
    if not null.shape[1]:
        return basis
    left, values, _ = np.linalg.svd(basis - null @ (null.T @ basis), full_matrices=False)
    return np.asarray(left[:, values > 0.5])


def _null_space(fit: Fit, free: NDArray[np.bool_]) -> Floats:
    index = np.flatnonzero(free)
    most = limits(fit.data)[index]
    values, vectors = np.linalg.eigh(information(fit)[np.ix_(index, index)] * np.outer(most, most))
    poor = values < max(1.0, 1e-14 * float(values[-1]) if len(values) else 0.0)
    null = np.zeros((len(free), int(poor.sum())))
    null[index] = np.linalg.qr(most[:, None] * vectors[:, poor])[0]
    return null


def covariance(fisher: Floats, free: NDArray[np.bool_], null: Floats) -> Floats:
    """Covariance (p, p) of the parameters, zero for those held and along `null`; natural units.

    Only functions of the parameters whose gradient is orthogonal to `null` may be propagated with it.
    """
    basis = _complement(free, null)
    inner = basis.T @ fisher @ basis
    scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    inverse = np.linalg.inv(inner / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray(basis @ inverse @ basis.T)


def is_determined(gradient: Floats, null: Floats) -> bool:
    """True where a function with this gradient (p,) does not change along `null`."""
    size = float(gradient @ gradient)
    along = gradient @ null
    return float(along @ along) <= _PARTICIPATES * size


def shift_by_held(determination: Determination, held: int) -> Floats:
    """∂β/∂(held parameter), (p,): how the fitted parameters follow the value that one is held at."""
    fisher = determination.fisher
    return np.asarray(-covariance(fisher, determination.free, determination.null) @ fisher[:, held])


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
