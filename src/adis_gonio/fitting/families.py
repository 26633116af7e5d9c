"""Base models on the readings of a session: planar and spatial, in natural units.

`counts` have neither a known zero nor a known gain: an ellipse or ellipsoid through the readings gives
both roughly, and everything after runs on readings that are nearly in units of gravity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adis_gonio.fitting import planar, spatial
from adis_gonio.fitting.planar import PlanarProblem
from adis_gonio.fitting.readings import Readings
from adis_gonio.fitting.spatial import SpatialProblem, conic_through
from adis_gonio.model.geometry import gains_and_skews
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Floats


@dataclass(frozen=True)
class Units:
    """Where natural units lie in the readings' unit.

    Attributes
    ----------
    zero, per_g : (axes,) float
        Reading at zero gravity and its change per local gravity, both rough where the unit is counts.
    gravity_mps2 : float
        Local gravity.
    unit : str
        `mg` or `counts`.
    """

    zero: Floats
    per_g: Floats
    gravity_mps2: float
    unit: str

    @property
    def scale_unit(self) -> str:
        """Unit in which gains are reported: 1 (reading over truth) or counts/(m/s²)."""
        return "1" if self.unit == "mg" else "counts/(m/s²)"

    @property
    def scale_per_natural(self) -> Floats:
        """Reported gain (axes,) of a natural gain of 1."""
        if self.unit == "mg":
            return np.ones_like(self.per_g)
        return self.per_g / self.gravity_mps2

    def to_natural(self, readings: Readings) -> tuple[Floats, Floats]:
        """Readings and their covariance in units of local gravity."""
        return (
            (readings.mean - self.zero) / self.per_g,
            readings.covariance / (self.per_g[:, None] * self.per_g[None, :]),
        )

    def shared(self, readings: Readings) -> Floats | None:
        """What 1/f noise adds to the covariance between readings (n, n, axes), in local gravity squared."""
        if readings.shared is None:
            return None
        flicker = readings.flicker[: len(self.per_g)] / self.per_g**2
        return np.asarray(readings.shared[:, :, None] * flicker)


def _units(readings: Readings, zero: Floats, per_g: Floats) -> Units:
    return Units(zero, per_g, readings.gravity_mg * STANDARD_GRAVITY_MPS2 / 1000, readings.unit)


class PlanarFamily:
    """Planar base model (see `stochastic.Family`)."""

    def __init__(self, readings: Readings) -> None:
        self.readings = readings
        self.gravity_mg = readings.gravity_mg
        if readings.unit == "counts":
            centre, matrix = conic_through(readings.mean)
            gains = np.sqrt(np.diag(np.linalg.inv(matrix)))
            self.units = _units(readings, centre, gains)
            # A zero in counts has no nominal value that it could be held at.
            self.may_hold: tuple[tuple[int, ...], ...] = ()
        else:
            self.units = _units(readings, np.zeros(2), np.full(2, readings.gravity_mg))
            self.may_hold = ((planar.BIAS_X, planar.BIAS_Y),)
        self.natural, self.natural_covariance = self.units.to_natural(readings)
        sigma = readings.fixture_sigma_rad
        assumed = 0.0 if sigma is None else sigma
        self.start = planar.start_of(self.natural, readings.angle_rad, assumed)
        probe = self.problem(self.natural_covariance, assumed)
        self._rows = probe.rows()
        self.free: NDArray[np.bool_] = np.ones(6, dtype=np.bool_)
        self.free[planar.ALPHA] = probe.determines_alpha

    def problem(self, covariance: Floats, sigma_rad: float) -> PlanarProblem:
        """Problem under a covariance of the readings (natural units) and a fixture uncertainty."""
        return PlanarProblem(self.natural, covariance, self.readings.angle_rad, sigma_rad)

    def natural_shared(self) -> Floats | None:
        """See `Units.shared`."""
        return self.units.shared(self.readings)

    def rows(self) -> int:
        """Rows that carry information."""
        return self._rows


class SpatialFamily:
    """Spatial base model with free attitudes (see `stochastic.Family`)."""

    def __init__(self, readings: Readings) -> None:
        self.readings = readings
        self.gravity_mg = readings.gravity_mg
        self.start = spatial.NOMINAL.copy()
        if readings.unit == "counts":
            centre, matrix = conic_through(readings.mean)
            gains, skews = gains_and_skews(np.asarray(np.linalg.inv(matrix), dtype=np.float64))
            self.units = _units(readings, centre, gains)
            self.start[spatial.SKEW] = skews
        else:
            self.units = _units(readings, np.zeros(3), np.full(3, readings.gravity_mg))
        self.may_hold: tuple[tuple[int, ...], ...] = ((6, 7, 8),)
        self.natural, self.natural_covariance = self.units.to_natural(readings)
        self.free: NDArray[np.bool_] = np.ones(9, dtype=np.bool_)

    def problem(self, covariance: Floats, sigma_rad: float) -> SpatialProblem:
        """Problem under a covariance of the readings; attitudes are free whatever σ_f is."""
        return SpatialProblem(self.natural, covariance)

    def natural_shared(self) -> Floats | None:
        """See `Units.shared`."""
        return self.units.shared(self.readings)

    def rows(self) -> int:
        """Rows that carry information."""
        return len(self.natural)
