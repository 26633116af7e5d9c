"""Noise of a dwell's mean: spectral density at frequency zero, and the covariance of 1/f noise.

**Density at zero.** The mean of n samples has the variance S(0)/n, with S the (two-sided, per sample)
spectral density. σ²/n is wrong if neighbouring samples are correlated, and the chip's Bartlett filter
correlates up to 127 of them. Means of batches are no alternative: batches that are long against the
correlation leave few degrees of freedom. Here the periodograms of all dwells are pooled, and their
logarithm is fitted near zero by a polynomial in f². Heidelberger and Welch (1981) use a quadratic; here the
fit is by the Whittle likelihood, in which each ordinate is exponentially distributed about S. The data
choose the band and the order. Bands are halved from the Nyquist frequency down. An order is sufficient if
one or two further terms bring no gain (likelihood ratio, 25 %). Of all bands with a sufficient order, the
band with the smallest variance at zero is used. For white noise this is the whole band, which gives the
textbook σ²/n with all its degrees of freedom; for filtered noise it is only the flat part at low
frequencies.

**1/f noise** would be followed by the polynomial of a narrow band, and be taken for noise that averaging
lowers. A polynomial plus h/f is therefore fitted as well, and is used if it fits better than one or two
further terms. In the three lowest ordinates of every dwell, the density may rise towards zero faster than
the polynomial. This excess, taken as 1/f noise, gives a part of the variance that averaging does not lower.
If 1/f noise is so strong that the polynomial has followed it down to the lowest ordinates (their slope is
then the slope of a power and not of a filter), the whole density there is taken as 1/f noise.

**Covariance of means under 1/f noise.** Noise of the one-sided spectrum h/f has an Allan variance of 2 h ln
2 at every averaging time, and below its corner an autocovariance of constant − h ln|t|. The mean of ln|t −
t'| over two dwells [a, b] and [c, d] is (F(a − d) + F(b − c) − F(a − c) − F(b − d))/((b − a)(d − c)) − 3/2
with F(x) = ½ x² ln|x|; for a dwell with itself it is ln(b − a) − 3/2. The constant (the variance of all
slower noise) belongs to the bias: the mean of 1/f noise over all time has no finite variance. The
uncertainty of a bias is therefore stated against the mean of a session twice as long that continues after
the last dwell; deviations from that mean do not contain the constant, and their covariance is computed
here. The means of N consecutive dwells scatter by N ln N/(2 (N − 1) ln 2) times the Allan variance (Barnes
1969).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats

_CELLS = 32
_LOWEST = 3
_ALONE = 64
"""Number of the lowest ordinates (values of a periodogram) that are not joined into bins, because some are
used one by one."""
_AT_ONCE = 1 << 17
"""Number of samples for which spectra are computed in one call, to limit the memory."""
_LEAST_WEIGHT = 6.0
_GAINS = (1.323, 2.773)
"""Gains in likelihood by one and by two further terms above which the terms are needed: 75 % quantiles of
χ². The low quantiles prefer the narrower band in doubt."""
_CHOICE_COST = 0.5
"""Factor on the degrees of freedom of the density because the data have chosen band and order (0.45 to 0.7
in simulations with the chip's filter).
"""
_SLOPE = 32
_CLEARLY = 2.0
"""Gain in −2 log likelihood above which 1/f noise counts as the better description of the lowest ordinates.
In simulations with 32 ordinates 1/f noise gains 3 or more; the chip's filter loses, or has a power of −2 in
dwells shorter than its window."""
_NOT_QUITE = 0.05
"""Largest gain of likelihood by further terms, as a share of the gain by h/f, at which h/f still describes
the noise: real noise is not 1/f at all frequencies."""
_LEAST_CYCLES = 3.5
"""Least number of cycles in a dwell at the frequency at which the density is 1/e of its value at zero. In
simulations with the chip's filter 3 cycles give two thirds of the true variance, and 6 give all of it."""
_ALLAN_OF_FLICKER = 4 * math.log(2)
"""Allan variance of noise with S(f) = h/f, two-sided, in units of h."""


@dataclass(frozen=True)
class MeanNoise:
    """Noise of the mean readings of d dwells, estimated from the samples.

    Attributes
    ----------
    covariance : (d, axes, axes) float
        Covariance of each mean from noise that averaging lowers, in the squared unit of the samples.
    dof : (d,) float
        Degrees of freedom of that covariance, common to its axes.
    pooled : bool
        True if all dwells share one spectral density.
    flicker : (axes,) float
        Allan variance of the 1/f noise that the dwells show; zero if they show none.
    flicker_limit : (axes,) float
        Upper limit (95 %) of the Allan variance of 1/f noise in the dwells.
    too_short : bool
        True if dwells are too short to distinguish correlation from drift.
    """

    covariance: Floats
    dof: Floats
    pooled: bool
    flicker: Floats
    flicker_limit: Floats
    too_short: bool


@dataclass(frozen=True)
class _Ordinates:
    """Periodograms (spectra) of all dwells with an equal number `n` of samples.

    `dwell` has the indices of these dwells. The lowest ordinates (values of a periodogram) are separate.
    Higher ordinates of a long dwell are joined into bins of frequency, which never cross a limit between
    the bands of the fit. `weight` is the number of ordinates of each bin.
    """

    dwell: NDArray[np.intp]
    n: int
    frequency: Floats
    """Lowest frequency of each bin (k,)."""
    weight: Floats
    by_frequency: Floats
    """Sum of weight times frequency (k,)."""
    by_period: Floats
    """Sum of weight over frequency (k,)."""
    cross: Floats
    """Real part (d, k, axes, axes) of the cross-periodograms of d dwells, as weighted means in the bins."""


_Cells = tuple[Floats, Floats, Floats, Floats]


@dataclass(frozen=True)
class _Foot:
    """Fitted shape of the noise density in a band from frequency zero, relative to its mean over the band.

    `band` is the end of the band in cycles per sample. `log_zero` is the natural logarithm of the density
    at frequency zero and `log_zero_variance` its variance. `coefficients` belong to the polynomial that
    was fitted to the logarithm of the density, `total_weight` is the number of spectral values in this fit.
    `with_flicker` is True if 1/f noise was fitted in addition.
    """

    band: float
    log_zero: float
    log_zero_variance: float
    total_weight: float
    coefficients: Floats
    with_flicker: bool = False

    @property
    def is_white(self) -> bool:
        return self.band == 0.5 and len(self.coefficients) == 1 and not self.with_flicker

    @property
    def corner(self) -> float:
        """Frequency in cycles per sample at which the density falls to 1/e of its value at frequency zero.

        It is at most the end of the band.
        """
        x = np.linspace(0.0, 1.0, 65)
        fallen = np.flatnonzero(self.log_shape(x) < -1)
        return self.band * (float(x[fallen[0]]) if fallen.size else 1.0)

    def log_shape(self, x: Floats) -> Floats:
        """Return ln (density at the frequency x · `band` / density at frequency zero) for each x (n,)."""
        return _basis(x, len(self.coefficients) - 1) @ self.coefficients - self.log_zero


def noise_of_means(samples: Sequence[Floats], scale: Floats | float = 1.0) -> MeanNoise:
    """Estimate the noise of the mean of each dwell from the correlated samples within dwells.

    Parameters
    ----------
    samples : d arrays (n, axes)
        Samples of each dwell, n at least 2; any unit.
    scale : float or (axes,) float
        Factor by which the samples are multiplied first.
    """
    groups = _periodograms(samples, scale)
    has_flicker, all_flicker = _flicker_at_foot(groups)
    foot = _choose_foot(groups, has_flicker=has_flicker)
    d, axes = len(samples), samples[0].shape[1]
    level = np.zeros((d, axes, axes))
    weight = np.zeros(d)
    n = np.array([len(rows) for rows in samples], dtype=float)
    for group in groups:
        # Mean density of each dwell in the chosen band, weighted by the number of ordinates.
        w = group.weight * (group.frequency <= foot.band)
        weight[group.dwell] = w.sum()
        level[group.dwell] = np.einsum("k,dkab->dab", w, group.cross) / max(w.sum(), 1e-300)
    usable = weight > 0
    pooled_level = np.einsum("d,dab->ab", weight, level) / weight.sum()
    pooled = _homogeneous(level, weight)
    # Variance of log density at zero that comes from the fitted shape, not from the level.
    shape_variance = max(foot.log_zero_variance - 1 / foot.total_weight, 0.0)
    kept = 1.0 if foot.is_white else _CHOICE_COST
    if pooled:
        level = np.broadcast_to(pooled_level, level.shape)
        dof = np.full(d, 2 * kept / (1 / weight.sum() + shape_variance))
    else:
        level = np.where(usable[:, None, None], level, pooled_level)
        dof = 2 * kept / (1 / np.where(usable, weight, weight.sum()) + shape_variance)
    density = _without_chance_correlation(level, dof) * math.exp(foot.log_zero)
    flicker, limit = _flicker(groups, density, foot, float(dof[0] if pooled else dof.sum()), n)
    unresolved = bool(np.median(n) * foot.corner < _LEAST_CYCLES and not foot.is_white)
    if np.median(n) * foot.band <= 2 * _SLOPE and not foot.is_white and all_flicker:
        flicker = limit = np.maximum(flicker, _all_flicker(groups))
    return MeanNoise(
        covariance=density / n[:, None, None],
        dof=dof,
        pooled=pooled,
        flicker=flicker,
        flicker_limit=limit,
        too_short=unresolved,
    )


def _periodograms(samples: Sequence[Floats], scale: Floats | float) -> list[_Ordinates]:
    """Return the spectra of dwells in frequency bins, one entry for each length of a dwell.

    `samples` are the samples (n, axes) of each dwell, `scale` is a factor by which they are multiplied.
    """
    lengths = np.array([len(rows) for rows in samples])
    axes = samples[0].shape[1]
    groups = []
    for n in np.unique(lengths).tolist():
        dwell = np.flatnonzero(lengths == n)
        frequency = np.arange(1, n // 2 + 1) / n
        weight = np.ones(len(frequency))
        if n % 2 == 0:
            weight[-1] = 0.5
        starts = _bins(frequency)
        total = np.add.reduceat(weight, starts)
        cross = np.empty((len(dwell), len(starts), axes, axes))
        step = max(1, _AT_ONCE // n)
        for at in range(0, len(dwell), step):
            rows = np.stack([samples[k] for k in dwell[at : at + step].tolist()]) * scale
            # Remove the mean: ordinate zero is the mean itself and is not noise.
            rows -= rows.mean(axis=1, keepdims=True)
            lines = np.fft.rfft(rows, axis=1)[:, 1:]
            for a in range(axes):
                for b in range(a, axes):
                    # Cross-periodogram of two axes; the Nyquist ordinate has half the weight.
                    power = (lines[:, :, a] * lines[:, :, b].conj()).real / n * weight
                    mean = np.add.reduceat(power, starts, axis=1) / total
                    cross[at : at + step, :, a, b] = cross[at : at + step, :, b, a] = mean
        by_frequency = np.add.reduceat(weight * frequency, starts)
        by_period = np.add.reduceat(weight / frequency, starts)
        groups.append(_Ordinates(dwell, n, frequency[starts], total, by_frequency, by_period, cross))
    return groups


def _bins(frequency: Floats) -> NDArray[np.intp]:
    """Divide the values of a spectrum into bins; return the index of the first value in each bin.

    `frequency` has the frequency of each value in cycles per sample, up to 0.5. Each octave has `_CELLS`/2
    bins of equal width, so that the bins of the next higher octave are twice as wide. A value exactly
    between two octaves has a bin of its own, and so have the first `_ALONE` values.
    """
    # frexp splits 2f into octave (band) and mantissa (cell within the band).
    mantissa, octave = np.frexp(2 * frequency)
    cell = np.where(mantissa == 0.5, -1, np.floor(mantissa * _CELLS).astype(int))
    new = (np.diff(octave, prepend=octave[0] - 1) != 0) | (np.diff(cell, prepend=-2) != 0)
    new[:_ALONE] = True
    return np.flatnonzero(new)


def _basis(x: Floats, order: int) -> Floats:
    """Return even polynomials (n, order + 1) of x: Legendre polynomials of 2x² − 1, up to this order."""
    return np.asarray(np.polynomial.legendre.legvander(2 * x * x - 1, order), dtype=np.float64)


def _whittle(
    design: Floats, weight: Floats, mean: Floats, inverse_x: Floats | None = None
) -> tuple[Floats, Floats, float]:
    """Fit a noise density exp(polynomial) to a spectrum; with `inverse_x` plus 1/f noise h/x.

    Return the coefficients (p,) of the polynomial, their covariance (p, p) and −2 log likelihood (Whittle),
    by Fisher scoring. h is not returned; its uncertainty is included in the covariance. `mean` (n,) are the
    mean spectral values in n bins, `weight` (n,) the number of values in each bin, and `inverse_x` (n,) the
    mean of 1/x in each bin, with the frequency x. The columns of `design` (n, p) are the terms of the
    polynomial at the bins.
    """
    terms = design.shape[1]
    slope, inverse = design, np.linalg.pinv(design.T @ (weight[:, None] * design))
    slow = np.zeros(len(mean)) if inverse_x is None else inverse_x
    beta = np.zeros(terms + 1)  # the last one is ln h
    # Start values: white level from the upper half, h from the excess of the lowest ordinate.
    high = slow <= np.median(slow)
    level = max(float(np.average(mean[high], weights=weight[high])), 1e-300)
    beta[0] = math.log(level)
    if inverse_x is not None:
        first = int(slow.argmax())
        beta[-1] = math.log(max(float(mean[first] - level), 1e-3 * level) / float(slow[first]))

    def parts() -> tuple[Floats, Floats]:
        smooth = np.exp(np.clip(design @ beta[:-1], -60, 60))
        return smooth, math.exp(min(max(float(beta[-1]), -60.0), 60.0)) * slow

    for _ in range(50):
        smooth, rising = parts()
        expected = smooth + rising
        if inverse_x is not None:
            # Derivative of log density by the coefficients and by log h.
            slope = np.column_stack([design * smooth[:, None], rising]) / expected[:, None]
            inverse = np.linalg.pinv(slope.T @ (weight[:, None] * slope))
        step = inverse @ (slope.T @ (weight * (mean / expected - 1)))
        # Limit a step, for convergence from a poor start.
        step /= max(1.0, float(np.abs(step).max()))
        beta[: len(step)] += step
        if np.abs(step).max() < 1e-5:
            break
    expected = np.add(*parts())
    deviance = 2 * float(weight @ (np.log(expected) + mean / expected))
    return beta[:-1], np.asarray(inverse[:terms, :terms], dtype=np.float64), deviance


def _flicker_at_foot(groups: list[_Ordinates]) -> tuple[bool, bool]:
    """Return whether 1/f noise explains the lowest spectral values better than filtered noise.

    The first result is for white plus 1/f noise, the second for 1/f noise alone; both are False without a
    long dwell. `groups` has the spectra of the dwells, one entry for each length of a dwell. Only the
    `_SLOPE` lowest values are used, because there a filter is flat; over a wide band the decrease of a long
    filter resembles h/f plus a polynomial.
    """
    total, mean = _lowest(groups)
    if not total.any():
        return False, False
    x = np.arange(1.0, _SLOPE + 1) / _SLOPE
    one = np.ones(_SLOPE)
    filtered = _whittle(np.stack([one, x**2, x**4], axis=1), total, mean)[2]
    white_and_flicker = _whittle(one[:, None], total, mean, 1 / x)[2]
    power, _, alone = _whittle(np.stack([one, np.log(x)], axis=1), total, mean)
    all_flicker = bool(-1.5 < power[1] < -0.6 and alone < filtered - _CLEARLY)
    return white_and_flicker < filtered - _CLEARLY, all_flicker


def _lowest(groups: list[_Ordinates]) -> tuple[Floats, Floats]:
    """Average the `_SLOPE` lowest spectral values over all axes and all dwells with further values.

    Return how many were averaged for each value (0 without such a dwell), and the averages. Values are
    relative to the mean of the lowest values of their dwell and axis, so that loud dwells do not dominate.
    """
    total, moment = np.zeros((2, _SLOPE))
    for group in groups:
        if len(group.weight) > _SLOPE:
            auto = np.diagonal(group.cross[:, :_SLOPE], axis1=2, axis2=3)
            own = auto.mean(axis=1, keepdims=True)
            total += len(group.dwell) * auto.shape[2]
            moment += np.where(own > 0, auto / np.where(own > 0, own, 1.0), 0.0).sum(axis=(0, 2))
    return total, np.maximum(moment / np.maximum(total, 1.0), 1e-12)


def _choose_foot(groups: list[_Ordinates], *, has_flicker: bool) -> _Foot:
    """Fit the noise density near frequency zero in bands of decreasing width; return the most certain fit.

    This is the fit with the smallest variance of the density at frequency zero; of several the one in the
    widest band. `groups` has the spectra of the dwells; `has_flicker` is True to fit 1/f noise, too.
    """
    best: _Foot | None = None
    band, least = 0.5, math.inf
    while (cells := _cells(groups, band)) is not None:
        total = float(cells[1].sum())
        # 1/total is the variance of a flat fit, the smallest possible one in this band.
        if best is not None and (total < _LEAST_WEIGHT or 1 / total > least):
            break
        for with_flicker in (False, True)[: 1 + has_flicker]:
            foot = _fit_foot(band, cells, with_flicker=with_flicker)
            if foot is not None and foot.log_zero_variance < least:
                # Variances that differ by rounding errors count as equal.
                best, least = foot, foot.log_zero_variance * (1 - 1e-9)
        if total < _LEAST_WEIGHT:
            return best or _Foot(band, 0.0, 1 / total, total, np.zeros(1))
        band /= 2
    if best is None:  # the narrowest band has no ordinate: take the whole band as flat
        total = sum(float(group.weight.sum()) * len(group.dwell) for group in groups)
        best = _Foot(0.5, 0.0, 1 / total, total, np.zeros(1))
    return best


def _fit_foot(band: float, cells: _Cells, *, with_flicker: bool) -> _Foot | None:
    """Fit the log noise density in a band by a polynomial of the lowest sufficient order; None without one.

    An order is sufficient if one or two further terms do not improve the fit clearly. With `with_flicker`
    1/f noise is fitted in addition, which has to explain the density better than one or two further terms.
    `cells` are the averages in the `band` (`_cells`).
    """
    x, weight, mean, inverse_x = cells

    @cache
    def fitted(order: int, flicker: bool) -> tuple[Floats, Floats, float]:
        return _whittle(_basis(x, order), weight, mean, inverse_x if flicker else None)

    for order in range(min(3, len(x) - 2 * with_flicker)):
        beta, covariance, deviance = fitted(order, with_flicker)
        better = 0.0
        if with_flicker:
            better = min(fitted(order + k, False)[2] for k in (1, 2)) - deviance
            if better < _CLEARLY:
                continue
        # Likelihood-ratio test against one and two further terms.
        richer = (fitted(order + k, with_flicker)[2] for k in (1, 2) if order + k < len(x) - with_flicker)
        allowed = (max(gain, _NOT_QUITE * better) for gain in _GAINS)
        if not any(deviance - other > most for other, most in zip(richer, allowed, strict=False)):
            # Value and variance of log density, extrapolated to frequency zero.
            at_zero = _basis(np.zeros(1), order)[0]
            variance = float(at_zero @ covariance @ at_zero)
            return _Foot(band, float(at_zero @ beta), variance, float(weight.sum()), beta, with_flicker)
    return None


def _cells(groups: list[_Ordinates], band: float) -> _Cells | None:
    """Average the spectra of all dwells in cells of equal width from frequency zero to `band`.

    The results are arrays (c,) with one value for each cell that is not empty: the mean of x = f/band, the
    number of spectral values, their mean relative to each dwell's mean, and the mean of 1/x. None if all
    cells are empty.
    """
    total, moment, first = np.zeros(_CELLS), np.zeros(_CELLS), np.zeros(_CELLS)
    inverse = np.zeros(_CELLS)
    for group in groups:
        inside = group.frequency <= band
        if not inside.any():
            continue
        f, w = group.frequency[inside], group.weight[inside]
        auto = np.diagonal(group.cross[:, inside], axis1=2, axis2=3)
        own = np.einsum("k,dka->da", w, auto) / w.sum()
        # Axes without any noise have no relative density.
        alive = own > 0
        relative = np.where(alive[:, None, :], auto / np.where(alive, own, 1.0)[:, None, :], 0.0)
        # Cell of each bin within the band.
        cell = np.minimum((f / band * _CELLS).astype(int), _CELLS - 1)
        count = float(alive.sum())
        total += np.bincount(cell, w * count, _CELLS)
        moment += np.bincount(cell, w * relative.sum(axis=(0, 2)), _CELLS)
        first += np.bincount(cell, count / band * group.by_frequency[inside], _CELLS)
        inverse += np.bincount(cell, count * band * group.by_period[inside], _CELLS)
    held = total > 0
    if not held.any():
        return None
    return (
        first[held] / total[held],
        total[held],
        np.maximum(moment[held] / total[held], 1e-12),
        inverse[held] / total[held],
    )


def _homogeneous(level: Floats, weight: Floats) -> bool:
    """Return True if all dwells may have the same noise density, by Bartlett's test for each axis at 0.1 %.

    `level` (d, axes, axes) are the densities of the dwells, `weight` (d,) the numbers of spectral values
    from which each was computed.
    """
    use = weight > 0
    own = np.maximum(np.diagonal(level[use], axis1=1, axis2=2), 1e-300)
    return all(p_of_equal_variances(axis, 2 * weight[use]) >= 1e-3 / own.shape[1] for axis in own.T)


def p_of_equal_variances(variance: Floats, dof: Floats) -> float:
    """Return the p-value of Bartlett's test that k samples of a normal distribution have equal variances.

    `variance` (k,) are their measured variances, above 0, and `dof` (k,) the degrees of freedom.
    """
    if len(variance) < 2:
        return 1.0
    from scipy.special import chdtrc

    correction = 1 + (np.sum(1 / dof) - 1 / dof.sum()) / (3 * (len(dof) - 1))
    common = np.log(dof @ variance / dof.sum())
    return float(chdtrc(len(dof) - 1, max(dof @ (common - np.log(variance)) / correction, 0.0)))


def _without_chance_correlation(level: Floats, dof: Floats) -> Floats:
    """Return noise densities in which correlations between axes are zero if chance explains them.

    Chance explains correlations below three standard errors. `level` (d, axes, axes) are the densities of
    the dwells, `dof` (d,) their degrees of freedom. The results are positive definite.
    """
    deviation = np.sqrt(np.maximum(np.diagonal(level, axis1=1, axis2=2), 1e-300))
    correlation = level / (deviation[:, :, None] * deviation[:, None, :])
    keep = np.abs(correlation) > 3 / np.sqrt(dof)[:, None, None]
    keep |= np.eye(level.shape[1], dtype=bool)
    # An indefinite matrix is worse than a lost correlation; 0.95 keeps its inverse tame.
    one = np.eye(level.shape[1])
    limited = np.where(keep, np.clip(correlation, -0.95, 0.95) + 0.05 * one, 0.0)
    # Three axes that move together, of which one correlation is dropped: all correlations are kept.
    wild = np.linalg.eigvalsh(limited)[:, 0] < 0.049
    limited = np.where(wild[:, None, None], 0.95 * correlation + 0.05 * one, limited)
    return limited * deviation[:, :, None] * deviation[:, None, :]


def _all_flicker(groups: list[_Ordinates]) -> Floats:
    """Return the Allan variance (axes,) of 1/f noise if it were all of the noise at the lowest frequencies.

    The sensor's 1/f noise is equal in all dwells, so dwells with more noise have a smaller weight. `groups`
    has the spectra of the dwells.
    """
    axes = groups[0].cross.shape[-1]
    moment, total = np.zeros(axes), np.zeros(axes)
    k = np.arange(1, _LOWEST + 1)
    for group in groups:
        if len(group.weight) <= _LOWEST:
            continue
        auto = np.diagonal(group.cross[:, :_SLOPE], axis1=2, axis2=3)
        # Weight by higher ordinates: a low ordinate would otherwise get more weight because it is low.
        quiet = _reciprocal(auto[:, _LOWEST:].mean(axis=1))
        moment += (quiet * np.einsum("k,dka->da", k / group.n, auto[:, :_LOWEST])).sum(axis=0) / len(k)
        total += quiet.sum(axis=0)
    return np.asarray(_ALLAN_OF_FLICKER * moment / np.maximum(total, 1e-300))


def _reciprocal(level: Floats) -> Floats:
    """Return 1/level for each dwell and axis; 0 for a level that is only a rounding error.

    `level` are noise densities.
    """
    least = np.maximum(1e-9 * level.max(axis=tuple(range(level.ndim - 1))), 1e-300)
    return np.where(level > least, 1 / np.maximum(level, least), 0.0)


def _flicker(
    groups: list[_Ordinates], density: Floats, foot: _Foot, dof: float, n: Floats
) -> tuple[Floats, Floats]:
    """Return the Allan variance (axes,) of 1/f noise at the lowest frequencies, and its 95 % limit (axes,).

    Both are in the squared unit of the samples. The 1/f noise is the excess of the lowest spectral values
    over the fitted noise: the `density` (d, axes, axes) of each dwell at frequency zero times the fitted
    shape `foot`. `dof` are the degrees of freedom of the density, `n` (d,) the numbers of samples.
    """
    from scipy.special import fdtri

    axes = density.shape[1]
    excess, weight, ordinates = np.zeros(axes), 0.0, 0.0
    for group in groups:
        lowest = np.arange(min(_LOWEST, len(group.weight)))
        k = lowest + 1.0
        shape = np.exp(foot.log_shape(np.minimum(group.frequency[lowest] / foot.band, 1.0)))
        expected = np.diagonal(density[group.dwell], axis1=1, axis2=2)[:, None, :] * shape[None, :, None]
        auto = np.diagonal(group.cross[:, lowest], axis1=2, axis2=3)
        w = group.weight[lowest]
        # A dwell without noise among noisy ones has no information; avoid a ratio of rounding errors.
        each = _reciprocal(expected)
        excess += np.einsum("k,dka->a", w, np.where(each > 0, auto * each, 1) - 1)
        weight += len(group.dwell) * float(w @ (1 / k))
        ordinates += len(group.dwell) * float(w.sum())
    relative = excess / weight
    spread = np.sqrt(ordinates * (1 + ordinates * 2 / dof)) / weight
    # F test (1 %) of the lowest ordinates against the fitted density.
    threshold = float(fdtri(2 * ordinates, max(dof, 1.0), 0.99))
    shown = 1 + excess / ordinates > threshold
    # One 1/f noise for all dwells: noisy dwells, in which it is a small part, get little weight.
    quiet = _reciprocal(np.diagonal(density, axis1=1, axis2=2) / n[:, None])
    per_mean = _ALLAN_OF_FLICKER * (quiet > 0).sum(axis=0) / np.maximum(quiet.sum(axis=0), 1e-300)
    flicker = np.where(shown, np.maximum(relative, 0.0), 0.0) * per_mean
    return flicker, np.maximum(relative + 1.645 * spread, 0.0) * per_mean


MOST_MODES = 128
"""Largest number of modes that describe noise shared by dwells. For 1000 dwells the other modes, faster
than about 16 dwells, are treated as independent noise of each dwell."""


def covariance_of_means(begin_s: Floats, end_s: Floats) -> Floats:
    """Return the covariance (n, n) of the means of n dwells under 1/f noise with an Allan variance of 1.

    Each mean is relative to the mean over a time twice as long as the session.

    Parameters
    ----------
    begin_s, end_s : (n,) float
        Begin and end of each dwell. If a dwell has no length, or begins before the previous one has ended,
        these are not the times of one session, and the dwells are taken as consecutive.

    Source
    ------
    The double integral of −ln|t − t'|; Barnes, Tables of bias functions (NBS TN 375, 1969) for its mean.
    """
    begin_s, end_s = _in_order(begin_s, end_s)
    first = float(begin_s[0])
    begin_s, end_s = np.append(begin_s, first), np.append(end_s, 2 * float(end_s[-1]) - first)
    length = end_s - begin_s
    # F of the module docstring, combined over the four pairs of interval ends.
    crossed = (
        _second_integral(begin_s[:, None] - end_s[None, :])
        + _second_integral(end_s[:, None] - begin_s[None, :])
        - _second_integral(begin_s[:, None] - begin_s[None, :])
        - _second_integral(end_s[:, None] - end_s[None, :])
    )
    mean_log = crossed / (length[:, None] * length[None, :])
    # The last interval is the doubled session: rows are differences from its mean.
    about = np.eye(len(length))[:-1] - np.eye(len(length))[-1]
    covariance: Floats = -about @ mean_log @ about.T / (2 * math.log(2))
    return (covariance + covariance.T) / 2


def _in_order(begin_s: Floats, end_s: Floats) -> tuple[Floats, Floats]:
    """Return begin and end (n,) of dwells in s, corrected if the given times are impossible.

    If a dwell has no length or two dwells overlap, the dwells are taken as consecutive.
    """
    length = end_s - begin_s
    # Shorter dwells are not plausible, and their squares would underflow.
    if (length < 1e-9).any():
        length = np.ones(len(begin_s))
        begin_s = np.arange(len(begin_s), dtype=float)
    elif (begin_s[1:] < end_s[:-1] - 0.1 * length[:-1]).any():
        begin_s = np.cumsum(length) - length
    return begin_s, begin_s + length


def spans(times_s: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Return begin and end (n,) of each dwell in s; the end includes the period of the last sample.

    Each dwell has two or more samples.
    """
    begin = np.array([float(time[0]) for time in times_s])
    period = np.array([float(np.ptp(time)) / (len(time) - 1) for time in times_s])
    return begin, np.array([float(time[-1]) for time in times_s]) + period


def scatter_of_means(dwells: int) -> float:
    """Return the expected variance of the means of `dwells` dwells about their average under 1/f noise.

    The 1/f noise has an Allan variance of 1. The dwells are equally long and follow one another without
    pauses.
    """
    return 1.0 if dwells < 2 else dwells * math.log(dwells) / (2 * (dwells - 1) * math.log(2))


def modes(covariance: Floats) -> tuple[Floats, Floats]:
    """Split a covariance (n, n) into a factor (n, k) of its largest modes and the remaining variances (n,).

    The modes are its eigenvectors with the `MOST_MODES` largest eigenvalues, times the roots of the
    eigenvalues. For 1/f noise they vary slowly in time. The remaining variances are the part of the
    diagonal that the modes do not contain.
    """
    values, vectors = np.linalg.eigh(covariance)
    values, vectors = values[-MOST_MODES:], vectors[:, -MOST_MODES:]
    kept = values > 1e-12 * max(float(values[-1]), 1e-300)
    factor = vectors[:, kept] * np.sqrt(values[kept])
    left = np.diagonal(covariance) - (factor**2).sum(axis=1)
    return factor, np.maximum(left, 0.0)


def _second_integral(x: Floats) -> Floats:
    size = np.abs(x)
    return np.asarray(0.5 * size**2 * np.log(np.where(size > 0, size, 1.0)))
