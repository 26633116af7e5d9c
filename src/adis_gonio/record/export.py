"""A session as text for other programs: samples CSV and JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError, OutputError, SessionError
from adis_gonio.base.output import exists_error, replacing, write_utf8
from adis_gonio.model.records import Dwell, Session
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
    path = _new(path)
    try:
        with replacing(path) as beside:
            write_csv(session, beside)
    except OutputError as error:
        raise SessionError(str(error)) from None


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
    path = _new(path)
    try:
        text = json.dumps(session_dict(session), ensure_ascii=False, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise DataError(f"{session.source or 'session'}: has no JSON form: {error}") from None
    try:
        with replacing(path) as beside:
            write_utf8(beside, text + "\n")
    except OutputError as error:
        raise SessionError(str(error)) from None


def session_dict(session: Session) -> dict[str, Any]:
    """JSON form of a session; units as in `Session`, `fixture_sigma_deg` is "free" where it is infinite."""
    sigma = session.fixture_sigma_deg
    return {
        "sensor": session.sensor,
        "title": session.title,
        "operator": session.operator,
        "serial": session.serial,
        "stage": session.stage,
        "source": session.source,
        "accel_unit": session.accel_unit,
        "gyro_unit": session.gyro_unit,
        "gravity_mps2": session.gravity_mps2,
        "fixture_sigma_deg": "free" if sigma is not None and math.isinf(sigma) else sigma,
        "plane": session.plane,
        "reading_u_mg": session.reading_u_mg,
        "notes": list(session.notes),
        "facts": session.facts,
        "dwells": [_dwell_dict(dwell) for dwell in session.sampled],
    }


def _dwell_dict(dwell: Dwell) -> dict[str, Any]:
    def listed(values: Floats | None) -> Any:
        return None if values is None else values.tolist()

    return {
        "position": dwell.position,
        "angle_deg": dwell.angle_deg,
        "approach": dwell.approach,
        "use": dwell.use,
        "time_s": listed(dwell.time_s),
        "accel": listed(dwell.accel),
        "gyro": listed(dwell.gyro),
        "temperature_c": listed(dwell.temperature_c),
        "supply_v": listed(dwell.supply_v),
    }


def _new(path: str | Path) -> Path:
    path = Path(path)
    if path.exists():
        raise exists_error(path)
    return path
