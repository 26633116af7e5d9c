"""A session as text for other programs: samples CSV and JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from adis_gonio.base.errors import DataError, OutputError, SessionError
from adis_gonio.base.output import exists_error, replacing, write_utf8
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record.samples.columns import KEYS
from adis_gonio.record.samples_csv import write_samples_csv


def export_csv(session: Session, path: str | Path) -> None:
    """Write the samples CSV (gzipped where the name ends in `.gz`).

    What the format has no key for (registers, configuration, truth) stays behind; `export_json` has it.

    Raises
    ------
    UsageError
        The file exists.
    SessionError
        It cannot be written.
    DataError
        As `write_samples_csv`.
    """
    with _new_file(path) as beside:
        write_csv(session, beside)


def write_csv(session: Session, path: Path) -> None:
    """Write the samples CSV to a file that is still called otherwise; `DataError` names the session."""
    try:
        write_samples_csv(session, path)
    except DataError as error:
        told = str(error).removeprefix(f"{path.name}: ")
        raise DataError(f"{session.source or 'session'}: {told}") from None


def export_json(session: Session, path: str | Path) -> None:
    """Write everything that the session holds, samples included, as one JSON document.

    Raises
    ------
    UsageError
        The file exists.
    SessionError
        It cannot be written.
    DataError
        A value has no JSON form.
    """
    with _new_file(path) as beside:
        try:
            text = json.dumps(session_dict(session), ensure_ascii=False, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise DataError(f"{session.source or 'session'}: has no JSON form: {error}") from None
        write_utf8(beside, text + "\n")


def session_dict(session: Session) -> dict[str, Any]:
    """JSON form of a session; units as in `Session`, `fixture_sigma_deg` is "free" where it is infinite."""
    stated = {name: getattr(session, name) for name in KEYS if hasattr(session, name)}
    if session.free_attitudes:
        stated["fixture_sigma_deg"] = "free"
    return {
        **stated,
        "source": session.source,
        "notes": list(session.notes),
        "facts": session.facts,
        "dwells": [_dwell_dict(dwell) for dwell in session.sampled],
    }


def _dwell_dict(dwell: Dwell) -> dict[str, Any]:
    declared = {name: getattr(dwell, name) for name in ("position", "angle_deg", "approach", "use")}
    series = {n: getattr(dwell, n) for n in ("time_s", "accel", "gyro", "temperature_c", "supply_v")}
    return declared | {name: None if values is None else values.tolist() for name, values in series.items()}


@contextmanager
def _new_file(path: str | Path) -> Iterator[Path]:
    """Path beside a file that does not exist yet, which takes its place at the end."""
    path = Path(path)
    if path.exists():
        raise exists_error(path)
    try:
        with replacing(path) as beside:
            yield beside
    except OutputError as error:
        raise SessionError(str(error)) from None
