"""The world: what an axis reads, temperature, supply, hidden parameters, effects, settings."""

import math
import re
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.model.effects import parse_effect
from adis_gonio.model.effects.base import Effect, Enters, Parameter
from adis_gonio.sim import World, WorldSettings
from adis_gonio.sim.settings import GyroSettings

SILENT = {
    "noise_mg": 0.0,
    "bias_instability_mg": 0.0,
    "gyro_noise_dps": 0.0,
    "gyro_instability_dps": 0.0,
    "gyro_bias_sigma_dps": 0.0,
    "temperature_noise_c": 0.0,
    "temperature_offset_sigma_c": 0.0,
    "supply_noise_v": 0.0,
    "fixture_sigma_deg": 0.0,
    "vibration_mg": 0.0,
    "alpha_deg": 0.0,
    "delta_k": 0.0,
    "delta_phi_deg": 0.0,
    "scale_y": 1.0,
    "scale_z": 1.0,
    "skew_xz_deg": 0.0,
    "skew_yz_deg": 0.0,
} | {f"{name}_{axis}_{unit}": 0.0 for axis in "xyz" for name, unit in (
    ("bias", "mg"), ("bias_tempco", "mg_per_c"), ("scale_tempco", "ppm_per_c"))}  # fmt: skip


def silent(effects=(), **given):
    return World(WorldSettings(**(SILENT | given)), seed=1, effects=effects)


def reading(world, time_s=10.0):
    return world.sample(np.array([time_s])).accel_mg[0]


def turned(world, theta, approach=0):
    end = world.stage.move_to(0.0, theta, approach)
    return reading(world, end + 1.0)


def test_the_seed_papers_equations_hold():
    alpha, delta_phi, delta_k, k_y = np.radians(20.0), np.radians(0.3), 0.02, 0.99
    k_x = k_y * (1 + delta_k)
    given = {"alpha_deg": 20.0, "delta_phi_deg": 0.3, "delta_k": 0.02, "scale_y": 0.99}
    x1, y1, _ = turned(silent(**given), 0.0)
    x2, y2, _ = turned(silent(**given), 90.0)
    assert x1 == pytest.approx(1000 * k_x * np.cos(alpha))
    assert y1 == pytest.approx(1000 * k_y * np.sin(delta_phi + alpha))
    assert x2 == pytest.approx(1000 * k_x * np.sin(alpha))
    assert y2 == pytest.approx(-1000 * k_y * np.cos(delta_phi + alpha))


@pytest.mark.parametrize("theta", [0.0, 33.0, 135.0, 300.0])
def test_readings_follow_the_convention_of_the_samples_csv(theta):
    world = silent(alpha_deg=5.0, delta_phi_deg=-0.4, delta_k=-0.01, bias_x_mg=12.0, bias_y_mg=-7.0)
    psi = np.radians(5.0 - theta)
    x, y, z = turned(world, theta)
    assert x == pytest.approx(990 * np.cos(psi) + 12.0)
    assert y == pytest.approx(1000 * np.sin(psi + np.radians(-0.4)) - 7.0)
    assert z == pytest.approx(0.0, abs=1e-9)


def test_level_with_z_up_reads_minus_one_g_on_z():
    world = silent()
    end = world.stage.orient(0.0, np.array([0.0, 0.0, -1.0]))
    assert reading(world, end + 1) == pytest.approx([0.0, 0.0, -1000.0], abs=1e-9)


def test_local_gravity_scales_the_readings():
    assert reading(silent(gravity_mps2=9.78))[0] == pytest.approx(1000 * 9.78 / 9.80665)


def test_skews_are_the_angles_between_axes_less_than_ninety_degrees():
    world = silent(delta_phi_deg=0.2, skew_xz_deg=-0.1, skew_yz_deg=0.3)
    rows = []
    for unit in np.eye(3):
        end = world.stage.orient(world.stage.still_at_s if rows else 0.0, unit)
        rows.append(reading(world, end + 0.1) / 1000)
    axes = np.array(rows).T
    gram = axes @ axes.T
    for (a, b), skew in {(0, 1): 0.2, (0, 2): -0.1, (1, 2): 0.3}.items():
        assert np.degrees(np.arcsin(gram[a, b])) == pytest.approx(skew)
    assert np.diag(gram) == pytest.approx(1.0)


def test_ambient_drift_swing_and_self_heating_make_the_temperature():
    given = {"ambient_c": 20.0, "self_heating_c": 4.0, "self_heating_tau_s": 200.0, "powered_s": 0.0}
    times = np.array([0.0, 200.0, 3600.0])
    assert silent(**given).temperature_c(times) == pytest.approx([20.0, 20 + 4 * (1 - np.exp(-1)), 24.0])
    drifting = silent(ambient_c=20.0, ambient_drift_c_per_h=2.0, self_heating_c=0.0)
    assert drifting.temperature_c(times)[2] == pytest.approx(22.0)
    swinging = silent(ambient_c=20.0, ambient_swing_c=3.0, ambient_period_s=800.0, self_heating_c=0.0)
    assert swinging.temperature_c(times)[1] == pytest.approx(23.0)
    assert silent().temperature_c(times) == pytest.approx(25.0, abs=1e-3), "by default the part is warm"


def test_the_three_dies_read_the_temperature_with_offsets_of_their_own():
    inputs = silent(temperature_offset_sigma_c=1.0).sample(np.array([1.0]))
    offsets = inputs.temperature_c[0] - 25.0
    assert len(set(offsets)) == 3
    assert np.abs(offsets).max() < 5


def test_temperature_coefficients_of_bias_and_scale():
    given = {"ambient_c": 35.0, "self_heating_c": 0.0}
    world = silent(bias_tempco_x_mg_per_c=0.5, scale_tempco_x_ppm_per_c=100.0, bias_x_mg=3.0, **given)
    assert reading(world)[0] == pytest.approx(1000 * (1 + 100e-6 * 10) + 3.0 + 5.0)


def test_gyros_feel_the_move_acceleration_and_supply():
    world = silent(gyro_bias_z_dps=0.7, gyro_g_dps_per_g=0.05, gyro_supply_dps_per_v=0.25, supply_v=5.2)
    still = world.sample(np.array([0.0])).gyro_dps[0]
    assert still == pytest.approx([0.05 + 0.05, 0.05, 0.75])
    end = world.stage.move_to(1.0, 90.0)
    turning = world.sample(np.array([(1.0 + end) / 2])).gyro_dps[0]
    assert turning[2] - 0.75 == pytest.approx(np.pi / 2 * 45.0)


def test_the_supply_drifts():
    world = silent(supply_v=5.0, supply_drift_v_per_h=0.1)
    assert world.sample(np.array([0.0, 3600.0])).supply_v == pytest.approx([5.0, 5.1])


def test_a_change_of_temperature_takes_a_minute_and_a_change_of_supply_none():
    world = silent(ambient_drift_c_per_h=36.0)  # 0.01 °C a second
    world.bring_to(100.0, temperature_c=41.0, supply_v=5.2)
    times = np.array([0.0, 99.9, 100.0, 160.0, 1e4])
    drift = 25.0 + 0.01 * times
    changed = 15.0 * np.array([0, 0, 0, 1 - np.exp(-1), 1])
    assert world.temperature_c(times) == pytest.approx(drift + changed, abs=1e-3)
    assert world.supply_v(times) == pytest.approx([5.0, 5.0, 5.2, 5.2, 5.2])


def test_a_table_shakes_most_in_the_first_dwell_and_evenly_within_each():
    world = silent([(Everything(), ())], noise_mg=3.0, table_vibration_mg=4.0)
    Everything.seen.clear()
    first = world.sample(np.arange(4000) / 819.2)
    assert first.accel_mg.std(axis=0) == pytest.approx(5.0, rel=0.05)
    assert Everything.seen[0].variance_mg2 == pytest.approx(25.0)
    now, ends = 5.0, []
    for k in range(100):
        now = world.stage.move_to(now, 10.0 * (k % 2)) + 3.0
        ends.append(now - 3.0)
    Everything.seen.clear()
    world.sample(np.add.outer(ends, [1.0, 2.0]).ravel())
    variance = Everything.seen[0].variance_mg2[:, 0].reshape(100, 2)
    assert np.ptp(variance, axis=1).tolist() == [0.0] * 100
    levels = np.sqrt(variance[1:, 0] - 9.0)  # the first move goes to position 0
    assert np.mean(levels) == pytest.approx(2.0, abs=4 * 4 / math.sqrt(12 * 100))
    assert levels.max() <= 4.0


def test_the_part_rings_in_the_plane_of_its_turn():
    still, ringing = silent(), silent(vibration_mg=20.0, vibration_hz=35.0, vibration_decay_s=0.3)
    for world in (still, ringing):
        end = world.stage.move_to(0.0, 90.0)
    now = end + 1 / 140  # a quarter of a period
    expected = 20 * np.exp(-1 / 140 / 0.3)
    assert reading(ringing, now) - reading(still, now) == pytest.approx([expected, expected, 0.0], abs=1e-9)


@pytest.mark.parametrize(("effects", "rms"), [((), 3.0), (("vibration_rectification",), 3 * 26**0.5)])
def test_a_table_shakes_by_five_times_the_noise_if_an_effect_follows_it(effects, rms):
    world = silent([parse_effect(name) for name in effects], noise_mg=3.0)
    assert world.sample(np.arange(4000) / 819.2).accel_mg.std(axis=0) == pytest.approx(rms, rel=0.05)


def test_the_true_angle_of_a_free_turn_is_that_of_the_rest_before_it():
    world = silent(alpha_deg=10.0, fixture_sigma_deg=0.5)
    end = world.stage.turn_freely(world.stage.move_to(0.0, -30.0))
    resting = 10.0 + 30.0 + world.stage.error_deg
    assert world.truth()["alpha"] == pytest.approx(resting)
    assert world.stage.error_deg != 0
    x, y, _ = reading(world, end + 5.0)
    assert np.degrees(np.arctan2(y, x)) == pytest.approx(resting - 5.0, abs=0.1)  # after 365°


def test_the_truth_has_the_names_of_a_fit_and_what_was_given():
    world = World(WorldSettings(delta_k=0.01, bias_y_mg=-20.0, alpha_deg=2.0, delta_phi_deg=0.1), seed=3)
    truth = world.truth()
    assert truth["delta_k"] == 0.01
    assert truth["bias_y"] == -20.0
    assert truth["alpha"] == 2.0
    assert truth["delta_phi"] == truth["skew_xy"] == 0.1
    assert truth["scale_x"] == pytest.approx(truth["scale_y"] * 1.01)
    expected = {f"{stem}_{axis}" for stem in ("bias", "scale") for axis in "xyz"}
    assert expected | {"skew_xz", "skew_yz"} <= set(truth)


def test_the_truth_can_be_that_of_the_temperatures_of_a_session():
    given = {"ambient_c": 25.0, "ambient_drift_c_per_h": 10.0, "self_heating_c": 0.0}
    world = silent(bias_tempco_x_mg_per_c=0.5, scale_tempco_y_ppm_per_c=100.0, bias_x_mg=3.0, **given)
    assert world.truth()["bias_x"] == 3.0
    warm = world.truth(np.array([0.0, 3600.0, 7200.0]))  # 10 °C above the reference in the mean
    assert warm["bias_x"] == pytest.approx(8.0)
    assert warm["scale_y"] == pytest.approx(1.001)
    assert warm["delta_k"] == pytest.approx(1 / 1.001 - 1)
    assert reading(world, 3600.0)[0] == pytest.approx(1008.0)


def test_giving_one_parameter_leaves_the_other_hidden_ones_as_they_were():
    free, given = World(seed=5).truth(), World(WorldSettings(bias_x_mg=1.0), seed=5).truth()
    assert {name for name in free if free[name] != given[name]} == {"bias_x"}


def test_another_day_is_the_same_part_with_other_noise_and_other_errors_of_the_stage():
    worlds = [World(seed=5, day=day) for day in (0, 1, 1)]
    truths = [world.truth() for world in worlds]
    assert truths[0] == truths[1]
    seen = []
    for world in worlds:
        end = world.stage.move_to(0.0, 90.0)
        seen.append((world.stage.error_deg, *world.sample(np.array([end + 1])).accel_mg[0]))
    assert seen[1] == seen[2]
    assert not set(seen[0]) & set(seen[1])


def test_hidden_parameters_are_drawn_with_the_figures_of_the_variant():
    truths = [World(seed=seed).truth() for seed in range(400)]
    biases = [truth[f"bias_{axis}"] for truth in truths for axis in "xyz"]
    assert np.std(biases) == pytest.approx(10.0, rel=0.1)
    assert np.std([truth["delta_k"] for truth in truths]) == pytest.approx(0.001 * np.sqrt(2), rel=0.1)
    for name, most in {"alpha": 5.0, "delta_phi": 0.25, "skew_xz": 0.25, "skew_yz": 0.25}.items():
        angles = [truth[name] for truth in truths]
        assert -most <= min(angles) < -0.9 * most, name
        assert 0.9 * most < max(angles) <= most, name
    assert np.std([truth["bias_temperature_x"] for truth in truths]) == pytest.approx(0.5, rel=0.1)
    assert len({truths[0][name] for name in ("skew_xy", "skew_xz", "skew_yz")}) == 3
    # A setting in ppm/°C; the truth is a share per °C.
    gains = [truth[f"scale_temperature_{axis}"] for truth in truths for axis in "xyz"]
    assert np.std(gains) == pytest.approx(40e-6, rel=0.1)
    other = [World(part="adis16350", seed=seed).truth()["bias_temperature_x"] for seed in range(100)]
    assert np.std(other) == pytest.approx(4.0, rel=0.2)


# -- effects ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Square(Effect):
    """A tiny effect of the reading: the square of the ideal reading."""

    name: ClassVar[str] = "square"
    cause: ClassVar[str] = "test"

    @property
    def parameters(self):
        return tuple(Parameter(f"k_{axis}", "mg/g2", -100, 100, 5.0) for axis in self.axes)

    def reading(self, values, ideal, conditions):
        added = np.zeros_like(ideal)
        for k, column in enumerate("xyz".index(axis) for axis in self.axes):
            added[:, column] = values[k] * (ideal[:, column] / 1000) ** 2
        return added


@dataclass(frozen=True)
class Wobble(Effect):
    """A tiny effect of the stage: the true angle depends on the declared one and on the dwell."""

    name: ClassVar[str] = "wobble"
    cause: ClassVar[str] = "test"
    enters: ClassVar[Enters] = Enters.ATTITUDE
    by_axis: ClassVar[bool] = False

    @property
    def parameters(self):
        return (Parameter("a", "rad", -1, 1, 0.01), Parameter("b", "rad", -1, 1, 0.02))

    def attitude_rad(self, values, conditions):
        return values[0] * np.sin(conditions.angle_rad) + values[1] * conditions.order


@dataclass(frozen=True)
class Clip(Effect):
    """A tiny effect of the samples."""

    name: ClassVar[str] = "clip"
    cause: ClassVar[str] = "test"
    enters: ClassVar[Enters] = Enters.SAMPLES

    @property
    def parameters(self):
        return (Parameter("limit", "mg", 0, 5000, 900.0),)

    def samples_mg(self, values, samples_mg, conditions, rng):
        return np.minimum(samples_mg, values[0])


@dataclass(frozen=True)
class Everything(Effect):
    """Writes down the conditions that it is given."""

    name: ClassVar[str] = "everything"
    cause: ClassVar[str] = "test"
    by_axis: ClassVar[bool] = False
    seen: ClassVar[list] = []

    @property
    def parameters(self):
        return ()

    def reading(self, values, ideal, conditions):
        self.seen.append(conditions)
        return np.zeros_like(ideal)


def test_an_effect_of_the_reading_is_added_on_its_axes():
    plain, with_effect = (
        silent(alpha_deg=30.0),
        silent([(Square(("x", "y")), {"k_x": 8.0})], alpha_deg=30.0),
    )
    added = reading(with_effect) - reading(plain)
    assert added == pytest.approx([8.0 * np.cos(np.radians(30)) ** 2, 5.0 * 0.25, 0.0])
    assert with_effect.truth()["square.k_x"] == 8.0
    assert with_effect.truth()["square.k_y"] == 5.0


def test_an_effect_of_the_attitude_turns_the_part():
    world = silent([(Wobble(), (0.02, 0.0))])
    x, y, _ = turned(world, 90.0)
    assert np.arctan2(y, x) == pytest.approx(-np.pi / 2 + 0.02)


def test_effects_of_the_attitude_add_up():
    x, y, _ = turned(silent([(Wobble(), (0.02, 0.0)), (Wobble(), (0.03, 0.0))]), 90.0)
    assert np.arctan2(y, x) == pytest.approx(-np.pi / 2 + 0.05)


def test_an_effect_may_depend_on_the_dwell():
    world = silent([(Wobble(), {"a": 0.0, "b": 0.03})])
    end = world.stage.move_to(0.0, 0.0)
    assert reading(world, end)[1] == pytest.approx(0.0, abs=1e-9)
    end = world.stage.move_to(end, 0.0)
    assert reading(world, end)[1] == pytest.approx(1000 * np.sin(0.03))


def test_an_effect_of_the_samples_sees_the_noise():
    world = World(WorldSettings(noise_mg=50.0, alpha_deg=0.0), seed=1, effects=[(Clip(("x",)), {})])
    accel = world.sample(np.arange(1000) / 819.2).accel_mg
    assert accel[:, 0].max() == 900.0


def test_effects_get_every_condition():
    world = silent([(Everything(), ())], ambient_c=30.0, self_heating_c=2.0, powered_s=0.0, supply_v=5.1)
    end = world.stage.move_to(0.0, 40.0, approach=-1)
    end = world.stage.move_to(end, 70.0)
    Everything.seen.clear()
    world.sample(end + np.array([1.0, 20.0]))
    (conditions,) = Everything.seen
    assert conditions.lacks([f.name for f in fields(conditions)]) == ("line_hz", "session")
    seventy = np.radians(70.0)
    assert conditions.angle_rad == pytest.approx(seventy)
    assert np.degrees(conditions.previous_angle_rad) == pytest.approx(40.0)
    assert conditions.order.tolist() == [1, 1]
    assert conditions.approach.tolist() == [1, 1]
    assert conditions.time_in_dwell_s == pytest.approx([1.0, 20.0])
    assert conditions.supply_v == pytest.approx(5.1)
    load_s, load_mg = conditions.load_history
    assert load_s[-1] == end
    assert load_mg[-1] == pytest.approx(1000 * np.array([np.cos(seventy), -np.sin(seventy), 0.0]))
    history_s, history_c = conditions.temperature_history
    assert history_s[0] == 0.0
    assert history_s[-1] > conditions.time_s[-1]
    assert np.interp(conditions.time_s, history_s, history_c) == pytest.approx(
        conditions.temperature_c, abs=1e-3
    )


def test_effects_get_the_rate_of_a_turn_with_and_without_its_sign():
    world = silent([(Everything(), ())])
    end = world.stage.move_to(0.0, -90.0)
    Everything.seen.clear()
    world.sample(np.array([end / 2]))
    (conditions,) = Everything.seen
    fastest = np.pi / 2 * 45.0
    assert conditions.rate_dps[0] == pytest.approx([0.0, 0.0, -fastest])
    assert conditions.abs_rate_dps[0] == pytest.approx([0.0, 0.0, fastest])


# -- settings -----------------------------------------------------------------------------------


def test_settings_from_text():
    given = WorldSettings.from_options(
        {"delta_k": "0.01", "noise_mg": "4.7", "seed": "3"}, others=("seed",)
    )
    assert given == WorldSettings(delta_k=0.01, noise_mg=4.7)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"delta_kk": "1"}, "did you mean 'delta_k'"),
        ({"sed": "1"}, "did you mean 'seed'"),
        ({"zzzz": "1"}, "known: seed"),
        ({"noise_mg": "much"}, "'much' is no number"),
        ({"noise_mg": "-1"}, "must not be negative"),
        ({"noise_mg": "nan"}, "finite"),
        ({"fixture_sigma_deg": "inf"}, "finite"),
        ({"move_speed_dps": "0"}, "above 0"),
        ({"skew_xz_deg": "80", "skew_yz_deg": "80"}, "skews"),
    ],
)
def test_bad_settings_are_refused_in_one_line(options, message):
    with pytest.raises(UsageError, match=message) as caught:
        World(WorldSettings.from_options(options, others=("seed",)))
    assert "\n" not in str(caught.value)


def test_every_setting_is_described_and_named_with_its_unit():
    text = WorldSettings.__doc__ + GyroSettings.__doc__
    units = ("mg", "deg", "dps", "c", "s", "v", "hz", "mps2", "h", "g", "g2", "mm")
    pure = (
        r"delta_k|scale_[yz]|hand_(pauses|returns|unevenness|moves|miss)|gyro_(scale|asymmetry)_[xyz]"
        r"|gyro_(range_gain_(150|75)|saturation|g_compensation)|origin_compensation|part_slip_position"
    )
    for entry in fields(WorldSettings):
        stem = re.sub(r"_[xyz](_|$)", r"_x\1", entry.name)
        stems = [entry.name, stem, *(re.sub(r"_[xyz]{2}_", pair, stem) for pair in ("_xx_", "_xy_"))]
        assert any(re.search(rf"\b{name}\b", text) for name in stems), entry.name
        if not re.fullmatch(pure, entry.name):
            assert entry.name.rsplit("_", 1)[1] in units, entry.name


def test_the_truth_of_a_session_holds_the_flicker_that_was_lived_through():
    settings = WorldSettings(
        noise_mg=0.0, bias_instability_mg=5.0, bias_x_mg=3.0, bias_tempco_x_mg_per_c=0.0
    )
    world = World(settings, seed=9)
    times = np.arange(0.0, 100.0, 0.01)
    readings = world.sample(times).accel_mg[:, 0]
    still = World(
        WorldSettings(noise_mg=0.0, bias_instability_mg=0.0, bias_x_mg=3.0, bias_tempco_x_mg_per_c=0.0),
        seed=9,
    )
    ideal = still.sample(times).accel_mg[:, 0]
    part = slice(2000, 3000)
    wander = np.mean(readings[part] - ideal[part])
    assert abs(wander) > 0.1
    assert world.truth(times[part])["bias_x"] - 3.0 == pytest.approx(wander, abs=0.1)  # the grid is 1/16 s
    assert world.truth()["bias_x"] == 3.0
    assert world.truth(np.array([1e6]))["bias_x"] == 3.0  # not lived through yet
