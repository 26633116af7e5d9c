"""What surrounded the dwells of a session, and the geometry of a turn and of poses."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

Floats = np.ndarray[Any, np.dtype[np.float64]]

STANDARD_MPS2 = 9.80665


@dataclass
class Circumstances:
    """One row a dwell.

    Attributes
    ----------
    plane : bool
        A turn in the xy plane at declared angles; else poses in space with free attitudes.
    time_s : (n,) float
        Middle of each dwell, from the session's first dwell on.
    angle_rad : (n,) float
        Declared angle θ; zeros in space.
    temp_c, supply_v : (n,) float
        NaN where not recorded.
    approach : (n,) float
        +1 or −1, direction from which the dwell was reached; zeros where not recorded.
    variance_mg2 : (n, axes) float
        Variance of the vibration within a dwell beyond the sensor's own noise.
    check : (n,) bool
        Dwells that take no part in a fit.
    direction : (n, 3) float
        Declared attitude of a pose, from which moves are reckoned; unused in the plane.
    """

    plane: bool
    time_s: Floats
    angle_rad: Floats
    temp_c: Floats
    supply_v: Floats
    approach: Floats
    variance_mg2: Floats
    check: np.ndarray[Any, np.dtype[np.bool_]]
    direction: Floats = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def n(self) -> int:
        """Number of dwells."""
        return len(self.time_s)

    @property
    def axes(self) -> int:
        """Number of axes: 2 in the plane, 3 in space."""
        return 2 if self.plane else 3

    @property
    def order(self) -> Floats:
        """Number of each dwell from −1 (first) to +1 (last)."""
        return np.linspace(-1.0, 1.0, self.n)

    @property
    def move_rad(self) -> Floats:
        """Angle of the move into each dwell (signed in the plane); the first one is 0."""
        if self.plane:
            return np.diff(self.angle_rad, prepend=self.angle_rad[0])
        cosine = np.sum(self.direction[1:] * self.direction[:-1], axis=1)
        return np.concatenate([[0.0], np.arccos(np.clip(cosine, -1, 1))])

    @property
    def pause_s(self) -> Floats:
        """Time from the middle of the dwell before; of the first dwell the mean of the others."""
        steps = np.diff(self.time_s)
        return np.concatenate([[steps.mean()], steps])

    @property
    def minutes(self) -> Floats:
        """Time in minutes."""
        return self.time_s / 60.0


def lagged(time_s: Floats, x: Floats, tau_s: float) -> Floats:
    """First-order lag of x (linear between the dwells), at rest in the first one; y shaped like x."""
    y = np.array(x, dtype=float)
    for k in range(1, len(time_s)):
        h = time_s[k] - time_s[k - 1]
        slope = (x[k] - x[k - 1]) / h
        keep = np.exp(-h / tau_s)
        lag = keep * (x[k - 1] - y[k - 1]) + slope * tau_s * (1 - keep)
        y[k] = x[k] - lag
    return y


def ideal_plane(psi_rad: Floats, delta_phi_rad: float) -> Floats:
    """Projections of 1 g on x and y, (n, 2): cos ψ, sin(ψ + Δφ)."""
    return np.column_stack([np.cos(psi_rad), np.sin(psi_rad + delta_phi_rad)])


def tangent_plane(psi_rad: Floats, delta_phi_rad: float) -> Floats:
    """Derivative of the projections by ψ, (n, 2), in g/rad."""
    return np.column_stack([-np.sin(psi_rad), np.cos(psi_rad + delta_phi_rad)])
