"""The smoothed angle in turns of which the truth is known: shaking, gaps, ends of ranges, hours."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.live.motion_model import (
    LEVER_MM,
    LEVER_X,
    LEVER_Y,
    AngleSmoother,
    GyroKnowledge,
    Sensing,
)
from live.smoothing_hands import Turning, during, errors, sensing, told

SHAKEN = Turning(shake_mg=30.0, zero_dps=1.5, scale=1.005)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def z_of(turning: Turning, angles) -> np.ndarray:
    return errors(turning, angles) / np.array([angle.u_deg for angle in angles])


def test_a_shaken_turn_is_shown_without_the_shaking():
    samples = SHAKEN.drawn(1)
    angles = told(AngleSmoother(sensing(SHAKEN), lag_s=0.5), samples)
    moving = during(angles, 4, 6)
    gravity = np.degrees(np.arctan2(-samples[1][:, 1], samples[1][:, 0]))
    shaken = gravity.reshape(-1, 10).mean(axis=1) - SHAKEN.angle(samples[0]).reshape(-1, 10).mean(axis=1)
    assert rms(errors(SHAKEN, angles)[moving]) < rms(shaken[40:60]) / 3


def test_the_lag_is_what_it_is_said_to_be():
    for lag_s in (0.0, 0.2, 1.0):
        smoother = AngleSmoother(sensing(SHAKEN), lag_s=lag_s)
        samples = SHAKEN.drawn(2)
        angles = told(smoother, samples, every=100)
        behind = samples[0][-1] - angles[-1].time_s
        # One step waits for its neighbour, and the middle of a step is half of one before its end.
        assert lag_s <= behind <= lag_s + 0.04


def test_more_lag_is_less_error_and_less_u():
    found = []
    for lag_s in (0.0, 0.6):
        off, u = [], []
        for seed in range(3):
            angles = told(AngleSmoother(sensing(SHAKEN), lag_s=lag_s), SHAKEN.drawn(seed))
            moving = during(angles, 4, 6)
            off.append(rms(errors(SHAKEN, angles)[moving]))
            u.append(np.mean([a.u_deg for a, m in zip(angles, moving, strict=True) if m]))
        found.append((rms(np.array(off)), np.mean(u)))
    assert found[1][0] < found[0][0]
    assert found[1][1] < found[0][1]


@pytest.mark.parametrize("lag_s", [0.0, 0.25])
def test_u_is_honest_in_motion_and_at_rest(lag_s):
    rng = np.random.default_rng(5)
    squares: dict[str, list[float]] = {"motion": [], "rest": []}
    for seed in range(10):  # scripts/smoother_statistics.py: a thousand
        turning = Turning(
            rate_hz=100.0, turn_deg=float(rng.uniform(-200, 200)), zero_dps=float(rng.normal(0, 1)),
            scale=float(rng.normal(1, 0.01)), shake_mg=float(rng.uniform(0, 60)),
            shake_hz=float(rng.uniform(3, 12)),
        )  # fmt: skip
        angles = told(AngleSmoother(sensing(turning), lag_s=lag_s), turning.drawn(seed), every=25)
        z = z_of(turning, angles)
        squares["motion"].append(float(np.mean(z[during(angles, 4, 6)] ** 2)))
        squares["rest"].append(float(np.mean(z[during(angles, 2.5, 4) | during(angles, 7.5, 10)] ** 2)))
    for name, each in squares.items():
        mean, u = np.mean(each), np.std(each, ddof=1) / np.sqrt(len(each))
        assert mean + 3 * u > 0.6, name
        assert mean - u < 1.3, name  # 3 u of ten turns would accept a u that is four times too small


def test_the_accelerometers_one_over_f_noise_is_in_u():
    plain = sensing(SHAKEN)
    ways = [AngleSmoother(replace(plain, drift_mg=floor), lag_s=0.2) for floor in (0.0, 0.5)]
    quiet, drifting = (told(way, SHAKEN.drawn(3), every=100)[-1].u_deg for way in ways)
    # 17 octaves with half the square of the floor each, of 1000 mg.
    assert drifting**2 - quiet**2 == pytest.approx(np.degrees(0.5e-3 * np.sqrt(17 / 2)) ** 2, rel=0.1)


def test_samples_in_other_blocks_give_the_same_angles():
    samples = SHAKEN.drawn(3)
    ways = []
    for every in (5, 7, 40):
        smoother = AngleSmoother(sensing(SHAKEN), lag_s=0.3)
        told(smoother, samples, every)
        ways.append(smoother.angle())
    assert [way.angle_deg for way in ways] == pytest.approx([ways[0].angle_deg] * 3, abs=1e-12)
    assert [way.u_deg for way in ways] == pytest.approx([ways[0].u_deg] * 3, abs=1e-12)


@pytest.mark.parametrize("lag_s", [0.0, 0.25])
def test_the_rate_is_that_of_the_turn_without_the_errors_of_the_gyro(lag_s):
    turning = Turning(turn_deg=600.0, zero_dps=3.0, scale=1.03, noise=0.1)
    angles = told(AngleSmoother(sensing(turning), lag_s=lag_s), turning.drawn(6))
    off = np.array([a.rate_dps - turning.rate(np.array(a.time_s)) for a in angles])
    late = during(angles, 5.3, 10)  # half a turn has shown the error of the gain
    assert max(angle.rate_dps for angle in angles) > 400
    assert np.abs(off[late]).max() < 1.5
    assert angles[-1].zero_dps == pytest.approx(3.0, abs=4 * angles[-1].zero_u_dps)
    assert angles[-1].zero_u_dps < 0.1


def test_nothing_is_known_of_the_angle_after_a_long_gap_until_gravity_is_seen():
    time_s, accel, gyro = Turning(turn_deg=0.0).drawn(14)
    kept = (time_s < 3) | (time_s > 7)
    accel[time_s < 8] *= np.where(time_s[time_s < 8] > 7, 0.0, 1.0)[:, None]
    angles = told(AngleSmoother(sensing(Turning()), lag_s=0.0), (time_s[kept], accel[kept], gyro[kept]))
    assert min(angle.u_deg for angle in angles if 7.1 < angle.time_s < 7.9) > 80
    assert angles[-1].u_deg < 1
    assert abs(angles[-1].angle_deg - 20) < 1


@pytest.mark.parametrize("turn_deg", [1500.0, -1500.0])
def test_turns_through_180_degrees_have_no_jump(turn_deg):
    turning = Turning(turn_deg=turn_deg, end_s=24.0, seconds=26.0, zero_dps=-1.0, scale=0.99)
    angles = told(AngleSmoother(sensing(turning), lag_s=0.25), turning.drawn(4))
    shown = np.array([angle.angle_deg for angle in angles])
    assert np.abs(np.diff(shown)).max() > 300, "the scale does wrap"
    assert np.abs(shown).max() <= 180
    assert np.abs(errors(turning, angles)[during(angles, 3, 26)]).max() < 0.5


def test_a_part_that_turns_already_is_found_within_its_u():
    for seed in range(3):
        turning = Turning(begin_s=-4.0, end_s=8.0, turn_deg=300.0, zero_dps=2.0, scale=1.01, shake_mg=10.0)
        angles = told(AngleSmoother(sensing(turning), lag_s=0.25), turning.drawn(seed))
        assert np.abs(z_of(turning, angles)).max() < 4.5
        assert np.abs(errors(turning, angles)[during(angles, 3, 9)]).max() < 0.6


def test_lost_samples_and_gaps_are_said_and_u_holds_what_was_not_seen():
    for seed, (from_s, to_s) in itertools.product(range(2), [(4.8, 4.9), (4.6, 5.2), (3.9, 6.3)]):
        samples = SHAKEN.drawn(seed)
        kept = (samples[0] < from_s) | (samples[0] > to_s)
        angles = told(AngleSmoother(sensing(SHAKEN), lag_s=0.0), tuple(column[kept] for column in samples))
        after = during(angles, to_s, to_s + 0.2)
        assert all("gap" in a.notes for a, now in zip(angles, after, strict=True) if now)
        assert not any(a.notes for a in angles if a.time_s < from_s)
        assert angles[-1].notes == ()
        assert np.abs(z_of(SHAKEN, angles)[after]).max() < 4.5
        before_u = max(a.u_deg for a in angles if 3 < a.time_s < from_s)
        assert max(a.u_deg for a in angles if to_s < a.time_s < to_s + 0.2) > before_u


def test_a_single_lost_sample_costs_next_to_nothing():
    samples = SHAKEN.drawn(5)
    kept = np.ones(len(samples[0]), bool)
    kept[500] = False
    ways = [
        told(AngleSmoother(sensing(SHAKEN), lag_s=0.0), tuple(column[which] for column in samples), every=1)
        for which in (kept, np.ones_like(kept))
    ]
    u = [next(a.u_deg for a in angles if a.time_s > 5.05) for angles in ways]
    assert u[0] < 1.1 * u[1]


def test_a_gyro_at_the_end_of_its_range_is_said_and_gravity_carries_the_angle():
    for seed in range(3):
        turning = Turning(turn_deg=180.0, end_s=5.5, limit_dps=75.0, shake_mg=5.0)
        angles = told(AngleSmoother(sensing(turning, 75.0), lag_s=0.25), turning.drawn(seed))
        fast = during(angles, 4.4, 5.1)
        assert all("saturated" in a.notes for a, now in zip(angles, fast, strict=True) if now)
        rest_u = max(a.u_deg for a in angles if 3 < a.time_s < 3.7)
        assert min(a.u_deg for a, now in zip(angles, fast, strict=True) if now) > 3 * rest_u
        assert np.abs(z_of(turning, angles)[during(angles, 3, 8)]).max() < 4.5
        assert abs(errors(turning, angles)[-1]) < 0.2
        assert angles[-1].notes == ()


def test_a_turn_out_of_the_plane_is_said_and_one_in_it_is_not():
    turning = Turning(turn_deg=0.0)
    time_s, accel, gyro = turning.drawn(8)
    tilt = np.radians(np.interp(time_s, [5, 6], [0, 30]))
    accel[:, 2] += 1000 * np.sin(tilt)
    accel[:, :2] *= np.cos(tilt)[:, None]
    gyro[(time_s > 5) & (time_s < 6), 1] += 30.0
    angles = told(AngleSmoother(sensing(turning), lag_s=0.25), (time_s, accel, gyro))
    assert all("out_of_plane" in angle.notes for angle in angles if 5.7 < angle.time_s < 6)
    assert angles[-1].notes == ()
    plain = Turning(turn_deg=180.0)
    assert not any(a.notes for a in told(AngleSmoother(sensing(plain)), plain.drawn(8)))


def test_hours_of_running_neither_drift_nor_grow():
    hours = Turning(rate_hz=2.0, seconds=2 * 3600.0, begin_s=1e6, end_s=1e6 + 1, turn_deg=0.0)
    time_s, accel, gyro = hours.drawn(9)
    rng = np.random.default_rng(9)
    gyro[:, 2] += 1.0 + np.cumsum(rng.normal(0, 0.003 * np.sqrt(0.5), len(time_s)))
    smoother = AngleSmoother(sensing(hours), lag_s=1.0)
    angles = told(smoother, (time_s, accel, gyro), every=200)
    z = z_of(hours, angles)
    late = during(angles, 3600, 2 * 3600)
    assert rms(z[late]) < 1.4
    u = [angle.u_deg for angle in angles]
    assert u[-1] == pytest.approx(u[len(u) // 2], rel=0.5)
    assert len(smoother._seen) < 100


def test_a_rest_teaches_nothing_about_the_distance_from_the_axis():
    resting = Turning(rate_hz=819.2, turn_deg=0.0, seconds=12.0)
    smoother = AngleSmoother(sensing(resting))
    told(smoother, resting.drawn(13), every=82)
    u_mm = np.sqrt(np.diag(smoother._state.covariance)[[LEVER_X, LEVER_Y]])
    assert u_mm == pytest.approx([LEVER_MM] * 2, rel=0.1)


@dataclass(frozen=True)
class Other:
    """The calibration of another part."""

    zero_dps: float

    def correct(self, rate_dps, force_g, temperature_c):
        return rate_dps - np.array([0.0, 0.0, self.zero_dps])


def test_another_parts_gyro_calibration_is_found_out():
    stated = {"gyro_bias_z": 0.01, "gyro_scale_z": 0.001}
    for zero_dps, doubted in ((-0.95, True), (0.7, False)):  # 0.2 °/s from start to start
        turning = Turning(zero_dps=0.0, seconds=12.0, begin_s=8.0, end_s=10.0, shake_mg=20.0)
        knowledge = GyroKnowledge.of(Other(zero_dps), stated)
        angles = told(AngleSmoother(sensing(turning), knowledge, lag_s=0.25), turning.drawn(10))
        assert ("gyro_calibration" in angles[-1].notes) is doubted
        assert np.abs(z_of(turning, angles)[during(angles, 6, 12)]).max() < 4.5
        if doubted:  # the turn is then known as without a calibration
            plain = told(AngleSmoother(sensing(turning), lag_s=0.25), turning.drawn(10))
            turned = during(angles, 8.5, 9.5)
            u = [
                np.mean([a.u_deg for a, m in zip(found, turned, strict=True) if m])
                for found in (angles, plain)
            ]
            assert u[0] == pytest.approx(u[1], rel=0.2)


def test_a_calibration_of_the_gyro_makes_u_smaller():
    turning = Turning(zero_dps=0.5, turn_deg=300.0, shake_mg=100.0, shake_hz=3.0)
    across = {"g_sensitivity_zx": 0.002, "g_sensitivity_zy": 0.002}
    known = GyroKnowledge.of(Other(0.5), {"gyro_bias_z": 0.01, "gyro_scale_z": 0.001} | across)
    u = []
    for knowledge in (None, known):
        angles = told(AngleSmoother(sensing(turning), knowledge, lag_s=0.25, bend=1e-3), turning.drawn(11))
        u.append(np.mean([a.u_deg for a, m in zip(angles, during(angles, 5, 6), strict=True) if m]))
    assert u[1] < 0.8 * u[0]


def test_readings_without_gravity_leave_the_angle_to_the_gyro():
    turning = Turning(turn_deg=40.0)
    time_s, accel, gyro = turning.drawn(12)
    accel[(time_s > 4.5) & (time_s < 5.0)] = 0.0
    angles = told(AngleSmoother(sensing(turning), lag_s=0.0), (time_s, accel, gyro))
    assert np.abs(z_of(turning, angles)[during(angles, 3, 7)]).max() < 5
    assert np.isfinite([angle.angle_deg for angle in angles]).all()


@pytest.mark.parametrize("lag_s", [-0.1, 11.0, float("nan")])
def test_a_lag_that_is_none_is_refused(lag_s):
    with pytest.raises(UsageError, match="take 0 to 10"):
        AngleSmoother(Sensing(0.01, 1.0, 0.5), lag_s=lag_s)
