"""Output files: written to a temporary file and renamed, so that a failure leaves the old file or none."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from adis_gonio.base.errors import OutputError, UsageError


def ends_in(path: str | Path, *endings: str) -> bool:
    """Return True if a file name has one of these endings, in capital or small letters."""
    return Path(path).name.lower().endswith(endings)


def exists_error(path: str | Path, cure: str = "choose another name") -> UsageError:
    """Return the error for a file that exists and must not be overwritten; `cure` is advice to the user."""
    return UsageError(f"{path}: exists already; {cure} (nothing was changed)")


def check_output(
    path: str | Path, *, force: bool = False, cure: str = "choose another name, or --force to replace it"
) -> Path:
    """Check, before a long computation, that its output file can be written afterwards.

    Parameters
    ----------
    force : bool
        Replace a file that exists.
    cure : str
        Advice in the error for a file that exists.

    Raises
    ------
    UsageError
        The file exists and `force` is not set, or the path is a folder.
    OutputError
        Its folder does not exist or cannot be written to.
    """
    path = Path(path)
    if path.is_dir():
        raise UsageError(f"{path}: is a folder; name a file in it")
    if path.is_file() and not force:
        raise exists_error(path, cure)
    folder = path.resolve().parent
    if not folder.is_dir():
        raise OutputError(f"{path}: cannot be written: there is no folder {folder}")
    if not os.access(folder, os.W_OK | os.X_OK) and not _special(path):
        raise OutputError(f"{path}: cannot be written: no permission to write to {folder}")
    return path


def write_utf8(path: Path, text: str) -> int:
    """Write a text as UTF-8 and return the number of bytes; a lone surrogate becomes a question mark.

    UTF-8 has no lone surrogates, but an undecodable file name or a JSON text may contain them.
    """
    return path.write_bytes(text.encode("utf-8", "replace"))


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path; its file replaces `path` if the block ends without an exception.

    After any exception (a full disk, Ctrl-C) the temporary file is removed and `path` is unchanged. The
    temporary path has the ending of `path`, because some writers choose a format by it. For a symbolic
    link the target is replaced; a special file (`/dev/stdout`, a pipe) is written directly.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    path = Path(path)
    if _special(path):
        yield path
        return
    target = path.resolve()
    try:
        temporary = _create_temporary(target)
    except OSError as error:
        raise _unwritten(path, error) from error
    try:
        yield temporary
        _flushed(temporary)
        temporary.replace(target)
    except OSError as error:
        if error.filename is not None and Path(os.fsdecode(error.filename)) not in (temporary, target):
            raise  # the error is about another file
        raise _unwritten(path, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text to a file as UTF-8, completely or not at all; an existing file is replaced.

    A lone surrogate becomes a question mark (`write_utf8`). Raises `OutputError` if the file cannot be
    written.
    """
    with replacing(path) as temporary:
        write_utf8(temporary, text)


def _special(path: Path) -> bool:
    return path.exists() and not path.is_file() and not path.is_dir()


def _create_temporary(target: Path) -> Path:
    """Create an empty temporary file in the folder of `target`, and return its path.

    The new file has the permissions of `target`, or default permissions if `target` does not exist.
    """
    for number in count():
        temporary = target.with_name(f".{os.getpid()}-{number}.part-{target.name}")
        try:
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        except FileExistsError:
            continue
        if target.is_file():
            temporary.chmod(target.stat().st_mode & 0o777)
        return temporary
    raise AssertionError("unreachable")


def _flushed(path: Path) -> None:
    """Flush the content of a file to the disk.

    This precedes the renaming of the file, so that a power cut leaves either the old or the new file.
    """
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def flush_names(folder: Path) -> None:
    """Flush the names of a folder's files to the disk, so that no power cut undoes a renaming.

    Nothing happens if the system or the file system cannot do that.
    """
    if not hasattr(os, "O_DIRECTORY"):
        return
    with suppress(OSError):
        number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def _unwritten(path: Path, error: OSError) -> OutputError:
    return OutputError(f"{path}: cannot be written: {error.strerror or error}")
