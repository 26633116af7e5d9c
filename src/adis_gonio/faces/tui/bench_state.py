"""The state of a session on the bench screen, collected from the runner's events."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum
from typing import TypeVar

from adis_gonio.base.arrays import wrap_degrees
from adis_gonio.base.numbers import counted, signed
from adis_gonio.bench import events
from adis_gonio.faces import bench_words as words
from adis_gonio.faces.bench_words import Level, Question
from adis_gonio.record.plans import Plan, Position

E = TypeVar("E", bound=events.Event)

LEAST_SIZE = (80, 24)
"""Smallest terminal, in columns and rows, on which the screen works."""
_GOING_ON = (
    events.PositionAsked | events.GuardRaised | events.ExtensionOffered | events.Watching | events.Waiting
    | events.DwellProgress | events.DwellDone | events.DwellInterrupted | events.Advising | events.Paused
    | events.Finished
)  # fmt: skip
"""Events that end an earlier question, progress or pause; `Watching` only if the session is not idle."""
_DOING = {
    "measuring": "measuring the noise at rest",
    "moving": "waiting for rest",
    "settling": "still; settling",
}
"""Activity by the state of `Watching`; during a question (`idle`) the activity stays."""


class Mark(Enum):
    """State of a position in the list of positions, readable without colours.

    The value is a sign of one character, a word of at most seven letters, and the style of its row.
    """

    OPEN = "·", "to do", ""
    NOW = "▶", "now", "bold reverse"
    DONE = "✓", "done", "green"
    SKIPPED = "–", "skipped", "dim"
    FAULTY = "!", "fault", "bold red"
    WITHDRAWN = "↶", "again", "yellow"


@dataclass(frozen=True)
class Span:
    """Progress of an activity with a known length.

    `what` names the activity, the times are in s.
    """

    what: str
    elapsed_s: float
    length_s: float


class BenchState:
    """State of a session for display, collected from its events.

    Attributes
    ----------
    plan : Plan or None
        Plan of the session; None until it is open.
    marks : dict of int to Mark
        States of the positions that are done, skipped or faulty, by place in the plan.
    place : int or None
        Place in the plan that is asked for or measured; None if there is none.
    question : Event or None
        The question that waits for an answer; None if there is none.
    doing : str
        Current activity, as text.
    span : Span or None
        Progress of a dwell or wait; None during other activities.
    angle_deg, target_deg : float or None
        Live angle and requested angle on the stage's scale, in degrees; None if unknown. The live angle
        counts full turns since the last dwell, so that it may exceed 360°. If the turn was not watched (see
        `lost_way`), the live angle is the one within 180° of the requested angle.
    tolerance_deg : float or None
        Largest distance in degrees between live and requested angle at which the sensor counts as arrived,
        estimated from the dwells so far; None during a dwell and before the first dwell.
    spread_mg, limit_mg : float or None
        Spread of the readings in mg, and the limit below which the part counts as still, for the axis with
        the largest ratio of spread to limit; None if unknown.
    waits_for : str
        Event for which the session waits, as text.
    temperature_c, began_c : float or None
        Temperature now, and the first measured temperature, in °C; None if not measured.
    lost : int
        Scans lost so far.
    paused : bool
        True during a pause.
    quiet : bool
        True if no news of the sensor is expected: in a pause, during a trace, after the end.
    hands : bool
        True if keys move a simulated part.
    zero_known : bool
        True once a dwell has determined the stage's zero.
    here : Position or None
        Position of the last dwell; None after an interrupted dwell, because the sensor may have moved.
    reversed : bool
        True if the session counts turns in the direction opposite to the stage's scale.
    messages : list of (str, str)
        Messages for the operator with their levels, `said` or `warned`, the newest last.
    """

    def __init__(self) -> None:
        self._latest: dict[type[events.Event], events.Event] = {}
        self.plan: Plan | None = None
        self.marks: dict[int, Mark] = {}
        self.place: int | None = None
        self.question: Question | None = None
        self.doing = "opening the sensor"
        self.span: Span | None = None
        self.angle_deg: float | None = None
        self.target_deg: float | None = None
        self.tolerance_deg: float | None = None
        self.spread_mg: float | None = None
        self.limit_mg: float | None = None
        self.waits_for = ""
        self.temperature_c: float | None = None
        self.began_c: float | None = None
        self.lost = 0
        self.paused = self.quiet = self.hands = self.zero_known = self.reversed = False
        self.here: Position | None = None
        self._turned_deg: float | None = None
        self.messages: list[tuple[str, Level]] = []

    def latest(self, kind: type[E]) -> E | None:
        """Return the latest event of a kind; None before the first, and after it was withdrawn."""
        event = self._latest.get(kind)
        return event if isinstance(event, kind) else None

    @property
    def position(self) -> Position | None:
        """Position that the operator is asked for, or that is being measured; None if there is none."""
        return None if self.plan is None or self.place is None else self.plan.positions[self.place]

    @property
    def more_deg(self) -> float | None:
        """Remaining turn to the target in degrees, positive in the stage's direction; None if unknown."""
        if self.angle_deg is None or self.target_deg is None:
            return None
        return self.target_deg - self.angle_deg

    @property
    def lost_way(self) -> bool:
        """True if the live angle did not follow all turns of the sensor since the last dwell."""
        here = self.here
        return here is not None and here.angle_deg is not None and self._turned_deg is None

    @property
    def passes(self) -> bool:
        """True if the last dwell was at the requested angle, but reached it from the other side.

        The sensor then has to pass the angle and turn back to it.
        """
        asked, here = self.position, self.here
        if asked is None or here is None or not isinstance(self.question, events.PositionAsked):
            return False
        return asked.angle_deg == here.angle_deg and asked.approach != here.approach

    def mark(self, place: int) -> Mark:
        """Return the state of the position with this place in the plan."""
        return Mark.NOW if place == self.place else self.marks.get(place, Mark.OPEN)

    def remember(self, done: Collection[int], skipped: Collection[int]) -> None:
        """Mark the positions that earlier runs have done or skipped, by place in the plan."""
        self.zero_known = bool(done)
        self.marks |= dict.fromkeys(done, Mark.DONE)
        self.marks |= dict.fromkeys(skipped, Mark.SKIPPED)

    def answered(self, answer: str = "") -> None:
        """Close the open question after the answer with this name; the next event sets the new state.

        The list of messages keeps the question of a guard with its answer.
        """
        if isinstance(self.question, events.GuardRaised) and answer:
            meaning = words.answers_to(self.question)[answer].meaning
            self.say(f"{self.question.message}: {meaning}", "warned")
        if isinstance(self.question, events.PositionAsked):
            self.doing = "going on"
        self.question = None

    def say(self, text: str, level: Level = "said") -> None:
        """Add the message `text` to the list of messages; its level is `said` or `warned`."""
        self.messages = [*self.messages, (text, level)][-100:]

    def take(self, event: events.Event) -> None:
        """Update the state and the messages by an event of the runner."""
        self._latest[type(event)] = event
        idle = isinstance(event, events.Watching) and event.state == "idle"
        if isinstance(event, _GOING_ON) and not idle:
            self.question, self.span, self.paused, self.quiet = None, None, False, False
        self._follow_session(event)
        self._follow_position(event)
        # The first lines of a session are in the title and at the side.
        if not isinstance(event, events.Started | events.Configured):
            for text, level in words.lines_about(event):
                self.say(text, level)

    def _follow_session(self, event: events.Event) -> None:
        """Update the state by an event about the whole session; other events change nothing."""
        match event:
            case events.Started():
                self.plan, self.doing = event.plan, "setting up the sensor"
            case events.Configured():
                for name, (before, after) in event.changed.items():
                    self.say(f"register {name} {before} → {after}")
            case events.StageMoved():
                self.doing = f"the stage has gone to {event.position}"
            case events.Advising():
                self.place, self.quiet, self.waits_for = None, True, ""
                self.doing = f"tracing {counted(event.dwells, 'dwell')}"
            case events.Paused():
                self.paused = self.quiet = True
                # Turns during the pause are not counted.
                self.angle_deg = self.spread_mg = self._turned_deg = None
                self.doing = "paused"
            case events.Unpaused():
                self.paused, self.doing = False, "going on"
            case events.TurnProgress():
                turn = "turn" if event.turns == 1 else f"turn {event.turn} of {event.turns}"
                self.doing = {"rest": "at rest", "turn": turn, "after": "let rest"}[event.state]
                motion = f"{signed(event.turned_deg, 0)}°, {signed(event.rate_dps, 1)} °/s, time limit"
                self.span = Span(motion, event.elapsed_s, event.length_s)
            case events.Finished():
                self.place, self.quiet = None, True
                self.doing = "complete" if event.complete else "not complete"

    def _follow_position(self, event: events.Event) -> None:
        """Update the state by an event about a position of the plan; other events change nothing."""
        match event:
            case events.PositionAsked() | events.GuardRaised() | events.ExtensionOffered():
                self.question = event
                self.place = None if isinstance(event, events.ExtensionOffered) else event.place
                self.doing, self.waits_for = "waiting for you", "your answer"
                if isinstance(event, events.PositionAsked):
                    self.target_deg = event.position.angle_deg
            case events.Watching():
                self._look(event)
                self.doing = _DOING.get(event.state, self.doing)
            case events.DwellProgress():
                self._look(event.newest)
                self.tolerance_deg = None
                self.place, self.doing = event.place, "recording"
                self.span = Span("dwell", event.elapsed_s, event.length_s)
            case events.Waiting():
                self.place, self.doing = event.place, "waiting, as the plan asks"
                self.span = Span("wait", event.elapsed_s, event.length_s)
            case events.DwellDone():
                self.marks[event.place] = Mark.FAULTY if event.alarms else Mark.DONE
                self.here, self._turned_deg = event.position, event.position.angle_deg
                self.zero_known |= event.position.angle_deg is not None
                self.place, self.doing = None, f"{event.position} is done"
            case events.DwellInterrupted():
                self.here = self._turned_deg = None
            case events.Problem() if event.kind in ("status", "alarm"):
                self.marks[event.place] = Mark.FAULTY
            case events.Withdrawn():
                self.marks[event.place] = Mark.WITHDRAWN
                self._latest.pop(events.Running, None)

    def _look(self, event: events.Watching) -> None:
        self.lost = event.lost
        self.angle_deg = event.angle_deg
        if event.angle_deg is not None and self._turned_deg is not None:
            # The live angle is known up to whole turns and moves by less than 180° from event to event;
            # since the last dwell it counts on.
            self._turned_deg += wrap_degrees(event.angle_deg - self._turned_deg)
            self.angle_deg = self._turned_deg
        self.tolerance_deg = event.tolerance_deg
        self.target_deg = event.target_deg if event.target_deg is not None else self.target_deg
        self.waits_for = event.waits_for
        if event.temperature_c is not None:
            self.temperature_c = event.temperature_c
            self.began_c = event.temperature_c if self.began_c is None else self.began_c
        if event.limit_mg is None:
            self.spread_mg, self.limit_mg = max(event.spread_mg), None
            return
        pairs = zip(event.spread_mg, event.limit_mg, strict=True)
        self.spread_mg, self.limit_mg = max(pairs, key=lambda pair: pair[0] / pair[1])
