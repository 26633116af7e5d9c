"""Gates of `trace`: held-out folds speak against single effects only, and cannot be made to explode."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import norm

from adis_gonio import trace
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.model.records import Dwell, Session
from adis_gonio.tracing.credible_sets import Names
from adis_gonio.tracing.findings import effect_mixture
from adis_gonio.tracing.linear_problem import amplitudes
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.selection import select
from adis_gonio.tracing.trace_result import TraceResult
from adis_gonio.tracing.validation import cut_worse_steps


def forth_and_back(bias=(8.0, -5.0), k2_x=0.0, slip_mg=0.0, seed=3, slip_deg=0.0) -> Session:
    """A turn forth and back in steps of 20°, 0.1 mg a reading; dwell 7 off on x, or turned."""
    rng = np.random.default_rng(seed)
    angles = np.concatenate([np.arange(0, 360, 20.0), np.arange(350, -10, -20.0)])
    psi = np.radians(12.0 - angles + 0.003 * rng.standard_normal(len(angles)))
    psi[7] += np.radians(slip_deg)
    readings = 1000 * np.stack([1.002 * np.cos(psi), np.sin(psi + np.radians(0.2))], axis=1) + bias
    readings[:, 0] += k2_x * np.cos(psi) ** 2
    readings[7, 0] += slip_mg
    readings += 0.1 * rng.standard_normal(readings.shape)
    return Session(
        tuple(
            Dwell(k, np.array([20.0 * k]), readings[k : k + 1], angle_deg=float(a))
            for k, a in enumerate(angles)
        ),
        accel_unit="mg",
        fixture_sigma_deg=0.003,
        reading_u_mg=0.1,
        sensor="generic",
    )


def fitted(data: Readings, *labels: str):
    """Fit of the terms of these labels."""
    at_hand = {term.label: term for term in named_terms(data)[0]}
    model = tuple(at_hand[label] for label in labels)
    values = tuple(term.start(np.zeros(len(term.amplitudes))) for term in model)
    return Fit.begin(data).with_terms(model, values).refit()


@cache
def trace_of_a_curved_axis(seed: int) -> TraceResult:
    """Trace of a turn with a bias and a curved X axis."""
    return trace(forth_and_back(k2_x=3.0, seed=seed))


@pytest.mark.parametrize("seed", [2, 3, 5])
def test_bias_and_curvature_stand_whatever_else_comes_in(seed: int) -> None:
    result = trace_of_a_curved_axis(seed)
    assert {"bias", "quadratic"} <= {finding.effect for finding in result.found}
    assert not {"bias", "quadratic"} & set(result.reasons)
    assert result.after.heldout_rms < 0.1 * result.before.heldout_rms


def test_an_uncertain_effect_is_open_and_no_finding() -> None:
    # One reading off by some four uncertainties: the search adds a slip with half the posterior.
    result = trace(forth_and_back(k2_x=3.0, slip_mg=0.41, seed=0))
    assert {finding.effect for finding in result.found} == {"bias", "quadratic"}
    assert "of the posterior" in result.reasons["position_slip"]
    assert result.adequate


def test_a_cause_that_is_there_but_has_two_names_is_a_set_and_no_finding() -> None:
    result = trace(forth_and_back(k2_x=3.0, slip_mg=0.4, seed=2))
    assert {finding.effect for finding in result.found} == {"bias", "quadratic"}
    (open_,) = [one for one in result.sets if "outlier_dwell" in one.names]
    assert set(open_.names) == {"outlier_dwell", "position_slip"}
    assert open_.present > 0.85
    assert sum(open_.probability) > 0.95
    assert open_.as_dict() in result.as_dict()["sets"]


@pytest.mark.parametrize("slip_deg", [2.0, 5.0])
def test_a_slip_of_degrees_is_one_slip_and_no_scatter(slip_deg: float) -> None:
    # Off by 4° a reading is 2.4 mg shorter along its old direction than a linear slip says.
    result = trace(forth_and_back(slip_deg=slip_deg))
    assert {finding.effect for finding in result.found} == {"bias", "position_slip"}
    assert result.adequate
    (slip,) = [f for f in result.found if f.effect == "position_slip"]
    assert abs(slip.parameters["slip"].value - slip_deg) < 4 * (slip.parameters["slip"].u or 0)


def test_a_dwell_that_was_left_out_is_not_predicted_by_its_own_slip() -> None:
    data = readings_of(forth_and_back(slip_mg=3.0))
    rest = data.rows(np.arange(len(data)) != 7)
    fit = fitted(data, "outlier_dwell[x](dwell=7)")
    again = fit.again(rest)
    out = data.rows(np.arange(len(data)) == 7)
    (slip,) = again.terms
    assert slip.added(again.values.terms[0], out.mean, out.conditions)[0, 0] == 0


@pytest.mark.parametrize(
    ("errors", "count"),
    [
        ((8.0, 0.7, 0.1, 0.104), 3),
        ((8.0, 0.7, 0.1, 0.12), 2),
        ((8.0, 0.7, 0.1, 9.0), 2),
        ((0.1, 0.3, 0.2, 0.11), 0),
        ((), 3),
    ],
)
def test_the_model_is_the_longest_that_is_not_worse_than_nothing(errors, count: int) -> None:
    names = Names(("bias", "quadratic", "cubic"), {}, ())
    kept, left = cut_worse_steps(names, names.accepted, errors, None)
    assert kept == count
    assert left.accepted == names.accepted[:count]
    assert set(left.rejected) == set(names.accepted[count:])
    assert set(left.confounded) == {(name,) for name in names.accepted[count:]}


def test_stated_errors_are_compared_with_each_other_and_not_with_those_of_other_dwells() -> None:
    names = Names(("bias", "quadratic"), {}, ())
    errors = (2.0, 0.5, 0.1)
    assert cut_worse_steps(names, names.accepted, errors, (9.0, 4.0))[0] == 2
    count, left = cut_worse_steps(names, names.accepted, errors, (3.0, 4.0))
    assert count == 1
    assert left.accepted == ("bias",)
    assert left.rejected == {"quadratic": "the held-out error would go from 3 to 4 mg with it"}


def test_models_with_amplitudes_that_no_part_has_take_no_share_of_the_posterior() -> None:
    # The variance within the dwells is the same everywhere but for its own scatter: a second bias.
    rng = np.random.default_rng(4)
    angles = np.arange(0, 360, 15.0)
    psi = np.radians(12.0 - angles)
    readings = 1000 * np.stack([np.cos(psi), np.sin(psi)], axis=1) + [0.6, 0.0]
    time = np.arange(400) * 0.01
    dwells = tuple(
        Dwell(k, 10.0 * k + time, readings[k] + rng.normal(0, 3.0, (400, 2)), angle_deg=float(angle))
        for k, angle in enumerate(angles)
    )
    session = Session(dwells, accel_unit="mg", fixture_sigma_deg=0.003, sensor="generic")
    data = readings_of(session).training
    selection = select(data, named_terms(data)[0], 2)
    verdict = selection.verdict
    assert verdict.names.get("vibration_rectification", 0.0) < 0.01
    assert verdict.names["bias"] == pytest.approx(1.0)
    assert sum(verdict.weights.values()) == pytest.approx(1.0)


def test_fits_of_the_result_belong_to_its_steps_and_stay_out_of_the_json() -> None:
    result = trace_of_a_curved_axis(3)
    final = result.fits[-1]
    assert {term.name for term in final.terms} == {step.effect for step in result.steps}
    assert len(result.fits) == len(result.steps) + 1
    curved = next(k for k, term in enumerate(final.terms) if term.name == "quadratic")
    stated = next(f for f in result.found if f.effect == "quadratic").parameters["k2_x"].value
    assert final.values.terms[curved][0] == pytest.approx(stated)
    assert "fits" not in result.as_dict()
    assert replace(result, fits=()) == result


def test_the_uncertainty_of_an_effect_holds_what_other_probable_models_say() -> None:
    data = readings_of(forth_and_back(k2_x=3.0))
    selection = select(data, named_terms(data)[0], 3)
    terms = selection.problem.terms
    number = {term.label: k for k, term in enumerate(terms)}
    bias = number["bias[xy]"]
    both = tuple(sorted((bias, number["quadratic[xy]"])))
    one = tuple(sorted((bias, number["quadratic[x]"])))
    values = dict(zip(both, amplitudes(selection.problem, both), strict=True))
    k2_x, k2_y = values[number["quadratic[xy]"]]
    (other,) = (
        a for k, a in zip(one, amplitudes(selection.problem, one), strict=True) if terms[k].name != "bias"
    )
    verdict = replace(selection.verdict, best=both)
    alone = replace(selection, verdict=verdict, found=replace(selection.found, scores={both: 0.0}))
    scores = {both: np.log(0.6), one: np.log(0.4)}
    open_ = replace(selection, verdict=verdict, found=replace(selection.found, scores=scores))
    assert effect_mixture(alone, "quadratic")[1].u(0.1, np.array([1.0, 0.0])) == pytest.approx(0.1)
    names, mixture = effect_mixture(open_, "quadratic")
    assert names == ["k2_x", "k2_y"]
    for along, away in zip(
        np.eye(2), (other[0] - k2_x, -k2_y), strict=True
    ):  # none on y in the other model
        half = 1.959964 * mixture.u(0.1, along)
        inside = [norm.cdf((half - d) / 0.1) - norm.cdf((-half - d) / 0.1) for d in (0.0, away)]
        assert 0.6 * inside[0] + 0.4 * inside[1] == pytest.approx(0.95, abs=1e-4)
