"""The sensor: registers, variants, frames, decoding and the driver, independent of the bridge."""

from adis_gonio.device.sensor.driver import DEFAULT_SCAN, Adis16354, open_sensor
from adis_gonio.device.sensor.registers import REGISTERS, VARIANTS, Register
from adis_gonio.device.sensor.settings import Alarm, ScanBlock

__all__ = [
    "DEFAULT_SCAN", "REGISTERS", "VARIANTS", "Adis16354", "Alarm", "Register", "ScanBlock", "open_sensor",
]  # fmt: skip
