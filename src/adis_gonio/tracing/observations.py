"""What the tracing works on: readings with their noise, and what surrounded each of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adis_gonio.fitting.flicker import covariance_of_means, modes, scatter_of_means, spans
from adis_gonio.model.effects import Conditions
from adis_gonio.model.records import Dwell, Floats, Session

if TYPE_CHECKING:
    from adis_gonio.fitting.readings import Readings

HISTORY_POINTS = 2000
SEEN = 0.02
"""Least root mean square over the poses of what a gain or a skew of 1 adds to the norm beside the other
base parameters and a bias, for it to be fitted: six faces of a cube set down a degree off show less of a
skew and would pay for a bias of milli-g with a skew of degrees."""


@dataclass(frozen=True)
class Observations:
    """Readings of n dwells.

    Attributes
    ----------
    mean_mg : (n, axes) float
        Mean of each dwell; two axes in a planar session, three in space.
    covariance : (n, axes, axes) float
        Covariance of the means in mg².
    noise_dof : float
        Degrees of freedom of that covariance; inf where it was stated.
    known : bool
        False where nothing states the noise of a reading.
    conditions : Conditions
        What surrounded each reading.
    gravity_mg : float
        Local gravity.
    fixture_rad : float
        Standard uncertainty of a declared angle; inf where attitudes are free.
    check : (n,) bool
        Dwells that take no part in choosing or fitting.
    position : (n,) int
        Numbers of the dwells in the file.
    zero_unknown : bool
        True where the file is in counts, so that the zero of an axis is part of the unit.
    fitted : (4,) or (6,) bool or None
        Base parameters that are fitted; None: those that these poses show. Folds have those of the session.
    notes : tuple of str
        What has to be said about the noise.
    slow_mg : (n, axes, k) float or None
        What each of k independent modes of unit variance adds to the readings: the part of `covariance`
        that dwells share (1/f noise). Modes of different axes are independent. None where there is none.
    """

    mean_mg: Floats
    covariance: Floats
    noise_dof: float
    known: bool
    conditions: Conditions
    gravity_mg: float
    fixture_rad: float
    check: NDArray[np.bool_]
    position: NDArray[np.intp]
    zero_unknown: bool = False
    fitted: NDArray[np.bool_] | None = None
    notes: tuple[str, ...] = ()
    slow_mg: Floats | None = None

    def __len__(self) -> int:
        return len(self.mean_mg)

    @property
    def axes(self) -> int:
        """Axes of a reading: 2 in the plane, 3 in space."""
        return int(self.mean_mg.shape[1])

    @property
    def planar(self) -> bool:
        """True where the plane of rotation is known."""
        return self.axes == 2

    @property
    def base_seen(self) -> NDArray[np.bool_]:
        """Base parameters that the poses show (4,) or (6,); the others stay at their nominal values.

        In a plane with free attitudes the start angle is part of them. In space the norm of a reading
        changes by u_i² with a gain, u_i u_j with a skew and u_i with a bias.
        """
        if self.fitted is not None:
            return self.fitted
        if self.planar:
            return np.array([np.isfinite(self.fixture_rad), True, True, True])
        unit = self.mean_mg / np.maximum(np.linalg.norm(self.mean_mg, axis=1, keepdims=True), 1e-300)
        x, y, z = unit.T
        seen = np.array([np.sqrt((u**4).mean()) >= SEEN for u in (x, x, y, x, x, z)])
        beside = np.column_stack([x * x, y * y, z * z, unit])
        for place, skew in ((1, x * y), (3, x * z), (4, y * z)):
            left = skew - beside @ np.linalg.lstsq(beside, skew, rcond=1e-9)[0]
            seen[place] = np.sqrt((left**2).mean()) >= SEEN
            if seen[place]:
                beside = np.column_stack([beside, skew])
        return seen

    @property
    def own_covariance(self) -> Floats:
        """Covariance of the means (n, axes, axes) in mg² without what dwells share."""
        if self.slow_mg is None:
            return self.covariance
        shared: Floats = (self.slow_mg**2).sum(axis=2)[:, :, None] * np.eye(self.axes)
        return self.covariance - shared

    @cached_property
    def root(self) -> Floats:
        """Inverse Cholesky factor (n, axes, axes) of `covariance`, in 1/mg."""
        root: Floats = np.linalg.inv(np.linalg.cholesky(self.covariance))
        return root

    @cached_property
    def own_root(self) -> Floats:
        """Inverse Cholesky factor (n, axes, axes) of `own_covariance`, in 1/mg."""
        root: Floats = np.linalg.inv(np.linalg.cholesky(self.own_covariance))
        return root

    def rows(self, index: NDArray[np.bool_] | NDArray[np.intp]) -> Observations:
        """Some of the dwells."""
        return replace(
            self,
            mean_mg=self.mean_mg[index],
            covariance=self.covariance[index],
            conditions=self.conditions.rows(index),
            check=self.check[index],
            position=self.position[index],
            slow_mg=None if self.slow_mg is None else self.slow_mg[index],
        )


def observe(session: Session) -> Observations:
    """Observations of a session, `check` dwells among them.

    Raises
    ------
    DataError
        As `adis_gonio.fitting.reduce_session`.
    """
    from adis_gonio.fitting.readings import reduce_session, refuse_other_units, refuse_reversed

    dwells = [dwell for dwell in session.dwells if len(dwell)]
    everything = replace(session, dwells=tuple(replace(dwell, use="fit") for dwell in dwells))
    readings = reduce_session(everything)
    refuse_other_units(session, readings)
    refuse_reversed(everything, readings)
    to_mg = _counts_to_mg(readings)
    mean = readings.mean
    covariance = readings.covariance
    if to_mg is not None:
        scale, zero = to_mg
        mean = (mean - zero) / scale
        covariance = covariance / scale**2
    flicker = readings.flicker / (1.0 if to_mg is None else to_mg[0] ** 2)
    covariance, slow = _shared(dwells, covariance, flicker)
    sigma = readings.fixture_sigma_rad
    angles_known = bool(np.isfinite(readings.angle_rad).all())
    if session.plane != "xy" or not angles_known:
        sigma = float("inf")
    finite = readings.dof[np.isfinite(readings.dof)]
    return Observations(
        mean_mg=mean,
        covariance=covariance,
        noise_dof=_together(finite),
        known=bool(readings.known.all()),
        conditions=_conditions(dwells, readings),
        gravity_mg=readings.gravity_mg,
        fixture_rad=0.0 if sigma is None else sigma,
        check=np.array([dwell.use == "check" for dwell in dwells]),
        position=readings.position,
        zero_unknown=to_mg is not None,
        notes=readings.notes,
        slow_mg=slow,
    )


def _shared(dwells: list[Dwell], covariance: Floats, flicker: Floats) -> tuple[Floats, Floats | None]:
    """Covariance of each mean with its true share of 1/f noise, and the modes (n, axes, k) of that noise.

    `reduce_session` has given the same share to every dwell of more than one sample.
    """
    many = np.array([len(dwell) > 1 for dwell in dwells])
    if not flicker.any() or many.sum() < 2:
        return covariance, None
    begin, end = spans([dwell.time_s for dwell in dwells if len(dwell) > 1])
    between = covariance_of_means(begin, end)
    change = np.diagonal(between) - scatter_of_means(int(many.sum()))
    covariance = covariance.copy()
    covariance[many] += (change[:, None] * flicker)[:, :, None] * np.eye(len(flicker))
    factor, _ = modes(between)
    axes, k = len(flicker), factor.shape[1]
    slow = np.zeros((len(dwells), axes, axes * k))
    for axis in range(axes):
        slow[many, axis, axis * k : (axis + 1) * k] = np.sqrt(flicker[axis]) * factor
    return covariance, slow[:, :, (slow != 0).any(axis=(0, 1))]


def _together(dof: Floats) -> float:
    """Degrees of freedom of the noise of all readings together.

    Dwells that share one noise have its degrees of freedom each, more than there are dwells; those that
    have noise of their own have few each, which add up.
    """
    if not dof.size:
        return float("inf")
    return float(dof.max()) if dof.max() > len(dof) else float(dof.sum())


def _counts_to_mg(readings: Readings) -> tuple[float, Floats] | None:
    """One scale (counts per mg) and the zeros (axes,) by a sphere through the readings; None in mg."""
    if readings.unit == "mg":
        return None
    mean = readings.mean
    # |u|² − 2 u·c + const = 0 with the radius in the constant: linear in the centre c.
    design = np.column_stack([2 * mean, np.ones(len(mean))])
    solution = np.linalg.lstsq(design, (mean**2).sum(axis=1), rcond=None)[0]
    centre = solution[:-1]
    radius = float(np.sqrt(max(solution[-1] + centre @ centre, 1e-12)))
    return radius / readings.gravity_mg, centre


def _conditions(dwells: list[Dwell], readings: Readings) -> Conditions:
    start = float(dwells[0].time_s[0])
    angle = readings.angle_rad if np.isfinite(readings.angle_rad).all() else None
    approach = np.array([float(dwell.approach) for dwell in dwells])
    temperature = _means([dwell.temperature_c for dwell in dwells])
    supply = _means([dwell.supply_v for dwell in dwells])
    many = all(len(dwell) > 1 for dwell in dwells)
    return Conditions(
        time_s=np.array([float(dwell.time_s.mean()) for dwell in dwells]) - start,
        angle_rad=angle,
        order=np.arange(len(dwells), dtype=float),
        approach=approach if approach.any() else None,
        previous_angle_rad=None if angle is None else np.concatenate([angle[:1], angle[:-1]]),
        temperature_c=temperature,
        supply_v=supply,
        temperature_history=None if temperature is None else _history(dwells, start),
        variance_mg2=_variances(dwells, readings) if many and readings.unit == "mg" else None,
    )


def _means(series: list[Floats | None]) -> Floats | None:
    means = [float(np.mean(s)) for s in series if s is not None]
    if len(means) != len(series) or not np.isfinite(means).all():
        return None
    return np.array(means)


def _history(dwells: list[Dwell], start: float) -> tuple[Floats, Floats] | None:
    """Temperature of the whole session in at most `HISTORY_POINTS` means of neighbours."""
    time = np.concatenate([dwell.time_s for dwell in dwells]) - start
    temperature = np.concatenate([d.temperature_c for d in dwells if d.temperature_c is not None])
    if (np.diff(time) <= 0).any():
        return None
    if len(time) > HISTORY_POINTS:
        cuts = np.linspace(0, len(time), HISTORY_POINTS, endpoint=False).astype(np.intp)
        counts = np.diff(np.append(cuts, len(time)))
        time = np.add.reduceat(time, cuts) / counts
        temperature = np.add.reduceat(temperature, cuts) / counts
    return time, temperature


def _variances(dwells: list[Dwell], readings: Readings) -> Floats:
    raw = np.array([dwell.accel[:, : readings.mean.shape[1]].var(axis=0) for dwell in dwells])
    return raw * _mg_per_unit(dwells, readings) ** 2


def _mg_per_unit(dwells: list[Dwell], readings: Readings) -> float:
    """Milli-g per unit of the file, from the readings themselves (mean in mg over mean in the unit)."""
    raw = np.array([dwell.accel[:, : readings.mean.shape[1]].mean(axis=0) for dwell in dwells])
    return float((readings.mean * raw).sum() / max(float((raw**2).sum()), 1e-300))
