"""What is done with one session of a fleet: the same wherever it is done."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adis_gonio.base.jsonable import Record
from adis_gonio.base.version import __version__

if TYPE_CHECKING:
    from adis_gonio.model.records import Session

Document = dict[str, Any]
"""What a worker returns: `record` (a row of the summary), `evidence` (for the population trace, or None),
`final` (false where another run of the same file may end otherwise)."""


@dataclass(frozen=True)
class Options(Record):
    """What is asked of every session.

    Attributes
    ----------
    trace : bool
        Trace the residual too: seconds a session, where a fit takes tenths.
    evidence : bool
        Compute what `adis_gonio.fleet.population` needs of it.
    """

    trace: bool = True
    evidence: bool = False


@dataclass(frozen=True)
class Job:
    """One session: its file, and the SHA-256 of the file's bytes."""

    path: str
    digest: str

    def key(self, options: Options) -> str:
        """Name of the result: the same bytes, options and version give the same."""
        parts = [self.digest, options.as_dict(), __version__]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def digest_of_file(path: str | Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal.

    Raises
    ------
    OSError
        It cannot be read.
    """
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def lost(path: str, reason: str) -> Document:
    """What stands for a session that nobody could work on: a failed row, and not the last word."""
    from adis_gonio.fleet.memory.record import SessionRecord

    record = SessionRecord(path, status="failed", reason=f"{path}: {reason}")
    return {"record": record.as_dict(), "evidence": None, "final": False}


def work(path: str, digest: str, options: Mapping[str, bool], version: str) -> Document:
    """Fit and trace one session; a file that cannot be used is a failed row with its reason.

    Parameters
    ----------
    path, digest : str
        As in `Job`; a file that is not that one is not worked on.
    options : mapping
        `Options.as_dict()`.
    version : str
        Of adis-gonio, where the fleet is run from.
    """
    if version != __version__:
        return lost(path, f"the worker has adis-gonio {__version__}, the fleet is run by {version}")
    try:
        own = digest_of_file(path)
    except OSError as error:
        return lost(path, f"cannot be read where the worker is: {error.strerror or error}")
    if own != digest:
        return lost(path, "is not the same file where the worker is, or was changed meanwhile")
    from adis_gonio.fleet.memory.record import record_and_session

    record, session = record_and_session(path, trace=options["trace"])
    asked = options["evidence"] and record.status == "ok"
    evidence = _evidence(session) if asked and session is not None else None
    return {"record": record.as_dict(), "evidence": evidence, "final": True}


def _evidence(session: Session) -> Document | None:
    """What a population needs of a session; None where it has nothing to say there, as one pose has not."""
    from adis_gonio.base.errors import AdisGonioError
    from adis_gonio.fleet.population import evidence_of

    try:
        return evidence_of(session).as_dict()
    except AdisGonioError:
        return None
