"""adis-gonio: driver and calibration tool for the ADIS16354 inertial sensor in a goniometer.

The names here are the public Python interface; they are imported when first used, so that
`import adis_gonio` and `adis-gonio --help` stay quick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from adis_gonio.base import __version__

_HOMES = {
    "open_bus": "adis_gonio.device.bus",
    "open_sensor": "adis_gonio.device.sensor",
    "Adis16354": "adis_gonio.device.sensor",
    "load_session": "adis_gonio.record",
    "Session": "adis_gonio.model",
    "Dwell": "adis_gonio.model",
    "fit": "adis_gonio.faces.api",
    "FitResult": "adis_gonio.fitting",
    "trace": "adis_gonio.faces.api",
    "TraceResult": "adis_gonio.tracing.trace_result",
    "Calibration": "adis_gonio.tracing.trace_calibrations",
    "GyroCalibration": "adis_gonio.tracing.trace_calibrations",
    "AdisGonioError": "adis_gonio.base.errors",
}

__all__ = ["__version__", *sorted(_HOMES)]  # noqa: PLE0604 (all are strings)

if TYPE_CHECKING:
    from adis_gonio.base.errors import AdisGonioError as AdisGonioError
    from adis_gonio.calibrate import Calibration as Calibration
    from adis_gonio.calibrate import GyroCalibration as GyroCalibration
    from adis_gonio.device.bus import open_bus as open_bus
    from adis_gonio.device.sensor import Adis16354 as Adis16354
    from adis_gonio.device.sensor import open_sensor as open_sensor
    from adis_gonio.faces.api import fit as fit
    from adis_gonio.faces.api import trace as trace
    from adis_gonio.fitting import FitResult as FitResult
    from adis_gonio.model import Dwell as Dwell
    from adis_gonio.model import Session as Session
    from adis_gonio.record.loading import load_session as load_session
    from adis_gonio.tracing.trace_result import TraceResult as TraceResult


def __dir__() -> list[str]:
    """Public names, also those that were not imported yet."""
    return sorted(__all__)


def __getattr__(name: str) -> Any:
    """Import a public name from its home when it is first asked for (PEP 562)."""
    if name in _HOMES:
        import importlib

        value = getattr(importlib.import_module(_HOMES[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'adis_gonio' has no attribute '{name}'")
