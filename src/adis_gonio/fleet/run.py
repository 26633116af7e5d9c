"""A fleet from files to documents: what is the same counts once, what was done is not done again."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from adis_gonio.base.errors import UsageError
from adis_gonio.base.numbers import counted, format_duration
from adis_gonio.base.output import ends_in
from adis_gonio.fleet.journal import Journal
from adis_gonio.fleet.memory.files import ENDINGS
from adis_gonio.fleet.work import Document, Job, Options, digest_of_file, lost

_WRITTEN = ("when", "serial", "operator", "stage", "plan")


class Workers(Protocol):
    """Whoever works on the jobs: `LocalPool`, `Cluster`."""

    def results(self, jobs: Sequence[Job], options: Options) -> Iterator[tuple[Job, Document]]:
        """Each job once with its document, in any order."""


@dataclass(frozen=True)
class Repeated:
    """A file that holds the same session as another, which is the one that counts."""

    path: str
    same_as: str

    def as_dict(self) -> dict[str, str]:
        """`{"path", "same_as"}`."""
        return {"path": self.path, "same_as": self.same_as}


@dataclass(frozen=True)
class Survey:
    """What the files are, before work.

    Attributes
    ----------
    jobs : tuple of Job
        By path.
    repeated : tuple of Repeated
    unreadable : tuple of Document
        Of files without bytes to read.
    """

    jobs: tuple[Job, ...]
    repeated: tuple[Repeated, ...]
    unreadable: tuple[Document, ...]


@dataclass(frozen=True)
class Fleet:
    """Everything that was said of a fleet.

    Attributes
    ----------
    documents : tuple of Document
        One a session, by path: whoever worked on it, and in whatever order.
    repeated : tuple of Repeated
    again : int
        Sessions that were in the journal already.
    """

    documents: tuple[Document, ...]
    repeated: tuple[Repeated, ...]
    again: int

    @property
    def failed(self) -> int:
        """Sessions without a result."""
        return sum(document["record"]["status"] != "ok" for document in self.documents)


def files_of(given: Iterable[str | Path]) -> list[str]:
    """Files as given, and of each folder those that end like a session, in order; each name once.

    Raises
    ------
    UsageError
        There is none.
    """
    found: dict[str, None] = {}
    folders = []
    for path in map(Path, given):
        if not path.is_dir():
            found[str(path)] = None
            continue
        folders.append(str(path))
        shut: list[OSError] = []
        for folder, _, names in os.walk(path, onerror=shut.append):
            inside = [name for name in names if ends_in(name, *ENDINGS) and not name.startswith(".")]
            found |= dict.fromkeys(str(Path(folder, name)) for name in inside)
        found |= dict.fromkeys(str(error.filename) for error in shut)
    if not found:
        where = f" in {', '.join(folders)}" if folders else ""
        raise UsageError(f"there is no session{where}: give files, or folders with {', '.join(ENDINGS)}")
    return sorted(found)


def survey(files: Sequence[str], share: Callable[[float], None] | None = None) -> Survey:
    """Read every file once: the same bytes by two names are one session, that of the first name."""
    names: dict[str, str] = {}
    repeated, unreadable = [], []
    for done, path in enumerate(sorted(set(files))):
        if share is not None:
            share(done / len(files))
        if _special(Path(path)):
            unreadable.append(lost(path, "is no regular file: save what comes through a pipe first"))
            continue
        try:
            digest = digest_of_file(path)
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
    journal: Journal | None = None,
    tell: Callable[[FleetProgress], None] | None = None,
) -> Fleet:
    """Have every session worked on that the journal does not hold.

    Raises
    ------
    OutputError
        The journal cannot be written; what it holds stays.
    FleetError
        Nobody is there to work.
    """
    held = {} if journal is None else journal.documents
    documents = {
        job.path: _named(held[key], job) for job in found.jobs if (key := job.key(options)) in held
    }
    todo = [job for job in found.jobs if job.path not in documents]
    progress = FleetProgress(len(todo), again=len(documents))
    for job, document in workers.results(todo, options) if todo else ():
        if journal is not None and document["final"]:
            journal.keep(job.key(options), document)
        documents[job.path] = document
        progress.arrived(document)
        if tell is not None:
            tell(progress)
    everything = [*documents.values(), *found.unreadable]
    kept, copies = _once(everything)
    repeated = sorted([*found.repeated, *copies], key=lambda one: one.path)
    return Fleet(tuple(kept), tuple(repeated), progress.again)


def _once(documents: Sequence[Document]) -> tuple[list[Document], list[Repeated]]:
    """Without files of other bytes but the same data, such as the CSV exported from an archive."""
    kept, copies, names = [], [], dict[str, str]()
    for document in sorted(documents, key=_lacking):
        path, data = document["record"]["path"], document["record"]["data_sha256"]
        if document["record"]["status"] == "ok" and data in names:
            copies.append(Repeated(path, names[data]))
            continue
        if document["record"]["status"] == "ok" and data:
            names[data] = path
        kept.append(document)
    return sorted(kept, key=_path), copies


def _path(document: Document) -> str:
    return str(document["record"]["path"])


def _lacking(document: Document) -> tuple[int, str]:
    """How much of what an operator writes down a file does not say, then its name."""
    record = document["record"]
    return sum(record[name] is None for name in _WRITTEN), _path(document)


def _named(document: Document, job: Job) -> Document:
    """A document of the journal under the name that the file has now."""
    return {**document, "record": {**document["record"], "path": job.path}}


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

    def arrived(self, document: Document) -> None:
        """Count one."""
        self.done += 1
        self.failed += document["record"]["status"] != "ok"

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
