"""The way from files to records: each session counts once, and none is computed twice."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from adis_gonio.base.budget import with_progress
from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import counted, format_duration
from adis_gonio.base.output import ends_in
from adis_gonio.fleet.session_record import Job, Options, SessionRecord, lost, once, record_of
from adis_gonio.fleet.store import Store
from adis_gonio.record.archive import is_archive
from adis_gonio.record.provenance import digest_of_file

ENDINGS = (".session", ".csv", ".csv.gz")
"""Endings of session files; archives are also recognised by their content."""


def files_of(given: Iterable[str | Path]) -> list[str]:
    """List the given files, and the session files in given folders and below, sorted, each once.

    Raises
    ------
    UsageError
        There is no session, or a given file or folder does not exist.
    """
    places = list(map(Path, given))
    for place in places:
        if not place.exists():
            raise UsageError(f"{place}: there is no such file or folder")
    found = {str(path) for place in places for path in _below(place)}
    if not found:
        folders = ", ".join(str(place) for place in places)
        where = f" in {folders}" if folders else ""
        raise UsageError(f"there is no session{where}: give files, or folders with {', '.join(ENDINGS)}")
    return sorted(found)


def session_files(places: Sequence[str | Path]) -> list[Path]:
    """Return absolute paths of the session files in folders and their subfolders, each once.

    Raises
    ------
    DataError
        A place does not exist, or is neither a folder nor a file.
    """
    found: dict[Path, None] = {}
    for place in map(Path, places):
        if not place.exists():
            raise DataError(f"{place}: there is no such folder")
        if not (place.is_dir() or place.is_file()):
            raise DataError(f"{place}: is neither a folder nor a file; save the data of a pipe first")
        found |= dict.fromkeys(_below(place.resolve()))
    return list(found)


def _below(place: Path) -> Iterator[Path]:
    """Yield the session files in a folder and its subfolders, except hidden ones; a file yields itself.

    An unreadable folder is yielded too, so that it is reported.
    """
    if not place.is_dir():
        yield place
        return
    shut: list[OSError] = []
    for folder, folders, names in os.walk(place, onerror=shut.append):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            path = Path(folder) / name
            # A broken link is judged by its name, so that it is reported.
            named = ends_in(path, *ENDINGS) or (path.is_file() and is_archive(path))
            if named and not name.startswith("."):
                yield path
    yield from (Path(error.filename) for error in shut)


class Workers(Protocol):
    """Interface of objects that compute the records of sessions: `LocalPool`, `Cluster`, `ThisProcess`."""

    def results(self, jobs: Sequence[Job], options: Options) -> Iterator[tuple[Job, SessionRecord]]:
        """Yield each job once with the record that was computed for it, in any order."""


class ThisProcess:
    """Computes the records of sessions one after another in the calling process."""

    def results(self, jobs: Sequence[Job], options: Options) -> Iterator[tuple[Job, SessionRecord]]:
        """Yield each job with its record, computed in the order of the jobs."""
        for job in with_progress(jobs):
            yield job, record_of(job.path, **options.as_dict())


class Repeated(JsonRecord):
    """A file that does not count, because the file `same_as` has the same data."""

    path: str
    same_as: str


@dataclass(frozen=True)
class Survey:
    """The sessions to compute, found by reading the files once.

    Attributes
    ----------
    jobs : tuple of Job
        Sessions to compute, sorted by path.
    repeated : tuple of Repeated
        Files with the same bytes as a session of `jobs`.
    unreadable : tuple of SessionRecord
        Records of unreadable files.
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
        One per session, sorted by path.
    repeated : tuple of Repeated
        Files that do not count, because another file has the same data.
    again : int
        Number of sessions that had a record in the store before the run.
    """

    records: tuple[SessionRecord, ...]
    repeated: tuple[Repeated, ...]
    again: int

    @property
    def failed(self) -> int:
        """Number of sessions for which no result could be computed."""
        return sum(record.status != "ok" for record in self.records)


def survey(
    files: Sequence[str], share: Callable[[float], None] | None = None, store: Store | None = None
) -> Survey:
    """Read every file once; files with equal bytes are one session, under the first name.

    `share` is called with the finished share of the files. With a store, only new or changed files are
    read; None reads all files.
    """
    names: dict[str, str] = {}
    repeated, unreadable = [], []
    digest_of = digest_of_file if store is None else store.digest_of
    for done, path in enumerate(sorted(set(files))):
        if share is not None:
            share(done / len(files))
        if _special(Path(path)):
            unreadable.append(lost(path, "is no regular file: save the data of a pipe first"))
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
    """Compute the record of every session that has no record in the store yet; return all records.

    `tell` is called with the progress after each session; None reports none. `found` has the sessions,
    `options` the computations to make.

    Raises
    ------
    OutputError
        The store cannot be written; the records that it has stay.
    FleetError
        The workers have gone.
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
    """Result of a search for sessions in folders.

    Attributes
    ----------
    computed, known : int
        Number of files that were computed now, and of files that had a record in the store before.
    unreadable : tuple of SessionRecord
        Records of unreadable files, which are not in the store.
    """

    computed: int = 0
    known: int = 0
    unreadable: tuple[SessionRecord, ...] = ()


def scan(store: Store, places: Sequence[str | Path], *, trace: bool = False) -> Scan:
    """Search folders for session files, and compute new or changed sessions in this process.

    Parameters
    ----------
    store : Store
        Store of the records.
    places : sequence of path
        Folders or files.
    trace : bool
        True also traces the residual; records without a trace are then made again.
    """
    paths = session_files(places)
    store.mark_gone(places, paths)
    found = survey([str(path) for path in paths], store=store)
    fleet = run_fleet(found, Options(trace=trace), ThisProcess(), store)
    unreadable = tuple(record for record in fleet.records if record.sha256 is None)
    computed = len(found.jobs) - fleet.again
    return Scan(computed, len(paths) - len(found.unreadable) - computed, unreadable)


class FleetProgress:
    """Counts the computed sessions of a fleet, to show the progress.

    Attributes
    ----------
    total, done, failed, again : int
        Number of sessions to compute in this run, of sessions computed so far, of failures among them, and
        of sessions with a record from an earlier run.
    """

    def __init__(self, total: int, again: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.total, self.again = total, again
        self.done = self.failed = 0
        self._clock = clock
        self._begun = clock()

    def arrived(self, record: SessionRecord) -> None:
        """Count the record of a session that has been computed."""
        self.done += 1
        self.failed += record.status != "ok"

    def __str__(self) -> str:
        """Return the progress as text.

        An example is `120 of 1000, 4.1 a second, 3 min 35 s left, 2 failed`.
        """
        elapsed = self._clock() - self._begun
        parts = [f"{self.done} of {counted(self.total, 'session')}"]
        if self.done and elapsed > 0:
            rate = self.done / elapsed
            parts.append(f"{rate:.1f} a second" if rate >= 1 else f"{1 / rate:.1f} s each")
            parts.append(f"{format_duration((self.total - self.done) / rate)} left")
        parts += [f"{self.failed} failed"] * bool(self.failed)
        parts += [f"{self.again} done before"] * bool(self.again)
        return ", ".join(parts)
