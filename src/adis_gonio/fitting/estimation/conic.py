"""Ellipse or ellipsoid through points: scale and zero of readings whose unit is not known."""

from __future__ import annotations

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError
from adis_gonio.base.numbers import counted


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
        raise FitError(
            f"{counted(n, 'position')} cannot show an unknown scale and zero; measure at least {2 * d + 3}"
        )
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
