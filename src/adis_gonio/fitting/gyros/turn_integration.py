"""Integrate the rates of the three gyros over a turn, from rest to rest, to its angle and attitude.

The mean rate of a turn needs only the integral of the rates (`integrate`). The trapezoidal rule runs on the
times of the samples, from the last sample of one dwell to the first sample of the next. The Bartlett filter
of the chip delays its output by N − 1 samples, so the integral belongs to an interval that began and ended
earlier by this delay. The part is at rest at both ends, so the filter, which mixes 2N − 1 samples, loses no
part of the turn.

A straight line bridges lost scans. The turn itself shows the error of such a bridge: the same bridge is
laid over every complete stretch of that length near the gap, and the mean square of its error is the
variance. A longer gap refuses the turn, unless the part was at rest on both sides of the gap and the
motion came later (or earlier). The interval then begins (or ends) at the gap. Long rests before and after
the motion are left out if they show no rotation, because they add only the drift of the gyros.

The rotation between two poses needs the attitude (`attitude`). A direction u fixed in space moves backwards
in the part: u̇ = −ω × u. The rate between two samples is taken as their mean, and the rotation by this
rate is exact, so u(t₁) = Φ(t₁, t₀) u(t₀), where Φ is a product of rotations. A small error δω of the
rates turns the result by ε, u(t₁) → u(t₁) + ε × u(t₁), with

    ε = −∫ Φ(t₁, t) δω(t) dt.

This is linear in all parameters of the gyros: readings m, zero rate z, gains and directions A and
asymmetry a give ω = A⁻¹ (m − z − a |m − z|), hence ε = ∫ Φ(t₁, t) A⁻¹ (δA ω + δz + δa |m − z|) dt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, rotation_matrices
from adis_gonio.fitting.estimation.readings import mg_per_unit
from adis_gonio.model.records import Dwell, Session, Turn

LONGEST_GAP_S = 0.25
"""Longest gap that is bridged within a turn; a hand's submovements take longer (`sim.hand`)."""
MARGIN_S = 1.0
"""Time at rest that is integrated before and after the motion."""
WINDOW_S = 0.1
"""Length of the windows whose mean rate decides between motion and rest."""
MOVING_DPS = 1.0
"""Mean rate in °/s above which a sensor moves; at rest it shows less in every attitude."""
MOVING_NOISE = 6.0
"""Mean rate of a window above which the sensor moves, in standard deviations of the mean."""
SHIFTED_G = 0.01
"""Change of the accelerometers' reading that shows another attitude (0.6°)."""
HELD_NOISE = 6.0
"""Largest integral of an omitted rest, in its standard uncertainties."""
PARAMETERS = 21
"""Of three gyros: A (9, row by row), g-sensitivity (9, row by row) in °/s/g, asymmetry (3)."""
NOT_RECORDED = "nothing was recorded between the dwells"
_BRIDGED_NEAR_S = 1.0
_LEAST_BRIDGES = 8


@dataclass(frozen=True)
class Sampling:
    """Properties of the sampling of the gyros: period, filter, range and noise.

    Attributes
    ----------
    period_s : float
        Time between samples without a loss.
    filter_m : int
        M of the Bartlett filter; 0 if unknown.
    range_dps : float
        Range of the gyros; inf if unknown.
    density_dps2 : (3, 3) float
        Spectral density of the noise at frequency zero, two-sided, per sample: the sum of n samples has n
        times this variance.
    drift_dps : (3,) float
        Allan deviation of the 1/f noise.
    """

    period_s: float
    filter_m: int
    range_dps: float
    density_dps2: Floats
    drift_dps: Floats

    @property
    def delay_s(self) -> float:
        """Delay in s of the chip's filter, N − 1 samples with N = 2^m."""
        return float((2**self.filter_m - 1) * self.period_s)

    @property
    def window(self) -> int:
        """Number of samples per mean in the test for motion, at least the length of the filter."""
        return max(8, round(WINDOW_S / self.period_s), int(2 * 2**self.filter_m - 1))

    @property
    def moving_dps(self) -> Floats:
        """Threshold (3,) in °/s: the sensor moves if the mean rate of a window exceeds it."""
        spread = np.sqrt(np.diagonal(self.density_dps2) / self.window)
        return np.maximum(MOVING_DPS, MOVING_NOISE * spread)


@dataclass(frozen=True)
class Path:
    """Samples of a turn, from the end of one dwell to the beginning of the next.

    Attributes
    ----------
    time_s : (n,) float
        Increasing.
    rate_dps, force_g : (n, 3) float
        Readings of the gyros and of the accelerometers.
    zero_dps, rest_g : (2, 3) float
        Means of the gyros and of the accelerometers in each of the two dwells.
    """

    time_s: Floats
    rate_dps: Floats
    force_g: Floats
    zero_dps: Floats
    rest_g: Floats


@dataclass(frozen=True)
class Integral:
    """A turn and the integral of its rates.

    Attributes
    ----------
    begin_s, end_s : float
        Interval of the turn, with the filter's delay subtracted.
    angle_deg : (3,) float
        Integral of the readings, zero rate included.
    covariance_deg2 : (3, 3) float
        From noise and bridged gaps, without changes of the zero rate.
    turned_deg : (3,) float
        Integral of the rates minus the mean zero rate of both dwells; it serves to count turns and to find
        the axis.
    force_g : (3,) float
        Mean reading of the accelerometers.
    mean_abs_dps : (3,) float
        Mean of |rate − zero rate|, which an asymmetry of the scale factor multiplies.
    samples, bridged : int
        Number of samples, and of lost scans in the interval.
    """

    begin_s: float
    end_s: float
    angle_deg: Floats
    covariance_deg2: Floats
    turned_deg: Floats
    force_g: Floats
    mean_abs_dps: Floats
    samples: int
    bridged: int

    @property
    def length_s(self) -> float:
        """Duration of the interval in s."""
        return self.end_s - self.begin_s


def dps_per_unit(session: Session) -> float:
    """Factor from the unit of the session's gyros to °/s."""
    return 180.0 / math.pi if session.gyro_unit == "radps" else 1.0


def g_per_unit(session: Session) -> float:
    """Factor from the unit of the session's accelerometers to g; NaN for counts."""
    return math.nan if session.accel_unit == "counts" else 1e-3 * mg_per_unit(session)


def three_axes(accel: Floats) -> Floats:
    """Extend accelerations of two axes to (n, 3) with zeros for Z; three axes are returned as given."""
    return accel if accel.shape[1] == 3 else np.column_stack([accel, np.zeros(len(accel))])


def path_between(session: Session, turn: Turn, before: Dwell, after: Dwell) -> Path | None:
    """Samples from the end of a dwell to the beginning of the next; None if there are none."""
    if turn.gyro is None or not len(turn) or before.gyro is None or after.gyro is None:
        return None
    per_dps, per_g = dps_per_unit(session), g_per_unit(session)
    last, first = slice(-1, None), slice(None, 1)
    time = np.concatenate([before.time_s[last], turn.time_s, after.time_s[first]])
    if not (np.diff(time) > 0).all():
        return None
    rate = np.concatenate([before.gyro[last], turn.gyro, after.gyro[first]])
    force = np.concatenate([three_axes(a) for a in (before.accel[last], turn.accel, after.accel[first])])
    zero = np.array([before.gyro.mean(axis=0), after.gyro.mean(axis=0)])
    at_rest = np.array([three_axes(dwell.accel).mean(axis=0) for dwell in (before, after)])
    return Path(time, per_dps * rate, per_g * force, per_dps * zero, per_g * at_rest)


def integrate(path: Path, sampling: Sampling) -> Integral | str:
    """Integrate the gyro rates of a turn to its rotation; if impossible, return the reason as text."""
    if len(path.time_s) < 2 * sampling.window:
        return NOT_RECORDED
    peak = np.abs(path.rate_dps).max(axis=0)
    if (peak >= sampling.range_dps).any():
        axis = "xyz"[int(np.argmax(peak))]
        return (
            f"gyro {axis} went to {peak.max():.0f} °/s, beyond its range of ±{sampling.range_dps:.0f} °/s:"
            " turn more slowly, or choose a wider range"
        )
    moving = _moving(path, sampling)
    steps = np.diff(path.time_s)
    # Gaps that a straight line must not bridge.
    long = np.flatnonzero(steps > LONGEST_GAP_S)
    if not moving.any():
        turned = _shows_another_attitude(path, path.rest_g[1:], 0)
        return "the part was turned while nothing was recorded" if turned else "the part was not turned"
    first, last = int(moving.argmax()), len(moving) - 1 - int(moving[::-1].argmax())
    within = long[(long >= first) & (long < last)]
    if within.size:
        worst = int(within[np.argmax(steps[within])])
        return (
            f"no samples for {steps[worst]:.2g} s while it was turned; at most {LONGEST_GAP_S:g} s can be"
            " bridged"
        )
    # A window across a gap sees only one side of it: the motion may have begun in the gap.
    begin = max((int(k) + 1 for k in long if k < first), default=0)
    wanted = int(np.searchsorted(path.time_s, path.time_s[first] - MARGIN_S))
    if wanted > begin and _is_rest(path, sampling, begin, wanted, path.zero_dps[0]):
        begin = wanted
    end = min((int(k) for k in long if k >= last), default=len(path.time_s) - 1)
    wanted = int(np.searchsorted(path.time_s, path.time_s[last] + MARGIN_S))
    if wanted < end and _is_rest(path, sampling, wanted, end, path.zero_dps[1]):
        end = wanted
    edge = sampling.window // 2
    # Both ends lie within the interval, which a gap may have made shorter than a window.
    head, tail = slice(begin, min(begin + edge, end + 1)), slice(max(end - edge + 1, begin), end + 1)
    if _shows_another_attitude(path, path.force_g[head], 0) or _shows_another_attitude(
        path, path.force_g[tail], 1
    ):
        return "a part of the turn was not recorded"
    if moving[head].any() or moving[tail].any():
        return "the part was already moving when the recording began, or still moving when it ended"
    return integral_over(path, sampling, begin, end)


def _shows_another_attitude(path: Path, here_g: Floats, dwell: int) -> bool:
    """True if the mean of the readings `here_g` (n, 3) differs from the mean in one of the two dwells.

    `dwell` is 0 or 1. A turn about the vertical changes no reading.
    """
    off = np.abs(here_g.mean(axis=0) - path.rest_g[dwell])
    noise = here_g.std(axis=0) / math.sqrt(len(here_g))
    return bool((off > np.maximum(SHIFTED_G, MOVING_NOISE * noise)).any())


def _moving(path: Path, sampling: Sampling) -> NDArray[np.bool_]:
    """For each sample (n,), True if the mean rate around it is too large for a sensor at rest."""
    rate = path.rate_dps - path.zero_dps.mean(axis=0)
    # Means of windows that shrink at both ends, by differences of the cumulative sum.
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(rate, axis=0)])
    half = sampling.window // 2
    low = np.maximum(np.arange(len(rate)) - half, 0)
    high = np.minimum(np.arange(len(rate)) + half + 1, len(rate))
    mean = (total[high] - total[low]) / (high - low)[:, None]
    # The attitudes of the two dwells differ, and gravity changes the zero rate of a gyro.
    allowed = sampling.moving_dps + np.abs(path.zero_dps[1] - path.zero_dps[0])
    return np.asarray((np.abs(mean) > allowed).any(axis=1))


def _is_rest(path: Path, sampling: Sampling, low: int, high: int, zero_dps: Floats) -> bool:
    """True if the rates between two rows show only the zero rate of the adjacent dwell and noise."""
    time, rate = path.time_s[low : high + 1], path.rate_dps[low : high + 1] - zero_dps
    length = float(time[-1] - time[0])
    if length <= 0:
        return True
    # Integral of the rest, against its uncertainty by white noise and drift.
    held = np.abs(np.trapezoid(rate, time, axis=0))
    noise = np.diagonal(sampling.density_dps2) * length * sampling.period_s
    u = np.sqrt(noise + (sampling.drift_dps * length) ** 2 * 2)
    return bool((held < HELD_NOISE * u).all())


def integral_over(path: Path, sampling: Sampling, begin: int, end: int) -> Integral | str:
    """Integrate the rates between two samples to a rotation; if impossible, return the reason as text."""
    rows = slice(begin, end + 1)
    time, rate, force = path.time_s[rows], path.rate_dps[rows], path.force_g[rows]
    weight, length = _trapezoid_weights(time), float(time[-1] - time[0])
    bridges = _bridges(time, rate, sampling)
    if bridges is None:
        return "too many scans were lost during the turn to estimate the missing part"
    missing, bridged = bridges
    zero = path.zero_dps.mean(axis=0)
    angle, share = weight @ rate, weight / length
    return Integral(
        begin_s=float(time[0]) - sampling.delay_s,
        end_s=float(time[-1]) - sampling.delay_s,
        angle_deg=angle,
        covariance_deg2=sampling.density_dps2 * (len(time) - 1) * sampling.period_s**2 + missing,
        turned_deg=angle - length * zero,
        force_g=share @ force,
        mean_abs_dps=share @ np.abs(smooth_blocks(rate - zero, sampling.window)),
        samples=len(time),
        bridged=bridged,
    )


def _trapezoid_weights(time_s: Floats) -> Floats:
    """Weights (n,) in s of the samples in an integral over time by the trapezoidal rule."""
    steps = np.diff(time_s)
    return np.asarray((np.append(steps, 0.0) + np.append(0.0, steps)) / 2)


def smooth_blocks(rate: Floats, window: int) -> Floats:
    """Replace each sample by the mean of its block of `window` samples.

    Without this, noise around zero would add to a mean of absolute rates.
    """
    # Sums over blocks of `window` samples, the last one shorter.
    starts = np.arange(0, len(rate), window)
    counts = np.diff(np.append(starts, len(rate)))
    means = np.add.reduceat(rate, starts, axis=0) / counts[:, None]
    return np.asarray(np.repeat(means, counts, axis=0))


def _bridges(time: Floats, rate: Floats, sampling: Sampling) -> tuple[Floats, int] | None:
    """Uncertainty that gaps in the samples add to the integrated angle, and the number of lost samples.

    The rate is interpolated linearly over a gap. The covariance (3, 3) in deg² comes from the error that
    such an interpolation makes in complete samples near the gap.

    None if there are too few complete samples.
    """
    period = sampling.period_s
    lost = np.rint(np.diff(time) / period).astype(int) - 1
    gaps = np.flatnonzero(lost > 0)
    covariance = np.zeros((3, 3))
    if not gaps.size:
        return covariance, 0
    # Cumulative angle by the trapezoidal rule.
    means = (rate[1:] + rate[:-1]) / 2
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(means * np.diff(time)[:, None], axis=0)])
    for size in np.unique(lost[gaps]).tolist():
        # Error of a line over each stretch of `width` steps; `whole` stretches have no lost scan.
        width = size + 1
        span = time[width:] - time[:-width]
        error = path[width:] - path[:-width] - span[:, None] * (rate[width:] + rate[:-width]) / 2
        whole = span < (width + 0.5) * period
        for gap in gaps[lost[gaps] == size].tolist():
            near = whole & (np.abs(time[: len(span)] - time[gap]) < _BRIDGED_NEAR_S + width * period)
            if int(near.sum()) < _LEAST_BRIDGES:
                near = whole
            if int(near.sum()) < _LEAST_BRIDGES:
                return None
            covariance += error[near].T @ error[near] / int(near.sum())
    return covariance, int(lost[gaps].sum())


def period_of(times_s: list[Floats]) -> float:
    """Usual time between samples in s: the median over all dwells, unaffected by lost samples.

    NaN without samples.
    """
    steps = [np.diff(time) for time in times_s if len(time) > 1]
    return float(np.median(np.concatenate(steps))) if steps else math.nan


@dataclass(frozen=True)
class AssumedGyros:
    """Assumed parameters of three gyros.

    Attributes
    ----------
    sensitivity : (3, 3) float
        A: scale factors times sensitive directions, one row for each gyro.
    per_g : (3, 3) float
        g-sensitivity in °/s/g.
    asymmetry : (3,) float
        Relative error of the scale factor that multiplies |rate| instead of the rate.
    """

    sensitivity: Floats
    per_g: Floats
    asymmetry: Floats

    @classmethod
    def of(cls, values: Floats) -> AssumedGyros:
        """Make the gyros from an array of values in the order of `PARAMETERS`."""
        return cls(values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:])


def gyro_directions(misalignment_deg: Floats) -> Floats:
    """Unit vectors (3, 3) along the sensitive axes of the gyros, one row for each gyro.

    `misalignment_deg` (3, 3) has the angle of each gyro (row) towards each other axis (column).
    """
    sines = np.sin(np.radians(misalignment_deg)) * (1 - np.eye(3))
    return np.asarray(sines + np.diag(np.sqrt(1 - (sines**2).sum(axis=1))))


@dataclass(frozen=True)
class Attitude:
    """Rotation of the sensor over a turn, with its derivatives by the gyro parameters.

    Attributes
    ----------
    rotation : (3, 3) float
        Φ: converts components of a direction in the sensor before the turn to components after it.
    by_parameter : (3, 21) float
        ∂ε/∂(A, g-sensitivity, asymmetry), rad, rad/(°/s/g), rad.
    by_zero : (3, 3) float
        ∂ε/∂(zero rate), rad/(°/s).
    noise_rad2 : (3, 3) float
        Covariance of ε by white noise of the rates.
    """

    rotation: Floats
    by_parameter: Floats
    by_zero: Floats
    noise_rad2: Floats


def attitude(
    time_s: Floats,
    rate_dps: Floats,
    force_g: Floats,
    gyros: AssumedGyros,
    noise_dps2: Floats,
    magnitude_dps: Floats | None = None,
) -> Attitude:
    """Integrate the rates of a turn to its rotation, and to the effect of gyro errors on it.

    Parameters
    ----------
    time_s : (n,) float
    rate_dps : (n, 3) float
        Readings minus the zero rate without force.
    force_g : (n, 3) float
        Readings of the accelerometers minus the force that belongs to that zero rate.
    gyros : AssumedGyros
    noise_dps2 : (3, 3) float
        Covariance of one sample, by the spectral density at frequency zero.
    magnitude_dps : (n, 3) float, optional
        |rate| without the noise of the samples; by default |`rate_dps`|.
    """
    inverse = np.linalg.inv(gyros.sensitivity)
    free = rate_dps - force_g @ gyros.per_g.T
    size = np.abs(free) if magnitude_dps is None else magnitude_dps
    # True rate by the assumed gyros, then Φ(t₁, t) from each sample to the end.
    omega = np.radians(free - gyros.asymmetry * size) @ inverse.T
    to_end = _to_end((omega[1:] + omega[:-1]) / 2 * np.diff(time_s)[:, None])
    weighted = _trapezoid_weights(time_s)[:, None, None] * (to_end @ inverse)
    rad = math.pi / 180
    # ∂ε/∂A[i, j] = ∫ (Φ A⁻¹)[:, i] ω[j] dt: one matrix product over samples for all nine, row by row.
    flat = weighted.reshape(-1, 9).T
    by_parameter = np.concatenate(
        [
            (flat @ omega).reshape(3, 9),
            rad * (flat @ force_g).reshape(3, 9),
            rad * (weighted * size[:, None, :]).sum(axis=0),
        ],
        axis=1,
    )
    # Sum over samples of W Σ Wᵀ with W = Φ A⁻¹ dt.
    by_row = weighted.transpose(1, 0, 2)
    noise = rad**2 * (by_row @ noise_dps2).reshape(3, -1) @ by_row.reshape(3, -1).T
    return Attitude(to_end[0], by_parameter, rad * weighted.sum(axis=0), noise)


def _to_end(steps_rad: Floats) -> Floats:
    """Rotation Φ(t₁, t) (n + 1, 3, 3) from the time of each sample to the end of the turn.

    The argument has the angles (n, 3) turned between samples. The products run within about √n blocks of
    about √n steps, all blocks at once, then over the blocks.
    """
    n = len(steps_rad)
    size = max(1, math.isqrt(n))
    blocks = -(-n // size)
    turns = np.broadcast_to(np.eye(3), (blocks * size, 3, 3)).copy()
    turns[:n] = rotation_matrices(-steps_rad)
    turns = turns.reshape(blocks, size, 3, 3)
    # The last step acts last: Φ of a sample is the product of all later steps, the latest on the left.
    for k in range(size - 2, -1, -1):
        turns[:, k] = turns[:, k + 1] @ turns[:, k]
    after = np.eye(3)
    for block in range(blocks - 1, -1, -1):
        whole = after @ turns[block, 0]
        turns[block] = after @ turns[block]
        after = whole
    return np.concatenate([turns.reshape(-1, 3, 3)[:n], np.eye(3)[None]])
