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
    """The time is over within a stage; `attempt` catches it."""


def _silent(_what: object) -> None:
    """Report nothing."""


@dataclass
class Budget:
    """Time for a piece of work.

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
        """Seconds since its creation."""
        return self.clock() - self._begun

    @property
    def over(self) -> bool:
        """True once a stage was omitted or the limit is reached."""
        return bool(self.left_out) or self.elapsed_s >= self.limit_s

    def limited(self, limit_s: float) -> Budget:
        """A new budget with the same callbacks."""
        return replace(self, limit_s=limit_s, left_out=[])

    def leave_out(self, what: str) -> None:
        """Record a stage that ended early."""
        if what not in self.left_out:
            self.left_out.append(what)


_current: ContextVar[Budget | None] = ContextVar("budget", default=None)


@contextmanager
def within(budget: Budget) -> Iterator[Budget]:
    """Use a budget within the block."""
    before = _current.set(budget)
    try:
        yield budget
    finally:
        _current.reset(before)


def current() -> Budget:
    """The present budget, or a budget without limit."""
    return _current.get() or Budget()


def spent() -> bool:
    """True if work must continue with its best result so far."""
    budget = _current.get()
    return budget is not None and budget.over


def check() -> None:
    """End the stage if the time is over.

    Raises
    ------
    OutOfTimeError
        Caught by `attempt`.
    """
    if spent():
        raise OutOfTimeError


def attempt(stage: str, work: Callable[[], T], otherwise: T) -> T:
    """Result of `work`, or `otherwise` if the time is over before it ends."""
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
