"""A session from a file, whatever wrote it: `load_session`."""

from __future__ import annotations

from pathlib import Path

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.model.records import Session
from adis_gonio.record.overrides import Overrides

_SQLITE_MAGIC = b"SQLite format 3\x00"


def load_session(path: str | Path, overrides: Overrides | None = None) -> Session:
    """Session of an archive (SQLite, written by `calibrate` or `simulate`) or of a samples CSV.

    The kind is told by the first bytes, not by the name.

    Parameters
    ----------
    path : str or Path
    overrides : Overrides, optional
        What the file should have said.

    Raises
    ------
    DataError
        One line that names the file and, where there is one, the row: not there, another kind of file,
        truncated, or with content that cannot be used.
    UsageError
        An override that this file cannot take.
    """
    path, overrides = Path(path), overrides or Overrides()
    if path.is_dir():
        raise DataError(f"{path}: is a folder; give a file written by calibrate or simulate, or a CSV")
    try:
        with path.open("rb") as file:
            head = file.read(len(_SQLITE_MAGIC))
    except FileNotFoundError as error:
        raise DataError(f"{path}: there is no such file") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    if head == _SQLITE_MAGIC:
        from adis_gonio.record.archive import read_session

        if overrides.columns:
            raise UsageError(f"{path}: columns are named for a CSV; this is a session of calibrate")
        return overrides.apply(read_session(path))
    from adis_gonio.record.samples_csv import read_samples_csv

    return read_samples_csv(path, overrides)
