"""Samples that are not noise: spikes, repeated values, limits of the range, coarse steps of the converter.

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
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage, optimize, special

from adis_gonio.base.arrays import Floats
from adis_gonio.base.numbers import format_number
from adis_gonio.base.uncertainty import FOUND_WITHIN, Value
from adis_gonio.fitting.estimation.readings import Readings, quantization_variance
from adis_gonio.fitting.estimation.screening import LIVELY, run_lengths
from adis_gonio.model.records import Session
from adis_gonio.tracing.within.samples import (
    SEARCHES,
    Place,
    Samples,
    WithinFinding,
    axes_and_positions,
    corrected,
    deviation,
    positions_text,
)

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
        usual = deviation(np.concatenate([one_side for _, _, one_side in looks.values()])) if looks else 0.0
        for k, (away, middle, one_side) in looks.items():
            rows = samples.values[k]
            spread = max(float(deviation(one_side)), float(usual), 0.5 * float(scatter[k, axis]))
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
    noise = {
        int(position): float(np.min(rows.std(axis=0))) / np.sqrt(len(rows))
        for position, rows in zip(samples.position, samples.values, strict=True)
    }
    # A spike that moves a mean by less than a third of its noise is harmless.
    spoiled = tuple(sorted({p.position for p in places if abs(p.shift_mg or 0.0) > noise[p.position] / 3}))
    repeat = f"; repeat {positions_text(spoiled, 0)}, whose means they move" if spoiled else ""
    count = len(places)
    return WithinFinding(
        kind="spikes",
        effect=None,
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
        effect=None,
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
    ends = np.zeros((len(limits), data.axes))
    for row, limit in zip(ends, limits, strict=True):
        row[limit.axis] = limit.value
    columns = range(len(limits)), [limit.axis for limit in limits]
    sizes = np.abs(data.unit.mg(ends)[columns])
    per_code = (data.unit.mg(ends) - data.unit.mg(0 * ends))[columns][0] / limits[0].value
    letters = tuple(sorted({"xyz"[limit.axis] for limit in limits}))
    positions = tuple(sorted({p for limit in limits for p in limit.positions}))
    p = max(float(special.bdtrc(m.samples - 1, m.samples + m.inside, 0.5)) for m in limits)
    step = float(data.converter.steps.max() * abs(per_code))
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
    rows = [values[:, axis : axis + 1] for values in samples.values]
    variance = np.array([float(values.var()) for values in rows])
    worth = np.maximum(samples.counts / reach, 1.0)
    on_means = float(np.mean(np.maximum(variance - step**2 / 12, 0.0) / worth))
    if float(np.mean(quantization_variance(rows, np.ones(1), np.array([step])))) <= on_means:
        return 1.0
    k = np.arange(1, 50)

    def excess(sigma: float) -> float:
        left = float((np.exp(-4 * np.pi**2 * k**2 * sigma**2) / k**2).sum()) / (2 * np.pi**2)
        return left - sigma**2 / float(np.mean(worth))

    hiding = float(optimize.brentq(excess, 1e-3, 2.0))
    dof = float(np.sum(np.maximum(worth - 1, 1.0)))
    return float(special.chdtr(dof, dof * float(np.mean(variance)) / (step**2 * (hiding**2 + 1 / 12))))
