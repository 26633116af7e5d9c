"""Scans of one sampler to the open buffers of many clients; lives in the event loop's thread.

A client's queue of scans: bounded, and what does not fit pushes out the oldest, counted.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from adis_gonio.faces.serve.device import ScanFormat
from adis_gonio.faces.serve.sampler import FreshScans


class ScanQueue:
    """Scans (structured arrays) waiting for a client.

    Parameters
    ----------
    capacity : int
        Most scans that are held.

    Attributes
    ----------
    lost : int
        Scans that were pushed out, since the queue began.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._blocks: deque[NDArray[np.void]] = deque()
        self._held = 0
        self.lost = 0

    def __len__(self) -> int:
        return self._held

    def put(self, scans: NDArray[np.void]) -> int:
        """Append scans; return how many old ones were pushed out."""
        self._blocks.append(scans)
        self._held += len(scans)
        pushed = max(0, self._held - self._capacity)
        self._drop(pushed)
        self.lost += pushed
        return pushed

    def take(self, most: int) -> bytes:
        """The oldest scans, up to `most`, as bytes."""
        parts: list[bytes] = []
        left = min(most, self._held)
        self._held -= left
        while left:
            block = self._blocks.popleft()
            parts.append(block[:left].tobytes())
            if len(block) > left:
                self._blocks.appendleft(block[left:])
            left -= min(left, len(block))
        return b"".join(parts)

    def _drop(self, count: int) -> None:
        self._held -= count
        while count:
            block = self._blocks.popleft()
            if len(block) > count:
                self._blocks.appendleft(block[count:])
            count -= min(count, len(block))


QUEUE_S = 30.0
"""Time that a client's queue bridges; all channels at full rate fill it with 0.6 MB."""

CLIENT_BLOCKS = 4
"""Its capacity in buffers of the size that the client opened: what the kernel's own default is."""

MOST_QUEUED = 1 << 18
"""Most scans in a client's queue, whatever it asks for."""


@dataclass(eq=False)
class Buffer:
    """An open buffer of a client.

    Attributes
    ----------
    news : asyncio.Event
        Set when scans came or the sensor failed.
    """

    format: ScanFormat
    queue: ScanQueue
    news: asyncio.Event = field(default_factory=asyncio.Event)


class Hub:
    """Open buffers, and what was lost on the way to them.

    Parameters
    ----------
    want : callable
        Told whether somebody listens.
    queue_s : float
        Least time that a client's queue bridges.

    Attributes
    ----------
    failure : Exception or None
        What ended the sampling; buffers then get no more scans.
    clients : int
        Connections, kept by the server.
    """

    def __init__(self, want: Callable[[bool], object], queue_s: float = QUEUE_S) -> None:
        self.failure: Exception | None = None
        self.clients = 0
        self._want = want
        self._queue_s = queue_s
        self._buffers: set[Buffer] = set()
        self._lost_by_sensor = 0
        self._lost_by_clients = 0

    def open(self, scan_format: ScanFormat, samples: int, rate_hz: float) -> Buffer:
        """Begin to fill a buffer from now on."""
        capacity = min(MOST_QUEUED, max(CLIENT_BLOCKS * samples, round(self._queue_s * rate_hz), 16))
        buffer = Buffer(scan_format, ScanQueue(capacity))
        self._buffers.add(buffer)
        self._want(True)
        return buffer

    def close(self, buffer: Buffer) -> None:
        """Forget a buffer; without any the sensor need not stream."""
        self._buffers.discard(buffer)
        if not self._buffers:
            self._want(False)

    def publish(self, scans: FreshScans) -> None:
        """Append scans to every buffer, in its own format."""
        self._lost_by_sensor += scans.lost
        for buffer in self._buffers:
            packed = buffer.format.pack(scans.numbers, scans.time_ns)
            self._lost_by_clients += buffer.queue.put(packed)
            buffer.news.set()

    def fail(self, error: Exception) -> None:
        """Let all who wait know that nothing will come."""
        self.failure = error
        for buffer in self._buffers:
            buffer.news.set()

    def counts(self) -> Mapping[str, int]:
        """The debug attributes."""
        return {
            "clients": self.clients,
            "scans_lost_by_sensor": self._lost_by_sensor,
            "scans_lost_by_clients": self._lost_by_clients,
        }
