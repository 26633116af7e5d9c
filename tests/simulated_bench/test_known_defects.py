"""The bench can fail: a defect of the past that is put back breaks the invariant that speaks of it.

`scripts/bench_stories.py --defects` counts the seeds that it takes to find each defect without a hint.
"""

from __future__ import annotations

import pytest

from simulated_bench.bench import LineFault
from simulated_bench.defects import put_back
from simulated_bench.disk import DiskFault
from simulated_bench.stories import Step, Story, play, tell

CALIBRATE = Step("calibrate")

STORIES = {
    "journal orphaned": (
        "a session set aside is whole",
        (Step("calibrate", disk=DiskFault("kill", 79, "within")), Step("calibrate afresh")),
    ),
    "not durable": (
        "the journal says what the part holds",
        (CALIBRATE, Step("write", disk=DiskFault("cut", 27, "before"))),
    ),
    "samples lost": ("every failure is one line", (CALIBRATE,)),
    "short replies": (
        "every failure is one line",
        (Step("calibrate", line=(LineFault("short", 3.0),)),),
    ),
    "late journal": (
        "the journal says what the part holds",
        (CALIBRATE, Step("write", disk=DiskFault("kill", 16, "before"))),
    ),
    "half a report": (
        "reports are whole",
        (CALIBRATE, Step("export", disk=DiskFault("cut", 5, "within"))),
    ),
    "doubts unsaid": (
        "status 0 means a right answer",
        (Step("calibrate", interrupt_s=8.0),),
    ),
}
"""The invariant and the story by the defect."""


def outcome_of(steps, folder):
    folder.mkdir()
    return play(Story(2, steps, motor=True, only="none"), folder)


@pytest.mark.parametrize("name", STORIES)
def test_a_defect_breaks_its_invariant_and_without_it_the_story_holds(tmp_path, name):
    invariant, steps = STORIES[name]
    with put_back(name):
        outcome = outcome_of(steps, tmp_path / "with")
    assert outcome.wrong, tell(outcome)
    assert outcome.wrong[0].startswith(invariant), tell(outcome)
    outcome = outcome_of(steps, tmp_path / "without")
    assert not outcome.wrong, tell(outcome)
