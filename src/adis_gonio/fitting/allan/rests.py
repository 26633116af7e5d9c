"""What of a session is at rest: equally spaced records of three gyros or accelerometers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
from scipy import fft

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.estimation.screening import steps_of
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Dwell, Session

Part = Literal["gyro", "accelerometer"]
PARTS: tuple[Part, ...] = get_args(Part)

LEAST = 128
"""Samples of a record that says something of its noise."""
_GAP = 2.5
"""Sample periods between two samples that end a record."""
_EVEN = 1.5
_MANY_LOST = 1e-3
_SHORT = 4
"""Part of the longest record below which another takes no part."""
_FAST = 100_000
"""Samples from which a record is cut to a length that transforms quickly (less than 2 % is lost)."""


@dataclass(frozen=True)
class Rests:
    """Records at rest of one part.

    Attributes
    ----------
    part : {"gyro", "accelerometer"}
    unit : str
        `dps`, `mg`, or `counts`.
    period_s : float
        Time between samples.
    filter_m : int or None
        The chip's filter; None where the file does not know it.
    records : tuple of (n, axes) float
        Samples in `unit`, each record about its first sample.
    positions : tuple of int
        Dwell of each record.
    step : (axes,) float
        Step of the converter in `unit`; 0 unknown.
    notes : tuple of str
        What there is to say of them.
    """

    part: Part
    unit: str
    period_s: float
    filter_m: int | None
    records: tuple[Floats, ...]
    positions: tuple[int, ...]
    step: Floats
    notes: tuple[str, ...]

    @property
    def axes(self) -> int:
        """Axes of a sample."""
        return int(self.records[0].shape[1])

    @property
    def duration_s(self) -> float:
        """Time of all records together."""
        return self.period_s * sum(len(record) for record in self.records)

    @property
    def longest_s(self) -> float:
        """Time of the longest one."""
        return self.period_s * max(len(record) for record in self.records)


def rests_of(session: Session, part: Part) -> Rests:
    """Records at rest of a session: its dwells, which of a continuous recording are what stood still.

    Raises
    ------
    UsageError
        No such part.
    DataError
        No gyros, no rest that is long enough, times that stand still, an axis that never changes.
    """
    where = session.source or session.title or "session"
    if part not in PARTS:
        raise UsageError(f"'{part}' is no part of the sensor: give {' or '.join(PARTS)}")
    held = [(dwell, series) for dwell in session.dwells if (series := _series(dwell, part)) is not None]
    if not held:
        if session.dwells:
            raise DataError(f"{where}: there are no gyros (gx, gy, gz): give --sensor-part accelerometer")
        raise DataError(f"{where}: nothing in it is at rest; record the part lying still")
    unit, scale = _unit(session, part, where)
    period_s = _period([dwell for dwell, _ in held], where)
    records, positions, lost = [], [], 0
    for dwell, series in held:
        if not np.isfinite(series).all():
            raise DataError(f"{where}: dwell {dwell.position} holds NaN or infinity")
        for rows in _pieces(dwell.time_s, period_s):
            lost += _lost(dwell.time_s[rows], period_s)
            if rows.stop - rows.start >= LEAST:
                records.append(np.asarray(series[_quick(rows)], np.float64))
                positions.append(dwell.position)
    _refuse_short(records, [series for _, series in held], period_s, where)
    _refuse_stuck(records, where)
    records, positions, notes = _long(records, positions)
    step = scale * steps_of(records)
    samples = sum(len(record) for record in records)
    if lost > _MANY_LOST * samples:
        notes.append(f"{counted(lost, 'sample')} of {samples} are missing: high frequencies are less sure")
    kept = tuple((record - record[0]) * scale for record in records)
    return Rests(part, unit, period_s, _filter(session), kept, tuple(positions), step, tuple(notes))


def _series(dwell: Dwell, part: Part) -> Floats | None:
    return dwell.gyro if part == "gyro" else dwell.accel


def _unit(session: Session, part: Part, where: str) -> tuple[str, float]:
    """Unit in which results stand, and by what the file's numbers are multiplied."""
    if part == "gyro":
        return {"dps": ("dps", 1.0), "radps": ("dps", 180 / np.pi), "counts": ("counts", 1.0)}[
            session.gyro_unit
        ]
    if session.accel_unit == "lsb":
        if session.sensor not in VARIANTS:
            raise DataError(f"{where}: the LSB of sensor '{session.sensor}' is not known; give --unit")
        return "mg", VARIANTS[session.sensor].accel_mg_per_lsb
    known = {"mg": 1.0, "g": 1000.0, "mps2": 1000.0 / STANDARD_GRAVITY_MPS2}
    return ("mg", known[session.accel_unit]) if session.accel_unit in known else ("counts", 1.0)


def _filter(session: Session) -> int | None:
    found = (session.facts.get("configuration") or {}).get("filter_m")
    return None if found is None else int(found)


def _period(dwells: list[Dwell], where: str) -> float:
    """Time between samples, by the whole of the longest dwell: coarse times may stand still between two."""
    longest = max(dwells, key=len)
    if len(longest) < 2:
        raise DataError(
            f"{where}: its dwells hold one averaged sample each; the noise needs the samples themselves"
        )
    steps = np.diff(longest.time_s)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    if not usual > 0:
        raise DataError(f"{where}: the times of the samples stand still; without them there is no rate")
    # Beyond it a sample is missing; coarse times that stand still count.
    return float(steps[steps < _EVEN * usual].mean())


def _pieces(time_s: Floats, period_s: float) -> list[slice]:
    """Rows between gaps."""
    gaps = np.flatnonzero(np.diff(time_s) > _GAP * period_s) + 1
    edges = [0, *gaps.tolist(), len(time_s)]
    return [slice(a, b) for a, b in pairwise(edges)]


def _lost(time_s: Floats, period_s: float) -> int:
    return max(0, round(float(time_s[-1] - time_s[0]) / period_s) + 1 - len(time_s))


def _long(records: list[Floats], positions: list[int]) -> tuple[list[Floats], list[int], list[str]]:
    """Without the records that are short against the longest: they say nothing of slow noise."""
    least = max(len(record) for record in records) / _SHORT
    kept = [k for k, record in enumerate(records) if len(record) >= least]
    left = len(records) - len(kept)
    notes = [f"{counted(left, 'rest')} shorter than a quarter of the longest left out"] if left else []
    return [records[k] for k in kept], [positions[k] for k in kept], notes


def _quick(rows: slice) -> slice:
    size = rows.stop - rows.start
    if size < _FAST:
        return rows
    kept = next(n for n in range(size, 0, -1) if fft.next_fast_len(n, real=True) == n)
    return slice(rows.start, rows.start + kept)


def _refuse_short(records: list[Floats], series: list[Floats], period_s: float, where: str) -> None:
    if not records:
        longest = max(len(rows) for rows in series)
        raise DataError(
            f"{where}: the longest rest without a gap has {counted(longest, 'sample')} at most"
            f" ({longest * period_s:.3g} s): noise needs {LEAST}; let the part lie still for longer"
        )


def _refuse_stuck(records: list[Floats], where: str) -> None:
    still = [axis for axis in range(records[0].shape[1]) if all(not np.ptp(r[:, axis]) for r in records)]
    if still:
        names = ", ".join("xyz"[axis] for axis in still)
        raise DataError(
            f"{where}: {names} never changes at rest: a dead axis, or noise below the converter"
        )
