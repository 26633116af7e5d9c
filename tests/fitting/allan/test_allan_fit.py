"""Noise of sessions whose truth is known, from a generator that is not the package's simulator."""

import math
import tracemalloc
from dataclasses import replace

import allantools
import numpy as np
import pytest
from scipy import stats

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.fitting.allan import fit_allan
from adis_gonio.fitting.allan.allan_fit import cells
from adis_gonio.fitting.allan.spectral_likelihood import NoiseParameter
from adis_gonio.model.records import Dwell, Session
from allan_statistics import Case, noise, samples, session_of
from recordings import recording

WHITE = Case({"white": 0.05}, 8192, 0)
ALL = Case({"white": 0.05, "flicker": 0.02, "walk": 0.012}, 1 << 17, 0)


def still(gyro, period_s=0.01, **facts):
    """A session of one dwell."""
    accel = np.zeros((len(gyro), 3))
    return Session((Dwell(0, np.arange(len(gyro)) * period_s, accel, gyro=gyro),), facts=facts)


def known(case, gyro):
    return fit_allan(session_of(case, gyro))


def test_of_white_noise_nothing_else_is_claimed_and_what_is_absent_has_a_limit_and_no_value():
    found = known(WHITE, samples(WHITE, 12))
    for axis in found.axes:
        assert axis["white"].value.value == pytest.approx(0.05, abs=4 * axis["white"].value.u)
        for kind in ("quantization", "flicker", "walk"):
            assert not axis[kind].present
            document = axis[kind].as_dict()
            assert (document["value"], document["u"], document["U"]) == (None, None, None)
            assert document["interval_95"][0] == 0 < document["upper_95"]
    # A walk or a floor as large as its limit would be seen in the plot.
    curve = found["x"].curve
    assert found["x"]["flicker"].high < curve.deviation.max()


def test_all_three_are_found_where_they_are():
    found = known(ALL, samples(ALL, 3))
    for axis in found.axes:
        for kind, truth in ALL.truth.items():
            low, high = axis[kind].low, axis[kind].high
            assert axis[kind].present
            assert 0 < low < axis[kind].value.value < high
            assert axis[kind].value.value == pytest.approx(truth, abs=4 * axis[kind].value.u)
        assert axis.adequacy > 0.001
        z = np.log(axis.curve.deviation / axis.curve.model) * np.sqrt(2 * axis.curve.dof)
        assert np.abs(z[axis.curve.dof > 4]).max() < 4


def test_small_noise_has_intervals_in_proportion():
    gyro = samples(WHITE, 7)
    for axis, small in zip(known(WHITE, gyro).axes, known(WHITE, 1e-5 * gyro).axes, strict=True):
        for one, other in zip(axis.parameters, small.parameters, strict=True):
            ends = (one.low, one.high)
            assert [1e5 * other.low, 1e5 * other.high] == pytest.approx(ends, rel=1e-4)


def test_intervals_cover_and_absent_noise_is_claimed_no_more_often_than_said():
    case = Case({"white": 0.05, "flicker": 0.03}, 1 << 13, 0)
    inside = {"white": 0, "flicker": 0}
    walks = count = 0
    for seed in range(25):
        for axis in known(case, samples(case, 100 + seed)).axes:
            count += 1
            walks += axis["walk"].present
            for kind in inside:
                low, high = axis[kind].low, axis[kind].high
                inside[kind] += low <= case.truth[kind] <= high
    for hits in inside.values():
        assert stats.binom.cdf(hits, count, 0.95) > 0.005
    assert stats.binom.sf(walks - 1, count, 0.025) > 0.005


def test_the_random_walk_is_allantools_deviation_at_one_second():
    gyro = samples(WHITE, 5)
    found = known(WHITE, gyro)
    for k, axis in enumerate(found.axes):
        _, deviation, _, count = allantools.oadev(gyro[:, k], rate=100, data_type="freq", taus=[1.0])
        dof = allantools.edf_greenhall(0, 2, 100, len(gyro) + 1, overlapping=True)
        assert count[0] > 0
        assert axis["white"].value.value == pytest.approx(deviation[0], rel=4 / math.sqrt(2 * dof))


def test_a_filter_that_the_file_does_not_say_is_asked_for():
    case = Case({"white": 0.05, "flicker": 0.01}, 1 << 14, 3)
    gyro = samples(case, 9)
    told = known(case, gyro)
    assert (told.filter_m, told.filter_known) == (3, True)
    assert fit_allan(still(gyro), filter_m=3)["x"]["white"].value == told["x"]["white"].value
    with pytest.raises(DataError, match="does not state the chip's filter"):
        fit_allan(still(gyro))
    other = fit_allan(replace(still(gyro), sensor="generic", gyro_unit="dps"))
    assert (other.filter_m, other.filter_known) == (0, False)
    assert "no filter is known" in other.notes[0]


def test_rounding_to_a_coarse_step_is_no_random_walk():
    """Behind 64 taps the noise is below a step; its rounding is neither white nor the sensor's."""
    case = Case({"white": 0.05, "walk": 0.01}, 1 << 16, 6)
    rng = np.random.default_rng(4)
    fine = np.stack([noise(case, rng) for _ in range(3)], axis=1)
    step = 0.07326
    for axis in known(case, np.rint(fine / step) * step).axes:
        value = axis["white"].value
        assert value.value == pytest.approx(0.05, abs=4 * value.u)
        assert axis.step == pytest.approx(step, rel=1e-6)


@pytest.mark.parametrize("amplitude", [0.01, 0.1, 3.0])
def test_a_sinusoid_is_taken_off_and_said(amplitude):
    case = replace(WHITE, samples=1 << 14)
    gyro = samples(case, 21)
    time_s = 0.01 * np.arange(len(gyro))
    shaken = gyro + amplitude * np.sin(2 * np.pi * 17.123 * time_s + 1)[:, None]
    plain, found = known(case, gyro), known(case, shaken)
    for axis, before in zip(found.axes, plain.axes, strict=True):
        assert before.lines == ()
        value, truth = axis["white"].value, before["white"].value
        assert value.value == pytest.approx(truth.value, abs=2 * truth.u)
        if amplitude > 0.05:
            (line,) = axis.lines
            assert line.frequency_hz == pytest.approx(17.123, abs=0.01)
            assert line.amplitude == pytest.approx(amplitude, rel=0.1)
            assert any("sinusoid of 17.12 Hz" in note for note in axis.notes)


def test_a_warm_up_in_a_straight_line_is_a_ramp_and_no_random_walk():
    gyro = samples(WHITE, 31)
    slope = 0.01
    found = known(WHITE, gyro + slope * 0.01 * np.arange(len(gyro))[:, None])
    for axis in found.axes:
        assert not axis["walk"].present
        assert axis.ramps
        assert axis.ramp.value == pytest.approx(slope, abs=4 * axis.ramp.u)
        assert any("drifts by" in note for note in axis.notes)


def test_dwells_that_were_shaken_are_left_out_and_named():
    quiet = [samples(WHITE, seed) for seed in (41, 42, 43)]
    parts = [quiet[0], 2 * quiet[1], quiet[2]]
    dwells = tuple(
        Dwell(k, 0.01 * np.arange(len(part)) + 1000 * k, np.zeros((len(part), 3)), gyro=part)
        for k, part in enumerate(parts)
    )
    found = fit_allan(Session(dwells, facts={"configuration": {"filter_m": 0}}))
    for axis in found.axes:
        assert axis["white"].value.value == pytest.approx(0.05, abs=4 * axis["white"].value.u)
        assert any("1 record left out" in note and "positions 1" in note for note in axis.notes)


@pytest.mark.parametrize("step", [0.0, 0.2])
def test_a_dwell_in_which_an_axis_never_changed_is_left_out_for_this_axis_and_named(step):
    parts = [samples(WHITE, seed) for seed in (44, 45, 46)]
    parts = [np.round(part / step) * step for part in parts] if step else parts
    parts[0][:, 0] = 0.0
    dwells = tuple(
        Dwell(k, 0.01 * np.arange(len(part)) + 1000 * k, np.zeros((len(part), 3)), gyro=part)
        for k, part in enumerate(parts)
    )
    found = fit_allan(Session(dwells, facts={"configuration": {"filter_m": 0}}))
    assert any("without noise (positions 0)" in note for note in found["x"].notes)
    assert not any("left out" in note for note in found["y"].notes)
    for axis in found.axes:
        assert axis["white"].value.value == pytest.approx(found["y"]["white"].value.value, rel=0.1)


def test_a_gap_divides_a_record_and_missing_samples_are_said():
    gyro = samples(replace(WHITE, samples=4096), 51)
    time_s = 0.01 * np.arange(len(gyro))
    time_s[2000:] += 60
    dwell = Dwell(0, time_s, np.zeros((len(gyro), 3)), gyro=gyro)
    found = fit_allan(Session((dwell,), facts={"configuration": {"filter_m": 0}}))
    assert found.samples == (2000, 2096)
    assert found.duration_s == pytest.approx(40.96)
    single = np.delete(0.01 * np.arange(len(gyro) + 40), np.arange(50, 4050, 100))
    holed = replace(dwell, time_s=single)
    notes = fit_allan(Session((holed,), facts={"configuration": {"filter_m": 0}})).notes
    assert any("40 samples of 4096 are missing" in note for note in notes)


def test_lost_samples_of_a_filtered_sensor_do_not_look_like_noise():
    errors = []
    for seed in range(4):
        case = Case({"white": 0.05}, 8192, 2)
        rows, kept = samples(case, 70 + seed), np.random.default_rng(seed).random(8192) > 0.02
        kept[1:] |= ~kept[:-1]  # single samples are lost
        dwell = Dwell(0, 0.01 * np.flatnonzero(kept), np.zeros((kept.sum(), 3)), gyro=rows[kept])
        found = fit_allan(Session((dwell,), facts={"configuration": {"filter_m": 2}}))
        assert found.samples == (8192,)
        errors += [(axis["white"].value.value - 0.05) / axis["white"].value.u for axis in found.axes]
    # If the samples are joined across the losses, the mean error is two u.
    assert abs(np.mean(errors)) < 1
    assert np.std(errors) < 2


def test_slow_noise_that_a_record_cannot_name_is_said_to_be_there():
    case = Case({"white": 0.02, "walk": 0.03}, 2048, 0)
    axes = [axis for seed in range(6) for axis in known(case, samples(case, 60 + seed)).axes]
    unnamed = [
        a for a in axes if not (a["flicker"].present or a["walk"].present) and a.slow_p_value < 0.025
    ]
    assert unnamed
    for axis in unnamed:
        assert any("too short to separate bias instability from random" in note for note in axis.notes)


def test_a_coefficient_is_shown_to_the_second_digit_of_its_uncertainty():
    walk = NoiseParameter("walk", "rate_random_walk", "dps/rt_s", 0.01998, 0.0050, 0.00833, 0.0291, 1e-9)
    _, value, u, _, dof, _ = cells(walk)
    assert (value, u, dof) == ("0.0200", "0.0050", "8.0")
    assert cells(replace(walk, u=1e-5))[1:5:3] == ("0.019980", "> 10⁴")


def test_units_are_the_files():
    gyro = samples(WHITE, 71)
    base = still(gyro, configuration={"filter_m": 0})
    there = fit_allan(base)
    (dwell,) = base.dwells
    turned = replace(base, dwells=(replace(dwell, gyro=np.radians(gyro)),), gyro_unit="radps")
    assert fit_allan(turned)["y"]["white"].value.value == pytest.approx(there["y"]["white"].value.value)
    counted = fit_allan(replace(base, gyro_unit="counts"))["y"]["white"]
    assert counted.unit == "counts/√Hz"
    in_g = replace(base, dwells=(replace(dwell, accel=gyro / 1000 + 1),), accel_unit="g")
    force = fit_allan(in_g, "accelerometer")["y"]["velocity_random_walk"]
    assert force.unit == "mg/√Hz"
    assert force.value.value == pytest.approx(there["y"]["white"].value.value, rel=1e-3)


def test_the_document_has_interval_and_uncertainties_that_agree():
    document = known(ALL, samples(ALL, 3)).as_dict()
    for name in ("angle_random_walk", "bias_instability", "rate_random_walk"):
        found = document["axes"]["x"]["parameters"][name]
        low, high = found["interval_95"]
        assert found["U"] == pytest.approx(max(high - found["value"], found["value"] - low))
        assert found["k"] * found["u"] == pytest.approx(found["U"])
        assert found["dof"] == pytest.approx(found["value"] ** 2 / (2 * found["u"] ** 2))


@pytest.mark.parametrize(
    ("session", "error", "words"),
    [
        (Session(()), DataError, "nothing in it is at rest"),
        (Session((Dwell(0, np.arange(200.0), np.zeros((200, 3))),)), DataError, "there are no gyros"),
        (
            still(np.random.default_rng(0).standard_normal((100, 3))),
            DataError,
            "no rest has 128 samples",
        ),
        (still(np.zeros((500, 3))), DataError, "x, y, z never changes"),
        (still(np.full((500, 3), np.nan)), DataError, "NaN"),
        (still(np.zeros((1, 3))), DataError, "one averaged sample each"),
        (still(np.random.default_rng(0).standard_normal((500, 3)), 0.0), DataError, "do not increase"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(session, error, words):
    with pytest.raises(error, match=words) as caught:
        fit_allan(session)
    assert "\n" not in str(caught.value)


def test_an_unknown_part_and_filter_are_wrong_usage():
    with pytest.raises(UsageError, match="no part 'magnetometer'; it has accelerometer, gyro"):
        fit_allan(still(samples(WHITE, 1)), "magnetometer")
    with pytest.raises(UsageError, match="give 0 to 6"):
        fit_allan(still(samples(WHITE, 1)), filter_m=7)


def test_memory_is_a_few_times_one_axis():
    n = 1 << 20
    gyro = np.random.default_rng(0).standard_normal((n, 3))
    session = still(gyro, configuration={"filter_m": 0})
    tracemalloc.start()
    try:
        fit_allan(session)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 20 * 8 * n


def test_a_real_recording_at_rest_is_fitted_on_its_first_fifty_seconds():
    from adis_gonio import load_session

    found = fit_allan(load_session(recording("xsens_mti_recording")))
    assert found.longest_s == pytest.approx(51.5, abs=0.5)
    assert len(found.samples) == 1
    for axis in found.axes:
        # allantools, overlapping, τ = 0.64 s: 3.67, 3.60, 3.52 counts, times √τ: 2.93, 2.88, 2.82.
        assert axis["angle_random_walk"].value.value == pytest.approx(2.8, abs=0.2)
        assert axis["angle_random_walk"].unit == "counts/√Hz"
        assert not axis["walk"].present
