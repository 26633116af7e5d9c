"""Guards on a bench that is turned by hand: each wrong move is told at once, with numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.bench.events import (
    DwellDone,
    DwellInterrupted,
    DwellProgress,
    Finished,
    GuardRaised,
    PositionAsked,
    Problem,
    Running,
    TurnMeasured,
    Watching,
    Withdrawn,
)
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.fitting import fit
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.plans import plan
from adis_gonio.record.session_reader import read_session
from adis_gonio.record.source import Settings
from bench.hand_bench import QUICK, Hand, by_hand, hand_sensor


@pytest.fixture
def sensor():
    with hand_sensor() as opened:
        yield opened


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.session"


def of(events, kind):
    return [event for event in events if isinstance(event, kind)]


def truth_of(sensor):
    return sensor.bus.inner.world.truth()


def right(sensor, path):
    """The result is the truth within its uncertainty (5 u: one seed, no statistics)."""
    result, truth = fit(read_session(path)), truth_of(sensor)
    for name in result.parameters.keys() & {"delta_k", "delta_phi"}:
        assert abs(result[name].value - truth[name]) < 5 * result[name].u
    return True


# -- a careful operator ----------------------------------------------------------------------------------


def test_a_careful_operator_is_asked_nothing_and_both_gravity_and_gyro_tell_the_turn(sensor, path):
    events, hand = by_hand(sensor, path, so_far=True)
    assert not hand.guards
    turns = of(events, TurnMeasured)
    assert [turn.asked_deg for turn in turns] == [90.0, 90.0, 90.0]
    for turn in turns:
        assert abs(turn.gravity_deg - 90.0) < 5
        assert abs(turn.gyro_deg - 90.0) < 4 * turn.gyro_u_deg
    running = of(events, Running)
    assert running[-1].dwells == 4
    final = fit(read_session(path)).as_dict()["parameters"]["delta_phi"]
    assert running[-1].parameters["delta_phi"] == final
    assert right(sensor, path)


def test_the_live_angle_follows_the_stage_and_comes_to_the_target(sensor, path):
    events, _ = by_hand(sensor, path)
    for event in of(events, DwellProgress):
        assert event.newest.target_deg is not None
        assert abs(event.newest.angle_deg - event.newest.target_deg) < 6
        assert event.newest.temperature_c is not None
    moving = [event.angle_deg for event in of(events, Watching) if event.target_deg == 90.0]
    assert moving[0] < 10
    assert moving[-1] > 80


# -- wrong moves -----------------------------------------------------------------------------------------


def test_nothing_moved_is_told_with_numbers_and_the_position_is_asked_again(sensor, path):
    forgets = lambda event, times: None if times == 0 and event.place == 1 else event.position.angle_deg  # noqa: E731
    events, hand = by_hand(sensor, path, angle=forgets)
    (guard,) = hand.guards
    assert (guard.kind, guard.place, guard.default) == ("not_moved", 1, "retake")
    assert abs(guard.values["gravity_deg"]) < 0.1
    assert guard.values["asked_deg"] == 90.0
    assert abs(guard.values["gyro_deg"]) < 4 * guard.values["gyro_u_deg"]
    assert [event.place for event in of(events, PositionAsked)] == [0, 1, 1, 2, 3]
    assert events[-1].complete
    assert right(sensor, path)


def test_never_turning_asks_at_every_position_and_what_is_kept_is_named_as_impossible(sensor, path):
    _, hand = by_hand(sensor, path, angle=lambda event, times: 0.0, answer=lambda event, times: "keep")
    assert [guard.place for guard in hand.guards] == [1, 2, 3]
    session = read_session(path)
    assert [doubt["kind"] for doubt in session.facts["doubts"]] == ["not_moved"] * 3
    assert sum("was kept: the part has not moved" in note for note in session.notes) == 3


def test_a_position_that_contradicts_the_first_dwell_and_is_skipped_leaves_a_doubt(sensor, path):
    """The part was not moved for the second position: skipping hides nothing."""
    forgets = lambda event, times: 0.0 if event.place == 1 else event.position.angle_deg  # noqa: E731
    _, hand = by_hand(sensor, path, angle=forgets, answer=lambda event, times: "skip")
    assert [guard.place for guard in hand.guards] == [1]
    session = read_session(path)
    (doubt,) = session.facts["doubts"]
    assert (doubt["attempt"], doubt["place"], doubt["kind"]) == (None, 1, "not_moved")
    assert any("90° contradicted dwells before it and was skipped" in note for note in session.notes)


def test_a_contradiction_is_settled_by_taking_the_first_dwell_again(sensor, path):
    """The first dwell was made at 90°; the second position is skipped, then the first is repeated."""
    wrong_first = lambda event, times: 90.0 if event.place == 0 and times == 0 else event.position.angle_deg  # noqa: E731
    runner = SessionRunner.begin(sensor, path, plan("four-position"), QUICK, fixture_sigma_deg=0.02)
    hand, undone = Hand(sensor, wrong_first, lambda event, times: "skip"), False
    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked) and hand.guards and not undone:
            undone = True
            runner.answer("undo")
        else:
            hand.see(runner, event)
    assert [guard.place for guard in hand.guards] == [1]
    assert not read_session(path).facts["doubts"]
    assert right(sensor, path)


def test_a_stage_that_counts_the_other_way_is_taken_as_reversed_and_the_result_is_right(sensor, path):
    backwards = lambda event, times: -event.position.angle_deg  # noqa: E731
    _, hand = by_hand(sensor, path, angle=backwards, answer=lambda event, times: "reverse")
    (guard,) = hand.guards
    assert (guard.kind, guard.place) == ("reversed", 1)
    assert guard.answers[0] == guard.default == "retake"
    assert abs(guard.values["gravity_deg"] + 90) < 5
    assert abs(guard.values["gyro_deg"] + 90) < 4 * guard.values["gyro_u_deg"]
    session = read_session(path)
    assert [dwell.angle_deg for dwell in session.dwells] == [0.0, -90.0, -180.0, -270.0]
    assert {dwell.approach for dwell in session.dwells} == {-1}
    assert session.facts["reversed"] is True
    assert "other way" in session.notes[0]
    assert not session.facts["doubts"]
    assert right(sensor, path)


def test_reversed_is_kept_over_a_break_and_not_asked_again(path):
    backwards = lambda event, times: -event.position.angle_deg  # noqa: E731
    with hand_sensor() as sensor:
        runner = SessionRunner.begin(sensor, path, plan("four-position"), QUICK, fixture_sigma_deg=0.02)
        hand = Hand(sensor, backwards, lambda event, times: "reverse")
        for event in runner.run(so_far=False):
            hand.see(runner, event)
            if isinstance(event, PositionAsked) and event.place == 2:
                runner.stop()
    with hand_sensor() as sensor:
        hand = Hand(sensor, backwards)
        runner = SessionRunner.resume(sensor, path)
        for event in runner.run(so_far=False):
            hand.see(runner, event)
        assert not hand.guards
        assert event.complete
        assert right(sensor, path)


def test_one_wrong_turn_late_in_the_session_does_not_offer_to_reverse_all_of_it(sensor, path):
    wrong = lambda event, times: 0.0 if event.place == 2 and times == 0 else event.position.angle_deg  # noqa: E731
    _, hand = by_hand(sensor, path, angle=wrong)
    (guard,) = hand.guards
    assert (guard.kind, guard.place) == ("reversed", 2)
    assert "reverse" not in guard.answers
    assert right(sensor, path)


@pytest.mark.parametrize("off", [-25.0, 5.0, 45.0])
def test_an_angle_off_by_more_than_part_and_fixture_explain_is_told(sensor, path, off):
    def clumsy(event, times):
        return event.position.angle_deg + (off if event.place == 2 and times == 0 else 0.0)

    _, hand = by_hand(sensor, path, angle=clumsy)
    (guard,) = hand.guards
    assert (guard.kind, guard.place) == ("wrong_angle", 2)
    assert abs(guard.values["off_deg"] - off) < guard.values["limit_deg"] < abs(off)
    assert right(sensor, path)


def test_what_a_session_has_shown_of_the_part_narrows_what_is_allowed(sensor, path):
    wrong = lambda event, times: event.position.angle_deg + (45.0 if times == 0 and event.place else 0.0)  # noqa: E731
    _, hand = by_hand(sensor, path, "mmpm", angle=wrong)
    limits = [guard.values["limit_deg"] for guard in hand.guards]
    assert len(limits) == 8
    assert limits[-1] < limits[0] / 2


def test_two_swapped_positions_are_told_at_the_first_of_them(sensor, path):
    def swapped(event, times):
        wrong = {1: 270.0, 3: 90.0} if times == 0 else {}
        return wrong.get(event.place, event.position.angle_deg)

    _, hand = by_hand(sensor, path, angle=swapped)
    assert [guard.place for guard in hand.guards] == [1, 3]
    assert right(sensor, path)


def test_a_part_that_lies_flat_is_told_by_the_sign_of_z(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), QUICK, fixture_sigma_deg=0.02)
    raised = None
    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked):
            sensor.bus.inner.stage.orient([0.0, 0.0, -1.0])
            runner.answer("confirm")
        if isinstance(event, GuardRaised):
            raised = event
            runner.stop()
    assert raised.kind == "wrong_axis"
    assert raised.message.startswith("z reads −")
    assert "the Z arrow points up" in raised.message
    assert raised.values["tilt_deg"] > 80


def test_a_turn_about_another_axis_is_named_by_the_gyros(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), QUICK, fixture_sigma_deg=0.02)
    hand, raised = Hand(sensor), []
    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked) and event.place == 1:
            # X points down: turned about it, gravity sees nothing; the gyro of X does.
            world, sample, begin_s = (
                sensor.bus.inner.world,
                sensor.bus.inner.world.sample,
                sensor.bus.now_s(),
            )

            def about_x(time_s, sample=sample, begin_s=begin_s):
                inputs = sample(time_s)
                gyro = np.array(inputs.gyro_dps)
                gyro[(time_s > begin_s + 0.3) & (time_s < begin_s + 2.3), 0] += 45.0
                return replace(inputs, gyro_dps=gyro)

            world.sample = about_x
        elif isinstance(event, Watching) and raised == [] and len(read_done(path)) == 1:
            if event.state == "idle" and sensor.bus.now_s() > begin_s + 3:
                runner.answer("confirm")
        elif isinstance(event, GuardRaised):
            raised.append(event)
            runner.stop()
        else:
            hand.see(runner, event)
    (guard,) = raised
    assert guard.kind == "wrong_axis"
    assert "turned about x" in guard.message
    assert abs(guard.values["gyro_x_deg"] - 90) < 4 * guard.values["gyro_u_deg"]


def read_done(path):
    with ArchiveView(path) as view:
        return view.dwells()


def test_a_part_the_other_way_up_than_drawn_may_stay_because_any_start_angle_serves(path):
    with hand_sensor("sim:?seed=3&alpha_deg=178") as sensor:
        _, hand = by_hand(sensor, path)
        (guard,) = hand.guards
        assert (guard.kind, guard.place, guard.default) == ("upside_down", 0, "keep")
        assert not read_session(path).facts["doubts"]
        assert right(sensor, path)


def test_a_first_dwell_at_a_wrong_place_can_be_undone_when_right_turns_look_wrong(sensor, path):
    """The first dwell was made at 90°: every right turn then looks wrong, until it is undone."""
    wrong_first = lambda event, times: 90.0 if event.place == 0 and times == 0 else event.position.angle_deg  # noqa: E731
    runner = SessionRunner.begin(sensor, path, plan("four-position"), QUICK, fixture_sigma_deg=0.02)
    hand, undone = Hand(sensor, wrong_first), False
    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked) and len(hand.guards) == 3 and not undone:
            undone = True
            runner.answer("undo")
        else:
            hand.see(runner, event)
    assert {guard.kind for guard in hand.guards} == {"not_moved"}
    assert event.complete
    assert not read_session(path).facts["doubts"]
    assert right(sensor, path)


def test_a_repeated_dwell_is_not_judged_by_the_one_that_it_replaces(sensor, path):
    """The first dwell was made at 5°; the operator sees it and repeats it at 0°."""

    def wrong_first(event, times):
        return 5.0 if event.place == 0 and times == 0 else event.position.angle_deg

    runner = SessionRunner.begin(sensor, path, plan("four-position"), QUICK, fixture_sigma_deg=0.02)
    hand, turned_s = Hand(sensor, wrong_first, lambda event, times: "keep"), None
    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked) and event.place == 1 and turned_s is None:
            hand.turn(0.0)
            turned_s = hand.stage.still_at_s
        elif turned_s is not None and isinstance(event, Watching) and event.state == "idle":
            if sensor.bus.now_s() > turned_s + 0.3:
                turned_s = math.inf
                runner.answer("repeat")
            elif turned_s == math.inf:
                hand.see(runner, event)
        else:
            hand.see(runner, event)
    assert not hand.guards
    assert right(sensor, path)


# -- within a dwell --------------------------------------------------------------------------------------


def test_a_part_that_slips_within_a_dwell_is_told_with_its_shift(sensor, path):
    runner = SessionRunner.begin(
        sensor, path, plan(), Settings(dwell_s=3.0, settle_s=0.1), fixture_sigma_deg=0.02
    )
    hand, slipped = Hand(sensor), False
    for event in runner.run(so_far=False):
        if isinstance(event, DwellProgress) and event.place == 1 and not slipped:
            slipped = True
            hand.turn(92.0)
        hand.see(runner, event)
    (guard,) = hand.guards
    assert (guard.kind, guard.place) == ("drift", 1)
    assert guard.values["shift_mg"] > 20


def test_a_bump_that_leaves_the_part_where_it_was_is_told_and_the_dwell_begins_anew(
    sensor, path, monkeypatch
):
    events, hand = bumped(sensor, path, times=1)
    assert not hand.guards
    assert len(of(events, DwellInterrupted)) == 1
    assert events[-1].complete


def test_a_table_that_never_stops_shaking_is_asked_about(sensor, path):
    events, hand = bumped(sensor, path, times=5)
    assert [guard.kind for guard in hand.guards] == ["shock"]
    assert events[-1].complete


def bumped(sensor, path, times):
    """Shake the part in the second position's dwells, so many times."""
    world = sensor.bus.inner.world
    sample, hits = world.sample, []

    def shaken(time_s):
        inputs = sample(time_s)
        accel = np.array(inputs.accel_mg)
        for begin_s in hits:
            now = (time_s > begin_s) & (time_s < begin_s + 0.1)
            accel[now, 0] += 300 * np.sin(2 * np.pi * 30 * time_s[now])
        return replace(inputs, accel_mg=accel)

    world.sample = shaken
    runner = SessionRunner.begin(
        sensor, path, plan(), Settings(dwell_s=1.0, settle_s=0.1), fixture_sigma_deg=0.02
    )
    hand, events, fresh = Hand(sensor), [], True
    for event in runner.run(so_far=False):
        events.append(event)
        if isinstance(event, DwellProgress) and event.place == 1 and fresh and len(hits) < times:
            hits.append(sensor.bus.now_s() + 0.05)
            fresh = False
        fresh = fresh or isinstance(event, DwellInterrupted)
        hand.see(runner, event)
    return events, hand


@pytest.mark.parametrize(("kind", "size"), [("temperature", 5.0), ("supply", 0.1)])
def test_a_step_of_temperature_or_supply_within_a_dwell_is_told(sensor, path, kind, size):
    world, steps = sensor.bus.inner.world, []
    sample = world.sample

    def stepped(time_s):
        inputs = sample(time_s)
        after = np.zeros(len(time_s), bool)
        for begin_s in steps:
            after |= time_s > begin_s
        if kind == "supply":
            return replace(inputs, supply_v=inputs.supply_v + size * after)
        return replace(inputs, temperature_c=inputs.temperature_c + size * after[:, None])

    world.sample = stepped
    runner = SessionRunner.begin(
        sensor, path, plan(), Settings(dwell_s=3.0, settle_s=0.1), fixture_sigma_deg=0.02
    )
    hand, events = Hand(sensor), []
    for event in runner.run(so_far=False):
        events.append(event)
        if isinstance(event, DwellProgress) and event.place == 1 and not steps:
            steps.append(sensor.bus.now_s() + 1.4)
        hand.see(runner, event)
    (guard,) = hand.guards
    assert (guard.kind, guard.place) == (kind, 1)
    assert guard.values["step_v" if kind == "supply" else "step_c"] == pytest.approx(size, rel=0.1)
    assert [event.place for event in of(events, Withdrawn)] == [1]
    assert events[-1].complete


def test_a_stuck_axis_is_asked_about_and_the_session_goes_on_once_it_lives(sensor, path):
    stuck = {"on": False}
    world = sensor.bus.inner.world
    sample = world.sample

    def frozen(time_s):
        inputs = sample(time_s)
        accel = np.array(inputs.accel_mg)
        if stuck["on"]:
            accel[:, 1] = 136.0
        return replace(inputs, accel_mg=accel)

    world.sample = frozen

    def answer(event, times):
        stuck["on"] &= event.kind != "stuck"  # the jump to the stuck value looks like a slip first
        return event.default

    runner = SessionRunner.begin(
        sensor, path, plan(), Settings(dwell_s=2.0, settle_s=0.1), fixture_sigma_deg=0.02
    )
    hand, once = Hand(sensor, answer=answer), False
    for event in runner.run(so_far=False):
        if isinstance(event, DwellProgress) and event.place == 0 and not once:
            once = stuck["on"] = True
        hand.see(runner, event)
    assert "stuck" in [guard.kind for guard in hand.guards]
    assert isinstance(event, Finished)
    assert event.complete


# -- poses -----------------------------------------------------------------------------------------------


def test_a_pose_that_is_not_new_and_one_the_other_way_up_are_told(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan("poses", 9), QUICK)
    kinds, asked = [], {}
    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked):
            times = asked[event.place] = asked.get(event.place, 0) + 1
            if event.place == 3 and times == 1:
                runner.answer("repeat")  # the same pose once more is not "not moved"
                continue
            wanted = np.array(event.position.direction)
            if event.place == 4 and times == 1:
                wanted = -wanted
            if not (event.place == 2 and times == 1):
                sensor.bus.inner.stage.orient(wanted)
            runner.answer("confirm")
        if isinstance(event, GuardRaised):
            kinds.append((event.place, event.kind))
            runner.answer("retake")
    assert kinds == [(2, "not_moved"), (4, "upside_down")]
    assert event.complete


# -- nobody there ----------------------------------------------------------------------------------------


def test_with_nobody_to_ask_a_guard_is_a_problem_and_the_session_goes_on(path):
    with open_sensor("sim:?seed=3") as sensor:
        stage = sensor.bus.stage
        sensor.bus.stage = Jammed(stage)
        runner = SessionRunner.begin(sensor, path, plan("four-position"), QUICK, auto=True)
        events = list(runner.run(so_far=False))
    assert not of(events, GuardRaised)
    assert [problem.kind for problem in of(events, Problem)] == ["not_moved"] * 3
    assert len(of(events, DwellDone)) == 4
    assert [doubt["kind"] for doubt in read_session(path).facts["doubts"]] == ["not_moved"] * 3


class Jammed:
    """A stage that does not move."""

    def __init__(self, stage):
        self._stage = stage

    def move_to(self, angle_deg, approach=1):
        self._stage.move_to(0.0, 0)
