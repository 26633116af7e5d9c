"""The sensor: registers, variants, frames, decoding and the driver, independent of the bridge."""

from adis_gonio.device.sensor.driver import DEFAULT_SCAN, Adis16354, Quantity, open_sensor
from adis_gonio.device.sensor.registers import REGISTERS, VARIANTS, Register, Variant
from adis_gonio.device.sensor.scanning import ScanStream
from adis_gonio.device.sensor.settings import (
    Alarm,
    Configuration,
    Offsets,
    ScanBlock,
    Status,
    decode_numbers,
)

__all__ = [
    "DEFAULT_SCAN", "REGISTERS", "VARIANTS", "Adis16354", "Alarm", "Configuration",
    "Offsets", "Quantity", "Register", "ScanBlock", "ScanStream", "Status", "Variant",
    "decode_numbers", "open_sensor",
]  # fmt: skip
