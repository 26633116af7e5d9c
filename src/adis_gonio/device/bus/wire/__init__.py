"""The wire protocol of the project's firmware: packets of header, body and CRC-32 in COBS.

The package converts packets to bytes and bytes to packets (firmware_proto/PROTOCOL.md), without input or
output. Invalid bytes never raise an error in the receiver.
"""

from __future__ import annotations

import functools
import zlib
from collections import Counter
from dataclasses import dataclass
from typing import Any

from adis_gonio.base.errors import NotInstalledError, install_extra
from adis_gonio.device.bus.wire.body import Body
from adis_gonio.device.bus.wire.protocol import CRC_SIZE, HEADER_SIZE, MAX_RAW, PacketType

_DELIMITER = b"\0"
_LONGEST = MAX_RAW + 1
_KINDS = frozenset(int(kind) for kind in PacketType)


@dataclass(frozen=True)
class Packet:
    """A valid packet: its type, the id (u16) of its request, and its body."""

    type: int
    id: int
    body: bytes = b""

    @classmethod
    def of(cls, body: Body, request_id: int) -> Packet:
        """Create the packet that carries a body, with the id of its request."""
        return cls(body.TYPE, request_id, body.pack())


@functools.cache
def load_cobs() -> Any:
    """Import package cobs and return its module.

    Raises
    ------
    NotInstalledError
        Package cobs is not installed.
    """
    try:
        from cobs import cobs
    except ImportError:
        raise NotInstalledError(f"serial: cobs is not installed: {install_extra('serial')}") from None
    return cobs


def encode(packet: Packet) -> bytes:
    """Encode a packet as bytes for the line, with a delimiter before and after it.

    The first delimiter ends any invalid bytes that the other side has collected.

    Raises
    ------
    ValueError
        The packet is longer than the protocol allows, or its type or id is out of range.
    """
    if not (0 <= packet.type <= 0xFF and 0 <= packet.id <= 0xFFFF):
        raise ValueError(f"type {packet.type} or id {packet.id} does not fit a packet's header")
    raw = bytes((packet.type,)) + packet.id.to_bytes(2, "little") + packet.body
    if len(raw) + CRC_SIZE > MAX_RAW:
        raise ValueError(f"a packet of {len(raw) + CRC_SIZE} bytes: at most {MAX_RAW}")
    raw += zlib.crc32(raw).to_bytes(CRC_SIZE, "little")
    stuffed: bytes = load_cobs().encode(raw)
    return _DELIMITER + stuffed + _DELIMITER


class Receiver:
    """Extracts valid packets from a stream of bytes and counts the invalid ones.

    Attributes
    ----------
    bad : Counter
        Number of discarded packets by reason: a wrong checksum (`crc`), a broken frame (`cobs`), a wrong
        length (`length`), or an unknown type (`type`).
    """

    def __init__(self) -> None:
        self.bad: Counter[str] = Counter()
        self._cobs = load_cobs()
        self._rest = b""

    def feed(self, data: bytes) -> list[Packet]:
        """Return the packets that these bytes complete; invalid bytes never raise an error."""
        parts = (self._rest + data).split(_DELIMITER)
        # One byte too many marks a part as too long; endless invalid bytes must not fill the memory.
        self._rest = parts.pop()[: _LONGEST + 1]
        return [packet for part in parts if (packet := self._take(part)) is not None]

    def _take(self, part: bytes) -> Packet | None:
        if len(part) > _LONGEST:
            self.bad["length"] += 1
            return None
        if not part:
            return None
        try:
            raw: bytes = self._cobs.decode(part)
        except self._cobs.DecodeError:
            self.bad["cobs"] += 1
            return None
        if len(raw) < HEADER_SIZE + CRC_SIZE:
            self.bad["length"] += 1
        elif zlib.crc32(raw[:-CRC_SIZE]) != int.from_bytes(raw[-CRC_SIZE:], "little"):
            self.bad["crc"] += 1
        elif raw[0] not in _KINDS:
            self.bad["type"] += 1
        else:
            return Packet(raw[0], int.from_bytes(raw[1:HEADER_SIZE], "little"), raw[HEADER_SIZE:-CRC_SIZE])
        return None


__all__ = ["Body", "Packet", "Receiver", "encode", "load_cobs"]
