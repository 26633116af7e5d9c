"""Faults that pass within a dwell: judged by EA of every scan, told, kept, asked about at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.bench.dialogue import Reply
from adis_gonio.bench.events import (
    DwellDone,
    DwellProgress,
    Event,
    ExtensionOffered,
    Finished,
    GuardRaised,
    PositionAsked,
    Problem,
    StageMoved,
    Withdrawn,
)
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import Adis16354, open_sensor
from adis_gonio.device.sensor.registers import ACCEL_OUT, EA, ND
from adis_gonio.device.sensor.settings import ScanBlock
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.blocks import find_alarms
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import plan
from adis_gonio.record.samples_writer import session_dict, write_samples_csv
from adis_gonio.record.session_reader import read_session
from adis_gonio.record.source import Settings
from adis_gonio.sim import World

URL = "sim:?seed=3"
SETTINGS = Settings(dwell_s=1.0, settle_s=0.1)
LENGTH_S = 0.030


class Glitches:
    """Turns a world's Z gyro beyond its range for 30 ms; the acceleration is as it was."""

    def __init__(self, world: World) -> None:
        self.begin_s: list[float] = []
        self._sample = world.sample
        world.sample = self._with_glitches

    def _with_glitches(self, time_s):
        inputs = self._sample(time_s)
        hit = np.zeros(len(time_s), bool)
        for begin_s in self.begin_s:
            hit |= (time_s >= begin_s) & (time_s < begin_s + LENGTH_S)
        gyro = np.array(inputs.gyro_dps)
        gyro[hit, 2] = 310.0
        return replace(inputs, gyro_dps=gyro)


@pytest.fixture
def sensor() -> Iterator[Adis16354]:
    with open_sensor(URL) as opened:
        yield opened


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.session"


def answer(runner: SessionRunner, event: Event, *, repeat: bool = False) -> None:
    """Go through the plan; take a faulty dwell again or keep it."""
    if isinstance(event, PositionAsked):
        runner.answer("confirm")
    elif isinstance(event, ExtensionOffered):
        runner.answer("decline")
    elif isinstance(event, GuardRaised):
        runner.answer(Reply.RETAKE if repeat else Reply.KEEP)


def visit(
    runner: SessionRunner,
    sensor: Adis16354,
    *,
    glitch_at: int | None = 1,
    stop: type[Event] | None = None,
    repeat: bool = False,
) -> list[Event]:
    """Run a session; the first dwell at a place gets a glitch; end it when an event of a type comes."""
    glitches = Glitches(sensor.bus.world)
    events, run = [], runner.run(so_far=False)
    for event in run:
        if isinstance(event, DwellProgress) and event.place == glitch_at and not glitches.begin_s:
            glitches.begin_s.append(sensor.bus.now_s() + 0.1)
        events.append(event)
        if stop is not None and isinstance(event, stop):
            run.close()
            break
        answer(runner, event, repeat=repeat)
    return events


def of(events: list[Event], kind: type[Event]) -> list[Event]:
    return [event for event in events if isinstance(event, kind)]


def test_an_over_range_that_ends_within_a_dwell_is_told_though_status_after_it_is_clean(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), SETTINGS)
    events = visit(runner, sensor)
    clean, hit = of(events, DwellDone)
    assert clean.alarms == 0
    assert hit.alarms in (24, 25)  # 30 ms at 819.2 samples a second
    (problem,) = of(events, Problem)
    assert (problem.kind, problem.place) == ("alarm", 1)
    assert "it has passed" in problem.message
    with ArchiveView(path) as view:
        assert [attempt.status for attempt in view.dwells()] == [0, 0]


def test_the_fault_is_in_the_session_s_notes_facts_report_text_and_exports(sensor, path, tmp_path):
    visit(SessionRunner.begin(sensor, path, plan(), SETTINGS), sensor)
    session = read_session(path)
    before, after = (entry["alarms"] for entry in session.facts["dwells"])
    assert before is None
    assert after["scans"] in (24, 25)
    assert after["times"] == 1
    assert after["longest_s"] == pytest.approx(LENGTH_S, abs=1.5 / 819.2)
    (note,) = session.notes
    assert note.startswith("dwell 1 (90°")
    assert f"{after['scans']} scans" in note
    assert session_dict(session)["facts"]["dwells"][1]["alarms"] == after
    write_samples_csv(session, tmp_path / "a.csv")
    assert load_session(tmp_path / "a.csv").notes == (note,)


def test_the_faulty_dwell_is_asked_about_at_once_and_a_sound_one_takes_its_place(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), SETTINGS)
    events = visit(runner, sensor, repeat=True)
    (raised,) = of(events, GuardRaised)
    assert (raised.kind, raised.place, raised.default) == ("over_range", 1, "retake")
    assert raised.values["scans"] in (24, 25)
    assert [withdrawn.place for withdrawn in of(events, Withdrawn)] == [1]
    assert [done.place for done in of(events, DwellDone)] == [0, 1, 1]
    assert isinstance(events[-1], Finished)
    session = read_session(path)
    assert [entry["alarms"] for entry in session.facts["dwells"]] == [None, None]
    assert session.notes == ()


def test_a_faulty_dwell_that_is_kept_is_not_asked_about_again(sensor, path):
    events = visit(SessionRunner.begin(sensor, path, plan(), SETTINGS), sensor)
    assert len(of(events, GuardRaised)) == 1
    with open_sensor(URL) as again:
        events = visit(SessionRunner.resume(again, path), again, glitch_at=None)
    assert not of(events, GuardRaised)
    assert len(read_session(path).notes) == 1


@pytest.mark.parametrize("stop", [Problem, GuardRaised])
def test_a_fault_survives_a_break_before_the_answer_in_the_session_s_notes(sensor, path, stop):
    visit(SessionRunner.begin(sensor, path, plan(), SETTINGS), sensor, stop=stop)
    assert "dwell 1 (90°" in read_session(path).notes[-1]
    with open_sensor(URL) as again:
        events = visit(SessionRunner.resume(again, path), again, glitch_at=None)
    assert not of(events, DwellDone)
    (note,) = read_session(path).notes
    assert note.startswith("dwell 1 (90°")


def test_a_faulty_dwell_of_an_earlier_run_is_taken_again_by_repeat(sensor, path):
    visit(SessionRunner.begin(sensor, path, plan(), SETTINGS), sensor, stop=GuardRaised)
    with open_sensor(URL) as again:
        runner, events = SessionRunner.resume(again, path), []
        for event in runner.run(so_far=False):
            events.append(event)
            if isinstance(event, ExtensionOffered):
                runner.answer("decline" if of(events, DwellDone) else "repeat")
    assert [(done.place, done.alarms) for done in of(events, DwellDone)] == [(1, 0)]
    assert read_session(path).notes == ()


def test_an_automatic_session_keeps_the_dwell_and_says_so(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), SETTINGS, auto=True)
    events = visit_auto(runner, sensor)
    assert len(of(events, DwellDone)) == 2
    assert events[-1].complete
    assert len(read_session(path).notes) == 1


def visit_auto(runner: SessionRunner, sensor: Adis16354) -> list[Event]:
    glitches = Glitches(sensor.bus.world)
    events = []
    for event in runner.run(so_far=False):
        if isinstance(event, DwellProgress) and event.place == 1 and not glitches.begin_s:
            glitches.begin_s.append(sensor.bus.now_s() + 0.1)
        events.append(event)
    return events


def test_a_fault_outside_the_dwell_is_not_charged_to_it(sensor, path):
    glitches = Glitches(sensor.bus.world)
    runner = SessionRunner.begin(sensor, path, plan(), SETTINGS)
    events = []
    for event in runner.run(so_far=False):
        if isinstance(event, StageMoved):
            glitches.begin_s.append(sensor.bus.now_s())
        events.append(event)
        answer(runner, event)
    assert not of(events, Problem)
    with ArchiveView(path) as view:
        before = [block for attempt in view.dwells() for block in view.blocks(attempt, "before")]
    assert any(block.alarm.any() for block in before)


def test_alarms_are_counted_in_runs_with_their_times():
    words = np.full((10, 3), ND, np.uint16)
    words[[2, 3, 7], 1] |= EA  # in one register alone: EA rose while the scan ran
    scans = ScanBlock(ACCEL_OUT, words, 5.0 + 0.01 * np.arange(10))
    found = find_alarms(scans)
    assert (found.scans, found.times) == (3, 2)
    assert found.first_s == pytest.approx(0.02)
    assert found.longest_s == pytest.approx(0.02)
    words[9] |= EA  # up to the very end
    assert find_alarms(scans).times == 3
    words[:] = ND
    assert find_alarms(scans) is None
