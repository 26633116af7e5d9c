"""The section of a report on the gyros, where the session calibrates them."""

from __future__ import annotations

import numpy as np

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.base.numbers import (
    HEAD,
    QuantityRow,
    format_fixed,
    format_number,
    format_uncertain,
    join_words,
)
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.gyros.gyro_fit import GyroFit, fit_gyro, gains_in
from adis_gonio.handover.offsets import gyro_offset_words
from adis_gonio.model.records import Session
from adis_gonio.page.document import Figure, Section, Table
from adis_gonio.page.svg import Role, Series, plot
from adis_gonio.tracing.trace_calibrations import gyros_as_recorded

_ROLES: tuple[Role, ...] = ("after", "third", "fourth")


def gyro_section(session: Session) -> Section | None:
    """Parameters, residuals, what is not determined; None where nothing calibrates the gyros."""
    try:
        result = fit_gyro(session)
    except AdisGonioError:
        return None
    said = [
        how_well(result),
        f"By the mean rates of {result.held}: a gyro reads K D ω + b + G f, with ω the rate of turn, b its "
        "zero rate, K its gain, D its axis in the accelerometers' frame, f what these read.",
        f"Residual {format_number(result.residual_rms_dps)} °/s rms; χ² / degrees of freedom "
        f"{format_number(result.chi2)} / {result.dof}.",
    ]
    gains = gains_in(result)
    if gains is not None:
        said.append(gains.line)
    return Section(
        "Gyros",
        words=said,
        points=tuple(result.warnings),
        figures=[_residuals(result)],
        tables=[by_gyro(result), *_offsets(session), *_scores(result)],
        parts=[Section("Every parameter of the gyros", tables=_every(result), folded=True)],
    )


def how_well(result: GyroFit) -> str:
    """What was determined, and how well, in a sentence."""
    largest: dict[str, list[float]] = {}
    for name, value in result.parameters.items():
        if value.u is not None:
            largest.setdefault(name.rsplit("_", 1)[0], []).append(value.u)
    told = {
        "gyro_bias": "zero rates to {} °/s",
        "gyro_scale": "gains to {} %",
        "gyro_misalignment": "directions of axes to {}°",
        "g_sensitivity": "what force adds to {} °/s/g",
    }
    parts = [
        text.format(format_number(max(largest[kind]) * (100 if kind == "gyro_scale" else 1), 2))
        + ("" if len(largest[kind]) in (3, 6, 9) else f" ({len(largest[kind])} of them)")
        for kind, text in told.items()
        if kind in largest
    ]
    return f"Determined: {join_words(parts)} (largest standard uncertainty of each)."


_KINDS = {
    "gyro_bias_{}": "zero rate / (°/s)",
    "gyro_scale_{}": "gain",
    **{f"gyro_misalignment_{{}}{j}": f"misalignment towards {j.upper()} / °" for j in "xyz"},
    **{f"g_sensitivity_{{}}{j}": f"force along {j.upper()} adds / (°/s/g)" for j in "xyz"},
}


def by_gyro(result: GyroFit) -> Table:
    """What is wrong with each gyro, one beside the other; rows of which nothing is known are left out."""
    rows = []
    for pattern, said in _KINDS.items():
        names = [pattern.format(axis) for axis in "xyz"]
        if any(name in result for name in names):
            rows.append([said, *(_cell(result, name) for name in names)])
    caption = (
        "Value ± standard uncertainty. – was not determined and counts as that of a perfect gyro: "
        "see the remarks above."
    )
    return Table(["quantity", "gyro X", "gyro Y", "gyro Z"], rows, caption=caption, numeric=(1, 2, 3))


def _cell(result: GyroFit, name: str) -> str:
    if name not in result:
        towards_itself = name.startswith("gyro_misalignment") and name[-1] == name[-2]
        return "" if towards_itself else "–"
    return format_uncertain(result[name].value, result[name].u)


def _every(result: GyroFit) -> list[Table]:
    """Parameters by name, and how the triad stands to the accelerometers'."""
    captions = (
        "First letter the gyro, second the axis of the accelerometers. u: standard uncertainty; U = k·u.",
        "Rotation of the gyros' triad against the accelerometers', and 90° minus its own angles.",
    )
    return [
        Table(HEAD, [QuantityRow.of(*one).cells for one in values.items()], caption, numeric=(2, 3, 4, 5))
        for values, caption in zip((result.parameters, result.triad), captions, strict=True)
        if values is not None
    ]


def _scores(result: GyroFit) -> list[Table]:
    """Residuals of dwells that were left out."""
    if not result.scores:
        return []
    rows = [
        [
            name,
            *(format_number(rms) for rms in score.rms_dps.values()),
            format_number(max(score.max_dps.values())),
        ]
        for name, score in result.scores.items()
    ]
    head = ["model", "X / (°/s)", "Y / (°/s)", "Z / (°/s)", "largest / (°/s)"]
    caption = "Residual of dwells at rest, each left out of the fit in turn, rms by gyro."
    return [Table(head, rows, caption=caption, numeric=(1, 2, 3, 4))]


def _offsets(session: Session) -> list[Table]:
    """What the chip's registers held, and what would take the zero rates out."""
    if session.sensor not in VARIANTS:
        return []
    try:
        words = gyro_offset_words(gyros_as_recorded(session))
    except AdisGonioError:
        return []
    rows = [
        [
            word.name,
            format_fixed(word.before, 0),
            format_fixed(word.number, 0),
            format_fixed(word.left_dps, 4, sign=True),
        ]
        for word in words
    ]
    head = ["register", "while recorded", "takes the zero rate out", "left / (°/s)"]
    return [Table(head, rows, caption="One LSB is 0.018315 °/s at every range.", numeric=(1, 2, 3))]


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
