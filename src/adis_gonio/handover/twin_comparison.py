"""Comparison of measured data with the digital twin: residuals, Allan deviation, spectrum."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.base.arrays import Floats, solvable
from adis_gonio.base.errors import DataError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.fitting.allan.noise_processes import overlapping
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.handover.digital_twin import period_of, simulate_like
from adis_gonio.model.records import Session
from adis_gonio.page.document import Figure, Section, Table
from adis_gonio.page.svg import Role, Series, plot
from adis_gonio.tracing.trace_result import TraceResult


class TwinComparison(JsonRecord):
    """Comparison of a measured session with its digital twin: residuals, Allan deviation, spectrum.

    Attributes
    ----------
    residual_measured, residual_twin : (r,) float
        Whitened residuals of the readings under one model, in their standard uncertainty.
    p_residual : float
        p-value of the Kolmogorov-Smirnov test that both residuals have equal distributions.
    p_variance : float
        p-value of the two-sided F test that χ² per degree of freedom is equal.
    tau_s : (t,) float
        Averaging times of the Allan deviations.
    allan_measured_mg, allan_twin_mg : (t, axes) float
    frequency_hz : (f,) float
    density_measured, density_twin : (f, axes) float
        One-sided amplitude densities within the dwells, mg/√Hz.
    """

    document_keys = (
        *("agrees", "residual_sd_measured", "residual_sd_twin", "p_residual", "p_variance"),
        *("allan_ratio", "density_ratio"),
    )

    residual_measured: Floats
    residual_twin: Floats
    p_residual: float
    p_variance: float
    tau_s: Floats
    allan_measured_mg: Floats
    allan_twin_mg: Floats
    frequency_hz: Floats
    density_measured: Floats
    density_twin: Floats

    @property
    def agrees(self) -> bool:
        """True if the twin's residuals and noise agree with the measured ones.

        The residuals are tested at a level of 1 %; Allan deviations and densities may differ by a factor of
        1.5.
        """
        return min(self.p_residual, self.p_variance) >= 0.01 and all(
            abs(np.log(ratio)) < np.log(1.5) for ratio in (self.allan_ratio, self.density_ratio)
        )

    @property
    def allan_ratio(self) -> float:
        """Measured Allan deviation over the twin's, geometric mean over averaging times and axes."""
        return _ratio(self.allan_measured_mg, self.allan_twin_mg)

    @property
    def density_ratio(self) -> float:
        """Measured noise density over the twin's, geometric mean over frequencies and axes."""
        return _ratio(self.density_measured, self.density_twin)

    @property
    def residual_sd_measured(self) -> float:
        """Standard deviation of the residuals of the measured session."""
        return float(np.std(self.residual_measured))

    @property
    def residual_sd_twin(self) -> float:
        """Standard deviation of the residuals of the twin."""
        return float(np.std(self.residual_twin))


@solvable
def compare(measured: Session, twin: Session, traced: Fit) -> TwinComparison:
    """Compare a session with its twin: fit the traced model to both, compare residuals and noise."""
    ours, theirs = readings_of(measured), readings_of(twin)
    fits = [
        Fit.begin(data).with_terms(traced.terms, traced.values.terms).refit() for data in (ours, theirs)
    ]
    residual = [_residual(fitted) for fitted in fits]
    if not all(part.size for part in residual):
        raise DataError(
            "there are no more readings than parameters, so that there is no residual to compare"
        )
    samples = [_samples(session, data) for session, data in ((measured, ours), (twin, theirs))]
    periods = [period_of(session.dwells) for session in (measured, twin)]
    # Both curves at the averaging times and frequencies of the measured one.
    tau_s, allan = _common([_allan(part, period) for part, period in zip(samples, periods, strict=True)])
    frequency_hz, density = _common(
        [_density(part, period) for part, period in zip(samples, periods, strict=True)]
    )
    return TwinComparison(
        residual_measured=residual[0],
        residual_twin=residual[1],
        p_residual=_p_same(*residual),
        p_variance=_p_variance(*fits),
        tau_s=tau_s,
        allan_measured_mg=allan[0],
        allan_twin_mg=allan[1],
        frequency_hz=frequency_hz,
        density_measured=density[0],
        density_twin=density[1],
    )


def _residual(fitted: Fit) -> Floats:
    rows = fitted.residual.ravel()
    # Directions that a free attitude absorbs have no residual.
    return np.asarray(rows[np.abs(rows) > 1e-9], np.float64)


def _p_same(ours: Floats, theirs: Floats) -> float:
    """Exact p-value of the two-sided test of Kolmogorov and Smirnov that two samples are alike.

    It counts the orders of the joined samples in which the distribution functions stay closer than seen
    (Kim and Jennrich, in Selected Tables in Mathematical Statistics 1, 1973).
    """
    m, n = len(ours), len(theirs)
    joined = np.concatenate([ours, theirs])
    below = [np.searchsorted(np.sort(part), joined, side="right") / len(part) for part in (ours, theirs)]
    seen = (0.5 + np.floor(np.abs(below[0] - below[1]).max() * m * n - 1e-7)) / (m * n)
    of_theirs = np.arange(n + 1) / n
    share = (of_theirs <= seen).astype(np.float64)
    for i in range(1, m + 1):
        inside = np.abs(i / m - of_theirs) <= seen
        # A path reaches (i, j) from (i − 1, j) or from (i, j − 1).
        share = np.where(inside, np.cumsum(np.where(inside, i / (i + n) * share, 0.0)), 0.0)
    return float(min(max(1 - share[-1], 0.0), 1.0))


def _p_variance(ours: Fit, theirs: Fit) -> float:
    from scipy.special import fdtr

    if ours.dof <= 0 or theirs.dof <= 0:
        return 1.0
    ratio = (ours.chi2 / ours.dof) / max(theirs.chi2 / theirs.dof, 1e-300)
    # Two-sided probability of the F distribution.
    below = float(fdtr(ours.dof, theirs.dof, ratio))
    return 2 * min(below, 1 - below)


def _samples(session: Session, data: Readings) -> list[Floats]:
    """Samples (n, axes) of each dwell minus their mean, in mg."""
    parts = [data.unit.mg(dwell.accel) for dwell in session.dwells if len(dwell)]
    return [part - part.mean(axis=0) for part in parts]


def _allan(samples: Sequence[Floats], period_s: float) -> tuple[Floats, Floats]:
    """Averaging times in s and overlapping Allan deviations of all dwells together, one per octave."""
    times, deviation = overlapping(samples)
    return period_s * np.array(times, dtype=float), deviation


def _density(samples: Sequence[Floats], period_s: float) -> tuple[Floats, Floats]:
    """Frequencies in Hz and amplitude densities by Welch's method, averaged over all dwells.

    The densities are averaged over bands of a third of an octave.
    """
    length = int(min(1024, np.median([len(part) for part in samples])))
    parts = [part for part in samples if len(part) >= length]
    taper = np.hanning(length + 1)[:-1, None]
    frequency = np.fft.rfftfreq(length, period_s)[1:]
    power = np.zeros((len(frequency), parts[0].shape[1]))
    for part in parts:
        # Segments that overlap by half, each without its mean.
        starts = range(0, len(part) - length + 1, length - length // 2)
        cut = np.stack([part[start : start + length] for start in starts])
        lines = np.fft.rfft((cut - cut.mean(axis=1, keepdims=True)) * taper, axis=1)[:, 1:]
        power += (np.abs(lines) ** 2).mean(axis=0) / len(parts)
    power *= 2 * period_s / float((taper**2).sum())
    power[-1] /= 1 if length % 2 else 2  # the highest frequency of an even length occurs once
    # Mean power in bands of a third of an octave.
    edges = frequency[0] * 2.0 ** (np.arange(0, 40) / 3)
    band = np.searchsorted(edges, frequency, side="right")
    kept = np.unique(band)
    return (
        np.array([frequency[band == b].mean() for b in kept]),
        np.sqrt(np.array([power[band == b].mean(axis=0) for b in kept])),
    )


def _common(curves: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, list[Floats]]:
    """Interpolate the second curve at the abscissas of the first one, over their common range.

    Both curves are logarithmic in both axes. Returns the abscissas and both curves.
    """
    (place, ours), (other, theirs) = curves
    inside = (place >= other[0] * 0.999) & (place <= other[-1] * 1.001)
    at = np.log(place[inside])
    least = 1e-9 * max(float(theirs.max(initial=0.0)), 1e-99)  # bands without any noise
    logs = [np.interp(at, np.log(other), np.log(np.maximum(column, least))) for column in theirs.T]
    moved = np.stack([np.exp(column) for column in logs], axis=1)
    return place[inside], [ours[inside], moved]


def _ratio(measured: Floats, twin: Floats) -> float:
    both = (measured > 0) & (twin > 0)  # a spectrum of quantization alone has empty bands
    return float(np.exp(np.mean(np.log(measured[both] / twin[both])))) if both.any() else 1.0


_AXES = "xyz"


def twin_section(session: Session, traced: TraceResult, *, seed: int = 0) -> Section | None:
    """Make the report section that compares a session with its digital twin.

    Returns None if the trace has no model.

    Raises
    ------
    DataError
        As `simulate_like`: dwells of a single averaged sample have no noise to copy.
    """
    if not traced.fits:
        return None
    twin = simulate_like(session, traced.fits[-1], seed=seed)
    found = compare(session, twin, traced.fits[-1])
    verdict = (
        "They agree: the model and the noise explain the measured data."
        if found.agrees
        else "They differ: neither the model nor the measured noise explains all of the session."
    )
    return Section(
        title="The digital twin against the measured data",
        words=(
            "The traced model was the world of a simulated sensor, which was measured in the positions and"
            " at the times of the session. " + verdict,
        ),
        folded=True,
        figures=tuple(_figures(found)),
        tables=(_table(found),),
    )


def _figures(found: TwinComparison) -> list[Figure]:
    allan = found.allan_measured_mg, found.allan_twin_mg
    density = found.density_measured, found.density_twin
    pairs = (
        (found.tau_s, *allan, "averaging time / s", "Allan deviation / mg"),
        (found.frequency_hz, *density, "frequency / Hz", "spectral density / mg/√Hz"),
    )
    figures = []
    for x, ours, theirs, x_label, y_label in pairs:
        for k in range(ours.shape[1]):
            series = [
                Series(x, ours[:, k], "measured", role="before"),
                Series(x, theirs[:, k], "twin", role="after", style="line"),
            ]
            title = f"{y_label.split(' /')[0].capitalize()} of {_AXES[k]}"
            svg = plot(series, x_label, y_label, title=title, x_log=True, y_log=True)
            figures.append(Figure(svg, f"{title}, within the dwells."))
    series = [
        _share_below(found.residual_measured, "measured", "before"),
        _share_below(found.residual_twin, "twin", "after"),
    ]
    title = "Distribution of the residuals"
    svg = plot(series, "residual / its standard uncertainty", "share below", title=title)
    return [*figures, Figure(svg, f"{title} of the readings.")]


def _share_below(values: Floats, label: str, role: Role) -> Series:
    share = (np.arange(len(values)) + 0.5) / len(values)
    return Series(np.sort(values), share, label, role=role, style="steps")


def _table(found: TwinComparison) -> Table:
    rows = (
        ("residuals, standard deviation: measured", f"{found.residual_sd_measured:.2f}"),
        ("residuals, standard deviation: twin", f"{found.residual_sd_twin:.2f}"),
        ("same distribution (Kolmogorov-Smirnov), p", f"{found.p_residual:.3f}"),
        ("same variance (F), p", f"{found.p_variance:.3f}"),
        ("Allan deviation, measured over twin", f"{found.allan_ratio:.2f}"),
        ("spectral density, measured over twin", f"{found.density_ratio:.2f}"),
    )
    return Table(("figure", "value"), rows, numeric=(1,))
