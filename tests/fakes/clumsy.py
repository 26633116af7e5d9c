"""A person at the bench who makes mistakes: what is done and said at each question, drawn from a seed.

A person hears what a front end says (a position is asked for, a guard has a question, more is offered) and
answers with steps: lines for the part (`fakes.hand_part`), `still` (wait until it has come to rest), `rest
SECONDS`, `arrow` (turn as the arrow of the screen says), `dwell KEY` (to be said while the next dwell runs)
and `say KEY`, which ends the turn unless it is nonsense or a note. The keys are the names of the session's
answers, with `pause`, `note` and `quit`.

The person goes by the scale of the stage as a careful one would, but for one mistake here and there. After
many questions in vain the hand becomes sober and the ears open: what a careful person cannot finish from
there is a dead end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

MISPLACED = ("forget", "wrong_way", "swap", "overshoot", "misread", "early", "flat")
DISTURBED = ("shake", "bump", "knock", "nudge", "unplug", "walk_away")
SPOKEN = ("nonsense", "skip", "undo", "repeat", "pause", "note", "quit")
BLUNDERS = (*MISPLACED, *DISTURBED, *SPOKEN)

NONSENSE = ("xyzzy", "yes please", "42", "?", "kk", "n0", "ü", "confirm confirm")
IN_VAIN = 3
"""Times that a place is asked for again before a person thinks that an earlier one was wrong."""
RARE = {"walk_away": 0.3, "skip": 0.5, "flat": 0.5}
"""Weights of blunders beside 1."""


@dataclass(frozen=True)
class Manner:
    """How a person behaves, as probabilities.

    Attributes
    ----------
    blunder : float
        Of a mistake at a position, besides the one that everybody makes.
    again : float
        Of a mistake when a position is asked again.
    keep, skip, reverse, odd : float
        At a guard: kept against advice, skipped, taken as reversed without being so, nonsense or a pause.
    accepts, returns : float
        Of the longer plan, and of coming back to a session that is not complete.
    obeys : float
        Of a person who turns by the arrow of the screen, and looks at the scale of the stage only when the
        screen says so.
    """

    blunder: float = 0.05
    again: float = 0.05
    keep: float = 0.08
    skip: float = 0.04
    reverse: float = 0.05
    odd: float = 0.06
    accepts: float = 0.9
    returns: float = 0.95
    obeys: float = 0.0


PERFECT = Manner(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Person:
    """See the module.

    Parameters
    ----------
    seed : int
        Draws the hand (alike for a perfect person) and the mistakes.
    places : sequence of float or (x, y, z)
        The plan as it hangs on the wall: angles in degrees, or directions.
    fixture_deg : float
        Standard deviation of an angle set by hand.
    only : str
        The mistake that is made, instead of any.
    """

    def __init__(
        self,
        seed: int,
        places: Sequence[float | tuple[float, ...]],
        fixture_deg: float,
        manner: Manner | None = None,
        only: str = "",
    ) -> None:
        self.manner = manner or Manner()
        self._hand = np.random.default_rng([seed, 2])
        self._mind = np.random.default_rng([seed, 3])
        taste = np.random.default_rng([seed, 4])
        self._fixture_deg = fixture_deg
        self._places = list(places)
        self._only = only
        self.obeys = bool(np.random.default_rng([seed, 5]).random() < self.manner.obeys)
        clumsy = self.manner.blunder > 0
        self._forced = int(taste.integers(len(places))) if clumsy else -1
        # A generator of its own, so that a perfect person decides alike.
        self._accepts = bool(np.random.default_rng([seed, 6]).random() < self.manner.accepts)
        self.backwards = clumsy and not only and bool(taste.random() < 0.04)
        self._sense = -1 if self.backwards else 1
        self._at: float | tuple[float, ...] = 0.0
        self._asked: Counter[int] = Counter()
        self._owed: dict[int, float | tuple[float, ...]] = {}
        self._undoing = self._began_anew = False
        self.blunders: list[str] = []
        self.questions = 0

    @property
    def sober(self) -> bool:
        """True once so much was asked that no more mistakes are made."""
        return self.questions > 15 + 3 * len(self._places)

    @property
    def exhausted(self) -> bool:
        """True where a careful person has been asked without end."""
        return self.questions > 80 + 10 * len(self._places)

    # -- questions ----------------------------------------------------------------------------------

    def at_position(self, place: int, can_undo: bool, reversed_: bool) -> list[str]:
        """The part has to be brought to a place of the plan."""
        self.questions += 1
        times = self._asked[place]
        self._asked[place] += 1
        if times >= 2 and self._asked[place] % 2:  # in vain by the scale: by the words, then
            self._sense = -1 if reversed_ else 1
        if times >= IN_VAIN and not self._began_anew:
            self._undoing = self._began_anew = True
        if self._undoing and can_undo:
            return ["say undo"]
        if self._undoing:
            self._undoing = False
            self._owed.clear()
            self._asked.clear()
            times = 1
        blunder = self._blunder(place, times, can_undo)
        if blunder:
            self.blunders.append(blunder)
        return self._steps(place, blunder)

    def at_guard(self, kind: str, answers: Sequence[str], default: str, place: int) -> list[str]:
        """A guard has stopped."""
        self.questions += 1
        manner, draw = self.manner, self._mind.random
        if self.sober and self._asked[place] > 8:
            return ["say keep" if "keep" in answers else "say skip"]
        if "reverse" in answers and (self.backwards or draw() < manner.reverse):
            if not self.backwards:
                self.blunders.append("reverse")
            return ["say reverse"]
        if not self.sober:
            for key, chance in (("keep", manner.keep), ("skip", manner.skip)):
                if key in answers and key != default and draw() < chance:
                    self.blunders.append(f"{key}_advised")
                    return [f"say {key}"]
            if draw() < manner.odd:
                return [f"say {self._mind.choice(['nonsense', 'pause', 'note'])}", f"say {default}"]
        return ["rest 1", f"say {default}"]

    def at_extension(self) -> list[str]:
        """A longer plan is offered."""
        self.questions += 1
        if self._accepts and len(self._places) == 2:
            self._places += [180.0, 270.0]
        return ["say accept" if self._accepts else "say decline"]

    def at_pause(self) -> list[str]:
        """The session is paused."""
        self.questions += 1
        return ["sleep 20", "say unpause"]

    def comes_back(self) -> bool:
        """The session has ended early: whether it is taken up again."""
        return self._mind.random() < self.manner.returns

    def nonsense(self) -> str:
        """Something that is no answer."""
        return str(self._mind.choice(NONSENSE))

    # -- the hand -----------------------------------------------------------------------------------

    def _blunder(self, place: int, times: int, can_undo: bool) -> str:
        if self.sober or not self.manner.blunder:
            return ""
        chance = self.manner.again if times else self.manner.blunder
        forced = place == self._forced and not times
        if not forced and self._mind.random() >= chance:
            return ""
        kinds = [self._only] if self._only else list(BLUNDERS)
        if not can_undo:
            kinds = [kind for kind in kinds if kind not in ("undo", "repeat")]
        if not isinstance(self._places[place], float):
            kinds = [kind for kind in kinds if kind not in ("flat", "nudge", "misread")]
        if not kinds:
            return ""
        weights = np.array([RARE.get(kind, 1.0) for kind in kinds])
        return str(self._mind.choice(kinds, p=weights / weights.sum()))

    def _steps(self, place: int, blunder: str) -> list[str]:
        here, there = self._at, self._owed.pop(place, self._places[place])
        confirm = ["still", f"rest {0.5 + self._hand.random():.2f}", "say confirm"]
        if blunder == "forget":
            return ["rest 1", "say confirm"]
        if blunder == "swap" and place + 1 < len(self._places):
            self._owed[place + 1] = there
            return [self._move(self._places[place + 1]), *confirm]
        if blunder == "wrong_way":
            return [self._move(self._opposite(here, there)), *confirm]
        if blunder == "flat":
            return ["orient 0 0 -1", *confirm]
        if blunder in ("overshoot", "misread"):
            return [*self._beside(there, blunder), *confirm]
        move = self._move(there)
        if self.obeys and not blunder and place and isinstance(there, float):
            rough = self._move(there + self._mind.uniform(-5, 5))
            by_scale = self._move(there)  # as the screen says, once the arrow has gone
            return [rough, "still", *["rest 0.5", "arrow", "still"] * 2, by_scale, *confirm]
        if blunder == "early":
            return [f"{move} 0.2" if move.startswith("turn") else move, "say confirm"]
        if blunder in DISTURBED:
            return self._disturbed(blunder, move, confirm)
        return self._spoken(blunder, move, confirm)

    def _beside(self, there: float | tuple[float, ...], blunder: str) -> list[str]:
        """Past the place and perhaps not back, or where a scale that was misread says."""
        mind = self._mind
        away = float(mind.choice([-1, 1]))
        if blunder == "misread":
            return [self._move(self._off(there, away * float(mind.choice([0.5, 1, 2, 5, 10]))))]
        past = self._move(self._off(there, away * mind.uniform(3, 20)))
        return [past] if mind.random() < 0.5 else [past, "still", self._move(there)]

    def _disturbed(self, blunder: str, move: str, confirm: list[str]) -> list[str]:
        """What befalls the part around the dwell."""
        mind = self._mind
        match blunder:
            case "walk_away":
                return ["sleep 3600", move, *confirm]
            case "shake":
                what = f"shake 0 {mind.uniform(20, 300):.1f} {mind.uniform(0.3, 3):.2f}"
            case "bump":
                what = f"shake {mind.uniform(0.1, 1):.2f} {mind.uniform(100, 1000):.0f} 0.15"
            case "unplug":
                what = f"unplug {mind.uniform(0, 0.8):.2f}"
            case _:  # by 0.2° to 5°, small ones as often as large ones
                size = float(mind.choice([-1, 1])) * 10 ** mind.uniform(-0.7, 0.7)
                what = f"{blunder} {mind.uniform(0, 1):.2f} {size:.3f}"
        return [move, *confirm[:-1], what, "say confirm"]

    def _spoken(self, blunder: str, move: str, confirm: list[str]) -> list[str]:
        mind = self._mind
        match blunder:
            case "nonsense":
                return ["say nonsense"] * int(mind.integers(1, 4)) + [move, *confirm]
            case "note":
                return ["say note", move, *confirm]
            case "pause" | "quit" if mind.random() < 0.5:
                return [move, *confirm[:-1], f"dwell {blunder}", "say confirm"]
            case "skip" | "undo" | "repeat" | "pause" | "quit":
                return (
                    [move, *confirm[:-1], f"say {blunder}"] if mind.random() < 0.3 else [f"say {blunder}"]
                )
            case _:
                return [move, *confirm]

    def _move(self, place: float | tuple[float, ...]) -> str:
        """A line for the part; attitudes in space are set by eye."""
        self._at = place
        if isinstance(place, float):
            return f"turn {self._sense * place + self._fixture_deg * self._hand.standard_normal():.5f}"
        vector = np.array(place) + 0.05 * self._hand.standard_normal(3)
        return "orient " + " ".join(f"{part:.5f}" for part in vector)

    def _opposite(self, here: float | tuple[float, ...], there: float | tuple[float, ...]):
        if isinstance(there, float) and isinstance(here, float):
            return 2 * here - there
        return tuple(-part for part in there)

    def _off(self, place: float | tuple[float, ...], by_deg: float):
        if isinstance(place, float):
            return place + by_deg
        return (*(np.array(place) + np.radians(by_deg) * self._hand.standard_normal(3)),)


__all__ = ["BLUNDERS", "PERFECT", "Manner", "Person"]
