"""Spectral lines inside the dwells, against the density of the session's own noise.

Two searches at every frequency and axis: the ordinates of all dwells together (a line that all of them
hold, each with a phase of its own), and the largest ordinate of a single dwell. Under noise an ordinate is
exponentially distributed about the density, so that the sum of d is a gamma variable; the density is an
estimate itself, which makes it an F variable. Real noise is rougher than that (dwells differ in their
spectra): degrees of freedom are lowered until they explain the scatter of the ordinates about the running
median. A line is taken away before the next one is looked for.

The time between samples need not be constant: frequency and amplitude are fitted on the samples' own times.
A line at f of samples at the rate f_s may be a vibration at f or at any k f_s ± f, k = 1, 2, …: above
half of the rate it is seen as its alias, and a filter that works on samples already taken lets it pass as
it lets f pass. A finding names them all up to `HIGHEST_HZ`. Amplitudes are those of the recorded samples,
behind whatever filter the sensor has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from adis_gonio.base.arrays import Floats
from adis_gonio.base.numbers import format_number
from adis_gonio.base.uncertainty import FOUND_WITHIN, Value
from adis_gonio.model.effects import effect
from adis_gonio.tracing.within.density import PADDING, TAPER_LOSS, Density, density_of, without_line
from adis_gonio.tracing.within.finding import (
    View,
    WithinFinding,
    corrected,
    positions_text,
)
from adis_gonio.tracing.within.samples import Samples

HIGHEST_HZ = effect("tone", ("x",)).parameters[1].high
"""Highest true frequency that is thought of: the bound of the catalogue's `tone`."""
MOST_ALIASES = 6
"""Most of them in a sentence."""
MOST = 5
"""Most lines that are looked for."""
_MOST_POINTS = 600


@dataclass(frozen=True)
class _Peak:
    """A point of the grid at which a line stands."""

    at: int
    p_value: float
    dwell: int | None
    """Row of the density of the one dwell that shows it; None where all together do."""


def tones(samples: Samples) -> tuple[list[WithinFinding], Samples, Density | None]:
    """Lines, the samples without them, and the density of what is left."""
    found: list[WithinFinding] = []
    density = density_of(samples)
    while density is not None and len(found) < MOST:
        peak = _highest(density)
        line = None if peak is None else _line(samples, density, peak)
        if line is None:
            break
        finding, samples = line
        found.append(finding)
        density = density_of(samples)
    return found, samples, density


def _highest(density: Density) -> _Peak | None:
    """The most significant line, if any is."""
    searched, relative = density.searched, density.relative
    d, points, axes = relative.shape
    if points < 1:
        return None
    tests = 2.0 * points * axes
    pooled = relative.mean(axis=0)
    width = density.width[searched]
    best: _Peak | None = None
    for axis in range(axes):
        effective = float(density.effective[axis])
        freedom = 2 * effective * width / TAPER_LOSS
        at = int(np.argmax(pooled[:, axis]))
        p = corrected(float(stats.f.sf(pooled[at, axis], 2 * effective, freedom[at])), tests)
        if best is None or p < best.p_value:
            best = _Peak(at + searched.start, p, None)
        single = relative[:, :, axis]
        dwell, at = divmod(int(np.argmax(single)), points)
        # Spectra of single dwells differ: the line has to stand out of its own dwell as well.
        half = int(width[at] * PADDING / 2)
        own = single[dwell, max(0, at - half) : at + half + 1]
        height = single[dwell, at] / max(1.0, float(np.median(own)) / np.log(2))
        rough = effective / d
        p = corrected(float(stats.f.sf(height, 2, 2 * width[at] / TAPER_LOSS)) ** rough, tests * d)
        if p < best.p_value:
            best = _Peak(at + searched.start, p, dwell)
    return best if best is not None and best.p_value < FOUND_WITHIN else None


def _line(samples: Samples, density: Density, peak: _Peak) -> tuple[WithinFinding, Samples] | None:
    """Fit a line at a peak and take it away; None where nothing of it is left on the samples' own times."""
    period = samples.period_s
    dwells = density.dwells
    times = [samples.elapsed_s(int(k)) for k in dwells]
    rows = [without_line(samples.values[int(k)]) for k in dwells]
    weight = 1.0 / (density.level * density.base[peak.at])
    step = density.frequency[1] / period
    about = density.frequency[peak.at] / period

    every = list(zip(times, rows, weight, strict=True))
    showing = [every[k] for k in _showing(density, peak)]

    def power(frequency: float) -> float:
        total = 0.0
        for time, own, w in showing:
            total += float((np.abs(np.exp(-2j * np.pi * frequency * time) @ own) ** 2 / len(own)) @ w)
        return -total

    search = optimize.minimize_scalar(
        power, bounds=(about - step, about + step), method="bounded", options={"xatol": 1e-4 * step}
    )
    frequency = float(search.x)
    squares, quadratures = _amplitudes(frequency, times, rows)
    counts = np.array([len(own) for own in rows], dtype=float)[:, None]
    noise = density.level * density.base[peak.at]
    # A quadrature of n samples of density S has the variance 2 S/n.
    excess = squares * counts / (4 * noise)
    chosen = np.ones(len(dwells), dtype=bool)
    if peak.dwell is not None:
        chosen = excess.max(axis=1) > -np.log(FOUND_WITHIN / excess.size)
        if not chosen.any():
            return None
    amplitude, u, stands = _sizes(squares[chosen], (4 * noise / counts)[chosen], excess[chosen])
    axes = [k for k in range(samples.axes) if stands[k]] or [int(np.argmax(excess.sum(axis=0)))]
    if not amplitude[axes].max() > 0:
        return None
    clear = excess[:, axes].max(axis=1) > -np.log(FOUND_WITHIN / (len(dwells) * len(axes)))
    if peak.dwell is None and (clear.mean() > 0.5 or not clear.any()):
        # A line that most dwells show stands in the others as well, below what one dwell can tell.
        expected = (amplitude[axes] ** 2 * counts / (4 * noise[:, axes])).sum(axis=1)
        clear |= excess[:, axes].sum(axis=1) > 0.25 * expected
    if not clear.any():
        return None
    information = float((clear[:, None] * amplitude[axes] ** 2 * counts**3 / (24 * noise[:, axes])).sum())
    u_frequency = 1 / (2 * np.pi * period * np.sqrt(max(information, 1e-300)))
    positions = tuple(int(p) for p in samples.position[dwells[clear]])
    if not clear.all():
        amplitude, u, _ = _sizes(squares[clear], (4 * noise / counts)[clear], excess[clear])
    values = list(samples.values)
    for k, time, (cosine, sine) in zip(dwells.tolist(), times, quadratures, strict=True):
        turn = 2 * np.pi * frequency * time
        values[k] = values[k] - np.cos(turn)[:, None] * cosine - np.sin(turn)[:, None] * sine
    letters = tuple(samples.letters[k] for k in axes)
    parameters = {
        **{f"tone_{samples.letters[k]}": Value(float(amplitude[k]), float(u[k]), "mg") for k in axes},
        "frequency": Value(frequency, float(u_frequency), "Hz"),
    }
    sizes = ", ".join(f"{samples.letters[k]} {parameters[f'tone_{samples.letters[k]}']}" for k in axes)
    folding = aliases_hz(frequency, 1 / period)
    finding = WithinFinding(
        kind="tone",
        effect="tone",
        axes=letters,
        positions=positions,
        parameters=parameters,
        p_value=peak.p_value,
        sentence=(
            f"a spectral line at {parameters['frequency']} (amplitude {sizes}) in "
            f"{positions_text(positions, len(samples))}{_or_alias(folding)}"
        ),
        advice=(
            "find what shakes the table at the line's frequency, or at one that folds to it: record again "
            "at another rate, where a line of that frequency stays and an alias moves"
        ),
        aliases_hz=folding,
        view=_view(density, period, axes[0], samples.letters[axes[0]], frequency),
    )
    return finding, samples.with_values(values)


def _showing(density: Density, peak: _Peak) -> list[int]:
    """Numbers of the dwells that show a peak: all, where it was found in all of them together."""
    if peak.dwell is None:
        return list(range(len(density.dwells)))
    near = slice(peak.at - PADDING, peak.at + PADDING + 1)
    height = density.power[:, near] / density.level[:, None, :] / density.bound[None, near]
    shown = height.max(axis=(1, 2)) > -np.log(FOUND_WITHIN / height.size)
    shown[peak.dwell] = True
    return [int(k) for k in np.flatnonzero(shown)]


def aliases_hz(frequency_hz: float, rate_hz: float) -> tuple[float, ...]:
    """Frequencies k f_s ± f up to `HIGHEST_HZ` that samples at a rate f_s show at f, lowest first."""
    orders = np.arange(1, int((HIGHEST_HZ + frequency_hz) / rate_hz) + 1)
    folding = np.concatenate([orders * rate_hz - frequency_hz, orders * rate_hz + frequency_hz])
    return tuple(np.sort(folding[folding <= HIGHEST_HZ]).tolist())


def _or_alias(folding: tuple[float, ...]) -> str:
    """What a sentence says of the frequencies that fold to a line."""
    if not folding:
        return ""
    named = ", ".join(format_number(f, 4) for f in folding[:MOST_ALIASES])
    more = ", …" if len(folding) > MOST_ALIASES else ""
    return f"; a vibration at {named}{more} Hz would be seen there as well"


def _amplitudes(
    frequency: float, times: list[Floats], rows: list[Floats]
) -> tuple[Floats, list[tuple[Floats, Floats]]]:
    """Squared amplitudes (d, axes) and the quadratures of each dwell by least squares."""
    squares, quadratures = [], []
    for time, own in zip(times, rows, strict=True):
        turn = 2 * np.pi * frequency * time
        design = np.column_stack([np.cos(turn), np.sin(turn), np.ones_like(turn)])
        solution = np.linalg.lstsq(design, own, rcond=None)[0]
        squares.append(solution[0] ** 2 + solution[1] ** 2)
        quadratures.append((solution[0], solution[1]))
    return np.array(squares), quadratures


def _sizes(squares: Floats, noise: Floats, excess: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Amplitude of each axis (axes,), its standard uncertainty, and whether it stands out of the noise.

    Noise adds to the square of an amplitude; dwells scatter by noise and because the line's strength may
    change, and both show in the scatter of the squares.
    """
    d = len(squares)
    weight = 1 / noise
    weight = weight / weight.sum(axis=0)
    mean = (weight * (squares - noise)).sum(axis=0)
    amplitude = np.sqrt(np.maximum(mean, 0.0))
    own = (weight**2 * noise * (noise + 2 * np.maximum(mean, 0.0))).sum(axis=0)
    if d > 1:
        spread = (weight**2 * (squares - noise - mean) ** 2).sum(axis=0) * d / (d - 1)
        own = np.maximum(own, spread)
    u = np.sqrt(own) / (2 * np.maximum(amplitude, 1e-300))
    u = np.minimum(u, np.sqrt(np.sqrt(own)))
    shown = stats.gamma.sf(excess.sum(axis=0), d) < 1e-3
    return amplitude, u, np.asarray(shown)


def _view(density: Density, period: float, axis: int, letter: str, frequency: float) -> View:
    """Pooled amplitude density about a line, in mg/√Hz, one-sided."""
    level = float(density.level[:, axis].mean())
    pooled = (density.power / density.level[:, None, :]).mean(axis=0)[:, axis] * level
    inside = slice(density.searched.start, density.searched.stop)
    x, y = density.frequency[inside] / period, np.sqrt(2 * period * pooled[inside])
    model = np.sqrt(2 * period * level * density.base[inside, axis])
    if len(x) > _MOST_POINTS:
        # Maxima of neighbours, so that the line stays in the drawing.
        each = -(-len(x) // _MOST_POINTS)
        cut = len(x) // each * each
        top = y[:cut].reshape(-1, each).argmax(axis=1) + np.arange(0, cut, each)
        x, y, model = x[top], y[top], model[top]
    return View(
        x,
        y,
        x,
        model,
        "frequency / Hz",
        f"density of {letter} / mg/√Hz",
        f"Spectrum of {letter} inside the dwells, with a line at {format_number(frequency, 4)} Hz.",
        model_label="noise",
        y_log=True,
    )
