"""Readings: a dwell's mean with its covariance and degrees of freedom, in mg.

The covariance of a reading has three parts.

* *Noise that averaging lowers*: spectral density at zero of the dwell's own samples, divided by their
  number (`fitting.spectrum`). Dwells whose densities are consistent share one (Bartlett's test at 0.1 %),
  which gives short dwells the degrees of freedom of all; where they are not, each keeps its own.
* *Quantization*: with noise of σ before a converter of step q the mean is off by up to
  (q/π)·exp(−2π²σ²/q²); its variance over all places between two codes is
  q²/(2π²)·Σ exp(−4π²k²σ²/q²)/k², which is q²/12 without noise and nothing at σ > q/2, where the noise
  dithers and quantization has become part of it.
* *Bias instability* (1/f noise), which averaging does not lower: from the dwells' lowest frequencies where
  they show it; else the variant's figure (an estimate: confidence D), but no more than the dwells allow;
  zero for a sensor without a figure. An Allan deviation s makes the means of N dwells scatter with
  s²·N ln N / (2 (N − 1) ln 2) (Barnes 1969).

A dwell of one sample is a reading that somebody averaged: `Session.reading_u_mg` is its whole uncertainty.
Without that it is unknown (`Readings.known`), and a fit estimates it from its residual.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from adis_gonio.errors import DataError, FitError
from adis_gonio.fitting.flicker import covariance_of_means, scatter_of_means, spans
from adis_gonio.fitting.screening import refuse_dead_data
from adis_gonio.fitting.spectrum import MeanNoise, noise_of_means
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Dwell, Floats, Session
from adis_gonio.sensor.variants import VARIANTS

MG_PER_MPS2 = 1000.0 / STANDARD_GRAVITY_MPS2


MOST_SHARED = 2000
"""Dwells up to which 1/f noise that they share counts between them: beyond, its covariance is too large to
keep, and of so many readings little is left of it."""
LEAST_TURNING, LEAST_TURN, LEAST_AREA = 4, 0.3, 0.5
"""Positions, least singular value of their cosines, sines and ones, and area (1 of a good sensor) from
which the sense of rotation is beyond doubt."""
OFF_UNIT = 2.0
"""Factor from 1 g beyond which still readings are in another unit: no sensor's gain is so far off."""
UNEQUAL = 0.5
"""Relative distance of a reading's length from the median of all, that no bias explains."""


@dataclass(frozen=True)
class Readings:
    """One row a dwell.

    Attributes
    ----------
    mean : (n, axes) float
        Mean of each dwell in `unit`; two columns in a planar session, three in space.
    covariance : (n, axes, axes) float
        Covariance of the means; where `known` is False a placeholder of 1 mg on each axis.
    dof : (n,) float
        Degrees of freedom of the covariance; inf where it was stated.
    angle_rad : (n,) float
        Declared angle θ; NaN where unknown.
    position : (n,) int
        Numbers of the dwells.
    samples : (n,) int
        Samples of each dwell.
    known : (n,) bool
        False where nothing states the uncertainty.
    unit : str
        `mg`, or `counts` where scale and zero have to be found.
    gravity_mg : float
        Local gravity.
    fixture_sigma_rad : float or None
        Standard uncertainty of a declared angle; inf free, None not stated.
    notes : tuple of str
        What has to be said about the noise.
    flicker : (axes,) float
        Allan variance of the 1/f noise that is in `covariance`, in the unit squared. There it is noise of
        each reading's own; in truth neighbours share most of it (`adis_gonio.fitting.flicker`).
    shared : (n, n) float or None
        What is to be added to the covariance of an axis' readings, times its `flicker`, so that it is true
        between them as well; None without 1/f noise, or beyond `MOST_SHARED` dwells.
    """

    mean: Floats
    covariance: Floats
    dof: Floats
    angle_rad: Floats
    position: NDArray[np.intp]
    samples: NDArray[np.intp]
    known: NDArray[np.bool_]
    unit: str
    gravity_mg: float
    fixture_sigma_rad: float | None
    notes: tuple[str, ...] = ()
    flicker: Floats = field(default_factory=lambda: np.zeros(3))
    shared: Floats | None = None

    def __len__(self) -> int:
        return len(self.mean)

    def select(self, rows: NDArray[np.intp]) -> Readings:
        """Readings of some rows (m,)."""
        names = ("mean", "covariance", "dof", "angle_rad", "position", "samples", "known")
        shared = None if self.shared is None else self.shared[np.ix_(rows, rows)]
        return replace(self, shared=shared, **{name: getattr(self, name)[rows] for name in names})


def refuse_other_units(session: Session, readings: Readings) -> None:
    """Raise `DataError` where readings of still poses are nowhere near 1 g: another unit, or no gravity.

    Parameters
    ----------
    readings : Readings
        Of this session.
    """
    if readings.unit != "mg":
        return
    lengths = np.linalg.norm(readings.mean, axis=1) / session.gravity_mg
    length = float(np.median(lengths))
    if 1 / OFF_UNIT < length < OFF_UNIT:
        odd = readings.position[np.abs(lengths / length - 1) > UNEQUAL].tolist()
        if odd and session.accel_unit != "counts":
            which = f"position{'s' if len(odd) > 1 else ''} {', '.join(map(str, odd[:8]))}"
            raise DataError(
                f"{session.source or 'session'}: readings of {which} are not 1 g long as the others: an "
                "axis is dead or saturated, or the part was not at rest; leave such dwells out"
            )
        return
    also = "; a plane that is turned has to be vertical" if session.plane == "xy" and length < 1 else ""
    raise DataError(
        f"{session.source or 'session'}: readings are {length:.3g} g long where 1 g acts: accel_unit "
        f"{session.accel_unit} cannot be right (lsb goes by the sensor, {session.sensor}); state the unit "
        f"of the file, or counts where it is not known{also}"
    )


def refuse_reversed(session: Session, readings: Readings) -> None:
    """Raise `DataError` where the readings turn the other way than the declared angles.

    X follows cos(α − θ) and Y sin(α − θ): with x_c, x_s, y_c, y_s their first harmonics, the sense of
    rotation is the sign of x_s y_c − x_c y_s, which neither gains nor a misalignment below 90° change.
    """
    rows = np.isfinite(readings.angle_rad)
    free = readings.fixture_sigma_rad is not None and math.isinf(readings.fixture_sigma_rad)
    if session.plane != "xy" or free or readings.unit != "mg" or readings.mean.shape[1] != 2:
        return
    theta = readings.angle_rad[rows]
    design = np.column_stack([np.cos(theta), np.sin(theta), np.ones(len(theta))])
    if len(theta) < LEAST_TURNING or np.linalg.svd(design, compute_uv=False)[-1] < LEAST_TURN:
        return
    (x_c, x_s, _), (y_c, y_s, _) = np.linalg.lstsq(design, readings.mean[rows], rcond=None)[0].T
    area = (x_s * y_c - x_c * y_s) / session.gravity_mg**2
    if area > -LEAST_AREA:
        return
    raise DataError(
        f"{session.source or 'session'}: the readings turn the other way than the declared angles: change "
        "the sign of angle_deg, or of an axis, so that Y reads at 90° minus what X reads at 0°"
    )


def reduce_session(session: Session) -> Readings:
    """Readings of the dwells that a fit may use (`check` dwells are left out).

    Raises
    ------
    DataError
        All-zero or stuck data, no usable dwell, readings that are not finite.
    """
    session = session.used_for("fit")
    dwells = [dwell for dwell in session.dwells if len(dwell)]
    if not dwells:
        raise DataError(
            f"{session.source or 'session'}: no dwell to fit; every dwell is empty or for checking"
        )
    axes = 2 if session.plane == "xy" else 3
    if dwells[0].accel.shape[1] < axes:
        raise DataError(f"{session.source or 'session'}: plane none needs three axes, there are two")
    refuse_dead_data(session)
    scale = _mg_per_unit(session)
    n = len(dwells)
    mean = np.array([d.accel[0, :axes] if len(d) == 1 else d.accel[:, :axes].mean(axis=0) for d in dwells])
    mean = mean * scale
    if not np.isfinite(mean).all():
        bad = int(np.flatnonzero(~np.isfinite(mean).all(axis=1))[0])
        raise DataError(
            f"{session.source or 'session'}: position {dwells[bad].position} holds NaN or infinity"
        )
    samples = np.array([len(d) for d in dwells], dtype=np.intp)
    unit = "counts" if session.accel_unit == "counts" else "mg"

    covariance = np.broadcast_to(np.eye(axes), (n, axes, axes)).copy()
    dof = np.full(n, np.inf)
    known = np.zeros(n, dtype=np.bool_)
    flicker = np.zeros(axes)
    notes: list[str] = []
    single = np.flatnonzero(samples == 1)
    if single.size:
        per_mg = 1.0 if unit == "mg" else _counts_per_mg(mean, session.gravity_mg)
        u = 1.0 if session.reading_u_mg is None else session.reading_u_mg
        covariance[single] *= (u * per_mg) ** 2
        known[single] = session.reading_u_mg is not None
    many = np.flatnonzero(samples > 1)
    if many.size:
        rows = [dwells[k].accel[:, :axes] * scale for k in many.tolist()]
        noise = noise_of_means(rows)
        quantum = _quantum(session, rows, scale)
        flicker = _flicker(session, noise)
        floor = flicker * scatter_of_means(many.size)
        covariance[many] = noise.covariance + (
            _quantization(rows, quantum)[:, :, None] + floor[None, :, None]
        ) * np.eye(axes)
        dof[many] = noise.dof
        known[many] = True
        if noise.too_short:
            notes.append(
                "within the dwells the noise still rises towards the lowest frequencies (a long filter, "
                "drift or 1/f noise): the uncertainty of a reading is itself uncertain, dwell longer"
            )
    sigma = session.fixture_sigma_deg
    return Readings(
        mean=mean,
        covariance=covariance,
        dof=dof,
        angle_rad=np.radians([np.nan if d.angle_deg is None else d.angle_deg for d in dwells]),
        position=np.array([d.position for d in dwells], dtype=np.intp),
        samples=samples,
        known=known,
        unit=unit,
        gravity_mg=session.gravity_mg,
        fixture_sigma_rad=None if sigma is None else math.radians(sigma),
        notes=tuple(notes),
        flicker=flicker,
        shared=shared_by(dwells) if flicker.any() else None,
    )


def shared_by(dwells: Sequence[Dwell]) -> Floats | None:
    """Covariance (n, n) of means for an Allan variance of 1, less that of dwells with a noise of their own.

    Zero for dwells of one sample, which somebody averaged; None for more than `MOST_SHARED`.

    `covariance_of_means` is about the mean of the session. Of 1/f noise that mean has no variance to be
    given; here it has that by which it differs from the mean of a session twice as long, half the Allan
    variance, so that a bias is stated as well as it would be found again.
    """
    many = np.array([len(dwell) > 1 for dwell in dwells])
    count = int(many.sum())
    if count < 2 or count > MOST_SHARED:
        return None
    begin, end = spans([dwell.time_s for dwell in dwells if len(dwell) > 1])
    out = np.zeros((len(dwells), len(dwells)))
    own = scatter_of_means(count) * np.eye(count)
    out[np.ix_(many, many)] = covariance_of_means(begin, end) + 0.5 - own
    return out


def _mg_per_unit(session: Session) -> float:
    if session.accel_unit == "lsb":
        if session.sensor not in VARIANTS:
            raise DataError(
                f"{session.source or 'session'}: the LSB of sensor '{session.sensor}' is not known"
            )
        return VARIANTS[session.sensor].accel_mg_per_lsb
    return {"mg": 1.0, "g": 1000.0, "mps2": MG_PER_MPS2, "counts": 1.0}[session.accel_unit]


def _counts_per_mg(mean: Floats, gravity_mg: float) -> float:
    span = float(np.ptp(mean, axis=0).max())
    if span <= 0:
        raise FitError(
            "readings in counts are all alike; their scale cannot be found: measure more positions"
        )
    return span / 2 / gravity_mg


def _quantum(session: Session, rows: list[Floats], scale: float) -> Floats:
    """Step of the converter on each axis (axes,): the LSB, else the smallest step between values seen."""
    axes = rows[0].shape[1]
    if session.accel_unit == "lsb":
        return np.full(axes, scale)
    steps = np.zeros(axes)
    sample = np.concatenate([r[:2000] for r in rows[:20]])
    for axis in range(axes):
        values = np.unique(sample[:, axis])
        gaps = np.diff(values)
        gaps = gaps[gaps > 1e-9 * max(1.0, float(np.abs(values).max()))]
        steps[axis] = gaps.min() if gaps.size else 0.0
    return steps


def _quantization(rows: list[Floats], quantum: Floats) -> Floats:
    """Variance (dwells, axes) that quantization leaves on a mean."""
    variance = np.array([r.var(axis=0) for r in rows])
    step = np.where(quantum > 0, quantum, 1.0)
    sigma2 = np.maximum(variance - quantum**2 / 12, 0.0) / step**2
    if float(sigma2.min(initial=np.inf)) > 1.0:
        return np.zeros_like(variance)
    k = np.arange(1, 200)
    series = np.exp(-4 * math.pi**2 * k**2 * np.minimum(sigma2, 1.0)[..., None]) / k**2
    return np.asarray(quantum**2 / (2 * math.pi**2) * series.sum(axis=-1))


def _flicker(session: Session, noise: MeanNoise) -> Floats:
    """Allan variance (axes,) of the 1/f noise in mg²."""
    variant = VARIANTS.get(session.sensor)
    stated = 0.0 if variant is None else variant.performance.bias_instability_mg**2
    if session.accel_unit == "counts":
        stated = 0.0
    shown = noise.flicker > 0
    return np.where(shown, noise.flicker, np.minimum(stated, noise.flicker_limit))
