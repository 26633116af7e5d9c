"""Events in the samples of single dwells: a step, a slope, a transient.

At each of several scales (from a few samples to half a dwell) the means of neighbouring stretches are
subtracted (Haar wavelet at every position). For stationary noise of any spectrum, 1/f noise included, the
differences of one scale have one normal distribution. Their scatter over all positions and dwells therefore
judges the largest difference, and no model of the noise is needed. If a scale has many independent
positions, the scatter is the median absolute deviation. At the longest scales, with one or two
differences per dwell, it comes from the other dwells without outliers, with few degrees of freedom and
little power.

A significant dwell is described by the form with the smallest residual: a step, a line or an exponential.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import special

from adis_gonio.base.arrays import MAD_TO_SD, Floats
from adis_gonio.base.numbers import format_number
from adis_gonio.base.uncertainty import FOUND_WITHIN
from adis_gonio.fitting.estimation.screening import LIVELY
from adis_gonio.tracing.within.samples import (
    SEARCHES,
    Place,
    Samples,
    WithinFinding,
    axes_and_positions,
    deviation,
    positions_text,
)

_SHORTEST = 8
_LEAST_SAMPLES = 6
_MANY = 300
"""Number of independent differences above which their scatter is the median absolute deviation.
With fewer differences the scatter comes from the other dwells."""
_RARE, _FEW = 1e-3, 0.15
_LEAST_DWELLS = 6
_EFFICIENCY = 0.37
"""Efficiency of the median absolute deviation relative to the standard deviation."""
_TAUS = 8
_CLEAR = 4.0
"""Least size of a form (step, drift, settling), in standard uncertainties, to describe a dwell by it."""


Form = Literal["step", "drift", "settling", "disturbance"]


@dataclass(frozen=True)
class _Scale:
    """Differences between the means of neighbouring stretches of samples, for one length of stretch.

    The length is a fixed number of samples or, on the last scale, half of each dwell.

    Attributes
    ----------
    dwells : (m,) int
        Indices of the dwells that are long enough.
    stretch : (m,) float
        Length of a stretch in samples.
    places : m arrays (j,)
        Number of the first sample in the later of the two stretches.
    differences : m arrays (j, axes)
        Differences, divided by their standard deviation for white noise.
    """

    dwells: NDArray[np.intp]
    stretch: Floats
    places: list[NDArray[np.intp]]
    differences: list[Floats]


@dataclass(frozen=True)
class _Looks:
    """The largest difference of means in each dwell and axis, on each of s scales.

    Attributes
    ----------
    p_value : (s, d, axes) float
        p-value of the difference, corrected for the number of tests; 1 if the dwell is too short.
    place : (s, d, axes) int
        Number of the first sample in the later of the two stretches.
    height_mg : (s, d, axes) float
        Later minus earlier mean.
    spread : (s, d, axes) float
        Standard deviation of the differences of the scale.
    stretch : (s, d) float
        Length of a stretch in samples; 0 if the dwell is too short.
    unit : (d, axes) float
        Divisor of the samples in mg: the scatter of the dwell on an axis whose scatter differs between
        dwells, otherwise 1.
    """

    p_value: Floats
    place: NDArray[np.intp]
    height_mg: Floats
    spread: Floats
    stretch: Floats
    unit: Floats

    @classmethod
    def of(cls, samples: Samples, scales: Sequence[_Scale], unit: Floats) -> _Looks:
        """Return the test of the largest differences on these scales; `unit` is as in the class."""
        shape = len(scales), len(samples), samples.axes
        looks = cls(
            p_value=np.ones(shape),
            place=np.zeros(shape, dtype=np.intp),
            height_mg=np.zeros(shape),
            spread=np.zeros(shape),
            stretch=np.zeros(shape[:2]),
            unit=unit,
        )
        # If the noise is below the converter's step, a mean may be wrong by half a step.
        scatter = np.array([rows.std(axis=0) for rows in samples.values])
        coarse = np.where(scatter < LIVELY * samples.quantum, 0.5 * samples.quantum / unit, 0.0)
        tests = sum(len(rows) for scale in scales for rows in scale.differences) * samples.axes
        for k, scale in enumerate(scales):
            own, half = scale.dwells, np.sqrt(scale.stretch / 2)[:, None]
            at = np.array([np.abs(rows).argmax(axis=0) for rows in scale.differences])
            peaks = zip(scale.differences, at, strict=True)
            highest = np.array([rows[m, range(samples.axes)] for rows, m in peaks])
            largest = np.maximum(np.abs(highest) - coarse[own] * half, 0.0)
            p, looks.spread[k, own] = _judge(scale, samples.counts[own], largest)
            p = np.minimum(1.0, 2 * p * max(tests, 1) * SEARCHES)
            looks.p_value[k, own] = np.where(largest > 0, p, 1.0)
            looks.place[k, own] = [places[m] for places, m in zip(scale.places, at, strict=True)]
            # Back to the difference of two means in mg.
            looks.height_mg[k, own] = highest / half * unit[own]
            looks.stretch[k, own] = scale.stretch
        return looks

    def u_mg(self, dwell: int, axis: int, stretch: float) -> float:
        """Return the standard uncertainty in mg of the difference between the means of two stretches.

        A stretch is a run of `stretch` samples. `dwell` and `axis` are indices.
        """
        lengths = np.maximum(self.stretch[:, dwell], 1e-9)
        k = int(np.abs(np.log(lengths / stretch)).argmin())
        return float(
            self.spread[k, dwell, axis] * np.sqrt(2 / max(lengths[k], 1.0)) * self.unit[dwell, axis]
        )


def events(samples: Samples, unlike: list[int], reach: int) -> list[WithinFinding]:
    """Find steps, slopes and transients in the samples of single dwells.

    Parameters
    ----------
    samples : Samples
        Samples without the slopes and settling that all dwells share.
    unlike : list of int
        Axes on which the scatter differs between dwells; on these each dwell is scaled by its scatter.
    reach : int
        Number of samples over which neighbours are correlated.
    """
    unit = np.ones((len(samples), samples.axes))
    for axis in unlike:
        unit[:, axis] = [max(float(rows[:, axis].std()), 1e-12) for rows in samples.values]
    scales = _scales(samples, unit, max(_SHORTEST, 2 * reach))
    if not scales:
        return []
    looks = _Looks.of(samples, scales, unit)
    p = looks.p_value.min(axis=0)
    described = [
        (k, axis, *_describe(samples, k, axis, looks)) for k, axis in np.argwhere(p < FOUND_WITHIN).tolist()
    ]
    found = []
    for form in get_args(Form):
        chosen = [(place, float(p[k, axis])) for k, axis, own, place in described if own == form]
        if chosen:
            places, p_values = zip(*chosen, strict=True)
            found.append(_finding(samples, form, places, min(p_values)))
    return found


def _scales(samples: Samples, unit: Floats, shortest: int) -> list[_Scale]:
    """Return the differences on all scales; the length of a stretch doubles from `shortest` samples on.

    `unit` (d, axes) divides the samples of each dwell.
    """
    sums = [
        np.concatenate(
            [np.zeros((1, samples.axes)), np.cumsum((rows - rows.mean(axis=0)) / unit[k], axis=0)]
        )
        for k, rows in enumerate(samples.values)
    ]
    counts = samples.counts
    doublings = range(max(int(counts.max()) // (3 * shortest), 0).bit_length())
    scales = []
    for length in (*(shortest << j for j in doublings), None):
        stretch = counts // 2 if length is None else np.full(len(samples), length)
        dwells = np.flatnonzero((counts >= _LEAST_SAMPLES) & (2 * stretch <= counts))
        places, differences = [], []
        for k in dwells.tolist():
            # Adjacent stretches of `own` samples at every quarter of a stretch; sums from cumulative sums.
            own, total = int(stretch[k]), sums[k]
            middle = np.arange(own, counts[k] - own + 1, max(1, own // 4))
            change = total[middle + own] - 2 * total[middle] + total[middle - own]
            places.append(middle)
            differences.append(change / np.sqrt(2 * own))
        scale = _Scale(dwells, stretch[dwells].astype(float), places, differences)
        if dwells.size and _places_apart(scale, counts[dwells]).sum() > 2:
            scales.append(scale)
    return scales


def _places_apart(scale: _Scale, counts: NDArray[np.intp]) -> Floats:
    """Return the number (m,) of independent differences in each dwell for white noise, at least 1.

    `counts` (m,) are the numbers of samples of the dwells.
    """
    return np.maximum(1.0, counts / (2 * scale.stretch))


def _judge(scale: _Scale, counts: NDArray[np.intp], largest: Floats) -> tuple[Floats, Floats]:
    """Return the one-sided p-values (m, axes) of the largest differences, and the scatter of differences.

    `counts` (m,) are the numbers of samples of the dwells, `largest` (m, axes) the moduli of the largest
    differences. The scatter is the standard deviation (m, axes) that each dwell is compared with.
    """
    p, spreads = np.ones_like(largest), np.zeros_like(largest)
    every = np.concatenate(scale.differences)
    for axis in range(largest.shape[1]):
        squares = np.array([(own[:, axis] ** 2).mean() for own in scale.differences])
        weight = _independent(_places_apart(scale, counts), squares)
        total = float(weight.sum())
        if total >= _MANY:
            spreads[:, axis] = max(MAD_TO_SD * float(np.median(np.abs(every[:, axis]))), 1e-12)
            dof = np.full(len(weight), _EFFICIENCY * total)
        else:
            weight = _without_outliers(squares, weight)
            # Variance from all other dwells, weighted by their independent places.
            dof = np.maximum(weight.sum() - weight, 1e-12)
            spreads[:, axis] = np.sqrt(np.maximum((weight @ squares - weight * squares) / dof, 1e-24))
        p[:, axis] = special.stdtr(dof, -largest[:, axis] / spreads[:, axis])
    return p, spreads


def _without_outliers(squares: Floats, weight: Floats) -> Floats:
    """Return the weights (m,) of the mean squared differences of dwells, with weight 0 for outliers.

    A dwell is an outlier if its mean square has a probability below `_RARE`, by a χ² distribution scaled to
    the upper quartile of the dwells. (The median would be too small with a coarse converter, since many
    dwells then have no difference at all.) No dwell is excluded if there are fewer than `_LEAST_DWELLS`
    dwells, or if the share of outliers exceeds `_FEW`. `squares` and `weight` (m,) are these mean squares
    and weights.
    """
    if len(weight) < _LEAST_DWELLS:
        return weight
    dof = float(np.median(weight))
    upper = float(np.quantile(squares, 0.75)) / float(special.chdtri(dof, 0.25))
    far = squares > upper * float(special.chdtri(dof, _RARE))
    return weight if far.mean() > _FEW else np.where(far, 0.0, weight)


def _independent(nominal: Floats, squares: Floats) -> Floats:
    """Return the effective number (m,) of independent differences in each dwell, at most `nominal`.

    `squares` (m,) are the mean squared differences of the dwells. The more they scatter from dwell to
    dwell, the smaller is the number.

    A difference is between the means of two neighbouring stretches of samples. A sensor filter that is
    longer than a stretch correlates the differences. The median absolute deviation of the mean squares is
    used, so that a few unusual dwells do not matter.
    """
    if len(squares) < _LEAST_DWELLS:
        return nominal
    spread = float(deviation(np.log(np.maximum(squares, 1e-300))))
    # The logarithm of a mean of ν squares has variance 2/ν.
    return np.minimum(nominal, max(2 / max(spread, 1e-6) ** 2, 1.0))


def _describe(samples: Samples, k: int, axis: int, looks: _Looks) -> tuple[Form, Place]:
    """Return the form that describes a dwell best, and its place.

    If the form is not significant in the noise of its scale, the event is a disturbance of the length at
    which it was found. `k` and `axis` are the indices of dwell and axis.
    """
    rows = samples.values[k][:, axis] - samples.values[k][:, axis].mean()
    elapsed, period, n = samples.elapsed_s(k), samples.period_s, len(rows)
    length = max(float(elapsed[-1]), 1e-12)
    # Step: the sum of squares decreases by n1 n2/n times the squared difference of the means.
    first = np.arange(1, n)
    gain = np.cumsum(rows)[:-1] ** 2 * n / (first * (n - first))
    inner = slice(2, max(n - 3, 3))
    cut = int(np.argmax(gain[inner])) + inner.start + 1
    fewer = min(cut, n - cut)
    moved = fewer / n if 2 * cut >= n else -fewer / n
    # Course of unit size, samples on either side of it, sample of the event, unit of the size, its ratio to
    # the difference of two means, and the shift of the dwell's mean for unit size.
    forms: list[tuple[Form, Floats, float, int | None, str, float, float]] = [
        ("step", (np.arange(n) >= cut).astype(float), fewer, cut, "mg", 1.0, moved),
        ("drift", elapsed, n / 2, None, "mg/s", 2 / length, length / 2),
    ]
    for tau in np.geomspace(3 * period, length / 3, _TAUS) if length > 9 * period else ():
        decay = np.exp(-elapsed / tau)
        forms.append(("settling", decay, min(tau / period, n / 2), 0, "mg", 1.0, float(decay.mean())))
    most, chosen = -1.0, None
    for form, course, stretch, at, unit, per_mg, shift in forms:
        centred = course - course.mean()
        energy = max(float(centred @ centred), 1e-300)
        size = float(centred @ rows) / energy
        if size**2 * energy > most:
            most, u = size**2 * energy, per_mg * looks.u_mg(k, axis, stretch)
            place = samples.place(k, axis, size, u, unit, at, size * shift)
            chosen = form, place, abs(size) > _CLEAR * u
    assert chosen is not None
    form, place, certain = chosen
    if certain:
        return form, place
    scale = int(looks.p_value[:, k, axis].argmin())
    at, height = int(looks.place[scale, k, axis]), float(looks.height_mg[scale, k, axis])
    stretch = float(looks.stretch[scale, k])
    u = looks.u_mg(k, axis, stretch)
    return "disturbance", samples.place(k, axis, height, u, at=at, shift=height * stretch / n)


_WORDS: dict[Form, tuple[str, str, str]] = {
    "step": ("the reading steps within", "height", "something moved (the part, its mount, the stage)"),
    "drift": (
        "the samples drift within",
        "slope",
        "the part or the stage creeps, or its temperature moves",
    ),
    "disturbance": (
        "the samples are disturbed for a moment in",
        "height",
        "something was touched or shook",
    ),
    "settling": (
        "the samples settle within",
        "settling",
        "the dwell began too early, or something was touched",
    ),
}


def _finding(samples: Samples, kind: Form, places: tuple[Place, ...], p_value: float) -> WithinFinding:
    """Return the finding of all events of one form; `p_value` is the smallest of their p-values."""
    words, name, cause = _WORDS[kind]
    axes, positions = axes_and_positions(places)
    worst = max(places, key=lambda place: abs(place.shift_mg or 0.0))
    assert worst.value is not None
    when = "" if worst.time_s is None or kind == "settling" else f" at {worst.time_s:.1f} s"
    where = positions_text(positions, len(samples))
    most = f", most in position {worst.position}" if len(positions) > 1 else ""
    return WithinFinding(
        kind=kind,
        effect=None,
        axes=axes,
        positions=positions,
        parameters={f"{name}_{worst.axis}": worst.value},
        p_value=p_value,
        sentence=(
            f"{words} {where}{most}: {worst.axis} by "
            f"{worst.value}{when}; its mean is off by about "
            f"{format_number(abs(worst.shift_mg or 0.0), 2)} mg"
        ),
        places=places,
        advice=f"repeat {positions_text(positions, 0)}: {cause} while the dwell was recorded",
    )
