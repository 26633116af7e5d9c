"""Turns on a table and by hand: when they end, and how a turn that was not whole is named."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.bench.gyro_turns import GyroTurn, judge_face, judge_whole_turn
from adis_gonio.bench.recorder import FreeTurn, free_turn_plan
from adis_gonio.record.blocks import ValueBlock
from adis_gonio.record.plans import Position

COLUMNS = ("ax", "ay", "az", "gx", "gy", "gz")
INTEGRAL = SimpleNamespace()
"""Stands for an integral that could be computed."""


def samples(begin_s: float, length_s: float, rates_dps=(0.0, 0.0, 0.0)) -> ValueBlock:
    """Return samples at 10 Hz of a level part with its Z arrow up, with gyros that read 1 °/s at rest."""
    count = round(10 * length_s)
    row = np.array([0.0, 0.0, -1000.0, *(np.array(rates_dps) + 1.0)])
    return ValueBlock(COLUMNS, np.tile(row, (count, 1)), begin_s + np.arange(1, count + 1) / 10)


def turned(*angles_deg: tuple[float, float, float], wanted_deg: float = 360.0) -> GyroTurn:
    """Return a turn by these angles about the sensor's axes, each in 10 s, from a rest that ends at 1 s."""
    turn = GyroTurn(0, Position(None, 0, turned_deg=wanted_deg), wanted_deg, samples(0.0, 1.0), ("", 0.0))
    turn.see(samples(0.9, 0.1))
    for k, angle_deg in enumerate(angles_deg):
        turn.see(samples(1.0 + 10 * k, 10.0, np.array(angle_deg) / 10.0))
    return turn


@pytest.mark.parametrize(
    ("angle_deg", "kind"),
    [
        # A gyro explains 3 % of the turn and 5°.
        (360.0, None),
        (376.0, None),
        (377.0, "wrong_angle"),
        (345.0, None),
        (344.0, "wrong_angle"),
        (720.0, None),
        (180.0, "wrong_angle"),
        (5.0, "wrong_angle"),
        (-360.0, "reversed"),
    ],
)
def test_a_turn_is_whole_if_its_gyro_explains_the_rest(angle_deg, kind):
    found = judge_whole_turn(turned((0.0, 0.0, angle_deg)), INTEGRAL)
    assert (found and found.kind) == kind
    if found:
        assert found.values["gyro_deg"] == pytest.approx(angle_deg)
        assert found.spoils == (kind != "reversed")


@pytest.mark.parametrize(
    ("angles_deg", "about"),
    [
        (((71.0, 0.0, 360.0),), None),  # at most a fifth of the turn
        (((73.0, 0.0, 360.0),), "x"),
        (((0.0, -73.0, 360.0),), "y"),
        (((60.0, -60.0, 0.0), (60.0, 0.0, 0.0)), "x"),
        (((11.0, 0.0, 0.0),), "x"),  # at least 10°
    ],
)
def test_a_turn_about_another_axis_than_the_vertical_is_named_by_that_axis(angles_deg, about):
    found = judge_whole_turn(turned(*angles_deg), INTEGRAL)
    if about is None:
        assert found is None
    else:
        assert found.kind == "wrong_axis"
        assert found.message.startswith(f"turned about {about}, not about the vertical")


def test_a_small_motion_is_no_turn_about_another_axis():
    assert judge_whole_turn(turned((9.0, 0.0, 0.0)), INTEGRAL).kind == "wrong_angle"


@pytest.mark.parametrize(
    ("angle_deg", "why", "kind"),
    [
        (360.0, "the rates reach the gyro's range", "over_range"),
        (360.0, "a gap of 2 s", "shock"),
        (0.0, "a gap of 2 s", "not_moved"),
        (19.0, "a gap of 2 s", "not_moved"),  # 1.9 °/s are below a turn by hand
        (21.0, "a gap of 2 s", "shock"),
    ],
)
def test_a_turn_without_an_integral_says_why(angle_deg, why, kind):
    found = judge_whole_turn(turned((0.0, 0.0, angle_deg)), why)
    assert (found.kind, found.spoils) == (kind, True)
    assert found.message.startswith(why)


@pytest.mark.parametrize(
    ("angle_deg", "rest_s", "ended"),
    [
        (331.0, 0.9, None),
        (331.0, 1.0, ""),
        (-331.0, 1.0, ""),
        (329.0, 5.9, None),
        (329.0, 6.0, ""),
        (0.0, 100.0, None),
    ],
)
def test_a_turn_ends_after_a_rest_that_is_longer_before_it_is_whole(angle_deg, rest_s, ended):
    turn = turned((0.0, 0.0, angle_deg))
    turn.see(samples(11.0, rest_s))
    assert turn.ended == ended


def test_a_rest_goes_on_over_blocks_and_begins_again_after_a_motion():
    turn = turned((0.0, 0.0, 360.0))
    for begin_s, rate_dps, ended in (
        (11.0, 0.0, None),
        (11.5, 5.0, None),
        (12.0, 0.0, None),
        (12.5, 0.0, ""),
    ):
        turn.see(samples(begin_s, 0.5, (0.0, 0.0, rate_dps)))
        assert turn.rate_dps == pytest.approx(rate_dps)
        assert turn.ended == ended


@pytest.mark.parametrize(
    ("asked", "face"),
    [((0.0, 0.0, -1.0), "Z arrow does not point up"), ((1.0, 0.0, 0.0), "X arrow does not point down")],
)
def test_a_face_may_lie_30_degrees_off(asked, face):
    def leaning(off_deg):
        """The reading with the Y arrow partly down instead."""
        return 1000 * (
            np.cos(np.radians(off_deg)) * np.array(asked) + [0.0, np.sin(np.radians(off_deg)), 0.0]
        )

    assert judge_face(leaning(29.9), asked) is None
    found = judge_face(leaning(30.1), asked)
    assert found.message.startswith(f"the {face}: 30° off")
    assert judge_face(-leaning(0.0), asked).values["off_deg"] == pytest.approx(180.0)


def test_a_turn_that_nobody_begins_ends_after_five_minutes_with_a_reason():
    turn = turned()
    turn.add(samples(1.0, 299.9))
    assert turn.ended is None
    turn.add(samples(300.9, 0.3))
    assert turn.ended == "no whole turn within 300 s"


# -- by hand, in the plane of gravity --------------------------------------------------------------------


def freely(*legs: tuple[float, float], turns: int = 1) -> FreeTurn:
    """Return a free turn by angles that are reached in some seconds each, in blocks of 0.25 s."""
    turn, angle_deg, time_s = FreeTurn(0, turns, 60.0, ("", 0.0)), 30.0, 0.0
    for by_deg, length_s in legs:
        count = round(4 * length_s)
        for _ in range(count):
            angle_deg, time_s = angle_deg + by_deg / count, time_s + 0.25
            # Gravity turns backwards in the part.
            accel_mg = [
                1000 * math.cos(math.radians(angle_deg)),
                -1000 * math.sin(math.radians(angle_deg)),
                9.0,
            ]
            turn.add(ValueBlock(COLUMNS[:3], np.tile(accel_mg, (2, 1)), np.array([time_s - 0.1, time_s])))
    return turn


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_free_turn_is_counted_by_gravity_counter_clockwise_positive(sense):
    turn = freely((0.0, 1.0), (sense * 400.0, 10.0))
    assert turn.sweeps.angle_deg == pytest.approx(sense * 400.0)
    assert turn.rate_dps == pytest.approx(sense * 40.0)
    assert turn.full
    assert turn.ended is None
    assert freely((0.0, 1.0), (sense * 350.0, 10.0)).full is False


@pytest.mark.parametrize(
    ("legs", "turns", "ended"),
    [
        (((370.0, 10.0), (0.0, 2.5)), 1, None),
        (((370.0, 10.0), (0.0, 3.0)), 1, ""),
        (((370.0, 10.0), (0.6, 3.0)), 1, None),  # it rests if it turns by less than 0.5° in 3 s
        (((370.0, 10.0), (0.4, 3.0)), 1, ""),
        (((370.0, 10.0), (0.0, 9.0)), 2, None),
        (((370.0, 10.0), (370.0, 10.0), (0.0, 3.0)), 2, ""),
        (((0.0, 60.0),), 1, None),
        (((0.0, 60.25),), 1, ""),
    ],
)
def test_a_free_turn_ends_at_rest_after_its_turns_or_at_its_limit(legs, turns, ended):
    assert freely(*legs, turns=turns).ended == ended


@pytest.mark.parametrize(
    ("turned_deg", "state", "turn"), [(350.0, "turn", 1), (400.0, "turn", 2), (730.0, "after", 2)]
)
def test_the_progress_counts_turns_and_lost_scans(turned_deg, state, turn):
    made = freely((0.0, 1.0), (turned_deg, 10.0), turns=2)
    for lost in (3, 0, 2):
        made.add(ValueBlock(COLUMNS[:3], made.blocks[-1].accel_mg, made.blocks[-1].time_s + 0.25, lost))
    seen = made.progress(begun=True)
    assert (seen.state, seen.turn, seen.turns, seen.lost) == (state, turn, 2, 5)
    assert (seen.samples, seen.turned_deg) == (94, pytest.approx(turned_deg))
    assert made.progress(begun=False).state == "rest"
    done = made.done()
    assert (done.lost, done.samples, done.turns) == (5, 94, int(turned_deg // 360))


def test_a_gap_in_the_samples_after_a_turn_is_no_rest():
    turn = freely((370.0, 10.0))
    accel_mg = turn.blocks[-1].accel_mg[-1:]
    for now_s, ended in ((14.0, None), (15.0, None), (16.5, None), (16.9, "")):
        turn.add(ValueBlock(COLUMNS[:3], accel_mg, np.array([now_s])))
        assert turn.ended == ended


@pytest.mark.parametrize(("turns", "least_s"), [(1, 14.0), (2, 22.0), (5, 46.0)])
def test_a_plan_of_free_turns_allows_45_degrees_a_second_between_two_rests_of_three_seconds(turns, least_s):
    assert free_turn_plan(turns, least_s).turns == turns
    for length_s in (least_s - 0.1, 6.0, 1.0, math.inf):  # 6 s are the rests alone
        with pytest.raises(UsageError, match=f"take {least_s:.0f} s or more"):
            free_turn_plan(turns, length_s)
    with pytest.raises(UsageError, match="take 1 or more"):
        free_turn_plan(0)
