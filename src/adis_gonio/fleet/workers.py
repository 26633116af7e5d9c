"""Workers that compute sessions: local processes or a dask cluster; a worker that dies loses nothing.

If a process of this machine dies, the unfinished sessions are computed again, one at a time; if the process
of a session then dies as well, the record of the session has the reason.

The files of a cluster are on a disk that all workers see. The scheduler gives the sessions of a worker that
dies to others; a session that was lost more often than its `distributed.scheduler.allowed-failures` (3) has
a record with the reason. dask is imported when a cluster is asked for (extra `fleet`).
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent import futures
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from itertools import islice
from multiprocessing import get_context
from typing import TYPE_CHECKING

from adis_gonio.base import Closing, __version__
from adis_gonio.base.errors import FleetError, NotInstalledError, UsageError, install_extra
from adis_gonio.fleet.session_record import Job, Options, SessionRecord, lost, work

if TYPE_CHECKING:
    from distributed import Client, Future

_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_LOOK_S = 0.5
"""Interval in s between checks while the cluster is waited for."""


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class LocalPool(Closing):
    """Computes sessions in several processes on this machine.

    Parameters
    ----------
    workers : int, optional
        Largest number of processes; None is one per core.
    compute : callable
        Computes a record in a worker, with the arguments of `work`.
    """

    def __init__(self, workers: int | None = None, compute: Callable[..., SessionRecord] = work) -> None:
        self.workers = workers or cores()
        self._compute = compute
        self._pool: ProcessPoolExecutor | None = None

    def close(self) -> None:
        """Kill the processes."""
        if self._pool is not None:
            for process in (self._pool._processes or {}).values():
                process.kill()
            self._pool.shutdown()

    def results(self, jobs: Sequence[Job], options: Options) -> Iterator[SessionRecord]:
        """Yield the record of each job, in the order in which the records arrive."""
        waiting = deque(jobs)
        while waiting:
            suspects = yield from self._until_death(waiting, options, self.workers)
            for job in suspects:
                if (yield from self._until_death(deque([job]), options, 1)):
                    yield lost(job.path, "its process died twice")

    def _until_death(
        self, waiting: deque[Job], options: Options, workers: int
    ) -> Generator[SessionRecord, None, list[Job]]:
        """Yield the records of the waiting jobs; if a process dies, return the jobs that were begun."""
        for name in _ONE_THREAD:  # each worker has a core
            os.environ.setdefault(name, "1")
        # A fresh pool; a process takes a job as soon as it has none, so no other job is begun.
        begun: dict[futures.Future[SessionRecord], Job] = {}
        with self:
            self._pool = ProcessPoolExecutor(min(workers, len(waiting)), get_context("spawn"), _be_quiet)
            try:
                while waiting or begun:
                    while waiting and len(begun) < workers:
                        job = waiting[0]
                        request = (job.path, job.digest, options.as_dict(), __version__)
                        with _interrupts_blocked():
                            begun[self._pool.submit(self._compute, *request)] = job
                        waiting.popleft()
                    for future in futures.wait(begun, return_when=futures.FIRST_COMPLETED).done:
                        record = future.result()
                        del begun[future]
                        yield record
            except BrokenProcessPool:
                return list(begun.values())
        return []


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Context whose new processes ignore Ctrl-C in the terminal: only the parent handles it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    held = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, held)


def _be_quiet() -> None:
    """Discard the output that libraries print in a worker process."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)


CONNECT_S = 10.0
"""Time limit in s for the answer of a scheduler."""
ALONE_S = 60.0
"""Time in s for which a cluster may be without a worker before the run ends.

New workers may start during this time.
"""
_ASK_VERSION = "__import__('adis_gonio').__version__"
"""Python expression that workers evaluate to give their version of adis-gonio.

They may lack the package, so no function of it is used.
"""


class Cluster(Closing):
    """Computes sessions on the workers of a dask scheduler.

    Parameters
    ----------
    address : str
        Address of the scheduler, such as `tcp://10.0.0.1:8786`.

    Raises
    ------
    NotInstalledError
        dask.distributed is not installed.
    UsageError
        The address is invalid.
    FleetError
        No scheduler answers, it has no worker, or a worker has another version of adis-gonio.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed  # noqa: F401
        except ImportError:
            raise NotInstalledError(f"a cluster needs dask: {install_extra('fleet')}") from None
        self.address = address
        self._count, self._looked, self._peopled = 0, 0.0, time.monotonic()
        self._client = _connected(address)
        with self.closed_on_error():
            self._check()

    def close(self) -> None:
        """Close the connection to the scheduler."""
        with suppress(Exception):  # the scheduler may have gone
            self._client.close(timeout=CONNECT_S)

    def results(self, jobs: Sequence[Job], options: Options) -> Iterator[SessionRecord]:
        """Yield the record of each job, in the order in which the records arrive.

        Raises
        ------
        FleetError
            The scheduler has gone, or all of its workers have gone.
        """
        waiting, arrived = iter(jobs), threading.Event()
        running: dict[Future, Job] = {}
        try:
            while True:
                # Submit few jobs at a time: waiting jobs cannot be lost here and do not slow the scheduler.
                wanted = max(1, 2 * self._threads()) - len(running)
                for job in islice(waiting, max(0, wanted)):
                    request = (job.path, job.digest, options.as_dict(), __version__)
                    future = self._client.submit(work, *request, pure=False)
                    running[future] = job
                    future.add_done_callback(lambda _: arrived.set())
                if not running:
                    return
                arrived.wait(_LOOK_S)
                arrived.clear()
                for future in [one for one in running if one.done()]:
                    record = self._record(running[future], future)
                    if record is not None:
                        del running[future]
                        yield record
        finally:
            with suppress(Exception):
                self._client.cancel(list(running), force=True)

    def _record(self, job: Job, future: Future) -> SessionRecord | None:
        """Return the record of a finished job; None if its worker died, so that it is computed again."""
        try:
            record: SessionRecord = future.result(timeout=_LOOK_S)
        except TimeoutError:
            return None
        except Exception as error:
            if future.cancelled():
                raise FleetError(f"the scheduler at {self.address} has gone") from None
            # KilledWorker, a worker that cannot import this package, or a record that cannot be read here.
            return lost(job.path, f"its workers failed: {_error_text(error)}")
        return record

    def _threads(self) -> int:
        """Return the number of sessions that the cluster can compute at once.

        The scheduler is asked at most every `_LOOK_S` seconds.

        Raises
        ------
        FleetError
            The scheduler does not answer, or has had no worker for longer than `ALONE_S`.
        """
        now = time.monotonic()
        if now - self._looked >= _LOOK_S:
            self._looked = now
            try:
                self._count = sum(self._client.nthreads().values())
            except (OSError, RuntimeError, TimeoutError) as error:
                raise FleetError(
                    f"the scheduler at {self.address} has gone: {_error_text(error)}"
                ) from error
            self._peopled = now if self._count else self._peopled
        if now - self._peopled > ALONE_S:
            raise FleetError(f"the scheduler at {self.address} has had no worker for {ALONE_S:g} s")
        return self._count

    def _check(self) -> None:
        """Check that the cluster has workers and that they run this version of the program.

        Raises `FleetError` otherwise, after `CONNECT_S` without a worker.
        """
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError:
            raise FleetError(
                f"the scheduler at {self.address} has no worker: start some with"
                f" dask worker {self.address} --nthreads 1"
            ) from None
        versions = self._client.run(eval, _ASK_VERSION, on_error="return")
        for worker, version in sorted(versions.items()):
            if version != __version__:
                has = _error_text(version) if isinstance(version, Exception) else f"adis-gonio {version}"
                raise FleetError(
                    f"worker {worker}: {has}, here is adis-gonio {__version__}: install the same version"
                )


def _connected(address: str) -> Client:
    from distributed import Client
    from distributed.comm import parse_address
    from distributed.comm.registry import get_backend

    try:  # a client with an invalid address would report it again at the end of the program
        get_backend(parse_address(address, strict=True)[0])
    except ValueError as error:
        raise UsageError(
            f"--scheduler {address}: {_error_text(error)}; an address is such as tcp://10.0.0.1:8786"
        ) from error
    for name in ("distributed", "tornado"):  # this module reports the errors
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise FleetError(
            f"no scheduler answers at {address}: {_error_text(error)}; start one with dask scheduler"
        ) from error


def _error_text(error: BaseException) -> str:
    """Format an error as one line of text."""
    return " ".join(str(error).split()) or type(error).__name__
