"""What the screen tells of a session of gyro turns, from the events of one that the program turns."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

pytest.importorskip("textual", reason="the extra 'bench' is not installed")

from adis_gonio.bench import events
from adis_gonio.bench.gyro_turns import gyro_turns_plan
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.faces.tui import screen_text
from adis_gonio.faces.tui.bench_state import BenchState, Mark
from adis_gonio.record.source import Settings
from faces.tui.screens import shown
from faces.tui.states import LAID, NOT_WHOLE, look, turning

SETTINGS = Settings(dwell_s=0.5, settle_s=0.1)


def test_a_turn_is_followed_from_the_mark_back_to_it(tmp_path):
    made = gyro_turns_plan(1)
    made = replace(made, positions=made.positions[:2])
    state, seen = BenchState(), []
    with open_sensor("sim:?seed=11&hand_moves=1&move_speed_dps=80&gyro_scale_x=1.01") as sensor:
        runner = SessionRunner.begin(sensor, tmp_path / "one.session", made, SETTINGS, auto=True)
        assert not runner.one_recording
        for event in runner.run():
            state.take(event)
            if isinstance(event, events.TurnProgress):
                seen.append(
                    (
                        event.state,
                        state.angle_deg,
                        screen_text.target(state),
                        screen_text.stillness(state, 40),
                    )
                )
                assert screen_text.task(state).startswith("1 turn counter-clockwise: ")
                assert state.lost == 0
    assert [name for k, (name, *_) in enumerate(seen) if not k or name != seen[k - 1][0]] == [
        "rest",
        "turn",
        "after",
    ]
    angles = [angle for _, angle, *_ in seen]
    assert angles[0] == pytest.approx(0, abs=1)
    assert angles[-1] == pytest.approx(360 * 1.01, abs=3)
    assert re.fullmatch(r"asked \+360°   \+1\.0\d turns so far   −[1-7]° to go", seen[-1][2])
    fastest = float(re.search(r"largest (\d+) of 300", seen[-1][3])[1])
    assert 80 <= fastest < 300
    assert state.turned.turned_deg == angles[-1]
    assert [state.mark(place) for place in range(2)] == [Mark.DONE, Mark.DONE]
    assert dict(screen_text.facts(state))["last turn"].startswith("gyro +36")


def test_a_rate_beyond_the_range_is_told_while_it_is_turned():
    state = BenchState()
    for event in [*LAID, turning("turn", 100.0, 90.0, peak=299.9)]:
        state.take(event)
    assert not screen_text.too_fast(state)
    assert "TOO FAST" not in screen_text.stillness(state, 60)
    state.take(turning("turn", 200.0, 90.0, peak=300.0))
    assert screen_text.stillness(state, 60).startswith("TOO FAST")


@pytest.mark.parametrize(
    ("key", "told"), [("enter", ["confirm"]), ("r", ["repeat"]), ("s", ["skip"]), ("u", ["undo"])]
)
def test_keys_answer_a_turn_that_is_asked_for_as_a_position(key, told):
    assert shown([*LAID, look(angle=None, target=None)], keys=["x", key])[2].told == told


@pytest.mark.parametrize(("key", "told"), [("enter", "retake"), ("k", "keep"), ("s", "skip")])
def test_a_guard_of_a_turn_is_answered_in_its_own_words(key, told):
    script = [*LAID, turning("after", 1653.0, 0.3, 5, 1.0), NOT_WHOLE]
    assert shown(script, keys=["x", key])[2].told == [told]


def test_within_a_turn_nothing_is_answered():
    text, _, runner = shown([*LAID, turning("turn", 827.4, 93.2, 3)], keys=["x", "enter"])
    assert runner.told == []
    assert "no position is asked for now" in text
