"""The calibration report: the sections of its HTML page, and the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.base import __version__
from adis_gonio.base.conformity import ErrorCurve, Tolerance, state_conformity
from adis_gonio.base.errors import AdisGonioError
from adis_gonio.base.numbers import (
    DASH,
    HEAD,
    NAMES,
    NO_BREAK,
    UNKNOWN,
    format_number,
    format_percent,
    format_span,
    format_uncertain,
    label_quantity,
    use_minus,
    with_unit,
)
from adis_gonio.base.uncertainty import NORMAL_95, Value
from adis_gonio.device.sensor.settings import compensations
from adis_gonio.fitting.answer import Answer, format_dof, format_share, method_tables
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.fit_result import FitResult
from adis_gonio.fitting.slips.session_positions import Angle, PositionFinding, sentences_of
from adis_gonio.model.records import METADATA, Session
from adis_gonio.page.document import Figure, KeyFigure, Role, Section, Series, Table, plot, render
from adis_gonio.record.provenance import digest_of_file
from adis_gonio.tracing import trace_summary as words
from adis_gonio.tracing.trace_figures import Panel, Views, views_of, what_if_panels
from adis_gonio.tracing.trace_result import TraceResult
from adis_gonio.tracing.traced_answer import answer_with_trace

_COVARIATES = {
    "angle": "declared angle / °",
    "previous_angle": "angle of the position before / °",
    "time": "time / min",
    "order": "number of the dwell",
    "temperature": "temperature / °C",
    "temperature_rate": "rate of the temperature / (°C/min)",
    "temperature_lag": "lag of the temperature / °C",
    "supply": "supply / V",
    "approach": "side of approach",
    "variance": "variance within the dwell / mg²",
}
_ROLES: tuple[Role, Role] = ("before", "after")
_MOST_PLACES = 24
"""Largest number of lines of one finding in the table of single dwells."""
_SIDES = {-1.0: "from above", 1.0: "from below"}


def summary_section(traced: TraceResult | str) -> Section:
    """Return the section that summarises the trace, or states the reason (a text) if there is none."""
    if isinstance(traced, str):
        return Section("Summary", words=[f"The session could not be traced: {traced}"])
    return Section("Summary", words=[words.headline(traced), words.gains(traced)])


def answer_section(answer: Answer) -> Section:
    """Return the section on the recommended answer: values with u, U, k, and the reason for its method."""
    table = Table(
        HEAD,
        answer.lines,
        numeric=(2, 3, 4, 5),
        caption="u: standard uncertainty; U = k·u covers 95 %. The error of the angle is the root mean "
        "square over held-out dwells; its u belongs to a displayed angle.",
    )
    return Section("Answer", words=[f"By method {answer.title}.", answer.why], tables=[table])


def certificate_section(
    answer: Answer,
    known: Mapping[str, str],
    positions: Sequence[PositionFinding] = (),
    tolerance: Tolerance | None = None,
) -> Section:
    """Return the first page of the report, for a laboratory to sign.

    It states results, conformity with the tolerance (if one is given), instrument and conditions. `known`
    are the facts of the session; `positions` are findings on wrong positions.
    """
    try:
        curves = answer.error_curves()
    except AdisGonioError as error:
        figures, stated = [], [f"Conformity is not stated: {error}."]
    else:
        figures = _error_figures(curves, tolerance)
        stated = ["Conformity is not stated: no tolerance was given."]
        if tolerance is not None:
            first, *lines = state_conformity(tolerance, curves).lines
            stated = [f"{first}.", *(f"{line[:1].upper()}{line[1:]}." for line in lines)]
    doubts = dict.fromkeys([*sentences_of(positions), *answer.doubts])
    who = ("sensor", "serial", "stage", "operator", "laboratory", "customer")
    instrument = [[name, known[name] or "not stated"] for name in who]
    conditions = [
        ["date (UTC)", known["begun (UTC)"][:16].replace("T", " ") or "not stated"],
        ["session", known["session"]],
        *([name, known[name]] for name in ("temperature", "supply", "local gravity")),
        ["u of a stage angle", known["standard uncertainty of a declared angle"]],
    ]
    signature = [["date", NO_BREAK], ["name, signature", NO_BREAK]]
    # For attitudes in space there are no key figures.
    wanted = [name for name in ("delta_k", "delta_phi", "angle") if name in answer.values]
    key = [_large(name, answer.values[name]) for name in wanted if len(wanted) > 1]
    angles = "and to declared angles " if key and answer.result.method != "free-turn" else ""
    return Section(
        "Certificate",
        key=key,
        words=[*doubts, *stated],
        figures=figures,
        tables=[
            Table(HEAD, [] if key else answer.lines, numeric=(2, 3, 4, 5)),
            *(Table(["", ""], rows) for rows in (instrument, conditions, signature[:1], signature[1:])),
        ],
        notes=[
            f"Method {answer.title}. U = k·u covers 95 %. The errors apply to the mean of many readings; "
            f"they are traceable to the stated gravity {angles}only. The annex follows.",
            *answer.remarks,
        ],
        sheet=True,
    )


def _error_figures(
    curves: tuple[ErrorCurve | None, ErrorCurve], tolerance: Tolerance | None
) -> list[Figure]:
    """Draw the error of the angle over the turn with its uncertainty band, without and with calibration.

    `curves` are the error curves without (None if unknown) and with calibration; `tolerance` is drawn as
    lines if given.
    """
    figures = []
    for curve, role, state in zip(curves, _ROLES, ("without", "with"), strict=True):
        if curve is None:
            continue
        angle = np.linspace(0, 360, len(curve.angle_deg) + 1)
        error, band = (
            np.interp(angle, curve.angle_deg, each, period=360) for each in (curve.error_deg, curve.U_deg)
        )
        series = [Series(angle, error, f"{state} calibration", band, role, "line")]
        if tolerance is not None:
            for k, limit in enumerate((tolerance.limit_deg, -tolerance.limit_deg)):
                label = "" if k else "tolerance"
                series.append(Series([0, 360], [limit] * 2, label, None, "model", "line"))
        caption = f"Error of the angle {state} calibration; the band is ± U."
        axes = ("angle / °", "error of the angle / °")
        ticks = {float(k): str(k) for k in range(0, 361, 90)}
        drawn = plot(series, *axes, title=caption, x_range=(0, 360), x_ticks=ticks, zero=True)
        figures.append(Figure(drawn, caption))
    return figures


def _large(name: str, value: Value) -> KeyFigure:
    """Make a key figure (a result in large numerals) of a value with its expanded uncertainty U.

    `name` is the name of the quantity. If it is `angle`, the error of the angle, U belongs to a displayed
    angle and not to the error; it is then shown in the small print.
    """
    if value.k is None:
        return KeyFigure(NAMES[name], with_unit(format_number(value.value, 4), value.unit), UNKNOWN)
    factor = f"k{NO_BREAK}={NO_BREAK}{value.k:.2f}"
    if name == "angle":
        of_angle = f"U of a displayed angle: {with_unit(format_number(value.U, 2), value.unit)} ({factor})"
        return KeyFigure(NAMES[name], with_unit(format_number(value.value, 2), value.unit), of_angle)
    return KeyFigure(
        NAMES[name], format_uncertain(value.value, value.U, value.unit), f"± U = k·u covers 95 % ({factor})"
    )


_ANGLES = ("position", "declared", "by gravity", "by the gyro", "found", "how sure")


def positions_section(findings: Sequence[PositionFinding]) -> Section:
    """Return the section on wrong positions and their angles; without contents if `findings` is empty."""
    rows = [
        [
            str(found.position),
            DASH if found.declared_deg is None else use_minus(f"{found.declared_deg:g}°"),
            _angle(found.gravity_deg),
            _angle(found.gyro_deg),
            ", ".join(dict.fromkeys(named.name.replace("_", " ") for named in found.names)),
            format_percent(found.probability),
        ]
        for found in findings
    ]
    table = Table(_ANGLES, rows, numeric=(1, 2, 3, 5), caption="Angles ± U (95 %).")
    return Section("Wrong positions", words=sentences_of(findings), tables=[table])


def _angle(angle: Angle | None) -> str:
    return DASH if angle is None else str(Value(*angle, "deg"))


def budget_section(answer: Answer) -> Section:
    """Return the section with the uncertainty budgets of ΔK, Δφ and the angle."""
    tables = []
    for name, rows in answer.budget.items():
        cells = [
            [
                row.source,
                row.kind,
                row.distribution,
                "–" if row.u is None else with_unit(format_number(row.u, 2), row.unit),
                format_number(row.sensitivity),
                format_number(row.contribution, 2),
                format_share(row.share),
            ]
            for row in rows
        ]
        value = answer.values.get(name)
        contribution = label_quantity("contribution", "" if value is None else value.unit)
        head = ["source", "type", "distribution", "u of source", "sensitivity", contribution, "share"]
        dof = "–" if value is None else format_dof(value.dof)
        caption = f"{NAMES.get(name, name)}: effective degrees of freedom {dof}."
        tables.append(Table(head, cells, caption=caption, numeric=(3, 4, 5, 6)))
    first = next(iter(answer.budget.values()), ())
    notes = [f"{row.source}: {row.note}" for row in first if row.note]
    return Section("Uncertainty budget", tables=tables, notes=notes, folded=True)


def scores_section(answer: Answer) -> Section:
    """Return the section that compares the errors of all methods, each computed on the same readings."""
    head, rows = answer.score_rows()
    table = Table(head, rows if head[1:] else [], numeric=tuple(range(1, len(head))), strong=(0,))
    return Section("Methods on the same readings", words=[answer.scored_on], tables=[table])


_BESIDE = 3
"""Largest number of methods in one table; more would be wider than the page."""


def fitted_section(fits: Sequence[FitResult], failures: Mapping[str, str]) -> Section:
    """Return the section with the fitted parameters of every method, ΔK and Δφ first.

    `failures` has the reason for each method that gave no result.
    """
    sentences: dict[str, list[str]] = {}
    for fit in fits:
        for warning in fit.warnings:
            sentences.setdefault(warning, []).append(fit.method)
    notes = [f"{', '.join(methods)}: {warning}" for warning, methods in sentences.items()]
    notes += [f"{method}: {reason}" for method, reason in failures.items()]
    none = [] if fits or failures else ["No method applies: the session has too few poses."]
    # The best fit is last in the list and first on the page.
    tables = [
        Table(head, rows, numeric=tuple(range(2, len(head))))
        for head, rows in method_tables(list(reversed(fits)), _BESIDE)
    ]
    return Section("Results by method", words=none, tables=tables, notes=notes, folded=bool(tables))


def found_section(traced: TraceResult) -> Section:
    """Return the section on the effects found, their alternatives, and unnamed causes."""
    inside = words.inside_only(traced)
    rows = [
        [
            words.with_axes(finding),
            "\n".join(words.parameters(finding)),
            "–" if finding in inside else format_percent(finding.explains),
        ]
        for finding in words.ordered(traced)
    ]
    table = Table(["effect", "parameters ± U (95 %)", "explains"], rows, numeric=(2,))
    parts = [
        Section("Effects that this session cannot distinguish", points=words.confounded(traced, most=8)),
        Section("Unnamed causes", points=[words.unnamed(traced)] if traced.unnamed else []),
        Section("Candidates not accepted", points=words.open_names(traced)),
    ]
    notes = [f"{one.effect}: {words.how_sure(one)}. {one.cause}" for one in words.ordered(traced)]
    share = "“Explains” is the share of the base model's residual beyond the measured noise."
    nothing = "No added term could be named." if traced.steps else "No effect had to be added."
    return Section(
        "Effects found",
        notes=[*notes, share] if rows else [],
        words=[] if rows else [nothing],
        tables=[table],
        parts=parts,
    )


def within_section(traced: TraceResult) -> Section:
    """Return the section on effects in the samples inside the dwells.

    It has sentences and a table by dwell.
    """
    if not traced.within:
        nothing = (
            "Spikes, stuck values, spectral lines, changes of the noise, drift, settling, steps: none."
        )
        return Section("Inside the dwells", words=[nothing] if traced.fits else [])
    rows = []
    for finding in traced.within:
        rows += [
            [
                finding.kind.replace("_", " "),
                str(place.position),
                place.axis,
                "" if place.time_s is None else f"{place.time_s:.2f}",
                "" if place.value is None else str(place.value),
                "" if place.shift_mg is None else format_number(abs(place.shift_mg), 2),
            ]
            for place in finding.places[:_MOST_PLACES]
        ]
        left_out = len(finding.places) - _MOST_PLACES
        if left_out > 0:
            rows.append([finding.kind, f"{left_out} more", "", "", "", ""])
    head = ["finding", "position", "axis", "time / s", "size", "the mean is off by / mg"]
    table = Table(head, rows, numeric=(3, 4, 5))
    return Section("Inside the dwells", points=words.within(traced), tables=[table])


def errors_section(traced: TraceResult) -> Section:
    """Return the section with the errors of the base model and of the model after each added effect."""
    head, rows = words.error_rows(traced)
    base = [[NAMES.get(name, name), str(value)] for name, value in traced.base.items()]
    table = Table(
        head,
        rows,
        numeric=tuple(range(1, len(head))),
        strong=(len(rows) - 1,),
    )
    parameters = Table(["base parameter", "in the final model"], base, numeric=(1,))
    design = traced.heldout_design or "nothing"
    alone = "; `fit` leaves out one dwell at a time" if "whole dwells" in design else ""
    alone += " and adds the source temperature to U" if alone and traced.before.unit == "mg" else ""
    left_out = f"Errors are root mean squares. Left out: {design}{alone}."
    return Section("Error before and after", tables=[table, parameters], notes=[left_out])


def steps_section(traced: TraceResult, views: Views) -> Section:
    """Return the section with a figure for each effect that the trace added.

    The figure shows the residual before and after the effect was added, against the covariate on which the
    effect depends.
    """
    parts = []
    for number, (step, view) in enumerate(zip(traced.steps, views.steps, strict=True), 1):
        figures = [_panel_figure(panel, step.effect, "before") for panel in view]
        parts.append(Section(f"Step {number}: {step.effect}", figures=figures))
    bars = ["Bars are standard uncertainties of a reading; they are left out if it is not known."]
    return Section("Residual, step by step", words=bars if any(views.steps) else [], parts=parts)


def residual_section(views: Views) -> Section:
    """Return the section with the residual of the final model against each covariate."""
    roles: tuple[Role, ...] = ("after", "third", "fourth")
    figures = []
    for covariate in dict.fromkeys(panel.covariate for panel in views.left):
        panels = [panel for panel in views.left if panel.covariate == covariate]
        # Shift the axes sideways, so that their bars do not hide each other.
        aside = 0.012 * float(np.ptp(panels[0].x)) if len(panels) > 1 else 0.0
        series = [
            Series(
                p.x + (k - (len(panels) - 1) / 2) * aside,
                p.after,
                ("norm" if p.quantity == "norm" else p.quantity[-1]) if len(panels) > 1 else "",
                _bars(p),
                roles[k],
            )
            for k, p in enumerate(panels)
        ]
        x = _covariate_label(covariate)
        y = "residual of the norm / mg" if panels[0].quantity == "norm" else "residual / mg"
        title = f"Residual of the final model against the {x.partition(' / ')[0]}"
        figures.append(Figure(plot(series, x, y, title=title, zero=True), title))
    return Section("Remaining residual", figures=figures)


def what_if_section(traced: TraceResult, *, figures: bool = True) -> list[Section]:
    """Return a list with the section that compares the user's model with the best model.

    The list is empty if the user gave no model. `figures` is False for the terminal.
    """
    if traced.what_if is None:
        return []
    head, rows = words.compared(traced.what_if)
    note = "Left out: the same dwells for all models. Odds contain the prior probability of the model."
    table = Table(head, rows, numeric=tuple(range(1, len(head))), strong=(2,))
    panels = what_if_panels(traced.what_if) if figures else []
    drawn = [_panel_figure(panel, "the asked model", "with the best model") for panel in panels]
    points = words.forced(traced.what_if)
    return [
        Section(words.asked(traced.what_if), points=points, tables=[table], figures=drawn, notes=[note])
    ]


def further_terms_section(traced: TraceResult) -> Section:
    """Return the section on the gain by each further term of the model: evidence and held-out error.

    It has a table and two figures.
    """
    bought = traced.further_terms()
    if not bought:
        return Section("What each further term buys")
    unit = traced.before.unit
    count = np.array([len(one.terms) for one in bought])
    error, u, nats = (
        np.array([getattr(one, name) for one in bought]) for name in ("heldout_rms", "u", "log_evidence")
    )
    chosen = np.array([one.chosen for one in bought])
    figures = []
    for values, bars, y in (
        (error, u, f"left out / {unit}"),
        (nats - nats.max(), None, "log evidence − best"),
    ):
        series = [Series(count, values, "best of this number", bars, "before")]
        series.append(Series(count[chosen], values[chosen], "chosen model", role="after"))
        ticks = {float(k): str(k) for k in count}
        title = f"{y} against the number of terms"
        figures.append(Figure(plot(series, "terms", y, title=title, x_ticks=ticks), title))
    rows = [
        [
            str(len(one.terms)),
            (" + ".join(one.terms) or "base model") + (" (chosen)" if one.chosen else ""),
            format_number(one.log_evidence),
            format_number(one.heldout_rms),
            format_uncertain(one.gain, NORMAL_95 * one.u) if one.terms else DASH,
            "yes" if one.efficient else "no",
        ]
        for one in bought
    ]
    head = ["terms", "best model", "log evidence", f"left out / {unit}", f"gain ± U / {unit}", "efficient"]
    caption = "Left out: dwells that the chosen model can spare. Efficient: no smaller model is as good."
    table = Table(head, rows, numeric=(0, 2, 3, 4), caption=caption)
    return Section("What each further term buys", tables=[table], figures=figures)


def rivals_section(traced: TraceResult) -> Section:
    """Return the section with the most probable models and their probabilities."""
    rows = [
        [" + ".join(rival.terms) or "base model", format_percent(rival.probability)]
        for rival in traced.rivals
    ]
    same = [
        f"{finding.effect}: {'; '.join(finding.equivalents)} would give equal readings in this session"
        for finding in traced.found
        if finding.equivalents
    ]
    caption = "Posterior probability among all models that were weighed; axes in brackets."
    table = Table(["model", "probability"], rows, caption=caption, numeric=(1,), strong=(0,))
    return Section("Other probable models", tables=[table], notes=same, folded=True)


def detection_section(traced: TraceResult) -> Section:
    """Return the section with the smallest amplitude of each effect that the session would have shown.

    It also states if the effect was found, is absent or remains open.
    """
    seen = words.group_undetected(traced)
    effects_found = {finding.effect for finding in traced.found}
    rows = []
    for names, verdict in (
        (sorted(effects_found & set(traced.detectable)), "found"),
        (seen.open, "open: not distinguishable from others here"),
        (seen.visible, words.absent(traced)),
        (seen.weak, "absent or smaller"),
    ):
        for name in names:
            entry = traced.detectable[name]
            rows.append([name, words.amplitude(entry), words.typical(name, entry), verdict])
    rows += [
        [", ".join(names), "–", "", f"could not be seen: {reason}"] for reason, names in seen.blind.items()
    ]
    table = Table(
        ["effect", "smallest amplitude", "typical size", "conclusion"],
        rows,
        numeric=(1, 2),
        caption="Smallest amplitude that this session would have shown with 90 % power.",
    )
    return Section("Smallest detectable amplitudes", tables=[table], folded=True)


def data_section(session: Session, traced: TraceResult | None, known: Mapping[str, str]) -> Section:
    """Return the section on data and configuration of a session; `known` are its facts."""
    rows = [[name, text] for name, text in known.items() if text]
    notes = [*session.notes, *(traced.notes if traced is not None else ())]
    problems = [str(problem) for problem in session.facts.get("problems", ())]
    return Section("Data and configuration", tables=[Table(["", ""], rows)], notes=[*notes, *problems])


def facts(session: Session, reference_c: float | None = None) -> dict[str, str]:
    """Return the facts of a session as texts by name; an empty text means unknown.

    `reference_c` is the temperature in °C at which the parameters are valid, None if unknown.
    """
    dwells = [dwell for dwell in session.dwells if len(dwell)]
    if session.free_turn and session.recording is not None:
        dwells = [session.recording]
    sigma = session.fixture_sigma_deg
    fixture = [f"certificate {session.stage_curve.name}"] if session.stage_curve else []
    fixture += [] if sigma is None else [f"{sigma:g}°"]
    if sigma is not None and math.isinf(sigma):
        fixture = ["free: declared angles are not used"]
    samples = [len(dwell) for dwell in dwells]
    low, high = min(samples), max(samples)
    each = f"{low}" if low == high else f"{low} to {high}"
    stored: dict[str, Any] = session.facts
    configuration = stored.get("configuration") or {}
    rate = configuration.get("sample_rate_hz")
    start, end = float(dwells[0].time_s[0]), float(dwells[-1].time_s[-1])
    return {
        "title": session.title,
        **{name: getattr(session, name) for name in METADATA},
        "file": Path(session.source).name,
        "SHA-256 of the file": digest_of_file(session.source) if Path(session.source).is_file() else "",
        "sensor": session.sensor + (" (simulated)" if stored.get("simulated") else ""),
        "bus": str(stored.get("url", "")),
        "note": str(stored.get("note", "")),
        "begun (UTC)": str(stored.get("started_utc", "")),
        "recorded by": str(stored.get("software", "")),
        "this page by": f"adis-gonio {__version__}",
        "session": words.shape(session),
        "samples": f"{sum(samples)}, {each} a dwell" if session.dwells else f"{sum(samples)}",
        "duration": f"{(end - start) / 60:.1f} min",
        "sample rate": with_unit(format_number(rate, 4), "Hz") if rate else "",
        "filter": f"2^{configuration['filter_m']} taps, twice" if "filter_m" in configuration else "",
        "the chip compensates": "\n".join(compensations(configuration)),
        "unit of the accelerations": session.accel_unit,
        "plane of rotation": "xy" if session.plane == "xy" else "none: attitudes in space",
        "standard uncertainty of a declared angle": ", ".join(fixture) or "not stated",
        "local gravity": f"{session.gravity_mps2:.5f} m/s²",
        "standard uncertainty of a reading": _noise(session),
        "reference temperature of the parameters": "" if reference_c is None else f"{reference_c:.1f} °C",
        "temperature": _span([d.temperature_c for d in dwells], "°C"),
        "supply": _span([d.supply_v for d in dwells], "V"),
    }


def _noise(session: Session) -> str:
    try:
        observed = readings_of(session)
    except AdisGonioError:
        return ""
    if not observed.noise_known:
        return "not known: estimated from the residual"
    sigma = np.sqrt(np.median(np.diagonal(observed.covariance, axis1=1, axis2=2), axis=0))
    return ", ".join(
        f"{axis} {format_number(float(s), 2)} mg" for axis, s in zip("xyz", sigma, strict=False)
    )


def _span(series: Sequence[Any], unit: str) -> str:
    known = [s for s in series if s is not None and len(s)]
    if not known:
        return "not recorded"
    low, high = min(float(np.nanmin(s)) for s in known), max(float(np.nanmax(s)) for s in known)
    return format_span(low, high, 2, unit)


def _panel_figure(panel: Panel, effect: str, before: str) -> Figure:
    """Draw the residual before and after an effect was added to the model, with a caption of its size.

    `effect` is the name of the effect, and `before` the label of the residual without it.
    """
    unit = "°" if panel.quantity == "angle" else " mg"
    was, now = (float(np.sqrt(np.nanmean(v**2))) for v in (panel.before, panel.after))
    quantity = {"norm": "Norm", "angle": "Angle"}.get(panel.quantity, f"Axis {panel.quantity[-1]}")
    caption = (
        f"{quantity}: {format_number(was)}{unit} rms {before}, {format_number(now)}{unit} with {effect}."
    )
    bars = _bars(panel)
    series = [
        Series(panel.x, panel.before, before, bars, "before"),
        Series(panel.x, panel.after, "after", bars, "after"),
    ]
    if panel.check_x.size:
        series.append(Series(panel.check_x, panel.check_after, "after, check dwells", role="third"))
    x = _covariate_label(panel.covariate)
    y = {"norm": "residual of the norm / mg", "angle": "computed − declared angle / °"}.get(
        panel.quantity, f"residual of {panel.quantity[-1]} / mg"
    )
    sides = panel.covariate == "approach"
    drawn = plot(
        series,
        x,
        y,
        title=f"{effect}: {y} against {x}",
        description=caption,
        x_ticks={k: text for k, text in _SIDES.items() if (panel.x == k).any()} if sides else None,
        x_range=(-1.6, 1.6) if sides else None,
        zero=True,
    )
    return Figure(drawn, caption)


def _bars(panel: Panel) -> Any:
    return None if np.isnan(panel.u).all() else panel.u


def _covariate_label(covariate: str) -> str:
    return _COVARIATES.get(covariate, f"reading of {covariate[-1]} / g")


def build_page(
    session: Session,
    fits: Sequence[FitResult],
    traced: TraceResult | str,
    sections: Sequence[Section] = (),
    failures: Mapping[str, str] | None = None,
    tolerance: Tolerance | None = None,
) -> str:
    """Render the calibration report as HTML.

    Parameters
    ----------
    session : Session
        Session of the report.
    fits : sequence of FitResult
        One fit per method, the best last.
    traced : TraceResult or str
        The trace, or the reason if there is none.
    sections : sequence of Section
        Further sections, before data and configuration.
    failures : mapping of str to str, optional
        Reason for each method that gave no result.
    tolerance : Tolerance, optional
        Tolerance of the angle for the statement of conformity.

    Returns
    -------
    str
        One page that needs no other file; all texts are escaped.
    """
    result = traced if isinstance(traced, TraceResult) else None
    best = next((fit for fit in reversed(fits) if fit.comparison is not None), None)
    answer = None if best is None else answer_with_trace(best, result)
    positions = next((fit.position_findings for fit in fits if fit.position_findings), ())
    if result is not None:
        positions = result.position_findings
    body = []
    dated = (one.reference_temperature_c for one in (answer, result) if one is not None)
    known = facts(session, next((degrees for degrees in dated if degrees is not None), None))
    if answer is not None:
        body += [certificate_section(answer, known, positions, tolerance), answer_section(answer)]
    body += [summary_section(traced), positions_section(positions)]
    if answer is not None:
        body += [budget_section(answer), scores_section(answer)]
    body += [fitted_section(fits, failures or {})]
    if result is not None:
        shown = result.views or views_of(readings_of(session), result)
        body += [*what_if_section(result), found_section(result), errors_section(result)]
        body += [further_terms_section(result), steps_section(result, shown)]
        body += [residual_section(shown), within_section(result)]
        body += [rivals_section(result), detection_section(result)]
        body += [Section("What to measure next", points=words.advice(result))]
    body += [*sections, data_section(session, result, known)]
    return render(
        "Calibration report",
        words.title(session),
        shape=" · ".join([words.shape(session), *map(" ".join, words.written_down(session).items())]),
        simulated=bool(session.facts.get("simulated")),
        begun=str(session.facts.get("started_utc", "")),
        sections=body,
        closing="This page is made from the session's file alone and can be made again from it.",
    )
