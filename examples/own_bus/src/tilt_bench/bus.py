"""`hexline:HOST:PORT` - a bridge that takes SPI frames as hexadecimal words, a batch a line.

host    C 250000 75.0 160.0\n      clock in Hz, stall and period in us
bridge  OK\n
host    X 3800 0000\n
bridge  = 0000 0402\n              one reply a frame, or: ! what is wrong
"""

from __future__ import annotations

import socket

import numpy as np

from adis_gonio.base.errors import BusTimeoutError, CannotOpenError, ProtocolError, UsageError
from adis_gonio.device.bus import BusUrl, Device, SpiBus, SpiTiming, Words

SAFE = SpiTiming(250e3, 75.0, 160.0)
MOST_FRAMES = 1000
TIMEOUT_S = 30.0


class HexlineBus(SpiBus):
    """The base class checks frames, locks and closes; here is only what the bridge speaks."""

    def __init__(self, line: socket.socket, url: str) -> None:
        super().__init__(SAFE)
        self.url = url
        line.settimeout(TIMEOUT_S)
        self._line = line
        self._file = line.makefile("rw", encoding="ascii", newline="\n")
        self._configure(SAFE)

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        self._ask(f"C {timing.clock_hz!r} {timing.stall_us!r} {timing.period_us!r}")
        return timing

    def _exchange(self, frames: Words) -> Words:
        parts = np.split(frames, range(MOST_FRAMES, len(frames), MOST_FRAMES))
        return np.concatenate([self._batch(part) for part in parts])

    def _batch(self, frames: Words) -> Words:
        words = self._ask("X " + " ".join(f"{int(frame):04X}" for frame in frames)).split()
        if len(words) != len(frames):
            raise ProtocolError(f"{self.url}: {len(words)} replies to {len(frames)} frames")
        try:
            return np.array([int(word, 16) for word in words], np.uint16)
        except (ValueError, OverflowError):
            raise ProtocolError(f"{self.url}: a reply is no 16-bit word: {' '.join(words)[:60]}") from None

    def _ask(self, line: str) -> str:
        try:
            self._file.write(line + "\n")
            self._file.flush()
            answer = self._file.readline()
        except TimeoutError:
            raise BusTimeoutError(f"{self.url}: no answer within {TIMEOUT_S:g} s") from None
        except OSError as error:
            raise ProtocolError(f"{self.url}: {error}") from None
        kind, _, rest = answer.strip().partition(" ")
        if kind == "!":
            raise ProtocolError(f"{self.url}: the bridge says: {rest}")
        if kind not in ("=", "OK"):
            raise ProtocolError(f"{self.url}: not an answer: {answer.strip()[:60]!r}")
        return rest

    def _close(self) -> None:
        self._file.close()
        self._line.close()


def open_from_url(url: BusUrl) -> HexlineBus:
    """Open `hexline:HOST:PORT`."""
    host, colon, port = url.place.rpartition(":")
    if not colon or not port.isdigit() or url.options:
        raise UsageError(f"'{url.text}': write hexline:HOST:PORT, without options")
    try:
        return HexlineBus(socket.create_connection((host, int(port)), TIMEOUT_S), url.text)
    except OSError as error:
        raise CannotOpenError(f"{url.text}: {error.strerror or error}") from None


def find_devices() -> list[Device]:
    """Nothing announces such a bridge; this says how one is opened."""
    return [Device("hexline:HOST:PORT", "hexadecimal SPI bridge over TCP; put its address there")]
