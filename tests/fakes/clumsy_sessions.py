"""Sessions of a clumsy person by the events of a runner, and what became of them."""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio import fit
from adis_gonio.base.errors import AdisGonioError, BusError, UsageError
from adis_gonio.bench.events import (
    DwellDone,
    DwellInterrupted,
    DwellProgress,
    Event,
    ExtensionOffered,
    Finished,
    GuardRaised,
    Paused,
    PositionAsked,
    Watching,
)
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import Adis16354
from adis_gonio.faces.tui.bench_state import BenchState
from adis_gonio.fitting.answer import Answer
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings
from fakes.clumsy import Manner, Person
from fakes.hand_part import HandBus, HandPart

FIXTURE_DEG = 0.02
QUICK = Settings(dwell_s=0.5, settle_s=0.1, still_timeout_s=5.0)
MOST_RUNS = 12


@dataclass(frozen=True)
class Task:
    """What a person is asked to do: the seed decides all that is random."""

    seed: int
    plan: str = "four-position"
    positions: int | None = None
    only: str = ""


@dataclass
class Outcome:
    """What became of one person's session.

    Attributes
    ----------
    status : int
        Exit status that `calibrate` has for it.
    time_s : float
        Simulated time at the bench.
    trouble : list of str
        What must not be: a traceback, a dead end, samples lost, an error that is not of one line.
    off : dict of str to float
        Error of each value of the answer in units of its U.
    unsaid : list of str
        Values that the answer leaves out, or gives no U for.
    """

    task: Task
    blunders: list[str] = field(default_factory=list)
    guards: list[str] = field(default_factory=list)
    status: int = 1
    complete: bool = False
    doubts: int = 0
    dwells: int = 0
    runs: int = 0
    questions: int = 0
    time_s: float = 0.0
    trouble: list[str] = field(default_factory=list)
    off: dict[str, float] = field(default_factory=dict)
    unsaid: list[str] = field(default_factory=list)
    said: list[str] = field(default_factory=list)

    @property
    def wrong(self) -> list[str]:
        """Values outside their U in a session that ended with status 0."""
        return [name for name, off in self.off.items() if self.status == 0 and abs(off) > 1]


def judge(outcome: Outcome, path: Path, truth: dict[str, float]) -> None:
    """Exit status by what `calibrate` does, and the errors of its answer."""
    try:
        session = load_session(path)
        outcome.dwells, outcome.doubts = len(session.dwells), len(session.facts["doubts"])
        values = Answer.of(fit(session), own=False).values
    except AdisGonioError as error:
        outcome.said.append(f"fit: {error}")
        outcome.status = 1
        return
    outcome.status = 0 if outcome.complete and not outcome.doubts else 1
    if "delta_k" in values or "delta_phi" in values:
        names = ("delta_k", "delta_phi")
    else:
        names = ("scale_x", "scale_y", "skew_xy")
    for name in names:
        if name not in values or values[name].U is None:
            outcome.unsaid.append(name)
            continue
        outcome.off[name] = (values[name].value - truth[name]) / values[name].U


class EventHand:
    """Does and says at a runner what a person wants, event by event."""

    def __init__(self, person: Person, runner: SessionRunner, bus: HandBus, outcome: Outcome) -> None:
        self._person, self._runner, self._bus, self._outcome = person, runner, bus, outcome
        self._screen, self._wobble = BenchState(), np.random.default_rng(person.questions)
        self._steps: list[str] = []
        self._until_s = -math.inf
        self._within = ""
        self._mark = 0

    def see(self, event: Event) -> None:
        """Take an event: a question begins a list of steps, a look at the sensor lets time pass."""
        person = self._person
        self._screen.take(event)
        match event:
            case PositionAsked():
                self._steps = person.at_position(event.place, event.can_undo, self._runner.reversed)
            case GuardRaised():
                self._outcome.guards.append(event.kind)
                self._steps = person.at_guard(event.kind, event.answers, event.default, event.place)
            case ExtensionOffered():
                self._steps = person.at_extension()
            case Paused():
                self._steps = person.at_pause()
            case DwellProgress() if self._within:
                self._say(self._within)
                self._within = ""
            case DwellDone() | DwellInterrupted():
                self._compare(event)
                return
            case Watching():
                pass
            case _:
                return
        self._go_on()

    def _go_on(self) -> None:
        while self._steps and self._bus.now_s() >= self._until_s:
            verb, _, rest = self._steps.pop(0).partition(" ")
            match verb:
                case "still":
                    self._until_s = self._bus.hands.still_at_s
                case "rest":
                    self._until_s = self._bus.now_s() + float(rest)
                case "dwell":
                    self._within = rest
                case "arrow":
                    self._follow_arrow()
                case "say":
                    self._say(rest)
                case _:
                    self._bus.obey(f"{verb} {rest}")

    def _follow_arrow(self) -> None:
        """Turn by what the screen says is missing, unless it says that the scale decides."""
        more, tolerance = self._screen.more_deg, self._screen.tolerance_deg
        if more is not None and tolerance is not None and abs(more) > tolerance:
            off = tolerance * self._wobble.uniform(-0.9, 0.9)
            self._bus.obey(f"turn {self._bus.part.angle_deg + more + off:.5f}")

    def _say(self, key: str) -> None:
        runner = self._runner
        self._mark = len(self._bus.delivered)
        match key:
            case "pause":
                runner.pause()
            case "unpause":
                runner.unpause()
            case "quit":
                runner.stop()
            case "note":
                runner.note("what is this?")
            case "nonsense":
                self._talk_nonsense()
            case _:
                runner.answer(key)

    def _talk_nonsense(self) -> None:
        try:
            self._runner.answer(self._person.nonsense())
        except (UsageError, ValueError) as error:
            if not isinstance(error, AdisGonioError):
                self._outcome.trouble.append(f"nonsense: {type(error).__name__}: {error}")
        else:
            self._outcome.trouble.append("nonsense was taken for an answer")

    def _compare(self, event: DwellDone | DwellInterrupted) -> None:
        self._outcome.trouble += lost(
            Path(self._outcome.said[0]), event.attempt, self._bus.delivered[self._mark :]
        )
        self._mark = len(self._bus.delivered)


def lost(path: Path, number: int | None, delivered: list[np.ndarray]) -> list[str]:
    """What a bus has delivered during an attempt and the archive does not hold; of None the last one."""
    with ArchiveView(path) as view:
        attempts = [a for a in view.attempts() if number in (None, a.number)]
        if not attempts:
            return [f"attempt {number} is not in the archive"]
        blocks = view.blocks(attempts[-1])
    if not delivered:
        return []
    kept = np.concatenate([block.words for block in blocks]) if blocks else np.empty((0, 1))
    given = np.concatenate(delivered)
    if len(given) > len(kept) or not (kept[-len(given) :] == given).all():
        return [f"attempt {attempts[-1].number}: {len(given)} scans delivered, {len(kept)} kept"]
    return []


def by_events(
    task: Task, folder: Path, manner: Manner | None = None, one_run: OneRun | None = None
) -> Outcome:
    """Let a person go through a session to its end, with as many resumptions as that takes."""
    part = HandPart(task.seed)
    chosen = plan(task.plan, task.positions)
    places = [p.direction if p.angle_deg is None else p.angle_deg for p in chosen.positions]
    person = Person(task.seed, places, FIXTURE_DEG, manner, task.only)
    path = folder / f"{task.plan}-{task.seed}.session"
    outcome = Outcome(task, person.blunders, said=[str(path)])
    for _ in range(MOST_RUNS):
        outcome.runs += 1
        try:
            (one_run or _one_run)(part, person, path, chosen, outcome)
        except BusError as error:
            outcome.said.append(str(error))
        except AdisGonioError as error:
            outcome.said.append(str(error))
        except Exception:
            outcome.trouble.append(traceback.format_exc())
            break
        if outcome.complete or person.exhausted or not person.comes_back():
            break
    if person.exhausted or outcome.runs == MOST_RUNS:
        outcome.trouble.append("dead end")
    outcome.questions, outcome.time_s = person.questions, part.lived_s
    if path.exists():
        judge(outcome, path, part.truth())
        path.unlink()
    return outcome


OneRun = Callable[[HandPart, Person, Path, Any, Outcome], None]


def runner_of(sensor: Adis16354, path: Path, chosen) -> SessionRunner:
    """A runner that begins a session, or goes on with it if there is one."""
    if path.exists():
        return SessionRunner.resume(sensor, path)
    return SessionRunner.begin(sensor, path, chosen, QUICK, fixture_sigma_deg=FIXTURE_DEG)


def _one_run(part: HandPart, person: Person, path: Path, chosen, outcome: Outcome) -> None:
    with part.switch_on() as bus, Adis16354(bus) as sensor:
        runner = runner_of(sensor, path, chosen)
        hand, dwelling = EventHand(person, runner, bus, outcome), False
        try:
            for event in runner.run(so_far=False):
                hand.see(event)
                dwelling = isinstance(event, DwellProgress)
                if isinstance(event, Finished):
                    outcome.complete = event.complete
                if person.exhausted:
                    runner.stop()
        except BusError:
            if dwelling:
                outcome.trouble += lost(path, None, bus.delivered[hand._mark :])
            raise


__all__ = ["FIXTURE_DEG", "Outcome", "Task", "by_events", "judge"]
