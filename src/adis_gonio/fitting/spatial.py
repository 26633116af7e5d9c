"""Maximum likelihood in space with free attitudes: biases, gains, skews.

A reading is U = b + K E u G with a free unit vector u, so only the norm of the calibrated reading carries
information. The two nuisance angles of each dwell are put at their optimum by Gauss-Newton on the sphere
and projected out: what remains of the three rows is the one along the normal, in the whitened space, of the
ellipsoid that the model draws there.

Parameters are in natural units: biases in units of local gravity, gains, skews in radians.
"""

from __future__ import annotations

import numpy as np

from adis_gonio.errors import FitError
from adis_gonio.fitting.least_squares import BLOCK, Reduced, blocks, sum_of, whitener_of
from adis_gonio.model.geometry import axes_matrix, axes_matrix_derivatives
from adis_gonio.model.records import Floats

BIAS, SCALE, SKEW = slice(0, 3), slice(3, 6), slice(6, 9)
NAMES = (
    "bias_x", "bias_y", "bias_z", "scale_x", "scale_y", "scale_z", "skew_xy", "skew_xz", "skew_yz",
)  # fmt: skip
NOMINAL = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0])

_INNER_STEPS = 60


class SpatialProblem:
    """χ² of readings in space.

    Parameters
    ----------
    readings : (n, 3) float
        Readings in units of local gravity.
    covariance : (n, 3, 3) float
        Their covariance in the same unit.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return NAMES

    def __init__(self, readings: Floats, covariance: Floats) -> None:
        self.readings = readings
        n = len(readings)
        self._parts = [
            SpatialProblem(readings[rows], covariance[rows]) for rows in (blocks(n) if n > BLOCK else [])
        ]
        self.whitener: Floats = (
            np.concatenate([part.whitener for part in self._parts])
            if self._parts
            else whitener_of(covariance)
        )

    def rows(self) -> int:
        """Rows that carry information: one a reading."""
        return len(self.readings)

    def calibrated(self, beta: Floats) -> Floats:
        """Gravity (n, 3), in its own unit, that the calibrated sensor computes from each reading."""
        return (self.readings - beta[BIAS]) @ np.linalg.inv(_mixing(beta)).T

    def attitudes(self, beta: Floats) -> Floats:
        """Unit vectors u (n, 3) that minimise χ² of each dwell."""
        if self._parts:
            return np.concatenate([part.attitudes(beta) for part in self._parts])
        mixing = _mixing(beta)
        u = self.calibrated(beta)
        u = u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-12)
        forward = self.whitener @ mixing
        right = (self.whitener @ (self.readings - beta[BIAS])[:, :, None])[:, :, 0]
        for _ in range(_INNER_STEPS):
            a, b = _tangents(u)
            first = np.einsum("nij,nj->ni", forward, a)
            second = np.einsum("nij,nj->ni", forward, b)
            residual = right - np.einsum("nij,nj->ni", forward, u)
            aa, bb = (first**2).sum(axis=1), (second**2).sum(axis=1)
            ab = (first * second).sum(axis=1)
            ra, rb = (first * residual).sum(axis=1), (second * residual).sum(axis=1)
            determinant = np.maximum(aa * bb - ab * ab, 1e-300)
            x, y = (bb * ra - ab * rb) / determinant, (aa * rb - ab * ra) / determinant
            length = np.hypot(x, y)
            limit = np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))
            u = u + (x * limit)[:, None] * a + (y * limit)[:, None] * b
            u = u / np.linalg.norm(u, axis=1, keepdims=True)
            if float(length.max()) < 1e-13:
                break
        return np.asarray(u)

    def evaluate(self, beta: Floats) -> Reduced:
        """χ² and its derivatives with the attitudes projected out (`least_squares.Problem`)."""
        if self._parts:
            return sum_of([part.evaluate(beta) for part in self._parts])
        residual, normal, _, jacobian = self._rows(beta)
        along = (normal * residual).sum(axis=1)
        return Reduced(float((residual**2).sum()), jacobian.T @ along, jacobian.T @ jacobian)

    def influence(self, beta: Floats) -> Floats:
        """Derivative (n, 3, 9) of the gradient by each reading."""
        if self._parts:
            return np.concatenate([part.influence(beta) for part in self._parts])
        _, _, row, jacobian = self._rows(beta)
        return np.asarray(row[:, :, None] * jacobian[:, None, :])

    def _rows(self, beta: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Whitened residual (n, 3), its free direction, the row of readings along it, slopes (n, 9)."""
        u = self.attitudes(beta)
        axes = axes_matrix(beta[SKEW])
        mixing = beta[SCALE, None] * axes
        residual = np.einsum("nij,nj->ni", self.whitener, self.readings - beta[BIAS] - u @ mixing.T)
        a, b = _tangents(u)
        across = np.cross(
            np.einsum("nij,nj->ni", self.whitener, a @ mixing.T),
            np.einsum("nij,nj->ni", self.whitener, b @ mixing.T),
        )
        normal = across / np.linalg.norm(across, axis=1, keepdims=True)
        # Row of the whitener along the normal: it takes any change of the reading to the one row left.
        row = np.einsum("ni,nij->nj", normal, self.whitener)
        jacobian = np.empty((len(u), 9))
        jacobian[:, BIAS] = row
        jacobian[:, SCALE] = row * (u @ axes.T)
        for k, change in enumerate(axes_matrix_derivatives(beta[SKEW])):
            jacobian[:, 6 + k] = (row * (u @ (beta[SCALE, None] * change).T)).sum(axis=1)
        return residual, normal, row, jacobian


def _mixing(beta: Floats) -> Floats:
    if not (beta[SCALE] > 0).all() or float(np.abs(beta[SKEW]).max()) > 1.2:
        raise FitError("gains must stay positive and the axes apart")
    return np.asarray(beta[SCALE, None] * axes_matrix(beta[SKEW]))


def _tangents(u: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors (n, 3) each at right angles to u and to one another."""
    helper = np.zeros_like(u)
    helper[np.arange(len(u)), np.abs(u).argmin(axis=1)] = 1.0
    a = np.cross(u, helper)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    return a, np.cross(u, a)


def conic_through(points: Floats) -> tuple[Floats, Floats]:
    """Centre (d,) and matrix (d, d) of the ellipse or ellipsoid (p − c)ᵀ Q (p − c) = 1 near the points.

    Algebraic least squares on centred and scaled points: with all quadratic terms where there are enough
    points and they give an ellipsoid, else with fewer (no mixed terms, then a sphere).

    Raises
    ------
    FitError
        If the points (n, d) lie on no ellipsoid: too few, or all in one place.
    """
    n, d = points.shape
    middle = points.mean(axis=0)
    size = float(np.abs(points - middle).max())
    if size <= 0 or n < d + 1:
        raise FitError(f"{n} positions do not show an unknown scale and zero; measure at least {2 * d + 3}")
    p = (points - middle) / size
    pairs = [(i, j) for i in range(d) for j in range(i + 1, d)]
    mixed = [2 * p[:, i] * p[:, j] for i, j in pairs]
    squares = list((p**2).T)
    linear = list((2 * p).T)
    for quadratic in (squares + mixed, squares, [np.sum(p**2, axis=1)]):
        design = np.stack(quadratic + linear, axis=1)
        if n < design.shape[1]:
            continue
        q, _, rank, _ = np.linalg.lstsq(design, np.ones(n), rcond=1e-9)
        if rank < design.shape[1]:
            continue
        terms = len(quadratic)
        matrix = np.diag(np.broadcast_to(q[: min(terms, d)], d)).copy()
        for value, (i, j) in zip(q[d:terms], pairs, strict=False):
            matrix[i, j] = matrix[j, i] = value
        if not np.all(np.linalg.eigvalsh(matrix) > 0):
            continue
        centre = -np.linalg.solve(matrix, q[terms:])
        level = 1 + centre @ matrix @ centre
        return middle + size * centre, np.asarray(matrix / (level * size**2), dtype=np.float64)
    raise FitError("the positions lie on no ellipsoid; spread them over more directions")
