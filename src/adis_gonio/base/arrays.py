"""Arrays of numbers: type, wrapped angles, derivatives by differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""Array of floating-point numbers of any shape."""
Angle = TypeVar("Angle", float, Floats)


def wrap_degrees(angle_deg: Angle) -> Angle:
    """Wrap an angle in degrees, a number or an array, to [−180, 180)."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def wrap_radians(angle_rad: Angle) -> Angle:
    """Wrap an angle in radians, a number or an array, to [−π, π)."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def mean_direction(angle_rad: Floats) -> float:
    """Angle in radians of the sum of unit vectors at the angles (n,)."""
    return float(np.angle(np.exp(1j * angle_rad).sum()))


def central_differences(
    function: Callable[[Floats], Floats],
    at: Floats,
    step: float | Floats,
    directions: Floats | None = None,
    subtract: Callable[[Floats, Floats], Floats] = np.subtract,
) -> Floats:
    """Derivatives of a function along k directions: (f(x + h d) − f(x − h d)) / 2h.

    Parameters
    ----------
    at : (...,) float
        Place x.
    step : float or (k,) float
        Step h, of each direction if an array.
    directions : (k, ...) float, optional
        Rows d that broadcast with x; the unit vectors of an x (k,) by default.
    subtract : callable
        Difference of two results, such as of angles within a turn.

    Returns
    -------
    (..., k) float
        Shape of the function's result, then the directions.
    """
    rows = np.eye(len(at)) if directions is None else directions
    steps = np.broadcast_to(step, len(rows))
    slopes = [
        subtract(function(at + h * row), function(at - h * row)) / (2 * h)
        for h, row in zip(steps, rows, strict=True)
    ]
    return np.stack(slopes, axis=-1) if slopes else np.zeros((*np.shape(function(at)), 0))
