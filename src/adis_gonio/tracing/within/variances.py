"""Changes of the scatter of the samples between dwells: the effect `noise_change`.

The variance of a dwell is compared above `LOWEST` cycles per dwell, without drift and slow noise. Its
degrees of freedom depend on the density (correlated neighbours count less), on the excess of the fourth
moment over that of a normal distribution, and on the converter: if the noise is near its step, the
variance depends on the position of the mean between two codes. Behind a long filter a few low frequencies
contain nearly all variance, while added white noise appears at the other frequencies. The level is
therefore compared too; it is the mean over all frequencies of the power in units of the density.

Four tests on each axis: all dwells equal (Bartlett), one change between two dwells (F, all places), one
dwell against the others (F), one change of the level against its scatter from dwell to dwell (t, all
places).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import special

from adis_gonio.base.arrays import Floats
from adis_gonio.base.numbers import format_number
from adis_gonio.base.uncertainty import FOUND_WITHIN, INADEQUATE, Value
from adis_gonio.fitting.estimation.screening import LIVELY
from adis_gonio.tracing.within.samples import Place, Samples, WithinFinding, corrected, positions_text
from adis_gonio.tracing.within.tones import TAPER_LOSS, Density, without_line

LEAST_DWELLS = 3
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

    def alike(self) -> float:
        """Return the p-value of Bartlett's test that all dwells have equal variances."""
        d = len(self.variance)
        if d < 2:
            return 1.0
        half = self.dof / 2
        correction = 1 + (np.sum(1 / self.dof) - 1 / self.dof.sum()) / (3 * (d - 1))
        statistic = 2 * (half.sum() * np.log(self.common) - half @ np.log(self.variance)) / correction
        return float(special.chdtrc(d - 1, max(statistic, 0.0)))

    def changed(self) -> float:
        """Return the p-value of the t-test for a single change of the level, at the most significant place.

        All places between two dwells are tried, and the p-value is corrected for their number.
        """
        d = len(self.level)
        p = 1.0
        for cut in range(1, d):
            step, u = step_of(self.course, self.level_dof, cut)
            p = min(p, 2 * float(special.stdtr(d - 2, -abs(step) / max(u, 1e-300))))
        return min(1.0, p * (d - 1))


def step_of(course: Floats, weight: Floats, cut: int) -> tuple[float, float]:
    """Return the change of the series `course` (d,) at index `cut`, and its standard uncertainty.

    The change is the weighted mean from index `cut` on minus the weighted mean before it. `weight` (d,) are
    relative weights, in proportion to 1/variance (such as degrees of freedom); the uncertainty follows from
    the scatter of the values about the two means.
    """
    parts = [(course[own], weight[own]) for own in (slice(cut), slice(cut, None))]
    means = [float(np.average(x, weights=w)) for x, w in parts]
    squares = sum(float(w @ (x - mean) ** 2) for (x, w), mean in zip(parts, means, strict=True))
    u2 = squares / (len(course) - 2) * sum(1 / float(w.sum()) for _, w in parts)
    return means[1] - means[0], math.sqrt(u2)


def noise_change(samples: Samples, density: Density | None) -> WithinFinding | None:
    """Return the finding on a change of the samples' scatter from dwell to dwell; None without a change.

    At least three dwells are needed. `density` is the noise density of the dwells, None if no dwell is long
    enough for a spectrum.
    """
    if density is None or len(density.dwells) < LEAST_DWELLS:
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
    candidates = [own.alike(), own.changed()]
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
    best: tuple[float, int] | None = None
    for cut in range(1, len(levels[0].level)):
        steps = [step_of(own.course, own.level_dof, cut) for own in levels]
        # Reduction of the log scatter by one step.
        dof = len(levels[0].level) - 2
        gain = sum(math.log1p((step / max(u, 1e-300)) ** 2 / dof) for step, u in steps)
        if best is None or gain > best[0]:
            best = (gain, cut if all(step > 0 for step, _ in steps) else 0)
    return best[1] if best is not None and best[1] else None


def _explained(own: Levels, cut: int) -> bool:
    """Return True if a single change of the noise explains the variances of an axis.

    The change is before dwell `cut` or within the dwell before it; the variances on each side must agree.
    """
    at = np.arange(len(own.variance))
    parts = [own.rows(at < cut - 1), own.rows(at > cut)]
    p = [part.alike() for part in parts if len(part.variance) > 1]
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
        axes=(),
        positions=positions,
        parameters={**{f"extra_{letter}": size for letter, size in extra.items()}, "start": start},
        p_value=1.0,
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
        effect=None,
        axes=(),
        positions=positions,
        parameters=parameters,
        p_value=1.0,
        sentence=(
            "the samples do not scatter alike in all dwells (standard deviation "
            f"{', '.join(f'{letter} {low} to {high} mg' for letter, low, high in ranges)}); unusual: "
            f"{positions_text(positions, len(samples))}"
        ),
        places=tuple(places),
    )
