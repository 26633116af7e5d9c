"""Provenance of a calibration: the facts of its session that a result keeps with the parameters."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.device.sensor.registers import ACCEL_OFF, GYRO_OFF
from adis_gonio.model.records import METADATA, Plane, Session


def digest_of_file(path: str | Path) -> str:
    """Return the SHA-256 digest of a file's content in hexadecimal digits.

    Raises
    ------
    OSError
        The file cannot be read.
    """
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Covered(JsonRecord):
    """Mean, minimum and maximum of the temperature (°C) or supply (V) over the dwells of a session.

    Attributes
    ----------
    mean : float
        Mean of the means of the dwells.
    low, high : float
        Smallest and largest sample.
    """

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class Provenance:
    """Origin of a result: the facts of its session and of the program.

    Attributes
    ----------
    sensor : str
        Variant of the sensor, or `generic`.
    plane : {"xy", "none"}
        Plane in which the stage turned the sensor; "none" for attitudes anywhere in space.
    gravity_mps2 : float
        Local gravity in m/s².
    counts : bool
        True if readings are counts of unknown scale, False if they are in mg.
    title, serial, operator, stage, laboratory, customer : str
        Texts that the operator entered; empty if not stated.
    source : str
        Name of the file, without its folder.
    sha256 : str
        Digest of the session's data (`digest_of`), which does not depend on the kind of file.
    recorded_utc, ended_utc : str
        Begin of the session, and of its last dwell, piece of a free turn or sample (ISO 8601); empty if
        the file does not state them.
    software : str
        Program that made the result.
    temperature_c, supply_v : Covered or None
        Temperature and supply over all samples; None unless every dwell recorded it.
    offsets_lsb : tuple of int or None
        Numbers in XACCL_OFF, YACCL_OFF, ZACCL_OFF during the recording; None if the file does not state
        them.
    written_lsb : tuple of int or None
        Numbers that were written to these registers after the recording; None if nothing was written.
    write_open : bool
        True if a later write to these registers was interrupted, so that only the sensor has the present
        numbers.
    gyro_offsets_lsb, gyro_written_lsb, gyro_write_open
        The corresponding facts of XGYRO_OFF, YGYRO_OFF, ZGYRO_OFF.
    """

    sensor: str
    plane: Plane
    gravity_mps2: float
    counts: bool = False
    title: str = ""
    serial: str = ""
    operator: str = ""
    stage: str = ""
    laboratory: str = ""
    customer: str = ""
    source: str = ""
    sha256: str = ""
    recorded_utc: str = ""
    ended_utc: str = ""
    software: str = ""
    temperature_c: Covered | None = None
    supply_v: Covered | None = None
    offsets_lsb: tuple[int, int, int] | None = None
    written_lsb: tuple[int, int, int] | None = None
    write_open: bool = False
    gyro_offsets_lsb: tuple[int, int, int] | None = None
    gyro_written_lsb: tuple[int, int, int] | None = None
    gyro_write_open: bool = False


_FROM_SESSION = ("sensor", "plane", "gravity_mps2", "title", *METADATA)


def provenance_of(session: Session) -> Provenance:
    """Return the provenance of a session's results; it is computed once and kept with the session."""
    return session.once(_provenance)


def _provenance(session: Session) -> Provenance:
    from adis_gonio.base import __version__

    return Provenance(
        **{name: getattr(session, name) for name in _FROM_SESSION},
        counts=session.accel_unit == "counts",
        source=PurePath(session.source).name,
        sha256=digest_of(session),
        recorded_utc=str(session.facts.get("started_utc") or ""),
        ended_utc=str(session.facts.get("ended_utc") or ""),
        temperature_c=_coverage([dwell.temperature_c for dwell in session.dwells]),
        supply_v=_coverage([dwell.supply_v for dwell in session.dwells]),
        software=f"adis-gonio {__version__}",
        offsets_lsb=_offsets(session.facts, ACCEL_OFF),
        **_later_writes(session, ACCEL_OFF),
        gyro_offsets_lsb=_offsets(session.facts, GYRO_OFF),
        **{f"gyro_{name}": value for name, value in _later_writes(session, GYRO_OFF).items()},
    )


def changed_registers(session: Session) -> list[str]:
    """Return messages about registers that changed during the recording; empty if none changed.

    After such a change the fitted biases are a mixture of the biases before and after it.
    """
    doubts = session.facts.get("doubts") or []
    return [str(doubt["message"]) for doubt in doubts if doubt["kind"] == "registers"]


def digest_of(session: Session) -> str:
    """Return the SHA-256 digest of a session's data in hexadecimal digits.

    The digest covers sensor, unit, plane and all dwells, or the recording of a free turn. An archive and
    the CSV exported from it have equal digests.
    """
    digest = hashlib.sha256(f"{session.sensor} {session.accel_unit} {session.plane}".encode())
    for dwell in session.sampled:
        digest.update(f"{dwell.angle_deg!r} {dwell.approach} {dwell.use} {len(dwell)}".encode())
        for series in (dwell.time_s, dwell.accel, dwell.temperature_c, dwell.supply_v):
            if series is not None:
                digest.update(np.ascontiguousarray(series, dtype="<f8").data)
    return digest.hexdigest()


def _coverage(series: list[Floats | None]) -> Covered | None:
    rows = [one for one in series if one is not None and len(one)]
    if not rows or len(rows) != len(series):
        return None
    means = [float(one.mean()) for one in rows]
    low, high = min(float(one.min()) for one in rows), max(float(one.max()) for one in rows)
    return Covered(float(np.mean(means)), low, high) if np.isfinite([*means, low, high]).all() else None


def _later_writes(session: Session, registers: tuple[str, ...]) -> dict[str, Any]:
    held = _offsets(session.facts, registers)
    if held is None or not session.facts.get("offset_writes"):
        return {}
    from adis_gonio.record.write_journal import operations_of

    known = operations_of(session, registers)
    if not known:
        return {}
    last = known[-1]
    if last.open:
        return {"write_open": True}
    pairs = zip(registers, held, strict=True)
    return {"written_lsb": tuple(last.target.get(name, number) for name, number in pairs)}


def _offsets(facts: Mapping[str, Any], registers: tuple[str, ...]) -> tuple[int, int, int] | None:
    held = ((facts.get("registers") or {}).get("configured")) or {}
    numbers = [held.get(name) for name in registers]
    if any(not isinstance(number, int) for number in numbers):
        return None
    x, y, z = (int(number) for number in numbers if number is not None)
    return x, y, z
