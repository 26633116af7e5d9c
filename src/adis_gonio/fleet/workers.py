"""Workers that compute sessions: local processes or a dask cluster; a worker that dies loses nothing.

Each process of this machine has one session at a time and a thread here that feeds it, so that it is
known which session was lost with it. That session is given to a new process; if that one dies as well,
the session is a row with the reason.

The files of a cluster are on a disk that all workers see. The scheduler gives the sessions of a worker
that dies to others; a session that was lost more often than its `distributed.scheduler.allowed-failures`
(3) is a row with the reason. dask is imported when a cluster is asked for (extra `fleet`).
"""

from __future__ import annotations

import json
import logging
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from adis_gonio.base import __version__
from adis_gonio.base.errors import FleetError, NotInstalledError, UsageError, install_extra
from adis_gonio.fleet.session_record import Job, Options, SessionRecord, lost, work

if TYPE_CHECKING:
    from distributed import Client, Future

COMMAND = (sys.executable, "-P", "-m", "adis_gonio.fleet.workers")
ATTEMPTS = 2
"""Number of processes that may die from one session."""
STARTS = 3
"""Number of processes that may die in succession before their first answer."""
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_LOOK_S = 0.5
"""Interval of checks while waiting, in s."""

Arrival = tuple[Job, SessionRecord]


def cores() -> int:
    """Number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class LocalPool:
    """Computes sessions in several processes on this machine.

    Attributes
    ----------
    workers : int
        Largest number of processes.
    """

    def __init__(self, workers: int | None = None, command: Sequence[str] = COMMAND) -> None:
        self.workers = workers or cores()
        self._command = tuple(command)
        self._hands: list[_Hand] = []

    def __enter__(self) -> LocalPool:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    @property
    def pids(self) -> tuple[int, ...]:
        """Identifiers of the running processes."""
        return tuple(hand.worker.pid for hand in self._hands if hand.worker is not None)

    def results(self, jobs: Sequence[Job], options: Options) -> Iterator[Arrival]:
        """Yield each job with its record, as they arrive.

        Raises
        ------
        FleetError
            No process can be started.
        """
        waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
        for job in jobs:
            waiting.put(job)
        arrived: queue.SimpleQueue[Arrival | BaseException] = queue.SimpleQueue()
        self._hands = [
            _Hand(self._command, waiting, arrived, options) for _ in range(min(self.workers, len(jobs)))
        ]
        for hand in self._hands:
            hand.start()
        try:
            for _ in jobs:
                yield _next(arrived)
        finally:
            self._stop()

    def _stop(self) -> None:
        for hand in self._hands:
            hand.stop()
        for hand in self._hands:
            hand.join(30)
        self._hands = []


def _next(arrived: queue.SimpleQueue[Arrival | BaseException]) -> Arrival:
    while True:
        try:
            one = arrived.get(timeout=_LOOK_S)
        except queue.Empty:
            continue
        if isinstance(one, BaseException):
            raise one
        return one


class _StoppedError(Exception):
    """Raised in a thread that waits for an answer which is no longer needed."""


class _Hand(threading.Thread):
    """Thread that gives jobs to one worker process.

    A job that ends its process is given to a new process, at most `ATTEMPTS` times in total.
    """

    def __init__(
        self,
        command: Sequence[str],
        waiting: queue.SimpleQueue[Job],
        arrived: queue.SimpleQueue[Arrival | BaseException],
        options: Options,
    ) -> None:
        super().__init__(daemon=True)
        self.worker: _Worker | None = None
        self._command, self._waiting, self._arrived, self._options = command, waiting, arrived, options
        self._over = False

    def run(self) -> None:
        """Work until there are no more jobs, or until `stop`."""
        try:
            while True:
                job = self._waiting.get_nowait()
                self._arrived.put((job, self._done(job)))
        except (queue.Empty, _StoppedError):
            pass
        except BaseException as error:  # raised again where the results are awaited
            self._arrived.put(error)
        finally:
            self._end()

    def stop(self) -> None:
        """Kill the process, from another thread; its present job gets no answer."""
        self._over = True
        if self.worker is not None:
            self.worker.kill()

    def _done(self, job: Job) -> SessionRecord:
        how = ""
        for _ in range(ATTEMPTS):
            record = self._ready().ask(job, self._options)
            if record is not None:
                return record
            how = self._end()
            if self._over:
                raise _StoppedError
        return lost(job.path, f"its process {how}, {ATTEMPTS} times")

    def _ready(self) -> _Worker:
        """Return the worker process; start a new one if there is none."""
        how = ""
        for _ in range(STARTS):
            if self.worker is None:
                self.worker = _Worker(self._command)
            if self._over:
                raise _StoppedError
            if self.worker.ready():
                return self.worker
            how = self._end()
        raise FleetError(f"no worker can be started: the process {how}")

    def _end(self) -> str:
        """End the worker process, if there is one, and describe how it ended."""
        worker, self.worker = self.worker, None
        return "" if worker is None else worker.end()


class _Worker:
    """A worker process and the pipes to it."""

    def __init__(self, command: Sequence[str]) -> None:
        self._stderr: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (closed in `end`)
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            env=_environment(),
            start_new_session=True,  # the parent handles Ctrl-C in the terminal
        )
        self.pid = self._process.pid
        self._ready = False

    def ready(self) -> bool:
        """Wait until the process has sent its first line; False if it ended before."""
        self._ready = self._ready or self._answer() is not None
        return self._ready

    def ask(self, job: Job, options: Options) -> SessionRecord | None:
        """Send a job and wait for its record; None if the process ended."""
        request = {"options": options.as_dict(), "version": __version__, **asdict(job)}
        pipe = self._process.stdin
        try:
            if pipe is not None:
                pipe.write(json.dumps(request).encode() + b"\n")
                pipe.flush()
        except OSError:
            return None
        answer = self._answer()
        return None if answer is None else SessionRecord.from_dict(answer)

    def kill(self) -> None:
        """Kill the process."""
        self._process.kill()

    def end(self) -> str:
        """Kill the process if it runs, wait for its end, and describe how it ended."""
        self._process.kill()
        status = self._process.wait(30)
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError):  # unwritten data
                if pipe is not None:
                    pipe.close()
        with self._stderr as file:
            file.seek(0)
            lines = file.read().decode(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        return _how(status) + (f" ({last})" if last else "")

    def _answer(self) -> dict[str, Any] | None:
        pipe = self._process.stdout
        line = b"" if pipe is None else pipe.readline()
        if not line.endswith(b"\n"):
            return None
        answer: dict[str, Any] = json.loads(line)
        return answer


def _environment() -> dict[str, str]:
    """Environment variables of a worker process.

    It imports this package first, and uses one thread, since each worker has a core.
    """
    home = str(Path(__file__).parents[2])
    paths = [home, *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**dict.fromkeys(_ONE_THREAD, "1"), **os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def _how(status: int) -> str:
    if status >= 0:
        return f"ended with status {status}"
    try:
        return f"was killed ({signal.Signals(-status).name})"
    except ValueError:
        return f"was killed (signal {-status})"


def main() -> None:
    """Answer jobs, one line of JSON each, until standard input ends."""
    # Output of libraries must not mix with the answers.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    jobs: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(jobs,), daemon=True).start()
    document: dict[str, Any] = {"ready": __version__}
    while True:
        answers.write(json.dumps(document) + "\n")
        answers.flush()
        document = work(**jobs.get()).as_dict()


def _read(jobs: queue.SimpleQueue[dict[str, Any]]) -> None:
    for line in sys.stdin:
        jobs.put(json.loads(line))
    os._exit(0)


CONNECT_S = 10.0
"""Time limit for the answer of a scheduler."""
ALONE_S = 60.0
"""Time for which a cluster may be without a worker before the run ends; others may still start."""
_ASK_VERSION = "__import__('adis_gonio').__version__"
"""Expression that workers evaluate to give their version; they may not have the package at all."""


class Cluster:
    """Computes sessions on the workers of a dask scheduler.

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
        The address is invalid.
    FleetError
        No scheduler answers, it has no worker, or a worker has another version of adis-gonio.
    """

    def __init__(self, address: str, connect_s: float = CONNECT_S, alone_s: float = ALONE_S) -> None:
        try:
            import distributed  # noqa: F401
        except ImportError:
            raise NotInstalledError(f"a cluster needs dask: {install_extra('fleet')}") from None
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

    def __exit__(self, *_: object) -> None:
        with suppress(Exception):  # the scheduler may have gone
            self._client.close(timeout=CONNECT_S)

    def results(self, jobs: Sequence[Job], options: Options) -> Iterator[tuple[Job, SessionRecord]]:
        """Yield each job with its record, as they arrive.

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
                # Submit few jobs at a time: waiting jobs cannot be lost here and do not slow the scheduler.
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
        request = (job.path, job.digest, options.as_dict(), __version__)
        return self._client.submit(work, *request, pure=False)

    def _next(self, arrived: queue.SimpleQueue[str]) -> str:
        while True:
            try:
                return arrived.get(timeout=_LOOK_S)
            except queue.Empty:
                self._threads()

    def _record(self, job: Job, future: Future) -> SessionRecord:
        """Wait for the record of a job; if its worker dies, the cluster computes the job again."""
        while True:
            if future.status == "cancelled":
                raise FleetError(f"the scheduler at {self.address} has gone")
            try:
                record: SessionRecord = future.result(timeout=_LOOK_S)
            except TimeoutError:
                self._threads()
            except Exception as error:  # KilledWorker, or a worker that cannot import this package
                return lost(job.path, f"its workers failed: {_error_text(error)}")
            else:
                return record

    def _threads(self) -> int:
        """Number of sessions that the cluster can compute at once, looked up from time to time.

        Raises
        ------
        FleetError
            The cluster has had no worker for too long.
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
            raise FleetError(f"the scheduler at {self.address} has gone: {_error_text(error)}") from error
        return threads

    def _check(self, limit_s: float) -> None:
        """Check that the cluster has workers and that they run this version of the program."""
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
                has = _error_text(version) if isinstance(version, Exception) else f"adis-gonio {version}"
                raise FleetError(
                    f"worker {worker}: {has}, here is adis-gonio {__version__}: install the same version"
                )


def _connected(address: str, limit_s: float) -> Client:
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
        return Client(address, timeout=limit_s, set_as_default=False)
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise FleetError(
            f"no scheduler answers at {address}: {_error_text(error)}; start one with dask scheduler"
        ) from error


def _error_text(error: BaseException) -> str:
    """Format an error as one line of text."""
    return " ".join(str(error).split()) or type(error).__name__


if __name__ == "__main__":
    main()
