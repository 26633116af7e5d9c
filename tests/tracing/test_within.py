"""The second pass on samples whose truth is known: false alarms, detection, intervals, many seeds each."""

from __future__ import annotations

import numpy as np
import pytest

from adis_gonio.tracing.within.faults import spikes
from adis_gonio.tracing.within.samples import WithinFinding, scatter
from adis_gonio.tracing.within.second_pass import (
    correlation_reach,
    look_within,
)
from adis_gonio.tracing.within.tones import density_of
from tracing.dwell_samples import bartlett, draw, kinds, only

SEEDS = 12


def covered(finding: WithinFinding, name: str, truth: float) -> bool:
    value = finding.parameters[name]
    assert value.u is not None
    return abs(value.value - truth) <= 1.96 * value.u


QUIET = {
    "the chip's usual filter": {},
    "no filter": {"filter_m": 0},
    "the longest filter, noise below a step": {"filter_m": 6, "n": 800},
    "1/f noise": {"flicker_mg2": 0.05},
    "mostly 1/f noise": {"flicker_mg2": 1.0, "filter_m": 0, "noise_mg": 1.0},
    "dwells of ten samples": {"n": 10, "filter_m": 0},
    "dwells shorter than the filter": {"n": 40, "filter_m": 6},
    "four long dwells": {"dwells": 4, "n": 2500},
    "two dwells": {"dwells": 2, "n": 1500},
    "dwells of different lengths": {"n": [60 + 37 * (7 * k % 24) for k in range(24)]},
    "noise far below a step": {"noise_mg": 0.15, "filter_m": 0},
    "noise of half a step": {"noise_mg": 0.3, "filter_m": 0},
    "numbers with many digits": {"lsb_mg": 0.0},
    "three axes": {"axes": 3},
    "uneven times": {"jitter": 0.5},
}


def test_a_session_without_anything_shows_nothing_but_the_coarse_steps_of_quiet_axes():
    """Family-wise 1 %, 0.2 % measured (scripts/within_statistics.py): of 45 sessions none shows more."""
    shown = []
    for seed in range(3):
        for k, (name, case) in enumerate(QUIET.items()):
            found = kinds(draw(np.random.default_rng([seed, k]), **case))
            if found != ["coarse"] * (name == "noise far below a step"):
                shown.append((name, seed, found))
    assert not shown


def test_tone_is_found_with_frequency_and_amplitude():
    """1 mg on x, 0.5 mg on y at 11.3 Hz: found in all, intervals hold."""
    truth = {"tone_x": 1.0, "tone_y": 0.5, "frequency": 11.3}
    held = dict.fromkeys(truth, 0)
    for seed in range(SEEDS):

        def line(k, time, rng):
            wave = np.sin(2 * np.pi * 11.3 * time + 0.3)
            return np.column_stack([wave, 0.5 * wave])

        found = [
            f for f in look_within(draw(np.random.default_rng(seed), added=line))[0] if f.kind == "tone"
        ]
        assert len(found) == 1
        assert found[0].axes == ("x", "y")
        assert len(found[0].positions) == 24
        for name, value in truth.items():
            held[name] += covered(found[0], name, value)
    # Of 12: fewer than 11 in one of eight at 95 % (these seeds are not), in 72 % at 80 %; fewer than 10 in
    # 2 % and 44 %.
    assert min(held.values()) >= 11, held


def test_a_tone_of_seven_cycles_a_dwell_is_no_rise_of_the_noise_towards_low_frequencies():
    """The noise of a long filter has its foot there, and 1/f noise would explain a line as well."""

    def humming(k, time, rng):
        line = np.sin(2 * np.pi * 7 / 1.7 * time + rng.uniform(0, 2 * np.pi))
        return np.column_stack([line, 0 * line])

    seen = 0
    for seed in range(6):
        samples = draw(
            np.random.default_rng([seed, 7]), n=170, filter_m=5, noise_mg=10.0, added=humming, dwells=18
        )
        tone = only(samples, "tone")
        seen += tone is not None and abs(tone.parameters["frequency"].value - 7 / 1.7) < 0.1
    assert seen == 6


def test_white_noise_spectra_are_as_rough_as_so_many_dwells_are():
    """Else lines are judged as if there were fewer dwells."""
    shares = []
    for seed in range(8):
        density = density_of(draw(np.random.default_rng([seed, 8]), n=150, filter_m=0, dwells=20))
        assert density is not None
        shares += (density.effective / 20).tolist()
    assert np.mean(shares) > 0.85
    assert max(shares) == 1.0


@pytest.mark.parametrize("flicker_mg2", [0.0, 0.05])
def test_settling_is_found_with_amplitude_and_time_constant(flicker_mg2):
    held = {"settling_x": 0, "tau": 0}
    for seed in range(SEEDS):

        def course(k, time, rng):
            fall = np.exp(-(time - time[0]) / 0.6)
            return np.column_stack([3.0 * fall, 0 * fall])

        samples = draw(np.random.default_rng(seed), added=course, flicker_mg2=flicker_mg2)
        found = look_within(samples)[0]
        assert [f.kind for f in found] == ["settling"]
        assert found[0].axes == ("x",)
        assert found[0].effect == "settling"
        assert "wait" in found[0].advice
        held["settling_x"] += covered(found[0], "settling_x", 3.0)
        held["tau"] += covered(found[0], "tau", 0.6)
    assert min(held.values()) >= 10, held


def test_common_drift_is_a_slope_and_not_settling():
    held = 0
    for seed in range(SEEDS):

        def slope(k, time, rng):
            return np.column_stack([0.2 * time, 0 * time])

        found = look_within(draw(np.random.default_rng(seed), added=slope))[0]
        assert [f.kind for f in found] == ["drift"]
        assert found[0].effect is None
        held += covered(found[0], "drift_x", 0.2)
    assert held >= 11


def test_step_in_one_dwell_is_found_where_and_when_it_was():
    held = near = 0
    for seed in range(SEEDS):

        def jump(k, time, rng):
            return np.column_stack([0 * time, (k == 7) * 4.0 * (time >= time[0] + 3.0)])

        samples = draw(np.random.default_rng(seed), added=jump)
        found = look_within(samples)[0]
        assert [f.kind for f in found] == ["step"]
        (place,) = found[0].places
        assert (place.position, place.axis) == (7, "y")
        near += abs(place.time_s - samples.time_s[7][0] - 3.0) < 0.1
        held += covered(found[0], "height_y", 4.0)
        assert place.shift_mg == pytest.approx(4.0 * 0.4, abs=0.8)
        assert "repeat position 7" in found[0].advice
    assert near >= 11
    assert held >= 11


def test_noise_that_joins_is_found_with_its_size_and_moment():
    held = {"extra_x": 0, "start": 0}
    gain = float(np.sqrt((bartlett(2) ** 2).sum()))
    for seed in range(SEEDS):
        start = 60.0 + 3.7 * seed

        def joining(k, time, rng, start=start):
            white = rng.normal(0, 4.0, (len(time) + 6, 1))
            own = np.convolve(white[:, 0], bartlett(2), "valid") * (time >= start)
            return np.column_stack([own, 0 * own])

        found = list(look_within(draw(np.random.default_rng(seed), added=joining))[0])
        assert [f.kind for f in found] == ["noise_change"]
        assert found[0].effect == "noise_change"
        assert found[0].axes == ("x",)
        held["extra_x"] += covered(found[0], "extra_x", 4.0 * gain)
        held["start"] += covered(found[0], "start", start)
    assert min(held.values()) >= 11, held


def test_white_noise_that_joins_behind_a_long_filter_shows_where_the_filter_stops():
    """0.9 mg of 2.5 mg hardly changes the variance, which a few low frequencies hold."""
    found, held = 0, 0
    for seed in range(SEEDS):

        def joining(k, time, rng):
            return rng.normal(0, 0.9, (len(time), 1)) * (k >= 14) * np.array([1.0, 0.0])

        samples = draw(np.random.default_rng([seed, 5]), n=300, filter_m=4, noise_mg=16.0, added=joining)
        change = only(samples, "noise_change")
        if change is not None and change.effect == "noise_change" and change.axes == ("x",):
            found += 1
            held += covered(change, "extra_x", 0.9)
            assert change.positions == tuple(range(14, 24))
    assert found >= 11
    assert held >= found - 2


def test_short_dwells_behind_a_long_filter_have_no_spikes():
    """Such a dwell is hardly longer than its noise is correlated: by itself it scatters too little."""
    shown = 0
    for seed in range(40):
        samples = draw(np.random.default_rng([seed, 6]), n=72, filter_m=6, noise_mg=8.0, dwells=30)
        shown += spikes(samples, scatter(samples), correlation_reach(samples))[0] is not None
    assert shown <= 3
