"""Methods compared on the same readings, and the one that is recommended."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from adis_gonio.base.errors import FitError
from adis_gonio.fitting import fit, fit_readings
from adis_gonio.fitting.answer import (
    DwellPrediction,
    Score,
    held_out_groups,
    predicted,
    recommend,
)
from adis_gonio.model.measurement import sensitivity
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record.loading import load_session
from fitting.test_uncertainty import FOUR, NINE, turn

TUMBLE = (*range(0, 360, 30), *range(330, -30, -30))


def test_every_method_is_scored_on_every_dwell():
    for angles in (FOUR, NINE, TUMBLE):
        comparison = fit(turn(angles)).comparison
        assert {score.dwells for score in comparison.scores.values()} == {len(angles)}


def test_the_method_that_saw_least_has_no_advantage():
    result = fit(turn(TUMBLE, bias=(20.0, -10.0)))
    scores = result.comparison.scores
    own = fit(turn(TUMBLE, bias=(20.0, -10.0)), "two-position").as_dict()["angle_error_deg"]
    # On its own readings it looks perfect; on all of them it is the worst.
    assert own["rms"] < 0.05
    assert scores["two-position"].angle_rms_deg > 1.0
    assert scores["paper"].angle_rms_deg > 1.0
    assert scores["ml"].angle_rms_deg < 0.05


def test_a_prediction_never_saw_its_dwell():
    session = turn(NINE)
    spoiled = [dwell.accel + (300.0 if k == 4 else 0.0) for k, dwell in enumerate(session.dwells)]
    dwells = tuple(
        type(d)(d.position, d.time_s, a, d.angle_deg) for d, a in zip(session.dwells, spoiled, strict=True)
    )
    bad = type(session)(dwells, accel_unit="mg", sensor="generic", fixture_sigma_deg=0.02, reading_u_mg=0.1)
    found = fit(bad, "ml").comparison.predictions["mmpm"]
    # Left out, the spoiled dwell is predicted by eight good ones and misses by all that was added.
    assert np.linalg.norm(found.residual_mg[4]) == pytest.approx(300 * np.sqrt(2), rel=0.02)


def test_mmpm_left_out_is_that_of_an_independent_least_squares():
    session = turn(NINE, seed=4)
    found = fit(session, "mmpm").comparison.predictions["mmpm"].angle_rad
    theta = np.radians(NINE)
    readings = np.array([dwell.accel[0] for dwell in session.dwells])
    for k in range(len(NINE)):
        rest = np.arange(len(NINE)) != k
        design = np.column_stack([np.cos(theta), np.sin(theta), np.ones(len(theta))])
        (ax, ay), (bx, by), zero = np.linalg.lstsq(design[rest], readings[rest], rcond=None)[0]
        # U − b = [a b] (cos θ, sin θ): the angle comes out of the inverse of that matrix.
        c, s = np.linalg.solve(np.array([[ax, bx], [ay, by]]), readings[k] - zero)
        error = (np.arctan2(s, c) - theta[k] + np.pi) % (2 * np.pi) - np.pi
        assert abs(found[k]) == pytest.approx(abs(error), abs=1e-9)


def test_ml_left_out_is_least_squares_of_the_others_however_large_the_noise():
    angles = tuple(range(0, 360, 60))
    session = turn(angles, noise=60.0, stated=60.0, sigma=0.0)
    found = fit(session, "ml").comparison.predictions["ml"]
    theta = np.radians(angles)
    readings = np.array([dwell.accel[0] for dwell in session.dwells])
    design = np.column_stack([np.cos(theta), np.sin(theta), np.ones(len(theta))])
    for k in range(len(angles)):
        rest = np.arange(len(angles)) != k
        # With exact angles and noise alike the model is linear in its six harmonics.
        harmonics = np.linalg.lstsq(design[rest], readings[rest], rcond=None)[0]
        np.testing.assert_allclose(found.residual_mg[k], readings[k] - design[k] @ harmonics, rtol=1e-5)
        c, s = np.linalg.solve(harmonics[:2].T, readings[k] - harmonics[2])
        assert found.angle_rad[k] == pytest.approx(np.angle(complex(c, s) * np.exp(-1j * theta[k])))


def test_two_positions_alone_cannot_be_scored_and_it_is_said():
    result = fit(turn((0, 90)))
    assert {score.dwells for score in result.comparison.scores.values()} == {0}
    recommended = result.comparison.recommended
    assert recommended.method == "two-position"
    assert "no dwell can be left out" in recommended.why
    assert result.as_dict()["scores"]["paper"]["angle_rms_deg"] is None


def test_what_sees_the_bias_is_recommended_before_what_does_not():
    comparison = fit(turn(FOUR)).comparison
    assert comparison.recommended.method == "ml"
    assert "determines the biases" in comparison.recommended.why


def test_the_rule_follows_the_scores_and_is_not_a_fixed_name():
    session = turn(TUMBLE)
    results = [fit(session, method) for method in ("four-position", "mmpm", "ml")]
    rng = np.random.default_rng(1)
    errors = {r.method: np.abs(rng.normal(1e-4, 1e-5, 24)) for r in results}

    def chosen(errors):
        found = {name: DwellPrediction(e, np.ones((24, 2))) for name, e in errors.items()}
        scores = {
            name: Score(float(np.sqrt((e**2).mean())), float(e.max()), 1.0, 1.0, 24)
            for name, e in errors.items()
        }
        return recommend(results, found, scores, "ml").method

    assert chosen(errors) == "ml"
    assert chosen({**errors, "ml": 3 * errors["ml"]}) == "mmpm"
    assert chosen({**errors, "ml": 3 * errors["ml"], "mmpm": 3 * errors["mmpm"]}) == "four-position"


def test_the_document_names_the_recommended_method_and_why():
    document = fit(turn(NINE), "mmpm").as_dict()
    assert document["method"] == "mmpm"
    assert document["recommended"]["method"] in ("ml", "mmpm")
    assert document["recommended"]["why"]
    assert set(document["scores"]) == {"mmpm", "ml"}
    assert {"angle_rms_deg", "angle_max_deg"} <= set(document["scores"]["ml"])


def test_in_space_the_residual_of_the_norm_is_scored():
    rng = np.random.default_rng(2)
    u = rng.normal(size=(16, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    base = turn(FOUR)
    dwells = tuple(
        type(base.dwells[0])(k, np.array([float(k)]), 1000 * v[None] + rng.normal(0, 0.1, (1, 3)))
        for k, v in enumerate(u)
    )
    session = type(base)(
        dwells, accel_unit="mg", sensor="generic", plane="none", reading_u_mg=0.1, fixture_sigma_deg=np.inf
    )
    result = fit(session)
    score = result.comparison.scores["ml"]
    assert score.angle_rms_deg is None
    assert score.dwells == 16
    assert 0.05 < score.residual_rms_mg < 0.5
    assert result.budget == {}
    assert fit_readings(result.session.training).method == "ml"


def test_dwells_for_checking_in_space_have_the_residual_of_their_own_norms():
    rng = np.random.default_rng(3)
    u = rng.normal(size=(13, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    rows = 1000 * u * [1.01, 0.99, 1.0] + rng.normal(0, 0.1, (13, 3))
    rows[12] *= 1.004
    dwells = tuple(
        Dwell(k, np.array([float(k)]), row[None], use="fit" if k < 10 else "check")
        for k, row in enumerate(rows)
    )
    session = Session(
        dwells, accel_unit="mg", sensor="generic", plane="none", reading_u_mg=0.1, fixture_sigma_deg=np.inf
    )
    result = fit(session)
    found = result.comparison.predictions["ml"].residual_mg
    assert found.shape == (13, 1)
    made = result.origin.fit
    values = made.values.parameters
    gains = np.linalg.inv(sensitivity(values[:6]))
    norms = np.linalg.norm((rows - values[6:]) @ gains.T, axis=1)
    np.testing.assert_allclose(found[10:, 0], norms[10:] - 1000, rtol=1e-6, atol=1e-6)
    assert found[12, 0] == pytest.approx(4.0, abs=0.5)


def test_only_dwells_that_were_fitted_are_left_out_and_one_that_is_needed_has_no_prediction():
    session = turn(NINE)
    result = fit(session, "ml")
    used, asked = np.arange(9) != 4, []

    def again(left_out):
        asked.append(np.flatnonzero(left_out).tolist())
        if asked[-1] == [2]:
            raise FitError("the others do not determine it")
        return result.origin.fit

    found = predicted(result.session, used, result.origin.fit, again)
    assert asked == [[k] for k in range(9) if k != 4]
    known = np.arange(9) != 2
    np.testing.assert_array_equal(np.isfinite(found.angle_rad), known)
    np.testing.assert_array_equal(np.isfinite(found.residual_mg).all(axis=1), known)


def test_a_dwell_is_predicted_under_the_scatter_of_the_angles_that_was_estimated():
    angles = range(0, 360, 45)
    session = replace(turn(angles, sigma=0.5), fixture_sigma_deg=None)
    result = fit(session, "ml")
    found, sigma = result.comparison.predictions["ml"], math.radians(result.fixture_sigma_deg)
    assert 0.2 < result.fixture_sigma_deg < 1.0
    readings = np.array([dwell.accel[0] for dwell in session.dwells])
    rest = np.arange(8) != 3

    def modelled(base, theta):
        psi = base[0] - theta
        axes = [base[1] * np.cos(psi) + base[4], base[2] * np.sin(psi + base[3]) + base[5]]
        return 1000 * np.stack(axes, axis=-1)

    def off(base, away, rows):
        left = readings[rows] - modelled(base, np.radians(angles)[rows] + away)
        return np.concatenate([left.ravel() / 0.1, away / sigma])

    begin = [math.radians(20), 1.0, 1.0, 0.0, 0.0, 0.0, *np.zeros(7)]
    base = least_squares(lambda x: off(x[:6], x[6:], rest), begin, x_scale="jac", xtol=1e-14).x[:6]
    away = least_squares(lambda x: off(base, x, ~rest), [0.0], x_scale=1e-3, xtol=1e-14).x
    expected = (readings[~rest] - modelled(base, np.radians(angles)[~rest] + away))[0]
    np.testing.assert_allclose(found.residual_mg[3], expected, atol=0.02)
    # Alone the reading shows the angle at which it lies in the direction of the model's.
    u, v = (readings[3] / 1000 - base[4:]) / base[1:3]
    shown = base[0] - math.atan2((v - u * math.sin(base[3])) / math.cos(base[3]), u)
    error = math.remainder(shown - math.radians(angles[3]), 2 * math.pi)
    assert found.angle_rad[3] == pytest.approx(error, abs=2e-5)


def test_what_the_others_do_not_determine_is_not_predicted():
    # Two positions do not see the biases, which three do.
    found = fit(turn((0, 90, 180)), "ml").comparison.predictions["ml"]
    assert np.isnan(found.angle_rad).all()
    assert np.isnan(found.residual_mg).all()


def test_angles_of_free_attitudes_are_compared_with_the_mean_start_that_the_others_show():
    session = replace(turn(NINE, sigma=0.0), fixture_sigma_deg=math.inf)
    found = fit(session, "ml").comparison.predictions["ml"].angle_rad
    # 0.1 mg at right angles to gravity are 0.006°; the part stands at 20°.
    assert np.degrees(np.abs(found)).max() < 0.06
    turned = (
        fit(
            replace(
                session,
                dwells=tuple(
                    replace(one, angle_deg=one.angle_deg + (0.9 if k == 3 else 0.0))
                    for k, one in enumerate(session.dwells)
                ),
            ),
            "ml",
        )
        .comparison.predictions["ml"]
        .angle_rad
    )
    # Eight others show the start: the one that is declared too far on stands behind by it all.
    assert np.degrees(turned[3] - found[3]) == pytest.approx(-0.9, abs=1e-3)
    assert np.degrees(turned[5] - found[5]) == pytest.approx(0.9 / 8, abs=1e-3)
    lost = (*session.dwells[:8], replace(session.dwells[8], angle_deg=None))
    without = fit(replace(session, dwells=lost), "ml").comparison.predictions["ml"].angle_rad
    assert np.isfinite(without).tolist() == [True] * 8 + [False]


@pytest.mark.parametrize("used", [0, 1, 7, 40, 41, 93])
def test_every_dwell_is_left_out_once_and_those_that_took_no_part_together(used):
    rows = np.zeros(100, dtype=bool)
    rows[np.random.default_rng(1).permutation(100)[:used]] = True
    folds = list(held_out_groups(rows))
    np.testing.assert_array_equal(np.sort(np.concatenate(folds)), np.arange(100))
    np.testing.assert_array_equal(folds[0], np.flatnonzero(~rows))
    assert len(folds) - 1 == min(used, 40)
    assert all(rows[fold].all() for fold in folds[1:])
    sizes = [len(fold) for fold in folds[1:]]
    assert max(sizes, default=0) - min(sizes, default=0) <= 1


def test_the_paper_is_scored_although_its_equations_divide_by_zero_at_one_place(tmp_path):
    # Without the dwell at 0° the first two positions are 90° and 180°, and U_x1 is zero.
    path = tmp_path / "zeros.csv"
    readings = [(1000, 0), (0, -1000), (-1000, 0), (0, 1000)]
    rows = [f"{k},{k},{90 * k},{x},{y}" for k, (x, y) in enumerate(readings)]
    path.write_text("# accel_unit: mg\ntime_s,position,angle_deg,ax,ay\n" + "\n".join(rows) + "\n")
    comparison = fit(load_session(path)).comparison
    assert comparison.scores["paper"].dwells == 4
    assert {score.dwells for score in comparison.scores.values()} == {4}
