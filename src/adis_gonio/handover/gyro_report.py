"""Sections of a report on the gyros: their calibration, and their noise at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adis_gonio.base import numbers
from adis_gonio.base.errors import AdisGonioError, DataError
from adis_gonio.fitting.allan import AllanResult, AxisNoise, allan_fit, fit_allan
from adis_gonio.fitting.gyros.gyro_fit import GyroFit, fit_gyro
from adis_gonio.model.records import Session
from adis_gonio.page.document import Figure, Role, Section, Series, Table, plot, render

_ROLES: tuple[Role, ...] = ("after", "third", "fourth")


def gyro_section(session: Session) -> Section | None:
    """Return the section on the gyros: parameters, residuals, remarks; None if the session lacks them."""
    try:
        result = fit_gyro(session)
    except AdisGonioError:
        return None
    sentences = [
        f"By the mean rates of {result.extent}: a gyro reads K D ω + b + G f, with ω the rate of turn, b "
        "its zero rate, K its gain, D its axis in the accelerometers' frame, f their readings.",
        f"Residual {numbers.format_number(result.residual_rms_dps)} °/s rms; χ² / degrees of freedom "
        f"{numbers.format_number(result.chi2)} / {result.dof}.",
    ]
    return Section(
        "Gyros",
        words=sentences,
        points=tuple(result.warnings),
        figures=[_residuals(result)],
        tables=[gyro_table(result)],
    )


_KINDS = {
    "gyro_bias_{}": "zero rate / (°/s)",
    "gyro_scale_{}": "gain",
    **{f"gyro_misalignment_{{}}{j}": f"misalignment towards {j.upper()} / °" for j in "xyz"},
    **{f"g_sensitivity_{{}}{j}": f"force along {j.upper()} adds / (°/s/g)" for j in "xyz"},
}


def gyro_table(result: GyroFit) -> Table:
    """Return a table with a column for each gyro's errors; rows of unknown quantities are omitted."""
    rows = []
    for pattern, title in _KINDS.items():
        names = [pattern.format(axis) for axis in "xyz"]
        if any(name in result for name in names):
            rows.append([title, *(_cell(result, name) for name in names)])
    caption = "Value ± U (95 %). A dash: not determined, taken as ideal (see the remarks above)."
    return Table(["quantity", "gyro X", "gyro Y", "gyro Z"], rows, caption=caption, numeric=(1, 2, 3))


def _cell(result: GyroFit, name: str) -> str:
    if name not in result:
        towards_itself = name.startswith("gyro_misalignment") and name[-1] == name[-2]
        return "" if towards_itself else "–"
    return numbers.format_uncertain(result[name].value, result[name].U)


def _residuals(result: GyroFit) -> Figure:
    residual = result.residual_dps
    order = np.arange(1.0, len(residual) + 1)
    data = None if result.fit is None else result.fit.data
    u = None if data is None else np.sqrt(np.diagonal(data.covariance, axis1=1, axis2=2))
    series = [
        Series(
            order + 0.12 * (k - 1),
            residual[:, k],
            f"gyro {axis}",
            None if u is None else u[:, k],
            _ROLES[k],
        )
        for k, axis in enumerate("XYZ")
    ]
    turns = ", turns between them" if result.turns else ""
    title = "Residual of the gyros against the number of the interval"
    drawn = plot(series, f"dwells in order{turns}", "reading − model / (°/s)", title=title, zero=True)
    return Figure(drawn, f"{title}; bars are standard uncertainties of a mean.")


LONG_S = 30.0
"""Length in s of a rest that shows the floor of a gyro's Allan deviation (docs/gyros.md).
Shorter rests show little but white noise."""


def allan_page(result: AllanResult) -> str:
    """Return the noise at rest as one HTML page that needs no other file; every text is escaped."""
    whole = section_of(result)
    return render(
        "Noise at rest",
        title_of(result),
        shape=result.sensor,
        simulated=result.simulated,
        sections=[replace(whole, title="Recording", parts=()), *whole.parts],
        closing="This page is made from the session's file and can be made again from it.",
    )


def title_of(result: AllanResult) -> str:
    """Return the part and the session of a result, such as `gyros of rest.csv`."""
    return f"{allan_fit.PARTS[result.part]} of {result.title or result.source or 'session'}"


def noise_section(session: Session) -> Section | None:
    """Return the section on the gyros' noise; None without gyros or slow noise.

    Slow noise is 1/f noise or a random walk of any axis; a rest of `LONG_S` seconds shows it.
    """
    try:
        result = fit_allan(session)
    except DataError:
        return None
    slow = any(axis[kind].present for axis in result.axes for kind in ("flicker", "walk"))
    return section_of(result) if slow or result.longest_s >= LONG_S else None


def section_of(result: AllanResult, *, figures: bool = True) -> Section:
    """Return a section with the content of `allan_page`; `figures` is False for the terminal."""
    return Section(
        f"Noise of the {allan_fit.PARTS[result.part]} at rest",
        words=(f"{allan_fit.headline(result)}.",),
        notes=[
            *result.notes,
            "The coefficients follow IEEE Std 952-1997, Annex C; the bias instability is the floor of the"
            " Allan deviation, 0.664 times the standard's B. They are fitted to the samples by restricted"
            " maximum likelihood, not to the points of the plot.",
            "A noise that was not separately detected has an upper limit (95 %).",
        ],
        parts=[_section(result, axis, figures=figures) for axis in result.axes],
    )


def _section(result: AllanResult, axis: AxisNoise, *, figures: bool) -> Section:
    rows: list[tuple[str, ...]] = []
    absent: list[str] = []
    for parameter in axis.parameters:
        if parameter.present:
            rows.append(allan_fit.cells(parameter))
        elif parameter.kind != "quantization":
            limit = numbers.with_unit(numbers.format_number(parameter.high), parameter.unit)
            absent.append(f"{allan_fit.name_shown(parameter)}: not separately detected, at most {limit}")
    return Section(
        f"{axis.name.upper()}",
        points=[*absent, *axis.notes],
        figures=(_figure(result, axis),) if figures else (),
        tables=(Table(("noise", "value", "u", "95 % interval", "ν", "unit"), rows, numeric=(1, 2, 3, 4)),),
    )


def _figure(result: AllanResult, axis: AxisNoise) -> Figure:
    curve = axis.curve
    series = [
        Series(curve.tau_s, curve.deviation, "measured", role="before"),
        Series(curve.tau_s, curve.low, "its 95 %", role="model", style="line"),
        Series(curve.tau_s, curve.high, "", role="model", style="line"),
        Series(curve.tau_s, curve.model, "fitted noise", role="after", style="line"),
    ]
    title = f"Allan deviation of {axis.name}"
    unit = numbers.format_unit(result.unit)
    # A sentence for a screen reader.
    first, last, least = (
        f"{numbers.format_number(curve.deviation[k])} {unit} at {numbers.format_number(curve.tau_s[k])} s"
        for k in (0, -1, int(curve.deviation.argmin()))
    )
    drawn = plot(
        series,
        "averaging time / s",
        f"Allan deviation / {unit}",
        title=title,
        description=f"{axis.name.upper()}: from {first} to {last}, least {least}.",
        x_log=True,
        y_log=True,
    )
    return Figure(drawn, f"{title}: overlapping estimate with its interval, and the fitted noise's curve.")
