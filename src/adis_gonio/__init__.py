"""adis-gonio: driver and calibration tool for the ADIS16354 inertial sensor in a goniometer.

The names here are the public Python interface; they are imported when first used, so that
`import adis_gonio` and `adis-gonio --help` stay quick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import __version__, lazily

_HOMES = {
    "base.errors": "AdisGonioError",
    "device.bus": "open_bus",
    "device.sensor": "Adis16354 open_sensor",
    "faces.api": "fit trace",
    "fitting": "FitResult",
    "model": "Dwell Session",
    "record": "load_session",
    "tracing.trace_calibrations": "Calibration GyroCalibration",
    "tracing.trace_result": "TraceResult",
}

__all__ = ["__version__"]

if TYPE_CHECKING:
    from adis_gonio.base.errors import AdisGonioError as AdisGonioError
    from adis_gonio.calibrate import Calibration as Calibration, GyroCalibration as GyroCalibration
    from adis_gonio.device.bus import open_bus as open_bus
    from adis_gonio.device.sensor import Adis16354 as Adis16354, open_sensor as open_sensor
    from adis_gonio.faces.api import fit as fit, trace as trace
    from adis_gonio.fitting.fit_result import FitResult as FitResult
    from adis_gonio.model import Dwell as Dwell, Session as Session
    from adis_gonio.record.loading import load_session as load_session
    from adis_gonio.tracing.trace_result import TraceResult as TraceResult


__getattr__ = lazily(__name__, _HOMES)


def __dir__() -> list[str]:
    """Public names, also names that were not imported yet."""
    return sorted(globals()["__all__"])
