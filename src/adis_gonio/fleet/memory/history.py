"""What became of one sensor: its quantities over time, their drift, their control charts, effects found."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.base.jsonable import JsonRecord, json_object
from adis_gonio.base.numbers import label_quantity
from adis_gonio.base.uncertainty import DRIFTING, Value
from adis_gonio.fleet.memory.control_chart import CUSUM_H, CUSUM_K, ControlChart, control_chart
from adis_gonio.fleet.memory.drift import Drift, drift_of
from adis_gonio.fleet.record import ANGLE, QUANTITIES, SessionRecord

_IN_PLANE = ("delta_k", "delta_phi", "bias_x", "bias_y")
_DAY_S = 86400.0

LISTED = (
    *("when", "path", "operator", "stage", "plan", "method", "effects"),
    *("adequate", "temperature_c", "angle_max_deg"),
)
"""Entries of a session's record in the document of `history`."""


@dataclass(frozen=True)
class Track(JsonRecord):
    """One quantity over the sessions that determine it.

    Attributes
    ----------
    name, unit : str
    sessions : tuple of int
        Which of the history's sessions, from 0.
    day : (n,) float
        Days since 1970.
    values : tuple of Value
    drift : Drift or None
        None with fewer than three sessions, and for the error of the angle, which is no signed quantity.
    chart : ControlChart or None
        None with fewer than two.
    drifts : bool
        True where the slope differs from zero at `DRIFTING` over all quantities.
    """

    document_keys = ("unit", "sessions", "values", "drift", "drifts", "chart")

    name: str
    unit: str
    sessions: tuple[int, ...]
    day: Floats
    values: tuple[Value, ...]
    drift: Drift | None = None
    chart: ControlChart | None = None
    drifts: bool = False

    @property
    def label(self) -> str:
        """Name and unit, such as `Δφ / °`."""
        return label_quantity(self.name, self.unit)

    @property
    def value(self) -> Floats:
        """Values (n,)."""
        return np.array([value.value for value in self.values])

    @property
    def u(self) -> Floats:
        """Standard uncertainties (n,)."""
        return np.array([value.u for value in self.values], dtype=float)

    @property
    def expanded(self) -> Floats:
        """U (n,), 95 %."""
        return np.array([value.U for value in self.values], dtype=float)


@dataclass(frozen=True)
class History:
    """A sensor over its sessions.

    Attributes
    ----------
    serial : str
    sessions : tuple of SessionRecord
        In the order of time.
    tracks : mapping of str to Track
    left_out : tuple of (SessionRecord, str)
        Sessions that cannot be placed or trusted, and why.
    """

    serial: str
    sessions: tuple[SessionRecord, ...]
    tracks: dict[str, Track]
    left_out: tuple[tuple[SessionRecord, str], ...] = ()

    @property
    def days(self) -> Floats:
        """When each session began, days since 1970, (n,)."""
        return np.array([day_of(record.when or "") for record in self.sessions])

    def as_dict(self) -> dict[str, Any]:
        """JSON document of `history`."""
        return json_object(
            serial=self.serial,
            sessions=[
                {name: getattr(record, name) for name in LISTED}
                | ({} if record.traced else {"effects": None})
                for record in self.sessions
            ],
            quantities=self.tracks,
            left_out=[{"path": record.path, "reason": reason} for record, reason in self.left_out],
        )


def history_of(
    serial: str, records: Sequence[SessionRecord], *, k: float = CUSUM_K, h: float = CUSUM_H
) -> History:
    """History from records of one serial number.

    Parameters
    ----------
    k, h : float
        Of the CUSUM, in standard deviations.
    """
    left_out = tuple((record, reason) for record in records if (reason := _unfit(record)))
    good = sorted((r for r in records if not _unfit(r)), key=lambda r: (day_of(r.when or ""), r.path))
    tracks = [_track(name, good, k, h) for name in _names(good)]
    tested = sum(track.drift is not None for track in tracks)
    judged = {track.name: _judged(track, tested) for track in tracks if track.sessions}
    return History(serial, tuple(good), judged, left_out)


def known_serial(serial: str, known: Sequence[str]) -> str:
    """The serial number, checked.

    Raises
    ------
    UsageError
        It is not among those known; the message lists those like it.
    """
    if serial in known:
        return serial
    lower = {name.lower() for name in known}
    close = difflib.get_close_matches(serial.lower(), sorted(lower), n=5, cutoff=0.5)
    near = [name for one in close for name in known if name.lower() == one]
    if near:
        hint = f"there is {', '.join(near)}"
    elif known:
        hint = f"known are {', '.join(known[:5])}{' …' if len(known) > 5 else ''}"
    else:
        hint = (
            "no session in these folders has a serial number (calibrate --serial, or '# serial:' in a CSV)"
        )
    raise UsageError(f"no session is of a sensor with serial number '{serial}'; {hint}")


def alike(serial: str, known: Sequence[str]) -> list[str]:
    """Other serial numbers that differ in capitals and spaces only."""

    def bare(text: str) -> str:
        return "".join(text.split()).casefold()

    return [other for other in known if other != serial and bare(other) == bare(serial)]


def day_of(when: str) -> float:
    """Days since 1970 of an ISO time."""
    return datetime.fromisoformat(when).timestamp() / _DAY_S


def date_of(day: float) -> str:
    """Date (UTC) of a day since 1970; `UsageError` beyond the calendar's end."""
    try:
        return (datetime(1970, 1, 1) + timedelta(days=float(day))).date().isoformat()
    except OverflowError:
        raise UsageError(f"day {day:g} is beyond the calendar") from None


def _unfit(record: SessionRecord) -> str:
    if record.status != "ok":
        return record.reason
    if record.when is None:
        return "no date: a samples CSV does not say when it was recorded"
    return f"the result cannot be right: {record.doubts[0]}" if record.doubts else ""


def _names(records: Sequence[SessionRecord]) -> list[str]:
    """Quantities to follow: in the plane gains as ΔK only, since their common part is gravity."""
    if any("delta_k" in record.values for record in records):
        return [*_IN_PLANE, ANGLE]
    return [name for name in QUANTITIES if name.startswith(("bias_", "scale_", "skew_"))]


def _track(name: str, records: Sequence[SessionRecord], k: float, h: float) -> Track:
    held = [(n, r, r.values[name]) for n, r in enumerate(records) if _stated(r.values.get(name))]
    day = np.array([day_of(record.when or "") for _, record, _ in held])
    values = tuple(value for _, _, value in held)
    unit = values[0].unit if values else ""
    track = Track(name, unit, tuple(n for n, _, _ in held), day, values)
    if name == ANGLE or len(values) < 2:
        return track
    return replace(
        track,
        drift=drift_of(day, track.value, track.u, unit),
        chart=control_chart(track.value, track.u, k, h),
    )


def _stated(value: Value | None) -> bool:
    return value is not None and bool(np.isfinite(value.value)) and value.u is not None and value.u > 0


def _judged(track: Track, tested: int) -> Track:
    found = track.drift is not None and track.drift.p_value * tested <= DRIFTING
    return replace(track, drifts=found)
