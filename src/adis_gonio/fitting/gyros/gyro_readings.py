"""Rate intervals: means of the three gyros over dwells and turns, with what the part truly turned.

A dwell is an interval in which nothing turns; a turn is one whose true rotation is known (`reference`).
Both are means over time, and for all that is linear in the rate (gain, direction of the axis, zero rate,
g-sensitivity) the mean is all that counts, however unevenly a hand turns. What is not linear is kept as a
fact of the interval: the mean of |rate| (`abs_dps`), which an asymmetry of the gain multiplies, and the
largest rate; turns that went beyond the range are refused.

Noise of a mean is the spectral density at frequency zero of the dwells' own samples over the number of
samples (as for the accelerometers, `estimation.spectrum`), in dwells with what quantization leaves, in
turns with what bridges over lost scans leave. 1/f noise, which intervals share, is not in it: `allan_dps2`
has its Allan variance, and `drift` what it does to these intervals.

Readings of the gyros: rate intervals as fit and trace take them.

A reading is the mean rate of an interval in °/s. Its covariance is that of the interval (noise,
quantization, lost scans), that of the true rotation by its reference, and 1/f noise: what each interval has
of its own, and the modes that intervals share (`Readings.slow`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import current
from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.numbers import counted, format_ranges
from adis_gonio.device.sensor.variants import GYRO_LSB_DPS, VARIANTS
from adis_gonio.fitting.estimation.readings import (
    Readings,
    Unit,
    flicker_parts,
    mg_per_unit,
    quantization_variance,
)
from adis_gonio.fitting.estimation.screening import steps_of
from adis_gonio.fitting.estimation.spectrum import MeanNoise, noise_of_means, spans
from adis_gonio.fitting.gyros.accelerometer_triad import Triad, triad_of
from adis_gonio.fitting.gyros.turn_integration import Integral, Path, Sampling, integrate, period_of
from adis_gonio.fitting.gyros.turn_references import (
    MARK_U_DEG,
    Reference,
    in_space,
    on_stage,
    steady_force,
    whole_turns,
)
from adis_gonio.model.effects import AXES, Conditions
from adis_gonio.model.measurement import MeanRate
from adis_gonio.model.records import Dwell, Session, Turn
from adis_gonio.record.provenance import provenance_of

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration

DPS_PER_RADPS = 180.0 / math.pi


@dataclass(frozen=True)
class RateIntervals:
    """One row an interval, in the order of time.

    Attributes
    ----------
    mean_dps : (n, 3) float
        Mean of what the gyros showed, in °/s.
    covariance_dps2 : (n, 3, 3) float
        Of the mean, from noise, quantization and lost scans; 1/f noise is not in it.
    dof : (n,) float
        Degrees of freedom of that covariance, one estimate for all where `pooled`.
    begin_s, end_s : (n,) float
        When it was, in s since the session began, the filter's delay taken off.
    turn : (n,) bool
        True for a turn, False for a dwell.
    position : (n,) int
        Number of the dwell, or of the dwell in which the turn ends.
    rotation_dps : (n, 3) float
        True mean rate by the reference, right-handed in the accelerometers' frame; 0 for dwells.
    rotation_covariance_dps2 : (n, 3, 3) float
        Of that, what each turn has of its own; 0 for dwells.
    rotation_modes_dps : (n, 3, k) float or None
        What errors of the accelerometers add to it, one standard uncertainty of each: k errors, the same in
        all turns (`gyros.axes`).
    force_g : (n, 3) float
        Mean of what the accelerometers read, as read, in g; z is 0 where there is none.
    abs_dps, peak_dps : (n, 3) float
        Mean and largest |rate|, the zero rate taken off; 0 for dwells.
    temperature_c, supply_v : (n,) float or None
    temperatures_c : (n, 3) float or None
        Of the three gyros' dies, where the file has them apart.
    check : (n,) bool
        True where the dwell, or one of the two dwells of the turn, takes no part in a fit.
    samples, bridged : (n,) int
        Samples, and lost scans that were bridged.
    allan_dps2 : (3,) float
        Allan variance of the 1/f noise; `allan_shown` False: the variant's figure, an estimate.
    pooled : bool
    references : tuple of str
        By what each interval's rotation is known: `rest`, `gravity` or `whole turns`.
    refused : tuple of str
        Turns that tell nothing, and why.
    """

    mean_dps: Floats
    covariance_dps2: Floats
    dof: Floats
    begin_s: Floats
    end_s: Floats
    turn: NDArray[np.bool_]
    position: NDArray[np.intp]
    rotation_dps: Floats
    rotation_covariance_dps2: Floats
    force_g: Floats
    abs_dps: Floats
    peak_dps: Floats
    temperature_c: Floats | None
    supply_v: Floats | None
    check: NDArray[np.bool_]
    samples: NDArray[np.intp]
    bridged: NDArray[np.intp]
    allan_dps2: Floats
    allan_shown: bool = False
    pooled: bool = True
    temperatures_c: Floats | None = None
    rotation_modes_dps: Floats | None = None
    references: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.mean_dps)

    @property
    def rotation_u_dps(self) -> Floats:
        """Standard uncertainty (n, 3) of `rotation_dps`, axis by axis."""
        own = np.diagonal(self.rotation_covariance_dps2, axis1=1, axis2=2)
        shared = 0.0 if self.rotation_modes_dps is None else (self.rotation_modes_dps**2).sum(axis=2)
        return np.sqrt(own + shared)

    @property
    def length_s(self) -> Floats:
        """Of each interval (n,)."""
        return self.end_s - self.begin_s

    def drift(self) -> tuple[Floats, Floats | None]:
        """1/f noise: variances (n, 3) of each interval's own, and modes (n, 3, k) that intervals share."""
        return flicker_parts(self.begin_s, self.end_s, self.allan_dps2)


def rate_intervals(session: Session, calibration: Calibration | None = None) -> RateIntervals:
    """Intervals of a session: its dwells with gyros, and the turns between them whose rotation is known.

    Parameters
    ----------
    calibration : Calibration, optional
        Of the same part's accelerometers, for what the session does not determine of them.

    Raises
    ------
    DataError
        The session has no gyros, or none of its dwells has two samples.
    """
    rests = gyro_dwells_of(session)
    dwells, rows, scale, noise, sampling = (
        rests.dwells, rests.rows, rests.scale, rests.noise, rests.sampling,
    )  # fmt: skip
    at_rest = _of_dwells(session, dwells, rows, scale, noise, sampling)
    by_position = rests.by_position
    turns = [t for t in session.turns if t.before in by_position and t.position in by_position]
    triad = triad_of(session, calibration) if turns else None
    made: list[_Interval] = []
    refused: dict[str, list[int]] = {}
    alike, whole = _alike(turns), any(turn.turned_deg is not None for turn in turns)
    for turn in turns:
        before, after = dwells[by_position[turn.before]], dwells[by_position[turn.position]]
        found = _turned(session, turn, before, after, scale, sampling, triad, alike[turn.position])
        if not isinstance(found, str):
            made.append(found)
        elif (
            turn.turned_deg is not None or not whole
        ):  # how a part is laid down between whole turns is free
            refused.setdefault(found, []).append(turn.position)
    return _joined(at_rest, made, noise, sampling, session, _in_words(refused), triad)


@dataclass(frozen=True)
class GyroDwells:
    """Dwells of a session with gyros, and what they say of how the rates were sampled.

    Attributes
    ----------
    dwells : tuple of Dwell
    rows : tuple of (n, 3) float
        Rates of each, in the file's unit.
    scale : float
        °/s in that unit.
    per_g : float
        g in the unit of the accelerometers; NaN where that is not known.
    noise : MeanNoise
    sampling : Sampling
    allan_dps2 : (3,) float
        Allan variance of the 1/f noise.
    """

    dwells: tuple[Dwell, ...]
    rows: tuple[Floats, ...]
    scale: float
    per_g: float
    noise: MeanNoise
    sampling: Sampling
    allan_dps2: Floats

    @property
    def by_position(self) -> dict[int, int]:
        """Place of a dwell by its number."""
        return {dwell.position: k for k, dwell in enumerate(self.dwells)}

    @cached_property
    def mean_dps(self) -> Floats:
        """Zero rates (n, 3), what force adds among them."""
        return self.scale * np.array([row.mean(axis=0) for row in self.rows])

    @cached_property
    def variance_dps2(self) -> Floats:
        """Variance (n, 3) of those by the samples' noise."""
        return np.diagonal(self.noise.covariance, axis1=1, axis2=2)

    @cached_property
    def force_g(self) -> Floats:
        """Mean of what the accelerometers read (n, 3), in g."""
        return self.per_g * np.array([_three(dwell.accel).mean(axis=0) for dwell in self.dwells])

    @cached_property
    def spans_s(self) -> Floats:
        """Begin and end (n, 2) of each dwell, the filter's delay taken off."""
        return np.column_stack(spans([dwell.time_s for dwell in self.dwells])) - self.sampling.delay_s


def gyro_dwells_of(session: Session) -> GyroDwells:
    """Dwells of a session that have gyros.

    Raises
    ------
    DataError
        The session has no gyros, or none of its dwells has two samples; they are in counts, or not finite.
    """
    source = session.source or "session"
    dwells = tuple(dwell for dwell in session.dwells if dwell.gyro is not None and len(dwell) > 1)
    if not dwells and any(dwell.gyro is not None for dwell in session.dwells):
        raise DataError(
            f"{source}: its dwells hold one sample of the gyros each, and nothing tells how noisy that is: "
            "give all samples"
        )
    if not dwells:
        raise DataError(
            f"{source}: no dwell holds samples of the gyros (gx, gy, gz): record them, or name the columns"
        )
    if session.gyro_unit == "counts":
        raise DataError(f"{source}: gyros in counts have no known scale; state gyro_unit dps or radps")
    scale = DPS_PER_RADPS if session.gyro_unit == "radps" else 1.0
    rows = tuple(np.asarray(dwell.gyro) for dwell in dwells)
    _refuse_not_finite(source, dwells, rows)
    noise = noise_of_means(rows, scale)
    per_g = 1e-3 * mg_per_unit(session) if session.accel_unit != "counts" else math.nan
    sampling = _sampling(session, dwells, noise)
    return GyroDwells(dwells, rows, scale, per_g, noise, sampling, _allan(session, noise))


def _in_words(refused: dict[str, list[int]]) -> tuple[str, ...]:
    """Turns that were refused, those for one reason together."""
    return tuple(
        f"turn{'s' if len(ends) > 1 else ''} to dwell {format_ranges(ends)}: {why}"
        for why, ends in refused.items()
    )


def _alike(turns: Sequence[Turn]) -> dict[int, int]:
    """How many whole turns follow one another with the part as it lies, by where each ends.

    They share what is not known of the direction of their axis.
    """
    alike: dict[int, int] = {}
    group: list[Turn] = []
    for turn in [*turns, None]:
        whole = turn is not None and turn.turned_deg is not None
        if turn is None or not whole or (group and group[-1].position != turn.before):
            alike |= {one.position: len(group) for one in group}
            group = []
        if turn is not None and whole:
            group.append(turn)
        elif turn is not None:
            alike[turn.position] = 1
    return alike


def _refuse_not_finite(source: str, dwells: Sequence[Dwell], rows: Sequence[Floats]) -> None:
    for dwell, gyro in zip(dwells, rows, strict=True):
        if not np.isfinite(gyro).all():
            raise DataError(f"{source}: the gyros of position {dwell.position} hold NaN or infinity")


def _sampling(session: Session, dwells: Sequence[Dwell], noise: MeanNoise) -> Sampling:
    configuration = session.facts.get("configuration") or {}
    counts = np.array([len(dwell) for dwell in dwells], dtype=float)
    density = (noise.covariance * counts[:, None, None] ** 2).sum(axis=0) / counts.sum()
    return Sampling(
        period_s=period_of([dwell.time_s for dwell in dwells]),
        filter_m=int(configuration.get("filter_m", 0)),
        range_dps=float(configuration.get("gyro_range_dps") or _range(session)),
        density_dps2=density,
        drift_dps=np.sqrt(_allan(session, noise)),
    )


def _range(session: Session) -> float:
    """Of the family's default; unknown where the sensor is another."""
    return 300.0 if session.sensor in VARIANTS else math.inf


def _allan(session: Session, noise: MeanNoise) -> Floats:
    """Allan variance (3,): what the dwells show, else the variant's figure as far as they allow it."""
    variant = VARIANTS.get(session.sensor)
    stated = 0.0 if variant is None else variant.performance.gyro_instability_dps**2
    return np.where(noise.flicker > 0, noise.flicker, np.minimum(stated, noise.flicker_limit))


@dataclass(frozen=True)
class _Interval:
    """A row of `RateIntervals`."""

    mean: Floats
    covariance: Floats
    dof: float
    begin_s: float
    end_s: float
    position: int
    force_g: Floats
    check: bool
    samples: int
    temperature_c: float
    supply_v: float
    temperatures_c: Floats
    before: int = -1
    bridged: int = 0
    rotation: Floats = field(default_factory=lambda: np.zeros(3))
    rotation_covariance: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    rotation_modes: Floats | None = None
    mean_abs: Floats = field(default_factory=lambda: np.zeros(3))
    peak: Floats = field(default_factory=lambda: np.zeros(3))
    reference: str = "rest"


def _of_dwells(
    session: Session,
    dwells: Sequence[Dwell],
    rows: Sequence[Floats],
    scale: float,
    noise: MeanNoise,
    sampling: Sampling,
) -> list[_Interval]:
    per_g = 1e-3 * mg_per_unit(session) if session.accel_unit != "counts" else math.nan
    steps = np.full(3, _step(session)) if session.gyro_unit == "dps" else steps_of(rows)
    rounding = quantization_variance(rows, np.full(3, scale), scale * steps)
    begin, end = spans([dwell.time_s for dwell in dwells])
    return [
        _Interval(
            mean=scale * rows[k].mean(axis=0),
            covariance=noise.covariance[k] + np.diag(rounding[k]),
            dof=float(noise.dof[k]),
            begin_s=float(begin[k]) - sampling.delay_s,
            end_s=float(end[k]) - sampling.delay_s,
            position=dwell.position,
            force_g=per_g * _three(dwell.accel).mean(axis=0),
            check=dwell.use == "check",
            samples=len(dwell),
            temperature_c=_mean(dwell.temperature_c),
            supply_v=_mean(dwell.supply_v),
            temperatures_c=_of_dies(dwell.temperatures_c),
        )
        for k, dwell in enumerate(dwells)
    ]


def _step(session: Session) -> float:
    """LSB of the gyros; 0 where the sensor is not of the family."""
    configuration = session.facts.get("configuration") or {}
    if session.sensor not in VARIANTS:
        return 0.0
    return GYRO_LSB_DPS[int(configuration.get("gyro_range_dps") or 300)]


def _three(accel: Floats) -> Floats:
    """Accelerations (n, 3) of two axes or three."""
    return accel if accel.shape[1] == 3 else np.column_stack([accel, np.zeros(len(accel))])


def _mean(series: Floats | None) -> float:
    return math.nan if series is None or not len(series) else float(np.mean(series))


def _of_dies(series: Floats | None) -> Floats:
    """Mean temperatures (3,) of the dies."""
    return np.full(3, math.nan) if series is None or not len(series) else np.asarray(series.mean(axis=0))


def _turned(
    session: Session,
    turn: Turn,
    before: Dwell,
    after: Dwell,
    scale: float,
    sampling: Sampling,
    triad: Triad | None,
    alike: int,
) -> _Interval | str:
    """Interval of a turn, or why there is none."""
    path = path_between(session, turn, before, after, scale)
    if path is None:
        return "nothing was recorded between the dwells"
    integral = integrate(path, sampling)
    if isinstance(integral, str):
        return integral
    if triad is None:
        return "nothing is known of the accelerometers"
    if turn.turned_deg is not None:
        found = _whole(session, path, integral, triad, sampling, alike)
    else:
        found = _by_gravity(integral, triad, (before.position, after.position))
    if isinstance(found, str):
        return found
    length = integral.length_s
    return _Interval(
        mean=integral.angle_deg / length,
        covariance=integral.covariance_deg2 / length**2,
        dof=math.nan,
        begin_s=integral.begin_s,
        end_s=integral.end_s,
        position=after.position,
        force_g=integral.force_g,
        check="check" in (before.use, after.use),
        samples=integral.samples,
        temperature_c=_mean(turn.temperature_c),
        supply_v=_mean(turn.supply_v),
        temperatures_c=_of_dies(turn.temperatures_c),
        before=before.position,
        bridged=integral.bridged,
        rotation=found.angle_deg / length,
        rotation_covariance=found.covariance_deg2 / length**2,
        rotation_modes=None if found.modes_deg is None else found.modes_deg / length,
        mean_abs=integral.mean_abs_dps,
        peak=integral.peak_dps,
        reference=found.kind,
    )


def path_between(session: Session, turn: Turn, before: Dwell, after: Dwell, scale: float) -> Path | None:
    """Samples from the end of one dwell to the beginning of the other, gyros times `scale`."""
    if turn.gyro is None or not len(turn) or before.gyro is None or after.gyro is None:
        return None
    ends = slice(-1, None), slice(None, 1)
    per_g = 1e-3 * mg_per_unit(session) if session.accel_unit != "counts" else math.nan
    time = np.concatenate([before.time_s[ends[0]], turn.time_s, after.time_s[ends[1]]])
    if not (np.diff(time) > 0).all():
        return None
    rate = np.concatenate([before.gyro[ends[0]], turn.gyro, after.gyro[ends[1]]])
    force = np.concatenate([_three(a) for a in (before.accel[ends[0]], turn.accel, after.accel[ends[1]])])
    zero = np.array([before.gyro.mean(axis=0), after.gyro.mean(axis=0)])
    at_rest = np.array([_three(dwell.accel).mean(axis=0) for dwell in (before, after)])
    return Path(time, scale * rate, per_g * force, scale * zero, per_g * at_rest)


def _whole(
    session: Session, path: Path, integral: Integral, triad: Triad, sampling: Sampling, alike: int
) -> Reference | str:
    """Whole turns about the vertical."""
    delay = sampling.delay_s
    steady, covariance = steady_force(path, integral.begin_s + delay, integral.end_s + delay)
    axis = covariance / max(float(steady @ steady), 1e-18)
    found = whole_turns(integral, triad.direction(steady), _mark_u_deg(session), axis, alike)
    if isinstance(found, str) or triad.modes is None:
        return found
    # Upwards is against what the accelerometers read.
    return replace(found, modes_deg=-360.0 * found.turns * triad.modes(steady))


def _by_gravity(integral: Integral, triad: Triad, positions: tuple[int, int]) -> Reference | str:
    """Turn between two dwells in which gravity stands otherwise."""
    if triad.psi_deg is not None:
        here, there = (triad.psi_deg.get(position) for position in positions)
        if here is None or there is None:
            return "one of its dwells has no angle by gravity"
        return on_stage(integral, (here[0], there[0]), math.hypot(here[1], there[1]))
    before, after = (triad.gravity.get(position) for position in positions)
    if before is None or after is None:
        return "one of its dwells has no direction of gravity"
    return in_space(integral, (before, after), triad.u_rad)


def _mark_u_deg(session: Session) -> float:
    sigma = session.fixture_sigma_deg
    return MARK_U_DEG if sigma is None or not math.isfinite(sigma) else sigma


def _joined(
    at_rest: list[_Interval],
    turns: list[_Interval],
    noise: MeanNoise,
    sampling: Sampling,
    session: Session,
    refused: tuple[str, ...],
    triad: Triad | None,
) -> RateIntervals:
    rows = sorted([*at_rest, *turns], key=lambda row: row.begin_s)
    start = min(row.begin_s for row in rows)
    dof = float(noise.dof.max() if noise.pooled else noise.dof.sum())

    def stacked(name: str) -> Floats:
        return np.array([getattr(row, name) for row in rows], dtype=float)

    temperature, supply = stacked("temperature_c"), stacked("supply_v")
    dies = stacked("temperatures_c")
    rotation_covariance = stacked("rotation_covariance")
    return RateIntervals(
        mean_dps=stacked("mean"),
        covariance_dps2=stacked("covariance"),
        dof=np.where(np.isnan(stacked("dof")), dof, stacked("dof")),
        begin_s=stacked("begin_s") - start,
        end_s=stacked("end_s") - start,
        turn=np.array([row.before >= 0 for row in rows]),
        position=np.array([row.position for row in rows], dtype=np.intp),
        rotation_dps=stacked("rotation"),
        rotation_covariance_dps2=rotation_covariance,
        rotation_modes_dps=_modes(rows),
        force_g=stacked("force_g"),
        abs_dps=stacked("mean_abs"),
        peak_dps=stacked("peak"),
        temperature_c=temperature if np.isfinite(temperature).all() else None,
        supply_v=supply if np.isfinite(supply).all() else None,
        temperatures_c=dies if np.isfinite(dies).all() else None,
        check=np.array([row.check for row in rows]),
        samples=np.array([row.samples for row in rows], dtype=np.intp),
        bridged=np.array([row.bridged for row in rows], dtype=np.intp),
        allan_dps2=_allan(session, noise),
        allan_shown=bool((noise.flicker > 0).any()),
        pooled=noise.pooled,
        references=tuple(row.reference for row in rows),
        refused=refused,
        notes=() if triad is None or not turns else triad.notes,
    )


def _modes(rows: Sequence[_Interval]) -> Floats | None:
    """Shared errors (n, 3, k); none for dwells."""
    known = [row.rotation_modes for row in rows if row.rotation_modes is not None]
    if not known:
        return None
    nothing = np.zeros_like(known[0])
    return np.array([nothing if row.rotation_modes is None else row.rotation_modes for row in rows])


def summary(intervals: RateIntervals) -> str:
    """What there is, in a line."""
    turns = int(intervals.turn.sum())
    told = f"{counted(len(intervals) - turns, 'dwell')} and {counted(turns, 'turn')}"
    return told + (f", {counted(len(intervals.refused), 'turn')} refused" if intervals.refused else "")


LEAST_FORCE_G = 0.02
"""Least range of a component of the force: what moves by less is a constant with noise, whose share of the
zero rate nothing tells from the zero rate itself."""


def gyro_readings_of(session: Session) -> Readings:
    """Readings of all intervals, those for checking among them; reduced once a session and kept with it.

    Raises
    ------
    DataError
        The session has no gyros, or their unit is not known.
    """
    return session.once(_gyro_readings)


def _gyro_readings(session: Session) -> Readings:
    current().tell("noise of the gyros")
    return readings_of_intervals(rate_intervals(session), session.sensor, session.gravity_mg)


def gyro_readings_by(session: Session, accelerometers: Calibration) -> Readings:
    """The same with a calibration of the part's accelerometers, which the session is not kept with.

    Raises
    ------
    DataError
        As `gyro_readings_of`.
    UsageError
        The calibration is of another part, or states no uncertainties.
    """
    where = accelerometers.provenance
    for here, there in ((session.sensor, where.sensor), (session.serial, where.serial)):
        if here and there and here != there:
            raise UsageError(f"the calibration of the accelerometers is of {there}, the session of {here}")
    current().tell("noise of the gyros")
    held = provenance_of(session)  # the offsets while the session was recorded, whatever was written since
    matching = accelerometers.for_registers(held.offsets_lsb, held.gyro_offsets_lsb)
    intervals = rate_intervals(session, matching)
    return readings_of_intervals(intervals, session.sensor, session.gravity_mg)


def readings_of_intervals(
    intervals: RateIntervals, sensor: str = "generic", gravity_mg: float = 1000.0
) -> Readings:
    """The same of intervals that somebody else made."""
    n = len(intervals)
    own, slow = intervals.drift()
    flicker = np.broadcast_to(own, (n, 3)).copy()
    covariance = intervals.covariance_dps2 + intervals.rotation_covariance_dps2
    force, still = _moving(intervals.force_g)
    return Readings(
        mean=intervals.mean_dps,
        own_covariance=covariance + flicker[:, :, None] * np.eye(3),
        dof=intervals.dof,
        known=np.ones(n, dtype=np.bool_),
        angle_rad=np.full(n, np.nan),
        conditions=_conditions(intervals, force),
        gravity_mg=gravity_mg,
        fixture_rad=math.inf,
        fixture_stated=False,
        check=intervals.check,
        position=intervals.position,
        samples=intervals.samples,
        unit=Unit("dps", np.zeros(3), np.ones(3)),
        slow=_shared(slow, intervals.rotation_modes_dps),
        flicker=flicker,
        flicker_shown=intervals.allan_shown,
        pooled=intervals.pooled,
        sensor=sensor,
        notes=(*intervals.notes, *intervals.refused, *still),
        measurement=MeanRate(),
    )


def _shared(slow: Floats | None, modes: Floats | None) -> Floats | None:
    """Modes (n, 3, k) of the 1/f noise and of errors of the accelerometers, which turns share."""
    both = [one for one in (slow, modes) if one is not None]
    return np.concatenate(both, axis=2) if both else None


def _conditions(intervals: RateIntervals, force: Floats | None) -> Conditions:
    time = (intervals.begin_s + intervals.end_s) / 2
    turned = bool(intervals.turn.any())
    temperature = intervals.temperature_c
    # A turn stands half-way between two dwells.
    order = np.cumsum(~intervals.turn) - 1 + 0.5 * intervals.turn
    return Conditions(
        time_s=time - time[0],
        order=order.astype(float),
        temperature_c=temperature,
        supply_v=intervals.supply_v,
        temperature_history=None if temperature is None else (time - time[0], temperature),
        temperatures_c=intervals.temperatures_c,
        force_g=force,
        rate_dps=intervals.rotation_dps if turned else None,
        abs_rate_dps=np.maximum(intervals.abs_dps, np.abs(intervals.rotation_dps)) if turned else None,
    )


def _moving(force_g: Floats) -> tuple[Floats | None, list[str]]:
    """Forces (n, 3) with 0 for components that do not move, and what is to be said of these."""
    if not np.isfinite(force_g).all():
        return None, ["accelerometers in counts: nothing can be said of the gyros' g-sensitivity"]
    moves = np.ptp(force_g, axis=0) >= LEAST_FORCE_G
    names = [AXES[k] for k in np.flatnonzero(~moves)]
    if not names:
        return force_g, []
    if len(names) == len(AXES):
        return None, ["the force was the same throughout: what it adds is in the zero rates"]
    note = f"the force along {', '.join(names)} did not change: what it adds is in the zero rates"
    return np.where(moves, force_g, 0.0), [note]
