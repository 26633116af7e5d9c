"""Output that commands share: JSON, tables, pages, numbers with their uncertainty, progress."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.cells import cell_len
from rich.console import Console

from adis_gonio.base.jsonable import finite
from adis_gonio.base.numbers import format_duration

if TYPE_CHECKING:
    from rich.table import Table

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


def table_of(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    texts: Container[int] = (0,),
    *,
    bold: Container[str] = (),
    number: Mapping[str, Any] | None = None,
    text: Mapping[str, Any] | None = None,
) -> Table:
    """Return rows below their head, without lines.

    Parameters
    ----------
    texts : numbers of columns
        Columns of text, to the left; the others are numbers, to the right.
    bold : container of str
        First cells of the rows that stand out.
    number, text : mapping, optional
        Further options of rich for the columns of numbers and of text.
    """
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0))
    for k, name in enumerate(head):
        if k in texts:
            table.add_column(name, **(text or {}))
        else:
            table.add_column(name, justify="right", **(number or {}))
    for row in rows:
        table.add_row(*row, style="bold" if row[0] in bold else None)
    return table


def print_table(
    screen: Console, head: Sequence[str], rows: Sequence[Sequence[str]], texts: Container[int]
) -> None:
    """Rows below their head; one after the other, each value by its name, where the screen is too narrow.

    Parameters
    ----------
    texts : numbers of columns
        Those of text, which may be folded; the others are numbers.
    """
    widths = [max(cell_len(row[k]) for row in (head, *rows)) for k in range(len(head))]
    least = sum(min(w, LEAST_TEXT) if k in texts else w for k, w in enumerate(widths)) + 2 * len(head)
    if least > screen.width:
        for row in rows:
            told = [f"{name} {cell}" for name, cell in zip(head, row, strict=True) if cell not in ("", "–")]
            screen.print("; ".join(told))
        return
    screen.print(table_of(head, rows, texts, number={"no_wrap": True}, text={"overflow": "fold"}))


def check_page(output: Path | None) -> None:
    """Refuse a page, if one is wanted, that could not be written; a page that is there is replaced."""
    if output is None:
        return
    from adis_gonio.base.output import check_output
    from adis_gonio.page.svg import require_matplotlib

    check_output(output, force=True)
    require_matplotlib()


def write_page(output: Path, text: str) -> None:
    """Write a page and report its size on standard error."""
    from adis_gonio.base.output import replacing, write_utf8

    with replacing(output) as beside:
        size = write_utf8(beside, text)
    click.echo(f"{output}: {size // 1024 + 1} kB", err=True)


def json_text(document: Any, *, ascii_only: bool = False) -> str:
    """One JSON document as text; what is not finite becomes null."""
    return json.dumps(finite(document), ensure_ascii=ascii_only, indent=2, allow_nan=False)


def print_json(document: Any) -> None:
    """Write one JSON document to standard output, in pure ASCII where that is not UTF."""
    unicode = (getattr(sys.stdout, "encoding", None) or "utf-8").lower().startswith("utf")
    click.echo(json_text(document, ascii_only=not unicode))


def report_times_s() -> Iterator[float]:
    """When a log gets a line, in s from the beginning: seldom, and more seldom as the work goes on."""
    yield from (1.0, 10.0, 30.0, 60.0, 120.0)
    yield from (300.0 * k for k in count(1))


class Work:
    """Where a piece of work is.

    Attributes
    ----------
    what : str
        Such as `tracing 24 dwells of today.session`.
    """

    def __init__(self, what: str, changed: Callable[[Work], None] | None = None) -> None:
        self.what = what
        self._stage = ""
        self._share: float | None = None
        self._changed = changed
        self._begun = time.monotonic()

    def tell(self, stage: str) -> None:
        """A stage begins."""
        self._stage, self._share = stage, None
        self._show()

    def share(self, done: float) -> None:
        """So much of the stage is done, 0 to 1."""
        self._share = min(max(done, 0.0), 1.0)
        self._show()

    def _show(self) -> None:
        if self._changed is not None:
            self._changed(self)

    @property
    def elapsed_s(self) -> float:
        """Seconds since it began."""
        return time.monotonic() - self._begun

    def __str__(self) -> str:
        """What, stage and share, without the time."""
        share = "" if self._share is None else f"{100 * self._share:.0f} %"
        stage = ", ".join(part for part in (self._stage, share) if part)
        return f"{self.what}: {stage}" if stage else self.what


@contextmanager
def working(what: str) -> Iterator[None]:
    """Tell on standard error what goes on: on a terminal in place, in a log by a line now and then.

    What is done within a second says nothing in a log.
    """
    from adis_gonio.base.budget import Budget, within

    screen = console(stderr=True)
    place = _on_terminal(what, screen) if screen.is_terminal else _in_log(what)
    with place as work, within(Budget(tell=work.tell, share=work.share)):
        yield


@contextmanager
def _on_terminal(what: str, screen: Console) -> Iterator[Work]:
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False))
    with Progress(*columns, console=screen, transient=True) as progress:
        task = progress.add_task(what)
        yield Work(what, lambda work: progress.update(task, description=str(work)))


@contextmanager
def _in_log(what: str) -> Iterator[Work]:
    work, over = Work(what), threading.Event()

    def tell() -> None:
        for due in report_times_s():
            if over.wait(due - work.elapsed_s):
                return
            since = f" ({format_duration(work.elapsed_s)})" if due > 1 else ""
            print(f"{work} …{since}", file=sys.stderr, flush=True)  # noqa: T201

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield work
    finally:
        over.set()
        teller.join()
