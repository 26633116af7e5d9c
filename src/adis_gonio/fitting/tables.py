"""The answer's tables as texts: parameters, budget, scores, all methods beside each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from adis_gonio.base.numbers import (
    DASH,
    NAMES,
    QuantityRow,
    format_number,
    format_percent,
    format_uncertain,
    with_unit,
)
from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.result import FitResult
from adis_gonio.fitting.scores import Score
from adis_gonio.fitting.uncertainty_budget import BudgetRow

Rows = list[list[str]]
_METHOD_WIDTH = 24
"""Columns that one method takes in the wide table, at most."""


def parameter_row(name: str, value: Value) -> list[str]:
    """Name, unit, value, u, U, k, ν."""
    line = QuantityRow.of(name, value)
    return [name, *line.cells[1:], freedom(value.dof) if value.u is not None else "–"]


def freedom(dof: float) -> str:
    """Degrees of freedom; so many that they do not count any more as such."""
    if math.isinf(dof):
        return "∞"
    return "> 10⁴" if dof > 1e4 else f"{dof:.{0 if dof >= 10 else 1}f}"


def budget_table(budget: Mapping[str, Sequence[BudgetRow]]) -> tuple[list[str], Rows]:
    """One row a source: type, distribution, u of the source, and its share of each quantity's variance."""
    if not budget:
        return [], []
    head = ["source", "type", "distribution", "u of it", *(_short(name) for name in budget)]
    rows = []
    for each in zip(*budget.values(), strict=True):
        first = each[0]
        u = DASH if first.u is None else with_unit(format_number(first.u, 2), first.unit)
        rows.append([first.source, first.kind, first.distribution, u, *(share(row.share) for row in each)])
    return head, rows


def score_table(scores: Mapping[str, Score], first: str) -> tuple[list[str], Rows]:
    """Errors of each method on the same dwells, `first` first; columns without a figure are left out."""
    order = [first, *(name for name in scores if name != first)] if first in scores else list(scores)
    columns = {
        "angle, rms / °": [scores[name].angle_rms_deg for name in order],
        "largest / °": [scores[name].angle_max_deg for name in order],
        "residual, rms / mg": [scores[name].residual_rms_mg for name in order],
        "largest / mg": [scores[name].residual_max_mg for name in order],
    }
    shown = {head: column for head, column in columns.items() if any(c is not None for c in column)}
    rows = [[name, *(format_number(c[k]) for c in shown.values())] for k, name in enumerate(order)]
    return ["method", *shown], rows


def blocks(results: Sequence[FitResult], width: int) -> Iterator[tuple[list[str], Rows]]:
    """All parameters of all methods, value ± u; in as many tables as the width asks for."""
    names = list(dict.fromkeys(e.name for result in results for e in result.parameters))
    units = {e.name: e.unit for result in results for e in result.parameters}
    beside = max(1, (width - 26) // _METHOD_WIDTH)
    for start in range(0, len(results), beside):
        part = results[start : start + beside]
        rows = [[name, units[name], *(_cell(result, name) for result in part)] for name in names]
        rows.append(["residual, rms", "mg", *(f"{r.residual_rms_mg:.3f}" for r in part)])
        rows.append(["χ² / dof", "", *(f"{r.chi2:.1f} / {r.dof}" if r.dof else "none left" for r in part)])
        yield ["", "unit", *(f"{result.method}, ± u" for result in part)], rows


def _cell(result: FitResult, name: str) -> str:
    if name not in result:
        return ""
    return format_uncertain(result[name].value, result[name].u)


def share(fraction: float) -> str:
    """A share in percent; a dash for nothing."""
    return format_percent(fraction) if fraction > 0 else DASH


def _short(name: str) -> str:
    return {"angle": "angle"}.get(name, NAMES.get(name, name))
