"""The stage: angles, errors, backlash, moves that take time, attitudes in space."""

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.sim import Stage, WorldSettings

PERFECT = {"fixture_sigma_deg": 0.0, "vibration_mg": 0.0}


def stage(alpha_deg=0.0, seed=0, **given):
    return Stage(WorldSettings(**(PERFECT | given)), np.radians(alpha_deg), np.random.default_rng(seed))


def at(part, time_s):
    return part.at(np.array([float(time_s)]))


def angle_of(part, time_s):
    x, y, _ = at(part, time_s).direction[0]
    return np.degrees(np.arctan2(y, x))


@pytest.mark.parametrize("theta", [0.0, 30.0, 90.0, 180.0, -45.0])
def test_the_true_angle_is_alpha_minus_theta(theta):
    part = stage(alpha_deg=7.0)
    end = part.move_to(1.0, theta)
    psi = np.radians(7.0 - theta)
    assert at(part, end + 1).direction[0] == pytest.approx([np.cos(psi), np.sin(psi), 0.0], abs=1e-12)
    assert part.angle_deg == pytest.approx(theta)


def test_a_tilted_axis_shortens_the_plane_and_shows_on_z():
    part = stage(axis_tilt_deg=2.0)
    assert at(part, 0).direction[0] == pytest.approx([np.cos(np.radians(2)), 0.0, np.sin(np.radians(2))])


def test_each_move_draws_its_own_error_so_that_coming_back_is_not_the_same():
    part = stage(fixture_sigma_deg=0.1, seed=3)
    errors, now = [], 0.0
    for k in range(4000):
        now = part.move_to(now, 10.0 * (k % 2))
        errors.append(part.error_deg)
    assert len(set(errors)) == 4000
    assert np.std(errors) == pytest.approx(0.1, rel=0.04)
    assert np.mean(errors) == pytest.approx(0, abs=0.006)
    assert 0.0 - angle_of(part, now + 5) == pytest.approx(10.0 - errors[-1])


def test_the_errors_depend_on_the_seed_alone():
    def errors(seed):
        part, now, found = stage(fixture_sigma_deg=0.1, seed=seed), 0.0, []
        for k in range(5):
            now = part.move_to(now, 20.0 * k)
            found.append(part.error_deg)
        return found

    assert errors(1) == errors(1)
    assert errors(1) != errors(2)


def test_backlash_parts_the_two_ways_of_reaching_a_position():
    part = stage(backlash_deg=0.2)
    end = part.move_to(0.0, 90.0, approach=1)
    up = angle_of(part, end)
    end = part.move_to(end, 90.0, approach=-1)
    assert up - angle_of(part, end) == pytest.approx(0.2)


def test_an_approach_against_the_way_goes_past_and_turns_round():
    part = stage(overshoot_deg=5.0)
    end = part.move_to(0.0, 90.0, approach=-1)
    times = np.linspace(0, end, 400)
    angles = np.degrees(part.at(times).angle_rad)
    assert angles.max() == pytest.approx(95.0, abs=0.05)
    assert angles[-1] == pytest.approx(90.0)
    direct = stage().move_to(0.0, 90.0)
    assert end > direct
    assert at(part, end + 1).approach[0] == -1


@pytest.mark.parametrize(
    ("angle", "speed", "duration"), [(90.0, 45.0, 2.0), (90.0, 30.0, 3.0), (1.0, 45.0, 0.3)]
)
def test_a_move_takes_its_time(angle, speed, duration):
    assert stage(move_speed_dps=speed).move_to(1.0, angle) == pytest.approx(1.0 + duration)


def test_the_rate_during_a_move_is_the_derivative_of_the_angle_about_z():
    part = stage()
    end = part.move_to(1.0, 90.0)
    times = np.linspace(0.5, end + 0.5, 20001)
    motion = part.at(times)
    derivative = np.gradient(np.degrees(motion.angle_rad), times)
    assert motion.rate_dps[:, 2] == pytest.approx(derivative, abs=0.1)
    assert np.trapezoid(motion.rate_dps[:, 2], times) == pytest.approx(90.0, abs=0.01)
    assert (motion.rate_dps[times > end] == 0).all()
    assert (motion.rate_dps[:, :2] == 0).all()


def test_the_part_rings_after_a_move_and_comes_to_rest():
    part = stage(vibration_mg=20.0, vibration_decay_s=0.3)
    end = part.move_to(0.0, 90.0)
    times = np.linspace(0, end + 10, 20000)
    ringing = np.abs(part.at(times).ringing_mg)
    assert (ringing[times <= end] == 0).all()
    assert 17 < ringing.max() <= 20
    assert ringing[times > end + 0.9].max() == pytest.approx(20 * np.exp(-3), rel=0.1)
    assert (ringing[times > end + 6.1] == 0).all()


def test_the_part_rings_at_its_frequency():
    part = stage(vibration_mg=20.0, vibration_decay_s=10.0, vibration_hz=35.0)
    end = part.move_to(0.0, 90.0)
    ringing = part.at(end + np.arange(1, 2**14) / 2**14).ringing_mg
    assert np.count_nonzero(np.diff(np.sign(ringing))) == pytest.approx(2 * 35, abs=1)


def test_the_part_slips_on_the_way_to_a_position_and_stays_there():
    part, now, errors = stage(part_slip_deg=0.3, part_slip_position=2.0), 0.0, []
    for place in (0.0, 10.0, 20.0, 30.0):
        now = part.move_to(now + 1, place)
        errors.append(part.error_deg)
        assert angle_of(part, now) == pytest.approx(part.error_deg - place)
    assert errors == pytest.approx([0.0, 0.0, -0.3, -0.3])


def test_a_free_turn_starts_at_the_angle_at_which_the_part_rests():
    part = stage(alpha_deg=170.0, fixture_sigma_deg=0.5)
    now = part.move_to(0.0, -30.0)
    assert part.free_start_deg is None
    resting = angle_of(part, now)
    now = part.turn_freely(now + 1)
    assert part.free_start_deg == pytest.approx(resting)
    assert part.error_deg != 0


@pytest.mark.parametrize("sense", [1, -1])
def test_a_free_turn_arrives_in_its_own_sense(sense):
    part = stage(hand_turn_deg=sense * 365.0)
    now = part.turn_freely(1.0)
    assert at(part, now + 1).approach[0] == sense


def test_before_any_move_nothing_rings():
    assert (stage(vibration_mg=20.0).at(np.linspace(-1, 5, 100)).ringing_mg == 0).all()


def test_dwells_are_counted_by_moves_and_know_where_they_came_from():
    part = stage()
    first = at(part, 0.0)
    end = part.move_to(0.0, 10.0)
    second = at(part, end)
    end = part.move_to(end + 5, 40.0)
    third = at(part, end + 2.5)
    assert [m.order[0] for m in (first, second, third)] == [0, 0, 1]
    assert np.degrees([second.previous_angle_rad[0], third.previous_angle_rad[0]]) == pytest.approx(
        [10, 10]
    )
    assert third.time_in_dwell_s[0] == pytest.approx(2.5)
    assert third.approach[0] == 1


@pytest.mark.parametrize("vector", [(0, 0, -1), (0, 0, 1), (1, 1, 1), (-1, 0, 0), (0.3, -2.0, 0.1)])
def test_an_attitude_in_space_is_reached(vector):
    part = stage()
    end = part.orient(0.0, np.array(vector, float))
    expected = np.array(vector) / np.linalg.norm(vector)
    assert at(part, end + 1).direction[0] == pytest.approx(expected, abs=1e-12)
    assert np.isnan(part.angle_deg)


def test_on_the_way_through_space_the_direction_stays_a_unit_vector_and_turns_as_the_gyros_say():
    part = stage()
    middle = part.orient(0.0, np.array([0.0, 0.0, -1.0]))
    end = part.orient(middle, np.array([1.0, 2.0, 0.5]))
    times = np.linspace(0, end, 20001)
    motion = part.at(times)
    assert np.linalg.norm(motion.direction, axis=1) == pytest.approx(1.0)
    # A vector that stands still in the room moves in the part's frame by -omega x d.
    derivative = np.gradient(motion.direction, times, axis=0)
    assert derivative == pytest.approx(-np.cross(np.radians(motion.rate_dps), motion.direction), abs=2e-3)


def test_from_space_back_into_the_plane():
    part = stage(alpha_deg=3.0)
    end = part.orient(0.0, np.array([0.0, 0.0, -1.0]))
    end = part.move_to(end, 90.0)
    psi = np.radians(3.0 - 90.0)
    for later in (0.0, 1.0):
        assert at(part, end + later).direction[0] == pytest.approx(
            [np.cos(psi), np.sin(psi), 0.0], abs=1e-9
        )
    assert part.angle_deg == pytest.approx(90.0)
    end = part.move_to(end, 0.0)
    assert angle_of(part, end) == pytest.approx(3.0)


def test_attitudes_in_space_have_the_fixtures_error_too():
    part, now, errors = stage(fixture_sigma_deg=0.5), 0.0, []
    for _ in range(500):
        now = part.orient(now, np.array([0.0, 0.0, -1.0]))
        errors.append(np.degrees(at(part, now).direction[0, :2]))
    assert np.std(errors, axis=0) == pytest.approx(0.5, rel=0.12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda part: part.move_to(0.0, float("nan")), "approach"),
        (lambda part: part.move_to(0.0, 1.0, approach=2), "approach"),
        (lambda part: part.orient(0.0, np.zeros(3)), "direction"),
        (lambda part: part.orient(0.0, np.ones(2)), "direction"),
        (lambda part: (part.move_to(0.0, 90.0), part.move_to(1.0, 0.0)), "wait"),
    ],
)
def test_impossible_moves_are_refused(call, message):
    with pytest.raises(UsageError, match=message):
        call(stage())


def test_positions_in_pieces_equal_positions_at_once():
    part = stage(fixture_sigma_deg=0.1, vibration_mg=5.0)
    now = part.move_to(0.0, 30.0)
    now = part.move_to(now + 1, 0.0, approach=1)
    now = part.orient(now + 1, np.ones(3))
    times = np.linspace(-1, now + 3, 1000)
    whole = part.at(times)
    for name in ("direction", "rate_dps", "ringing_mg", "angle_rad", "time_in_dwell_s"):
        pieces = np.concatenate([getattr(part.at(times[k : k + 1]), name) for k in range(1000)])
        assert np.array_equal(pieces, getattr(whole, name), equal_nan=True), name


def test_the_course_of_many_moves_tabulates_each_move_once(monkeypatch):
    """A twin of 2000 dwells asks for the course after each of its moves."""
    part, followed, along = stage(), [], Stage._along
    monkeypatch.setattr(Stage, "_along", lambda *given: followed.append(given) or along(*given))
    now = 0.0
    for k in range(40):
        now = part.move_to(now + 1, 37.0 * k % 360)
        part.course()
    assert len(followed) == 41


@pytest.mark.parametrize("hand", [0.0, 1.0])
def test_the_course_between_its_knots_is_the_way_that_the_part_takes(hand):
    part = stage(alpha_deg=3.0, fixture_sigma_deg=0.1, hand_moves=hand)
    knots, directions = part.course()
    assert knots.tolist() == [0.0]
    assert directions == pytest.approx(at(part, 0).direction)
    now = part.move_to(0.0, 180.0)
    now = part.move_to(now + 5, 20.0, approach=1)
    now = part.orient(now + 5, np.array([1.0, 1.0, -1.0]))
    now = part.move_to(now + 5, 90.0)
    times = np.linspace(-1, now + 3, 2000)
    knots, directions = part.course()
    assert (np.diff(knots) > 0).all()
    for axis in range(3):
        told = np.interp(times, knots, directions[:, axis])
        np.testing.assert_allclose(told, part.at(times).direction[:, axis], atol=3e-3)
