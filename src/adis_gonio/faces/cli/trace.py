"""`adis-gonio trace`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.base.numbers import counted
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import WIDTH, console, print_json, working

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from adis_gonio.model.records import Session
    from adis_gonio.record.loading import Overrides
    from adis_gonio.tracing.trace_result import TraceResult


@click.command("trace")
@option.session
@option.shown(
    "--max-effects", type=click.IntRange(0, 12), default=6, help="Most effects that the model may take on."
)
@option.time_limit(
    "End after so long with the best model so far; what was not validated is not called found."
)
@option.part()
@option.overrides
@option.json
def command(
    *,
    session: Path,
    max_effects: int,
    time_limit: float | None,
    part: str,
    as_json: bool,
    overrides: Overrides,
) -> None:
    """Trace what the residual says: find the effects that the seed paper's model lacks.

    Says what was found and how sure, the error before and after on data that took no part, what this
    session cannot tell apart or could not have seen, and what to measure next.
    """
    from adis_gonio.tracing.trace import trace

    loaded = option.load(session, overrides)
    with working(f"tracing {counted(len(loaded.dwells), 'dwell')} of {session.name}"):
        result = trace(loaded, max_effects=max_effects, time_limit=time_limit, part=part)
    if as_json:
        print_json(result.as_dict())
        return
    print_trace(loaded, result)


def print_trace(session: Session, result: TraceResult) -> None:
    """Show a trace on the terminal."""
    from adis_gonio.tracing import trace_summary as words

    screen = console(most=WIDTH)
    screen.print(f"{words.title(session)}: {words.shape(session)}", markup=False)
    screen.print()
    screen.print(words.headline(result), style="bold", markup=False)
    screen.print(words.gains(result), markup=False)
    _found(screen, result)
    _errors(screen, result)
    _items(screen, "What this session cannot tell apart", words.confounded(result))
    _items(screen, "Without a name", [words.unnamed(result)] if result.unnamed else [])
    _items(screen, "Looked like something, but not called found", words.open_names(result))
    _items(screen, "Inside the dwells", words.within(result))
    _sight(screen, result)
    _items(screen, "What to measure next", words.advice(result), numbered=True)
    _items(screen, "Remarks", [*session.notes, *result.notes])


def _heading(screen: Console, text: str) -> None:
    screen.print()
    screen.print(text, style="bold cyan", markup=False)


def _items(screen: Console, heading: str, items: Sequence[str], numbered: bool = False) -> None:
    """A list with hanging indent; nothing where there are no items."""
    from rich.table import Table

    if not items:
        return
    _heading(screen, heading)
    table = Table.grid(padding=(0, 1, 0, 0))
    table.add_column(justify="right", width=3)
    table.add_column()
    for k, item in enumerate(items, 1):
        table.add_row(f"{k}." if numbered else "·", _plain(item))
    screen.print(table)


def _found(screen: Console, result: TraceResult) -> None:
    from rich.table import Table

    from adis_gonio.base.numbers import format_percent
    from adis_gonio.tracing import trace_summary as words

    if not result.found:
        return
    _heading(screen, "Found")
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(justify="right", width=3)
    table.add_column(no_wrap=True)
    table.add_column()
    for k, finding in enumerate(words.ordered(result), 1):
        first, *more = words.parameters(finding) or ["–"]
        table.add_row(f"{k}.", _plain(words.with_axes(finding), "bold"), _plain(first))
        for line in more:
            table.add_row("", "", _plain(line))
        if finding.explains or finding not in words.inside_only(result):
            table.add_row(
                "", "", _plain(f"explains {format_percent(finding.explains)} of the excess residual")
            )
        else:
            table.add_row(
                "", "", _plain("inside the dwells; explains nothing of the residual of the means")
            )
        table.add_row("", "", _plain(words.how_sure(finding)))
        table.add_row("", "", _plain(finding.cause, "dim"))
    screen.print(table)


def _errors(screen: Console, result: TraceResult) -> None:
    from rich.padding import Padding
    from rich.table import Table

    from adis_gonio.tracing import trace_summary as words

    _heading(screen, "Error before and after")
    head, rows = words.error_rows(result)
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
    table.add_column(f"   {head[0]}")
    for name in head[1:]:
        short = name.replace("error of the angle", "angle")
        table.add_column(short if name.endswith("dof") else short.replace(" / ", "\n"), justify="right")
    for k, (name, *cells) in enumerate(rows):
        last = 0 < k == len(rows) - 1
        table.add_row(_plain(f"   {name}"), *cells, style="bold" if last else None)
    screen.print(table)
    if result.heldout_design:
        screen.print(Padding(_plain(f"left out: {result.heldout_design}", "dim"), (0, 0, 0, 3)))


def _sight(screen: Console, result: TraceResult) -> None:
    from adis_gonio.tracing import trace_summary as words

    seen = words.sight(result)
    items = []
    if seen.weak:
        listed = ", ".join(f"{name} from {text}" for name, text in seen.weak)
        items.append(f"only if larger than usual: {listed}")
    items += [f"{', '.join(names)}: {reason}" for names, reason in seen.blind]
    _items(screen, "What this session could not have seen", items)
    if seen.visible:
        listed = ", ".join(f"{name} {text}" for name, text in seen.visible)
        _items(screen, f"{words.absent(result).capitalize()} (90 % power) from", [listed])


def _plain(text: str, style: str = "") -> Text:
    from rich.text import Text

    return Text(text, style=style)
