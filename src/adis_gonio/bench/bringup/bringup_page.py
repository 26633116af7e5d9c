"""The HTML page of a bring-up: results, answers about the register table, and figures."""

from __future__ import annotations

from adis_gonio.base.numbers import format_fixed, format_number, with_unit
from adis_gonio.base.uncertainty import Value
from adis_gonio.bench.bringup.bringup_step import QUESTIONS, Bringup, Measured, Outcome, StepResult, Verdict
from adis_gonio.page.document import Section, Table, render


def build_page(found: Bringup) -> str:
    """Return the result of a bring-up as one HTML page without external resources."""
    details = [_detail(row) for row in found.rows if row.verdict is not Verdict.NOT_MEASURED]
    return render(
        "Bring-up",
        found.url,
        shape=f"{found.variant.upper()}, {found.bridge['bus']}",
        simulated=found.simulated,
        begun=found.begun_utc,
        software=found.software,
        sections=(_summary(found), _answers(found), Section("The steps", parts=details), _limits(found)),
        closing="The JSON file next to this page has these figures for programs.",
    )


def _summary(found: Bringup) -> Section:
    rows = [(row.name, row.verdict, row.text) for row in found.rows]
    strong = [k for k, row in enumerate(found.rows) if row.verdict in (Verdict.FAULT, Verdict.DIFFERS)]
    return Section(
        "Results",
        words=(found.headline, f"Writes: {found.undone}."),
        tables=(Table(("step", "verdict", "result"), rows, strong=tuple(strong)),),
    )


def _answers(found: Bringup) -> Section:
    rows, strong = [], []
    for k, question in enumerate(QUESTIONS):
        answer = found.answers[question.name]
        rows.append(
            (
                question.text,
                question.table,
                f"{question.source}, {question.confidence}",
                answer.outcome,
                "\n".join([answer.text, *(f"{f.name}: {_value(f)}" for f in answer.figures)]),
            )
        )
        if answer.outcome is Outcome.CONTRADICTS:
            strong.append(k)
    return Section(
        "Answers about the register table",
        words=(
            "Rows that a real part can settle, with the table's value, its source and its confidence (A the"
            " sibling's data sheet and code agree, B the sibling's sheet only, C derived, D an estimate).",
        ),
        tables=(Table(("question", "table", "source", "outcome", "measured"), rows, strong=tuple(strong)),),
    )


def _detail(row: StepResult) -> Section:
    rows = [
        (figure.name, _value(figure), "" if figure.expected is None else _number(figure.expected, figure))
        for figure in row.figures
    ]
    table = Table(("figure", "value", "expected"), rows, numeric=(1, 2))
    return Section(
        row.name,
        words=(f"{row.does[0].upper()}{row.does[1:]} ({row.effect}).",),
        tables=(table,) if rows else (),
    )


def _limits(found: Bringup) -> Section:
    held = ", ".join(f"{name} 0x{word:04X}" for name, word in found.registers.items())
    bridge = ", ".join(f"{name} {value}" for name, value in found.bridge.items())
    return Section(
        "Limits and surroundings",
        words=(
            "A good board is accused with a probability below 1 in 10 000. Each limit is a quantile of the"
            " figure's distribution on a good board: normal for means, chi-square for variances,"
            " exponential for the bins of a spectrum. Faults that are not random have no limit.",
            "± is U (95 %).",
        ),
        notes=(f"Bridge: {bridge}.", f"Original registers: {held or 'not read'}."),
    )


def _value(figure: Measured) -> str:
    if figure.u is None:
        return _number(figure.value, figure)
    return str(Value(figure.value, figure.u, figure.unit))


def _number(value: float, figure: Measured) -> str:
    if float(value).is_integer() and abs(value) < 1e7:
        text = format_fixed(value, 0)
    else:
        text = format_number(value, 6)
    return with_unit(text, figure.unit)
