"""Courses that the samples of all dwells share: a slope, or settling after each move.

A course is the deviation from the dwell's mean as a function of time. Each dwell is projected on it (a
line, or exponentials with time constants from a few samples to half a dwell). The amplitudes are tested by
their scatter from dwell to dwell (t-test). Slow noise within a dwell is independent between dwells, so no
model of the noise is needed. The amplitude is equal in all dwells, or proportional to the change of the
axis's reading in the preceding move. Time starts at the first sample of the dwell, since the file does not
contain the end of the move.

The time constant is then fitted. Standard uncertainties follow from least squares with residuals that are
correlated within dwells (sandwich estimator, one cluster per dwell).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from adis_gonio.base.arrays import Floats
from adis_gonio.base.numbers import format_number
from adis_gonio.base.uncertainty import FOUND_WITHIN, Value
from adis_gonio.model.records import MG_PER_G
from adis_gonio.tracing.within.samples import (
    Place,
    Samples,
    View,
    WithinFinding,
    corrected,
    neighbour_means,
)

Usable = NDArray[np.bool_]

LEAST_DWELLS = 4
LEAST_SAMPLES = 6
_TAUS = 12
_LONGEST = 0.5
"""Longest time constant in lengths of a dwell; a longer one would give nearly a straight line."""
_BENT = 9.0
"""Least gain of an exponential over a line: decrease of the sum of squares in noise variances."""
_POINTS = 120
_ROUNDING_MG = 1e-9
"""Least standard deviation of a projection; constant samples project on their rounding errors."""


@dataclass(frozen=True)
class _Candidate:
    """A time course (line or exponential) of the samples of one axis, with its test over all dwells.

    Attributes
    ----------
    axis : int
        Index of the axis.
    tau : float or None
        Time constant in s of an exponential; None for a line.
    by_move : bool
        True if the amplitude is proportional to the change of the reading in the preceding move, False if
        it is equal in all dwells.
    p_value : float
        p-value, corrected for the number of tests.
    """

    axis: int
    tau: float | None
    by_move: bool
    p_value: float
    explained: float
    """Sum of squares in mg² that the course explains."""
    noise: float
    """Variance from dwell to dwell of the projection on the course, in mg²."""


def courses(samples: Samples, most: int = 2) -> tuple[list[WithinFinding], Samples]:
    """Find at most `most` time courses common to all dwells; return findings and samples without them.

    A time course is a slope, or an exponential settling after each move.
    """
    found: list[WithinFinding] = []
    while len(found) < most:
        usable = samples.counts >= LEAST_SAMPLES
        if usable.sum() < LEAST_DWELLS:
            break
        best = _best(samples, usable)
        if best is None:
            break
        finding, samples = _fit_course(samples, usable, best)
        found.append(finding)
    return found, samples


def _regressors(samples: Samples) -> Floats:
    """Return the two factors (2, d, axes) to which a slope or settling may be proportional.

    In each dwell and axis the first is 1, the second is the change of the axis's reading in g since the
    dwell before.
    """
    change = np.diff(samples.reading, axis=0, prepend=samples.reading[:1]) / MG_PER_G
    return np.stack([np.ones_like(change), change])


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


def _course(elapsed_s: Floats, tau: float | None) -> Floats:
    """Return the course (n,): an exponential decay by `tau` in s; if `tau` is None the elapsed time."""
    return elapsed_s if tau is None else np.exp(-elapsed_s / tau)


def projections(samples: Samples, usable: Usable, tau: float | None) -> tuple[Floats, Floats]:
    """Return the projections (d, axes) of the samples of each dwell on a time course, and its norms (d,).

    `usable` (d,) is True for the dwells with at least `LEAST_SAMPLES` samples. The course is an exponential
    with the time constant `tau` in s, or a line if `tau` is None. A projection is the amplitude of the
    course times its norm.
    """
    z, norm = np.zeros((len(samples), samples.axes)), np.zeros(len(samples))
    for k in np.flatnonzero(usable).tolist():
        course = _course(samples.elapsed_s(k), tau)
        course = course - course.mean()
        norm[k] = np.sqrt(course @ course)
        if norm[k] > 0:
            z[k] = course @ samples.values[k] / norm[k]
    return z, norm


def _best(samples: Samples, usable: Usable) -> _Candidate | None:
    """Return the slope or settling that explains most variance; None if none is significant.

    `usable` (d,) is True for the dwells with at least `LEAST_SAMPLES` samples.
    """
    taus = grid(samples, usable)
    kinds = _regressors(samples)
    tests = len(taus) * 2 * samples.axes
    best: _Candidate | None = None
    line: _Candidate | None = None
    for tau in taus:
        z, norm = projections(samples, usable, tau)
        for by_move in (False, True):
            # Regression of the projections z on the regressor, without a constant.
            g = norm[:, None] * kinds[int(by_move)]
            energy = (g**2).sum(axis=0)
            alive = energy > 1e-12 * float((norm**2).sum())
            slope = np.where(alive, (g * z).sum(axis=0) / np.where(alive, energy, 1.0), 0.0)
            dof = int(usable.sum()) - 1
            # Dwells in which the regressor is zero do not influence the slope, but show the scatter.
            residual = np.maximum(((z - g * slope)[usable] ** 2).sum(axis=0) / dof, _ROUNDING_MG**2)
            t = slope * np.sqrt(energy / residual)
            for axis in range(samples.axes):
                if not alive[axis]:
                    continue
                p = corrected(2 * float(special.stdtr(dof, -abs(t[axis]))), tests)
                explained = float(slope[axis] ** 2 * energy[axis])
                if p >= FOUND_WITHIN:
                    continue
                own = _Candidate(axis, tau, by_move, p, explained, float(residual[axis]))
                if best is None or explained > best.explained:
                    best = own
                if tau is None and (line is None or explained > line.explained):
                    line = own
    # An exponential has one more parameter: a line is preferred unless the exponential explains much more.
    if best is not None and line is not None and best.explained - line.explained < _BENT * best.noise:
        return line
    return best


def _fit_course(samples: Samples, usable: Usable, best: _Candidate) -> tuple[WithinFinding, Samples]:
    weight = _regressors(samples)[int(best.by_move)]
    dwells = np.flatnonzero(usable).tolist()
    times = {k: samples.elapsed_s(k) for k in dwells}
    centred = {k: samples.values[k] - samples.values[k].mean(axis=0) for k in dwells}
    axes = _significant_axes(samples, usable, best)

    def amplitudes(tau: float | None) -> tuple[Floats, float]:
        z, norm = projections(samples, usable, tau)
        g = norm[:, None] * weight
        energy = np.maximum((g**2).sum(axis=0), 1e-300)
        slope = (g * z).sum(axis=0) / energy
        return slope, float((slope[axes] ** 2 * energy[axes]).sum())

    tau = best.tau
    if tau is not None:
        length = float(np.median([times[k][-1] for k in dwells]))
        search = optimize.minimize_scalar(
            lambda log_tau: -amplitudes(float(np.exp(log_tau)))[1],
            bounds=(np.log(samples.period_s), np.log(3 * length)),
            method="bounded",
            options={"xatol": 1e-4},
        )
        tau = float(np.exp(search.x))
    slope, _ = amplitudes(tau)
    shape = 0 if tau is None else 1
    size = len(axes) + shape
    normal, meat = np.zeros((size, size)), np.zeros((size, size))
    values = list(samples.values)
    shifts = np.zeros((len(samples), samples.axes))
    for k in dwells:
        course = _course(times[k], tau)
        shifts[k] = slope * weight[k] * (course.mean() if tau is not None else 0.0)
        offset = course - course.mean()
        jacobian = np.zeros((len(course), len(axes), size))
        for j, axis in enumerate(axes):
            jacobian[:, j, j] = offset * weight[k, axis]
            if tau is not None:
                # Derivative of exp(−t/τ) by τ.
                bend = course * times[k] / tau**2
                jacobian[:, j, -1] = slope[axis] * weight[k, axis] * (bend - bend.mean())
        residual = centred[k][:, axes] - offset[:, None] * (slope * weight[k])[axes]
        # One score per dwell: its outer products sum to the middle of the sandwich.
        score = np.einsum("naj,na->j", jacobian, residual)
        normal += np.einsum("naj,nai->ji", jacobian, jacobian)
        meat += np.outer(score, score)
        taken = np.zeros(samples.axes)
        taken[axes] = (slope * weight[k])[axes]
        values[k] = values[k] - offset[:, None] * taken
    inverse = np.linalg.pinv(normal)
    d = len(dwells)
    covariance = inverse @ meat @ inverse * d / max(d - size, 1)
    u = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    finding = _finding(samples, best, tau, slope, u, axes, dwells, shifts, weight)
    return finding, samples.with_values(values)


def _significant_axes(samples: Samples, usable: Usable, best: _Candidate) -> list[int]:
    """Return the axes with a slope or settling: the axis of `best`, and others on which it is significant.

    `usable` (d,) is True for the dwells with at least `LEAST_SAMPLES` samples.
    """
    z, norm = projections(samples, usable, best.tau)
    g = norm[:, None] * _regressors(samples)[int(best.by_move)]
    energy = np.maximum((g**2).sum(axis=0), 1e-300)
    slope = (g * z).sum(axis=0) / energy
    dof = int(usable.sum()) - 1
    residual = ((z - g * slope)[usable] ** 2).sum(axis=0) / dof
    p = 2 * special.stdtr(dof, -np.abs(slope) * np.sqrt(energy / np.maximum(residual, 1e-300)))
    return [
        axis for axis in range(samples.axes) if axis == best.axis or p[axis] < FOUND_WITHIN / samples.axes
    ]


def _finding(
    samples: Samples,
    best: _Candidate,
    tau: float | None,
    slope: Floats,
    u: Floats,
    axes: list[int],
    dwells: list[int],
    shifts: Floats,
    weight: Floats,
) -> WithinFinding:
    letters = tuple(samples.letters[axis] for axis in axes)
    stem = "drift" if tau is None else "settling"
    unit = "mg/s" if tau is None else "mg"
    if best.by_move:
        stem, unit = f"{stem}_per_g", unit.replace("mg", "mg/g", 1)
    parameters = {
        f"{stem}_{letter}": Value(float(slope[axis]), float(u[j]), unit)
        for j, (axis, letter) in enumerate(zip(axes, letters, strict=True))
    }
    sizes = ", ".join(f"{letter} {parameters[f'{stem}_{letter}']}" for letter in letters)
    by = ", in proportion to the change of the axis' own reading before" if best.by_move else ""
    positions = tuple(int(samples.position[k]) for k in dwells)
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
            samples.place(k, axis, slope[axis] * weight[k, axis], at=0, shift=float(shifts[k, axis]))
            for k in dwells
            for axis in axes
            if best.by_move
        )
    return WithinFinding(
        kind="drift" if tau is None else "settling",
        effect=None if tau is None or best.by_move else "settling",
        axes=letters,
        positions=positions,
        parameters=parameters,
        p_value=best.p_value,
        sentence=sentence,
        places=places,
        advice=advice,
        view=_view(samples, best, tau, float(slope[best.axis]), weight[:, best.axis], dwells),
    )


def _waiting_time(samples: Samples, amplitude: float, tau: float) -> float:
    """Return the time in s to wait until settling shifts a dwell's mean by only a third of its noise.

    `amplitude` is the largest amplitude of the settling in mg, `tau` its time constant in s. The noise of
    the mean is computed as for white noise.
    """
    sizes = []
    for k in range(len(samples)):
        n = len(samples.values[k])
        noise = float(np.min(samples.values[k].std(axis=0))) / np.sqrt(n)
        length = float(samples.elapsed_s(k)[-1])
        sizes.append(amplitude * tau / max(length, tau) / max(noise / 3, 1e-12))
    excess = float(np.median(sizes))
    return tau * float(np.log(excess)) if excess > 1 else 0.0


def _view(
    samples: Samples, best: _Candidate, tau: float | None, slope: float, weight: Floats, dwells: list[int]
) -> View:
    """Return the figure of a slope or settling: mean over the dwells, in at most `_POINTS` points, and fit.

    `tau` is the time constant in s (None for a line), `slope` the fitted amplitude, `weight` (d,) the
    factor to which each dwell's amplitude is proportional.
    """
    length = min(len(samples.values[k]) for k in dwells)
    norm = float((weight[dwells] ** 2).sum())
    # Least-squares course: each dwell weighted by its regressor.
    mean = sum(
        weight[k] * (samples.values[k][:length, best.axis] - samples.values[k][:, best.axis].mean())
        for k in dwells
    ) / max(norm, 1e-300)
    first = max(dwells, key=lambda k: len(samples.values[k]) == length)
    x, y = neighbour_means(_POINTS, samples.elapsed_s(first)[:length], np.asarray(mean))
    whole = _course(samples.elapsed_s(first), tau)
    model = slope * (_course(x, tau) - whole.mean())
    letter = samples.letters[best.axis]
    unit = "mg/g" if best.by_move else "mg"
    return View(
        x,
        y,
        "time since the first sample / s",
        f"{letter} about its mean / {unit}",
        f"Mean course of {letter} over {len(dwells)} dwells, with what was fitted.",
        model,
        points=True,
    )
