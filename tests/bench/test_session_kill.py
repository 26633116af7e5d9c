"""Smaller versions of `scripts/kill_test.py`, which does 100 kills."""

from __future__ import annotations

import sys

import pytest

import kill_test

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")


def test_killed_sessions_keep_what_was_announced_and_resume_to_the_same_result():
    seen = kill_test.kill_sessions(kills=5, seed=4, plan_name="tumble", positions=5, dwell_s=2.0)
    assert seen["kills"] == 5
    assert seen["dwells announced before a kill"] > 0


def test_a_kill_within_a_commit_loses_nothing_that_was_announced():
    seen = kill_test.kill_writers(kills=4, seed=2)
    assert seen["dwells announced"] > 0
