"""Fit and trace of gyros: the recorded ADIS16350, hidden truths, and what a session cannot tell."""

import json
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from click.testing import CliRunner

import adis_gonio
from adis_gonio.base.errors import DataError, FitError, UsageError
from adis_gonio.faces.cli import app
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import from_means
from adis_gonio.fitting.gyros.gyro_fit import fit_gyro
from adis_gonio.fitting.gyros.gyro_readings import gyro_readings_of
from adis_gonio.model import Dwell, Session
from adis_gonio.model.effects import Conditions, effect
from adis_gonio.model.measurement import MeanRate
from adis_gonio.tracing.trace import trace, trace_readings
from recordings import recording
from tracing.gyro_blind import answer_of, draw, judge

POSES = recording("adis16350_14_poses")
MG_PER_LSB = 2.522
"""Of the accelerometers of an ADIS16350, by its sheet."""


@pytest.fixture(scope="module")
def recording():
    return adis_gonio.load_session(POSES)


def plain_left_out(session, *, force: bool, order: bool):
    """Leave one pose out of an unweighted least squares, with nothing of the package but its reader."""
    rate = np.array([dwell.gyro.mean(axis=0) for dwell in session.dwells])
    columns = [np.ones(len(rate))]
    if force:
        columns += list(np.array([d.accel.mean(axis=0) for d in session.dwells]).T * MG_PER_LSB / 1000)
    if order:
        columns.append(np.arange(float(len(rate))))
    design, left = np.column_stack(columns), []
    for k in range(len(rate)):
        kept = np.arange(len(rate)) != k
        solved = np.linalg.lstsq(design[kept], rate[kept], rcond=None)[0]
        left.append(rate[k] - design[k] @ solved)
    return np.sqrt(np.mean(np.square(left), axis=0))


def test_plain_least_squares_gives_the_figures_that_are_to_be_reproduced(recording):
    before = plain_left_out(recording, force=False, order=False)
    force = plain_left_out(recording, force=True, order=False)
    both = plain_left_out(recording, force=True, order=True)
    np.testing.assert_allclose(before, [0.141, 0.244, 0.065], atol=0.001)
    assert force[1] == pytest.approx(0.053, abs=0.001)
    np.testing.assert_allclose(both[[0, 2]], [0.066, 0.023], atol=0.001)


def test_fit_of_the_recording_brings_the_falls_with_names(recording):
    result = adis_gonio.fit(POSES, part="gyro")
    before, force = (result.scores[name]["residual_rms_by_axis_dps"] for name in ("zero rate", "gyro"))
    drift = result.scores["gyro with a drift from dwell to dwell"]["residual_rms_by_axis_dps"]
    assert before["y"] > 0.235
    assert force["y"] <= 0.053
    assert drift["x"] <= 0.066 < 0.137 < before["x"]
    assert drift["z"] <= 0.0232 < 0.064 < before["z"]
    assert result["g_sensitivity_yz"].value == pytest.approx(0.28, abs=0.02)
    assert result["g_sensitivity_yz"].unit == "dps/g"
    assert set(result.inflation) == {"x", "y", "z"}
    assert any("whole turns" in text for text in result.warnings), "what no turn shows is said"
    document = json.loads(json.dumps(result.as_dict()))
    assert (document["method"], document["part"]) == ("gyro", "gyro")
    assert document["covariance"]["names"] == list(document["parameters"])
    assert document["residual_rms_dps"] == pytest.approx(result.residual_rms_dps)


def test_trace_of_the_recording_names_the_causes_and_says_what_stays_open(recording):
    result = trace(recording, part="gyro")
    document = result.as_dict()
    assert document["part"] == "gyro"
    names = {finding["effect"]: finding for finding in document["found"]}
    assert set(names["g_sensitivity"]["axes"]) == {"x", "y", "z"}
    assert names["g_sensitivity"]["parameters"]["g_sensitivity_yz"]["value"] == pytest.approx(
        0.28, abs=0.03
    )
    assert all(name.startswith("g_sensitivity_") for name in names["g_sensitivity"]["parameters"])
    before, after = (document["error"][when]["heldout_by_axis_dps"] for when in ("before", "after"))
    assert before["y"] > 0.23
    assert after["y"] <= 0.053
    assert before["x"] > 0.135
    assert after["x"] <= 0.066
    assert after["z"] <= 0.035 < 0.06 < before["z"]
    # A course in time is there, of which 14 poses in one order do not tell the form.
    slow = [names for names in document["confounded"] if any("gyro_" in n for n in names)]
    assert slow
    assert any("step at t" in name or name == "gyro_drift" for group in slow for name in group)
    assert any("another order" in line or "switch the sensor off" in line for line in document["next"])
    assert not any(key.endswith("_mg") for key in document["error"]["after"])


def test_the_effects_derivatives_hold_for_a_reading_of_a_gyro():
    rng = np.random.default_rng(4)
    rate = rng.uniform(-200, 200, (9, 3))
    conditions = Conditions(time_s=np.arange(9.0), rate_dps=rate)
    lean = effect("gyro_misalignment", ("x",))
    added = lean.reading(np.array([2.0, 0.0]), np.zeros((9, 3)), conditions)
    # A lean of 2° towards y: the unit vector (cos 2°, sin 2°, 0).
    axis = np.array([np.cos(np.radians(2)), np.sin(np.radians(2)), 0.0])
    np.testing.assert_allclose(rate[:, 0] + added[:, 0], rate @ axis)
    assert not added[:, 1:].any()


def test_a_gyro_with_three_thermometers_follows_its_own():
    own = np.array([[30.0, 25.0, 20.0], [40.0, 25.0, 20.0]])
    c = Conditions(time_s=np.zeros(2), temperature_c=own.mean(axis=1), temperatures_c=own)
    made = effect("gyro_bias_temperature", ("x", "y", "z"))
    added = made.reading(np.array([0.1, 0.1, 0.1]), np.zeros((2, 3)), c)
    np.testing.assert_allclose(added, [[0.5, 0.0, -0.5], [1.5, 0.0, -0.5]])
    only = replace(c, temperatures_c=None)
    np.testing.assert_allclose(
        made.reading(np.full(3, 0.1), np.zeros((2, 3)), only)[:, 0], [0.0, 1 / 3], atol=1e-9
    )


def rates(seed: int, turned: bool = True):
    """Means of rates drawn here: K D ω + b + G f with known noise, and the truth."""
    rng = np.random.default_rng(seed)
    n = 24
    force = rng.normal(size=(n, 3))
    force /= np.linalg.norm(force, axis=1, keepdims=True)
    omega = np.zeros((n, 3))
    if turned:
        omega[::2] = 100 * rng.normal(size=(n // 2, 3))
    gains = np.array([1.02, 0.97, 1.005])
    lean = np.radians([[0, 2.0, -1.0], [0.5, 0, 3.0], [-4.0, 1.0, 0]])
    directions = np.sin(lean)
    for k in range(3):
        directions[k, k] = np.sqrt(1 - (directions[k] ** 2).sum())
    per_g = rng.normal(0, 0.1, (3, 3))
    zero = np.array([0.3, -1.2, 0.8])
    u = 0.01
    mean = omega @ (gains[:, None] * directions).T + zero + force @ per_g.T + rng.normal(0, u, (n, 3))
    conditions = Conditions(
        time_s=30.0 * np.arange(n),
        order=np.arange(float(n)),
        force_g=force,
        rate_dps=omega if turned else None,
    )
    data = from_means(
        mean, np.tile(u**2 * np.eye(3), (n, 1, 1)), conditions, fixture_rad=np.inf, measurement=MeanRate()
    )
    truth = {f"gyro_bias_{a}": zero[k] for k, a in enumerate("xyz")}
    for i, a in enumerate("xyz"):
        truth |= {f"g_sensitivity_{a}{b}": per_g[i, j] for j, b in enumerate("xyz")}
        if turned:
            truth[f"gyro_scale_{a}"] = gains[i]
            truth |= {
                f"gyro_misalignment_{a}{b}": np.degrees(lean[i, j]) for j, b in enumerate("xyz") if j != i
            }
    return data, truth


def test_gains_directions_zero_rates_and_g_sensitivity_are_covered_by_their_intervals():
    from adis_gonio.fitting.gyros.gyro_fit import fit_gyro_readings

    off = []
    for seed in range(30):
        data, truth = rates(seed, turned=bool(seed % 2))
        result = fit_gyro_readings(data)
        assert set(result.parameters) == set(truth)
        off += [(result[name].value - value) / result[name].u for name, value in truth.items()]
    off = np.array(off)
    # 585 values: ±1.8 % at 95 %.
    assert 0.925 <= np.mean(np.abs(off) < 1.96) <= 0.975
    assert np.sqrt((off**2).mean()) == pytest.approx(1.0, abs=0.1)


def test_what_the_poses_do_not_determine_is_left_out_and_said():
    from adis_gonio.fitting.gyros.gyro_fit import fit_gyro_readings

    data, _ = rates(1, turned=False)
    force = data.conditions.force_g * [1.0, 1.0, 0.0]  # a turn in the plane
    flat = replace(data, conditions=replace(data.conditions, force_g=force))
    result = fit_gyro_readings(flat)
    assert "g_sensitivity_xz" not in result
    assert {"g_sensitivity_xz", "g_sensitivity_yz", "g_sensitivity_zz"} == set(result.undetermined)
    assert any("g_sensitivity_xz" in text and "up and down" in text for text in result.warnings)
    assert "g_sensitivity_xy" in result


@pytest.mark.parametrize(("kind", "index"), [("none", 0), ("none", 1), ("one", 1), ("one", 4), ("two", 2)])
def test_blind_sessions_are_traced_right(kind, index):
    blind = draw(kind, 43, index)
    verdict = judge(blind, answer_of(blind))
    assert verdict.exact, (verdict.truth, verdict.claimed, verdict.said)
    assert not verdict.wrong


def test_what_no_name_fits_stays_without_a_name():
    blind = draw("uncatalogued", 7, 0)
    verdict = judge(blind, answer_of(blind))
    assert verdict.covariate, (verdict.truth, verdict.claimed, verdict.said)
    assert not verdict.wrong


def test_a_session_without_gyros_or_with_one_dwell_gets_one_line(tmp_path):
    time = np.arange(200) / 100.0
    rng = np.random.default_rng(0)
    accel, gyro = rng.normal([0, 0, -1000], 1.0, (200, 3)), rng.normal(0, 0.1, (200, 3))
    bare = Session(
        (Dwell(0, time, accel),), sensor="generic", accel_unit="mg", plane="none", source="a.csv"
    )
    with pytest.raises(DataError, match=r"a\.csv: no dwell holds samples of the gyros"):
        adis_gonio.fit(bare, part="gyro")
    one = replace(bare, dwells=(Dwell(0, time, accel, gyro=gyro),))
    with pytest.raises(FitError, match="measure more positions"):
        trace(one, part="gyro")
    result = fit_gyro(one)  # the zero rates are known all the same
    assert list(result.parameters) == ["gyro_bias_x", "gyro_bias_y", "gyro_bias_z"]
    with pytest.raises(UsageError, match="theirs is gyro"):
        adis_gonio.fit(one, "ml", part="gyro")
    with pytest.raises(UsageError, match="no part 'compass'"):
        trace(one, part="compass")
    with pytest.raises(DataError, match="counts"):
        fit_gyro(replace(one, gyro_unit="counts"))


def test_readings_of_gyros_are_in_degrees_a_second_whatever_the_file():
    blind = draw("none", 3, 0)
    session = blind.session
    turned = replace(
        session,
        gyro_unit="radps",
        dwells=tuple(replace(d, gyro=np.radians(d.gyro)) for d in session.dwells),
    )
    one, two = gyro_readings_of(session), gyro_readings_of(turned)
    np.testing.assert_allclose(one.mean, two.mean)
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=1e-6)
    assert one.model.unit == "dps"
    wanted = np.array([d.gyro.mean(axis=0) for d in session.dwells])
    np.testing.assert_allclose(one.mean, wanted)
    assert one.check.tolist() == [d.use == "check" for d in session.dwells]


def test_the_commands_take_the_part_and_the_accelerometers_stay_as_they_were(recording):
    run = CliRunner()
    shown = run.invoke(app, ["fit", "--sensor-part", "gyro", str(POSES)])
    assert shown.exit_code == 0, shown.output
    assert "g_sensitivity_yz" in shown.output
    assert "°/s" in shown.output
    assert " mg" not in shown.output
    wrong = run.invoke(app, ["fit", "--sensor-part", "compass", str(POSES)])
    assert wrong.exit_code == 2
    plain = run.invoke(app, ["fit", "--json", str(POSES)])
    document = json.loads(plain.stdout)
    assert "part" not in document
    assert document["method"] == "ml"


def test_the_simulated_world_runs_the_same_effects_and_its_accelerometers_do_not_feel_them():
    from adis_gonio.model.effects import parse_effect
    from adis_gonio.sim import World, WorldSettings

    time = np.arange(200) / 819.2
    # A gyro feels the force itself: the accelerometer's own noise and bias are not in it.
    perfect = WorldSettings(
        noise_mg=0.0, bias_instability_mg=0.0, bias_x_mg=0.0, bias_tempco_x_mg_per_c=0.0,
        scale_tempco_x_ppm_per_c=0.0,
    )  # fmt: skip
    plain, moved = (
        World(perfect, seed=5, effects=e).sample(time)
        for e in ((), (parse_effect("g_sensitivity:g_sensitivity_yx=0.3"),))
    )
    np.testing.assert_array_equal(plain.accel_mg, moved.accel_mg)
    np.testing.assert_allclose(
        (moved.gyro_dps - plain.gyro_dps)[:, 1], 3e-4 * plain.accel_mg[:, 0], atol=1e-9
    )
    np.testing.assert_array_equal(plain.gyro_dps[:, [0, 2]], moved.gyro_dps[:, [0, 2]])


@pytest.mark.parametrize("hidden", ["force", "time"])
def test_where_force_follows_the_order_of_the_poses_it_is_not_told_from_a_drift(hidden):
    rng, n, u = np.random.default_rng(0), 16, 0.01
    z, side = np.linspace(-0.95, 0.95, n), rng.uniform(0, 2 * np.pi, n)
    across = np.sqrt(1 - z**2)
    force = np.column_stack([across * np.cos(side), across * np.sin(side), z])
    mean = np.array([0.1, -0.2, 0.3]) + u * rng.normal(size=(n, 3))
    mean[:, 2] += 0.08 * (force[:, 2] if hidden == "force" else np.linspace(-1, 1, n))
    c = Conditions(time_s=30.0 * np.arange(n), order=np.arange(float(n)), force_g=force)
    covariance = np.tile(u**2 * np.eye(3), (n, 1, 1))
    result = trace_readings(from_means(mean, covariance, c, fixture_rad=np.inf, measurement=MeanRate()))
    assert any({"g_sensitivity", "gyro_drift"} <= set(names) for names in result.confounded)
    (cause,) = result.sets
    assert {"g_sensitivity", "gyro_drift"} <= set(cause.names)
    assert max(cause.probability) < 0.6, "neither is more than an even guess"
    assert any("tells" in line and "attitude" in line for line in result.advice)


class Ambient(MeanRate):
    """An invented third kind of reading: three light sensors, which have effects of no other part."""

    part = "light"
    unit = "lux"
    full = 1000.0
    driven_by = ()
    named_forms: ClassVar = {}


def test_the_engine_traces_a_third_kind_of_reading_without_a_change_in_it(monkeypatch):
    """Its unit ends the names of the errors, its effects alone are offered, forms without a name too."""
    from dataclasses import dataclass

    from adis_gonio.model import effects as registry
    from adis_gonio.model.effects.base import LinearAxisEffect, Parameter

    @dataclass(frozen=True)
    class Lamp(LinearAxisEffect):
        """The lamp follows the supply."""

        name = "lamp"
        cause = "The lamp follows the supply."
        needs = ("supply_v",)
        parts = ("light",)
        coefficients: ClassVar[tuple[Parameter, ...]] = (Parameter("lamp", "lux/V", -1e4, 1e4, 100.0),)

        def basis(self, axis, ideal, conditions):
            return (conditions.covariate("supply_v") - 5.0,)

    monkeypatch.setitem(registry.BUILT_IN, "lamp", Lamp)
    rng = np.random.default_rng(8)
    n = 30
    volts = 5 + 0.2 * rng.normal(size=n)
    mean = np.array([300.0, 320.0, 280.0]) + 5.0 * rng.normal(size=(n, 3))
    mean[:, 1] += 200.0 * (volts - 5)
    c = Conditions(time_s=10.0 * np.arange(n), order=np.arange(float(n)), supply_v=volts)
    data = from_means(
        mean, np.tile(25.0 * np.eye(3), (n, 1, 1)), c, fixture_rad=np.inf, measurement=Ambient()
    )
    assert Fit.begin(data).refit().dof == 3 * n - 3
    result = trace_readings(data)
    (found,) = result.found
    assert (found.effect, found.axes) == ("lamp", ("y",))
    assert found.parameters["lamp_y"].value == pytest.approx(200.0, abs=4 * found.parameters["lamp_y"].u)
    assert set(result.detectable) == {"lamp"}
    assert "residual_rms_lux" in result.after.as_dict()
