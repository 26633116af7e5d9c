"""Start values, and the parameters that poses show."""

import math

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import FreeAttitude, MeanRate, PlanarTurn, across, axes_matrix

PLANE, SPACE = PlanarTurn(981.0), FreeAttitude(981.0)
FACES = np.concatenate([np.eye(3), -np.eye(3)])


def at_rest(n):
    return Conditions(time_s=np.arange(float(n)))


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
