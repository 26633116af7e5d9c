"""The five methods on readings whose truth is known, their refusals and their warnings."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.errors import FitError, SingularError, UsageError
from adis_gonio.fitting import METHODS, applicable_methods, fit
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.methods import fit_of
from adis_gonio.model.measurement import axes_matrix
from adis_gonio.model.records import Dwell, Session

G = 1000.0
TWO = (0, 90)
FOUR = (0, 90, 180, 270)
NINE = tuple(range(0, 360, 40))


def planar(
    angles,
    alpha=20.0,
    phi=0.3,
    delta_k=0.02,
    bias=(0.0, 0.0),
    sigma=0.0,
    u=0.1,
    noise=None,
    true_angles=None,
    **more,
):
    """Session of one reading a position, without noise unless given (n, 2)."""
    true = np.asarray(angles if true_angles is None else true_angles, dtype=float)
    psi = np.radians(alpha - true)
    k_y = 0.99
    readings = G * np.stack(
        [k_y * (1 + delta_k) * np.cos(psi), k_y * np.sin(psi + math.radians(phi))], axis=1
    ) + np.asarray(bias)
    if noise is not None:
        readings = readings + noise
    dwells = tuple(
        Dwell(k, np.array([float(k)]), readings[k : k + 1], None if np.isnan(a) else float(a))
        for k, a in enumerate(np.asarray(angles, dtype=float))
    )
    settings = {"accel_unit": "mg", "reading_u_mg": u, "fixture_sigma_deg": sigma, "sensor": "generic"}
    return Session(dwells=dwells, **{**settings, **more})


def values(result):
    return {name: one.value for name, one in result.parameters.items()}


@pytest.mark.parametrize("alpha", [-170, -45, 0, 20, 45, 90, 133])
def test_two_position_is_exact_at_every_start_angle(alpha):
    found = values(fit(planar(TWO, alpha=alpha), "two-position"))
    assert found["delta_k"] == pytest.approx(0.02, abs=1e-12)
    assert found["delta_phi"] == pytest.approx(0.3, abs=1e-10)
    assert found["alpha"] == pytest.approx(alpha, abs=1e-10)
    assert found["scale_x"] == pytest.approx(0.99 * 1.02)
    assert "bias_x" not in found


@pytest.mark.parametrize(
    ("method", "angles"), [("four-position", FOUR), ("mmpm", NINE), ("ml", NINE), ("ml", FOUR)]
)
def test_methods_that_see_a_bias_are_exact_with_one(method, angles):
    found = values(fit(planar(angles, bias=(57.3, -20.6)), method))
    expected = {"delta_k": 0.02, "delta_phi": 0.3, "alpha": 20.0, "bias_x": 57.3, "bias_y": -20.6}
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, abs=1e-7), name


def test_a_bias_misleads_two_positions_as_the_theory_says():
    session = planar(TWO, alpha=20, phi=0.3, delta_k=0, bias=(5, 0))
    found = fit(session, "two-position")
    assert found["delta_phi"].value == pytest.approx(0.13, abs=0.015)
    warning = next(w for w in found.warnings if "bias" in w)
    assert "cannot be seen in two positions" in warning
    assert "180° and 270°" in warning
    # The stated sensitivity is the slope that is seen.
    slope = (found["delta_phi"].value - 0.3) / 5
    stated = float(warning.replace("−", "-").split("moves Δφ by ")[1].split("°")[0])
    assert stated == pytest.approx(slope, rel=0.1)


def test_paper_is_exact_where_its_equations_are_and_says_where_they_are_not():
    level = fit(planar(TWO, alpha=0, phi=0.3), "paper")
    assert level["delta_k"].value == pytest.approx(0.02, abs=2e-5)
    assert level["delta_phi"].value == pytest.approx(0.3, abs=1e-4)
    tilted = fit(planar(TWO, alpha=20, phi=0.3, delta_k=0), "paper")
    # Equation 5 is off by about Δφ·tan α, and with it equation 12 by 1/cos(2α + Δφ).
    assert abs(tilted["delta_k"].value) == pytest.approx(
        math.radians(0.3) * math.tan(math.radians(20)), rel=0.05
    )
    assert tilted["delta_phi"].value == pytest.approx(0.3 / math.cos(math.radians(40.3)), rel=1e-3)
    assert any("equation 5 is exact at α = 0° only" in w and "+0.09" in w for w in tilted.warnings)
    assert any("bias cannot be seen" in w for w in tilted.warnings)


@pytest.mark.parametrize("phi", [0.0, 0.3, -0.3, 2.0])
@pytest.mark.parametrize("alpha", [45.0, -45.0, 135.0])
def test_paper_refuses_its_pole_and_says_by_how_much(alpha, phi):
    with pytest.raises(SingularError) as caught:
        fit(planar(TWO, alpha=alpha, phi=phi, u=0.02), "paper")
    message = str(caught.value)
    assert "singular" in message
    assert f"α = {alpha:.2f}°" in message.replace("−", "-")
    assert "times" in message
    assert "two-position" in message
    assert "\n" not in message


def test_paper_refuses_by_what_the_session_can_tell_and_not_by_an_angle():
    assert fit(planar(TWO, alpha=44, phi=0.0, u=0.02), "paper")["delta_phi"].u > 0.01
    with pytest.raises(SingularError):
        fit(planar(TWO, alpha=44, phi=0.0, u=5.0), "paper")
    with pytest.raises(SingularError):
        fit(planar(TWO, alpha=44, phi=0.6, u=0.02), "paper")


def test_papers_uncertainty_grows_towards_its_pole():
    def u(alpha):
        return fit(planar(TWO, alpha=alpha, phi=0.0, u=0.1), "paper")["delta_phi"].u

    # docs/theory.md (two positions): 0.008° at 5°, 0.016° at 30° and 0.27° at 44° with 1e-4 G; with ΔK by
    # equation 5 its own noise comes on top, hence more than the pole's 1/cos 2α.
    assert u(5) == pytest.approx(0.008, rel=0.3)
    assert u(30) / u(5) > 1.9
    assert u(43) / u(5) > 12
    two = [fit(planar(TWO, alpha=a, u=0.1), "two-position")["delta_phi"].u for a in (5, 30, 44, 45)]
    np.testing.assert_allclose(two, 0.0081, rtol=0.02)


@pytest.mark.parametrize("method", ["paper", "two-position", "four-position", "mmpm", "ml"])
def test_covariance_is_noise_and_errors_of_angles_carried_through_the_fit(method):
    """By differences of fits; `fit_statistics` compares it with the scatter of drawn sessions."""
    angles = {"paper": TWO, "two-position": TWO, "four-position": FOUR}.get(method, NINE)
    n, sigma, u_mg = len(angles), 0.05, 0.3
    truth = {"alpha": 10.0, "phi": 0.2, "delta_k": 0.01, "sigma": sigma, "u": u_mg}
    exact = fit(planar(angles, **truth), method)

    def values(move):
        off, noise = sigma * move[:n], u_mg * move[n:].reshape(n, 2)
        session = planar(angles, true_angles=np.asarray(angles) - off, noise=noise, **truth)
        return np.array([e.value for e in fit_of(readings_of(session), method).parameters.values()])

    slopes = np.array([values(move) - values(-move) for move in 0.1 * np.eye(3 * n)]) / 0.2
    carried, stated = slopes.T @ slopes, exact.covariance
    u = np.sqrt(np.diag(stated))
    np.testing.assert_allclose(carried / np.outer(u, u), stated / np.outer(u, u), atol=0.02)
    assert [e.u for e in exact.parameters.values()] == pytest.approx(u.tolist())


def test_ml_weighs_angles_by_what_they_are_worth():
    rng = np.random.default_rng(2)
    sigma, errors = 0.5, {"ml": [], "mmpm": []}
    for _ in range(60):
        true = np.asarray(NINE) - rng.normal(0, sigma, 9)
        session = planar(NINE, true_angles=true, noise=rng.normal(0, 0.1, (9, 2)), sigma=sigma)
        for method, found in errors.items():
            found.append(fit(session, method)["delta_phi"].value - 0.3)
    assert np.std(errors["ml"]) < 0.2 * np.std(errors["mmpm"])


def test_repeated_dwells_are_combined_and_modulo_a_turn():
    rng = np.random.default_rng(3)
    angles = (0, 90, 360, -270, 180, 270, 450.2)
    once = fit(planar(FOUR, u=0.4), "four-position")
    many = fit(planar(angles, u=0.4, noise=rng.normal(0, 1e-6, (7, 2))), "four-position")
    assert many["delta_phi"].value == pytest.approx(0.3, abs=1e-2)
    assert many["delta_phi"].u < once["delta_phi"].u
    assert many.positions == (0, 2, 1, 3, 6, 4, 5)
    assert many.dof == 2 * 7 - 6


def test_dwells_for_checking_take_no_part():
    session = planar((*FOUR, 45))
    spoiled = replace(session.dwells[-1], accel=session.dwells[-1].accel + 500, use="check")
    session = replace(session, dwells=(*session.dwells[:-1], spoiled))
    assert fit(session, "ml")["bias_x"].value == pytest.approx(0, abs=1e-6)


def test_ml_with_two_positions_holds_the_bias_and_names_it():
    result = fit(planar(TWO, u=0.1), "ml")
    assert values(result)["delta_phi"] == pytest.approx(0.3, abs=1e-6)
    assert set(result.undetermined) == {"bias_x", "bias_y"}
    assert "bias_x" not in result
    text = " ".join(result.warnings)
    assert "bias_x cannot be seen in these positions" in text
    assert "180° and 270°" in text
    two = fit(planar(TWO, u=0.1), "two-position")
    for name in ("delta_k", "delta_phi", "alpha"):
        assert result[name].u == pytest.approx(two[name].u, rel=1e-6)


def test_ml_with_three_positions_has_everything_and_nothing_to_spare():
    result = fit(planar((0, 90, 180), bias=(30, -10)), "ml")
    assert result.dof == 0
    assert result["bias_x"].value == pytest.approx(30, abs=1e-5)
    assert result.undetermined == ()


def test_opposite_positions_alone_determine_no_angle():
    with pytest.raises(SingularError) as caught:
        fit(planar((0, 180)), "ml")
    assert "cannot determine delta_k or delta_phi" in str(caught.value)
    assert "0°, 90°, 180°, 270°" in str(caught.value)


def test_free_attitudes_leave_alpha_out_and_find_the_ellipse():
    rng = np.random.default_rng(4)
    angles = rng.uniform(0, 360, 12)
    session = planar(angles, bias=(40, -30), sigma=math.inf)
    result = fit(session)
    assert result.method == "ml"
    assert "alpha" in result.undetermined
    assert values(result)["delta_phi"] == pytest.approx(0.3, abs=1e-6)
    assert values(result)["bias_y"] == pytest.approx(-30, abs=1e-5)
    assert result.dof == 12 - 5
    unknown = replace(session, dwells=tuple(replace(d, angle_deg=None) for d in session.dwells))
    again = fit(replace(unknown, fixture_sigma_deg=0.1))
    assert values(again) == pytest.approx(values(result), abs=1e-7)
    assert again.as_dict()["angle_error_deg"] is None
    with pytest.raises(FitError, match="free"):
        fit(session, "mmpm")


def test_free_attitudes_on_four_positions_cannot_see_all():
    result = fit(planar((0, 90, 200, 300), sigma=math.inf, u=0.1))
    assert {"bias_x", "bias_y"} & set(result.undetermined)
    assert any("cannot be seen" in w for w in result.warnings)


def test_a_direction_beyond_linearity_counts_as_undetermined_although_not_singular():
    rng = np.random.default_rng(11)
    arc = np.linspace(0, 12, 15)
    result = fit(planar(arc, sigma=math.inf, u=1.0, noise=rng.normal(0, 1.0, (15, 2))))
    assert {"bias_x", "bias_y"} <= set(result.undetermined)
    wide = fit(planar(np.linspace(0, 300, 15), sigma=math.inf, u=1.0, noise=rng.normal(0, 1.0, (15, 2))))
    assert "bias_x" in wide


def test_counts_need_no_scale_for_mismatch_and_misalignment():
    session = planar(NINE, bias=(0, 0), sigma=0.05)
    counts = tuple(
        replace(d, accel=d.accel * np.array([0.41, 0.4]) + [33000, 32000]) for d in session.dwells
    )
    result = fit(replace(session, dwells=counts, accel_unit="counts"), "ml")
    assert result["delta_phi"].value == pytest.approx(0.3, abs=1e-6)
    assert result["delta_k"].value == pytest.approx(1.02 * 0.41 / 0.4 - 1, abs=1e-8)
    assert result["bias_x"].value == pytest.approx(33000, abs=1e-4)
    assert result["bias_x"].unit == "counts"
    assert result["scale_y"].unit == "counts/(m/s²)"
    assert result["scale_y"].value == pytest.approx(0.99 * 0.4 * 1000 / 9.80665, rel=1e-7)
    four = planar(FOUR, accel_unit="counts")
    with pytest.raises(FitError, match="known zero"):
        fit(four, "two-position")


def spatial(n=24, noise=0.0, seed=5, vectors=None, **more):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, 3)) if vectors is None else np.asarray(vectors, dtype=float)
    u = u / np.linalg.norm(u, axis=1, keepdims=True)
    gain = np.array([1.01, 0.99, 1.002])
    mixing = gain[:, None] * axes_matrix(np.radians([0.2, -0.3, 0.4]))
    readings = G * u @ mixing.T + [57.0, -21.0, 46.0] + rng.normal(0, 1, (len(u), 3)) * noise
    dwells = tuple(Dwell(k, np.array([float(k)]), readings[k : k + 1]) for k in range(len(u)))
    settings = {"plane": "none", "accel_unit": "mg", "sensor": "generic", "reading_u_mg": 0.2}
    return Session(dwells=dwells, fixture_sigma_deg=math.inf, **{**settings, **more})


def test_space_finds_bias_scale_and_skew():
    result = fit(spatial())
    expected = {
        "bias_x": 57, "bias_y": -21, "bias_z": 46, "scale_x": 1.01, "scale_y": 0.99, "scale_z": 1.002,
        "skew_xy": 0.2, "skew_xz": -0.3, "skew_yz": 0.4,
    }  # fmt: skip
    assert values(result) == pytest.approx(expected, abs=1e-6)
    assert result.dof == 24 - 9
    assert result.residual_rms_mg < 1e-6
    assert result.as_dict()["angle_error_deg"] is None


def test_space_in_counts_finds_scale_and_zero_too():
    session = spatial()
    dwells = tuple(replace(d, accel=d.accel * 4.06 + 33000) for d in session.dwells)
    result = fit(replace(session, dwells=dwells, accel_unit="counts", gravity_mps2=9.80665))
    assert result["scale_x"].value == pytest.approx(1.01 * 4.06 * 1000 / 9.80665, rel=1e-8)
    assert result["bias_z"].value == pytest.approx(33000 + 46 * 4.06, abs=1e-4)
    assert result["skew_yz"].value == pytest.approx(0.4, abs=1e-6)


def test_six_faces_leave_the_skews_undetermined():
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    result = fit(spatial(vectors=faces))
    assert set(result.undetermined) == {"skew_xy", "skew_xz", "skew_yz"}
    assert result["bias_x"].value == pytest.approx(57, abs=1)
    assert any("skew_xy cannot be seen" in w and "share gravity" in w for w in result.warnings)


def test_a_turn_about_z_leaves_z_undetermined_and_keeps_the_rest():
    t = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    session = spatial(vectors=np.stack([np.cos(t), np.sin(t), 0 * t], axis=1))
    flat = tuple(replace(d, accel=d.accel * [1, 1, 0]) for d in session.dwells)
    result = fit(replace(session, dwells=flat))
    assert {"bias_z", "scale_z"} <= set(result.undetermined)
    assert "bias_x" in result
    assert "scale_y" in result
    assert any("not determined by these positions" in w for w in result.warnings)
    assert any("axis z up and down" in w for w in result.warnings)


def test_an_unknown_reading_uncertainty_is_estimated_from_the_residual():
    rng = np.random.default_rng(6)
    angles = np.arange(0, 360, 10.0)
    session = planar(angles, noise=rng.normal(0, 0.7, (36, 2)), u=None, sigma=0.02)
    result = fit(session, "ml")
    note = next(w for w in result.warnings if "reading_u_mg" in w)
    assert float(note.split("were given ")[1].split(" mg")[0]) == pytest.approx(0.7, rel=0.2)
    assert result.chi2 == pytest.approx(result.dof, rel=0.1)
    stated = fit(replace(session, reading_u_mg=0.7), "ml")
    assert result["delta_phi"].u == pytest.approx(stated["delta_phi"].u, rel=0.25)


def test_without_any_knowledge_of_noise_there_is_no_uncertainty():
    result = fit(planar(TWO, u=None), "two-position")
    assert result["delta_phi"].u is None
    assert result.covariance is None
    assert any("no uncertainty can be given" in w for w in result.warnings)
    assert json.loads(json.dumps(result.as_dict()))["parameters"]["delta_phi"]["u"] is None


def test_an_unknown_fixture_is_estimated_or_taken_as_exact():
    rng = np.random.default_rng(7)
    angles = np.arange(0, 360, 10.0)
    true = angles - rng.normal(0, 0.3, 36)
    result = fit(planar(angles, true_angles=true, noise=rng.normal(0, 0.1, (36, 2)), sigma=None), "ml")
    assert result.fixture_sigma_deg == pytest.approx(0.3, rel=0.3)
    assert any("was estimated from the residual" in w for w in result.warnings)
    exact = fit(planar(angles, noise=rng.normal(0, 0.1, (36, 2)), sigma=None), "ml")
    assert exact.fixture_sigma_deg < 0.01
    two = fit(planar(TWO, sigma=None), "two-position")
    assert any("declared angles were taken as exact" in w for w in two.warnings)


def test_a_residual_beyond_the_noise_is_said_and_enlarges_the_uncertainty():
    rng = np.random.default_rng(8)
    angles = np.arange(0, 360, 20.0)
    noise = rng.normal(0, 2.0, (18, 2))
    result = fit(planar(angles, noise=noise, u=0.1, sigma=0.01), "ml")
    assert result.chi2 / result.dof > 50
    assert any("times what the noise of the readings explains" in w for w in result.warnings)
    assert result.extra_mg == pytest.approx(2.0, rel=0.4)
    honest = fit(planar(angles, noise=noise, u=2.0, sigma=0.01), "ml")
    # Effects of the catalogue that 2 mg of scatter would hide are covered as well.
    assert 1.0 < result["bias_x"].u / honest["bias_x"].u < 8
    assert honest.extra_mg == 0


def test_chi2_is_that_of_its_degrees_of_freedom():
    rng = np.random.default_rng(9)
    for method in ("four-position", "mmpm", "ml"):
        angles = FOUR if method == "four-position" else NINE
        ratio = []
        for _ in range(80):
            n = len(angles)
            true = np.asarray(angles) - rng.normal(0, 0.1, n)
            session = planar(angles, true_angles=true, noise=rng.normal(0, 0.3, (n, 2)), u=0.3, sigma=0.1)
            result = fit_of(readings_of(session), method)
            ratio.append(result.chi2 / result.dof)
        assert np.mean(ratio) == pytest.approx(1, abs=4 * math.sqrt(2 / result.dof / 80)), method


def test_angle_error_is_what_the_calibrated_goniometer_shows():
    true = np.array(NINE, dtype=float)
    true[3] += 0.5
    result = fit(planar(NINE, true_angles=true, sigma=0.5, u=0.01), "ml")
    errors = np.degrees(result.angle_error_rad)
    assert int(np.abs(errors).argmax()) == 3
    assert errors[3] == pytest.approx(0.5, abs=0.08)
    document = result.as_dict()["angle_error_deg"]
    assert document["max"] == pytest.approx(np.abs(errors).max())
    assert document["rms"] == pytest.approx(np.sqrt(np.mean(errors**2)))


def test_the_document_has_the_keys_of_the_format():
    for method, angles in (
        ("paper", TWO),
        ("two-position", TWO),
        ("four-position", FOUR),
        ("mmpm", NINE),
        ("ml", NINE),
    ):
        document = json.loads(json.dumps(fit(planar(angles), method).as_dict(), allow_nan=False))
        assert document["method"] == method
        keys = "method parameters covariance chi2 dof residual_rms_mg angle_error_deg warnings"
        assert set(keys.split()) <= set(document)
        assert document["parameters"]["delta_k"]["unit"] == "1"
        assert document["parameters"]["delta_phi"]["unit"] == "deg"
        names = document["covariance"]["names"]
        assert names == list(document["parameters"])
        matrix = np.array(document["covariance"]["matrix"])
        assert matrix.shape == (len(names), len(names))
        u = [document["parameters"][name]["u"] for name in names]
        np.testing.assert_allclose(np.sqrt(np.diag(matrix)), u)


def test_the_default_is_the_best_that_the_session_supports():
    assert fit(planar(TWO)).method == "two-position"
    assert fit(planar((0, 90, 0, 90))).method == "two-position"
    assert fit(planar((0, 90, 180))).method == "ml"
    assert fit(planar(NINE)).method == "ml"
    assert fit(spatial()).method == "ml"


def test_applicable_methods_follow_the_positions():
    assert applicable_methods(planar(TWO)) == ("paper", "two-position", "ml")
    assert applicable_methods(planar(FOUR)) == ("paper", "two-position", "four-position", "ml")
    assert applicable_methods(planar(range(0, 360, 30))) == METHODS
    assert applicable_methods(planar(NINE)) == ("mmpm", "ml")
    assert applicable_methods(planar(NINE, sigma=math.inf)) == ("ml",)
    assert applicable_methods(spatial()) == ("ml",)
    for angles in (TWO, FOUR, NINE):
        for method in applicable_methods(planar(angles)):
            fit(planar(angles), method)


@pytest.mark.parametrize(
    ("method", "angles", "words"),
    [
        ("two-position", (0, 180), "90 is missing"),
        ("paper", (90, 180), "0 is missing"),
        ("four-position", (0, 90), "180, 270 are missing"),
        ("mmpm", range(0, 360, 45), "nine or more positions with a declared angle, there are 8"),
        ("ml", (30,), "one position only"),
        (None, (30, 30, 30), "one position only (3 dwells)"),
        ("two-position", (0,), "one position only"),
    ],
)
def test_what_a_method_needs_is_said_in_one_line(method, angles, words):
    with pytest.raises(FitError) as caught:
        fit(planar(tuple(angles)), method)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 1
    with pytest.raises(FitError, match=r"^there\.csv: "):
        fit(planar(tuple(angles), source="there.csv"), method)


def test_an_unknown_method_is_wrong_usage():
    with pytest.raises(UsageError, match="no method is called 'magic'"):
        fit(planar(TWO), "magic")


def test_space_has_no_planar_methods():
    with pytest.raises(FitError, match="needs a plane"):
        fit(spatial(), "two-position")


def test_notes_of_the_session_come_first_among_the_warnings():
    result = fit(planar(NINE, notes=("unfinished session",)))
    assert result.warnings[0] == "unfinished session"


def test_attitudes_one_of_which_was_measured_twice_give_what_they_determine():
    """Left out one by one, eight distinct attitudes lead the search past axes that no part can have."""
    counts = [
        [882.8, -211.49, 1931.66], [-1055.3, 1067.61, 1482.17], [55.11, -1897.53, 1050.67],
        [1150.65, 1610.01, 710.6], [1151.5, 1610.2, 711.54], [1801.59, -1181.99, -266.42],
        [-537.74, 1965.54, -512.76], [-783.6, -1606.76, -1234.3], [1322.13, 611.58, -1566.81],
        [-799.17, 280.91, -1964.46],
    ]  # fmt: skip
    dwells = tuple(Dwell(k, np.array([float(k)]), np.array([row])) for k, row in enumerate(counts))
    session = Session(dwells=dwells, accel_unit="lsb", reading_u_mg=0.2, plane="none", sensor="adis16354")
    result = fit(session, method="ml")
    assert set(result.as_dict()["scores"]) == {"ml"}
    assert abs(values(result)["skew_xy"]) < 1.0
