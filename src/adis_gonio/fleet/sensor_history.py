"""History of one sensor: quantities over time, drift, control charts, effects found; as data and texts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError, suggest
from adis_gonio.base.jsonable import JsonRecord, json_object
from adis_gonio.base.numbers import (
    DASH,
    NAMES,
    counted,
    format_p,
    format_uncertain,
    label_quantity,
)
from adis_gonio.base.uncertainty import DRIFTING, Value
from adis_gonio.fleet.control_charts import ControlChart, Drift, control_chart, drift_of
from adis_gonio.fleet.fleet_statistics import unshared_u
from adis_gonio.fleet.session_record import ANGLE, QUANTITIES, SessionRecord

_IN_PLANE = ("delta_k", "delta_phi", "bias_x", "bias_y")
_DAY_S = 86400.0

LISTED = (
    *("when", "path", "operator", "stage", "plan", "method", "effects"),
    *("adequate", "temperature_c", "angle_max_deg"),
)
"""Fields of a session's record that the JSON document of `history` includes."""


class Track(JsonRecord):
    """Values of one quantity over time, from the sessions of a sensor that determine it.

    Attributes
    ----------
    name, unit : str
        Name and unit of the quantity.
    sessions : tuple of int
        Indices of the sessions in the history, from 0.
    day : (n,) float
        Time of each session in days since 1970.
    values : tuple of Value
        Value of the quantity in each session, with uncertainty.
    drift : Drift or None
        Straight line over time; None with fewer than three sessions, and for the error of the angle, which
        has no sign.
    chart : ControlChart or None
        Control charts; None with fewer than two sessions.
    drifts : bool
        True if the slope differs from zero: its p-value times the number of quantities is below 5 %
        (`DRIFTING`).
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
        """Name of the quantity with its unit, such as `Δφ / °`."""
        return label_quantity(self.name, self.unit)

    @property
    def value(self) -> Floats:
        """Values (n,) of the quantity, one per session that determines it."""
        return np.array([value.value for value in self.values])

    @property
    def u(self) -> Floats:
        """Standard uncertainties (n,) of the values."""
        return np.array([value.u for value in self.values], dtype=float)

    @property
    def expanded(self) -> Floats:
        """Expanded uncertainties U (n,) of the values, 95 %."""
        return np.array([value.U for value in self.values], dtype=float)


@dataclass(frozen=True)
class History:
    """The sessions of one sensor over time, with the values of each quantity.

    Attributes
    ----------
    serial : str
        Serial number of the sensor.
    sessions : tuple of SessionRecord
        Sessions in the order of time.
    tracks : mapping of str to Track
        Values of each quantity over time, by its name.
    left_out : tuple of (SessionRecord, str)
        Sessions that are not used, without a date or with a doubtful result, and the reason.
    """

    serial: str
    sessions: tuple[SessionRecord, ...]
    tracks: dict[str, Track]
    left_out: tuple[tuple[SessionRecord, str], ...] = ()

    @property
    def days(self) -> Floats:
        """Time at which each session began, in days since 1970-01-01, (n,)."""
        return np.array([day_of(record.when or "") for record in self.sessions])

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document that `adis-gonio history --json` prints."""
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


def history_of(serial: str, records: Sequence[SessionRecord]) -> History:
    """Make the history of a sensor from the records of its sessions."""
    left_out = tuple((record, reason) for record in records if (reason := _unfit(record)))
    good = sorted((r for r in records if not _unfit(r)), key=lambda r: (day_of(r.when or ""), r.path))
    # In the plane the gain ratio ΔK is tracked instead of gains: a common factor of both gains cannot be
    # distinguished from a change of gravity.
    names = [name for name in QUANTITIES if name.startswith(("bias_", "scale_", "skew_"))]
    if any("delta_k" in record.values for record in good):
        names = [*_IN_PLANE, ANGLE]
    tracks = []
    for name in names:
        stated = [
            (n, record, value)
            for n, record in enumerate(good)
            if (value := record.values.get(name)) is not None
            and np.isfinite(value.value)
            and (value.u or 0.0) > 0
        ]
        if not stated:
            continue
        numbers, shown, values = zip(*stated, strict=True)
        day = np.array([day_of(record.when or "") for record in shown])
        track = Track(name, values[0].unit, numbers, day, values)
        if name != ANGLE and len(values) > 1:
            u = own_u(shown, name)
            drift = drift_of(day, track.value, u, track.unit)
            track = replace(track, drift=drift, chart=control_chart(track.value, u))
        tracks.append(track)
    drifts = {track.name: track.drift for track in tracks if track.drift is not None}
    moving = {name for name, drift in drifts.items() if drift.p_value * len(drifts) <= DRIFTING}
    judged = {track.name: replace(track, drifts=track.name in moving) for track in tracks}
    return History(serial, tuple(good), judged, left_out)


def known_serial(serial: str, known: Sequence[str]) -> str:
    """Return the serial number `serial` if it is one of the known serial numbers.

    Raises
    ------
    UsageError
        The serial number is unknown; the message names the most similar serial number.
    """
    if serial in known:
        return serial
    if known:
        otherwise = f"known: {', '.join(known[:5])}{' …' if len(known) > 5 else ''}"
    else:
        otherwise = (
            "no session in these folders has a serial number (calibrate --serial, or '# serial:' in a CSV)"
        )
    hint = suggest(serial, known, otherwise)
    raise UsageError(f"no session is of a sensor with serial number '{serial}'; {hint}")


def alike(serial: str, known: Sequence[str]) -> list[str]:
    """Return the known serial numbers that differ from this one only by capitals and spaces."""

    def bare(text: str) -> str:
        return "".join(text.split()).casefold()

    return [other for other in known if other != serial and bare(other) == bare(serial)]


def day_of(when: str) -> float:
    """Convert an ISO time to days since 1970-01-01."""
    return datetime.fromisoformat(when).timestamp() / _DAY_S


def date_of(day: float) -> str:
    """Convert days since 1970-01-01 to a date (UTC); `UsageError` for a day beyond the calendar's end."""
    try:
        return (datetime(1970, 1, 1) + timedelta(days=float(day))).date().isoformat()
    except OverflowError:
        raise UsageError(f"day {day:g} is beyond the calendar") from None


def _unfit(record: SessionRecord) -> str:
    if record.status != "ok":
        return record.reason
    if record.when is None:
        return "no date: a samples CSV does not state its time of recording"
    return f"the result cannot be right: {record.doubts[0]}" if record.doubts else ""


def own_u(records: Sequence[SessionRecord], name: str) -> Floats:
    """Return the standard uncertainties (n,) of a quantity without the errors of a stage that all share.

    `name` is the quantity. The result applies to differences between the sessions (`unshared_u`).
    """
    return unshared_u(
        np.array([record.values[name].u or 0.0 for record in records]),
        [record.stage_curve for record in records],
        [record.stage_influence.get(name, ()) for record in records],
    )


def drift_sentences(track: Track) -> list[str]:
    """Return sentences on the drift of a quantity, and on its scatter between sessions.

    The list is empty without a drift fit.
    """
    drift = track.drift
    if drift is None:
        return []
    said = "drifts" if track.drifts else "no drift shown"
    rate = format_uncertain(drift.slope.value, drift.slope.U, drift.slope.unit)
    lines = [f"{said}: {rate} (U, 95 %), {format_p(drift.p_value)}"]
    if drift.birge_p < DRIFTING:
        lines.append(
            f"sessions scatter by more than their u: {drift.between:.2g} between sessions "
            f"(Birge ratio {drift.birge:.2f}, {format_p(drift.birge_p)})"
        )
    return lines


def chart_sentences(track: Track, history: History) -> list[str]:
    """Return sentences on the sessions at which the control charts of a quantity signal a change."""
    chart = track.chart
    if chart is None:
        return []
    lines = []
    if chart.signal is not None and chart.since is not None:
        at, since = (history.sessions[track.sessions[n]] for n in (chart.signal, chart.since))
        way = "up" if chart.up[chart.signal] > chart.h else "down"
        lines.append(f"CUSUM signals a change {way} since {_date(since)} (seen on {_date(at)})")
    if chart.outside:
        dates = ", ".join(_date(history.sessions[track.sessions[n]]) for n in chart.outside)
        lines.append(f"outside the 3σ limits: {dates}")
    return lines


def effect_table(history: History) -> list[list[str]]:
    """Return table rows (date, effects found, adequacy of the model), one for each session."""
    adequate = {None: "–", True: "adequate", False: "not adequate"}
    rows = []
    for record in history.sessions:
        names = [f"{e.effect} ({', '.join(e.axes)})" if e.axes else e.effect for e in record.effects]
        effects = (", ".join(names) or "none") if record.traced else "not traced"
        rows.append([_date(record), effects, adequate[record.adequate]])
    return rows


def _date(record: SessionRecord) -> str:
    return (record.when or "")[:10]


def headline(history: History) -> str:
    """Return one line on a history: number of sessions, drifting quantities, signals of control charts."""
    names = {NAMES.get(name, name): track for name, track in history.tracks.items()}
    charts = {name: track.chart for name, track in names.items() if track.chart is not None}
    moving = [name for name, track in names.items() if track.drifts]
    signals = [name for name, chart in charts.items() if chart.signal is not None]
    outside = [name for name, chart in charts.items() if chart.outside]
    parts = [counted(len(history.sessions), "session")]
    parts.append(f"drift in {', '.join(moving)}" if moving else "no drift shown")
    if signals:
        parts.append(f"control chart signals {', '.join(signals)}")
    if outside:
        parts.append(f"a session is outside the 3σ limits of {', '.join(outside)}")
    if not signals and not outside:
        parts.append("control charts quiet")
    return "; ".join(parts)


def value_rows(history: History) -> tuple[list[str], Sequence[list[str]]]:
    """Return the head and the rows of a table: the date of each session and all its quantities ± U."""
    tracks = list(history.tracks.values())
    rows = []
    for n, record in enumerate(history.sessions):
        stated = [t.values[t.sessions.index(n)] if n in t.sessions else None for t in tracks]
        rows.append(
            [_date(record), *(DASH if v is None else format_uncertain(v.value, v.U) for v in stated)]
        )
    return ["date", *(track.label for track in tracks)], rows
