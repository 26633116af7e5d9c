"""Links: turns between poses that the gyros measured, tested against gravity and added to a fit.

The zero rate of a gyro during a turn is taken as its mean rate in the two adjacent dwells, plus its
g-sensitivity times the change of the accelerometers' readings during the turn. The uncertainty of the
rotation has these parts:

* white noise of the samples and of the means of both dwells, and the error of bridges over lost scans;
* motion that is faster than the samples show (`turn_integration.Aliasing`), such as a knock;
* 1/f noise: the difference between the zero rate during the turn and its mean in both dwells;
* the rotation of the earth: its share in the zero rate changes with the attitude;
* errors that all links share: gains and directions of the gyros (`GyroPrior`), their g-sensitivity with its
  uncertainty after the dwells of the session, and the change of a gain with the sign of the rate.

Two neighbouring links share the dwell between them. Links that are farther apart count as independent,
because slow noise cancels in the zero rate minus the mean of its neighbours.

The rotation over a turn (`Leg.attitude`) needs the attitude at each sample. A direction u fixed in space
moves backwards in the part: u̇ = −ω × u. The rate between two samples is taken as their mean, and the
rotation by this rate is exact, so u(t₁) = Φ(t₁, t₀) u(t₀), where Φ is a product of rotations. A small error
δω of the rates turns the result by ε, u(t₁) → u(t₁) + ε × u(t₁), with

    ε = −∫ Φ(t₁, t) δω(t) dt.

This is linear in all parameters of the gyros: readings m, zero rate z, gains and directions A and
asymmetry a give ω = A⁻¹ (m − z − a |m − z|), hence ε = ∫ Φ(t₁, t) A⁻¹ (δA ω + δz + δa |m − z|) dt.

Links and the length of gravity determine the parameters together. Links that disagree with gravity raise χ²
of the fit; the rise is tested with the degrees of freedom that the links add. If it is above the 99.9 %
quantile, the link that disagrees most is removed and the test is repeated. If more than a quarter of the
links would be removed, or no link remains, no link is used and the fit uses gravity alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, central_differences, rotation_matrices
from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.base.uncertainty import LINK_REFUSED
from adis_gonio.calibrate.gyro_calibration import GyroCalibration, sensitivity_of
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.fitting import determination
from adis_gonio.fitting.determination import chi2_quantile, settle
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.links import Links
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.fitting.estimation.spectrum import covariance_of_means
from adis_gonio.fitting.gyros import turn_integration
from adis_gonio.fitting.gyros.gyro_readings import GyroDwells, gyro_dwells_of, measured_turn
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.records import Session, Turn

SHEET_GAIN = 0.02
"""Largest relative error of a gyro's scale factor (ADIS16350 data sheet: sensitivity ±2 %)."""
SHEET_FRAME_DEG = 0.5
"""Largest angle in degrees between a triad and the package, for gyros and accelerometers (ADIS16350 data
sheet)."""
SHEET_ASYMMETRY = 0.002
"""Largest relative change of a gyro's gain with the sign of the rate (ADIS16350 data sheet: nonlinearity
±0.2 % of full scale)."""
UNKNOWN_GAIN, UNKNOWN_MISALIGNMENT_DEG, UNKNOWN_G_DPS = 0.05, 2.0, 0.1
"""Standard uncertainties of gain, misalignment and g-sensitivity (°/s/g) of gyros without a data sheet:
estimates (D)."""
PARAMETERS = 21
"""Number of parameters of three gyros: gains and directions A (9, row by row), g-sensitivity (9, row by
row) in °/s/g, asymmetry of the gains (3)."""
_LEAST_DRIFTING = 7
"""Fewest dwells for a drift: zero rate, drift and three g-sensitivities leave two degrees of freedom."""
_NAMES = (
    *(f"gyro_scale_{i}" if i == j else f"gyro_misalignment_{i}{j}" for i in AXES for j in AXES),
    *(f"g_sensitivity_{i}{j}" for i in AXES for j in AXES),
)
"""Names of the first 18 of the 21 gyro parameters, as a calibration has them."""


@dataclass(frozen=True)
class GyroPrior:
    """Prior of the parameters of three gyros, from a data sheet or a calibration.

    The 21 parameters are the matrix of gains and directions (9), the g-sensitivity (9) and the asymmetry of
    the gains (3), which is their relative change with the sign of the rate.

    Attributes
    ----------
    values : (21,) float
        Prior mean of the parameters.
    covariance : (21, 21) float
        Prior covariance of the parameters.
    """

    values: Floats
    covariance: Floats

    @cached_property
    def root(self) -> Floats:
        """Square root (21, q) of the prior covariance: root times its transpose is the covariance."""
        size, axes = np.linalg.eigh(self.covariance)
        kept = size > 1e-12 * max(float(size[-1]), 1e-300)
        return np.asarray(axes[:, kept] * np.sqrt(size[kept]))

    @classmethod
    def of_sheet(cls, sensor: str) -> GyroPrior:
        """Make the prior of perfect gyros, with rectangular distributions within data-sheet limits.

        Gains and misalignments of each gyro are independent. In addition the triad of the gyros is rotated
        as a whole against the triad of the accelerometers, because the direction of each triad in the
        package is uncertain by the same limit.
        """
        values = np.concatenate([np.eye(3).ravel(), np.zeros(PARAMETERS - 9)])
        gain, per_g = UNKNOWN_GAIN, UNKNOWN_G_DPS
        misalignment = turned = math.radians(UNKNOWN_MISALIGNMENT_DEG)
        if sensor in VARIANTS:
            figures = VARIANTS[sensor].performance
            gain = SHEET_GAIN / math.sqrt(3)
            misalignment = figures.skew_u_rad
            turned = math.radians(SHEET_FRAME_DEG) * math.sqrt(2 / 3)
            per_g = figures.gyro_g_sensitivity_dps_per_g
        own = np.where(np.eye(3, dtype=bool), gain, misalignment).ravel() ** 2
        covariance = np.diag(
            np.concatenate([own, np.full(9, per_g**2), np.full(3, SHEET_ASYMMETRY**2 / 3)])
        )
        for i, j in ((0, 1), (0, 2), (1, 2)):
            # A small rotation in the plane of axes i and j changes two elements of A by ± its angle.
            apart = np.zeros(PARAMETERS)
            apart[3 * i + j], apart[3 * j + i] = turned, -turned
            covariance += np.outer(apart, apart)
        return cls(values, covariance)

    def calibrated(self, gyros: GyroCalibration) -> GyroPrior:
        """Return a copy in which parameters that a calibration of the gyros determines have its values."""
        values, covariance = self.values.copy(), self.covariance.copy()
        names = np.array(_NAMES)
        known = np.flatnonzero([name in gyros for name in names])
        matrix = np.zeros((len(gyros.parameters),) * 2) if gyros.covariance is None else gyros.covariance
        begin = gyros.values
        slope = central_differences(lambda values: _parameters(gyros, values), begin, 1e-6)
        values[known] = _parameters(gyros, begin)[known]
        # The calibration replaces the prior of these parameters and their correlation with the others.
        covariance[known, :] = covariance[:, known] = 0.0
        covariance[np.ix_(known, known)] = (slope @ matrix @ slope.T)[np.ix_(known, known)]
        return GyroPrior(values, covariance)


def _parameters(gyros: GyroCalibration, values: Floats) -> Floats:
    """Convert values of a calibration's parameters to the 21 gyro parameters of the prior.

    Parameters that the calibration lacks get the values of perfect gyros.
    """
    held = gyros.by_kind(values)
    return np.concatenate([sensitivity_of(held).ravel(), held["g_sensitivity"].ravel(), np.zeros(3)])


EARTH_DPS = 360.0 / 86164.0
"""Rate of rotation of the earth in °/s."""
_CONTRAST = np.array([-0.5, 1.0, -0.5])
"""Weights of dwell, turn and dwell whose sum is the zero rate over the turn minus its estimate by the two
dwells."""
_FIRST, _NEXT = np.append(_CONTRAST, [0.0, 0.0]), np.append([0.0, 0.0], _CONTRAST)
"""These weights for two neighbouring turns, of the five intervals that share the dwell between them."""


@dataclass(frozen=True)
class Attitude:
    """Rotation of the sensor over a turn, with its derivatives by the gyro parameters.

    Attributes
    ----------
    rotation : (3, 3) float
        Φ: converts components of a direction in the sensor before the turn to components after it.
    by_parameter : (3, 21) float
        Derivative of the rotation error ε by A, g-sensitivity and asymmetry, in rad, rad/(°/s/g) and rad.
    by_zero : (3, 3) float
        Derivative of the rotation error ε by the zero rates, in rad/(°/s).
    noise_rad2 : (3, 3) float
        Covariance of ε from the white noise of the rates.
    """

    rotation: Floats
    by_parameter: Floats
    by_zero: Floats
    noise_rad2: Floats


@dataclass(frozen=True)
class Leg:
    """Samples of a turn between two dwells.

    Attributes
    ----------
    positions : (int, int)
        Numbers of the dwells before and after the turn.
    time_s, rate_dps, force_g, size_dps : (n,), then (n, 3) float
        Samples of the turn: times; rates minus the mean rate in both dwells; force minus its mean in both
        dwells; and absolute rates with reduced noise (of means over short blocks of samples).
    zero_dps2 : (3,) float
        Variance of the zero rate that was subtracted.
    missing_rad2 : (3, 3) float
        Covariance of the rotation by lost samples, by fast motion that they miss and by the earth's turn.
    spans_s : (3, 2) float
        Begin and end of the dwell before, the turn and the dwell after.
    shared_dps2 : (3,) float
        Variance of the mean rate in the dwell after, which the next turn shares.
    """

    positions: tuple[int, int]
    time_s: Floats
    rate_dps: Floats
    force_g: Floats
    size_dps: Floats
    zero_dps2: Floats
    missing_rad2: Floats
    spans_s: Floats
    shared_dps2: Floats

    def attitude(self, values: Floats, noise_dps2: Floats) -> Attitude:
        """Integrate the rates to the rotation over the turn, and to the effect of gyro errors on it.

        Parameters
        ----------
        values : (21,) float
            Assumed parameters of the gyros: the matrix A of scale factors times unit vectors along the
            sensitive axes (one row for each gyro) and the g-sensitivity in °/s/g, both row by row; then the
            asymmetry, the relative error of the scale factor that multiplies |rate|.
        noise_dps2 : (3, 3) float
            Covariance of the noise of one sample, by the spectral density at frequency zero.
        """
        inverse = np.linalg.inv(values[:9].reshape(3, 3))
        free = self.rate_dps - self.force_g @ values[9:18].reshape(3, 3).T
        # True rate by the assumed gyros, then Φ(t₁, t) from each sample to the end.
        omega = np.radians(free - values[18:] * self.size_dps) @ inverse.T
        to_end = _to_end((omega[1:] + omega[:-1]) / 2 * np.diff(self.time_s)[:, None])
        weighted = turn_integration.trapezoid_weights(self.time_s)[:, None, None] * (to_end @ inverse)
        rad = math.pi / 180
        # ∂ε/∂A[i, j] = ∫ (Φ A⁻¹)[:, i] ω[j] dt: one matrix product over samples for all nine, row by row.
        flat = weighted.reshape(-1, 9).T
        by_parameter = np.concatenate(
            [
                (flat @ omega).reshape(3, 9),
                rad * (flat @ self.force_g).reshape(3, 9),
                rad * (weighted * self.size_dps[:, None, :]).sum(axis=0),
            ],
            axis=1,
        )
        # Sum over samples of W Σ Wᵀ with W = Φ A⁻¹ dt.
        by_row = weighted.transpose(1, 0, 2)
        noise = rad**2 * (by_row @ noise_dps2).reshape(3, -1) @ by_row.reshape(3, -1).T
        return Attitude(to_end[0], by_parameter, rad * weighted.sum(axis=0), noise)


def _rates_at_end(time_s: Floats, rate_dps: Floats) -> Floats:
    """Convert the rates (n, 3) of a turn to components along the directions of the axes at its end.

    The rotation until the end is computed as if the gyros were perfect.
    """
    mean = np.radians(rate_dps[1:] + rate_dps[:-1]) / 2
    return np.asarray((_to_end(mean * np.diff(time_s)[:, None]) @ rate_dps[:, :, None])[:, :, 0])


def _to_end(steps_rad: Floats) -> Floats:
    """Return the rotation Φ(t₁, t) (n + 1, 3, 3) from the time of each sample to the end of the turn.

    The argument has the angles (n, 3) turned between samples.
    """
    turns = rotation_matrices(-steps_rad)
    # The last step acts last: Φ of a sample is the product of all later steps, the latest on the left.
    return np.array([*accumulate([np.eye(3), *turns[::-1]], np.matmul)])[::-1]


@dataclass(frozen=True)
class GyroLinks:
    """All turns of a session as links, before the parameters of its gyros are fitted.

    Attributes
    ----------
    legs : tuple of Leg
        Samples of each turn that gives a link, in the order of time.
    prior : GyroPrior
        Prior of the gyros' parameters.
    noise_dps2 : (3, 3) float
        Covariance of a sample's noise, by its spectral density at frequency zero.
    allan_dps2 : (3,) float
        Allan variance of the gyros' 1/f noise.
    refused : tuple of (int, int, str)
        Turns without a link: numbers of the dwells before and after, and the reason.
    """

    legs: tuple[Leg, ...]
    prior: GyroPrior
    noise_dps2: Floats
    allan_dps2: Floats
    refused: tuple[tuple[int, int, str], ...] = ()

    def at(self, values: Floats, position: Sequence[int]) -> Links:
        """Return links between readings, linearised at parameters `values` (21,) of the gyros.

        Parameters
        ----------
        position : (n,) int
            Numbers of the dwells of the readings; turns that begin or end in other dwells are left out.
        """
        m = len(self.legs)
        turned = [leg.attitude(values, self.noise_dps2) for leg in self.legs]
        own, following = np.zeros((m, 3, 3)), np.zeros((m, 3, 3))
        for k, (leg, found) in enumerate(zip(self.legs, turned, strict=True)):
            # Noise of the zero rate and of the samples, turned into the frame after the turn.
            wander = _CONTRAST @ covariance_of_means(*leg.spans_s.T) @ _CONTRAST
            zero = np.diag(leg.zero_dps2 + self.allan_dps2 * wander)
            own[k] = found.by_zero @ zero @ found.by_zero.T + found.noise_rad2 + leg.missing_rad2
            if k + 1 < m and self.legs[k + 1].positions[0] == leg.positions[1]:
                # Each leg takes half of the common dwell as its zero rate.
                spans = np.concatenate([leg.spans_s, self.legs[k + 1].spans_s[1:]])
                wander = _FIRST @ covariance_of_means(*spans.T) @ _NEXT
                shared = np.diag(leg.shared_dps2 / 4 + self.allan_dps2 * wander)
                following[k] = found.by_zero @ shared @ turned[k + 1].by_zero.T
        slopes = np.array([one.by_parameter for one in turned]).reshape(m, 3, len(values))
        before, after = np.array([leg.positions for leg in self.legs], dtype=np.intp).reshape(m, 2).T
        links = Links(
            before=before,
            after=after,
            rotation=np.array([one.rotation for one in turned]).reshape(m, 3, 3),
            offset_rad=slopes @ (self.prior.values - values),
            own_rad2=own,
            next_rad2=following,
            modes_rad=slopes @ self.prior.root,
        )
        # From numbers of dwells to rows of the readings.
        kept = links.rows(np.array(position, dtype=np.intp))
        return links.only(np.zeros(m, dtype=bool)) if kept is None else kept


def gyro_links(session: Session, prior: GyroPrior | None = None) -> GyroLinks | None:
    """Make the links of a session; None if it records no turn between two poses.

    Parameters
    ----------
    prior : GyroPrior, optional
        Prior of the gyros' parameters; by default from their data sheet.
    """
    if session.gyro_unit == "counts" or not any(dwell.gyro is not None for dwell in session.dwells):
        return None
    turns = [turn for turn in session.turns if turn.gyro is not None and len(turn)]
    if not turns:
        return None
    try:
        rests = session.once(gyro_dwells_of)
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
    unrecorded = ("recorded", "recording", "no samples", "not turned")
    if not legs and all(any(word in reason for word in unrecorded) for *_, reason in refused):
        return None
    known = GyroPrior.of_sheet(session.sensor) if prior is None else prior
    return GyroLinks(
        tuple(legs), _by_dwells(known, rests), rests.sampling.density_dps2, rests.allan_dps2, tuple(refused)
    )


def _leg(session: Session, turn: Turn, rests: GyroDwells) -> Leg | str:
    """Return the samples of a turn from one dwell to the next, or the reason why it gives no link."""
    measured = measured_turn(session, turn, rests)
    if isinstance(measured, str):
        return measured
    (path, integral), sampling = measured, rests.sampling
    before, after = (rests.by_position[position] for position in (turn.before, turn.position))
    rows = slice(
        int(np.searchsorted(path.time_s, integral.begin_s + sampling.delay_s)),
        int(np.searchsorted(path.time_s, integral.end_s + sampling.delay_s, side="right")),
    )
    time = path.time_s[rows]
    rate = path.rate_dps[rows] - path.zero_dps.mean(axis=0)
    force = path.force_g[rows] - path.rest_g.mean(axis=0)
    turned = _rates_at_end(time, rate)
    # The earth turns by a known angle about an unknown axis: a third of its square on each axis.
    earth_deg2 = (EARTH_DPS * float(time[-1] - time[0])) ** 2 / 3
    missing = (integral.bridged_deg2 + earth_deg2) * np.eye(3)
    missing += sampling.aliasing.covariance(time, turned, sampling.period_s)
    return Leg(
        (turn.before, turn.position),
        time,
        rate,
        np.where(np.isfinite(force), force, 0.0),
        np.abs(turn_integration.smooth_blocks(rate, sampling.window)),
        (rests.variance_dps2[before] + rests.variance_dps2[after]) / 4,
        math.radians(1.0) ** 2 * missing,
        np.array([rests.spans_s[before], (integral.begin_s, integral.end_s), rests.spans_s[after]]),
        rests.variance_dps2[after],
    )


def _by_dwells(prior: GyroPrior, rests: GyroDwells) -> GyroPrior:
    """Return the prior with the g-sensitivity updated by the zero rates measured in the dwells.

    A drift of the zero rates with time is removed if the dwells are then predicted better.
    """
    n = len(rests.dwells)
    if n < 2 or not np.isfinite(rests.force_g).all():
        return prior
    time = rests.spans_s.mean(axis=1)
    courses = [np.ones((n, 1)), np.column_stack([np.ones(n), time - time.mean()])]
    found = []
    for course in courses[: 1 if n < _LEAST_DRIFTING else 2]:
        # Least squares of zero rates on forces, both without the course in time.
        span = np.linalg.qr(course)[0]
        away, left = (one - span @ (span.T @ one) for one in (rests.force_g, rests.mean_dps))
        residual = left - away @ np.linalg.lstsq(away, left, rcond=1e-6)[0]
        leverage = (span**2).sum(axis=1) + np.einsum("ni,in->n", away, np.linalg.pinv(away, rcond=1e-6))
        # Sum over gyros of the logarithm of the error of left-out dwells.
        ahead = residual / np.maximum(1 - leverage, 1e-6)[:, None]
        found.append((float(np.log((ahead**2).mean(axis=0) + 1e-300).sum()), away, left, residual, course))
    _, away, left, residual, course = min(found, key=lambda one: one[0])
    scatter = (residual**2).sum(axis=0) / max(n - 3 - course.shape[1], 1)
    # The zero rate wanders from dwell to dwell; a few dwells show too little of that.
    variance = np.maximum(scatter, rests.variance_dps2.mean(axis=0) + 2 * rests.allan_dps2)
    gram, product = away.T @ away, away.T @ left
    values, covariance = prior.values.copy(), prior.covariance.copy()
    for gyro in range(3):
        rows = slice(9 + 3 * gyro, 12 + 3 * gyro)
        before = covariance[rows, rows]
        # Posterior of a linear model: (P⁻¹ + G/σ²)⁻¹, without the inverse of a P that may be singular.
        after = np.linalg.solve(np.eye(3) + before @ gram / variance[gyro], before)
        values[rows] = values[rows] + after @ (product[:, gyro] - gram @ values[rows]) / variance[gyro]
        covariance[rows, rows] = (after + after.T) / 2
    return GyroPrior(values, covariance)


Refused = tuple[int, int, str]
LEAST_POSES = 3
"""Fewest poses for a fit with links: two turns give four equations for nine parameters of the
accelerometers and for the parameters of the gyros.
"""
MOST_LEFT_OUT = 0.25
"""Largest share of links that may be removed; if more disagree, the gyros as a whole are wrong."""
FAR_RAD, FAR_SHARE = math.radians(10.0), 0.1
"""Limits of the angle between gravity and its prediction by the gyros: in rad, and as a share of the turn's
angle. A link above both is wrong for any parameters: a bias of 50 mg turns gravity by only 3°."""
_SETTLED = 0.05
"""Change of the gyros' parameters between two fits, in standard uncertainties of the prior, below which
they have converged."""


@dataclass(frozen=True)
class LinkReport:
    """Effect that links (turns between poses that the gyros measured) have on a fit.

    Attributes
    ----------
    used : int
        Number of links in the fit; 0 if it uses gravity alone.
    chi2, dof : float or None, int
        Increase of χ² by the links, and the degrees of freedom that the links add; `chi2` is None if the
        links could not be tested.
    refused : tuple of (int, int, str)
        Turns that were not used: numbers of the dwells before and after, and the reason.
    calibrated : bool
        True if a calibration of the gyros was given; False if the data sheet is used.
    why : str
        Reason why no link is used; empty if some are.
    """

    used: int
    chi2: float | None
    dof: int
    refused: tuple[Refused, ...] = ()
    calibrated: bool = False
    why: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of the report, the value of `links` in a result."""
        return {
            "used": self.used,
            "chi2": self.chi2,
            "dof": self.dof,
            "refused": [{"from": b, "to": a, "why": why} for b, a, why in self.refused],
            "gyros": "calibrated" if self.calibrated else "data sheet",
            "why_none": self.why or None,
        }

    @property
    def line(self) -> str:
        """Summary of the report in one line of text."""
        if not self.used:
            return f"turns between the poses are not used: {self.why}"
        parts = [f"{counted(self.used, 'turn')} between the poses by the gyros"]
        parts.append(f"χ² {self.chi2:.1f} at {counted(self.dof, 'degree')} of freedom")
        parts += [f"{b} to {a} left out: {why}" for b, a, why in self.refused[:2]]
        if len(self.refused) > 2:
            parts.append(f"and {len(self.refused) - 2} more")
        return "; ".join(parts)


def linked_readings(
    session: Session, gyros: GyroCalibration | None = None
) -> tuple[Readings, LinkReport | None]:
    """Add the links that agree with gravity to the readings of a session in space, and report on all links.

    The second value is None, and the readings are returned unchanged, if nothing was recorded between the
    poses. `gyros` is a calibration from another session; without it the data sheet is used.

    Raises
    ------
    UsageError
        A calibration of gyros was given for a session that cannot use it.
    """
    readings = readings_of(session)
    if readings.planar or readings.check.all():
        if gyros is not None:
            raise UsageError("a calibration of gyros is for poses in space; this session has a plane")
        return readings, None
    prior = GyroPrior.of_sheet(session.sensor)
    found = gyro_links(session, prior if gyros is None else prior.calibrated(gyros))
    if found is None:
        if gyros is not None:
            raise UsageError(
                "nothing was recorded between the poses: a calibration of gyros is of no use here; record"
                " with calibrate --record-turns"
            )
        return readings, None
    try:
        links, report = judge_links(readings.training, found)
    except (np.linalg.LinAlgError, UsageError):  # with few poses the fit can run to impossible axes
        links, report = None, LinkReport(0, None, 0, found.refused, why="a fit with them does not converge")
    report = replace(report, calibrated=gyros is not None)
    if links is None:
        return readings, report
    # Links are numbered among the fitted readings: renumber them among all readings.
    rows = np.flatnonzero(~readings.check)
    links = replace(links, before=rows[links.before], after=rows[links.after])
    return replace(readings, links=links), report


def judge_links(readings: Readings, found: GyroLinks) -> tuple[Links | None, LinkReport]:
    """Compare the gyros' links with gravity, and remove the worst link until the others agree with it.

    Return the accepted links between these readings, and a report. The links are None if too many disagree
    or if they cannot be tested; the report then has the reason.
    """
    refused = list(found.refused)

    def none(why: str, chi2: float | None = None, dof: int = 0) -> tuple[None, LinkReport]:
        return None, LinkReport(0, chi2, dof, tuple(refused), why=why)

    if len(readings) < LEAST_POSES:
        return none("poses are too few to test them by")
    alone = settle(readings)
    if not alone.noise.known:
        return none("the noise of the poses is unknown")
    data, plain = alone.noise.applied(readings), alone.determination
    position = readings.position
    links = found.at(found.prior.values, position.tolist())
    near = _near(links, plain.fit)
    count, far = len(links), int((~near).sum())
    allowed = math.floor(MOST_LEFT_OUT * count)
    refused += [(*_ends(links, position, int(k)), _FAR) for k in np.flatnonzero(~near)]
    if far > allowed:
        return none(f"in {far} of {count} {_FAR}: a wrong sign, axis, range or unit")
    links = links.only(near)
    left_out = far
    while len(links):
        links, linked = _settled(found, links, data)
        chi2, dof = linked.fit.chi2 - plain.fit.chi2, linked.dof - plain.dof
        if dof < 1:
            return none("they are too few to be tested against gravity")
        if chi2 <= chi2_quantile(dof, LINK_REFUSED):
            return links, LinkReport(len(links), chi2, dof, tuple(refused))
        if left_out >= allowed:
            rows = linked.fit.link_rows
            assert rows is not None
            # The misclosure is relative to the prior; its offset leads back to the linearisation's gyros.
            off = np.degrees(rows.misclosure + (rows.turned @ rows.links.offset_rad[:, :, None])[:, :, 0])
            reason = (
                f"they contradict gravity (χ² {chi2:.3g} at {counted(dof, 'degree')} of freedom):"
                f" {np.sqrt((off**2).mean()):.2g}° rms, at most {np.abs(off).max():.2g}°"
            )
            return none(reason, chi2, dof)
        worst = _worst(linked.fit)
        refused.append((*_ends(links, position, worst), "it contradicts gravity and the other turns"))
        links = links.only(np.arange(len(links)) != worst)
        left_out += 1
    return none(refused[0][2] if refused else "none lies between two poses that are fitted")


_FAR = "the gyros turn gravity to a wrong direction"


def _ends(links: Links, position: NDArray[np.intp], link: int) -> tuple[int, int]:
    """Return the numbers of the two dwells that a link connects.

    `link` is the index of the link, `position` (n,) are the numbers of the dwells.
    """
    return int(position[links.before[link]]), int(position[links.after[link]])


def _near(links: Links, fit: Fit) -> NDArray[np.bool_]:
    """Return a mask (m,) of the links that agree roughly with gravity before and after their turn.

    The other links are too wrong for any parameters of gyros and accelerometers to explain: they disagree
    by more than `FAR_RAD` and by more than `FAR_SHARE` of the turn's angle.
    """
    attitude = fit.settled(4).values.attitude
    # Gravity before the turn, carried by the gyros, against gravity after it.
    came = (links.rotation @ attitude[links.before][:, :, None])[:, :, 0]
    there = attitude[links.after]
    away = np.arctan2(np.linalg.norm(np.cross(came, there), axis=1), (came * there).sum(axis=1))
    # Angle of a rotation from its trace: 1 + 2 cos θ.
    turned = np.arccos(np.clip((np.trace(links.rotation, axis1=1, axis2=2) - 1) / 2, -1, 1))
    return np.asarray(away <= np.maximum(FAR_RAD, FAR_SHARE * turned))


def _settled(found: GyroLinks, links: Links, data: Readings) -> tuple[Links, determination.Determination]:
    """Fit readings with links, and linearise the links at the fitted gyro parameters until these settle.

    Return the links, linearised at the last parameters, and the fit.
    """
    size = np.sqrt(np.maximum(np.diagonal(found.prior.covariance), 1e-24))
    values = found.prior.values
    linked = determination.determine(replace(data, links=links))
    for _ in range(4):
        moved = probable_gyros(linked.fit, found.prior)
        if float(np.max(np.abs(moved - values) / size)) < _SETTLED:
            break
        values = moved
        moved_links = found.at(values, data.position.tolist())
        wanted = set(zip(links.before.tolist(), links.after.tolist(), strict=True))
        pairs = zip(moved_links.before.tolist(), moved_links.after.tolist(), strict=True)
        links = moved_links.only(np.array([pair in wanted for pair in pairs]))
        linked = determination.determine(replace(data, links=links))
    return links, linked


def probable_gyros(fit: Fit, prior: GyroPrior) -> Floats:
    """Return the most probable parameters (21,) of the gyros, given a fit with links and their prior."""
    links, rows = fit.link_rows, fit.modes
    assert links is not None
    assert rows is not None
    flat = fit.unshared_residual
    count = links.links.modes_rad.shape[2]
    # Posterior mean of the shared modes with unit prior; the gyros' modes are the last ones.
    found = np.linalg.solve(np.eye(rows.shape[1]) + rows.T @ rows, rows.T @ flat)
    return np.asarray(prior.values + prior.root @ found[-count:])


def _worst(fit: Fit) -> int:
    """Return the index of the link with the largest residual."""
    links = fit.link_rows
    assert links is not None
    # The last rows of the residual belong to the links, two for each.
    rows = fit.residual[-2 * len(links.links) :].reshape(-1, 2)
    return int((rows**2).sum(axis=1).argmax())
