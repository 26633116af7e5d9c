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

from dataclasses import dataclass, replace

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
    WithinFinding,
    corrected,
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
        p_value=1.0,
        sentence=sentence,
        places=places,
        advice=advice,
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
