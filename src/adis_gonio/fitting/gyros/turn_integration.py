"""Turns of the sensor between two dwells: by its gyros, and the true rotation by other sources.

**Integral.** The mean rate of a turn needs only the integral of the rates (`integrate`). The trapezoidal
rule runs on the times of the samples, from the last sample of one dwell to the first sample of the next.
The Bartlett filter of the chip delays its output by N − 1 samples, so the integral belongs to an interval
that began and ended earlier by this delay. The part is at rest at both ends, so the filter, which mixes 2N
− 1 samples, loses no part of the turn.

A straight line bridges lost scans. The turn itself shows the error of such a bridge: the same bridge is
laid over every complete stretch of that length near the gap, and the mean square of its error is the
variance. A longer gap refuses the turn, unless the part was at rest on both sides of the gap and the
motion came later (or earlier). The interval then begins (or ends) at the gap. Long rests before and after
the motion are left out if they show no rotation, because they add only the drift of the gyros. Motion that
is faster than the samples show (a part that is set down stops within a millisecond) adds the error of
`Aliasing`.

**True rotation.** A `Reference` states the rotation of the sensor between two dwells as a rotation vector
in the accelerometers' frame. It comes from one of two sources:

Gravity on both sides
    If the axis is not vertical, the rotation is the angle about the axis between the two directions of
    gravity, plus whole turns, which the gyro counts. On a stage (plane xy) the axis is z of the frame, and
    the angle ψ of gravity to X decreases as the part turns forward. Declared angles, with the fixture's
    uncertainty, improve ψ. In space the axis is taken from the gyros themselves, so that the angle about it
    is measured and its direction is not.
Declared angle
    On a level table the axis is vertical, and gravity does not depend on the angle. The operator declares
    the angle. From a mark back to the mark the rotation is a whole number of turns, which is exact up to
    the error of setting the mark. The gyro counts the whole turns beyond the declared angle. The direction
    of the axis is the constant part c of the accelerometers' reading during the turn, which is c + a cos θ
    + b sin θ + d ω² + e dω/dt. The table's tilt causes a and b, the distance of the part from the axis
    causes d and e.

A rotation vector equals the integral of the rate if the axis is constant in the part, as on a stage and
on a table. In space a turn about an axis that wanders by more than `STRAIGHT` allows is refused.

**Accelerometers.** A `Triad` gives the directions of gravity for the true rotation, with their uncertainty.
Gains, skews and biases of the accelerometers are taken from a fit of the same session if it determines
them, else from a calibration of the part, else from a perfect triad with the uncertainty expected of this
family of sensors. An error of one of these nine parameters changes the directions of all turns of a session
at once, in its own way. For example, a bias of Y adds the same amount to the misalignments in every turn
about X, and nothing in turns about Y.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import (
    Floats,
    block_means,
    central_differences,
    cumulative_integral,
    mean_direction,
    wrap_degrees,
)
from adis_gonio.base.errors import AdisGonioError, UsageError
from adis_gonio.calibrate.calibration import independent_changes
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.fitting.estimation.readings import Readings, mg_per_unit, readings_of
from adis_gonio.fitting.estimation.spectrum import noise_of_means
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.measurement import SKEW_AXES, sensitivity
from adis_gonio.model.records import Dwell, Session, Turn

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration
    from adis_gonio.fitting.fit_result import FitResult

Series = tuple[Floats, Floats]
"""Times (n,) in s, and rates (n, 3) of the gyros in °/s."""
LONGEST_GAP_S = 0.25
"""Longest gap between samples, in s, that is bridged within a turn; the single movements of a turning hand
take longer."""
MARGIN_S = 1.0
"""Time at rest, in s, that is integrated before and after the motion."""
WINDOW_S = 0.1
"""Length in s of the windows whose mean rate decides between motion and rest."""
MOVING_DPS = 1.0
"""Mean rate of a window, in °/s, above which the sensor moves; at rest it is smaller in every attitude."""
MOVING_NOISE = 6.0
"""Mean rate of a window, in standard deviations of its noise, above which the sensor moves."""
SHIFTED_G = 0.01
"""Change of the accelerometers' reading, in g, above which the attitude has changed (0.6°)."""
HELD_NOISE = 6.0
"""Largest integral of the rates over an omitted rest, in its standard uncertainties."""
NOT_RECORDED = "nothing was recorded between the dwells"
_BRIDGED_NEAR_S = 1.0
_LEAST_BRIDGES = 8


@dataclass(frozen=True)
class Aliasing:
    """Error of an integral of sampled rates by motion that is faster than the samples show.

    Sampling with the period T folds the spectrum of the motion at the sampling frequency F = 1/T. The
    integral, T times the sum of the samples, is therefore wrong by the spectrum of the motion at F, 2F, ….
    The motion has there an assumed density K f^−p, which gives the error of the integral the variance V = 2
    K T^p ζ(p).

    The samples show K and p by their second differences. E(h) is the sum of the squared second differences
    of samples h apart over a turn, minus its value by the noise at rest. With r = E(2)/E(1) = 2^(p−1), the
    variance is V = T² E(1) ζ(1−p)/(r − 4). It is T² E(1)/24 for steps of the rate (p = 2), T² E(1)/480 for
    kinks (p = 4) and T² E(1)/6 for white noise (p → 1). The ratio r comes from all turns of a session.

    Attributes
    ----------
    share : float
        V/(T² E(1)), the same for all turns; 0 without turns.
    rest_dps2 : float
        Mean square of the second difference of a gyro's samples at rest.
    """

    share: float = 0.0
    rest_dps2: float = 0.0

    @classmethod
    def of(cls, rests: Sequence[Series], turns: Sequence[Series], period_s: float) -> Aliasing:
        """Estimate the error from times (n,) in s and rates (n, 3) of dwells and turns.

        `period_s` is the usual time between samples.
        """
        from scipy.special import gamma, zeta

        energy, still = [], []
        for lag in (1, 2):
            rest, moved = (
                np.concatenate(
                    [np.empty((0, 3)), *(_second_differences(*one, lag, period_s) for one in many)]
                )
                for many in (rests, turns)
            )
            still.append(float((rest**2).sum()) / max(rest.size, 1))
            energy.append(float((moved**2).sum()) - moved.size * still[-1])
        if energy[0] <= 0:
            return cls(0.0, still[0])
        # The second difference shows exponents between 1 and 5.
        p = 1 + float(np.clip(math.log2(max(energy[1] / energy[0], 1.0)), 1e-6, 4 - 1e-6))
        reflected = 2 * (2 * math.pi) ** -p * math.cos(math.pi * p / 2) * gamma(p) * zeta(p)  # ζ(1 − p)
        return cls(float(reflected / (2 ** (p - 1) - 4)), still[0])

    def covariance(self, time_s: Floats, rate_dps: Floats, period_s: float) -> Floats:
        """Return the covariance (3, 3) in deg² that fast motion adds to the integral of rates (n, 3)."""
        ahead = _second_differences(time_s, rate_dps, 1, period_s)
        size, axes = np.linalg.eigh(ahead.T @ ahead - len(ahead) * self.rest_dps2 * np.eye(3))
        return np.asarray(self.share * period_s**2 * (axes * np.maximum(size, 0.0)) @ axes.T)


def _second_differences(time_s: Floats, rate_dps: Floats, lag: int, period_s: float) -> Floats:
    """Return second differences (k, 3) of rates: f(t + h) − 2 f(t) + f(t − h) with h of `lag` samples.

    Places at which a scan was lost are left out. `period_s` is the usual time between samples.
    """
    ahead = rate_dps[2 * lag :] - 2 * rate_dps[lag:-lag] + rate_dps[: -2 * lag]
    return np.asarray(ahead[time_s[2 * lag :] - time_s[: -2 * lag] < (2 * lag + 0.5) * period_s])


@dataclass(frozen=True)
class Sampling:
    """Properties of the sampling of the gyros: period, filter, range and noise.

    Attributes
    ----------
    period_s : float
        Time between samples without a loss.
    filter_m : int
        Parameter M of the Bartlett filter; 0 if unknown.
    range_dps : float
        Largest rate that the gyros measure; inf if unknown.
    density_dps2 : (3, 3) float
        Spectral density of the noise at frequency zero, two-sided, per sample: the sum of n samples has n
        times this variance.
    drift_dps : (3,) float
        Allan deviation of the 1/f noise of each gyro.
    aliasing : Aliasing
        Error by motion that is faster than the samples show.
    """

    period_s: float
    filter_m: int
    range_dps: float
    density_dps2: Floats
    drift_dps: Floats
    aliasing: Aliasing = Aliasing()

    @property
    def delay_s(self) -> float:
        """Delay in s of the chip's filter: N − 1 samples with N = 2^M."""
        return float((2**self.filter_m - 1) * self.period_s)

    @property
    def window(self) -> int:
        """Number of samples in a window of the test for motion, at least the length of the filter."""
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
        Times of the samples, increasing.
    rate_dps, force_g : (n, 3) float
        Readings of the gyros and of the accelerometers, in °/s and g.
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
        Begin and end of the turn, with the filter's delay subtracted.
    angle_deg : (3,) float
        Integral of the gyros' readings, from which the zero rates are not subtracted.
    covariance_deg2 : (3, 3) float
        Covariance of `angle_deg` from noise, aliasing and bridged gaps, without changes of the zero rate.
    bridged_deg2 : float
        Part of the trace of `covariance_deg2` that comes from bridged gaps.
    turned_deg : (3,) float
        Integral of the rates minus the mean zero rate of both dwells; it serves to count turns and to find
        the axis.
    force_g : (3,) float
        Mean reading of the accelerometers during the turn.
    mean_abs_dps : (3,) float
        Mean of |rate − zero rate|, by which an asymmetry of the scale factor is multiplied.
    samples : int
        Number of samples in the interval.
    """

    begin_s: float
    end_s: float
    angle_deg: Floats
    covariance_deg2: Floats
    bridged_deg2: float
    turned_deg: Floats
    force_g: Floats
    mean_abs_dps: Floats
    samples: int

    @property
    def length_s(self) -> float:
        """Duration of the interval in s."""
        return self.end_s - self.begin_s


def dps_per_unit(session: Session) -> float:
    """Return the factor from the unit of the session's gyros to °/s."""
    return 180.0 / math.pi if session.gyro_unit == "radps" else 1.0


def g_per_unit(session: Session) -> float:
    """Return the factor from the unit of the session's accelerometers to g; NaN for counts."""
    return math.nan if session.accel_unit == "counts" else 1e-3 * mg_per_unit(session)


def three_axes(accel: Floats) -> Floats:
    """Extend accelerations of two axes to (n, 3) with zeros for Z; three axes are returned as given."""
    return accel if accel.shape[1] == 3 else np.column_stack([accel, np.zeros(len(accel))])


def path_between(session: Session, turn: Turn, before: Dwell, after: Dwell) -> Path | None:
    """Return the samples from the end of a dwell to the beginning of the next; None without any.

    None also without gyros in a dwell, or if the times do not increase.
    """
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
    moves = moving(path, sampling)
    steps = np.diff(path.time_s)
    # Gaps that a straight line must not bridge.
    long = np.flatnonzero(steps > LONGEST_GAP_S)
    if not moves.any():
        turned = _shows_another_attitude(path, path.rest_g[1:], 0)
        return "the part was turned while nothing was recorded" if turned else "the part was not turned"
    first, last = int(moves.argmax()), len(moves) - 1 - int(moves[::-1].argmax())
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
    if any(_shows_another_attitude(path, path.force_g[rows], k) for k, rows in enumerate((head, tail))):
        return "a part of the turn was not recorded"
    if moves[head].any() or moves[tail].any():
        return "the part was already moving when the recording began, or still moving when it ended"
    return integral_over(path, sampling, begin, end)


def has_gap(path: Path) -> bool:
    """Return True if a gap between samples is longer than a straight line may bridge (`LONGEST_GAP_S`)."""
    return float(np.diff(path.time_s).max()) > LONGEST_GAP_S


def _shows_another_attitude(path: Path, here_g: Floats, dwell: int) -> bool:
    """Return True if the mean of the readings `here_g` (n, 3) differs from the mean in a dwell.

    `dwell` is 0 for the dwell before the turn, 1 for the dwell after it. A turn about the vertical changes
    no reading.
    """
    off = np.abs(here_g.mean(axis=0) - path.rest_g[dwell])
    noise = here_g.std(axis=0) / math.sqrt(len(here_g))
    return bool((off > np.maximum(SHIFTED_G, MOVING_NOISE * noise)).any())


def moving(path: Path, sampling: Sampling) -> NDArray[np.bool_]:
    """Return a mask (n,) of the samples around which the mean rate is too large for a sensor at rest."""
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
    """Return True if the sensor is at rest between two samples: its rates show only a zero rate and noise.

    `low` and `high` are the indices of the samples, `zero_dps` (3,) is the zero rate in the adjacent dwell.
    """
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
    """Integrate the rates between two samples to a rotation; if impossible, return the reason as text.

    `begin` and `end` are the rows of the samples in `path`.
    """
    rows = slice(begin, end + 1)
    time, rate, force = path.time_s[rows], path.rate_dps[rows], path.force_g[rows]
    weight, length = trapezoid_weights(time), float(time[-1] - time[0])
    missing = _bridges(time, rate, sampling)
    if missing is None:
        return "too many scans were lost during the turn to estimate the missing part"
    zero = path.zero_dps.mean(axis=0)
    angle, share = weight @ rate, weight / length
    # A bridge adds its error to the noise of all scans, the lost ones included.
    noise = sampling.density_dps2 * length * sampling.period_s
    return Integral(
        begin_s=float(time[0]) - sampling.delay_s,
        end_s=float(time[-1]) - sampling.delay_s,
        angle_deg=angle,
        covariance_deg2=noise + sampling.aliasing.covariance(time, rate, sampling.period_s) + missing,
        bridged_deg2=float(np.trace(missing)),
        turned_deg=angle - length * zero,
        force_g=share @ force,
        mean_abs_dps=share @ np.abs(smooth_blocks(rate - zero, sampling.window)),
        samples=len(time),
    )


def trapezoid_weights(time_s: Floats) -> Floats:
    """Return the weights (n,) in s of the samples in an integral over time by the trapezoidal rule."""
    steps = np.diff(time_s)
    return np.asarray((np.append(steps, 0.0) + np.append(0.0, steps)) / 2)


def smooth_blocks(rate: Floats, window: int) -> Floats:
    """Replace each sample of `rate` (n, 3) by the mean of its block of `window` samples.

    Without this, noise around zero would add to a mean of absolute rates.
    """
    # The last block is shorter.
    means = block_means(rate, np.arange(0, len(rate), window))
    return np.asarray(np.repeat(means, window, axis=0)[: len(rate)])


def _bridges(time: Floats, rate: Floats, sampling: Sampling) -> Floats | None:
    """Return the covariance (3, 3) in deg² that gaps in the samples add to the integrated angle.

    The rate is interpolated linearly over a gap. The covariance comes from the error that such an
    interpolation makes in complete samples near the gap; None if too few samples without a gap are near.
    `time` (n,) and `rate` (n, 3) are times in s and rates in °/s.
    """
    period = sampling.period_s
    lost = np.rint(np.diff(time) / period).astype(int) - 1
    gaps = np.flatnonzero(lost > 0)
    covariance = np.zeros((3, 3))
    path = cumulative_integral(rate, time)
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
    return covariance


def period_of(times_s: list[Floats]) -> float:
    """Return the usual time between samples in s: the median over all dwells.

    Lost samples do not affect it. NaN without samples.
    """
    steps = [np.diff(time) for time in times_s if len(time) > 1]
    return float(np.median(np.concatenate(steps))) if steps else math.nan


MARK_U_DEG = 0.1
"""Standard uncertainty, in degrees, of setting a part against a mark or a stop (an estimate, D)."""
FARTHEST_DEG = 90.0
"""Largest difference, in degrees, between the gyro's angle and the declared angle at which the declared
angle is accepted; a gain error of 2 % in ten turns gives less."""
LEAST_REFERENCE_DEG = 20.0
"""Smallest angle of a turn, in degrees, from which a gyro's scale factor is determined."""
LEAST_INCLINED = math.sin(math.radians(15))
"""Smallest sine of the angle between the axis of a turn and gravity at which gravity shows the turn's
angle."""
STRAIGHT = math.cos(math.radians(5))
"""Smallest ratio of the angle turned to the path of the rotation vector at which a turn in space is about
one axis: the cosine of 5°."""


@dataclass(frozen=True)
class Reference:
    """True rotation of the sensor in a turn, known from gravity or declared.

    Attributes
    ----------
    angle_deg : (3,) float
        Rotation vector, right-handed about the accelerometers' axes.
    covariance_deg2 : (3, 3) float
        Covariance of the rotation vector; an unobserved component has a standard uncertainty of `UNSEEN`
        times the angle.
    modes_deg : (3, k) float or None
        Change of the rotation by one standard uncertainty of each of k errors that turns share; None
        without such errors.
    """

    angle_deg: Floats
    covariance_deg2: Floats
    modes_deg: Floats | None = None


UNSEEN = 0.2
"""Standard uncertainty of an unobserved component of a rotation, as a share of its angle: every gyro is
more accurate."""


def reference_on_stage(
    integral: Integral, before_deg: tuple[float, float], after_deg: tuple[float, float]
) -> Reference | str:
    """Return the true rotation about the stage's axis, by gravity, or why it is unknown.

    `before_deg` and `after_deg` are the angle ψ of gravity from X to Y before and after the turn, each with
    its standard uncertainty.
    """
    seen = float(integral.turned_deg[2])
    part = before_deg[0] - after_deg[0]
    turns = round((seen - part) / 360.0)
    angle = part + 360.0 * turns
    if abs(seen - angle) > max(10.0, 0.1 * abs(angle)):
        return f"the gyro turned {seen:.1f}°, by gravity {angle:.1f}°: not about the stage's axis"
    if abs(angle) < LEAST_REFERENCE_DEG:
        return f"a turn of {angle:.1f}° is too short; a gain needs {LEAST_REFERENCE_DEG:g}° or more"
    return Reference(
        np.array([0.0, 0.0, angle]), np.diag([0.0, 0.0, before_deg[1] ** 2 + after_deg[1] ** 2])
    )


def reference_in_space(integral: Integral, gravity: Sequence[Floats], u_rad: float) -> Reference | str:
    """Return the true rotation by gravity about the axis that the gyros show, or why it is unknown.

    Parameters
    ----------
    gravity : pair of (3,) float
        Direction of gravity before and after the turn.
    u_rad : float
        Standard uncertainty of each direction of gravity.
    """
    size = float(np.linalg.norm(integral.turned_deg))
    if size < LEAST_REFERENCE_DEG:
        return f"a turn of {size:.1f}° is too short; a gain needs {LEAST_REFERENCE_DEG:g}° or more"
    travelled = float(np.linalg.norm(integral.mean_abs_dps)) * integral.length_s
    if size < STRAIGHT * travelled:
        return "it was not turned about one axis; turn about one axis at a time"
    axis = integral.turned_deg / size
    # Components of both unit vectors of gravity across the axis.
    across = [g / np.linalg.norm(g) - axis * (axis @ g) / np.linalg.norm(g) for g in gravity]
    inclined = min(float(np.linalg.norm(a)) for a in across)
    if inclined < LEAST_INCLINED:
        return "the axis was upright, so gravity does not show the angle; declare it (turned_deg)"
    # A direction fixed in space moves backwards in the part: from the second direction to the first.
    part = math.degrees(
        math.atan2(float(axis @ np.cross(across[1], across[0])), float(across[1] @ across[0]))
    )
    turns = round((size - part) / 360.0)
    angle = part + 360.0 * turns
    if abs(angle - size) > max(10.0, 0.1 * size):
        return f"the gyro turned {size:.1f}°, by gravity {angle:.1f}°: not about one axis, or a slip"
    u_deg = math.degrees(math.sqrt(2) * u_rad / inclined)
    along = np.outer(axis, axis)
    # Along the axis the uncertainty by gravity, across it the large one of an unobserved component.
    covariance = u_deg**2 * along + (UNSEEN * angle) ** 2 * (np.eye(3) - along)
    return Reference(angle * axis, covariance)


def reference_as_declared(
    path: Path,
    integral: Integral,
    declared_deg: float,
    triad: Triad,
    delay_s: float,
    u_mark_deg: float,
    consecutive: int,
) -> Reference | str:
    """Return the true rotation about the vertical by a declared angle, or why it is unknown.

    Parameters
    ----------
    declared_deg : float
        Declared angle, positive counter-clockwise seen from above, up to whole turns.
    triad : Triad
        Calibrated accelerometers, which show the vertical during the turn.
    delay_s : float
        Delay of the sensor's filter.
    u_mark_deg : float
        Standard uncertainty of setting the part to the mark, each time.
    consecutive : int
        Number of directly successive declared turns of which this turn is one. Each ends at the mark where
        the next begins, so that an error of setting that mark changes both turns, with opposite signs.
    """
    steady, noise = steady_force(path, integral.begin_s + delay_s, integral.end_s + delay_s)
    # The accelerometers read the opposite of the upward axis.
    down = triad.axes.direction(steady)
    up = -down / np.linalg.norm(down)
    seen = float(up @ integral.turned_deg)
    if np.linalg.norm(integral.turned_deg - seen * up) > 0.2 * max(abs(seen), LEAST_REFERENCE_DEG):
        return (
            "it was not turned about the vertical; leave it flat on the table, or correct the order of the"
            " gyros' axes"
        )
    angle = declared_deg + 360.0 * round((seen - declared_deg) / 360.0)
    if abs(angle) < LEAST_REFERENCE_DEG or abs(seen - angle) > min(
        FARTHEST_DEG, max(10.0, 0.1 * abs(angle))
    ):
        where = (
            "no whole number of turns" if declared_deg % 360 == 0 else f"not {declared_deg:g}° as declared"
        )
        return (
            f"the gyro turned {seen:.0f}° about the vertical, which is {where}: begin and end at the marks,"
            " or correct turned_deg"
        )
    along = np.outer(up, up)
    across = np.eye(3) - along
    # Two marks per turn; a mark between consecutive turns counts in both.
    mark = 2 * u_mark_deg**2 * (2 - 1 / consecutive)
    axis_rad2 = noise / max(float(steady @ steady), 1e-18)
    covariance = mark * along + angle**2 * across @ axis_rad2 @ across
    return Reference(angle * up, covariance, -angle * triad.axes.modes(steady))


def steady_force(path: Path, begin_s: float, end_s: float) -> tuple[Floats, Floats]:
    """Return the constant component of the accelerometers' reading during a turn about one axis.

    The turn is the part of `path` from `begin_s` to `end_s`, in its times.

    Returns
    -------
    (3,) and (3, 3) float
        The component in g, and its covariance by the residual's noise at frequency zero,
        because a hand's shaking is not white.
    """
    rows = (path.time_s >= begin_s) & (path.time_s <= end_s)
    time, force = path.time_s[rows], path.force_g[rows]
    rate = path.rate_dps[rows] - path.zero_dps.mean(axis=0)
    turned = np.trapezoid(rate, time, axis=0)
    # Rate about the axis of the whole turn, and its integral.
    spin = np.radians(rate @ (turned / np.linalg.norm(turned)))
    angle = cumulative_integral(spin, time)
    starts = np.unique(np.linspace(0, len(time), 400, endpoint=False).astype(np.intp))
    # Least squares on means of blocks: constant, tilt of the table, and both terms of a lever arm.
    speed, *tilted = (block_means(term, starts) for term in (spin, np.cos(angle), np.sin(angle), spin**2))
    jerk = np.gradient(speed, block_means(time, starts))
    design = np.column_stack([np.ones(len(starts)), *tilted, jerk])
    size = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    seen = block_means(force, starts)
    found = np.linalg.lstsq(design / size, seen, rcond=1e-8)[0] / size[:, None]
    residual = seen - design @ found
    inverse = np.linalg.pinv((design / size).T @ (design / size))[0, 0] / size[0] ** 2
    noise, n = noise_of_means([residual]), len(residual)
    covariance = n**2 / (n - design.shape[1]) * inverse * noise.covariance[0] + np.diag(noise.flicker)
    return np.asarray(found[0]), covariance


SKEWS = tuple(f"skew_{AXES[i]}{AXES[j]}" for i, j in SKEW_AXES)
BIASES = tuple(f"bias_{axis}" for axis in AXES)
NAMES = (*(f"scale_{axis}" for axis in AXES), *SKEWS, *BIASES)
CONSISTENT = 4.0
"""Largest difference between the declared angle and the angle by gravity, in standard uncertainties, at
which both are averaged."""
UNKNOWN_SKEW_DEG = 0.25
UNKNOWN_BIAS_MG = 50.0
"""Standard uncertainty, in mg, of an accelerometer's bias without a measurement: the one real ADIS16350
showed +57, −21, +46 mg. The default of 10 mg of simulated parts is an estimate, and no limit."""
UNKNOWN_ACCEL_GAIN = 0.02
_NATURAL = np.array([1.0] * 3 + [math.pi / 180] * 3 + [1.0] * 3)
"""Factors from the units of results to the units of `Axes.values`: skews from degrees to rad."""
_NOT_CALIBRATED = (
    "the accelerometers' biases are not determined: u of the directions of axes includes them;"
    " rest each arrow up and down"
)
_NOT_SQUARE = (
    "the angles between the accelerometers are not determined: u of the directions of axes includes"
    " them; rest the part with gravity shared between two axes"
)


@dataclass(frozen=True)
class Axes:
    """Scale factors, skews and biases of three accelerometers, with their covariance.

    Attributes
    ----------
    values : (9,) float
        Scale factors, skews in rad, biases in mg.
    factor : (9, k) float
        Matrix F with the covariance F Fᵀ of the values; its columns are independent errors of one standard
        uncertainty.
    known : frozenset of str
        Names of the parameters that were measured.
    """

    values: Floats
    factor: Floats
    known: frozenset[str]

    @classmethod
    def of(cls, prior: tuple[float, float, float], *sources: FitResult | Calibration) -> Axes:
        """Combine sources of the nine parameters; if several state a parameter, the first counts.

        Parameters
        ----------
        prior : (float, float, float)
            Standard uncertainty of an unmeasured gain, skew in rad and bias in mg.
        sources : FitResult or Calibration
            Results with parameters and their covariance; one without a covariance does not count.
        """
        values = np.array([1.0] * 3 + [0.0] * 6)
        covariance, known = np.diag(np.repeat(np.array(prior, dtype=float), 3) ** 2), set[str]()
        for source in sources:
            # Δφ of a result in the plane is the skew of X and Y.
            order = ["skew_xy" if name == "delta_phi" else name for name in source.names]
            # Parameters that no earlier source has measured.
            new = [k for k, name in enumerate(NAMES) if name in order and name not in known]
            if source.covariance is None or not new:
                continue
            rows = [order.index(NAMES[k]) for k in new]
            values[new] = [source[source.names[row]].value for row in rows] * _NATURAL[new]
            # Covariance of the new parameters, from the units of results to those used here.
            block = source.covariance[np.ix_(rows, rows)] * np.outer(_NATURAL[new], _NATURAL[new])
            covariance[np.ix_(new, new)] = block
            known |= {NAMES[k] for k in new}
        return cls(values, independent_changes(covariance).T, frozenset(known))

    def direction(self, force_g: Floats) -> Floats:
        """Return the direction of gravity (…, 3) in the accelerometers' frame, from readings (…, 3) in g.

        The vectors are not normalized.
        """
        return _direction(self.values, force_g)

    def modes(self, force_g: Floats) -> Floats:
        """Return the change (3, k) of the direction of gravity by each independent error of the axes.

        The direction is the unit vector that the reading `force_g` (3,) in g shows; the change is for one
        standard uncertainty of each of the k errors.
        """

        def unit(values: Floats) -> Floats:
            vector = _direction(values, force_g)
            return np.asarray(vector / np.linalg.norm(vector))

        return central_differences(unit, self.values, 0.01, self.factor.T)

    def u_rad(self) -> float:
        """Return the standard uncertainty in rad of a direction of gravity that the accelerometers show.

        It comes from the uncertainty of their parameters, holds for each of the two components across the
        direction, and is averaged over directions along the three axes.
        """
        # A direction has two components across it, so half of the squared length counts for each.
        sizes = [np.linalg.norm(self.modes(row)) for row in np.eye(3)]
        return float(np.sqrt(np.mean(np.square(sizes)) / 2))


def _direction(values: Floats, force_g: Floats) -> Floats:
    return np.asarray((force_g - 1e-3 * values[6:]) @ np.linalg.inv(sensitivity(values[:6])).T)


@dataclass(frozen=True)
class Triad:
    """Calibrated accelerometers of a session, which give the true rotation of each turn.

    Attributes
    ----------
    axes : Axes
        Calibration of the accelerometers, with errors that all turns of the session share.
    u_rad : float
        Standard uncertainty of a direction of gravity, along each axis perpendicular to it.
    psi_deg : mapping or None
        Angle ψ of gravity in each dwell and its standard uncertainty, by number of the dwell; None if the
        session has no stage.
    gravity : mapping
        Direction of gravity (3,) in each dwell of a session in space, by number of the dwell; otherwise
        empty.
    notes : tuple of str
        Remarks for the user.
    """

    axes: Axes
    u_rad: float
    psi_deg: dict[int, tuple[float, float]] | None
    gravity: dict[int, Floats]
    notes: tuple[str, ...] = ()

    def reference(self, turn: Turn, integral: Integral) -> Reference | str:
        """Return the true rotation in a turn without a declared angle, or why it is unknown."""
        ends = turn.before, turn.position
        if self.psi_deg is None:
            if not self.gravity.keys() >= set(ends):
                return "one of its dwells has no direction of gravity"
            return reference_in_space(integral, [self.gravity[k] for k in ends], self.u_rad)
        if not self.psi_deg.keys() >= set(ends):
            return "one of its dwells has no angle by gravity"
        return reference_on_stage(integral, *(self.psi_deg[k] for k in ends))


def triad_of(session: Session, calibration: Calibration | None = None) -> Triad:
    """Return the accelerometers of a session, calibrated by a fit to it as far as it determines them.

    Parameters
    ----------
    calibration : Calibration, optional
        Calibration of the same accelerometers, for parameters that the session does not determine.

    Raises
    ------
    UsageError
        The calibration states no uncertainties.
    """
    given = [] if calibration is None else [calibration]
    if calibration is not None and calibration.covariance is None:
        raise UsageError("the calibration of the accelerometers states no uncertainties: fit one that does")
    try:
        from adis_gonio.fitting.fit_result import calibration_as_recorded
        from adis_gonio.fitting.methods import fit, fit_of

        readings = readings_of(session)
        # In space by gravity alone, because the turns will calibrate the gyros.
        result = fit(session, method="ml") if readings.planar else fit_of(readings, "ml")
        own = calibration_as_recorded(result) if readings.planar else None
    except AdisGonioError:
        return _triad_in_space(session, *given)
    u_mg = np.sqrt(np.diagonal(readings.covariance, axis1=1, axis2=2).mean(axis=0))
    if own is None:
        return _triad_in_space(session, result, *given, noise_mg=float(u_mg.max()))
    shown = own.angle(readings.mean, reading_u=list(u_mg))
    biases_open = any(name.startswith("bias") for name in result.undetermined)
    unseen = math.degrees(UNKNOWN_BIAS_MG / session.gravity_mg) if biases_open else 0.0
    u = np.hypot(np.asarray(shown.u_deg), unseen)
    note = "the accelerometers' biases are not determined: u of the turns includes them"
    return replace(
        _triad_in_space(session, *given),
        psi_deg=_with_declared(readings, np.asarray(shown.angle_deg), u),
        notes=(note,) if biases_open else (),
    )


def _triad_in_space(session: Session, *sources: FitResult | Calibration, noise_mg: float = 0.0) -> Triad:
    """Make the triad of a session in space from `sources` of its nine parameters.

    Parameters without a source have the spread that the data sheet gives for this family of sensors.
    `noise_mg` is the noise of a mean reading.
    """
    variant = VARIANTS.get(session.sensor)
    prior = (UNKNOWN_ACCEL_GAIN, math.radians(UNKNOWN_SKEW_DEG) / math.sqrt(3), UNKNOWN_BIAS_MG)
    if variant is not None:
        prior = (variant.performance.scale_error_typical, variant.performance.skew_u_rad, UNKNOWN_BIAS_MG)
    axes = Axes.of(prior, *sources)
    notes: tuple[str, ...] = ()
    if not axes.known.issuperset(BIASES):
        notes = (_NOT_CALIBRATED,)
    elif not axes.known.issuperset(SKEWS):
        notes = (_NOT_SQUARE,)
    per_g = g_per_unit(session)
    gravity = {
        dwell.position: axes.direction(per_g * dwell.accel.mean(axis=0))
        for dwell in session.dwells
        if dwell.accel.shape[1] == 3 and math.isfinite(per_g)
    }
    return Triad(axes, math.hypot(noise_mg / session.gravity_mg, axes.u_rad()), None, gravity, notes)


def _with_declared(readings: Readings, psi: Floats, u: Floats) -> dict[int, tuple[float, float]]:
    """Return the angle ψ of each dwell in degrees with u, averaged with its declared angle.

    `psi` and `u` (n,) are the angles by gravity in degrees with their u; the average is weighted by the
    uncertainties. ψ + θ is the start angle α for all dwells, apart from errors. Angles that disagree are
    not averaged. The keys are the numbers of the dwells.
    """
    sigma = math.degrees(readings.fixture_rad)
    theta = np.degrees(readings.angle_rad)
    if readings.fixture_stated and 0 < sigma < math.inf and np.isfinite(theta).all():
        alpha = math.degrees(mean_direction(np.radians(psi + theta)))
        off = wrap_degrees(psi + theta - alpha)
        agrees = np.abs(off) < CONSISTENT * np.hypot(u, sigma)
        # Weighted mean of both angles, only for dwells in which they agree.
        psi = psi - np.where(agrees, u**2 / (u**2 + sigma**2), 0.0) * off
        u = np.where(agrees, u * sigma / np.hypot(u, sigma), u)
    pairs = zip(psi.tolist(), u.tolist(), strict=True)
    return dict(zip(readings.position.tolist(), pairs, strict=True))
