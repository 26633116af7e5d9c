"""Output that the commands share: JSON, tables, pages and progress."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from itertools import count
from pathlib import Path
from textwrap import TextWrapper
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import click
from rich.cells import cell_len
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from adis_gonio.base.jsonable import json_text
from adis_gonio.base.numbers import format_duration

if TYPE_CHECKING:
    from adis_gonio.page.document import Section

WIDTH = 100
"""Largest width in columns of running text, since longer lines are hard to read."""


def console(*, stderr: bool = False, most: int = 0) -> Console:
    """Return a rich console without automatic colours and markup.

    Output to a program is 200 columns wide, so that no row is folded, unless COLUMNS gives its width.

    Parameters
    ----------
    stderr : bool
        True writes to standard error instead of standard output.
    most : int
        Largest width in columns; 0 for no limit.
    """

    def make(width: int | None = None) -> Console:
        return Console(stderr=stderr, highlight=False, markup=False, emoji=False, width=width)

    screen = make()
    width = screen.width if screen.is_terminal or "COLUMNS" in os.environ else 200
    if most:
        width = min(width, most)
    return screen if screen.width == width else make(width)


def print_indented(screen: Console, text: str, indent: int = 2, style: str = "") -> None:
    """Print a text, wrapped to the screen, with all of its lines indented by `indent` columns.

    `style` is a style of rich, such as `bold yellow`.
    """
    screen.print(Padding(Text(text, style=style), (0, 0, 0, indent)), width=min(screen.width, WIDTH))


def say(text: str, *, err: bool = True, hang: int = 0) -> None:
    """Print a line for people, folded to the width of a terminal.

    `err` prints it on standard error, otherwise on standard output. Lines after the first are indented by
    `hang` columns.
    """
    screen = console(stderr=err, most=WIDTH)
    if screen.is_terminal and len(text) >= screen.width:
        # The first line may begin with a line break; a path or an option is not broken.
        wrapper = TextWrapper(screen.width - 1, subsequent_indent=" " * hang, replace_whitespace=False)
        wrapper.break_long_words = wrapper.break_on_hyphens = False
        text = wrapper.fill(text)
    click.echo(text, err=err)


LEAST_TEXT = 16
"""Smallest width in columns of a folded column of text."""


def print_table(
    screen: Console,
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    texts: Container[int] = (0,),
    bold: Container[str] = (),
    indent: int = 0,
) -> None:
    """Print a table without its empty columns, in several parts if it is too wide for the screen.

    Each part repeats the first column, which names the row.

    Parameters
    ----------
    head : sequence of str
        Headings of the columns.
    rows : sequence of sequence of str
        Cells of each row.
    texts : container of int
        Indices of the columns of text, aligned left, which may be folded; the others hold numbers, aligned
        right. A word, such as a name of a file, is broken only if it is wider than half of the screen.
    bold : container of str
        First cells of those rows that are printed in bold.
    indent : int
        Number of columns of the screen to the left of the table.
    """
    from rich.table import Table

    shown = [k for k in range(len(head)) if any(row[k] not in ("", "–") for row in rows)]
    least: dict[int, int] = {}
    room = screen.width - indent
    for k in shown:
        widest = max(cell_len(line) for row in (head, *rows) for line in row[k].split("\n"))
        if k in texts:
            word = max((cell_len(word) for row in (head, *rows) for word in row[k].split()), default=0)
            widest = min(widest, max(LEAST_TEXT, min(word, room // 2)))
        least[k] = 2 + widest
    parts: list[list[int]] = [[]]
    for k in shown:
        if len(parts[-1]) > 1 and sum(least[j] for j in (*parts[-1], k)) > room:
            parts.append(shown[:1])
        parts[-1].append(k)
    for part in parts:
        fits = sum(least[k] for k in part) <= room
        table = Table(box=None, padding=(0, 2, 0, 0), show_header=any(head))
        for k in part:
            side: Literal["left", "right"] = "left" if k in texts else "right"
            table.add_column(Text(head[k]), justify=side, overflow="fold", no_wrap=fits and k not in texts)
        for row in rows:
            table.add_row(*(Text(row[k]) for k in part), style="bold" if row[0] in bold else None)
        screen.print(Padding(table, (0 if part is parts[0] else 1, 0, 0, indent)))


_MOST_ROWS = 40
"""Largest number of rows that `print_sections` prints of a table."""


def print_sections(screen: Console, sections: Iterable[Section]) -> None:
    """Print words, points, tables, notes and parts of sections of a page; empty sections are left out."""
    for section in sections:
        if section.words or section.points or section.tables:
            screen.print()
            screen.print(section.title, style="bold cyan")
        for text in section.words:
            print_indented(screen, text)
        if section.points:
            print_table(screen, ("", ""), [("·", text) for text in section.points], (0, 1), indent=2)
        for number, table in enumerate(section.tables):
            if number:
                screen.print()
            words = set(range(len(table.head))) - set(table.numeric)
            strong = [table.rows[k][0] for k in table.strong]
            print_table(screen, table.head, table.rows[:_MOST_ROWS], words, strong)
            if len(table.rows) > _MOST_ROWS:
                screen.print(f"The first {_MOST_ROWS} rows; all are in the JSON document.")
        for text in section.notes:
            print_indented(screen, text)
        print_sections(screen, section.parts)


def print_result(
    result: Any, title: str, sections: Iterable[Section], *, as_json: bool, most: int = 80
) -> None:
    """Print a result as its JSON document, or as a title with sections of at most `most` columns."""
    if as_json:
        print_json(result.as_dict())
        return
    screen = console(most=most)
    screen.print(title, style="bold")
    print_sections(screen, sections)


def check_page(output: Path | None) -> None:
    """Raise `NotInstalledError` if an HTML page is wanted and its figures cannot be drawn.

    `output` is the file of the page; None means that no page is wanted.
    """
    if output is not None:
        from adis_gonio.page.document import require_matplotlib

        require_matplotlib()


def write_page(output: Path, text: str) -> None:
    """Write an HTML page and report it on standard error."""
    from adis_gonio.base.output import write_text

    write_text(output, text)
    report_written(output)


def report_written(path: Path | str, content: str = "") -> None:
    """Report on standard error that a file was written, with `content` or, if this is empty, its size."""
    say(f"written: {path}, {content or f'{Path(path).stat().st_size // 1024 + 1} kB'}")


def print_json(document: Any) -> None:
    """Write a JSON document to standard output, in pure ASCII unless the output's encoding is a UTF."""
    unicode = (getattr(sys.stdout, "encoding", None) or "utf-8").lower().startswith("utf")
    click.echo(json_text(document, ascii_only=not unicode), nl=False)


def report_times_s() -> Iterator[float]:
    """Yield the times at which the progress of a computation is logged, in s since its beginning.

    The intervals between them grow.
    """
    yield from (1.0, 10.0, 30.0, 60.0, 120.0)
    yield from (300.0 * k for k in count(1))


T = TypeVar("T")


class Work:
    """Describes the progress of a long computation.

    Parameters
    ----------
    what : str
        Description, such as `tracing 24 dwells of today.session`.
    """

    def __init__(self, what: str) -> None:
        self.what = what
        self._stage = ""
        self._share: float | None = None
        self._begun = time.monotonic()

    def tell(self, stage: str) -> None:
        """Begin the next stage of the work, with this description."""
        self._stage, self._share = stage, None

    def share(self, done: float) -> None:
        """Set the finished share of the present stage to `done`, 0 to 1."""
        self._share = min(max(done, 0.0), 1.0)

    @property
    def elapsed_s(self) -> float:
        """Seconds since the work began."""
        return time.monotonic() - self._begun

    def __str__(self) -> str:
        """Return the description of the work, its stage and the finished share, without the time."""
        share = "" if self._share is None else f"{100 * self._share:.0f} %"
        stage = ", ".join(part for part in (self._stage, share) if part)
        return f"{self.what}: {stage}" if stage else self.what


@contextmanager
def report_progress(what: str) -> Iterator[None]:
    """Context that reports the progress of the computation inside it on standard error.

    `what` is the description of the computation. A terminal gets one line that changes, a log gets lines at
    growing intervals; work of less than a second leaves no line in a log.
    """
    from adis_gonio.base.budget import Budget, within

    screen, work = console(stderr=True), Work(what)
    progress = _on_terminal(work, screen) if screen.is_terminal else _in_log(work)
    with progress, within(Budget(tell=work.tell, share=work.share)):
        yield


@contextmanager
def report_waits(url: str) -> Iterator[None]:
    """Context that reports long waits for the sensor behind `url` on standard error, when they begin."""
    from adis_gonio.base.budget import Budget, within

    with within(Budget(tell=lambda wait: say(f"{url}: {wait}"))):
        yield


@contextmanager
def opened(opening: Callable[..., AbstractContextManager[T]], url: str, **options: Any) -> Iterator[T]:
    """Context with the sensor `opening(url, **options)`; report long waits until it is open."""
    with ExitStack() as stack:
        with report_waits(url):
            sensor = stack.enter_context(opening(url, **options))
        yield sensor


@contextmanager
def _on_terminal(work: Work, screen: Console) -> Iterator[None]:
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    # The text of the work is made at each refresh of the line.
    columns = (SpinnerColumn(), TimeElapsedColumn(), TextColumn("{task.fields[work]}", markup=False))
    with Progress(*columns, console=screen, transient=True) as progress:
        progress.add_task("", work=work)
        yield


@contextmanager
def _in_log(work: Work) -> Iterator[None]:
    over = threading.Event()

    def tell() -> None:
        for due in report_times_s():
            if over.wait(due - work.elapsed_s):
                return
            since = f" ({format_duration(work.elapsed_s)})" if due > 1 else ""
            print(f"{work} …{since}", file=sys.stderr, flush=True)  # noqa: T201

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield
    finally:
        over.set()
        teller.join()
