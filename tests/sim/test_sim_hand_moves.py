"""Moves by hand between positions, and whole turns about an axis on a table."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adis_gonio.base.errors import UsageError
from adis_gonio.sim import SimBus, Stage, World, WorldSettings
from adis_gonio.sim.hand import HandMove

STEP_S = 1e-4
EXACT = {"fixture_sigma_deg": 0.0, "vibration_mg": 0.0, "mark_sigma_deg": 0.0}
CALM = {"hand_tremor_dps": 0.0, "hand_unevenness": 0.0}


def stage(seed=0, **given):
    rng = np.random.default_rng
    return Stage(WorldSettings(**(EXACT | given)), 0.0, rng(seed), rng(seed + 1), rng(seed + 2))


def by_hand(seed=0, **given):
    return stage(seed, hand_moves=1.0, **given)


def at(part, time_s):
    return part.at(np.array([float(time_s)]))


def turned_by_gyros(motion, time_s, start):
    """The direction of gravity that the rates alone lead to, by small exact turns."""
    mean = np.radians((motion.rate_dps[1:] + motion.rate_dps[:-1]) / 2)
    turns = Rotation.from_rotvec(-mean * np.diff(time_s)[:, None]).as_matrix()
    while len(turns) > 1:  # neighbours into one turn, the earlier one first
        if len(turns) % 2:
            turns = np.concatenate([turns, np.eye(3)[None]])
        turns = turns[1::2] @ turns[::2]
    return turns[0] @ np.array(start)


@pytest.mark.parametrize("span_deg", [90.0, -90.0, 3.0, 720.0])
def test_a_hand_goes_from_rest_to_rest_and_ends_on_the_mark(span_deg):
    for seed in range(20):
        hand = HandMove(WorldSettings(), np.random.default_rng(seed), np.radians(span_deg))
        time_s = np.array([0.0, hand.length_s])
        angle, rate = hand.turned(time_s)
        assert np.degrees(angle) == pytest.approx([0.0, span_deg], abs=1e-9)
        assert rate == pytest.approx([0, 0], abs=1e-9)


def test_rates_of_a_hand_are_derivatives_of_its_angle():
    hand = HandMove(WorldSettings(), np.random.default_rng(1), np.radians(90.0))
    angle, rate = hand.turned(np.arange(0.0, hand.length_s, STEP_S))
    assert np.gradient(angle, STEP_S)[1:-1] == pytest.approx(rate[1:-1], abs=1e-5)


def test_hands_differ_in_grips_overshoot_and_time_and_a_seed_is_one_hand():
    def course(seed):
        hand = HandMove(WorldSettings(**CALM), np.random.default_rng(seed), np.radians(90.0))
        angle, rate = hand.turned(np.linspace(0.0, hand.length_s, 2001))
        resting = np.abs(np.degrees(rate)) < 0.02
        early = resting & (np.degrees(angle) > 10) & (np.degrees(angle) < 80)
        return hand.length_s, float(np.degrees(angle).max()) > 90.3, bool(early.any())

    hands = [course(seed) for seed in range(200)]
    assert course(7) == hands[7]
    lengths = np.array([length for length, _, _ in hands])
    assert lengths.max() > 1.7 * lengths.min()
    overshot = np.mean([over for _, over, _ in hands])
    assert 0.2 < overshot < 0.6
    two_grips = np.mean([two for _, _, two in hands])
    assert 0.4 < two_grips < 0.8


def test_a_mark_that_is_reached_from_one_side_is_never_passed():
    for seed in range(50):
        hand = HandMove(WorldSettings(**CALM), np.random.default_rng(seed), -1.5, one_way=True)
        angle, rate = hand.turned(np.linspace(0.0, hand.length_s, 2001))
        assert angle.min() > -1.5 - 1e-9
        assert rate.max() < 1e-9


def test_a_stage_moved_by_hand_stands_where_the_motor_would_have_brought_it():
    hand, motor = by_hand(fixture_sigma_deg=0.1), stage(fixture_sigma_deg=0.1)
    for place, approach in ((90.0, 1), (30.0, 1), (30.0, -1), (200.0, 0)):
        ends = [part.move_to(part.still_at_s + 5.0 if part.still_at_s > 0 else 0.0, place, approach)
                for part in (hand, motor)]  # fmt: skip
        there, here = (at(part, end + 1.0) for part, end in zip((hand, motor), ends, strict=True))
        assert there.direction == pytest.approx(here.direction)
        assert there.approach == here.approach
        assert (there.rate_dps == 0).all()
        assert (there.shaking_mg == 0).all()


@pytest.mark.parametrize("first", [(0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.3, -0.5, 0.7)])
def test_in_a_hand_gravity_turns_through_the_part_as_its_rates_say_twist_and_stray_included(first):
    part = by_hand(seed=4)
    begin = part.orient(0.0, np.array(first)) + 1.0
    end = part.orient(begin, np.array([1.0, 2.0, 0.5]))
    time_s = np.arange(begin, end + STEP_S, STEP_S)
    motion = part.at(time_s)
    start = np.array(first) / np.linalg.norm(first)
    found = turned_by_gyros(motion, time_s, start)
    assert found == pytest.approx(np.array([1.0, 2.0, 0.5]) / np.linalg.norm([1.0, 2.0, 0.5]), abs=2e-5)
    # About the vertical, which gravity cannot tell, it turned as well.
    upward = -(motion.rate_dps * motion.direction).sum(axis=1)
    plain = by_hand(seed=4, hand_twist_deg=0.0)
    plain.orient(plain.orient(0.0, np.array(first)) + 1.0, np.array([1.0, 2.0, 0.5]))
    without = plain.at(time_s)
    twist = np.trapezoid(upward + (without.rate_dps * without.direction).sum(axis=1), time_s)
    assert abs(twist) > 0.5


@pytest.mark.parametrize("kind", [by_hand, stage])
@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_whole_turns_on_a_level_table_are_felt_by_the_gyro_that_points_up_and_leave_gravity_alone(kind, up):
    axis = np.eye(3)["xyz".index(up)]
    part = kind()
    now = part.orient(0.0, -axis)
    for turns in (3, -3):
        begin = now + 4.0
        now = part.turn_about(begin, 360.0 * turns)
        time_s = np.linspace(begin, now, 20001)
        motion = part.at(time_s)
        integral = np.trapezoid(motion.rate_dps, time_s, axis=0)
        assert integral == pytest.approx(360.0 * turns * axis, abs=1e-4)
        assert motion.direction == pytest.approx(np.tile(-axis, (20001, 1)), abs=1e-9)
        assert at(part, now + 1).direction[0] == pytest.approx(-axis, abs=1e-9)


def test_about_a_level_axis_of_the_part_gravity_goes_round_with_it():
    part = by_hand(seed=2)
    begin = part.orient(0.0, np.array([0.0, 0.0, -1.0])) + 1.0
    end = part.turn_about(begin, 450.0, np.array([2.0, 0.0, 0.0]))
    time_s = np.arange(begin, end + STEP_S, STEP_S)
    motion = part.at(time_s)
    assert np.trapezoid(motion.rate_dps, time_s, axis=0) == pytest.approx([450.0, 0.0, 0.0], abs=1e-4)
    # Right-handed about x by 90°: what pointed down, -z, is seen along -y: the part turned, not gravity.
    assert at(part, end + 1).direction[0] == pytest.approx([0.0, -1.0, 0.0], abs=1e-9)
    assert turned_by_gyros(motion, time_s, [0.0, 0.0, -1.0]) == pytest.approx([0.0, -1.0, 0.0], abs=2e-5)


def test_a_table_that_is_not_level_leads_gravity_round_a_cone_and_back():
    part = stage()
    tilt = np.radians(2.0)
    begin = part.orient(0.0, np.array([np.sin(tilt), 0.0, -np.cos(tilt)])) + 1.0
    end = part.turn_about(begin, 720.0, np.array([0.0, 0.0, 1.0]))
    directions = part.at(np.linspace(begin, end, 2001)).direction
    assert directions[:, 2] == pytest.approx(-np.cos(tilt))
    assert directions[:, 0].min() == pytest.approx(-np.sin(tilt), rel=1e-3)
    assert directions[-1] == pytest.approx(directions[0], abs=1e-9)


def test_marks_are_met_with_an_error_that_does_not_add_up():
    part, now, errors = stage(mark_sigma_deg=0.3), 0.0, []
    for k in range(1, 400):
        begin = now
        now = part.turn_about(begin, 360.0 * (-1) ** k)
        time_s = np.linspace(begin, now, 3001)
        about = np.trapezoid(-(part.at(time_s).rate_dps * at(part, now).direction).sum(axis=1), time_s)
        errors.append(about - 360.0 * (-1) ** k)
    assert np.std(np.cumsum(errors)) == pytest.approx(0.3, rel=0.12)
    neighbours = np.mean([one * other for one, other in pairwise(errors)])
    assert neighbours == pytest.approx(-(0.3**2), rel=0.4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda part: part.turn_about(0.0, float("inf")), "angle"),
        (lambda part: part.turn_about(0.0, 90.0, np.zeros(3)), "axis"),
        (lambda part: part.turn_about(0.0, 90.0, np.ones(2)), "axis"),
        (lambda part: (part.turn_about(0.0, 360.0), part.turn_about(1.0, 360.0)), "wait"),
    ],
)
def test_impossible_turns_are_refused(call, message):
    with pytest.raises(UsageError, match=message):
        call(stage())


def test_hands_in_pieces_equal_hands_at_once():
    part = by_hand(fixture_sigma_deg=0.1, vibration_mg=5.0)
    now = part.move_to(0.0, 30.0, approach=-1)
    now = part.orient(now + 1, np.ones(3))
    now = part.turn_about(now + 1, -400.0)
    now = part.turn_about(now + 1, 100.0, np.array([1.0, -1.0, 0.0]))
    times = np.linspace(-1, now + 3, 700)
    whole = part.at(times)
    each = [part.at(times[k : k + 1]) for k in range(len(times))]
    for name in ("direction", "rate_dps", "shaking_mg", "angle_rad"):
        pieces = np.concatenate([getattr(one, name) for one in each])
        assert np.array_equal(pieces, getattr(whole, name), equal_nan=True), name


def test_the_bus_turns_the_part_in_its_own_time_and_the_gyro_says_how_far():
    settings = WorldSettings(
        **EXACT, hand_moves=1.0, gyro_bias_sigma_dps=0.0, gyro_g_dps_per_g=0.0, gyro_noise_dps=0.0,
        gyro_instability_dps=0.0,
    )  # fmt: skip
    bus = SimBus(World(settings, seed=3))
    bus.stage.orient((0.0, 0.0, -1.0))
    begin = bus.now_s()
    bus.stage.turn_about(-720.0)
    end = bus.now_s()
    assert end - begin > 10.0
    time_s = np.arange(begin, end, 1 / 819.2)
    rates = bus.world.sample(time_s).gyro_dps
    assert rates.sum(axis=0) / 819.2 == pytest.approx([0.0, 0.0, -720.0], abs=0.2)


def test_hands_draw_from_a_stream_of_their_own():
    """What the world hides stays what it was when a hand moves the part."""
    worlds = [World(WorldSettings(hand_moves=moves), seed=5) for moves in (0.0, 1.0)]
    for world in worlds:
        world.stage.move_to(0.0, 90.0)
    assert worlds[0].truth() == worlds[1].truth()
    assert worlds[0].stage.error_deg == worlds[1].stage.error_deg
    later = [world.stage.still_at_s + 10.0 + np.arange(5) / 819.2 for world in worlds]
    noise = [world.sample(times) for world, times in zip(worlds, later, strict=True)]
    assert np.array_equal(noise[0].supply_v, noise[1].supply_v)
