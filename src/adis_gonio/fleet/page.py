"""The summary as one HTML page, in the style of the calibration report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.numbers import NAMES, counted, format_percent, label_quantity
from adis_gonio.fleet import words
from adis_gonio.fleet.run import Repeated
from adis_gonio.fleet.summary import GROUPS, Outlying, QuantitySummary, Summary
from adis_gonio.page.document import Figure, KeyFigure, Section, Table, render
from adis_gonio.page.svg import Series, plot

_MOST_BINS = 40
_MOST_GROUPS = 12
"""Groups beside each other in one figure."""
_MOST_FIGURES = 6
"""Figures of outlying groups."""
_MOST_ROWS = 200
"""Rows of a table of the page; the JSON has all."""


def build_page(
    summary: Summary, repeated: Sequence[Repeated] = (), population: Sequence[str] = (), title: str = ""
) -> str:
    """The page.

    Parameters
    ----------
    repeated : sequence of Repeated
        Files that do not count.
    population : sequence of str
        What the population trace says, a paragraph each.

    Raises
    ------
    NotInstalledError
        Matplotlib is not installed.
    """
    sections = [
        _overview(summary),
        Section("Population trace", words=population),
        _parameters(summary),
        _effects(summary),
        _outlying(summary),
        _failures(summary),
        _repeated(repeated),
    ]
    return render(
        "Fleet",
        title or counted(summary.sessions["n"], "session"),
        shape=words.headline(summary).rstrip("."),
        sections=sections,
        closing="This page is made from the sessions' files alone and can be made again from them.",
    )


def _overview(summary: Summary) -> Section:
    n = summary.sessions
    key = [KeyFigure("Sessions with a result", f"{n['ok']} of {n['n']}")]
    key += [KeyFigure(f"{kind.capitalize()}s", str(n[f"{kind}s"])) for kind in GROUPS if n[f"{kind}s"]]
    if n["traced"]:
        key.append(
            KeyFigure(
                "Model adequate", format_percent(n["adequate"] / n["traced"]), "of the sessions traced"
            )
        )
    key.append(
        KeyFigure("Standing out", str(len(summary.outlying)), "units, stages, operators by quantity")
    )
    return Section("Summary", key=key, words=words.remarks(summary))


def _parameters(summary: Summary) -> Section:
    table = Table(words.PARAMETER_HEAD, words.parameter_rows(summary), numeric=tuple(range(2, 11)))
    figures = [_histogram(one, summary.table[one.name]) for one in summary.parameters]
    return Section(
        "Parameters",
        tables=[table] if summary.parameters else [],
        figures=[figure for figure in figures if figure is not None],
        notes=words.PARAMETER_NOTES if summary.parameters else (),
    )


def _histogram(one: QuantitySummary, values: Floats) -> Figure | None:
    """How many sessions lie where, beside what the median u alone would make of one true value."""
    x = values[np.isfinite(values)]
    spread = one.distribution
    width = 2 * (spread.quantiles["75"] - spread.quantiles["25"]) / len(x) ** (1 / 3)
    if len(x) < 5 or not width > 0:
        return None
    # The few far away would press all others into one bin.
    middle, reach = spread.quantiles["50"], 6 * spread.robust_sd
    low, high = max(spread.low, middle - reach), min(spread.high, middle + reach)
    edges = np.linspace(low, high, 1 + int(np.clip(np.ceil((high - low) / width), 4, _MOST_BINS)))
    counts, _ = np.histogram(x, edges)
    series = [
        Series(
            np.append(np.insert(edges, 0, edges[0]), edges[-1]),
            np.concatenate([[0], counts, [0, 0]]),
            "sessions",
            role="after",
            style="steps",
        )
    ]
    if one.beyond is not None and one.beyond.u > 0.2 * (edges[1] - edges[0]):
        grid = np.linspace(edges[0], edges[-1], 300)
        u = one.beyond.u
        density = np.exp(-0.5 * ((grid - middle) / u) ** 2) / (u * np.sqrt(2 * np.pi))
        expected = density * len(x) * (edges[1] - edges[0])
        series.append(Series(grid, expected, "if u explained all", role="model", style="line"))
    name = NAMES.get(one.name, one.name)
    outside = int((x < low).sum() + (x > high).sum())
    far = f"; {counted(outside, 'session')} outside the figure" if outside else ""
    svg = plot(
        series,
        label_quantity(one.name, one.unit),
        "sessions",
        title=f"Distribution of {name}",
        zero=True,
    )
    return Figure(svg, f"{name} of {counted(len(x), 'session')}{far}.")


def _effects(summary: Summary) -> Section:
    rows = words.effect_rows(summary)
    table = Table(
        words.EFFECT_HEAD, rows, numeric=(1, 2, 3), caption="95 % interval of the share by Wilson."
    )
    none = ["No effect was found."] if summary.sessions["traced"] and not rows else []
    return Section("Effects by frequency", words=none, tables=[table] if rows else [])


def _outlying(summary: Summary) -> Section:
    rows = words.outlying_rows(summary)
    caption = "" if len(rows) <= _MOST_ROWS else f"The first {_MOST_ROWS} of {len(rows)}."
    table = Table(words.OUTLYING_HEAD, rows[:_MOST_ROWS], numeric=(2, 3, 4, 5), caption=caption)
    groups = [one for one in summary.outlying if one.kind != "unit" and one.quantity in summary.table]
    shown = {(one.kind, one.quantity): one for one in groups}
    figures = [_beside(one, summary) for one in list(shown.values())[:_MOST_FIGURES]]
    return Section(
        "Standing out",
        words=[words.outlying_text(summary)],
        tables=[table] if rows else [],
        figures=[figure for figure in figures if figure is not None],
        notes=[
            "Units: robust z of the median of their sessions. Stages and operators: normal scores over"
            " their units, effects by the hypergeometric tail. The oddest is taken out before the others"
            " are compared."
        ]
        if summary.tests
        else (),
    )


def _beside(one: Outlying, summary: Summary) -> Figure | None:
    """Sessions by stage or operator."""
    names = summary.table[GROUPS[one.kind]]
    values = summary.table[one.quantity]
    known = [str(name) for name in np.unique(names[(names != "") & np.isfinite(values)])]
    if len(known) > _MOST_GROUPS:
        return None
    at = np.array([known.index(name) if name in known else np.nan for name in names.tolist()])
    odd = np.isin(
        names, [x.name for x in summary.outlying if (x.kind, x.quantity) == (one.kind, one.quantity)]
    )
    # Side by side in the order of the sessions, so that points do not hide each other.
    place = at + np.linspace(-0.3, 0.3, len(at))
    name = NAMES.get(one.quantity, one.quantity)
    svg = plot(
        [
            Series(place[~odd], values[~odd], "others", role="after"),
            Series(place[odd], values[odd], "standing out", role="before"),
        ],
        one.kind,
        label_quantity(one.quantity, one.unit),
        title=f"{name} by {one.kind}",
        x_ticks={float(k): text if len(text) < 9 else f"{text[:7]}…" for k, text in enumerate(known)},
    )
    return Figure(svg, f"{name} of each session by {one.kind}.")


def _failures(summary: Summary) -> Section:
    rows = [[path, reason] for path, reason in summary.failures[:_MOST_ROWS]]
    more = len(summary.failures) - len(rows)
    table = Table(["file", "reason"], rows, caption=f"{more} more." if more else "")
    return Section("Failed sessions", tables=[table] if rows else [])


def _repeated(repeated: Sequence[Repeated]) -> Section:
    rows = [[one.path, one.same_as] for one in repeated[:_MOST_ROWS]]
    more = len(repeated) - len(rows)
    table = Table(["file", "same session as"], rows, caption=f"{more} more." if more else "")
    return Section("Files that count once", tables=[table] if rows else [], folded=True)
