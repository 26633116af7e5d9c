"""Clumsy operators: whatever is done wrong, sessions end, nothing is lost, no wrong answer has status 0.

A thousand of them, with the shares of values outside U: `scripts/clumsy_operators.py`.
"""

from __future__ import annotations

import numpy as np
import pytest

from fakes.clumsy import PERFECT, Manner
from fakes.clumsy_sessions import Task, by_events, lost

ADVISED = Manner(keep=0.0, skip=0.0, reverse=0.0)
"""Clumsy, but for answers against advice."""

MISTAKES = [
    ("forget", "four-position", 4, 1),
    ("wrong_way", "four-position", 4, 2),
    ("swap", "mmpm", 9, 3),
    ("overshoot", "two-position", 2, 4),
    ("misread", "mmpm", 9, 5),
    ("early", "four-position", 4, 6),
    ("flat", "two-position", 2, 7),
    ("shake", "poses", 9, 8),
    ("bump", "four-position", 4, 9),
    ("knock", "tumble", 4, 10),
    ("unplug", "four-position", 4, 11),
    ("quit", "poses", 9, 12),
]


@pytest.mark.parametrize(("mistake", "plan", "positions", "seed"), MISTAKES)
def test_a_mistake_leads_neither_into_a_dead_end_nor_to_a_wrong_answer(
    tmp_path, mistake, plan, positions, seed
):
    outcome = by_events(Task(seed, plan, positions, mistake), tmp_path, ADVISED)
    assert mistake in outcome.blunders
    assert not outcome.trouble
    assert outcome.complete
    assert outcome.status == 0
    assert outcome.off
    assert all(abs(off) < 3 for off in outcome.off.values())  # one seed each: no statistics of U here


def test_what_was_kept_against_advice_never_ends_with_status_0(tmp_path):
    outcome = by_events(Task(1, "four-position", 4, "forget"), tmp_path, Manner(blunder=1.0, keep=1.0))
    assert "keep_advised" in outcome.blunders
    assert outcome.complete
    assert (outcome.status, outcome.doubts > 0) == (1, True)
    assert not outcome.trouble


def test_a_perfect_operator_is_asked_nothing_beside_the_plan(tmp_path):
    outcome = by_events(Task(1, "mmpm", 9), tmp_path, PERFECT)
    assert (outcome.status, outcome.questions, outcome.guards, outcome.trouble) == (0, 9, [], [])


def test_the_rig_sees_scans_that_an_archive_does_not_hold(tmp_path):
    """The judge can fail: words that no archive has are called lost."""
    from adis_gonio.bench.events import ExtensionOffered, PositionAsked
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.device.sensor import Adis16354
    from adis_gonio.record.plans import plan
    from bench.hand_bench import QUICK
    from fakes.hand_part import HandPart

    path = tmp_path / "a.session"
    with HandPart(1).switch_on() as bus, Adis16354(bus) as sensor:
        runner = SessionRunner.begin(sensor, path, plan(), QUICK)
        for event in runner.run():
            if isinstance(event, PositionAsked):
                bus.obey(f"turn {event.position.angle_deg}")
                runner.answer("confirm")
            elif isinstance(event, ExtensionOffered):
                runner.answer("decline")
    last = bus.delivered[-1]
    assert lost(path, None, [last]) == []
    assert lost(path, None, [last, np.zeros_like(last)])
    assert lost(path, 99, [last])
