"""Columns of terms: what each amplitude adds to which axis, written out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from adis_gonio.fitting.estimation.terms import Basis, NamedTerm, NamelessTerm
from adis_gonio.model.effects import Conditions, effect

IDEAL = np.array([[500.0, -800.0, 300.0], [-200.0, 900.0, 400.0], [1000.0, 100.0, -50.0]])
TIME = np.array([0.0, 2.0, 5.0])
CONDITIONS = Conditions(time_s=TIME)
IN_G = IDEAL / 1000
LINE_AND_SQUARE = Basis("t, t²", ("time",), lambda c: np.column_stack([c.time_s, c.time_s**2]))
SQUARE_OF_OWN = Basis("u²", ("reading",), by_axis=lambda driven, axis: driven[:, axis, None] ** 2)


def nameless(where: str, axes: tuple[int, ...], basis: Basis, **more: object) -> NamelessTerm:
    return NamelessTerm("one", basis.covariates, 0.0, where, axes, basis, **more)


def test_a_bias_adds_its_functions_to_its_own_axes_each_with_amplitudes_of_its_own() -> None:
    added = nameless("bias", (2, 0), LINE_AND_SQUARE).added(
        np.array([3.0, 0.5, -2.0, 0.25]), IDEAL, CONDITIONS
    )
    np.testing.assert_allclose(added[:, 2], 3.0 * TIME + 0.5 * TIME**2)
    np.testing.assert_allclose(added[:, 0], -2.0 * TIME + 0.25 * TIME**2)
    assert not added[:, 1].any()


def test_a_gain_multiplies_what_its_own_axis_reads_in_g() -> None:
    added = nameless("gain", (1,), LINE_AND_SQUARE).added(np.array([3.0, 0.5]), IDEAL, CONDITIONS)
    np.testing.assert_allclose(added[:, 1], (3.0 * TIME + 0.5 * TIME**2) * IDEAL[:, 1] / 1000)
    assert not added[:, [0, 2]].any()


def test_a_misalignment_multiplies_what_each_of_the_other_axes_reads() -> None:
    term = nameless("misalignment", (1, 2), Basis("t", ("time",), lambda c: c.time_s[:, None]))
    added = term.added(np.array([4.0, 7.0, -1.0, 2.0]), IDEAL, CONDITIONS)
    np.testing.assert_allclose(added[:, 1], TIME * (4.0 * IN_G[:, 0] + 7.0 * IN_G[:, 2]))
    np.testing.assert_allclose(added[:, 2], TIME * (-1.0 * IN_G[:, 0] + 2.0 * IN_G[:, 1]))
    assert not added[:, 0].any()


def test_a_function_of_the_reading_is_of_each_axis_own() -> None:
    added = nameless("bias", (0, 2), SQUARE_OF_OWN).added(np.array([5.0, -3.0]), IDEAL, CONDITIONS)
    np.testing.assert_allclose(added[:, 0], 5.0 * IN_G[:, 0] ** 2)
    np.testing.assert_allclose(added[:, 2], -3.0 * IN_G[:, 2] ** 2)
    by_gain = nameless("gain", (0,), SQUARE_OF_OWN).added(np.array([5.0]), IDEAL, CONDITIONS)
    np.testing.assert_allclose(by_gain[:, 0], 5.0 * IN_G[:, 0] ** 3)


def test_what_drives_a_gain_may_be_another_quantity_than_the_reading() -> None:
    rates = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
    term = nameless("gain", (1,), LINE_AND_SQUARE, stimulus=lambda ideal, conditions: rates)
    np.testing.assert_allclose(term.columns(IDEAL, CONDITIONS)[:, 1, 0], TIME * rates[:, 1])


def test_an_angle_turns_the_part_by_thousandths_of_a_radian_an_amplitude() -> None:
    term = nameless("angle", (), LINE_AND_SQUARE)
    assert term.enters_angle
    np.testing.assert_allclose(
        term.added(np.array([3.0, 0.5]), IDEAL, CONDITIONS), 1e-3 * (3.0 * TIME + 0.5 * TIME**2)
    )
    assert not nameless("bias", (0,), LINE_AND_SQUARE).enters_angle


def test_a_nameless_term_is_said_by_place_and_formula_and_keeps_its_amplitudes() -> None:
    term = nameless("gain", (0, 2), LINE_AND_SQUARE, prior_sd=25.0)
    assert term.shown_as == "unnamed: gain of x, z follows t, t²"
    assert nameless("angle", (), LINE_AND_SQUARE).shown_as == "unnamed: true angle follows t, t²"
    assert term.name is None
    assert term.prior_sd == 25.0
    amplitudes = np.array([1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(term.start(amplitudes), amplitudes)
    assert term.amplitude_index(amplitudes) == [0, 1, 2, 3]
    slope = term.derivative(amplitudes, IDEAL, CONDITIONS)
    np.testing.assert_allclose(slope @ amplitudes, term.added(amplitudes, IDEAL, CONDITIONS))


def test_what_is_only_rounding_stands_for_nothing_and_conditions_are_not_mixed_up() -> None:
    calls = []

    def fifth_harmonic(conditions: Conditions) -> np.ndarray:
        calls.append(conditions)
        theta = conditions.angle_rad
        return np.column_stack([np.sin(5 * theta), np.cos(5 * theta)])

    basis = Basis("5θ", ("angle",), fifth_harmonic)
    grid = Conditions(time_s=np.arange(10.0), angle_rad=np.radians(36.0 * np.arange(10)))
    between = Conditions(time_s=np.arange(10.0), angle_rad=np.radians(30.0 * np.arange(10)))
    on_grid = basis.over(grid)
    assert not on_grid[:, 0].any()
    np.testing.assert_allclose(on_grid[:, 1], np.cos(np.pi * np.arange(10)))
    assert basis.over(grid) is on_grid
    np.testing.assert_allclose(basis.over(between)[:, 0], np.sin(5 * between.angle_rad))
    assert len(calls) == 2


@pytest.fixture
def warming() -> NamedTerm:
    """Warm-up of two axes, its time constant at 600 s of the grid."""
    return NamedTerm("warm_up", ("time",), 0.0, effect("warm_up", ("x", "y")), ((2, 600.0),))


def test_columns_of_a_named_term_are_the_slopes_by_its_amplitudes_at_the_shape_of_the_grid(
    warming: NamedTerm,
) -> None:
    conditions = Conditions(time_s=np.array([0.0, 300.0, 1200.0]))
    columns = warming.columns(IDEAL, conditions)
    assert columns.shape == (3, 3, 2)
    started = warming.start(np.array([4.0, -6.0]))
    np.testing.assert_array_equal(started, [4.0, -6.0, 600.0])
    assert warming.amplitude_index(started) == [0, 1]
    # It is linear in its amplitudes.
    np.testing.assert_allclose(columns @ [4.0, -6.0], warming.added(started, IDEAL, conditions))
    step = 1e-3
    for k in range(3):
        by = step * np.eye(3)[k]
        slope = (
            warming.added(started + by, IDEAL, conditions) - warming.added(started - by, IDEAL, conditions)
        ) / (2 * step)
        np.testing.assert_allclose(
            warming.derivative(started, IDEAL, conditions)[:, :, k], slope, atol=1e-8
        )


def test_a_shape_at_most_doubles_or_halves_in_a_step_and_all_stay_within_their_bounds(
    warming: NamedTerm,
) -> None:
    old = np.array([1.0, 2.0, 600.0])
    np.testing.assert_array_equal(warming.limited(old, np.array([3.0, -4.0, 5000.0])), [3.0, -4.0, 1200.0])
    np.testing.assert_array_equal(warming.limited(old, np.array([3.0, -4.0, 5.0])), [3.0, -4.0, 300.0])
    np.testing.assert_array_equal(warming.limited(old, np.array([3.0, -4.0, 700.0])), [3.0, -4.0, 700.0])
    low, high = warming.bounds.T
    np.testing.assert_array_equal(warming.limited(old, np.array([1e9, -1e9, 600.0]))[:2], [high[0], low[1]])


def test_what_a_named_term_says_of_itself(warming: NamedTerm) -> None:
    assert warming.name == warming.shown_as == "warm_up"
    assert warming.prior_sd is None
    assert NamedTerm("warm_up", (), 0.0, effect("warm_up", ("x",)), prior_sd=3.0).prior_sd == 3.0
    assert not warming.enters_angle
    assert warming.dwell is None
    assert NamedTerm("slip", (), 0.0, effect("position_slip", ("x",), dwell=7)).dwell == 7


def test_an_effect_of_the_stage_turns_the_part_by_what_its_formula_says() -> None:
    theta = np.radians([0.0, 40.0, 200.0])
    term = NamedTerm("stage", (), 0.0, effect("stage_eccentricity", ("x", "y")))
    assert term.enters_angle
    turned = term.added(np.array([0.2, -0.1]), IDEAL, Conditions(time_s=TIME, angle_rad=theta))
    np.testing.assert_allclose(turned, np.radians(0.2 * np.sin(theta) - 0.1 * np.cos(theta)))


def test_a_nameless_term_acts_on_every_dwell() -> None:
    assert nameless("bias", (0,), LINE_AND_SQUARE).dwell is None
