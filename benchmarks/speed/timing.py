"""Two ways to the same answer, timed in turn; the answers are compared before the times."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

Clock = Callable[[], float]
Call = Callable[[], Any]
LEAST_S = 0.02
"""A call that takes less is repeated until one measurement lasts so long."""


class DisagreementError(AssertionError):
    """Two sides give different answers: their times say nothing."""


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    ratio, low, high : float or None
        The baseline's time over ours: median and quartiles of the runs. None where nothing is compared.
    agreement : str
        How far the answers agree, and the tolerance.
    note : str
        What else the run showed, as text; `figures` the same as numbers.
    """

    benchmark: str
    baseline: str
    ratio: float | None
    low: float | None
    high: float | None
    runs: int
    agreement: str
    note: str = ""
    figures: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return asdict(self)


def require(within: bool, what: str) -> str:
    """What agrees, in words.

    Raises
    ------
    DisagreementError
        It does not.
    """
    if not within:
        raise DisagreementError(f"the answers differ: {what}")
    return what


def compare(
    benchmark: str,
    ours: Call,
    baselines: Mapping[str, Call],
    agree: Callable[[str, Any, Any], str],
    runs: int,
    *,
    clock: Clock = time.process_time,
) -> list[Row]:
    """Rows of one benchmark: every side once to warm up and to compare, then all sides in turn.

    Parameters
    ----------
    agree : callable
        Given the baseline's name, our answer and its answer: says how far they agree, or raises
        `DisagreementError`.
    clock : callable
        Processor time, which other programs do not lengthen; wall time where a disk is waited for.
    """
    answer = ours()
    said = {name: agree(name, answer, call()) for name, call in baselines.items()}
    sides = {"": ours, **baselines}
    counts = {name: _repeats(call, clock) for name, call in sides.items()}
    times: dict[str, list[float]] = {name: [] for name in sides}
    for run in range(runs):
        order = list(sides) if run % 2 else list(reversed(sides))
        for name in order:
            times[name].append(_once(sides[name], counts[name], clock))
    rows = []
    for name, agreement in said.items():
        ratios = [theirs / own for theirs, own in zip(times[name], times[""], strict=True)]
        low, middle, high = quartiles(ratios)
        rows.append(Row(benchmark, name, middle, low, high, runs, agreement))
    return rows


def quartiles(values: list[float]) -> tuple[float, float, float]:
    """Lower quartile, median and upper quartile."""
    if len(values) < 2:
        return values[0], values[0], values[0]
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return low, middle, high


def _repeats(call: Call, clock: Clock) -> int:
    spent = _once(call, 1, clock)
    return 1 if spent >= LEAST_S else min(1000, int(LEAST_S / max(spent, LEAST_S / 1000)) + 1)


def _once(call: Call, count: int, clock: Clock) -> float:
    began = clock()
    for _ in range(count):
        call()
    return (clock() - began) / count
