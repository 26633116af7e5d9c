"""The noise at rest: coverage, false claims, and the reading-off of slopes beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

import allan_boundary
import allan_statistics as allan
from results.section import Effort, Section, svg, table

if TYPE_CHECKING:
    from adis_gonio.fitting.allan import AxisNoise

SESSIONS = 120
EXAMPLE = "all three"
DRAWS = 20000

Limits = Mapping[str, Mapping[str, float]]
"""Coverage of long records by case and kind."""
_NAMES = {
    "quantization": "quantization",
    "white": "random walk N",
    "flicker": "bias instability",
    "walk": "rate random walk K",
}


def run(effort: Effort) -> Section:
    """Every case of the script; three axes a session."""
    rows = allan.run(effort.sessions(SESSIONS, 1), effort.seed, effort.jobs)
    return section_of(allan.summary(rows), example(effort.seed), limits(effort.seed))


def limits(seed: int) -> Limits:
    """What the boundary leaves of 95 % where records are long."""
    rng = np.random.default_rng(seed)
    return {name: allan_boundary.coverage(case, DRAWS, rng) for name, case in allan.CASES.items()}


def example(seed: int) -> AxisNoise:
    """One axis of the case that has all noises."""
    case = allan.CASES[EXAMPLE]
    return allan.fit_allan(allan.session_of(case, allan.samples(case, seed)))["x"]


def section_of(cases: Mapping[str, Mapping[str, Any]], shown: AxisNoise, limits: Limits) -> Section:
    """The page of a summary, of one axis as an example, and of what long records would cover."""
    markdown = f"""
Simulated records at rest, three axes each, {allan.LSB_DPS} °/s to the converter's step, 100 samples a
second (the simulator's: 819.2); truth, generator and sizes stand in `scripts/allan_statistics.py`.
The noise is written there from IEEE Std 952-1997, Annex C, in one case by the package's own simulator.

## What is present

Coverage: the interval of 95 % holds the truth, whether the noise was claimed or not (then it begins at 0).
U: value ± U holds it, of those that were claimed. In brackets the 95 % of the share itself.

{_lines(_present(cases, limits))}

![Coverage of the interval of 95 % by case and noise](allan-coverage.svg)

*By the information*: what the interval would cover if estimates were normal with the Fisher information
(`scripts/allan_boundary.py`). Kinds that a record does not have can be found above zero and not below it,
and what they take is missing from their neighbours: nearly all misses of white noise alone are low ones.
This, and intervals that may begin at zero where the noise hardly shows, moves the coverage from 95 % by
less than 1.2 %. The simulator's 1/f noise ends at 1.6 Hz, the standard's does not: its N is read a third of
its u low, which alone costs two per cent of its coverage.

## One axis

{_said(shown)}

![Allan deviation of one axis with the fitted noise](allan-example.svg)

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
    figures = {"coverage": _coverage_figure(cases), "example": _example_figure(shown)}
    return Section("Noise at rest", markdown, {"cases": cases, "limits": limits}, figures)


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


def _present(cases: Mapping[str, Mapping[str, Any]], limits: Limits) -> list[list[str]]:
    rows = [["case", "axes", "noise", "claimed", "coverage", "by the information", "± U"]]
    for name, kind, found in _each(cases, present=True):
        within = "–" if found["within_U"] is None else f"{100 * found['within_U']:.1f} %"
        rows.append(
            [
                name,
                str(cases[name]["axes"]),
                _NAMES[kind],
                f"{100 * found['claimed']:.0f} %",
                _share(found["coverage"], found["coverage_95"]),
                f"{100 * limits[name][kind]:.1f} %",
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


def _said(shown: AxisNoise) -> str:
    """The example in words."""
    truth = allan.CASES[EXAMPLE].truth
    values = [
        f"{_NAMES[one.kind]} {one.value.value:.3g} ± {one.value.u:.1g} (true: {truth[one.kind]:g})"
        for one in shown.parameters
        if one.value is not None and one.value.u is not None
    ]
    return (
        f"The case '{EXAMPLE}', u behind ±: {'; '.join(values)}.\n"
        "The points are the overlapping Allan deviation, the band its interval of 95 % by the degrees of\n"
        "freedom that the fitted noise gives it; the line is that noise, fitted to the samples and not to\n"
        "the points."
    )


def _coverage_figure(cases: Mapping[str, Mapping[str, Any]]) -> str:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    rows = list(reversed(_each(cases, present=True)))
    with mpl.rc_context({"svg.hashsalt": "allan", "svg.fonttype": "none"}):
        figure = Figure(figsize=(7, 0.26 * len(rows) + 1), layout="constrained")
        axes = figure.subplots()
        axes.axvspan(*(100 * share for share in allan.BAND), color="0.85", label="94 to 96 %")
        for place, (_, _, found) in enumerate(rows):
            low, high = (100 * share for share in found["coverage_95"])
            axes.plot([low, high], [place, place], color="C0")
            axes.plot(100 * found["coverage"], place, "o", color="C0")
        axes.set_yticks(range(len(rows)), [f"{name}: {_NAMES[kind]}" for name, kind, _ in rows])
        axes.set(xlabel="coverage / %, with its own 95 %")
        axes.legend(loc="lower left", frameon=False)
        return svg(figure)


def _example_figure(shown: AxisNoise) -> str:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    curve = shown.curve
    with mpl.rc_context({"svg.hashsalt": "allan", "svg.fonttype": "none"}):
        figure = Figure(figsize=(7, 3.8), layout="constrained")
        axes = figure.subplots()
        axes.fill_between(curve.tau_s, curve.low, curve.high, color="0.85", label="its 95 %")
        axes.plot(curve.tau_s, curve.deviation, "o", mfc="none", color="C1", label="Allan deviation")
        axes.plot(curve.tau_s, curve.model, color="C0", label="fitted noise")
        axes.set(xscale="log", yscale="log", xlabel="averaging time / s", ylabel="Allan deviation / (°/s)")
        axes.legend(frameon=False)
        return svg(figure)
