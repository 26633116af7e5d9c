"""Many sessions from files to records: each session counts once, and none is computed twice."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from adis_gonio.base.budget import with_progress
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import counted, format_duration
from adis_gonio.fleet.files import session_files
from adis_gonio.fleet.record import SessionRecord, once
from adis_gonio.fleet.store import Store
from adis_gonio.fleet.work import Job, Options, lost, record_of
from adis_gonio.record.provenance import digest_of_file


class Workers(Protocol):
    """Whoever works on the jobs: `LocalPool`, `Cluster`, `ThisProcess`."""

    def results(self, jobs: Sequence[Job], options: Options) -> Iterator[tuple[Job, SessionRecord]]:
        """Each job once with its record, in any order."""


class ThisProcess:
    """Works on one job after the other, here."""

    def results(self, jobs: Sequence[Job], options: Options) -> Iterator[tuple[Job, SessionRecord]]:
        """Each job with its record."""
        for job in with_progress(jobs):
            yield job, record_of(job.path, **options.as_dict())


@dataclass(frozen=True)
class Repeated(JsonRecord):
    """A file that holds the same session as another, which is the one that counts."""

    path: str
    same_as: str


@dataclass(frozen=True)
class Survey:
    """The files before any session is computed.

    Attributes
    ----------
    jobs : tuple of Job
        By path.
    repeated : tuple of Repeated
    unreadable : tuple of SessionRecord
        Of files without bytes to read.
    """

    jobs: tuple[Job, ...]
    repeated: tuple[Repeated, ...]
    unreadable: tuple[SessionRecord, ...]


@dataclass(frozen=True)
class Fleet:
    """The records of many sessions.

    Attributes
    ----------
    records : tuple of SessionRecord
        One a session, in the order of their paths.
    repeated : tuple of Repeated
    again : int
        Sessions with a record in the store before the run.
    """

    records: tuple[SessionRecord, ...]
    repeated: tuple[Repeated, ...]
    again: int

    @property
    def failed(self) -> int:
        """Sessions without a result."""
        return sum(record.status != "ok" for record in self.records)


def survey(
    files: Sequence[str], share: Callable[[float], None] | None = None, store: Store | None = None
) -> Survey:
    """Read every file once: the same bytes by two names are one session, that of the first name.

    With a store only files that are new to it or have changed are read.
    """
    names: dict[str, str] = {}
    repeated, unreadable = [], []
    digest_of = digest_of_file if store is None else store.digest_of
    for done, path in enumerate(sorted(set(files))):
        if share is not None:
            share(done / len(files))
        if _special(Path(path)):
            unreadable.append(lost(path, "is no regular file: save what comes through a pipe first"))
            continue
        try:
            digest = digest_of(path)
        except OSError as error:
            unreadable.append(lost(path, f"cannot be read: {error.strerror or error}"))
            continue
        if digest in names:
            repeated.append(Repeated(path, names[digest]))
        else:
            names[digest] = path
    jobs = tuple(Job(path, digest) for digest, path in names.items())
    return Survey(jobs, tuple(repeated), tuple(unreadable))


def _special(path: Path) -> bool:
    return path.exists() and not (path.is_file() or path.is_dir())


def run_fleet(
    found: Survey,
    options: Options,
    workers: Workers,
    store: Store,
    tell: Callable[[FleetProgress], None] | None = None,
) -> Fleet:
    """Compute every session that has no record in the store.

    Raises
    ------
    OutputError
        The store cannot be written; its records stay.
    FleetError
        There are no workers.
    """
    known = ((job.path, store.found(job, options)) for job in found.jobs)
    records = {path: record for path, record in known if record is not None}
    todo = [job for job in found.jobs if job.path not in records]
    progress = FleetProgress(len(todo), again=len(records))
    for job, record in workers.results(todo, options) if todo else ():
        store.keep(record, options=options)
        records[job.path] = record
        progress.arrived(record)
        if tell is not None:
            tell(progress)
    kept, copies = once([*records.values(), *found.unreadable])
    repeated = [*found.repeated, *(Repeated(path, same_as) for path, same_as in copies.items())]
    return Fleet(tuple(kept), tuple(sorted(repeated, key=lambda one: one.path)), progress.again)


@dataclass(frozen=True)
class Scan:
    """Result of looking through folders.

    Attributes
    ----------
    computed, known : int
        Files that were computed now, and files with a record in the store before.
    unreadable : tuple of SessionRecord
        Files that could not even be read; they are not in the store.
    """

    computed: int = 0
    known: int = 0
    unreadable: tuple[SessionRecord, ...] = ()


def scan(store: Store, places: Sequence[str | Path], *, trace: bool = False) -> Scan:
    """Look through folders; compute the sessions that are new or have changed since, here.

    Parameters
    ----------
    trace : bool
        Look for effects too; records that were made without are made again.
    """
    paths = session_files(places)
    store.mark_gone(places, paths)
    found = survey([str(path) for path in paths], store=store)
    fleet = run_fleet(found, Options(trace=trace), ThisProcess(), store)
    unreadable = tuple(record for record in fleet.records if record.sha256 is None)
    computed = len(found.jobs) - fleet.again
    return Scan(computed, len(paths) - len(found.unreadable) - computed, unreadable)


class FleetProgress:
    """How far a fleet is.

    Attributes
    ----------
    total, done, failed, again : int
        Sessions to do in this run; done; failed of these; not to be done again.
    """

    def __init__(self, total: int, again: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.total, self.again = total, again
        self.done = self.failed = 0
        self._clock = clock
        self._begun = clock()

    def arrived(self, record: SessionRecord) -> None:
        """Count one."""
        self.done += 1
        self.failed += record.status != "ok"

    def __str__(self) -> str:
        """`120 of 1000, 4.1 a second, 3 min 35 s left, 2 failed`."""
        elapsed = self._clock() - self._begun
        parts = [f"{self.done} of {counted(self.total, 'session')}"]
        if self.done and elapsed > 0:
            rate = self.done / elapsed
            parts.append(f"{rate:.1f} a second" if rate >= 1 else f"{1 / rate:.1f} s each")
            parts.append(f"{format_duration((self.total - self.done) / rate)} left")
        parts += [f"{self.failed} failed"] * bool(self.failed)
        parts += [f"{self.again} were done before"] * bool(self.again)
        return ", ".join(parts)
