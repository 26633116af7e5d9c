"""Keys alone lead a clumsy person to a right answer. More of them: scripts/clumsy_operators.py."""

from __future__ import annotations

import pytest

pytest.importorskip("textual", reason="the extra 'bench' is not installed")

from fakes.clumsy import Manner
from fakes.clumsy_screen import by_screen
from fakes.clumsy_sessions import Task

ADVISED = Manner(keep=0.0, skip=0.0, reverse=0.0, obeys=1.0)


@pytest.mark.parametrize(("mistake", "seed"), [("wrong_way", 2), ("nonsense", 3), ("note", 4)])
def test_a_mistake_at_the_screen_ends_in_a_right_answer(tmp_path, mistake, seed):
    outcome = by_screen(Task(seed, "two-position", None, mistake), tmp_path, ADVISED)
    assert mistake in outcome.blunders
    assert not outcome.trouble
    assert (outcome.complete, outcome.status) == (True, 0)
    assert all(abs(off) < 3 for off in outcome.off.values())
