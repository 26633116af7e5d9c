"""Writes to a HID device that cannot hold up the caller.

A write of hidapi knows no time-out: on hidraw the kernel waits 5 s for a device that takes
nothing, on libusb hidapi waits 1 s and then calls it a failure. So writes are done by a thread, and whoever
asked waits for it as long as he likes.
"""

from __future__ import annotations

import contextlib
import time
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Protocol

WRITE_S = 2.5
"""Time for a write: longer than hidapi's own second on libusb, so that there none is left on its way, and
half of the kernel's on hidraw. A board takes a report within 1 ms, but a busy host may be away."""
AT_ONCE_S = 0.5
"""What fails later than this was not taken; a device that is gone fails at once."""
LONGEST_WRITE_S = 6.0
"""Until then the kernel has given a write up."""


class HidDevice(Protocol):
    """What of an open device of package hidapi is used."""

    def write(self, data: bytes, /) -> int:
        """Send a report with a leading report id; a negative number is a failure."""

    def read(self, size: int, timeout_ms: int = 0, /) -> list[int]:
        """A report, or nothing in time; `OSError` once the device is gone."""

    def set_nonblocking(self, on: int, /) -> int:
        """Let reads without a time-out return at once."""

    def close(self) -> None:
        """Give the device back."""


class TimedWrites:
    """A `HidDevice` whose `write` raises `TimeoutError` where the device takes nothing.

    Parameters
    ----------
    device : HidDevice
        Belongs to this one from now on.
    timeout_s : float
        Time for a write, one before it that is still on its way included.
    """

    def __init__(self, device: HidDevice, timeout_s: float = WRITE_S) -> None:
        self._device = device
        self._timeout_s = timeout_s
        self._thread = ThreadPoolExecutor(1, "mcp2210-write")
        self._last: Future[int] | None = None

    def write(self, data: bytes, /) -> int:
        """Send a report with a leading report id; a negative number is a failure."""
        if self._last is not None and not wait([self._last], self._timeout_s).done:
            raise TimeoutError("an earlier report is still on its way")
        self._last = self._thread.submit(self._write, data)
        return self._last.result(self._timeout_s)

    def _write(self, data: bytes) -> int:
        begin_s = time.monotonic()
        sent = self._device.write(data)
        if sent < 0 and time.monotonic() - begin_s > AT_ONCE_S:
            raise TimeoutError("hidapi's own time-out")
        return sent

    def read(self, size: int, timeout_ms: int = 0, /) -> list[int]:
        """A report, or nothing in time; `OSError` once the device is gone."""
        return self._device.read(size, timeout_ms)

    def set_nonblocking(self, on: int, /) -> int:
        """Let reads without a time-out return at once."""
        return self._device.set_nonblocking(on)

    def close(self) -> None:
        """Give the device back; waits for a write, since hidapi frees what the write still uses."""
        self._thread.shutdown(wait=False)
        if self._last is None or wait([self._last], LONGEST_WRITE_S).done:
            self._device.close()
        else:
            self._last.add_done_callback(self._close_late)

    def _close_late(self, _: Future[int]) -> None:
        with contextlib.suppress(OSError, ValueError):
            self._device.close()
