"""The conic through points: against the ellipse, circle or ellipsoid that the points were taken from."""

import math

import numpy as np
import pytest

from adis_gonio.base.errors import FitError
from adis_gonio.fitting.estimation.readings import conic_through

TURNED = np.array([[math.cos(0.4), -math.sin(0.4)], [math.sin(0.4), math.cos(0.4)]])


def on_ellipse(angles, axes, centre, turned=TURNED):
    """Points of an ellipse by their parameter, and the matrix that its equation has."""
    unit = np.column_stack([np.cos(angles), np.sin(angles)])
    matrix = turned @ np.diag(1 / np.square(axes)) @ turned.T
    return (unit * axes) @ turned.T + centre, matrix


@pytest.mark.parametrize("count", [5, 6, 40])
def test_points_of_a_turned_ellipse_give_its_centre_and_matrix_in_any_unit(count):
    angles = np.linspace(0.1, 5.9, count)
    for size in (1e-3, 1.0, 3e4):
        points, matrix = on_ellipse(angles, np.array([3.0, 2.0]) * size, np.array([20.0, -7.0]) * size)
        centre, found = conic_through(points)
        np.testing.assert_allclose(centre, np.array([20.0, -7.0]) * size, rtol=1e-8)
        np.testing.assert_allclose(found * size**2, matrix * size**2, rtol=1e-7)


def test_points_of_an_ellipsoid_give_its_centre_and_matrix():
    rng = np.random.default_rng(4)
    unit = rng.standard_normal((9, 3))
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    shape = np.array([[2.0, 0.1, -0.2], [0.0, 1.5, 0.3], [0.0, 0.0, 1.1]])
    centre, found = conic_through(unit @ shape.T + [5.0, -3.0, 100.0])
    np.testing.assert_allclose(centre, [5.0, -3.0, 100.0], rtol=1e-7)
    np.testing.assert_allclose(found, np.linalg.inv(shape @ shape.T), rtol=1e-6, atol=1e-9)


def test_four_points_of_an_upright_ellipse_are_enough_for_it():
    points, matrix = on_ellipse(
        np.array([0.2, 1.9, 3.0, 4.4]), np.array([3.0, 2.0]), np.array([1.0, 2.0]), np.eye(2)
    )
    centre, found = conic_through(points)
    np.testing.assert_allclose(centre, [1.0, 2.0], rtol=1e-9)
    np.testing.assert_allclose(found, matrix, rtol=1e-9, atol=1e-12)


def test_three_points_give_the_circle_through_them_and_four_in_space_the_sphere():
    # Right angle at the origin: the hypotenuse is the diameter (Thales).
    centre, matrix = conic_through(np.array([[0.0, 0.0], [6.0, 0.0], [0.0, 8.0]]))
    np.testing.assert_allclose(centre, [3.0, 4.0], rtol=1e-12)
    np.testing.assert_allclose(matrix, np.eye(2) / 25, rtol=1e-12, atol=1e-15)
    corners = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 6.0]])
    centre, matrix = conic_through(corners)
    np.testing.assert_allclose(centre, [1.0, 2.0, 3.0], rtol=1e-12)
    np.testing.assert_allclose(matrix, np.eye(3) / 14, rtol=1e-12, atol=1e-15)


def test_points_of_a_hyperbola_give_the_nearest_figure_that_is_closed():
    # xy = 1 has no ellipse among the quadrics through it; a sensor's reading has no other figure.
    x = np.array([0.3, 0.5, 1.0, 2.0, 4.0])
    _, matrix = conic_through(np.column_stack([x, 1 / x]))
    assert np.linalg.eigvalsh(matrix).min() > 0


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((6, 2)), "at least 7"),
        (np.array([[0.0, 1.0], [1.0, 0.0]]), "2 positions .* at least 7"),
        (np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]]), "3 positions .* at least 9"),
        (np.column_stack([np.arange(7.0), 2 * np.arange(7.0)]), "lie on no ellipsoid"),
    ],
)
def test_points_in_one_place_too_few_or_on_a_line_are_refused(points, words):
    with pytest.raises(FitError, match=words):
        conic_through(points)
