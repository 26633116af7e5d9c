"""The way from files to the results of a fleet: each session counts once, and none is computed twice."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from adis_gonio.base import __version__
from adis_gonio.base.budget import current
from adis_gonio.base.errors import AdisGonioError, UsageError
from adis_gonio.base.jsonable import json_object, json_text
from adis_gonio.base.numbers import counted, format_duration
from adis_gonio.base.output import ends_in, replacing, write_utf8
from adis_gonio.fleet.fleet_summary import Summary, summarise
from adis_gonio.fleet.session_record import Job, Options, Repeated, SessionRecord, lost, once, record_of
from adis_gonio.fleet.store import Store
from adis_gonio.record.archive import is_archive
from adis_gonio.record.provenance import digest_of_file

if TYPE_CHECKING:
    from adis_gonio.fleet.population_trace import PopulationResult

ENDINGS = (".session", ".csv", ".csv.gz")
"""Endings of session files; archives are also recognised by their content."""
OUTPUTS = (".parquet", ".json", ".html")
"""Endings of the files to which a fleet can be written."""


def session_files(places: Iterable[str | Path]) -> list[str]:
    """List the given files, and the session files in given folders and their subfolders.

    The list is sorted, and each file occurs once.

    Raises
    ------
    UsageError
        A given file or folder does not exist.
    """
    found: set[str] = set()
    for place in map(Path, places):
        if not place.exists():
            raise UsageError(f"{place}: there is no such file or folder")
        found |= {str(path) for path in _below(place)}
    return sorted(found)


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
    """Interface of objects that compute the records of sessions: `LocalPool`, `Cluster`."""

    def results(self, jobs: Sequence[Job], options: Options) -> Iterator[SessionRecord]:
        """Yield the record that was computed for each job, in any order."""


@dataclass(frozen=True)
class Fleet:
    """The records of many sessions, with their summary.

    Nothing but `computed` and `known` depends on the workers, on the order in which they finish, and on the
    records that the store had before.

    Attributes
    ----------
    options : Options
        Computations that were made for each session.
    records : tuple of SessionRecord
        One per session, sorted by path.
    repeated : tuple of Repeated
        Files that do not count, because another file has the same data.
    computed, known : int
        Number of sessions that were computed now, and of sessions that had a record in the store.
    """

    options: Options
    records: tuple[SessionRecord, ...]
    repeated: tuple[Repeated, ...]
    computed: int
    known: int

    @property
    def failed(self) -> int:
        """Number of sessions for which no result could be computed."""
        return sum(record.status != "ok" for record in self.records)

    @property
    def unreadable(self) -> tuple[SessionRecord, ...]:
        """Records without a digest, of files that could not be read; the store does not have them."""
        return tuple(record for record in self.records if record.sha256 is None)

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """Rows of the table of the fleet, one per session, with the columns `session_record.COLUMNS`."""
        return [record.row() for record in self.records]

    @cached_property
    def summary(self) -> Summary:
        """Statistics over all sessions of the fleet."""
        return summarise(self.rows)

    @cached_property
    def population(self) -> PopulationResult | str | None:
        """Result of the population trace, or the reason if it failed; None if it was not requested."""
        if not self.options.evidence:
            return None
        from adis_gonio.fleet.population_trace import trace_population
        from adis_gonio.fleet.session_evidence import SessionEvidence

        known = [record.evidence for record in self.records if record.evidence is not None]
        try:
            return trace_population([SessionEvidence.from_dict(evidence) for evidence in known])
        except AdisGonioError as error:
            return str(error)

    @property
    def population_lines(self) -> tuple[str, ...]:
        """Lines of text on the result of the population trace; empty if it was not requested."""
        found = self.population
        if found is None:
            return ()
        return (f"No population trace: {found}.",) if isinstance(found, str) else found.summary()

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document that `adis-gonio fleet` writes.

        It has summary, options, and the files that are not counted.
        """
        found = self.population
        population = {"reason": found} if isinstance(found, str) else found
        return self.summary.as_dict() | json_object(
            options=self.options,
            repeated=self.repeated,
            **{} if found is None else {"population": population},
        )

    def write(self, path: Path) -> None:
        """Write the result to a file, in the format of the file's ending; an existing file is replaced.

        Raises
        ------
        OutputError
            The file cannot be written; an existing file stays as it is.
        """
        with replacing(path) as temporary:
            if path.suffix.lower() == ".parquet":
                from adis_gonio.fleet.session_record import write_parquet

                about = {"software": f"adis-gonio {__version__}", "options": self.options.as_dict()}
                write_parquet(self.rows, temporary, about)
            elif path.suffix.lower() == ".html":
                from adis_gonio.fleet.fleet_pages import build_page

                write_utf8(temporary, build_page(self.summary, self.repeated, self.population_lines))
            else:
                write_utf8(temporary, json_text(self.as_dict()))


def check_outputs(paths: Sequence[Path], files: Sequence[str]) -> None:
    """Check before the work begins that the output files can be written.

    `files` are the session files.

    Raises
    ------
    UsageError
        An output file has an unknown ending, or is one of the session files.
    OutputError, NotInstalledError
        A file cannot be written, or its format needs a package that is not installed.
    """
    for path in paths:
        if path.suffix.lower() not in OUTPUTS:
            raise UsageError(f"{path}: unknown ending; use {', '.join(OUTPUTS)}")
        if str(path) in files:
            raise UsageError(f"{path}: is one of the sessions; name another file")
        if path.suffix.lower() == ".parquet":
            from adis_gonio.handover.session_export import require_pyarrow

            require_pyarrow()
        elif path.suffix.lower() == ".html":
            from adis_gonio.page.document import require_matplotlib

            require_matplotlib()


def run_fleet(
    files: Iterable[str], options: Options, store: Store, workers: Workers | None = None
) -> Fleet:
    """Compute the record of every session that has no record in the store yet; return all records.

    The progress is reported to the current `base.budget.Budget`, which may be infinite.

    Parameters
    ----------
    files : iterable of str
        Paths of session files. Files with equal bytes are one session, under the first name.
    options : Options
        Computations to make for each session.
    store : Store
        Store of the records. If it is strict, every file is read; else only new and changed files are.
    workers : Workers, optional
        Processes that compute the records; by default the sessions are computed here, one after another.

    Raises
    ------
    OutputError
        The store cannot be written; the records that it has stay.
    FleetError
        The workers have gone.
    """
    budget, names = current(), sorted(set(files))
    budget.tell("reading")
    jobs: dict[str, Job] = {}
    repeated, records = list[Repeated](), list[SessionRecord]()
    for done, path in enumerate(names):
        budget.share(done / len(names))
        digest = _digest_or_reason(path, store)
        if isinstance(digest, SessionRecord):
            records.append(digest)
        elif digest in jobs:
            repeated.append(Repeated(path, jobs[digest].path))
        else:
            jobs[digest] = Job(path, digest)
    found = {job: store.found(job, options) for job in jobs.values()}
    records += [record for record in found.values() if record is not None]
    todo = [job for job, record in found.items() if record is None]
    budget.tell("waiting for workers")
    begun, failed = time.monotonic(), 0
    here = (record_of(job.path, **options.as_dict()) for job in todo)
    results = here if workers is None else workers.results(todo, options)
    for done, record in enumerate(results, 1):
        store.keep(record, options=options)
        records.append(record)
        failed += record.status != "ok"
        rate = done / max(time.monotonic() - begun, 1e-9)
        each = f"{rate:.1f} a second" if rate >= 1 else f"{1 / rate:.1f} s each"
        left = format_duration((len(todo) - done) / rate)
        progress = f"{done} of {counted(len(todo), 'session')}, {each}, {left} left"
        budget.tell(progress + f", {failed} failed" * bool(failed))
    budget.tell("summary")
    kept, copies = once(records)
    repeated = sorted([*repeated, *copies], key=lambda one: one.path)
    return Fleet(options, tuple(kept), tuple(repeated), len(todo), len(jobs) - len(todo))


def _digest_or_reason(path: str, store: Store) -> str | SessionRecord:
    """Return the digest of a file, or a record with the reason if the file cannot be read."""
    place = Path(path)
    if place.exists() and not (place.is_file() or place.is_dir()):
        return lost(path, "is no regular file: save the data of a pipe first")
    try:
        return digest_of_file(path) if store.strict else store.digest_of(path)
    except OSError as error:
        return lost(path, f"cannot be read: {error.strerror or error}")


def scan(store: Store, places: Sequence[str | Path], *, trace: bool = False) -> Fleet:
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
    files = session_files(Path(place).resolve() for place in places)
    return run_fleet(files, Options(trace=trace), store)
