"""Sentences on the result of a trace, for the summary in the terminal and the report page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from adis_gonio.base.numbers import (
    counted,
    format_number,
    format_p,
    format_percent,
    format_reduction,
    format_unit,
    join_words,
    power_of_ten,
    with_unit,
)
from adis_gonio.base.uncertainty import Detectable
from adis_gonio.model.effects import AXES, catalogue, effect
from adis_gonio.model.effects.base import Parameter
from adis_gonio.model.records import Session
from adis_gonio.tracing.trace_result import Finding, TraceResult

if TYPE_CHECKING:
    from adis_gonio.tracing.joint_trace import JointResult
    from adis_gonio.tracing.what_if import WhatIf

_COUNTS = ("No", "One", "Two", "Three", "Four", "Five", "Six")
_SURE = (
    (0.999, 1e-3, "as good as certain"),
    (0.98, 1e-2, "very likely"),
    (0.9, 5e-2, "likely"),
    (0.0, 1.0, "the best of several explanations"),
)
"""Phrases for the certainty of a finding, each with its smallest probability and largest p-value."""


@dataclass
class UndetectedEffects:
    """Effects that were not found, in groups: shown at typical size, only if larger, or not at all.

    Attributes
    ----------
    visible, weak : list of str
        Effects with a smallest detectable amplitude: below the effect's typical size in `visible`, above it
        in `weak`.
    open : list of str
        Visible effects that the session cannot distinguish from others.
    blind : dict of str to list of str
        Effects that would not have shown at any physical amplitude, by the reason.
    """

    visible: list[str] = field(default_factory=list)
    weak: list[str] = field(default_factory=list)
    open: list[str] = field(default_factory=list)
    blind: dict[str, list[str]] = field(default_factory=dict)


def title(session: Session) -> str:
    """Return the name of the session: its title, or the name of its file if it has no title."""
    return session.title or session.source.rsplit("/", maxsplit=1)[-1] or "session"


_WRITTEN_DOWN = {"serial": "part", "stage": "stage", "operator": "operator"}
"""Fields of a session that a person wrote, with their names on the page."""


def written_down(session: Session) -> dict[str, str]:
    """Return the serial number, stage and operator of a session by their names on the page, if stated."""
    texts = {name: str(getattr(session, field, "")).strip() for field, name in _WRITTEN_DOWN.items()}
    return {name: text for name, text in texts.items() if text}


def shape(session: Session) -> str:
    """Describe the size and kind of a session, such as `24 dwells, adis16354, one plane`."""
    dwells = [dwell for dwell in session.dwells if len(dwell)]
    if session.free_turn and session.recording is not None:
        return f"one free turn, {counted(len(session.recording), 'sample')}, {session.sensor}"
    if len(dwells) == 1:
        kind = f"one pose, {counted(len(dwells[0]), 'sample')}"
    else:
        kind = f"{counted(len(dwells), 'dwell')}" + (
            ", one plane" if session.plane == "xy" else ", attitudes in space"
        )
    checks = sum(dwell.use == "check" for dwell in dwells)
    held = f", {checks} of them for checking" if checks else ""
    return f"{kind}{held}, {session.sensor}"


def with_axes(finding: Finding) -> str:
    """Return the name of a finding with its axes, such as `bias (x, y)`."""
    return f"{finding.effect} ({', '.join(finding.axes)})" if finding.axes else finding.effect


def parameters(finding: Finding) -> list[str]:
    """Return the parameters of a finding with their values as lines of text, one for each axis."""
    groups: dict[str, list[str]] = {}
    for name, value in finding.parameters.items():
        axis = name.rsplit("_", 1)[-1]
        group = axis if axis in finding.axes and len(finding.parameters) > 3 else name
        groups.setdefault(group, []).append(f"{name} = {value}")
    return ["; ".join(texts) for texts in groups.values()]


def error_rows(result: TraceResult) -> tuple[list[str], list[list[str]]]:
    """Return the column names and the rows of the table of errors, one row for each nested model.

    The base model is first. Columns without values are omitted.
    """
    rows = [("base model", result.before), *((f"+ {step.effect}", step.error) for step in result.steps)]
    unit = format_unit(result.before.unit)
    unit = f"({unit})" if "/" in unit else unit
    columns: dict[str, list[float | None]] = {
        f"residual / {unit}": [error.residual_rms for _, error in rows],
        f"left out / {unit}": [error.heldout_rms for _, error in rows],
        **{
            f"{axis} / {unit}": [(error.heldout_by_axis or {}).get(axis) for _, error in rows]
            for axis in result.before.heldout_by_axis or ()
        },
        "error of the angle / °": [error.angle_rms_deg for _, error in rows],
        "χ² / dof": [error.chi2_per_dof for _, error in rows],
    }
    shown = {head: column for head, column in columns.items() if any(cell is not None for cell in column)}
    cells = [
        [name, *(format_number(column[k]) for column in shown.values())] for k, (name, _) in enumerate(rows)
    ]
    return ["model", *shown], cells


def asked(what_if: WhatIf) -> str:
    """Return the question of a what-if, such as `What if: with quadratic:x, without bias_drift`."""
    request = what_if.request
    words = {"only" if request.only else "with": request.include, "without": request.exclude}
    parts = [f"{word} {join_words(names)}" for word, names in words.items() if names]
    return f"What if: {', '.join(parts) or 'the base model only'}"


def compared(what_if: WhatIf) -> tuple[list[str], list[list[str]]]:
    """Return the column names and the rows of the table that compares the models of a what-if."""
    models = {"base": what_if.before, "best": what_if.best, "asked": what_if.asked}
    unit = format_unit(what_if.before.error.unit)
    rows = [
        [
            f"{name}: {' + '.join(model.terms) or 'no effect'}",
            format_number(model.error.residual_rms),
            format_number(model.error.heldout_rms),
            format_number(model.error.chi2_per_dof),
            odds(model.log_evidence - what_if.best.log_evidence),
        ]
        for name, model in models.items()
    ]
    return ["model", f"residual / {unit}", f"left out / {unit}", "χ² / dof", "odds / best"], rows


def odds(log_odds: float) -> str:
    """Format the ratio of two probabilities, such as `1 : 25`; `log_odds` is its natural logarithm."""
    tenfold = abs(log_odds) / math.log(10)
    size = format_number(10**tenfold, 2) if tenfold < 4 else power_of_ten(round(tenfold))
    return f"1 : {size}" if log_odds < 0 else f"{size} : 1"


def forced(what_if: WhatIf) -> list[str]:
    """Return a line for each term that the user put into the model, with its values."""
    return [
        f"{term.effect}: {'; '.join(f'{name} = {value}' for name, value in term.parameters.items())}"
        + ("" if term.differs_from_zero else " (not different from zero)")
        for term in what_if.forced
    ]


def how_sure(finding: Finding) -> str:
    """Describe how certain a finding is, such as `very likely: probability 99.6 %, p < 10⁻¹²`."""
    word = next(
        word for least, most, word in _SURE if finding.probability >= least and finding.p_value <= most
    )
    return f"{word}: probability {format_percent(finding.probability)}, {format_p(finding.p_value)}"


def uncertain_steps(result: TraceResult) -> list[str]:
    """Return the effects in the final model that are neither findings nor put there by the user."""
    known = {finding.effect for finding in result.found}
    known |= {term.effect for term in result.what_if.forced} if result.what_if is not None else set()
    return list(dict.fromkeys(step.effect for step in result.steps if step.effect not in known))


def ordered(result: TraceResult) -> list[Finding]:
    """Return the findings in the order in which the trace added their effects to the model."""
    order = [step.effect for step in result.steps]
    return sorted(result.found, key=lambda f: order.index(f.effect) if f.effect in order else len(order))


def inside_only(result: TraceResult) -> list[Finding]:
    """Return the findings inside the dwells with effects that are not in the model of the readings."""
    steps = {step.effect for step in result.steps}
    seen = {finding.effect for finding in result.within}
    return [finding for finding in result.found if finding.effect in seen - steps]


def within(result: TraceResult) -> list[str]:
    """Return a sentence with the p-value for each finding inside the dwells."""
    return [
        f"{finding.sentence[:1].upper()}{finding.sentence[1:]} ({format_p(finding.p_value)})."
        for finding in result.within
    ]


def headline(result: TraceResult) -> str:
    """Return the outcome of a trace in a few sentences; a time limit that ended it is mentioned first."""
    if result.stopped is not None:
        rest = f" {_outcome(result)}" if result.stopped.checked else ""
        return result.stopped.sentence + rest
    return _outcome(result)


def _outcome(result: TraceResult) -> str:
    inside = inside_only(result)
    first = _of_readings(result, [finding for finding in ordered(result) if finding not in inside])
    if inside:
        return f"{first} Inside the dwells: {join_words([with_axes(finding) for finding in inside])}."
    return first


def _of_readings(result: TraceResult, found: Sequence[Finding]) -> str:
    """Return sentences about the effects found, and how well the model describes the readings."""
    names = [with_axes(finding) for finding in found]
    what = f"Found: {join_words(names)}." if names else ""
    rest = result.unnamed
    if rest is not None:
        begin = f"{what} Besides, the" if names else "The"
        end = "" if result.adequate else " Not all of the residual is explained."
        covariates = join_words([f"the {name.replace('_', ' ')}" for name in rest.covariates])
        return f"{begin} residual follows {covariates} in a way that no named effect explains.{end}"
    if result.adequate:
        names += [term.effect for term in result.what_if.forced] if result.what_if is not None else []
        if not names and not result.steps:
            return (
                "The base model explains this session: the residual is the noise of the readings. No effect"
                " had to be added."
            )
        unsure = uncertain_steps(result)
        if unsure:
            verb = "is" if len(unsure) == 1 else "are"
            return (
                f"The residual falls to the noise of the readings with {join_words([*names, *unsure])}; "
                f"{join_words(unsure)} {verb} not certain."
            )
        count = _COUNTS[len(names)] if len(names) < len(_COUNTS) else str(len(names))
        word = "effect brings" if len(names) == 1 else "effects bring"
        return f"{count} {word} the residual down to the noise of the readings: {join_words(names)}."
    if exact(result):
        return (
            f"{what} The model has as many parameters as there are readings: no reading remains to "
            "test it. Measure more positions."
        )
    if result.before.heldout_by_axis is not None and not result.fits:
        return (
            f"{what or 'No condition was found that the readings follow.'} One pose does not show whether"
            " bias or gain changes. Adequacy cannot be tested, since the noise of neighbouring samples is"
            " correlated."
        )
    if not result.tested:
        noise_known = bool(result.fits) and result.fits[-1].data.noise_known
        ending = "Adequacy cannot be tested: " + (
            "the model has as many parameters as there are readings. Measure more positions."
            if noise_known
            else "the noise of a reading is unknown."
        )
        return f"{what or 'Nothing was found beyond the base model.'} {ending}"
    undecided = result.confounded or result.reasons
    rest_by = "this session cannot decide what causes" if undecided else "no named effect explains"
    begin = what or "Nothing was found for certain."
    return f"{begin} The residual stays larger than the noise, and {rest_by} the rest."


def exact(result: TraceResult) -> bool:
    """Return True if the final model passes exactly through every reading and cannot be tested."""
    return bool(result.steps) and result.after.residual_rms < 1e-9 * result.before.residual_rms


def gains(result: TraceResult) -> str:
    """Return a sentence with the errors of the base model and of the final model.

    It also states the held-out error of a smaller model if this error is less than the final model's.
    """
    before, after = result.before, result.after
    unit = format_unit(before.unit)
    if exact(result):
        return f"The base model leaves {format_number(before.residual_rms)} {unit}."
    parts = [f"The residual goes {_fall(before.residual_rms, after.residual_rms, f' {unit}')}"]
    if before.heldout_rms is not None and after.heldout_rms is not None:
        left, kept = format_number(after.heldout_rms), format_number(after.heldout_kept)
        parts.append(f"on held-out data {_fall(before.heldout_rms, after.heldout_rms, f' {unit}')}")
        if after.heldout_kept is not None and kept != left:
            parts[-1] += (
                f", effects chosen again each time, or to {kept} {unit} with the effects of this model kept"
            )
    else:
        parts.append("no data were held out, so this is not verified on other data")
    if before.angle_rms_deg is not None and after.angle_rms_deg is not None:
        parts.append(f"the error of the angle {_fall(before.angle_rms_deg, after.angle_rms_deg, '°', '°')}")
    errors = [before.heldout_rms, *(step.error.heldout_rms for step in result.steps[:-1])]
    least = min(filter(None, errors), default=0.0)
    # Smaller models are not chosen again in each fold either.
    if format_reduction(after.heldout_kept or after.heldout_rms, least):
        names = join_words([one.effect for one in result.steps[: errors.index(least)]]) or "the base model"
        parts.append(f"with {names} alone, the held-out error is smaller: {format_number(least)} {unit}")
    return "; ".join(parts) + "."


def _fall(before: float, after: float, unit: str, unit_before: str = "") -> str:
    """Return an error before and after as text, such as `from 2 to 0.1 mg (20 times less)`."""
    numbers = f"from {format_number(before)}{unit_before} to {format_number(after)}{unit}"
    return numbers + format_reduction(before, after)


def confounded(result: TraceResult, most: int = 4) -> list[str]:
    """Return the groups of effects that the session cannot distinguish, one line for each group.

    `most` is the largest number of rivals that a line names.
    """
    groups: dict[str, list[str]] = {}
    for names in result.confounded:
        rest = groups.setdefault(names[0], [])
        rest += [name for name in names[1:] if name not in rest]
    lines = []
    known = catalogue()
    for first, others in groups.items():
        text = first
        named = [name for name in others if name in known]
        nameless = [name for name in others if name not in named]
        listed = named[:most] + nameless[:1]
        if listed:
            more = len(named[most:]) + len(nameless[1:])
            kind = "more" if named[most:] else f"other unnamed form{'s' * (more > 1)}"
            text = f"{first} — or {', or '.join(listed)}" + (f" (or {more} {kind})" if more else "")
        reason = result.reasons.get(first)
        lines.append(f"{text}: {reason}" if reason else text)
    return lines


def open_names(result: TraceResult) -> list[str]:
    """Return the rejected effects outside the groups of `confounded`, each with its reason."""
    grouped = {names[0] for names in result.confounded}
    return [f"{name}: {reason}" for name, reason in result.reasons.items() if name not in grouped]


def unnamed(result: TraceResult) -> str:
    """Describe the unnamed part: its form, the share of the excess χ² that it explains, and its p-value.

    The text is empty if there is no unnamed part.
    """
    rest = result.unnamed
    if rest is None:
        return ""
    sure = f"probability {format_percent(rest.probability)}, {format_p(rest.p_value)}"
    return f"{rest.form} (explains {format_percent(rest.explains)} of the excess; {sure})"


def owners(result: JointResult) -> list[str]:
    """Describe for each cause whether its amplitudes belong to the stage, the part or the session.

    Each possibility has its probability; those below 1 % are omitted.
    """
    return [
        f"{cause}: {', '.join(f'{one} {format_percent(p)}' for one, p in by.items() if p >= 0.01)}"
        for cause, by in result.owners.items()
    ]


def session_shares(result: JointResult) -> list[str]:
    """Describe each session's share of the evidence, its result alone, and its held-out errors."""
    # A trace that its time limit ended has no shares.
    causes = [cause for one in result.sessions[:1] for cause in one.evidence]
    total = {cause: sum(one.evidence[cause] for one in result.sessions) for cause in causes}
    lines = []
    for one in result.sessions:
        shares = [f"{cause} {format_percent(own / total[cause])}" for cause, own in one.evidence.items()]
        alone = [f"{cause} ({format_percent(p)})" for cause, p in one.alone.items()] or ["nothing"]
        unit = format_unit(result.before.unit)
        left = " → ".join(format_number(x) for x in (one.heldout_before_mg, one.heldout_after_mg))
        whole = " → ".join(format_number(x) for x in (one.session_before_mg, one.session_after_mg))
        lines.append(
            f"{one.session}: {'; '.join(shares)} of the evidence. Alone: {', '.join(alone)}. Left out:"
            f" dwells {left} {unit}, the whole session {whole} {unit}"
        )
    return lines


def group_undetected(result: TraceResult) -> UndetectedEffects:
    """Group effects that were not found by whether the session could have shown them at typical size."""
    found = {finding.effect for finding in result.found}
    undecided = {name for names in result.confounded for name in names} | set(result.reasons)
    undecided |= {step.effect for step in result.steps}
    seen = UndetectedEffects()
    for name in catalogue():
        if name in found or name not in result.detectable:
            continue
        entry = result.detectable[name]
        prototype = _parameter(name, entry)
        if name in undecided:
            seen.open.append(name)
        elif entry.amplitude is None:
            reason = _reason(entry)
            seen.blind.setdefault(reason, []).append(name)
        elif prototype is not None and entry.amplitude > prototype.high:
            reason = "too little of what drives it; no physical amplitude would show"
            seen.blind.setdefault(reason, []).append(name)
        elif prototype is not None and entry.amplitude > abs(prototype.typical):
            seen.weak.append(name)
        else:
            seen.visible.append(name)
    return seen


def absent(result: TraceResult) -> str:
    """Return the conclusion about effects that the session could have shown but that were not found."""
    if result.adequate and result.unnamed is None:
        return "absent: it would have been found"
    return "not found: without other effects it would have been found"


def amplitude(entry: Detectable) -> str:
    """Return the smallest amplitude that would have been found, with unit; a dash if there is none.

    `entry` is the effect's entry of `TraceResult.detectable`.
    """
    return "–" if entry.amplitude is None else with_unit(format_number(entry.amplitude, 2), entry.unit)


def typical(name: str, entry: Detectable) -> str:
    """Return the typical size of an effect's parameter on a bench, with unit; empty if unknown.

    `name` is the effect, `entry` its entry of `TraceResult.detectable`.
    """
    prototype = _parameter(name, entry)
    return "" if prototype is None else with_unit(f"{abs(prototype.typical):.4g}", prototype.unit)


def advice(result: TraceResult) -> Sequence[str]:
    """Return the advice for the next session, or a statement that no other session is needed."""
    return result.advice or ("nothing: the session answers what it was asked",)


def _reason(entry: Detectable) -> str:
    """Return in words why an effect cannot show; names of recorded fields are replaced by usual words."""
    if entry.reason == "looked for within the dwells":
        return "they change the samples of a dwell, which this session does not hold"
    words = {
        "temperature_c, temperature_history": "temperature",
        "temperature_c": "temperature",
        "supply_v": "supply",
        "variance_mg2": "scatter of the samples in mg",
        "angle_rad": "declared angle",
        "previous_angle_rad": "declared angle",
        "load_history": "times that increase",
        "force_g": "force that changes",
        "rate_dps": "turns between dwells",
        "rate_dps, temperature_c": "turns between dwells, or the temperature,",
    }
    if lacking := ", ".join(entry.lacking):
        return f"{words.get(lacking, lacking.replace('_', ' '))} not recorded"
    return entry.reason.replace("_", " ") or "its trace lies in what is fitted"


def _parameter(name: str, entry: Detectable) -> Parameter | None:
    """Return the parameter of effect `name` to which the amplitude in `entry` refers; None if unknown."""
    kind = catalogue().get(name)
    if kind is None or not entry.parameter:
        return None
    stem = entry.parameter.rsplit("_", 1)[0]
    alike = [p for p in effect(name, AXES).parameters if p.name.rsplit("_", 1)[0] == stem]
    return next((p for p in alike if p.name == entry.parameter), alike[0] if alike else None)
