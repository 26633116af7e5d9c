"""What commands share in showing: JSON and tables."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Container, Sequence
from typing import Any, TypeVar

import click
from rich.cells import cell_len
from rich.console import Console

from adis_gonio.base.jsonable import finite

F = TypeVar("F", bound=Callable[..., Any])

json_option = click.option("--json", "as_json", is_flag=True, help="One JSON document on standard output.")
variant_option = click.option(
    "--variant", default="adis16354", show_default=True, help="adis16354, adis16350 or adis16355."
)
poll_option = click.option(
    "--poll", is_flag=True, help="Poll the scans: leave the data-ready line alone, whatever is on it."
)
no_check_option = click.option(
    "--no-check", is_flag=True, help="Open without proving that |a| is 1 g for this variant."
)


WIDTH = 100
"""Widest text: longer lines are hard to read."""


def console(*, stderr: bool = False, most: int = 0) -> Console:
    """Console without automatic colours; wide where a program reads it, so that no row is folded.

    Text is shown as it stands: brackets and colons in it are no markup. With `most` it is at most so wide.
    """

    def made(width: int | None = None) -> Console:
        return Console(stderr=stderr, highlight=False, markup=False, emoji=False, width=width)

    screen = made()
    width = screen.width if screen.is_terminal else 200
    if most:
        width = min(width, most)
    return screen if screen.width == width else made(width)


LEAST_TEXT = 16
"""Width down to which a column of text is folded."""


def print_table(
    screen: Console, head: Sequence[str], rows: Sequence[Sequence[str]], texts: Container[int]
) -> None:
    """Rows below their head; one after the other, each value by its name, where the screen is too narrow.

    Parameters
    ----------
    texts : numbers of columns
        Those of text, which may be folded; the others are numbers.
    """
    from rich.table import Table

    widths = [max(cell_len(row[k]) for row in (head, *rows)) for k in range(len(head))]
    least = sum(min(w, LEAST_TEXT) if k in texts else w for k, w in enumerate(widths)) + 2 * len(head)
    if least > screen.width:
        for row in rows:
            told = [f"{name} {cell}" for name, cell in zip(head, row, strict=True) if cell not in ("", "–")]
            screen.print("; ".join(told))
        return
    table = Table(box=None, padding=(0, 2, 0, 0))
    for k, name in enumerate(head):
        if k in texts:
            table.add_column(name, overflow="fold")
        else:
            table.add_column(name, no_wrap=True, justify="right")
    for row in rows:
        table.add_row(*row)
    screen.print(table)


def json_text(document: Any, *, ascii_only: bool = False) -> str:
    """One JSON document as text; what is not finite becomes null."""
    return json.dumps(finite(document), ensure_ascii=ascii_only, indent=2, allow_nan=False)


def print_json(document: Any) -> None:
    """Write one JSON document to standard output, in pure ASCII where that is not UTF."""
    unicode = (getattr(sys.stdout, "encoding", None) or "utf-8").lower().startswith("utf")
    click.echo(json_text(document, ascii_only=not unicode))
