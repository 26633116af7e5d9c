"""The benchmarks compare answers before times, and their baselines are what they are called."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import speed_ratios
import trace_peers
from speed import fits, growth, streams
from speed.tedaldi import calibrate
from speed.timing import DisagreementError, compare, require

ROOT = Path(__file__).parents[2]


def test_a_side_that_is_fast_and_wrong_is_refused_before_it_is_timed():
    timed = []

    def wrong():
        timed.append(1)
        return 41

    def same(name, ours, theirs):
        return require(ours == theirs, f"{name}: {ours} and {theirs}")

    with pytest.raises(DisagreementError, match="fast one: 42 and 41"):
        compare("b", lambda: 42, {"fast one": wrong}, same, 5)
    assert len(timed) == 1


def test_a_ratio_is_the_baselines_time_over_ours_by_any_clock():
    now = [0.0]

    def lasts(seconds):
        def call():
            now[0] += seconds
            return 0

        return call

    (row,) = compare("b", lasts(2.0), {"slow": lasts(6.0)}, lambda *_: "", 4, clock=lambda: now[0])
    assert (row.ratio, row.low, row.high) == pytest.approx((3, 3, 3))


def test_short_calls_are_repeated_and_long_ones_are_not():
    now, calls = [0.0], []

    def short():
        calls.append(1)
        now[0] += 0.001

    def long():
        now[0] += 1.0

    (row,) = compare("b", short, {"long": long}, lambda *_: "", 3, clock=lambda: now[0])
    assert row.ratio == pytest.approx(1000)
    assert len(calls) >= 3 * 20


@pytest.mark.parametrize(
    ("side", "changed"), [("scipy_planar", "values"), ("scipy_planar", "u"), ("tedaldi_space", "bias")]
)
def test_a_fit_that_is_off_by_a_tenth_or_one_u_does_not_pass(side, changed):
    rng = np.random.default_rng(4)
    if side == "scipy_planar":
        data = fits.planar(rng, 12)
        ours, theirs = fits.ours_planar(data), fits.scipy_planar(data)
        fits.agree_planar("scipy", ours, theirs)
        off = theirs.values + 0.1 * theirs.u if changed == "values" else 1.1 * theirs.u
        with pytest.raises(DisagreementError):
            fits.agree_planar("scipy", ours, fits.replace(theirs, **{changed: off}))
    else:
        data = fits.spatial(rng, 30)
        ours, theirs = fits.ours_space(data), fits.tedaldi_space(data)
        fits.agree_norm("tedaldi", ours, theirs)
        with pytest.raises(DisagreementError):
            fits.agree_norm("tedaldi", ours, fits.replace(theirs, bias=theirs.bias + ours.u))


def test_tedaldis_method_recovers_a_sensor_without_noise():
    rng = np.random.default_rng(5)
    mean = fits.SENSOR.means(fits.attitudes(rng, 20), rng, 0.0)
    matrix, bias = calibrate(mean, fits.G_MG)
    np.testing.assert_allclose(bias, fits.SENSOR.bias, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm((mean - bias) @ matrix.T, axis=1), fits.G_MG, rtol=1e-9)
    np.testing.assert_array_equal(np.tril(matrix, -1), 0)


def test_the_error_of_the_angle_is_zero_for_the_truth_and_what_was_put_in_else():
    truth = fits.Space(np.linalg.inv(fits.SENSOR.mixing), fits.SENSOR.bias)
    assert truth.angle_error_deg(fits.SENSOR) < 1e-5
    # A zero off by e tilts gravity by e/g across it: rms over the sphere √(2/3) of that.
    off = fits.Space(truth.matrix, truth.bias + np.array([0.0, 0.0, 5.0]))
    assert off.angle_error_deg(fits.SENSOR) == pytest.approx(
        math.degrees(0.005 * math.sqrt(2 / 3)), rel=0.05
    )
    sound = fits.Planar(np.zeros(4), np.ones(4), np.array([1.004, 0.997]), 0.003, np.array([12.0, -7.0]))
    assert sound.angle_error_deg() < 1e-9
    skewed = fits.replace(sound, phi=0.003 + math.radians(1.0))
    # sin²ψ·1° about its mean: amplitude a half, rms 1/(2√2).
    assert skewed.angle_error_deg() == pytest.approx(1 / (2 * math.sqrt(2)), rel=0.02)


def test_the_loop_of_struct_reads_words_as_the_data_sheet_says():
    words = np.array([[0x8001, 0x3FFF, 0x2000, 0xC001, 0x1FFF, 0x7FFE, 0x8000 | 2730]], dtype="<u2")
    (row,) = streams.by_struct(words.tobytes())
    numbers = [value / lsb for value, lsb in zip(row, streams.LSB, strict=True)]
    assert numbers == pytest.approx([1, -1, -8192, 1, 8191, -2, 2730])


def test_fast_benchmarks_without_other_packages_agree_and_give_rows():
    rng = np.random.default_rng(6)
    rows = [*streams.decoding(rng, fast=True), *streams.archiving(rng, fast=True)]
    assert [row.baseline for row in rows] == [
        "loop of struct",
        "sqlite3 executemany, as durable",
        "sqlite3 executemany, its defaults",
    ]
    assert all(row.ratio > 0 and row.agreement for row in rows)


def test_the_recording_of_the_segmentation_is_the_same_each_time_and_holds_its_rests():
    first, second = (growth.recording(150_000) for _ in range(2))
    assert all((a == b).all() for a, b in zip(first, second, strict=True))
    assert growth.segment_here(150_000)["dwells"] == 4  # 183 s: three rests of 50 s and a part of a fourth


def test_the_script_names_the_extra_of_a_package_that_is_absent(monkeypatch, capsys):
    monkeypatch.setattr(speed_ratios, "find_spec", lambda name: None)
    monkeypatch.setattr(sys, "argv", ["speed_ratios.py", "fit"])
    assert speed_ratios.main() == 2
    assert capsys.readouterr().err == "lmfit, imucal not installed: pip install 'adis-gonio[baselines]'\n"


def test_the_script_prints_one_table():
    command = [sys.executable, ROOT / "scripts" / "speed_ratios.py", "decode", "--fast", "--seed", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    head, columns, _, row = done.stdout.strip().splitlines()
    assert "numpy" in head
    assert columns.startswith("| benchmark | baseline | its time over ours")
    assert row.count("|") == columns.count("|")


@pytest.mark.parametrize("missing", [("sklearn", "pysindy"), ("pysindy",)])
def test_the_peers_of_the_trace_name_the_packages_to_install(monkeypatch, missing):
    monkeypatch.setattr(trace_peers, "find_spec", lambda name: None if name in missing else name)
    monkeypatch.setattr(sys, "argv", ["trace_peers.py"])
    names = " ".join({"sklearn": "scikit-learn"}.get(name, name) for name in missing)
    with pytest.raises(SystemExit, match=f"not installed: pip install {names}$"):
        trace_peers.main()
