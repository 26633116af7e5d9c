"""A spectral line that moves is one finding with its course, and no other session has one."""

from __future__ import annotations

import numpy as np
import pytest

from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.record.loading import load_session
from adis_gonio.tracing.within.samples import Samples, samples_of
from adis_gonio.tracing.within.second_pass import look_within
from adis_gonio.tracing.within.tones import moving_lines
from recordings import recording
from tracing.dwell_samples import Added, draw

SPACING_S = 8.0
"""Time from the beginning of one dwell to the next one: 500 samples of 0.01 s, and a move of 3 s."""


def warming(start_hz: float, change_hz: float, tau_s: float, amplitude_mg: float) -> tuple[Added, object]:
    """A line on x, a third of it on y; its frequency approaches the end like 1 − e^(−t/τ)."""

    def phase(time_s):
        return start_hz * time_s + change_hz * (time_s + tau_s * np.expm1(-time_s / tau_s))

    def frequency(time_s):
        return start_hz - change_hz * np.expm1(-time_s / tau_s)

    def added(dwell, time_s, rng):
        wave = amplitude_mg * np.sin(2 * np.pi * phase(time_s) + 1.0)
        return np.stack([wave, wave / 3], axis=1)

    return added, frequency


def of_kind(samples: Samples, kind: str):
    return [finding for finding in look_within(samples)[0] if finding.kind == kind]


def test_a_line_that_moves_is_one_finding_with_its_first_and_last_frequency():
    added, frequency = warming(11.0, 3.0, 90.0, 4.0)
    samples = draw(np.random.default_rng(1), added=added)
    (finding,) = look_within(samples)[0]
    middles = [float(time.mean()) for time in samples.time_s]
    for name, at in (("frequency_first", middles[0]), ("frequency_last", middles[-1])):
        value = finding.parameters[name]
        assert abs(value.value - frequency(at)) < 4 * value.u
        assert value.u < 0.02
    assert finding.positions == tuple(range(24))
    for axis, amplitude in (("x", 4.0), ("y", 4.0 / 3)):
        value = finding.parameters[f"tone_{axis}"]
        assert abs(value.value - amplitude) < 4 * value.u + 0.05 * amplitude


def test_frequencies_of_the_dwells_are_covered_by_their_uncertainties():
    inside = []
    for seed in range(12):
        rng = np.random.default_rng([2, seed])
        added, frequency = warming(rng.uniform(8, 14), rng.choice([-1, 1]) * rng.uniform(1, 3), 90.0, 5.0)
        samples = draw(rng, filter_m=0, added=added)
        (line, *_) = moving_lines(samples)[0]
        middle = np.array([samples.time_s[k].mean() for k in line.dwells])
        inside += (np.abs(line.frequency_hz - frequency(middle)) < 1.96 * line.u_hz).tolist()
    assert len(inside) > 250
    # 95 % with the scatter of so many draws; a chirp of the wrong sign or half the size fails it.
    assert 0.92 <= np.mean(inside) <= 0.98


def test_what_is_left_holds_no_more_of_the_line_than_noise_does():
    added, _ = warming(11.0, 3.0, 90.0, 8.0)
    with_line, without = (draw(np.random.default_rng(3), filter_m=0, added=one) for one in (added, None))
    left = moving_lines(with_line)[1]
    powers = [np.mean([np.var(rows, axis=0) for rows in one.values], axis=0) for one in (left, without)]
    assert powers[0] == pytest.approx(powers[1], rel=0.02)


def test_a_line_of_constant_frequency_is_not_called_moving():
    def added(dwell, time_s, rng):
        wave = 6.0 * np.sin(2 * np.pi * 13.3 * time_s + rng.uniform(0, 6))
        return np.stack([wave, wave], axis=1)

    samples = draw(np.random.default_rng(4), added=added)
    (finding,) = look_within(samples)[0]
    assert finding.parameters["frequency"].value == pytest.approx(13.3, abs=0.01)


@pytest.mark.parametrize("filter_m", [0, 2, 5])
def test_no_line_moves_in_noise(filter_m):
    found = 0
    for seed in range(40):
        rng = np.random.default_rng([5, filter_m, seed])
        samples = draw(
            rng, filter_m=filter_m, flicker_mg2=rng.choice([0.0, 0.3, 3.0]), n=int(rng.integers(100, 900))
        )
        found += len(moving_lines(samples)[0])
    assert found == 0


def test_the_line_of_a_measured_sensor_moves_through_the_session():
    """By periodograms of four seconds each (numpy): 7.0 to 8.7 Hz."""
    session = load_session(recording("mimu4444/exp6_imu4"))
    samples = samples_of(session, readings_of(session))
    moving = [one for one in of_kind(samples, "tone") if "frequency_first" in one.parameters]
    (finding,) = moving
    assert finding.parameters["frequency_first"].value == pytest.approx(7.08, abs=0.01)
    assert finding.parameters["frequency_last"].value == pytest.approx(8.69, abs=0.02)
    assert finding.parameters["tone_x"].value == pytest.approx(15.7, abs=0.8)
    assert of_kind(samples, "noise_change") == of_kind(samples, "step") == []
