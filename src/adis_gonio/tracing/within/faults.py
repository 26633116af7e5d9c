"""Faults of the samples: spikes, repeated values, limits, coarse converter steps, noise that changes.

Spikes
    A sample that differs from the median of its neighbours before *and* after it (a step does not) by more
    than a normal distribution allows for all samples of the session. Near the ends of a dwell one side
    decides. The scale is the scatter of such distances, so that slow noise does not count; one and a half
    steps of the converter are subtracted.
Stuck values
    A run of equal values that is longer than the other runs of the axis explain. The run lengths of
    stationary noise have an exponential tail with a rate that depends on filter and converter; the session
    shows the rate, without the longest run of each dwell. Slow noise may also stay within one step for
    its correlation time, depending on its scatter; this probability is computed separately. If the noise is
    below `LIVELY` steps of the converter, constant values are normal and no test is made.
Saturation
    Samples that accumulate at an extreme value (`Readings.converter`). The p-value is the probability of
    this many samples at the extreme rather than one value inside, if both were equally probable.
Quantization
    A converter step q that noise of standard deviation σ does not dither: the error of the means by
    quantization, q²/(2π²)·Σ exp(−4π²k²σ²/q²)/k², exceeds the error by noise, in all dwells together. The
    p-value is the probability that noise with equal errors scatters as little as the samples.
Noise change
    The variance of a dwell is compared above `LOWEST` cycles per dwell, without drift and slow noise. Its
    degrees of freedom depend on the density (correlated neighbours count less), on the excess of the fourth
    moment over that of a normal distribution, and on the converter: if the noise is near its step, the
    variance depends on the position of the mean between two codes. Behind a long filter a few low
    frequencies contain nearly all variance, while added white noise appears at the other frequencies. The
    level is therefore compared too; it is the mean over all frequencies of the power in units of the
    density. Four tests on each axis: all dwells equal (Bartlett), one change between two dwells (F, all
    places), one dwell against the others (F), one change of the level against its scatter from dwell to
    dwell (t, all places).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize, special

from adis_gonio.base.arrays import Floats, robust_sd
from adis_gonio.base.numbers import format_number
from adis_gonio.base.uncertainty import FOUND_WITHIN, INADEQUATE, Detectable, Value
from adis_gonio.fitting.estimation.readings import Readings, quantized_means
from adis_gonio.fitting.estimation.screening import LIVELY, run_lengths
from adis_gonio.fitting.estimation.spectrum import p_of_equal_variances
from adis_gonio.model.records import Session
from adis_gonio.tracing.within.samples import (
    POWER,
    SEARCHES,
    Place,
    Samples,
    WithinFinding,
    axes_and_positions,
    corrected,
    positions_text,
)
from adis_gonio.tracing.within.tones import TAPER_LOSS, Density, without_line

_NEIGHBOURS = 15
_LEAST_SAMPLES = 2 * _NEIGHBOURS
_LEAST_RUN = 8
_LONG_QUANTILE = 0.9
_LEAST_LONG = 20
_SAFETY = 1.5
"""Safety factor on the mean by which long runs exceed their limit, since this mean is an estimate."""


def spikes(samples: Samples, scatter: Floats, reach: int) -> tuple[WithinFinding | None, Samples]:
    """Find spikes in all dwells, and replace them by the median of their neighbours.

    The finding is None without spikes.

    Parameters
    ----------
    samples : Samples
        Samples of all dwells.
    scatter : (d, axes) float
        Standard deviation of single samples in each dwell.
    reach : int
        Number of samples over which neighbours are correlated; the sensor's filter spreads a spike over
        this width.
    """
    total = int(samples.counts.sum()) * samples.axes
    limit = -float(special.ndtri(FOUND_WITHIN / (2 * total * SEARCHES)))
    values = list(samples.values)
    found: list[tuple[Place, float]] = []  # with p-value
    long = np.flatnonzero(samples.counts >= _LEAST_SAMPLES + 2 * reach).tolist()
    for axis in range(samples.axes):
        looks = {k: _from_neighbours(samples.values[k][:, axis], reach) for k in long}
        # The scale of a single dwell is uncertain, and too small if the dwell is hardly longer than the
        # correlation of its noise. It is used only if it exceeds the scale of all dwells.
        usual = robust_sd(np.concatenate([one_side for _, _, one_side in looks.values()])) if looks else 0.0
        for k, (away, middle, one_side) in looks.items():
            rows = samples.values[k]
            spread = max(robust_sd(one_side), usual, 0.5 * float(scatter[k, axis]))
            # Both the neighbours' median and the sample are rounded.
            size = (np.abs(away) - 1.5 * samples.quantum[axis]) / spread
            far = np.flatnonzero(size > limit)
            # Far samples that are at most 2 `reach` + 1 apart are one spike.
            for own in np.split(far, np.flatnonzero(np.diff(far) > 2 * reach + 1) + 1) if far.size else ():
                first, last = int(own[0]), int(own[-1]) + 1
                top = first + int(np.argmax(np.abs(away[first:last])))
                low, high = max(0, first - 2 * reach), min(len(rows), last + 2 * reach)
                values[k] = values[k].copy()
                values[k][low:high, axis] = middle[top]
                shift = float((rows[low:high, axis] - middle[top]).sum() / len(rows))
                place = samples.place(k, axis, away[top], spread, at=top, shift=shift)
                p = corrected(2 * float(special.ndtr(-size[top])), total)
                found.append((place, p))
    if not found:
        return None, samples
    return _spikes_finding(samples, found), samples.with_values(values)


def _from_neighbours(column: Floats, reach: int) -> tuple[Floats, Floats, Floats]:
    """Return the distance (n,) of each sample from the median of its neighbours on the nearer side.

    One median is over samples before it, one over samples after it. The second result (n,) is the nearer
    median, the third (m,) are the distances from the median before.

    The scatter is estimated from the third result, since the distance to the nearer of two medians is too
    small on average. `column` (n,) are the samples of one axis; `reach` is the number of samples over
    which neighbours are correlated.
    """
    half = _NEIGHBOURS // 2
    n = len(column)
    median = ndimage.median_filter(column, size=_NEIGHBOURS, mode="nearest")
    at = np.arange(n)
    before, after = at - reach - half, at + reach + half
    has_before, has_after = before - half >= 0, after + half < n
    by_before = column - median[np.maximum(before, 0)]
    by_after = column - median[np.minimum(after, n - 1)]
    use_before = np.where(has_before & has_after, np.abs(by_before) <= np.abs(by_after), has_before)
    away = np.where(use_before, by_before, by_after)
    return away, column - away, by_before[reach + 2 * half :]


def _spikes_finding(samples: Samples, found: list[tuple[Place, float]]) -> WithinFinding:
    """Return the finding of spikes, each given as its place and p-value."""
    places = [place for place, _ in found]
    size = max(abs(place.value.value) if place.value else 0.0 for place in places)
    axes, positions = axes_and_positions(places)
    noise = dict(zip(samples.position.tolist(), samples.u_of_means.tolist(), strict=True))
    # A spike that moves a mean by less than a third of its noise is harmless.
    spoiled = tuple(sorted({p.position for p in places if abs(p.shift_mg or 0.0) > noise[p.position] / 3}))
    repeat = f"; repeat {positions_text(spoiled, 0)}, whose means they move" if spoiled else ""
    count = len(places)
    return WithinFinding(
        kind="spikes",
        axes=axes,
        positions=positions,
        parameters={"count": Value(float(count), None, "1"), "largest": Value(size, None, "mg")},
        p_value=min(p for _, p in found),
        sentence=(
            f"{count} spike{'' if count == 1 else 's'} in {positions_text(positions, len(samples))}, the "
            f"largest {format_number(size)} mg"
        ),
        places=tuple(places),
        advice=f"look for what makes the spikes (contacts, supply, a touch){repeat}",
    )


def stuck(samples: Samples, scatter: Floats, reach: int) -> WithinFinding | None:
    """Find runs of equal samples that are too long for noise and converter; None if there are none.

    Parameters
    ----------
    samples : Samples
        Samples of all dwells.
    scatter : (d, axes) float
        Standard deviation of single samples in each dwell.
    reach : int
        Number of samples over which neighbours are correlated.
    """
    places: list[Place] = []
    least_p = 1.0
    tests = len(samples) * samples.axes
    for axis in range(samples.axes):
        lengths = [run_lengths(rows[:, axis]) for rows in samples.values]
        kept = [np.delete(own, int(own.argmax())) for own in lengths]
        typical = float(np.median(scatter[:, axis]))
        if typical < LIVELY * samples.quantum[axis]:
            continue
        # The tail of the run lengths begins at `start`; longer runs exceed it by `common` on average.
        runs = np.concatenate(kept)
        start = float(np.quantile(runs, _LONG_QUANTILE)) if runs.size else 1.0
        common = float(np.mean(runs[runs > start] - start)) if (runs > start).any() else 0.0
        for k, own in enumerate(lengths):
            longest = int(own.max())
            if longest < _LEAST_RUN:
                continue
            excess = common
            if (kept[k] > start).sum() >= _LEAST_LONG:
                excess = max(excess, float(np.mean(kept[k][kept[k] > start] - start)))
            excess = _SAFETY * excess + 0.5
            chances = max(1.0, (own > start).sum())
            # Tail probability of the longest of `chances` runs.
            p = float(chances * np.exp(-(longest - start) / excess))
            # Slow noise stays within one step for a few of its correlation times.
            stays = float(special.erf(samples.quantum[axis] / (2 * np.sqrt(2) * scatter[k, axis])))
            slow = len(samples.values[k]) / reach * stays ** (longest / reach)
            p = corrected(max(p, slow), tests)
            if p < FOUND_WITHIN:
                least_p = min(least_p, p)
                begin = int(own[: int(own.argmax())].sum())
                places.append(samples.place(k, axis, longest, unit="samples", at=begin))
    if not places:
        return None
    axes, positions = axes_and_positions(places)
    run = max(place.value.value for place in places if place.value)
    where = positions_text(positions, len(samples))
    return WithinFinding(
        kind="stuck",
        axes=axes,
        positions=positions,
        parameters={"longest": Value(run, None, "samples")},
        p_value=least_p,
        sentence=(
            f"one value repeats for up to {run:.0f} samples in {where}, longer than noise and converter "
            "allow"
        ),
        places=tuple(places),
        advice=f"check wiring and the reading of the sensor, then repeat {positions_text(positions, 0)}",
    )


def saturation(session: Session, data: Readings) -> WithinFinding | None:
    """Return the finding on samples at the ends of the sensor's range; None without such samples."""
    if data.converter is None or not data.converter.limits:
        return None
    limits = data.converter.limits
    recorded = sum(1 for dwell in session.dwells if len(dwell))
    axes = [limit.axis for limit in limits]
    values, zeros = np.array([limit.value for limit in limits]), data.unit.zero[axes]
    sizes = np.abs((values * data.unit.scale - zeros) / data.unit.per_mg[axes])
    letters = tuple(sorted({"xyz"[limit.axis] for limit in limits}))
    positions = tuple(sorted({p for limit in limits for p in limit.positions}))
    p = max(float(special.bdtrc(m.samples - 1, m.samples + m.inside, 0.5)) for m in limits)
    step = float(data.converter.steps.max() * abs(data.unit.scale / data.unit.per_mg[axes[0]]))
    limit_mg = Value(float(sizes.mean()), math.hypot(step / math.sqrt(12), np.ptp(sizes) / 2), "mg")
    return WithinFinding(
        kind="limit",
        effect="saturation",
        axes=letters,
        positions=positions,
        parameters={"limit": limit_mg},
        p_value=corrected(p, len(limits)),
        sentence=(
            f"{', '.join(letters)} stop at ±{format_number(limit_mg.value)} mg in "
            f"{positions_text(positions, recorded)}: dwells that it moves took no part in the fit"
        ),
        advice="record with a wider range, or without the positions in which an axis stands at its limit",
    )


def quantization(samples: Samples, reach: int) -> WithinFinding | None:
    """Return the finding on axes with a converter step too coarse for the noise; None without such axes.

    Parameters
    ----------
    reach : int
        Number of samples over which neighbours are correlated.
    """
    p = [corrected(_coarse(samples, axis, reach), samples.axes) for axis in range(samples.axes)]
    found = [axis for axis, own in enumerate(p) if own < FOUND_WITHIN]
    if not found:
        return None
    letters = tuple(samples.letters[axis] for axis in found)
    step = max(float(samples.quantum[axis]) for axis in found)
    return WithinFinding(
        kind="coarse",
        effect="quantization",
        axes=letters,
        positions=tuple(int(p) for p in samples.position),
        parameters={"lsb": Value(step, None, "mg")},
        p_value=min(p),
        sentence=(
            f"{', '.join(letters)} come in steps of {format_number(step)} mg, which the noise does not"
            " hide: the means follow a staircase"
        ),
        advice=(
            "give the converter more noise or finer words (a shorter filter, a format with all digits), or "
            "measure each angle a few times, a fraction of a step apart"
        ),
    )


def _coarse(samples: Samples, axis: int, reach: int) -> float:
    """Return the p-value of the hypothesis that noise spreads an axis' samples over several steps.

    It is 1 if the samples scatter enough. `reach` is the number of samples over which neighbours are
    correlated.
    """
    step = float(samples.quantum[axis])
    if not step > 0:
        return 1.0
    variance = np.array([values[:, axis].var() for values in samples.values])
    worth = np.maximum(samples.counts / reach, 1.0)
    on_means = float(np.mean(np.maximum(variance - step**2 / 12, 0.0) / worth))
    if float(quantized_means(variance, np.array(step)).mean()) <= on_means:
        return 1.0

    def excess(sigma: float) -> float:
        rounded = quantized_means(np.array(sigma**2 + 1 / 12), np.ones(()))
        return float(rounded) - sigma**2 / float(np.mean(worth))

    hiding = float(optimize.brentq(excess, 1e-3, 2.0))
    dof = float(np.sum(np.maximum(worth - 1, 1.0)))
    return float(special.chdtr(dof, dof * float(np.mean(variance)) / (step**2 * (hiding**2 + 1 / 12))))


LEAST_LOUD = 3
TESTS = 4
"""Number of tests per axis that share the error probability of the axis."""


@dataclass(frozen=True)
class Levels:
    """Variances and noise levels of dwells on one axis.

    Attributes
    ----------
    variance : (d,) float
        Variance of the samples of each dwell in mg².
    level : (d,) float
        Mean power of each dwell over frequencies, in units of the noise density of all dwells.
    dof, level_dof : (d,) float
        Degrees of freedom of the variances and of the levels.
    """

    variance: Floats
    dof: Floats
    level: Floats
    level_dof: Floats

    def rows(self, chosen: NDArray[np.bool_]) -> Levels:
        """Return the variances and levels of the dwells for which the mask `chosen` (d,) is True."""
        return Levels(self.variance[chosen], self.dof[chosen], self.level[chosen], self.level_dof[chosen])

    @cached_property
    def course(self) -> Floats:
        """Logarithm of each dwell's level, (d,), corrected for the mean logarithm of a χ² variable."""
        half = self.level_dof / 2
        return np.log(np.maximum(self.level, 1e-300)) - special.digamma(half) + np.log(half)

    @property
    def common(self) -> float:
        """Pooled variance of all dwells in mg²."""
        return float(self.dof @ self.variance / self.dof.sum())

    def changed(self) -> float:
        """Return the p-value of the t-test for a single change of the level, at the most significant place.

        All places between two dwells are tried, and the p-value is corrected for their number.
        """
        step, u = self.steps
        d = len(self.level)
        return min(1.0, (d - 1) * 2 * float(special.stdtr(d - 2, -np.abs(step) / u).min()))

    @cached_property
    def steps(self) -> tuple[Floats, Floats]:
        """Change of the level between two dwells and its u, at each of the d − 1 places, in nats.

        The change is the weighted mean of `course` after the place minus the weighted mean before it, with
        the degrees of freedom as weights. u follows from the scatter of the values about the two means.
        """
        weight = self.level_dof
        about = self.course - np.average(self.course, weights=weight)
        before = np.cumsum(weight)[:-1]
        after = weight.sum() - before
        inverse = 1 / before + 1 / after
        # The values are relative to their mean: the sums on both sides are equal and opposite.
        step = -np.cumsum(weight * about)[:-1] * inverse
        squares = np.maximum(weight @ about**2 - step**2 / inverse, 0.0)
        return step, np.maximum(np.sqrt(squares / (len(weight) - 2) * inverse), 1e-300)


def noise_change(samples: Samples, density: Density | None) -> WithinFinding | None:
    """Return the finding on a change of the samples' scatter from dwell to dwell; None without a change.

    At least three dwells are needed. `density` is the noise density of the dwells, None if no dwell is long
    enough for a spectrum.
    """
    if density is None or len(density.dwells) < LEAST_LOUD:
        return None
    levels = {axis: levels_of(samples, density, axis) for axis in range(samples.axes)}
    p = {
        axis: _p_value(own, samples.axes)
        for axis, own in levels.items()
        if np.sqrt(np.median(own.variance)) >= LIVELY * samples.quantum[axis]
    }
    levels = {axis: levels[axis] for axis in p if p[axis] < FOUND_WITHIN}
    if not levels:
        return None
    cut = _best_cut(list(levels.values()))
    if cut is not None and all(_explained(own, cut) for own in levels.values()):
        finding = _joining(samples, density, levels, cut)
    else:
        finding = _varying(samples, density.dwells, levels)
    spread = max(float(np.ptp(own.variance)) for own in levels.values())
    return replace(
        finding,
        axes=tuple(samples.letters[axis] for axis in levels),
        p_value=min(p.values()),
        sentence=(
            f"{finding.sentence}; variances differ by up to {format_number(spread)} mg², in which a "
            "vibration_rectification could show between the dwells"
        ),
    )


def levels_of(samples: Samples, density: Density, axis: int) -> Levels:
    """Return the variance and level of each dwell on one axis.

    The lowest frequencies, with drift and slow noise, are excluded. `density` is the noise density of the
    dwells.
    """
    searched = density.searched
    band = density.power[:, searched, axis]
    base = density.base[searched, axis]
    # The variance includes the part below the band: add its share by the density.
    whole = float(density.base[:, axis].sum() / base.sum())
    variance = np.maximum(whole * band.sum(axis=1) / (len(density.frequency) - 1), 1e-300)
    counts = samples.counts[density.dwells].astype(float)
    # Two degrees of freedom per independent ordinate, weighted by the density.
    share = len(base) / len(density.frequency)
    dof = counts * share * base.mean() ** 2 / np.mean(base**2) / TAPER_LOSS
    level_dof = counts * share / TAPER_LOSS
    relative = 2 / dof
    rows = [without_line(samples.values[int(k)])[:, axis] for k in density.dwells]
    squares = [own * own for own in rows]
    fourth = float(np.mean([np.mean(own**2) / max(float(np.mean(own)) ** 2, 1e-300) for own in squares]))
    relative = relative + max(fourth - 3, 0.0) / (dof / 2)
    step = samples.quantum[axis]
    if step > 0:
        sigma2 = max(float(np.median(variance)) / step**2 - 1 / 12, 0.02)
        ripple = (4 * sigma2 + 1 / np.pi**2) * np.exp(-2 * np.pi**2 * sigma2) / (sigma2 + 1 / 12)
        relative = relative + ripple**2 / 2
    return Levels(variance, 2 / relative, (band / base).mean(axis=1), level_dof)


def _p_value(own: Levels, axes: int) -> float:
    at = np.arange(len(own.variance))
    halves, singles = [at >= cut for cut in at[1:]], [at == k for k in at]
    # Four tests, two of them for many divisions of the dwells; each is multiplied by the total number.
    candidates = [p_of_equal_variances(own.variance, own.dof), own.changed()]
    for parts in (halves, singles):
        candidates += [_ratio_p(own.rows(~part), own.rows(part)) * len(parts) for part in parts]
    return corrected(min(candidates) * TESTS * axes, 1)


def _ratio_p(one: Levels, other: Levels) -> float:
    ratio = other.common / one.common
    a, b = float(other.dof.sum()), float(one.dof.sum())
    return min(1.0, 2 * min(float(special.fdtrc(a, b, ratio)), float(special.fdtr(a, b, ratio))))


def _best_cut(levels: list[Levels]) -> int | None:
    """Return the index of the first dwell after a single increase of the noise; None without an increase.

    The place is found by least squares of the log levels over all axes. The result is None if the noise
    does not increase there on every axis.
    """
    step, u = np.swapaxes([own.steps for own in levels], 0, 1)
    # Reduction of the log scatter by one step.
    place = int(np.log1p((step / u) ** 2 / (step.shape[1] - 1)).sum(axis=0).argmax())
    return place + 1 if (step[:, place] > 0).all() else None


def _explained(own: Levels, cut: int) -> bool:
    """Return True if a single change of the noise explains the variances of an axis.

    The change is before dwell `cut` or within the dwell before it; the variances on each side must agree.
    """
    at = np.arange(len(own.variance))
    parts = [own.rows(at < cut - 1), own.rows(at > cut)]
    p = [p_of_equal_variances(part.variance, part.dof) for part in parts if len(part.variance) > 1]
    return all(value > INADEQUATE / max(len(p), 1) for value in p)


def _joining(samples: Samples, density: Density, levels: dict[int, Levels], cut: int) -> WithinFinding:
    """Return the finding for a single change of the noise, before dwell `cut`; without its p-value.

    `levels` has the variances and levels of each axis that shows the change.
    """
    dwells = density.dwells
    at = np.arange(len(dwells))
    quiet, loud = at < cut - 1, at > cut
    if not quiet.any():
        quiet = at < cut
    if not loud.any():
        loud = at >= cut
    extra = {
        samples.letters[axis]: _joined(density, axis, own, quiet, loud) for axis, own in levels.items()
    }
    # The change is between the middles of the two dwells.
    low, high = (float(np.mean(samples.time_s[k])) for k in dwells[cut - 1 : cut + 1])
    start = Value((low + high) / 2, (high - low) / math.sqrt(12), "s")
    positions = tuple(samples.position[dwells[cut:]].tolist())
    return WithinFinding(
        kind="noise_change",
        effect="noise_change",
        positions=positions,
        parameters={**{f"extra_{letter}": size for letter, size in extra.items()}, "start": start},
        sentence=(
            f"from {start} on (position {positions[0]}) the samples scatter more: noise of "
            f"{', '.join(f'{letter} {size}' for letter, size in extra.items())} has joined"
        ),
        advice=(
            "look for what joined (a machine, a loose contact, the supply); readings before and after it "
            "differ in their uncertainty"
        ),
    )


def _joined(
    density: Density, axis: int, own: Levels, quiet: NDArray[np.bool_], loud: NDArray[np.bool_]
) -> Value:
    """Return the standard deviation in mg of the noise that was added at a change of the noise.

    `quiet` and `loud` (d,) are the dwells before and after the change. If the change of the spectrum
    resembles white noise more than the noise of the dwells, the value follows from the spectrum, because
    behind a long filter the variance hardly changes. Otherwise it follows from the change of the variance
    of the samples. `own` are the variances and levels on this axis.
    """
    base = density.base[density.searched, axis]
    power = density.power[:, density.searched, axis] / base
    change = power[loud].mean(axis=0) - power[quiet].mean(axis=0)

    def left(shape: Floats) -> float:
        return float(np.sum((change - shape * (change @ shape) / (shape @ shape)) ** 2))

    white = 1 / base
    if left(white) < left(np.ones_like(base)):
        # Amount of white noise in each dwell by projection on its shape.
        amounts = power @ white / (white @ white)
        parts = [amounts[quiet], amounts[loud]]
        square = float(parts[1].mean() - parts[0].mean())
        spread = sum(float(((part - part.mean()) ** 2).sum()) for part in parts) / max(len(amounts) - 2, 1)
        u2 = spread * sum(1 / len(part) for part in parts)
    else:
        before, after = own.rows(quiet), own.rows(loud)
        square = after.common - before.common
        u2 = 2 * (before.common**2 / before.dof.sum() + after.common**2 / after.dof.sum())
    extra = math.sqrt(max(square, 0.0))
    return Value(extra, float(np.sqrt(u2)) / (2 * max(extra, 1e-12)), "mg")


def _varying(samples: Samples, dwells: NDArray[np.intp], levels: dict[int, Levels]) -> WithinFinding:
    """Return the finding for variances that do not differ by a single change; without its p-value.

    `levels` has the variances and levels of each axis on which the variances differ between dwells.
    """
    d = len(dwells)
    unusual = np.zeros(d, dtype=bool)
    places: list[Place] = []
    parameters: dict[str, Value] = {}
    for axis, own in levels.items():
        size, u = np.sqrt(own.variance), np.sqrt(own.variance / (2 * own.dof))
        ratio = own.variance / float(np.median(own.variance))
        far = np.abs(np.log(ratio)) > -special.ndtri(FOUND_WITHIN / (2 * d)) * np.sqrt(2 / own.dof)
        unusual |= far
        places += [
            samples.place(int(dwells[k]), axis, size[k], float(u[k])) for k in np.flatnonzero(far).tolist()
        ]
        for word, k in (("least", int(size.argmin())), ("largest", int(size.argmax()))):
            parameters[f"{word}_{samples.letters[axis]}"] = Value(float(size[k]), float(u[k]), "mg")
    positions = tuple(samples.position[dwells[unusual] if unusual.any() else dwells].tolist())
    values = [format_number(value.value) for value in parameters.values()]
    letters = [samples.letters[axis] for axis in levels]
    ranges = zip(letters, values[::2], values[1::2], strict=True)
    return WithinFinding(
        kind="noise_change",
        positions=positions,
        parameters=parameters,
        sentence=(
            "the samples do not scatter alike in all dwells (standard deviation "
            f"{', '.join(f'{letter} {low} to {high} mg' for letter, low, high in ranges)}); unusual: "
            f"{positions_text(positions, len(samples))}"
        ),
        places=tuple(places),
    )


def smallest_noise_change(samples: Samples, density: Density | None) -> Detectable:
    """Return the smallest white noise, added from mid-session on, that the search would have found.

    Two tests look for one change of the noise between dwells: the F-test of the variance and the t-test
    of the level. The amplitude is None if there are too few dwells.
    """
    if density is None or len(density.dwells) < LEAST_LOUD:
        return Detectable(None, "mg", "extra", f"needs {LEAST_LOUD} dwells long enough for a spectrum")
    dwells = len(density.dwells)
    p = FOUND_WITHIN / SEARCHES / (2 * TESTS * samples.axes * (dwells - 1))
    worst = 0.0
    for axis in range(samples.axes):
        own = levels_of(samples, density, axis)
        half = float(own.dof.sum()) / 2
        ratio = float(special.fdtri(half, half, 1 - p) / special.fdtri(half, half, 1 - POWER))
        # The added noise scatters too, according to its degrees of freedom.
        chance = math.sqrt(float(special.polygamma(1, np.median(own.level_dof) / 2)) * 4 / dwells)
        away = _noncentral(p, dwells - 2) * max(own.steps[1][dwells // 2 - 1], chance)
        quiet = float(np.median(own.level)) * density.base[density.searched, axis]
        seen = (own.common * (ratio - 1), _joining_variance(quiet, away))
        worst = max(worst, math.sqrt(min(seen)))
    return Detectable(worst, "mg", "extra")


def _joining_variance(quiet: Floats, away: float) -> float:
    """Return the variance in mg² of white noise that raises the level of half of the dwells by `away` nats.

    `quiet` (points,) is the spectral density without the added noise. The level of a dwell is its mean
    power in units of the density of all dwells, which the added noise changes too. The result is infinite
    if no variance raises the level so much.
    """
    middle = len(quiet) // 2, (len(quiet) - 1) // 2

    def median(values: Floats) -> float:
        # Of a thousand points, without the checks for NaN and empty arrays that take np.median longer.
        found = np.partition(values, middle)
        return float(found[middle[0]] + found[middle[1]]) / 2

    def missing(log_variance: float) -> float:
        loud = quiet + math.exp(log_variance)
        base = quiet
        for _ in range(8):
            base = (quiet / median(quiet / base) + loud / median(loud / base)) / 2
        return float(np.log(np.mean(loud / base) / np.mean(quiet / base))) - away

    low, high = float(np.log(quiet.min())) - 20, float(np.log(quiet.max())) + 50
    return math.exp(optimize.brentq(missing, low, high, xtol=1e-3)) if missing(high) > 0 else math.inf


def _noncentral(p: float, dof: int) -> float:
    """Return the true value, in standard uncertainties, that a t-test detects with 90 % probability.

    The test is one-sided, at significance level `p`. `dof` are the degrees of freedom of the test.
    """
    limit = -float(special.stdtrit(dof, p))

    def missing(size: float) -> float:
        # Far beyond the limit the function returns NaN instead of 0.
        return 1 - float(np.nan_to_num(special.nctdtr(dof, size, limit))) - POWER

    return float(optimize.brentq(missing, 0.0, 10 * limit + 50, xtol=1e-6))
