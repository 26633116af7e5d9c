from __future__ import annotations

import numpy as np
import pytest

from adis_gonio.base.errors import SessionError
from adis_gonio.device.sensor.settings import Configuration, white_noise_gain
from adis_gonio.record.stillness import NoiseMeter, StillnessLimits, StillnessWatch, window_samples

WINDOW = 200
LIMITS = StillnessLimits(WINDOW, np.full(3, 0.5), np.full(3, 6.0))
NOISE = np.full(3, 2.0)


def samples(seed: int, count: int, sigma: float = 2.0) -> np.ndarray:
    return np.array([1000.0, 0.0, 0.0]) + sigma * np.random.default_rng(seed).standard_normal((count, 3))


def test_window_spans_a_quarter_second_or_eight_settling_times():
    def configuration(smpl_prd: int, m: int) -> Configuration:
        return Configuration(smpl_prd, m, 300, False, False, False)

    assert window_samples(configuration(1, 0)) == 205
    assert window_samples(configuration(1, 6)) == 8 * 127
    assert window_samples(configuration(0xFF, 0)) == 32


def test_white_noise_gain_is_the_filters_table():
    table = [1.000, 0.612, 0.415, 0.290, 0.204, 0.144, 0.102]
    assert [white_noise_gain(m) for m in range(7)] == pytest.approx(table, rel=0.01)


def test_noise_is_measured_at_rest_whatever_the_block_length():
    rest = samples(1, 4000)
    for length in (37, 100, 4000):
        meter = NoiseMeter(WINDOW, 2.0)
        found = [meter.feed(part) for part in np.array_split(rest, len(rest) // length)]
        noise = next(value for value in found if value is not None)
        assert noise == pytest.approx([2.0] * 3, rel=0.1)


def test_noise_is_not_taken_from_motion():
    meter = NoiseMeter(WINDOW, 2.0)
    swing = samples(2, 6000) + 30 * np.sin(np.arange(6000) / 400.0)[:, None]
    assert all(meter.feed(part) is None for part in np.array_split(swing, 60))
    assert all(meter.feed(part) is None for part in np.array_split(samples(3, 6000, 40.0), 60))
    later = [meter.feed(part) for part in np.array_split(samples(4, 3000), 30)]
    assert later[-1] == pytest.approx([2.0] * 3, rel=0.1)


@pytest.mark.parametrize(("times", "known"), [(9.5, True), (10.5, False)])
def test_noise_is_measured_up_to_ten_times_that_of_the_data_sheet(times, known):
    parts = np.array_split(samples(3, 30 * WINDOW, times * 2.0), 30)
    meter = NoiseMeter(WINDOW, 2.0)
    assert any(noise is not None for noise in map(meter.feed, parts)) is known


def test_a_stuck_axis_is_no_quiet_axis():
    meter = NoiseMeter(WINDOW, 2.0)
    data = samples(5, 3000)
    data[:, 1] = 3.7
    parts = np.array_split(data, 30)
    with pytest.raises(SessionError, match=r"accelerometer y is stuck at 3\.7 mg"):
        [meter.feed(part) for part in parts]


def test_rest_is_still_in_every_window():
    watch = StillnessWatch(LIMITS, NOISE)
    looks = [look for part in np.array_split(samples(6, 20_000), 77) for look in watch.feed(part)]
    assert len(looks) == 20_000 // (WINDOW // 2) - 1
    assert {look.state for look in looks} == {"still"}
    assert [look.end for look in looks[:3]] == [200, 300, 400]


@pytest.mark.parametrize("at", [1000, 1090, 1100, 1111, 1199])
def test_a_short_knock_is_seen_wherever_it_falls(at):
    data = samples(7, 3000)
    data[at : at + 8, 0] += 60.0
    looks = StillnessWatch(LIMITS, NOISE).feed(data)
    moving = [look for look in looks if look.state == "moving"]
    assert moving
    assert all(look.end - WINDOW <= at + 8 and look.end >= at for look in moving)
    assert "x varies by" in moving[0].why


def test_a_slow_shift_since_the_dwell_began_is_motion_and_a_drift_of_the_bias_is_not():
    def states(total_mg: float, anchored: bool) -> set[str]:
        watch = StillnessWatch(LIMITS, NOISE)
        if anchored:
            watch.anchor(500)
        data = samples(8, 40_000)
        data[:, 2] += np.linspace(0, total_mg, 40_000)
        return {look.state for look in watch.feed(data)}

    assert states(10.0, anchored=True) == {"still", "moving"}
    assert states(10.0, anchored=False) == {"still"}
    assert states(3.0, anchored=True) == {"still"}


def test_a_dwell_begins_only_far_below_the_limit_that_breaks_it_off():
    data = samples(10, 2000, 4.0)
    assert {look.state for look in StillnessWatch(LIMITS, NOISE).feed(data)} == {"moving"}
    watch = StillnessWatch(LIMITS, NOISE)
    watch.anchor(0)
    assert {look.state for look in watch.feed(data)} == {"still"}


def test_a_flat_axis_is_stuck_only_when_it_stays_flat():
    data = samples(9, 2000)
    data[600:820, 1] = 0.0
    assert "stuck" not in {look.state for look in StillnessWatch(LIMITS, NOISE).feed(data)}
    data[600:, 1] = 0.0
    looks = StillnessWatch(LIMITS, NOISE).feed(data)
    assert looks[-1].state == "stuck"
    assert "accelerometer y is stuck" in looks[-1].why
