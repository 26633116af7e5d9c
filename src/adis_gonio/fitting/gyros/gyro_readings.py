"""Readings of the gyros: mean rates over dwells and turns, with the true rotation of the sensor.

In a dwell the true rate is zero. A turn is used if its true rotation is known (`turn_integration`). A
reading of a dwell or turn is a mean over time. All effects that are linear in the rate (gain, direction of
the axis, zero rate, g-sensitivity) depend on this mean alone, however uneven a hand turns. The asymmetry of
the gain, its change with the sign of the rate, is not linear; the mean of |rate| is kept for it
(`abs_dps`). Turns beyond the range of the gyros are refused.

The noise of a mean is the spectral density at frequency zero of the samples in the dwells, divided by the
number of samples (as for the accelerometers, `estimation.spectrum`). Dwells add the error of quantization,
turns add the error of bridges over lost scans. `allan_dps2` is the Allan variance of the 1/f noise, which
intervals share.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import current
from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.numbers import format_fixed, format_ranges
from adis_gonio.device.sensor.registers import GYRO_LSB_DPS, VARIANTS
from adis_gonio.fitting.estimation.readings import (
    Readings,
    Unit,
    flicker_of,
    flicker_parts,
    quantization_variance,
)
from adis_gonio.fitting.estimation.screening import is_lively, piles, steps_of
from adis_gonio.fitting.estimation.spectrum import MeanNoise, noise_of_means, spans
from adis_gonio.fitting.gyros import turn_integration
from adis_gonio.model.effects import AXES, Conditions
from adis_gonio.model.measurement import MeanRate
from adis_gonio.model.records import Dwell, Session, Turn
from adis_gonio.record.provenance import provenance_of

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration

LEAST_FORCE_G = 0.02
"""Smallest change, in g, of a component of the force over the intervals at which its g-sensitivity is
fitted: below it the effect cannot be separated from the zero rate."""

Row = dict[str, Any]
"""A dwell or turn: its values by the names in the notes of `RateIntervals`."""


@dataclass(frozen=True)
class RateIntervals:
    """All dwells with gyros of a session, and the turns with a known rotation, in the order of time.

    Attributes
    ----------
    rows : tuple of mapping
        Dwells and turns, as mappings from the names in Notes to values.
    rests : GyroDwells
        Dwells of the session, with the noise of their gyros.
    refused : tuple of str
        Turns that are not used, with the reason.
    notes : tuple of str
        Remarks on the accelerometers as the reference.

    Notes
    -----
    Each row has:

    * `mean_dps` (3,), `covariance_dps2` (3, 3), `dof`: mean reading of the gyros, its covariance by noise,
      quantization and lost scans (without 1/f noise), and the degrees of freedom of that covariance;
    * `begin_s`, `end_s`, `length_s`: times on the clock of the session, with the filter's delay subtracted;
    * `position`: number of the dwell, or of the dwell in which the turn ends;
    * `force_g` (3,): mean reading of the accelerometers; z is 0 without a Z accelerometer;
    * `check`: True if the dwell, or a dwell next to the turn, takes no part in a fit;
    * `samples`: number of samples;
    * `temperature_c`, `supply_v`, `temperatures_c` (3,): means over the interval, the last one of the three
      gyros' dies; NaN if not recorded;
    * `turn`: True for a turn, False for a dwell;
    * `rotation_dps` (3,), `rotation_covariance_dps2` (3, 3): true mean rate of the sensor by gravity or the
      declared angle, right-handed in the accelerometers' frame, and the part of its covariance that is
      independent in each turn; 0 for a dwell;
    * `rotation_modes_dps` (3, k): change of `rotation_dps` by one standard uncertainty of each of k errors
      of the accelerometers, which all turns share (`turn_integration.Axes`); None without such errors;
    * `abs_dps` (3,): mean of |rate − zero rate| over a turn; 0 for a dwell.
    """

    rows: tuple[Row, ...]
    rests: GyroDwells
    refused: tuple[str, ...]
    notes: tuple[str, ...]

    def column(self, name: str) -> NDArray[Any]:
        """Return one value of all intervals, by its name, as an array (n, …)."""
        return np.array([row[name] for row in self.rows])


@dataclass(frozen=True)
class GyroDwells:
    """Dwells of a session with gyro samples, and the properties of their sampling and noise.

    Attributes
    ----------
    dwells : tuple of Dwell
        Dwells with two or more samples of the gyros.
    rows : tuple of (n, 3) float
        Rates of each dwell, in the file's unit.
    scale, per_g : float
        Size of the gyros' unit in °/s and of the accelerometers' unit in g; `per_g` is NaN if unknown.
    noise : MeanNoise
        Noise of the mean rates, in (°/s)².
    sampling : Sampling
        Period and filter delay of the samples.
    allan_dps2 : (3,) float
        Allan variance of the 1/f noise.
    """

    dwells: tuple[Dwell, ...]
    rows: tuple[Floats, ...]
    scale: float
    per_g: float
    noise: MeanNoise
    sampling: turn_integration.Sampling
    allan_dps2: Floats

    @property
    def by_position(self) -> dict[int, int]:
        """Index of each dwell among the dwells with gyro samples, by its number in the session."""
        return {dwell.position: k for k, dwell in enumerate(self.dwells)}

    @cached_property
    def mean_dps(self) -> Floats:
        """Mean reading (n, 3) of each gyro in each dwell in °/s: its zero rate under the force there."""
        return self.scale * np.array([row.mean(axis=0) for row in self.rows])

    @cached_property
    def variance_dps2(self) -> Floats:
        """Variance (n, 3) in (°/s)² of the mean rates from the noise of the samples."""
        return np.diagonal(self.noise.covariance, axis1=1, axis2=2)

    @cached_property
    def force_g(self) -> Floats:
        """Mean reading (n, 3) of the accelerometers in each dwell, in g."""
        return self.per_g * np.array(
            [turn_integration.three_axes(dwell.accel).mean(axis=0) for dwell in self.dwells]
        )

    @cached_property
    def spans_s(self) -> Floats:
        """Begin and end (n, 2) of each dwell in s, with the filter's delay subtracted."""
        return np.column_stack(spans([dwell.time_s for dwell in self.dwells])) - self.sampling.delay_s


def gyro_dwells_of(session: Session) -> GyroDwells:
    """Collect the dwells of a session that have gyros.

    Raises
    ------
    DataError
        The session has no gyros, or no dwell with two samples; the gyros are in counts, or not finite.
    """
    source = session.source or "session"
    dwells = tuple(dwell for dwell in session.dwells if dwell.gyro is not None and len(dwell) > 1)
    if not dwells and any(dwell.gyro is not None for dwell in session.dwells):
        raise DataError(
            f"{source}: its dwells hold one sample of the gyros each, and their noise is unknown: "
            "give all samples"
        )
    if not dwells:
        raise DataError(
            f"{source}: no dwell holds samples of the gyros (gx, gy, gz): record them, or name the columns"
        )
    if session.gyro_unit == "counts":
        raise DataError(f"{source}: gyros in counts have no known scale; state gyro_unit dps or radps")
    scale = turn_integration.dps_per_unit(session)
    rows = tuple(np.asarray(dwell.gyro) for dwell in dwells)
    for dwell, gyro in zip(dwells, rows, strict=True):
        if not np.isfinite(gyro).all():
            raise DataError(f"{source}: the gyros of position {dwell.position} hold NaN or infinity")
    variant = VARIANTS.get(session.sensor)
    constant = ~np.any([np.ptp(row, axis=0) > 0 for row in rows], axis=0)
    averaged = constant & (np.ptp([row[0] for row in rows], axis=0) > 0)
    if variant is None and averaged.any():
        axis = AXES[int(averaged.argmax())]
        raise DataError(
            f"{source}: gyro {axis} is constant within each dwell and differs between"
            " dwells: repeated averages do not show their noise; give all samples"
        )
    noise = noise_of_means(rows, scale)
    allan = flicker_of(noise, variant.performance.gyro_instability_dps**2 if variant else 0.0)
    configuration = session.facts.get("configuration") or {}
    counts = np.array([len(dwell) for dwell in dwells], dtype=float)
    period = turn_integration.period_of([dwell.time_s for dwell in dwells])
    turns = [
        (turn.time_s, scale * turn.gyro) for turn in session.turns if turn.gyro is not None and len(turn)
    ]
    range_dps = float(configuration.get("gyro_range_dps") or (300.0 if variant else math.inf))
    if turns:
        # Gyros may be clipped short of their range.
        ends = piles([rate for _, rate in turns], is_lively(rows, steps_of(rows)))
        range_dps = min((range_dps, *(abs(value) for _, value, _ in ends)))
    rests = [(dwell.time_s, scale * row) for dwell, row in zip(dwells, rows, strict=True)]
    sampling = turn_integration.Sampling(
        period_s=period,
        filter_m=int(configuration.get("filter_m", 0)),
        range_dps=range_dps,
        density_dps2=(noise.covariance * counts[:, None, None] ** 2).sum(axis=0) / counts.sum(),
        drift_dps=np.sqrt(allan),
        aliasing=turn_integration.Aliasing.of(
            rests, [(time, rate) for time, rate in turns if np.abs(rate).max() < range_dps], period
        ),
    )
    return GyroDwells(dwells, rows, scale, turn_integration.g_per_unit(session), noise, sampling, allan)


def measured_turn(
    session: Session, turn: Turn, rests: GyroDwells
) -> tuple[turn_integration.Path, turn_integration.Integral] | str:
    """Return the samples of a turn and their integral, or the reason as text why there is none."""
    if not rests.by_position.keys() >= {turn.before, turn.position}:
        return "one of its dwells has no gyros"
    ends = [rests.dwells[rests.by_position[position]] for position in (turn.before, turn.position)]
    path = turn_integration.path_between(session, turn, *ends)
    if path is None:
        return turn_integration.NOT_RECORDED
    integral = turn_integration.integrate(path, rests.sampling)
    return integral if isinstance(integral, str) else (path, integral)


def rate_intervals(session: Session, calibration: Calibration | None = None) -> RateIntervals:
    """Collect the dwells with gyros of a session, and the turns between them with a known rotation.

    Parameters
    ----------
    calibration : Calibration, optional
        Calibration of the accelerometers of the same sensor, for their parameters that the session does not
        determine.

    Raises
    ------
    DataError
        The session has no gyros, or none of its dwells has two samples.
    """
    rests = session.once(gyro_dwells_of)
    rows = _intervals_of_dwells(session, rests)
    turns = [t for t in session.turns if {t.before, t.position} <= rests.by_position.keys()]
    triad = turn_integration.triad_of(session, calibration) if turns else None
    refused: dict[str, list[int]] = {}
    ratios: list[float] = []
    if triad is not None:
        consecutive, whole = _consecutive(turns), any(turn.turned_deg is not None for turn in turns)
        for turn in turns:
            found = _interval_of_turn(session, turn, rests, triad, consecutive[turn.position])
            if not isinstance(found, str):
                rows.append(found)
                if turn.turned_deg:
                    # The accelerometers read the opposite of the upward axis.
                    turned_deg = -found["length_s"] * float(found["rotation_dps"] @ found["force_g"])
                    ratios.append(turned_deg / turn.turned_deg / float(np.linalg.norm(found["force_g"])))
            elif turn.turned_deg is not None or not whole:
                # Between whole turns a part may be laid down in any way: such turns need no message.
                refused.setdefault(found, []).append(turn.position)
    return RateIntervals(
        tuple(sorted(rows, key=lambda row: row["begin_s"])),
        rests,
        tuple(
            f"turn{'s' if len(ends) > 1 else ''} to dwell {format_ranges(ends)}: {why}"
            for why, ends in refused.items()
        ),
        ()
        if triad is None or not any(row["turn"] for row in rows)
        else (*triad.notes, *_miscounted(ratios)),
    )


def _miscounted(ratios: Sequence[float]) -> tuple[str, ...]:
    """Return a note if the gyro turned another number of whole turns than declared in every declared turn.

    `ratios` are the counted angles of the turns over the declared ones. One turn is miscounted by a hand,
    all of them by a wrong range or unit of the gyros, which whole turns would hide.
    """
    if len(ratios) < 2 or min(abs(ratio - 1) for ratio in ratios) < 0.1:
        return ()
    ratio = format_fixed(float(np.median(ratios)), 2)
    return (
        f"in all {len(ratios)} declared turns the gyros turned {ratio} times turned_deg, and whole turns "
        "are counted as turned: check the range, unit and signs of the gyros, or turned_deg",
    )


def _consecutive(turns: Sequence[Turn]) -> dict[int, int]:
    """Return the length of the series of declared turns to which each turn belongs.

    The keys are the numbers of the dwells in which the turns end. The turns of a series follow one another:
    each begins in the dwell in which the turn before ended. They share the error of the direction of their
    axis. A turn without a declared angle counts as a series of length 1.
    """
    series: list[list[Turn]] = []
    for turn in turns:
        last = series[-1][-1] if series else None
        declared = last is not None and None not in (last.turned_deg, turn.turned_deg)
        if last is not None and declared and last.position == turn.before:
            series[-1].append(turn)
        else:
            series.append([turn])
    return {turn.position: len(each) for each in series for turn in each}


def _surroundings(part: Dwell | Turn) -> Row:
    """Return mean temperature, supply voltage and temperatures of the gyro dies, by name.

    They are means over a dwell or turn; NaN if not recorded.
    """
    found = {}
    for name, unknown in (("temperature_c", ()), ("supply_v", ()), ("temperatures_c", 3)):
        series = getattr(part, name)
        recorded = series is not None and len(series)
        found[name] = series.mean(axis=0) if recorded else np.full(unknown, math.nan)
    return found


def _intervals_of_dwells(session: Session, rests: GyroDwells) -> list[Row]:
    """Return a row for each dwell, which has a mean rate with covariance and a force, but no rotation."""
    steps = steps_of(rests.rows)
    if session.gyro_unit == "dps":
        configuration = session.facts.get("configuration") or {}
        lsb = GYRO_LSB_DPS[int(configuration.get("gyro_range_dps") or 300)]
        steps = np.full(3, lsb if session.sensor in VARIANTS else 0.0)
    rounding = quantization_variance(rests.rows, np.full(3, rests.scale), rests.scale * steps)
    return [
        dict(
            mean_dps=rests.mean_dps[k],
            covariance_dps2=rests.noise.covariance[k] + np.diag(rounding[k]),
            dof=float(rests.noise.dof[k]),
            begin_s=float(rests.spans_s[k, 0]),
            end_s=float(rests.spans_s[k, 1]),
            length_s=float(np.ptp(rests.spans_s[k])),
            position=dwell.position,
            force_g=rests.force_g[k],
            check=dwell.use == "check",
            samples=len(dwell),
            turn=False,
            rotation_dps=np.zeros(3),
            rotation_covariance_dps2=np.zeros((3, 3)),
            rotation_modes_dps=None,
            abs_dps=np.zeros(3),
            **_surroundings(dwell),
        )
        for k, dwell in enumerate(rests.dwells)
    ]


def _interval_of_turn(
    session: Session, turn: Turn, rests: GyroDwells, triad: turn_integration.Triad, consecutive: int
) -> Row | str:
    """Return the mean rates over a turn with its true rotation, or the reason as text why there is none.

    `consecutive` is the length of the series of declared turns to which the turn belongs (`_consecutive`).
    """
    measured = measured_turn(session, turn, rests)
    if isinstance(measured, str):
        return measured
    path, integral = measured
    before, after = (rests.dwells[rests.by_position[k]] for k in (turn.before, turn.position))
    if turn.turned_deg is not None:
        sigma = session.fixture_sigma_deg
        mark_u_deg = turn_integration.MARK_U_DEG if sigma is None or not math.isfinite(sigma) else sigma
        found = turn_integration.reference_as_declared(
            path, integral, turn.turned_deg, triad, rests.sampling.delay_s, mark_u_deg, consecutive
        )
    else:
        found = triad.reference(turn, integral)
    if isinstance(found, str):
        return found
    length = integral.length_s
    return dict(
        mean_dps=integral.angle_deg / length,
        covariance_dps2=integral.covariance_deg2 / length**2,
        dof=float(rests.noise.dof.max() if rests.noise.pooled else rests.noise.dof.sum()),
        begin_s=integral.begin_s,
        end_s=integral.end_s,
        length_s=length,
        position=after.position,
        force_g=integral.force_g,
        check="check" in (before.use, after.use),
        samples=integral.samples,
        turn=True,
        rotation_dps=found.angle_deg / length,
        rotation_covariance_dps2=found.covariance_deg2 / length**2,
        rotation_modes_dps=None if found.modes_deg is None else found.modes_deg / length,
        abs_dps=integral.mean_abs_dps,
        **_surroundings(turn),
    )


def gyro_readings_of(session: Session, accelerometers: Calibration | None = None) -> Readings:
    """Return the gyro readings of all dwells and turns, with `check` dwells.

    They are computed once per session, unless `accelerometers` is given: a calibration of the
    accelerometers of the same sensor, for the true rotations in the turns.

    Raises
    ------
    DataError
        The session has no gyros, or their unit is not known.
    UsageError
        The calibration is of another part, or states no uncertainties.
    """
    if accelerometers is None:
        return session.once(_gyro_readings)
    where = accelerometers.provenance
    for here, there in ((session.sensor, where.sensor), (session.serial, where.serial)):
        if here and there and here != there:
            raise UsageError(f"the calibration of the accelerometers is of {there}, the session of {here}")
    held = provenance_of(session)  # the offsets during the recording, without any write since then
    matching = accelerometers.for_registers(held.offsets_lsb, held.gyro_offsets_lsb)
    return _gyro_readings(session, matching)


def _gyro_readings(session: Session, accelerometers: Calibration | None = None) -> Readings:
    current().tell("noise of the gyros")
    intervals = rate_intervals(session, accelerometers)
    return readings_of_intervals(intervals, session.sensor, session.gravity_mg)


def readings_of_intervals(
    intervals: RateIntervals, sensor: str = "generic", gravity_mg: float = 1000.0
) -> Readings:
    """Convert mean rates over dwells and turns to `Readings`, the input of a fit and a trace.

    `sensor` is the name of the variant, `gravity_mg` local gravity. The covariance of a reading is the sum
    of the covariance of the mean rate, the covariance of the true rotation, and the part of the 1/f noise
    that is independent from interval to interval. The part that neighbouring intervals share is in
    `Readings.slow` (n, 3, k): the change of each reading by one standard deviation of each of k independent
    errors.
    """
    n, column, noise = len(intervals.rows), intervals.column, intervals.rests.noise
    begin, end = column("begin_s"), column("end_s")
    own, slow = flicker_parts(begin - begin[0], end - begin[0], intervals.rests.allan_dps2)
    flicker = np.broadcast_to(own, (n, 3)).copy()
    # The error of the true rotation acts on the residual like noise of the reading.
    covariance = column("covariance_dps2") + column("rotation_covariance_dps2")
    force, still = _changing_force(column("force_g"))
    # Modes (n, 3, k) of the 1/f noise and of errors of the accelerometers, which turns share.
    modes = [row["rotation_modes_dps"] for row in intervals.rows]
    if (first := next((one for one in modes if one is not None), None)) is not None:
        turns = np.array([np.zeros_like(first) if one is None else one for one in modes])
        slow = np.concatenate([slow, turns], axis=2)
    return Readings(
        mean=column("mean_dps"),
        own_covariance=covariance + flicker[:, :, None] * np.eye(3),
        dof=column("dof"),
        noise_known=True,
        angle_rad=np.full(n, np.nan),
        conditions=_conditions(intervals, force),
        gravity_mg=gravity_mg,
        fixture_rad=math.inf,
        fixture_stated=False,
        check=column("check"),
        position=column("position"),
        samples=column("samples"),
        unit=Unit("dps", np.zeros(3), np.ones(3)),
        slow=slow,
        stage=np.zeros((n, 3, 0)),
        flicker=flicker,
        flicker_shown=bool((noise.flicker > 0).any()),
        pooled=noise.pooled,
        sensor=sensor,
        notes=(*intervals.notes, *intervals.refused, *still),
        measurement=MeanRate(),
    )


def _conditions(intervals: RateIntervals, force: Floats | None) -> Conditions:
    column = intervals.column
    time = (column("begin_s") + column("end_s")) / 2
    turn, rotation = column("turn"), column("rotation_dps")
    temperature, supply, dies = (
        values if np.isfinite(values := column(name)).all() else None
        for name in ("temperature_c", "supply_v", "temperatures_c")
    )
    # A turn is half-way between two dwells.
    order = np.cumsum(~turn) - 1 + 0.5 * turn
    return Conditions(
        time_s=time - time[0],
        order=order.astype(float),
        temperature_c=temperature,
        supply_v=supply,
        temperature_history=None if temperature is None else (time - time[0], temperature),
        temperatures_c=dies,
        force_g=force,
        rate_dps=rotation if turn.any() else None,
        abs_rate_dps=np.maximum(column("abs_dps"), np.abs(rotation)) if turn.any() else None,
    )


def _changing_force(force_g: Floats) -> tuple[Floats | None, list[str]]:
    """Return forces (n, 3) in which components that do not change are 0, and remarks on these components.

    The force is None if no component changes or the accelerometers are in counts.
    """
    if not np.isfinite(force_g).all():
        return None, ["accelerometers in counts: the gyros' g-sensitivity is not determined"]
    moves = np.ptp(force_g, axis=0) >= LEAST_FORCE_G
    names = [AXES[k] for k in np.flatnonzero(~moves)]
    if not names:
        return force_g, []
    if len(names) == len(AXES):
        return None, ["the force was constant: its effect is in the zero rates"]
    note = f"the force along {', '.join(names)} did not change: its effect is in the zero rates"
    return np.where(moves, force_g, 0.0), [note]
