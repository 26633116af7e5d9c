"""The page of a sensor's history: every quantity over time with U, its control chart, effects found."""

from __future__ import annotations

import numpy as np

from adis_gonio.fleet.memory import words
from adis_gonio.fleet.memory.history import History, Track
from adis_gonio.page.document import Figure, Section, Table, render
from adis_gonio.page.svg import Series, plot


def history_page(history: History) -> str:
    """One HTML page that loads nothing; every text is escaped."""
    head, rows = words.value_rows(history)
    sections = [
        Section(
            "What became of it",
            words=(f"{words.headline(history)[:1].upper()}{words.headline(history)[1:]}.",),
            tables=(Table(head, rows, "Values ± U (95 %).", tuple(range(1, len(head)))),),
            notes=tuple(f"left out: {record.path}: {reason}" for record, reason in history.left_out),
        ),
        *(_section(track, history) for track in history.tracks.values()),
        Section(
            "Effects found",
            tables=(Table(["date", "effects", "model"], words.of_effects(history)),),
        ),
    ]
    return render(
        "History",
        f"sensor {history.serial}",
        shape=words.headline(history),
        simulated=any(record.simulated for record in history.sessions),
        sections=sections,
        closing="This page is made from the sessions' files and can be made again from them.",
    )


def _section(track: Track, history: History) -> Section:
    figures = [_over_time(track)]
    if track.chart is not None:
        figures.append(_cusum(track))
    said = [
        f"{text[:1].upper()}{text[1:]}."
        for text in (*words.of_drift(track), *words.of_chart(track, history))
    ]
    return Section(track.label, words=said, figures=figures)


def _years(track: Track) -> np.ndarray:
    """Calendar years (n,) as fractions."""
    return 1970.0 + track.day / 365.2425


def _over_time(track: Track) -> Figure:
    x = _years(track)
    series = [Series(x, track.value, "session, with U", error=track.expanded, role="after")]
    if track.drift is not None:
        day = np.linspace(track.day.min(), track.day.max(), 50)
        line = track.drift.level.value + track.drift.slope.value / 365.25 * (
            day - track.drift.reference_day
        )
        series.append(Series(1970.0 + day / 365.2425, line, "drift", role="before", style="line"))
    if track.chart is not None:
        for limit, label in ((track.chart.low, "3σ limits"), (track.chart.high, "")):
            series.append(Series(x, limit, label, role="model", style="line"))
    name = track.label
    drawn = plot(series, "year", name, title=f"{name} over time")
    caption = "Value of each session with U" + ("; limits from all before it." if track.chart else ".")
    return Figure(drawn, caption)


def _cusum(track: Track) -> Figure:
    chart = track.chart
    assert chart is not None
    number = np.arange(1, len(chart.z) + 1)
    limit = np.full(len(number), chart.h)
    series = [
        Series(number, chart.up, "up", role="after", style="line"),
        Series(number, chart.down, "down", role="before", style="line"),
        Series(number, limit, f"limit {chart.h:.3g}", role="model", style="line"),
    ]
    drawn = plot(
        series,
        "session",
        "CUSUM / σ",
        title=f"CUSUM of {track.label}",
        zero=True,
    )
    return Figure(
        drawn, f"Sums of differences beyond {chart.k:g} σ; over the limit the quantity has changed."
    )
