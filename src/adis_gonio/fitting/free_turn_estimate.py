"""Angle and calibration from one continuous turn: a batch estimate over the whole recording.

Unknown are the angle ψ_k of gravity to X at the centre of each window, and common parameters:

    U_x = K_x G ⟨cos ψ⟩ + b_x + d_x(t) + l_x ω² + l_y ω'
    U_y = K_y G ⟨sin(ψ + Δφ)⟩ + b_y + d_y(t) + l_y ω² − l_x ω'
    ψ_{k+1} − ψ_k = −∫ω dt + noise,   ω = (1/s) g_z − b_g − γ_x u_x − γ_y u_y − d_g(t) + τ g_z'

⟨…⟩ is the mean in a window over the gyro's course of the angle within it, so neither the window nor an
uneven turn smears the angle. d are slow drifts with the spectrum 1/f, as its principal components. l is
the lever arm in mm, τ the gyro's latency. The priors hold for any part (`SENSOR_SPREAD`) and any
bench (`LEVER_MM` …); the biases have none.

Gauss–Newton maximises the posterior. The variances of accelerometers, gyro and drifts follow from the
same data by the evidence (MacKay 1992: the squared residual divided by the remaining degrees of freedom),
that of the accelerometers in short stretches, because a hand does not shake evenly.

Windows are Hann windows that overlap by half. Their weights add up to a constant, so nothing slow is
lost, and motion faster than their hop (tremor at 8 to 12 Hz) hardly changes a mean. The noise of the
means is then noise of low frequencies, which the parameters follow. White noise correlates neighbours by
1/6; `LONG_RUN` is the resulting factor on the variance of slow parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import SingularError
from adis_gonio.model.measurement import SENSOR_SPREAD
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

HOP_S = 0.25
"""Distance between the centres of windows; each window has twice this length."""
MOST_WINDOWS = 480
"""A longer recording has longer windows, which bounds the cost of an estimate."""
LONG_RUN = 4 / 3
"""Spectral density at zero of means in neighbouring windows, over their variance: 1 + 2/6."""
LEAST_FILLED = 0.5
"""Smallest share of its samples with which a window is used."""
GAP_PERIODS = 5.0
"""Sample periods in a gap above which the gyro's integral over it does not count."""


@dataclass(frozen=True)
class TurnRecording:
    """Samples of one continuous recording in which the sensor turns.

    Attributes
    ----------
    time_s : (n,) float
        From the first sample on.
    accel_mg : (n, 2 or 3) float
    rate : (n, 3) float
        Gyros in rad/s.
    temperature_c : (n,) float or None
    smear_s : float
        Root of the second moment of the sensor's own filter.
    """

    time_s: Floats
    accel_mg: Floats
    rate: Floats
    temperature_c: Floats | None = None
    smear_s: float = 0.0

    @property
    def period_s(self) -> float:
        """Time between two samples in s."""
        return float(np.median(np.diff(self.time_s)))

    @property
    def length_s(self) -> float:
        """Duration of the recording in s."""
        return float(self.time_s[-1])

    def integral(self, values: Floats) -> Floats:
        """Integral (n, …) over time of sampled values, from the first sample to each sample.

        It uses the trapezoidal rule.
        """
        from scipy.integrate import cumulative_trapezoid

        return np.asarray(cumulative_trapezoid(values, self.time_s, axis=0, initial=0))


class Windows:
    """Overlapping Hann windows over a recording, which average its samples.

    Attributes
    ----------
    centre_s : (m,) float
    gap_s : (m - 1,) float
        Time without samples between neighbouring centres.
    """

    def __init__(self, series: TurnRecording) -> None:
        from scipy.sparse import csr_matrix

        time_s, period = series.time_s, series.period_s
        hop = max(HOP_S, 8 * period, series.length_s / MOST_WINDOWS)
        count = int(series.length_s / hop) - 1
        low = np.clip(np.floor(time_s / hop).astype(np.intp), 0, None)
        rows, columns, weights = [], [], []
        for step in (-1, 0):
            row = low + step
            # Hann weights of each sample in its two windows.
            phase = (time_s - (row + 1) * hop) / hop
            inside = (row >= 0) & (row < count)
            rows.append(row[inside])
            columns.append(np.flatnonzero(inside))
            weights.append(0.5 * (1 + np.cos(np.pi * phase[inside])))
        matrix: Any = csr_matrix(
            (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))),
            shape=(max(count, 0), len(time_s)),
        )
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
        """Weighted mean in each window (m, …) of sampled values (n, …)."""
        return np.asarray(self._matrix @ values)


NAMES = (
    "scale_x", "scale_y", "delta_phi", "bias_x", "bias_y", "lever_x", "lever_y",
    "gyro_gain_z", "gyro_bias_z", "g_sensitivity_zx", "g_sensitivity_zy", "gyro_latency",
)  # fmt: skip
"""Common parameters: 1, 1, rad, mg, mg, mm, mm, 1, rad/s, rad/s, rad/s, s."""

LEVER_MM = 100.0
"""Prior standard deviation of the sensor's distance from the axis (D)."""
GYRO_GAIN = 0.05
"""Prior standard deviation of the gyro's scale factor; the prior mean is 1 (D)."""
G_SENSITIVITY_DPS = 0.2
"""Prior standard deviation of the gyro's sensitivity to acceleration, in °/s/g (CHIP: 0.05, B, of the
sibling)."""
LATENCY_S = 2e-3
"""Prior standard deviation of the gyro's delay against the accelerometers (D)."""
GYRO_INSTABILITY_DPS = 0.015
"""Floor of the gyro's Allan deviation (the simulator's, D)."""
DRIFT_HZ = 0.5
"""Highest frequency of the drift functions; faster drifts count as noise of a window."""
MOST_DRIFTS = 80
GYRO_DRIFTS = 12
STRETCH_S = 3.0
"""Length of the stretches, in s, within which the accelerometers' noise counts as constant."""
STATED_DOF = 8.0
"""Degrees of freedom of a stated variance (of a drift, or of a stretch by the whole)."""
_MG_PER_MM = 1.0 / STANDARD_GRAVITY_MPS2
"""Acceleration in mg at a distance of 1 mm from the axis for a squared rate of 1 (rad/s)²."""
_GAP_RATE = 0.5
"""Standard deviation, in rad/s, of the unknown rate while samples are missing."""
_MOST_ROUNDS = 40
_DONE = 1e-3
_SETTLED = 0.1
"""Largest change by the last iteration of a valid result, in standard uncertainties."""


@dataclass(frozen=True)
class Variances:
    """Noise of the accelerometers and the gyro, estimated from the recording.

    Attributes
    ----------
    accel_mg2 : (m,) float
        Variance of the mean reading in each window, increased for the correlation of neighbours.
    gyro : float
        Angle random walk in rad²/s.
    drift : float
        Factor on the stated variance of the accelerometers' drift.
    accel_dof, gyro_dof, drift_dof : float
        Their degrees of freedom.
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
    covariance : (12 + m, 12 + m) float
        Covariance of the values and the angles.
    parts : list of (share (12 + m, 12 + m), degrees of freedom)
        The covariance by its causes: noise of the accelerometers, of the gyro, drift, prior knowledge.
    variances : Variances
    residual_mg : (m, 2) float
    """

    values: Floats
    psi_rad: Floats
    covariance: Floats
    parts: tuple[tuple[Floats, float], ...]
    variances: Variances
    residual_mg: Floats


class LeastSquaresProblem:
    """Nonlinear least-squares problem of a recording, averaged in windows, for Gauss–Newton iterations.

    Parameters
    ----------
    series : TurnRecording
    gravity_mg : float
        Local gravity.
    floor_mg : float
        Stated Allan floor of the accelerometers; 0 for no drift.
    """

    def __init__(self, series: TurnRecording, windows: Windows, gravity_mg: float, floor_mg: float) -> None:
        self.series, self.windows, self.gravity_mg = series, windows, gravity_mg
        mean = windows.mean
        self.reading = mean(series.accel_mg[:, :2])
        rate = series.rate[:, 2]
        unit = series.accel_mg[:, :2] / gravity_mg
        slope = np.gradient(rate, series.time_s)
        self._square, self._rate, self._slope = mean(rate**2), mean(rate), mean(slope)
        self._integrals = np.column_stack(
            [series.integral(rate), -series.time_s, -series.integral(unit), rate]
        )
        # Means in the windows, which make the fastest drifts smaller.
        drifts, self.drift_prior = drift_functions(series.time_s, series.length_s, floor_mg, MOST_DRIFTS)
        self.drifts: Floats = mean(drifts)
        gyro, self.gyro_prior = drift_functions(
            series.time_s, series.length_s, math.radians(GYRO_INSTABILITY_DPS), GYRO_DRIFTS
        )
        self._gyro_drifts = -series.integral(gyro)
        at = np.clip(np.searchsorted(series.time_s, windows.centre_s), 0, len(rate) - 1)
        self._centre = at
        # The rate at a centre is the mean of its window, because a single sample is mostly noise.
        held = self._integrals[at]
        held[:, 4] = self._rate
        self._steps = np.diff(np.column_stack([held, self._gyro_drifts[at]]), axis=0)
        self.m, self.common = len(windows), len(NAMES)
        self.drift_rows = slice(self.common, self.common + 2 * self.drifts.shape[1])
        self.size = self.drift_rows.stop + self.gyro_prior.size + self.m
        self.prior = self._prior()

    def _prior(self) -> tuple[Floats, Floats]:
        """Prior mean and variance of the 12 common parameters; the variance is inf without a prior."""
        g = math.radians(G_SENSITIVITY_DPS)
        sigma = [SENSOR_SPREAD, SENSOR_SPREAD, SENSOR_SPREAD, np.inf, np.inf, LEVER_MM, LEVER_MM,
                 GYRO_GAIN, np.inf, g, g, LATENCY_S]  # fmt: skip
        mean = np.zeros(self.size - self.m)
        mean[[0, 1, 7]] = 1.0
        variance = np.concatenate([np.square(sigma), self.drift_prior, self.drift_prior, self.gyro_prior])
        return mean, variance

    def begin(self) -> Floats:
        """Starting values of the fit: the common parameters, then the angle of each window.

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
        """Residuals of the accelerometers (m, 2) in mg and of the gyro (m - 1,) in rad, with Jacobians."""
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

    def walk(self, variances: Variances) -> Floats:
        """Variance (m - 1,) in rad² that gyro noise adds to the angle between neighbouring windows."""
        gap = self.windows.gap_s
        return variances.gyro * np.diff(self.windows.centre_s) + np.square(_GAP_RATE * gap)


def drift_functions(time_s: Floats, length_s: float, floor: float, most: int) -> tuple[Floats, Floats]:
    """Functions of time (n, k) that describe a drift, and the variance (k,) of each from 1/f noise.

    The 1/f noise is given by its Allan deviation `floor`. Each function has the mean zero.

    They are principal components of the noise. Each is a sum of cosines with a whole number of half cycles
    in the recording. A density h/f has, up to a constant, the covariance −h ln|t − s|; `_of_cosines` has
    its integrals over cosines. A section of a longer recording is no sum of independent cosines, and the
    slowest ones have less variance than their density.
    """
    count = min(most, int(DRIFT_HZ * 2 * length_s)) if floor > 0 else 0
    density = floor**2 / (2 * math.log(2))
    variance, turn = np.linalg.eigh(density * _of_cosines(count))
    cosines = math.sqrt(2) * np.cos(np.pi * np.outer(time_s, np.arange(1, count + 1)) / length_s)
    return cosines @ turn, variance


def _of_cosines(count: int) -> Floats:
    """Covariance (k, k) of the means of √2 cos(π j t) times a noise of density 1/f, t from 0 to 1.

    Integrated by parts, with J = π j and Cin(x) = γ + ln x − Ci(x). The diagonal is 2 (Si(J) − (1 − cos
    J)/J)/J. Off the diagonal it is 4 (Cin(J) − Cin(K))/(K² − J²) if j and k are both even or both odd,
    else 0.
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
    values, variances, change = problem.begin(), _first(problem), math.inf
    for _ in range(_MOST_ROUNDS):
        values, covariance, change = _step(problem, values, variances)
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


def _first(problem: LeastSquaresProblem) -> Variances:
    spread = np.diff(problem.reading, n=3, axis=0)
    quiet = float(np.median(spread**2)) / 0.455 / 20
    m = problem.m
    return Variances(np.full(m, max(quiet, 1e-6)), math.radians(0.03) ** 2, 1.0, m, m, STATED_DOF)


def _system(
    problem: LeastSquaresProblem, values: Floats, variances: Variances
) -> tuple[Floats, Floats, tuple[Floats, ...]]:
    """Normal equations of one iteration: information matrix and right side.

    Also returns the information matrix of each cause of uncertainty.
    """
    accel, gyro, by_accel, by_gyro = problem.model(values)
    mean, variance = problem.prior
    n_p = problem.size - problem.m
    # Precision of the priors, with the fitted size of the drifts.
    scaled = variance.copy()
    scaled[problem.drift_rows] *= variances.drift
    weight = 1 / variances.accel_mg2
    flat = by_accel.reshape(-1, problem.size)
    weighted = flat * np.repeat(weight, 2)[:, None]
    info_accel = flat.T @ weighted
    steps = by_gyro / problem.walk(variances)[:, None]
    info_gyro = by_gyro.T @ steps
    precision = np.zeros(problem.size)
    precision[:n_p] = 1 / scaled
    pull = np.zeros(problem.size)
    pull[:n_p] = (mean - values[:n_p]) / scaled
    right = weighted.T @ accel.ravel() + steps.T @ gyro + pull
    return info_accel + info_gyro + np.diag(precision), right, (info_accel, info_gyro, precision)


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


def _step(
    problem: LeastSquaresProblem, values: Floats, variances: Variances
) -> tuple[Floats, Floats, float]:
    information, right, _ = _system(problem, values, variances)
    covariance = _inverse(information)
    step = covariance @ right
    change = float(np.abs(step[: problem.common] / np.sqrt(np.diag(covariance)[: problem.common])).max())
    # At most half a radian per step, so that no angle jumps to another turn.
    largest = float(np.abs(step[-problem.m :]).max())
    return values + step * min(1.0, 0.5 / max(largest, 1e-12)), covariance, change


def _renewed(
    problem: LeastSquaresProblem, values: Floats, covariance: Floats, before: Variances
) -> Variances:
    """Estimate the noise variances again, from the residuals and their remaining degrees of freedom."""
    accel, gyro, by_accel, by_gyro = problem.model(values)
    flat = by_accel.reshape(-1, problem.size)
    taken = np.einsum("ij,ij->i", flat @ covariance, flat).reshape(-1, 2) / before.accel_mg2[:, None]
    # The used degrees of freedom are slow, and slow noise is denser than the noise of a window
    # (`LONG_RUN`).
    free = np.maximum(2 - LONG_RUN * taken.sum(axis=1), 1e-3)
    squares = (accel**2).sum(axis=1)
    whole = float(squares.sum() / free.sum()) if free.sum() > 1 else float(before.accel_mg2.mean())
    stretch = (problem.windows.centre_s / STRETCH_S).astype(np.intp)
    # Variance of each stretch, drawn towards the whole by `STATED_DOF`.
    sums, frees = np.bincount(stretch, squares), np.bincount(stretch, free)
    each = (sums + STATED_DOF * whole) / (frees + STATED_DOF)
    # The whole is an average over uneven stretches; a quiet stretch may have much less.
    each = np.maximum(each, 1e-3 * whole)
    walk = problem.walk(before)
    # Degrees of freedom that the fit used of each step of the gyro.
    used = np.einsum("ij,ij->i", by_gyro @ covariance, by_gyro) / walk
    sure = problem.windows.gap_s == 0
    left = float(np.maximum(1 - used[sure], 0).sum())
    dt = np.diff(problem.windows.centre_s)
    gyro_now = (float((gyro[sure] ** 2 / dt[sure]).sum()) + STATED_DOF * math.radians(0.021) ** 2) / (
        left + STATED_DOF
    )
    drift, known = 1.0, STATED_DOF
    rows = problem.drift_rows
    if rows.stop > rows.start:
        stated = problem.prior[1][rows]
        seen = float((1 - np.diag(covariance)[rows] / (stated * before.drift)).sum())
        drift = (float((values[rows] ** 2 / stated).sum()) + STATED_DOF) / (max(seen, 0) + STATED_DOF)
        known = STATED_DOF + max(seen, 0.0)
    return Variances(
        LONG_RUN * each[stretch], gyro_now, drift,
        max(float(free.sum()) / LONG_RUN, 1.0), max(left + STATED_DOF, 1.0), known,
    )  # fmt: skip


def _finished(problem: LeastSquaresProblem, values: Floats, variances: Variances) -> Solution:
    information, _, (by_accel, by_gyro, precision) = _system(problem, values, variances)
    covariance = _inverse(information)
    # Common parameters and angles, without the drifts.
    keep = np.r_[0 : problem.common, problem.size - problem.m : problem.size]
    drifts = np.zeros(problem.size, bool)
    drifts[problem.drift_rows] = True
    chosen = covariance[keep]
    shares = (
        (chosen @ by_accel @ chosen.T, variances.accel_dof),
        (chosen @ by_gyro @ chosen.T, variances.gyro_dof),
        ((chosen * (precision * drifts)) @ chosen.T, variances.drift_dof),
        ((chosen * (precision * ~drifts)) @ chosen.T, math.inf),
    )
    return Solution(
        values[: problem.common].copy(),
        values[-problem.m :].copy(),
        covariance[np.ix_(keep, keep)],
        shares,
        variances,
        problem.model(values)[0],
    )
