"""A time budget: long work reports its progress, and ends in an orderly way when its time is over.

The present budget is a context variable, like a cancel scope, so that an inner loop can check it without an
argument. Work asks at its safe points: `spent` if it can continue with its best result so far, `check` if
unfinished work must be discarded. `attempt` runs a stage and returns its substitute in this case;
`with_progress` reports the progress of a loop. Without a budget nothing ends early.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import TypeVar

T = TypeVar("T")


class OutOfTimeError(Exception):
    """Raised by `check` in a stage of work if the time is over; `attempt` catches it."""


def _silent(_what: object) -> None:
    """Default callback, which does nothing."""


@dataclass
class Budget:
    """Time limit for a piece of work, with callbacks that report its progress.

    Attributes
    ----------
    limit_s : float
        Seconds from now on; infinite for no limit.
    tell : callable
        Called with the name of each stage at its beginning.
    share : callable
        Called with the completed fraction of the stage, 0 to 1, if known.
    clock : callable
        Seconds from any origin.
    left_out : list of str
        Stages that ended early or did not begin, in order.
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
        """Seconds since this budget was created."""
        return self.clock() - self._begun

    @property
    def over(self) -> bool:
        """True if no further stage may begin: the limit is reached or a stage was already omitted."""
        return bool(self.left_out) or self.elapsed_s >= self.limit_s

    def limited(self, limit_s: float) -> Budget:
        """Make a budget with another limit and the callbacks of this one."""
        return replace(self, limit_s=limit_s, left_out=[])

    def leave_out(self, what: str) -> None:
        """Record the name of a stage that ended early or did not begin."""
        if what not in self.left_out:
            self.left_out.append(what)


_current: ContextVar[Budget | None] = ContextVar("budget", default=None)


@contextmanager
def within(budget: Budget) -> Iterator[Budget]:
    """Make a budget the current one within a `with` block."""
    before = _current.set(budget)
    try:
        yield budget
    finally:
        _current.reset(before)


def current() -> Budget:
    """Return the budget of the surrounding `within` block, or a budget without limit."""
    return _current.get() or Budget()


def spent() -> bool:
    """True if the time of the current budget is over.

    The caller then continues with its best result so far.
    """
    budget = _current.get()
    return budget is not None and budget.over


def check() -> None:
    """Raise an exception that ends the stage if the time of the current budget is over.

    Raises
    ------
    OutOfTimeError
        Caught by `attempt`.
    """
    if spent():
        raise OutOfTimeError


def attempt(stage: str, work: Callable[[], T], otherwise: T) -> T:
    """Return the result of `work`, or `otherwise` if the time is over before `work` ends."""
    budget = current()
    budget.tell(stage)
    try:
        check()
        return work()
    except OutOfTimeError:
        budget.leave_out(stage)
        return otherwise


def with_progress(items: Sequence[T], before: int = 0, total: int | None = None) -> Iterator[T]:
    """Yield each item and report the completed fraction of the stage.

    Parameters
    ----------
    items : sequence
    before, total : int
        Number of items of the stage before these, and of all items; by default these are all.
    """
    share, count = current().share, len(items) if total is None else total
    for done, item in enumerate(items, before):
        share(done / count)
        yield item
    share((before + len(items)) / max(count, 1))
