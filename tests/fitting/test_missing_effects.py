"""Uncertainties of a fit whose model lacks an effect, against the truth of simulated sessions."""

import json
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio import fit, load_session
from adis_gonio.faces.cli import main
from adis_gonio.fitting.answer import Answer
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import from_means
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.fitting.methods import fit_ml, fit_readings
from adis_gonio.fitting.uncertainty import missing_curvature
from adis_gonio.model.effects import Conditions, effect
from tracing.joint_fleets import draw_part, draw_session
from tracing.recorded import record

HIDDEN = (
    "quadratic:k2_x=8",
    "quadratic:k2_y=-6",
    "asymmetry:asymmetry_y=7",
    "cross_quadratic:kpp_yx=-8",
    "cross_axis:kip_xy=6",
    "hysteresis:hysteresis_x=4",
)
LED_BY = "The model does not describe this session"


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    """Return files of tumbles that each hide an effect."""
    folder = tmp_path_factory.mktemp("lacking")
    return [
        record(folder / f"{seed}.session", seed, effect, dwell_s=2.0, smpl_prd=31)
        for seed, effect in enumerate(HIDDEN)
    ]


@pytest.fixture(scope="module")
def lacking(paths):
    """Return fits by `ml` of these sessions, with the truth."""
    sessions = list(map(load_session, paths))
    return [(fit(session, method="ml"), session.facts["truth"]) for session in sessions]


@pytest.fixture(scope="module")
def complete(tmp_path_factory):
    path = tmp_path_factory.mktemp("complete") / "a.session"
    given = ["--plan", "four-position", "--seed", "3", "--dwell", "2", "-o", str(path)]
    assert main(["simulate", *given]) == 0
    return load_session(path)


def misses(found, expanded):
    return [
        (name, abs(one.value - truth[name]) / expanded(one))
        for result, truth in found
        for name, one in result.parameters.items()
        if abs(one.value - truth[name]) > expanded(one)
    ]


def test_the_stated_uncertainty_covers_what_a_missing_effect_does_to_the_parameters(lacking):
    assert all(result.extra_mg > 0 for result, _ in lacking)
    count = sum(len(result.parameters) for result, _ in lacking)
    assert count >= 6 * len(HIDDEN)
    assert len(misses(lacking, lambda one: one.U)) <= 0.05 * count


def test_a_change_with_temperature_that_the_residual_does_not_prove_is_covered():
    """Parts by their data sheet, read at nine positions while the temperature changes by 4 °C once."""
    off = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        angle_rad, alpha = rng.permutation(np.radians(np.arange(9) * 40.0)), rng.uniform(0.0, 2 * np.pi)
        skew, gains = 0.005 * rng.standard_normal(), 1 + 0.005 * rng.standard_normal(2)
        bias, per_c = rng.normal(0.0, 20.0, 2), rng.normal(0.0, 0.5, 2)
        degrees = np.where(np.arange(9) < 3, 25.0, 29.0)
        ideal = np.stack([np.cos(alpha - angle_rad), np.sin(alpha - angle_rad + skew)], axis=1)
        mean = 1000.0 * gains * ideal + bias + np.outer(degrees - degrees.mean(), per_c)
        conditions = Conditions(
            time_s=60.0 * np.arange(9), angle_rad=angle_rad, temperature_c=degrees, order=np.arange(9.0)
        )
        found = fit_readings(
            from_means(
                mean + 0.5 * rng.standard_normal((9, 2)),
                np.tile(0.25 * np.eye(2), (9, 1, 1)),
                conditions,
                sensor="adis16354",
            )
        )
        truth = {"scale_x": gains[0], "scale_y": gains[1], "delta_phi": np.degrees(skew)}
        if not found.extra_mg:
            off.append([(found[name].value - true) / found[name].u for name, true in truth.items()])
    assert 15 <= len(off) <= 35
    assert 0.85 < np.sqrt(np.mean(np.square(off))) < 1.15


def test_scatter_of_the_readings_alone_would_not_cover_it(lacking, monkeypatch):
    """The check itself: without the catalogue the same sessions are missed."""
    monkeypatch.setattr(
        "adis_gonio.fitting.uncertainty.missing_effects",
        lambda fit: np.zeros((*fit.data.mean.shape, 0)),
    )
    again = [(fit_ml(result.session), truth) for result, truth in lacking]
    count = sum(len(result.parameters) for result, _ in again)
    assert len(misses(again, lambda one: one.U)) > 0.05 * count


def test_the_uncertainty_stays_useful(lacking):
    """A bias that an uncalibrated part leaves open by tens of mg is known to a few."""
    for result, _ in lacking:
        assert all(result[f"bias_{axis}"].U < 15 for axis in "xy")


def test_a_model_that_does_not_describe_the_session_leads_the_answer_and_names_trace(lacking):
    for result, _ in lacking:
        first = Answer.of(result).text().splitlines()[0]
        assert first.startswith(LED_BY)
        assert "adis-gonio trace" in Answer.of(result).text()


def test_the_command_says_so_in_its_first_line_and_its_first_warning(paths, capsys):
    path = paths[0]
    assert main(["fit", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(LED_BY)
    assert sum(line.startswith(LED_BY) for line in lines) == 1
    for more in ([], ["--method", "mmpm"], ["--all"]):
        assert main(["fit", str(path), "--json", *more]) == 0
        first = json.loads(capsys.readouterr().out)["warnings"][0]
        assert first.startswith(LED_BY)
        assert "adis-gonio trace" in first


def test_a_model_that_describes_the_session_is_not_doubted(complete):
    result = fit(complete)
    assert result.extra_mg == 0
    assert Answer.of(result).doubts == ()


def test_one_dwell_of_few_samples_does_not_take_the_degrees_of_freedom_of_all(lacking):
    """Welch and Satterthwaite: each estimate counts by what it contributes."""
    result, _ = lacking[0]
    readings = result.session
    dof = np.array(readings.dof, dtype=float)
    dof[3] = 1.0
    again = fit_ml(replace(readings, dof=dof))
    assert again.extra_mg > 0
    assert again.dof > 20
    for name, one in again.parameters.items():
        assert one.k == pytest.approx(result[name].k, rel=0.1)
        assert one.k < 2.5


def test_the_covariance_by_a_missing_curvature_is_the_average_over_models_with_one_amplitude_more():
    """Against quadrature over the amplitude of each model."""
    rng = np.random.default_rng(41)
    data = draw_session(rng, draw_part(rng), [(effect("cubic", ("y",)), [0.6])])
    bias = NamedTerm.offset("xy")
    begun = Fit.begin(data).with_terms((bias,), (np.zeros(2),)).refit()
    jacobian, residual = begun.jacobian, begun.residual.ravel()
    grid = np.linspace(-8, 8, 4001)  # amplitude in typical sizes
    prior = np.exp(-0.5 * grid**2)
    factors, parts = [], []
    for name in ("cross_axis", "quadratic", "cubic", "asymmetry", "cross_quadratic"):
        made = effect(name, ("x", "y"))
        columns = begun.white(begun.candidate(NamedTerm(name, (), 0.0, made)))
        for column, parameter in zip(columns.T, made.parameters, strict=True):
            moved = np.linalg.lstsq(jacobian, column * parameter.typical, rcond=None)[0]
            left = column * parameter.typical - jacobian @ moved
            likely = np.exp(-0.5 * ((residual[:, None] - left[:, None] * grid) ** 2).sum(axis=0))
            likely *= prior / np.exp(-0.5 * residual @ residual)
            factors.append(likely.sum() / prior.sum())
            parts.append(np.outer(moved, moved) * (likely @ grid**2) / likely.sum())
    weights = np.array(factors) / len(factors)
    expected = np.einsum("k,kpq->pq", weights / (1 + weights.sum()), parts)
    np.testing.assert_allclose(missing_curvature(begun), expected, rtol=1e-6, atol=1e-18)
