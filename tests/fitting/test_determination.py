"""What a session determines, by algebra on matrices whose answer is known."""

import math

import numpy as np
import pytest

from adis_gonio.fitting.determination import covariance, format_directions, is_determined

FREE = np.ones(3, dtype=bool)
NOTHING = np.zeros((3, 0))


def information(seed=3, size=3):
    rows = np.random.default_rng(seed).standard_normal((9, size)) * [1.0, 1e3, 1e-3][:size]
    return rows.T @ rows


def test_the_covariance_of_what_is_free_is_the_inverse_information():
    fisher = information()
    np.testing.assert_allclose(covariance(fisher, FREE, NOTHING), np.linalg.inv(fisher), rtol=1e-8)


def test_what_is_held_has_no_covariance_and_the_rest_that_of_a_fit_without_it():
    fisher, free = information(), np.array([True, False, True])
    found = covariance(fisher, free, NOTHING)
    assert not found[1].any()
    assert not found[:, 1].any()
    np.testing.assert_allclose(
        found[np.ix_(free, free)], np.linalg.inv(fisher[np.ix_(free, free)]), rtol=1e-8
    )


def test_along_a_lost_direction_there_is_no_covariance_and_across_it_the_pseudo_inverse():
    lost = np.array([[1.0], [1.0], [0.0]]) / math.sqrt(2)
    rows = np.random.default_rng(5).standard_normal((9, 3))
    rows -= rows @ lost @ lost.T  # rows that do not see their sum
    found = covariance(rows.T @ rows, FREE, lost)
    np.testing.assert_allclose(found, np.linalg.pinv(rows.T @ rows, rcond=1e-10), atol=1e-12)
    np.testing.assert_allclose(found @ lost, 0, atol=1e-12)
    assert is_determined(np.array([1.0, -1.0, 0.0]), lost)
    assert is_determined(np.array([0.0, 0.0, 1e-6]), lost)
    assert not is_determined(np.array([1.0, 1.0, 0.0]), lost)
    assert not is_determined(np.array([1e-6, 0.0, 0.0]), lost), "whatever the unit"
    assert is_determined(np.array([1.0, 1.0, 0.0]), NOTHING)


@pytest.mark.parametrize(
    ("direction", "words"),
    [
        ([0.0, -1.0, 0.0], "b"),
        ([0.05, 0.998, 0.03], "b"),
        ([0.6, 0.0, -0.8], "0.80·c −0.60·a"),
        ([-0.6, 0.0, 0.8], "0.80·c −0.60·a"),
        ([0.6, 0.8, 0.0], "0.80·b +0.60·a"),
    ],
)
def test_a_lost_direction_is_said_by_its_largest_parts_with_the_first_positive(direction, words):
    assert format_directions(np.array([direction]).T, ("a", "b", "c")) == [words]
