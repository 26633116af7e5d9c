"""Arrays of numbers against numpy, scipy and geometry."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from adis_gonio.base.arrays import (
    block_means,
    cumulative_integral,
    log_sum_exp,
    mean_direction,
    rotation_matrices,
    unit_directions,
    wrap_degrees,
    wrap_radians,
)


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(179.0, 179.0), (180.0, -180.0), (-180.0, -180.0), (540.5, -179.5), (-190.0, 170.0)],
)
def test_half_a_turn_is_wrapped_to_its_negative(angle, wrapped):
    assert wrap_degrees(angle) == wrapped
    assert wrap_radians(np.radians([angle])) == pytest.approx(np.radians([wrapped]))


def test_rotations_are_those_of_scipy_also_by_nothing():
    vectors = np.random.default_rng(1).normal(size=(2, 3, 3))
    vectors[0, 0] = 0.0
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    assert rotation_matrices(vectors) == pytest.approx(matrices.reshape(2, 3, 3, 3))


def test_directions_have_length_one_and_their_components_across():
    across = np.array([[9.0, 0.1, -0.2], [0.3, 9.0, 0.0], [1.0, 1.0, 9.0]])
    found = unit_directions(across)
    assert found[:2] == pytest.approx(np.array([[0.95**0.5, 0.1, -0.2], [0.3, 0.91**0.5, 0.0]]))
    assert found[2] == pytest.approx([1.0, 1.0, 0.0])  # too long: nothing along its axis


def test_the_mean_of_directions_on_both_sides_of_half_a_turn_is_between_them():
    assert wrap_degrees(np.degrees(mean_direction(np.radians([170.0, -150.0]))) - 190.0) == pytest.approx(0)


def test_an_integral_begins_at_zero_and_is_the_trapezoidal_rule():
    time = np.array([0.0, 1.0, 1.5, 4.0])
    values = np.random.default_rng(2).normal(size=(4, 3))
    for rate in (values, values[:, 0]):
        assert cumulative_integral(rate, time) == pytest.approx(
            cumulative_trapezoid(rate, time, axis=0, initial=0)
        )


def test_blocks_of_different_lengths_have_their_own_means():
    values = np.arange(12.0).reshape(6, 2)
    assert block_means(values, np.array([0, 1, 4])).tolist() == [[0, 1], [4, 5], [9, 10]]


def test_a_sum_of_exponentials_is_that_of_scipy_without_overflow():
    values = np.array([[1000.0, 1001.0, -np.inf], [-np.inf, -np.inf, -np.inf]])
    for axis in (None, 0, 1, (0, 1)):
        assert log_sum_exp(values, axis) == pytest.approx(logsumexp(values, axis=axis))
