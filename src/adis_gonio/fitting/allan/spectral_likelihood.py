"""Restricted maximum likelihood of the noise processes on the spectrum of a record at rest.

Sinusoids (a vibrating table, hum) are subtracted from the record first, and the ordinates around them are
left out. The spectrum consists of DCT-II ordinates: the lowest ones individually, the higher ones as
means of narrow bins.

Ordinates are independent and normal with variances linear in the squared coefficients θ ≥ 0. The mean and
the linear slope of each record are no noise. The likelihood therefore describes the part of the data
orthogonal to them (REML), which is a term of rank one for the slope. An absent coefficient is on the
boundary θ = 0, and the likelihood ratio has there the distribution ½χ²₀ + ½χ²₁ (Self and Liang 1987).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, optimize, special

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.uncertainty import LINE_IN_NOISE, NORMAL_95, SLOW_NOISE
from adis_gonio.fitting.allan.noise_processes import line, ordinate_variances, variances

MOST = 12
_LOWEST = 24
"""Fewest cycles per record of a sinusoid that can be separated from slow noise."""
_WIDTH = 48
"""Number of ordinates on each side from which the noise power at an ordinate is estimated."""
_LEAKS = 4
"""Ordinates on either side into which a sinusoid leaks behind Hann's window."""


class SpectralLine(JsonRecord):
    """A sinusoid that was found in a record.

    Attributes
    ----------
    frequency_hz : float
        Frequency after sampling: a vibration above half of the rate appears as its alias.
    amplitude : float
        In the unit of the samples, behind the sensor's filter.
    """

    frequency_hz: float
    amplitude: float


def subtract_sinusoids(
    record: Floats, period_s: float, highest: float
) -> tuple[Floats, list[SpectralLine], NDArray[np.intp]]:
    """Subtract strong sinusoids from a record; also return them and the ordinates that they affect.

    Parameters
    ----------
    record : (n,) float
        Without its linear slope.
    highest : float
        Highest frequency of a sinusoid in cycles per sample.
    """
    found: list[SpectralLine] = []
    masked: list[NDArray[np.intp]] = []
    taken = np.zeros(len(record) // 2 + 1, dtype=bool)
    while len(found) < MOST:
        peak = _peak(record, highest, taken)
        if peak is None:
            break
        place, ratio = peak
        record, amplitude = _subtract_sinusoid(record, place)
        reach = _LEAKS + int(min(math.sqrt(ratio) / 16, len(record) / 256))
        middle = round(place)
        taken[max(0, middle - reach) : middle + reach + 1] = True
        masked.append(np.arange(2 * (middle - reach), 2 * (middle + reach) + 1))
        found.append(SpectralLine(place / len(record) / period_s, amplitude))
    return record, found, np.concatenate(masked) if masked else np.zeros(0, np.intp)


def _peak(record: Floats, highest: float, taken: NDArray[np.bool_]) -> tuple[float, float] | None:
    """Find the strongest sinusoid of a record: its frequency in cycles per record, and power over noise.

    Returns None if no sinusoid exceeds the noise clearly.
    """
    n = len(record)
    last = int(highest * n)
    if last - _LOWEST < 4 * _WIDTH:
        return None
    lines = fft.rfft(record * np.hanning(n + 1)[:-1])[: last + 2]
    power = lines.real**2 + lines.imag**2
    level = _level(power[_LOWEST:last])
    # The rest of a subtracted sinusoid does not count again.
    ratio = np.where(taken[_LOWEST:last], 0.0, power[_LOWEST:last] / level)
    at = int(ratio.argmax())
    # The power is exponential around its level, the mean of about ninety neighbours.
    if ratio[at] < 1.35 * math.log(len(ratio) / LINE_IN_NOISE):
        return None
    # Frequency between two ordinates by the ratio of their amplitudes behind Hann's window.
    k = at + _LOWEST
    side = 1 if power[k + 1] > power[k - 1] else -1
    towards = math.sqrt(power[k + side] / power[k])
    return k + side * max(0.0, (2 * towards - 1) / (towards + 1)), float(ratio[at])


def _level(power: Floats) -> Floats:
    """Mean power of the noise around each ordinate of a spectrum.

    It is the higher one of the levels by the medians on both sides.
    """
    step = _WIDTH // 4
    # Medians over four cells of `step` ordinates; the median of exponential noise is ln 2 times its mean.
    cells = power[: len(power) // step * step].reshape(-1, step)
    windows = np.lib.stride_tricks.sliding_window_view(cells, 4, axis=0)
    medians = np.median(windows, axis=(1, 2)) / math.log(2)
    cell = np.minimum(np.arange(len(power)) // step, len(cells) - 1)
    before = np.clip(cell - 4, 0, len(medians) - 1)
    after = np.clip(cell + 1, 0, len(medians) - 1)
    # On a slope (of the filter, of slow noise) the higher side counts.
    level: Floats = np.maximum(np.maximum(medians[before], medians[after]), 1e-300)
    return level


def _subtract_sinusoid(record: Floats, place: float) -> tuple[Floats, float]:
    phase = 2 * np.pi * place / len(record) * np.arange(len(record))
    # Least squares of cosine and sine at this frequency.
    columns = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    values = np.linalg.solve(columns.T @ columns, columns.T @ record)
    return np.asarray(record - columns @ values, np.float64), float(np.hypot(*values))


SINGLES = 64
"""Number of the lowest ordinates that have a bin each."""
_RELATIVE, _ABSOLUTE = 1 / 32, 1 / 1024
"""Widest bin: relative to its frequency, and in cycles per sample."""
_POINTS = 16
"""Largest number of ordinates of a bin at which the noise densities are computed."""


@dataclass(frozen=True)
class Ordinates:
    """Spectrum of one or several records of an axis: DCT-II ordinates, joined in frequency bins.

    Attributes
    ----------
    frequency : (b,) float
        Highest frequency of each bin in cycles per sample.
    weight : (b,) float
        Number of ordinates.
    power : (b,) float
        Mean of their squares.
    shapes : (b, 4) float
        Mean variance per squared coefficient of each of `noise_processes.KINDS`.
    rounding : (b,) float
        Mean variance of the converter's rounding.
    lines : tuple of (first, ordinate, line)
        For each record: the bin of its first single ordinate, the (s,) single ordinates, and the ordinates
        of a line of slope 1 per sample.
    """

    frequency: Floats
    weight: Floats
    power: Floats
    shapes: Floats
    rounding: Floats
    lines: tuple[tuple[int, Floats, Floats], ...]

    @property
    def columns(self) -> dict[str, Any]:
        """All attributes with one row for each frequency bin, by name."""
        return {name: value for name, value in vars(self).items() if name != "lines"}

    def below(self, frequency: float) -> Ordinates:
        """Copy without the bins above a frequency, in cycles per sample.

        The ordinates of the straight line are cut likewise; the lowest bins suffice to fit it.
        """
        chosen = self.frequency <= frequency
        place = np.cumsum(chosen) - 1
        lines = []
        for first, ordinate, slope in self.lines:
            kept = int(chosen[first : first + len(ordinate)].sum())
            lines.append((int(place[first]), ordinate[:kept], slope[:kept]))
        columns = {name: column[chosen] for name, column in self.columns.items()}
        return Ordinates(lines=tuple(lines), **columns)


def ordinates(
    record: Floats, filter_m: int, period_s: float, rounding: Floats, masked: NDArray[np.intp]
) -> Ordinates:
    """Compute the spectrum (DCT-II ordinates) of a record after its linear slope was subtracted.

    Parameters
    ----------
    record : (n,) float
    rounding : (lags,) float
        Autocovariance of the converter's rounding.
    masked : (l,) int
        Ordinates to leave out.
    """
    n = len(record)
    lines = np.asarray(fft.dct(record, type=2, norm="ortho"), np.float64)[1:]
    grid = _grid(n, filter_m, period_s)
    starts = grid.starts
    kept = np.ones(n - 1, dtype=bool)
    kept[masked[(masked >= 1) & (masked < n)] - 1] = False
    square = np.where(kept, lines**2, 0.0)
    # Sums over the ordinates of each bin.
    weight = np.add.reduceat(kept.astype(np.float64), starts - 1)
    power = np.add.reduceat(square, starts - 1) / np.maximum(weight, 1.0)
    rounded = _rounded(rounding.tobytes(), n, filter_m, period_s)
    singles = min(SINGLES, n - 1)
    number = np.arange(1, singles + 1)
    slope = np.where(kept[:singles], line(n, number.astype(np.float64)), 0.0)
    return Ordinates(
        grid.highest, weight, power, grid.shapes, rounded, ((0, lines[:singles].copy(), slope),)
    )


def together(parts: list[Ordinates]) -> Ordinates:
    """Combine the ordinates of several records of an axis into one object."""
    lines, at = [], 0
    for part in parts:
        lines += [(first + at, ordinate, slope) for first, ordinate, slope in part.lines]
        at += len(part.weight)
    columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns}
    return Ordinates(lines=tuple(lines), **columns)


@dataclass(frozen=True)
class _Grid:
    """Frequency bins for records of one length, and the shapes of the noise processes in them.

    They do not depend on the data.

    Attributes
    ----------
    starts : (b,) int
        First ordinate of each bin.
    highest : (b,) float
        Highest frequency in cycles per sample.
    points : (p,) float
        Ordinates at which densities are computed, `_POINTS` per bin at most.
    first, count : (b,) int
        First point and number of points of a bin.
    shapes : (b, 4) float
    """

    starts: NDArray[np.intp]
    highest: Floats
    points: Floats
    first: NDArray[np.intp]
    count: NDArray[np.intp]
    shapes: Floats

    def mean(self, values: Floats) -> Floats:
        """Mean (b,) in each bin of the values (p,) at its points."""
        return np.asarray(np.add.reduceat(values, self.first) / self.count, np.float64)


@lru_cache(maxsize=8)
def _grid(n: int, filter_m: int, period_s: float) -> _Grid:
    # Axes, and most dwells of a session, have one length.
    starts, stops = _bins(n)
    count = np.minimum(_POINTS, stops - starts)
    first = np.cumsum(count) - count
    owner = np.repeat(np.arange(len(starts)), count)
    # Evenly spaced points within each bin.
    step = np.arange(len(owner)) - first[owner]
    points = starts[owner] + (step + 0.5) / count[owner] * (stops - starts)[owner] - 0.5
    shapes = np.add.reduceat(variances(filter_m, n, points, period_s), first, axis=0) / count[:, None]
    return _Grid(starts, (stops - 1) / (2 * n), points, first, count, shapes)


@lru_cache(maxsize=8)
def _rounded(rounding: bytes, n: int, filter_m: int, period_s: float) -> Floats:
    """Mean variance (b,) in each frequency bin that the converter's rounding causes.

    `rounding` are the bytes of the autocovariance of the rounding errors.
    """
    grid = _grid(n, filter_m, period_s)
    return grid.mean(ordinate_variances(np.frombuffer(rounding), n, grid.points))


def _bins(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Divide the ordinates 1 … n − 1 into bins: the first of each, and the ordinate after its last.

    Low ordinates have a bin each; at higher frequencies the bins are wider.
    """
    edges = list(range(1, min(SINGLES, n - 1) + 1))
    at = edges[-1] + 1
    while at < n:
        edges.append(at)
        at += max(1, int(min(at * _RELATIVE, 2 * n * _ABSOLUTE)))
    starts = np.array(edges, dtype=np.intp)
    return starts, np.append(starts[1:], n).astype(np.intp)


_POWER_90 = 1.2815515655446004
_STEPS, _CLOSE = 60, 1e-7
_CELLS, _LEAST_CELL = 24, 16


@dataclass(frozen=True)
class Profile:
    """Estimate of one noise coefficient (not squared) by its profile likelihood.

    Attributes
    ----------
    value : float
        Maximum of the likelihood.
    u : float
        By the Fisher information; nan at zero.
    low, high : float
        Profile-likelihood interval of 95 %; `low` is 0 if the coefficient may be absent.
    p_value : float
        Probability of such data if the coefficient is absent.
    detectable : float
        Coefficient that this record shows with 90 % power.
    """

    value: float
    u: float
    low: float
    high: float
    p_value: float
    detectable: float

    @property
    def present(self) -> bool:
        """True if the data rule out that this noise process is absent."""
        return self.p_value < SLOW_NOISE

    @property
    def dof(self) -> float:
        """Degrees of freedom at which a standard deviation would have this relative uncertainty."""
        return self.value**2 / (2 * self.u**2) if self.u > 0 else math.nan


class Likelihood:
    """−2 log likelihood of squared coefficients, its slope and its information.

    Parameters
    ----------
    data : Ordinates
        The weight of an empty bin is 0.
    without : collection of int
        Indices of coefficients that the model lacks.
    """

    def __init__(self, data: Ordinates, without: Collection[int] = ()) -> None:
        self._data = data
        self._has = np.array([k not in without for k in range(data.shapes.shape[1])])
        self._least = 1e-12 * float(np.max(data.power, initial=1e-300))
        typical = float(np.average(data.power, weights=data.weight))
        # Bins with equal expectations, as those of records of equal length, count as one.
        same = np.column_stack([data.shapes, data.rounding])
        kinds, self._owner = np.unique(same, axis=0, return_inverse=True)
        self._shapes, self._rounding = kinds[:, :-1], kinds[:, -1]
        self._weight = np.bincount(self._owner, data.weight)
        self._power = np.bincount(self._owner, data.weight * data.power) / np.maximum(self._weight, 1e-300)
        # Scales: each process alone would make up the whole power.
        self.scale = typical / np.average(data.shapes, axis=0, weights=data.weight)
        # The single ordinates of all records, one after another: their bins and their records.
        size = np.array([len(c) for _, c, _ in data.lines])
        self._singles = self._owner[np.concatenate([np.arange(f, f + len(c)) for f, c, _ in data.lines])]
        self._has_line = size > 0
        self._starts = (np.cumsum(size) - size)[self._has_line]
        self._record = np.repeat(np.arange(len(self._starts)), size[self._has_line])
        self._c = np.concatenate([c for _, c, _ in data.lines])
        self._d = np.concatenate([d for _, _, d in data.lines])

    def expected(self, theta: Floats) -> Floats:
        """Expected variance (k,) in each distinct frequency bin for the squared coefficients θ."""
        return np.asarray(np.maximum(self._shapes @ theta + self._rounding, self._least), np.float64)

    def _lines(self, v: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Terms and sums for the weighted fit of a straight line to each of r records with ordinates.

        The bins have the variances v. The results are the terms (s,) of a = Σ d²/v and of b = Σ c d/v over
        the single ordinates of all records, then a (r,) and b (r,); c are the ordinates of a record, and d
        the ordinates of a line of slope 1. Records without a line have an infinite a.
        """
        square, product = self._d**2 / v[self._singles], self._c * self._d / v[self._singles]
        a, b = np.add.reduceat(square, self._starts), np.add.reduceat(product, self._starts)
        return square, product, np.where(a > 0, a, np.inf), b

    def deviance(self, theta: Floats) -> float:
        """Deviance, −2 log likelihood up to a constant, of the squared coefficients θ."""
        v = self.expected(theta)
        total = float(self._weight @ (np.log(v) + self._power / v))
        _, _, a, b = self._lines(v)
        seen = np.isfinite(a)
        return total + float((np.log(a[seen]) - b[seen] ** 2 / a[seen]).sum())

    def slope_and_information(self, theta: Floats) -> tuple[Floats, Floats]:
        """Gradient (4,) of the deviance by the squared coefficients θ, and Fisher information (4, 4)."""
        v = self.expected(theta)
        relative = self._shapes / v[:, None]
        slope = relative.T @ (self._weight * (1 - self._power / v))
        information = relative.T @ (self._weight[:, None] * relative)
        square, product, a, b = self._lines(v)
        # Derivatives of ln a − b²/a, the REML terms of the records' lines.
        shape = relative[self._singles]
        da = -np.add.reduceat(square[:, None] * shape, self._starts, axis=0) / a[:, None]
        db = -np.add.reduceat(product[:, None] * shape, self._starts, axis=0)
        slope += da.sum(axis=0) - 2 * (b / a) @ db + (b**2 / a) @ da
        information += da.T @ da - 2 * shape.T @ ((square / a[self._record])[:, None] * shape)
        return slope, information / 2

    def maximum(self, start: Floats, fixed: dict[int, float] | None = None) -> tuple[Floats, float]:
        """θ (4,) ≥ 0 of the largest likelihood and its deviance, by projected Fisher scoring.

        Parameters
        ----------
        fixed : dict
            Values of fixed coefficients, by index.
        """
        held = fixed or {}
        theta = np.where(self._has, np.maximum(start, 0.0), 0.0)
        for index, value in held.items():
            theta[index] = value
        loose = self._has & np.array([index not in held for index in range(len(theta))])
        best = self.deviance(theta)
        for _ in range(_STEPS):
            slope, information = self.slope_and_information(theta)
            free = loose & ((theta > 0) | (slope < 0))
            if not free.any():
                break
            step = self._step(slope, information, free)
            theta, now = self._along(theta, step, best)
            if best - now < _CLOSE:
                return theta, min(best, now)
            best = now
        return theta, best

    def _step(self, slope: Floats, information: Floats, free: np.ndarray) -> Floats:
        step = np.zeros(len(slope))
        scale = self.scale[free]
        # Scaled Newton step by the expected information of the free coefficients.
        inner = information[np.ix_(free, free)] * np.outer(scale, scale)
        step[free] = -scale * (np.linalg.pinv(inner, rcond=1e-13) @ (slope[free] * scale)) / 2
        return step

    def _along(self, theta: Floats, step: Floats, best: float) -> tuple[Floats, float]:
        for _ in range(30):
            trial = np.maximum(theta + step, 0.0)
            now = self.deviance(trial)
            if now <= best:
                return trial, now
            step = step / 2
        return theta, best

    def best(self) -> tuple[Floats, float]:
        """Maximize the likelihood from several starting values; return θ (4,) and its deviance."""
        white = np.array([0.0, self.scale[1], 0.0, 0.0])
        # White noise alone, a little slow noise, and all processes alike.
        starts = [white + share * self.scale * [0.0, 0.0, 1.0, 1.0] for share in (0.0, 0.01)]
        starts.append(self.scale / 4)
        return min((self.maximum(start) for start in starts), key=lambda found: found[1])

    def u_squared(self, theta: Floats, index: int) -> float:
        """Standard uncertainty of the squared coefficient θ[index], by the Fisher information.

        Other coefficients count as free if they are above zero.
        """
        _, information = self.slope_and_information(theta)
        with_it = (theta > 0) | (np.arange(len(theta)) == index)
        scale = np.where(with_it, self.scale, 0.0)
        inverse = np.linalg.pinv(information * np.outer(scale, scale), rcond=1e-13)
        return float(scale[index] * math.sqrt(max(inverse[index, index], 0.0)))

    def slopes(self, theta: Floats) -> list[tuple[float, float]]:
        """Slope per sample of the straight line fitted to each record, and its standard uncertainty."""
        _, _, a, b = self._lines(self.expected(theta))
        slope, u = np.zeros(len(self._has_line)), np.full(len(self._has_line), np.inf)
        slope[self._has_line], u[self._has_line] = b / a, np.where(np.isfinite(a), 1 / np.sqrt(a), np.inf)
        return list(zip(slope.tolist(), u.tolist(), strict=True))

    def adequacy(self, theta: Floats) -> float:
        """p-value of the spectrum under the model θ: small if these noise processes do not explain it.

        The test compares the mean power in groups of neighbouring ordinates with the model.
        """
        data = self._data
        v = self.expected(theta)[self._owner]
        order = np.argsort(data.frequency, kind="stable")
        weight, ratio = data.weight[order], (data.power / v)[order]
        filled = np.cumsum(weight)
        width = max(float(filled[-1]) / _CELLS, _LEAST_CELL)
        # Half of the cells have equal numbers of ordinates, half are octaves, so that slow noise has cells.
        edges = np.concatenate([np.arange(1, _CELLS) * width, _LEAST_CELL * 2.0 ** np.arange(_CELLS)])
        edges = np.unique(edges[edges < filled[-1] - _LEAST_CELL])
        cuts = np.unique(np.concatenate([[0], np.searchsorted(filled, edges) + 1]))
        cuts = cuts[cuts < len(weight)]
        sums = np.add.reduceat(weight, cuts)
        mean = np.add.reduceat(weight * ratio, cuts) / np.maximum(sums, 1.0)
        kept = sums >= _LEAST_CELL / 2
        mean = np.maximum(mean[kept], 1e-12)
        distance = float(np.sum(sums[kept] * (mean - 1 - np.log(mean))))
        dof = int(kept.sum()) - int((theta > 0).sum())
        return float(special.chdtrc(dof, distance)) if dof > 0 else 1.0


def profile(likelihood: Likelihood, theta: Floats, least: float, index: int) -> Profile:
    """Estimate of one coefficient with its interval, by the likelihood maximized over the others.

    `theta` is the maximum of the likelihood over all squared coefficients, and `least` its deviance.
    """
    absent, deviance = likelihood.maximum(theta.copy(), {index: 0.0})
    ratio = max(deviance - least, 0.0)
    p_value = 0.5 * float(special.chdtrc(1, ratio)) if theta[index] > 0 else 1.0
    u_squared = likelihood.u_squared(theta, index)
    sigma = math.sqrt(theta[index])
    u = u_squared / (2 * sigma) if sigma > 0 else math.nan
    dof = max(sigma**2 / (2 * u**2), 1.0) if sigma > 0 else 1.0
    # With few degrees of freedom the likelihood ratio exceeds χ² by the mean of ln χ² (Bartlett).
    limit = NORMAL_95**2 * (1 + 1 / (3 * dof))

    def beyond(squared: float) -> float:
        return likelihood.maximum(theta, {index: squared})[1] - least - limit

    top = theta[index] + NORMAL_95 * max(u_squared, 1e-12 * likelihood.scale[index])
    high = _root_above(beyond, max(theta[index], 0.0), top)
    low = _root_below(beyond, float(theta[index])) if p_value < SLOW_NOISE else 0.0
    return Profile(
        value=sigma,
        u=u,
        low=math.sqrt(low),
        high=math.sqrt(high),
        p_value=p_value,
        detectable=_detectable(likelihood, absent, index),
    )


def _root_above(beyond: Callable[[float], float], begin: float, top: float) -> float:
    for _ in range(60):
        if beyond(top) > 0:
            break
        begin, top = top, 2 * top
    return float(optimize.brentq(beyond, begin, top, rtol=1e-5))


def _root_below(beyond: Callable[[float], float], top: float) -> float:
    low = top
    for _ in range(40):
        low /= 2
        if beyond(low) > 0:
            return float(optimize.brentq(beyond, low, 2 * low, rtol=1e-5))
    return 0.0


def _detectable(likelihood: Likelihood, absent: Floats, index: int) -> float:
    """Smallest coefficient that nine of ten records like this one would detect.

    `absent` (4,) is the best model without this process.
    """
    at = absent.copy()
    without = likelihood.u_squared(at, index)
    # The uncertainty depends on the size, so iterate.
    size = (NORMAL_95 + _POWER_90) * without
    for _ in range(8):
        at[index] = size
        size = NORMAL_95 * without + _POWER_90 * likelihood.u_squared(at, index)
    return math.sqrt(size)
