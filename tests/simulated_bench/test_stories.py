"""Stories drawn from seeds: every invariant holds, and the same seed gives the same bytes.

`scripts/bench_stories.py` plays them without end. A story that failed is kept in `KEPT`, shrunk.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from simulated_bench.bench import LineFault
from simulated_bench.disk import Disk, DiskFault
from simulated_bench.stories import Step, Story, draw, play, shrink, tell

SEEDS = [*range(1000, 1005)]

KEPT = {
    "a session that was killed within a commit is whole when --force sets it aside": Story(
        seed=2,
        motor=True,
        steps=(
            Step("calibrate", disk=DiskFault("kill", 79, "within")),
            Step("calibrate afresh"),
        ),
    ),
    "a dwell is kept if the bus fails at the check of the sensor after it": Story(
        seed=2,
        motor=True,
        steps=(Step("calibrate", line=(LineFault("short", 6.0, 2.0),)),),
    ),
    "an operator is told that the settings changed, instead of being asked without end": Story(
        seed=2000074,
        only="none",
        steps=(Step("calibrate", line=(LineFault("filter", 12.155),)),),
        patience_s=300.0,
    ),
    "the live angle is refused while the manual self-test is on": Story(
        seed=2,
        motor=True,
        plan="two-position",
        positions=2,
        steps=(Step("calibrate"), Step("self-test on"), Step("angle")),
    ),
    "offsets by hand are gone if the part is switched off before any session": Story(
        seed=3000119, motor=True, only="none", steps=(Step("offset by hand"), Step("power"))
    ),
}
"""Shrunk stories that failed once, by what they show."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "bench"
    made.mkdir()
    return made


@pytest.mark.parametrize("seed", SEEDS)
def test_no_story_breaks_an_invariant(folder, seed):
    outcome = play(draw(seed), folder)
    assert not outcome.wrong, tell(outcome)


@pytest.mark.parametrize("name", KEPT)
def test_a_story_that_failed_once_holds(folder, name):
    outcome = play(KEPT[name], folder)
    assert not outcome.wrong, tell(outcome)
    assert outcome.ended[-1].status == 0


@pytest.mark.parametrize("motor", [True, False])
def test_the_same_seed_gives_the_same_bytes(tmp_path, motor):
    story = Story(
        seed=11,
        motor=motor,
        steps=(
            Step("calibrate", line=(LineFault("unplug", 9.0),), disk=DiskFault("cut", 70, "within")),
            Step("write", disk=DiskFault("kill", 20)),
        ),
    )
    digests = set()
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        digests.add(play(story, tmp_path / name).digest)
    assert len(digests) == 1


def test_a_failing_story_is_shrunk_to_the_step_that_matters():
    culprit = Step("write", disk=DiskFault("kill", 7))
    story = Story(
        seed=1,
        only="",
        steps=(
            Step("calibrate", line=(LineFault("busy", 1.0),)),
            Step("night", hours=8.0),
            Step("write", line=(LineFault("late", 1.0), LineFault("dip", 2.0)), disk=culprit.disk),
            Step("fit"),
        ),
    )
    small = shrink(story, lambda one: any(step.disk == culprit.disk for step in one.steps))
    assert small == Story(seed=1, only="none", steps=(culprit,))


def test_a_torn_commit_is_rolled_back_by_sqlite_itself(tmp_path):
    """The bench's own journal follows SQLite's format: the database is the old one, byte for byte."""
    import sqlite3

    path = tmp_path / "a.session"
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("CREATE TABLE t (a)")
    for k in range(200):
        connection.execute("INSERT INTO t VALUES (?)", ("x" * 300 + str(k),))
    old = path.read_bytes()
    connection.execute("UPDATE t SET a = 'y' || a")
    connection.close()
    new = path.read_bytes()
    assert struct.unpack(">H", new[16:18])[0] == 4096
    disk = Disk(tmp_path, np.random.default_rng(1), lambda _: None)
    mixed = 0
    for _ in range(30):
        torn = disk._torn_commit("a.session", old, new)
        mixed += torn["a.session"] not in (old, new)
        for name, content in torn.items():
            (tmp_path / name).write_bytes(content)
        connection = sqlite3.connect(path)
        assert connection.execute("SELECT count(*) FROM t WHERE a LIKE 'x%'").fetchone() == (200,)
        connection.close()
        assert path.read_bytes() == old
    assert mixed > 10
