"""The best plan is the best: against all plans there are, against theory, and by a second computation."""

import itertools
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.conformity import Tolerance
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.uncertainty import Detectable
from adis_gonio.plan.optimal_plan import (
    arrange_in_columns,
    best_plan,
    candidates,
    even_plan,
    fewest_positions,
    headline,
    interleaved_plan,
    positions_in,
    prediction_lines,
    search,
)
from adis_gonio.plan.prediction import (
    LARGEST_FIXTURE_DEG,
    Bench,
    expected_readings,
    predict,
    predict_uncertainty,
)
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings

QUIET = Bench(0.02, flicker_mg=0.0)


@pytest.mark.parametrize(
    ("best", "beware"),
    [("angle", ()), ("parameters", ()), ("angle", ("bias_drift",)), ("tell-apart", ("bias_drift",))],
)
def test_no_plan_of_all_there_are_is_better_than_the_one_found(best, beware):
    ground = candidates(Bench(0.02), 4, beware, 45.0, best)
    angle = ground.angle_deg
    every = np.array(
        [c for c in itertools.product(range(8), repeat=4) if (np.diff(angle[list(c)]) != 0).all()]
    )
    scores = ground.scores(np.array([ground.information(choice) for choice in every]))
    rng = np.random.default_rng(1)
    starts = [ground.nearest(even_plan(4)), *(every[k] for k in rng.integers(0, len(every), 8))]
    found = ground.score(search(ground, starts, rng))
    # The simplest order may cost a thousandth, and nothing else may.
    assert scores.max() - 1e-3 <= found <= scores.max() + 1e-9
    assert found > np.median(scores) + 0.1


def dense(bench, angles_deg, order_s):
    """Information of (α, K_x, K_y, Δφ, b_x, b_y in g) by finite differences and one dense covariance."""
    theta = np.radians(angles_deg)
    g = 1000.0

    def reads(p):
        psi = p[0] - theta
        x, y = p[1] * np.cos(psi) + p[4], p[2] * np.sin(psi + p[3]) + p[5]
        return g * np.stack([x, y], axis=1).ravel()

    at = np.array([0.0, 1, 1, 0, 0, 0])
    step = 1e-6
    jacobian = np.stack([(reads(at + step * e) - reads(at - step * e)) / (2 * step) for e in np.eye(6)], 1)
    n = len(theta)
    tangent = np.zeros((2 * n, n))
    for k in range(n):
        psi = -theta[k]
        tangent[2 * k : 2 * k + 2, k] = -g * math.sin(psi), g * math.cos(psi)
    samples = bench.samples
    white = (4.7**2 + 0.4672**2 / 12) / samples
    fixture = math.radians(bench.fixture_deg) ** 2
    # Barnes: the covariance of means of 1/f noise by numerical integration of −ln|t − t'| over both spans:
    # the dwells, and the session with as long a time after it, whose mean the bias is.
    twice = 2 * (order_s.max() + 10.0 - order_s.min())
    starts, lengths = np.append(order_s, order_s.min()), np.append(np.full(n, 10.0), twice)
    mean_log = np.zeros((n + 1, n + 1))
    for i, j in itertools.combinations_with_replacement(range(n + 1), 2):
        if i == j:
            mean_log[i, j] = math.log(lengths[i]) - 1.5
        else:
            # Unlike numbers of steps, so that no two points meet.
            one, two = ((np.arange(m) + 0.5) / m for m in (2000, 2011))
            gap = starts[i] + lengths[i] * one[:, None] - starts[j] - lengths[j] * two[None, :]
            mean_log[i, j] = mean_log[j, i] = np.log(np.abs(gap)).mean()
    about = np.concatenate([np.eye(n), -np.ones((n, 1))], axis=1)
    slow = bench.floor_mg**2 * (-about @ mean_log @ about.T / (2 * math.log(2)))
    covariance = white * np.eye(2 * n) + fixture * tangent @ tangent.T + np.kron(slow, np.eye(2))
    return jacobian.T @ np.linalg.solve(covariance, jacobian)


def test_the_information_is_that_of_a_dense_covariance_written_out_by_hand():
    bench = Bench(0.03)
    ground = candidates(bench, 6, (), 30.0)
    choice = np.array([0, 5, 3, 9, 1, 7])
    begins = bench.each_s * np.arange(6)
    by_hand = dense(bench, ground.angle_deg[choice], begins)
    ours = ground.information(choice) - np.diag(ground.precision)
    assert np.allclose(ours, by_hand, rtol=1e-3, atol=1e-3 * np.abs(by_hand).max())


def test_effects_are_told_apart_by_the_worst_of_them_and_then_by_all():
    ground = candidates(QUIET, 5, ("bias_drift",), 60.0, "tell-apart")
    separations = np.array([[5.0, 5.0], [5.0, 9.0], [9.0, 5.0], [5.5, 5.5], [0.0, 50.0]])
    information = np.array([np.diag(ground.precision) for _ in separations])
    # Each amplitude's u by the session alone is its typical size divided by the separation.
    k = np.arange(ground.base, len(ground.precision))
    information[:, k, k] += separations**2
    assert ground.separations(information) == pytest.approx(separations, abs=1e-6)
    ranks = np.argsort(ground.scores(information))
    assert ranks.tolist() in ([4, 0, 1, 2, 3], [4, 0, 2, 1, 3])


@pytest.mark.parametrize("beware", [(), ("bias_drift", "hysteresis")])
def test_an_exchange_is_worth_what_the_exchanged_plan_is_worth(beware):
    ground = candidates(Bench(0.05), 5, beware, 60.0)
    choice = np.random.default_rng(2).integers(0, len(ground.angle_deg), 5)
    for dwell in range(5):
        together = ground.exchanged(choice, dwell)
        for k, information in enumerate(together):
            trial = choice.copy()
            trial[dwell] = k
            assert np.allclose(information, ground.information(trial), rtol=1e-8)


@pytest.mark.parametrize("best", ["angle", "parameters"])
@pytest.mark.parametrize("start_deg", [0.0, 33.0])
def test_without_shared_noise_even_spacing_cannot_be_beaten(best, start_deg):
    """First-order trigonometric regression: even spacing is D- and G-optimal, whatever the start angle."""
    found = best_plan(Bench(0.0, flicker_mg=0.0, start_deg=start_deg), 9, best, grid_deg=10.0)
    over_even = found.gains[0]
    assert over_even.name == "even"
    # Information on six parameters of nine pairs of readings, whatever nine: tr = const, so det is bounded.
    assert over_even.criterion == pytest.approx(1.0, abs=2e-3)
    theta = np.radians([position.angle_deg for position in found.plan.positions])
    if best == "parameters":  # every D-optimal design has no first and no second moment
        assert abs(np.exp(1j * theta).mean()) < 0.02
        assert abs(np.exp(2j * theta).mean()) < 0.02


def test_without_shared_noise_the_positions_are_in_the_order_of_their_angles():
    ground = candidates(Bench(0.0, flicker_mg=0.0), 9, (), 10.0)
    rng = np.random.default_rng(3)
    found = search(ground, [rng.permutation(ground.nearest(even_plan(9)))], rng)
    angles = ground.angle_deg[found].tolist()
    assert angles in (sorted(angles), sorted(angles, reverse=True))


def test_the_same_seed_gives_the_same_plan_and_it_beats_even_spacing_and_tumble():
    one, again = (best_plan(Bench(0.02), 12, seed=4) for _ in range(2))
    assert one == again
    assert {gain.name for gain in one.gains} == {"even", "tumble"}
    assert all(gain.criterion > 1.0 for gain in one.gains)
    reach, even = one.prediction.reach, predict_uncertainty(even_plan(12), Bench(0.02))
    ratios = {gain.name: gain.u for gain in one.gains}["even"]
    assert ratios["delta_phi"] == pytest.approx(
        even.parameters["delta_phi"].u / reach.parameters["delta_phi"].u
    )
    assert ratios["angle_worst"] == pytest.approx(even.angle_worst.u / reach.angle_worst.u)
    assert ratios["angle_worst_by_parameters"] == pytest.approx(even.fitted_deg / reach.fitted_deg)
    angles = [position.angle_deg for position in one.plan.positions]
    assert all(a != b for a, b in itertools.pairwise(angles))
    assert {position.approach for position in one.plan.positions} == {1}


def test_order_is_what_separates_drift_from_the_angle_and_both_sides_show_backlash():
    found = best_plan(Bench(0.02), 10, "tell-apart", ["bias_drift", "backlash"], grid_deg=15.0)
    over_even = found.gains[0]
    assert over_even.criterion > 10  # all from below: a backlash cannot be seen at all
    assert {position.approach for position in found.plan.positions} == {1, -1}
    assert min(found.separations.values()) == pytest.approx(found.figure)
    angles = [position.angle_deg for position in found.plan.positions]
    time = np.arange(10.0)
    along = abs(np.corrcoef(time, np.cos(np.radians(angles)))[0, 1])
    assert along < 0.3
    assert found.prediction.sight.detectable["backlash"].amplitude is not None
    alike = [set(pair.effects) for pair in found.prediction.sight.confounded]
    assert {"bias_drift", "backlash"} not in alike


def test_fewer_positions_that_determine_nothing_are_too_few_and_no_error():
    # With this noise 15 interleaved positions decide, but 10 determine neither ΔK nor Δφ.
    with pytest.raises(FitError, match=r"^15 positions"):
        fewest_positions(Bench(0.05, flicker_mg=200.0), Tolerance(15.0), grid_deg=15.0)


def test_fewest_is_the_fewest_and_time_is_what_a_session_expects():
    bench = Bench(0.05)
    tolerance = Tolerance(0.05, risk=0.02)
    found = fewest_positions(bench, tolerance, grid_deg=15.0)
    count = len(found.plan)
    assert found.prediction.reach.conformity(tolerance).verdict == "pass"
    assert count > 4
    fewer = best_plan(bench, count - 1, grid_deg=15.0).prediction.reach
    assert fewer.conformity(tolerance).verdict == "undecided"
    assert positions_in(bench, 4.0) == math.floor(240 / 20.5)
    assert found.prediction.seconds == pytest.approx(20.5 * count)


def test_an_angle_that_a_plan_does_not_determine_has_no_ratio():
    found = best_plan(Bench(LARGEST_FIXTURE_DEG, noise_mg=1e4), 5, grid_deg=60.0)
    assert found.prediction.reach.angle_worst.u is None
    assert [gain.as_dict()["u"]["angle_worst"] for gain in found.gains] == [None]


def test_the_headline_has_the_time_of_the_session_in_minutes():
    bench = Bench(0.02, settings=Settings(dwell_s=589.5))  # 600 s each
    assert headline(predict(plan("four-position"), bench)).startswith("4 positions, 40 min: angle u 0.01")


def test_the_text_of_a_prediction_has_its_positions_effects_notes_and_decision():
    bench = Bench(0.02)
    made = predict(plan("mmpm"), bench)
    noted = replace(made, reach=replace(made.reach, notes=("Two words.", "And two more.")))
    text = "\n".join(prediction_lines(noted))
    assert text.splitlines()[0] == headline(made)
    parts = ("Predicted", "Shows effects", "Cannot show", "Cannot tell apart", "Positions, in this order")
    pieces = re.split("|".join(parts), text)
    for name, one in made.sight.detectable.items():
        shown, hidden = (re.search(rf"\b{name}\b", pieces[k]) is not None for k in (2, 3))
        assert (shown, hidden) == (one.amplitude is not None, one.amplitude is None), name
    assert all(name in pieces[4] for name in made.sight.confounded[0].effects)
    assert pieces[5].count("°") == len(made.plan)
    assert text.endswith("Two words.\nAnd two more.")
    blind = list(prediction_lines(predict(plan("two-position"), bench)))
    (unseen,) = (line for line in blind if "not determined" in line)
    assert "bias_x" in unseen
    assert "bias_y" in unseen
    assert "not determined" not in text
    u_deg = made.reach.angle_worst.u
    for factor, decides in ((10.0, True), (1.0, False)):
        tolerance = Tolerance(factor * u_deg)
        second = "\n".join(prediction_lines(made, tolerance=tolerance)).splitlines()[1]
        assert second.startswith("decides") is decides


def test_an_effect_without_its_condition_is_not_predicted_whatever_its_reason():
    made = predict(plan("mmpm"), Bench(0.02))
    unseen = {
        "supply_bias": Detectable(None, "", "", "no supply", ("supply_v",)),
        "cubic": Detectable(None, "", "", "its samples are not recorded"),
    }
    lines = list(prediction_lines(replace(made, sight=replace(made.sight, detectable=unseen))))
    assert "  supply_bias: not predicted" in lines
    assert "  cubic: its samples are not recorded" in lines


def test_cells_run_down_the_columns_of_a_line_of_eighty_characters():
    assert list(arrange_in_columns(["a", "b", "c", "d", "e"], least=24)) == [
        "  a" + " " * 23 + "c" + " " * 23 + "e",
        "  b" + " " * 23 + "d",
    ]
    assert list(arrange_in_columns(["x" * 40, "y"])) == ["  " + "x" * 40, "  y"]
    assert list(arrange_in_columns([])) == []


def test_interleaved_angles_are_the_even_ones_in_another_order():
    assert sorted(p.angle_deg for p in interleaved_plan(11).positions) == [
        p.angle_deg for p in even_plan(11).positions
    ]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"positions": 3}, "positions is 3"),
        ({"positions": 8, "best": "tell-apart"}, "needs effects"),
        ({"positions": 8, "best": "speed"}, "best is 'speed'"),
        ({"positions": 8, "grid_deg": 0.1}, "grid is 0.1"),
        ({"positions": 8, "beware": ["quadratc"]}, "did you mean 'quadratic'"),
        ({"positions": 8, "beware": ["gravity"]}, "no plan can be made for 'gravity'; "),
        ({"positions": 8, "beware": ["axis_tilt"]}, "lies in the model"),
        ({"positions": 8, "beware": ["creep"]}, "no plan can be made for 'creep'; "),
        ({"positions": 8, "beware": ["supply_bias"]}, "no plan can be made for 'supply_bias'; "),
        ({"positions": 8, "beware": ["tone"]}, "no plan can be made for 'tone'; "),
        ({"positions": 8, "beware": ["outlier_dwell"]}, "no plan can be made for 'outlier_dwell'; "),
    ],
)
def test_what_cannot_be_searched_for_is_told_in_one_line(arguments, told):
    with pytest.raises(UsageError, match=told) as caught:
        best_plan(QUIET, **arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "deg"), [("four-position", 10.0), ("tumble", LARGEST_FIXTURE_DEG)])
def test_a_wide_stage_is_still_in_the_angles_uncertainty(name, deg):
    at_1, there = (predict_uncertainty(plan(name), Bench(f)).angle.u for f in (1.0, deg))
    assert there == pytest.approx(deg * at_1, rel=0.05)


def test_a_bench_that_there_is_not_is_refused():
    for wrong in ({"fixture_deg": -1}, {"fixture_deg": math.inf}, {"fixture_deg": 0, "noise_mg": -1}):
        with pytest.raises(UsageError):
            Bench(**wrong)
    for wrong in ({"start_deg": math.nan}, {"gravity_mps2": 0.0}, {"gravity_mps2": math.nan}):
        with pytest.raises(UsageError, match=r"start|gravity"):
            Bench(0.02, **wrong)
    with pytest.raises(UsageError, match="are 0: without noise"):
        Bench(0.0, noise_mg=0.0, flicker_mg=0.0)
    for minutes in (0.1, 1000.0, math.nan):
        with pytest.raises(UsageError, match="minutes"):
            positions_in(QUIET, minutes)
    with pytest.raises(FitError, match="100 positions cannot decide"):
        fewest_positions(QUIET, Tolerance(1e-5))
    assert len(expected_readings(even_plan(5), QUIET)) == 5
