"""Smaller versions of `scripts/kill_test.py`, which does 100 kills."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "kill_test.py"

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")


@pytest.fixture(scope="module")
def kill_test() -> ModuleType:
    spec = importlib.util.spec_from_file_location("kill_test", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["kill_test"] = module
    spec.loader.exec_module(module)
    return module


def test_killed_sessions_keep_what_was_announced_and_resume_to_the_same_result(kill_test):
    seen = kill_test.kill_sessions(kills=8, seed=4, plan_name="tumble", positions=5, dwell_s=2.0)
    assert seen["kills"] == 8
    assert seen["dwells announced before a kill"] > 0


def test_a_kill_within_a_commit_loses_nothing_that_was_announced(kill_test):
    seen = kill_test.kill_writers(kills=4, seed=2)
    assert seen["dwells announced"] > 0
