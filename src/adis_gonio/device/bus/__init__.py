"""Buses that carry 16-bit frames: the contract, its errors, opening by URL."""

from adis_gonio.device.bus.contract import Capability, FrameBlock, FrameStream, SpiBus, SpiTiming, Words
from adis_gonio.device.bus.opening import BusUrl, Device, bus_schemes, find_devices, open_bus

__all__ = [
    "BusUrl", "Capability", "Device", "FrameBlock", "FrameStream", "SpiBus", "SpiTiming", "Words",
    "bus_schemes", "find_devices", "open_bus",
]  # fmt: skip
