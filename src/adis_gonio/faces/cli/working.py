"""What long work says while it goes on: stage, share done and elapsed time, on standard error."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from typing import TYPE_CHECKING

from adis_gonio.base.numbers import format_duration
from adis_gonio.faces.cli.show import console

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console


def _times_s() -> Iterator[float]:
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
        for due in _times_s():
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
