"""u, degrees of freedom, k and U: against GTC, against simulation, and the budget against both."""

import json
import math

import GTC
import numpy as np
import pytest
from scipy import stats

import coverage_of_u as coverage
from adis_gonio import fit
from adis_gonio.base.uncertainty import coverage_factor, effective_dof
from adis_gonio.fitting.monte_carlo import monte_carlo
from adis_gonio.fitting.uncertainty import GRAVITY, Source, Sources
from adis_gonio.model.records import Dwell, Session

G = 1000.0
FOUR, NINE = (0, 90, 180, 270), tuple(range(0, 360, 40))


def turn(
    angles, samples=1, noise=0.1, sigma=0.02, stated=0.1, seed=1, bias=(5.0, -3.0), start=20.0, **more
):
    """A turn of a part with ΔK = 0.02, Δφ = 0.3° and α = `start`."""
    rng = np.random.default_rng(seed)
    psi = np.radians(start - np.asarray(angles, float) + sigma * rng.standard_normal(len(angles)))
    level = G * np.stack([1.02 * np.cos(psi), np.sin(psi + math.radians(0.3))], axis=1) + bias
    dwells = tuple(
        Dwell(
            k,
            10.0 * k + np.arange(float(samples)),
            level[k] + noise * rng.standard_normal((samples, 2)),
            float(a),
        )
        for k, a in enumerate(angles)
    )
    stated_u = stated if samples == 1 else None
    return Session(
        dwells, accel_unit="mg", sensor="generic", fixture_sigma_deg=sigma, reading_u_mg=stated_u, **more
    )


def test_effective_degrees_of_freedom_and_k_are_those_of_gtc():
    for u, v, du, dv in ((1.0, 2.0, 5, 9), (0.3, 0.1, 2, 50), (1.0, 1.0, 3, math.inf)):
        total = GTC.ureal(1, u, du) + GTC.ureal(2, v, dv)
        assert effective_dof([(u**2, du), (v**2, dv)]) == pytest.approx(GTC.dof(total), rel=1e-9)
        dof = effective_dof([(u**2, du), (v**2, dv)])
        assert coverage_factor(dof) == pytest.approx(stats.t.ppf(0.975, dof), rel=1e-9)
    assert coverage_factor(math.inf) == pytest.approx(stats.norm.ppf(0.975))


def test_the_closed_form_propagates_readings_and_angles_as_gtc_does():
    session = turn((0, 90), bias=(0.0, 0.0))
    result = fit(session, "two-position")
    u, sigma = 0.1, math.radians(0.02)
    (x1, y1), (x2, y2) = (dwell.accel[0] for dwell in session.dwells)
    a, b = GTC.ureal(0, sigma), GTC.ureal(0, sigma)
    # ψ turned further by a: U_x1 falls by U_x2, U_y1 by U_y2; at 90° they are what the others were.
    gx1, gy1 = GTC.ureal(x1, u) - x2 * a, GTC.ureal(y1, u) - y2 * a
    gx2, gy2 = GTC.ureal(x2, u) + x1 * b, GTC.ureal(y2, u) + y1 * b
    ratio = GTC.sqrt(gx1**2 + gx2**2) / GTC.sqrt(gy1**2 + gy2**2)
    phi = GTC.atan2(gy1, -gy2) - GTC.atan2(gx2, gx1)
    assert result["delta_k"].value == pytest.approx(GTC.value(ratio) - 1, abs=1e-12)
    assert result["delta_k"].u == pytest.approx(GTC.uncertainty(ratio), rel=0.01)
    assert result["delta_phi"].u == pytest.approx(math.degrees(GTC.uncertainty(phi)), rel=0.01)


def test_four_positions_propagate_as_gtc_does_source_by_source():
    session = turn(FOUR)
    result = fit(session, "four-position")
    readings = np.array([dwell.accel[0] for dwell in session.dwells])
    noise = [[GTC.ureal(0, 0.1) for _ in range(2)] for _ in FOUR]
    angles = [GTC.ureal(0, math.radians(0.02)) for _ in FOUR]
    x, y = [], []
    for k in range(4):
        before = (readings[k - 1] - readings[(k + 1) % 4]) / 2  # ∂U/∂ψ, ψ = α − θ, by the neighbours
        x.append(readings[k, 0] + noise[k][0] + before[0] * angles[k])
        y.append(readings[k, 1] + noise[k][1] + before[1] * angles[k])
    phi = GTC.atan2(y[0] - y[2], y[3] - y[1]) - GTC.atan2(x[1] - x[3], x[0] - x[2])
    assert result["delta_phi"].value == pytest.approx(math.degrees(GTC.value(phi)), abs=1e-9)
    assert result["delta_phi"].u == pytest.approx(math.degrees(GTC.uncertainty(phi)), rel=0.01)
    rows = {row.source: row.contribution for row in result.budget["delta_phi"]}
    by_noise = math.sqrt(sum(GTC.component(phi, e) ** 2 for pair in noise for e in pair))
    by_angle = math.sqrt(sum(GTC.component(phi, e) ** 2 for e in angles))
    assert rows["repeatability"] == pytest.approx(math.degrees(by_noise), rel=0.01)
    assert rows["fixture"] == pytest.approx(math.degrees(by_angle), rel=0.01)


@pytest.mark.parametrize("method", ["two-position", "four-position", "mmpm", "ml"])
@pytest.mark.parametrize("samples", [1, 20])
def test_the_budget_adds_up_to_u_and_its_shares_to_one(method, samples):
    angles = FOUR if "position" in method else NINE
    result = fit(turn(angles, samples, noise=1.0 if samples > 1 else 0.1), method)
    assert set(result.budget) == {"delta_k", "delta_phi", "angle"}
    for name, rows in result.budget.items():
        assert [row.source for row in rows] == [
            "repeatability", "1/f noise", "fixture", "gravity", "quantization", "temperature",
            "model choice",
        ]  # fmt: skip
        u = result.shown_angle.u if name == "angle" else result[name].u
        assert math.sqrt(sum(row.contribution**2 for row in rows)) == pytest.approx(u, rel=1e-9)
        assert sum(row.share for row in rows) == pytest.approx(1, rel=1e-9)
        for row in rows:
            if row.sensitivity is not None:
                assert row.sensitivity * row.u == pytest.approx(row.contribution, rel=1e-9, abs=1e-15)
        gravity = next(row for row in rows if row.source == GRAVITY)
        assert gravity.u > 0
        assert gravity.contribution == pytest.approx(0, abs=1e-12)
    matrix = np.sqrt(np.diag(result.covariance))
    np.testing.assert_allclose(matrix, [e.u for e in result.parameters.values()], rtol=1e-9)


def test_what_was_stated_is_of_type_b_and_normal_and_what_was_measured_of_type_a_and_students():
    for samples, noise, known in ((1, 0.1, ("B", "normal")), (20, 1.0, ("A", "Student"))):
        rows = {row.source: row for row in fit(turn(NINE, samples, noise=noise), "ml").budget["delta_phi"]}
        assert (rows["repeatability"].kind, rows["repeatability"].distribution) == known
        assert (rows["fixture"].kind, rows["fixture"].distribution) == ("B", "normal")
        assert rows["repeatability"].as_dict()["type"] == known[0]


def test_student_is_in_k_and_not_in_u():
    few = fit(turn((0, 90), samples=2, noise=1.0, sigma=0.0, bias=(0.0, 0.0)), "two-position")["delta_k"]
    many = fit(turn((0, 90), samples=2000, noise=1.0, sigma=0.0, bias=(0.0, 0.0)), "two-position")[
        "delta_k"
    ]
    assert few.dof < 8
    assert few.k > 2.3
    assert many.k == pytest.approx(1.96, abs=0.01)
    assert pytest.approx(few.k * few.u) == few.U
    document = fit(turn(NINE, samples=3), "ml").as_dict()["parameters"]["delta_phi"]
    assert set(document) == {"value", "u", "dof", "k", "U", "unit"}
    assert document["U"] == pytest.approx(document["k"] * document["u"])
    assert document["k"] == pytest.approx(stats.t.ppf(0.975, document["dof"]))


@pytest.mark.parametrize("angles", [FOUR, (0, 90), (0, 90, 0, 90)])
def test_averages_without_an_uncertainty_and_without_freedom_have_none(angles):
    exact = turn(angles, noise=0.0, sigma=0.0, stated=None, bias=(0.0, 0.0))
    result = fit(exact)
    assert all(e.u is None and e.U is None for e in result.parameters.values())
    document = json.loads(json.dumps(result.as_dict(), allow_nan=False))
    for entry in (*document["parameters"].values(), document["angle"]):
        assert entry["u"] is entry["U"] is entry["k"] is entry["dof"] is None
    assert "u unknown" in result.summary()
    assert "e-0" not in result.summary()


def test_numbers_in_the_offset_registers_widen_u_of_two_positions():
    part = Session(**{**vars_of(turn((0, 90), samples=4, noise=0.1)), "sensor": "adis16354"})
    held = {"XACCL_OFF": 80, "YACCL_OFF": 0, "ZACCL_OFF": 0}
    moved = Session(**{**vars_of(part), "facts": {"registers": {"configured": held}}})
    without, wider = fit(part, "two-position"), fit(moved, "two-position")
    for name in ("delta_k", "delta_phi"):
        # 10 mg on both axes; then √(10² + (80 · 0.4672)²) = 38.7 mg on X.
        assert 1.2 < wider[name].u / without[name].u < 3.9
    assert "offset registers +37.4 mg and +0.0 mg" in wider.budget["delta_k"][-1].note


def test_a_bias_that_two_positions_cannot_see_is_in_the_budget_where_the_part_has_a_figure():
    blind = turn((0, 90), samples=4, noise=0.1, bias=(0.0, 0.0))
    part = Session(**{**vars_of(blind), "sensor": "adis16354"})
    without, held = fit(blind, "two-position"), fit(part, "two-position")
    assert held["delta_phi"].u > 20 * without["delta_phi"].u
    # A figure of the part has unlimited degrees of freedom, and nearly all of u is of it.
    assert held["delta_phi"].k == pytest.approx(1.96, abs=0.001)
    assert "it determines the biases" not in held.comparison.recommended.why
    row = held.budget["delta_phi"][-1]
    assert row.source == "model choice"
    assert row.share > 0.99
    # 10 mg on each axis, moved by the slopes that the warning states.
    warning = next(w for w in held.warnings if "bias cannot be seen" in w)
    x = float(warning.replace("−", "-").split("moves Δφ by ")[1].split("°")[0])
    y = float(warning.replace("−", "-").split("on Y Δφ by ")[1].split("°")[0])
    assert row.contribution == pytest.approx(10 * math.hypot(x, y), rel=0.05)


def vars_of(session):
    return {name: getattr(session, name) for name in session.__dataclass_fields__}


@pytest.mark.parametrize("unseen", [0.01, 100.0])
def test_a_further_readings_scatter_keeps_its_degrees_of_freedom_beside_unseen_effects(unseen):
    moves, dof = np.array([[0.1, unseen]]), np.array([2, math.inf])
    source = Source(
        "model", "B", "normal", 1.0, moves, dof=dof, estimate=np.array([3, 0]), reading_mg2=np.eye(1)
    )
    u, found = Sources((source,)).uncertainty(np.eye(1), np.eye(1))
    assert u == pytest.approx(math.hypot(1.0, 0.1, unseen))
    assert found == pytest.approx(effective_dof([(1.0 + 0.1**2, 2), (unseen**2, math.inf)]))


@pytest.mark.parametrize("kind", ["stated", "unknown", "blind"])
def test_u_expanded_holds_the_truth_in_95_of_100_sessions(kind):
    rows = coverage.held(coverage.KINDS[kind], 80, np.random.default_rng(2))
    # Three standard errors of 80 sessions, as far as there is room (scripts/coverage_of_u.py: thousands).
    assert (np.abs(rows.mean(axis=0) - 0.95) < 0.01 + 3 * math.sqrt(0.0475 / 80)).all(), rows.mean(axis=0)


@pytest.mark.parametrize("method", ["two-position", "four-position", "mmpm"])
def test_monte_carlo_agrees_with_the_linear_uncertainty(method):
    angles = {"two-position": (0, 90), "four-position": FOUR, "mmpm": NINE}[method]
    run = monte_carlo(fit(turn(angles), method), 2000, np.random.default_rng(3))
    for name, p in run.parameters.items():
        assert p.u == pytest.approx(p.linear.u, rel=0.01 + 3 * p.doubt), name
        assert (p.high - p.low) / 2 == pytest.approx(p.linear.U, rel=0.07), name
        # The standard deviation of n normal values is known to 1/√(2 n) of itself.
        stated = p.as_dict()["u_standard_error"]
        assert stated == pytest.approx(p.u / math.sqrt(2 * 2000), rel=0.15), name
    assert run.failed == 0


def test_monte_carlo_says_few_degrees_of_freedom_from_a_model_that_bends():
    few = fit(turn(FOUR, samples=3, noise=1.0, sigma=0.0), "four-position")
    run = monte_carlo(few, 1500, np.random.default_rng(4))
    assert run.parameters["bias_x"].u > 1.02 * run.parameters["bias_x"].linear.u
    assert "degrees of freedom" in run.parameters["bias_x"].why
    bent = fit(turn((0, 90), stated=300.0, noise=0.0, sigma=0.0, bias=(0.0, 0.0)), "two-position")
    run = monte_carlo(bent, 1500, np.random.default_rng(4))
    assert any("not linear enough" in p.why for p in run.parameters.values())


def test_a_start_angle_beside_180_degrees_scatters_in_a_simulation_as_any_other():
    # Draws lie at 179.99° and at −179.99°: their plain mean is no angle.
    runs = [
        monte_carlo(fit(turn(NINE, start=start), "ml"), 200, np.random.default_rng(3))
        for start in (20.0, 180.0)
    ]
    u = [run.parameters["alpha"].u for run in runs]
    assert u[1] == pytest.approx(u[0], rel=0.2)  # 200 draws know it to 5 %
