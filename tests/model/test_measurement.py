"""Start values, and the parameters that poses show."""

import math

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import (
    FreeAttitude,
    JointMeasurement,
    MeanRate,
    PlanarTurn,
    SessionOrigin,
    across,
    axes_matrix,
    gains_and_skews,
    sensitivity,
)

PLANE, SPACE = PlanarTurn(981.0), FreeAttitude(981.0)
FACES = np.concatenate([np.eye(3), -np.eye(3)])


def at_rest(n):
    return Conditions(time_s=np.arange(float(n)))


FIVE = np.arange(5)
TURNED_RAD = np.array([0.0, -0.5, -1.6, -3.0, -4.4])
UNIT = np.array([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0], [0.48, 0.6, 0.64], [-0.36, 0.48, -0.8], [0.8, 0.6, 0]])
ORIGINS = (SessionOrigin("a", "7", "old"), SessionOrigin("b", "7"), SessionOrigin("c", "8"))
WHICH = np.array([2, 0, 1, 0, 2])
IN_PLANE, IN_SPACE = ([0.3, 1.02, 0.97, 0.05], [1.02, 0.97, 1.01, 0.05, -0.03, 0.02])
EACH = {
    "plane": (PLANE, IN_PLANE, 0.01 * FIVE),
    "space": (SPACE, IN_SPACE, UNIT),
    "gyros": (MeanRate(), [1.0, -2.0, 0.5], 50 * UNIT),
    # Start angles of a, b and c; gains and Δφ of the parts 7 and 8.
    "plane of three sessions": (
        JointMeasurement([PLANE] * 3, ORIGINS, WHICH),
        [0.3, 1.02, 0.97, 0.05, -0.7, 2.0, 0.99, 1.03, -0.04],
        0.01 * FIVE,
    ),
    "space of three sessions": (
        JointMeasurement([SPACE, FreeAttitude(979.0), SPACE], ORIGINS, WHICH),
        [*IN_SPACE, 0.98, 1.0, 1.03, -0.04, 0.01, 0.06],
        UNIT,
    ),
}


@pytest.mark.parametrize("kind", EACH)
def test_columns_and_tangent_are_the_derivatives_of_the_readings(kind):
    model, base, attitude = EACH[kind]
    base, step = np.array(base), 1e-6
    n, p = len(attitude), len(model.parameters)
    assert len(base) == p

    def change(first, last):
        difference = model.ideal(*last, TURNED_RAD) - model.ideal(*first, TURNED_RAD)
        return difference / (2 * step)

    columns = model.columns(base, attitude, TURNED_RAD)
    for k, one in enumerate(step * np.eye(p)):
        by_hand = change((base - one, attitude), (base + one, attitude))
        assert columns[:, :, k] == pytest.approx(by_hand, abs=1e-4)
    tangent = model.tangent(base, attitude, TURNED_RAD)
    assert tangent.shape == (n, model.axes, model.freedom)
    for k, one in enumerate(step * np.eye(model.freedom)):
        by_hand = change(*((base, model.moved(attitude, np.tile(sign * one, (n, 1)))) for sign in (-1, 1)))
        assert tangent[:, :, k] == pytest.approx(by_hand, abs=1e-4)
    off = model.deviation_rad(attitude)
    assert off.shape == (n, model.freedom)
    assert (off == (attitude[:, None] if model.planar else 0)).all()


@pytest.mark.parametrize("kind", EACH)
def test_calibrated_readings_are_gravity_or_the_rate(kind):
    model, base, attitude = EACH[kind]
    found = model.calibrated(np.array(base), model.ideal(np.array(base), attitude, TURNED_RAD))
    if model.planar:
        psi = model.start_rad(np.array(base)) + TURNED_RAD + attitude
        attitude = np.stack([np.cos(psi), np.sin(psi)], axis=1)
    assert found == pytest.approx(attitude, abs=1e-12)


def test_parameters_are_of_the_session_or_of_the_part():
    model = EACH["plane of three sessions"][0]
    own = ["scale_x", "scale_y", "delta_phi"]
    seven, eight = ([f"{name}@{part}" for name in own] for part in "78")
    assert list(model.names) == ["alpha@a", *seven, "alpha@b", "alpha@c", *eight]
    one_part = JointMeasurement([SPACE] * 2, [SessionOrigin("a", "7"), SessionOrigin("b", "7")], FIVE % 2)
    assert one_part.names == SPACE.names


def test_sessions_of_one_part_begin_with_the_mean_of_their_gains_and_each_with_its_own_angle():
    origins = [SessionOrigin(label, "7") for label in "abc"]
    model = JointMeasurement([PLANE] * 3, origins, np.repeat([0, 1], 4))
    theta = np.radians([0.0, 50.0, 200.0, 300.0] * 2)
    one, other = ([0.3, 1.1, 0.9, -0.02], [-1.2, 1.0, 1.0, 0.04])
    reading = np.concatenate([planar(one, theta[:4]), planar(other, theta[4:])])
    found, off = model.begin(reading, theta, at_rest(8))
    assert model.names == ("alpha@a", "scale_x", "scale_y", "delta_phi", "alpha@b", "alpha@c")
    # Session c has no dwells: its angle is nominal.
    assert found == pytest.approx([0.3, 1.05, 0.95, 0.01, -1.2, 0.0])
    assert off == pytest.approx(np.zeros(8))
    assert model.start_rad(found) == pytest.approx([0.3] * 4 + [-1.2] * 4)
    some = model.rows(np.arange(8) % 2 == 0)
    assert some.start_rad(found) == pytest.approx([0.3, 0.3, -1.2, -1.2])
    # An angle is determined by its own session, a gain by any session of the part.
    declared = np.arange(8) < 4
    assert model.visible(reading, declared).tolist() == [True, True, True, True, False, False]


def test_a_skew_is_the_angle_that_two_axes_lack_to_a_right_one_and_a_gain_is_along_its_axis():
    skews = np.radians([3.0, -2.0, 1.5])
    axes = axes_matrix(skews)
    cosines = axes @ axes.T
    assert cosines[[0, 0, 1], [1, 2, 2]] == pytest.approx(np.sin(skews))
    assert np.diag(cosines) == pytest.approx([1, 1, 1])
    assert axes[0] == pytest.approx([1, 0, 0])  # X is the reference, Y is in its plane
    assert axes[1, 2] == pytest.approx(0)
    whole = sensitivity(np.array([1.02, 0.97, 1.01, *skews]))
    assert np.linalg.norm(whole, axis=1) == pytest.approx([1.02, 0.97, 1.01])
    for d, expected in ((3, skews), (2, skews[:1])):
        gains, found = gains_and_skews((whole @ whole.T)[:d, :d])
        assert gains == pytest.approx([1.02, 0.97, 1.01][:d])
        assert found == pytest.approx(expected)


def test_poses_in_space_begin_with_equal_gains_and_the_directions_of_the_readings():
    reading = 981.0 * np.array([1.1, 0.9, 1.0, 1.0, 1.2])[:, None] * UNIT
    base, attitude = SPACE.begin(reading, np.full(5, np.nan), at_rest(5))
    assert base == pytest.approx([1.04, 1.04, 1.04, 0, 0, 0])
    assert attitude == pytest.approx(UNIT)


def test_gyros_are_driven_by_the_known_rate_and_pose_by_the_accelerometers():
    rate = 50 * UNIT
    turned = Conditions(time_s=np.arange(5.0), rate_dps=rate, force_g=1.1 * UNIT)
    assert MeanRate().stimulus(rate + 3, turned) == pytest.approx(rate / 100)
    assert MeanRate().pose(rate, turned) == pytest.approx(UNIT)
    assert MeanRate().pose(rate, at_rest(5)) is None
    assert not MeanRate().stimulus(rate, at_rest(5)).any()
    assert SPACE.stimulus(500 * UNIT, at_rest(5)) == pytest.approx(0.5 * UNIT)
    assert SPACE.pose(500 * UNIT, at_rest(5)) == pytest.approx(UNIT)


def planar(base, theta):
    return PLANE.ideal(np.array(base), np.zeros(len(theta)), -theta)


@pytest.mark.parametrize("alpha", [0.3, -3.0])
def test_exact_readings_at_declared_angles_begin_at_the_truth(alpha):
    theta = np.radians([0.0, 50.0, 200.0, np.nan])
    truth = [alpha, 1.1, 0.9, -0.02]
    found, off = PLANE.begin(planar(truth, np.nan_to_num(theta, nan=1.0)), theta, at_rest(4))
    assert found == pytest.approx(truth)
    assert off[:3].tolist() == [0.0] * 3
    # Without a declared angle the dwell begins where its reading points: Δφ and gains are not removed.
    assert off[3] == pytest.approx(-1.0, abs=0.15)


@pytest.mark.parametrize("theta", [[0.4], [0.4, 0.4 + math.pi]])
def test_angles_on_one_line_begin_with_a_perfect_part_at_the_start_angle(theta):
    found, _ = PLANE.begin(
        planar([2.0, 1.0, 1.0, 0.0], np.array(theta)), np.array(theta), at_rest(len(theta))
    )
    assert found == pytest.approx([2.0, 1.0, 1.0, 0.0])


def test_six_faces_show_gains_and_no_skew_and_edges_show_the_skew_of_their_axes():
    every = np.ones(6, dtype=bool)
    assert SPACE.visible(981.0 * FACES, every).tolist() == [True] * 3 + [False] * 3
    edges = np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0]]) / math.sqrt(2)
    more = np.concatenate([FACES, edges])
    assert SPACE.visible(more, np.ones(9, dtype=bool)).tolist() == [True] * 4 + [False] * 2
    level = FACES[[0, 1, 3, 4]]  # Z never sees gravity
    assert SPACE.visible(level, every[:4]).tolist() == [True, True, False, False, False, False]
    assert PLANE.visible(level[:, :2], np.zeros(4, dtype=bool)).tolist() == [False, True, True, True]


def test_start_angles_are_stated_within_half_a_turn_and_skews_as_they_are():
    alpha, _, _, delta_phi = PLANE.parameters
    assert alpha.stated(math.radians(190.0)) == pytest.approx(-170.0)
    assert delta_phi.stated(math.radians(190.0)) == pytest.approx(190.0)
    assert PLANE.parameters[1].stated(1.5) == 1.5


def test_gyros_begin_with_their_readings_at_rest_as_zeros():
    rate = np.array([[0.0, 0, 0], [0, 0, 50], [0, 0, 0]])
    zero = np.array([1.0, -2.0, 0.5])
    turned = Conditions(time_s=np.arange(3.0), rate_dps=rate)
    found, true = MeanRate().begin(
        rate + zero + [[0.1] * 3, [9.0] * 3, [-0.1] * 3], np.full(3, np.nan), turned
    )
    assert found == pytest.approx(zero)
    assert true is rate
    assert MeanRate().by_pose(turned).tolist() == [True, False, True]
    never = Conditions(time_s=np.arange(2.0), rate_dps=rate[[1, 1]])
    assert MeanRate().begin(rate[[1, 1]] + zero, np.full(2, np.nan), never)[0] == pytest.approx(zero)


def test_axes_that_cannot_be_are_refused():
    with pytest.raises(UsageError, match="no three axes"):
        axes_matrix(np.radians([60.0, 60.0, -60.0]))


def test_two_directions_across_a_vector_are_at_right_angles_to_it_and_to_each_other():
    unit = np.concatenate([FACES, np.full((1, 3), 3**-0.5)])
    both = across(unit)
    frames = np.concatenate([unit[:, :, None], both], axis=2)
    assert frames.swapaxes(1, 2) @ frames == pytest.approx(np.tile(np.eye(3), (7, 1, 1)), abs=1e-12)
