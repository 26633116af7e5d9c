"""Stories drawn from seeds: every invariant holds, and the same seed gives the same bytes.

`scripts/bench_stories.py` plays them without end. A story that failed is kept in `KEPT`, shrunk.
"""

from __future__ import annotations

import os
import struct
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from adis_gonio.base import output
from adis_gonio.faces.serve.iio_device import Sampler
from simulated_bench.bench import LineFault
from simulated_bench.disk import Disk, DiskFault, Killed
from simulated_bench.stories import Play, Step, Story, draw, play, shrink, tell

SEEDS = [*range(1000, 1003)]

KEPT = {
    "a session that was killed within a commit is whole when --force sets it aside": Story(
        seed=2,
        motor=True,
        steps=(
            Step("calibrate", disk=DiskFault("kill", 79, "within")),
            Step("calibrate afresh"),
        ),
    ),
    "a session that a full disk does not let --force rename ends with one line": Story(
        seed=2,
        motor=True,
        only="none",
        plan="two-position",
        positions=2,
        steps=(Step("calibrate"), Step("calibrate afresh", disk=DiskFault("full", 1))),
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
    "write --status that ends with 1 says why, also with --json": Story(
        seed=2,
        motor=True,
        only="none",
        steps=(
            Step("calibrate"),
            Step("write"),
            Step("fit", line=(LineFault("offset", 0.0),)),
            Step("status"),
        ),
    ),
    "serve publishes no words of a line that is dead for a moment": Story(
        seed=115,
        motor=True,
        only="none",
        steps=(Step("serve", line=(LineFault("dip", 3.26),), draw=2325),),
    ),
    "serve publishes no noise of a dead line between polled words": Story(
        seed=186,
        motor=True,
        streams=False,
        only="none",
        steps=(Step("serve", line=(LineFault("dip-and-restart", 1.802),), draw=27911),),
    ),
    "a block of a stream in which no scan is new ends serve with one line": Story(
        seed=234,
        motor=True,
        only="none",
        steps=(
            Step(
                "serve",
                line=(LineFault("dip-and-restart", 4.146), LineFault("dip-and-restart", 3.975)),
                draw=12874,
            ),
        ),
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
    steps = (
        Step("calibrate", line=(LineFault("unplug", 9.0),), disk=DiskFault("cut", 70, "within")),
        Step("write", disk=DiskFault("kill", 20)),
        Step("serve", line=(LineFault("kill", 3.0),), draw=1),
        Step("serve", line=(LineFault("late", 2.0, 3.0),), interrupt_s=6.0, draw=2),
    )
    # A motor changes how the first step goes.
    story = Story(seed=11, motor=motor, steps=steps[:1] if motor else steps)
    one, two = tmp_path / "one", tmp_path / "two"
    outcomes = []
    for path in (one, two):
        path.mkdir()
        outcomes.append(play(story, path))
        assert not outcomes[-1].wrong
    assert outcomes[0].ended == outcomes[1].ended
    assert outcomes[0].digest == outcomes[1].digest


@pytest.mark.parametrize("draw_", range(4))
def test_clients_of_a_sound_server_get_what_they_came_for(folder, draw_):
    """The server cuts off a client of nonsense only, and ends in order after Ctrl-C."""
    outcome = play(Story(3, (Step("serve", draw=draw_),), motor=True, streams=bool(draw_ % 2)), folder)
    served = outcome.ended[0]
    assert not outcome.wrong, tell(outcome)
    assert served.status == 0
    assert served.clients
    assert all("is content" in told or "(wrong)" in told for told in served.clients), served.clients


def test_a_served_number_that_the_part_never_sent_is_noticed(folder):
    run = Play(Story(3, (), motor=True), folder)
    publish = Sampler._publish
    for change, wrong in ((0x0000, False), (0x0800, True)):

        def changed(self, block, since_1970_ns, change=change):
            words = block.words.copy()
            words[:, 1:-1] ^= np.uint16(change)
            publish(self, replace(block, words=words), since_1970_ns)

        with mock.patch.object(Sampler, "_publish", changed):
            run.do(Step("serve", draw=62785))
        assert bool(run.outcome.wrong) is wrong


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


def cut_after_renaming(folder: Path, draw: int, operation: int) -> bytes:
    """Content of a report that replaces an old one, if the power fails right after its renaming.

    `operation` is the number of the renaming among the operations of the disk.
    """
    folder.mkdir()
    report = folder / "report.json"
    report.write_bytes(b"old")
    disk = Disk(folder, np.random.default_rng(draw), lambda _: None)
    disk.begin(DiskFault("cut", operation, "after"))
    with suppress(Killed), disk.hooked(), output.replacing(report) as temporary:
        temporary.write_bytes(b"new" * 100)
    disk.end()
    assert disk.acted == "replace report.json"
    return report.read_bytes()


def test_a_power_cut_leaves_the_old_report_or_the_new_one_if_it_was_flushed(tmp_path):
    contents = {cut_after_renaming(tmp_path / str(draw_), draw_, 4) for draw_ in range(20)}
    assert contents == {b"old", b"new" * 100}
    with mock.patch.object(output, "_flushed"):
        contents = {cut_after_renaming(tmp_path / f"not {draw_}", draw_, 3) for draw_ in range(20)}
    assert len(contents - {b"old", b"new" * 100}) > 3


def test_a_power_cut_after_a_command_tears_only_what_was_not_flushed(tmp_path):
    disk = Disk(tmp_path, np.random.default_rng(1), lambda _: None)
    lost = 0
    for _ in range(20):
        disk.begin(None)
        with disk.hooked():
            (tmp_path / "kept").write_bytes(b"kept")
            with (tmp_path / "kept").open("rb+") as file:
                os.fsync(file.fileno())
            (tmp_path / "lost").write_bytes(b"lost")
        disk.lose_power()
        assert (tmp_path / "kept").read_bytes() == b"kept"
        lost += (tmp_path / "lost").read_bytes() != b"lost"
    assert lost > 5
