"""Single samples that no noise makes: spikes, and values that stand still.

Spikes
    A sample that differs from the median of its neighbours before *and* of those after it (so that a step
    is none), by more than a normal distribution allows for all samples of the session together. Near the
    ends of a dwell only one side exists and decides. The scale is that of the sample's own distance from
    its neighbours, so that slow noise does not count; one and a half steps of the converter are taken off.
Stuck values
    A run of equal values longer than those of the same axis explain: the lengths of runs of a stationary
    noise fall off exponentially (a rate that filter and converter set and that the session shows), and the
    longest run of a dwell takes no part in the estimate of that rate. Slow noise may also stay in one step
    for as long as its correlation and its scatter allow, which is reckoned apart. Where the noise is below
    `_LIVELY` steps of the converter a constant word is normal, and nothing is looked for.

What the codes of the samples show: limits of the range (`saturation`), a coarse step (`quantization`).

Saturation
    Samples that pile up at an extreme value (`Readings.converter`). Its p-value is that of so many
    samples at the extreme against those one value inside, were both equally likely.
Quantization
    A step that the noise does not hide: what it leaves on the means, q²/(2π²)·Σ exp(−4π²k²σ²/q²)/k², is
    more than what noise leaves on them, in all dwells together. Its p-value is the chance that noise of the
    scatter at which both are equal scatters no more than was seen. Words of which only every second, third,
    … one occurs have lost bits: that is stated of any scatter, and its p-value is the chance of so many
    differences without another divisor.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize, special, stats

from adis_gonio.base.arrays import Floats
from adis_gonio.base.numbers import format_number
from adis_gonio.base.uncertainty import FOUND_WITHIN, Value
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.estimation.readings import Readings, left_by_quantization
from adis_gonio.model.records import Session
from adis_gonio.tracing.within.samples import (
    SEARCHES,
    Place,
    Samples,
    View,
    WithinFinding,
    corrected,
    deviation,
    positions_text,
)

_NEIGHBOURS = 15
_LEAST_SAMPLES = 2 * _NEIGHBOURS
_LEAST_RUN = 8
_LIVELY = 0.6
"""Noise in steps of the converter below which runs are no evidence; as `estimation.screening`."""
_LONG_QUANTILE = 0.9
_LEAST_LONG = 20
_SAFETY = 1.5
"""Factor on the mean excess of long runs: it is itself estimated."""


def spikes(samples: Samples, scatter: Floats, reach: int) -> tuple[WithinFinding | None, Samples]:
    """Spikes of all dwells, and the samples with the spikes replaced by what surrounds them.

    Parameters
    ----------
    samples : Samples
    scatter : (d, axes) float
        Standard deviation of single samples.
    reach : int
        Samples over which neighbours are correlated: a spike ahead of the sensor's filter is as wide.
    """
    total = int(samples.counts.sum()) * samples.axes
    limit = float(stats.norm.isf(FOUND_WITHIN / (2 * total * SEARCHES)))
    values = list(samples.values)
    places: list[Place] = []
    least_p = 1.0
    worst: tuple[float, int, int, int] | None = None
    long = np.flatnonzero(samples.counts >= _LEAST_SAMPLES + 2 * reach).tolist()
    for axis in range(samples.axes):
        looks = {k: _from_neighbours(samples.values[k][:, axis], reach) for k in long}
        # A dwell's own scale is uncertain, and too small where the dwell is hardly longer than its noise is
        # correlated: it counts only where it is above that of all together.
        usual = deviation(np.concatenate([one_side for _, _, one_side in looks.values()])) if looks else 0.0
        for k, (away, middle, one_side) in looks.items():
            rows = samples.values[k]
            spread = max(float(deviation(one_side)), float(usual), 0.5 * float(scatter[k, axis]))
            # A neighbours' median and the sample are both rounded.
            size = (np.abs(away) - 1.5 * samples.quantum[axis]) / spread
            wild = size > limit
            if not wild.any():
                continue
            for first, last in _groups(wild, 2 * reach + 1):
                top = first + int(np.argmax(np.abs(away[first:last])))
                p = corrected(2 * float(stats.norm.sf(size[top])), total)
                least_p = min(least_p, p)
                low, high = max(0, first - 2 * reach), min(len(rows), last + 2 * reach)
                cleaned = values[k].copy()
                cleaned[low:high, axis] = middle[top]
                shift = float((rows[low:high, axis] - middle[top]).sum() / len(rows))
                values[k] = cleaned
                places.append(
                    Place(
                        int(samples.position[k]),
                        samples.letters[axis],
                        float(samples.time_s[k][top]),
                        Value(float(away[top]), spread, "mg"),
                        shift,
                    )
                )
                if worst is None or abs(away[top]) > worst[0]:
                    worst = (abs(float(away[top])), k, axis, top)
    if worst is None:
        return None, samples
    return _spikes_finding(samples, places, least_p, worst), samples.with_values(values)


def _from_neighbours(column: Floats, reach: int) -> tuple[Floats, Floats, Floats]:
    """Distance (n,) from the nearer one of the medians before and after, that median, and from one (m,).

    Of the last the scale counts: the nearer one of two is never farther.
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


def _groups(flags: NDArray[np.bool_], gap: int) -> list[tuple[int, int]]:
    """Stretches (first, past the last) of flagged samples that are at most `gap` apart."""
    at = np.flatnonzero(flags)
    cuts = np.flatnonzero(np.diff(at) > gap)
    firsts, lasts = np.concatenate([[0], cuts + 1]), np.concatenate([cuts, [len(at) - 1]])
    return [(int(at[a]), int(at[b]) + 1) for a, b in zip(firsts, lasts, strict=True)]


def _spikes_finding(
    samples: Samples, places: list[Place], p_value: float, worst: tuple[float, int, int, int]
) -> WithinFinding:
    size, k, axis, top = worst
    positions = tuple(sorted({place.position for place in places}))
    noise = {
        int(position): float(np.min(rows.std(axis=0))) / np.sqrt(len(rows))
        for position, rows in zip(samples.position, samples.values, strict=True)
    }
    # Spikes that move a mean by less than a third of its noise do no harm.
    spoiled = tuple(sorted({p.position for p in places if abs(p.shift_mg or 0.0) > noise[p.position] / 3}))
    repeat = f"; repeat {positions_text(spoiled, 0)}, whose means they move" if spoiled else ""
    count = len(places)
    low, high = max(0, top - 40), min(len(samples.values[k]), top + 41)
    time = samples.elapsed_s(k)[low:high]
    letter = samples.letters[axis]
    return WithinFinding(
        kind="spikes",
        effect=None,
        axes=tuple(sorted({place.axis for place in places})),
        positions=positions,
        parameters={
            "count": Value(float(count), None, "1"),
            "largest": Value(size, None, "mg"),
        },
        p_value=p_value,
        sentence=(
            f"{count} spike{'' if count == 1 else 's'} in {positions_text(positions, len(samples))}, the "
            f"largest {format_number(size)} mg"
        ),
        places=tuple(places),
        advice=f"look for what makes the spikes (contacts, supply, a touch){repeat}",
        view=View(
            time,
            samples.values[k][low:high, axis],
            np.zeros(0),
            np.zeros(0),
            "time since the first sample / s",
            f"{letter} / mg",
            f"The largest spike: {letter}, position {samples.position[k]}.",
        ),
    )


def stuck(samples: Samples, scatter: Floats, reach: int) -> WithinFinding | None:
    """Runs of equal values that noise and converter do not explain."""
    places: list[Place] = []
    least_p = 1.0
    tests = len(samples) * samples.axes
    for axis in range(samples.axes):
        lengths = [_run_lengths(rows[:, axis]) for rows in samples.values]
        kept = [np.delete(own, int(own.argmax())) for own in lengths]
        typical = float(np.median(scatter[:, axis]))
        if typical < _LIVELY * samples.quantum[axis]:
            continue
        start, common = _tail(np.concatenate(kept))
        for k, own in enumerate(lengths):
            longest = int(own.max())
            if longest < _LEAST_RUN:
                continue
            excess = common
            if (kept[k] > start).sum() >= _LEAST_LONG:
                excess = max(excess, float(np.mean(kept[k][kept[k] > start] - start)))
            excess = _SAFETY * excess + 0.5
            chances = max(1.0, (own > start).sum())
            p = float(chances * np.exp(-(longest - start) / excess))
            # Slow noise stays in one step for some of its correlation times by itself.
            stays = float(special.erf(samples.quantum[axis] / (2 * np.sqrt(2) * scatter[k, axis])))
            slow = len(samples.values[k]) / reach * stays ** (longest / reach)
            p = corrected(max(p, slow), tests)
            if p < FOUND_WITHIN:
                least_p = min(least_p, p)
                begin = int(own[: int(own.argmax())].sum())
                places.append(
                    Place(
                        int(samples.position[k]),
                        samples.letters[axis],
                        float(samples.time_s[k][begin]),
                        Value(float(longest), None, "samples"),
                    )
                )
    if not places:
        return None
    longest_place = max(places, key=lambda place: place.value.value if place.value else 0.0)
    positions = tuple(sorted({place.position for place in places}))
    run = longest_place.value.value if longest_place.value else 0.0
    where = positions_text(positions, len(samples))
    return WithinFinding(
        kind="stuck",
        effect=None,
        axes=tuple(sorted({place.axis for place in places})),
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


def _run_lengths(column: Floats) -> NDArray[np.intp]:
    change = np.flatnonzero(np.diff(column))
    return np.diff(np.concatenate([[-1], change, [len(column) - 1]])).astype(np.intp)


def _tail(lengths: NDArray[np.intp]) -> tuple[float, float]:
    """Length from which the distribution counts as exponential, and the mean excess beyond it."""
    if not lengths.size:
        return 1.0, 0.0
    start = float(np.quantile(lengths, _LONG_QUANTILE))
    beyond = lengths[lengths > start]
    return start, float(np.mean(beyond - start)) if beyond.size else 0.0


def saturation(session: Session, data: Readings) -> WithinFinding | None:
    """Limits of the range that samples have reached; None where there are none."""
    if data.converter is None or not data.converter.limits:
        return None
    limits = data.converter.limits
    recorded = sum(1 for dwell in session.dwells if len(dwell))
    zero = np.zeros((1, data.axes))
    sizes, steps = [], []
    for limit in limits:
        at = zero.copy()
        at[0, limit.axis] = limit.value
        sizes.append(abs(float(data.unit.mg(at)[0, limit.axis])))
        steps.append(
            float(data.unit.mg(at)[0, limit.axis] - data.unit.mg(zero)[0, limit.axis]) / limit.value
        )
    letters = tuple(sorted({"xyz"[limit.axis] for limit in limits}))
    positions = tuple(sorted({p for limit in limits for p in limit.positions}))
    p = max(float(stats.binom.sf(m.samples - 1, m.samples + m.inside, 0.5)) for m in limits)
    spread = (max(sizes) - min(sizes)) / 2
    step = float(data.converter.steps.max()) * abs(steps[0])
    limit_mg = Value(float(np.mean(sizes)), math.hypot(step / math.sqrt(12), spread), "mg")
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


def quantization(session: Session, samples: Samples, reach: int) -> WithinFinding | None:
    """A step of the converter that noise does not hide; None where it does.

    Parameters
    ----------
    reach : int
        Samples over which neighbours are correlated.
    """
    found: dict[int, float] = {}
    for axis in range(samples.axes):
        p = corrected(min(_coarse(samples, axis, reach), _lost_bits(session, samples, axis)), samples.axes)
        if p < FOUND_WITHIN:
            found[axis] = p
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
        p_value=min(found.values()),
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
    """Chance that noise which hides the step scatters as little as the samples; 1 where it hides it."""
    step = float(samples.quantum[axis])
    if not step > 0:
        return 1.0
    rows = [values[:, axis : axis + 1] for values in samples.values]
    variance = np.array([float(values.var()) for values in rows])
    worth = np.maximum(samples.counts / reach, 1.0)
    on_means = float(np.mean(np.maximum(variance - step**2 / 12, 0.0) / worth))
    if float(np.mean(left_by_quantization(rows, np.ones(1), np.array([step])))) <= on_means:
        return 1.0
    k = np.arange(1, 50)

    def excess(sigma: float) -> float:
        left = float((np.exp(-4 * np.pi**2 * k**2 * sigma**2) / k**2).sum()) / (2 * np.pi**2)
        return left - sigma**2 / float(np.mean(worth))

    hiding = float(optimize.brentq(excess, 1e-3, 2.0))
    dof = float(np.sum(np.maximum(worth - 1, 1.0)))
    return float(stats.chi2.cdf(dof * float(np.mean(variance)) / (step**2 * (hiding**2 + 1 / 12)), dof))


def _lost_bits(session: Session, samples: Samples, axis: int) -> float:
    """Chance that all differences of words share their divisor; 1 where it is one, or the words unknown."""
    if session.accel_unit != "lsb" or session.sensor not in VARIANTS:
        return 1.0
    words = round(float(samples.quantum[axis]) / VARIANTS[session.sensor].accel_mg_per_lsb)
    if words < 2:
        return 1.0
    differences = sum(len(np.unique(values[:, axis])) - 1 for values in samples.values)
    return float(words) ** -differences
