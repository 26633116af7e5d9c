"""`calibrate --plain` itself before a clumsy person: on a pseudo-terminal and on a pipe."""

from __future__ import annotations

import sys

import pytest

from fakes.clumsy import Manner
from fakes.clumsy_sessions import Task
from fakes.clumsy_typist import by_typing

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")

ADVISED = Manner(keep=0.0, skip=0.0, reverse=0.0)


@pytest.mark.parametrize(
    ("mistake", "seed"), [("forget", 2), ("nonsense", 3), ("unplug", 4), ("quit", 5), ("note", 6)]
)
def test_a_mistake_at_the_prompts_ends_in_a_right_answer(tmp_path, mistake, seed):
    """Even seeds sit at a terminal, odd ones at a pipe."""
    outcome = by_typing(Task(seed, "four-position", None, mistake), tmp_path, ADVISED)
    assert mistake in outcome.blunders
    assert not outcome.trouble
    assert (outcome.complete, outcome.status) == (True, 0)
    assert all(abs(off) < 3 for off in outcome.off.values())
