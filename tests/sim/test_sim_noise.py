"""Noise: its size against allantools, and that asking does not change it."""

import allantools
import numpy as np
import pytest

from adis_gonio.sim import World, WorldSettings
from adis_gonio.sim.noise import Flicker, RateWalk

RATE = 819.2


def overlapping(values, rate, taus):
    """Allan deviation by allantools at averaging times in s."""
    _, deviation, _, _ = allantools.oadev(values, rate=rate, data_type="freq", taus=taus)
    return deviation


def test_the_floor_of_the_allan_deviation_is_the_bias_instability():
    values = Flicker(np.full(16, 0.1), np.random.default_rng(3)).at(np.arange(2**15) / 4.0)
    taus = 2.0 ** np.arange(0, 8)  # 1 to 128 s of 2.3 hours
    deviation = np.sqrt(np.mean([overlapping(channel, 4.0, taus) ** 2 for channel in values.T], axis=0))
    assert deviation == pytest.approx(0.1, rel=0.06)


def test_the_spectrum_of_flicker_is_one_over_f():
    flicker = Flicker(np.full(30, 1.0), np.random.default_rng(4))
    values = flicker.at(np.arange(2**14) / 8.0)
    power = (np.abs(np.fft.rfft(values - values.mean(axis=0), axis=0)) ** 2).mean(axis=1) * 2 / (8 * 2**14)
    frequency = np.fft.rfftfreq(2**14, 1 / 8.0)
    band = (frequency > 0.004) & (frequency < 0.7)
    level = power[band] * frequency[band]
    slope = np.polyfit(np.log(frequency[band]), np.log(power[band]), 1)[0]
    assert slope == pytest.approx(-1, abs=0.08)
    assert level.mean() == pytest.approx(1 / (2 * np.log(2)), rel=0.1)


def test_white_noise_has_its_rms_and_falls_by_the_root_of_time():
    world = World(WorldSettings(bias_instability_mg=0.0, gyro_instability_dps=0.0), seed=2)
    inputs = world.sample(np.arange(1, 2**17) / RATE)
    assert inputs.accel_mg.std(axis=0) == pytest.approx(4.7, rel=0.01)
    assert inputs.gyro_dps.std(axis=0) == pytest.approx(0.6, rel=0.01)
    assert inputs.temperature_c.std(axis=0) == pytest.approx(0.1, rel=0.01)
    assert inputs.supply_v.std() == pytest.approx(0.001, rel=0.01)
    taus = np.array([4, 64, 1024]) / RATE
    expected = 4.7 / np.sqrt([4, 64, 1024])
    assert overlapping(inputs.accel_mg[:, 0], RATE, taus) == pytest.approx(expected, rel=0.08)


def test_white_samples_do_not_know_each_other():
    world = World(WorldSettings(noise_mg=4.7, bias_instability_mg=0.0, fixture_sigma_deg=0.0), seed=1)
    values = world.sample(np.arange(1, 100_000) / RATE).accel_mg
    assert np.corrcoef(values.T)[0, 1] == pytest.approx(0, abs=0.012)
    assert np.corrcoef(values[1:, 0], values[:-1, 0])[0, 1] == pytest.approx(0, abs=0.012)


def test_noise_density_at_819_sps_is_a_fifth_of_a_mg_per_root_hertz():
    # Behind a pole of 350 Hz the density is sigma / sqrt(350 pi/2); of white samples sigma sqrt(2 / rate).
    assert 4.7 / np.sqrt(350 * np.pi / 2) == pytest.approx(0.2, rel=0.01)
    assert 4.7 * np.sqrt(2 / RATE) == pytest.approx(0.23, rel=0.02)


@pytest.mark.parametrize("size", [1, 7, 500])
def test_noise_does_not_depend_on_how_it_is_asked_for(size):
    times = np.arange(1500) / RATE + 3.0
    whole = World(seed=4).sample(times)
    world = World(seed=4)
    parts = [world.sample(times[k : k + size]) for k in range(0, len(times), size)]
    for name in ("accel_mg", "gyro_dps", "temperature_c", "supply_v"):
        assert (np.concatenate([getattr(part, name) for part in parts]) == getattr(whole, name)).all()


def test_flicker_does_not_depend_on_the_times_in_between():
    rough = Flicker(np.ones(3), np.random.default_rng(8)).at(np.arange(0, 500, 50.0))
    fine = Flicker(np.ones(3), np.random.default_rng(8)).at(np.arange(0, 500, 0.5))[::100]
    assert (rough == fine).all()
    stepwise = Flicker(np.ones(3), np.random.default_rng(8))
    assert (np.concatenate([stepwise.at(np.array([t])) for t in np.arange(0, 500, 50.0)]) == rough).all()


def test_flicker_has_no_steps_between_the_points_of_its_grid():
    times = 100 + np.arange(0, 2, 1 / 64)
    values = Flicker(np.ones(1), np.random.default_rng(8)).at(times)[:, 0]
    for k in range(0, len(values) - 4, 4):  # a grid of 1/16 s
        assert values[k : k + 5] == pytest.approx(np.linspace(values[k], values[k + 4], 5))


def test_a_rate_walk_has_steps_of_its_size_and_never_jumps():
    walk = RateWalk(2.0, np.random.default_rng(5))
    values = walk.at(np.arange(0, 300, 1 / 16))
    assert values[0].tolist() == [0.0] * 3
    steps = np.diff(values, axis=0)
    assert steps.std() == pytest.approx(2.0 / 4, rel=0.03)
    assert np.abs(steps).max() < 6 * 2.0 / 4


def test_past_values_are_those_of_the_nearest_points_that_were_reached():
    walk = RateWalk(2.0, np.random.default_rng(5))
    assert walk.past_values(np.array([1.0])).shape == (0, 3)
    values = walk.at(np.array([10.0, 10 + 1 / 16, 10 + 2 / 16]))
    near = np.array([9.0, 10.01, 10.02, 10.04, 10.12, 1e6])
    assert walk.past_values(near).tolist() == values.tolist()


def test_other_seeds_give_other_noise():
    times = np.arange(100) / RATE
    assert (World(seed=1).sample(times).accel_mg != World(seed=2).sample(times).accel_mg).all()
