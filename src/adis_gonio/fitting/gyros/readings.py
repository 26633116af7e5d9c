"""Readings of the gyros: rate intervals as fit and trace take them.

A reading is the mean rate of an interval in °/s. Its covariance is that of the interval (noise,
quantization, lost scans), that of the true rotation by its reference, and 1/f noise: what each interval has
of its own, and the modes that intervals share (`Readings.slow`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import current
from adis_gonio.base.errors import UsageError
from adis_gonio.fitting.estimation.readings import Readings, Unit
from adis_gonio.fitting.gyros.intervals import RateIntervals, rate_intervals
from adis_gonio.model.effects import AXES, Conditions
from adis_gonio.model.measurement import MeanRate
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import provenance_of

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration

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
    kept: Readings | None = vars(session).get("_gyro_readings")  # the session is frozen: it cannot go stale
    if kept is None:
        current().tell("noise of the gyros")
        kept = readings_of_intervals(rate_intervals(session), session.sensor, session.gravity_mg)
        vars(session)["_gyro_readings"] = kept
    return kept


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
