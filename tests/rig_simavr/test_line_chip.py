"""The line-level chip itself: what it answers, and that it sees each thing that a host may not do."""

from __future__ import annotations

import numpy as np
import pytest

STARTED_US = 200_000.0


def read(chip, *addresses, at_us=STARTED_US, period_us=200.0, clock_hz=1e6):
    """Words of registers, by frames that are 200 µs apart."""
    words = [address << 8 for address in addresses] + [0]
    begin = at_us + period_us * np.arange(len(words))
    return [int(word) for word in chip.frames(begin, words, clock_hz)[1:]]


def by_hand(chip, word, *, at_us, clocks=16, half_us=0.5, idle=1, setup_us=None):
    """One frame of edges; a master with `idle` 0 clocks in mode 1, which samples at the other edge."""
    t = at_us
    chip.line("sck", t - 1, idle)
    chip.line("cs", t, 0)
    reply = 0
    for k in range(clocks):
        bit = (word >> (15 - k)) & 1 if k < 16 else 0
        t += half_us
        chip.line("sck", t, 1 - idle)
        chip.line("mosi", t if setup_us is None else t + half_us - setup_us, bit)
        t += half_us
        reply = reply << 1 | (chip.miso(t) == 1)
        chip.line("sck", t, idle)
    t += half_us
    chip.line("cs", t, 1)
    return reply


def test_outputs_are_what_the_part_measures_and_new_once(line_chip):
    line_chip.input(0, "supply", 5.0)
    line_chip.input(0, "gyro_y", -10 * 0.07326)
    line_chip.power_on(0)
    assert read(line_chip, 0x02, 0x06, 0x0E, 0x10) == [0x8000 | 2730, 0xBFF6, 0x8000 | 0x37A4, 0x8000]
    # Frames of 20 µs that break the pace would be heard no more; these four come within one sample.
    at = STARTED_US + 10_000
    assert [word >> 15 for word in read(line_chip, 0x0E, 0x0E, at_us=at, period_us=41)] == [1, 0]
    assert line_chip.violations() == {}


def test_a_write_goes_to_one_byte(line_chip):
    # XACCL_OFF: the unused bits stay away.
    line_chip.frames(STARTED_US + 200 * np.arange(2), [0xA000 | 0x34, 0xA100 | 0xF2])
    assert read(line_chip, 0x20, 0x21, at_us=STARTED_US + 1000) == [0x0234, 0x0234]
    line_chip.frames([STARTED_US + 3000], [0xA177])
    assert read(line_chip, 0x20, at_us=STARTED_US + 4000) == [0x0734]


def test_a_status_read_clears_and_a_standing_fault_comes_back_with_the_next_update(line_chip):
    line_chip.input(STARTED_US, "supply", 4.7)
    at = STARTED_US + 10_000
    first, second = read(line_chip, 0x3C, 0x3C, at_us=at, period_us=41)
    assert (first, second) == (1, 0)
    assert read(line_chip, 0x3C, at_us=at + 10_000) == [1]
    line_chip.input(at + 20_000, "supply", 5.0)
    # Without a read the supply's bit falls by itself.
    assert read(line_chip, 0x3C, at_us=at + 30_000) == [0]


def test_the_sample_clock_and_data_ready_follow_their_registers(line_chip):
    line_chip.frames(STARTED_US + 200 * np.arange(2), [0xB404, 0xB603])  # data-ready, low; SMPL_PRD 3
    begin = STARTED_US + 5000
    edges, level = [], line_chip.dio(begin, 1)
    for k in range(400_000 // 20):
        now = line_chip.dio(begin + 20 * k, 1)
        if now != level:
            edges.append((begin + 20 * k, now))
            level = now
    falls = [at for at, low in edges if not low]
    assert np.diff(falls).mean() == pytest.approx(4 * 610.35, abs=1)
    assert line_chip.dio(begin, 2) == -1
    before = line_chip.updates(begin + 400_000)
    assert line_chip.updates(begin + 800_000) - before == pytest.approx(164, abs=1)


def test_self_test_and_reset_take_their_time(line_chip):
    line_chip.set("self_test_fails", 0x2000)
    line_chip.frames([STARTED_US], [0xB504])
    assert read(line_chip, 0x34, at_us=STARTED_US + 1000) == [0x0400]
    assert read(line_chip, 0x34, 0x3C, at_us=STARTED_US + 36_000) == [0, 0x2020]
    line_chip.frames([STARTED_US + 50_000], [0xBE80])
    assert line_chip.violations() == {}
    read(line_chip, 0x36, at_us=STARTED_US + 51_000)
    assert line_chip.violations() == {"reset_traffic": 2}
    assert read(line_chip, 0x36, at_us=STARTED_US + 51_000 + 160_000) == [1]


def test_what_was_not_saved_is_gone_and_what_was_saved_is_back(line_chip):
    begin = STARTED_US
    line_chip.frames([begin, begin + 200], [0xA011, 0xBE08])  # XACCL_OFF, flash update
    line_chip.frames([begin + 150_000, begin + 150_200], [0xA022, 0xBE80])
    assert read(line_chip, 0x20, 0x00, at_us=begin + 400_000) == [0x0011, 1]


@pytest.mark.parametrize(
    ("kind", "frame"),
    [
        ("clocks", {"clocks": 15}),
        ("clocks", {"clocks": 17}),
        ("clocks", {"clocks": 8}),
        ("mode", {"idle": 0}),
        ("sclk_fast", {"half_us": 0.24}),
        ("sclk_slow", {"half_us": 51}),
        ("setup", {"setup_us": 0.02}),
        ("select", {"half_us": 0.04}),
    ],
)
def test_a_frame_that_breaks_a_rule_is_named(line_chip, kind, frame):
    by_hand(line_chip, 0x3600, at_us=STARTED_US, **frame)
    assert kind in line_chip.violations()


def test_a_sound_frame_breaks_none_and_reads_by_hand(line_chip):
    by_hand(line_chip, 0x3600, at_us=STARTED_US)
    assert by_hand(line_chip, 0x3600, at_us=STARTED_US + 100) == 1
    assert line_chip.violations() == {}


@pytest.mark.parametrize(
    ("smpl_prd", "stall_us", "period_us"), [(1, 9, 40), (9, 9, 40), (10, 75, 160), (128, 75, 160)]
)
def test_stall_and_period_are_judged_by_the_mode(line_chip, smpl_prd, stall_us, period_us):
    line_chip.set("stall_locks", 0)
    line_chip.frames([STARTED_US], [0xB600 | smpl_prd])
    at = STARTED_US + 10_000
    # At 1 MHz or 250 kHz a frame lasts 16 or 64 µs.
    clock_hz, lasts = (1e6, 16.0) if smpl_prd < 10 else (250e3, 64.0)

    def pair(begin, distance):
        before = line_chip.violations()
        line_chip.frames([begin, begin + distance], [0, 0], clock_hz)
        return {kind for kind, count in line_chip.violations().items() if count != before.get(kind)}

    assert pair(at + 2000, period_us + 0.1) == set()
    assert pair(at + 4000, period_us - 0.1) == {"period"}
    assert pair(at + 6000, lasts + stall_us - 0.1) == {"period", "stall"}


def test_after_too_short_a_stall_the_part_is_deaf_until_a_reset(line_chip):
    line_chip.frames([STARTED_US, STARTED_US + 20], [0x3600, 0x3600])
    assert read(line_chip, 0x36, 0x38, at_us=STARTED_US + 1000) == [
        0xFFFF,
        0xFFFF,
    ]  # nobody drives the line
    line_chip.line("rst", STARTED_US + 2000, 0)
    line_chip.line("rst", STARTED_US + 3000, 1)
    assert read(line_chip, 0x36, 0x38, at_us=STARTED_US + 200_000) == [1, 0x0402]


def test_slow_select_after_a_sleep_command_is_named(line_chip):
    line_chip.line("sck", STARTED_US - 1, 1)
    chip, t = line_chip, STARTED_US
    chip.line("cs", t, 0)
    for k in range(16):
        chip.line("sck", t + k + 0.5, 0)
        chip.line("mosi", t + k + 0.5, (0xBA01 >> (15 - k)) & 1)
        chip.line("sck", t + k + 1.0, 1)
    chip.line("cs", t + 16 + 10.1, 1)
    assert chip.violations() == {"sleep_select": 1}


def test_a_frame_during_a_factory_restore_is_named(line_chip):
    line_chip.frames([STARTED_US], [0xBE02])
    read(line_chip, 0x20, at_us=STARTED_US + 50_000)
    assert line_chip.violations() == {"restore_traffic": 2}


@pytest.mark.parametrize(("command", "takes_us"), [(0xBE01, 251_000), (0xBE10, 30_101_000)])
def test_nulling_measures_finer_than_an_output_shows(line_chip, command, takes_us):
    line_chip.input(STARTED_US, "gyro_x", 41.2 * 0.018315)
    begin = STARTED_US + 20_000
    line_chip.frames([begin], [command])
    assert read(line_chip, 0x1A, 0x00, at_us=begin + takes_us) == [-41 & 0x1FFF, 1]
