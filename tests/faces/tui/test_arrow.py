"""The arrow of the screen against the true stage, event by event, in sessions taken by hand."""

import itertools
from dataclasses import replace

import pytest

from adis_gonio.bench.events import Paused, PositionAsked
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import Adis16354
from adis_gonio.faces.tui import screen_text
from adis_gonio.faces.tui.bench_state import BenchState
from adis_gonio.record.plans import Position, plan
from bench.hand_bench import QUICK, Hand, HandBus

ARROWS = {"▶▶": 1, "◀◀": -1}
FOUR = plan("four-position")
BACK = replace(FOUR, positions=(*FOUR.positions, Position(0.0, -1, "fit"), Position(90.0, -1, "fit")))
"""From 270° the whole way back to 0°, and on to 90° from above."""
PLANS = {"four-position": FOUR, "back": BACK, "tumble": plan("tumble", 6)}


def arrow(text: str) -> int:
    """Return the direction that a line of the screen asks for: 1, -1, or 0 without an arrow."""
    return next((way for sign, way in ARROWS.items() if sign in text), 0)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("name", PLANS)
def test_the_arrow_follows_the_way_asked_and_is_silent_at_its_end_and_while_recording(name, seed, tmp_path):
    sensor = Adis16354(HandBus(f"sim:?seed={seed}"))
    runner = SessionRunner.begin(sensor, tmp_path / "a.session", PLANS[name], QUICK, fixture_sigma_deg=0.02)
    hand, state = Hand(sensor), BenchState()
    seen = {"recording": 0, "arrived": 0, "under way": 0, "silent": 0}
    tolerances = []
    for event in runner.run(so_far=False):
        before = state.here
        state.take(event)
        line, task = screen_text.target(state), screen_text.task(state)
        asked, now_s = state.position, sensor.bus.now_s()
        if "recording" in task:
            seen["recording"] += 1
            assert not arrow(line)
        elif asked is not None and before is not None and hasattr(event, "tolerance_deg"):
            way = (asked.angle_deg > before.angle_deg) - (asked.angle_deg < before.angle_deg)
            if now_s > hand.stage.still_at_s + 0.3 and hand.stage.angle_deg == asked.angle_deg:
                seen["arrived"] += 1
                assert not arrow(line), (task, line)
                tolerances.append(event.tolerance_deg)
            elif abs(state.more_deg) > 10:
                seen["under way"] += 1
                assert arrow(line) == way, (task, line)
            else:
                seen["silent"] += not arrow(line)
        hand.see(runner, event)
    assert not hand.guards
    assert seen["recording"] > len(PLANS[name])
    assert seen["arrived"] >= len(PLANS[name]) // 2
    assert seen["under way"] >= len({p.angle_deg for p in PLANS[name].positions}) - 1
    assert tolerances[-1] < tolerances[0] / 2, "dwells teach what the part does"


def test_a_turn_of_more_than_half_a_circle_is_counted_on_the_way_asked(tmp_path):
    sensor = Adis16354(HandBus("sim:?seed=1"))
    runner = SessionRunner.begin(sensor, tmp_path / "a.session", BACK, QUICK, fixture_sigma_deg=0.02)
    hand, state, remaining = Hand(sensor), BenchState(), []
    for event in runner.run(so_far=False):
        state.take(event)
        if state.place == 4 and state.more_deg is not None:
            remaining.append(state.more_deg)
        if isinstance(event, PositionAsked) and event.place == 4:
            assert "−270°" in screen_text.task(state).replace("-", "−")
        hand.see(runner, event)
    assert min(remaining) < -250
    assert abs(remaining[-1]) < 1
    steps = [after - before for before, after in itertools.pairwise(remaining)]
    assert max(map(abs, steps)) < 90, "no jump by a turn"


def test_past_it_and_back_is_not_called_there(tmp_path):
    sensor = Adis16354(HandBus("sim:?seed=2"))
    turned = plan("tumble", 4)
    runner = SessionRunner.begin(sensor, tmp_path / "a.session", turned, QUICK, fixture_sigma_deg=0.02)
    hand, state, said = Hand(sensor), BenchState(), []
    for event in runner.run(so_far=False):
        state.take(event)
        if state.question is not None and "past it and back" in screen_text.task(state):
            said.append(screen_text.target(state))
        hand.see(runner, event)
    assert said
    assert not any("there" in line or arrow(line) for line in said)


@pytest.mark.parametrize("ends_at", [0.0, 200.0])
def test_a_turn_during_a_pause_is_not_counted_and_not_guessed(ends_at, tmp_path):
    """Nobody watches a pause: from 270° to 0° the part may have turned by −270° or by +90°."""
    sensor = Adis16354(HandBus("sim:?seed=1"))
    runner = SessionRunner.begin(sensor, tmp_path / "a.session", BACK, QUICK, fixture_sigma_deg=0.02)
    hand, state, said = Hand(sensor), BenchState(), []
    paused = False
    for event in runner.run(so_far=False):
        state.take(event)
        if state.place == 4 and paused and state.question is not None and state.tolerance_deg is not None:
            said.append(screen_text.target(state))
        if isinstance(event, Paused):
            hand.turn(ends_at)
            sensor.bus.sleep_s(30)
            runner.unpause()
        elif isinstance(event, PositionAsked) and event.place == 4 and not paused:
            paused = True
            runner.pause()
        elif len(said) == 3:
            runner.stop()
        else:
            hand.see(runner, event)
    assert said
    assert not any(arrow(line) for line in said), said
    assert all(("by the scale" in line) == (ends_at == 0.0) for line in said)
