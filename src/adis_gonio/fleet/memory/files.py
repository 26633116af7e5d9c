"""Session files in folders, and what tells a changed file from the same one."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from adis_gonio.base.errors import DataError
from adis_gonio.base.output import ends_in
from adis_gonio.record.database import is_archive

ENDINGS = (".session", ".csv", ".csv.gz")
"""Names that are taken for sessions whatever is in them; an archive is known by its content as well."""


@dataclass(frozen=True)
class Stamp:
    """Length and times of a file: as long as they are the same, so is its content."""

    size: int
    mtime_ns: int
    ctime_ns: int

    @classmethod
    def of(cls, path: Path) -> Stamp:
        """Stamp of a file as it is now; `OSError` where it is not there."""
        now = path.stat()
        return cls(now.st_size, now.st_mtime_ns, now.st_ctime_ns)


def session_files(places: Sequence[str | Path]) -> Iterator[Path]:
    """Absolute paths of session files in folders and below, each once; what is hidden is left out.

    A folder that cannot be looked into comes as a path of its own, so that somebody is told.

    Raises
    ------
    DataError
        A place is not there, or is no folder and no file.
    """
    seen: set[Path] = set()
    for place in map(Path, places):
        if not place.exists():
            raise DataError(f"{place}: there is no such folder")
        if not (place.is_dir() or place.is_file()):
            raise DataError(f"{place}: is neither a folder nor a file; save what a pipe gives first")
        for path in _below(place):
            if path not in seen:
                seen.add(path)
                yield path


def _below(place: Path) -> Iterator[Path]:
    if place.is_file():
        yield place.resolve()
        return
    shut: list[OSError] = []
    for folder, folders, names in os.walk(place.resolve(), onerror=shut.append):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            path = Path(folder) / name
            if not name.startswith(".") and _is_session(path):
                yield path
    for error in shut:
        yield Path(error.filename)


def _is_session(path: Path) -> bool:
    """By name or content; a link that leads nowhere by its name, so that somebody is told."""
    named = ends_in(path, *ENDINGS)
    if path.is_file():
        return named or is_archive(path)
    return named and path.is_symlink() and not path.exists()
