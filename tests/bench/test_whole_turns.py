"""Whole turns on a table: when they end, and how a turn that was not whole is named."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from adis_gonio.bench.gyro_turns import GyroTurn, judge_whole_turn
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
