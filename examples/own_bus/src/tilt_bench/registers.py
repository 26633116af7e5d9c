"""Host code that shares nothing with adis-gonio: one register of a board, by the firmware's wire protocol.

Written from firmware_proto/PROTOCOL.md with the standard library alone; yours may be in C, Rust or LabVIEW.
"""

from __future__ import annotations

import os
import select
import struct
import zlib

HELLO, EXCHANGE, REPLY, ERROR = 0x01, 0x03, 0x80, 0xFF
VERSION = 1


class Board:
    """A board at a serial port such as /dev/ttyACM0, which is already set to raw bytes."""

    def __init__(self, path: str, timeout_s: float = 30.0) -> None:
        self._line = os.open(path, os.O_RDWR | os.O_NOCTTY)
        self._timeout_s = timeout_s
        self._id = 0
        try:
            self._ask(HELLO, struct.pack("<BI", VERSION, 12345))
        except OSError:
            self.close()
            raise

    def read_register(self, address: int) -> int:
        """Word of a register: the reply to a read comes with the next frame."""
        words = self._ask(EXCHANGE, struct.pack("<BHH", 0, address << 8, 0))
        return int(struct.unpack("<HH", words)[1])

    def close(self) -> None:
        os.close(self._line)

    def _ask(self, kind: int, body: bytes) -> bytes:
        self._id += 1
        raw = struct.pack("<BH", kind, self._id) + body
        os.write(self._line, _stuffed(raw + struct.pack("<I", zlib.crc32(raw))) + b"\0")
        data = b""
        while not data.endswith(b"\0"):
            if not select.select([self._line], [], [], self._timeout_s)[0]:
                raise TimeoutError("the board does not answer")
            data += os.read(self._line, 4096)
        reply = _unstuffed(data[:-1])
        if zlib.crc32(reply[:-4]) != struct.unpack("<I", reply[-4:])[0]:
            raise OSError("the reply's checksum is wrong")
        if reply[0] == ERROR:
            raise OSError(f"the board refused: code {reply[4]}")
        return reply[3:-4]


def _stuffed(raw: bytes) -> bytes:
    """COBS of a packet below 254 bytes."""
    return b"".join(bytes([len(part) + 1]) + part for part in raw.split(b"\0"))


def _unstuffed(data: bytes) -> bytes:
    parts, at = [], 0
    while at < len(data):
        parts.append(data[at + 1 : at + data[at]])
        at += data[at]
    return b"\0".join(parts)
