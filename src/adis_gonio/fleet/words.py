"""A fleet's summary in words and rows of tables, for terminal and page."""

from __future__ import annotations

from adis_gonio.base.numbers import (
    NAMES,
    count_decimals,
    counted,
    format_fixed,
    format_number,
    format_p,
    format_percent,
    format_unit,
    with_unit,
)
from adis_gonio.base.uncertainty import OUTLYING
from adis_gonio.fleet.outlying import FEWEST, FEWEST_UNITS
from adis_gonio.fleet.statistics import Beyond
from adis_gonio.fleet.summary import Outlying, QuantitySummary, Summary

PARAMETER_HEAD = [
    "quantity", "unit", "sessions", "median", "5 %", "95 %", "mean", "robust sd", "median u", "sd beyond u",
    "repeats / u",
]  # fmt: skip
PARAMETER_NOTES = (
    "sd beyond u: standard deviation of the true values that the scatter demands beside the sessions' own u"
    " (Paule and Mandel), with its interval of 95 %; 0 where u explains all.",
    "repeats / u: scatter of sessions of the same unit over what their u explains; 1 where u is honest.",
    "angle: error of the angle, rms over dwells left out; it has no u of its own.",
)
EFFECT_HEAD = ["effect", "sessions", "share", "95 % interval"]
OUTLYING_HEAD = ["what", "quantity", "here", "the others", "z", "p × tests", "of"]


def headline(summary: Summary) -> str:
    """How many there are, such as `998 of 1000 sessions have a result, of 334 units on 4 stages.`."""
    n = summary.sessions
    verb = "has" if 1 in (n["ok"], n["n"]) else "have"
    text = f"{n['ok']} of {counted(n['n'], 'session')} {verb} a result"
    who = [
        f"of {counted(n['units'], 'unit')}" if n["units"] else "",
        f"on {counted(n['stages'], 'stage')}" if n["stages"] else "",
        f"by {counted(n['operators'], 'operator')}" if n["operators"] else "",
    ]
    known = " ".join(filter(None, who))
    return f"{text}, {known}." if known else f"{text}."


def remarks(summary: Summary) -> list[str]:
    """What has to be known of the rest."""
    n = summary.sessions
    said = []
    if n["failed"]:
        said.append(f"{counted(n['failed'], 'session')} failed.")
    if n["traced"]:
        said.append(f"{n['traced']} were traced; the model is adequate in {n['adequate']} of them.")
    else:
        said.append("No session was traced: nothing is known of effects.")
    if n["doubted"]:
        said.append(f"{counted(n['doubted'], 'session')} cannot be right by what the operator kept.")
    if n["without_serial"]:
        said.append(
            f"{counted(n['without_serial'], 'session')} without a serial number: each counts as a unit."
        )
    return said


def parameter_rows(summary: Summary) -> list[list[str]]:
    """Rows under `PARAMETER_HEAD`."""
    return [_parameter(one) for one in summary.parameters]


def _parameter(one: QuantitySummary) -> list[str]:
    spread = one.distribution
    q = spread.quantiles
    return [
        NAMES.get(one.name, one.name),
        format_unit(one.unit),
        str(spread.n),
        *(_to_digit_of(spread.robust_sd, value) for value in (q["50"], q["5"], q["95"], spread.mean)),
        format_number(spread.robust_sd if spread.n > 1 else None, 2),
        "–" if one.beyond is None else format_number(one.beyond.u, 2),
        "–" if one.beyond is None else _tau(one.beyond),
        "–" if one.repeats is None else f"{one.repeats.ratio:.2f} ({format_p(one.repeats.p_value)})",
    ]


def _to_digit_of(sd: float, value: float) -> str:
    """Value to the second digit of a standard deviation."""
    if not sd > 1e-6:
        return format_number(value)
    return format_fixed(value, count_decimals(sd))


def _tau(beyond: Beyond) -> str:
    low, high = beyond.tau_95
    if beyond.tau == 0:
        return "0" if high == 0 else f"0 (to {format_number(high, 2)})"
    return f"{format_number(beyond.tau, 2)} ({format_number(low, 2)} to {format_number(high, 2)})"


def effect_rows(summary: Summary) -> list[list[str]]:
    """Rows under `EFFECT_HEAD`."""
    rows = []
    for one in summary.effects:
        low, high = one.interval
        share = format_percent(one.found / one.traced)
        between = f"{format_percent(low)} to {format_percent(high)}"
        rows.append([one.effect, f"{one.found} of {one.traced}", share, between])
    return rows


def outlying_rows(summary: Summary) -> list[list[str]]:
    """Rows under `OUTLYING_HEAD`."""
    return [_outlying(one) for one in summary.outlying]


def _outlying(one: Outlying) -> list[str]:
    if one.quantity.startswith("effect "):
        values = [format_percent(one.value), format_percent(one.others)]
    else:
        values = [with_unit(format_number(value), one.unit) for value in (one.value, one.others)]
    same = f", the same sessions as {', '.join(one.same_sessions_as)}" if one.same_sessions_as else ""
    of_sessions = one.kind == "unit"
    return [
        f"{one.kind} {one.name}{same}",
        NAMES.get(one.quantity, one.quantity),
        *values,
        format_fixed(one.z, 1),
        format_number(one.adjusted_p, 2)
        if one.adjusted_p >= 1e-12
        else format_p(one.adjusted_p).split("p\u00a0")[1],
        counted(one.n, "session" if of_sessions else "unit"),
    ]


def outlying_text(summary: Summary) -> str:
    """What was compared and how sure a name is; who stands out where that is nobody."""
    if not summary.tests:
        return (
            f"Nothing could be compared: that takes {FEWEST_UNITS} units, or {FEWEST} units on a stage or"
            f" with an operator and {FEWEST} elsewhere."
        )
    found = "" if summary.outlying else " None stands out."
    return (
        f"{counted(summary.tests, 'comparison')} of units, stages and operators with the rest of the fleet;"
        f" the probability of naming anything falsely is at most {format_percent(OUTLYING)} in all"
        f" (Bonferroni).{found}"
    )
