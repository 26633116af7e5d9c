"""Consistent overhead byte stuffing (Cheshire and Baker 1999): no 0x00 within a packet."""

from __future__ import annotations

_RUN = 254


def encode(data: bytes) -> bytes:
    """Bytes without any 0x00; one longer than `data` for each 254 bytes begun."""
    out = bytearray()
    parts = data.split(b"\0")
    last = len(parts) - 1
    for k, part in enumerate(parts):
        while len(part) >= _RUN:
            out.append(0xFF)
            out += part[:_RUN]
            part = part[_RUN:]
            if not part and k == last:
                return bytes(out)
        out.append(len(part) + 1)
        out += part
    return bytes(out)


def decode(data: bytes) -> bytes | None:
    """Undo `encode`; None where `data` is no such encoding."""
    out = bytearray()
    at, end = 0, len(data)
    while at < end:
        code = data[at]
        stop = at + code
        if code == 0 or stop > end:
            return None
        out += data[at + 1 : stop]
        at = stop
        if code <= _RUN and at < end:
            out.append(0)
    return None if 0 in data else bytes(out)
