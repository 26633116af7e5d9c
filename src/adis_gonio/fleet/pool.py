"""Workers as processes of this machine; one that dies loses nothing.

Each process has one session at a time and a thread here that feeds it, so that it is known which session
was lost with it. That session is given to a new process; if that one dies as well, it is a row with the
reason.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from adis_gonio.base import __version__
from adis_gonio.base.errors import FleetError
from adis_gonio.fleet.record import SessionRecord
from adis_gonio.fleet.work import Job, Options, lost

COMMAND = (sys.executable, "-P", "-m", "adis_gonio.fleet.worker")
ATTEMPTS = 2
"""Processes that a session may cost."""
STARTS = 3
"""Processes that may die before their first word, one after the other, before starting more is no use."""
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_LOOK_S = 0.5
"""How often a wait looks whether it is still wanted, in s."""

Arrival = tuple[Job, SessionRecord]


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class LocalPool:
    """Processes of this machine.

    Attributes
    ----------
    workers : int
        Processes at most.
    """

    def __init__(self, workers: int | None = None, command: Sequence[str] = COMMAND) -> None:
        self.workers = workers or cores()
        self._command = tuple(command)
        self._hands: list[_Hand] = []

    def __enter__(self) -> LocalPool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    @property
    def pids(self) -> tuple[int, ...]:
        """Processes that run now."""
        return tuple(hand.worker.pid for hand in self._hands if hand.worker is not None)

    def results(self, jobs: Sequence[Job], options: Options) -> Iterator[Arrival]:
        """Each job with its record, as they come.

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
    """Nobody waits for the answer any more."""


class _Hand(threading.Thread):
    """Gives a process job after job; a job that lost its process is given to another."""

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
        """Until no job is left, or `stop`."""
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
        """Called by another thread: kill the process; whatever it was at is not answered."""
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
        return lost(job.path, f"the process that worked on it {how}, {ATTEMPTS} times")

    def _ready(self) -> _Worker:
        """The process, or a new one."""
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
        """End the process where there is one; how it ended, in words."""
        worker, self.worker = self.worker, None
        return "" if worker is None else worker.end()


class _Worker:
    """A process and its pipes."""

    def __init__(self, command: Sequence[str]) -> None:
        self._complaints: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (closed in `end`)
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            env=_environment(),
            start_new_session=True,  # Ctrl-C in the terminal is its parent's affair
        )
        self.pid = self._process.pid
        self._ready = False

    def ready(self) -> bool:
        """Wait for its first word; False where it ended before."""
        self._ready = self._ready or self._answer() is not None
        return self._ready

    def ask(self, job: Job, options: Options) -> SessionRecord | None:
        """Record of a job; None if the process ended."""
        asked = {"options": options.as_dict(), "version": __version__, **asdict(job)}
        pipe = self._process.stdin
        try:
            if pipe is not None:
                pipe.write(json.dumps(asked).encode() + b"\n")
                pipe.flush()
        except OSError:
            return None
        answer = self._answer()
        return None if answer is None else SessionRecord.from_dict(answer)

    def kill(self) -> None:
        """End it in the midst of its work."""
        self._process.kill()

    def end(self) -> str:
        """Wait for its end, which is brought about where it lives; how it ended, in words."""
        self._process.kill()
        status = self._process.wait(30)
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError):  # what could not be written
                if pipe is not None:
                    pipe.close()
        with self._complaints as file:
            file.seek(0)
            said = file.read().decode(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(said) if line.strip()), "")
        return _how(status) + (f" ({last})" if last else "")

    def _answer(self) -> dict[str, Any] | None:
        pipe = self._process.stdout
        line = b"" if pipe is None else pipe.readline()
        if not line.endswith(b"\n"):
            return None
        answer: dict[str, Any] = json.loads(line)
        return answer


def _environment() -> dict[str, str]:
    """That of a worker: this package before others, and one thread a process, since each has a core."""
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
