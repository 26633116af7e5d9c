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

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy import special

from adis_gonio.base.arrays import MAD_TO_SD, Floats
from adis_gonio.base.numbers import format_number
from adis_gonio.base.uncertainty import FOUND_WITHIN
from adis_gonio.tracing.within.samples import (
    Place,
    Samples,
    View,
    WithinFinding,
    axes_and_positions,
    corrected,
    deviation,
    neighbour_means,
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
_LIVELY = 0.6
_TAUS = 8
_CLEAR = 4.0
"""Least size of a form (step, drift, settling), in standard uncertainties, to describe a dwell by it."""
_POINTS = 300


@dataclass(frozen=True)
class _Scale:
    """Differences between the means of neighbouring stretches of samples, for one length of stretch.

    The length is a fixed number of samples or, on the last scale, half of each dwell.
    """

    differences: list[Floats]
    """For each dwell the differences (m, axes), divided by their standard deviation for white noise."""
    places: list[Floats]
    """For each dwell the number (m,) of the first sample in the later of the two stretches."""
    independent: Floats
    """Number of independent differences in each dwell, (d,)."""


_Form = Literal["step", "drift", "settling", "disturbance"]


@dataclass(frozen=True)
class _Look:
    """The most significant difference of means in each dwell and axis, over all lengths of stretches.

    Attributes
    ----------
    place : (d, axes) float
        Number of the first sample in the later of the two stretches.
    stretch : (d, axes) float
        Length of the stretches in samples.
    unit : (d, axes) float
        Divisor of the samples in mg: the scatter of the dwell on an axis whose scatter differs between
        dwells, otherwise 1.
    """

    place: Floats
    stretch: Floats
    difference_mg: Floats
    """Later minus earlier mean (d, axes) in mg."""
    noise: list[tuple[Floats, Floats]]
    """For each scale: lengths of stretches (d,), and standard deviations (d, axes) of its differences."""
    unit: Floats

    def u_mg(self, dwell: int, axis: int, stretch: float) -> float:
        """Return the standard uncertainty in mg of the difference between the means of two stretches.

        A stretch is a run of `stretch` samples. `dwell` and `axis` are indices.
        """
        best = min(self.noise, key=lambda one: abs(np.log(max(one[0][dwell], 1e-9) / stretch)))
        return float(best[1][dwell, axis] * np.sqrt(2 / max(best[0][dwell], 1.0)) * self.unit[dwell, axis])


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
    tests = sum(sum(len(own) for own in scale.differences) for scale in scales) * samples.axes
    p = np.ones((len(samples), samples.axes))
    look = _Look(np.zeros_like(p), np.ones_like(p), np.zeros_like(p), [], unit)
    # If the noise is below the converter's step, a mean may be wrong by half a step.
    spread = np.array([rows.std(axis=0) for rows in samples.values])
    coarse = np.where(spread < _LIVELY * samples.quantum, 0.5 * samples.quantum / unit, 0.0)
    for scale in scales:
        _judge(scale, coarse, tests, p, look)
    flagged = np.argwhere(p < FOUND_WITHIN)
    described = [_describe(samples, int(k), int(axis), look) for k, axis in flagged]
    found = []
    for kind in get_args(_Form):
        chosen = [
            (k, axis, place, model)
            for (k, axis), (own, place, model) in zip(flagged.tolist(), described, strict=True)
            if own == kind
        ]
        if chosen:
            least = min(float(p[k, axis]) for k, axis, _, _ in chosen)
            found.append(_finding(samples, kind, chosen, least))
    return found


def _scales(samples: Samples, unit: Floats, reach: int) -> list[_Scale]:
    counts = samples.counts
    sums = [
        np.concatenate(
            [np.zeros((1, samples.axes)), np.cumsum((rows - rows.mean(axis=0)) / unit[k], axis=0)]
        )
        for k, rows in enumerate(samples.values)
    ]
    longest = int(counts.max())
    lengths: list[int | None] = []
    length = reach
    while 3 * length <= longest:
        lengths.append(length)
        length *= 2
    lengths.append(None)
    scales = []
    for chosen in lengths:
        differences, places = [], []
        independent = np.zeros(len(samples))
        for k, total in enumerate(sums):
            n = int(counts[k])
            own = n // 2 if chosen is None else chosen
            if n < _LEAST_SAMPLES or 2 * own > n:
                differences.append(np.zeros((0, samples.axes)))
                places.append(np.zeros(0))
                continue
            # Adjacent stretches of `own` samples at every quarter of a stretch; sums from cumulative sums.
            middle = np.arange(own, n - own + 1, max(1, own // 4))
            before = total[middle] - total[middle - own]
            after = total[middle + own] - total[middle]
            differences.append((after - before) / np.sqrt(2 * own))
            places.append(middle.astype(float))
            independent[k] = max(1.0, n / (2 * own))
        if independent.sum() > 2:
            scales.append(_Scale(differences, places, independent))
    return scales


def _judge(scale: _Scale, coarse: Floats, tests: float, p: Floats, look: _Look) -> None:
    """Test the differences on one scale; lower the larger p-values in `p` (d, axes) to its values.

    `coarse` (d, axes) is the error of a mean by the converter's step, `tests` the number of tests; `look`
    gets the differences with the lowest p-values.
    """
    noise = np.zeros_like(p)
    look.noise.append((np.array([float(own[0]) if len(own) else 0.0 for own in scale.places]), noise))
    every = np.concatenate(scale.differences)
    stretch = np.array([float(own[0]) if len(own) else 1.0 for own in scale.places])
    for axis in range(p.shape[1]):
        squares = np.array(
            [(own[:, axis] ** 2).mean() if len(own) else np.nan for own in scale.differences]
        )
        weight = _independent(scale.independent, squares)
        total = float(weight.sum())
        largest = np.array([np.abs(own[:, axis]).max(initial=0.0) for own in scale.differences])
        largest = np.maximum(largest - coarse[:, axis] * np.sqrt(stretch / 2), 0.0)
        if total >= _MANY:
            spread = MAD_TO_SD * float(np.median(np.abs(every[:, axis])))
            own_p = np.asarray(special.stdtr(_EFFICIENCY * total, -largest / max(spread, 1e-12)))
            spreads = np.full(len(largest), spread)
        else:
            known, weight = _without_outliers(np.nan_to_num(squares), weight)
            total = float(weight.sum())
            # Variance from all other dwells, weighted by their independent places.
            others = (weight @ known - weight * known) / np.maximum(total - weight, 1e-12)
            spreads = np.sqrt(np.maximum(others, 1e-24))
            own_p = np.asarray(special.stdtr(np.maximum(total - weight, 1e-12), -largest / spreads))
        noise[:, axis] = spreads
        for k in np.flatnonzero(largest > 0).tolist():
            value = corrected(2 * float(own_p[k]), tests)
            if value < p[k, axis]:
                p[k, axis] = value
                at = int(np.abs(scale.differences[k][:, axis]).argmax())
                look.place[k, axis] = scale.places[k][at]
                look.stretch[k, axis] = stretch[k]
                # Back to the difference of two means in mg.
                height = scale.differences[k][at, axis] * np.sqrt(2 / stretch[k])
                look.difference_mg[k, axis] = height * look.unit[k, axis]


def _without_outliers(squares: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return the mean squared differences of dwells and their weights, with weight 0 for outliers.

    A dwell is an outlier if its mean square has a probability below `_RARE`, by a χ² distribution scaled to
    the upper quartile of the dwells. (The median would be too small with a coarse converter, since many
    dwells then have no difference at all.) No dwell is excluded if there are fewer than `_LEAST_DWELLS`
    dwells, or if the share of outliers exceeds `_FEW`. `squares` and `weight` (d,) are these mean squares
    and weights.
    """
    use = weight > 0
    if use.sum() < _LEAST_DWELLS:
        return squares, weight
    dof = float(np.median(weight[use]))
    upper = float(np.quantile(squares[use], 0.75)) / float(special.chdtri(dof, 0.25))
    far = use & (squares > upper * float(special.chdtri(dof, _RARE)))
    if far.sum() > _FEW * use.sum():
        return squares, weight
    return squares, np.where(far, 0.0, weight)


def _independent(nominal: Floats, squares: Floats) -> Floats:
    """Return the effective number (d,) of independent differences in each dwell, at most `nominal`.

    `squares` (d,) are the mean squared differences of the dwells. The more they scatter from dwell to
    dwell, the smaller is the number.

    A difference is between the means of two neighbouring stretches of samples. A sensor filter that is
    longer than a stretch correlates the differences. The median absolute deviation of the mean squares is
    used, so that a few unusual dwells do not matter.
    """
    use = np.isfinite(squares) & (nominal > 0)
    if use.sum() < _LEAST_DWELLS:
        return nominal
    logs = np.log(np.maximum(squares[use], 1e-300))
    spread = float(deviation(logs))
    # The logarithm of a mean of ν squares has variance 2/ν.
    each = max(2 / max(spread, 1e-6) ** 2, 1.0)
    return np.where(use, np.minimum(nominal, each), 0.0)


def _describe(samples: Samples, k: int, axis: int, look: _Look) -> tuple[_Form, Place, Floats]:
    """Return the form that describes a dwell best, its place, and its values (n,) about the dwell's mean.

    If the form is not significant in the noise of its scale, the event is a disturbance of the length at
    which it was found. `k` and `axis` are the indices of dwell and axis.
    """
    rows = samples.values[k][:, axis] - samples.values[k][:, axis].mean()
    elapsed = samples.elapsed_s(k)
    n = len(rows)
    # Step: the sum of squares decreases by n1 n2/n times the squared difference of the means.
    total = np.cumsum(rows)[:-1]
    first = np.arange(1, n)
    # `total` is the sum of the first part; the sum of all rows is zero.
    gain = total**2 * n / (first * (n - first))
    inner = slice(2, max(n - 3, 3))
    cut = int(np.argmax(gain[inner])) + inner.start
    fitted: dict[_Form, tuple[float, Floats, Place]] = {}
    height = float(rows[cut + 1 :].mean() - rows[: cut + 1].mean())
    model = np.where(np.arange(n) > cut, height, 0.0)
    model = model - model.mean()
    before, after = cut + 1, n - cut - 1
    shift = height * (min(before, after) / n) * (1 if before >= after else -1)
    u = look.u_mg(k, axis, min(before, after))
    fitted["step"] = float(gain[cut]), model, samples.place(k, axis, height, u, at=cut + 1, shift=shift)
    line = elapsed - elapsed.mean()
    energy = max(float(line @ line), 1e-300)
    slope = float(line @ rows) / energy
    length = max(float(elapsed[-1]), 1e-12)
    # The means of the two halves of a line differ by half of its span.
    u = 2 * look.u_mg(k, axis, n / 2) / length
    place = samples.place(k, axis, slope, u, "mg/s", shift=slope * length / 2)
    fitted["drift"] = slope**2 * energy, slope * line, place
    best: tuple[float, float, float, Floats, float] | None = None
    for tau in (
        np.geomspace(3 * samples.period_s, length / 3, _TAUS) if length > 9 * samples.period_s else ()
    ):
        course = np.exp(-elapsed / tau)
        centred = course - course.mean()
        own = max(float(centred @ centred), 1e-300)
        amplitude = float(centred @ rows) / own
        if best is None or amplitude**2 * own > best[0]:
            best = (amplitude**2 * own, amplitude, float(course.mean()), centred, float(tau))
    if best is not None:
        explained, amplitude, mean, centred, tau = best
        u = look.u_mg(k, axis, min(tau / samples.period_s, n / 2))
        place = samples.place(k, axis, amplitude, u, at=0, shift=amplitude * mean)
        fitted["settling"] = explained, amplitude * centred, place
    kind = max(fitted, key=lambda name: fitted[name][0])
    _, course, place = fitted[kind]
    size = place.value
    if size is not None and size.u is not None and abs(size.value) > _CLEAR * size.u:
        return kind, place, course
    stretch, at = float(look.stretch[k, axis]), int(look.place[k, axis])
    height = float(look.difference_mg[k, axis])
    course = np.zeros(n)
    course[at : at + int(stretch)] = height
    u = look.u_mg(k, axis, stretch)
    return "disturbance", samples.place(k, axis, height, u, at=at, shift=height * stretch / n), course


_WORDS: dict[_Form, tuple[str, str, str]] = {
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


def _finding(
    samples: Samples, kind: _Form, chosen: list[tuple[int, int, Place, Floats]], p_value: float
) -> WithinFinding:
    words, name, cause = _WORDS[kind]
    places = tuple(place for _, _, place, _ in chosen)
    axes, positions = axes_and_positions(places)
    k, axis, worst, model = max(chosen, key=lambda one: abs(one[2].shift_mg or 0.0))
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
        view=_view(samples, k, axis, model, kind),
    )


def _view(samples: Samples, k: int, axis: int, model: Floats, kind: _Form) -> View:
    """Return the figure of an event in dwell `k`: averaged samples, and the fitted form `model` (n,)."""
    rows = samples.values[k][:, axis] - samples.values[k][:, axis].mean()
    time = samples.elapsed_s(k)
    x, y, shown = neighbour_means(_POINTS, time, rows, model)
    letter = samples.letters[axis]
    return View(
        x,
        y,
        "time since the first sample / s",
        f"{letter} about its mean / mg",
        f"{kind.capitalize()} in position {samples.position[k]}, {letter}: samples averaged, and the fit.",
        shown,
        points=True,
    )
