"""Time steps of the smoother: means, turns, gaps and ends of ranges, by hand."""

import math

import numpy as np
import pytest

from adis_gonio.live.motion_model import (
    HAND_DPS_PER_RT_S,
    SATURATED_DPS,
    GyroKnowledge,
    Increment,
    Sensing,
    Stepper,
)

SENSING = Sensing(0.01, noise_mg=4.0, gyro_noise_dps=0.5, gyro_range_dps=100.0)
"""Two samples a step."""


def steps(time_s, rate_dps, accel_mg=None, warm_c=None, block: int = 3) -> list[Increment]:
    """Steps of samples of a turn about Z, in blocks."""
    time_s, n = np.asarray(time_s, dtype=float), len(time_s)
    accel = np.tile([1000.0, 0.0, 0.0], (n, 1)) if accel_mg is None else np.asarray(accel_mg)
    gyro = np.column_stack([np.zeros((n, 2)), np.broadcast_to(rate_dps, n)])
    warm = None if warm_c is None else np.asarray(warm_c, dtype=float)
    stepper, found = Stepper(SENSING), []
    for k in range(0, n, block):
        part = slice(k, k + block)
        found += stepper.feed(time_s[part], accel[part], gyro[part], None if warm is None else warm[part])
    return found


def test_a_step_turns_by_the_integral_of_the_rates_from_middle_to_middle():
    time_s = 0.01 * np.arange(10)
    found = steps(time_s, 50 + 400 * time_s)
    assert [one.time_s for one in found] == pytest.approx([0.005, 0.025, 0.045, 0.065, 0.085])
    assert [one.length_s for one in found] == pytest.approx([0, 0.02, 0.02, 0.02, 0.02])
    assert [one.rate_dps[2] for one in found] == pytest.approx([52, 60, 68, 76, 84])
    # Mean over the two samples of a step of the trapezoids since the two samples before.
    assert [one.turned_deg[2] for one in found] == pytest.approx([0, 1.12, 1.28, 1.44, 1.60])
    assert all(one.gap_s == 0 and not one.saturated and one.temperature_c is None for one in found)


def test_readings_are_rotated_to_the_middle_of_their_step():
    time_s = 0.01 * np.arange(8)
    angle = np.radians(3000.0 * time_s)  # 30° between two samples
    accel = 1000 * np.column_stack([np.cos(angle), -np.sin(angle), np.full(8, 0.2)])
    for one in steps(time_s, 3000.0, accel):
        middle = math.radians(3000.0 * one.time_s)
        assert one.accel_mg == pytest.approx([1000 * math.cos(middle), -1000 * math.sin(middle), 200.0])


def test_the_temperature_of_a_step_is_the_mean_of_its_samples():
    found = steps(0.01 * np.arange(6), 0.0, warm_c=[20, 22, 23, 24, 25, np.nan])
    assert [one.temperature_c for one in found] == [21.0, 23.5, None]


@pytest.mark.parametrize(("wait_s", "gap"), [(0.0149, False), (0.0151, True), (0.3, True)])
def test_more_than_one_and_a_half_periods_between_samples_are_a_gap(wait_s, gap):
    found = steps(np.cumsum([0, 0.01, 0.01, 0.01, wait_s, 0.01, 0.01, 0.01]), 0.0)
    assert [one.gap_s > 0 for one in found] == [False, False, gap, False]
    assert found[2].gap_s == pytest.approx(wait_s if gap else 0)


@pytest.mark.parametrize(("wait_s", "hand"), [(0.04, 0.0), (0.06, HAND_DPS_PER_RT_S)])
def test_a_hand_may_turn_the_sensor_in_a_long_gap(wait_s, hand):
    found = steps(np.cumsum([0, 0.01, 0.01, 0.01, wait_s, 0.01]), 20.0)
    assert [one.unseen_deg2 for one in found[:2]] == [0, 0]  # a steady rate misses nothing
    # Integral of a Brownian bridge.
    assert found[2].unseen_deg2 == pytest.approx(hand**2 * wait_s**3 / 12)


def test_a_rate_that_changes_leaves_a_turn_between_samples_unseen():
    found = steps(0.01 * np.arange(8), np.repeat([0.0, 6.0, 0.0, 6.0], 2))
    # Squared change per second, in an exponential mean over a second, as of the step before.
    walk = [0.0, 0.0, 0.02 * 1800, 0.02 * 1800 + 0.02 * (1800 - 0.02 * 1800)]
    expected = [2 * one * 0.01**3 / 12 for one in walk]
    assert [one.unseen_deg2 for one in found] == pytest.approx(expected)


@pytest.mark.parametrize("sign", [1, -1])
def test_turns_that_a_saturated_gyro_missed_add_up_with_one_sign(sign):
    rate = sign * np.array([50, 50, 97.9, 97.9, 98, 20, 98, 98, 99, 100, 0, 0])
    found = steps(0.01 * np.arange(12), rate)
    assert [one.saturated for one in found] == [False, False, True, True, True, False]
    # Together (3 SATURATED_DPS length)²; the changes of the rate add less than a thousandth.
    assert sum(one.unseen_deg2 for one in found) == pytest.approx((3 * SATURATED_DPS * 0.02) ** 2, rel=1e-3)


@pytest.mark.parametrize(
    ("sensing", "samples", "delay_s"),
    [
        (Sensing(0.01, 1.0, 1.0), 2, 0.0),
        (Sensing(0.05, 1.0, 1.0), 1, 0.0),
        (Sensing(0.001, 1.0, 1.0, filter_m=2), 20, 0.003),
        (Sensing(0.001, 1.0, 1.0, filter_m=5), 32, 0.031),
    ],
)
def test_a_step_is_20_ms_or_the_window_of_the_chips_filter(sensing, samples, delay_s):
    assert sensing.step_samples == samples
    assert sensing.delay_s == pytest.approx(delay_s)
    assert sensing.step_noise_mg2 == pytest.approx(1 / samples)


def test_the_doubt_of_a_gyro_is_what_its_calibration_states_and_the_drift_since():
    unknown = GyroKnowledge.of(None, {"gyro_scale_z": 0.001})
    assert unknown == GyroKnowledge()

    class Shift:
        def correct(self, rate_dps, force_g, temperature_c):
            return rate_dps - 0.5 - 0.1 * force_g - (0 if temperature_c is None else temperature_c[0] - 25)

    u = {"gyro_bias_z": 0.15, "gyro_scale_z": 0.002, "g_sensitivity_zx": 0.01, "g_sensitivity_zy": 0.02}
    known = GyroKnowledge.of(Shift(), u)
    assert (known.zero_dps, known.scale, known.g_dps_per_g) == pytest.approx((0.25, 0.002, 0.02))
    rate, accel = np.array([1.0, 2.0, 3.0]), np.array([1000.0, 0.0, -500.0])
    assert known.corrected(rate, accel, None) == pytest.approx([0.4, 1.5, 2.55])
    assert known.corrected(rate, accel, 26.0) == pytest.approx([-0.6, 0.5, 1.55])
    assert unknown.corrected(rate, accel, 26.0) == pytest.approx(rate)
    partly = GyroKnowledge.of(Shift(), {"gyro_bias_z": None, "g_sensitivity_zx": 0.01})
    # A parameter that is not stated has the uncertainty without a calibration.
    assert (partly.scale, partly.g_dps_per_g) == (unknown.scale, unknown.g_dps_per_g)
    assert partly.zero_dps == pytest.approx(0.2 * math.sqrt(2))
