"""Advisors, which propose the next positions to measure after analysing the dwells so far.

A runner asks its advisor whenever its plan is done. `TraceAdvisor` traces the session so far and asks for
the positions that are expected to separate the remaining explanations of the residual. It ends if the model
is adequate and no measurement would decide anything more, if further positions are not expected to help, or
if a limit is reached.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from adis_gonio.base.errors import FitError
from adis_gonio.model.records import Session
from adis_gonio.record.plans import Position

if TYPE_CHECKING:
    from adis_gonio.tracing.trace_result import NextDwell, TraceResult

MOST_EXTRA = 24
"""Default limit of the number of positions that an advisor adds to the plan."""
FEW = 24
"""Number of dwells below which an inadequate model gets positions even if they may decide nothing."""
AT_ONCE = 4
"""Largest number of positions in one round; their results decide the next positions."""


@dataclass(frozen=True)
class Advice:
    """Positions that an advisor proposes, or the reason why it proposes none.

    Attributes
    ----------
    positions : tuple of Position
        Positions to visit next, in this order; empty at the end.
    reasons : tuple of str
        Reasons for these positions, one sentence each.
    ended : str
        Reason why no position is proposed; empty if there are positions.
    summary : dict
        JSON form of the trace so far (see `summarise_trace`); empty if there is none.
    """

    positions: tuple[Position, ...]
    reasons: tuple[str, ...] = ()
    ended: str = ""
    summary: dict[str, Any] = field(default_factory=dict)


class TraceAdvisor:
    """Advisor that traces the session and proposes the measurements that the trace recommends.

    Parameters
    ----------
    most : int
        Limit of positions beyond the plan.

    Attributes
    ----------
    result : TraceResult or None
        Result of the last trace; None before the first.
    dwells : int
        Number of dwells in the last trace; 0 before the first.
    """

    def __init__(self, most: int = MOST_EXTRA) -> None:
        self.most = most
        self.result: TraceResult | None = None
        self.dwells = 0

    def advise(self, session: Session, visited: int, reachable: Callable[[Position], bool]) -> Advice:
        """Trace the session, and propose the measurements that the trace recommends.

        `session` has all dwells so far. `visited` is the number of positions that were requested before and
        accepted; `reachable` returns True for a position that can be visited.
        """
        from adis_gonio.tracing.proposals import LEAST_SEPARATION, sentences
        from adis_gonio.tracing.trace import trace

        try:
            result = trace(session)
        except FitError as error:
            return Advice((), ended=f"the session cannot be traced: {error}")
        self.result, self.dwells = result, len(session.dwells)
        summary = summarise_trace(result, len(session.dwells))
        decide = [m for m in result.measurements if m.purpose == "decide"]
        wanted = [m for m in decide if m.separation >= LEAST_SEPARATION]
        if not result.tested:
            wanted = list(result.measurements)
        elif not wanted and not result.adequate and len(session.dwells) < FEW:
            # With few readings the explanation may be a model that they cannot check.
            wanted = decide
        within = [m for m in wanted if reachable(_position(m))]
        left = self.most - visited
        if within and left > 0:
            chosen = within[: min(AT_ONCE, left)]
            return Advice(tuple(_position(m) for m in chosen), sentences(chosen), "", summary)
        return Advice((), (), _reason_to_end(result, wanted, within, visited), summary)


def summarise_trace(result: TraceResult, dwells: int) -> dict[str, Any]:
    """Return a JSON summary of a trace of `dwells` dwells, to compare with a trace of more dwells."""
    return {
        "dwells": dwells,
        "adequate": result.adequate,
        "tested": result.tested,
        "found": [finding.effect for finding in result.found],
        "uncertain": sorted(
            {step.effect for step in result.steps} - {finding.effect for finding in result.found}
        ),
        "confounded": [list(names) for names in result.confounded],
        "error": result.after.as_dict(),
    }


def _position(measurement: NextDwell) -> Position:
    approach = measurement.approach
    return Position(
        measurement.angle_deg,
        -1 if approach < 0 else 1 if approach > 0 or measurement.angle_deg is not None else 0,
        "fit",
        measurement.direction,
        measurement.wait_s,
    )


def _reason_to_end(
    result: TraceResult, wanted: list[NextDwell], within: list[NextDwell], visited: int
) -> str:
    """Return the reason why no further position is proposed.

    `wanted` are the useful measurements, `within` the reachable measurements among them, and `visited` is
    the number of positions that were added so far.
    """
    if within:
        return f"the limit of further positions is reached ({visited} were added); not all is decided"
    if result.adequate and not wanted:
        return "the model is adequate, and no further position would decide anything more"
    return (
        "the advice is exhausted: no position that can be reached is expected to explain the residual;"
        " see what to measure next"
    )
