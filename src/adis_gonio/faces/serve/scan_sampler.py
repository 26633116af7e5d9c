"""One thread reads the sensor, and a hub distributes its scans to the open buffers of many clients.

The thread streams while a client listens, and runs jobs in between. A bus that streams takes no other
exchange, so a job ends the stream, runs, and the stream begins again. `state` and `newest` therefore keep
the values of the attributes, so that reading them needs no job during a stream.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.device.sensor import Adis16354, ScanBlock
from adis_gonio.device.sensor.registers import ACCEL_OFF, GYRO_OFF, registers
from adis_gonio.faces.serve.iio_device import ScanFormat, SensorState

T = TypeVar("T")
_Job = tuple[Callable[[Adis16354], Any], "Future[Any]", bool]

BLOCK_S = 0.04
"""Length of a block of scans, the longest delay of a scan in addition to the delay of the bus."""

MOST_BLOCK = 256


@dataclass(frozen=True)
class FreshScans:
    """New scans for the clients.

    Attributes
    ----------
    numbers : (n, k) int32
    time_ns : (n,) int64
        Time since 1970, by the host's clock at the begin of the stream and by the bus's clock after it.
    lost : int
        Updates of the sensor that were missed before and between these scans.
    """

    numbers: NDArray[np.int32]
    time_ns: NDArray[np.int64]
    lost: int


class Sampler:
    """Thread that alone uses the sensor while it is served: streams scans and runs jobs.

    Parameters
    ----------
    sensor : Adis16354
        Open; stays open afterwards.
    names : sequence of str
        Output registers of a scan.
    on_scans, on_failure : callable
        Called from the thread of the sampler, which ends after a failure.

    Attributes
    ----------
    state : SensorState
        Values from the registers.
    newest : mapping of str to int, or None
        Numbers of the newest scan during a stream.
    """

    def __init__(
        self,
        sensor: Adis16354,
        names: Sequence[str],
        on_scans: Callable[[FreshScans], object],
        on_failure: Callable[[Exception], object],
    ) -> None:
        self.names = tuple(names)
        self.newest: dict[str, int] | None = None
        self._sensor = sensor
        self._simulated = getattr(sensor.bus, "world", None) is not None
        self._on_scans = on_scans
        self._on_failure = on_failure
        self._jobs: queue.SimpleQueue[_Job] = queue.SimpleQueue()
        self._wake = threading.Event()
        self._stopping = False
        self._wanted = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="sampler", daemon=True)
        self.state = state_of(sensor)

    def start(self) -> None:
        """Start the thread that owns the sensor."""
        self._thread.start()

    def stop(self) -> None:
        """End the stream, which restores the register that it changed, and end the thread."""
        self._stopping = True
        self._wake.set()
        self._thread.join()

    def want(self, wanted: bool) -> None:
        """Start or end streaming: `wanted` is True if at least one client needs scans."""
        if wanted != self._wanted:
            self._wanted = wanted
            self._wake.set()

    def submit(self, job: Callable[[Adis16354], T], *, changes: bool = False) -> Future[T]:
        """Queue a job that uses the sensor; the thread runs it between two scans.

        Parameters
        ----------
        changes : bool
            True if the job writes registers, so that `state` has to be read again.
        """
        future: Future[T] = Future()
        if self._failure is not None or self._stopping:
            future.set_exception(self._failure or AdisGonioError("the server ends"))
            return future
        self._jobs.put((job, future, changes))
        self._wake.set()
        return future

    # -- inside the thread --------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._wake.clear()
                self._run_jobs()
                if self._wanted and not self._stopping:
                    self._stream()
                else:
                    self._wake.wait()
        except Exception as error:  # of any kind, because no client may wait for scans that will not come
            self._failure = error
            self._on_failure(error)
        finally:
            self.newest = None
            self._refuse_jobs()

    def _run_jobs(self) -> None:
        while not self._jobs.empty():
            job, future, changes = self._jobs.get()
            if not future.set_running_or_notify_cancel():
                continue
            try:
                answer = partial(future.set_result, job(self._sensor))
            except Exception as error:
                answer = partial(future.set_exception, error)
            if changes:  # a failed job may have changed some registers
                with contextlib.suppress(AdisGonioError):
                    self.state = state_of(self._sensor)
            answer()

    def _refuse_jobs(self) -> None:
        while not self._jobs.empty():
            _, future, _ = self._jobs.get()
            if future.set_running_or_notify_cancel():
                future.set_exception(self._failure or AdisGonioError("the server ends"))

    def _stream(self) -> None:
        sensor = self._sensor
        rate_hz = self.state.configuration.sample_rate_hz
        block_scans = min(MOST_BLOCK, max(1, round(BLOCK_S * rate_hz)))
        wall_s = time.monotonic()
        bus_s = sensor.bus.now_s()
        since_1970_ns = time.time_ns() - round(bus_s * 1e9)
        try:
            with sensor.stream(self.names, block_scans=block_scans) as stream:
                for block in stream:
                    if self._simulated:  # its clock may run ahead, but clients expect the rate
                        self._wait_until(wall_s + float(block.time_s[-1]) - bus_s)
                    self._publish(block, since_1970_ns)
                    if self._interrupted:
                        break
        finally:
            self.newest = None

    @property
    def _interrupted(self) -> bool:
        return self._stopping or not self._wanted or not self._jobs.empty()

    def _wait_until(self, monotonic_s: float) -> None:
        while (left_s := monotonic_s - time.monotonic()) > 0:
            self._wake.wait(left_s)
            self._wake.clear()
            if self._interrupted:
                return

    def _publish(self, block: ScanBlock, since_1970_ns: int) -> None:
        numbers = block.numbers()
        self.newest = dict(zip(block.registers, numbers[-1].tolist(), strict=True))
        time_ns = np.rint(block.time_s * 1e9).astype(np.int64) + since_1970_ns
        self._on_scans(FreshScans(numbers, time_ns, block.lost))


def state_of(sensor: Adis16354) -> SensorState:
    """Read configuration and offsets of the sensor, from which attributes are computed."""
    rows = registers([*ACCEL_OFF, *GYRO_OFF])
    words = sensor.read_words(rows)
    offsets = {row.name: row.number(word) for row, word in zip(rows, words, strict=True)}
    return SensorState(sensor.configuration(), offsets)


class ScanQueue:
    """Bounded queue of scans (structured arrays) for a client; a full queue drops the oldest scans.

    Parameters
    ----------
    capacity : int
        Most scans in the queue.

    Attributes
    ----------
    lost : int
        Number of dropped scans.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._blocks: deque[NDArray[np.void]] = deque()
        self._held = 0
        self.lost = 0

    def __len__(self) -> int:
        return self._held

    def put(self, scans: NDArray[np.void]) -> int:
        """Append scans; return the number of old scans that were dropped for them."""
        self._blocks.append(scans)
        self._held += len(scans)
        dropped = max(0, self._held - self._capacity)
        self._remove(dropped)
        self.lost += dropped
        return dropped

    def take(self, most: int) -> bytes:
        """Remove the oldest scans, at most `most`, and return them as bytes."""
        return b"".join(part.tobytes() for part in self._remove(min(most, self._held)))

    def _remove(self, count: int) -> list[NDArray[np.void]]:
        """Remove the oldest `count` scans and return them as a list of arrays."""
        parts = []
        self._held -= count
        while count:
            block = self._blocks.popleft()
            parts.append(block[:count])
            if len(block) > count:
                self._blocks.appendleft(block[count:])
            count -= len(parts[-1])
        return parts


QUEUE_S = 30.0
"""Length of a client's queue in time; all channels at full rate fill it with 0.6 MB."""

CLIENT_BLOCKS = 4
"""Least capacity of the queue in buffers of the client's size, the default of the kernel."""

MOST_QUEUED = 1 << 18
"""Most scans in a client's queue, even if it asks for more."""


@dataclass(eq=False)
class Buffer:
    """An open buffer of a client: the format of its scans, and their queue.

    Attributes
    ----------
    news : asyncio.Event
        Set after new scans, or a failure of the sensor.
    """

    format: ScanFormat
    queue: ScanQueue
    news: asyncio.Event = field(default_factory=asyncio.Event)


class Hub:
    """Distributes scans to the open buffers, in the thread of the event loop, and counts lost scans.

    Parameters
    ----------
    want : callable
        Called with True when a buffer opens, and with False when the last one closes.
    queue_s : float
        Least length of a client's queue in time.

    Attributes
    ----------
    failure : Exception or None
        Error that ended the sampling; buffers then get no more scans.
    clients : int
        Connections, counted by the server.
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
        """Open a buffer for a client; it gets all scans from now on."""
        capacity = min(MOST_QUEUED, max(CLIENT_BLOCKS * samples, round(self._queue_s * rate_hz), 16))
        buffer = Buffer(scan_format, ScanQueue(capacity))
        self._buffers.add(buffer)
        self._want(True)
        return buffer

    def close(self, buffer: Buffer) -> None:
        """Close a buffer; when the last one is closed, the sensor ends streaming."""
        self._buffers.discard(buffer)
        if not self._buffers:
            self._want(False)

    def publish(self, scans: FreshScans) -> None:
        """Append new scans to the queue of every buffer, in the format of the buffer."""
        self._lost_by_sensor += scans.lost
        for buffer in self._buffers:
            packed = buffer.format.pack(scans.numbers, scans.time_ns)
            self._lost_by_clients += buffer.queue.put(packed)
            buffer.news.set()

    def fail(self, error: Exception) -> None:
        """Note that the sensor has failed, and wake all waiting clients."""
        self.failure = error
        for buffer in self._buffers:
            buffer.news.set()

    def counts(self) -> Mapping[str, int]:
        """Values of the debug attributes: number of clients, and of scans lost by sensor and clients."""
        return {
            "clients": self.clients,
            "scans_lost_by_sensor": self._lost_by_sensor,
            "scans_lost_by_clients": self._lost_by_clients,
        }
