"""Propagation of distributions: what is drawn, what is made of the draws, and what is said of them."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from adis_gonio import fit
from adis_gonio.base.errors import FitError
from adis_gonio.base.numbers import NAMES
from adis_gonio.base.uncertainty import Value
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.fitting import monte_carlo as module
from adis_gonio.fitting.fit_result import FitResult
from adis_gonio.fitting.monte_carlo import monte_carlo
from adis_gonio.fitting.uncertainty import TEMPERATURE, Sources
from fitting.test_uncertainty import FOUR, turn

SIGMA_DEG = 0.02
DRAWS = 1000


@pytest.fixture(scope="module")
def few() -> FitResult:
    """Four positions of three samples each: eight degrees of freedom an axis."""
    return fit(turn(FOUR, samples=3, noise=1.0, sigma=0.0), "four-position")


@pytest.fixture(scope="module")
def stated() -> FitResult:
    """Four positions of stated uncertainty, 0.1 mg and 0.02°."""
    return fit(turn(FOUR), "four-position")


def moved(made: object, draws: int = DRAWS, sources: Sources | None = None) -> np.ndarray:
    draw = module._drawing(made, sources or Sources(()), np.random.default_rng(1))
    return np.array([draw().mean for _ in range(draws)]) - made.readings.mean


def test_readings_are_drawn_with_their_noise_and_turned_by_the_stage(stated: FitResult) -> None:
    made = stated.origin
    found = moved(made)
    # Across the direction of gravity a turn does not show: there only noise is left.
    tangent = made.fit.tangent[:, :, 0]
    expected = 0.1**2 + (math.radians(SIGMA_DEG) * tangent) ** 2
    error = np.sqrt(2 / DRAWS)
    np.testing.assert_allclose(found.var(axis=0), expected, rtol=5 * error)
    assert (np.abs(found.mean(axis=0)) < 5 * np.sqrt(expected / DRAWS)).all()
    products = np.einsum("dna,dnb->nab", found, found)[:, 0, 1] / DRAWS
    by_stage = math.radians(SIGMA_DEG) ** 2 * tangent.prod(axis=1)
    np.testing.assert_allclose(products, by_stage, atol=5 * expected.max() / math.sqrt(DRAWS))


def test_a_converters_step_is_drawn_as_a_rectangle_and_what_dwells_share_together(
    stated: FitResult,
) -> None:
    made = stated.origin
    data = made.readings
    quantization, flicker = np.full((4, 2), 0.5), np.full((4, 2), 0.2)
    own = data.own_covariance + (quantization + flicker)[:, :, None] * np.eye(2)
    slow = np.zeros((4, 2, 1))
    slow[:, 0, 0] = 2.0
    changed = replace(data, own_covariance=own, quantization=quantization, flicker=flicker, slow=slow)
    still = replace(made.fit, data=replace(made.fit.data, fixture_rad=0.0))
    found = moved(replace(made, readings=changed, fit=still))
    # Student's kurtosis is 3, a rectangle's 1.8: that of the sum is between by the squared shares.
    variance = np.array([4.0 + 0.7 + 0.01, 0.7 + 0.01])
    np.testing.assert_allclose(found.var(axis=0), np.tile(variance, (4, 1)), rtol=5 * math.sqrt(2 / DRAWS))
    assert (np.abs(found.mean(axis=0)) < 5 * np.sqrt(variance / DRAWS)).all()
    kurtosis = (found[:, :, 1] ** 4).mean() / (found[:, :, 1] ** 2).mean() ** 2
    assert kurtosis == pytest.approx(3 - 1.2 * (0.5 / 0.71) ** 2, abs=0.3)
    # The shared part moves all dwells alike.
    shared = np.mean(found[:, 0, 0] * found[:, 3, 0])
    assert shared == pytest.approx(4.0, rel=5 * math.sqrt(2 / DRAWS))


def test_scatter_beyond_the_noise_is_drawn_with_the_students_factor_of_its_degrees_of_freedom(
    stated: FitResult,
) -> None:
    made = stated.origin
    noise = replace(made.noise, extra_mg=3.0, dof=12.0)
    still = replace(made.fit, data=replace(made.fit.data, fixture_rad=0.0))
    found = moved(replace(made, noise=noise, fit=still), 1500)
    assert found.var() == pytest.approx((3.0**2 + 0.1**2) * 12 / 10, rel=0.1)


def test_a_fixture_that_is_estimated_is_drawn_with_the_students_factor_too(stated: FitResult) -> None:
    made = stated.origin
    noise = replace(made.noise, sigma_dof=12.0)
    wide = replace(made.fit, data=replace(made.fit.data, fixture_rad=0.01))
    found = moved(replace(made, noise=noise, fit=wide), 1500)
    along = (0.01 * made.fit.tangent[:, :, 0]) ** 2
    assert found.var(axis=0).sum() == pytest.approx((along * 12 / 10 + 0.1**2).sum(), rel=0.1)


def test_an_unseen_bias_is_drawn_once_for_all_dwells() -> None:
    session = replace(turn((0, 90)), sensor="adis16354")
    result = fit(session, "two-position")
    found = moved(result.origin, sources=result.sources)
    u = VARIANTS["adis16354"].performance.initial_bias_mg
    np.testing.assert_allclose(found.std(axis=0), u, rtol=5 / math.sqrt(2 * DRAWS))
    assert (found[:, 0] - found[:, 1]).std() < 0.1 * u
    assert abs(np.corrcoef(found[:, 0].T)[0, 1]) < 5 / math.sqrt(DRAWS)


def test_coefficients_of_temperature_are_drawn_once_for_all_dwells(stated: FitResult) -> None:
    made = stated.origin
    columns = np.array([-3.0, -1.0, 1.0, 3.0])[:, None, None] * np.eye(2)
    own = next(one for one in stated.sources.each if one.name == TEMPERATURE)
    found = moved(made, sources=Sources((replace(own, acts_mg=columns),)))
    np.testing.assert_allclose(found.std(axis=0)[[0, 3]], 3.0, rtol=0.15)
    np.testing.assert_allclose(found[:, 0], -found[:, 3], atol=3.0)
    assert (found[:, 0] + found[:, 3]).std() < 0.8


def test_attitudes_that_are_free_are_drawn_where_they_stand(stated: FitResult) -> None:
    made = stated.origin
    free = replace(made.fit, data=replace(made.fit.data, fixture_rad=math.inf))
    np.testing.assert_allclose(moved(replace(made, fit=free)).std(axis=0), 0.1, rtol=0.15)


def test_what_rests_on_one_estimate_is_drawn_with_one_factor() -> None:
    rng = np.random.default_rng(7)
    dof = np.array([[6.0, math.inf], [6.0, 9.0], [40.0, 6.0]])
    estimate = np.array([[0, 1], [0, 2], [2, 3]])
    drawn = np.array([module._students(rng, dof, estimate) for _ in range(4000)])
    assert (drawn[:, 0, 1] == 1).all(), "what was stated is no estimate"
    np.testing.assert_array_equal(drawn[:, 0, 0], drawn[:, 1, 0])
    np.testing.assert_array_equal(drawn[:, 1, 1], drawn[:, 2, 0])
    assert (drawn[:, 0, 0] != drawn[:, 2, 1]).all()
    # χ² of ν degrees of freedom: the mean of ν/χ² is ν/(ν − 2). Of two ν that claim one estimate the less.
    assert (drawn[:, 1, 1] ** 2).mean() == pytest.approx(9 / 7, rel=0.05)
    assert (drawn[:, 0, 0] ** 2).mean() == pytest.approx(6 / 4, rel=0.1)


@pytest.mark.parametrize("kind", ["normal", "uniform", "arcsine", "exponential"])
def test_the_doubt_is_the_scatter_of_the_standard_deviation(few: FitResult, kind: str) -> None:
    rng = np.random.default_rng(2)
    linear = Value(0.0, 1.0, "1")
    draw = {
        "normal": rng.standard_normal,
        "uniform": rng.uniform,
        "arcsine": partial(rng.beta, 0.5, 0.5),
        "exponential": rng.standard_exponential,
    }
    cause = few.sources, few.outputs[0].gradient
    found = [module._propagated(linear, draw[kind](size=800), *cause) for _ in range(300)]
    u = np.array([one.u for one in found])
    # 300 sessions know a scatter to 4 %; of heavy tails the kurtosis itself is uncertain and low.
    wide = 0.2 if kind == "exponential" else 0.1
    assert np.mean([one.doubt for one in found]) == pytest.approx(u.std() / u.mean(), rel=wide)


def test_the_interval_leaves_as_much_below_as_above(few: FitResult) -> None:
    values = 3.0 + np.random.default_rng(3).standard_exponential(100_000)
    found = module._propagated(Value(4.0, 1.0, "1"), values, few.sources, few.outputs[0].gradient)
    assert found.low == pytest.approx(3.0 - math.log(0.975), abs=0.003)
    assert found.high == pytest.approx(3.0 - math.log(0.025), abs=0.06)
    assert found.u == pytest.approx(1.0, abs=0.02)


def test_angles_on_both_sides_of_half_a_turn_are_neighbours(few: FitResult) -> None:
    values = np.array([179.9, -179.9, 180.0, 179.8, -179.8])
    found = module._propagated(Value(-179.9, 0.1, "deg"), values, few.sources, few.outputs[0].gradient)
    assert found.u == pytest.approx(np.std([-0.1, 0.1, 0.0, -0.2, 0.2], ddof=1))
    assert -180.3 < found.low < -180.0 < found.high < -179.7


@pytest.mark.parametrize("name", ["bias_x", "alpha", "scale_y"])
def test_students_standard_deviation_is_wider_by_its_degrees_of_freedom(few: FitResult, name: str) -> None:
    linear = few[name]
    assert linear.dof == pytest.approx(8)
    wide = module._students_u(few.sources, few.outputs[few.names.index(name)].gradient)
    assert wide == pytest.approx((linear.u or 0) * math.sqrt(8 / 6))


def test_why_two_ways_differ_is_told_by_what_explains_it(few: FitResult) -> None:
    linear = few["bias_x"]
    wide = linear.u * math.sqrt(8 / 6)
    assert module._explain_difference(linear, linear.u, 0.01, wide) == ""
    by_student = module._explain_difference(linear, wide, 0.01, wide)
    assert by_student.startswith("u is 1.15 times the linear one: with 8 degrees of freedom Student's")
    # A hundredth and two standard errors of the trials are no difference.
    assert module._explain_difference(linear, 1.018 * linear.u, 0.005, wide) == ""
    assert module._explain_difference(linear, 1.022 * linear.u, 0.005, wide)
    bent = module._explain_difference(linear, 1.5 * wide, 0.01, wide)
    assert bent.startswith("u is 1.73 times the linear one: the model is not linear enough")
    nothing = replace(linear, u=None)
    assert module._explain_difference(nothing, 1.0, 0.01, wide).startswith("the linear u is zero")


def test_values_of_students_distribution_are_hardly_ever_taken_for_a_model_that_bends(
    few: FitResult,
) -> None:
    linear = few["bias_x"]
    cause = few.sources, few.outputs[few.names.index("bias_x")].gradient
    rng = np.random.default_rng(4)
    factor = np.sqrt(8 / rng.chisquare(8, (300, 400)))
    drawn = linear.value + linear.u * factor * rng.standard_normal((300, 400))
    told = [module._propagated(linear, own, *cause).why for own in drawn]
    # Three standard errors of heavy tails: 1 % of all at most.
    assert sum("not linear" in why for why in told) <= 3
    assert sum("Student" in why for why in told) > 100


def test_an_estimate_without_a_part_in_a_parameter_does_not_widen_it() -> None:
    parts = [(0, math.inf, 1.0), (4, 1.0, 0.0), (4, 1.0, 1e-12), (1, 6.0, 2.0)]
    sources = SimpleNamespace(parts=lambda gradient: parts)
    wide = module._students_u(sources, np.ones(6))
    assert wide == pytest.approx(math.sqrt(1.0 + 2.0 * 6 / 4))


def test_with_two_degrees_of_freedom_no_standard_deviation_exists() -> None:
    result = fit(turn((0, 90), samples=2, noise=1.0, sigma=0.0, bias=(0.0, 0.0)), "two-position")
    linear = result["scale_x"]
    assert linear.dof == pytest.approx(2, abs=0.01)
    wide = module._students_u(result.sources, result.outputs[result.names.index("scale_x")].gradient)
    assert math.isinf(wide)
    assert "no standard deviation exists" in module._explain_difference(linear, 5 * linear.u, 0.05, wide)


def test_a_run_gives_each_parameter_both_ways_as_table_and_document(stated: FitResult) -> None:
    run = monte_carlo(stated, 100, np.random.default_rng(5))
    assert (run.method, run.trials, run.failed) == ("four-position", 100, 0)
    head, rows = run.rows()
    assert [row[0] for row in rows] == [NAMES.get(name, name) for name in stated.parameters]
    for (name, p), row in zip(run.parameters.items(), rows, strict=True):
        # 100 trials know u to 7 %.
        assert p.u == pytest.approx(p.linear.u, rel=0.3)
        assert p.low < p.linear.value < p.high
        entry = run.as_dict()["parameters"][name]
        assert entry["u_standard_error"] == pytest.approx(p.u / math.sqrt(200), rel=0.4)
        assert entry["linear_U"] == pytest.approx(entry["linear_u"] * p.linear.k)
        assert entry["agrees"] == (p.why == "")
        by_head = dict(zip(head, row, strict=True))
        low, high = (float(by_head[name].replace("−", "-")) for name in ("from", "to"))
        assert (high - low) / 2 == pytest.approx((p.high - p.low) / 2, rel=0.05)
        assert float(by_head["U, linear"]) == pytest.approx(p.linear.U, rel=0.05)


def test_what_is_remarked_on_are_differences_and_lost_trials(stated: FitResult) -> None:
    run = monte_carlo(stated, 20, np.random.default_rng(5))
    agreeing = replace(run, parameters={name: replace(p, why="") for name, p in run.parameters.items()})
    assert agreeing.remarks == ["the linear uncertainties agree within 1 % and the error of the trials"]
    bent = {"delta_k": replace(run.parameters["delta_k"], why="it bends")}
    differing = replace(run, failed=3, parameters=bent)
    assert differing.remarks == ["ΔK: it bends", "3 trials gave no result and were left out"]


def test_trials_without_a_result_are_counted_and_none_at_all_is_an_error(
    stated: FitResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    method, asked = module.METHOD_TABLE["four-position"], []

    def every_third(data: object, made: object) -> object:
        asked.append(data)
        if len(asked) % 3 == 0:
            raise FitError("not determined")
        return method.refit(data, made)

    monkeypatch.setitem(module.METHOD_TABLE, "four-position", replace(method, refit=every_third))
    run = monte_carlo(stated, 12, np.random.default_rng(6))
    assert (run.trials, run.failed) == (8, 4)
    assert monte_carlo(stated, 2, np.random.default_rng(6)).trials == 2
    with pytest.raises(FitError, match="no trial"):
        monte_carlo(stated, 1, np.random.default_rng(6))
    unknown = fit(turn((0, 90), noise=0.0, sigma=0.0, stated=None, bias=(0.0, 0.0)))
    with pytest.raises(FitError, match="noise of a reading is unknown"):
        monte_carlo(unknown, 5, np.random.default_rng(6))
