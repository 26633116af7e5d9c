"""Slips, swapped and mistyped positions: what is found, what is accused falsely, and from which size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import slip_statistics as sessions
from results.section import Effort, Section, svg, table

FAULTY, GOOD = 200, 500
BESIDE_FAULTY, BESIDE_GOOD = 100, 100
WANTED = 0.99
_WORDS = {
    "slipped": "a slip of 0.5° to 20°",
    "swapped": "two positions swapped",
    "mistyped": "one mistyped",
}
_COUNTS = ("right", "in the set", "oracle")
_HEAD = ("wrong is", "sessions", *_COUNTS, "without gyros: sessions", *_COUNTS)

Row = Mapping[str, Any]


def run(effort: Effort) -> Section:
    """Sessions with one fault and without, with gyros; fewer without gyros."""
    faulty, good = effort.sessions(FAULTY, 3), effort.sessions(GOOD, 1)
    beside = effort.sessions(BESIDE_FAULTY, 3), effort.sessions(BESIDE_GOOD, 1)
    return section_of(
        sessions.run(faulty, good, effort.seed, effort.jobs),
        sessions.run(*beside, effort.seed, effort.jobs, gyros=False),
    )


def section_of(rows: Sequence[Row], still: Sequence[Row]) -> Section:
    """The page: with gyros, and without."""
    with_gyros, without = sessions.summary(rows), sessions.summary(still)
    slips = [row for row in rows if row["fault"] == "slipped"]
    from_deg = _from(slips, "size_deg")
    ratio = _from([row for row in rows if row["fault"] is not None], "ratio")
    faulty, good = with_gyros["sessions"], with_gyros["good"]
    seen, sure = with_gyros["of_detectable"], with_gyros["of_oracle"]
    lines = [
        f"{faulty} sessions in which one thing is wrong and {good} in which nothing is: 8 to 24 positions",
        "(around, there and back, shuffled) that a hand moves a part through, a fixture of 0.02° to 0.3°,",
        "a drifting temperature, and gyros with all the faults of",
        "[simulated gyros](../simulated_gyros.md); slips come during a move or after it. *Right*: this",
        f"name, this position, nothing else accused, the angle within {sessions.WITHIN:g} u. *In the set*:",
        "another name stands first that predicts the same angles (of the first or last position), the true",
        "one beside it, and the angle is right. *Oracle*: right of somebody who knows how these sessions",
        "are made (`scripts/slip_oracle.py`): the share of faulty ones, the sizes of slips, from which",
        "list the wrong entries were drawn, and that no fixture is worse than stated. He names what is",
        "most probable, certain or not, and does not look at how the hand moved.",
        "",
        *table(_HEAD, [*(_line(name, with_gyros, without) for name in sessions.FAULTS),
                       _total(with_gyros, without)]),
        "",
        "Accused in sessions in which nothing is wrong:",
        f"{with_gyros['accused']} of {good}, by the oracle {with_gyros['oracle_accused']};",
        f"without gyros {without['accused']} of {without['good']},",
        f"by the oracle {without['oracle_accused']}.",
        "",
        f"Of the {sure['sessions']} faulty sessions in which the oracle is right, {sure['right']} are",
        f"right here and {sure['alike']} in the set.",
        "",
        "## From which size",
        "",
        "Each session says from which size on it would have accused an error with 99 % power.",
        f"Of errors above their own session's: right {seen['right']}, in the set {seen['alike']}, of",
        f"{seen['sessions']}. Right or in the set in at least {100 * WANTED:g} % of all errors larger than",
        f"{_stated(ratio, ' times that size')}; of slips larger than {_stated(from_deg, '°')}, over all",
        "these fixtures. What is smaller is what twice the fixture's stated uncertainty does to a good",
        "session as well, and is not accused.",
        "",
        "![Slips by their size and the fixture](slips-sizes.svg)",
    ]  # fmt: skip
    document = {
        "with_gyros": with_gyros,
        "without_gyros": without,
        "slips_from_deg": from_deg,
        "from_times_detectable": ratio,
        "not_right": [row for row in rows if not row["right"]],
    }
    return Section("Slips and wrong positions", "\n".join(lines), document, {"sizes": _figure(slips)})


def _line(name: str, *found: Mapping[str, Any]) -> list[str]:
    return [_WORDS[name], *_cells([one["by_fault"][name] for one in found])]


def _total(*found: Mapping[str, Any]) -> list[str]:
    return ["all", *_cells(found)]


def _cells(counts: Sequence[Mapping[str, Any]]) -> list[str]:
    return [str(one[key]) for one in counts for key in ("sessions", "right", "alike", "oracle")]


def _size(row: Row, key: str) -> float:
    if key != "ratio":
        return float(row[key])
    return float(row["size_deg"]) / max(float(row["detectable_deg"]), 1e-9)


def _from(rows: Sequence[Row], key: str) -> float | None:
    """Smallest size from which on the wanted share is told; None where there is none."""
    ordered = sorted(rows, key=lambda row: -_size(row, key))
    told, smallest = 0, None
    for count, row in enumerate(ordered, 1):
        told += row["right"] or row["alike"]
        if told >= WANTED * count:
            smallest = _size(row, key)
    return smallest


def _stated(value: float | None, unit: str) -> str:
    return "no size" if value is None else f"{value:.2f}{unit}"


def _figure(slips: Sequence[Row]) -> str:
    """Size against the fixture's uncertainty, found and not."""
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
