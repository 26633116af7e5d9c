"""Closing the loop: what has been measured asks for what is measured next.

A runner asks its advisor whenever its plan is done. The one here traces the session so far and asks for the
positions that are expected to tell apart what is still possible; it ends when the model is adequate and
nothing is left that a measurement would decide, or when nothing more is to be expected from further
positions, or at a limit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from adis_gonio.base.errors import FitError
from adis_gonio.model.records import Session
from adis_gonio.record.plans import Position

if TYPE_CHECKING:
    from adis_gonio.tracing.trace_result import NextDwell, TraceResult

MOST_EXTRA = 24
"""Positions that are asked for beyond the plan, by default."""
FEW = 24
"""Dwells from which a model that is not adequate asks only for positions that would decide."""
AT_ONCE = 4
"""Most positions of one round: what they show decides which come next."""


@dataclass(frozen=True)
class Advice:
    """What an advisor says.

    Attributes
    ----------
    positions : tuple of Position
        To be visited next, in this order; empty where nothing is asked for.
    reasons : tuple of str
        One sentence each.
    ended : str
        Why nothing is asked for.
    summary : dict
        JSON form of where the session stands.
    """

    positions: tuple[Position, ...]
    reasons: tuple[str, ...] = ()
    ended: str = ""
    summary: dict[str, Any] = field(default_factory=dict)


class Advisor(Protocol):
    """Who is asked for further positions."""

    def advise(self, session: Session, visited: int, reachable: Callable[[Position], bool]) -> Advice:
        """Say what to measure next.

        Parameters
        ----------
        session : Session
            All dwells so far.
        visited : int
            Positions that were asked for before and accepted.
        reachable : callable
            True for a position that can be visited.
        """


class TraceAdvisor:
    """Asks for what the trace of the session says would decide.

    Parameters
    ----------
    most : int
        Most positions beyond the plan.
    max_effects : int
        As `adis_gonio.trace`.

    Attributes
    ----------
    result : TraceResult or None
        The last trace.
    dwells : int
        How many dwells it saw.
    """

    def __init__(self, most: int = MOST_EXTRA, max_effects: int = 6) -> None:
        self.most = most
        self.max_effects = max_effects
        self.result: TraceResult | None = None
        self.dwells = 0

    def advise(self, session: Session, visited: int, reachable: Callable[[Position], bool]) -> Advice:
        """Trace the session, and ask for the measurements that it proposes."""
        from adis_gonio.tracing.advice import sentences
        from adis_gonio.tracing.proposals import LEAST_SEPARATION
        from adis_gonio.tracing.trace import trace

        try:
            result = trace(session, self.max_effects)
        except FitError as error:
            return Advice((), ended=f"the session cannot be traced: {error}")
        self.result, self.dwells = result, len(session.dwells)
        summary = where_it_stands(result, len(session.dwells))
        decide = [m for m in result.measurements if m.purpose == "decide"]
        wanted = [m for m in decide if m.separation >= LEAST_SEPARATION]
        if not result.tested:
            wanted = list(result.measurements)
        elif not wanted and not result.adequate and len(session.dwells) < FEW:
            # Few readings hide what explains the rest behind models that they cannot check.
            wanted = decide
        within = [m for m in wanted if reachable(_position(m))]
        left = self.most - visited
        if within and left > 0:
            chosen = within[: min(AT_ONCE, left)]
            return Advice(tuple(_position(m) for m in chosen), sentences(chosen), "", summary)
        return Advice((), (), _ended(result, wanted, within, visited), summary)


def where_it_stands(result: TraceResult, dwells: int) -> dict[str, Any]:
    """What of a trace is compared before and after further positions."""
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
        measurement.temperature_c,
        measurement.supply_v,
    )


def _ended(result: TraceResult, wanted: list[NextDwell], within: list[NextDwell], visited: int) -> str:
    """Why nothing more is asked for."""
    from adis_gonio.tracing.advice import sentences

    if within:
        return f"the limit of further positions is reached ({visited} were added); not all is decided"
    if wanted:
        return (
            "the positions have shown what they can; what is still open needs something else: "
            + "; ".join(sentences(wanted))
        )
    if result.adequate:
        if not _open_names(result):
            return "the model is adequate, and no further position would decide anything more"
        return (
            f"the model is adequate; no further position would decide between {_open_names(result)}: "
            "see what to measure next"
        )
    return (
        "the advice is exhausted: no further position is expected to show what explains the rest; "
        "see what to measure next"
    )


def _open_names(result: TraceResult) -> str:
    """Effects of the model that something else with a name could replace, each with the first of these."""
    from adis_gonio.model.effects import catalogue

    known = catalogue().keys() - {step.effect for step in result.steps}
    inside = {step.effect for step in result.steps}
    pairs: dict[str, str] = {}
    for names in result.confounded:
        others = [name for name in names[1:] if name in known]
        if names[0] in inside and others:
            pairs.setdefault(names[0], others[0])
    return ", and between ".join(f"{name} and {other}" for name, other in pairs.items())


__all__ = ["Advice", "Advisor", "TraceAdvisor", "where_it_stands"]
