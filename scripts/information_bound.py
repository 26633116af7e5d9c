"""The least uncertainty that any estimator can reach: Fisher information from how readings arise.

Nothing of the package is used: readings are written down from the geometry (docs/theory.md), slopes are
central differences, and everything that is random beside the noise of a reading (the error of each declared
angle, the attitude of a pose, the 1/f noise of each dwell) is one more unknown with its own prior. The
inverse of the information on all unknowns together, of which the parameters are a part, is the Cramér–Rao
bound with nuisance parameters (Van Trees, Detection, Estimation and Modulation Theory I, 2.4.3: the bound
of a vector of which a part is random). No elimination, no whitening, no tangent: what `Fit` does by
algebra is done here by brute force, so that one can be held to the other.

The prior's spread moves the slopes too little to matter: at 0.1° they differ by 2·10⁻³ and the
information by its square. That of the covariance on the parameters (where the noise lies tells of the
angle) is left out; tests compare with the full likelihood.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

G_MG = 1000.0
PLANAR = ("alpha", "scale_x", "scale_y", "delta_phi", "bias_x", "bias_y")
SPATIAL = (
    "scale_x", "scale_y", "scale_z", "skew_xy", "skew_xz", "skew_yz", "bias_x", "bias_y", "bias_z",
)  # fmt: skip
_STEP = 1e-5


@dataclass(frozen=True)
class Bound:
    """What readings tell of p parameters and k nuisances.

    Attributes
    ----------
    covariance : (p, p) float
        Least covariance of any unbiased estimator, in the parameters' own units.
    gain : (p, m) float
        By readings (m,): errors of the estimator that attains the bound, for an error of the readings.
    carried : (p, k) float
        The same for the nuisances' own values.
    """

    covariance: Floats
    gain: Floats
    carried: Floats

    def error(self, noise_mg: Floats, nuisance: Floats) -> Floats:
        """Error (p,) of the estimator that attains the bound, of readings' noise (m,), nuisances (k,)."""
        return np.asarray(self.gain @ noise_mg + self.carried @ nuisance)


def planar_mg(parameters: Floats, psi: Floats) -> Floats:
    """Readings (n, 2) of `PLANAR` (rad, mg), gravity standing at ψ (n,) beside the start angle."""
    alpha, k_x, k_y, phi, b_x, b_y = parameters[:6]
    u_x = k_x * G_MG * np.cos(alpha + psi) + b_x
    u_y = k_y * G_MG * np.sin(alpha + psi + phi) + b_y
    return np.stack([u_x, u_y], axis=1)


def spatial_mg(parameters: Floats, gravity: Floats) -> Floats:
    """Readings (n, 3) of `SPATIAL` (rad, mg); gravity (n, 3) in units of local gravity.

    Axes at angles of 90° minus a skew have the Gram matrix with the sines of the skews; its Cholesky factor
    is the one triangular matrix of directions that has it.
    """
    gains, (xy, xz, yz), bias = parameters[:3], np.sin(parameters[3:6]), parameters[6:9]
    axes = np.linalg.cholesky(np.array([[1, xy, xz], [xy, 1, yz], [xz, yz, 1]]))
    return np.asarray(G_MG * (gravity @ axes.T) * gains + bias)


def planar_bound(
    parameters: Floats,
    angles_rad: Floats,
    noise_mg: float,
    fixture_rad: float,
    *,
    flicker_mg2: Floats | None = None,
    sees: NDArray[np.bool_] | None = None,
    model: Callable[[Floats, Floats], Floats] = planar_mg,
) -> Bound:
    """Bound of a session in the plane; nuisances are the angles' errors (n,), then the flicker (2 n,).

    Parameters
    ----------
    parameters : (p,) float
        `PLANAR`, then whatever else `model` takes.
    noise_mg : float
        White noise of a reading, each axis.
    fixture_rad : float
        Standard uncertainty of a declared angle.
    flicker_mg2 : (n, n) float, optional
        Covariance of each axis's means by noise that dwells share. A bias is then that of the session: its
        own and the mean of this noise over the dwells.
    sees : (p,) bool, optional
        Parameters that are unknown; by default all.
    model : callable
        Readings (n, 2) of parameters and of the angles (n,) from α.
    """
    n, p = len(angles_rad), len(parameters)
    turned = n if fixture_rad > 0 else 0
    slow = 0 if flicker_mg2 is None else 2 * n

    def readings(z: Floats) -> Floats:
        away = z[p : p + turned] if turned else 0.0
        made = model(z[:p], away - angles_rad)
        if slow:
            made = made + z[p + turned :].reshape(2, n).T
        return made.ravel()

    prior = np.zeros((p + turned + slow,) * 2)
    if turned:
        prior[p : p + n, p : p + n] = np.eye(n) / fixture_rad**2
    if flicker_mg2 is not None:
        prior[p + turned :, p + turned :] = np.kron(np.eye(2), np.linalg.inv(flicker_mg2))
    at = np.concatenate([parameters, np.zeros(turned + slow)])
    wanted = np.eye(p, len(at))
    if slow:
        wanted[4, p + turned : p + turned + n] = wanted[5, p + turned + n :] = 1 / n
    return _bound(readings, at, noise_mg, prior, wanted, sees)


def spatial_bound(parameters: Floats, gravity: Floats, noise_mg: float) -> Bound:
    """Bound of poses (n, 3) whose attitudes nobody declares; nuisances are their two turns each (2 n,)."""
    n, p = len(gravity), len(parameters)
    first = np.cross(gravity, np.roll(gravity, 1, axis=1) + np.array([0.3, -0.2, 0.1]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(gravity, first)

    def readings(z: Floats) -> Floats:
        away = z[p:].reshape(2, n)
        turned = gravity + away[0][:, None] * first + away[1][:, None] * second
        return spatial_mg(z[:p], turned / np.linalg.norm(turned, axis=1, keepdims=True)).ravel()

    at = np.concatenate([parameters, np.zeros(2 * n)])
    return _bound(readings, at, noise_mg, np.zeros((len(at),) * 2), np.eye(p, len(at)), None)


def _bound(
    readings: Callable[[Floats], Floats],
    at: Floats,
    noise_mg: float,
    prior: Floats,
    wanted: Floats,
    sees: NDArray[np.bool_] | None,
) -> Bound:
    """Of `wanted` (p, all) combinations of all unknowns."""
    p = len(wanted)
    slope = slopes(readings, at) / noise_mg
    information = slope.T @ slope + prior
    size = np.sqrt(np.diag(information))
    open_ = np.ones(len(at), dtype=bool)
    if sees is not None:
        open_[:p] = sees
    inverse = np.zeros_like(information)
    grid = np.ix_(open_, open_)
    inverse[grid] = np.linalg.inv(information[grid] / np.outer(size, size)[grid])
    inverse[grid] /= np.outer(size, size)[grid]
    # The estimate of a nuisance is drawn to zero by its prior: its own value is an error of that.
    carried = -wanted @ inverse @ prior[:, p:]
    return Bound(wanted @ inverse @ wanted.T, wanted @ inverse @ slope.T / noise_mg, carried)


def slopes(function: Callable[[Floats], Floats], at: Floats) -> Floats:
    """∂function/∂at (m, k) by central differences; steps of 1e-5 of a value of one."""
    columns = []
    for k in range(len(at)):
        step = np.zeros(len(at))
        step[k] = _STEP * max(1.0, abs(at[k]))
        columns.append((function(at + step) - function(at - step)) / (2 * step[k]))
    return np.stack(columns, axis=1)


def shown_rad(parameters: Floats, reading_mg: Floats) -> Floats:
    """Angle θ (n,) of the stage that a goniometer with the parameters `PLANAR` shows for readings."""
    alpha, k_x, k_y, phi, b_x, b_y = parameters[:6]
    u = (reading_mg[:, 0] - b_x) / (k_x * G_MG)
    v = (reading_mg[:, 1] - b_y) / (k_y * G_MG)
    return np.asarray(alpha - np.arctan2((v - u * math.sin(phi)) / math.cos(phi), u))


def angle_bound(
    parameters: Floats,
    covariance: Floats,
    angles_rad: Floats,
    noise_mg: float,
    *,
    shown: Callable[[Floats, Floats], Floats] = shown_rad,
    model: Callable[[Floats, Floats], Floats] = planar_mg,
) -> tuple[Floats, Floats, Floats]:
    """Least variance of the shown angle in rad² at places (m,) of the turn: by parameters, by the reading.

    The third is the slope (m, p) of the shown angle by the parameters.

    Parameters
    ----------
    covariance : (p, p) float
        Bound of the parameters.
    noise_mg : float
        Noise of the fresh reading, each axis.
    """
    exact = model(parameters, -angles_rad)

    def by_parameters(values: Floats) -> Floats:
        return np.unwrap(shown(values, exact))

    slope = slopes(by_parameters, parameters)
    by_parameters_rad2 = np.einsum("mp,pq,mq->m", slope, covariance, slope)
    by_reading = np.zeros(len(angles_rad))
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = 1e-3
        change = shown(parameters, exact + step) - shown(parameters, exact - step)
        by_reading += (np.angle(np.exp(1j * change)) / 2e-3 * noise_mg) ** 2
    return np.asarray(by_parameters_rad2), by_reading, slope
