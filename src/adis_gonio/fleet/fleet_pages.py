"""Pages with figures: the summary of a fleet, and the history of a sensor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.base.numbers import (
    DASH,
    NAMES,
    count_decimals,
    counted,
    format_fixed,
    format_number,
    format_p,
    format_percent,
    format_unit,
    label_quantity,
    with_unit,
)
from adis_gonio.base.uncertainty import OUTLYING
from adis_gonio.fleet import sensor_history
from adis_gonio.fleet.fleet_summary import FEWEST, FEWEST_UNITS, GROUPS, Distribution, Summary, headline
from adis_gonio.fleet.sensor_history import YEAR_DAYS, History, Track
from adis_gonio.fleet.session_record import ANGLE, Repeated, format_quantity
from adis_gonio.page.document import Figure, KeyFigure, Section, Series, Table, plot, render

_MOST_BINS = 40
_VALUES = "Values ± U (95 %). The U of the angle error belongs to a displayed angle."
"""Caption of the values of a history."""
_MOST_ROWS = 200
"""Largest number of rows in a table of the page; the JSON document has all rows."""


def build_page(summary: Summary, repeated: Sequence[Repeated] = (), population: Sequence[str] = ()) -> str:
    """Render the summary of a fleet as one HTML page; the parameters are as in `fleet_sections`.

    Raises
    ------
    NotInstalledError
        Matplotlib is not installed.
    """
    return render(
        "Fleet",
        counted(summary.sessions["n"], "session"),
        shape=headline(summary).rstrip("."),
        sections=fleet_sections(summary, repeated, population),
        closing="This page is made from the sessions' files alone and can be made again from them.",
    )


def fleet_sections(
    summary: Summary,
    repeated: Sequence[Repeated] = (),
    population: Sequence[str] = (),
    *,
    figures: bool = True,
) -> list[Section]:
    """Return the sections on a fleet, for a page or the terminal.

    Parameters
    ----------
    summary : Summary
        Statistics of the fleet.
    repeated : sequence of Repeated
        Files that do not count, because another file has the same data.
    population : sequence of str
        Paragraphs on the population trace; empty without one.
    figures : bool
        False leaves the figures out, which need matplotlib.
    """
    copies = [(one.path, one.same_as) for one in repeated]
    return [
        _overview(summary),
        Section("Population trace", words=population),
        _parameters(summary, figures=figures),
        _effects(summary),
        _outlying(summary),
        _files("Failed sessions", "reason", summary.failures),
        _files("Files that count once", "same session as", copies, folded=True),
    ]


def _overview(summary: Summary) -> Section:
    n = summary.sessions
    key = [KeyFigure("Sessions with a result", f"{n['ok']} of {n['n']}")]
    key += [KeyFigure(f"{kind.capitalize()}s", str(n[f"{kind}s"])) for kind in GROUPS if n[f"{kind}s"]]
    traced = "No session was traced: effects are not known."
    if n["traced"]:
        share = format_percent(n["adequate"] / n["traced"])
        key.append(KeyFigure("Model adequate", share, "of the sessions traced"))
        traced = f"{counted(n['traced'], 'session')} traced; the model is adequate in {n['adequate']}."
    key.append(KeyFigure("Outlying", str(len(summary.outlying)), "units, stages, operators by quantity"))
    failed, doubted, unnamed = (counted(n[of], "session") for of in ("failed", "doubted", "without_serial"))
    words = [f"{failed} failed."] if n["failed"] else []
    words.append(traced)
    if n["doubted"]:
        words.append(f"{doubted} with readings that the operator kept against a warning.")
    if n["without_serial"]:
        words.append(f"{unnamed} without a serial number: each counts as a unit.")
    return Section("Summary", key=key, words=words)


def _parameters(summary: Summary, *, figures: bool) -> Section:
    head = ["quantity", "unit", "sessions", "median", "5 %", "95 %", "mean", "robust sd"]
    rows = []
    for one in summary.parameters:
        q, sd = one.quantiles, one.robust_sd
        # As many decimals as show two digits of the standard deviation.
        values = [
            format_fixed(value, count_decimals(sd)) if sd > 1e-6 else format_number(value)
            for value in (q["50"], q["5"], q["95"], one.mean)
        ]
        spread = format_number(sd if one.n > 1 else None, 2)
        rows.append([NAMES.get(one.name, one.name), format_unit(one.unit), str(one.n), *values, spread])
    table = Table(head, rows, numeric=tuple(range(2, 8)))
    drawn = [_histogram(one) for one in summary.parameters] if figures else []
    return Section(
        "Parameters",
        tables=[table],
        figures=[figure for figure in drawn if figure is not None],
    )


def _histogram(one: Distribution) -> Figure | None:
    """Plot a histogram of one quantity over the sessions; None for fewer than five sessions."""
    x = one.values
    width = 2 * (one.quantiles["75"] - one.quantiles["25"]) / len(x) ** (1 / 3)
    if len(x) < 5 or not width > 0:
        return None
    # A few far values would press all others into one bin.
    middle, reach = one.quantiles["50"], 6 * one.robust_sd
    low, high = max(one.low, middle - reach), min(one.high, middle + reach)
    edges = np.linspace(low, high, 1 + int(np.clip(np.ceil((high - low) / width), 4, _MOST_BINS)))
    counts, _ = np.histogram(x, edges)
    steps = Series(
        np.append(np.insert(edges, 0, edges[0]), edges[-1]),
        np.concatenate([[0], counts, [0, 0]]),
        "sessions",
        role="after",
        style="steps",
    )
    name = NAMES.get(one.name, one.name)
    outside = int((x < low).sum() + (x > high).sum())
    far = f"; {counted(outside, 'session')} outside the figure" if outside else ""
    svg = plot(
        [steps], label_quantity(one.name, one.unit), "sessions", title=f"Distribution of {name}", zero=True
    )
    return Figure(svg, f"{name} of {counted(len(x), 'session')}{far}.")


def _effects(summary: Summary) -> Section:
    rows = []
    for one in summary.effects:
        share, low, high = map(format_percent, (one.share, *one.wilson_95))
        rows.append([one.effect, f"{one.found} of {one.traced}", share, f"{low} to {high}"])
    head = ["effect", "sessions", "share", "95 % interval"]
    table = Table(head, rows, numeric=(1, 2, 3), caption="95 % interval of the share by Wilson.")
    none = ["No effect was found."] if summary.sessions["traced"] and not rows else []
    return Section("Effects by frequency", words=none, tables=[table])


def _outlying(summary: Summary) -> Section:
    """Return the section on units, stages and operators that differ from the rest of the fleet."""
    rows = []
    for one in summary.outlying:
        values = [with_unit(format_number(value), one.unit) for value in (one.value, one.others)]
        if one.quantity.startswith("effect "):
            values = [format_percent(one.value), format_percent(one.others)]
        p = format_number(one.adjusted_p, 2)
        if one.adjusted_p < 1e-12:
            p = format_p(one.adjusted_p).split("p\u00a0")[1]
        count = counted(one.n, "session" if one.kind == "unit" else "unit")
        quantity = NAMES.get(one.quantity, one.quantity)
        rows.append([f"{one.kind} {one.name}", quantity, *values, format_fixed(one.z, 1), p, count])
    caption = "" if len(rows) <= _MOST_ROWS else f"The first {_MOST_ROWS} of {len(rows)}."
    head = ["group", "quantity", "here", "the others", "z", "p × tests", "of"]
    table = Table(head, rows[:_MOST_ROWS], numeric=(2, 3, 4, 5), caption=caption)
    words = (
        f"{counted(summary.tests, 'comparison')} of units, stages and operators with the rest of the fleet;"
        f" the probability of any false name is at most {format_percent(OUTLYING)} in all"
        f" (Bonferroni).{'' if rows else ' No group is outlying.'}"
    )
    if not summary.tests:
        words = (
            f"Nothing could be compared: a comparison needs {FEWEST_UNITS} units, or {FEWEST} units on a"
            f" stage or with an operator and {FEWEST} elsewhere."
        )
    return Section(
        "Outlying groups",
        words=[words],
        tables=[table],
        notes=[
            "Units: robust z of the median of their sessions. Stages and operators: normal scores over"
            " their units, effects by the hypergeometric tail. The most outlying group is removed"
            " before the others are compared."
        ]
        if summary.tests
        else (),
    )


def _files(title: str, head: str, rows: Sequence[tuple[str, str]], *, folded: bool = False) -> Section:
    """Make a section with a table of files and a text for each file.

    `head` is the heading of the texts; `folded` hides the section until it is opened. `title` is the
    heading of the section.
    """
    more = len(rows) - _MOST_ROWS
    table = Table(["file", head], rows[:_MOST_ROWS], caption=f"{more} more." if more > 0 else "")
    return Section(title, tables=[table], folded=folded)


def history_page(history: History) -> str:
    """Render the history of a sensor as one HTML page that needs no other file; every text is escaped."""
    return render(
        "History",
        f"sensor {history.serial}",
        shape=sensor_history.headline(history),
        simulated=any(record.simulated for record in history.sessions),
        sections=history_sections(history),
        closing="This page is made from the sessions' files and can be made again from them.",
    )


def history_sections(history: History, *, figures: bool = True) -> list[Section]:
    """Return the sections on the history of a sensor; `figures` is False for the terminal."""
    tracks, shape = history.tracks.values(), sensor_history.headline(history)
    head = ["date", *(track.label for track in tracks)]
    adequate = {None: "–", True: "adequate", False: "not adequate"}
    values, effects = [], []
    for n, record in enumerate(history.sessions):
        stated = [(t.name, t.values[t.sessions.index(n)]) if n in t.sessions else None for t in tracks]
        date = (record.when or "")[:10]
        cells = (DASH if one is None else format_quantity(one[0], one[1].value, one[1].U) for one in stated)
        values.append([date, *cells])
        names = [f"{e.effect} ({', '.join(e.axes)})" if e.axes else e.effect for e in record.effects]
        found = (", ".join(names) or "none") if record.traced else "not traced"
        effects.append([date, found, adequate[record.adequate]])
    return [
        Section(
            "Overview",
            words=(f"{shape[:1].upper()}{shape[1:]}.",),
            tables=(Table(head, values, _VALUES, tuple(range(1, len(head)))),),
            notes=tuple(f"left out: {record.path}: {reason}" for record, reason in history.left_out),
        ),
        *(_section(track, history, figures=figures) for track in tracks),
        Section("Effects found", tables=(Table(["date", "effects", "model"], effects),)),
    ]


def _section(track: Track, history: History, *, figures: bool) -> Section:
    sentences = [
        f"{text[:1].upper()}{text[1:]}."
        for text in (
            *sensor_history.drift_sentences(track),
            *sensor_history.chart_sentences(track, history),
        )
    ]
    drawn = [_over_time(track)] if figures else []
    if figures and track.chart is not None:
        drawn.append(_cusum(track))
    return Section(track.label, words=sentences, figures=drawn)


def _over_time(track: Track) -> Figure:
    x = track.day
    # Dates of at most four sessions, far enough apart to be read.
    dates: dict[float, str] = {}
    for day in sorted(x.tolist()):
        if not dates or day - max(dates) >= 0.3 * np.ptp(x):
            dates[day] = sensor_history.date_of(day)
    # An rms error is positive, and its U belongs to a displayed angle: no error bars.
    error, stated = (None, "") if track.name == ANGLE else (track.expanded, " with U")
    series = [Series(x, track.value, f"session{stated}", error=error, role="after")]
    if track.drift is not None:
        drift, days = track.drift, np.array([x.min(), x.max()])
        line = drift.level.value + drift.slope.value / YEAR_DAYS * (days - drift.reference_day)
        series.append(Series(days, line, "drift", role="before", style="line"))
    if track.chart is not None:
        for limit, label in ((track.chart.low, "3σ limits"), (track.chart.high, "")):
            series.append(Series(x, limit, label, role="model", style="line"))
    name = track.label
    drawn = plot(series, "date", name, title=f"{name} over time", x_ticks=dates)
    limits = "; limits from all previous sessions" if track.chart else ""
    return Figure(drawn, f"Value of each session{stated}{limits}.")


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
    drawn = plot(series, "session", "CUSUM / σ", title=f"CUSUM of {track.label}", zero=True)
    return Figure(
        drawn, f"Sums of differences beyond {chart.k:g} σ; above the limit the quantity has changed."
    )
