"""Seeded faults between a host and a device: what a cable, a hub or a firmware may do.

`Faults` decides, `FaultyStream` applies them to the bytes of a serial line; a model of USB packets asks
`Faults` for each. What may happen to SPI frames themselves stands in `adis_gonio.sim.testing.faulty_bus`.

Rates are probabilities: of `drop`, `duplicate`, `flip`, `delay` and `chunk` a byte of a stream or a packet
of USB, of `hang`, `busy`, `progress` (the device says that it is at work), `stuck`, `short` and `unplug` a
packet. A serial line knows `drop`, `duplicate`, `flip`, `delay`, `chunk` and `hang`.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Faults:
    """Rates and the dice; everything that happened is counted in `seen`."""

    seed: int = 0
    drop: float = 0.0
    duplicate: float = 0.0
    flip: float = 0.0
    delay: float = 0.0
    chunk: float = 0.0
    hang: float = 0.0
    unplug: float = 0.0
    busy: float = 0.0
    progress: float = 0.0
    stuck: float = 0.0
    short: float = 0.0
    delay_s: float = 0.05
    hang_s: float = 0.6
    seen: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.dice = random.Random(self.seed)
        self.hung_until_s = -math.inf

    def happens(self, kind: str) -> bool:
        """Throw the dice for a kind of fault."""
        rate = getattr(self, kind)
        if rate and self.dice.random() < rate:
            self.seen[kind] += 1
            return True
        return False

    def hangs(self, now_s: float) -> bool:
        """True while the device does not react; may begin now."""
        if now_s >= self.hung_until_s and self.happens("hang"):
            self.hung_until_s = now_s + self.hang_s
        return now_s < self.hung_until_s

    def flipped(self, data: bytes, first: int, last: int) -> bytes:
        """Bytes with one bit turned in some of those from first to last (exclusive)."""
        out = bytearray(data)
        for k in range(first, min(last, len(out))):
            if self.happens("flip"):
                out[k] ^= 1 << self.dice.randrange(8)
        return bytes(out)

    def delayed_s(self) -> float:
        """Extra time that something takes."""
        return self.delay_s * self.dice.random() * 2 if self.happens("delay") else 0.0

    @property
    def total(self) -> int:
        """Faults so far."""
        return sum(self.seen.values())


class FaultyStream:
    """Bytes on their way, each with its time of arrival; order is kept."""

    def __init__(self, faults: Faults, byte_s: float = 0.0) -> None:
        self.faults = faults
        self._byte_s = byte_s
        self._queue: list[tuple[float, int]] = []
        self._at = 0
        self._last_s = -math.inf

    def put(self, data: bytes, now_s: float) -> None:
        """Bytes enter."""
        faults = self.faults
        for byte in data:
            if faults.happens("drop"):
                continue
            if faults.happens("flip"):
                byte ^= 1 << faults.dice.randrange(8)
            # A chunk is a pause inside a packet, as a hub or a driver makes it; a delay may be long.
            extra = faults.delayed_s() + (0.002 if faults.happens("chunk") else 0.0)
            self._last_s = max(self._last_s, now_s) + self._byte_s + extra
            for _ in range(2 if faults.happens("duplicate") else 1):
                self._queue.append((self._last_s, byte))

    def next_s(self) -> float | None:
        """Time at which the next byte arrives; None where none is on its way."""
        return self._queue[self._at][0] if self._at < len(self._queue) else None

    def take(self, now_s: float, size: int) -> bytes:
        """Up to `size` bytes that have arrived."""
        end = self._at
        while end < len(self._queue) and end - self._at < size and self._queue[end][0] <= now_s:
            end += 1
        data = bytes(byte for _, byte in self._queue[self._at : end])
        self._at = end
        if self._at > 4096:
            del self._queue[: self._at]
            self._at = 0
        return data

    def waiting(self, now_s: float) -> int:
        """Bytes that have arrived and were not taken."""
        count = 0
        for k in range(self._at, len(self._queue)):
            if self._queue[k][0] > now_s:
                break
            count += 1
        return count

    def clear(self) -> None:
        """Throw away what is on its way."""
        self._queue.clear()
        self._at = 0
