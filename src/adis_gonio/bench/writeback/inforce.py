"""Which offsets are in force after a session's write-back, and what bias they leave for coefficients.

What the chip corrects must not be corrected again: coefficients for the sensor as it is now take
`bias_left_mg`, not the bias that the fit found.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import SessionError
from adis_gonio.bench.writeback.plan import BIASES, recorded_offsets
from adis_gonio.device.sensor.registers import ACCEL_OFF, GYRO_OFF, Kind
from adis_gonio.device.sensor.variants import variant
from adis_gonio.model.records import Session
from adis_gonio.record.write_journal import INTERRUPTED, operations_of

if TYPE_CHECKING:
    from adis_gonio.fitting import FitResult


def offsets_recorded(session: Session) -> Floats:
    """Offsets (3,) in mg that the part added to its outputs while a session was recorded.

    Raises
    ------
    SessionError
        The session does not hold the registers (a CSV, a generic sensor).
    """
    return _in_mg(session, recorded_offsets(session))


def offsets_in_force(session: Session) -> Floats:
    """Offsets (3,) in mg that the part adds since the last write-back of a session, as its archive knows.

    The recorded ones where nothing was written. Offsets that were written and not saved are in force until
    the part's power is off.

    Raises
    ------
    SessionError
        As `offsets_recorded`; or a write was interrupted, so that only the sensor can tell.
    """
    known = operations_of(session)
    if known and known[-1].open:
        raise SessionError(f"{session.source}: {INTERRUPTED}")
    return _in_mg(session, recorded_offsets(session) | (known[-1].target if known else {}))


def bias_left_mg(session: Session, result: FitResult) -> dict[str, float]:
    """Biases in mg by name (`bias_x` …) of the sensor as it is now: the fit's, less what was written since.

    The fit's own where the session does not know its registers: nothing can have been written then.

    Raises
    ------
    SessionError
        A write was interrupted (see `offsets_in_force`).
    """
    found = {name: result[name].value for name in BIASES if name in result}
    if not operations_of(session):
        return found
    moved = offsets_in_force(session) - offsets_recorded(session)
    return {name: value + float(moved[BIASES.index(name)]) for name, value in found.items()}


def gyro_offsets_recorded(session: Session) -> Floats:
    """Offsets (3,) in °/s that the part added to its gyros while a session was recorded.

    Raises
    ------
    SessionError
        As `offsets_recorded`.
    """
    return _in_dps(session, recorded_offsets(session, GYRO_OFF))


def gyro_offsets_in_force(session: Session) -> Floats:
    """Offsets (3,) in °/s that the part adds to its gyros since the last write-back of a session.

    Raises
    ------
    SessionError
        As `offsets_in_force`.
    """
    known = operations_of(session, GYRO_OFF)
    if known and known[-1].open:
        raise SessionError(f"{session.source}: {INTERRUPTED}")
    return _in_dps(session, recorded_offsets(session, GYRO_OFF) | (known[-1].target if known else {}))


def _in_dps(session: Session, numbers: Mapping[str, int]) -> Floats:
    lsb = variant(session.sensor).lsb(Kind.GYRO_OFFSET)[0]
    return lsb * np.array([numbers[name] for name in GYRO_OFF], dtype=np.float64)


def _in_mg(session: Session, numbers: Mapping[str, int]) -> Floats:
    lsb = variant(session.sensor).accel_mg_per_lsb
    return lsb * np.array([numbers[name] for name in ACCEL_OFF], dtype=np.float64)
