"""The bench can fail: a defect of the past that is put back breaks the invariant that speaks of it.

`scripts/bench_stories.py --defects` counts the seeds that it takes to find each defect without a hint.
"""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import pytest

from simulated_bench.bench import LineFault
from simulated_bench.defects import DEFECTS, put_back
from simulated_bench.disk import DiskFault
from simulated_bench.stories import Outcome, Step, Story, play, tell

CALIBRATE = Step("calibrate")
KILLED = Step("calibrate", disk=DiskFault("kill", 79, "within"))
STOPPED = Step("calibrate", interrupt_s=8.0)


def story(*steps: Step, motor: bool = True, only: str = "none", **bench) -> Story:
    return Story(2, steps, motor=motor, only=only, **bench)


RESTARTED = story(Step("calibrate", line=(LineFault("restart", 5.0),)), streams=False)

STORIES = {
    "restart": ("dwells are measured alike", RESTARTED),
    "no mark": ("dwells are measured alike", RESTARTED),
    "mark left": ("registers are as before or as planned", story(KILLED, CALIBRATE)),
    "loan kept": ("registers are as before or as planned", story(CALIBRATE)),
    "self-test": ("dwells are measured alike", story(Step("self-test on", draw=1), CALIBRATE)),
    "other settings": (
        "dwells are measured alike",
        story(STOPPED, Step("offset by hand"), CALIBRATE),
    ),
    "short replies": (
        "every failure is one line",
        story(Step("calibrate", line=(LineFault("short", 3.0),))),
    ),
    "not durable": (
        "the journal says what the part holds",
        story(CALIBRATE, Step("write", disk=DiskFault("cut", 27, "before"))),
    ),
    "hot journal": ("the session can be read", story(KILLED, CALIBRATE)),
    "journal orphaned": ("a session set aside is whole", story(KILLED, Step("calibrate afresh"))),
    "aside forgotten": (
        "a session set aside is whole",
        Story(
            8,
            (STOPPED, Step("calibrate afresh", disk=DiskFault("cut", 10, "after"))),
            motor=True,
            only="none",
            plan="two-position",
            positions=2,
        ),
    ),
    "samples lost": ("every failure is one line", story(CALIBRATE)),
    "interruption lost": (
        "the last scans before an error are kept",
        story(Step("calibrate", line=(LineFault("unplug", 6.0),))),
    ),
    "interrupted counts": ("every failure is one line", story(STOPPED, CALIBRATE)),
    "half a report": (
        "reports are whole",
        story(CALIBRATE, Step("export", disk=DiskFault("cut", 5, "within"))),
    ),
    "no fsync": (
        "reports are whole",
        story(CALIBRATE, Step("export", disk=DiskFault("cut", 7, "after"))),
    ),
    "late journal": (
        "the journal says what the part holds",
        story(CALIBRATE, Step("write", disk=DiskFault("kill", 16, "before"))),
    ),
    "not set back": (
        "the journal says what the part holds",
        story(CALIBRATE, Step("write", interrupt_s=10.0)),
    ),
    "said saved": (
        "the journal says what the part holds",
        story(CALIBRATE, Step("write"), Step("status")),
    ),
    "unexplained": (
        "the journal says what the part holds",
        story(CALIBRATE, Step("offset by hand"), Step("write")),
    ),
    "doubts unsaid": ("status 0 means a right answer", story(STOPPED, CALIBRATE)),
    "no guards": (
        "status 0 means a right answer",
        story(CALIBRATE, motor=False, only="forget", plan="two-position", positions=2),
    ),
    "records replaced": ("nothing recorded is lost", story(KILLED, CALIBRATE)),
    "endless wait": (
        "every wait ends",
        story(Step("calibrate", line=(LineFault("shake", 5.0, 4000.0),)), patience_s=90.0),
    ),
    "old noise": (
        "every wait ends",
        Story(
            4000052,
            (Step("calibrate", line=(LineFault("range", 1.484),)),),
            only="none",
            plan="two-position",
            positions=2,
            patience_s=150.0,
        ),
    ),
    "forged values": (
        "every failure is one line",
        story(CALIBRATE, Step("forged session values", draw=8), Step("fit")),
    ),
    "forged schema": (
        "nothing recorded is lost",
        story(STOPPED, Step("forged session objects", draw=572), CALIBRATE),
    ),
    "dead line served": (
        "clients get words of the sensor only",
        Story(115, (Step("serve", line=(LineFault("dip", 3.26),), draw=2325),), motor=True),
    ),
}  # fmt: skip
"""The invariant and the story by the defect."""


@cache
def outcome_of(one: Story, defect: str) -> Outcome:
    with tempfile.TemporaryDirectory() as outer:
        folder = Path(outer) / "bench"
        folder.mkdir()
        if not defect:
            return play(one, folder)
        with put_back(defect):
            return play(one, folder)


def test_every_defect_has_a_story():
    assert STORIES.keys() == DEFECTS.keys()


@pytest.mark.parametrize("name", STORIES)
def test_a_defect_breaks_its_invariant_and_without_it_the_story_holds(name):
    invariant, one = STORIES[name]
    outcome = outcome_of(one, name)
    assert outcome.wrong, tell(outcome)
    assert outcome.wrong[0].startswith(invariant), tell(outcome)
    outcome = outcome_of(one, "")
    assert not outcome.wrong, tell(outcome)
