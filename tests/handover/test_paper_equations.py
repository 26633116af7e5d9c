"""The numbers behind the page against the paper's equations written out by hand."""

import math

import numpy as np
import pytest

from adis_gonio.device.sensor import open_sensor
from adis_gonio.fitting import fit
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.handover import paper_study as through_chip
from adis_gonio.handover.paper_study import (
    DELTA_K,
    METHODS,
    TABLE,
    TRACED,
    Study,
    crossing_deg,
    estimates_of,
    measured,
    propagated_errors,
    reproduce,
    url_of,
    verdicts,
)
from handover import by_hand


@pytest.fixture(scope="module")
def part():
    return url_of(41, "x")


MMPM_DEG = tuple(40.0 * k for k in range(9))


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
    with open_sensor(url_of(3, column)) as sensor:
        hidden = sensor.bus.world.truth()
    assert hidden["scale_x"] == pytest.approx(1.0214)
    assert hidden["scale_y"] == pytest.approx(1.021)
    assert hidden["delta_phi"] == pytest.approx(phi)
    assert (hidden["bias_x"], hidden["bias_y"]) == pytest.approx((-3.0, -2.9))


def test_a_session_through_the_chip_gives_the_numbers_of_the_equations_by_hand(part):
    four, nine = measured(part, "four-position"), measured(part, "mmpm")
    (x1, y1), (x2, y2) = natural(four)[:2]
    delta_k, phi = by_hand.paper(x1, y1, x2, y2)
    ours = estimates_of(fit(four, "paper"))
    assert ours["delta_k"][0] == pytest.approx(delta_k, abs=1e-12)
    assert ours["delta_phi"][0] == pytest.approx(phi, abs=1e-9)
    assert ours["scale_x"][0] == pytest.approx(math.hypot(x1, x2), abs=1e-12)
    assert ours["scale_y"][0] == pytest.approx(math.hypot(x1, x2) / (1 + delta_k), abs=1e-12)
    assert "bias_x" not in ours

    delta_k, phi, b_x, b_y = by_hand.mmpm(MMPM_DEG, natural(nine).tolist())
    ours = estimates_of(fit(nine, "mmpm"))
    assert ours["delta_k"][0] == pytest.approx(delta_k, abs=1e-12)
    assert ours["delta_phi"][0] == pytest.approx(phi, abs=1e-9)
    assert (ours["bias_x"][0], ours["bias_y"][0]) == pytest.approx((1e3 * b_x, 1e3 * b_y), abs=1e-9)


@pytest.mark.parametrize(("fixture_deg", "bias_mg", "noise_mg"), [(0.5, 0.0, 0.16), (0.02, 10.0, 0.5)])
def test_the_propagated_errors_are_the_scatter_of_the_equations_by_hand(fixture_deg, bias_mg, noise_mg):
    """Sessions of the planar model with an error of each angle, a bias of each axis and noise."""
    rng = np.random.default_rng(5)
    k_x, k_y, phi = 1.0214, 1.021, math.radians(0.0612)
    found = {"paper": [], "mmpm": []}
    for _ in range(4000):
        alpha = math.radians(rng.uniform(-5, 5))
        bias = 1e-3 * bias_mg * rng.standard_normal(2)
        rows = []
        for angle in MMPM_DEG:
            theta = math.radians(angle - fixture_deg * rng.standard_normal())
            rows.append(by_hand.readings(alpha, k_x, k_y, phi, theta, *bias))
        at_90 = math.radians(90 - fixture_deg * rng.standard_normal())
        two = [rows[0], by_hand.readings(alpha, k_x, k_y, phi, at_90, *bias)]
        two, rows = (np.array(r) + 1e-3 * noise_mg * rng.standard_normal((len(r), 2)) for r in (two, rows))
        found["paper"].append(by_hand.paper(*two.ravel()))
        found["mmpm"].append(by_hand.mmpm(MMPM_DEG, rows))
    stated = propagated_errors(fixture_deg, bias_mg, noise_mg)
    for error, method in zip(stated, ("paper", "mmpm"), strict=True):
        assert error == pytest.approx(np.std([delta_k for delta_k, *_ in found[method]]), rel=0.05)
    two, nine = (np.std([delta_phi for _, delta_phi, *_ in found[method]]) for method in found)
    assert nine < two  # in Δφ the paper's method is never better


def test_at_the_crossing_both_methods_have_one_error_of_delta_k():
    for bias in (0.0, 10.0):
        two, nine = propagated_errors(crossing_deg(bias, 0.16), bias, 0.16)
        assert two == pytest.approx(nine)


def test_the_true_delta_k_of_the_paper_is_the_difference_of_its_two_scale_errors():
    assert DELTA_K.measured == pytest.approx(TABLE[0].measured - TABLE[1].measured, abs=2e-4)


def handmade(paper_deg, ours_deg):
    return {
        method: {"delta_phi": (TABLE[4].measured + error, 0.1)}
        for method, error in (("paper", paper_deg), ("ml", ours_deg))
        if error is not None
    }


def test_the_spread_is_of_the_sessions_that_a_method_answered():
    results = [handmade(0.6, 0.01), handmade(-0.8, 0.01), handmade(None, 0.5)]
    spread = Study(1, 3, {"x": results}).spread(TABLE[4], "paper")
    assert spread.sessions == 2
    assert spread.error == pytest.approx(math.sqrt(0.5))


def test_a_study_applies_every_method_to_each_part_and_traces_the_first_of_each_column():
    study = reproduce(7, 2)
    for column in "xy":
        first, second = study.results[column]
        assert set(first) == set(METHODS)
        assert set(second) == set(METHODS) - {TRACED}
        assert first["ml"] != second["ml"]
        for one in (first, second):
            assert one["mmpm"]["bias_x"][0] == pytest.approx(-3.0, abs=2)


@pytest.mark.parametrize(("sessions", "traced"), [(2, 1), (5, 1), (9, 1), (10, 2)])
def test_a_fifth_of_the_parts_is_traced_and_a_seed_draws_the_same_parts(monkeypatch, sessions, traced):
    monkeypatch.setattr(through_chip, "results_of", lambda *asked: asked)
    results = reproduce(7, sessions).results
    assert results == reproduce(7, sessions).results != reproduce(8, sessions).results
    for column in "xy":
        urls, flags = zip(*results[column], strict=True)
        assert flags == (True,) * traced + (False,) * (sessions - traced)
        assert len(set(urls)) == sessions
        angle = {"x": 0.0612, "y": 0.0673}[column]
        assert all(f"&delta_phi_deg={angle}&" in url for url in urls)


def test_the_printed_table_has_mmpm_nearer_everywhere_but_for_the_sign_of_n():
    nearer = [row.name for row in TABLE if abs(row.paper - row.measured) < abs(row.mmpm - row.measured)]
    assert nearer == ["N, X", "N, Y"]
    assert f"in {len(nearer)} of 6 rows, the rows of N" in verdicts(Study(1, 0, {"x": [], "y": []}))[-1]


def test_a_method_that_refuses_a_session_has_no_result(monkeypatch):
    from adis_gonio.base.errors import SingularError

    def refusing(session, method):
        raise SingularError(f"method {method} is singular here")

    monkeypatch.setattr(through_chip, "fit", refusing)
    monkeypatch.setattr(through_chip, "measured", lambda url, name: None)
    results = through_chip.results_of(url_of(1, "x"))
    assert not results
    assert Study(1, 1, {"x": [results]}).spread(DELTA_K, "paper").sessions == 0
