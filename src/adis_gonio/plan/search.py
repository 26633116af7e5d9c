"""The exchange of positions: from several plans on, one dwell or two at a time, as long as that is better.

Coordinate exchange (Meyer and Nachtsheim, Technometrics 37, 1995) after Fedorov (1972): in each dwell by
turns the best of all positions, given those of the others; then the best exchange of two dwells' places,
since what dwells share and what changes with time makes the order count. Dwells after one another never
have the same angle: a stage that was not turned has the same error twice.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.budget import check
from adis_gonio.plan.candidates import Candidates, Choice
from adis_gonio.plan.criteria import Criterion

_LEAST_GAIN = 1e-7
"""Rise of a criterion that is no rounding."""
_MOST_SWEEPS = 50
_WORK = 240
"""Dwells of all ascents together: of long plans only the best starts are climbed from."""
_PAIRS = 300
"""Exchanges of two dwells that are tried in a row; of more pairs a draw of them."""
SIMPLER = 1e-3
"""Fall of a criterion, a logarithm of variance, that a simpler order may cost."""


@dataclass(frozen=True)
class SearchResult:
    """The best plan that was found."""

    choice: Choice
    score: float


def search(
    ground: Candidates, criterion: Criterion, starts: Sequence[Choice], rng: np.random.Generator
) -> SearchResult:
    """The best of what is reached from several starts, in the simplest order that is as good.

    Parameters
    ----------
    starts : sequence of (n,) int
        Plans to begin with; the result is no worse than any of them.
    rng : numpy.random.Generator
        Draws the order in which dwells are exchanged: the same result for the same seed.
    """
    climb = _Climb(ground, criterion, rng)
    highest = sorted(starts, key=lambda start: -climb.score(start))
    ascents = max(_WORK // ground.dwells, 1)
    best = max((climb.from_(start) for start in highest[:ascents]), key=lambda found: found.score)
    order = np.lexsort((ground.approach[best.choice], ground.angle_deg[best.choice]))
    simple = best.choice[order]
    for one in (simple, simple[::-1]):
        score = climb.score(one)
        if score >= best.score - SIMPLER and not _repeats(ground.angle_deg[one]):
            return SearchResult(one, score)
    return best


def _repeats(angle_deg: NDArray[np.float64]) -> bool:
    return bool((np.diff(angle_deg) == 0).any())


@dataclass
class _Climb:
    ground: Candidates
    criterion: Criterion
    rng: np.random.Generator

    def score(self, choice: Choice) -> float:
        return float(self.criterion(self.ground.information(choice)[None])[0])

    def from_(self, start: Choice) -> SearchResult:
        found = SearchResult(start.copy(), self.score(start))
        for _ in range(_MOST_SWEEPS):
            before = found.score
            found = self._swapped(self._exchanged(found))
            if found.score < before + _LEAST_GAIN:
                break
        return found

    def _exchanged(self, found: SearchResult) -> SearchResult:
        """After the best position in each dwell by turns."""
        choice, score = found.choice.copy(), found.score
        for dwell in self.rng.permutation(len(choice)).tolist():
            check()
            scores = self.criterion(self.ground.exchanged(choice, dwell))
            scores[self._taken(choice, dwell)] = -np.inf
            best = int(scores.argmax())
            if scores[best] > score + _LEAST_GAIN:
                choice[dwell], score = best, float(scores[best])
        return SearchResult(choice, score)

    def _taken(self, choice: Choice, dwell: int) -> NDArray[np.bool_]:
        """Positions (m,) at the angle of a neighbour."""
        angle = self.ground.angle_deg
        taken = np.zeros(len(angle), dtype=bool)
        for near in (dwell - 1, dwell + 1):
            if 0 <= near < len(choice):
                taken |= angle == angle[choice[near]]
        return taken

    def _swapped(self, found: SearchResult) -> SearchResult:
        """After every exchange of two dwells that is better."""
        choice, score = found.choice.copy(), found.score
        pairs = np.array(list(itertools.combinations(range(len(choice)), 2)))
        for one, two in self.rng.permutation(pairs)[:_PAIRS].tolist():
            check()
            trial = choice.copy()
            trial[[one, two]] = trial[[two, one]]
            if _repeats(self.ground.angle_deg[trial]):
                continue
            reached = self.score(trial)
            if reached > score + _LEAST_GAIN:
                choice, score = trial, reached
        return SearchResult(choice, score)
