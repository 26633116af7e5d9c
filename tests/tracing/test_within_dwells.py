"""The second pass on one session of each kind whose truth is known; rates over seeds: test_within.py."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from adis_gonio.tracing.within.courses import LEAST_DWELLS, Course
from adis_gonio.tracing.within.faults import LEAST_LOUD, Levels
from adis_gonio.tracing.within.samples import (
    WithinFinding,
    axes_and_positions,
    corrected,
    positions_text,
)
from adis_gonio.tracing.within.second_pass import counts_as_found, look_within, probability
from adis_gonio.tracing.within.tones import (
    HIGHEST_HZ,
    alias_text,
    aliases_hz,
    density_of,
    line_sizes,
    strongest_frequency,
)
from tracing.dwell_samples import bartlett, draw, kinds, only
from tracing.stated import EFFECTS, SORTS, finder


def _tone(k, time, rng):
    wave = np.sin(2 * np.pi * 11.3 * time + 0.3)
    return np.column_stack([wave, 0.5 * wave])


def _settling(k, time, rng):
    fall = np.exp(-(time - time[0]) / 0.6)
    return np.column_stack([3.0 * fall, 0 * fall])


def _drift(k, time, rng):
    return np.column_stack([0 * time, -0.2 * time])


def _step(k, time, rng):
    return np.column_stack([0 * time, (k == 7) * 4.0 * (time >= time[0] + 3.0)])


def _creep(k, time, rng):
    return np.column_stack([(k == 5) * 1.5 * time, 0 * time])


def _touch(k, time, rng):
    return np.column_stack([(k == 3) * 20.0 * np.exp(-(time - time[0]) / 0.5), 0 * time])


def _joining(k, time, rng):
    white = rng.normal(0, 4.0, len(time) + 6)
    own = np.convolve(white, bartlett(2), "valid") * (time >= 90.0)
    return np.column_stack([own, 0 * own])


GAIN = float(np.sqrt((bartlett(2) ** 2).sum()))
"""Part of white noise that the filter of the sessions lets through."""
EVERY = tuple(range(24))
KINDS = {
    "tone": (_tone, "tone", ("x", "y"), EVERY, {"tone_x": 1.0, "tone_y": 0.5, "frequency": 11.3}),
    "settling": (_settling, "settling", ("x",), EVERY, {"settling_x": 3.0, "tau": 0.6}),
    "drift": (_drift, None, ("y",), EVERY, {"drift_y": -0.2}),
    "step": (_step, None, ("y",), (7,), {"height_y": 4.0}),
    "drift of one": (_creep, None, ("x",), (5,), {"slope_x": 1.5}),
    "settling of one": (_touch, None, ("x",), (3,), {"settling_x": 20.0}),
    "noise_change": (
        *(_joining, "noise_change", ("x",), tuple(range(11, 24))),
        {"extra_x": 4.0 * GAIN, "start": 90.0},
    ),
}


@pytest.mark.parametrize("name", KINDS)
def test_what_was_added_is_the_only_finding_with_its_size_and_place(name: str) -> None:
    added, effect, axes, positions, truth = KINDS[name]
    (finding,) = look_within(draw(np.random.default_rng(1), added=added))[0]
    assert (finding.kind, finding.effect, finding.axes) == (name.split(" ")[0], effect, axes)
    assert finding.positions == positions
    assert finding.p_value < 1e-3
    for parameter, value in truth.items():
        estimate = finding.parameters[parameter]
        assert estimate.u is not None
        assert estimate.u > 0
        assert abs(estimate.value - value) < 3.5 * estimate.u
    assert set(finding.parameters) == set(truth)


def test_the_advice_on_settling_is_to_wait_until_it_moves_a_mean_by_a_third_of_its_noise() -> None:
    samples = draw(np.random.default_rng(1), added=_settling)
    (finding,) = look_within(samples)[0]
    amplitude, tau = (finding.parameters[name].value for name in ("settling_x", "tau"))
    # Over 5 s the mean of A e^(-t/tau) is A tau/5; y has the least noise of a mean.
    u = min(float(np.median([rows[:, axis].std() for rows in samples.values])) for axis in (0, 1))
    wait_s = tau * math.log(amplitude * tau / 4.99 / (u / math.sqrt(500) / 3))
    assert float(finding.advice.split()[1]) == pytest.approx(wait_s, rel=0.05)
    shift = re.search(r"moves the means by up to ([0-9.]+)\s+mg", finding.sentence)
    assert shift is not None
    assert float(shift[1]) == pytest.approx(amplitude * tau / 5, rel=0.03)


def test_an_event_of_one_dwell_says_when_it_was_and_how_far_it_moved_the_mean() -> None:
    samples = draw(np.random.default_rng(1), added=_step)
    (place,) = look_within(samples)[0][0].places
    assert (place.position, place.axis) == (7, "y")
    assert place.time_s == pytest.approx(samples.time_s[7][0] + 3.0, abs=0.05)
    # The shorter part, 40 % of the dwell, is the one that moved.
    assert place.shift_mg == pytest.approx(4.0 * 0.4, abs=0.3)


@pytest.mark.parametrize(("name", "sort"), list(zip(EFFECTS, SORTS, strict=True)))
def test_twice_the_stated_amplitude_is_found_and_a_fifth_is_not(name: str, sort: str) -> None:
    found = finder(name, sort)
    assert found(2.0, 1)
    assert not found(0.2, 1)


def test_dwells_that_are_too_few_for_settling_say_so() -> None:
    shown = look_within(draw(np.random.default_rng(1), dwells=LEAST_DWELLS - 1))[1]
    assert shown["settling"].amplitude is None
    assert "4 dwells" in shown["settling"].reason
    assert shown["tone"].amplitude is not None
    enough = look_within(draw(np.random.default_rng(1), dwells=LEAST_DWELLS))[1]
    assert enough["settling"].amplitude is not None


def test_tone_at_uneven_times_and_in_some_dwells():
    def line(k, time, rng):
        wave = np.sin(2 * np.pi * 7.7 * time) * (k in (3, 4, 9))
        return np.column_stack([2.5 * wave, 0 * wave])

    finding = only(draw(np.random.default_rng(5), added=line, jitter=0.3), "tone")
    assert finding is not None
    assert finding.positions == (3, 4, 9)
    assert finding.parameters["frequency"].value == pytest.approx(7.7, abs=0.06)


def test_settling_in_proportion_to_the_move_is_told_from_a_common_one():
    rng = np.random.default_rng(8)
    samples = draw(rng)
    change = np.diff(samples.reading, axis=0, prepend=samples.reading[:1]) / 1000.0
    rows = [
        own + np.exp(-(time - time[0]) / 0.5)[:, None] * (4.0 * change[k] * [1.0, 0.0])
        for k, (own, time) in enumerate(zip(samples.values, samples.time_s, strict=True))
    ]
    finding = only(samples.with_values(rows), "settling")
    assert finding is not None
    assert finding.effect is None
    value = finding.parameters["settling_per_g_x"]
    assert abs(value.value - 4.0) < 1.96 * value.u
    assert [place.position for place in finding.places] == list(EVERY)
    assert [place.value.value for place in finding.places] == pytest.approx(value.value * change[:, 0])


def test_scatter_that_varies_from_dwell_to_dwell_names_no_moment():
    levels = np.random.default_rng(3).uniform(0, 6, 24)

    def shaking(k, time, rng):
        return levels[k] * rng.normal(size=(len(time), 2))

    finding = only(draw(np.random.default_rng(4), added=shaking, filter_m=0), "noise_change")
    assert finding is not None
    assert finding.effect is None
    assert "vibration_rectification" in finding.sentence
    assert finding.parameters["largest_x"].value > 1.3 * finding.parameters["least_x"].value


def test_spikes_are_counted_and_taken_out():
    def knocks(k, time, rng):
        rows = np.zeros((len(time), 2))
        rows[100, 0] = 30.0 * (k == 2)
        rows[333, 1] = -25.0 * (k == 17)
        return rows

    found = look_within(draw(np.random.default_rng(1), added=knocks, filter_m=0))[0]
    assert [f.kind for f in found] == ["spikes"]
    assert [(p.position, p.axis) for p in found[0].places] == [(2, "x"), (17, "y")]
    assert found[0].parameters["largest"].value == pytest.approx(30.0, abs=15.0)
    assert found[0].places[0].shift_mg == pytest.approx(30.0 / 500, rel=0.6)


def test_values_that_stand_still_are_found():
    samples = draw(np.random.default_rng(2))
    rows = [own.copy() for own in samples.values]
    rows[5][200:260, 0] = rows[5][200, 0]
    finding = only(samples.with_values(rows), "stuck")
    assert finding is not None
    assert [(p.position, p.axis) for p in finding.places] == [(5, "x")]
    assert finding.parameters["longest"].value == pytest.approx(60, abs=2)
    assert finding.places[0].time_s == pytest.approx(samples.time_s[5][200], abs=0.02)


def test_values_of_one_axis_stand_still_beside_an_axis_without_noise():
    samples = draw(np.random.default_rng(2))
    rows = [own.copy() for own in samples.values]
    for own in rows:
        own[:, 0] = own[0, 0]
    rows[5][200:260, 1] = rows[5][200, 1]
    finding = only(samples.with_values(rows), "stuck")
    assert finding is not None
    assert finding.axes == ("y",)


@pytest.mark.parametrize(("noise_steps", "shown"), [(0.9, True), (0.25, False)])
def test_values_that_stand_still_are_normal_if_the_noise_is_below_the_converters_step(noise_steps, shown):
    samples = draw(np.random.default_rng(2), noise_mg=noise_steps * 0.5, lsb_mg=0.5, filter_m=0)
    rows = [own.copy() for own in samples.values]
    rows[5][200:300, 0] = rows[5][200, 0]
    assert (only(samples.with_values(rows), "stuck") is not None) is shown


def test_several_things_at_once_are_all_found():
    def everything(k, time, rng):
        elapsed = time - time[0]
        x = 1.5 * np.sin(2 * np.pi * 17.0 * time) + 3.0 * np.exp(-elapsed / 0.5)
        x = x + (k == 11) * 5.0 * (elapsed > 2.0)
        rows = np.column_stack([x, 0 * x])
        rows[50, 1] = 40.0 * (k == 20)
        return rows

    found = kinds(draw(np.random.default_rng(6), added=everything))
    assert sorted(found) == ["settling", "spikes", "step", "tone"]


def test_findings_are_documents():
    def line(k, time, rng):
        return np.column_stack([np.sin(2 * np.pi * 11.3 * time), 0 * time])

    finding = only(draw(np.random.default_rng(0), added=line), "tone")
    assert finding is not None
    text = json.loads(json.dumps(finding.as_dict()))
    assert set(text) == {
        "kind",
        "effect",
        "axes",
        "positions",
        "parameters",
        "p_value",
        "sentence",
        "places",
        "advice",
        "aliases_hz",
    }
    assert text["parameters"]["frequency"]["unit"] == "Hz"
    assert min(text["aliases_hz"]) > text["parameters"]["frequency"]["value"]


@pytest.mark.parametrize("n", [2, 3, 6, 16, 33])
def test_short_dwells_are_looked_at_as_far_as_they_go(n):
    assert kinds(draw(np.random.default_rng(n), dwells=8, n=n)) == []


@pytest.mark.parametrize("code_mg", [0.0, 467.2])
@pytest.mark.parametrize("same", [[True, False], [True, True]], ids=["one axis", "both axes"])
def test_an_axis_of_one_code_shows_nothing_but_its_coarse_steps(same, code_mg):
    samples = draw(np.random.default_rng(3), n=120, dwells=8)
    values = tuple(np.where(same, code_mg, rows) for rows in samples.values)
    assert kinds(replace(samples, values=values)) == ["coarse"]


def test_a_rugged_spectrum_counts_for_fewer_dwells():
    """An echo: ripples that are too narrow for the density to follow."""

    def echoing(k, time, rng):
        white = rng.normal(0, 20.0, (len(time) + 25, 2))
        return white[25:] + 0.7 * white[:-25]

    density = density_of(draw(np.random.default_rng(9), n=150, filter_m=0, dwells=20, added=echoing))
    assert density is not None
    assert density.effective.max() < 10


@pytest.mark.parametrize(("p_value", "called"), [(1e-4, True), (1e-3, False)])
def test_a_finding_is_called_found_from_the_probability_that_any_cause_needs(p_value, called):
    """Prior 1 in 57; evidence of p = 10⁻⁴ is some 120 to 1, of 10⁻³ some 20 to 1."""
    finding = WithinFinding(
        kind="tone",
        effect="tone",
        axes=("x",),
        positions=tuple(range(4)),
        parameters={},
        p_value=p_value,
        sentence="",
    )
    assert counts_as_found(finding) == called
    assert not counts_as_found(replace(finding, positions=(0, 1, 2), p_value=1e-9))
    assert not counts_as_found(replace(finding, effect=None, p_value=1e-9))


def test_probability_of_a_p_value_is_the_mean_of_all_alternatives():
    """∫ ξ p^(ξ−1) dξ by numbers, against 1; a p-value of one speaks for nothing being there."""
    xi = (np.arange(20000) + 0.5) / 20000
    for p_value in (1e-12, 1e-5, 0.01, 0.3, 0.999999999):
        evidence = float(np.mean(xi * p_value ** (xi - 1)))
        odds = 0.0175 / 0.9825 * evidence
        assert probability(p_value) == pytest.approx(odds / (1 + odds), rel=2e-3)
    assert probability(1.0) == pytest.approx(0.00883, rel=1e-3)
    assert probability(0.0) == pytest.approx(1.0)


@pytest.mark.parametrize("dwells", [4, 9])
def test_the_p_value_of_a_drift_is_that_of_the_t_test_of_its_slopes(dwells: int) -> None:
    samples = draw(np.random.default_rng(3), dwells=dwells, n=60, lsb_mg=0.0)
    course = Course.of(samples, np.full(dwells, True), None, False)
    slopes = [
        np.polyfit(time, rows, 1)[0] for time, rows in zip(samples.time_s, samples.values, strict=True)
    ]
    assert course.p_value == pytest.approx(stats.ttest_1samp(slopes, 0.0).pvalue, rel=1e-9)


def test_the_p_value_of_a_change_of_noise_is_that_of_the_best_t_test_times_the_places() -> None:
    dof = np.full(12, 40.0)
    level = np.random.default_rng(4).chisquare(dof) / dof * np.where(np.arange(12) < 6, 1.0, 1.4)
    logs = np.log(level)
    best = min(stats.ttest_ind(logs[:k], logs[k:]).pvalue for k in range(1, 12))
    assert Levels(level, dof, level, dof).changed() == pytest.approx(11 * best, rel=1e-9)


def test_a_change_of_noise_needs_three_dwells() -> None:
    for dwells in (LEAST_LOUD - 1, LEAST_LOUD):
        shown = look_within(draw(np.random.default_rng(1), dwells=dwells))[1]["noise_change"]
        assert (shown.amplitude is not None) == (dwells == LEAST_LOUD == 3)


def test_dwells_that_are_too_short_say_so() -> None:
    shown = look_within(draw(np.random.default_rng(1), n=4, filter_m=0))[1]
    assert set(shown) >= set(EFFECTS)
    assert all(entry.amplitude is None and entry.reason for entry in shown.values())


def test_a_line_that_moves_is_found_below_a_stronger_one_of_two_dwells() -> None:
    def both(k, time, rng):
        steady = 8.0 * (k in (3, 4)) * np.sin(2 * np.pi * 31.0 * time)
        moving = 3.0 * np.sin(2 * np.pi * (11.0 + 0.01 * time) * time)
        return np.column_stack([steady + moving, 0 * time])

    samples = draw(np.random.default_rng(1), filter_m=0, added=both)
    found = look_within(samples)[0]
    assert [finding.kind for finding in found] == ["tone", "tone"]
    steady_hz = [one.parameters["frequency"].value for one in found if "frequency" in one.parameters]
    assert steady_hz == pytest.approx([31.0], abs=0.05)
    # The frequency at a time t is 11 Hz + 0.02 Hz/s t.
    moving_hz = strongest_frequency(samples, samples.position)
    assert moving_hz == pytest.approx([11 + 0.02 * time.mean() for time in samples.time_s], abs=0.1)
    assert strongest_frequency(draw(np.random.default_rng(1), filter_m=0), samples.position) is None


@pytest.mark.parametrize("flicker_mg2", [0.0, 0.3, 3.0])
def test_the_density_of_noise_follows_white_and_1_over_f_noise(flicker_mg2: float) -> None:
    samples = draw(np.random.default_rng(2), filter_m=0, noise_mg=1.0, lsb_mg=0.0, flicker_mg2=flicker_mg2)
    density = density_of(samples)
    assert density is not None
    searched = density.searched
    frequency = density.frequency[searched]
    found = float(np.median(density.level[:, 0])) * density.base[searched, 0]
    assert found / (1.0 + flicker_mg2 / frequency) == pytest.approx(np.ones(len(frequency)), abs=0.25)


# -- small parts -----------------------------------------------------------------------------------------


def test_frequencies_that_sampling_folds_to_a_line_are_listed_up_to_the_highest() -> None:
    found = aliases_hz(11.0, 100.0)
    assert found[:5] == pytest.approx([89, 111, 189, 211, 289])
    every = [k * 100 + sign * 11 for k in range(1, 1000) for sign in (-1, 1)]
    assert found == pytest.approx([f for f in every if f <= HIGHEST_HZ])
    assert aliases_hz(3.0, 2 * HIGHEST_HZ) == ()


def test_a_sentence_names_at_most_six_aliases() -> None:
    assert alias_text(()) == ""
    seven = (89.0, 111.0, 189.0, 211.0, 289.0, 311.0, 389.0)
    texts = alias_text(seven[:6]), alias_text(seven)
    assert ["311.0" in text for text in texts] == [True, True]
    assert ["…" in text for text in texts] == [False, True]
    assert "389" not in texts[1]


def test_a_p_value_is_multiplied_by_its_tests_and_by_the_searches() -> None:
    assert corrected(1e-4, 10) == pytest.approx(6e-3)  # six kinds are searched for
    assert corrected(1e-4, 0.2) == pytest.approx(6e-4)  # no fewer than one test
    assert corrected(0.5, 3) == 1.0


def test_positions_are_named_in_a_text() -> None:
    assert positions_text(EVERY, 24) == "all 24 dwells"
    assert positions_text((7,), 24) == "position 7"
    assert positions_text((7,), 1) == "position 7"
    assert positions_text((3, 4, 9), 24) == "positions 3, 4, 9"
    assert positions_text((3, 4, 9), 24, most=2).startswith("positions 3, 4")


def test_samples_know_their_rate_and_the_noise_of_their_means() -> None:
    samples = draw(np.random.default_rng(3), dwells=3, n=[400, 100, 25], filter_m=0, noise_mg=5.0)
    assert len(samples) == 3
    assert samples.counts.tolist() == [400, 100, 25]
    assert samples.period_s == pytest.approx(0.01)
    assert samples.u_of_means == pytest.approx([0.25, 0.5, 1.0], rel=0.25)
    assert samples.elapsed_s(1)[[0, -1]] == pytest.approx([0, 0.99])
    places = [samples.place(2, 1, 4.0, 0.5, at=10, shift=-0.2), samples.place(0, 0, 4.0)]
    assert (places[0].position, places[0].axis, places[0].shift_mg) == (2, "y", -0.2)
    assert places[0].time_s == samples.time_s[2][10]
    assert places[1].time_s is None
    assert axes_and_positions([*places, places[0]]) == (("x", "y"), (0, 2))
    still = replace(samples, time_s=tuple(np.zeros(n) for n in (400, 100, 25)))
    assert math.isnan(still.period_s)


def test_the_size_of_a_line_is_the_root_of_its_mean_square_without_the_noise() -> None:
    rng = np.random.default_rng(4)
    noise = np.full((400, 2), 0.5)
    # Two quadratures: a line of 2 mg on x and none on y, each with noise.
    waves = rng.normal([2.0, 0.0], math.sqrt(0.25), (400, 2)), rng.normal(0, math.sqrt(0.25), (400, 2))
    amplitude, u, shown = line_sizes(waves[0] ** 2 + waves[1] ** 2, noise)
    assert abs(amplitude[0] - 2.0) < 3 * u[0] < 0.15
    assert u[0] == pytest.approx(0.5 / math.sqrt(400), rel=0.15)
    assert abs(amplitude[1]) < 3 * u[1]
    assert shown.tolist() == [True, False]
