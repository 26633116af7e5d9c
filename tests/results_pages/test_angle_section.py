"""Error of the shown angle by method against the bound."""

import numpy as np
import pytest

import shown_angle

Cell = shown_angle.Cell


def ratios(cell, sessions=40):
    shown = shown_angle.measure(cell, sessions, (21,))
    return {method: shown_angle.figures(shown, method) for method in shown.calibration}


def test_a_goniometer_that_knows_the_effects_shows_the_angle_where_it_stands():
    truth = np.array([0.3, 1.004, 0.995, 0.006, 10.0, -10.0, 2.0, -2.0])
    theta = np.radians(shown_angle.PLACES_DEG)
    shown = shown_angle.shown_with_effects_rad(truth, shown_angle.with_effects_mg(truth, -theta))
    assert np.angle(np.exp(1j * (shown - theta))) == pytest.approx(np.zeros(72), abs=1e-12)


def test_the_angle_by_ml_is_as_good_as_the_noise_allows_and_that_of_two_positions_is_not():
    found = ratios(Cell("tumble", 12, "bias", 0.02))
    assert found["ml"].ratio == pytest.approx(1.0, abs=0.01)
    assert found["ml"].half < 0.01
    assert found["four-position"].ratio > 1.3
    assert found["paper"].ratio > 50
    assert found["two-position"].ratio > 50


def test_trusting_the_stage_costs_a_quarter_of_the_angle_where_its_fixture_is_bad():
    found = ratios(Cell("tumble", 12, "none", 0.1))
    assert found["mmpm"].ratio - found["mmpm"].half > 1.2
    assert found["ml"].ratio == pytest.approx(1.0, abs=0.01)


def test_two_positions_reach_the_bound_of_a_part_without_bias_and_have_none_with_one():
    found = ratios(Cell("two-position", None, "none", 0.02))
    assert found["two-position"].ratio == pytest.approx(1.0, abs=0.01)
    assert ratios(Cell("two-position", None, "bias", 0.02), 3)["ml"].bound is None


def test_the_bound_grows_by_the_effects_that_have_to_be_found():
    rng = np.random.default_rng(3)
    draw = shown_angle.draw_of(Cell("tumble", 12, "quadratic, cubic", 0.02), rng)
    bounds = [shown_angle.bounds_deg(Cell("tumble", 12, kind, 0.02), draw) for kind in shown_angle.KINDS]
    own = [np.sqrt((one[0] ** 2).mean()) for one in bounds]
    assert own[0] == pytest.approx(own[1], rel=0.01)
    assert own[1] < own[2] < own[3]
