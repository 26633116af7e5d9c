"""Poses in space with the turns between them: coverage, what the turns gain, false gyros."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import links_statistics as links
from results.section import Effort, Section, table

SESSIONS = 120
_NAMES = {"scale": "gains", "skew": "skews", "bias": "biases"}
_UNITS = {"scale": (100.0, " %"), "skew": (1.0, "°"), "bias": (1.0, " mg")}


def run(effort: Effort) -> Section:
    """Simulated hands, two parts in turn."""
    return section_of(links.run(effort.sessions(SESSIONS, 2), effort.seed, effort.jobs))


def section_of(rows: Sequence[Mapping[str, Any]]) -> Section:
    """The page."""
    found = links.summary([dict(row) for row in rows])
    known = 100 * np.sqrt(0.95 * 0.05 / (3 * found["sessions"]))
    markdown = f"""
## Poses in space with the turns between them

{found["sessions"]} simulated parts (adis16354 and adis16350 in turn) with realistic gyros (gains,
directions, triad, g-sensitivity and its square, asymmetry, warm-up, 1/f noise, the earth) are laid by a
hand in random poses of {links.DWELL_S:.0f} s. Their first {links.POSES[0]} to {links.POSES[-1]} poses are
fitted by gravity alone, with the turns and the gyros' data sheet, and with the turns and a calibration of
the gyros (gains {100 * links.GAIN_U:.2f} %, directions {links.LEAN_U_DEG}°, g-sensitivity {links.G_U}
°/s/g, off by as much).

### Coverage of U (95 %)

{_lines(_coverage(found))}

A share is known to ± {known:.1f} % (one standard deviation, parameters taken as independent). By gravity
alone few poses determine little: the share that is determined stands in brackets where it is not all. What
it then states of five or six poses takes skews as zero; what they may be by the data sheet is in its u.
With a data sheet intervals are a little wide where the sheet decides (few poses): these gyros are better
than its limits.

### u, median

{_lines(_sizes(found))}

### u with turns over u by gravity alone, median, of what both determine

{_lines(_ratios(found))}

![What turns gain](links-ratio.svg)

The poses are random, as a hand lays them that has no plan. The 14 of `--plan poses` are chosen for gravity
alone, and leave the turns nothing to add.

### Gyros that are false, {links.FALSE_POSES} poses

{_lines(_false(found))}

"Some left out" counts sessions in which single turns were left out with the reason and the others used, as
where a turn leaves the range of its gyros.
"""
    return Section("Turns between poses", markdown, {"links": found}, {"ratio": _figure(found)})


def _lines(rows: list[list[str]]) -> str:
    return "\n".join(table(rows[0], rows[1:]))


def _coverage(found: Mapping[str, Any]) -> list[list[str]]:
    ways = [way for way in links.WAYS if way != "alone"]
    head = ["poses", "gravity alone"]
    head += [f"{_NAMES[kind]}, {_told(way)}" for way in ways for kind in links.KINDS]
    rows = [head]
    for poses, at in found["poses"].items():
        row = [poses, _share(at["alone"]["all"])]
        rows.append(row + [_share(at[way][kind]) for way in ways for kind in links.KINDS])
    return rows


def _told(way: str) -> str:
    return {"alone": "gravity alone", "sheet": "data sheet", "calibrated": "calibrated"}[way]


def _share(of: Mapping[str, Any]) -> str:
    if of["coverage"] is None:
        return "–"
    told = f"{100 * of['coverage']:.1f} %"
    return told if of["determined"] > 0.999 else f"{told} ({100 * of['determined']:.0f} %)"


def _sizes(found: Mapping[str, Any]) -> list[list[str]]:
    rows = [["poses", *(f"{_NAMES[k]}, {_told(way)}" for k in links.KINDS for way in links.WAYS)]]
    for poses, at in found["poses"].items():
        row = [poses]
        for kind in links.KINDS:
            factor, unit = _UNITS[kind]
            for way in links.WAYS:
                u = at[way][kind]["u"]
                row.append("–" if u is None else f"{factor * u:.2g}{unit}")
        rows.append(row)
    return rows


def _ratios(found: Mapping[str, Any]) -> list[list[str]]:
    ways = [way for way in links.WAYS if way != "alone"]
    rows = [["part", "poses", *(f"{_NAMES[k]}, {_told(way)}" for way in ways for k in links.KINDS)]]
    for part in links.PARTS:
        for poses, at in found["poses"].items():
            ratios = [at[way]["ratio"][part][kind] for way in ways for kind in links.KINDS]
            if any(ratio is not None for ratio in ratios):
                rows.append([part, poses, *map(_number, ratios)])
    return rows


def _number(value: float | None) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.2f}"


def _false(found: Mapping[str, Any]) -> list[list[str]]:
    rows = [["gyros", "sessions", "turns refused", "some left out", "coverage of U (95 %)"]]
    for name, one in found["false"].items():
        told = "–" if one["coverage"] is None else f"{100 * one['coverage']:.1f} %"
        row = [name, str(one["sessions"]), str(one["refused"]), str(one["some_left_out"]), told]
        rows.append(row)
    return rows


def _figure(found: Mapping[str, Any]) -> str:
    """Skews' u with turns over that by gravity alone."""
    from adis_gonio.page.svg import Series, plot

    lines = []
    for part, way, role in [
        (links.PARTS[0], "sheet", "before"),
        (links.PARTS[0], "calibrated", "after"),
    ]:
        at = [
            (float(poses), one[way]["ratio"][part]["skew"])
            for poses, one in found["poses"].items()
            if one[way]["ratio"][part]["skew"] is not None
        ]
        x, y = np.array(at).T if at else (np.zeros(0), np.zeros(0))
        lines.append(Series(x, y, f"{part}, {_told(way)}", role=role))
    return plot(lines, "poses", "u of skews over that by gravity alone", title="What turns gain")
