"""Arrays of numbers: type, wrapped angles, derivatives, robust scatter, singular matrices."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.errors import FitError

Floats = NDArray[np.float64]
"""Array of floating-point numbers of any shape."""
Angle = TypeVar("Angle", float, Floats)


def wrap_degrees(angle_deg: Angle) -> Angle:
    """Wrap an angle in degrees, a number or an array, to [−180, 180)."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def wrap_radians(angle_rad: Angle) -> Angle:
    """Wrap an angle in radians, a number or an array, to [−π, π)."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def rotation_matrices(vector_rad: Floats) -> Floats:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad (Rodrigues' formula)."""
    x, y, z = np.moveaxis(np.asarray(vector_rad), -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    cross = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    # sin(a)/a and (1 − cos(a))/a², which exist at zero; numpy's sinc has a factor of π.
    turns = np.sqrt(x * x + y * y + z * z)[..., None, None] / np.pi
    return np.asarray(np.eye(3) + np.sinc(turns) * cross + np.sinc(turns / 2) ** 2 / 2 * (cross @ cross))


def unit_directions(across: Floats) -> Floats:
    """Return unit vectors (3, 3) as rows, row i nearest to axis i, from their components across that axis.

    The diagonal of `across` (3, 3) is not used. A row that is too long for a unit vector has the component
    0 along its axis.
    """
    off = across * (1 - np.eye(3))
    return np.asarray(off + np.diag(np.sqrt(np.maximum(1 - (off**2).sum(axis=1), 0.0))))


def mean_direction(angle_rad: Floats) -> float:
    """Return the circular mean of angles (n,) in rad: the direction of the sum of their unit vectors."""
    return float(np.angle(np.exp(1j * angle_rad).sum()))


def cumulative_integral(values: Floats, time_s: Floats) -> Floats:
    """Return the integral (n, …) of `values` (n, …) over time, from the first sample to each sample.

    It uses the trapezoidal rule at the times (n,) of the samples.
    """
    steps = np.diff(time_s).reshape(-1, *[1] * (values.ndim - 1))
    means = (values[1:] + values[:-1]) / 2
    return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(means * steps, axis=0)])


def block_means(values: Floats, starts: NDArray[np.intp]) -> Floats:
    """Return the mean (b, …) of `values` (n, …) in each of b blocks of neighbouring rows.

    `starts` (b,) is the first row of each block, increasing from 0.
    """
    counts = np.diff(np.append(starts, len(values)))
    return np.asarray((np.add.reduceat(values, starts, axis=0).T / counts).T)


def log_sum_exp(values: Floats, axis: int | tuple[int, ...] | None = None) -> Floats:
    """Return the logarithm of the sum of exponentials along `axis` (None: of all values), without overflow.

    The result has the shape of `values` without the dimensions in `axis`. Unlike `scipy.special.logsumexp`
    the function is for real finite numbers and −∞ only, and several times as fast.
    """
    top = values.max(axis=axis, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):  # the sum is zero if all values are −∞
        total = np.log(np.exp(values - top).sum(axis=axis, keepdims=True)) + top
    return np.asarray(total.reshape(()) if axis is None else total.squeeze(axis))


def central_differences(
    function: Callable[[Floats], Floats],
    at: Floats,
    step: float | Floats,
    directions: Floats | None = None,
    subtract: Callable[[Floats, Floats], Floats] = np.subtract,
) -> Floats:
    """Return the derivatives of a function f at x along k directions d: (f(x + h d) − f(x − h d)) / 2h.

    Parameters
    ----------
    at : (...,) float
        Point x at which the derivatives are computed.
    step : float or (k,) float
        Step h, of each direction if an array.
    directions : (k, ...) float, optional
        Rows d that broadcast with x; the unit vectors of an x (k,) by default.
    subtract : callable
        Function that returns the difference of two results of f; for angles a wrapped difference.

    Returns
    -------
    (..., k) float
        Derivatives: first the dimensions of the function's result, then the directions.
    """
    rows = np.eye(len(at)) if directions is None else directions
    steps = np.broadcast_to(step, len(rows))
    slopes = [
        subtract(function(at + h * row), function(at - h * row)) / (2 * h)
        for h, row in zip(steps, rows, strict=True)
    ]
    return np.stack(slopes, axis=-1) if slopes else np.zeros((*np.shape(function(at)), 0))


F = TypeVar("F", bound=Callable[..., Any])


def unsolvable(name: str, error: Exception) -> FitError:
    """Return the `FitError` to raise if a fit fails because its matrix is singular.

    `name` is the file or command that the message begins with, `error` the exception of the computation.
    """
    return FitError(
        f"{name}: no fit is possible with these numbers ({error}): check the times, the units and the"
        " stated uncertainties"
    )


def solvable(compute: F) -> F:
    """Decorate a function of a session so that it raises `FitError` instead of numpy's `LinAlgError`.

    Values that are finite one by one can still give a matrix without an inverse, such as times that differ
    by many orders of magnitude.
    """

    @wraps(compute)
    def computed(session: Any, *args: Any, **options: Any) -> Any:
        try:
            return compute(session, *args, **options)
        except np.linalg.LinAlgError as error:
            raise unsolvable(session.source or "session", error) from error

    return cast(F, computed)


MAD_TO_SD = 1.482602218505602
"""Ratio of the standard deviation of a normal distribution to its median absolute deviation."""


def robust_sd(values: Floats) -> float:
    """Return an estimate of the standard deviation of values, from their median absolute deviation.

    Outliers hardly affect it. The factor is for a normal distribution.
    """
    return float(MAD_TO_SD * np.median(np.abs(values - np.median(values))))
