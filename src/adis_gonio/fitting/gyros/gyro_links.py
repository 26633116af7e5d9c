"""What is known of three gyros before a session's links are looked at: a data sheet, or a calibration.

Rotations of the part between two poses by its gyros, with all that is uncertain about them.

The zero rate over a turn is the mean of the two dwells beside it, and what force adds follows the
accelerometers as the part is turned. The uncertainty of the rotation has

* white noise of the samples and of both dwells' means, and what bridges over lost scans leave;
* 1/f noise: how far the zero rate over the turn is from that mean, by the three intervals' covariance;
* the turning of the earth, whose share in the zero rate changes with the attitude;
* what all links have in common: gains and directions of the gyros (`gyros.prior`), g-sensitivity as the
  dwells of the session leave it, asymmetry of the gains.

Neighbouring links share the dwell between them. What is farther apart is taken as independent: a zero rate
less the mean of its neighbours is a difference in which slow noise cancels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences
from adis_gonio.base.errors import DataError
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.estimation.links import Links
from adis_gonio.fitting.estimation.spectrum import covariance_of_means
from adis_gonio.fitting.gyros.gyro_readings import GyroDwells, gyro_dwells_of, path_between
from adis_gonio.fitting.gyros.turn_integration import (
    PARAMETERS,
    AssumedGyros,
    Attitude,
    Integral,
    Path,
    Sampling,
    attitude,
    integrate,
    smooth,
)
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.records import Session, Turn

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration

SHEET_GAIN = 0.02
"""Limit of a gain's error (CHIP: sensitivity ±2 %)."""
SHEET_FRAME_DEG = 0.5
"""Limit of the angle between a triad and the package (CHIP), of the gyros' and of the accelerometers'."""
SHEET_ASYMMETRY = 0.002
"""Limit of what a gain depends on the sign of the rate by (CHIP: nonlinearity ±0.2 % of full scale)."""
UNKNOWN_GAIN, UNKNOWN_MISALIGNMENT_DEG, UNKNOWN_G_DPS = 0.05, 2.0, 0.1
"""Standard uncertainties of gyros without a data sheet: estimates (D)."""
_STEP = 1e-6


@dataclass(frozen=True)
class GyroPrior:
    """Parameters of three gyros in the order of `attitude.PARAMETERS`, with their covariance."""

    values: Floats
    covariance: Floats

    @cached_property
    def root(self) -> Floats:
        """Root (21, q) of the covariance."""
        size, axes = np.linalg.eigh(self.covariance)
        kept = size > 1e-12 * max(float(size[-1]), 1e-300)
        return np.asarray(axes[:, kept] * np.sqrt(size[kept]))

    @classmethod
    def of_sheet(cls, sensor: str) -> GyroPrior:
        """Perfect gyros, as uncertain as their data sheet leaves them: rectangles within its limits.

        Gains and misalignments of each gyro, and a rotation of the whole triad against the
        accelerometers', whose own place in the package is as uncertain.
        """
        values = np.concatenate([np.eye(3).ravel(), np.zeros(PARAMETERS - 9)])
        figures = VARIANTS[sensor].performance if sensor in VARIANTS else None
        gain, misalignment, turned = (
            UNKNOWN_GAIN,
            math.radians(UNKNOWN_MISALIGNMENT_DEG),
            math.radians(UNKNOWN_MISALIGNMENT_DEG),
        )
        per_g = UNKNOWN_G_DPS
        if figures is not None:
            gain = SHEET_GAIN / math.sqrt(3)
            misalignment = figures.skew_u_rad
            turned = math.radians(SHEET_FRAME_DEG) * math.sqrt(2 / 3)
            per_g = figures.gyro_g_sensitivity_dps_per_g
        own = np.where(np.eye(3, dtype=bool), gain, misalignment).ravel() ** 2
        own = np.concatenate([own, np.full(9, per_g**2), np.full(3, SHEET_ASYMMETRY**2 / 3)])
        covariance = np.diag(own)
        for i, j in ((0, 1), (0, 2), (1, 2)):
            apart = np.zeros(PARAMETERS)
            apart[3 * i + j], apart[3 * j + i] = turned, -turned
            covariance += np.outer(apart, apart)
        return cls(values, covariance)

    def calibrated(self, gyros: GyroCalibration) -> GyroPrior:
        """The same where a calibration knows better; what it does not determine stays."""
        values, covariance = self.values.copy(), self.covariance.copy()
        known = _known(gyros)
        matrix = np.zeros((len(gyros.parameters),) * 2) if gyros.covariance is None else gyros.covariance
        begin = gyros.values
        slope = central_differences(lambda values: _stated(gyros, values), begin, _STEP)
        values[known] = _stated(gyros, begin)[known]
        # What both say of is said by the calibration alone.
        covariance[known, :] = covariance[:, known] = 0.0
        covariance[np.ix_(known, known)] = (slope @ matrix @ slope.T)[np.ix_(known, known)]
        return GyroPrior(values, covariance)

    def with_g_sensitivity(self, gram: Floats, product: Floats, variance: Floats) -> GyroPrior:
        """The same with what zero rates of dwells say of the g-sensitivity, gyro by gyro.

        Parameters
        ----------
        gram, product : (3, 3) float
            Forces times forces, and times rates (a column a gyro), less their means.
        variance : (3,) float
            Of a zero rate, by gyro.
        """
        values, covariance = self.values.copy(), self.covariance.copy()
        for gyro in range(3):
            rows = slice(9 + 3 * gyro, 12 + 3 * gyro)
            prior = covariance[rows, rows]
            # Posterior of a linear model: (P⁻¹ + G/σ²)⁻¹, without the inverse of a P that may be singular.
            after = np.linalg.solve(np.eye(3) + prior @ gram / variance[gyro], prior)
            values[rows] = values[rows] + after @ (product[:, gyro] - gram @ values[rows]) / variance[gyro]
            covariance[rows, rows] = (after + after.T) / 2
        return replace(self, values=values, covariance=covariance)


def _stated(gyros: GyroCalibration, values: Floats) -> Floats:
    """Parameters (21,) by the values of a calibration."""
    held = dict(zip((one.name for one in gyros.parameters), values.tolist(), strict=True))
    misalignment = np.array([[held.get(f"gyro_misalignment_{i}{j}", 0.0) for j in AXES] for i in AXES])
    sines = np.sin(np.radians(misalignment)) * (1 - np.eye(3))
    gains = np.array([held.get(f"gyro_scale_{i}", 1.0) for i in AXES])
    rows = gains[:, None] * (sines + np.diag(np.sqrt(1 - (sines**2).sum(axis=1))))
    per_g = np.array([[held.get(f"g_sensitivity_{i}{j}", 0.0) for j in AXES] for i in AXES])
    return np.concatenate([rows.ravel(), per_g.ravel(), np.zeros(3)])


def _known(gyros: GyroCalibration) -> list[int]:
    """Places among the parameters of what the calibration determines."""
    found = []
    for i, gyro in enumerate(AXES):
        for j, axis in enumerate(AXES):
            name = f"gyro_scale_{gyro}" if i == j else f"gyro_misalignment_{gyro}{axis}"
            if name in gyros:
                found.append(3 * i + j)
            if f"g_sensitivity_{gyro}{axis}" in gyros:
                found.append(9 + 3 * i + j)
    return sorted(found)


EARTH_DPS = 360.0 / 86164.0
"""Rate of the earth."""
_CONTRAST = np.array([-0.5, 1.0, -0.5])
"""Of dwell, turn, dwell: zero rate over the turn less what is taken for it."""


@dataclass(frozen=True)
class Leg:
    """A turn between two dwells as its samples.

    Attributes
    ----------
    positions : (int, int)
        Numbers of the dwells.
    time_s, rate_dps, force_g, size_dps : (n,), (n, 3) float
        Samples: rates less the mean zero rate of both dwells, force less its mean in both, |rate| without
        the samples' noise.
    zero_dps2 : (3,) float
        Variance of the zero rate that was taken off.
    missing_rad2 : float
        Variance of what lost scans leave, each axis.
    spans_s : (3, 2) float
        Begin and end of the dwell before, the turn and the dwell after.
    shared_dps2 : (3,) float
        Variance of the mean of the dwell after.
    """

    positions: tuple[int, int]
    time_s: Floats
    rate_dps: Floats
    force_g: Floats
    size_dps: Floats
    zero_dps2: Floats
    missing_rad2: float
    spans_s: Floats
    shared_dps2: Floats

    @property
    def length_s(self) -> float:
        """Of the turn."""
        return float(self.time_s[-1] - self.time_s[0])


@dataclass(frozen=True)
class GyroLinks:
    """All links of a session, before anything is known of its gyros but the prior.

    Attributes
    ----------
    legs : tuple of Leg
        In the order of time.
    prior : GyroPrior
    noise_dps2 : (3, 3) float
        Of a sample, by its density at frequency zero.
    allan_dps2 : (3,) float
        Allan variance of the 1/f noise.
    refused : tuple of (int, int, str)
        Turns that give no link: the two dwells and the reason.
    """

    legs: tuple[Leg, ...]
    prior: GyroPrior
    noise_dps2: Floats
    allan_dps2: Floats
    refused: tuple[tuple[int, int, str], ...] = ()

    def integrated(self, values: Floats) -> tuple[Attitude, ...]:
        """Rotation of each leg with the gyros at some parameters (21,)."""
        gyros = AssumedGyros.of(values)
        return tuple(
            attitude(leg.time_s, leg.rate_dps, leg.force_g, gyros, self.noise_dps2, leg.size_dps)
            for leg in self.legs
        )

    @cached_property
    def _wander(self) -> tuple[Floats, Floats]:
        """1/f noise of an Allan variance of 1: variance (m,) of each leg, covariance (m,) with the next."""
        own, following = np.zeros(len(self.legs)), np.zeros(len(self.legs))
        for k, leg in enumerate(self.legs):
            covariance = covariance_of_means(*leg.spans_s.T)
            own[k] = _CONTRAST @ covariance @ _CONTRAST
            if k + 1 < len(self.legs) and self.legs[k + 1].positions[0] == leg.positions[1]:
                spans = np.concatenate([leg.spans_s, self.legs[k + 1].spans_s[1:]])
                covariance = covariance_of_means(*spans.T)
                following[k] = np.append(_CONTRAST, [0, 0]) @ covariance @ np.append([0, 0], _CONTRAST)
        return own, following

    def at(self, values: Floats, position: Sequence[int]) -> Links:
        """Links between readings, linearised at parameters (21,) of the gyros.

        Parameters
        ----------
        position : (n,) int
            Numbers of the dwells that the readings are of; legs of others are left out.
        """
        place = {int(number): row for row, number in enumerate(position)}
        used = [k for k, leg in enumerate(self.legs) if all(p in place for p in leg.positions)]
        turned = self.integrated(values)
        own_wander, next_wander = self._wander
        m = len(used)
        own, following = np.zeros((m, 3, 3)), np.zeros((m, 3, 3))
        for row, k in enumerate(used):
            leg, found = self.legs[k], turned[k]
            zero = np.diag(leg.zero_dps2 + self.allan_dps2 * own_wander[k])
            own[row] = found.by_zero @ zero @ found.by_zero.T + found.noise_rad2
            earth = (math.radians(EARTH_DPS) * leg.length_s) ** 2 / 3
            own[row] += (leg.missing_rad2 + earth) * np.eye(3)
            if row + 1 < m and self.legs[used[row + 1]].positions[0] == leg.positions[1]:
                shared = np.diag(leg.shared_dps2 / 4 + self.allan_dps2 * next_wander[k])
                following[row] = found.by_zero @ shared @ turned[used[row + 1]].by_zero.T
        slopes = np.array([turned[k].by_parameter for k in used]).reshape(m, 3, len(values))
        return Links(
            before=np.array([place[self.legs[k].positions[0]] for k in used], dtype=np.intp),
            after=np.array([place[self.legs[k].positions[1]] for k in used], dtype=np.intp),
            rotation=np.array([turned[k].rotation for k in used]).reshape(m, 3, 3),
            offset_rad=slopes @ (self.prior.values - values),
            own_rad2=own,
            next_rad2=following,
            modes_rad=slopes @ self.prior.root,
        )


def gyro_links(session: Session, prior: GyroPrior | None = None) -> GyroLinks | None:
    """Links of a session between whose poses the part was turned; None where nothing was recorded there.

    Parameters
    ----------
    prior : GyroPrior, optional
        What is known of the gyros; by default what their data sheet says.
    """
    if session.gyro_unit == "counts" or not any(dwell.gyro is not None for dwell in session.dwells):
        return None
    turns = [turn for turn in session.turns if turn.gyro is not None and len(turn)]
    if not turns:
        return None
    try:
        rests = gyro_dwells_of(session)
    except DataError:
        return None
    legs: list[Leg] = []
    refused: list[tuple[int, int, str]] = []
    for turn in turns:
        leg = _leg(session, turn, rests)
        if isinstance(leg, Leg):
            legs.append(leg)
        else:
            refused.append((turn.before, turn.position, leg))
    if not legs and all(_nothing_there(reason) for *_, reason in refused):
        return None
    known = GyroPrior.of_sheet(session.sensor) if prior is None else prior
    return GyroLinks(
        tuple(legs),
        _by_dwells(known, rests),
        rests.sampling.density_dps2,
        rests.allan_dps2,
        tuple(refused),
    )


def _nothing_there(reason: str) -> bool:
    """True where a turn was not recorded, so that there is nothing to tell of it."""
    return any(word in reason for word in ("recorded", "recording", "no samples", "not turned"))


def _leg(session: Session, turn: Turn, rests: GyroDwells) -> Leg | str:
    """Samples of a turn from rest to rest, or why it gives no link."""
    before, after = (rests.by_position.get(position) for position in (turn.before, turn.position))
    if before is None or after is None:
        return "one of its dwells has no gyros"
    path = path_between(session, turn, rests.dwells[before], rests.dwells[after], rests.scale)
    if path is None:
        return "nothing was recorded between the dwells"
    integral = integrate(path, rests.sampling)
    if isinstance(integral, str):
        return integral
    return _cut(path, integral, rests, (before, after), (turn.before, turn.position))


def _cut(
    path: Path, integral: Integral, rests: GyroDwells, ends: tuple[int, int], positions: tuple[int, int]
) -> Leg:
    sampling: Sampling = rests.sampling
    delay = sampling.delay_s
    rows = slice(
        int(np.searchsorted(path.time_s, integral.begin_s + delay)),
        int(np.searchsorted(path.time_s, integral.end_s + delay, side="right")),
    )
    time = path.time_s[rows]
    rate = path.rate_dps[rows] - path.zero_dps.mean(axis=0)
    force = path.force_g[rows] - path.rest_g.mean(axis=0)
    noise = sampling.density_dps2 * (len(time) - 1) * sampling.period_s**2
    missing = max(float(np.trace(integral.covariance_deg2 - noise)), 0.0)
    spans = np.array([rests.spans_s[ends[0]], (integral.begin_s, integral.end_s), rests.spans_s[ends[1]]])
    return Leg(
        positions,
        time,
        rate,
        np.where(np.isfinite(force), force, 0.0),
        np.abs(smooth(rate, sampling.window)),
        (rests.variance_dps2[ends[0]] + rests.variance_dps2[ends[1]]) / 4,
        math.radians(1.0) ** 2 * missing,
        spans,
        rests.variance_dps2[ends[1]],
    )


def _by_dwells(prior: GyroPrior, rests: GyroDwells) -> GyroPrior:
    """The prior with what the zero rates of the dwells say of the g-sensitivity."""
    if len(rests.dwells) < 2 or not np.isfinite(rests.force_g).all():
        return prior
    away = rests.force_g - rests.force_g.mean(axis=0)
    left = rests.mean_dps - rests.mean_dps.mean(axis=0)
    least = np.linalg.lstsq(away, left, rcond=1e-6)[0]
    scatter = ((left - away @ least) ** 2).sum(axis=0) / max(len(away) - 4, 1)
    # The zero rate wanders from dwell to dwell; few dwells do not show by how much.
    variance = np.maximum(scatter, rests.variance_dps2.mean(axis=0) + 2 * rests.allan_dps2)
    return prior.with_g_sensitivity(away.T @ away, away.T @ left, variance)
