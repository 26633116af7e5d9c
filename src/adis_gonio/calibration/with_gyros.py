"""The gyros of a session, calibrated, and put beside the calibration of its accelerometers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.calibration.calibration import Calibration
from adis_gonio.calibration.gyro_building import (
    GyroEstimates,
    estimates_of_gyro_fit,
    estimates_of_gyro_trace,
)
from adis_gonio.calibration.gyros import GyroCalibration
from adis_gonio.errors import AdisGonioError, SessionError
from adis_gonio.model.provenance import Provenance, provenance_of
from adis_gonio.model.records import Session
from adis_gonio.sensor.variants import VARIANTS
from adis_gonio.writeback.journal import INTERRUPTED

if TYPE_CHECKING:
    from adis_gonio.fitting.gyro import GyroFit
    from adis_gonio.tracing.outcome.result import TraceResult


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


def gyros_alone(session: Session) -> str:
    """What to do where a session calibrates its gyros and not its accelerometers; else nothing."""
    try:
        gyro_calibration_of(session)
    except AdisGonioError:
        return ""
    return (
        "; its gyros are calibrated: put them beside the accelerometers of another session of the part, "
        f"export OTHER --gyros {PurePath(session.source).name} -o both.json"
    )


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
    return _as_written(gyros_as_recorded(session, traced=traced), provenance_of(session))


def gyros_as_recorded(session: Session, *, traced: bool = False) -> GyroCalibration:
    """As `gyro_calibration_of`, for the offsets that stood while the session was recorded."""
    return _made(gyro_estimates_of(session, traced=traced), provenance_of(session))


def calibration_of_gyro_fit(result: GyroFit) -> GyroCalibration:
    """Calibration by a fit of the gyros, for the part as it is.

    Raises
    ------
    FitError
        A zero rate is not determined.
    SessionError
        As `gyro_calibration_of`.
    """
    return _of_result(estimates_of_gyro_fit(result), result.provenance)


def calibration_of_gyro_trace(result: TraceResult) -> GyroCalibration:
    """Calibration by the final model of a trace of the gyros, for the part as it is.

    Raises
    ------
    FitError
        The trace was not finished, or a zero rate is not determined.
    SessionError
        As `gyro_calibration_of`.
    """
    return _of_result(estimates_of_gyro_trace(result), result.provenance)


def _of_result(found: GyroEstimates, where: Provenance | None) -> GyroCalibration:
    made = _made(found, where)
    return made if where is None else _as_written(made, where)


def _made(found: GyroEstimates, where: Provenance | None) -> GyroCalibration:
    about: dict[str, Any] = {}
    if where is not None:
        about = {
            "temperature_c": where.temperature_c,
            "supply_v": where.supply_v,
            "offsets_lsb": where.gyro_offsets_lsb,
            "source": where.source,
        }
    return GyroCalibration.of(
        found.estimates,
        found.covariance,
        method=found.method,
        not_corrected=found.not_corrected,
        **about,
    )


def _as_written(gyro: GyroCalibration, where: Provenance) -> GyroCalibration:
    """For the part as it is: what was written since is corrected by the chip, and moves the force."""
    if where.gyro_write_open:
        raise SessionError(f"{where.source}: {INTERRUPTED}")
    if where.gyro_written_lsb is not None:
        gyro = gyro.with_offsets(where.gyro_written_lsb)
    if where.offsets_lsb is None or where.written_lsb is None or where.sensor not in VARIANTS:
        return gyro
    moved = np.array(where.written_lsb) - np.array(where.offsets_lsb)
    return gyro.with_force_moved(moved * VARIANTS[where.sensor].accel_mg_per_lsb / 1000)


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
