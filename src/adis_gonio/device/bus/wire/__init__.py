"""The wire protocol of the project's own firmware: constants, bodies, packets; no input or output."""

from adis_gonio.device.bus.wire.body import Body
from adis_gonio.device.bus.wire.packets import Packet, Receiver, ReceiverCounts, crc32, encode, load_cobs

__all__ = ["Body", "Packet", "Receiver", "ReceiverCounts", "crc32", "encode", "load_cobs"]
