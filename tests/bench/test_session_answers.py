"""Undo, notes, pause, kept doubts: what an operator says, when it counts, and that nothing is lost."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.bench.dialogue import Reply
from adis_gonio.bench.events import (
    DwellInterrupted,
    DwellProgress,
    Event,
    ExtensionOffered,
    Finished,
    Noted,
    Paused,
    PositionAsked,
    Problem,
    Running,
    Unpaused,
    Watching,
    Withdrawn,
)
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.plans import plan
from adis_gonio.record.session_reader import read_session
from adis_gonio.record.source import Settings
from bench.hand_bench import QUICK

URL = "sim:?seed=3"


@pytest.fixture
def sensor():
    with open_sensor(URL) as opened:
        yield opened


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.session"


def run(runner, answer) -> list[Event]:
    """All events of a session; `answer` gets each, positions are confirmed where it does nothing."""
    events = []
    for event in runner.run(so_far=False):
        events.append(event)
        if not answer(event) and isinstance(event, PositionAsked):
            runner.answer("confirm")
        if isinstance(event, ExtensionOffered):
            runner.answer("decline")
    return events


def of(events, kind):
    return [event for event in events if isinstance(event, kind)]


def test_undo_withdraws_dwell_after_dwell_and_asks_their_positions_again(sensor, path):
    runner, undone = SessionRunner.begin(sensor, path, plan("four-position"), QUICK), []

    def answer(event):
        if isinstance(event, PositionAsked) and event.place == 3 - len(undone) and len(undone) < 2:
            assert event.can_undo
            undone.append(event.place)
            runner.answer("undo")
            return True
        return False

    events = run(runner, answer)
    assert [event.place for event in of(events, PositionAsked)] == [0, 1, 2, 3, 2, 1, 2, 3]
    assert [event.place for event in of(events, Withdrawn)] == [2, 1]
    assert [dwell.angle_deg for dwell in read_session(path).dwells] == [0.0, 90.0, 180.0, 270.0]
    with ArchiveView(path) as view:
        assert len([attempt for attempt in view.attempts() if attempt.outcome == "complete"]) == 6
        assert view.withdrawn() == {2, 3}


def test_a_withdrawn_dwell_stays_withdrawn_over_a_break_and_a_simulation_goes_on_to_the_bit(path, tmp_path):
    with open_sensor(URL) as sensor:
        runner = SessionRunner.begin(sensor, path, plan("four-position"), QUICK)

        def answer(event):
            if isinstance(event, PositionAsked) and event.place == 2:
                runner.answer("undo")
                runner.stop()
                return True
            return False

        run(runner, answer)
    with ArchiveView(path) as view:
        stopped_before_it_was_heard = not view.withdrawn()
    assert stopped_before_it_was_heard  # stop goes first: the dwell counts, and undo is asked for again
    with open_sensor(URL) as sensor:
        runner = SessionRunner.resume(sensor, path)
        undone = []

        def undo(event):
            if isinstance(event, PositionAsked) and not undone:
                undone.append(event.place)
                runner.answer("undo")
                return True
            if isinstance(event, Withdrawn):
                runner.stop()
            return False

        run(runner, undo)
    with ArchiveView(path) as view:
        assert view.pending() == [1, 2, 3]
    with open_sensor(URL) as sensor:
        run(SessionRunner.resume(sensor, path, auto=True), lambda event: True)
    whole = tmp_path / "whole.session"
    with open_sensor(URL) as sensor:
        run(SessionRunner.begin(sensor, whole, plan("four-position"), QUICK, auto=True), lambda event: True)
    for mine, other in zip(read_session(path).dwells, read_session(whole).dwells, strict=True):
        assert np.array_equal(mine.accel, other.accel)


def test_nothing_can_be_undone_before_the_first_dwell(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), QUICK)
    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked):
            assert not event.can_undo
            with pytest.raises(UsageError, match="open question"):
                runner.answer("undo")
            runner.stop()


def test_a_note_from_any_thread_at_any_time_is_archived_with_time_and_place(sensor, path):
    runner, said = SessionRunner.begin(sensor, path, plan(), QUICK), []

    def answer(event):
        if isinstance(event, DwellProgress) and event.place == 1 and not said:
            said.append(True)
            thread = threading.Thread(target=runner.note, args=(" the lamp came on ",))
            thread.start()
            thread.join(60)
        return False

    events = run(runner, answer)
    assert [event.text for event in of(events, Noted)] == ["the lamp came on"]
    (remark,) = read_session(path).facts["remarks"]
    assert (remark["text"], remark["place"]) == ("the lamp came on", 1)
    assert remark["utc"]


def test_a_note_at_the_very_end_is_kept(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), QUICK)

    def answer(event):
        if isinstance(event, ExtensionOffered):
            runner.note("last words")
        return False

    run(runner, answer)
    assert read_session(path).facts["remarks"][0]["text"] == "last words"


def test_a_pause_within_a_dwell_keeps_its_samples_and_asks_the_position_again(sensor, path):
    runner, paused = SessionRunner.begin(sensor, path, plan(), Settings(dwell_s=2.0, settle_s=0.1)), []

    def answer(event):
        if isinstance(event, DwellProgress) and event.place == 1 and not paused:
            paused.append(True)
            runner.pause()
        if isinstance(event, Paused):
            with pytest.raises(UsageError):
                runner.answer("confirm")
            threading.Timer(0.2, runner.unpause).start()
        return False

    events = run(runner, answer)
    (broken,) = of(events, DwellInterrupted)
    assert broken.reason == "paused by the operator"
    assert broken.samples > 0
    names = [type(event) for event in events if isinstance(event, Paused | Unpaused | PositionAsked)]
    assert names == [PositionAsked, PositionAsked, Paused, Unpaused, PositionAsked]
    assert len(read_session(path).dwells) == 2


def test_a_pause_at_a_question_puts_it_again_and_a_stop_ends_a_pause(sensor, path):
    runner, asked = SessionRunner.begin(sensor, path, plan(), QUICK), []

    def answer(event):
        if isinstance(event, PositionAsked):
            asked.append(event.place)
            if len(asked) in (1, 3):
                runner.pause()
                return True
        if isinstance(event, Paused):
            (runner.unpause if len(asked) == 1 else runner.stop)()
        return False

    events = run(runner, answer)
    assert asked == [0, 0, 1]
    assert isinstance(events[-1], Finished)
    assert not events[-1].complete


def test_time_left_shrinks_from_position_to_position(sensor, path):
    events = run(SessionRunner.begin(sensor, path, plan("four-position"), QUICK), lambda event: False)
    left = [event.time_left_s for event in of(events, PositionAsked)]
    assert left[0] >= 4 * QUICK.dwell_s  # a guess: nothing was timed yet
    assert left == sorted(left, reverse=True)
    assert left[-1] > 0


def test_an_operator_who_goes_away_for_an_hour_finds_the_question_still_standing(sensor, path):
    runner, away = SessionRunner.begin(sensor, path, plan(), QUICK), []

    def answer(event):
        if isinstance(event, PositionAsked) and not away:
            away.append(sensor.bus.now_s())
            return True
        if isinstance(event, Watching) and len(away) == 1:
            away.append(sensor.bus.sleep_s(3600.0))
            runner.answer("confirm")
        return False

    events = run(runner, answer)
    assert events[-1].complete
    assert sensor.bus.now_s() - away[0] > 3600


def test_a_part_that_is_not_laid_down_at_the_start_is_waited_for(path):
    with open_sensor(URL) as sensor:
        world = sensor.bus.world
        sample = world.sample

        def held(time_s):
            inputs = sample(time_s)
            shake = 200 * np.sin(2 * np.pi * 3 * time_s) * (time_s < 20)
            object.__setattr__(inputs, "accel_mg", inputs.accel_mg + shake[:, None])
            return inputs

        world.sample = held
        settings = Settings(dwell_s=0.5, settle_s=0.1, still_timeout_s=3.0)
        events = run(SessionRunner.begin(sensor, path, plan(), settings), lambda event: False)
    assert next(problem.kind for problem in of(events, Problem)) == "stillness"
    assert events[-1].complete


def test_an_unknown_answer_is_a_typed_error(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), QUICK)
    with pytest.raises(UsageError, match="possible: nothing"):
        runner.answer(Reply.KEEP)


def test_nonsense_is_a_usage_error_that_names_what_is_open_and_the_question_stands(sensor, path):
    runner, refused = SessionRunner.begin(sensor, path, plan(), QUICK), []

    def answer(event):
        if isinstance(event, PositionAsked) and not refused:
            with pytest.raises(UsageError, match=r"'xyzzy' .*open question .*confirm") as error:
                runner.answer("xyzzy")
            refused.append(error)
        return False

    assert run(runner, answer)[-1].complete
    assert refused


def test_what_is_shown_while_a_session_runs_costs_no_comparison_of_methods(sensor, path, monkeypatch):
    """Each dwell left out once, for each method, belongs to the end: it would grow with the square."""
    from adis_gonio.fitting import answer

    monkeypatch.setattr(answer, "compare_methods", lambda session: pytest.fail("methods were compared"))
    running = of(list(SessionRunner.begin(sensor, path, plan("mmpm"), QUICK, auto=True).run()), Running)
    assert running[-1].dwells == 9
    assert {"value", "u", "unit"} <= set(running[-1].parameters["delta_phi"])
