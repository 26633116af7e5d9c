"""The state of a session on the bench screen, collected from the runner's events."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum
from functools import singledispatchmethod

from adis_gonio.base.arrays import wrap_degrees
from adis_gonio.base.numbers import counted
from adis_gonio.bench import events
from adis_gonio.faces import bench_words as words
from adis_gonio.faces.bench_words import Level, Question
from adis_gonio.record.plans import Plan, Position

LEAST_SIZE = (80, 24)
"""Smallest terminal, in columns and rows, on which the screen works."""


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
    path, url, variant : str
        File, sensor and its variant; empty until the session is open.
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
    turn : TurnMeasured or None
        The last turn between positions; None before the first.
    running : Running or None
        Parameters from the dwells so far; None before the first fit.
    temperature_c, began_c : float or None
        Temperature now, and the first measured temperature, in °C; None if not measured.
    lost : int
        Scans lost so far.
    rate_hz : float or None
        Sample rate; None until the sensor is configured.
    link : str
        Way in which scans are started, as text.
    time_left_s : float or None
        Remaining time in s when the last position was asked for; None before.
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
    finished : Finished or None
        Event of the session's end; None before.
    """

    def __init__(self) -> None:
        self.path = self.url = self.variant = ""
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
        self.turn: events.TurnMeasured | None = None
        self.running: events.Running | None = None
        self.temperature_c: float | None = None
        self.began_c: float | None = None
        self.lost = 0
        self.rate_hz: float | None = None
        self.link = ""
        self.time_left_s: float | None = None
        self.paused = False
        self.quiet = False
        self.hands = False
        self.zero_known = False
        self.here: Position | None = None
        self._turned_deg: float | None = None
        self.reversed = False
        self.messages: list[tuple[str, Level]] = []
        self.finished: events.Finished | None = None

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
        self._take(event)
        # The first lines of a session are in the title and at the side.
        if not isinstance(event, events.Started | events.Configured):
            for text, level in words.lines_about(event):
                self.say(text, level)

    @singledispatchmethod
    def _take(self, event: events.Event) -> None:
        """Update the state by an event; an event without a method of its own changes nothing."""

    @_take.register
    def _(self, event: events.Started) -> None:
        self.path, self.url, self.variant = event.path, event.url, event.variant
        self.plan = event.plan
        self.doing = "setting up the sensor"

    @_take.register
    def _(self, event: events.Configured) -> None:
        self.rate_hz = float(event.configuration["sample_rate_hz"])
        self.link = event.why_polled and f"polled: {event.why_polled}"
        self.link = self.link or "at the data-ready edges"
        for name, (before, after) in event.changed.items():
            self.say(f"register {name} {before} → {after}")

    @_take.register
    def _(self, event: events.PositionAsked) -> None:
        self._ask(event)
        self.time_left_s = event.time_left_s
        self.target_deg = event.position.angle_deg

    @_take.register
    def _(self, event: events.GuardRaised | events.ExtensionOffered) -> None:
        self._ask(event)

    def _ask(self, question: Question) -> None:
        self._go_on()
        self.question = question
        self.place = None if isinstance(question, events.ExtensionOffered) else question.place
        self.doing, self.waits_for = "waiting for you", "your answer"

    @_take.register
    def _(self, event: events.StageMoved) -> None:
        self.doing = f"the stage has gone to {event.position}"

    @_take.register
    def _(self, event: events.Watching) -> None:
        self._look(event)
        self.lost = event.lost
        if event.state == "idle":
            return
        self._go_on()
        activities = {"measuring": "measuring the noise at rest", "moving": "waiting for rest"}
        self.doing = activities.get(event.state, "still; settling")

    @_take.register
    def _(self, event: events.DwellProgress) -> None:
        self._look(event.newest)
        self.tolerance_deg = None
        self._go_on()
        self.place = event.place
        self.doing = "recording"
        self.span = Span("dwell", event.elapsed_s, event.length_s)

    def _look(self, event: events.Watching) -> None:
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

    def _go_on(self) -> None:
        self.question, self.span, self.paused, self.quiet = None, None, False, False

    @_take.register
    def _(self, event: events.Waiting) -> None:
        self._go_on()
        self.place = event.place
        self.doing = "waiting, as the plan asks"
        self.span = Span("wait", event.elapsed_s, event.length_s)

    @_take.register
    def _(self, event: events.Advising) -> None:
        self._go_on()
        self.place = None
        self.quiet = True
        self.waits_for = ""
        self.doing = f"tracing {counted(event.dwells, 'dwell')}"

    @_take.register
    def _(self, event: events.DwellDone) -> None:
        self._go_on()
        self.marks[event.place] = Mark.FAULTY if event.alarms else Mark.DONE
        self.here = event.position
        self._turned_deg = event.position.angle_deg
        self.zero_known |= event.position.angle_deg is not None
        self.place = None
        self.doing = f"{event.position} is done"

    @_take.register
    def _(self, event: events.DwellInterrupted) -> None:
        self._go_on()
        self.here = self._turned_deg = None

    @_take.register
    def _(self, event: events.Problem) -> None:
        if event.kind in ("status", "alarm"):
            self.marks[event.place] = Mark.FAULTY

    @_take.register
    def _(self, event: events.TurnMeasured) -> None:
        self.turn = event

    @_take.register
    def _(self, event: events.Running) -> None:
        self.running = event

    @_take.register
    def _(self, event: events.Paused) -> None:
        self._go_on()
        self.paused = self.quiet = True
        # Turns during the pause are not counted.
        self.angle_deg = self.spread_mg = self._turned_deg = None
        self.doing = "paused"

    @_take.register
    def _(self, event: events.Unpaused) -> None:
        self.paused = False
        self.doing = "going on"

    @_take.register
    def _(self, event: events.Withdrawn) -> None:
        self.marks[event.place] = Mark.WITHDRAWN
        self.running = None

    @_take.register
    def _(self, event: events.Finished) -> None:
        self._go_on()
        self.place = None
        self.quiet = True
        self.finished = event
        self.doing = "complete" if event.complete else "not complete"
