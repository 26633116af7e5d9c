"""The archive's tables: SQL, type and range of every column, classes for the rows, and the checksum.

A checksum detects damage, but not a forged value with a matching checksum. Therefore every value of a
session file goes through `checked_row`. Kinds of records that `RECORDS` does not list are read by no
program, and their values are not checked.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal

import numpy as np

from adis_gonio.base import __version__
from adis_gonio.base.jsonable import json_value
from adis_gonio.base.shapes import (
    Shape,
    ShapeError,
    anything,
    blob,
    checked_value,
    choice,
    fields,
    list_of,
    mapping_of,
    moment,
    nullable,
    number,
    text,
    truth_value,
    whole,
)
from adis_gonio.device.sensor.registers import ACCEL_OFF, BY_NAME, GYRO_LSB_DPS, GYRO_OFF, VARIANTS
from adis_gonio.model.records import METADATA
from adis_gonio.record.blocks import GENERIC, UNITS, Block
from adis_gonio.record.plans import MOST_POSITIONS, Plan, Position

Phase = Literal["before", "dwell", "after"]
Outcome = Literal["complete", "interrupted"]

JsonDict = dict[str, Any]


@dataclass(frozen=True)
class Move:
    """A move of the stage by the program.

    Attributes
    ----------
    bus_s : float
        Time at which the move begins on the bus's clock, in s.
    angle_deg : float or None
        Angle of the stage to which it moves; None for a move in space.
    approach : {1, -1, 0}
        Direction of travel in which the angle is reached; 0 for a move in space.
    direction : tuple of 3 float or None
        Attitude to which it moves in space: the reading of an ideal sensor there, in units of G. None for a
        move in the plane.
    turned_deg : float or None
        Turn of the sensor about the vertical, positive counter-clockwise seen from above; None for other
        moves.
    """

    bus_s: float
    angle_deg: float | None
    approach: int
    direction: tuple[float, float, float] | None = None
    turned_deg: float | None = None

    @property
    def aim(self) -> list[float] | dict[str, float] | None:
        """Target of the move in space, as stored: a direction, a turn about the vertical, or None."""
        if self.turned_deg is not None:
            return {"turned_deg": self.turned_deg}
        return None if self.direction is None else list(self.direction)


@dataclass(frozen=True)
class Attempt:
    """One attempt to record a dwell: to be stored with its samples, or read back without them.

    Attributes
    ----------
    place : int
        Number of the position in the plan, from 0.
    position : Position
        This position: declared angle, approach and use.
    outcome : {"complete", "interrupted"}
        `complete` if the dwell was recorded to its end.
    started_utc : str
        Time of its beginning by the wall clock, ISO 8601, UTC.
    started_bus_s, ended_bus_s : float
        Times of its beginning and end on the bus's clock, in s.
    blocks : sequence of (phase, Block)
        All scans in order; scans of phase `dwell` are the samples of the dwell. Empty if read back.
    moves : sequence of Move
        Moves of the stage for this attempt. Empty if read back.
    reason : str
        Reason of an interruption; empty for a complete dwell.
    status : int or None
        Content of the register STATUS after the attempt; None if it was not read.
    number : int
        Number of the attempt, from 1, in the order of recording; 0 until it is stored, like the next ones.
    run : int
        Number of the run (opening of the session) to which it belongs.
    offset_s : float
        Seconds to add to a time on the bus's clock to get the time since the session began.
    registers : tuple of str
        Names of the columns of its samples; empty without samples.
    variant : str
        Variant of the sensor; empty without samples.
    gyro_range_dps : int or None
        Range of the gyros in °/s; None if it is unknown or there are no samples.
    stored_blocks : int
        Number of its blocks of samples in the file.
    """

    place: int
    position: Position
    outcome: Outcome
    started_utc: str
    started_bus_s: float
    ended_bus_s: float
    blocks: Sequence[tuple[Phase, Block]] = ()
    moves: Sequence[Move] = ()
    reason: str = ""
    status: int | None = None
    number: int = 0
    run: int = 0
    offset_s: float = 0.0
    registers: tuple[str, ...] = ()
    variant: str = ""
    gyro_range_dps: int | None = None
    stored_blocks: int = 0


@dataclass(frozen=True)
class Header:
    """Facts of a session that are fixed when it begins.

    Attributes
    ----------
    url, variant : str
        URL of the bus, and variant of the sensor.
    plan : Plan
        Plan at the beginning; an extension is stored as a record.
    settings : mapping
        JSON form of the session's `Settings`.
    gravity_mps2 : float
        Local gravity in m/s².
    fixture_sigma_deg : float or None
        Standard uncertainty of a declared angle in degrees; `inf` if attitudes are free, None if not
        stated.
    title, note, operator, serial, stage, laboratory, customer : str
        Texts that the operator entered; all but the first two are empty in sessions of older programs.
    stage_curve : mapping or None
        JSON form of the stage's errors of angle according to its certificate; None without a certificate.
    simulated : bool
        True if the bus is simulated, so that the true parameters are known.
    created_utc : str
        Time of creation, ISO 8601, UTC; empty until the file is created.
    software : str
        Name and version of the program that created the file.
    """

    url: str
    variant: str
    plan: Plan
    settings: Mapping[str, Any]
    gravity_mps2: float
    fixture_sigma_deg: float | None
    title: str = ""
    note: str = ""
    operator: str = ""
    serial: str = ""
    stage: str = ""
    laboratory: str = ""
    customer: str = ""
    stage_curve: Mapping[str, Any] | None = None
    simulated: bool = False
    created_utc: str = ""
    software: str = field(default=f"adis-gonio {__version__}")


def utc_now() -> str:
    """Return the present UTC time as ISO 8601 text with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def checksum(*values: Any) -> int:
    """Return the CRC-32 of the values of a row; bytes count as they are, other values as JSON text."""
    plain = [value for value in values if not isinstance(value, bytes)]
    blobs = [value for value in values if isinstance(value, bytes)]
    return zlib.crc32(b"".join([json.dumps(plain).encode(), *blobs]))


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")


APPLICATION_ID = 0x4144474F
"""Application id in the header of a session file (the letters `ADGO`), by which it is recognised."""
SCHEMA_VERSION = 1

LARGEST_S = 1e10
"""Largest magnitude of a time in s: three hundred years; clocks that count from 1970 are far below it."""
LARGEST_VALUE = 1e9
"""Largest magnitude of a sample or a parameter in its unit."""
LEAST_FIXTURE_DEG = 1e-9
"""Smallest standard uncertainty of a declared angle in degrees, apart from 0."""
_MOST = 10**9
"""Largest count or row number."""

_COUNT = whole(0, _MOST)
_TIME = number(-LARGEST_S, LARGEST_S)
_LENGTH = number(0.0, LARGEST_S)
_ANGLE = number(-1e6, 1e6)
_VALUE = number(-LARGEST_VALUE, LARGEST_VALUE)
_APPROACH = choice(-1, 0, 1)
_USE = choice("fit", "check")
_VECTOR = list_of(number(-1e6, 1e6), 3, 3)
_TEXTS = list_of(text, 0, 10_000)
_REGISTER_NUMBERS = mapping_of(whole(-0x8000, 0xFFFF))
_OFFSETS = fields({}, {name: whole(*BY_NAME[name].range) for name in (*ACCEL_OFF, *GYRO_OFF)})
_SCAN = list_of(choice(*BY_NAME, *UNITS), 0, len(BY_NAME))
_RANGE = nullable(choice(*GYRO_LSB_DPS))
_NUMBERING = {"smpl_prd": whole(1, 0xFF), "filter_m": whole(0, 6)}

_POSITION = fields(
    {"angle_deg": nullable(_ANGLE), "approach": _APPROACH, "use": _USE, "direction": nullable(_VECTOR)},
    {"wait_s": _LENGTH, "turned_deg": nullable(_ANGLE)},
)
_PLAN = fields(
    {"name": text, "plane": choice("xy", "none"), "positions": list_of(_POSITION, 1, 10 * MOST_POSITIONS)},
    {"turns": whole(0, 10_000)},
)
_SETTINGS = fields(
    {},
    {
        "dwell_s": _LENGTH,
        "settle_s": _LENGTH,
        "still_timeout_s": _LENGTH,
        **_NUMBERING,
        "gyro_range_dps": _RANGE,
        "data_ready": nullable(truth_value),
        "registers": _SCAN,
        "turns": truth_value,
    },
    others=anything,
)


def _fixture(value: Any) -> None:
    # The square of an angle between 0 and this limit would underflow.
    if value not in ("free", 0):
        nullable(number(LEAST_FIXTURE_DEG, 1e6))(value)


_CURVE = list_of(number(-1e6, 1e6), 2, 3600)
_STAGE_CURVE = fields(
    {
        "name": text,
        **dict.fromkeys(("angle_deg", "error_deg"), _CURVE),
        "covariance_deg2": list_of(_CURVE, 2, 3600),
    }
)
META = fields(
    {
        "url": text,
        "variant": choice(*VARIANTS, GENERIC),
        "plan": _PLAN,
        "settings": _SETTINGS,
        "gravity_mps2": number(1e-6, 1e6),
        "fixture_sigma_deg": _fixture,
    },
    {
        "simulated": truth_value,
        "created_utc": moment,
        "stage_curve": nullable(_STAGE_CURVE),
        **dict.fromkeys(("title", "note", *METADATA, "software"), text),
    },
)
"""Checks of the values in the table `meta`, one for each key: the fields of `Header`."""

_DOUBT = {"kind": text, "message": text}
_SUMMARY = fields(
    {
        "dwells": _COUNT,
        "adequate": truth_value,
        "tested": truth_value,
        "found": _TEXTS,
        "uncertain": _TEXTS,
        "confounded": list_of(list_of(text, 1, 10_000), 0, 10_000),
        "error": fields(
            dict.fromkeys(
                ("residual_rms_mg", "heldout_rms_mg", "angle_rms_deg", "chi2_per_dof"), nullable(_VALUE)
            ),
            others=anything,
        ),
    },
    others=anything,
)


def _summary(value: Any) -> None:
    """Check the summary of a trace in a record of kind `advised` (an advisor's answer); it may be empty."""
    if value not in (None, {}):
        _SUMMARY(value)


RECORDS: Mapping[str, Shape] = {
    "plan": _PLAN,
    **dict.fromkeys(("registers-before", "registers-configured", "registers-after"), _REGISTER_NUMBERS),
    "configuration": fields(
        {},
        {
            **_NUMBERING,
            "gyro_range_dps": _RANGE,
            "sample_rate_hz": number(1e-6, 1e9),
            **dict.fromkeys(("data_ready", "linear_g", "origin"), truth_value),
        },
        others=anything,
    ),
    "truth": mapping_of(_VALUE),
    "noise": list_of(number(0.0, LARGEST_VALUE), 3, 3),
    "scanning": fields({"how": text, "caveat": text}, others=anything),
    "problem": fields({}, others=anything),
    "advised": fields(
        {"planned": _COUNT, "ended": text, "summary": _summary},
        {"round": _COUNT, "positions": _COUNT, "reasons": _TEXTS},
        others=anything,
    ),
    "reversed": truth_value,
    "skipped": _COUNT,
    "withdrawn": _COUNT,
    "dropped": fields({"attempt": _COUNT, "scans": _COUNT}),
    "doubt": fields({"attempt": _COUNT, **_DOUBT}),
    "contradiction": fields({"place": _COUNT, "dwells": list_of(_COUNT, 0, _MOST), **_DOUBT}),
    "offsets": fields(
        {
            "number": _COUNT,
            "step": choice("planned", "written", "verified", "saving", "saved", "done", "set-back"),
        },
        {
            "op": choice("write", "undo", "autonull"),
            **dict.fromkeys(("old", "new", "found", "beside"), _OFFSETS),
            "save": truth_value,
            **dict.fromkeys(("endurance", "endurance_after"), nullable(_COUNT)),
        },
        others=anything,
    ),
}
"""Check of the value of a record, by the record's kind."""


def _aim(value: Any) -> None:
    """Check the stored target of a move: null, a direction in space, or a turn."""
    if isinstance(value, dict):
        fields({"turned_deg": _ANGLE})(value)
    else:
        nullable(_VECTOR)(value)


@dataclass(frozen=True)
class TableColumn:
    """A column of a table.

    Attributes
    ----------
    name : str
        Name of the column.
    sql : str
        SQL type and constraints.
    shape : Shape
        Check of a value; it raises `ShapeError` for a wrong type or a value out of range.
    json : bool
        True if the column has JSON text; the check then applies to the parsed value.
    """

    name: str
    sql: str
    shape: Shape
    json: bool = False

    def stored(self, value: Any) -> Any:
        """Convert a value to the type in which the column stores it: JSON text, or float for REAL."""
        if self.json:
            # NaN and infinities are refused, because JSON does not allow them.
            return json.dumps(value, ensure_ascii=False, allow_nan=False, default=_plain)
        return float(value) if self.sql.startswith("REAL") and value is not None else value

    def checked(self, value: Any, where: str) -> Any:
        """Return a stored value, with JSON parsed; raise `ShapeError` if it is wrong.

        The message of the error begins with `where` and the name of the column.
        """
        name = f"{where}{self.name}"
        if self.json:
            if not isinstance(value, str):  # of any length, because the JSON of a long plan is long
                raise ShapeError(f"{name} is no text")
            try:
                value = json_value(value)
            except ValueError as error:
                raise ShapeError(f"{name}: {error}") from None
        return checked_value(name, self.shape, value)


_RUN = _ATTEMPT = whole(1, _MOST)
_KEY, _INTEGER, _REAL, _TEXT = "INTEGER PRIMARY KEY", "INTEGER NOT NULL", "REAL NOT NULL", "TEXT NOT NULL"
_OF_RUN, _OF_ATTEMPT = f"{_INTEGER} REFERENCES runs", f"{_INTEGER} REFERENCES attempts"


def _one_of(name: str, *allowed: str) -> TableColumn:
    """Return a text column of this name that allows only the given words."""
    listed = ", ".join(f"'{text}'" for text in allowed)
    return TableColumn(name, f"{_TEXT} CHECK ({name} IN ({listed}))", choice(*allowed))


TABLES: Mapping[str, tuple[TableColumn, ...]] = {
    "meta": (
        TableColumn("key", "TEXT PRIMARY KEY", text),
        TableColumn("value", _TEXT, anything, json=True),
    ),
    "runs": (
        TableColumn("run", _KEY, _RUN),
        TableColumn("started_utc", _TEXT, text),
        TableColumn("bus_s", _REAL, _TIME),
        TableColumn("clock_offset_s", _REAL, _TIME),
        TableColumn("continues", _INTEGER, _COUNT),
        TableColumn("software", _TEXT, text),
    ),
    "records": (
        TableColumn("record", _KEY, whole(1, _MOST)),
        TableColumn("run", _OF_RUN, _RUN),
        TableColumn("utc", _TEXT, text),
        TableColumn("bus_s", _REAL, _TIME),
        TableColumn("kind", _TEXT, text),
        TableColumn("value", _TEXT, anything, json=True),
    ),
    "attempts": (
        TableColumn("attempt", _KEY, _ATTEMPT),
        TableColumn("run", _OF_RUN, _RUN),
        TableColumn("place", _INTEGER, _COUNT),
        TableColumn("angle_deg", "REAL", nullable(_ANGLE)),
        TableColumn("approach", _INTEGER, _APPROACH),
        _one_of("use", "fit", "check"),
        _one_of("outcome", "complete", "interrupted"),
        TableColumn("reason", _TEXT, text),
        TableColumn("started_utc", _TEXT, text),
        TableColumn("started_bus_s", _REAL, _TIME),
        TableColumn("ended_bus_s", _REAL, _TIME),
        TableColumn("registers", _TEXT, _SCAN, json=True),
        TableColumn("variant", _TEXT, choice("", *VARIANTS, GENERIC)),
        TableColumn("gyro_range_dps", "INTEGER", _RANGE),
        TableColumn("status", "INTEGER", nullable(whole(0, 0xFFFF))),
        TableColumn("blocks", _INTEGER, _COUNT),
    ),
    "blocks": (
        TableColumn("attempt", _OF_ATTEMPT, _ATTEMPT),
        TableColumn("sequence", _INTEGER, _COUNT),
        _one_of("phase", "before", "dwell", "after"),
        TableColumn("scans", _INTEGER, _COUNT),
        TableColumn("lost", _INTEGER, _COUNT),
        TableColumn("words", "BLOB NOT NULL", blob),
        TableColumn("time_s", "BLOB NOT NULL", blob),
    ),
    "moves": (
        TableColumn("move", _KEY, whole(1, _MOST)),
        TableColumn("attempt", _OF_ATTEMPT, _ATTEMPT),
        TableColumn("bus_s", _REAL, _TIME),
        TableColumn("angle_deg", "REAL", nullable(_ANGLE)),
        TableColumn("approach", _INTEGER, _APPROACH),
        TableColumn("direction", _TEXT, _aim, json=True),
    ),
}
"""Columns of each table by the table's name, without the last one, which is the checksum of the row."""


def statements() -> list[str]:
    """Return the SQL statements that create the tables of an empty archive, to be run in one transaction.

    An archive is refused if its SQL differs from this text in any character, so the text must not change.
    """
    create = []
    for table, columns in TABLES.items():
        width = max(len(column.name) for column in columns)
        lines = [f"{column.name:{width}} {column.sql}" for column in columns]
        lines.append(f"{'crc32':{width}} {_INTEGER}")
        lines += ["PRIMARY KEY (attempt, sequence)"] if table == "blocks" else []
        create.append(f"CREATE TABLE {table} (\n    " + ",\n    ".join(lines) + "\n)")
    guards = [
        f"CREATE TRIGGER {table}_no_{verb.lower()} BEFORE {verb} ON {table}"
        f" BEGIN SELECT RAISE(ABORT, 'a session file is append-only'); END"
        for table in TABLES
        for verb in ("UPDATE", "DELETE")
    ]
    return [
        *create,
        *guards,
        f"PRAGMA application_id = {APPLICATION_ID}",
        f"PRAGMA user_version = {SCHEMA_VERSION}",
    ]


def checked_row(table: str, row: Sequence[Any], where: str) -> dict[str, Any]:
    """Check the values of a row of a table, and return them by column name, with JSON parsed.

    `row` has the values in the order of the columns, without the checksum.

    Raises
    ------
    ShapeError
        A value has a wrong type or is out of range; the message begins with `where` and the name of the
        column.
    """
    columns = zip(TABLES[table], row, strict=True)
    return {column.name: column.checked(value, where) for column, value in columns}
