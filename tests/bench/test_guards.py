"""Limits of the checks at the bench, with readings of an ideal sensor."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adis_gonio.bench.events import Problem
from adis_gonio.bench.guards import (
    Judge,
    Turning,
    angle_between_deg,
    greatest_step,
    judge_dwell,
    judge_pose,
    judge_shift,
)
from adis_gonio.record.blocks import ValueBlock
from adis_gonio.record.plans import Position, PriorKnowledge

EXACT = PriorKnowledge(bias_mg=1e-6, reading_mg=0.1, fixture_deg=0.02)
COLUMNS = ("ax", "ay", "az", "gx", "gy", "gz")


def reading(angle_deg: float, z_mg: float = 0.0, alpha_deg: float = 0.0) -> np.ndarray:
    """Return the reading (3,) of an ideal sensor at a stage angle, at start angle `alpha_deg`."""
    phi = math.radians(alpha_deg - angle_deg)
    return np.array([1000.0 * math.cos(phi), 1000.0 * math.sin(phi), z_mg])


def samples(accel_mg, begin_s: float, length_s: float, rate_dps=(0.0, 0.0, 0.0)) -> ValueBlock:
    """Return a block of samples at 100 Hz with one reading and constant rates."""
    count = round(100 * length_s)
    row = np.concatenate([accel_mg, rate_dps])
    return ValueBlock(COLUMNS, np.tile(row, (count, 1)), begin_s + np.arange(count) / 100)


def judge(*angles_deg: float, sense: int = 1, alpha_deg: float = 0.0) -> Judge:
    """Return a judge after dwells at these stage angles, each of a second."""
    made = Judge(EXACT, planar=True, sense=sense, longest_gap_s=0.05)
    for place, angle_deg in enumerate(angles_deg):
        scans = samples(reading(sense * angle_deg, alpha_deg=alpha_deg), place, 1.0)
        made.done(place, Position(angle_deg), scans, doubted=False)
    return made


# -- attitudes in space ----------------------------------------------------------------------------------


def test_the_angle_between_two_directions_does_not_depend_on_their_lengths():
    assert angle_between_deg([1.0, 0, 0], [0, 0, 1000.0]) == pytest.approx(90.0)
    assert angle_between_deg([3.0, 4.0, 0], [-300.0, -400.0, 0]) == 180.0
    assert angle_between_deg([3.0, 4.0, 0], [3.0, 4.0, 0]) == 0.0


@pytest.mark.parametrize(("off_deg", "kind"), [(0.0, None), (119.0, None), (121.0, "upside_down")])
def test_an_attitude_may_differ_from_the_drawing_by_120_degrees(off_deg, kind):
    found = judge_pose(reading(off_deg), (1.0, 0.0, 0.0), None, None)
    assert (found and found.kind) == kind
    if found:
        assert found.values["off_deg"] == pytest.approx(off_deg)
        assert (found.default, found.spoils) == ("keep", False)


@pytest.mark.parametrize(
    ("asked_deg", "turned_deg", "kind"),
    [
        (90.0, 8.9, "not_moved"),
        (90.0, 9.1, None),
        (None, 8.9, "not_moved"),  # about 90° between any two attitudes
        (None, 9.1, None),
        (30.0, 3.1, None),
        (1.0, 0.28, "not_moved"),  # the stillness watch sees a shift of 5 mg, which is 0.286°
        (1.0, 0.30, None),
    ],
)
def test_a_part_has_moved_if_it_turned_by_a_tenth_of_the_requested_turn(asked_deg, turned_deg, kind):
    asked = None if asked_deg is None else tuple(reading(asked_deg))
    found = judge_pose(reading(turned_deg), asked, reading(0.0), (1.0, 0.0, 0.0))
    assert (found and found.kind) == kind


def test_a_pose_that_was_not_moved_is_told_even_where_another_way_up_was_asked():
    asked, before = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.5, -0.8])
    mean = np.array([2.0, 500.0, -850.0])
    assert judge_pose(mean, asked, None, None).kind == "upside_down"
    guard = judge_pose(mean, asked, mean + 0.1, before)
    assert (guard.kind, guard.default, guard.spoils) == ("not_moved", "retake", True)


# -- within a dwell --------------------------------------------------------------------------------------


def test_a_shift_after_a_disturbance_counts_from_five_mg_or_the_limit_of_its_axis():
    limit, before = np.array([0.1, 20.0, 0.1]), np.array([10.0, -20.0, 990.0])
    for shift in ([4.9, 0.0, 0.0], [0.0, -19.9, 0.0], [0.0, 0.0, -4.9]):
        assert judge_shift(before + shift, before, limit) is None
    found = judge_shift(before + np.array([0.0, 12.0, -5.2]), before, limit)
    assert found.message.startswith("z has shifted by 5.2 mg")
    assert found.values == pytest.approx({"shift_mg": 5.2, "limit_mg": 5.0})
    assert judge_shift(before + np.array([0.0, 20.1, 0.0]), before, limit).values["limit_mg"] == 20.0


@pytest.mark.parametrize("length_s", [1.0, 3.0])
def test_the_greatest_step_is_that_of_a_jump_and_of_a_slope_in_the_time_of_two_means(length_s):
    time_s = 7.0 + np.arange(round(100 * length_s)) / 100
    jump = np.where(time_s > 7.0 + length_s / 2, 25.7, 25.0)
    assert greatest_step(time_s, jump) == pytest.approx(0.7)
    assert greatest_step(time_s, -jump) == pytest.approx(0.7)
    assert greatest_step(time_s, 0.4 * time_s) == pytest.approx(0.4 * min(1.0, length_s / 2), rel=0.03)


def test_a_dwell_of_few_samples_has_no_step():
    assert greatest_step(np.array([1.0]), np.array([5.0])) == 0.0
    assert greatest_step(np.array([1.0, 2.0, 3.0]), np.array([5.0, 6.0, 7.0])) == 0.0


@pytest.mark.parametrize(
    ("column", "step", "kinds"),
    [
        ("temp_c", 0.95, []),
        ("temp_c", 1.05, ["temperature"]),
        ("supply_v", -0.045, []),
        ("supply_v", -0.055, ["supply"]),
    ],
)
def test_a_condition_may_change_by_its_limit_within_a_dwell(column, step, kinds):
    time_s = np.arange(300) / 100
    data = np.column_stack([np.tile(reading(0.0), (300, 1)), np.where(time_s < 1.5, 5.0, 5.0 + step)])
    found = judge_dwell(ValueBlock(("ax", "ay", "az", column), data, time_s), [])
    assert [guard.kind for guard in found] == kinds


def test_a_supply_out_of_range_is_asked_about_once_and_before_the_alarm_that_it_sets():
    time_s = np.arange(300) / 100
    data = np.column_stack([np.tile(reading(0.0), (300, 1)), np.where(time_s < 1.5, 5.0, 4.6)])
    scans = ValueBlock(("ax", "ay", "az", "supply_v"), data, time_s)
    problems = [
        Problem("alarm", "EA is set", 1),
        Problem("lost", "2 lost", 1),
        Problem("supply", "4.6 V", 1),
    ]
    (found,) = judge_dwell(scans, problems)
    assert (found.kind, found.message) == ("supply", "4.6 V; EA is set")
    (found,) = judge_dwell(scans.first(100), problems[:2])
    assert (found.kind, found.message) == ("over_range", "EA is set")


# -- the turn by the gyros -------------------------------------------------------------------------------


def turned(*, begin_s: float = 1.0, pieces: int = 4, turning: Turning | None = None) -> Turning:
    """Turn by 90° about Z within 10 s, in blocks, with gyros that read 2, −1 and 0.5 °/s at rest."""
    zero, rates = np.array([2.0, -1.0, 0.5]), np.array([2.0, -1.0, 9.5])
    turning = Turning(0.05, samples(reading(0.0), 0.0, 1.0, zero)) if turning is None else turning
    for k in range(pieces):
        length_s = 10.0 / pieces
        turning.see(samples(reading(0.0), begin_s + k * length_s, length_s, rates))
    return turning


@pytest.mark.parametrize("pieces", [1, 4])
def test_the_rates_are_integrated_from_the_zero_rates_of_the_dwell_before(pieces):
    found = turned(pieces=pieces).turn()
    assert found.angle_deg == pytest.approx([0.0, 0.0, 90.0], abs=0.1)
    # In 10 s: bias 0.015 and g-sensitivity 0.05 √2 °/s; noise of 0.6 °/s at 100 Hz; 1 % of the travel.
    wander, noise = 10 * math.hypot(0.015, 0.05 * math.sqrt(2)), 0.6 * math.sqrt(10 * 0.01)
    assert found.u_deg == pytest.approx(math.hypot(wander, noise, 0.9), rel=1e-3)


def test_a_rate_that_rises_from_block_to_block_is_integrated_without_a_step():
    turning = Turning(0.05, samples(reading(0.0), 0.0, 1.0))
    time_s = np.arange(1.0, 3.0, 0.01)
    rising = np.tile(np.concatenate([reading(0.0), np.zeros(3)]), (len(time_s), 1))
    rising[:, 5] = 20.0 * (time_s - 0.99)
    for rows in np.array_split(np.arange(len(time_s)), 4):
        turning.see(ValueBlock(COLUMNS, rising[rows], time_s[rows]))
    assert turning.turn().angle_deg[2] == pytest.approx(10.0 * 2.0**2, abs=1e-6)


def test_the_uncertainty_of_a_turn_counts_the_way_forth_and_back():
    turning = turned()
    back = np.array([2.0, -1.0, 0.5 - 9.0])
    turning.see(samples(reading(0.0), 11.0, 10.0, back))
    found = turning.turn()
    assert found.angle_deg[2] == pytest.approx(0.0, abs=0.1)
    wander, noise = 20 * math.hypot(0.015, 0.05 * math.sqrt(2)), 0.6 * math.sqrt(20 * 0.01)
    assert found.u_deg == pytest.approx(math.hypot(wander, noise, 1.8), rel=1e-3)


def test_a_turn_is_unknown_after_a_gap_without_samples_and_before_the_first_dwell():
    assert turned(begin_s=1.03).turn() is not None
    assert turned(begin_s=1.06).turn() is None
    assert Turning(0.05).turn() is None
    assert turned(turning=Turning(0.05)).turn() is None
    assert Turning(0.05, samples(reading(0.0), 0.0, 1.0)).turn() is None
    without_gyros = ValueBlock(("ax", "ay", "az"), np.zeros((5, 3)), np.arange(5.0))
    assert turned(turning=Turning(0.05, without_gyros)).turn() is None


def test_samples_of_the_ended_dwell_do_not_count_as_a_turn():
    turning = Turning(0.05, samples(reading(0.0), 0.0, 1.0))
    turning.see(samples(reading(0.0), 0.5, 0.4, (0.0, 0.0, 50.0)))
    assert turning.turn() is None


# -- positions in the plane ------------------------------------------------------------------------------


@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize(("off_deg", "asked"), [(89.0, False), (-89.0, False), (91.0, True), (-91.0, True)])
def test_the_first_position_may_differ_from_the_drawing_by_a_right_angle(off_deg, asked, sense):
    found = judge(sense=sense).settled(0, Position(40.0), reading(sense * (40.0 + off_deg)))
    assert (found is not None) == asked
    if found:
        assert found.values["off_deg"] == pytest.approx(off_deg)
        assert (found.kind, found.default, found.spoils) == ("upside_down", "keep", False)


@pytest.mark.parametrize(
    ("z_mg", "way"), [(198.0, None), (-198.0, None), (200.0, "down"), (-200.0, "up"), (2000.0, "down")]
)
def test_the_axis_of_rotation_may_tilt_until_a_reading_changes_by_two_percent(z_mg, way):
    """The cosine of the tilt is then 0.98, and its sine 0.199."""
    found = judge(0.0).settled(1, Position(90.0), reading(90.0, z_mg))
    assert (found is None) == (way is None)
    if found:
        assert (found.kind, found.spoils) == ("wrong_axis", True)
        assert f"the Z arrow points {way}" in found.message
        assert found.values["limit_mg"] == pytest.approx(199.0, abs=0.1)
        assert found.values["tilt_deg"] == pytest.approx(90.0 if z_mg > 1000 else 11.54, abs=0.01)


@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize(
    ("angles_deg", "to_deg", "real_deg", "asked_deg", "kind"),
    [
        ((0.0, 90.0), 180.0, 180.0, 90.0, None),
        ((0.0, 90.0), 180.0, 90.2, 90.0, "not_moved"),
        ((0.0, 90.0), 180.0, 90.4, 90.0, "wrong_angle"),
        ((0.0, 90.0), 180.0, 0.0, 90.0, "reversed"),
        ((0.0, 90.0), 180.0, 170.0, 90.0, "wrong_angle"),
        ((0.0,), 270.0, 0.0, -90.0, "not_moved"),
        ((0.0,), 180.0, 0.0, 180.0, "not_moved"),
        ((180.0,), 0.0, 180.0, 180.0, "not_moved"),
    ],
)
def test_a_turn_in_the_plane_is_judged_by_gravity(angles_deg, to_deg, real_deg, asked_deg, kind, sense):
    made, place = judge(*angles_deg, sense=sense, alpha_deg=5.0), len(angles_deg)
    now_mg = reading(sense * real_deg, alpha_deg=5.0)
    found = made.settled(place, Position(to_deg), now_mg)
    assert (found and found.kind) == kind
    measured = made.turned(place, Position(to_deg), now_mg)
    assert measured.asked_deg == asked_deg
    if abs(asked_deg) < 180:
        assert measured.gravity_deg == pytest.approx(real_deg - angles_deg[-1])
    if found:
        assert found.spoils
        assert found.values["gravity_deg"] == pytest.approx(measured.gravity_deg)
        # No dwell but the first, or both senses contradict 90°: then the stage does not count backwards.
        assert "reverse" not in found.answers


@pytest.mark.parametrize(
    ("angles_deg", "offered"), [((0.0,), True), ((0.0, 180.0), True), ((0.0, 90.0), False)]
)
def test_reversal_is_offered_until_a_dwell_shows_the_sense_of_the_stage(angles_deg, offered):
    made = judge(*angles_deg)
    to_deg = angles_deg[-1] + 90.0
    real_deg = -to_deg if offered else angles_deg[-1] - 90.0
    found = made.settled(len(angles_deg), Position(to_deg), reading(real_deg))
    assert found.kind == "reversed"
    assert ("reverse" in found.answers) == offered
    if offered:
        made.reverse()
        assert made.settled(len(angles_deg), Position(to_deg), reading(real_deg)) is None


@pytest.mark.parametrize(
    ("rates_dps", "axis"),
    [
        ((45.0, 0.0, 0.0), "x"),
        ((0.0, -45.0, 10.0), "y"),
        ((10.0, 0.0, 45.0), None),
        ((0.45, 0.0, 0.0), None),  # 0.9°: 5 mg of gravity and 3.9 u explain 0.95°
        ((0.5, 0.0, 0.0), "x"),
    ],
)
def test_a_turn_about_another_axis_is_named_if_the_gyros_are_sure_of_it(rates_dps, axis):
    made = judge(0.0)
    made.turning.see(samples(reading(0.0), 1.0, 2.0, rates_dps))
    found = made.settled(1, Position(90.0), reading(0.0))
    assert found.kind == ("not_moved" if axis is None else "wrong_axis")
    if axis:
        assert f"turned about {axis} " in found.message
        wanted = 2.0 * np.array(rates_dps)
        assert [found.values[f"gyro_{k}_deg"] for k in "xyz"] == pytest.approx(wanted, abs=0.5)
    assert found.values["gyro_deg"] == pytest.approx(2.0 * rates_dps[2], abs=0.5)


def test_a_reversed_stage_counts_the_turn_of_the_gyro_backwards():
    made = judge(0.0, sense=-1)
    made.turning.see(samples(reading(0.0), 1.0, 2.0, (0.0, 0.0, -45.0)))
    measured = made.turned(1, Position(90.0), reading(-90.0))
    assert measured.gyro_deg == pytest.approx(90.0, abs=0.5)
    assert measured.gravity_deg == pytest.approx(90.0)


def test_a_doubted_dwell_teaches_nothing_but_the_next_turn_begins_there():
    made = judge(0.0, 90.0)
    before = made.tolerance_deg(reading(180.0), 180.0)
    made.done(2, Position(180.0), samples(reading(150.0), 2.0, 1.0), doubted=True)
    assert made.tolerance_deg(reading(180.0), 180.0) == before
    assert made.turned(3, Position(270.0), reading(270.0)).gravity_deg == pytest.approx(120.0)


def test_dwells_narrow_the_tolerance_and_withdrawn_ones_widen_it_again():
    made = judge()
    assert made.tolerance_deg(reading(45.0), 45.0) is None
    limits = []
    for place, angle_deg in enumerate((0.0, 90.0, 180.0)):
        made.done(place, Position(angle_deg), samples(reading(angle_deg), place, 1.0), doubted=False)
        limits.append(made.tolerance_deg(reading(45.0), 45.0))
    assert limits[0] > limits[1] > limits[2]
    made.withdraw(2)
    assert made.tolerance_deg(reading(45.0), 45.0) == pytest.approx(limits[1])
    assert made.turned(3, Position(270.0), reading(270.0)).gravity_deg == pytest.approx(90.0)
    made.withdraw(1)
    assert made.tolerance_deg(reading(45.0), 45.0) == pytest.approx(limits[0])
    assert made.angle_deg(reading(33.0)) == pytest.approx(33.0)


def test_attitudes_in_space_have_no_angle_and_no_tolerance():
    made, first = Judge(EXACT, planar=False, sense=1, longest_gap_s=0.05), Position(None, 0)
    made.done(0, first, samples(reading(0.0), 0, 1.0), doubted=False)
    assert made.settled(0, first, reading(0.0)) is None, "a repeated dwell need not be a new attitude"
    assert made.settled(1, first, reading(0.0)).kind == "not_moved"
    assert made.angle_deg(reading(0.0)) is None
    assert made.tolerance_deg(reading(0.0), 0.0) is None
    made.turning.see(samples(reading(0.0), 1.0, 2.0, (30.0, 0.0, 40.0)))
    measured = made.turned(1, Position(None, 0), reading(60.0))
    assert (measured.asked_deg, measured.gravity_deg) == (None, pytest.approx(60.0))
    assert measured.gyro_deg == pytest.approx(100.0, abs=0.6)
