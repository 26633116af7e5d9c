"""The measurement: readings of ideal axes under gravity, and of ideal gyros in turns.

All packages use this convention. The axes of the sensor are three unit vectors, the rows of D. X is the
reference, Y is in the plane of x and y, and a *skew* is 90° minus the angle between two axes, so that its
sine is the cosine of that angle::

        y ▲   Y          D = ⎡ 1         0        0 ⎤      X · Y = sin(skew_xy)
          │  ╱               ⎢ sin s_xy  cos s_xy 0 ⎥      X · Z = sin(skew_xz)
          │ ╱ skew_xy        ⎣ sin s_xz  …        … ⎦      Y · Z = sin(skew_yz)
          │╱
          └──────▶ X       U = diag(K) D g + b

K_i is the sensitivity along the direction of axis i. In the plane, gravity is at the angle ψ = α − θ + δ
from X (α start angle, θ declared angle, δ the fixture's error), so that U_x = K_x G cos ψ + b_x and U_y =
K_y G sin(ψ + Δφ) + b_y: Δφ *is* skew_xy, and K_x = K_y (1 + ΔK). Gravity alone cannot show a rotation of
all axes together, so D has three angles and not six.

A `Measurement` contains these equations together with the unknown *attitude* of each dwell: `PlanarTurn`
and `FreeAttitude` for accelerometers, `MeanRate` for gyros, other subclasses for other readings. Fit and
trace take all properties of a kind of readings from this object, such as the unit and the typical size.
Angles are in radians inside; results are stated in `BaseParameter.unit`.

Gyros are right-handed about the drawn axes, in the frame of the accelerometers, and read in °/s::

    rate = K D ω + b + G f + …

ω is the true rate, K gains and D unit directions, b the zero rate, G the linear g-sensitivity and f the
**readings** of the accelerometers in g (level with Z up: z = −1). The base model is a perfect gyro with a
zero rate; everything else is an effect (`model.effects.gyro_terms`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, mean_direction, wrap_degrees, wrap_radians
from adis_gonio.base.errors import UsageError
from adis_gonio.model.records import MG_PER_G

if TYPE_CHECKING:
    from adis_gonio.model.effects.base import Conditions

SKEW_AXES: tuple[tuple[int, int], ...] = ((0, 1), (0, 2), (1, 2))
"""Indices of the two axes between which each skew lies: skew_xy, skew_xz, skew_yz."""

SENSOR_SPREAD = 0.2
"""Prior standard deviation of gains, skews and misalignment (rad) over all devices sold as sensors."""
SESSION_BIAS_MG, SESSION_ZERO_DPS = 1.7, 0.022
"""Prior standard deviation of an accelerometer's bias and of a gyro's zero rate in one session about their
mean over all sessions of the part. Source: the means of six runs at rest, 10 000 s each, of one ADIS16405
(SMAC-Group/imudata, adis_16405_imu1 to imu6) scatter by 2.4, 1.2, 1.2 mg and 0.022, 0.023, 0.020 °/s; 15
degrees of freedom, so ±18 %."""
SEEN = 0.02
"""Smallest effect on the readings with which a gain or a skew is fitted.
The effect is the change of the length of a reading, in units of gravity per unit of the parameter: its rms
over the poses, without the part that the other base parameters and a bias can imitate. If a part is set
down on its six faces with errors of a degree, a skew has a smaller effect, and a fit would exchange a bias
of milli-g for a skew of degrees."""


@dataclass(frozen=True)
class BaseParameter:
    """A parameter of the base model, with its unit, nominal value and prior.

    Attributes
    ----------
    name : str
        Name of the parameter, such as `scale_x`.
    unit : str
        Unit in results: `deg` (computations use rad), `1`, or `Measurement.unit`.
    nominal : float
        Value of a perfect sensor, in natural units (rad, 1).
    spread : float
        Prior standard deviation about the nominal value; inf if nothing is known (the start angle).
    low, high : float
        Limits for real sensors, in natural units.
    """

    name: str
    unit: str
    nominal: float
    spread: float = SENSOR_SPREAD
    low: float = -math.inf
    high: float = math.inf

    @property
    def per_natural(self) -> float:
        """Factor from the natural unit (rad, 1) to `unit`: 180/π for degrees, else 1."""
        return 180 / math.pi if self.unit == "deg" else 1.0

    def stated(self, value: float) -> float:
        """Convert a value from natural units (rad, 1) to `unit`; the start angle is wrapped to ±180°."""
        out = value * self.per_natural
        return wrap_degrees(out) if self.unit == "deg" and math.isinf(self.spread) else out


class Measurement(ABC):
    """Equations for the readings of n dwells as a function of base parameters (p,) and attitudes.

    Attributes
    ----------
    parameters : tuple of BaseParameter
        Base parameters, in the order of their values.
    axes : int
        Number of axes of a reading.
    freedom : int
        Number of unknown angles in the attitude of a dwell; the last dimension of `tangent`.
    part : str
        Part of the sensor that gives the readings: `accelerometer` or `gyro`.
    unit : str
        Unit of the readings and of the terms that effects add.
    full : float
        Reading in `unit` for which the trace states the amplitude of a function that has no named cause.
    constant : bool
        True if the base model contains a constant (bias) for each axis.
    planar : bool
        True if the sensor turns in a known plane.
    origins : tuple of SessionOrigin
        Part and stage of each session, if the dwells are of several sessions; else empty.
    driven_by : tuple of str
        Covariates on which an unnamed function may depend in addition to the recorded conditions:
        `reading`, `force`, `rotation`.
    named_forms : mapping of str to tuple of str
        For each covariate, the properties of an axis (`bias`, `gain`, `misalignment`) for which the
        catalogue has an effect in proportion to the covariate. The trace tries no unnamed function that
        would repeat such an effect.
    """

    parameters: tuple[BaseParameter, ...]
    axes: int
    freedom: int
    part: str = "accelerometer"
    unit: str = "mg"
    full: float = MG_PER_G
    constant: bool = False
    planar: bool = False
    origins: tuple[SessionOrigin, ...] = ()
    driven_by: tuple[str, ...] = ("reading",)
    named_forms: Mapping[str, tuple[str, ...]] = {
        "time": ("bias", "gain"),
        "temperature": ("bias", "gain", "misalignment"),
        "supply": ("bias", "gain"),
        "temperature_rate": ("bias",),
    }

    @property
    def size(self) -> float:
        """Typical size of a reading: local gravity in mg for accelerometers, 100 °/s for gyros."""
        return float(getattr(self, "gravity_mg", self.full))

    def stimulus(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the quantity (n, axes) that the gains multiply, in units of 1 g (gyros: 100 °/s)."""
        return ideal / self.full

    def pose(self, reading: Floats, conditions: Conditions) -> Floats | None:
        """Return the unit vectors (n, axes) of gravity along the sensor's axes; None if unknown.

        `reading` (n, axes) are the measured readings.
        """
        return np.asarray(reading / np.linalg.norm(reading, axis=1, keepdims=True))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters, in their order."""
        return tuple(parameter.name for parameter in self.parameters)

    def index(self, name: str) -> int:
        """Return the index of a base parameter in `parameters`, by its name."""
        return self.names.index(name)

    @property
    def nominal(self) -> Floats:
        """Base parameters (p,) of a perfect sensor, in natural units."""
        return np.array([parameter.nominal for parameter in self.parameters])

    def by_pose(self, conditions: Conditions) -> NDArray[np.bool_]:
        """Return for each reading (n,) True if it was taken at rest in a pose, False if in a turn."""
        return np.ones(len(conditions), dtype=bool)

    @abstractmethod
    def begin(self, reading: Floats, angle_rad: Floats, conditions: Conditions) -> tuple[Floats, Floats]:
        """Return rough starting values: base parameters (p,), and the attitude of each dwell.

        Parameters
        ----------
        reading : (n, axes) float
            Measured readings in `unit`.
        angle_rad : (n,) float
            Declared angle θ in rad; NaN for a dwell without one.
        conditions : Conditions
            Circumstances of the dwells.
        """

    @abstractmethod
    def ideal(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the ideal readings (n, axes) in mg or °/s at attitudes rotated further by `turn_rad`.

        `base` (p,) are the base parameters; `attitude` are the attitudes of n dwells.
        """

    @abstractmethod
    def tangent(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the derivative of the ideal readings by the attitude, (n, axes, freedom), per rad.

        `freedom` is the number of unknown angles in an attitude. The derivative is taken for the base
        parameters `base` (p,), at the attitudes of n dwells rotated further by `turn_rad` (n,).
        """

    @abstractmethod
    def columns(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the derivative of the ideal readings by the base parameters `base` (p,), (n, axes, p).

        It is in mg or °/s, for an angle per rad and for a gain per 1. The derivative is taken at the
        attitudes of n dwells, rotated further by `turn_rad` (n,).
        """

    @abstractmethod
    def moved(self, attitude: Floats, step: Floats) -> Floats:
        """Return the attitudes of n dwells after a rotation of each by `step` (n, freedom) in rad."""

    def deviation_rad(self, attitude: Floats) -> Floats:
        """Return the deviation of the attitudes of n dwells from the declared ones, (n, freedom) in rad.

        A fit penalizes it by the uncertainty of the fixture. By default it is 0.
        """
        return np.zeros((len(attitude), self.freedom))

    @abstractmethod
    def calibrated(self, base: Floats, reading: Floats) -> Floats:
        """Return the calibrated output (n, axes) for readings (n, axes) by base parameters (p,).

        It is gravity along the axes in units of local gravity, or rates of turn in °/s.
        """

    def start_rad(self, base: Floats) -> float | Floats:
        """Return the start angle α in rad: one number for all dwells, or (n,); 0 without a plane.

        `base` (p,) are the base parameters.
        """
        return 0.0

    @property
    def sessions(self) -> list[tuple[Measurement, NDArray[np.intp]]]:
        """Measurement of each session, and the numbers of its parameters among all base parameters."""
        return [(self, np.arange(len(self.parameters)))]

    def rows(self, index: NDArray[np.bool_] | NDArray[np.intp]) -> Measurement:
        """Return the measurement of the selected dwells."""
        return self

    def visible(self, reading: Floats, declared: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return for each base parameter (p,) if dwells with these readings can determine it.

        `declared` (n,) is True for dwells with a declared angle.
        """
        return np.ones(len(self.parameters), dtype=bool)


@dataclass(frozen=True)
class PlanarTurn(Measurement):
    """A turn in one vertical plane; the attitude of a dwell is δ, its deviation from the declared angle.

    Attributes
    ----------
    gravity_mg : float
        Local gravity in mg.
    """

    gravity_mg: float

    parameters = (
        BaseParameter("alpha", "deg", 0.0, spread=math.inf),
        BaseParameter("scale_x", "1", 1.0),
        BaseParameter("scale_y", "1", 1.0),
        BaseParameter("delta_phi", "deg", 0.0),
    )
    axes = 2
    freedom = 1
    planar = True

    def start_rad(self, base: Floats) -> float | Floats:
        """Return the start angle α in rad."""
        return float(base[0])

    def begin(self, reading: Floats, angle_rad: Floats, conditions: Conditions) -> tuple[Floats, Floats]:
        """Return starting values of the base parameters (4,) and of the deviations δ (n,).

        They follow from a fit of A cos θ + B sin θ to the dwells with declared angles θ. Fewer than two
        different declared angles leave the scale factors and Δφ nominal.
        """
        reading = reading / self.gravity_mg
        shown = np.arctan2(reading[:, 1], reading[:, 0])
        declared = np.isfinite(angle_rad)
        theta = angle_rad[declared]
        # Both axes are A cos θ + B sin θ; two different angles determine A and B.
        design = np.column_stack([np.cos(theta), np.sin(theta)])
        base = self.nominal
        if len(theta) > 1 and np.linalg.svd(design, compute_uv=False)[-1] > 1e-3:
            # Amplitude and phase of each axis give the gains, the start angle and the skew.
            (xc, yc), (xs, ys) = np.linalg.lstsq(design, reading[declared], rcond=None)[0]
            alpha = math.atan2(xs, xc)
            base = np.array(
                [alpha, math.hypot(xc, xs), math.hypot(yc, ys), wrap_radians(math.atan2(yc, -ys) - alpha)]
            )
        elif len(theta):
            # One angle gives only the start angle: the mean of shown plus declared angles.
            base[0] = mean_direction(shown[declared] + theta)
        attitude = np.where(declared, 0.0, wrap_radians(shown - base[0]))
        return base, attitude

    def ideal(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the ideal readings K_x G cos ψ and K_y G sin(ψ + Δφ), (n, 2) in mg."""
        alpha, k_x, k_y, skew = base
        psi = alpha + turn_rad + attitude
        ideal = np.empty((len(psi), 2))
        ideal[:, 0] = k_x * np.cos(psi)
        ideal[:, 1] = k_y * np.sin(psi + skew)
        ideal *= self.gravity_mg
        return ideal

    def tangent(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the derivative of the readings by δ, (n, 2, 1) in mg per rad.

        It is −K_x G sin ψ for x and K_y G cos(ψ + Δφ) for y.
        """
        alpha, k_x, k_y, skew = base
        psi = alpha + turn_rad + attitude
        slope = np.empty((len(psi), 2, 1))
        slope[:, 0, 0] = -k_x * np.sin(psi)
        slope[:, 1, 0] = k_y * np.cos(psi + skew)
        slope *= self.gravity_mg
        return slope

    def columns(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the derivative of the readings by α, K_x, K_y and Δφ, (n, 2, 4) in mg per rad or per 1."""
        alpha, _, k_y, skew = base
        psi = alpha + turn_rad + attitude
        columns = np.zeros((len(psi), 2, 4))
        # α and δ both turn the part, so their columns are equal.
        columns[:, :, 0] = self.tangent(base, attitude, turn_rad)[:, :, 0]
        columns[:, 0, 1] = self.gravity_mg * np.cos(psi)
        columns[:, 1, 2] = self.gravity_mg * np.sin(psi + skew)
        columns[:, 1, 3] = self.gravity_mg * k_y * np.cos(psi + skew)
        return columns

    def moved(self, attitude: Floats, step: Floats) -> Floats:
        """Return the deviations δ (n,) in rad from the declared angles after a change by `step` (n, 1)."""
        return np.asarray(attitude + step[:, 0])

    def deviation_rad(self, attitude: Floats) -> Floats:
        """Return the deviations δ from the declared angles, as (n, 1) in rad."""
        return np.asarray(attitude[:, None])

    def calibrated(self, base: Floats, reading: Floats) -> Floats:
        """Return gravity (n, 2) along two perpendicular axes, in units of local gravity, free of Δφ."""
        _, k_x, k_y, skew = base
        x, y = reading[..., 0] / (self.gravity_mg * k_x), reading[..., 1] / (self.gravity_mg * k_y)
        return np.stack([x, (y - x * np.sin(skew)) / np.cos(skew)], axis=-1)

    def angle_rad(self, base: Floats, reading: Floats) -> Floats:
        """Return the angle ψ (n,) in rad that a calibrated goniometer without effects shows."""
        gravity = self.calibrated(base, reading)
        return np.asarray(np.arctan2(gravity[..., 1], gravity[..., 0]))

    def visible(self, reading: Floats, declared: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return for each base parameter (4,) True, except for the start angle if no angle is declared."""
        return np.array([bool(declared.any()), True, True, True])


@dataclass(frozen=True)
class FreeAttitude(Measurement):
    """Poses in space; the attitude of a dwell is the unit vector u (3,) of gravity in the sensor's frame.

    The frame is the one in which D has the axes as rows: X first, Y in the plane of x and y. Directions are
    unknown, so only the length of a calibrated reading informs a fit.

    Attributes
    ----------
    gravity_mg : float
        Local gravity in mg.
    """

    gravity_mg: float

    parameters = (
        BaseParameter("scale_x", "1", 1.0, low=0.5, high=2.0),
        BaseParameter("scale_y", "1", 1.0, low=0.5, high=2.0),
        BaseParameter("scale_z", "1", 1.0, low=0.5, high=2.0),
        BaseParameter("skew_xy", "deg", 0.0, low=-0.2, high=0.2),
        BaseParameter("skew_xz", "deg", 0.0, low=-0.2, high=0.2),
        BaseParameter("skew_yz", "deg", 0.0, low=-0.2, high=0.2),
    )
    axes = 3
    freedom = 2

    def begin(self, reading: Floats, angle_rad: Floats, conditions: Conditions) -> tuple[Floats, Floats]:
        """Return starting values of the base parameters (6,) and of the unit vectors of gravity (n, 3).

        The gains of all axes are equal, and the skews are 0.
        """
        length = np.linalg.norm(reading, axis=1, keepdims=True)
        gain = float(length.mean()) / self.gravity_mg
        return np.array([gain, gain, gain, 0.0, 0.0, 0.0]), reading / length

    def ideal(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the ideal readings G diag(K) D u, (n, 3) in mg, with u the unit vector of gravity."""
        return np.asarray(self.gravity_mg * attitude @ sensitivity(base).T)

    def tangent(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the derivative of the readings by u along two normals of u, (n, 3, 2) in mg per rad."""
        return np.asarray(self.gravity_mg * np.einsum("jk,nkm->njm", sensitivity(base), across(attitude)))

    def columns(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the derivative of the readings, (n, 3, 6) in mg, by three scale factors and three skews.

        It is per 1 for a scale factor, and per rad for a skew.
        """
        columns = np.zeros((len(attitude), 3, 6))
        ideal = self.gravity_mg * attitude @ axes_matrix(base[3:]).T
        for axis in range(3):
            columns[:, axis, axis] = ideal[:, axis]
        # Columns of the skews: G diag(K) ∂D/∂skew u.
        for k, change in enumerate(axes_matrix_derivatives(base[3:])):
            columns[:, :, 3 + k] = self.gravity_mg * base[:3] * (attitude @ change.T)
        return columns

    def moved(self, attitude: Floats, step: Floats) -> Floats:
        """Return the unit vectors of gravity (n, 3) after a small change `step` (n, 2) in rad.

        The two components of the change are along two directions across the vector.
        """
        # Step in the tangent plane, then back to unit length.
        turned = attitude + (across(attitude) @ step[:, :, None])[:, :, 0]
        return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))

    def calibrated(self, base: Floats, reading: Floats) -> Floats:
        """Return gravity (n, 3) in the sensor's frame, in units of local gravity."""
        return np.asarray(reading / self.gravity_mg @ np.linalg.inv(sensitivity(base)).T)

    def visible(self, reading: Floats, declared: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return for each base parameter (6,) True if the poses determine it.

        A parameter counts as determined if its effect on the norms of the readings, as rms over the poses,
        is at least `SEEN`.

        With u the unit vector of gravity, the relative change of the norm is u_i² per unit of a gain, u_i
        u_j per unit of a skew, and u_i per unit of a bias. For a skew only the part counts that gains,
        biases and other skews cannot imitate.
        """
        unit = reading / np.maximum(np.linalg.norm(reading, axis=1, keepdims=True), 1e-300)
        seen = np.zeros(6, dtype=bool)
        seen[:3] = np.sqrt((unit**4).mean(axis=0)) >= SEEN
        others = np.column_stack([unit**2, unit])
        for k, (i, j) in enumerate(SKEW_AXES):
            # Part of the skew that is orthogonal to gains, biases and the skews accepted before.
            skew = unit[:, i] * unit[:, j]
            left = skew - others @ np.linalg.lstsq(others, skew, rcond=1e-9)[0]
            seen[3 + k] = np.sqrt((left**2).mean()) >= SEEN
            if seen[3 + k]:
                others = np.column_stack([others, skew])
        return seen


def sensitivity(base: Floats) -> Floats:
    """Return the sensitivity matrix diag(K) D (3, 3) of `base` (6,): scale factors, then skews in rad."""
    return np.asarray(base[:3, None] * axes_matrix(base[3:]))


def axes_matrix(skews_rad: Floats) -> Floats:
    """Return the matrix D (3, 3) with the directions of the three axes as rows, from their skews in rad.

    The skews are (skew_xy, skew_xz, skew_yz); the text of the module defines them.

    Raises
    ------
    UsageError
        No three axes have such skews.
    """
    # Entries are the cosines between axes, i.e. D Dᵀ; a lower triangular D is its Cholesky factor.
    cosines = np.eye(3)
    for skew, (i, j) in zip(np.sin(skews_rad), SKEW_AXES, strict=True):
        cosines[i, j] = cosines[j, i] = skew
    try:
        return np.asarray(np.linalg.cholesky(cosines))
    except np.linalg.LinAlgError:
        raise UsageError("no three axes have skews of this size; give skews of a few degrees") from None


def axes_matrix_derivatives(skews_rad: Floats) -> Floats:
    """Return the derivatives of the axes' directions D by each skew, (3, 3, 3) per rad.

    The first index is the skew. `axes_matrix` returns D, with the axes as rows.
    """
    axes = axes_matrix(skews_rad)
    change, inverse = np.zeros((3, 3, 3)), np.linalg.inv(axes)
    for k, (i, j) in enumerate(SKEW_AXES):
        change[k, i, j] = change[k, j, i] = np.cos(skews_rad[k])
    # Derivative of a Cholesky factor D of C: D Φ(D⁻¹ ∂C D⁻ᵀ), Φ the lower triangle with half the diagonal.
    inner = inverse @ change @ inverse.T
    return np.asarray(axes @ (np.tril(inner) - inner * np.eye(3) / 2))


def gains_and_skews(gram: Floats) -> tuple[Floats, Floats]:
    """Return scale factors (d,) and skews (pairs,) in rad from `gram`, diag(K) D Dᵀ diag(K) (d, d).

    d is 2 or 3. K are the scale factors, and the rows of D are the axes.
    """
    # The diagonal has the squared gains; the rest has the cosines between the axes.
    gains = np.sqrt(np.diag(gram))
    cosines = gram / np.outer(gains, gains)
    pairs = [(i, j) for i in range(len(gram)) for j in range(i + 1, len(gram))]
    return gains, np.array([math.asin(float(np.clip(cosines[i, j], -1, 1))) for i, j in pairs])


def across(unit: Floats) -> Floats:
    """Return two perpendicular directions normal to each unit vector (n, 3), as columns of (n, 3, 2)."""
    # The coordinate axis with the smallest component is never parallel to the vector.
    axis = np.eye(3)[np.abs(unit).argmin(axis=1)]
    first = _cross(unit, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, _cross(unit, first)], axis=2)


def _cross(a: Floats, b: Floats) -> Floats:
    """Return the cross products of the rows, (n, 3); more than twice as fast as `numpy.cross`."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


@dataclass(frozen=True)
class SessionOrigin:
    """Names by which a session shares parameters and causes with other sessions.

    Attributes
    ----------
    label : str
        Name of the session, unique among the sessions.
    part : str
        Serial number of the part.
    stage : str
        Name of the stage; empty if unknown.
    """

    label: str
    part: str
    stage: str = ""


class JointMeasurement(Measurement):
    """Measurement of dwells of several sessions, which share parameters of the part.

    A parameter without a prior (the start angle) has a value for each session; any other parameter has one
    value for each part, common to all its sessions.

    Attributes
    ----------
    models : tuple of Measurement
        Measurement of each of S sessions, all of one kind.
    origins : tuple of SessionOrigin
        Part and stage of each session.
    session : (n,) int
        Number of the session of each dwell.
    numbers : (S, p) int
        Number of each parameter of a session among all parameters.
    """

    def __init__(
        self, models: Sequence[Measurement], origins: Sequence[SessionOrigin], session: NDArray[np.intp]
    ) -> None:
        self.models, self.session = tuple(models), session
        self.origins = tuple(origins)
        several = len({origin.part for origin in origins}) > 1
        places: dict[str, int] = {}
        found: list[BaseParameter] = []
        index: list[list[int]] = []
        for model, origin in zip(models, origins, strict=True):
            index.append([])
            for one in model.parameters:
                owner = origin.label if math.isinf(one.spread) else origin.part if several else ""
                name = f"{one.name}@{owner}" if owner else one.name
                if name not in places:
                    places[name] = len(places)
                    found.append(replace(one, name=name))
                index[-1].append(places[name])
        self.parameters, self.numbers = tuple(found), np.array(index)
        first = models[0]
        self.axes, self.freedom, self.part = first.axes, first.freedom, first.part
        self.unit, self.full, self.planar = first.unit, first.full, first.planar
        self.driven_by, self.named_forms = first.driven_by, first.named_forms

    @property
    def sessions(self) -> list[tuple[Measurement, NDArray[np.intp]]]:
        """Measurement of each session, and the numbers of its parameters among all base parameters."""
        return list(zip(self.models, self.numbers, strict=True))

    @property
    def size(self) -> float:
        """Typical size of a reading, from the first session."""
        return self.models[0].size

    @cached_property
    def _by_session(self) -> list[tuple[Measurement, NDArray[np.intp], NDArray[np.intp]]]:
        """Model, indices of the dwells and indices (p,) of the parameters, for each session with dwells."""
        each = [(m, np.flatnonzero(self.session == k), self.numbers[k]) for k, m in enumerate(self.models)]
        return [one for one in each if len(one[1])]

    @cached_property
    def _groups(self) -> list[tuple[Measurement, NDArray[np.intp], NDArray[np.intp]]]:
        """Model, indices of dwells and indices of parameters, for groups of dwells computed together.

        In the plane all dwells are one group, with the indices (p, n) of the parameters of each dwell. In
        space a group has all sessions with the same parameters, whose indices are (p,).
        """
        together: dict[tuple[Measurement, tuple[int, ...]], list[int]] = {}
        for k, model in enumerate(self.models):
            kind = model, () if self.planar else tuple(self.numbers[k].tolist())
            together.setdefault(kind, []).append(k)
        found = []
        for (model, _), sessions in together.items():
            rows = np.flatnonzero(np.isin(self.session, sessions))
            own = self.numbers[self.session[rows]].T if self.planar else self.numbers[sessions[0]]
            if len(rows):
                found.append((model, rows, own))
        return found

    def rows(self, index: NDArray[np.bool_] | NDArray[np.intp]) -> JointMeasurement:
        """Return the measurement of the selected dwells, with the parameters of all sessions."""
        return JointMeasurement(self.models, self.origins, self.session[index])

    def start_rad(self, base: Floats) -> float | Floats:
        """Return the start angle α (n,) in rad of each dwell's session."""
        return np.array([float(model.start_rad(base[own])) for model, own in self.sessions])[self.session]

    def stimulus(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the quantity (n, axes) that the scale factors multiply, as a fraction of `full`."""
        return self.models[0].stimulus(ideal, conditions)

    def begin(self, reading: Floats, angle_rad: Floats, conditions: Conditions) -> tuple[Floats, Floats]:
        """Return starting values of the base parameters (p,) and of the attitude of each dwell.

        A parameter common to several sessions has the mean of the starting values of these sessions.
        """
        total, count, attitudes = np.zeros(len(self.parameters)), np.zeros(len(self.parameters)), []
        for model, rows, own in self._by_session:
            base, attitude = model.begin(reading[rows], angle_rad[rows], conditions.rows(rows))
            total[own] += base
            count[own] += 1
            attitudes.append((rows, attitude))
        return np.where(count > 0, total / np.maximum(count, 1), self.nominal), self._joined(attitudes)

    def _joined(self, parts: Sequence[tuple[NDArray[np.intp], Floats]]) -> Floats:
        """Join arrays of some dwells each to one array of all dwells.

        `parts` are pairs: the indices of the dwells, and the array with a row for each of them.
        """
        out = np.zeros((len(self.session), *parts[0][1].shape[1:]))
        for rows, own in parts:
            out[rows] = own
        return out

    def ideal(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the ideal readings (n, axes) in `unit`, each by the parameters of its session."""
        return self._joined([(r, m.ideal(base[k], attitude[r], turn_rad[r])) for m, r, k in self._groups])

    def tangent(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the derivative of `ideal` by the attitude, (n, axes, freedom) in `unit` per rad."""
        return self._joined([(r, m.tangent(base[k], attitude[r], turn_rad[r])) for m, r, k in self._groups])

    def columns(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the derivative of `ideal` by all p base parameters, (n, axes, p), per rad or per 1."""
        out = np.zeros((len(self.session), self.axes, len(self.parameters)))
        for model, rows, own in self._groups:
            columns = model.columns(base[own], attitude[rows], turn_rad[rows])
            out[rows[:, None], :, own.T] = columns.swapaxes(1, 2)
        return out

    def moved(self, attitude: Floats, step: Floats) -> Floats:
        """Return the attitudes of n dwells after a rotation of each by `step` (n, freedom) in rad."""
        return self.models[0].moved(attitude, step)

    def deviation_rad(self, attitude: Floats) -> Floats:
        """Return the deviation of the attitudes of n dwells from the declared ones, (n, freedom) in rad."""
        return self.models[0].deviation_rad(attitude)

    def calibrated(self, base: Floats, reading: Floats) -> Floats:
        """Return gravity (n, axes) in units of local gravity, each by the parameters of its session."""
        return self._joined([(r, m.calibrated(base[k], reading[r])) for m, r, k in self._groups])

    def visible(self, reading: Floats, declared: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return for each base parameter (p,) if the dwells of its session or part can determine it."""
        seen = np.zeros(len(self.parameters), dtype=bool)
        parts = np.array([origin.part for origin in self.origins])[self.session]
        for model, rows, own in self._by_session:
            part = parts == parts[rows[0]]
            whole = model.visible(reading[part], declared[part])
            here = model.visible(reading[rows], declared[rows])
            free = np.isinf([one.spread for one in model.parameters])
            seen[own] |= np.where(free, here, whole)
        return seen


@dataclass(frozen=True)
class MeanRate(Measurement):
    """Mean readings of three gyros over a dwell or a turn; their "attitude" is the true rate (n, 3) in °/s.

    The true rate is known (`Conditions.rate_dps`), so that no attitude is fitted.
    """

    parameters = tuple(BaseParameter(f"gyro_bias_{axis}", "dps", 0.0, spread=math.inf) for axis in "xyz")
    axes = 3
    freedom = 0
    part = "gyro"
    unit = "dps"
    full = 100.0  # °/s, a brisk turn by hand, at which amplitudes of unnamed functions are stated
    constant = True
    driven_by = ("force", "rotation")
    named_forms = MappingProxyType(
        {"time": ("bias",), "temperature": ("bias", "gain"), "supply": ("bias",)}
    )

    def stimulus(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the true rates of turn (n, 3) in units of 100 °/s; 0 for dwells at rest."""
        if conditions.rate_dps is None:
            return np.zeros_like(ideal)
        return conditions.rate_dps / self.full

    def pose(self, reading: Floats, conditions: Conditions) -> Floats | None:
        """Return the unit vectors (n, 3) of the accelerometer readings; None if these were not recorded."""
        if conditions.force_g is None:
            return None
        length = np.linalg.norm(conditions.force_g, axis=1, keepdims=True)
        return np.asarray(conditions.force_g / np.maximum(length, 1e-12))

    def by_pose(self, conditions: Conditions) -> NDArray[np.bool_]:
        """Return for each interval (n,) True if the sensor is at rest, False if it turns."""
        if conditions.rate_dps is None:
            return super().by_pose(conditions)
        return np.asarray(~conditions.rate_dps.any(axis=1))

    def begin(self, reading: Floats, angle_rad: Floats, conditions: Conditions) -> tuple[Floats, Floats]:
        """Return starting values in °/s: mean reading at rest as zero rates (3,), and true rates (n, 3)."""
        rate = np.zeros_like(reading) if conditions.rate_dps is None else conditions.rate_dps
        # Readings at rest show the zero rates; without rest, subtract the true rates.
        still = ~rate.any(axis=1)
        rest = reading[still] if still.any() else reading - rate
        return rest.mean(axis=0), rate

    def ideal(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the ideal readings: true rate plus zero rate, (n, 3) in °/s."""
        return np.asarray(attitude + base)

    def tangent(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return an empty array (n, 3, 0), because the true rates are known and no attitude is fitted."""
        return np.zeros((len(attitude), self.axes, 0))

    def columns(self, base: Floats, attitude: Floats, turn_rad: Floats) -> Floats:
        """Return the derivative of the readings by the zero rates: n identity matrices, (n, 3, 3)."""
        return np.tile(np.eye(self.axes), (len(attitude), 1, 1))

    def moved(self, attitude: Floats, step: Floats) -> Floats:
        """Return the true rates unchanged, because they are known."""
        return attitude

    def calibrated(self, base: Floats, reading: Floats) -> Floats:
        """Return the readings minus the zero rates, (n, 3) in °/s."""
        return np.asarray(reading - base)
