"""A wide stage makes the start angle less sure, and not unknown; `plan` foresees what `fit` states."""

import math
from functools import cache

import numpy as np
import pytest

import plan_statistics as statistics
from adis_gonio.base.errors import UsageError
from adis_gonio.fitting.methods import fit_readings
from adis_gonio.plan.prediction import LARGEST_FIXTURE_DEG, Bench, expected_readings, predict_uncertainty
from adis_gonio.record.plans import plan

ALPHA = statistics.NAMES.index("alpha")


@cache
def _drawn(name: str, fixture_deg: float):
    """Fits of 40 sessions with the truth of each by `NAMES[:-1]`."""
    case = statistics.Case(name, plan(name), Bench(fixture_deg))
    bare, rng = expected_readings(case.plan, case.bench), np.random.default_rng(31)
    drawn = (statistics.drawn(case, rng, bare) for _ in range(40))
    return [(fit_readings(readings), truth) for readings, truth, _ in drawn]


@pytest.mark.parametrize("fixture_deg", [3.0, 10.0, 30.0])
def test_the_start_angle_is_known_as_well_as_the_mean_of_the_declared_ones(fixture_deg):
    covered = []
    for result, truth in _drawn("mmpm", fixture_deg):
        alpha = result["alpha"]
        assert alpha.u == pytest.approx(fixture_deg / math.sqrt(9), rel=0.05)
        assert result.shown_angle.u == pytest.approx(alpha.u, rel=0.02)  # the angle counts from there
        assert result.undetermined == ()
        covered.append(abs(alpha.value - truth[ALPHA]) <= alpha.U)
    # 95 % of 40 is 38; 33 or fewer come by chance once in 250.
    assert sum(covered) > 33


def test_four_positions_and_a_wide_stage_state_the_angle_between_the_axes_by_the_stage():
    z = {"delta_phi": [], "alpha": [], "delta_k": []}
    for result, truth in _drawn("four-position", 8.0):
        for name, values in z.items():
            values.append((result[name].value - truth[statistics.NAMES.index(name)]) / result[name].u)
        assert result["delta_phi"].u == pytest.approx(8.0, rel=0.5)
        assert any("only the stage" in line and "(8°)" in line for line in result.warnings)
    for name, values in z.items():
        # A standard deviation of 40 is known to 11 %.
        assert 0.6 < math.sqrt(np.mean(np.square(values))) < 1.4, name


def test_an_angle_that_rests_on_what_is_not_determined_has_no_uncertainty():
    exact = expected_readings(plan("four-position"), Bench(25.0))
    result = fit_readings(exact)
    assert "delta_phi" in result.undetermined
    assert result.shown_angle.u is None
    assert "angle" not in result.budget
    assert "delta_k" in result.budget


@pytest.mark.parametrize(("name", "fixture_deg"), [("four-position", 8.0), ("mmpm", 30.0)])
def test_a_plan_foresees_what_the_fit_states(name, fixture_deg):
    foreseen = predict_uncertainty(plan(name), Bench(fixture_deg, start_deg=2.0))
    stated = {quantity: [] for quantity in ("alpha", "delta_phi")}
    for result, _ in _drawn(name, fixture_deg):
        for quantity, values in stated.items():
            values.append(result[quantity].u)
    for quantity, values in stated.items():
        assert foreseen.parameters[quantity].u == pytest.approx(np.median(values), rel=0.1), quantity


def test_of_few_positions_a_wide_stage_makes_the_gains_less_sure_and_the_plan_says_so():
    exact, wide = (predict_uncertainty(plan("four-position"), Bench(deg)) for deg in (0.01, 8.0))
    assert wide.parameters["delta_k"].u > 10 * exact.parameters["delta_k"].u
    assert any("depends on the errors of the stage" in note for note in wide.notes)
    assert not any("depends on the errors of the stage" in note for note in exact.notes)


def test_a_plan_takes_a_stage_as_wide_as_a_hand_and_no_wider():
    assert Bench(LARGEST_FIXTURE_DEG).fixture_deg == LARGEST_FIXTURE_DEG
    with pytest.raises(UsageError, match=r"fixture is 31°: take 0 to 30°"):
        Bench(31.0)
