"""A stand-in for hidapi's module, with MCP2210 boards behind it."""

from __future__ import annotations

from collections import deque

from adis_gonio.sim.testing.faults import Faults
from fakes.mcp2210_device import (
    BUSY,
    FINISHED,
    PRODUCT_ID,
    REPORT,
    VENDOR_ID,
    Mcp2210Device,
)

TRANSFER = 0x42
HEADER = 4
"""Bytes of an answer that carry its meaning; what follows is guarded by USB's CRC alone."""


def flipped(faults: Faults, answer: bytes) -> bytes:
    """The answer with those bits of its header flipped that the faults draw."""
    out = bytearray(answer)
    for k in range(min(HEADER, len(out))):
        if faults.happens("flip"):
            out[k] ^= 1 << faults.dice.randrange(8)
    return bytes(out)


class HidBoard:
    """A board at a port.

    Attributes
    ----------
    plugged, permitted, taken : bool
        State of the port, the rights and of another program.
    latency_s : float
        Time that a report takes each way; USB needs 1 ms, less is more demanding.
    """

    def __init__(
        self,
        device: Mcp2210Device,
        *,
        path: str = "1-1:1.0",
        faults: Faults | None = None,
        latency_s: float = 0.5e-3,
    ) -> None:
        self.device = device
        self.path = path
        self.faults = faults or Faults()
        self.latency_s = latency_s
        self.plugged = True
        self.permitted = True
        self.taken = False
        self.sent: list[bytes] = []
        self.answers: deque[tuple[float, bytes]] = deque()

    @property
    def clock(self):
        return self.device.pins.clock

    def write(self, report: bytes) -> bool:
        """A report goes out; False where nobody is there."""
        faults, clock = self.faults, self.clock
        if faults.happens("unplug"):
            self.plugged = False
        if not self.plugged:
            return False
        clock.advance_to(clock.now_s() + self.latency_s)
        self.sent.append(report)
        if faults.happens("drop"):
            return True
        if faults.happens("stuck"):
            self.device.stuck = True
        if faults.happens("busy"):
            self.device.busy = 1
        if faults.happens("progress"):
            self.device.busy_polls = faults.dice.randrange(1, 4)
        if faults.happens("short"):
            self.device.short = True
        hung = faults.hangs(clock.now_s())
        answer = flipped(faults, self.device.report(report))
        if faults.happens("drop"):
            return True
        arrival = max(clock.now_s() + self.latency_s, self.answers[-1][0] if self.answers else 0.0)
        arrival += faults.delayed_s() + (faults.hung_until_s - clock.now_s() if hung else 0.0)
        for _ in range(2 if faults.happens("duplicate") else 1):
            self.answers.append((arrival, answer))
        return True

    def read(self, timeout_s: float) -> bytes:
        """Next answer that arrives in time."""
        clock = self.clock
        if self.plugged and self.faults.happens("unplug"):
            self.plugged = False
        if not self.plugged:
            raise OSError("read error")
        now = clock.now_s()
        if self.answers and self.answers[0][0] <= now + timeout_s:
            arrival, answer = self.answers.popleft()
            clock.advance_to(arrival)
            return answer
        clock.advance_to(now + timeout_s)
        return b""

    def replug(self) -> None:
        """Out and in again."""
        self.plugged = True
        self.answers.clear()
        self.device.usb_reset()


class HidHandle:
    """What `hid.device()` gives."""

    def __init__(self, module: FakeHid) -> None:
        self._module = module
        self._board: HidBoard | None = None
        self._nonblocking = False

    def open_path(self, path: bytes) -> None:
        board = self._module.boards.get(path.decode())
        if board is None or not (board.plugged and board.permitted) or board.taken:
            raise OSError("open failed")
        board.taken = True
        board.answers.clear()
        self._board = board

    def _need(self) -> HidBoard:
        if self._board is None:
            raise ValueError("not open")
        return self._board

    def set_nonblocking(self, on: int, /) -> int:
        self._nonblocking = bool(on)
        return 0

    def write(self, data: bytes, /) -> int:
        board = self._need()
        assert len(data) == REPORT + 1, "a report id and 64 bytes"
        assert data[0] == 0
        return len(data) if board.write(bytes(data[1:])) else -1

    def read(self, size: int, timeout_ms: int = 0, /) -> list[int]:
        board = self._need()
        assert timeout_ms or self._nonblocking, "a read that may block for ever"
        return list(board.read(timeout_ms / 1000)[:size])

    def close(self) -> None:
        if self._board is not None:
            self._board.taken = False
            self._board = None


class FakeHid:
    """The module."""

    def __init__(self, *boards: HidBoard) -> None:
        self.boards = {board.path: board for board in boards}

    def device(self) -> HidHandle:
        return HidHandle(self)

    def enumerate(self, vendor_id: int = 0, product_id: int = 0) -> list[dict]:
        assert (vendor_id, product_id) == (VENDOR_ID, PRODUCT_ID)
        return [
            {
                "path": board.path.encode(),
                "vendor_id": VENDOR_ID,
                "product_id": PRODUCT_ID,
                "serial_number": board.device.serial if board.permitted else "",
                "product_string": "MCP2210 USB-to-SPI Master",
            }
            for board in self.boards.values()
            if board.plugged
        ]


__all__ = ["BUSY", "FINISHED", "FakeHid", "HidBoard", "HidHandle"]
