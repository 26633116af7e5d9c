import math
from itertools import pairwise

import numpy as np
import pytest

from adis_gonio.base.errors import DataError
from adis_gonio.record.segmentation import segment_with_notes
from adis_gonio.record.stillness import limits_from_noise

RATE = 100.0


def dwells_of(t, accel, gyro=None):
    return segment_with_notes(t, accel, gyro)[0]


def recording(rng, rests_s, move_s=1.0, noise=2.0, quantum=0.0):
    """Accelerations in mg that rest and turn by a radian in between; also (start, stop) of each rest."""
    knots_t, knots_a, spans = [0.0], [0.0], []
    for k, rest in enumerate(rests_s):
        start = knots_t[-1]
        knots_t += [start + rest, start + rest + move_s]
        knots_a += [float(k), float(k + 1)]
        spans.append((start, start + rest))
    t = np.arange(0, knots_t[-1], 1 / RATE)
    angle = np.interp(t, knots_t, knots_a)
    accel = 1000 * np.stack([np.cos(angle), np.sin(angle), 0.1 + 0 * angle], axis=1)
    accel += rng.normal(0, noise, accel.shape)
    if quantum:
        accel = quantum * np.round(accel / quantum)
    gyro = np.gradient(angle, t)[:, None] * [0.0, 0.0, 1.0] + rng.normal(0, 1e-3, (len(t), 3))
    return t, accel, gyro, spans


@pytest.mark.parametrize("with_gyro", [False, True])
@pytest.mark.parametrize("quantum", [0.0, 0.4672, 20.0])
def test_every_rest_is_found_and_no_motion_is_in_it(with_gyro, quantum):
    rng = np.random.default_rng(1)
    t, accel, gyro, spans = recording(rng, [5, 3, 8, 2.5, 4, 6], quantum=quantum)
    found = dwells_of(t, accel, gyro if with_gyro else None)
    assert len(found) == len(spans)
    for rows, (start, stop) in zip(found, spans, strict=True):
        assert start - 1e-9 <= t[rows.start]
        assert t[rows.stop - 1] <= stop
        # Trimmed at both ends, but most of the rest is kept.
        assert t[rows.stop - 1] - t[rows.start] > stop - start - 1.1


def test_rests_that_are_too_short_are_left_out():
    t, accel, _, _ = recording(np.random.default_rng(2), [5, 0.9, 5])
    assert len(dwells_of(t, accel)) == 2


def test_the_limit_follows_the_sensors_own_noise():
    for noise in (0.05, 2.0, 20.0):
        rng = np.random.default_rng(3)
        t, accel, _, _ = recording(rng, [6, 6, 6], noise=noise)
        assert len(dwells_of(t, accel)) == 3
        _, notes = segment_with_notes(t, accel)
        assert f"{noise:.1g}"[:3] in notes[0] or any(f"{noise * f:.3g}"[:2] in notes[0] for f in (0.99, 1))


def test_a_stuck_stretch_is_left_out_and_named():
    rng = np.random.default_rng(4)
    t, accel, _, _ = recording(rng, [10, 10, 10], quantum=0.4672)
    accel[1300:1900] = accel[1300]
    found, notes = segment_with_notes(t, accel)
    assert not any(rows.start < 1850 and rows.stop > 1350 for rows in found)
    assert any("stuck" in note and "12.99 s to 19 s" in note for note in notes)


def test_one_stuck_axis_is_enough_to_be_left_out():
    rng = np.random.default_rng(4)
    t, accel, _, _ = recording(rng, [10, 10, 10], quantum=0.4672)
    accel[1300:1900, 1] = accel[1300, 1]
    found, _ = segment_with_notes(t, accel)
    assert not any(rows.start < 1850 and rows.stop > 1350 for rows in found)


def test_a_quiet_sensor_behind_a_coarse_converter_is_not_called_stuck():
    rng = np.random.default_rng(5)
    t, accel, _, _ = recording(rng, [6, 6, 6], noise=0.5, quantum=10.0)
    found, notes = segment_with_notes(t, accel)
    assert len(found) == 3
    assert not any("stuck" in note for note in notes)


def test_data_that_never_change_are_refused():
    t = np.arange(1000) / RATE
    with pytest.raises(DataError, match="stuck"):
        dwells_of(t, np.full((1000, 3), 7.0))
    with pytest.raises(DataError, match="all-zero"):
        dwells_of(t, np.zeros((1000, 3)))


def test_a_slip_within_a_rest_splits_it():
    rng = np.random.default_rng(6)
    t, accel, _, _ = recording(rng, [10, 10], noise=1.0)
    for length_s in (0.02, 0.8):  # the slower one moves the mean of a window, but not its deviation
        slipped = accel.copy()
        slipped[:, 1] += np.interp(t, [0, 4.5, 4.5 + length_s, 10], [0, 0, 12.0, 12.0])
        found = dwells_of(t, slipped)
        assert len([rows for rows in found if t[rows.start] < 10]) == 2


@pytest.mark.parametrize(("noise", "move_s"), [(2.0, 45), (2.0, 20), (5.0, 25), (5.0, 15), (5.0, 10)])
def test_a_slow_turn_is_no_rest(noise, move_s):
    rng = np.random.default_rng(8)
    t, accel, _, spans = recording(rng, [8, 8, 8], move_s, noise)
    found = [(t[rows.start], t[rows.stop - 1]) for rows in dwells_of(t, accel)]
    assert len(found) == len(spans)
    for (begin, end), (start, stop) in zip(found, spans, strict=True):
        assert start - 0.25 < begin < start + 1
        assert stop - 1 < end < stop + 0.25


def test_dwells_share_no_rows_at_a_sample_a_second():
    rng = np.random.default_rng(9)
    found = 0
    for _ in range(300):
        steps = 3.0 * rng.standard_normal((200, 2)) * (rng.random((200, 1)) < 0.02)
        accel = 1000 + np.cumsum(steps, axis=0) + rng.standard_normal((200, 2))
        dwells = dwells_of(np.arange(200.0), accel)
        found += len(dwells)
        assert all(one.stop <= other.start for one, other in pairwise(dwells))
    assert found > 300


def test_a_gyro_shows_a_turn_that_gravity_does_not():
    rng = np.random.default_rng(7)
    t = np.arange(3000) / RATE
    accel = np.array([0.0, 0.0, -1000.0]) + rng.normal(0, 2, (3000, 3))
    rate = 0.5 * ((t > 12) & (t < 15)) * np.sin(8 * t)
    gyro = np.stack([0 * t, 0 * t, rate], axis=1) + rng.normal(0, 1e-3, (3000, 3))
    assert len(dwells_of(t, accel)) == 1
    assert len(dwells_of(t, accel, gyro)) == 2


def test_too_little_is_no_recording():
    assert dwells_of(np.arange(5) / RATE, np.ones((5, 3)) + np.arange(5)[:, None]) == []


def test_limits_bracket_living_noise():
    limits = limits_from_noise(np.array([2.0, 0.1]), 100, np.array([0.4672, 0.4672]))
    assert limits.window_samples == 100
    assert limits.lower[0] > 0
    assert limits.lower[1] == 0
    assert limits.upper[1] >= 2 * 0.4672 / math.sqrt(12)
