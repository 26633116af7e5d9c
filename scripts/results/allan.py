"""The noise at rest: coverage, false claims, and the reading-off of slopes beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import allan_statistics as allan
from results.section import Effort, Section, table

SESSIONS = 40
_NAMES = {
    "quantization": "quantization",
    "white": "random walk N",
    "flicker": "bias instability",
    "walk": "rate random walk K",
}


def run(effort: Effort) -> Section:
    """Every case of the script; three axes a session."""
    rows = allan.run(effort.sessions(SESSIONS, 1), effort.seed, effort.jobs)
    return section_of(allan.summary(rows))


def section_of(cases: Mapping[str, Mapping[str, Any]]) -> Section:
    """The page of a summary."""
    markdown = f"""
Simulated records at rest, three axes each, {allan.LSB_DPS} °/s to the converter's step, 100 samples a
second (the simulator's: 819.2); truth, generator and sizes stand in `scripts/allan_statistics.py`.
The noise is written there from IEEE Std 952-1997, Annex C, in one case by the package's own simulator.

## What is present

Coverage: the interval of 95 % holds the truth, whether the noise was claimed or not (then it begins at 0).
U: value ± U holds it, of those that were claimed. In brackets the 95 % of the share itself.

{_lines(_present(cases))}

An interval that may begin at zero covers more than 95 % where the noise hardly shows. The simulator's
1/f noise ends at 1.6 Hz, the standard's does not: its N is read 0.15 % low, a third of its u.

## What is absent

Claims of noise that the record does not have; each is made at a level of 2.5 %.

{_lines(_absent(cases))}

## Beside the reading-off of slopes

Median error and rms error, relative to the truth, of what was claimed; beside it N, floor and K read off
allantools' overlapping Allan deviation where its slope is nearest to −½, 0 and +½, as is usual. Such a
reading always gives a bias instability, present or not, and behind a filter it takes the filter's own
slopes for noise.

{_lines(_peers(cases))}

## Does the spectrum fit

{_lines(_adequate(cases))}
"""
    return Section("Noise at rest", markdown, {"cases": cases})


def _lines(rows: list[list[str]]) -> str:
    return "\n".join(table(rows[0], rows[1:]))


def _each(
    cases: Mapping[str, Mapping[str, Any]], *, present: bool
) -> list[tuple[str, str, Mapping[str, Any]]]:
    return [
        (name, kind, found)
        for name, case in cases.items()
        for kind, found in case["kinds"].items()
        if (found["truth"] is not None) == present and "claimed" in found
    ]


def _share(value: float, interval: list[float]) -> str:
    return f"{100 * value:.1f} % ({100 * interval[0]:.1f} to {100 * interval[1]:.1f})"


def _present(cases: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    rows = [["case", "axes", "noise", "claimed", "coverage", "± U"]]
    for name, kind, found in _each(cases, present=True):
        within = "–" if found["within_U"] is None else f"{100 * found['within_U']:.1f} %"
        rows.append(
            [
                name,
                str(cases[name]["axes"]),
                _NAMES[kind],
                f"{100 * found['claimed']:.0f} %",
                _share(found["coverage"], found["coverage_95"]),
                within,
            ]
        )
    return rows


def _absent(cases: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    rows = [["case", "noise", "claimed", "claimed by slopes"]]
    for name, kind, found in _each(cases, present=False):
        peer = "–" if kind == "quantization" else f"{100 * found['peer_claimed']:.0f} %"
        rows.append([name, _NAMES[kind], _share(found["claimed"], found["claimed_95"]), peer])
    return rows


def _peers(cases: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    rows = [["case", "noise", "bias", "rms", "slopes: bias", "slopes: rms"]]
    for name, kind, found in _each(cases, present=True):
        if kind == "quantization":
            continue
        errors = [found[key] for key in ("bias", "rms", "peer_bias", "peer_rms")]
        rows.append([name, _NAMES[kind], *(_percent(error) for error in errors)])
    return rows


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f} %"


def _adequate(cases: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    rows = [["case", "samples", "filter M", "axes", "of these not adequate (p < 1 %)"]]
    for name, case in cases.items():
        rows.append([name, *(str(case[key]) for key in ("samples", "filter_m", "axes", "inadequate"))])
    return rows
