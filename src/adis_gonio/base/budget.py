"""Time limits: long work reports its progress, and ends in an orderly way when its time is over.

A `Budget` here is a budget of time (elsewhere a budget of uncertainty). The current budget is a context
variable, so that an inner loop can check it without an argument. Long work calls a function at the places
at which it can stop. `spent` returns True at the end of the time, for work that can return its best result
so far; `check` raises an exception, for work that is of no use unfinished. `attempt` runs a stage and
returns a substitute result if `check` ended the stage; `with_progress` reports the progress of a
loop. Without a time limit nothing ends early.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import TypeVar

from adis_gonio.base.errors import UsageError

T = TypeVar("T")


class OutOfTimeError(Exception):
    """Raised by `check` within a stage of work if the time limit is reached; `attempt` catches it."""


def _silent(_what: object) -> None:
    """Do nothing: the default callback for progress."""


@dataclass
class Budget:
    """Time limit for a piece of work, with callbacks that report its progress.

    Attributes
    ----------
    limit_s : float
        Time limit in seconds after the creation of this object; infinite for no limit.
    tell : callable
        Function that is called with the name of each stage when the stage begins.
    share : callable
        Function that is called with the completed fraction of the present stage, 0 to 1, if known.
    clock : callable
        Function that returns the present time in seconds from any origin.
    left_out : list of str
        Names of the stages that ended early or did not begin, in order.
    """

    limit_s: float = math.inf
    tell: Callable[[str], None] = _silent
    share: Callable[[float], None] = _silent
    clock: Callable[[], float] = time.monotonic
    left_out: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._begun = self.clock()

    @property
    def elapsed_s(self) -> float:
        """Seconds since this time limit was created."""
        return self.clock() - self._begun

    @property
    def over(self) -> bool:
        """True if no further stage may begin: the time limit is reached or a stage was already omitted."""
        return bool(self.left_out) or self.elapsed_s >= self.limit_s

    def limited(self, limit_s: float) -> Budget:
        """Return a copy with another time limit in s from now on and with no omitted stages.

        The copy has the same callbacks.
        """
        return replace(self, limit_s=limit_s, left_out=[])

    def leave_out(self, what: str) -> None:
        """Record the name of a stage that ended early or did not begin."""
        if what not in self.left_out:
            self.left_out.append(what)


_current: ContextVar[Budget | None] = ContextVar("budget", default=None)


@contextmanager
def within(budget: Budget) -> Iterator[Budget]:
    """Make a time limit the current one within a `with` block, and yield it."""
    before = _current.set(budget)
    try:
        yield budget
    finally:
        _current.reset(before)


def current() -> Budget:
    """Return the time limit of the surrounding `within` block, or an infinite one outside any block."""
    return _current.get() or Budget()


@contextmanager
def limited_to(seconds: float | None) -> Iterator[None]:
    """Limit the time of a `with` block to some seconds; None adds no limit.

    Raises `UsageError` if the number of seconds is not positive.
    """
    if seconds is not None and not seconds > 0:
        raise UsageError(f"a time limit of {seconds:g} s: give a positive number of seconds")
    with nullcontext() if seconds is None else within(current().limited(seconds)):
        yield


def spent() -> bool:
    """Return True if the current time limit is reached, or if a stage of the work was already omitted."""
    return current().over


def check() -> None:
    """End the current stage of work by an exception if the current time limit is reached.

    Raises
    ------
    OutOfTimeError
        The limit is reached, or a stage was already omitted; `attempt` catches the exception.
    """
    if spent():
        raise OutOfTimeError


def attempt(stage: str, work: Callable[[], T], otherwise: T) -> T:
    """Return the result of `work`, or `otherwise` if the time limit is reached before `work` ends.

    `stage` is the name of the work in progress reports and in `Budget.left_out`.
    """
    budget = current()
    budget.tell(stage)
    try:
        check()
        return work()
    except OutOfTimeError:
        budget.leave_out(stage)
        return otherwise


def with_progress(items: Sequence[T], before: int = 0, total: int | None = None) -> Iterator[T]:
    """Yield each item and report the completed fraction of the present stage of work.

    Parameters
    ----------
    items : sequence
        Items that are yielded.
    before : int
        Number of items of this stage that were completed before these.
    total : int, optional
        Number of all items of this stage; by default the number of `items`.
    """
    share, count = current().share, len(items) if total is None else total
    for done, item in enumerate(items, before):
        share(done / count)
        yield item
    share((before + len(items)) / max(count, 1))
