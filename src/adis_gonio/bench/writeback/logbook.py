"""The journal on the disk: steps into the archive of a session, and the session that holds them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from adis_gonio.base.errors import SessionError, UsageError
from adis_gonio.bench.writeback.plan import recorded_offsets
from adis_gonio.model.records import Session
from adis_gonio.record.archive import Archive, read_session
from adis_gonio.record.database import is_archive
from adis_gonio.record.write_journal import AFTER, KIND, Operation, WriteStep


class Logbook:
    """Writes an operation's steps to the archive; on return a step is on the disk."""

    def __init__(self, archive: Archive, operation: Operation, now_s: Callable[[], float]) -> None:
        self._archive, self.operation, self._now_s = archive, operation, now_s

    @property
    def steps(self) -> tuple[WriteStep, ...]:
        """Steps so far."""
        return self.operation.steps

    def note(self, step: WriteStep, **facts: Any) -> None:
        """Record a step.

        Raises
        ------
        SessionError
            The file cannot be written, or another program goes on with the session.
        """
        last = self.steps[-1] if self.steps else None
        if step not in AFTER[last]:
            raise UsageError(f"'{step}' does not follow '{last}'")
        self._archive.add_record(
            KIND, {"number": self.operation.number, "step": step, **facts}, self._now_s()
        )
        known = {name: facts[name] for name in ("endurance", "endurance_after") if name in facts}
        self.operation = replace(self.operation, steps=(*self.steps, step), **known)


def load(path: Path) -> Session:
    """Session of an archive.

    Raises
    ------
    SessionError
        Another kind of file (a journal of what is written needs an archive), or not from the chip.
    DataError
        As `read_session`.
    """
    if path.is_file() and not is_archive(path):
        raise SessionError(
            f"{path}: is no session file of calibrate, where the undo of a write is kept: calibrate first"
        )
    session = read_session(path)
    recorded_offsets(session)
    return session
