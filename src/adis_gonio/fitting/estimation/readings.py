"""Readings: the mean of each dwell with its covariance, degrees of freedom and conditions.

The covariance of a reading has three parts.

* *Noise that averaging lowers*: spectral density at zero of the dwell's own samples, divided by their
  number (`estimation.spectrum`). If the densities of the dwells are consistent (Bartlett's test at 0.1 %),
  all dwells share one density, which gives short dwells the degrees of freedom of all; otherwise each dwell
  keeps its own.
* *Quantization*: with noise of σ before a converter of step q the mean is off by up to
  (q/π)·exp(−2π²σ²/q²). The variance of this error over all places between two codes is
  q²/(2π²)·Σ exp(−4π²k²σ²/q²)/k², which is q²/12 without noise and negligible at σ > q/2, because then the
  noise dithers and quantization is part of it.
* *Bias instability* (1/f noise), which averaging does not lower. If the lowest frequencies of the dwells
  show it, its size is taken from them. Otherwise it is the variant's figure (an estimate: confidence D),
  limited to the amount that the dwells allow, or zero for a sensor without a figure. With an Allan
  deviation s the means of N dwells scatter with s²·N ln N / (2 (N − 1) ln 2) (Barnes 1969).

Neighbouring dwells share 1/f noise. The shared part is kept as modes (`Readings.slow`); one mode is the
constant by which this session differs from a session on another day.

A dwell of one sample is a reading that was averaged before. `Session.reading_u_mg` is its whole
uncertainty. If the session does not state it, the noise of every dwell counts as unknown
(`Readings.noise_known` is False): a fit estimates one noise for all from its residual, in addition to the
shared 1/f noise of the variant's figure, which the residual shows less than the parameters do.

Readings in `counts` have neither a known zero nor a known gain. An ellipse or ellipsoid through them gives
rough values of both (`Unit`), so that all later steps use readings that are nearly in mg.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, block_means
from adis_gonio.base.budget import current
from adis_gonio.base.errors import DataError, FitError, UsageError
from adis_gonio.base.jsonable import ComputedOnce
from adis_gonio.base.numbers import counted, format_number, name_positions
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.fitting.estimation import screening, spectrum
from adis_gonio.fitting.estimation.links import Links
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import FreeAttitude, Measurement, PlanarTurn, gains_and_skews
from adis_gonio.model.records import ACCEL_UNITS, MG_PER_MPS2, Dwell, Session
from adis_gonio.record.provenance import provenance_of

MOST_SHARED = 2000
"""Largest number of dwells for which the 1/f noise that dwells share is modelled. For more dwells its
covariance matrix is too large, and shared noise is small in the mean of so many readings."""
HISTORY_POINTS = 2000
LEAST_TURNING, LEAST_AREA = 4, 0.5
"""Least number of positions, and least area of the ellipse of readings (1 for a good sensor), at which the
sense of rotation is certain."""
TURNING_U, TURNING_BIAS = 0.03, 0.1
"""Standard deviations in g of a reading about its first harmonic, and of a bias, in the test of the sense
of rotation."""
LARGEST_RADIANS = 4 * math.pi
"""Largest declared angle, as a number, that may be in radians: two turns."""
LIKELIER = 50.0
"""Difference of χ² by which angles in radians have to describe the readings better than degrees."""
OFF_UNIT = 2.0
"""Factor by which the length of readings at rest may differ from 1 g. Beyond it the unit is wrong, because
no gain of a sensor is so far from 1."""
UNEQUAL = 0.5
"""Difference of a reading's length from the median length, as a share of it, that no bias explains."""


@dataclass(frozen=True)
class Unit:
    """Conversion from the unit of the file to mg, for each axis.

    Attributes
    ----------
    name : str
        `mg` or `dps` for any unit of known size, or `counts`.
    zero, per_mg : (axes,) float
        Value in the file at zero acceleration, and counts per mg. For counts both are rough estimates from
        the readings; for a known unit they are 0 and 1.
    scale : float
        Factor by which the values of the file are multiplied first: mg per unit, or 1 if the unit is
        unknown.
    """

    name: str
    zero: Floats
    per_mg: Floats
    scale: float = 1.0

    def mg(self, values: Floats) -> Floats:
        """Convert values (n, columns) from the unit of the file to mg (n, axes).

        Columns beyond the axes of the unit are dropped.
        """
        return np.asarray((values[:, : len(self.zero)] * self.scale - self.zero) / self.per_mg)

    @property
    def known(self) -> bool:
        """True if zero and scale of the unit are known; False for counts."""
        return self.name != "counts"


def in_mg(axes: int, scale: float = 1.0) -> Unit:
    """Return the unit of readings with a known scale, for a number of axes.

    `scale` is in mg per unit of the file; the zero is 0.
    """
    return Unit("mg", np.zeros(axes), np.ones(axes), scale)


@dataclass(frozen=True)
class Readings(ComputedOnce):
    """Mean readings of a session and their noise, one row for each dwell.

    Attributes
    ----------
    mean : (n, axes) float
        Mean of each dwell in mg; two columns in a planar session, three in space.
    own_covariance : (n, axes, axes) float
        Covariance of the means in mg² without the noise that dwells share. If `noise_known` is False, it
        is a placeholder: 1 mg² on each axis.
    dof : (n,) float
        Degrees of freedom of that covariance; inf if it was stated.
    noise_known : bool
        False if the noise of the readings is neither measured nor stated.
    angle_rad : (n,) float
        Declared angle θ of each dwell; NaN if unknown.
    conditions : Conditions
        Conditions of each reading, such as time and temperature.
    gravity_mg : float
        Local gravity.
    fixture_rad : float
        Standard uncertainty of a declared angle; inf if attitudes are free, 0 if it is not stated.
    fixture_stated : bool
        True if the session states the uncertainty of a declared angle.
    check : (n,) bool
        True for dwells that take no part in the choice of a model or in its fit.
    position, samples : (n,) int
        Numbers of the dwells in the file, and their numbers of samples.
    unit : Unit
        Unit of the file.
    slow : (n, axes, k) float
        Contribution of each of k independent modes of unit variance to the readings: the noise that dwells
        share (1/f noise, whose modes of different axes are independent).
    stage : (n, axes, q) float
        Contribution of each of q independent errors of the stage by its certificate, of unit variance.
    quantization, flicker : (n, axes) float or None
        Parts of `own_covariance` from quantization and 1/f noise; None without them.
    flicker_shown : bool
        True if the dwells show the 1/f noise, False if it is the figure of the variant.
    pooled : bool
        True if one estimate of noise serves all dwells, so that `dof` counts once and not for each dwell.
    sensor : str
        Name of the variant, for data-sheet figures that a session cannot show.
    offset_mg : (3,) float
        Amounts that the offset registers of the chip add to the readings of X, Y and Z; 0 if unknown.
    notes : tuple of str
        Remarks on the noise, for the result.
    fitted : (p,) bool or None
        True for base parameters that are fitted. None: the parameters that these dwells determine are
        fitted. Parts of a session use the mask of the whole session.
    measurement : Measurement or None
        The measured quantity. None: gravity in the plane of a turn for two axes, in space for three.
    converter : Converter or None
        Steps and limits of the analogue-to-digital converter in all samples, including dwells at a limit;
        None without samples.
    links : Links or None
        Rotations of the sensor between poses, measured by its gyros; None if none are used.
    """

    mean: Floats
    own_covariance: Floats
    dof: Floats
    noise_known: bool
    angle_rad: Floats
    conditions: Conditions
    gravity_mg: float
    fixture_rad: float
    fixture_stated: bool
    check: NDArray[np.bool_]
    position: NDArray[np.intp]
    samples: NDArray[np.intp]
    unit: Unit
    slow: Floats
    stage: Floats
    quantization: Floats | None = None
    flicker: Floats | None = None
    flicker_shown: bool = False
    pooled: bool = True
    sensor: str = "generic"
    offset_mg: tuple[float, ...] = (0.0, 0.0, 0.0)
    notes: tuple[str, ...] = ()
    fitted: NDArray[np.bool_] | None = None
    measurement: Measurement | None = None
    converter: screening.Converter | None = None
    links: Links | None = None

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def axes(self) -> int:
        """Number of axes of a reading: 2 in the plane, 3 in space."""
        return int(self.mean.shape[1])

    @property
    def unseen_bias_mg(self) -> Floats:
        """Standard uncertainty (axes,) in mg of a bias that no reading shows; 0 if nothing states it.

        It is the figure of the part. Numbers in the offset registers may compensate a bias, or add to it:
        their size is a part of u.
        """
        figure = VARIANTS[self.sensor].performance.initial_bias_mg if self.sensor in VARIANTS else 0.0
        return np.hypot(figure, self.offset_mg[: self.axes])

    @property
    def planar(self) -> bool:
        """True if the sensor turns in a known plane, False for any attitude in space."""
        return self.model.planar

    @cached_property
    def model(self) -> Measurement:
        """Base model that relates the readings to attitude and parameters."""
        if self.measurement is not None:
            return self.measurement
        return PlanarTurn(self.gravity_mg) if self.axes == 2 else FreeAttitude(self.gravity_mg)

    @property
    def variance_of_mean(self) -> Floats:
        """Variance (n,) of each mean reading, averaged over its axes, in the squared unit of readings."""
        return np.asarray(np.trace(self.covariance, axis1=1, axis2=2) / self.axes)

    @property
    def noise_dof(self) -> float:
        """Degrees of freedom of the noise of all readings together; inf if all noise was stated.

        If the dwells of a session share one estimate of noise (`pooled`), its degrees of freedom count once
        for each session. Otherwise the degrees of freedom of all dwells are added.
        """
        known, session = np.isfinite(self.dof), self.conditions.session
        dof = self.dof[known]
        if not dof.size:
            return math.inf
        if not self.pooled:
            return float(dof.sum())
        whole = np.zeros(len(dof)) if session is None else session[known]
        return float(sum(dof[whole == k].max() for k in np.unique(whole)))

    @cached_property
    def fixture(self) -> Floats:
        """Standard uncertainty (n,) of each declared angle in rad; inf for a dwell without one."""
        declared = np.isfinite(self.angle_rad) if self.planar else np.zeros(len(self), dtype=bool)
        return np.where(declared, self.fixture_rad, np.inf)

    @cached_property
    def fixture_precision(self) -> Floats:
        """1/variance (n,) of each declared angle in rad⁻²; 0 if the angle is exact or undeclared."""
        certain = self.fixture == 0
        return np.where(certain, 0.0, 1 / np.where(certain, 1.0, self.fixture) ** 2)

    @cached_property
    def turn_rad(self) -> Floats:
        """Declared angle (n,) of the stage in rad with the sign reversed; 0 if no angle is declared."""
        return np.where(np.isfinite(self.angle_rad), -self.angle_rad, 0.0)

    @property
    def free(self) -> bool:
        """True if the attitudes are unknown and no declared angle restricts them."""
        return self.model.freedom > 0 and bool(np.isinf(self.fixture).all())

    @property
    def equations_each(self) -> int:
        """Number of equations from each reading: one if the attitude is free, otherwise one per axis."""
        return 1 if self.free else self.axes

    @property
    def by_axis(self) -> bool:
        """True if each axis of a reading carries information, False if only its length does."""
        return self.model.freedom < 2

    @cached_property
    def visible(self) -> NDArray[np.bool_]:
        """Mask (p,) of the base parameters that are fitted; the others keep their nominal values.

        These are the parameters that were stated as fitted or, if none were, the parameters that the dwells
        determine.
        """
        if self.fitted is not None:
            return self.fitted
        return self.model.visible(self.mean, np.isfinite(self.fixture))

    @cached_property
    def shared(self) -> Floats:
        """Contributions (n, axes, k + q) of all modes that dwells share: `slow`, then `stage`."""
        return np.concatenate([self.slow, self.stage], axis=2)

    @cached_property
    def covariance(self) -> Floats:
        """Covariance (n, axes, axes) of the mean readings in mg², including errors that dwells share."""
        shared: Floats = (self.shared**2).sum(axis=2)[:, :, None] * np.eye(self.axes)
        return self.own_covariance + shared

    @cached_property
    def root(self) -> Floats:
        """Whitening matrix (n, axes, axes) in 1/mg: inverse Cholesky factor of the readings' covariance."""
        return _inverse_root(self.covariance)

    @cached_property
    def own_root(self) -> Floats:
        """Whitening matrix (n, axes, axes) in 1/mg: the inverse Cholesky factor of `own_covariance`."""
        return _inverse_root(self.own_covariance)

    def rows(self, index: NDArray[np.bool_] | NDArray[np.intp]) -> Readings:
        """Return a copy with the selected dwells."""
        every = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "fitted"}
        own: dict[str, Any] = {name: rows for name, rows in every.items() if isinstance(rows, np.ndarray)}
        return replace(
            self,
            conditions=self.conditions.rows(index),
            links=None if self.links is None else self.links.rows(np.arange(len(self))[index]),
            measurement=None if self.measurement is None else self.measurement.rows(index),
            **{name: rows[index] for name, rows in own.items()},
        )

    @cached_property
    def training(self) -> Readings:
        """Readings of the dwells that may be fitted (no `check` dwells), for all fits of the session.

        Raises
        ------
        FitError
            Every dwell is for checking.
        """
        if self.check.all():
            raise FitError("every dwell is for checking: there is none to fit")
        rows = self.rows(~self.check)
        return replace(rows, fitted=rows.visible)

    @property
    def checking(self) -> Readings | None:
        """The `check` dwells of the session, which are not fitted; None if there are none."""
        return self.rows(self.check) if self.check.any() else None


def _inverse_root(covariance: Floats) -> Floats:
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def from_means(
    mean: Floats,
    covariance: Floats,
    conditions: Conditions,
    *,
    gravity_mg: float = 1000.0,
    fixture_rad: float = 0.0,
    **others: object,
) -> Readings:
    """Make readings from mean values (n, axes) in mg and their covariance (n, axes, axes) in mg².

    `gravity_mg` is local gravity, `fixture_rad` the standard uncertainty of a declared angle; `others` are
    further attributes of `Readings`.
    """
    n, axes = mean.shape
    angle = conditions.angle_rad
    made = Readings(
        mean=mean,
        own_covariance=covariance,
        dof=np.full(n, np.inf),
        noise_known=True,
        angle_rad=np.full(n, np.nan) if angle is None else angle,
        conditions=conditions,
        gravity_mg=gravity_mg,
        fixture_rad=fixture_rad,
        fixture_stated=True,
        check=np.zeros(n, dtype=bool),
        position=np.arange(n, dtype=np.intp),
        samples=np.ones(n, dtype=np.intp),
        unit=in_mg(axes),
        slow=np.zeros((n, axes, 0)),
        stage=np.zeros((n, axes, 0)),
    )
    return replace(made, **others)  # type: ignore[arg-type]


def _refuse_other_units(session: Session, readings: Readings) -> None:
    """Raise `DataError` if the readings at rest are far from 1 g, by a factor of `OFF_UNIT` or more.

    Their unit is then wrong, or they do not measure gravity. A single dwell whose length differs much from
    the others is refused, too.

    Parameters
    ----------
    readings : Readings
        Readings of this session.
    """
    if not readings.unit.known:
        return
    lengths = np.linalg.norm(readings.mean, axis=1) / session.gravity_mg
    length = float(np.median(lengths))
    odd = np.abs(lengths / length - 1) > UNEQUAL
    source, right_unit = session.source or "session", 1 / OFF_UNIT < length < OFF_UNIT
    if right_unit and (session.accel_unit == "counts" or not odd.any()):
        return
    whole = np.array([np.linalg.norm(dwell.accel.mean(axis=0)) for dwell in session.dwells if len(dwell)])
    whole *= (mg_per_unit(session) or math.nan) / session.gravity_mg
    flat = float(np.median(whole))
    odd_positions = name_positions(readings.position[odd].tolist())
    left = 1 / OFF_UNIT < flat < OFF_UNIT and (length < 1 / OFF_UNIT or np.ptp(whole) < UNEQUAL)
    if session.plane == "xy" and left:
        where = f" at {odd_positions}" if right_unit else ""
        raise DataError(
            f"{source}: the part lies flat, X and Y read {lengths.min():.2g} g, not {flat:.3g} g{where}:"
            " a plane that is turned has to be vertical; write '# plane: none' for poses in space"
        )
    if right_unit:
        raise DataError(
            f"{source}: readings of {odd_positions} are not 1 g long as the others: an axis is dead or"
            " saturated, or the part was not at rest; leave such dwells out"
        )
    also = "; a plane that is turned has to be vertical" if session.plane == "xy" and length < 1 else ""
    raise DataError(
        f"{source}: by accel_unit {session.accel_unit} and sensor {session.sensor}, readings are "
        f"{format_number(length)} g long, not 1 g; state the unit of the file, or counts if it is unknown"
        f"{_as_another(session, length)}{also}"
    )


def _as_another(session: Session, length: float) -> str:
    """Return advice for a message: the units in which the readings at rest are 1 g long.

    `length` is their length in g by the stated unit. The text is empty if no unit fits.
    """
    own = mg_per_unit(session)
    fits = [
        unit
        for unit in ACCEL_UNITS
        if unit != "counts"
        and (unit != "lsb" or session.sensor in VARIANTS)
        and 1 / OFF_UNIT < length * mg_per_unit(replace(session, accel_unit=unit)) / own < OFF_UNIT
    ]
    if not fits:
        return ""
    return (
        f"; {' or '.join(fits)} would fit: add a line '# accel_unit: {fits[0]}', or give --unit {fits[0]}"
    )


def _refuse_other_turns(session: Session, readings: Readings) -> None:
    """Raise `DataError` if the declared angles are in radians, or of the opposite sense of rotation.

    X follows cos(α − θ) and Y sin(α − θ): with x_c, x_s, y_c, y_s their first harmonics, the sense of
    rotation is the sign of x_s y_c − x_c y_s, which neither gains nor a misalignment below 90° change.
    """
    rows = np.isfinite(readings.angle_rad)
    if session.plane != "xy" or readings.free or not readings.unit.known or readings.axes != 2:
        return
    theta = readings.angle_rad[rows]
    if len(theta) < LEAST_TURNING:
        return
    # First harmonics of both axes by least squares, with wide priors and a prior of the bias.
    prior = TURNING_U / np.array([2.0, 2.0, TURNING_BIAS])
    target = np.concatenate([readings.mean[rows] / session.gravity_mg, np.zeros((3, 2))])

    def harmonics(theta: Floats) -> tuple[Floats, Floats, float]:
        columns = np.column_stack([np.cos(theta), np.sin(theta), np.ones(len(theta))])
        design = np.concatenate([columns, np.diag(prior)])
        found = np.linalg.lstsq(design, target, rcond=None)[0]
        return design, found, float(((design @ found - target) ** 2).sum()) / TURNING_U**2

    design, found, chi2 = harmonics(theta)
    numbers = np.degrees(theta)
    if np.abs(numbers).max() <= LARGEST_RADIANS and harmonics(numbers)[-1] < chi2 - LIKELIER:
        raise DataError(
            f"{session.source or 'session'}: the readings turn as if the declared angles, up to "
            f"{np.abs(numbers).max():.4g}, were radians: angle_deg is in degrees, multiply it by 57.29578"
        )
    x, y = found[:2].T
    area = x[1] * y[0] - x[0] * y[1]
    # Variance of the area, from the covariance of the cosine and sine of each axis.
    covariance = TURNING_U**2 * np.linalg.inv(design.T @ design)[:2, :2]
    by_x, by_y = np.array([-y[1], y[0]]), np.array([x[1], -x[0]])
    u = math.sqrt(by_x @ covariance @ by_x + by_y @ covariance @ by_y)
    if area > -max(LEAST_AREA, 3 * u):
        return
    if "reverse" in session.facts.get("overrides", {}):
        raise DataError(
            f"{session.source or 'session'}: reversed, the readings turn the other way than the angles, as "
            "declared they agree: leave --reverse out"
        )
    raise DataError(
        f"{session.source or 'session'}: the readings turn the other way than the declared angles: change "
        "the sign of angle_deg (--reverse), or of an axis, so that Y reads at 90° minus what X reads at 0°"
    )


def readings_of(session: Session) -> Readings:
    """Reduce all dwells of a session to readings, including `check` dwells; computed once for each session.

    Raises
    ------
    DataError
        All-zero or stuck data, no usable dwell, readings that are not finite or far from 1 g, or declared
        angles of the opposite sense of rotation.
    """
    return session.once(_checked_readings)


def _checked_readings(session: Session) -> Readings:
    current().tell("noise of the readings")
    if session.stage_curve is not None and session.plane != "xy":
        raise DataError(
            f"{session.source or 'session'}: the certificate of a stage corrects angles in a plane, but the"
            " session states plane none: leave out one of the two"
        )
    try:
        readings = reduced(session)
    except FitError as error:
        raise FitError(f"{session.source}: {error}" if session.source else str(error)) from error
    _refuse_other_units(session, readings)
    _refuse_other_turns(session, readings)
    return readings


def reduced(session: Session) -> Readings:
    """Reduce all dwells to readings; the length of a reading and the sense of rotation are not checked."""
    axes = 2 if session.plane == "xy" else 3
    dwells, converter, notes = _usable(session, axes)
    scale = mg_per_unit(session)
    n = len(dwells)
    mean = np.array([d.accel[0, :axes] if len(d) == 1 else d.accel[:, :axes].mean(axis=0) for d in dwells])
    mean *= scale
    if not np.isfinite(mean).all():
        bad = dwells[int(np.flatnonzero(~np.isfinite(mean).all(axis=1))[0])]
        raise DataError(f"{session.source or 'session'}: position {bad.position} holds NaN or infinity")
    samples = np.array([len(d) for d in dwells], dtype=np.intp)
    unit = (
        in_mg(axes, scale) if session.accel_unit != "counts" else _unit_of_counts(mean, session.gravity_mg)
    )
    mean, mg = (mean - unit.zero) / unit.per_mg, scale / unit.per_mg

    covariance = np.broadcast_to(np.eye(axes), (n, axes, axes)).copy()
    dof = np.full(n, np.inf)
    slow = np.zeros((n, axes, 0))
    parts: dict[str, Any] = {}
    single = np.flatnonzero((samples == 1) | _without_noise(session, dwells, axes))
    many = np.setdiff1d(np.arange(n), single)
    known = not single.size or session.reading_u_mg is not None
    if session.reading_u_mg is not None:
        covariance[single] *= session.reading_u_mg**2
    elif single.size and many.size:
        notes.append(
            f"{counted(single.size, 'dwell')} of one sample without a stated noise: one noise is estimated "
            "for all dwells; state reading_u_mg, or keep the samples of each dwell"
        )
    if many.size and known:
        rows = [dwells[k].accel[:, :axes] for k in many.tolist()]
        noise = spectrum.noise_of_means(rows, mg)
        # Dwells at a limit show other steps than the converter's, so they are left out here.
        steps = screening.steps_of(rows) if converter.spoiled else converter.steps
        quantum = mg * np.maximum(steps, float(session.accel_unit == "lsb"))
        begin_s, end_s = spectrum.spans([dwells[k].time_s for k in many.tolist()])
        own, shared_noise = flicker_parts(begin_s, end_s, flicker_of(noise, stated_flicker(session)))
        slow = np.zeros((n, *shared_noise.shape[1:]))
        slow[many] = shared_noise
        rounding, level = np.zeros((n, axes)), np.zeros((n, axes))
        rounding[many], level[many] = quantization_variance(rows, mg, quantum), own
        covariance[many] = noise.covariance + (rounding + level)[many, :, None] * np.eye(axes)
        parts = {
            "quantization": rounding,
            "flicker": level,
            "flicker_shown": bool((noise.flicker > 0).any()),
            "pooled": noise.pooled,
        }
        dof[many] = noise.dof
        if noise.too_short:
            notes.append(
                "within the dwells the noise still rises towards the lowest frequencies (a long filter, "
                "drift or 1/f noise): the uncertainty of a reading is itself uncertain, dwell longer"
            )
    elif not known:
        # 1/f noise has no scale of time: means that follow one another share it, however long they are.
        order = np.arange(float(n))
        _, slow = flicker_parts(order, order + 1, np.full(axes, stated_flicker(session)))
    angle, of_stage = _stage(session, dwells, mean)
    return Readings(
        mean=mean,
        own_covariance=covariance,
        dof=dof,
        noise_known=known,
        angle_rad=angle,
        conditions=_conditions(dwells, angle, mean, unit, scale, axes),
        gravity_mg=session.gravity_mg,
        fixture_rad=math.radians(session.fixture_sigma_deg or 0.0),
        fixture_stated=session.fixture_sigma_deg is not None,
        check=np.array([dwell.use == "check" for dwell in dwells]),
        position=np.array([d.position for d in dwells], dtype=np.intp),
        samples=samples,
        unit=unit,
        slow=slow,
        stage=of_stage,
        sensor=session.sensor,
        offset_mg=_offsets_mg(session),
        notes=tuple(notes),
        converter=converter,
        **parts,
    )


def _stage(session: Session, dwells: list[Dwell], mean: Floats) -> tuple[Floats, Floats]:
    """Return the declared angles (n,) in rad, corrected by the stage's certificate, and its errors.

    The errors (n, axes, q) in mg change the means (n, axes) by one standard deviation each, and dwells
    share them. Without a certificate q is 0.
    """
    angle = np.radians([np.nan if d.angle_deg is None else d.angle_deg for d in dwells])
    if session.stage_curve is None:
        return angle, np.zeros((*mean.shape, 0))
    error_deg, changes_deg = session.stage_curve.at(np.degrees(np.nan_to_num(angle)))
    angle = angle - np.radians(error_deg)
    # A reading (x, y) moves by (y, −x) per rad of the stage.
    tangent = np.stack([mean[:, 1], -mean[:, 0]], axis=1) * np.isfinite(angle)[:, None]
    return angle, tangent[:, :, None] * np.radians(changes_deg)[:, None, :]


def _offsets_mg(session: Session) -> tuple[float, ...]:
    """Return the amounts (3,) in mg that the offset registers add to the readings; 0 if unknown."""
    lsb_mg = VARIANTS[session.sensor].accel_mg_per_lsb if session.sensor in VARIANTS else 0.0
    return tuple(lsb_mg * number for number in provenance_of(session).offsets_lsb or (0, 0, 0))


def _without_noise(session: Session, dwells: list[Dwell], axes: int) -> bool:
    """Return True if an axis has constant samples within every dwell: the file seems to repeat averages.

    `axes` is the number of examined axes.
    """
    if session.accel_unit == "lsb":  # a converter's step may hide the noise
        return False
    ranges = [np.ptp(dwell.accel[:, :axes], axis=0) > 0 for dwell in dwells]
    return not bool(np.any(ranges, axis=0).all())


def _usable(session: Session, axes: int) -> tuple[list[Dwell], screening.Converter, list[str]]:
    """Return the usable dwells, the converter's steps and limits, and notes for the user.

    The notes are on dwells at a limit of the range; `axes` is the number of axes in use.
    """
    source = session.source or "session"
    dwells = [dwell for dwell in session.dwells if len(dwell)]
    if session.free_turn and not dwells:
        raise DataError(
            f"{source}: a free turn has no positions; use fit with this file alone, or measure positions"
            " (calibrate --plan tumble)"
        )
    if not dwells:
        raise DataError(f"{source}: no dwell to fit; every dwell is empty")
    if dwells[0].accel.shape[1] < axes:
        raise DataError(f"{source}: plane none needs three axes, there are two")
    converter = screening.converter_of([replace(dwell, accel=dwell.accel[:, :axes]) for dwell in dwells])
    limits = converter.limits
    screening.refuse_dead_data(
        session, limits, None if session.accel_unit == "counts" else mg_per_unit(session)
    )
    if len(dwells) > 1:  # a single pose is kept even at a limit
        dwells = [dwell for dwell in dwells if dwell.position not in converter.spoiled]
    if not dwells:
        raise DataError(f"{source}: every dwell is at a limit of the range; record with a wider range")
    return dwells, converter, screening.limit_notes(limits, session.accel_unit)


def flicker_parts(begin_s: Floats, end_s: Floats, flicker: Floats) -> tuple[Floats, Floats]:
    """Split the 1/f noise of dwell means into a part of each mean alone and a part that means share.

    The noise is the deviation from the mean over a time twice as long as the session
    (`covariance_of_means`).

    Parameters
    ----------
    begin_s, end_s : (m,) float
        Begin and end of each dwell.
    flicker : (axes,) float
        Allan variance of the 1/f noise in mg².

    Returns
    -------
    (m, axes) float in mg²
        Variance of each mean alone.
    (m, axes, k) float in mg
        Change of the means by each of k independent errors, which the means share, at one standard
        deviation.
    """
    m, axes = len(begin_s), len(flicker)
    if not (2 <= m <= MOST_SHARED and flicker.any()):
        return np.tile(flicker * spectrum.scatter_of_means(m), (m, 1)), np.zeros((m, axes, 0))
    factor, left = spectrum.modes(spectrum.covariance_of_means(begin_s, end_s))
    k = factor.shape[1]
    slow = np.zeros((m, axes, axes * k))
    for axis in range(axes):
        # Modes of different axes are independent: a block of columns for each axis.
        slow[:, axis, axis * k : (axis + 1) * k] = np.sqrt(flicker[axis]) * factor
    return left[:, None] * flicker, slow[:, :, (slow != 0).any(axis=(0, 1))]


def _unit_of_counts(mean: Floats, gravity_mg: float) -> Unit:
    """Return the zero and the counts per mg of each axis, from readings in several positions.

    `mean` (n, axes) are the readings in counts. All have the length of gravity `gravity_mg`, so they are on
    an ellipse or ellipsoid.
    """
    if float(np.ptp(mean, axis=0).max()) <= 0:
        raise FitError(
            "readings in counts are all alike; their scale cannot be found: measure more positions"
        )
    centre, matrix = conic_through(mean)
    gains, _ = gains_and_skews(np.asarray(np.linalg.inv(matrix), dtype=np.float64))
    return Unit("counts", centre, gains / gravity_mg)


def _conditions(
    dwells: list[Dwell], angle: Floats, mean: Floats, unit: Unit, scale: float, axes: int
) -> Conditions:
    """Return the conditions of n dwells, such as time, temperature, supply, and histories between dwells.

    `angle` (n,) are the declared angles in rad, `mean` the mean readings; `scale` converts samples to mg.
    """
    start = float(dwells[0].time_s[0])
    declared = angle if np.isfinite(angle).all() else None
    approach = np.array([float(dwell.approach) for dwell in dwells])
    temperature = _means([dwell.temperature_c for dwell in dwells])
    many = all(len(dwell) > 1 for dwell in dwells)
    variance = None
    if many and unit.known:
        variance = np.array([dwell.accel[:, :axes].var(axis=0) for dwell in dwells]) * scale**2
    return Conditions(
        time_s=np.array([float(dwell.time_s.mean()) for dwell in dwells]) - start,
        angle_rad=declared,
        order=np.arange(len(dwells), dtype=float),
        approach=approach if approach.any() else None,
        previous_angle_rad=None if declared is None else np.concatenate([declared[:1], declared[:-1]]),
        temperature_c=temperature,
        supply_v=_means([dwell.supply_v for dwell in dwells]),
        temperature_history=None if temperature is None else _history(dwells, start),
        load_history=_loads(dwells, mean, start),
        variance_mg2=variance,
    )


def _means(series: list[Floats | None]) -> Floats | None:
    means = [float(np.mean(s)) for s in series if s is not None]
    if len(means) != len(series) or not np.isfinite(means).all():
        return None
    return np.array(means)


def _history(dwells: list[Dwell], start: float) -> tuple[Floats, Floats] | None:
    """Return times in s and temperatures in °C of the session, averaged to at most `HISTORY_POINTS` points.

    `start` is the time in s of the first sample. None if the times do not increase.
    """
    time = np.concatenate([dwell.time_s for dwell in dwells]) - start
    temperature = np.concatenate([d.temperature_c for d in dwells if d.temperature_c is not None])
    if (np.diff(time) <= 0).any():
        return None
    if len(time) > HISTORY_POINTS:
        # Means of blocks of neighbouring samples.
        cuts = np.linspace(0, len(time), HISTORY_POINTS, endpoint=False).astype(np.intp)
        time, temperature = block_means(time, cuts), block_means(temperature, cuts)
    return time, temperature


def _loads(dwells: list[Dwell], mean: Floats, start: float) -> tuple[Floats, Floats] | None:
    """Return times and readings in mg at the beginning and end of each dwell: the load over time.

    `mean` (n, axes) are the mean readings. The load is taken as linear during moves; `start` is the time in
    s of the first sample. None if the times do not increase.
    """
    ends = np.array([dwell.time_s[[0, -1]] for dwell in dwells]) - start
    # A dwell of one sample has one time, others have a begin and an end.
    kept = np.column_stack([np.ones(len(dwells), dtype=bool), ends[:, 1] > ends[:, 0]])
    times, loads = ends[kept], np.repeat(mean, kept.sum(axis=1), axis=0)
    return (times, loads) if (np.diff(times) > 0).all() else None


def mg_per_unit(session: Session) -> float:
    """Return the factor from the unit of the accelerometers to mg; 1 for counts of unknown size."""
    if session.accel_unit == "lsb":
        if session.sensor not in VARIANTS:
            raise DataError(
                f"{session.source or 'session'}: the LSB of sensor '{session.sensor}' is not known"
            )
        return VARIANTS[session.sensor].accel_mg_per_lsb
    return {"mg": 1.0, "g": 1000.0, "mps2": MG_PER_MPS2, "counts": 1.0}[session.accel_unit]


def quantization_variance(rows: Sequence[Floats], mg: Floats, quantum: Floats) -> Floats:
    """Return the variance (dwells, axes) in mg² of each dwell's mean by rounding to the converter's steps.

    `rows` are the samples of each dwell, `mg` the factor (axes,) from samples to mg, `quantum` the step
    (axes,) in mg.
    """
    return quantized_means(np.array([r.var(axis=0) for r in rows]) * mg**2, quantum)


def quantized_means(variance_mg2: Floats, quantum_mg: Floats) -> Floats:
    """Return the variance (dwells, axes) in mg² of each dwell's mean by rounding to the converter's steps.

    `quantum_mg` (axes,) are the steps; `variance_mg2` (dwells, axes) is the variance of the rounded
    samples. Both may be of one axis, (dwells,) and a number.
    """
    step = np.where(quantum_mg > 0, quantum_mg, 1.0)
    # Noise before the converter, in steps: subtract the variance of rounding.
    sigma2 = np.maximum(variance_mg2 - quantum_mg**2 / 12, 0.0) / step**2
    if float(sigma2.min(initial=np.inf)) > 1.0:
        return np.zeros_like(variance_mg2)
    k = np.arange(1, 200)
    series = np.exp(-4 * math.pi**2 * k**2 * np.minimum(sigma2, 1.0)[..., None]) / k**2
    return np.asarray(quantum_mg**2 / (2 * math.pi**2) * series.sum(axis=-1))


def stated_flicker(session: Session) -> float:
    """Return the Allan variance in mg² of the sensor's 1/f noise, stated or by its data sheet; else 0."""
    known = session.bias_instability_mg
    if known is None and session.sensor in VARIANTS:
        known = VARIANTS[session.sensor].performance.bias_instability_mg
    return 0.0 if known is None or session.accel_unit == "counts" else known**2


def flicker_of(noise: spectrum.MeanNoise, stated: float) -> Floats:
    """Return the Allan variance (axes,) of the 1/f noise, in the squared unit of the readings.

    It is the measured one on an axis that shows 1/f noise in its dwells. Otherwise it is the data-sheet
    figure `stated`, but at most the upper limit that the dwells allow.
    """
    return np.where(noise.flicker > 0, noise.flicker, np.minimum(stated, noise.flicker_limit))


def conic_through(points: Floats) -> tuple[Floats, Floats]:
    """Return centre (d,) and matrix (d, d) of the ellipse or ellipsoid through points (n, d).

    Points p on it have (p − c)ᵀ Q (p − c) = 1 with the centre c and the matrix Q. They are found by
    algebraic least squares on centred and scaled points: with all quadratic terms if there are enough
    points and they give an ellipsoid, otherwise with fewer (no mixed terms, then a sphere).

    Raises
    ------
    FitError
        If the points (n, d) lie on no ellipsoid: too few points, or all in one place.
    """
    n, d = points.shape
    middle = points.mean(axis=0)
    size = float(np.abs(points - middle).max())
    if size <= 0 or n < d + 1:
        raise FitError(
            f"{counted(n, 'position')} cannot show an unknown scale and zero; measure at least {2 * d + 3}"
        )
    p = (points - middle) / size
    pairs = [(i, j) for i in range(d) for j in range(i + 1, d)]
    mixed = [2 * p[:, i] * p[:, j] for i, j in pairs]
    squares = list((p**2).T)
    linear = list((2 * p).T)
    # From the general ellipsoid to an aligned one to a sphere.
    for quadratic in (squares + mixed, squares, [np.sum(p**2, axis=1)]):
        design = np.stack(quadratic + linear, axis=1)
        if n < design.shape[1]:
            continue
        q, _, rank, _ = np.linalg.lstsq(design, np.ones(n), rcond=1e-9)
        if rank < design.shape[1]:
            continue
        terms = len(quadratic)
        matrix = np.diag(np.broadcast_to(q[: min(terms, d)], d)).copy()
        for value, (i, j) in zip(q[d:terms], pairs, strict=False):
            matrix[i, j] = matrix[j, i] = value
        if not np.all(np.linalg.eigvalsh(matrix) > 0):
            continue
        # Complete the square: centre, and the level by which to normalise the matrix.
        centre = -np.linalg.solve(matrix, q[terms:])
        level = 1 + centre @ matrix @ centre
        return middle + size * centre, np.asarray(matrix / (level * size**2), dtype=np.float64)
    raise FitError("the positions lie on no ellipsoid; spread them over more directions")


ACCELEROMETER, GYRO = "accelerometer", "gyro"
PARTS = (ACCELEROMETER, GYRO)


def known_part(part: str) -> str:
    """Return `part` if it is `accelerometer` or `gyro`; raise `UsageError` for any other name."""
    if part not in PARTS:
        raise UsageError(f"a sensor has no part '{part}'; it has {', '.join(PARTS)}")
    return part


def readings_of_part(session: Session, part: str) -> Readings:
    """Reduce a session to readings of its accelerometers or gyros; `part` is `accelerometer` or `gyro`."""
    if known_part(part) == ACCELEROMETER:
        return readings_of(session)
    from adis_gonio.fitting.gyros.gyro_readings import gyro_readings_of

    return gyro_readings_of(session)
