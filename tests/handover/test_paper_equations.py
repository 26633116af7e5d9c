"""The numbers behind the page against the paper's equations written out by hand."""

import math

import numpy as np
import pytest

from adis_gonio.bench.events import DwellDone
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.fitting import fit
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.handover import paper_study as through_chip
from adis_gonio.handover.paper_map import (
    MMPM_ANGLES_DEG,
    TABLE,
    Draws,
    Point,
    crossing_deg,
    errors,
    estimates,
    readings as by_readings,
    truth_of,
)
from adis_gonio.handover.paper_study import (
    MethodValues,
    Part,
    Results,
    errors_with_bias,
    measured,
    printed_verdicts,
    quantities,
    spread_of,
)
from adis_gonio.record.plans import plan
from adis_gonio.record.settings import Settings
from handover import by_hand


@pytest.fixture(scope="module")
def part():
    return Part(41, truth_of("x"))


def natural(session):
    data = readings_of(session)
    return data.mean / data.gravity_mg


def test_table_1_is_what_the_theory_prints():
    values = [(r.printed, r.axis, r.measured, r.paper, r.mmpm, r.specification) for r in TABLE]
    assert values == [
        ("SF", "x", 0.0214, 0.0116, 0.0128, 0.0),
        ("SF", "y", 0.021, 0.0121, 0.0129, 0.0),
        ("Δφ", "x", -0.003, -0.0025, -0.003, -0.001),
        ("Δφ", "y", -0.0029, -0.0023, -0.003, -0.001),
        ("N", "x", 0.0612, 0.051, -0.057, 0.05),
        ("N", "y", 0.0673, 0.0514, -0.055, 0.05),
    ]


@pytest.mark.parametrize(("column", "phi"), [("x", 0.0612), ("y", 0.0673)])
def test_the_hidden_parameters_of_the_chips_world_are_the_measured_column(column, phi):
    with open_sensor(Part(3, truth_of(column)).url) as sensor:
        hidden = sensor.bus.world.truth()
    assert hidden["scale_x"] == pytest.approx(1.0214)
    assert hidden["scale_y"] == pytest.approx(1.021)
    assert hidden["delta_phi"] == pytest.approx(phi)
    assert (hidden["bias_x"], hidden["bias_y"]) == pytest.approx((-3.0, -2.9))


def test_a_session_through_the_chip_gives_the_numbers_of_the_equations_by_hand(part):
    four, nine = measured(part, "four-position"), measured(part, "mmpm")
    (x1, y1), (x2, y2) = natural(four)[:2]
    delta_k, phi = by_hand.paper(x1, y1, x2, y2)
    ours = quantities(fit(four, "paper"))
    assert ours.values["delta_k"] == pytest.approx(delta_k, abs=1e-12)
    assert ours.values["non_orthogonality"] == pytest.approx(phi, abs=1e-9)
    assert ours.values["scale_error_x"] == pytest.approx(math.hypot(x1, x2) - 1, abs=1e-12)
    assert ours.values["scale_error_y"] == pytest.approx(math.hypot(x1, x2) / (1 + delta_k) - 1, abs=1e-12)
    assert ours.values["offset_x"] is None

    delta_k, phi, b_x, b_y = by_hand.mmpm(MMPM_ANGLES_DEG, natural(nine).tolist())
    ours = quantities(fit(nine, "mmpm"))
    assert ours.values["delta_k"] == pytest.approx(delta_k, abs=1e-12)
    assert ours.values["non_orthogonality"] == pytest.approx(phi, abs=1e-9)
    assert (ours.values["offset_x"], ours.values["offset_y"]) == pytest.approx((b_x, b_y), abs=1e-12)


def test_the_maps_estimates_are_those_of_the_equations_by_hand():
    truth, point = truth_of("y"), Point(0.3, 4.0, 0.5)
    draws = Draws.of(np.random.default_rng(5), 6)
    ours = estimates(truth, point, draws)
    phi = math.radians(0.0673)
    for i in range(6):
        bias = 4e-3 * draws.bias[i]
        rows = []
        for plan_number, angles in enumerate(((0, 90, 180, 270), MMPM_ANGLES_DEG)):
            rows.append([])
            for k, angle in enumerate(angles):
                theta = math.radians(angle) - math.radians(0.3) * draws.fixture[plan_number][i, k]
                at = by_hand.readings(draws.alpha_rad[i], 1.0214, 1.021, phi, theta, *bias)
                rows[-1].append(np.array(at) + 5e-4 * draws.noise[plan_number][i, k])
        by_two = by_hand.paper(*rows[0][0], *rows[0][1])
        by_nine = by_hand.mmpm(MMPM_ANGLES_DEG, rows[1])
        assert ours["paper"]["delta_k"][i] == pytest.approx(by_two[0], abs=1e-12)
        assert ours["paper"]["non_orthogonality"][i] == pytest.approx(by_two[1], abs=1e-9)
        assert ours["mmpm"]["delta_k"][i] == pytest.approx(by_nine[0], abs=1e-12)
        assert ours["mmpm"]["non_orthogonality"][i] == pytest.approx(by_nine[1], abs=1e-9)


@pytest.mark.parametrize(("bias", "noise"), [(0.0, 0.16), (1.0, 0.05), (10.0, 0.5)])
def test_the_crossing_is_where_propagation_by_hand_puts_it(bias, noise):
    draws = Draws.of(np.random.default_rng(11), 20_000)
    ours = crossing_deg(truth_of("x"), bias, noise, draws)
    assert ours == pytest.approx(by_hand.crossing_deg(bias, noise, 5.0, 1.0212), rel=0.04)


def test_in_delta_phi_there_is_no_crossing_and_mmpm_is_three_times_better_on_a_coarse_stage():
    draws = Draws.of(np.random.default_rng(12), 20_000)
    assert crossing_deg(truth_of("x"), 0.0, 0.16, draws, "non_orthogonality") is None
    found = errors(truth_of("x"), Point(0.5, 0.0, 0.05), draws)
    ratio = found["paper"]["non_orthogonality"] / found["mmpm"]["non_orthogonality"]
    assert ratio == pytest.approx(3.0, rel=0.03)  # √2 over √(2/9)


def test_with_biases_of_10_mg_the_papers_angle_is_more_than_50_times_worse():
    draws = Draws.of(np.random.default_rng(13), 5000)
    found = errors(truth_of("x"), Point(0.02, 10.0, 0.16), draws)
    ratio = found["paper"]["non_orthogonality"] / found["mmpm"]["non_orthogonality"]
    assert ratio > 50
    # √2 b in radians, whatever the start angle.
    assert found["paper"]["non_orthogonality"] == pytest.approx(math.degrees(math.sqrt(2) * 0.01), rel=0.05)


def test_readings_of_the_map_are_those_of_chip_and_driver_at_the_stages_true_angles(tmp_path):
    """One session with a coarse stage: what the driver measured against the model at the hidden angles."""
    noise_mg = 4.7
    settings = {"fixture_sigma_deg": 0.5, "bias_instability_mg": 0.0, "noise_mg": noise_mg}
    part = Part(17, truth_of("x"), settings)
    hidden_deg = []
    with open_sensor(part.url) as sensor:
        world = sensor.bus.world
        runner = SessionRunner.begin(
            sensor, tmp_path / "s.session", plan("mmpm"), Settings(dwell_s=1.0), auto=True,
            gravity_mps2=world.settings.gravity_mps2, fixture_sigma_deg=0.5,
        )  # fmt: skip
        for event in runner.run():
            if isinstance(event, DwellDone):
                hidden_deg.append(world.stage.error_deg)
        alpha = math.radians(world.truth()["alpha"])
    assert np.std(hidden_deg) > 0.1
    from adis_gonio.record.loading import load_session

    got = natural(load_session(tmp_path / "s.session"))
    bias = np.broadcast_to(np.array([-3.0e-3, -2.9e-3]), (1, 9, 2))
    model = by_readings(part.truth, MMPM_ANGLES_DEG, np.array([alpha]), np.radians([hidden_deg]), bias)[0]
    assert np.abs(got - model).max() < 5 * 1e-3 * noise_mg / math.sqrt(819)


def handmade(paper_deg, ours_deg, seed=1):
    true = truth_of("x").delta_phi_deg
    found = {
        method: MethodValues({"non_orthogonality": true + error}, {"non_orthogonality": 0.1})
        for method, error in (("paper", paper_deg), ("ml", ours_deg))
        if error is not None
    }
    return Results(Part(seed, truth_of("x")), found)


def test_the_multiple_is_of_the_sessions_that_both_answered_and_counts_the_others():
    results = [handmade(0.6, 0.01), handmade(-0.8, 0.01), handmade(None, 0.5)]
    found = errors_with_bias(results, np.random.default_rng(0))
    assert found.multiple == pytest.approx(math.sqrt((0.36 + 0.64) / 2) / 0.01)
    assert (found.sessions, found.refused) == (2, 1)
    assert found.low <= found.multiple <= found.high
    assert 59 < found.low < found.high < 81
    spread = spread_of(results, "paper", "non_orthogonality")
    assert spread.sessions == 2
    assert spread.error == pytest.approx(math.sqrt(0.5))


def test_the_printed_table_has_mmpm_nearer_everywhere_but_for_the_sign_of_n():
    nearer = {name: verdict["nearer"] for name, verdict in printed_verdicts().items()}
    assert [name for name, method in nearer.items() if method == "paper"] == ["N, X", "N, Y"]
    assert {verdict["nearer_without_sign"] for verdict in printed_verdicts().values()} == {"mmpm"}


def test_equation_5_is_off_by_delta_phi_tan_alpha():
    at = by_readings(truth_of("x"), [0.0, 90.0], np.radians([20.0]), np.zeros((1, 2)), np.zeros((1, 2, 2)))
    x1, _, _, y2 = at[0].ravel()
    off = x1 / -y2 - 1 - truth_of("x").delta_k
    assert off == pytest.approx(math.radians(0.0612) * math.tan(math.radians(20)), rel=0.01)


def test_a_methods_refusal_is_kept_with_its_reason(monkeypatch):
    from adis_gonio.base.errors import SingularError

    def refusing(session, method):
        raise SingularError(f"method {method} is singular here")

    monkeypatch.setattr(through_chip, "fit", refusing)
    monkeypatch.setattr(through_chip, "measured", lambda part, name: None)
    results = through_chip.results_of(Part(1, truth_of("x")))
    assert not results.found
    assert results.refused["paper"] == "method paper is singular here"
