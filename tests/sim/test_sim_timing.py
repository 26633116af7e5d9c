"""The serial port's limits, on both sides of each, and what follows where one is broken."""

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.sim import SimulatedChip, State
from sim.chip_rig import Host, Quiet, frames_apart, rd, wr

FAST, NORMAL = 0x01, 0x0A
STATUS_SPI = 0x0008


def chip_in(mode, **options):
    """A started chip in a mode, and the time at which the next frame may come."""
    chip = SimulatedChip(Quiet(), flash={"SMPL_PRD": mode}, **options)
    chip.run_to(0.2)
    return chip, 0.2


def two_frames(mode, *, stall_s, clock_hz, at_s=0.2):
    """Reply of the second of two frames that are `stall_s` apart."""
    chip, _ = chip_in(mode)
    chip.frame(rd(0x38), start_s=at_s, clock_hz=clock_hz)
    rise = at_s + 16 / clock_hz
    return chip, chip.frame(0, start_s=rise + stall_s, clock_hz=clock_hz)


@pytest.mark.parametrize(
    ("mode", "stall_us", "clock_hz", "alive"),
    [
        (FAST, 9.0, 500e3, True),
        (FAST, 8.0, 500e3, False),
        (FAST, 8.99, 500e3, False),
        (FAST, 0.0, 100e3, False),
        (NORMAL, 75.0, 100e3, True),
        (NORMAL, 74.99, 100e3, False),
        (NORMAL, 9.0, 100e3, False),
        (0x09, 9.0, 500e3, True),
        (0x80, 9.0, 100e3, False),
        (0x80, 75.0, 100e3, True),
    ],
)
def test_a_short_stall_silences_the_chip_until_a_hard_reset(mode, stall_us, clock_hz, alive):
    chip, reply = two_frames(mode, stall_s=stall_us * 1e-6, clock_hz=clock_hz)
    assert reply == (0x0402 if alive else 0xFFFF)
    if alive:
        return
    later = [chip.frame(rd(0x38), start_s=1.0 + k * 1e-3, clock_hz=100e3) for k in range(3)]
    assert later == [0xFFFF] * 3
    chip.frame(wr(0x3E, 0x80), start_s=2.0, clock_hz=100e3)
    assert chip.frame(0, start_s=2.5, clock_hz=100e3) == 0xFFFF
    chip.hard_reset(3.0)
    chip.frame(rd(0x38), start_s=3.2, clock_hz=100e3)
    assert chip.frame(0, start_s=3.201, clock_hz=100e3) == 0x0402


def test_a_stall_of_exactly_nine_microseconds_passes_at_any_time_in_spite_of_rounding():
    clock_hz = 16 / 31e-6  # with it, a period of 40 us leaves a stall of 9 us to the last digit
    for at_s in np.random.default_rng(1).uniform(0.2, 1e5, 40):
        chip = SimulatedChip(Quiet(), start_s=at_s - 0.2)
        replies = frames_apart(
            chip, np.full(50, rd(0x38), np.uint16), start_s=at_s, frame_s=40e-6, clock_hz=clock_hz
        )
        assert (replies[1:] == 0x0402).all()


def test_eight_microseconds_are_punished_in_a_batch_too():
    chip, now = chip_in(FAST)
    clock_hz = 16 / 32e-6
    words = np.full(20, rd(0x38), np.uint16)
    replies = frames_apart(chip, words, start_s=now, frame_s=40e-6, clock_hz=clock_hz)
    assert replies[0] == 0
    assert (replies[1:] == 0xFFFF).all()
    assert chip.state is State.DEAD


def test_the_floating_word_can_be_chosen():
    chip, now = chip_in(FAST, floating_word=0)
    chip.frame(rd(0x38), start_s=now, clock_hz=500e3)
    assert chip.frame(0, start_s=now + 33e-6, clock_hz=500e3) == 0
    assert chip.state is State.DEAD


@pytest.mark.parametrize(
    ("mode", "clock_hz", "good"),
    [
        (FAST, 2e6, True),
        (FAST, 2.001e6, False),
        (FAST, 10e3, True),
        (FAST, 9.99e3, False),
        (0x09, 2e6, True),
        (NORMAL, 300e3, True),
        (NORMAL, 300.1e3, False),
        (NORMAL, 2e6, False),
        (NORMAL, 10e3, True),
        (NORMAL, 9.9e3, False),
        (0x80, 300e3, True),
        (0x80, 1e6, False),
        (0xFF, 1e6, False),
    ],
)
def test_a_clock_outside_the_mode_garbles_the_frame_and_sets_status(mode, clock_hz, good):
    chip, now = chip_in(mode)
    chip.frame(rd(0x38), start_s=now, clock_hz=100e3)
    garbled = chip.frame(wr(0x20, 0x55), start_s=now + 0.01, clock_hz=clock_hz)
    assert (garbled == 0x0402) is good
    assert (chip.memory["XACCL_OFF"] == 0x55) is good
    chip.frame(rd(0x3C), start_s=now + 0.02, clock_hz=100e3)
    assert chip.frame(0, start_s=now + 0.03, clock_hz=100e3) == (0 if good else STATUS_SPI)


@pytest.mark.parametrize(
    ("mode", "clock_hz", "period_us", "good"),
    [
        (FAST, 2e6, 40.0, True),
        (FAST, 2e6, 39.0, False),
        (FAST, 1e6, 39.99, False),
        (NORMAL, 300e3, 160.0, True),
        (NORMAL, 300e3, 159.99, False),
        (NORMAL, 300e3, 140.0, False),
    ],
)
def test_a_short_frame_period_repeats_the_reply_before_and_sets_status(mode, clock_hz, period_us, good):
    chip, now = chip_in(mode)
    chip.frame(rd(0x38), start_s=now, clock_hz=100e3)
    assert chip.frame(rd(0x32), start_s=now + 0.01, clock_hz=clock_hz) == 0x0402
    reply = chip.frame(rd(0x3C), start_s=now + 0.01 + period_us * 1e-6, clock_hz=clock_hz)
    assert reply == (0 if good else 0x0402)
    assert chip.frame(0, start_s=now + 0.02, clock_hz=100e3) == (0 if good else STATUS_SPI)


@pytest.mark.parametrize("bits", [1, 8, 15, 17, 32])
def test_a_frame_of_another_length_is_ignored_and_sets_status(bits):
    chip, now = chip_in(FAST)
    chip.frame(wr(0x20, 0x55), start_s=now, clock_hz=250e3, bits=bits)
    assert chip.memory["XACCL_OFF"] == 0
    chip.frame(rd(0x3C), start_s=now + 0.01, clock_hz=250e3)
    assert chip.frame(0, start_s=now + 0.02, clock_hz=250e3) == STATUS_SPI


@pytest.mark.parametrize(("bits", "word"), [(8, 0x04), (12, 0x040), (17, 0x0804), (20, 0x4020)])
def test_a_frame_of_another_length_gets_as_many_bits_of_the_reply(bits, word):
    chip, now = chip_in(FAST)
    chip.frame(rd(0x38), start_s=now, clock_hz=250e3)
    assert chip.frame(0, start_s=now + 0.01, clock_hz=250e3, bits=bits) == word


def test_a_frame_before_the_time_of_the_chip_is_refused():
    chip, _ = chip_in(FAST)
    chip.run_to(1.0)
    with pytest.raises(UsageError, match="already simulated until 1 s"):
        chip.frame(rd(0x38), start_s=0.9, clock_hz=250e3)


def test_outputs_during_a_self_test_show_an_earlier_error():
    chip, now = chip_in(FAST)
    chip.frame(wr(0x35, 0x04), start_s=now, clock_hz=250e3)
    chip.frame(rd(0x0A), start_s=now + 0.01, clock_hz=250e3)
    assert chip.frame(0, start_s=now + 0.011, clock_hz=250e3, bits=15) == 0
    chip.frame(rd(0x0A), start_s=now + 0.012, clock_hz=250e3)
    assert chip.frame(0, start_s=now + 0.013, clock_hz=250e3) == 0x4000


def test_a_pulse_of_chip_select_without_a_clock_does_nothing():
    chip, now = chip_in(FAST)
    chip.frame(rd(0x38), start_s=now, clock_hz=250e3)
    chip.frame(0, start_s=now + 0.01, clock_hz=250e3, bits=0)
    assert chip.frame(rd(0x3C), start_s=now + 0.02, clock_hz=250e3) == 0x0402
    assert chip.frame(0, start_s=now + 0.03, clock_hz=250e3) == 0


def test_the_stall_is_counted_from_the_rise_of_chip_select():
    chip, now = chip_in(FAST)
    chip.frame(rd(0x38), start_s=now, clock_hz=500e3, cs_hold_s=20e-6)
    assert chip.frame(0, start_s=now + 32e-6 + 20e-6 + 5e-6, clock_hz=500e3) == 0xFFFF


def test_the_limits_follow_smpl_prd_at_once():
    host = Host()
    host.write_low(0x36, 0x0A)
    chip = host.chip
    chip.frame(rd(0x38), start_s=host.now, clock_hz=300e3)
    assert chip.frame(0, start_s=host.now + 160e-6, clock_hz=300e3) == 0x0402
    chip.frame(rd(0x38), start_s=host.now + 1e-3, clock_hz=1e6)
    chip.frame(rd(0x3C), start_s=host.now + 2e-3, clock_hz=300e3)
    assert chip.frame(0, start_s=host.now + 3e-3, clock_hz=300e3) == STATUS_SPI


@pytest.mark.parametrize("at_s", [0.0, 0.1, 0.1499])
def test_a_frame_during_the_start_up_spoils_the_chip(at_s):
    host = Host(start=False)
    host.wait(at_s)
    assert host.send(0) == 0xFFFF
    host.wait(1.0)
    assert host.silent


def test_after_the_start_up_the_chip_answers():
    host = Host(start=False)
    host.wait(0.1501)
    assert host.read(0x38) == 0x0402


@pytest.mark.parametrize("pause_s", [0.001, 0.149])
def test_a_frame_during_the_recovery_of_a_software_reset_spoils_the_chip(pause_s):
    host = Host()
    host.write_low(0x3E, 0x80)
    host.wait(pause_s - 200e-6)
    host.send(0)
    host.wait(1.0)
    assert host.silent
    host.chip.hard_reset(host.now)
    host.wait(0.2)
    assert not host.silent


def test_a_frame_during_a_factory_restore_spoils_the_chip():
    host = Host()
    host.write_low(0x3E, 0x02)
    host.wait(0.05)
    host.send(0)
    host.wait(1.0)
    assert host.silent


def test_frames_during_a_flash_update_are_ignored():
    host = Host()
    host.write_low(0x3E, 0x08)
    host.write(0x20, 0x123)
    host.wait(0.2)
    assert host.read(0x20) == 0
    assert host.read(0x00) == 1
