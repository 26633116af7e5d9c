"""Session files in folders."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.output import ends_in
from adis_gonio.record.database import is_archive

ENDINGS = (".session", ".csv", ".csv.gz")
"""Endings of session files; an archive is known by its content as well."""


def files_of(given: Iterable[str | Path]) -> list[str]:
    """Files as given, and session files of each folder and below, in order; each name once.

    Raises
    ------
    UsageError
        There is none.
    """
    places = list(map(Path, given))
    found = {str(path) for place in places for path in _below(place)}
    if not found:
        folders = ", ".join(str(place) for place in places)
        where = f" in {folders}" if folders else ""
        raise UsageError(f"there is no session{where}: give files, or folders with {', '.join(ENDINGS)}")
    return sorted(found)


def session_files(places: Sequence[str | Path]) -> list[Path]:
    """Absolute paths of session files in folders and below, each once.

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
            raise DataError(f"{place}: is neither a folder nor a file; save what a pipe gives first")
        found |= dict.fromkeys(_below(place.resolve()))
    return list(found)


def _below(place: Path) -> Iterator[Path]:
    """Session files of a folder and below without hidden ones; a file itself.

    A folder that cannot be read is yielded itself, so that it is reported.
    """
    if not place.is_dir():
        yield place
        return
    shut: list[OSError] = []
    for folder, folders, names in os.walk(place, onerror=shut.append):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            path = Path(folder) / name
            # A link that leads nowhere counts by its name, so that it is reported.
            named = ends_in(path, *ENDINGS) or (path.is_file() and is_archive(path))
            if named and not name.startswith("."):
                yield path
    yield from (Path(error.filename) for error in shut)
