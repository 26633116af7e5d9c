"""Workers of a dask cluster: the scheduler has an address, the files stand on a disk that all of them see.

The sessions of a worker that dies go back to the scheduler, which hands them to others; one that was lost
more often than its `distributed.scheduler.allowed-failures` says (3) is a row with the reason. dask is
imported when a cluster is asked for (extra `fleet`).
"""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from types import TracebackType
from typing import TYPE_CHECKING

from adis_gonio.base import __version__
from adis_gonio.base.errors import FleetError, NotInstalledError, UsageError
from adis_gonio.fleet.record import SessionRecord
from adis_gonio.fleet.work import Job, Options, lost, work

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_S = 10.0
"""How long a scheduler may take to answer."""
ALONE_S = 60.0
"""How long a cluster may be without any worker before the run ends: others may be on their way."""
_LOOK_S = 0.5
_ASK_VERSION = "__import__('adis_gonio').__version__"
"""Evaluated on the workers, which may not have the package at all."""


class Cluster:
    """The workers behind a scheduler.

    Parameters
    ----------
    address : str
        Such as `tcp://10.0.0.1:8786`.
    connect_s, alone_s : float
        Limits in s: for the scheduler's answer, for a cluster without a worker.

    Raises
    ------
    NotInstalledError
        dask.distributed is not installed.
    UsageError
        The address is none.
    FleetError
        No scheduler answers, it has no worker, or a worker has another version of adis-gonio.
    """

    def __init__(self, address: str, connect_s: float = CONNECT_S, alone_s: float = ALONE_S) -> None:
        try:
            import distributed  # noqa: F401
        except ImportError:
            raise NotInstalledError("a cluster needs dask: pip install 'adis-gonio[fleet]'") from None
        self.address = address
        self._alone_s = alone_s
        self._count, self._looked, self._peopled = 0, 0.0, time.monotonic()
        self._client = _connected(address, connect_s)
        try:
            self._check(connect_s)
        except BaseException:
            self._client.close(timeout=connect_s)
            raise

    def __enter__(self) -> Cluster:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(Exception):  # a scheduler that has gone cannot be taken leave of
            self._client.close(timeout=CONNECT_S)

    def results(self, jobs: Sequence[Job], options: Options) -> Iterator[tuple[Job, SessionRecord]]:
        """Each job with its record, as they come.

        Raises
        ------
        FleetError
            The scheduler has gone, or all of its workers have.
        """
        arrived: queue.SimpleQueue[str] = queue.SimpleQueue()
        waiting = iter(jobs)
        running: dict[str, tuple[Job, Future]] = {}
        try:
            while True:
                # Few at a time: what waits here is lost by nobody, and does not slow the scheduler.
                wanted = max(1, 2 * self._threads()) - len(running)
                for job in islice(waiting, max(0, wanted)):
                    future = self._submit(job, options)
                    running[future.key] = job, future
                    future.add_done_callback(lambda future: arrived.put(future.key))
                if not running:
                    return
                job, future = running.pop(self._next(arrived))
                yield job, self._record(job, future)
        finally:
            with suppress(Exception):
                self._client.cancel([future for _, future in running.values()], force=True)

    def _submit(self, job: Job, options: Options) -> Future:
        asked = (job.path, job.digest, options.as_dict(), __version__)
        return self._client.submit(work, *asked, pure=False)

    def _next(self, arrived: queue.SimpleQueue[str]) -> str:
        while True:
            try:
                return arrived.get(timeout=_LOOK_S)
            except queue.Empty:
                self._threads()

    def _record(self, job: Job, future: Future) -> SessionRecord:
        """What a future that is done holds; fetched again where its worker has died since."""
        while True:
            if future.status == "cancelled":
                raise FleetError(f"the scheduler at {self.address} has gone")
            try:
                record: SessionRecord = future.result(timeout=_LOOK_S)
            except TimeoutError:
                self._threads()
            except Exception as error:  # KilledWorker, or a worker that cannot import this package
                return lost(job.path, f"lost by its workers: {_words(error)}")
            else:
                return record

    def _threads(self) -> int:
        """How many sessions the cluster can have at once; looked up now and then.

        Raises
        ------
        FleetError
            Nobody has been there for too long.
        """
        now = time.monotonic()
        if now - self._looked >= _LOOK_S:
            self._looked = now
            self._count = sum(self._asked_threads().values())
            self._peopled = now if self._count else self._peopled
        if now - self._peopled > self._alone_s:
            raise FleetError(f"the scheduler at {self.address} has had no worker for {self._alone_s:g} s")
        return self._count

    def _asked_threads(self) -> dict[str, int]:
        try:
            threads: dict[str, int] = self._client.nthreads()
        except (OSError, RuntimeError, TimeoutError) as error:
            raise FleetError(f"the scheduler at {self.address} has gone: {_words(error)}") from error
        return threads

    def _check(self, limit_s: float) -> None:
        """See that there are workers and that they compute what is computed here."""
        try:
            self._client.wait_for_workers(1, timeout=limit_s)
        except TimeoutError:
            raise FleetError(
                f"the scheduler at {self.address} has no worker: start some with"
                f" dask worker {self.address} --nthreads 1"
            ) from None
        versions = self._client.run(eval, _ASK_VERSION, on_error="return")
        for worker, version in sorted(versions.items()):
            if version != __version__:
                has = _words(version) if isinstance(version, Exception) else f"adis-gonio {version}"
                raise FleetError(
                    f"worker {worker}: {has}, here is adis-gonio {__version__}: install the same"
                )


def _connected(address: str, limit_s: float) -> Client:
    from distributed import Client
    from distributed.comm import parse_address
    from distributed.comm.registry import get_backend

    try:  # a client of an address that is none would complain once more when the program ends
        get_backend(parse_address(address, strict=True)[0])
    except ValueError as error:
        raise UsageError(
            f"--scheduler {address}: {_words(error)}; an address is such as tcp://10.0.0.1:8786"
        ) from error
    for name in ("distributed", "tornado"):  # what has to be said is said in an error of ours
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        return Client(address, timeout=limit_s, set_as_default=False)
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise FleetError(
            f"no scheduler answers at {address}: {_words(error)}; start one with dask scheduler"
        ) from error


def _words(error: BaseException) -> str:
    """An error in one line."""
    return " ".join(str(error).split()) or type(error).__name__
