"""A part's noise at rest, as a page and in a report: coefficients with u beside the Allan plot."""

from __future__ import annotations

from dataclasses import replace

from adis_gonio.base.errors import DataError
from adis_gonio.base.numbers import format_number, format_unit
from adis_gonio.fitting.allan import AllanResult, AxisNoise, fit_allan
from adis_gonio.fitting.allan import allan_result as said
from adis_gonio.model.records import Session
from adis_gonio.page.parts import Figure, Section, Table
from adis_gonio.page.render import render
from adis_gonio.page.svg import ROLES, Series, plot

LONG_S = 30.0
"""Rests from which a gyro's floor shows (docs/noise.md): shorter ones know white noise and little else."""
_TIME = "averaging time / s"
_SLOW = ("flicker", "walk")


def allan_page(result: AllanResult) -> str:
    """One HTML page that loads nothing; every text is escaped."""
    name = result.title or result.source or "session"
    whole = section_of(result)
    return render(
        "Noise at rest",
        f"{said.PARTS[result.part]} of {name}",
        shape=result.sensor,
        simulated=result.simulated,
        sections=[replace(whole, title="What was recorded", parts=()), *whole.parts],
        closing="This page is made from the session's file and can be made again from it.",
    )


def noise_section(session: Session) -> Section | None:
    """The gyros' noise for a report of a session; None without gyros, and where rests are too short."""
    try:
        result = fit_allan(session)
    except DataError:
        return None
    return section_of(result) if worth_saying(result) else None


def worth_saying(result: AllanResult) -> bool:
    """The rests are long enough to see slow noise, or show it."""
    shown = any(axis[kind].present for axis in result.axes for kind in _SLOW)
    return shown or result.longest_s >= LONG_S


def section_of(result: AllanResult) -> Section:
    """What `allan_page` holds, as a section of another page."""
    return Section(
        f"Noise of the {said.PARTS[result.part]} at rest",
        words=(f"{said.headline(result)}.",),
        notes=[*result.notes, *_reading()],
        parts=[_section(result, axis) for axis in result.axes],
    )


def allan_svg(result: AllanResult) -> str:
    """Allan deviations of all axes with the fitted curves, as one drawing."""
    series = []
    for role, axis in zip(ROLES, result.axes, strict=False):
        curve = axis.curve
        series.append(Series(curve.tau_s, curve.deviation, axis.axis, role=role))
        series.append(Series(curve.tau_s, curve.model, "", role="model", style="line"))
    title = f"Allan deviation of the {said.PARTS[result.part]}"
    described = " ".join(_described(result, axis) for axis in result.axes)
    return plot(
        series, _TIME, _deviation(result), title=title, description=described, x_log=True, y_log=True,
        width=560, height=380,
    )  # fmt: skip


def _deviation(result: AllanResult) -> str:
    return f"Allan deviation / {format_unit(result.unit)}"


def _reading() -> tuple[str, ...]:
    return (
        "The coefficients are those of IEEE Std 952-1997, Annex C; the bias instability is the floor of the"
        " Allan deviation, 0.664 times the standard's B. They are fitted to the samples by restricted"
        " maximum likelihood, not to the points of the plot.",
        "What is not present has the limit that it stays under (95 %), and the size that these records"
        " would have shown in nine of ten cases.",
    )


def _section(result: AllanResult, axis: AxisNoise) -> Section:
    rows: list[tuple[str, ...]] = []
    absent: list[str] = []
    for parameter in axis.parameters:
        if parameter.present:
            # Every row has its name: who hears a table hears the head of each row.
            rows += [(said.name_shown(parameter), *row[1:]) for row in said.cells(parameter)]
        elif parameter.kind != "quantization":
            unit = format_unit(parameter.unit)
            absent.append(f"{said.name_shown(parameter)} / {unit}: {said.missing(parameter)}")
    return Section(
        f"{axis.axis.upper()}",
        points=[*absent, *axis.notes],
        figures=(_figure(result, axis),),
        tables=(Table(("noise", *said.HEAD[1:]), rows, numeric=(1, 2, 3, 4)),),
    )


def _figure(result: AllanResult, axis: AxisNoise) -> Figure:
    curve = axis.curve
    series = [
        Series(curve.tau_s, curve.deviation, "measured", role="before"),
        Series(curve.tau_s, curve.low, "its 95 %", role="model", style="line"),
        Series(curve.tau_s, curve.high, "", role="model", style="line"),
        Series(curve.tau_s, curve.model, "fitted noise", role="after", style="line"),
    ]
    title = f"Allan deviation of {axis.axis}"
    drawn = plot(
        series, _TIME, _deviation(result), title=title, description=_described(result, axis), x_log=True,
        y_log=True,
    )  # fmt: skip
    return Figure(drawn, f"{title}: overlapping estimate with its interval, and the fitted noise's curve.")


def _described(result: AllanResult, axis: AxisNoise) -> str:
    """The curve in a sentence, for who does not see it."""
    tau, deviation, unit = axis.curve.tau_s, axis.curve.deviation, format_unit(result.unit)
    first, last, least = (
        f"{format_number(deviation[k])} {unit} at {format_number(tau[k])} s"
        for k in (0, -1, int(deviation.argmin()))
    )
    return f"{axis.axis.upper()}: from {first} to {last}, least {least}."
