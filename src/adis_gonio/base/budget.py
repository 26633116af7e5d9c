"""A time budget: long work tells its stages and shares, and ends in an orderly way when its time is over.

The budget in use is ambient (a context variable), as a cancel scope is, so that a loop deep inside asks it
without being handed one. Work asks at its safe points: `spent` where it goes on with the best that it has,
`check` where what is half done is thrown away. `attempt` runs a stage and gives its substitute where that
happened; `told` counts through a loop. Without a budget nothing ends early.
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
    """The time is over in the midst of a stage; never leaves `attempt`."""


def _silent(_what: object) -> None:
    """Tell nobody."""


@dataclass
class Budget:
    """Time for a piece of work.

    Attributes
    ----------
    limit_s : float
        Seconds from now on; infinite for no limit.
    tell : callable
        Called with the name of each stage as it begins.
    share : callable
        Called with how much of the stage is done, 0 to 1, where that is known.
    clock : callable
        Seconds from any origin.
    left_out : list of str
        Stages that ended early or were not begun, in order.
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
        """Seconds since it was made."""
        return self.clock() - self._begun

    @property
    def over(self) -> bool:
        """True from the moment on at which something was left out, or the limit is reached."""
        return bool(self.left_out) or self.elapsed_s >= self.limit_s

    def limited(self, limit_s: float) -> Budget:
        """A new budget that tells the same listeners."""
        return replace(self, limit_s=limit_s, left_out=[])

    def leave_out(self, what: str) -> None:
        """Note what ended early."""
        if what not in self.left_out:
            self.left_out.append(what)


_current: ContextVar[Budget | None] = ContextVar("budget", default=None)


@contextmanager
def within(budget: Budget) -> Iterator[Budget]:
    """Make a budget the one that is asked."""
    before = _current.set(budget)
    try:
        yield budget
    finally:
        _current.reset(before)


def current() -> Budget:
    """The budget in use; one without limit where there is none."""
    return _current.get() or Budget()


def spent() -> bool:
    """True where work has to go on with the best that it has."""
    budget = _current.get()
    return budget is not None and budget.over


def check() -> None:
    """End the stage where the time is over.

    Raises
    ------
    OutOfTimeError
        Caught by `attempt`.
    """
    if spent():
        raise OutOfTimeError


def attempt(stage: str, work: Callable[[], T], otherwise: T) -> T:
    """What `work` gives, or `otherwise` where the time is over before it ends: the stage is left out."""
    budget = current()
    budget.tell(stage)
    try:
        check()
        return work()
    except OutOfTimeError:
        budget.leave_out(stage)
        return otherwise


def told(items: Sequence[T], before: int = 0, total: int | None = None) -> Iterator[T]:
    """Each item in turn; tells how much of the stage is done.

    Parameters
    ----------
    items : sequence
    before, total : int
        Items of the stage that came before these, and all of them; by default these are all.
    """
    share, count = current().share, len(items) if total is None else total
    for done, item in enumerate(items, before):
        share(done / count)
        yield item
    share((before + len(items)) / max(count, 1))
