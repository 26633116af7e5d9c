"""The one reader of the sensor: a thread that streams while somebody listens and runs jobs in between.

A bus that streams takes no other exchange meanwhile, so a job ends the stream, runs, and the stream begins
again; what reading an attribute needs is therefore kept (`state`, `newest`) and costs no job while the
sensor streams.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.device.sensor import Adis16354, ScanBlock
from adis_gonio.device.sensor.registers import ACCEL_OFF, GYRO_OFF, registers
from adis_gonio.faces.serve.device import SensorState

T = TypeVar("T")
_Job = tuple[Callable[[Adis16354], Any], "Future[Any]", bool]

BLOCK_S = 0.04
"""Time that a block of scans spans: what a client waits for its newest scan at most, beside the bus."""

MOST_BLOCK = 256


@dataclass(frozen=True)
class FreshScans:
    """Fresh scans for the clients.

    Attributes
    ----------
    numbers : (n, k) int32
    time_ns : (n,) int64
        Since 1970, by the host's clock when the stream began and the bus's clock from there on.
    lost : int
        Updates of the sensor that were missed before and between them.
    """

    numbers: NDArray[np.int32]
    time_ns: NDArray[np.int64]
    lost: int


class Sampler:
    """Owns the sensor while it is served; `start` and `stop` it.

    Parameters
    ----------
    sensor : Adis16354
        Open; stays open afterwards.
    names : sequence of str
        Output registers of a scan.
    on_scans, on_failure : callable
        Called from the thread of the sampler. After a failure the thread has ended.

    Attributes
    ----------
    state : SensorState
        What the registers say.
    newest : mapping of str to int, or None
        Numbers of the newest scan while the sensor streams.
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
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the stream, which sets back the register that it changed, and the thread."""
        self._stopping = True
        self._wake.set()
        self._thread.join()

    def want(self, wanted: bool) -> None:
        """Whether somebody listens."""
        if wanted != self._wanted:
            self._wanted = wanted
            self._wake.set()

    def submit(self, job: Callable[[Adis16354], T], *, changes: bool = False) -> Future[T]:
        """Let the thread do something with the sensor, between two scans.

        Parameters
        ----------
        changes : bool
            The job writes registers, so that `state` has to be read again.
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
        except Exception as error:  # whatever it is, nobody may wait for scans that will not come
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
            if changes:  # half of a change that failed may stand
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
                    if self._simulated:  # its clock may run ahead of the wall's: clients expect the rate
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
    """Read what the attributes say."""
    rows = registers([*ACCEL_OFF, *GYRO_OFF])
    words = sensor.read_words(rows)
    offsets = {row.name: row.number(word) for row, word in zip(rows, words, strict=True)}
    return SensorState(sensor.configuration(), offsets)
