"""The least that a board can do: give back what it was sent. They prove the rig, not the product."""

from __future__ import annotations

from collections.abc import Callable

from fakes.cp2130_device import StallError


class EchoBulk:
    """Gives a bulk transfer back; control request 0x31 reads what 0x30 wrote."""

    def __init__(self) -> None:
        self._kept = b""
        self._sent: list[bytes] = []

    def control_in(self, request: int, value: int, index: int, length: int) -> bytes:
        """What was kept."""
        if request != 0x31:
            raise StallError(request)
        return self._kept

    def control_out(self, request: int, value: int, index: int, data: bytes) -> None:
        """Keep it."""
        if request != 0x30:
            raise StallError(request)
        self._kept = data

    def bulk_out(self, data: bytes) -> None:
        """Keep it too."""
        self._sent.append(data)

    def bulk_in(self) -> bytes | None:
        """The same transfer."""
        return self._sent.pop(0) if self._sent else None

    def usb_reset(self) -> None:
        """Nothing to forget."""


class EchoSerial:
    """Gives bytes back."""

    def connect(self, send: Callable[[bytes], None]) -> None:
        """Where to."""
        self._send = send

    def receive(self, data: bytes) -> None:
        """The same bytes."""
        self._send(data)

    def close(self) -> None:
        """Nothing runs."""
