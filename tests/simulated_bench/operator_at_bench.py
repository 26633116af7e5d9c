"""The operator of the bench: reads the prompts of `calibrate --plain`, moves the part, types lines.

The mistakes are those of `fakes.clumsy`; prompts are read as in `fakes.clumsy_typist`.
"""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.record.plans import plan as find_plan
from fakes.clumsy import PERFECT, Person
from fakes.clumsy_sessions import Outcome, Task
from fakes.clumsy_typist import ASKED, GUARD_KEYS, KEYS, Typist

if TYPE_CHECKING:
    from simulated_bench.bench import Bench


_KEYS = KEYS | GUARD_KEYS
LONGEST_AWAY_S = 300.0
"""Longest time in s for which an operator leaves a running command; nights pass between commands."""


class DeadEndError(BaseException):
    """A careful operator was asked without end; no handler of the program catches this."""


class Operator:
    """A person with a plan, over all commands of a story.

    Attributes
    ----------
    person : Person
    did : list of str
        What the hand did and the mouth said, with the times, for the story.
    """

    def __init__(self, bench: Bench, seed: int, plan: str, positions: int | None, only: str) -> None:
        self._bench = bench
        chosen = find_plan(plan, positions)
        places = [p.direction if p.angle_deg is None else p.angle_deg for p in chosen.positions]
        manner = PERFECT if only == "none" else None
        kind = "" if only == "none" else only
        self.person = Person(seed, places, bench.fixture_deg, manner, kind)
        self._outcome = Outcome(Task(seed, plan, positions, kind), self.person.blunders)
        self._typist = Typist(self.person, bench.part, list(chosen.positions), self._outcome)
        self.did: list[str] = []
        self._steps: list[str] = []
        self._until_s = -math.inf
        self._late = ""

    @property
    def guards(self) -> int:
        """Number of questions of guards so far."""
        return len(self._outcome.guards)

    @property
    def plan_length(self) -> int:
        """Number of positions of the plan, as last extended."""
        return len(self._typist._positions)

    @property
    def busy(self) -> bool:
        """True if the answer to the last question is still to come."""
        return bool(self._steps)

    def become_careful(self) -> None:
        """From now on the operator makes no mistakes."""
        self.person.manner = PERFECT
        self.person.questions = 0
        self.person._asked.clear()
        self.person._owed.clear()
        self.person._sense = 1
        self.person.backwards = False

    def new_session(self, plan: str, positions: int | None) -> None:
        """The session begins again: nothing that was said before holds."""
        self._typist._reversed = False
        self._typist._positions = list(find_plan(plan, positions).positions)
        self.person._places = [
            p.direction if p.angle_deg is None else p.angle_deg for p in self._typist._positions
        ]

    def listening(self, said: io.StringIO) -> _Ears:
        """Sit down before a program that writes its prompts to `said`."""
        self._steps, self._until_s, self._late = [], -math.inf, ""
        return _Ears(self, said)

    # -- one turn ---------------------------------------------------------------------------------------

    def hear(self, question: str) -> None:
        """Take a prompt: it leads to a list of steps."""
        asked = ASKED.search(question)
        if asked is None:
            raise AssertionError(f"the operator does not understand: {question!r}")
        if self.person.exhausted:
            raise DeadEndError(f"asked without end: {question}")
        kind, late, self._late = str(asked.lastgroup), self._late, ""
        self._typist._keys = _KEYS
        if late:
            self._steps = [f"say {late}"]
        else:
            self._steps = (
                ["say nothing"] if kind in ("metadata", "note") else self._typist._steps(kind, question)
            )

    def act(self, *, wait: bool) -> str | None:
        """Go on with the steps; return the line that is typed, or None if the hands are busy."""
        bench = self._bench
        while True:
            if bench.now_s < self._until_s:
                if not wait:
                    return None
                bench.advance(self._until_s - bench.now_s)
            if not self._steps:
                raise AssertionError("the operator has nothing to say")
            verb, _, rest = self._steps.pop(0).partition(" ")
            match verb:
                case "still":
                    self._until_s = bench.world.stage.still_at_s
                case "rest":
                    self._until_s = bench.now_s + float(rest)
                case "dwell":
                    if rest == "quit":
                        bench.interrupt_in(0.5)
                    else:
                        self._late = rest
                    self._note(f"presses {'Ctrl-C' if rest == 'quit' else rest} during the dwell")
                case "say":
                    return self._say(rest)
                case _:
                    self._do(verb, [float(part) for part in rest.split()])

    def _note(self, what: str) -> None:
        self.did.append(f"{self._bench.now_s:.1f} s: {what}")

    def _say(self, key: str) -> str:
        if key == "nothing":
            return ""
        self._note(f"answers '{key}'")
        self._typist._reversed ^= key == "reverse"
        if key == "quit" and self.person.comes_back():
            raise EOFError
        return self.person.nonsense() if key == "nonsense" else self._typist._keys[key]

    def _do(self, name: str, numbers: list[float]) -> None:
        bench = self._bench
        part, stage = bench.part, bench.world.stage
        self._note(f"{name} {' '.join(f'{number:.2f}' for number in numbers)}")
        match name:
            case "turn":
                part.angle_deg, part.direction = numbers[0], None
                after_s = numbers[1] if len(numbers) > 1 else 0.0
                stage.move_to(self._free_s(after_s), part.angle_deg + part.slipped_deg)
            case "orient":
                part.direction = tuple(numbers)
                stage.orient(self._free_s(0.0), np.array(numbers))
            case "knock" | "nudge":
                if name == "knock":
                    part.slipped_deg += numbers[1]
                else:
                    part.angle_deg += numbers[1]
                if part.direction is None:
                    stage.move_to(self._free_s(numbers[0]), part.angle_deg + part.slipped_deg)
            case "shake":
                bench.world.shakes += ((self._free_s(numbers[0]), numbers[1], numbers[2]),)
            case "unplug":
                bench.unplug_in(numbers[0])
            case "sleep":
                away_s = min(numbers[0], LONGEST_AWAY_S)
                self._until_s = bench.now_s + away_s
                bench.be_patient(away_s)
            case _:
                raise AssertionError(name)

    def _free_s(self, after_s: float) -> float:
        return max(self._bench.now_s + after_s, self._bench.may_move_s())


class _Ears:
    """Takes the place of `line_prompts.Lines`: the lines of standard input."""

    def __init__(self, operator: Operator, said: io.StringIO) -> None:
        self._operator, self._said, self._heard = operator, said, 0

    def next(self, *, wait: bool) -> str | None:
        text = self._said.getvalue()
        line = text[self._heard :].rpartition("\n")[2]
        if len(text) > self._heard and ASKED.search(line):
            self._heard = len(text)
            if not self._operator.busy:  # a prompt after a note or nonsense is the same question
                self._operator.hear(line)
        return self._operator.act(wait=wait)


__all__ = ["DeadEndError", "Operator"]
