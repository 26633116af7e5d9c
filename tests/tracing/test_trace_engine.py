"""The engine of `trace` on readings whose truth is known: whitening, search, names, held-out honesty."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

from adis_gonio.base.errors import FitError
from adis_gonio.fitting.estimation.fit import Fit, adequacy, amplitude_spreads
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.model.effects import Conditions, effect
from adis_gonio.tracing.grammar import nameless_terms
from adis_gonio.tracing.linear_problem import Products, amplitudes, linearise, span
from adis_gonio.tracing.model_search import price, search
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.selection import select
from adis_gonio.tracing.session_blocks import orthonormal
from adis_gonio.tracing.trace import trace_readings
from adis_gonio.tracing.trace_result import TraceResult
from tracing.small_problems import function, observations

QUADRATIC = (effect("quadratic", ("x",)), {"k2_x": 1.2})


def test_base_fit_recovers_gains_and_misalignment_within_its_covariance() -> None:
    data = observations(seed=5)
    fit = Fit.begin(data).refit()
    error = fit.values.base - [0.05, 1.01, 0.99, np.deg2rad(0.3)]
    assert error @ np.linalg.solve(fit.covariance, error) < 18.5  # 99.9 % of χ² with four degrees
    assert adequacy(fit.chi2, fit.dof, data.noise_dof) > 0.001


def test_whitening_is_the_inverse_root_of_reading_and_fixture_covariance() -> None:
    data = observations(fixture_deg=0.02)
    at = Fit.begin(data).refit()
    tangent = at.tangent[:, :, 0]
    full = data.covariance + data.fixture_rad**2 * tangent[:, :, None] * tangent[:, None, :]
    np.testing.assert_allclose(
        at.whitener @ full @ at.whitener.transpose(0, 2, 1), np.tile(np.eye(2), (24, 1, 1)), atol=1e-9
    )


def test_free_attitudes_leave_nothing_along_the_tangent() -> None:
    data = observations()
    free = replace(data, fixture_rad=float("inf"))
    at = Fit.begin(free)
    assert np.abs(at.whitener @ at.tangent).max() < 1e-6 * np.abs(at.tangent).max()


def test_cycles_of_the_stage_are_those_that_the_angles_show_and_cost_by_their_logarithm() -> None:
    def cost_of(data: Readings) -> dict[int, float]:
        return {t.effect.cycles: t.cost for t in named_terms(data)[0] if t.name == "stage_periodic"}

    equal = cost_of(observations(n=24))
    assert list(equal) == list(range(3, 13))
    assert equal[12] - equal[3] == pytest.approx(np.log(4))
    uneven = observations(n=24)
    angles = np.random.default_rng(1).uniform(0, 2 * np.pi, 24)
    uneven = replace(uneven, conditions=replace(uneven.conditions, angle_rad=angles))
    assert list(cost_of(uneven)) == list(range(3, 73))
    # The whole share of the name stays what it is.
    shares = [np.exp(-np.array(list(costs.values()))).sum() for costs in (equal, cost_of(uneven))]
    assert shares[0] == pytest.approx(shares[1])


def test_a_lean_by_temperature_is_a_candidate_on_single_axes_only() -> None:
    leans = [t.effect.axes for t in named_terms(observations())[0] if t.name == "misalignment_temperature"]
    assert leans == [("x",), ("y",)]


def test_linear_gains_equal_explicit_least_squares() -> None:
    data = observations([QUADRATIC])
    terms = [*named_terms(data)[0], *nameless_terms(data)[::40]]
    state = Fit.begin(data).refit()
    problem = linearise(state, terms)
    basis, residual = span(problem, [3])
    gains = problem.gains(basis, residual)
    for k in range(0, len(problem.terms), 17):
        if k == 3:
            continue
        both = np.concatenate([problem.block(3), problem.block(k)], axis=1)
        left = problem.target - both @ np.linalg.lstsq(both, problem.target, rcond=1e-10)[0]
        assert gains[k] == pytest.approx(residual @ residual - left @ left, rel=2e-3, abs=1e-3)


@pytest.mark.parametrize("model", [(), (5,), (2, 9), (0, 7, 20)])
@pytest.mark.parametrize("inflation", [1.0, 1e4])
def test_products_of_blocks_are_those_of_least_squares_with_the_rows_of_the_prior_below(
    model: tuple[int, ...], inflation: float
) -> None:
    data = observations([QUADRATIC])
    free = linearise(Fit.begin(data).refit(), [*named_terms(data)[0], *nameless_terms(data)[::40]])
    problem = free.with_inflation(3.0).with_inflation(inflation)
    few = problem.subset(np.arange(1, len(problem.terms), 3))
    sizes = [len(problem.back_of(k)) for k in model]
    spread = amplitude_spreads(data.model, [problem.terms[k] for k in model], np.array(sizes, dtype=int))
    back = linalg.block_diag(np.zeros((0, 0)), *(problem.back_of(k) for k in model))[: sum(sizes)]
    below = np.sqrt(inflation) * back / spread[:, None]
    columns = np.concatenate([np.zeros((len(problem.target), 0)), *map(problem.block, model)], axis=1)
    whole = np.concatenate([columns, below])
    onto = (whole @ np.linalg.pinv(whole, rcond=1e-2))[:, : len(columns)]
    left = np.append(problem.target, np.zeros(len(below))) - onto @ problem.target
    longer = np.concatenate([few.columns, np.zeros((len(below), few.columns.shape[1]))])
    products = Products(problem, few)
    for _ in range(2):  # the second time from what was kept
        chi2, z, inside = products.of_model(model)
        assert chi2 == pytest.approx(left @ left)
        assert problem.chi2 - problem.gain(model) == pytest.approx(left @ left)
        assert z == pytest.approx(left @ longer, abs=1e-9 * np.sqrt(problem.chi2))
        assert inside.T @ inside == pytest.approx(longer.T @ onto @ few.columns, abs=1e-9)
    for k in model:
        whole = problem.block(k).T @ problem.block(k) + problem.prior_of(k)
        assert whole == pytest.approx(np.eye(len(whole)), abs=1e-9)


@pytest.mark.parametrize("inflation", [1.0, 1e4])
@pytest.mark.parametrize(
    ("label", "amplitude", "nats"),
    [
        ("bias[x]", 1000.0, 2.0),  # at the bound of the catalogue: two standard deviations
        ("bias[x]", 3000.0, 18.0),
        ("quadratic[y]", -50.0, 0.5),
        ("wave", 100.0, 0.5),  # 100 mg of a function without a name: one
        ("wave", -400.0, 8.0),
    ],
)
def test_an_amplitude_costs_as_many_nats_as_a_part_seldom_has_it_whatever_the_noise(
    label: str, amplitude: float, nats: float, inflation: float
) -> None:
    data = observations(n=24)
    fit = Fit.begin(data).refit()
    terms = [function("wave", lambda c: np.cos(3 * c.angle_rad)), *named_terms(data)[0]]
    term = next(term for term in terms if term.label == label)
    problem = linearise(fit, [term]).with_inflation(inflation)
    added = fit.white(fit.candidate(term))[:, 0] * amplitude
    base = orthonormal(fit.white(fit.base_columns))
    problem = replace(problem, target=added - base @ (base.T @ added))
    free = problem.chi2 - float((span(problem, (0,))[1] ** 2).sum())
    assert free == pytest.approx(problem.chi2)
    cost = 0.5 * (free - problem.gain((0,))) / inflation
    seen = 1 - problem.prior_of(0)[0, 0]  # of a prior that is not vague beside the noise a part
    # Blocks are orthonormal to 1e-10.
    assert cost == pytest.approx(nats * seen, rel=2e-3, abs=1e-10 * problem.chi2 / inflation)


def test_columns_of_many_terms_are_those_of_each() -> None:
    data = observations([QUADRATIC])
    fit = Fit.begin(data).refit()
    terms = [*named_terms(data)[0][::5], *nameless_terms(data)[::7]]
    together, widths = fit.candidates(terms)
    each = [fit.candidate(term) for term in terms]
    assert widths.tolist() == [block.shape[2] for block in each]
    np.testing.assert_array_equal(together, np.concatenate(each, axis=2))


def test_search_finds_the_pair_that_exhaustive_enumeration_finds() -> None:
    data = observations([QUADRATIC, (effect("bias", ("y",)), {"bias_y": 0.6})], seed=2)
    terms = named_terms(data)[0]
    state = Fit.begin(data).refit()
    problem = linearise(state, terms)
    prices = price(problem)
    found = search(problem, 2)
    best = -np.inf
    for pair in itertools.combinations(range(len(problem.terms)), 2):
        best = max(best, 0.5 * problem.gain(pair) - float(prices[list(pair)].sum()))
    assert found.scores[found.best] == pytest.approx(best, rel=2e-8)  # the ridge of `gains`


def test_amplitudes_of_the_linear_problem_are_those_put_in() -> None:
    data = observations([QUADRATIC])
    problem = linearise(Fit.begin(data).refit(), named_terms(data)[0])
    k = next(i for i, term in enumerate(problem.terms) if term.label == "quadratic[x]")
    assert amplitudes(problem, [k])[0][0] == pytest.approx(1.2, abs=0.25)


def test_nothing_is_found_in_noise() -> None:
    wrong = 0
    for seed in range(12):
        data = observations(seed=100 + seed, n=16)
        terms = [*named_terms(data)[0], *nameless_terms(data)]
        wrong += bool(select(data, terms, 6).terms)
    # At the level of 1 % two or more of 12 have 0.6 %, one has 11 %.
    assert wrong <= 1


@pytest.mark.parametrize(
    ("name", "axes", "values"),
    [
        ("bias", ("x", "y"), {"bias_x": 0.8, "bias_y": -0.7}),
        ("quadratic", ("y",), {"k2_y": 1.3}),
        ("cubic", ("x",), {"k3_x": 3.0}),
        ("bias_temperature", ("x",), {"tempco_x": 0.15}),
        ("stage_eccentricity", (), {"ecc_sin": 0.06, "ecc_cos": -0.05}),
        ("backlash", (), {"backlash": 0.1}),
        ("supply_bias", ("y",), {"supply_y": 8.0}),
        ("scale_drift", ("x",), {"scale_drift_x": 80.0}),
        ("supply_scale", ("y",), {"supply_scale_y": 12000.0}),
        ("misalignment_temperature", ("y",), {"misalignment_tempco_yx": 0.015}),
        ("stage_periodic", (), {"per_sin": 0.06}),
    ],
)
def test_one_catalogued_effect_is_found_alone(
    name: str, axes: tuple[str, ...], values: dict[str, float]
) -> None:
    result = trace_readings(observations([(effect(name, axes or ("x", "y")), values)], seed=11))
    assert [finding.effect for finding in result.found] == [name]
    assert result.unnamed is None
    assert result.adequate
    for key, value in values.items():
        stated = result.found[0].parameters[key]
        assert abs(stated.value - value) < 3.5 * stated.u
    assert result.after.heldout_rms < result.before.heldout_rms


@pytest.mark.parametrize(
    ("covariate", "added", "turned"),
    [
        ("time", lambda c, a: np.outer(c.order >= 13, [0.9, 0.0]), None),
        # Over a third of the turn: what touches two or three angles may be as many slips (docs/trace.md).
        ("angle", None, lambda c: np.deg2rad(0.15) * np.exp(-3 * (1 - np.cos(c.angle_rad - 2)))),
        ("previous_angle", lambda c, a: np.outer(np.sin(c.previous_angle_rad), [0.9, 0.0]), None),
        ("temperature", lambda c, a: np.outer(np.sin(1.3 * (c.temperature_c - 25)), [0.9, 0.5]), None),
        ("reading", lambda c, a: np.stack([1.5 * (a[:, 0] ** 5 - a[:, 0]) * 2, 0 * a[:, 1]], axis=1), None),
    ],
)
def test_a_cause_outside_the_catalogue_is_unnamed_with_its_covariate(covariate, added, turned) -> None:
    result = trace_readings(observations(added=added, turned=turned, seed=21))
    assert result.found == ()
    assert result.unnamed is not None
    assert result.unnamed.covariates == (covariate,)
    assert result.after.residual_rms < result.before.residual_rms


def test_temperature_that_only_rises_with_time_is_not_called_found_by_one_name() -> None:
    data = observations(seed=4, n=16)
    line = 25 + data.conditions.time_s / 120.0
    c = Conditions(
        **{
            **data.conditions.__dict__,
            "temperature_c": line,
            "temperature_history": (data.conditions.time_s, line),
        }
    )
    drifting = data.mean + np.outer(c.time_s / 60.0, [0.12, 0.0])
    result = trace_readings(replace(data, conditions=c, mean=drifting))
    told = {name for group in result.confounded for name in group}
    named = {finding.effect for finding in result.found}
    equivalents = {e for finding in result.found for e in finding.equivalents}
    assert {"bias_drift", "bias_temperature"} <= told | named | equivalents
    assert len(named) <= 1


def test_check_dwells_take_no_part() -> None:
    data = observations([QUADRATIC], seed=6, check=5)
    result = trace_readings(data)
    broken = data.mean.copy()
    broken[data.check] += 50.0
    other = trace_readings(replace(data, mean=broken))
    assert [f.as_dict() for f in other.found] == [f.as_dict() for f in result.found]
    assert other.after.heldout_rms > 10 * result.after.heldout_rms
    assert "5 check dwells" in result.heldout_design


@pytest.fixture(scope="module")
def slipped() -> TraceResult:
    """Trace of a curved axis and a dwell that slipped."""
    slip = (effect("position_slip", dwell=7), {"slip": -0.12})
    return trace_readings(observations([QUADRATIC, slip], seed=15))


def test_a_slipped_dwell_is_reported_and_does_not_spoil_the_rest(slipped: TraceResult) -> None:
    found = {finding.effect: finding for finding in slipped.found}
    assert set(found) == {"position_slip", "quadratic"}
    assert found["position_slip"].parameters["dwell"].value == 7
    assert found["position_slip"].parameters["slip"].value == pytest.approx(-0.12, abs=0.03)


def test_a_large_bias_does_not_leave_second_order_effects() -> None:
    bias = (effect("bias"), {"bias_x": 60.0, "bias_y": -35.0})
    result = trace_readings(observations([bias], seed=9))
    assert [finding.effect for finding in result.found] == ["bias"]
    assert result.found[0].parameters["bias_x"].value == pytest.approx(60.0, abs=0.15)
    assert result.unnamed is None


def test_a_large_bias_stands_beside_a_nameless_step() -> None:
    bias = (effect("bias"), {"bias_x": 40.0, "bias_y": -35.0})
    data = observations([bias], added=lambda c, a: np.outer(c.order >= 13, [0.9, 0.0]), seed=10)
    result = trace_readings(data)
    assert [finding.effect for finding in result.found] == ["bias"]
    assert result.unnamed is not None
    assert result.unnamed.covariates == ("time",)


@pytest.fixture(scope="module")
def quiet() -> TraceResult:
    """Trace of a session without effects."""
    return trace_readings(observations(seed=30))


def test_detectable_amplitude_is_found_and_a_third_of_it_is_not(quiet: TraceResult) -> None:
    seen = quiet.detectable["quadratic"]
    assert seen.unit == "mg/g²"
    hits, misses = 0, 0
    for seed in range(6):
        for share, count in ((1.3, 1), (0.33, 0)):
            data = observations(
                [(effect("quadratic", ("x",)), {"k2_x": share * seen.amplitude})], seed=40 + seed
            )
            terms = [*named_terms(data)[0], *nameless_terms(data)]
            names = {term.name for term in select(data, terms, 3).terms}
            hits += count and "quadratic" in names
            misses += (not count) and "quadratic" in names
    assert hits >= 4
    assert misses <= 1


def test_what_a_session_cannot_show_has_no_amplitude_but_a_reason(quiet: TraceResult) -> None:
    for name in ("scale", "misalignment", "gravity", "tone", "vibration_rectification"):
        assert quiet.detectable[name].amplitude is None
        assert quiet.detectable[name].reason


def test_scatter_that_nothing_explains_is_called_that_with_its_size() -> None:
    rng = np.random.default_rng(1)
    data = observations(seed=12)
    rough = data.mean + rng.normal(0, 0.5, data.mean.shape)
    result = trace_readings(replace(data, mean=rough))
    assert not result.adequate
    (finding,) = result.found
    assert finding.effect == "reading_scatter"
    value = finding.parameters["scatter"]
    assert abs(value.value - 0.5) < 4 * value.u
    assert value.u < 0.15
    assert any("no covariate explains it" in note for note in result.notes)


def test_as_dict_is_the_document_of_the_formats_and_is_json(slipped: TraceResult) -> None:
    document = slipped.as_dict()
    keys = {"adequate", "found", "steps", "confounded", "unnamed", "error", "detectable", "next"}
    assert keys <= set(document)
    errors = {"residual_rms_mg", "heldout_rms_mg", "angle_rms_deg", "chi2_per_dof"}
    assert set(document["error"]["before"]) == errors
    assert set(document["error"]["after"]) == errors | {"heldout_kept_mg"}
    assert {"effect", *errors, "heldout_kept_mg"} == set(document["steps"][-1])
    assert {"effect", "axes", "parameters", "p_value", "explains"} <= set(document["found"][0])
    assert document["steps"][-1]["residual_rms_mg"] == document["error"]["after"]["residual_rms_mg"]
    json.dumps(document, allow_nan=False)


def test_too_few_positions_are_refused_with_what_is_needed() -> None:
    with pytest.raises(FitError, match="measure at least 2 positions"):
        trace_readings(observations(n=24).rows(np.array([0])))
