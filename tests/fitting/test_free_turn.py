"""The estimate of a free turn: right values, honest uncertainties, refusals that say what to do.

Recordings are those of `scripts/free_turn_statistics.py`: a hand in the simulator, through the chip's
filter.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

import free_turn_statistics as script
from adis_gonio.base.errors import FitError
from adis_gonio.fitting import applicable_methods, fit
from adis_gonio.fitting.answer import Answer
from adis_gonio.fitting.free_turn import LeastSquaresProblem, Windows, drift_functions, series_of, solve
from adis_gonio.model.records import Dwell, Session
from adis_gonio.sim import World, WorldSettings
from adis_gonio.tracing.trace import trace

SEED = 11


@pytest.fixture(scope="module")
def turned():
    return script.free_turn(SEED, 1)


@pytest.fixture(scope="module")
def result(turned):
    return fit(turned[0])


def recorded(seed=SEED, total_s=60.0, **settings):
    """A recording of another hand than those of the script."""
    given = script.hand_of(np.random.default_rng(seed)) | settings
    world = World(WorldSettings(**given), seed=seed)
    time_s = 5.0 + script.PERIOD_S * np.arange(round(total_s / script.PERIOD_S))
    world.stage.turn_freely(8.0)
    accel, gyro = script.samples_of(world, time_s)
    recording = Dwell(0, time_s, accel, gyro=gyro)
    facts = {"configuration": {"filter_m": 2, "gyro_range_dps": 300}}
    return Session((), accel_unit="mg", recording=recording, free_turn=True, facts=facts)


def without(session, *gaps):
    """The session with samples between times missing."""
    whole = session.recording
    since = whole.time_s - whole.time_s[0]
    keep = np.all([(since < low) | (since > high) for low, high in gaps], axis=0)
    part = replace(whole, time_s=whole.time_s[keep], accel=whole.accel[keep], gyro=whole.gyro[keep])
    return replace(session, recording=part)


def test_every_parameter_is_where_it_should_be(result, turned):
    _, world, truth = turned
    for name in ("alpha", "delta_k", "delta_phi", "bias_x", "bias_y", "scale_x", "scale_y"):
        assert abs(result[name].value - truth[name]) < 4 * result[name].u, name
    given = world.settings
    for name in ("lever_x", "lever_y"):
        assert abs(result[name].value - getattr(given, f"{name}_mm")) < 4 * result[name].u
    lean = math.cos(
        math.radians(math.hypot(given.gyro_misalignment_zx_deg, given.gyro_misalignment_zy_deg))
    )
    assert abs(result["gyro_scale_z"].value - given.gyro_scale_z * lean) < 4 * result["gyro_scale_z"].u


def test_the_true_start_angle_is_the_angle_of_the_first_rest_which_the_fit_reports():
    """The stage is 0.5° off its zero, and an earlier turn ended elsewhere."""
    world = World(WorldSettings(alpha_deg=7.0, fixture_sigma_deg=0.5, hand_turn_deg=400.0), seed=SEED)
    assert world.truth()["alpha"] == 7.0
    begin = world.stage.turn_freely(5.0) + 5.0
    world.stage.turn_freely(begin)
    rest = world.sample(begin - 4.0 + script.PERIOD_S * np.arange(2000)).accel_mg.mean(axis=0)
    truth = world.truth(np.array([begin]))
    x, y = ((rest[k] - truth[f"bias_{axis}"]) / truth[f"scale_{axis}"] for k, axis in enumerate("xy"))
    psi = math.degrees(math.atan2(y - x * math.sin(math.radians(truth["delta_phi"])), x))
    assert truth["alpha"] == pytest.approx(psi, abs=0.1)
    assert abs(truth["alpha"] - 7.0) > 30


def test_a_recording_without_noise_is_explained_to_its_rounding():
    quiet = {"noise_mg": 0.05, "gyro_noise_dps": 0.01, "bias_instability_mg": 0.0, "hand_vibration_mg": 0.0}
    quiet |= {"gyro_instability_dps": 0.0, "gyro_rate_walk_dps_per_rt_s": 0.0, "axis_wobble_deg": 0.0}
    quiet |= {"delta_k": 0.01, "delta_phi_deg": 0.2, "bias_x_mg": 20.0, "bias_y_mg": -30.0}
    found = fit(recorded(**quiet, lever_x_mm=60.0, lever_y_mm=-40.0))
    assert found["delta_k"].value == pytest.approx(0.01, abs=1e-5)
    assert found["delta_phi"].value == pytest.approx(0.2, abs=0.003)  # one LSB is 0.027°
    assert found["lever_x"].value == pytest.approx(60.0, abs=1.0)
    assert found["lever_y"].value == pytest.approx(-40.0, abs=1.0)


def test_an_ellipse_through_the_means_agrees(result, turned):
    """Another way to the same numbers: a conic by linear least squares, without gyro or lever arm."""
    accel = turned[0].recording.accel[:, :2] / 1000
    x, y = accel[: len(accel) // 400 * 400].reshape(-1, 400, 2).mean(axis=1).T
    a, b, c, d, e = np.linalg.lstsq(
        np.column_stack([x * x, x * y, y * y, x, y]), np.ones(len(x)), rcond=None
    )[0]
    delta_k = math.sqrt(c / a) - 1
    delta_phi = math.degrees(math.asin(-b / (2 * math.sqrt(a * c))))
    bias = np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e]) * 1000
    assert abs(result["delta_k"].value - delta_k) < 5 * result["delta_k"].u
    assert abs(result["delta_phi"].value - delta_phi) < 5 * result["delta_phi"].u
    assert np.abs([result["bias_x"].value, result["bias_y"].value] - bias).max() < 0.5


def test_uncertainties_hold_over_a_few_hands():
    rows = script.run(3, 20, 1, 1)
    squares = np.array([list(row["z"].values()) for row in rows]) ** 2
    assert squares.max() < 4.5**2
    assert 0.1 < squares.mean() < 3
    assert script.summary(rows)["ratio"] < 3


def test_drifts_have_the_variances_that_the_simulators_flicker_gives_them():
    """Its covariance is a sum of exponentials; the model's has been integrated for a pure 1/f."""
    step_s, length_s, floor = 1 / 16, 60.0, 0.7
    time_s = step_s * (np.arange(round(length_s / step_s)) + 0.5)
    components, variance = drift_functions(time_s, length_s, floor, 12)
    corners = 2.0**-15 * 2.0 ** np.arange(17)
    lag = np.abs(time_s[:, None] - time_s)
    flicker = sum(floor**2 / 2 * np.exp(-2 * np.pi * corner * lag) for corner in corners)
    seen = components.T @ flicker @ components / len(time_s) ** 2
    # Flicker above 1.5 Hz is not simulated: of it the quickest component has lost 4 %.
    assert np.diag(seen) / variance == pytest.approx(1.0, abs=0.05)
    size = np.sqrt(np.diag(seen))
    assert np.abs(seen / np.outer(size, size) - np.eye(12)).max() < 0.01


def test_a_stated_level_of_1_f_noise_replaces_the_figure_of_the_data_sheet(result, turned):
    # The figure is 0.1 mg.
    noisy = fit(replace(turned[0], bias_instability_mg=1.0))
    for name in ("bias_x", "bias_y", "delta_phi"):
        assert noisy[name].u > 2 * result[name].u


def test_noise_of_the_windows_is_what_their_slow_part_has():
    """White samples alone: the variance that counts is that of a mean over much, not of a window."""
    found = []
    for seed in range(3):
        settings = {"bias_instability_mg": 0.0, "hand_vibration_mg": 0.0, "hand_tremor_dps": 0.0}
        series = series_of(recorded(seed, noise_mg=5.0, **settings))
        windows = Windows(series)
        solution = solve(LeastSquaresProblem(series, windows, 1000.0, 0.7))
        white = 5.0**2 * series.period_s / windows.hop_s  # density over the windows' distance
        found.append(float(solution.variances.accel_mg2.mean()) / white)
    assert np.mean(found) == pytest.approx(1.0, abs=0.06)


def test_the_answer_has_values_budget_and_what_a_turn_cannot_see(result):
    document = Answer.of(result).as_dict()
    assert document["method"] == document["recommended"]["method"] == "free-turn"
    assert list(document["answer"]) == ["delta_k", "delta_phi", "angle"]
    assert document["answer"]["angle"]["value"] is None
    for rows in document["budget"].values():
        assert sum(row["share"] for row in rows) == pytest.approx(1.0)
    assert any("zero of the stage" in warning for warning in document["warnings"])
    assert any("stated gravity" in warning for warning in document["warnings"])
    matrix = np.array(document["covariance"]["matrix"])
    assert np.sqrt(np.diag(matrix)) == pytest.approx([p["u"] for p in document["parameters"].values()])
    assert np.linalg.eigvalsh(matrix / np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))).min() > -1e-9


def test_the_calibration_shows_the_angle_of_the_rest(result, turned):
    angle = result.calibration().angle(turned[0].recording.accel[:2000, :2]).angle_deg
    turn = math.degrees(math.remainder(math.radians(float(np.mean(angle))), 2 * math.pi))
    assert min(abs(turn), abs(turn - result["alpha"].value)) < 0.1


def test_other_methods_and_trace_say_what_serves(turned):
    session = turned[0]
    assert applicable_methods(session) == ("free-turn",)
    with pytest.raises(FitError, match="use method free-turn"):
        fit(session, "ml")
    with pytest.raises(FitError, match="calibrate --plan tumble"):
        trace(session)
    positions = Session(
        tuple(replace(session.recording, angle_deg=a) for a in (0.0, 90.0)), accel_unit="mg"
    )
    with pytest.raises(FitError, match="needs one continuous recording"):
        fit(positions, "free-turn")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hand_turn_s": 4.0, "hand_pauses": 0.0}, "too fast: .* °/s .*turn once more"),
        ({"hand_turn_deg": 120.0}, "too short: it went 1[12].°.*all around"),
        ({"hand_sway_deg": 3.0}, "turned about its [XY] axis too .*turn once more"),
        ({"hand_sway_deg": 1.0}, "not in one vertical plane: the part swayed by .*turn once more"),
        ({"axis_tilt_deg": 20.0}, "not in one vertical plane: the part leaned by (19|20)"),
    ],
)
def test_a_turn_that_does_not_hold_is_refused(settings, message):
    with pytest.raises(FitError, match=message) as caught:
        fit(recorded(**settings))
    assert "\n" not in str(caught.value)


def test_an_interrupted_turn_is_refused_and_a_short_gap_is_used_and_said(turned, result):
    with pytest.raises(FitError, match=r"interrupted: 20\.0 of 60\.0 s have no samples"):
        fit(without(turned[0], (20.0, 40.0)))
    found = fit(without(turned[0], (25.0, 27.0)))
    assert any("samples are missing" in warning for warning in found.warnings)
    assert abs(found["delta_phi"].value - result["delta_phi"].value) < 3 * found["delta_phi"].u
    with pytest.raises(FitError, match="free turn takes 10 s or more"):
        fit(without(turned[0], (5.0, 61.0)))


def test_less_than_a_full_turn_is_used_with_an_uncertainty_that_says_so(result):
    found = fit(recorded(hand_turn_deg=220.0))
    # Each recording reads its own drift, by which a u is known to a tenth.
    assert found["bias_x"].u > 1.25 * result["bias_x"].u
    assert any("no full turn" in warning for warning in found.warnings)


def test_without_gyros_or_known_units_nothing_is_guessed(turned):
    session = turned[0]
    with pytest.raises(FitError, match="needs gyros"):
        fit(replace(session, recording=replace(session.recording, gyro=None)))
    with pytest.raises(FitError, match="known units"):
        fit(replace(session, accel_unit="counts"))
