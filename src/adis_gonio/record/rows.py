"""Rows of the archive as plain data, and the checksum that each row carries."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal

import numpy as np

from adis_gonio.base import __version__
from adis_gonio.record.blocks import Block
from adis_gonio.record.plans import Plan, Position

Phase = Literal["before", "dwell", "after"]
Outcome = Literal["complete", "interrupted"]

JsonDict = dict[str, Any]


@dataclass(frozen=True)
class Move:
    """A move of the stage by the program, at `bus_s` on the clock of the bus.

    Attributes
    ----------
    angle_deg, approach, direction
        As in `Position`: an angle in the plane, or a direction in space.
    turned_deg : float or None
        Turn about the vertical, as in `Position`; the move goes on after `bus_s`.
    """

    bus_s: float
    angle_deg: float | None
    approach: int
    direction: tuple[float, float, float] | None = None
    turned_deg: float | None = None

    @property
    def aim(self) -> list[float] | dict[str, float] | None:
        """What the archive keeps beside the angle."""
        if self.turned_deg is not None:
            return {"turned_deg": self.turned_deg}
        return None if self.direction is None else list(self.direction)


@dataclass(frozen=True)
class Attempt:
    """One try at a dwell.

    Attributes
    ----------
    place : int
        Which position of the plan, from 0.
    outcome : {"complete", "interrupted"}
    reason : str
        What interrupted it; empty for a complete dwell.
    started_utc : str
        Wall clock, ISO 8601, UTC.
    started_bus_s, ended_bus_s : float
        Clock of the bus.
    blocks : sequence of (phase, Block)
        Every scan that was read, in order; those of phase `dwell` are the dwell's samples.
    moves : sequence of Move
        What moved the stage for it.
    status : int or None
        Word of STATUS after it.
    """

    place: int
    position: Position
    outcome: Outcome
    started_utc: str
    started_bus_s: float
    ended_bus_s: float
    blocks: Sequence[tuple[Phase, Block]]
    moves: Sequence[Move] = ()
    reason: str = ""
    status: int | None = None


@dataclass(frozen=True)
class StoredAttempt:
    """Row of `attempts`: an attempt without its samples.

    Attributes
    ----------
    number : int
        Number of the attempt, from 1, in the order in which they were made.
    run : int
        Which opening of the session it belongs to.
    offset_s : float
        Added to times on the bus's clock it gives seconds since the session began.
    """

    number: int
    run: int
    offset_s: float
    place: int
    position: Position
    outcome: Outcome
    reason: str
    started_utc: str
    started_bus_s: float
    ended_bus_s: float
    registers: tuple[str, ...]
    variant: str
    gyro_range_dps: int | None
    status: int | None
    blocks: int


@dataclass(frozen=True)
class Record:
    """Row of `records`."""

    run: int
    utc: str
    bus_s: float
    kind: str
    value: Any


@dataclass(frozen=True)
class Header:
    """What stands from the beginning of a session.

    Attributes
    ----------
    url, variant : str
        Bus and part.
    plan : Plan
        The plan to begin with; an extension is a record.
    settings : mapping
        JSON form of the runner's settings.
    title, note, operator, serial, stage : str
        What the operator wrote down; a session of older programs has the last three empty.
    simulated : bool
        True where the bus has a world whose truth is known.
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
    simulated: bool = False
    created_utc: str = ""
    software: str = field(default=f"adis-gonio {__version__}")


def utc_now() -> str:
    """Wall clock, ISO 8601, UTC, to the millisecond."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def to_json(value: Any) -> str:
    """JSON text; numpy's scalars and arrays become numbers and lists.

    Raises
    ------
    ValueError
        NaN or an infinity, which JSON does not have.
    """
    return json.dumps(value, ensure_ascii=False, allow_nan=False, default=_plain)


def checksum(*values: Any) -> int:
    """CRC-32 of a row's values; bytes count as they are, the rest as JSON."""
    plain = [value for value in values if not isinstance(value, bytes)]
    crc = zlib.crc32(json.dumps(plain).encode())
    for value in values:
        if isinstance(value, bytes):
            crc = zlib.crc32(value, crc)
    return crc


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} has no JSON form")
