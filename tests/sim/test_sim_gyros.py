"""Faults of the gyros, measured from the chip's words through the driver."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor import Adis16354
from adis_gonio.device.sensor.registers import ACCEL_OUT, GYRO_OUT, TEMP_OUT
from adis_gonio.model.effects import parse_effect
from adis_gonio.sim import SimBus, World, WorldSettings
from typical_gyros import draw_gyros

SCAN = (*GYRO_OUT, *ACCEL_OUT, *TEMP_OUT)
FACES = [sign * row for row in np.eye(3) for sign in (1, -1)]
PERFECT = {
    "noise_mg": 0.0, "bias_instability_mg": 0.0, "gyro_instability_dps": 0.0, "gyro_bias_sigma_dps": 0.0,
    "gyro_g_dps_per_g": 0.0, "gyro_supply_dps_per_v": 0.0, "temperature_noise_c": 0.05,
    "temperature_offset_sigma_c": 0.0, "supply_noise_v": 0.0, "self_heating_c": 0.0, "ambient_c": 25.0,
    "gyro_noise_dps": 0.1, "vibration_mg": 0.0, "fixture_sigma_deg": 0.0, "mark_sigma_deg": 0.0,
    "delta_k": 0.0, "delta_phi_deg": 0.0, "scale_y": 1.0, "scale_z": 1.0, "skew_xz_deg": 0.0,
    "skew_yz_deg": 0.0, "alpha_deg": 0.0,
} | {f"{name}_{axis}_{unit}": 0.0 for axis in "xyz" for name, unit in (
    ("bias", "mg"), ("bias_tempco", "mg_per_c"), ("scale_tempco", "ppm_per_c"))}  # fmt: skip
"""Noise that is left hides the steps of the registers."""


def part(**given) -> Adis16354:
    return Adis16354(SimBus(World(WorldSettings(**(PERFECT | given)), seed=1)))


def three(name: str, values) -> dict[str, float]:
    return {name.format(axis): value for axis, value in zip("xyz", values, strict=True)}


def rest(sensor, n=3000):
    """Means of gyros in °/s, accelerometers in mg, thermometers in °C."""
    values = sensor.read_scans(n, SCAN).values().mean(axis=0)
    return values[:3], values[3:6], values[6:9]


def turned(sensor, angle_deg, axis=None):
    """Integrals (3,) in degrees of the gyros over a turn, their zero before it taken off."""
    stage, zero = sensor.bus.stage, rest(sensor)[0]
    with sensor.stream(GYRO_OUT, block_scans=256) as stream:
        blocks = [next(stream)]
        stage.turn_about(angle_deg, axis)
        while blocks[-1].time_s[-1] < sensor.bus.world.stage.still_at_s + 0.1:
            blocks.append(next(stream))
    time_s = np.concatenate([block.time_s for block in blocks])
    rates = np.concatenate([block.values() for block in blocks]) - zero
    return np.trapezoid(rates, time_s, axis=0)


# -- zero rate ------------------------------------------------------------------------------------------


def test_each_gyros_bias_follows_its_own_thermometer_and_no_other():
    per_c = (0.2, -0.3, 0.1)
    lags = three("die_lag_{}_s", (5.0, 60.0, 200.0)) | three("die_gradient_{}_c", (1.0, -2.0, 0.5))
    sensor = part(**three("gyro_bias_tempco_{}_dps_per_c", per_c), **lags)
    sensor.bus.world.bring_to(sensor.bus.now_s(), temperature_c=45.0)
    seen = []
    for _ in range(8):
        gyros, _, thermometers = rest(sensor, 400)
        seen.append([*gyros, *thermometers])
        sensor.bus.sleep_s(40.0)
    gyros, dies = np.array(seen)[:, :3], np.array(seen)[:, 3:]
    assert np.ptp(dies, axis=0).min() > 8.0
    for k in range(3):
        slope, zero = np.polyfit(dies[:, k] - 25.0, gyros[:, k], 1)
        assert (slope, zero) == pytest.approx((per_c[k], 0.0), abs=0.01)
        for other in {0, 1, 2} - {k}:
            left = gyros[:, k] - np.polyval(np.polyfit(dies[:, other], gyros[:, k], 1), dies[:, other])
            assert np.abs(left).max() > 0.08, (k, other)


def test_thermometers_differ_by_a_gradient_that_power_on_builds_up():
    sensor = part(powered_s=0.0, die_gradient_tau_s=60.0, **three("die_gradient_{}_c", (4.0, -3.0, 0.0)))
    early = rest(sensor, 300)[2]
    sensor.bus.sleep_s(600.0)
    assert early == pytest.approx([25.0] * 3, abs=0.15)
    assert rest(sensor, 300)[2] == pytest.approx([29.0, 22.0, 25.0], abs=0.1)


def test_a_gyro_warms_up_after_power_on():
    sensor = part(powered_s=0.0, gyro_warm_up_tau_s=30.0, **three("gyro_warm_up_{}_dps", (2.0, -1.0, 0.0)))
    sensor.bus.sleep_s(30.0 - sensor.bus.now_s())
    assert rest(sensor, 400)[0] == pytest.approx(np.array([2.0, -1.0, 0.0]) * np.exp(-1), abs=0.02)
    sensor.bus.sleep_s(300.0)
    assert rest(sensor, 400)[0] == pytest.approx([0.0] * 3, abs=0.02)


def test_the_truth_of_a_time_follows_warm_up_walk_and_the_temperature_of_the_gains():
    quiet = {"gyro_noise_dps": 0.0, "temperature_noise_c": 0.0}
    warm = {"powered_s": 30.0, "gyro_warm_up_tau_s": 30.0, "gyro_warm_up_x_dps": 2.0, "ambient_c": 35.0}
    gains = {"gyro_scale_z": 1.02, "gyro_scale_tempco_z_ppm_per_c": 1000.0}
    walk = {"gyro_rate_walk_dps_per_rt_s": 0.5}
    world = World(WorldSettings(**(PERFECT | quiet | warm | gains | walk)), seed=1)
    time_s = np.arange(0, 4, 1 / 16)
    rates = world.sample(time_s).gyro_dps
    assert rates[0, 0] == pytest.approx(2.0 * np.exp(-1))
    truth = world.truth(time_s)
    assert [truth[f"gyro_bias_{axis}"] for axis in "xyz"] == pytest.approx(rates.mean(axis=0))
    assert truth["gyro_scale_z"] == pytest.approx(1.02 * 1.01)
    assert truth["gyro_scale_error_z"] == pytest.approx(1.02 * 1.01 - 1)


@pytest.mark.parametrize("instability_dps", [0.0, 0.3])
def test_gyros_have_the_flicker_of_their_own_figure_and_the_truth_of_a_time_includes_it(instability_dps):
    flicker = {"bias_instability_mg": 0.5, "gyro_instability_dps": instability_dps, "gyro_noise_dps": 0.0}
    world = World(WorldSettings(**(PERFECT | flicker)), seed=1)
    time_s = np.arange(0, 4, 1 / 16)
    rates = world.sample(time_s).gyro_dps
    assert (rates.std(axis=0) > 0).tolist() == [instability_dps > 0] * 3
    truth = world.truth(time_s)
    assert [truth[f"gyro_bias_{axis}"] for axis in "xyz"] == pytest.approx(rates.mean(axis=0))


def test_nothing_has_warmed_up_before_power_on():
    given = {"powered_s": 0.0, "self_heating_c": 3.0, "gyro_warm_up_y_dps": 2.0, "die_gradient_z_c": 4.0}
    world = World(WorldSettings(**(PERFECT | given | {"gyro_noise_dps": 0.0})), seed=1)
    before, later = np.array([-0.5, -0.1]), np.array([0.0, 1e4])
    assert world.temperature_c(before).tolist() == [25.0, 25.0]
    assert world.die_temperature_c(before).tolist() == [[25.0] * 3] * 2
    assert world.die_temperature_c(later)[1] == pytest.approx([28.0, 28.0, 32.0])
    assert world.sample(before).gyro_dps[:, 1] == pytest.approx([2.0, 2.0])


def test_a_die_follows_the_self_heating_since_power_on():
    given = {"powered_s": 600.0, "self_heating_c": 20.0, "self_heating_tau_s": 200.0, "die_lag_y_s": 100.0}
    world = World(WorldSettings(**(PERFECT | given)), seed=1)
    # The step response of two lags in series, 600 s after the step.
    rise = 1 - (200 * np.exp(-600 / 200) - 100 * np.exp(-600 / 100)) / (200 - 100)
    assert world.die_temperature_c(np.zeros(1))[0, 1] == pytest.approx(25.0 + 20.0 * rise, abs=0.01)


def test_the_supply_moves_each_gyro_by_its_own():
    sensor = part(gyro_supply_x_dps_per_v=3.0, gyro_supply_z_dps_per_v=-2.0)
    sensor.bus.world.bring_to(sensor.bus.now_s(), supply_v=5.2)
    assert rest(sensor)[0] == pytest.approx([0.6, 0.0, -0.4], abs=0.01)


def test_forces_move_the_gyros_by_nine_linear_and_nine_quadratic_figures():
    rng = np.random.default_rng(3)
    per_g, per_g2 = rng.normal(0, 0.3, (3, 3)), rng.normal(0, 0.3, (3, 3))
    given = {f"gyro_g_sensitivity_{a}{b}_dps_per_g": per_g[k, j]
             for k, a in enumerate("xyz") for j, b in enumerate("xyz")}  # fmt: skip
    given |= {f"gyro_g2_sensitivity_{a}{b}_dps_per_g2": per_g2[k, j]
              for k, a in enumerate("xyz") for j, b in enumerate("xyz")}  # fmt: skip
    sensor = part(**given)
    readings, forces = [], []
    for face in FACES:
        sensor.bus.stage.orient(face)
        gyros, accel, _ = rest(sensor)
        readings.append(gyros)
        forces.append(accel / 1000)
    forces, readings = np.array(forces), np.array(readings)
    for k in range(3):
        design = np.column_stack([forces, forces**2])
        found = np.linalg.lstsq(design, readings[:, k], rcond=None)[0]
        assert found == pytest.approx([*per_g[k], *per_g2[k]], abs=0.01)
    truth = sensor.bus.world.truth()
    assert [truth[f"g_sensitivity_{a}{b}"] for a in "xyz" for b in "xyz"] == pytest.approx(per_g.ravel())
    assert [truth[f"g2_sensitivity_{a}{b}"] for a in "xyz" for b in "xyz"] == pytest.approx(per_g2.ravel())


def test_the_earth_turns_the_gyro_that_points_up():
    sensor = part(earth_rate_up_dps=0.5)
    for up in np.eye(3):
        sensor.bus.stage.orient(-up)
        assert rest(sensor)[0] == pytest.approx(0.5 * up, abs=0.01)


# -- gains and directions -------------------------------------------------------------------------------


def test_turns_about_three_axes_show_the_gyros_directions_and_the_triads_rotation_together():
    given = three("gyro_scale_{}", (1.02, 0.99, 1.01)) | three("gyro_triad_{}_deg", (0.5, -1.5, 1.0))
    given |= {"gyro_misalignment_xy_deg": 1.0, "gyro_misalignment_yz_deg": -2.0,
              "gyro_misalignment_zx_deg": 0.5}  # fmt: skip
    sensor = part(**given)
    columns = []
    for up in np.eye(3):
        sensor.bus.stage.orient(-up)
        columns.append(turned(sensor, 720.0) / 720.0)
    found = np.array(columns).T
    lean = np.sin(np.radians([[0, 1.0, 0], [0, 0, -2.0], [0.5, 0, 0]]))
    own = np.diag([1.02, 0.99, 1.01]) @ (lean + np.diag(np.sqrt(1 - (lean**2).sum(axis=1))))
    # A gyro's axis, a vector of the gyros' frame, is turned into the accelerometers'.
    expected = Rotation.from_rotvec(np.radians([0.5, -1.5, 1.0])).apply(own)
    assert found == pytest.approx(expected, abs=3e-4)
    truth = sensor.bus.world.truth()
    for k, a in enumerate("xyz"):
        assert truth[f"gyro_scale_{a}"] == pytest.approx(expected[k, k])
        assert truth[f"gyro_scale_error_{a}"] == pytest.approx((0.02, -0.01, 0.01)[k])
        for j, b in enumerate("xyz"):
            if j != k:
                sine = expected[k, j] / np.linalg.norm(expected[k])
                assert truth[f"gyro_misalignment_{a}{b}"] == pytest.approx(np.degrees(np.arcsin(sine)))


def test_the_gain_follows_the_temperature_of_the_gyros_own_die():
    sensor = part(ambient_c=45.0, gyro_scale_tempco_z_ppm_per_c=1000.0, die_gradient_z_c=10.0)
    sensor.bus.stage.orient((0.0, 0.0, -1.0))
    found = turned(sensor, 720.0)[2] / 720.0
    assert found == pytest.approx(1.03, abs=3e-4)
    now = np.array([sensor.bus.now_s()])
    assert sensor.bus.world.truth(now)["gyro_scale_z"] == pytest.approx(1.03)
    assert sensor.bus.world.truth()["gyro_scale_temperature_z"] == pytest.approx(1e-3)


def test_an_asymmetric_gyro_closes_no_turn_there_and_back():
    sensor = part(gyro_asymmetry_z=0.004)
    sensor.bus.stage.orient((0.0, 0.0, -1.0))
    there, back = turned(sensor, 720.0)[2], turned(sensor, -720.0)[2]
    assert there == pytest.approx(720 * 1.004, abs=0.2)
    assert back == pytest.approx(-720 * 0.996, abs=0.2)


@pytest.mark.parametrize(("dps", "m", "gain"), [(300, 2, 1.0), (150, 2, 1.01), (75, 4, 0.98)])
def test_ranges_differ_in_gain_and_in_the_size_of_a_step(dps, m, gain):
    sensor = part(gyro_range_gain_150=1.01, gyro_range_gain_75=0.98, gyro_bias_y_dps=40.0)
    sensor.configure(gyro_range_dps=dps, filter_m=m)
    block = sensor.read_scans(2000, GYRO_OUT)
    assert block.values()[:, 1].mean() == pytest.approx(40.0 * gain, abs=0.01)
    assert dps == 300 or sensor.bus.world.truth()[f"gyro_range_gain_{dps}"] == gain
    steps = np.diff(np.unique(block.values()[:, 0]))
    assert steps.min() == pytest.approx(0.07326 * dps / 300, rel=1e-6)


@pytest.mark.parametrize(("dps", "m"), [(300, 0), (150, 2), (75, 4)])
@pytest.mark.parametrize("over", [1.2, 5.0])
def test_a_gyro_is_cut_off_a_little_beyond_its_range_or_at_the_end_of_its_word(dps, m, over):
    sensor = part(gyro_bias_x_dps=-3.0 * dps, gyro_bias_z_dps=3.0 * dps, gyro_saturation=over)
    sensor.configure(gyro_range_dps=dps, filter_m=m)
    gyros = rest(sensor, 200)[0]
    most = min(over * dps, 8191.5 * 0.07326 * dps / 300)
    assert gyros == pytest.approx([-most, 0.0, most], abs=0.2)
    assert "a sensor is over its range" in sensor.status().messages


# -- what the chip does about it ------------------------------------------------------------------------


def test_msc_ctrl_7_leaves_of_the_gs_what_the_factory_did_not_know():
    given = {"gyro_g_dps_per_g": 0.5, "gyro_g_sensitivity_xz_dps_per_g": -0.4, "gyro_g_compensation": 0.8}
    sensor = part(**given)
    sensor.bus.stage.orient((0.0, 0.0, -1.0))
    plain, accel, _ = rest(sensor)
    assert plain == pytest.approx([0.4, 0.0, -0.5], abs=0.01)
    assert sensor.configure(linear_g=True).linear_g
    left, same, _ = rest(sensor)
    assert left == pytest.approx(0.2 * plain, abs=0.01)
    assert same == pytest.approx(accel, abs=0.5)
    truth = sensor.bus.world.truth()
    assert (truth["g_sensitivity_zz"], truth["g_sensitivity_left_zz"]) == pytest.approx((0.5, 0.1))


def test_what_msc_ctrl_7_takes_off_is_what_the_chips_own_accelerometers_read():
    sensor = part(gyro_g_dps_per_g=1.0, gyro_g_compensation=1.0, bias_z_mg=200.0)
    sensor.bus.stage.orient((0.0, 0.0, -1.0))
    sensor.configure(linear_g=True)
    assert rest(sensor)[0] == pytest.approx([0.0, 0.0, -0.2], abs=0.01)


def test_accelerometers_away_from_the_origin_feel_the_turn_and_msc_ctrl_6_takes_most_of_it_off():
    places = np.array([[30.0, -10.0, 5.0], [4.0, 20.0, -6.0], [7.0, 3.0, -25.0]])
    given = {f"accel_place_{a}{b}_mm": places[k, j]
             for k, a in enumerate("xyz") for j, b in enumerate("xyz")}  # fmt: skip
    step_s = 1e-3

    def spun(sensor):
        """Accelerometers over a turn about the vertical, at its own times, and the world's rate."""
        sensor.bus.stage.orient((0.0, 0.0, -1.0))
        world, begin = sensor.bus.world, sensor.bus.now_s()
        world.stage.turn_about(begin + 0.1, 720.0)
        block = sensor.read_scans(int(819.2 * 7), ACCEL_OUT)
        return block.values(), world.stage.at(block.time_s), world, block.time_s

    sensor = part(**given, move_speed_dps=120.0)
    sensor.configure(filter_m=0)
    accel, motion, world, time_s = spun(sensor)
    spin = np.radians(motion.rate_dps[:, 2])
    faster = np.radians(world.stage.at(time_s + step_s).rate_dps[:, 2])
    slower = np.radians(world.stage.at(time_s - step_s).rate_dps[:, 2])
    change = (faster - slower) / (2 * step_s)
    # Minus the accelerations of places that go round the vertical: -w² r inwards, and dw/dt across.
    x = spin**2 * places[0, 0] + change * places[0, 1]
    y = spin**2 * places[1, 1] - change * places[1, 0]
    expected = np.column_stack([x, y, 0 * x]) / 9.80665 - [0.0, 0.0, 1000.0]
    assert np.abs(expected[:, 0]).max() > 20.0
    even = np.abs(faster - 2 * spin + slower) < 0.02 * np.abs(change).max() * step_s  # no jolt of the motor
    assert even.mean() > 0.9
    assert accel[even] == pytest.approx(expected[even], abs=0.5)
    aligned = part(**given, move_speed_dps=120.0, origin_compensation=0.75)
    assert aligned.configure(filter_m=0, origin=True).origin
    left, _, _, _ = spun(aligned)
    gravity = np.array([0.0, 0.0, -1000.0])
    assert (left - gravity)[even] == pytest.approx(0.25 * (expected - gravity)[even], abs=0.5)


# -- autonull -------------------------------------------------------------------------------------------


def lying(**given):
    """A part that lies level, with a zero rate, gravity, warmth and the earth in its gyros."""
    faults = {"gyro_bias_z_dps": 1.0, "gyro_g_dps_per_g": 0.5, "ambient_c": 35.0, "earth_rate_up_dps": 0.1}
    sensor = part(**(faults | {"gyro_bias_tempco_z_dps_per_c": 0.08} | given))
    sensor.bus.stage.orient((0.0, 0.0, -1.0))
    return sensor


ZERO_DPS = 1.0 - 0.5 + 0.8 + 0.1
"""Of which the gyro's own zero at 25 °C, without gravity and the earth, is 1."""


def test_a_precision_autonull_takes_everything_that_the_gyro_reads_for_its_zero_and_saves_it():
    sensor = lying()
    endurance = sensor.read("ENDURANCE")
    begin = sensor.bus.now_s()
    offsets = sensor.precision_autonull()
    assert sensor.bus.now_s() - begin > 30.0
    assert offsets.gyro_dps == pytest.approx((0.0, 0.0, -ZERO_DPS), abs=0.018315 / 2 + 1e-3)
    assert sensor.read("ENDURANCE") == endurance + 1
    sensor.reset()
    assert rest(sensor)[0] == pytest.approx([0.0] * 3, abs=0.02)
    # On another face gravity is not what it was, and the zero is wrong by that.
    sensor.bus.stage.orient((0.0, 0.0, 1.0))
    assert rest(sensor)[0][2] == pytest.approx(2 * 0.5 - 2 * 0.1, abs=0.02)


def test_a_precision_autonull_averages_the_noise_away_that_a_short_one_keeps():
    settings = WorldSettings(**(PERFECT | {"gyro_noise_dps": 2.0}))
    nulls = [
        Adis16354(SimBus(World(settings, seed=seed))).precision_autonull().gyro_dps for seed in range(12)
    ]
    assert np.std(nulls) == pytest.approx(2.0 / np.sqrt(30 * 819.2), rel=0.5)  # of an LSB of 0.018 °/s


def test_a_part_that_is_turned_during_an_autonull_keeps_the_turn_as_its_zero():
    sensor = lying()
    sensor.bus.world.stage.turn_about(sensor.bus.now_s() + 1.0, 360.0)
    offsets = sensor.precision_autonull()
    assert offsets.gyro_dps[2] == pytest.approx(-(ZERO_DPS + 360.0 / 30.0), abs=0.05)
    assert rest(sensor)[0][2] == pytest.approx(-12.0, abs=0.05)


def test_an_offset_register_holds_no_more_than_75_dps():
    sensor = part(gyro_bias_x_dps=90.0, gyro_bias_y_dps=-90.0)
    assert sensor.autonull().gyro_dps == pytest.approx((-4096 * 0.018315, 4095 * 0.018315, 0.0), abs=0.2)
    assert rest(sensor)[0] == pytest.approx([90 - 4096 * 0.018315, -90 + 4095 * 0.018315, 0.0], abs=0.2)


@pytest.mark.parametrize(("average_s", "least"), [(0.0, 0.415), (0.2, 164**-0.5)])
def test_how_long_an_autonull_averages_is_a_figure_of_the_chip(average_s, least):
    settings = WorldSettings(**(PERFECT | {"gyro_noise_dps": 2.0, "autonull_s": average_s}))
    nulls = [Adis16354(SimBus(World(settings, seed=seed))).autonull().gyro_dps for seed in range(12)]
    assert np.std(nulls) == pytest.approx(2.0 * least, rel=0.3)


# -- effects of the catalogue -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("effect", "face", "conditions", "expected"),
    [
        ("gyro_bias_temperature:gyro_bias_temperature_y=0.1", (0, 0, -1), {"ambient_c": 35.0}, (0, 1.0, 0)),
        ("g_sensitivity:g_sensitivity_yz=0.4", (0, 0, -1), {}, (0, -0.4, 0)),
        ("g2_sensitivity:g2_sensitivity_xz=0.4", (0, 0, -1), {}, (0.4, 0, 0)),
        ("gyro_supply:gyro_supply_x=2", (0, 0, -1), {"supply_v": 5.1}, (0.2, 0, 0)),
    ],
)
def test_effects_of_gyros_change_the_gyros_and_nothing_else(effect, face, conditions, expected):
    effects = [parse_effect(effect)]
    settings = WorldSettings(**(PERFECT | conditions))
    plain, changed = (Adis16354(SimBus(World(settings, seed=1, effects=given))) for given in ((), effects))
    for sensor in (plain, changed):
        sensor.bus.stage.orient(face)
    (without, same, _), (found, accel, _) = rest(plain), rest(changed)
    assert found - without == pytest.approx(expected, abs=0.005)
    assert accel == pytest.approx(same, abs=1e-9)


def test_an_effect_of_the_gain_shows_in_turns():
    effects = [parse_effect("gyro_scale:gyro_scale_error_z=0.01", "z")]
    sensor = Adis16354(SimBus(World(WorldSettings(**PERFECT), seed=1, effects=effects)))
    sensor.bus.stage.orient((0.0, 0.0, -1.0))
    assert turned(sensor, 720.0)[2] == pytest.approx(720.0 * 1.01, abs=0.2)


def test_no_axis_leans_beyond_ninety_degrees():
    with pytest.raises(UsageError, match="gyro_misalignment_y"):
        World(WorldSettings(gyro_misalignment_yx_deg=80.0, gyro_misalignment_yz_deg=60.0))


def test_gyros_in_pieces_equal_those_at_once():
    settings = WorldSettings(**draw_gyros(np.random.default_rng(2)), hand_moves=1.0, powered_s=1.0)
    worlds = [World(settings) for _ in range(2)]
    for world in worlds:
        end = world.stage.orient(0.5, np.array([0.0, 0.0, -1.0]))
        world.stage.turn_about(end + 0.2, 90.0)
    times = np.arange(0.0, 9.0, 0.01)
    whole = worlds[0].sample(times)
    pieces = [worlds[1].sample(times[k : k + 7]) for k in range(0, len(times), 7)]
    for name in ("gyro_dps", "accel_mg", "temperature_c", "place_mg"):
        joined = np.concatenate([getattr(piece, name) for piece in pieces])
        assert np.array_equal(joined, getattr(whole, name)), name


def test_the_truth_of_a_time_is_what_the_gyros_read_at_rest_then():
    given = draw_gyros(np.random.default_rng(8)) | {"earth_rate_up_dps": 0.0}
    given |= {"gyro_rate_walk_dps_per_rt_s": 0.0, "powered_s": 20.0, "ambient_c": 40.0, "supply_v": 5.1}
    given["gyro_noise_dps"] = 0.3
    sensor = part(**given)
    sensor.bus.stage.orient((1.0, 0.0, 0.0))
    begin = sensor.bus.now_s()
    gyros, accel, _ = rest(sensor, 8000)
    truth = sensor.bus.world.truth(np.linspace(begin, sensor.bus.now_s(), 50))
    for k, axis in enumerate("xyz"):
        force = [truth[f"g_sensitivity_{axis}{other}"] for other in "xyz"] @ accel / 1000
        square = [truth[f"g2_sensitivity_{axis}{other}"] for other in "xyz"] @ (accel / 1000) ** 2
        assert gyros[k] == pytest.approx(truth[f"gyro_bias_{axis}"] + force + square, abs=0.01)
