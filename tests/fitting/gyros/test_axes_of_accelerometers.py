"""What is not known of the accelerometers, carried to the directions of the gyros' axes and their u."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import adis_gonio
from adis_gonio.base.errors import UsageError
from adis_gonio.base.uncertainty import Value
from adis_gonio.bench.gyro_turns import gyro_turns_plan
from adis_gonio.faces.cli import app
from adis_gonio.fitting import fit
from adis_gonio.fitting.fit_result import FittedParameters
from adis_gonio.fitting.gyros.gyro_fit import TIME_BASE_U, fit_gyro
from adis_gonio.fitting.gyros.gyro_readings import rate_intervals
from adis_gonio.fitting.gyros.turn_integration import NAMES, UNKNOWN_BIAS_MG, Axes
from adis_gonio.model.measurement import sensitivity
from adis_gonio.sim import World, WorldSettings
from adis_gonio.tracing.trace_calibrations import load_calibration
from fitting.gyros.simulated import Recorder

LEANS = {"xy": 0.5, "xz": -0.3, "yx": 0.4, "yz": -0.6, "zx": 0.2, "zy": -0.4}
SKEWS = {"delta_phi_deg": 0.24, "skew_xz_deg": -0.22, "skew_yz_deg": 0.2}
QUIET = {"gyro_noise_dps": 0.02, "gyro_instability_dps": 1e-4, "mark_sigma_deg": 0.02}


def part(bias_mg: float) -> WorldSettings:
    leans = {f"gyro_misalignment_{pair}_deg": value for pair, value in LEANS.items()}
    biases = {f"bias_{axis}_mg": bias_mg for axis in "xyz"}
    return WorldSettings(hand_moves=1.0, move_speed_dps=85, **QUIET, **SKEWS, **leans, **biases)


def on_table(bias_mg: float, faces: int = 6, seed: int = 3):
    """A session of gyro turns, one each way."""
    rng = np.random.default_rng(seed)
    recorder = Recorder(World(part(bias_mg), seed=seed))
    for position in gyro_turns_plan(1, faces).positions:
        if position.direction is not None:
            level = np.asarray(position.direction) + 0.005 * rng.standard_normal(3)
            recorder.now_s = recorder.world.stage.orient(recorder.now_s, level) + 1.5
            recorder._history = None
        else:
            recorder.turn(
                lambda at, by=position.turned_deg: recorder.world.stage.turn_about(at, by),
                before_s=1.5,
                after_s=1.5,
                turned_deg=position.turned_deg,
            )
        recorder.dwell(3.0)
    return recorder.session(plane="none", fixture_sigma_deg=0.02)


def in_attitudes(bias_mg: float, seed: int = 3):
    """The accelerometers of the same part, in as many attitudes as show all nine of them."""
    recorder = Recorder(World(part(bias_mg), seed=seed))
    rng = np.random.default_rng(seed + 1)
    for vector in rng.standard_normal((14, 3)):
        attitude = vector / np.linalg.norm(vector)
        recorder.now_s = recorder.world.stage.orient(recorder.now_s, attitude) + 1.5
        recorder._history = None
        recorder.dwell(3.0)
    return recorder.session(plane="none", fixture_sigma_deg=math.inf)


@pytest.fixture(scope="module")
def up_and_down():
    return on_table(27.0)


@pytest.fixture(scope="module")
def up_alone():
    return on_table(27.0, faces=3)


@pytest.fixture(scope="module")
def attitudes():
    return in_attitudes(27.0)


def off(result):
    """Error (6,) of each misalignment and its u, in degrees."""
    found = [result[f"gyro_misalignment_{pair}"] for pair in LEANS]
    error = np.array([value.value for value in found]) - list(LEANS.values())
    return error, np.array([value.u for value in found])


def result_of(values, covariance):
    """A fit that determined these parameters."""
    parameters = {name: Value(value, None, "1") for name, value in values.items()}
    return FittedParameters(
        method="ml", parameters=parameters, covariance=covariance, chi2=0.0, dof=0, positions=()
    )


def test_modes_are_what_each_unknown_does_to_a_direction():
    """By plain geometry: Y's bias tilts the X-up vertical towards y by bias over g, a skew by itself."""
    axes = Axes.of((0.001, math.radians(0.1), 20.0))
    up = np.array([-1.0, 0.0, 0.0])
    size = {name: np.zeros(3) for name in NAMES}
    for mode, direction in zip(axes.modes(up).T, axes.factor.T, strict=True):
        size[NAMES[int(np.abs(direction).argmax())]] = np.abs(mode)
    np.testing.assert_allclose(size["bias_y"], [0, 0.02, 0], atol=1e-5)
    np.testing.assert_allclose(size["bias_x"], 0, atol=1e-5)
    np.testing.assert_allclose(size["skew_xz"], [0, 0, math.radians(0.1)], atol=1e-5)
    np.testing.assert_allclose(size["skew_yz"], 0, atol=1e-5)
    matrix = np.diag(np.arange(1.0, 10.0)) ** 2
    named = dict.fromkeys(NAMES, 0.0) | dict.fromkeys(NAMES[:3], 1.0)
    known = Axes.of((1, 1, 1), result_of(named, matrix))
    unit = np.array([1.0] * 3 + [math.radians(1.0)] * 3 + [1.0] * 3)
    np.testing.assert_allclose(known.factor @ known.factor.T, matrix * np.outer(unit, unit), rtol=1e-9)


def test_of_two_sources_the_first_that_has_a_name_counts():
    first = result_of({"bias_x": 5.0}, np.array([[0.04]]))
    second = result_of({"delta_phi": 0.3, "bias_x": 9.0}, np.diag([0.01, 1.0]))
    axes = Axes.of((0.001, 0.002, 50.0), first, second)
    assert axes.values[NAMES.index("bias_x")] == 5.0
    assert axes.values[NAMES.index("skew_xy")] == pytest.approx(math.radians(0.3))
    assert axes.known == {"bias_x", "skew_xy"}
    variance = np.diagonal(axes.factor @ axes.factor.T)
    assert variance[NAMES.index("bias_x")] == pytest.approx(0.04)
    assert variance[NAMES.index("bias_y")] == pytest.approx(2500)


def test_directions_are_those_of_the_accelerometers_own_model():
    values = np.array([1.01, 0.99, 1.02, 0.004, -0.003, 0.002, 12.0, -20.0, 7.0])
    axes = Axes(values, np.zeros((9, 1)), frozenset(NAMES))
    gravity = np.array([0.6, -0.64, 0.48])
    reading = sensitivity(values[:6]) @ gravity + 1e-3 * values[6:]
    np.testing.assert_allclose(axes.direction(reading), gravity, atol=1e-12)


def test_opposite_faces_find_the_biases_so_that_leans_no_skew_hides_are_sharp(up_and_down):
    result = fit_gyro(up_and_down)
    error, u = off(result)
    hidden = np.isin(list(LEANS), ["yx", "zx", "zy"])  # what skew_xy, skew_xz, skew_yz are taken for
    assert u[~hidden].max() < 0.03
    assert np.abs(error / u).max() < 4
    assert u[hidden] == pytest.approx(0.25 / math.sqrt(3), rel=0.05)
    names = list(result.parameters)
    between = result.covariance[names.index("gyro_misalignment_yx"), names.index("gyro_misalignment_zx")]
    assert abs(between) < 0.2 * u[hidden].min() ** 2


def test_arrows_up_alone_say_that_biases_of_a_real_part_hide_the_leans(up_alone):
    error, u = off(fit_gyro(up_alone))
    assert np.abs(error).min() > 1.0  # 27 mg are 1.5°
    assert np.abs(error / u).max() < 2
    assert u == pytest.approx(math.degrees(UNKNOWN_BIAS_MG / 1000), rel=0.1)


@pytest.mark.parametrize("faces", [6, 3])
def test_a_calibration_of_the_accelerometers_makes_all_leans_sharp(faces, up_and_down, up_alone, attitudes):
    calibration = fit(attitudes).calibration()
    session = up_and_down if faces == 6 else up_alone
    result = fit_gyro(session, calibration)
    error, u = off(result)
    assert u.max() < 0.04
    assert np.abs(error / u).max() < 4
    assert not any("accelerometers" in warning for warning in result.warnings)
    assert rate_intervals(session).notes != ()


def test_a_clock_that_runs_fast_moves_all_gains_alike_and_their_covariance_says_so(
    up_and_down, monkeypatch
):
    fast = 1 + 100e-6
    moved = replace(
        up_and_down,
        dwells=tuple(replace(dwell, time_s=fast * dwell.time_s) for dwell in up_and_down.dwells),
        turns_from=lambda: tuple(replace(t, time_s=fast * t.time_s) for t in up_and_down.turns),
    )
    right, wrong = fit_gyro(up_and_down), fit_gyro(moved)
    names = [f"gyro_scale_{axis}" for axis in "xyz"]
    for name in names:
        assert wrong[name].value / right[name].value == pytest.approx(fast, abs=1e-6)
        assert right[name].u > TIME_BASE_U
    assert right.as_dict()["time_base_u"] == pytest.approx(29e-6, rel=0.01)
    monkeypatch.setattr("adis_gonio.fitting.gyros.gyro_fit.TIME_BASE_U", 0.0)
    exact = fit_gyro(replace(up_and_down))  # a session keeps its fit
    rows = [list(right.parameters).index(name) for name in names]
    values = np.array([right[name].value for name in names])
    added = (right.covariance - exact.covariance)[np.ix_(rows, rows)]
    np.testing.assert_allclose(added, TIME_BASE_U**2 * np.outer(values, values), rtol=1e-3)


def test_a_calibration_of_another_part_is_refused(up_alone, attitudes):
    other = fit(replace(attitudes, serial="17")).calibration()
    with pytest.raises(UsageError, match="of 17, the session of 18"):
        fit_gyro(replace(up_alone, serial="18"), other)
    with pytest.raises(UsageError, match="part='gyro'"):
        adis_gonio.fit(attitudes, accelerometers=other)


def test_the_command_takes_a_calibration_file(tmp_path):
    table, poses, file = tmp_path / "table.session", tmp_path / "poses.session", tmp_path / "part.json"
    url = "sim:?seed=6&hand_moves=1&move_speed_dps=85&bias_y_mg=30"
    plans = {
        table: ["--plan", "gyro-turns", "--turns", "1", "--positions", "3"],
        poses: ["--plan", "poses"],
    }
    runner = CliRunner()
    for path, options in plans.items():
        told = runner.invoke(
            app, ["calibrate", url, *options, "--dwell", "1", "--settle", "0.1", "--auto", "-o", str(path)]
        )
        assert told.exit_code == 0, told.output
    load_calibration(poses).save(file)
    gyro = ["fit", str(table), "--sensor-part", "gyro", "--json"]
    u = {}
    for name, options in {"without": [], "file": ["--calibration", str(file)]}.items():
        document = json.loads(runner.invoke(app, [*gyro, *options]).stdout)
        u[name] = document["parameters"]["gyro_misalignment_yx"]["u"]
    assert u["file"] < 0.05 * u["without"]
    refused = runner.invoke(app, ["fit", str(poses), "--calibration", str(file)])
    assert refused.exit_code != 0
