"""Measured data against the twin's: residuals, Allan deviation, spectrum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats, solvable
from adis_gonio.base.errors import DataError
from adis_gonio.fitting.allan.noise_processes import overlapping
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.handover.twin.world import period_of
from adis_gonio.model.records import Session


@dataclass(frozen=True)
class TwinComparison:
    """What the measured session and its twin have in common.

    Attributes
    ----------
    residual_measured, residual_twin : (r,) float
        Whitened residuals of the readings under the same model; 1 is what their noise explains.
    p_residual : float
        Kolmogorov-Smirnov test that both are of one distribution.
    p_variance : float
        F test, two-sided, that χ² per degree of freedom is the same.
    tau_s : (t,) float
        Averaging times of the Allan deviations.
    allan_measured_mg, allan_twin_mg : (t, axes) float
    frequency_hz : (f,) float
    density_measured, density_twin : (f, axes) float
        One-sided amplitude densities within the dwells, mg/√Hz.
    """

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
        """Residuals do not differ (1 %); Allan deviations and densities are within a factor of 1.5."""
        return min(self.p_residual, self.p_variance) >= 0.01 and all(
            abs(np.log(ratio)) < np.log(1.5) for ratio in (self.allan_ratio, self.density_ratio)
        )

    @property
    def allan_ratio(self) -> float:
        """Measured over twin, geometric mean over averaging times and axes."""
        return _ratio(self.allan_measured_mg, self.allan_twin_mg)

    @property
    def density_ratio(self) -> float:
        """Measured over twin, geometric mean over frequencies and axes."""
        return _ratio(self.density_measured, self.density_twin)

    def as_dict(self) -> dict[str, Any]:
        """Figures, without the curves."""
        return {
            "agrees": self.agrees,
            "residual_sd_measured": float(np.std(self.residual_measured)),
            "residual_sd_twin": float(np.std(self.residual_twin)),
            "p_residual": self.p_residual,
            "p_variance": self.p_variance,
            "allan_ratio": self.allan_ratio,
            "density_ratio": self.density_ratio,
        }


@solvable
def compare(measured: Session, twin: Session, traced: Fit) -> TwinComparison:
    """Compare a session with its twin under the same model, refitted to each from the trace's values."""
    from scipy import stats

    ours, theirs = readings_of(measured), readings_of(twin)
    fits = [
        Fit.begin(data).with_terms(traced.terms, traced.values.terms).refit() for data in (ours, theirs)
    ]
    residual = [_residual(fitted) for fitted in fits]
    if not all(part.size for part in residual):
        raise DataError("there are no more readings than parameters: nothing is left to compare")
    same = stats.ks_2samp(residual[0].tolist(), residual[1].tolist())
    samples = [_samples(session, data) for session, data in ((measured, ours), (twin, theirs))]
    periods = [period_of(session.dwells) for session in (measured, twin)]
    tau_s, allan = _common([_allan(part, period) for part, period in zip(samples, periods, strict=True)])
    frequency_hz, density = _common(
        [_density(part, period) for part, period in zip(samples, periods, strict=True)]
    )
    return TwinComparison(
        residual_measured=residual[0],
        residual_twin=residual[1],
        p_residual=float(same.pvalue),
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
    # Directions that a free attitude takes up have no residual.
    return np.asarray(rows[np.abs(rows) > 1e-9], np.float64)


def _p_variance(ours: Fit, theirs: Fit) -> float:
    from scipy import stats

    if ours.dof <= 0 or theirs.dof <= 0:
        return 1.0
    ratio = (ours.chi2 / ours.dof) / max(theirs.chi2 / theirs.dof, 1e-300)
    below = float(stats.f.cdf(ratio, ours.dof, theirs.dof))
    return 2 * min(below, 1 - below)


def _samples(session: Session, data: Readings) -> list[Floats]:
    """Samples of every dwell about its mean, in mg."""
    parts = [data.unit.mg(dwell.accel) for dwell in session.dwells if len(dwell)]
    return [part - part.mean(axis=0) for part in parts]


def _allan(samples: Sequence[Floats], period_s: float) -> tuple[Floats, Floats]:
    """Overlapping Allan deviation, pooled over dwells, at octaves of the averaging time."""
    times, deviation = overlapping(samples)
    return period_s * np.array(times, dtype=float), deviation


def _density(samples: Sequence[Floats], period_s: float) -> tuple[Floats, Floats]:
    """Amplitude density by Welch's method, averaged over dwells and then over thirds of an octave."""
    from scipy import signal

    length = int(min(1024, np.median([len(part) for part in samples])))
    parts = [part for part in samples if len(part) >= length]
    power: Floats = np.array([])
    for part in parts:
        frequency, own = signal.welch(part, 1 / period_s, nperseg=length, axis=0)
        power = own if not power.size else power + own
    power, frequency = power[1:] / len(parts), frequency[1:]
    edges = frequency[0] * 2.0 ** (np.arange(0, 40) / 3)
    band = np.searchsorted(edges, frequency, side="right")
    kept = np.unique(band)
    return (
        np.array([frequency[band == b].mean() for b in kept]),
        np.sqrt(np.array([power[band == b].mean(axis=0) for b in kept])),
    )


def _common(curves: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, list[Floats]]:
    """Curves on the first one's places, over the range that both have."""
    (place, ours), (other, theirs) = curves
    inside = (place >= other[0] * 0.999) & (place <= other[-1] * 1.001)
    at = np.log(place[inside])
    least = 1e-9 * max(float(theirs.max(initial=0.0)), 1e-99)  # bands without any noise
    logs = [np.interp(at, np.log(other), np.log(np.maximum(column, least))) for column in theirs.T]
    moved = np.stack([np.exp(column) for column in logs], axis=1)
    return place[inside], [ours[inside], moved]


def _ratio(measured: Floats, twin: Floats) -> float:
    both = (measured > 0) & (twin > 0)  # a spectrum that is quantization only has empty bands
    return float(np.exp(np.mean(np.log(measured[both] / twin[both])))) if both.any() else 1.0
