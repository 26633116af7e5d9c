"""The gyros of a session, calibrated, and put beside the calibration of its accelerometers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adis_gonio.calibration.calibration import Calibration
from adis_gonio.calibration.gyro_building import (
    GyroEstimates,
    estimates_of_gyro_fit,
    estimates_of_gyro_trace,
)
from adis_gonio.calibration.gyros import GyroCalibration
from adis_gonio.errors import AdisGonioError, SessionError
from adis_gonio.model.provenance import provenance_of
from adis_gonio.model.records import Session
from adis_gonio.sensor.registers import ACCEL_OFF, GYRO_OFF
from adis_gonio.sensor.variants import VARIANTS
from adis_gonio.writeback.journal import INTERRUPTED, operations_of


def with_gyros(calibration: Calibration, session: Session, *, traced: bool = False) -> Calibration:
    """The calibration with the session's gyros in it; as it was where these cannot be calibrated.

    Raises
    ------
    SessionError
        As `gyro_calibration_of`.
    """
    try:
        gyro = gyro_calibration_of(session, traced=traced)
    except SessionError:
        raise
    except AdisGonioError:
        return calibration
    return replace(calibration, gyro=gyro)


def gyro_calibration_of(session: Session, *, traced: bool = False) -> GyroCalibration:
    """Calibration of a session's gyros, for the part as it is: with the offsets that were written since.

    Parameters
    ----------
    traced : bool
        By the traced model, with its effects.

    Raises
    ------
    FitError
        The session has no gyros, or does not determine their zero rates.
    SessionError
        A write of gyro offsets was interrupted, so that only the sensor can tell.
    """
    made = gyros_as_recorded(session, traced=traced)
    known = operations_of(session, GYRO_OFF)
    if known and known[-1].open:
        raise SessionError(f"{session.source}: {INTERRUPTED}")
    if known and made.offsets_lsb is not None:
        then = dict(zip(GYRO_OFF, made.offsets_lsb, strict=True))
        made = made.with_offsets([known[-1].target.get(name, then[name]) for name in GYRO_OFF])
    return _force_as_written(made, session)


def gyros_as_recorded(session: Session, *, traced: bool = False) -> GyroCalibration:
    """As `gyro_calibration_of`, for the offsets that stood while the session was recorded."""
    found = gyro_estimates_of(session, traced=traced)
    where = provenance_of(session)
    held = ((session.facts.get("registers") or {}).get("configured")) or {}
    numbers = [held.get(name) for name in GYRO_OFF]
    offsets = tuple(numbers) if all(isinstance(one, int) for one in numbers) else None
    return GyroCalibration.of(
        found.estimates,
        found.covariance,
        method=found.method,
        not_corrected=found.not_corrected,
        temperature_c=where.temperature_c,
        supply_v=where.supply_v,
        offsets_lsb=offsets,
    )


def _force_as_written(gyro: GyroCalibration, session: Session) -> GyroCalibration:
    """Gyros feel what the accelerometers read, which their own offsets move."""
    where = provenance_of(session)
    if where.offsets_lsb is None or where.written_lsb is None or session.sensor not in VARIANTS:
        return gyro
    moved = np.array(where.written_lsb) - np.array(where.offsets_lsb)
    assert len(moved) == len(ACCEL_OFF)
    return gyro.with_force_moved(moved * VARIANTS[session.sensor].accel_mg_per_lsb / 1000)


def gyro_estimates_of(session: Session, *, traced: bool = False) -> GyroEstimates:
    """Parameters of a session's gyros by name.

    Raises
    ------
    DataError, FitError
        The session has no gyros, or none whose unit is known, or no dwell.
    """
    if traced:
        from adis_gonio.tracing.trace import trace

        return estimates_of_gyro_trace(trace(session, part="gyro"))
    from adis_gonio.fitting.gyro import fit_gyro

    return estimates_of_gyro_fit(fit_gyro(session))
