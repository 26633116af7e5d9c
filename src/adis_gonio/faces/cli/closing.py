"""What the closed loop did, on the terminal: where it stood before the further positions, and after."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from adis_gonio.base.numbers import counted
from adis_gonio.faces.cli.show import WIDTH, console

if TYPE_CHECKING:
    from adis_gonio.model.records import Session
    from adis_gonio.tracing.trace_result import TraceResult

_MOST_GROUPS = 3
_ERRORS = {
    "residual_rms_mg": "residual / mg",
    "heldout_rms_mg": "left out / mg",
    "angle_rms_deg": "error of the angle / °",
    "chi2_per_dof": "χ² / dof",
}


def standing(summary: Mapping[str, Any]) -> list[str]:
    """Where a session stands, in at most two lines."""
    if not summary:
        return []
    first = f"With {counted(summary['dwells'], 'dwell')}: the model is {_adequate(summary)}"
    if not summary["tested"]:
        first = f"With {counted(summary['dwells'], 'dwell')}: no readings are left over to test the model"
    lines = [f"{first}; found: {_listed(summary['found'])}"]
    if summary["uncertain"]:
        lines.append(f"Not certain: {_listed(summary['uncertain'])}")
    return lines


def print_loop(session: Session, result: TraceResult) -> None:
    """Show what the further positions changed, and why the loop ended; nothing where there was no round."""
    from rich.table import Table
    from rich.text import Text

    from adis_gonio.base.numbers import format_number
    from adis_gonio.bench.advisor import summarise_trace

    rounds = session.facts.get("advised", [])
    if not rounds or not rounds[0]["summary"]:
        return
    screen = console(most=WIDTH)
    planned = len(session.facts["plan"]["positions"])
    extra = planned - rounds[0]["planned"]
    before, after = rounds[0]["summary"], summarise_trace(result, len(session.dwells))
    screen.print()
    screen.print("Closing the loop", style="bold cyan", markup=False)
    if extra:
        table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
        table.add_column("")
        table.add_column("after the plan")
        table.add_column(f"with {extra} more" if extra > 1 else "with one more")
        rows = [
            ("model", _adequate(before), _adequate(after)),
            ("found", _listed(before["found"]), _listed(after["found"])),
            ("not certain", _listed(before["uncertain"]), _listed(after["uncertain"])),
            ("not told apart", _groups(before), _groups(after)),
        ]
        for key, name in _ERRORS.items():
            rows.append((name, format_number(before["error"][key]), format_number(after["error"][key])))
        for name, first, second in rows:
            table.add_row(f"   {name}", Text(first), Text(second))
        screen.print(table)
    ended = rounds[-1]["ended"]
    if not ended:
        declined = planned == rounds[-1]["planned"]
        ended = "further positions were declined" if declined else "not ended: go on with --resume --trace"
    screen.print(f"   {ended}", markup=False)


def _adequate(summary: Mapping[str, Any]) -> str:
    if not summary["tested"]:
        return "cannot be tested: no readings to spare"
    return "adequate" if summary["adequate"] else "not adequate"


def _listed(names: list[str]) -> str:
    return ", ".join(names) if names else "–"


def _groups(summary: Mapping[str, Any]) -> str:
    """Groups that are not told apart, one a line, the first of them."""
    from adis_gonio.model.effects import catalogue

    known = catalogue()
    seen: dict[str, list[str]] = {}
    for names in summary["confounded"]:
        others = seen.setdefault(names[0], [])
        others += [name for name in names[1:] if name not in others and name in known]
    lines = [f"{first} or {', '.join(others[:_MOST_GROUPS])}" for first, others in seen.items() if others]
    more = [f"and {len(lines) - _MOST_GROUPS} more"] if len(lines) > _MOST_GROUPS else []
    return "\n".join([*lines[:_MOST_GROUPS], *more]) or "–"
