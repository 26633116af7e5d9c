"""Frames out and words in, without a chip: checked against plain arithmetic written here."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from adis_gonio.base.errors import ChipError, UsageError
from adis_gonio.device.sensor.registers import (
    BY_NAME,
    FAST,
    NORMAL,
    REGISTERS,
    read_frame,
    timing_for,
    write_frames,
)
from adis_gonio.device.sensor.settings import (
    Configuration,
    ScanBlock,
    decode_numbers,
    filter_response,
    filter_settling_samples,
    filter_weights,
    join,
    low_pass_3db_hz,
    mean_at_rest,
    rounding_covariance,
    rounding_spectrum,
    sample_period_s,
    sens_avg_word,
    smpl_prd_for,
)

OUTPUTS = [row for row in REGISTERS if row.flags]


@pytest.mark.parametrize("row", [row for row in REGISTERS if row.readable], ids=lambda row: row.name)
def test_a_read_frame_never_has_the_write_bit_or_bit_14(row):
    frame = read_frame(row)
    assert frame & 0xC000 == 0
    assert frame >> 8 == row.address


def test_a_register_is_written_low_byte_first():
    assert [hex(f) for f in write_frames(BY_NAME["XGYRO_OFF"], 0x1234)] == ["0x9a34", "0x9b12"]


def test_a_byte_without_writable_bits_is_not_sent():
    assert [hex(f) for f in write_frames(BY_NAME["SMPL_PRD"], 0x09)] == ["0xb609"]
    assert [hex(f) for f in write_frames(BY_NAME["MSC_CTRL"], 0x0400, byte_mask=0xFF00)] == ["0xb504"]


@given(st.sampled_from([row for row in REGISTERS if row.writable]), st.integers(0, 0xFFFF))
def test_no_write_can_produce_0xffff_or_bit_14(row, word):
    for frame in write_frames(row, word & row.write_mask):
        assert frame != 0xFFFF
        assert frame & 0xC000 == 0x8000


def test_bits_that_a_register_has_not_and_read_only_registers_are_refused():
    with pytest.raises(UsageError, match="no bits 0x0800"):
        write_frames(BY_NAME["SENS_AVG"], 0x0C02)
    with pytest.raises(UsageError, match="read-only"):
        write_frames(BY_NAME["STATUS"], 0)
    with pytest.raises(UsageError, match="cannot be read"):
        read_frame(BY_NAME["COMMAND"])


@pytest.mark.parametrize(
    ("smpl_prd", "timing"),
    [(1, FAST), (9, FAST), (10, NORMAL), (0x7F, NORMAL), (0x80, NORMAL), (0x81, NORMAL)],
)
def test_the_mode_follows_the_whole_byte_of_smpl_prd(smpl_prd, timing):
    assert timing_for(smpl_prd) is timing


def test_both_timings_keep_the_data_sheets_limits_with_their_own_clock():
    for timing, clock, stall, period in ((FAST, 2e6, 9, 40), (NORMAL, 300e3, 75, 160)):
        assert timing.clock_hz <= clock
        assert timing.frame_s * 1e6 >= period
        assert timing.frame_s * 1e6 - 16e6 / timing.clock_hz >= stall - 1e-9


def test_a_bus_that_clocks_more_slowly_than_it_may_still_keeps_the_stall():
    # Then the frame fills its period, and nothing but the stall that was asked for is left between frames.
    for timing, stall_us in ((FAST, 9), (NORMAL, 75)):
        assert timing.stall_us >= stall_us


@given(st.lists(st.integers(0, 0xFFFF), min_size=len(OUTPUTS), max_size=len(OUTPUTS)))
def test_the_vectorised_decoder_agrees_with_the_table_row_by_row(words):
    array = np.array([words], np.uint16)
    expected = [row.number(word) for row, word in zip(OUTPUTS, words, strict=True)]
    assert decode_numbers(OUTPUTS, array)[0].tolist() == expected


@pytest.mark.parametrize(
    "names", [("XACCL_OUT", "SUPPLY_OUT", "XTEMP_OUT"), ("ENDURANCE", "ALM_MAG1", "ZGYRO_OUT")]
)
@pytest.mark.parametrize("count", [0, 1, 10_921, 10_922, 10_923, 40_000])
def test_long_blocks_decode_like_single_words(names, count):
    table = [BY_NAME[name] for name in names]
    words = np.random.default_rng(count).integers(0, 1 << 16, (count, 3)).astype(np.uint16)
    numbers = decode_numbers(table, words[:, ::-1][:, ::-1])  # a view that is not contiguous serves too
    assert numbers.shape == words.shape
    expected = [[row.number(int(word)) for row, word in zip(table, scan, strict=True)] for scan in words]
    assert numbers.tolist() == expected


def test_a_block_gives_units_flags_and_columns():
    names = ("XACCL_OUT", "ZGYRO_OUT", "XTEMP_OUT", "SUPPLY_OUT")
    words = np.array([[0x885C, 0x7FFF, 0x0FFF, 0x8AAA], [0x37A4, 0x0001, 0x3800, 0x4AAA]], np.uint16)
    block = ScanBlock(names, words, np.array([0.0, 1.0]), gyro_range_dps=150)
    assert block.units == ("mg", "°/s", "°C", "V")
    expected = [
        [2140 * 0.4672, -1 * 0.03663, 25 - 0.1453, 2730 * 1.8315e-3],
        [-2140 * 0.4672, 0.03663, 25 - 2048 * 0.1453, 2730 * 1.8315e-3],
    ]
    np.testing.assert_allclose(block.values(), expected)
    np.testing.assert_allclose(block.supply_v, [5.0, 5.0], atol=1e-3)
    assert block.alarm.tolist() == [True, True]
    assert block.select(("SUPPLY_OUT",)).words[:, 0].tolist() == [0x8AAA, 0x4AAA]
    with pytest.raises(UsageError, match="YACCL_OUT was not scanned"):
        _ = block.accel_mg


def test_joined_blocks_add_what_was_lost():
    block = ScanBlock(("XACCL_OUT",), np.zeros((2, 1), np.uint16), np.array([0.0, 1.0]), lost=3)
    both = join([block, block])
    assert (len(both), both.lost) == (4, 6)
    known = ScanBlock(
        ("XACCL_OUT",), np.zeros((3, 1), np.uint16), np.arange(3.0), lost=7, missed=np.array([2, 0, 5])
    )
    assert [known.first(k).lost for k in range(4)] == [0, 2, 2, 7]
    assert join([known, known]).first(4).lost == 9


def test_a_gyro_of_unknown_range_is_refused_instead_of_scaled_wrong():
    block = ScanBlock(("XGYRO_OUT",), np.zeros((1, 1), np.uint16), np.zeros(1), gyro_range_dps=None)
    with pytest.raises(ChipError, match="range"):
        block.values()


@pytest.mark.parametrize(
    ("smpl_prd", "rate"), [(0x01, 819.2), (0x09, 163.84), (0x0A, 148.95), (0x80, 52.85), (0xFF, 0.413)]
)
def test_sample_rates_of_the_data_sheet(smpl_prd, rate):
    assert 1 / sample_period_s(smpl_prd) == pytest.approx(rate, rel=1e-3)
    assert smpl_prd_for(rate) == smpl_prd


def test_a_rate_that_the_part_does_not_have_is_refused():
    for rate in (0, 0.3, 1000, float("nan")):
        with pytest.raises(UsageError, match="sample_rate_hz"):
            smpl_prd_for(rate)


@pytest.mark.parametrize(("dps", "least"), [(300, 0), (150, 2), (75, 4)])
def test_a_gyro_range_refuses_too_little_filtering(dps, least):
    for m in range(7):
        if m < least:
            with pytest.raises(UsageError, match=f">= {least}"):
                sens_avg_word(dps, m)
        else:
            word = sens_avg_word(dps, m)
            assert Configuration.from_words(1, word, 0).gyro_range_dps == dps
            assert Configuration.from_words(1, word, 0).filter_m == m


def test_settling_of_the_filter_is_the_data_sheets():
    assert [filter_settling_samples(m) for m in range(7)] == [1, 3, 7, 15, 31, 63, 127]


@pytest.mark.parametrize("m", range(1, 7))
def test_the_filter_halves_the_power_at_its_cut_off(m):
    """The taps of a Bartlett filter are two boxcars, one over the other."""
    box = np.full(2**m, 0.5**m)
    taps = np.convolve(box, box)
    cycles = low_pass_3db_hz(m, 100.0) / 100.0
    gain = np.abs(np.sum(taps * np.exp(-2j * np.pi * cycles * np.arange(len(taps)))))
    assert gain**2 == pytest.approx(0.5)
    assert filter_response(m, np.array([0.0, cycles])) == pytest.approx([1.0, 0.5])
    assert low_pass_3db_hz(0, 100.0) == 350.0  # data sheet: the poles of the front end


@pytest.mark.parametrize("m", [0, 4])
def test_the_uncertainty_of_a_mean_at_rest_is_the_scatter_of_such_means(m):
    rng, lsb, sigma, n = np.random.default_rng(m), 0.5, 4.0, 256
    noise = sigma * rng.standard_normal((n + 2 * 2**m - 2, 400))
    box = filter_weights(m)
    filtered = np.stack([np.convolve(column, box, "valid") for column in noise.T], axis=1)
    means, u = mean_at_rest(lsb * np.rint(filtered / lsb), np.full(400, lsb), m)
    assert u.mean() == pytest.approx(means.std(), rel=0.1)


def test_the_mean_of_a_constant_number_is_uncertain_by_its_rounding():
    means, u = mean_at_rest(np.full((100, 2), 7.0), np.array([0.5, 2.0]), 2)
    assert means.tolist() == [7.0, 7.0]
    assert u == pytest.approx([0.5 / 12**0.5, 2.0 / 12**0.5])


@pytest.mark.parametrize(("m", "sigma"), [(0, 0.6), (2, 1.5), (4, 3.0)])
def test_rounding_of_filtered_noise_has_the_predicted_covariance_and_spectrum(m, sigma):
    box, n = filter_weights(m), 400_000
    exact = np.convolve(sigma * np.random.default_rng(m).standard_normal(n), box, "valid")
    error = np.rint(exact) - exact
    covariance = rounding_covariance(m, sigma)
    for lag in range(min(4, len(box))):
        measured = np.mean(error[: len(error) - lag] * error[lag:])
        assert measured == pytest.approx(covariance[lag], abs=8e-4)
    taper = np.hanning(64)
    segments = error[: len(error) // 64 * 64].reshape(-1, 64)
    power = np.mean(np.abs(np.fft.rfft(segments * taper)) ** 2, axis=0) / np.sum(taper**2)
    predicted = rounding_spectrum(m, sigma, np.arange(33) / 64)
    assert power[2:-2] == pytest.approx(predicted[2:-2], rel=0.12, abs=2e-3)


def test_an_undefined_range_code_is_unknown_not_guessed():
    assert Configuration.from_words(1, 0x0302, 0).gyro_range_dps is None
