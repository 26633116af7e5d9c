"""Integral of the three rates over a turn, from rest to rest.

A turn is integrated by the trapezoidal rule on the samples' own times, from the last sample of the dwell
before to the first of the dwell after. The chip's Bartlett filter delays what it shows by N − 1 samples, so
that the integral belongs to an interval that began and ended so much earlier; both its ends are at rest,
where the filter's smearing of 2N − 1 samples holds nothing back.

Lost scans are bridged by a straight line. How far off that is, the turn itself tells: the same bridge is
laid over all stretches of that length around the gap of which every sample is there, and the mean square
of its error is the variance. A gap too long for that refuses the turn, unless the part rested on both sides
of it and nothing has turned before it (or after it): the interval then begins (or ends) there.

What is long at rest before the motion and after it is left out too, where it holds no turning: it would add
nothing but the gyro's drift.

Integral of attitude: the rotation of the part over a turn, and what errors of its gyros do to it.

A direction fixed in space goes backwards in the part: u̇ = −ω × u. Between two samples the rate is their
mean, and the rotation by it is exact (Rodrigues), so that u(t₁) = Φ(t₁, t₀) u(t₀) with a product of
rotations Φ. A small error δω of the rates turns the result by ε, u(t₁) → u(t₁) + ε × u(t₁) with

    ε = −∫ Φ(t₁, t) δω(t) dt,

which is linear in all that a gyro can have: with ω = A⁻¹ (m − z − a |m − z|) for readings m, zero rate z,
gains and directions A, asymmetry a, it is ε = ∫ Φ(t₁, t) A⁻¹ (δA ω + δz + δa |m − z|) dt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats

LONGEST_GAP_S = 0.25
"""Lost scans that may be bridged within a turn; a hand's submovements take longer (`sim.hand`)."""
MARGIN_S = 1.0
"""Rest that is kept on both sides of the motion."""
WINDOW_S = 0.1
"""Means over this tell motion from rest."""
MOVING_DPS = 1.0
"""A mean above this is motion; a part at rest shows less, whatever its attitude."""
MOVING_NOISE = 6.0
"""The same in standard deviations of the mean."""
SHIFTED_G = 0.01
"""Change of what the accelerometers read from which the part lies otherwise (0.6°)."""
HELD_NOISE = 6.0
"""What is left out at the ends may hold so many standard uncertainties of its own integral."""
_BRIDGED_NEAR_S = 1.0
_LEAST_BRIDGES = 8


@dataclass(frozen=True)
class Sampling:
    """How the rates were sampled.

    Attributes
    ----------
    period_s : float
        Between samples where none is lost.
    filter_m : int
        M of the Bartlett filter; 0 where it is not known.
    range_dps : float
        What the gyros can show at most; inf unknown.
    density_dps2 : (3, 3) float
        Spectral density of their noise at frequency zero, two-sided, per sample: the variance of the sum of
        n samples is n times that.
    drift_dps : (3,) float
        Allan deviation of their 1/f noise.
    """

    period_s: float
    filter_m: int
    range_dps: float
    density_dps2: Floats
    drift_dps: Floats

    @property
    def delay_s(self) -> float:
        """By which the filter delays what it shows: N − 1 samples."""
        return float((2**self.filter_m - 1) * self.period_s)

    @property
    def window(self) -> int:
        """Samples whose mean tells motion from rest; no fewer than the filter mixes."""
        return max(8, round(WINDOW_S / self.period_s), int(2 * 2**self.filter_m - 1))

    @property
    def moving_dps(self) -> Floats:
        """Mean (3,) of a window above which the part moves."""
        spread = np.sqrt(np.diagonal(self.density_dps2) / self.window)
        return np.maximum(MOVING_DPS, MOVING_NOISE * spread)


@dataclass(frozen=True)
class Path:
    """Samples from the last one of a dwell to the first one of the next.

    Attributes
    ----------
    time_s : (n,) float
        Increasing.
    rate_dps : (n, 3) float
    force_g : (n, 3) float
        What the accelerometers read.
    zero_dps, rest_g : (2, 3) float
        Means of the rates, and of what the accelerometers read, in both dwells.
    """

    time_s: Floats
    rate_dps: Floats
    force_g: Floats
    zero_dps: Floats
    rest_g: Floats


@dataclass(frozen=True)
class Integral:
    """A turn as its integral.

    Attributes
    ----------
    begin_s, end_s : float
        Interval to which it belongs, the filter's delay taken off.
    angle_deg : (3,) float
        Integral of what the gyros showed, their zero rate in it.
    covariance_deg2 : (3, 3) float
        From noise and bridged gaps; what the zero rate does meanwhile is not in it.
    turned_deg : (3,) float
        The same without the zero rate, which goes from that of the dwell before to that of the one after:
        good enough to count turns and to find the axis.
    force_g : (3,) float
        Mean of what the accelerometers read.
    moment_g : (3, 3) float
        Mean of its outer product with itself.
    mean_abs_dps : (3,) float
        Mean of |rate − zero|: what an asymmetry of the gain multiplies.
    peak_dps : (3,) float
        Largest |rate|.
    samples, bridged : int
        Samples, and how many of the interval are missing.
    """

    begin_s: float
    end_s: float
    angle_deg: Floats
    covariance_deg2: Floats
    turned_deg: Floats
    force_g: Floats
    moment_g: Floats
    mean_abs_dps: Floats
    peak_dps: Floats
    samples: int
    bridged: int

    @property
    def length_s(self) -> float:
        """Of the interval."""
        return self.end_s - self.begin_s


def integrate(path: Path, sampling: Sampling) -> Integral | str:
    """Integral of a turn; where there can be none, why not in words."""
    if len(path.time_s) < 2 * sampling.window:
        return "nothing was recorded between the dwells"
    peak = np.abs(path.rate_dps).max(axis=0)
    if (peak >= sampling.range_dps).any():
        axis = "xyz"[int(np.argmax(peak))]
        return (
            f"gyro {axis} went to {peak.max():.0f} °/s, beyond its range of ±{sampling.range_dps:.0f} °/s:"
            " turn more slowly, or choose a wider range"
        )
    moving = _moving(path, sampling)
    steps = np.diff(path.time_s)
    long = np.flatnonzero(steps > LONGEST_GAP_S)
    if not moving.any():
        turned = _lies_otherwise(path, path.rest_g[1:], 0)
        return "the part was turned while nothing was recorded" if turned else "the part was not turned"
    first, last = int(moving.argmax()), len(moving) - 1 - int(moving[::-1].argmax())
    within = long[(long >= first) & (long < last)]
    if within.size:
        worst = int(within[np.argmax(steps[within])])
        return (
            f"no samples for {steps[worst]:.2g} s while it was turned; at most {LONGEST_GAP_S:g} s can be"
            " bridged"
        )
    # A window across a gap sees only one side of it: the motion may have begun within.
    begin = _begin(path, sampling, first, [int(k) + 1 for k in long if k < first])
    end = _end(path, sampling, last, [int(k) for k in long if k >= last])
    edge = sampling.window // 2
    heads = _lies_otherwise(path, path.force_g[begin : begin + edge], 0)
    if heads or _lies_otherwise(path, path.force_g[end - edge + 1 : end + 1], 1):
        return "a part of the turn went by while nothing was recorded"
    if moving[begin : begin + edge].any() or moving[end - edge + 1 : end + 1].any():
        return "the part was moving already where the recording begins, or still where it ends"
    return integral_over(path, sampling, begin, end)


def _lies_otherwise(path: Path, here_g: Floats, rest: int) -> bool:
    """True where what the accelerometers read (n, 3) is not what they read in one of the dwells.

    About the vertical nothing shows it.
    """
    off = np.abs(here_g.mean(axis=0) - path.rest_g[rest])
    noise = here_g.std(axis=0) / math.sqrt(len(here_g))
    return bool((off > np.maximum(SHIFTED_G, MOVING_NOISE * noise)).any())


def _moving(path: Path, sampling: Sampling) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """True (n,) where the mean of a window about a sample is beyond rest."""
    rate = path.rate_dps - path.zero_dps.mean(axis=0)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(rate, axis=0)])
    half = sampling.window // 2
    low = np.maximum(np.arange(len(rate)) - half, 0)
    high = np.minimum(np.arange(len(rate)) + half + 1, len(rate))
    mean = (total[high] - total[low]) / (high - low)[:, None]
    # The two dwells lie differently, and what gravity does to a gyro is none of its turning.
    allowed = sampling.moving_dps + np.abs(path.zero_dps[1] - path.zero_dps[0])
    moves: np.ndarray[tuple[int], np.dtype[np.bool_]] = (np.abs(mean) > allowed).any(axis=1)
    return moves


def _begin(path: Path, sampling: Sampling, first: int, gaps: list[int]) -> int:
    """Sample at which the interval begins: after the last long gap, and not long before the motion."""
    start = max(gaps, default=0)
    wanted = int(np.searchsorted(path.time_s, path.time_s[first] - MARGIN_S))
    if wanted > start and _holds_nothing(path, sampling, start, wanted, path.zero_dps[0]):
        return wanted
    return start


def _end(path: Path, sampling: Sampling, last: int, gaps: list[int]) -> int:
    stop = min(gaps, default=len(path.time_s) - 1)
    wanted = int(np.searchsorted(path.time_s, path.time_s[last] + MARGIN_S))
    if wanted < stop and _holds_nothing(path, sampling, wanted, stop, path.zero_dps[1]):
        return wanted
    return stop


def _holds_nothing(path: Path, sampling: Sampling, low: int, high: int, zero_dps: Floats) -> bool:
    """True where what lies between two samples is the zero rate of the dwell beside it and noise."""
    time, rate = path.time_s[low : high + 1], path.rate_dps[low : high + 1] - zero_dps
    length = float(time[-1] - time[0])
    if length <= 0:
        return True
    held = np.abs(np.trapezoid(rate, time, axis=0))
    noise = np.diagonal(sampling.density_dps2) * length * sampling.period_s
    u = np.sqrt(noise + (sampling.drift_dps * length) ** 2 * 2)
    return bool((held < HELD_NOISE * u).all())


def integral_over(path: Path, sampling: Sampling, begin: int, end: int) -> Integral | str:
    """Integral from one sample to another, wherever they lie; where there can be none, why not."""
    rows = slice(begin, end + 1)
    time, rate, force = path.time_s[rows], path.rate_dps[rows], path.force_g[rows]
    steps, length = np.diff(time), float(time[-1] - time[0])
    weight = np.zeros(len(time))
    weight[:-1] += steps / 2
    weight[1:] += steps / 2
    share = weight / length
    bridges = _bridges(time, rate, sampling)
    if bridges is None:
        return "too many scans were lost while it was turned to tell what is missing"
    missing, bridged = bridges
    zero = path.zero_dps.mean(axis=0)
    angle = weight @ rate
    noise = sampling.density_dps2 * (len(time) - 1) * sampling.period_s**2
    return Integral(
        begin_s=float(time[0]) - sampling.delay_s,
        end_s=float(time[-1]) - sampling.delay_s,
        angle_deg=angle,
        covariance_deg2=noise + missing,
        turned_deg=angle - length * zero,
        force_g=share @ force,
        moment_g=np.einsum("n,ni,nj->ij", share, force, force),
        mean_abs_dps=share @ np.abs(smooth(rate - zero, sampling.window)),
        peak_dps=np.abs(rate).max(axis=0),
        samples=len(time),
        bridged=bridged,
    )


def smooth(rate: Floats, window: int) -> Floats:
    """Means of blocks, each for its samples: of noise about zero, |mean| is not mean |…|."""
    starts = np.arange(0, len(rate), window)
    counts = np.diff(np.append(starts, len(rate)))
    means = np.add.reduceat(rate, starts, axis=0) / counts[:, None]
    return np.asarray(np.repeat(means, counts, axis=0))


def _bridges(time: Floats, rate: Floats, sampling: Sampling) -> tuple[Floats, int] | None:
    """Covariance (3, 3) in deg² of what straight lines over lost scans leave, and how many were lost.

    None where too few samples are left around a gap.
    """
    period = sampling.period_s
    lost = np.rint(np.diff(time) / period).astype(int) - 1
    gaps = np.flatnonzero(lost > 0)
    covariance = np.zeros((3, 3))
    if not gaps.size:
        return covariance, 0
    means = (rate[1:] + rate[:-1]) / 2
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(means * np.diff(time)[:, None], axis=0)])
    for size in np.unique(lost[gaps]).tolist():
        width = size + 1
        span = time[width:] - time[:-width]
        left = path[width:] - path[:-width] - span[:, None] * (rate[width:] + rate[:-width]) / 2
        whole = span < (width + 0.5) * period
        for gap in gaps[lost[gaps] == size].tolist():
            near = whole & (np.abs(time[: len(span)] - time[gap]) < _BRIDGED_NEAR_S + width * period)
            if int(near.sum()) < _LEAST_BRIDGES:
                near = whole
            if int(near.sum()) < _LEAST_BRIDGES:
                return None
            rows = left[near]
            covariance += rows.T @ rows / len(rows)
    return covariance, int(lost[gaps].sum())


def period_of(times_s: list[Floats]) -> float:
    """Time between samples where none is lost: the median of all; nan where there is none."""
    steps = [np.diff(time) for time in times_s if len(time) > 1]
    return float(np.median(np.concatenate(steps))) if steps else math.nan


PARAMETERS = 21
"""Of three gyros: A (9, row by row), g-sensitivity (9, row by row) in °/s/g, asymmetry (3)."""


@dataclass(frozen=True)
class AssumedGyros:
    """What three gyros are taken for.

    Attributes
    ----------
    sensitivity : (3, 3) float
        A: gains times directions, a row a gyro.
    per_g : (3, 3) float
        What force adds, °/s/g.
    asymmetry : (3,) float
        What |rate| adds, relative.
    """

    sensitivity: Floats
    per_g: Floats
    asymmetry: Floats

    @classmethod
    def of(cls, values: Floats) -> AssumedGyros:
        """From `PARAMETERS` values in their order."""
        return cls(values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:])


@dataclass(frozen=True)
class Attitude:
    """What a turn did to a direction fixed in space.

    Attributes
    ----------
    rotation : (3, 3) float
        Φ: components in the part after the turn, from those before.
    by_parameter : (3, 21) float
        ∂ε/∂(A, g-sensitivity, asymmetry), rad, rad/(°/s/g), rad.
    by_zero : (3, 3) float
        ∂ε/∂(zero rate), rad/(°/s).
    noise_rad2 : (3, 3) float
        Covariance of ε for white noise of the rates.
    travelled_rad : float
        Length of the way, ∫ |ω| dt.
    """

    rotation: Floats
    by_parameter: Floats
    by_zero: Floats
    noise_rad2: Floats
    travelled_rad: float


def attitude(
    time_s: Floats,
    rate_dps: Floats,
    force_g: Floats,
    gyros: AssumedGyros,
    noise_dps2: Floats,
    magnitude_dps: Floats | None = None,
) -> Attitude:
    """Rotation over a turn.

    Parameters
    ----------
    time_s : (n,) float
    rate_dps : (n, 3) float
        Readings less the zero rate without force.
    force_g : (n, 3) float
        What the accelerometers read beyond the force at which that zero rate holds.
    gyros : AssumedGyros
    noise_dps2 : (3, 3) float
        Covariance of one sample, as the spectral density at frequency zero has it.
    magnitude_dps : (n, 3) float, optional
        |rate| without the samples' noise; by default of `rate_dps` as it is.
    """
    inverse = np.linalg.inv(gyros.sensitivity)
    free = rate_dps - force_g @ gyros.per_g.T
    size = np.abs(free) if magnitude_dps is None else magnitude_dps
    omega = np.radians(free - gyros.asymmetry * size) @ inverse.T
    steps = np.diff(time_s)
    to_end = _to_end((omega[1:] + omega[:-1]) / 2 * steps[:, None])
    weight = np.zeros(len(time_s))
    weight[:-1] += steps / 2
    weight[1:] += steps / 2
    by_rate = to_end @ inverse
    weighted = weight[:, None, None] * by_rate
    rad = math.pi / 180
    flat = weighted.reshape(-1, 9).T
    by_parameter = np.concatenate(
        [
            (flat @ omega).reshape(3, 9),
            rad * (flat @ force_g).reshape(3, 9),
            rad * (weighted * size[:, None, :]).sum(axis=0),
        ],
        axis=1,
    )
    by_row = weighted.transpose(1, 0, 2)
    noise = rad**2 * (by_row @ noise_dps2).reshape(3, -1) @ by_row.reshape(3, -1).T
    travelled = float(weight @ np.linalg.norm(np.radians(size) @ inverse.T, axis=1))
    return Attitude(to_end[0], by_parameter, rad * weighted.sum(axis=0), noise, travelled)


def _to_end(steps_rad: Floats) -> Floats:
    """Φ(t₁, t) (n + 1, 3, 3) of each sample, from the angles (n, 3) turned between samples.

    Products within blocks of about √n steps, all blocks side by side, then of the blocks.
    """
    n = len(steps_rad)
    size = max(1, math.isqrt(n))
    blocks = -(-n // size)
    turns = np.broadcast_to(np.eye(3), (blocks * size, 3, 3)).copy()
    turns[:n] = rotations(-steps_rad)
    turns = turns.reshape(blocks, size, 3, 3)
    # The last step acts last: Φ of a sample is the product of all later steps, the latest to the left.
    for k in range(size - 2, -1, -1):
        turns[:, k] = turns[:, k + 1] @ turns[:, k]
    after = np.eye(3)
    for block in range(blocks - 1, -1, -1):
        whole = after @ turns[block, 0]
        turns[block] = after @ turns[block]
        after = whole
    return np.concatenate([turns.reshape(-1, 3, 3)[:n], np.eye(3)[None]])


def rotations(vectors_rad: Floats) -> Floats:
    """Matrices (n, 3, 3) of rotation vectors (n, 3): Rodrigues' formula."""
    angle = np.linalg.norm(vectors_rad, axis=1)[:, None, None]
    cross = np.zeros((len(vectors_rad), 3, 3))
    x, y, z = vectors_rad.T
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross[:, 1, 0], cross[:, 2, 0], cross[:, 2, 1] = z, -y, x
    half = np.sinc(angle / (2 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * half**2 * (cross @ cross))
