"""Instructions for the operator and plans of turns: how far, which way, which arrow, how fast."""

from __future__ import annotations

import json

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.bench.guidance import PLANE, drawing, to_do, turn_to_do
from adis_gonio.bench.gyro_turns import gyro_turns_plan
from adis_gonio.record.plans import Plan, Position, plan
from adis_gonio.sim import World, WorldSettings

# -- drawings ---------------------------------------------------------------------------------------------


def test_the_drawing_agrees_with_the_simulated_part():
    world = World(WorldSettings(alpha_deg=0.0, fixture_sigma_deg=0.0), seed=1)
    start = world.stage.at(np.array([0.0])).direction[0]
    end_s = world.stage.move_to(1.0, 90.0)
    turned = world.stage.at(np.array([end_s + 1.0])).direction[0]
    # The words for the start are on the left, the words for +90° on the right.
    left, right = (" ".join(line[part].strip() for line in PLANE) for part in (slice(47), slice(47, None)))
    assert "X arrow down (reads +1 g), Y level (0)" in left
    assert start == pytest.approx([1, 0, 0], abs=1e-9)
    assert "X level (0), Y arrow up (reads -1 g)" in right
    assert turned == pytest.approx([0, -1, 0], abs=1e-9)


def test_plans_of_attitudes_have_a_drawing_of_their_own_and_terminals_can_show_both():
    assert drawing(plan("poses")) != drawing(plan())
    assert all(line.replace("°", "").isascii() for line in (*drawing(plan("poses")), *drawing(plan())))


# -- positions --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "to", "reverse", "said"),
    [
        (None, Position(0.0), False, "turn the part to 0°"),
        (Position(None, 0), Position(30.0), False, "turn the part to 30°"),
        (Position(0.0), Position(90.0), False, "turn the part +90° (counter-clockwise) to 90°"),
        (Position(90.0), Position(30.0), False, "turn the part −60° (clockwise) to 30°"),
        (Position(0.0), Position(90.0), True, "turn the part +90° (clockwise) to 90°"),
        (Position(90.0), Position(90.0), False, "leave the part at 90°"),
        (Position(90.0), Position(90.0, -1), False, "turn the part past it and back to 90° from above"),
    ],
)
def test_a_turn_in_the_plane_says_by_how_much_and_which_way(before, to, reverse, said):
    assert to_do(to, before, reverse=reverse) == said


@pytest.mark.parametrize(
    ("direction", "arrows"),
    [
        ((0.0, 0.0, -1.0), "Z arrow up,"),
        ((1.0, 0.0, 0.0), "X arrow down,"),
        ((0.0, 0.28, -0.96), "Z arrow up (16° off),"),
        ((0.0, 0.1, -0.995), "Z arrow up,"),  # 6° are near enough
        ((0.6, 0.0, -0.8), "X arrow down (53° off), Z arrow up (37° off),"),
    ],
)
def test_an_attitude_is_told_by_its_arrows_and_their_tilt(direction, arrows):
    assert (
        to_do(Position(None, 0, direction=direction))
        == f"hold the part with its {arrows} still, near enough"
    )
    check = to_do(Position(None, 0, "check", direction))
    assert check.endswith("near enough (check)")
    laid = to_do(Position(None, 0, direction=direction), table=True)
    assert laid == f"lay the part flat on the table, against the mark, with its {arrows[:-1]}"


def test_an_attitude_without_a_direction_is_any_new_one():
    assert to_do(Position(None, 0)) == "hold the part in a new attitude"


# -- turns ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("turned_deg", "options", "said"),
    [
        (
            -1800.0,
            {"fastest_dps": 90.0},
            ["5 times clockwise, seen from above", "90 °/s at most (4 s a turn"],
        ),
        (360.0, {}, ["turn it once counter-clockwise", "180 °/s at most (2 s a turn"]),
    ],
)
def test_a_turn_on_the_table_says_which_way_how_often_how_fast_and_when_to_stop(turned_deg, options, said):
    text = to_do(Position(None, 0, turned_deg=turned_deg), **options)
    for words in (*said, "back to the mark", "let it rest"):
        assert words in text


def test_the_prompt_of_a_free_turn_asks_for_the_turns_of_the_plan():
    assert "2 times all around" in turn_to_do(2)
    assert "forth and back" in turn_to_do(2)
    assert "once all around" in turn_to_do(1)


def test_the_plan_turns_each_arrow_up_both_ways_and_rests_it_down():
    made = gyro_turns_plan(5)
    turned = [position.turned_deg for position in made.positions]
    assert turned == [None, 1800.0, -1800.0, None] * 3
    faces = [position.direction for position in made.positions if position.turned_deg is None]
    assert len(set(faces)) == 6
    assert np.sum(faces, axis=0) == pytest.approx([0, 0, 0])
    assert Plan.from_dict(json.loads(json.dumps(made.as_dict()))) == made
    assert len(gyro_turns_plan(5, 3)) == 9
    assert len(gyro_turns_plan(20)) == 12
    assert str(gyro_turns_plan(1).positions[1]) == "1 turn counter-clockwise"


@pytest.mark.parametrize(
    ("turns", "faces", "message"),
    [
        (0, 6, "take 1 to 20 each way"),
        (-1, 6, "take 1 to 20 each way"),
        (21, 6, "take 1 to 20 each way"),
        (5, 4, "take 6"),
    ],
)
def test_plans_that_cannot_be_are_refused(turns, faces, message):
    with pytest.raises(UsageError, match=message):
        gyro_turns_plan(turns, faces)
