"""The parts of a sensor that fit and trace know, and where their readings come from: one table."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

from adis_gonio.base.errors import UsageError
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.model.records import Session

ACCELEROMETER, GYRO = "accelerometer", "gyro"
_READERS = {
    ACCELEROMETER: ("adis_gonio.fitting.estimation.readings", "readings_of"),
    GYRO: ("adis_gonio.fitting.gyros.gyro_readings", "gyro_readings_of"),
}
PARTS: tuple[str, ...] = tuple(_READERS)


def known_part(part: str) -> str:
    """The part itself; `UsageError` where there is no such part."""
    if part not in _READERS:
        raise UsageError(f"a sensor has no part '{part}'; it has {', '.join(PARTS)}")
    return part


def readings_of_part(session: Session, part: str) -> Readings:
    """Readings of a part of the sensor, as `readings_of` gives those of the accelerometers."""
    module, name = _READERS[known_part(part)]
    reader: Callable[[Session], Readings] = getattr(import_module(module), name)
    return reader(session)
