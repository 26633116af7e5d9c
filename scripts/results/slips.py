"""Slips, swapped and mistyped positions: found, wrongly found, and the smallest size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import slip_statistics as sessions
from results.section import Effort, Section, svg

FAULTY, GOOD = 200, 500
FAULTY_WITHOUT, GOOD_WITHOUT = 100, 100
WANTED = 0.99
Row = Mapping[str, Any]


def run(effort: Effort) -> Section:
    """Measure sessions with one fault and without, with gyros, and fewer without gyros."""
    faulty, good = effort.sessions(FAULTY, 1), effort.sessions(GOOD, 1)
    without = effort.sessions(FAULTY_WITHOUT, 1), effort.sessions(GOOD_WITHOUT, 1)
    return section_of(
        sessions.run(faulty, good, effort.seed, effort.jobs),
        sessions.run(*without, effort.seed, effort.jobs, gyros=False),
    )


def section_of(rows: Sequence[Row], still: Sequence[Row]) -> Section:
    """The section: with gyros, and without."""
    with_gyros, without = sessions.summary(rows), sessions.summary(still)
    slips = [row for row in rows if row["fault"] == "slipped"]
    from_deg = _from(slips, "size_deg")
    ratio = _from([row for row in rows if row["fault"] is not None], "ratio")
    document = {
        "with_gyros": with_gyros,
        "without_gyros": without,
        "slips_from_deg": from_deg,
        "from_times_detectable": ratio,
        "not_right": [row for row in rows if not row["right"]],
    }
    return Section(document, {"sizes": _figure(slips)})


def _size(row: Row, key: str) -> float:
    if key != "ratio":
        return float(row[key])
    return float(row["size_deg"]) / max(float(row["detectable_deg"]), 1e-9)


def _from(rows: Sequence[Row], key: str) -> float | None:
    """Smallest size above which the wanted share is found; None if there is none."""
    ordered = sorted(rows, key=lambda row: -_size(row, key))
    found, smallest = 0, None
    for count, row in enumerate(ordered, 1):
        found += row["right"] or row["alike"]
        if found >= WANTED * count:
            smallest = _size(row, key)
    return smallest


def _figure(slips: Sequence[Row]) -> str:
    """Draw sizes against the uncertainty of the fixture, found and not found."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"svg.hashsalt": "slips", "svg.fonttype": "none"}):
        figure = Figure(figsize=(7, 3.6), layout="constrained")
        axes = figure.subplots()
        for label, marker, wanted in (("right", "o", True), ("not right", "x", False)):
            some = [row for row in slips if row["right"] == wanted]
            axes.plot(
                [row["fixture_deg"] for row in some], [row["size_deg"] for row in some], marker,
                label=label, fillstyle="none",
            )  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel="uncertainty of a stage angle (°)", ylabel="slip (°)")
        axes.legend()
        return svg(figure)
