"""Courses in the samples: a slope or settling that all dwells share, and events in single dwells.

A shared course is the deviation from the dwell's mean as a function of time. Each dwell is projected on it
(a line, or exponentials with time constants from a few samples to half a dwell). The amplitudes are tested
by their scatter from dwell to dwell (t-test). Slow noise within a dwell is independent between dwells, so
no model of the noise is needed. The amplitude is equal in all dwells, or proportional to the change of the
axis's reading in the preceding move. Time starts at the first sample of the dwell, since the file does not
contain the end of the move.

The time constant is then fitted. Standard uncertainties follow from least squares with residuals that are
correlated within dwells (sandwich estimator, one cluster per dwell).

Events in single dwells are a step, a slope or a transient. At each of several scales (from a few samples to
half a dwell) the means of neighbouring stretches are subtracted (Haar wavelet at every position). For
stationary noise of any spectrum, 1/f noise included, the differences of one scale have one normal
distribution. Their scatter over all positions and dwells therefore judges the largest difference, and no
model of the noise is needed. If a scale has many independent positions, the scatter is the median absolute
deviation. At the longest scales, with one or two differences per dwell, it comes from the other dwells
without outliers, with few degrees of freedom and little power.

A significant dwell is described by the form with the smallest residual: a step, a line or an exponential.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from adis_gonio.base.arrays import MAD_TO_SD, Floats, robust_sd
from adis_gonio.base.numbers import format_number
from adis_gonio.base.uncertainty import FOUND_WITHIN, Detectable, Value
from adis_gonio.fitting.estimation.screening import LIVELY
from adis_gonio.model.records import MG_PER_G
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

Usable = NDArray[np.bool_]

LEAST_DWELLS = 4
LEAST_SAMPLES = 6
_TAUS = 12
_LONGEST = 0.5
"""Longest time constant in lengths of a dwell; a longer one would give nearly a straight line."""
_BENT = 9.0
"""Least gain of an exponential over a line: decrease of the sum of squares in noise variances."""
_ROUNDING_MG = 1e-9
"""Least standard deviation of a projection; constant samples project on their rounding errors."""


@dataclass(frozen=True)
class Course:
    """A time course (line or exponential) of the samples, fitted to all dwells on every axis.

    Attributes
    ----------
    tau : float or None
        Time constant in s of an exponential; None for a line.
    by_move : bool
        True if the amplitude is proportional to the change of the reading in the preceding move, False if
        it is equal in all dwells.
    slope : (axes,) float
        Amplitude, in units of the factor to which it is proportional.
    energy : (axes,) float
        Sum of squares of the course in all dwells, for unit amplitude.
    noise : (axes,) float
        Variance from dwell to dwell of the projection on the course, in mg².
    p_value : (axes,) float
        p-value of the t-test over the dwells, not corrected; 1 on an axis with a factor of zero.
    """

    tau: float | None
    by_move: bool
    slope: Floats
    energy: Floats
    noise: Floats
    p_value: Floats

    @classmethod
    def of(cls, samples: Samples, usable: Usable, tau: float | None, by_move: bool) -> Course:
        """Fit a line or an exponential to the samples of all dwells that the mask `usable` (d,) selects.

        `tau` is the time constant in s; None for a line. With `by_move` the amplitude is proportional to
        the change of the reading in the move before the dwell, otherwise it is equal in all dwells.
        """
        z, norm = np.zeros((len(samples), samples.axes)), np.zeros(len(samples))
        for k in np.flatnonzero(usable).tolist():
            course = _shape(samples.elapsed_s(k), tau)
            course = course - course.mean()
            norm[k] = np.sqrt(course @ course)
            if norm[k] > 0:
                z[k] = course @ samples.values[k] / norm[k]
        # Regression of the projections z on the regressor, without a constant.
        g = norm[:, None] * _regressor(samples, by_move)
        energy = (g**2).sum(axis=0)
        alive = energy > 1e-12 * float((norm**2).sum())
        slope = np.where(alive, (g * z).sum(axis=0) / np.where(alive, energy, 1.0), 0.0)
        dof = int(usable.sum()) - 1
        # Dwells in which the regressor is zero do not influence the slope, but show the scatter.
        noise = np.maximum(((z - g * slope)[usable] ** 2).sum(axis=0) / dof, _ROUNDING_MG**2)
        p = np.where(alive, 2 * special.stdtr(dof, -np.abs(slope) * np.sqrt(energy / noise)), 1.0)
        return cls(tau, by_move, slope, energy, noise, p)

    @property
    def explained(self) -> Floats:
        """Sum of squares (axes,) in mg² that the course explains."""
        return self.slope**2 * self.energy


def courses(samples: Samples, most: int = 2) -> tuple[list[WithinFinding], Samples]:
    """Find at most `most` time courses common to all dwells; return findings and samples without them.

    A time course is a slope, or an exponential settling after each move.
    """
    found: list[WithinFinding] = []
    usable = samples.counts >= LEAST_SAMPLES
    while len(found) < most and usable.sum() >= LEAST_DWELLS:
        best = _best(samples, usable)
        if best is None:
            break
        finding, samples = _fit_course(samples, usable, *best)
        found.append(finding)
    return found, samples


def _regressor(samples: Samples, by_move: bool) -> Floats:
    """Return the factor (d, axes) to which a slope or settling is proportional in each dwell.

    It is the change of the axis's reading in g since the dwell before if `by_move`, else 1.
    """
    if not by_move:
        return np.ones_like(samples.reading)
    return np.diff(samples.reading, axis=0, prepend=samples.reading[:1]) / MG_PER_G


def grid(samples: Samples, usable: Usable) -> list[float | None]:
    """Return the time constants in s to try; None in the list stands for a straight line.

    `usable` (d,) is True for the dwells with at least `LEAST_SAMPLES` samples.
    """
    lengths = [float(samples.elapsed_s(k)[-1]) for k in np.flatnonzero(usable).tolist()]
    longest = float(np.median(lengths))
    shortest = 3 * samples.period_s
    if not 0 < shortest < _LONGEST * longest:
        return [None]
    return [None, *np.geomspace(shortest, _LONGEST * longest, _TAUS).tolist()]


def _shape(elapsed_s: Floats, tau: float | None) -> Floats:
    """Return the course (n,): an exponential decay by `tau` in s; if `tau` is None the elapsed time."""
    return elapsed_s if tau is None else np.exp(-elapsed_s / tau)


def _best(samples: Samples, usable: Usable) -> tuple[Course, int, float] | None:
    """Return the significant course that explains most variance, its axis and its corrected p-value.

    The result is None if no slope or settling is significant on any axis. `usable` (d,) is True for the
    dwells with at least `LEAST_SAMPLES` samples.
    """
    taus = grid(samples, usable)
    tests = len(taus) * 2 * samples.axes
    found = [
        (course, axis, p)
        for course in (Course.of(samples, usable, tau, by) for tau in taus for by in (False, True))
        for axis in range(samples.axes)
        if (p := corrected(float(course.p_value[axis]), tests)) < FOUND_WITHIN
    ]
    if not found:
        return None

    def explained(one: tuple[Course, int, float]) -> float:
        return float(one[0].explained[one[1]])

    best = max(found, key=explained)
    line = max((one for one in found if one[0].tau is None), key=explained, default=best)
    # An exponential has one more parameter: a line is preferred unless the exponential explains much more.
    more = explained(best) - explained(line)
    return line if more < _BENT * float(best[0].noise[best[1]]) else best


def _fit_course(
    samples: Samples, usable: Usable, best: Course, axis: int, p_value: float
) -> tuple[WithinFinding, Samples]:
    """Fit the time constant of a course on all axes that show it; return finding and samples without it.

    `axis` is the axis on which the course was found, with the corrected p-value `p_value`.
    """
    weight = _regressor(samples, best.by_move)
    dwells = np.flatnonzero(usable).tolist()
    times = {k: samples.elapsed_s(k) for k in dwells}
    centred = {k: samples.values[k] - samples.values[k].mean(axis=0) for k in dwells}
    shown = best.p_value < FOUND_WITHIN / samples.axes
    axes = [k for k in range(samples.axes) if k == axis or shown[k]]
    tau = best.tau
    if tau is not None:
        length = float(np.median([times[k][-1] for k in dwells]))
        search = optimize.minimize_scalar(
            lambda log_tau: (
                -float(
                    Course.of(samples, usable, float(np.exp(log_tau)), best.by_move).explained[axes].sum()
                )
            ),
            bounds=(np.log(samples.period_s), np.log(3 * length)),
            method="bounded",
            options={"xatol": 1e-4},
        )
        tau = float(np.exp(search.x))
    fitted = Course.of(samples, usable, tau, best.by_move)
    size = len(axes) + (tau is not None)
    normal, meat = np.zeros((size, size)), np.zeros((size, size))
    values = list(samples.values)
    for k in dwells:
        course = _shape(times[k], tau)
        offset, own = course - course.mean(), weight[k, axes]
        taken = fitted.slope[axes] * own
        jacobian = np.zeros((len(course), len(axes), size))
        jacobian[:, range(len(axes)), range(len(axes))] = offset[:, None] * own
        if tau is not None:
            # Derivative of exp(−t/τ) by τ.
            bend = course * times[k] / tau**2
            jacobian[:, :, -1] = taken * (bend - bend.mean())[:, None]
        residual = centred[k][:, axes] - offset[:, None] * taken
        # One score per dwell: its outer products sum to the middle of the sandwich.
        score = np.einsum("naj,na->j", jacobian, residual)
        normal += np.einsum("naj,nai->ji", jacobian, jacobian)
        meat += np.outer(score, score)
        values[k] = values[k].copy()
        values[k][:, axes] -= offset[:, None] * taken
    inverse = np.linalg.pinv(normal)
    d = len(dwells)
    covariance = inverse @ meat @ inverse * d / max(d - size, 1)
    u = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    finding = _finding(samples, fitted, u, axes, dwells)
    return replace(finding, p_value=p_value), samples.with_values(values)


def _finding(
    samples: Samples, fitted: Course, u: Floats, axes: list[int], dwells: list[int]
) -> WithinFinding:
    """Return the finding of a fitted course, without its p-value.

    `u` are the standard uncertainties of the amplitudes on these `axes`, then of the time constant if the
    course has one. `dwells` are the indices of the fitted dwells.
    """
    tau, slope, weight = fitted.tau, fitted.slope, _regressor(samples, fitted.by_move)
    letters = tuple(samples.letters[axis] for axis in axes)
    stem = "drift" if tau is None else "settling"
    unit = "mg/s" if tau is None else "mg"
    if fitted.by_move:
        stem, unit = f"{stem}_per_g", unit.replace("mg", "mg/g", 1)
    parameters = {
        f"{stem}_{letter}": Value(float(slope[axis]), float(u[j]), unit)
        for j, (axis, letter) in enumerate(zip(axes, letters, strict=True))
    }
    sizes = ", ".join(f"{letter} {parameters[f'{stem}_{letter}']}" for letter in letters)
    by = ", in proportion to the change of the axis' own reading before" if fitted.by_move else ""
    advice = ""
    places: tuple[Place, ...] = ()
    if tau is None:
        sentence = f"within the dwells the samples drift in common: {sizes}{by}"
        advice = (
            "let the sensor warm up longer, or keep the temperature steadier: the samples drift while the "
            "part stands still"
        )
    else:
        parameters["tau"] = Value(tau, float(u[-1]), "s")
        largest = float(np.abs(slope[axes] * weight[dwells][:, axes]).max())
        means = np.array([_shape(samples.elapsed_s(k), tau).mean() for k in dwells])
        shifts = slope * weight[dwells] * means[:, None]
        shift = float(np.abs(shifts[:, axes]).max())
        needed = _waiting_time(samples, largest, tau)
        sentence = (
            f"each dwell settles: {sizes} at its first sample, time constant "
            f"{parameters['tau']}{by}; it moves the means by up to {format_number(shift, 2)} mg"
        )
        if needed > 0:
            wait = format_number(needed, 2)
            advice = f"wait {wait} s longer after each move before recording: the dwells settle"
        places = tuple(
            samples.place(k, axis, slope[axis] * weight[k, axis], at=0, shift=float(moved[axis]))
            for k, moved in zip(dwells, shifts, strict=True)
            for axis in axes
            if fitted.by_move
        )
    return WithinFinding(
        kind="drift" if tau is None else "settling",
        effect=None if tau is None or fitted.by_move else "settling",
        axes=letters,
        positions=tuple(samples.position[dwells].tolist()),
        parameters=parameters,
        sentence=sentence,
        places=places,
        advice=advice,
    )


def _waiting_time(samples: Samples, amplitude: float, tau: float) -> float:
    """Return the time in s to wait until settling shifts a dwell's mean by only a third of its noise.

    `amplitude` is the largest amplitude of the settling in mg, `tau` its time constant in s. The noise of
    the mean is computed as for white noise.
    """
    lengths = [time[-1] - time[0] for time in samples.time_s]
    shifts = amplitude * tau / np.maximum(lengths, tau)
    excess = float(np.median(shifts / np.maximum(samples.u_of_means / 3, 1e-12)))
    return tau * float(np.log(excess)) if excess > 1 else 0.0


_SHORTEST = 8
_MANY = 300
"""Number of independent differences above which their scatter is the median absolute deviation.
With fewer differences the scatter comes from the other dwells."""
_RARE, _FEW = 1e-3, 0.15
_COMPARED_DWELLS = 6
_EFFICIENCY = 0.37
"""Efficiency of the median absolute deviation relative to the standard deviation."""
_EVENT_TAUS = 8
_CLEAR = 4.0
"""Least size of a form (step, drift, settling), in standard uncertainties, to describe a dwell by it."""


Form = Literal["step", "drift", "settling", "disturbance"]


class _Largest(NamedTuple):
    """The largest differences between the means of neighbouring stretches of a dwell, on each axis.

    `stretch` is the length of a stretch in samples. The arrays (axes,) are `place`, the number of the first
    sample in the later of the two stretches; `height_mg`, the later minus the earlier mean; `u_mg`, the
    standard deviation of such differences; and `p_value`, the one-sided p-value, not corrected.
    """

    stretch: int
    place: NDArray[np.intp]
    height_mg: Floats
    u_mg: Floats
    p_value: Floats


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
    largest, differences = _largest_differences(samples, unit, max(_SHORTEST, 2 * reach))
    tests = 2 * SEARCHES * samples.axes * differences
    p = np.ones(unit.shape)
    for k, scales in enumerate(largest):
        p[k] = np.min([p[k], *(tests * scale.p_value for scale in scales)], axis=0)
    described = [
        (k, axis, *_describe(samples, k, axis, largest[k]))
        for k, axis in np.argwhere(p < FOUND_WITHIN).tolist()
    ]
    found = []
    for form in get_args(Form):
        chosen = [(place, float(p[k, axis])) for k, axis, own, place in described if own == form]
        if chosen:
            places, p_values = zip(*chosen, strict=True)
            found.append(_finding_of_events(samples, form, places, min(p_values)))
    return found


def _largest_differences(samples: Samples, unit: Floats, shortest: int) -> tuple[list[list[_Largest]], int]:
    """Return the largest differences on all scales, by dwell, and the number of all differences.

    A scale is a length of the stretches: it doubles from `shortest` samples on; on the last scale it is
    half of each dwell. `unit` (d, axes) divides the samples of each dwell.
    """
    sums = [
        np.concatenate(
            [np.zeros((1, samples.axes)), np.cumsum((rows - rows.mean(axis=0)) / unit[k], axis=0)]
        )
        for k, rows in enumerate(samples.values)
    ]
    # If the noise is below the converter's step, a mean may be wrong by half a step.
    scatter = np.array([rows.std(axis=0) for rows in samples.values])
    coarse = np.where(scatter < LIVELY * samples.quantum, 0.5 * samples.quantum / unit, 0.0)
    counts = samples.counts
    doublings = range(max(int(counts.max()) // (3 * shortest), 0).bit_length())
    found: list[list[_Largest]] = [[] for _ in samples.values]
    tests = 0
    for length in (*(shortest << j for j in doublings), None):
        stretch = counts // 2 if length is None else np.full(len(samples), length)
        dwells = np.flatnonzero((counts >= LEAST_SAMPLES) & (2 * stretch <= counts))
        # Number of independent differences in each dwell for white noise.
        apart = np.maximum(1.0, counts[dwells] / (2 * stretch[dwells]))
        if apart.sum() <= 2:
            continue
        differences, places, highest = [], [], []
        for k in dwells.tolist():
            # Adjacent stretches of `own` samples at every quarter of a stretch; sums from cumulative sums.
            own, total = int(stretch[k]), sums[k]
            middle = np.arange(own, counts[k] - own + 1, max(1, own // 4))
            change = (total[middle + own] - 2 * total[middle] + total[middle - own]) / np.sqrt(2 * own)
            top = np.abs(change).argmax(axis=0)
            differences.append(change)
            places.append(middle[top])
            highest.append(change[top, range(samples.axes)])
        half = np.sqrt(stretch[dwells] / 2)[:, None]
        largest = np.maximum(np.abs(highest) - coarse[dwells] * half, 0.0)
        p, spread = _judge(apart, differences, largest)
        p = np.where(largest > 0, p, 1.0)
        tests += sum(map(len, differences))
        for row, k in enumerate(dwells.tolist()):
            # Back to the difference of two means in mg.
            mg = unit[k] / half[row]
            found[k].append(
                _Largest(int(stretch[k]), places[row], highest[row] * mg, spread[row] * mg, p[row])
            )
    return found, tests


def _judge(apart: Floats, differences: Sequence[Floats], largest: Floats) -> tuple[Floats, Floats]:
    """Return the one-sided p-values (m, axes) of the largest differences, and the scatter of differences.

    `apart` (m,) are the numbers of independent differences in the dwells, `differences` (j, axes) all
    differences of each dwell, `largest` (m, axes) the moduli of the largest ones. The scatter is the
    standard deviation (m, axes) that each dwell is compared with.
    """
    p, spreads = np.ones_like(largest), np.zeros_like(largest)
    every = np.concatenate(differences)
    for axis in range(largest.shape[1]):
        squares = np.array([(own[:, axis] ** 2).mean() for own in differences])
        weight = _independent(apart, squares)
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
    dwells then have no difference at all.) No dwell is excluded if there are fewer than `_COMPARED_DWELLS`
    dwells, or if the share of outliers exceeds `_FEW`. `squares` and `weight` (m,) are these mean squares
    and weights.
    """
    if len(weight) < _COMPARED_DWELLS:
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
    if len(squares) < _COMPARED_DWELLS:
        return nominal
    spread = robust_sd(np.log(np.maximum(squares, 1e-300)))
    # The logarithm of a mean of ν squares has variance 2/ν.
    return np.minimum(nominal, max(2 / max(spread, 1e-6) ** 2, 1.0))


def _describe(samples: Samples, k: int, axis: int, scales: Sequence[_Largest]) -> tuple[Form, Place]:
    """Return the form that describes a dwell best, and its place.

    If the form is not significant in the noise of its scale, the event is a disturbance of the length at
    which it was found. `k` and `axis` are the indices of dwell and axis.
    """
    rows = samples.values[k][:, axis] - samples.values[k][:, axis].mean()
    elapsed, period, n = samples.elapsed_s(k), samples.period_s, len(rows)
    length = max(float(elapsed[-1]), 1e-12)
    # Step: the sum of squares decreases by n1 n2/n times the squared difference of the means.
    before = np.arange(1, n)
    gain = np.cumsum(rows)[:-1] ** 2 * n / (before * (n - before))
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
    for tau in np.geomspace(3 * period, length / 3, _EVENT_TAUS) if length > 9 * period else ():
        decay = np.exp(-elapsed / tau)
        forms.append(("settling", decay, min(tau / period, n / 2), 0, "mg", 1.0, float(decay.mean())))

    def u_mg(stretch: float) -> float:
        """Return u of the difference between the means of two stretches, by the nearest scale."""
        nearest = min(scales, key=lambda one: abs(math.log(one.stretch / stretch)))
        return float(nearest.u_mg[axis])

    most, chosen = -1.0, None
    for form, course, stretch, at, unit, per_mg, shift in forms:
        centred = course - course.mean()
        energy = max(float(centred @ centred), 1e-300)
        size = float(centred @ rows) / energy
        if size**2 * energy > most:
            most, u = size**2 * energy, per_mg * u_mg(stretch)
            place = samples.place(k, axis, size, u, unit, at, size * shift)
            chosen = form, place, abs(size) > _CLEAR * u
    assert chosen is not None
    form, place, certain = chosen
    if certain:
        return form, place
    scale = min(scales, key=lambda one: float(one.p_value[axis]))
    height, u = float(scale.height_mg[axis]), float(scale.u_mg[axis])
    shift = height * scale.stretch / n
    return "disturbance", samples.place(k, axis, height, u, at=int(scale.place[axis]), shift=shift)


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


def _finding_of_events(
    samples: Samples, kind: Form, places: tuple[Place, ...], p_value: float
) -> WithinFinding:
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


def smallest_settling(samples: Samples) -> Detectable:
    """Return the smallest amplitude of a settling, common to all dwells, that the search would have found.

    The time constant is the middle of the searched grid; the limit comes from the t-test over the dwells.
    """
    usable = samples.counts >= LEAST_SAMPLES
    constants = [tau for tau in grid(samples, usable) if tau is not None] if usable.any() else []
    dwells = int(usable.sum())
    if dwells < LEAST_DWELLS or not constants:
        return Detectable(
            None, "mg", "settling", f"needs {LEAST_DWELLS} dwells of {LEAST_SAMPLES} samples or more"
        )
    course = Course.of(samples, usable, constants[len(constants) // 2], by_move=False)
    tests = (len(constants) + 1) * 2 * samples.axes
    # Size in units of its u that exceeds the two-sided limit with a probability of 90 %.
    p = FOUND_WITHIN / SEARCHES / tests / 2
    size = -float(special.stdtrit(dwells - 1, p) + special.stdtrit(dwells - 1, 1 - POWER))
    return Detectable(float(np.sqrt((course.noise / course.energy).max())) * size, "mg", "settling")
