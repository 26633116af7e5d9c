"""A history in words and as a chart of characters, for every face."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.base.numbers import (
    DASH,
    NAMES,
    counted,
    format_p,
    format_uncertain,
    format_unit,
    use_minus,
)
from adis_gonio.base.uncertainty import DRIFTING, Value
from adis_gonio.fleet.memory.history import History, Track, date_of
from adis_gonio.fleet.record import SessionRecord

_ROWS = 9


def format_expanded(value: Value) -> str:
    """Value ± U without unit."""
    return format_uncertain(value.value, value.U)


def of_drift(track: Track) -> list[str]:
    """What the line and the scatter say, one sentence each."""
    drift = track.drift
    if drift is None:
        return []
    unit = format_unit(drift.slope.unit).removeprefix("1/")
    said = "drifts" if track.drifts else "no drift shown"
    rate = f"{format_expanded(drift.slope)} {'a year' if unit == 'a' else unit}"
    lines = [f"{said}: {rate} (U, 95 %), {format_p(drift.p_value)}"]
    if drift.birge_p < DRIFTING:
        lines.append(
            f"sessions scatter by more than their u: {drift.between:.2g} between sessions "
            f"(Birge ratio {drift.birge:.2f}, {format_p(drift.birge_p)})"
        )
    return lines


def of_chart(track: Track, history: History) -> list[str]:
    """What the control charts signal, one sentence each."""
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


def of_effects(history: History) -> list[list[str]]:
    """Rows of date, effects found with their axes, whether the model is adequate."""
    return [[_date(record), _effects(record), _adequate(record)] for record in history.sessions]


def _effects(record: SessionRecord) -> str:
    if not record.traced:
        return "not traced"
    names = [f"{e.effect} ({', '.join(e.axes)})" if e.axes else e.effect for e in record.effects]
    return ", ".join(names) or "none"


def _adequate(record: SessionRecord) -> str:
    return {None: "–", True: "adequate", False: "not adequate"}[record.adequate]


def _date(record: SessionRecord) -> str:
    return (record.when or "")[:10]


def headline(history: History) -> str:
    """One sentence: how many sessions, and what moves."""
    moving = [NAMES.get(name, name) for name, track in history.tracks.items() if track.drifts]
    signals = [
        NAMES.get(name, name)
        for name, track in history.tracks.items()
        if track.chart is not None and track.chart.signal is not None
    ]
    parts = [counted(len(history.sessions), "session")]
    parts.append(f"drift in {', '.join(moving)}" if moving else "no drift shown")
    parts.append(f"control chart signals {', '.join(signals)}" if signals else "control charts quiet")
    return "; ".join(parts)


def chart_lines(track: Track, width: int = 80) -> list[str]:
    """Values over time in characters, at most `width` wide: `●` value, `│` its U, `·` weighted mean."""
    if not track.values:
        return []
    value, half = track.value, np.nan_to_num(track.expanded)
    low, high = float((value - half).min()), float((value + half).max())
    low, high = (low, high) if high > low else (low - 1, high + 1)
    labels = [use_minus(f"{edge:.4g}") for edge in (high, (high + low) / 2, low)]
    margin = max(map(len, labels)) + 1
    columns = width - margin - 1
    grid = [[" "] * columns for _ in range(_ROWS)]
    span = float(np.ptp(track.day)) or 1.0
    where = np.round((track.day - track.day.min()) / span * (columns - 1)).astype(int)

    def row(at: float) -> int:
        return round((high - at) / (high - low) * (_ROWS - 1))

    weights = 1 / np.where(half > 0, half, 1.0) ** 2
    for column in range(0, columns, 2):
        grid[row(float(np.average(value, weights=weights)))][column] = "·"
    for column, one, u in zip(where, value, half, strict=True):
        for line in range(row(one + u), row(one - u) + 1):
            grid[line][column] = "│"
    for column, one in zip(where, value, strict=True):
        grid[row(one)][column] = "●"
    edges = {0: labels[0], _ROWS // 2: labels[1], _ROWS - 1: labels[2]}
    lines = [f"{edges.get(k, ''):>{margin}}│{''.join(cells)}".rstrip() for k, cells in enumerate(grid)]
    first, last = date_of(track.day.min()), date_of(track.day.max())
    foot = first if first == last else first + last.rjust(columns - len(first))
    return [*lines, " " * (margin + 1) + foot]


def value_rows(history: History) -> tuple[list[str], Sequence[list[str]]]:
    """Head and rows: date, every quantity ± U."""
    tracks = list(history.tracks.values())
    rows = []
    for n, record in enumerate(history.sessions):
        held = [t.values[t.sessions.index(n)] if n in t.sessions else None for t in tracks]
        rows.append([_date(record), *(DASH if v is None else format_expanded(v) for v in held)])
    return ["date", *(track.label for track in tracks)], rows
