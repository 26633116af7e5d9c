"""A turn by hand: what moves belongs together, and the sensor feels what physics says."""

import numpy as np
import pytest

from adis_gonio.sim import World, WorldSettings
from adis_gonio.sim.hand import HandTurn, Sines, hold

QUIET = {"noise_mg": 0.0, "bias_instability_mg": 0.0, "gyro_noise_dps": 0.0, "gyro_instability_dps": 0.0}
QUIET |= {"gyro_bias_sigma_dps": 0.0, "gyro_g_dps_per_g": 0.0, "delta_k": 0.0, "delta_phi_deg": 0.0}
QUIET |= {"scale_y": 1.0, "bias_x_mg": 0.0, "bias_y_mg": 0.0, "hand_vibration_mg": 0.0}
QUIET |= {f"{name}_{axis}_{unit}": 0.0 for axis in "xy" for name, unit in (
    ("bias_tempco", "mg_per_c"), ("scale_tempco", "ppm_per_c"))}  # fmt: skip
STEP_S = 1e-4


def hand(**settings) -> HandTurn:
    return HandTurn(WorldSettings(**settings), np.random.default_rng(3))


def turning(**settings) -> tuple[World, np.ndarray]:
    world = World(WorldSettings(**(QUIET | settings)), seed=2)
    world.stage.turn_freely(1.0)
    return world, np.arange(0.0, 60.0, 0.01)


def test_rates_are_derivatives_of_the_angle():
    time_s = 20.0 + STEP_S * np.arange(20000)
    angle, rate = hand().turned(time_s)
    assert np.gradient(angle, STEP_S)[1:-1] == pytest.approx(rate[1:-1], abs=1e-6)


def test_a_hand_stops_for_new_grips_and_goes_as_far_as_it_should():
    turn = hand(hand_turn_deg=-365.0, hand_tremor_dps=0.0, hand_unevenness=0.0)
    angle, rate = turn.turned(np.linspace(0, turn.length_s, 5001))
    assert np.degrees(angle[-1]) == pytest.approx(-365.0)
    assert (np.abs(rate) < 1e-6).sum() > 50
    assert np.abs(rate).max() > 1.5 * np.radians(365) / turn.length_s


def crossings_hz(values, step_s):
    """Frequency of a series about zero, by its changes of sign."""
    return np.count_nonzero(np.diff(np.sign(values))) / 2 / (step_s * len(values))


def test_sines_have_an_rms_of_one_within_their_band():
    lines = Sines.drawn(np.random.default_rng(1), (2.0, 3.0))
    value, rate = lines.at(np.arange(0, 400, 0.01))
    assert value.std() == pytest.approx(1.0, rel=0.05)
    assert rate.std() ** 2 == pytest.approx(lines.mean_square_rate, rel=0.05)
    assert 2.0 < crossings_hz(value, 0.01) < 3.0


def test_a_hand_takes_hold_and_lets_go_in_half_a_second():
    firmness, _ = hold(np.array([-1.0, 0.0, 0.25, 0.5, 5.0, 9.5, 9.75, 10.0, 11.0]), 10.0)
    assert firmness == pytest.approx([0, 0, 0.5, 1, 1, 1, 0.5, 0, 0])


@pytest.mark.parametrize(
    ("setting", "size", "rms_dps", "band_hz"),
    # A turn of 365° in 50 s has a mean speed of 7.3 °/s.
    [("hand_tremor_dps", 2.0, 2.0, (8.0, 12.0)), ("hand_unevenness", 0.3, 0.3 * 7.3, (0.5, 3.0))],
)
def test_tremor_and_unevenness_change_the_rate_by_their_rms_in_their_band(setting, size, rms_dps, band_hz):
    time_s = np.arange(1.0, 49.0, 0.005)
    quiet = {"hand_tremor_dps": 0.0, "hand_unevenness": 0.0}
    rates = [hand(**(quiet | {setting: value})).turned(time_s)[1] for value in (0.0, size)]
    extra = np.degrees(rates[1] - rates[0])
    assert np.sqrt(np.mean(extra**2)) == pytest.approx(rms_dps, rel=0.2)
    assert band_hz[0] < crossings_hz(extra, 0.005) < band_hz[1]


def test_a_hand_pauses_for_a_new_grip_between_two_tenths_and_nine_tenths_of_a_second():
    time_s = np.arange(0.0, 50.0, 0.001)
    _, rate = hand(hand_tremor_dps=0.0, hand_unevenness=0.0).turned(time_s)
    edges = np.flatnonzero(np.diff((np.abs(rate) < 1e-12).astype(int)))
    pauses = np.diff(edges)[1::2] / 1000
    assert len(pauses) >= 3
    assert ((pauses > 0.19) & (pauses < 0.91)).all()


def test_a_bearing_wobbles_at_one_and_two_cycles_a_turn_and_a_held_part_sways():
    time_s, angle = np.arange(2.0, 48.0, 0.01), np.linspace(0, 4 * np.pi, 4600)
    course = angle, np.ones(4600)
    tilt = np.degrees(hand(axis_wobble_deg=0.2).tilt(time_s, course)[0])
    cycles = np.abs(np.fft.rfft(tilt[:-1])) * 2 / 4599
    assert cycles[[2, 4]] == pytest.approx([0.2, 0.1], rel=0.01)
    swaying = np.degrees(hand(axis_wobble_deg=0.2, hand_sway_deg=3.0).tilt(time_s, course)[0]) - tilt
    assert swaying.std() == pytest.approx(3.0, rel=0.3)
    assert 0.05 < crossings_hz(swaying, 0.01) < 0.5


def test_gravity_turns_through_the_part_as_its_rates_say():
    world, time_s = turning(axis_wobble_deg=1.0)
    time_s = 20.0 + STEP_S * np.arange(5000)
    motion = world.stage.at(time_s)
    changed = np.gradient(motion.direction, STEP_S, axis=0)
    expected = -np.cross(np.radians(motion.rate_dps), motion.direction)
    assert changed[1:-1] == pytest.approx(expected[1:-1], abs=1e-5)


def test_a_part_off_the_axis_feels_the_acceleration_of_its_place():
    lever = {"lever_x_mm": 80.0, "lever_y_mm": -50.0}
    (away, time_s), (centred, _) = turning(**lever), turning()
    time_s = 20.0 + STEP_S * np.arange(5000)
    motion = centred.stage.at(time_s)
    # Its place in the room, r turned by the stage's angle, differentiated twice and turned back.
    angle = motion.angle_rad
    place = (0.08 - 0.05j) * np.exp(1j * angle)
    felt = np.gradient(np.gradient(place, STEP_S), STEP_S) * np.exp(-1j * angle)
    extra = away.sample(time_s).accel_mg - centred.sample(time_s).accel_mg
    expected = -felt / 9.80665 * 1000
    assert extra[5:-5, 0] == pytest.approx(expected.real[5:-5], abs=0.02)
    assert extra[5:-5, 1] == pytest.approx(expected.imag[5:-5], abs=0.02)


def test_forces_of_the_hand_and_of_the_place_add_up_and_gyros_feel_both():
    lever, felt = {"lever_x_mm": 800.0}, {"gyro_g_sensitivity_yx_dps_per_g": 0.1}
    worlds = [
        turning(**felt, **place, hand_vibration_mg=shaking)[0]
        for place, shaking in (({}, 0.0), (lever, 0.0), ({}, 30.0), (lever, 30.0))
    ]
    neither, at_place, shaken, both = (world.sample(20.0 + 0.01 * np.arange(200)) for world in worlds)
    by_place, by_hand = (one.accel_mg - neither.accel_mg for one in (at_place, shaken))
    assert np.abs(by_place[:, 0]).max() > 1.0
    assert np.abs(by_hand).max(axis=0).min() > 10.0
    force = both.accel_mg - neither.accel_mg
    assert force == pytest.approx(by_place + by_hand)
    more = both.gyro_dps - neither.gyro_dps
    assert more[:, 1] == pytest.approx(1e-4 * force[:, 0], abs=1e-12)


def test_gyro_faults_are_what_their_names_say():
    settings = {
        "gyro_scale_z": 1.02, "gyro_misalignment_xz_deg": 1.0,
        "gyro_g_sensitivity_zx_dps_per_g": 0.1, "axis_wobble_deg": 0.0,
    }  # fmt: skip
    world, time_s = turning(**settings)
    motion, gyro = world.stage.at(time_s), world.sample(time_s)
    rate = motion.rate_dps[:, 2]
    assert gyro.gyro_dps[:, 0] == pytest.approx(np.sin(np.radians(1.0)) * rate, abs=1e-9)
    assert gyro.gyro_dps[:, 2] == pytest.approx(1.02 * rate + 1e-4 * gyro.accel_mg[:, 0], abs=1e-9)


def test_a_rate_walk_grows_with_the_root_of_time_and_does_not_depend_on_calls():
    settings = {"gyro_rate_walk_dps_per_rt_s": 0.1, "hand_tremor_dps": 0.0}
    ends = []
    for seed in range(60):
        world = World(WorldSettings(**(QUIET | settings)), seed=seed)
        ends.append(world.sample(np.array([0.0, 25.0])).gyro_dps[1])
    assert np.std(ends) == pytest.approx(0.5, rel=0.25)
    one, two = (World(WorldSettings(**(QUIET | settings)), seed=1) for _ in range(2))
    time_s = np.arange(0.0, 2.0, 0.1)
    parts = np.concatenate([two.sample(time_s[:7]).gyro_dps, two.sample(time_s[7:]).gyro_dps])
    assert np.array_equal(one.sample(time_s).gyro_dps, parts)


def test_the_truth_names_the_gyros_faults_and_the_lever_as_they_are_while_the_part_turns():
    """Told from what the simulated sensor reads, by least squares, with no noise in it."""
    given = {"lever_x_mm": 80.0, "lever_y_mm": -50.0, "gyro_scale_z": 1.02, "gyro_bias_z_dps": 0.7}
    given |= {"gyro_g_sensitivity_zx_dps_per_g": 0.1, "gyro_g_sensitivity_zy_dps_per_g": -0.05}
    given |= {"gyro_misalignment_zx_deg": 3.0, "gyro_rate_walk_dps_per_rt_s": 1e-3, "supply_v": 5.1}
    given |= {"gyro_supply_dps_per_v": 0.2, "axis_wobble_deg": 0.0}
    world, time_s = turning(**given)
    motion, felt = world.stage.at(time_s), world.sample(time_s)
    known = [motion.rate_dps[:, 2], np.ones(len(time_s)), *(felt.accel_mg[:, :2].T / 1000)]
    found = np.linalg.lstsq(np.column_stack(known), felt.gyro_dps[:, 2], rcond=None)[0]
    truth = world.truth(time_s)
    names = ("gyro_scale_z", "gyro_bias_z", "g_sensitivity_zx", "g_sensitivity_zy")
    assert [truth[name] for name in names] == pytest.approx(found, abs=3e-3)
    assert truth["gyro_bias_z"] == pytest.approx(0.72, abs=0.02)  # of which the supply has 0.02
    assert truth["gyro_scale_z"] < 1.0195  # an axis that leans sees less
    assert (truth["lever_x"], truth["lever_y"]) == (80.0, -50.0)
    assert world.truth()["gyro_bias_z"] == 0.7


def test_several_turns_go_on_or_back_in_the_same_time():
    rng = np.random.default_rng
    quiet = {"hand_tremor_dps": 0.0, "hand_unevenness": 0.0}
    on = HandTurn(WorldSettings(**quiet), rng(1), 2)
    back = HandTurn(WorldSettings(**quiet, hand_returns=1.0), rng(1), 2)
    for turn, farthest, end in ((on, 730.0, 730.0), (back, 365.0, 0.0)):
        angle = np.degrees(turn.turned(np.linspace(0, turn.length_s, 5001))[0])
        assert turn.length_s == pytest.approx(50.0, abs=0.01)
        assert angle.max() == pytest.approx(farthest, abs=0.01)
        assert angle[-1] == pytest.approx(end, abs=0.01)
        assert np.degrees(turn.total_rad) == pytest.approx(end)
