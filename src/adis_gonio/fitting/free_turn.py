"""The free turn: angle and calibration from one slow continuous turn without declared angles.

All parameters are estimated together from the samples of the whole recording. The unknowns are the angle
ψ_k of gravity to X at the centre of each time window k, and parameters that all windows share:

    U_x = K_x G ⟨cos ψ⟩ + b_x + d_x(t) + l_x ω² + l_y ω'
    U_y = K_y G ⟨sin(ψ + Δφ)⟩ + b_y + d_y(t) + l_y ω² − l_x ω'
    ψ_{k+1} − ψ_k = −∫ω dt + noise,   ω = (1/s) g_z − b_g − γ_x u_x − γ_y u_y − d_g(t) + τ g_z'

U_x and U_y are the mean readings of the accelerometers in a window, and u_x and u_y are their readings as a
share of gravity G. The rate of the turn is ω, the reading of gyro Z is g_z, and ' is the derivative by
time. ⟨…⟩ is the mean over a window, in which the angle changes as the gyro shows; neither the length of the
window nor an uneven turn therefore distorts the result. Unknown are the gains K, the misalignment Δφ, the
biases b_x and b_y, the lever arm l in mm from the axis of the turn to the sensor, the gyro's gain s, zero
rate b_g, g-sensitivity γ and delay τ, and slow drifts d with a 1/f spectrum, as their principal components.
The priors hold for any part (`SENSOR_SPREAD`) and any bench (`LEVER_MM` …); the biases b_x and b_y have no
prior.

Gauss–Newton iterations maximise the posterior. The variances of the noise of accelerometers and gyro and of
the drifts follow from the same data by the evidence (MacKay 1992: the squared residual divided by the
remaining degrees of freedom). The variance of the accelerometers is estimated in short stretches, because a
hand does not shake evenly.

The windows are Hann windows that overlap by half. Their weights add up to a constant, so no slow signal is
lost. Motion that is fast against the distance of the windows (tremor at 8 to 12 Hz) hardly changes a mean.
White noise gives the means of neighbouring windows a correlation of 1/6; `LONG_RUN` is the resulting factor
on the variance of slow parameters.

`fit_free_turn` makes the fit. Functions `require_…` check the conditions of the estimate; their messages
say what to do if the turn does not meet them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, cumulative_integral, wrap_degrees
from adis_gonio.base.errors import DataError, FitError, SingularError
from adis_gonio.base.numbers import counted
from adis_gonio.fitting.answer import MethodComparison, Recommendation, Score
from adis_gonio.fitting.estimation.readings import mg_per_unit, stated_flicker
from adis_gonio.fitting.fit_result import FitResult, Output, values_of, variances
from adis_gonio.fitting.methods import FREE_TURN
from adis_gonio.fitting.uncertainty import Kind, ShownAngle, Source, Sources, gradient_of_base
from adis_gonio.model.measurement import SENSOR_SPREAD
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Session, Sweeps
from adis_gonio.record.provenance import provenance_of

HOP_S = 0.25
"""Time in s between the centres of neighbouring windows; each window has twice this length."""
MOST_WINDOWS = 480
"""Largest number of windows: a longer recording has longer windows, which bounds the cost of an
estimate."""
LONG_RUN = 4 / 3
"""Factor by which the overlap of windows increases the variance of slow parameters: the spectral density at
frequency zero of the windows' means, divided by their variance, 1 + 2/6."""
LEAST_FILLED = 0.5
"""Smallest share of its expected samples with which a window is used."""
GAP_PERIODS = 5.0
"""Length of a gap between samples, in sample periods, above which the gyro's integral over it does not
count."""


@dataclass(frozen=True)
class TurnRecording:
    """Samples of one continuous recording in which the sensor turns.

    Attributes
    ----------
    time_s : (n,) float
        Time since the first sample.
    accel_mg : (n, 2 or 3) float
        Readings of the accelerometers X, Y and, if recorded, Z.
    rate : (n, 3) float
        Readings of the gyros X, Y, Z in rad/s.
    smear_s : float
        Standard deviation in time of the impulse response of the sensor's own filter; 0 without one.
    """

    time_s: Floats
    accel_mg: Floats
    rate: Floats
    smear_s: float = 0.0

    @property
    def period_s(self) -> float:
        """Median time between two samples in s."""
        return float(np.median(np.diff(self.time_s)))

    @property
    def length_s(self) -> float:
        """Duration of the recording in s."""
        return float(self.time_s[-1])


class Windows:
    """Overlapping Hann windows over a recording, which average its samples.

    Attributes
    ----------
    centre_s : (m,) float
        Time of each window's centre, since the first sample.
    gap_s : (m - 1,) float
        Time without samples between neighbouring centres.
    """

    def __init__(self, series: TurnRecording) -> None:
        from scipy.sparse import csr_matrix

        time_s, period = series.time_s, series.period_s
        hop = max(HOP_S, 8 * period, series.length_s / MOST_WINDOWS)
        count = int(series.length_s / hop) - 1
        # Hann weights (2, n) of each sample in its two windows.
        rows = np.floor(time_s / hop).astype(np.intp) - np.array([[1], [0]])
        weights = 0.5 * (1 + np.cos(np.pi * (time_s - (rows + 1) * hop) / hop))
        inside = (rows >= 0) & (rows < count)
        places: Any = rows[inside], np.nonzero(inside)[1]
        matrix: Any = csr_matrix((weights[inside], places), shape=(max(count, 0), len(time_s)))
        # Share of each window with samples.
        filled = np.asarray(matrix.sum(axis=1)).ravel() * period / hop
        keep = filled > LEAST_FILLED
        self._matrix: Any = matrix[keep].multiply(1 / (filled[keep] * hop / period)[:, None]).tocsr()
        self.hop_s = hop
        self.centre_s: Floats = np.asarray((np.arange(count) + 1) * hop, np.float64)[keep]
        steps = np.diff(time_s)
        missing = np.where(steps > GAP_PERIODS * period, steps, 0.0)
        lost = np.concatenate([[0.0], np.cumsum(missing)])
        self.gap_s: Floats = np.diff(np.interp(self.centre_s, time_s, lost))

    def __len__(self) -> int:
        return len(self.centre_s)

    def mean(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the weighted mean in each window (m, …) of sampled values (n, …)."""
        return np.asarray(self._matrix @ values)


NAMES = (
    "scale_x", "scale_y", "delta_phi", "bias_x", "bias_y", "lever_x", "lever_y",
    "gyro_gain_z", "gyro_bias_z", "g_sensitivity_zx", "g_sensitivity_zy", "gyro_latency",
)  # fmt: skip
"""Parameters common to all windows. Their units are 1, 1, rad, mg, mg, mm, mm, 1, rad/s, rad/s, rad/s,
s."""

LEVER_MM = 100.0
"""Prior standard deviation of each component of the distance between the sensor and the axis of the turn,
in mm (D)."""
GYRO_GAIN = 0.05
"""Prior standard deviation of the gyro's scale factor, of which the prior mean is 1 (D)."""
G_SENSITIVITY_DPS = 0.2
"""Prior standard deviation of the gyro's sensitivity to acceleration, in °/s/g (the ADIS16350 data sheet
states 0.05, B)."""
LATENCY_S = 2e-3
"""Prior standard deviation of the gyro's delay against the accelerometers, in s (D)."""
GYRO_INSTABILITY_DPS = 0.015
"""Smallest Allan deviation of the gyro over all averaging times, in °/s, for the prior of its drift (as in
the simulator, D)."""
DRIFT_HZ = 0.5
"""Highest frequency in Hz of the functions that describe a drift; faster drifts count as noise of a
window."""
MOST_DRIFTS = 80
GYRO_DRIFTS = 12
STRETCH_S = 3.0
"""Length in s of the stretches of a recording, within each of which the accelerometers' noise counts as
constant.
"""
STATED_DOF = 8.0
"""Degrees of freedom given to a variance that is not estimated from enough data: the stated variance of a
drift, or the variance of the whole recording as prior of a stretch."""
_MG_PER_MM = 1.0 / STANDARD_GRAVITY_MPS2
"""Acceleration in mg at a distance of 1 mm from the axis of a turn with a rate of 1 rad/s."""
_GAP_RATE = 0.5
"""Standard deviation, in rad/s, of the unknown rate while samples are missing."""
_DONE = 1e-3
_SETTLED = 0.1
"""Largest change of a parameter by the last iteration, in standard uncertainties, at which the result is
valid."""


@dataclass(frozen=True)
class Variances:
    """Noise of the accelerometers and the gyro, estimated from the recording.

    Attributes
    ----------
    accel_mg2 : (m,) float
        Variance of the mean reading in each window, increased for the correlation of neighbouring windows.
    gyro : float
        Variance of the angle per time from white gyro noise (angle random walk), in rad²/s.
    drift : float
        Factor on the stated variance of the accelerometers' drift.
    accel_dof, gyro_dof, drift_dof : float
        Degrees of freedom of these three estimates.
    """

    accel_mg2: Floats
    gyro: float
    drift: float
    accel_dof: float
    gyro_dof: float
    drift_dof: float


@dataclass(frozen=True)
class Solution:
    """Most probable parameters and angles of a recording, with their covariance.

    Attributes
    ----------
    values : (12,) float
        Common parameters, in the order of `NAMES`.
    psi_rad : (m,) float
        Angle of gravity to X at the windows' centres, unwrapped.
    sources : Sources
        Sources of the uncertainty of the values and the angles (12 + m parameters): noise of the
        accelerometers, noise of the gyro, drift and prior knowledge.
    variances : Variances
        Estimated noise of the accelerometers and the gyro.
    residual_mg : (m, 2) float
        Mean reading in each window minus the model.
    """

    values: Floats
    psi_rad: Floats
    sources: Sources
    variances: Variances
    residual_mg: Floats


class LeastSquaresProblem:
    """Nonlinear least-squares problem of a recording, averaged in windows, for Gauss–Newton iterations.

    Parameters
    ----------
    series : TurnRecording
        Samples of the turn.
    windows : Windows
        Windows over these samples.
    gravity_mg : float
        Local gravity.
    floor_mg : float
        Stated smallest Allan deviation of the accelerometers, which sets the prior of their drift; 0 for no
        drift.
    """

    def __init__(self, series: TurnRecording, windows: Windows, gravity_mg: float, floor_mg: float) -> None:
        self.series, self.windows, self.gravity_mg = series, windows, gravity_mg
        mean = windows.mean
        self.reading = mean(series.accel_mg[:, :2])
        rate = series.rate[:, 2]
        unit = series.accel_mg[:, :2] / gravity_mg
        slope = np.gradient(rate, series.time_s)
        self._square, self._rate, self._slope = mean(rate**2), mean(rate), mean(slope)
        turned, pulled = (cumulative_integral(values, series.time_s) for values in (rate, unit))
        self._integrals = np.column_stack([turned, -series.time_s, -pulled, rate])
        # Means in the windows, which make the fastest drifts smaller.
        drifts, self.drift_prior = drift_functions(series.time_s, series.length_s, floor_mg, MOST_DRIFTS)
        self.drifts: Floats = mean(drifts)
        gyro, self.gyro_prior = drift_functions(
            series.time_s, series.length_s, math.radians(GYRO_INSTABILITY_DPS), GYRO_DRIFTS
        )
        self._gyro_drifts = -cumulative_integral(gyro, series.time_s)
        at = np.clip(np.searchsorted(series.time_s, windows.centre_s), 0, len(rate) - 1)
        self._centre = at
        # The rate at a centre is the mean of its window, because a single sample is mostly noise.
        held = self._integrals[at]
        held[:, 4] = self._rate
        self._steps = np.diff(np.column_stack([held, self._gyro_drifts[at]]), axis=0)
        self.m, self.common = len(windows), len(NAMES)
        self.drift_rows = slice(self.common, self.common + 2 * self.drifts.shape[1])
        self.size = self.drift_rows.stop + self.gyro_prior.size + self.m
        g = math.radians(G_SENSITIVITY_DPS)
        sigma = [SENSOR_SPREAD, SENSOR_SPREAD, SENSOR_SPREAD, np.inf, np.inf, LEVER_MM, LEVER_MM,
                 GYRO_GAIN, np.inf, g, g, LATENCY_S]  # fmt: skip
        expected = np.zeros(self.size - self.m)
        expected[[0, 1, 7]] = 1.0
        self.prior = (
            expected,
            np.concatenate([np.square(sigma), self.drift_prior, self.drift_prior, self.gyro_prior]),
        )
        """Prior mean and variance, inf without a prior: common parameters, then drifts."""

    def begin(self) -> Floats:
        """Return starting values of the fit: common parameters and drifts, then the angle of each window.

        The biases and angles come from a circle through the readings.
        """
        x, y = self.reading.T / self.gravity_mg
        # Circle through the readings by linear least squares.
        found = np.linalg.lstsq(np.column_stack([x, y, np.ones(self.m)]), x**2 + y**2, rcond=None)[0]
        centre = np.clip(found[:2] / 2, -0.3, 0.3)
        values = np.concatenate([self.prior[0], np.zeros(self.m)])
        values[3:5] = centre * self.gravity_mg
        values[-self.m :] = np.unwrap(np.arctan2(y - centre[1], x - centre[0]))
        return values

    def model(self, values: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the residuals of accelerometers and gyro, then their Jacobians.

        The residuals are (m, 2) in mg, and (m − 1,) in rad for the turn between neighbouring windows. The
        Jacobians (m, 2, p) and (m − 1, p) are the derivatives of the predictions by the p `values`: common
        parameters, drifts and angles.
        """
        k_x, k_y, skew = values[:3]
        rest = values[: self.size - self.m]
        psi = values[-self.m :]
        gyro = np.concatenate([rest[7:12], rest[self.drift_rows.stop :]])
        course = -(self._integrals @ gyro[:5] + self._gyro_drifts @ gyro[5:])
        # Mean of the direction within a window, relative to the direction at its centre.
        inside = self.windows.mean(np.exp(1j * course)) * np.exp(-1j * course[self._centre])
        # Square of the rate minus the gyro zero, by the means of the square and of the rate.
        spin2 = gyro[0] ** 2 * self._square - 2 * gyro[0] * gyro[1] * self._rate + gyro[1] ** 2
        smear = 1 - 0.5 * self.series.smear_s**2 * spin2
        z = inside * np.exp(1j * psi) * smear
        turned = z * np.exp(1j * skew)
        gravity = self.gravity_mg
        n_d = self.drifts.shape[1]
        x = slice(self.common, self.common + n_d)
        y = slice(self.common + n_d, self.common + 2 * n_d)
        jacobian = np.zeros((self.m, 2, self.size))
        own = np.arange(self.m), self.size - self.m + np.arange(self.m)
        jacobian[:, 0, 0] = gravity * z.real
        jacobian[:, 1, 1] = gravity * turned.imag
        jacobian[:, 1, 2] = gravity * k_y * turned.real
        jacobian[:, 0, 3] = jacobian[:, 1, 4] = 1.0
        jacobian[:, 0, 5] = jacobian[:, 1, 6] = _MG_PER_MM * spin2
        jacobian[:, 0, 6] = _MG_PER_MM * self._slope
        jacobian[:, 1, 5] = -_MG_PER_MM * self._slope
        jacobian[:, 0, x], jacobian[:, 1, y] = self.drifts, self.drifts
        linear = jacobian @ np.concatenate([[k_x, k_y, 0.0], values[3 : self.common + 2 * n_d],
                                            np.zeros(self.size - self.common - 2 * n_d)])  # fmt: skip
        jacobian[own[0], 0, own[1]] = -gravity * k_x * z.imag
        jacobian[own[0], 1, own[1]] = gravity * k_y * turned.real
        steps = np.zeros((self.m - 1, self.size))
        steps[:, 7:12] = self._steps[:, :5]
        steps[:, self.common + 2 * n_d : self.size - self.m] = self._steps[:, 5:]
        rows = np.arange(self.m - 1)
        steps[rows, self.size - self.m + rows] = -1.0
        steps[rows, self.size - self.m + rows + 1] = 1.0
        return self.reading - linear, -(steps @ values), jacobian, steps


def drift_functions(time_s: Floats, length_s: float, floor: float, most: int) -> tuple[Floats, Floats]:
    """Return functions of time (n, k) that describe a drift, and the prior variance (k,) of each.

    `time_s` (n,) are the times since the beginning of the recording, and `length_s` is its length. The
    drift is 1/f noise with the Allan deviation `floor` in any unit; the variances are in this unit squared.
    At most `most` functions are returned, and none if `floor` is 0. Each function has the mean zero.

    The functions are the principal components of the noise. Each is a sum of cosines with a whole number of
    half cycles in the recording. A density h/f has, up to a constant, the covariance −h ln|t − s| of two
    times; `_of_cosines` has the integrals of this covariance over pairs of cosines.
    """
    count = min(most, int(DRIFT_HZ * 2 * length_s)) if floor > 0 else 0
    density = floor**2 / (2 * math.log(2))
    variance, turn = np.linalg.eigh(density * _of_cosines(count))
    cosines = math.sqrt(2) * np.cos(np.pi * np.outer(time_s, np.arange(1, count + 1)) / length_s)
    return cosines @ turn, variance


def _of_cosines(count: int) -> Floats:
    """Return the covariance (`count`, `count`) of the amplitudes of cosines in a noise of density 1/f.

    The amplitude of cosine j is the mean of √2 cos(π j t) times the noise over the time t from 0 to 1. With
    J = π j and Cin(x) = γ + ln x − Ci(x), the variance of this amplitude is 2 (Si(J) − (1 − cos J)/J)/J.
    Its covariance with the amplitude of cosine k, K = π k, is 4 (Cin(J) − Cin(K))/(K² − J²) if j and k are
    both even or both odd, otherwise 0.
    """
    from scipy.special import sici

    j = np.arange(1, count + 1)
    x = np.pi * j
    si, ci = sici(x)
    cin = np.log(x) - ci
    alike = (j[:, None] - j) % 2 == 0
    apart = np.square(x) - np.square(x)[:, None] + np.eye(count)
    found = np.where(alike, 4 * (cin[:, None] - cin) / apart, 0.0)
    np.fill_diagonal(found, 2 * (si - (1 - np.cos(x)) / x) / x)
    return np.asarray(found)


def solve(problem: LeastSquaresProblem) -> Solution:
    """Find the most probable parameters and angles, and their covariance.

    Raises
    ------
    SingularError
        The recording does not determine the parameters, or the iteration does not converge.
    """
    m, change, values = problem.m, math.inf, problem.begin()
    # Third differences show the noise of a slow turn.
    quiet = float(np.median(np.diff(problem.reading, n=3, axis=0) ** 2)) / 0.455 / 20
    variances = Variances(np.full(m, max(quiet, 1e-6)), math.radians(0.03) ** 2, 1.0, m, m, STATED_DOF)
    for _ in range(40):
        left, rows = _whitened(problem, values, variances)
        covariance = _inverse(rows.T @ rows)
        step = covariance @ (rows.T @ left)
        # Largest change of a common parameter, in its standard uncertainties.
        change = float(
            np.abs(step[: problem.common] / np.sqrt(np.diag(covariance)[: problem.common])).max()
        )
        # At most half a radian per step, so that no angle jumps to another turn.
        largest = float(np.abs(step[-problem.m :]).max())
        values = values + step * min(1.0, 0.5 / max(largest, 1e-12))
        renewed = _renewed(problem, values, covariance, variances)
        moved = max(
            abs(math.log(renewed.gyro / variances.gyro)),
            float(np.abs(np.log(renewed.accel_mg2 / variances.accel_mg2)).max()),
        )
        variances = renewed
        if change < _DONE and moved < 10 * _DONE:
            break
    if change > _SETTLED:
        raise SingularError(
            "the free turn's estimate does not settle: the recording is no turn of a rigid part;"
            " turn once more, slowly"
        )
    return _finished(problem, values, variances)


def _whitened(problem: LeastSquaresProblem, values: Floats, variances: Variances) -> tuple[Floats, Floats]:
    """Return residuals (r,) and their Jacobian (r, p) at `values`, both divided by standard deviations.

    The rows are the readings of the accelerometers (2 m), the turns by the gyro between windows (m − 1),
    and the priors of the common parameters and drifts.
    """
    accel, gyro, by_accel, by_gyro = problem.model(values)
    mean, variance = problem.prior
    # The priors of the drifts have the fitted size of the drifts.
    prior = variance.copy()
    prior[problem.drift_rows] *= variances.drift
    # Change of the angle from one window's centre to the next by noise of the gyro and missing samples.
    walk = variances.gyro * np.diff(problem.windows.centre_s) + (_GAP_RATE * problem.windows.gap_s) ** 2
    weights = 1 / np.sqrt(np.concatenate([np.repeat(variances.accel_mg2, 2), walk, prior]))
    known = np.eye(len(mean), problem.size)
    rows = np.concatenate([by_accel.reshape(-1, problem.size), by_gyro, known])
    left = np.concatenate([accel.ravel(), gyro, mean - values[: len(mean)]])
    return left * weights, rows * weights[:, None]


def _inverse(information: Floats) -> Floats:
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    # Unit diagonal before the factorisation.
    size = 1 / np.sqrt(np.diag(information))
    try:
        factor = cho_factor(information * size[:, None] * size)
    except (LinAlgError, ValueError):
        raise SingularError(
            "the recording does not determine the biases and the angle: turn the part once all around"
        ) from None
    return np.asarray(cho_solve(factor, np.eye(len(size))) * size[:, None] * size)


def _renewed(
    problem: LeastSquaresProblem, values: Floats, covariance: Floats, before: Variances
) -> Variances:
    """Estimate the noise variances again, from the residuals and their remaining degrees of freedom.

    `before` are the variances with which `values` and `covariance` were fitted.
    """
    accel, gyro, *_ = problem.model(values)
    _, rows = _whitened(problem, values, before)
    # Degrees of freedom that the fit uses of each row.
    taken = np.einsum("ij,ij->i", rows @ covariance, rows)
    # The used degrees of freedom are slow, and slow noise is denser than the noise of a window
    # (`LONG_RUN`).
    free = np.maximum(2 - LONG_RUN * taken[: 2 * problem.m].reshape(-1, 2).sum(axis=1), 1e-3)
    squares = (accel**2).sum(axis=1)
    whole = float(squares.sum() / free.sum()) if free.sum() > 1 else float(before.accel_mg2.mean())
    stretch = (problem.windows.centre_s / STRETCH_S).astype(np.intp)
    # Variance of each stretch, drawn towards the whole by `STATED_DOF`.
    sums, frees = np.bincount(stretch, squares), np.bincount(stretch, free)
    each = (sums + STATED_DOF * whole) / (frees + STATED_DOF)
    # The whole is an average over uneven stretches; a quiet stretch may have much less.
    each = np.maximum(each, 1e-3 * whole)
    sure = problem.windows.gap_s == 0
    left = float(np.maximum(1 - taken[2 * problem.m : 3 * problem.m - 1][sure], 0).sum())
    dt = np.diff(problem.windows.centre_s)
    gyro_now = (float((gyro[sure] ** 2 / dt[sure]).sum()) + STATED_DOF * math.radians(0.021) ** 2) / (
        left + STATED_DOF
    )
    # Without drifts both sums are 0, and the factor on their stated variance is 1.
    drifts = problem.drift_rows
    seen = max(float((1 - taken[3 * problem.m - 1 :][drifts]).sum()), 0.0)
    size = float((values[drifts] ** 2 / problem.prior[1][drifts]).sum())
    drift = (size + STATED_DOF) / (seen + STATED_DOF)
    return Variances(
        LONG_RUN * each[stretch], gyro_now, drift,
        max(float(free.sum()) / LONG_RUN, 1.0), max(left + STATED_DOF, 1.0), STATED_DOF + seen,
    )  # fmt: skip


def _finished(problem: LeastSquaresProblem, values: Floats, variances: Variances) -> Solution:
    _, rows = _whitened(problem, values, variances)
    covariance = _inverse(rows.T @ rows)
    # Common parameters and angles, without the drifts.
    keep = np.r_[0 : problem.common, problem.size - problem.m : problem.size]
    # Change of these by one standard deviation of each row: its blocks are the causes of the uncertainty.
    changes = covariance[keep] @ rows.T
    begin = 3 * problem.m - 1
    drifts = np.arange(begin + problem.drift_rows.start, begin + problem.drift_rows.stop)
    priors = np.setdiff1d(np.arange(begin, len(rows)), drifts)
    causes: tuple[tuple[str, Kind, NDArray[np.intp], float], ...] = (
        ("noise of the accelerometers", "A", np.arange(2 * problem.m), variances.accel_dof),
        ("noise of the gyro", "A", np.arange(2 * problem.m, begin), variances.gyro_dof),
        ("drift of the biases", "A", drifts, variances.drift_dof),
        ("prior", "B", priors, math.inf),
    )
    sources = tuple(
        Source(name, kind, "normal", None, changes[:, one], dof=dof, estimate=k, unit="1")
        for k, (name, kind, one, dof) in enumerate(causes)
    )
    psi_rad, residual_mg = values[-problem.m :].copy(), problem.model(values)[0]
    return Solution(values[: problem.common].copy(), psi_rad, Sources(sources), variances, residual_mg)


LEAST_S = 10.0
"""Shortest recording in s: a shorter one contains no slow turn."""
FASTEST_DPS = 90.0
"""Largest rate in °/s: above it a window covers more than an eighth of a turn, and a lever arm of 0.1 m
adds 25 mg."""
LEAST_TURN_DEG = 180.0
"""Smallest range of angles in degrees: in less than half a turn a bias and a gain are nearly equivalent."""
WOBBLE_DEG = 0.5
"""Largest tilt (rms, degrees) of the axis X–Y plane out of the plane of the turn: it shortens gravity's
part in that plane by 0.04 mg, the resolution of a session."""
LEANING_DEG = 10.0
MOST_LOST = 0.2
"""Largest allowed share of the recording without samples."""
REST_DPS = 0.5
"""Mean rate in a window, in °/s, below which the sensor counts as at rest."""

_AGAIN = "turn once more"


def require_recording(series: TurnRecording) -> None:
    """Raise `FitError` if a recording is too short or has too many missing samples."""
    if series.length_s < LEAST_S:
        raise FitError(
            f"the recording has {series.length_s:.1f} s: a free turn takes {LEAST_S:.0f} s or more,"
            " 60 s is good"
        )
    steps = np.diff(series.time_s)
    lost_s = float(steps[steps > GAP_PERIODS * series.period_s].sum())
    if lost_s > MOST_LOST * series.length_s:
        raise FitError(
            f"the recording was interrupted: {lost_s:.1f} of {series.length_s:.1f} s have no samples;"
            f" mend the link and {_AGAIN}"
        )


def require_slow(series: TurnRecording, windows: Windows, range_dps: float | None) -> None:
    """Raise `FitError` if the turn was faster than the model can describe or the gyro can measure.

    `range_dps` is the gyro's range; None if unknown.
    """
    rate = np.degrees(np.abs(windows.mean(series.rate[:, 2])))
    fastest = float(rate.max())
    limit = FASTEST_DPS if range_dps is None else min(FASTEST_DPS, 0.9 * range_dps)
    if fastest > limit:
        raise FitError(
            f"the turn was too fast: {fastest:.0f} °/s at {windows.centre_s[rate.argmax()]:.1f} s, at most"
            f" {limit:.0f} °/s can be modelled; {_AGAIN}, a turn in about a minute (6 °/s)"
        )


def require_axis(series: TurnRecording, windows: Windows) -> None:
    """Raise `FitError` if the gyros show that the chip turned about another axis than Z."""
    rates = windows.mean(series.rate)
    # Without the zero rates; the largest of X and Y against Z.
    rates = rates - np.median(rates, axis=0)
    size = np.sqrt((rates**2).mean(axis=0))
    other = int(np.argmax(size[:2]))
    if size[other] > 0.5 * size[2]:
        raise FitError(
            f"the part turned about its {'XY'[other]} axis too ({math.degrees(size[other]):.1f} °/s rms,"
            f" about Z {math.degrees(size[2]):.1f}): lay Z level along the axis of the turn and {_AGAIN}"
        )


def sweeps_of(psi_rad: Floats) -> Sweeps:
    """Return the numbers of full turns and degrees that a recording covers.

    `psi_rad` (m,) is the unwrapped angle ψ at each window. A turn back counts as a turn.
    """
    found = Sweeps()
    for angle_deg in np.degrees(psi_rad - psi_rad[0]).tolist():
        found.see(angle_deg)
    return found


def require_turn(psi_rad: Floats) -> None:
    """Raise `FitError` if the turned angles (m,) in rad cover a range too small to fit."""
    turned = sweeps_of(psi_rad).span_deg
    if turned < LEAST_TURN_DEG:
        raise FitError(
            f"the turn is too short: it went {turned:.0f}°, at least {LEAST_TURN_DEG:.0f}° separate biases"
            f" from gains, and 360° are best; {_AGAIN}, all around"
        )


def require_plane(series: TurnRecording, windows: Windows, psi_rad: Floats, gravity_mg: float) -> list[str]:
    """Check that the turn stayed in one vertical plane; return a warning if there is no Z accelerometer.

    `psi_rad` (m,) is the angle at each window; `gravity_mg` is local gravity.

    Raises
    ------
    FitError
        The turn left its plane by more than the model allows.
    """
    if series.accel_mg.shape[1] < 3:
        return ["no Z accelerometer: whether the turn stayed in one plane is not known"]
    z = windows.mean(series.accel_mg[:, 2])
    # A skew of Z, and a tilt that turns with the part, are one cycle in Z; a bias is a constant.
    design = np.column_stack([np.ones(len(z)), np.cos(psi_rad), np.sin(psi_rad)])
    found = np.linalg.lstsq(design, z, rcond=None)[0]
    # Robust noise by second differences (six times its variance).
    noise = float(np.median(np.abs(np.diff(z, n=2)))) / 0.6745 / math.sqrt(6)
    left = math.sqrt(max(float(((z - design @ found) ** 2).mean()) - noise**2, 0.0))
    wobble = math.degrees(left / gravity_mg)
    leaning = math.degrees(math.asin(min(abs(float(found[0])) / gravity_mg, 1.0)))
    swing = math.degrees(math.hypot(found[1], found[2]) / gravity_mg)
    if wobble > WOBBLE_DEG or swing > LEANING_DEG or leaning > LEANING_DEG:
        _, worst = max(
            (wobble / WOBBLE_DEG, f"swayed by {wobble:.1f}° rms"),
            (swing / LEANING_DEG, f"tilted by {swing:.1f}° with the turn"),
            (leaning / LEANING_DEG, f"leaned by {leaning:.1f}°"),
        )
        raise FitError(
            f"the turn was not in one vertical plane: the part {worst}; hold it in a bearing or on a stage"
            f" with a level axis and {_AGAIN}"
        )
    return []


def remarks(windows: Windows, psi_rad: Floats, u_phi_deg: float, wanted: int = 0) -> list[str]:
    """Return remarks for the user on a valid turn, such as missing rests or samples; often none.

    `psi_rad` (m,) is the unwrapped angle at each window, `u_phi_deg` is the standard uncertainty of Δφ;
    `wanted` is the number of full turns in the plan.
    """
    notes = []
    sweeps = sweeps_of(psi_rad)
    if not sweeps.full:
        notes.append(
            f"the turn went {sweeps.span_deg:.0f}°, no full turn: u(Δφ) is {u_phi_deg:.2g}°;"
            " all around would determine it better"
        )
    elif sweeps.full < wanted:
        notes.append(
            f"{sweeps.full} of {counted(wanted, 'turn')} seen: u(Δφ) is {u_phi_deg:.2g}°; each angle seen"
            " again, on or back, would make it smaller"
        )
    rate = np.degrees(np.abs(np.diff(psi_rad) / np.diff(windows.centre_s)))
    for where, part in (("start", rate[:4]), ("end", rate[-4:])):
        if len(part) and float(np.median(part)) > REST_DPS:
            notes.append(f"no rest at the {where}: a lever arm is separated less well from a bias")
    if (windows.gap_s > 0).any():
        lost = float(windows.gap_s.sum())
        notes.append(f"{lost:.2g} s of samples are missing: across them the gyro is not used")
    return notes


WHY = "no angle is declared: gravity and gyro determine the calibration"
UNSEEN = (
    "angles count from the start of the turn, which is at alpha; no zero of the stage is declared",
    "K_x and K_y hold for the stated gravity and a level axis, because a turn shows neither of these",
)
"""Statements on quantities that no free turn determines."""


class FreeTurnResult(FitResult):
    """Calibration and angle from one continuous turn without declared angles."""

    @cached_property
    def comparison(self) -> MethodComparison:
        """Comparison that lists only the method `free-turn`; no other method fits such a recording."""
        return MethodComparison(
            (self,), {}, {}, {FREE_TURN: Score(None, None, None, None, 0)}, Recommendation(FREE_TURN, WHY)
        )


def fit_free_turn(session: Session) -> FreeTurnResult:
    """Fit the calibration and the angles of one continuous turn.

    Parameters
    ----------
    session : Session
        Session with a `recording` of the turn.

    Raises
    ------
    FitError
        No recording with gyros, or a turn that is too short, too fast, broken or not in one plane; the
        message says what to do.
    SingularError
        The recording does not determine the parameters.
    """
    try:
        return _fitted(session)
    except FitError as error:
        if not session.source:
            raise
        raise type(error)(f"{session.source}: {error}") from error


def _fitted(session: Session) -> FreeTurnResult:
    """Check the recording of a free turn and fit it; error messages do not name the session."""
    series = series_of(session)
    require_recording(series)
    windows = Windows(series)
    range_dps = (session.facts.get("configuration") or {}).get("gyro_range_dps")
    require_slow(series, windows, None if range_dps is None else float(range_dps))
    require_axis(series, windows)
    floor_mg = math.sqrt(stated_flicker(session))
    problem = LeastSquaresProblem(series, windows, session.gravity_mg, floor_mg)
    require_turn(problem.begin()[-len(windows) :])
    solution = solve(problem)
    require_turn(solution.psi_rad)
    notes = require_plane(series, windows, solution.psi_rad, session.gravity_mg)
    outputs = _outputs(solution, windows)
    sources = solution.sources
    parameters = values_of(outputs, sources)
    # The angle from gravity to X after calibration; its uncertainty excludes the noise of a reading.
    natural = gradient_of_base(np.append(0.0, solution.values[:3]), zero=False)[:, 1:]
    slopes = np.zeros((len(natural), len(outputs[0].gradient)))
    slopes[:, :5] = natural / [1.0, 1.0, 1.0, session.gravity_mg, session.gravity_mg]
    wanted = int(session.facts.get("plan", {}).get("turns", 0))
    notes += remarks(windows, solution.psi_rad, parameters["delta_phi"].u or 0.0, wanted)
    accel = solution.residual_mg
    return FreeTurnResult(
        method=FREE_TURN,
        parameters=parameters,
        covariance=variances(outputs, sources.covariance),
        chi2=float((accel**2 / solution.variances.accel_mg2[:, None]).sum()),
        dof=int(solution.variances.accel_dof),
        residual_mg=accel,
        positions=(0,),
        warnings=(*session.notes, *notes, *UNSEEN),
        outputs=tuple(outputs),
        sources=sources,
        around=ShownAngle(slopes, np.zeros((len(slopes), 2))),
        provenance=provenance_of(session),
        overrides=session.facts.get("overrides", {}),
        session_notes=session.notes,
    )


def series_of(session: Session) -> TurnRecording:
    """Return the recording of a session, converted to mg and rad/s.

    Raises
    ------
    FitError
        The session has no recording, no gyros, or unknown units.
    DataError
        A sample is not finite.
    """
    whole = session.recording
    if whole is None:
        raise FitError(
            "method free-turn needs one continuous recording: record one by calibrate --plan free-turn, or"
            " give a samples CSV without the column 'position'"
        )
    if whole.gyro is None or session.gyro_unit == "counts" or session.accel_unit == "counts":
        raise FitError("method free-turn needs gyros (gx, gy, gz) and accelerometers in known units")
    rate = whole.gyro if session.gyro_unit == "radps" else np.radians(whole.gyro)
    accel = whole.accel * mg_per_unit(session)
    if not (np.isfinite(accel).all() and np.isfinite(rate).all()):
        raise DataError(f"{session.source or 'session'}: the recording holds NaN or infinity")
    # Root of the second moment of the chip's Bartlett window, if the file states its setting.
    taps = 2 ** int((session.facts.get("configuration") or {}).get("filter_m", 0))
    smear_s = math.sqrt((taps**2 - 1) / 6) * float(np.median(np.diff(whole.time_s)))
    return TurnRecording(whole.time_s - whole.time_s[0], accel, rate, smear_s)


def _outputs(solution: Solution, windows: Windows) -> list[Output]:
    """Return the reported parameters, with the names of a planar session.

    Their gradients (12 + m,) are by the 12 common parameters and the m angles of the solution.
    """
    size = len(NAMES) + len(solution.psi_rad)
    common = dict(zip(NAMES, np.eye(size), strict=False))
    value = dict(zip(NAMES, solution.values, strict=True))
    degrees = 180 / math.pi
    k_x, k_y = value["scale_x"], value["scale_y"]
    # The start angle is the mean over the windows at rest at the beginning, at least one.
    rate = np.abs(np.diff(solution.psi_rad) / np.diff(windows.centre_s))
    moving = np.flatnonzero(np.degrees(rate) > REST_DPS)
    start = max(int(moving[0]), 1) if moving.size else 1
    alpha = np.zeros(size)
    alpha[len(NAMES) : len(NAMES) + start] = 1 / start
    at_start = float(np.degrees(solution.psi_rad[:start].mean()))
    gain = value["gyro_gain_z"]
    by_ratio = common["scale_x"] / k_y - common["scale_y"] * k_x / k_y**2
    return [
        Output("delta_k", k_x / k_y - 1, "1", by_ratio),
        Output("delta_phi", value["delta_phi"] * degrees, "deg", common["delta_phi"] * degrees),
        Output("alpha", wrap_degrees(at_start), "deg", alpha * degrees),
        *(Output(name, value[name], unit, common[name]) for name, unit in _PLAIN),
        Output("gyro_scale_z", 1 / gain, "1", -common["gyro_gain_z"] / gain**2),
        *(
            Output(name, value[name] * degrees / gain, unit, common[name] * degrees / gain)
            for name, unit in _RATES
        ),
    ]


_PLAIN = (("scale_x", "1"), ("scale_y", "1"), ("bias_x", "mg"), ("bias_y", "mg"), ("lever_x", "mm"),
          ("lever_y", "mm"), ("gyro_latency", "s"))  # fmt: skip
_RATES = (("gyro_bias_z", "deg/s"), ("g_sensitivity_zx", "deg/s/g"), ("g_sensitivity_zy", "deg/s/g"))
