"""Dwells of a long recording, in less memory than the recording takes."""

import tracemalloc

import numpy as np
import pytest

from adis_gonio.faces.cli import main
from adis_gonio.model.records import Dwell
from adis_gonio.record import segmentation
from adis_gonio.record.loading import load_session
from adis_gonio.record.segmentation import segment_with_notes, shows_a_free_turn

RATE = 100.0
STEP_S = 40.0


def samples(first, last):
    """Samples first to last (exclusive) of a turn: 36 s of rest, 4 s of motion; every third rest slips."""
    rng = np.random.default_rng((7, first))
    t = np.arange(first, last) / RATE
    place, into = np.divmod(t, STEP_S)
    angle = 0.5 * (place + np.clip((into - 36.0) / 4.0, 0.0, 1.0))
    slip = 30.0 * ((place % 3 == 1) & (into > 15.0))
    accel = 1000 * np.stack([np.cos(angle), np.sin(angle), np.full(len(t), 0.1)], axis=1)
    accel[:, 0] += slip
    gyro = np.where(into > 36.0, 7.0, 0.0)[:, None] * [0.0, 0.0, 1.0]
    return t, accel + rng.normal(0, 2.0, accel.shape), gyro + rng.normal(0, 0.1, (len(t), 3))


WHOLE = samples(0, 60_000)


def plain(_, accel, gyro):
    """Dwells by the definition, window by window, without running sums or blocks."""
    window, trim, least = round(RATE / 2), round(RATE / 4), round(RATE)
    spread = np.lib.stride_tricks.sliding_window_view(accel, window, axis=0).std(axis=-1)
    noise = [np.median(s[s <= 2 * np.quantile(s, 0.05)]) for s in spread.T]
    still = ((spread <= 4 * np.array(noise)) & (spread >= 0.1 * np.array(noise))).all(axis=1)
    turning = np.lib.stride_tricks.sliding_window_view(gyro, window, axis=0).std(axis=-1)
    still &= (turning <= 10 * np.median(turning[still], axis=0)).all(axis=1)
    mean = np.lib.stride_tricks.sliding_window_view(accel, window, axis=0).mean(axis=-1)
    moved = (np.abs(mean[2 * window :] - mean[: -2 * window]) > 4 * np.array(noise)).any(axis=1)
    still[window:-window] &= ~(moved & still[: -2 * window] & still[2 * window :])
    found, k = [], 0
    while k < len(still):
        if not still[k]:
            k += 1
            continue
        end = k
        while end < len(still) and still[end]:
            end += 1
        a, b = k + trim, end - 1 + window - trim
        k = end
        found += [slice(a, b)] if b - a >= least else []
    return found


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(segmentation, "_BLOCK", 777)


def test_dwells_are_those_of_the_definition(small_blocks):
    found, _ = segment_with_notes(*WHOLE)
    wanted = plain(*WHOLE)
    assert len(found) == len(wanted) == 20  # 15 rests, 5 of them slip
    for one, other in zip(found, wanted, strict=True):
        assert abs(one.start - other.start) <= 1  # the noise is a median to 0.1 %
        assert abs(one.stop - other.stop) <= 1


@pytest.mark.parametrize("block", [60, 1000, 9999])
def test_dwells_do_not_depend_on_the_size_of_a_block(monkeypatch, block):
    whole = segment_with_notes(*WHOLE)
    monkeypatch.setattr(segmentation, "_BLOCK", block)
    assert segment_with_notes(*WHOLE) == whole


def test_a_stuck_stretch_over_many_blocks_is_named_by_its_times(small_blocks):
    accel = WHOLE[1].copy()
    accel[20_000:23_000] = accel[20_000]
    found, notes = segment_with_notes(WHOLE[0], accel)
    (line,) = [note for note in notes if "stuck" in note]
    assert "at 200 s to 230 s" in line
    window = round(RATE / 2)  # one that is stuck in part still shows noise
    assert not any(rows.start < 23_000 - window and rows.stop > 20_000 + window for rows in found)


def test_memory_is_less_than_that_of_the_recording(monkeypatch):
    monkeypatch.setattr(segmentation, "_BLOCK", 4096)
    whole = samples(0, 400_000)
    tracemalloc.start()
    try:
        found, _ = segment_with_notes(*whole)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(found) >= 400_000 / RATE / STEP_S
    assert peak < sum(array.nbytes for array in whole)


def behind_filter(samples, filter_m):
    """Samples (n, k) behind the chip's filter, without those before it has settled."""
    taps = np.full(1 << filter_m, 0.5**filter_m)
    taps = np.convolve(taps, taps)
    return np.stack([np.convolve(axis, taps, "valid") for axis in samples.T], axis=1)


@pytest.mark.parametrize(("rate_hz", "filter_m"), [(20.0, 2), (20.0, 4), (100.0, 4), (100.0, 6)])
def test_a_rest_behind_a_slow_filter_is_one_dwell_and_a_move_divides_it(rate_hz, filter_m):
    rng = np.random.default_rng(3)
    half = 150 << filter_m
    seen = np.repeat([[1000.0, 0.0, 0.0], [0.0, 1000.0, 0.0]], half, axis=0)
    seen += rng.normal(0.0, 5.0, seen.shape)
    behind = behind_filter(seen, filter_m)
    slices, _ = segment_with_notes(np.arange(len(behind)) / rate_hz, behind, filter_m=filter_m)
    first, second = slices
    assert first.stop <= half <= second.start + len(seen) - len(behind) + 1
    assert min(rows.stop - rows.start for rows in slices) > 0.8 * half


@pytest.mark.parametrize(
    ("rate_hz", "filter_m", "turn_s", "rest_s"), [(100.0, 6, 20.0, 5.0), (20.0, 4, 20.0, 5.0)]
)
def test_a_turn_in_two_windows_of_a_slow_filter_is_no_dwell_but_a_free_turn(
    rate_hz, filter_m, turn_s, rest_s
):
    rng = np.random.default_rng(3)
    rest = np.zeros(round(rest_s * rate_hz))
    rate_dps = np.concatenate([rest, np.full(round(turn_s * rate_hz), 360.0 / turn_s), rest])
    turned = np.radians(np.cumsum(rate_dps) / rate_hz)
    seen = np.stack([1000.0 * np.cos(turned), 1000.0 * np.sin(turned), 0 * turned, rate_dps], axis=1)
    seen = behind_filter(seen + rng.normal(0.0, [5.0, 5.0, 5.0, 0.5], seen.shape), filter_m)
    time_s, accel, gyro = np.arange(len(seen)) / rate_hz, seen[:, :3], seen[:, [3, 3, 3]] * [0.0, 0.0, 1.0]
    slices, _ = segment_with_notes(time_s, accel, gyro, filter_m)
    assert slices == []
    assert shows_a_free_turn(Dwell(0, time_s, accel, gyro=gyro), slices)


def test_rests_shorter_than_the_window_of_a_slow_filter_are_not_one_dwell():
    rng = np.random.default_rng(3)
    angles = np.radians(np.repeat(np.arange(12) * 90.0, 600))
    seen = 1000.0 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    accel = behind_filter(seen + rng.normal(0.0, 5.0, seen.shape), 6)
    assert segment_with_notes(np.arange(len(accel)) / 100.0, accel, filter_m=6)[0] == []


@pytest.mark.parametrize("filter_m", [0, 4, 6])
def test_a_recording_that_is_too_short_reports_the_length_that_gives_a_dwell(filter_m):
    rng = np.random.default_rng(3)
    accel = behind_filter(rng.normal([1000.0, 0.0, 0.0], 5.0, (4000, 3)), filter_m)
    time_s = np.arange(len(accel)) / 100.0
    window = max(50, 8 * (2 << filter_m) - 8)
    (note,) = segment_with_notes(time_s[: window + 50], accel[: window + 50], filter_m=filter_m)[1]
    needed = round(100.0 * 1.01 * float(note.removesuffix(" s").rpartition(" ")[2]))
    slices, _ = segment_with_notes(time_s[:needed], accel[:needed], filter_m=filter_m)
    assert len(slices) == 1


def test_the_filter_that_a_file_states_sets_the_window(tmp_path):
    path = tmp_path / "rest.csv"
    arguments = ["stream", "sim:?seed=1", "--rate", "20", "--filter", "4", "--seconds", "120"]
    assert main([*arguments, "-o", str(path)]) == 0
    session = load_session(path)
    assert [len(dwell.time_s) > 0.85 * 120 * 20 for dwell in session.dwells] == [True]
    path.write_text(path.read_text().replace("# filter_m: 4\n", "# filter_m:\n"))
    assert sum(len(dwell.time_s) for dwell in load_session(path).dwells) < 0.5 * 120 * 20
