"""Words on the wire: pipelining, ND and EA, word formats, byte addresses."""

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.sim import SimulatedChip
from sim.chip_rig import Host, Quiet, rd, signed, wr

OUTPUTS = {
    "SUPPLY_OUT": 0x02, "XGYRO_OUT": 0x04, "YGYRO_OUT": 0x06, "ZGYRO_OUT": 0x08, "XACCL_OUT": 0x0A,
    "YACCL_OUT": 0x0C, "ZACCL_OUT": 0x0E, "XTEMP_OUT": 0x10, "YTEMP_OUT": 0x12, "ZTEMP_OUT": 0x14,
    "AUX_ADC": 0x16,
}  # fmt: skip
NARROW = (0x02, 0x10, 0x12, 0x14, 0x16)


def test_a_reply_comes_one_frame_late():
    host = Host()
    replies = [host.send(word) for word in (rd(0x36), rd(0x38), rd(0x32), 0)]
    assert replies == [0, 0x0001, 0x0402, 0]


def test_one_g_is_085c_and_minus_one_g_37a4_on_the_16354():
    host = Host(Quiet(accel_mg=(1000.0, -1000.0, -1000.0)))
    assert host.read(0x0A) & 0x3FFF == 0x085C == 2140
    assert host.read(0x0C) & 0x3FFF == 0x37A4
    assert host.read(0x0E) & 0x3FFF == 0x37A4


@pytest.mark.parametrize("part", ["adis16350", "adis16355"])
def test_one_g_is_397_on_the_ten_g_siblings(part):
    host = Host(Quiet(accel_mg=(1000.0, 0.0, -1000.0)), part=part)
    assert host.read(0x0A) & 0x3FFF == 397
    assert signed(host.read(0x0E), 14) == -397


def test_full_range_of_the_16354_is_3639():
    host = Host(Quiet(accel_mg=(1700.0, -1700.0, 0.0)))
    assert signed(host.read(0x0A), 14) == 3639
    assert signed(host.read(0x0C), 14) == -3639


def test_words_stop_at_the_limits_of_their_width():
    host = Host(Quiet((9e4, -9e4, 0.0), (9e4, -9e4, 0.0), (9e4, -9e4, 0.0), 99.0, -1.0))
    assert [signed(host.read(address), 14) for address in (0x0A, 0x0C)] == [8191, -8192]
    assert [signed(host.read(address), 14) for address in (0x04, 0x06)] == [8191, -8192]
    assert [signed(host.read(address), 12) for address in (0x10, 0x12)] == [2047, -2048]
    assert [host.read(address) & 0xFFF for address in (0x02, 0x16)] == [4095, 0]


@pytest.mark.parametrize(
    ("address", "bits", "lsb", "zero"),
    [(0x02, 12, 1.8315e-3, 0.0), (0x16, 12, 0.6105e-3, 0.0)]
    + [(a, 14, 0.07326, 0.0) for a in (4, 6, 8)]
    + [(a, 14, 0.4672, 0.0) for a in (0x0A, 0x0C, 0x0E)]
    + [(a, 12, 0.1453, 25.0) for a in (0x10, 0x12, 0x14)],
)
def test_each_output_has_its_lsb_its_sign_and_its_axis(address, bits, lsb, zero):
    values = dict(zip(OUTPUTS.values(), range(11), strict=True))
    numbers = np.array([2730, 1500, -1400, 1300, 1200, -1100, 1000, 60, -70, 80, 1638], float)
    sizes = np.array([1.8315e-3] + [0.07326] * 3 + [0.4672] * 3 + [0.1453] * 3 + [0.6105e-3])
    inputs = numbers * sizes
    host = Host(Quiet(inputs[4:7], inputs[1:4], inputs[7:10] + 25.0, inputs[0], inputs[10]))
    word = host.read(address)
    number = signed(word, bits) if zero or bits == 14 else word & 0xFFF
    expected = inputs[values[address]] / lsb
    assert number == round(expected) == numbers[values[address]]


def test_five_volts_read_2730():
    assert Host(Quiet(supply_v=5.0)).read(0x02) & 0xFFF == 2730


@pytest.mark.parametrize("address", NARROW)
def test_unused_bits_of_12_bit_words_are_not_zero_so_that_forgetting_the_mask_shows(address):
    for level in range(4):
        host = Host(
            Quiet(temperature_c=np.full(3, 25 + 0.1453 * level), supply_v=5 + 0.0018315 * level, aux_v=0.1)
        )
        assert host.read(address) & 0x3000


def test_nd_is_set_by_an_update_and_cleared_by_reading_that_register_alone():
    host = Host()
    host.settle(3)
    assert host.read(0x0A) >> 15 == 1
    assert host.read(0x0A) >> 15 == 0
    assert host.read(0x0C) >> 15 == 1
    host.settle(1.5)
    assert host.read(0x0A) >> 15 == 1


def test_nd_comes_once_an_update_in_a_long_poll():
    host = Host()
    fresh = [host.send(rd(0x0A)) >> 15 for _ in range(6104)]
    assert sum(fresh) == pytest.approx(6104 * 200e-6 * 819.2, abs=2)


def test_ea_stands_in_every_output_while_a_supply_fault_lasts_and_falls_with_it():
    host = Host()
    assert not any(host.read(address) & 0x4000 for address in OUTPUTS.values())
    host.world.supply_v = 5.3
    host.settle()
    assert all(host.read(address) & 0x4000 for address in OUTPUTS.values())
    host.world.supply_v = 5.0
    host.settle()
    assert not host.read(0x0A) & 0x4000
    assert host.read(0x3C) == 0


def test_ea_of_a_fault_that_stays_goes_only_when_status_is_read():
    host = Host()
    host.chip.frame(rd(0x0A), start_s=host.now, clock_hz=250e3, bits=15)
    host.now += 1e-3
    host.settle()
    assert all(host.read(address) & 0x4000 for address in OUTPUTS.values())
    assert host.read(0x3C) == 0x0008
    assert not host.read(0x0A) & 0x4000


def test_endurance_and_control_words_have_no_flags():
    host = Host(endurance=5)
    host.world.supply_v = 4.0
    host.settle()
    assert host.read(0x0A) & 0x4000
    assert host.read(0x00) == 5
    assert host.read(0x38) == 0x0402


@pytest.mark.parametrize("address", range(0x02, 0x3E, 2))
def test_either_byte_address_reads_the_whole_word(address):
    host = Host()
    host.world.supply_v = 5.1
    host.settle()
    word = host.read(address)
    if address in OUTPUTS.values():
        host.settle(1.5)
    assert host.read(address + 1) == word
    host.chip.hard_reset(host.now)


@pytest.mark.parametrize("address", [0x18, 0x19, 0x3E, 0x3F])
def test_reserved_addresses_and_command_read_zero(address):
    assert Host().read(address) == 0


@pytest.mark.parametrize("data", [0xFF, 0x80, 0x08, 0x02, 0x01])
def test_writing_the_high_byte_of_command_does_nothing(data):
    host = Host()
    host.send(wr(0x20, 0x33))
    host.send(wr(0x3F, data) | (0x4000 if data == 0xFF else 0))
    host.wait(0.3)
    assert host.read(0x20) == 0x33
    assert host.read(0x00) == 0


def test_the_default_idle_frame_is_a_harmless_read_of_endurance():
    host = Host(endurance=77)
    assert host.read(0x00) == 77
    assert [host.send(0) for _ in range(20)] == [77] * 20


def test_the_data_byte_of_a_read_is_ignored():
    host = Host()
    host.send(rd(0x38) | 0xA5)
    assert host.send(0) == 0x0402


def test_a_written_frame_is_answered_by_zero():
    host = Host()
    host.send(rd(0x38))
    host.send(wr(0x20, 0x11))
    assert host.send(0) == 0


def test_time_does_not_run_backwards():
    chip = SimulatedChip(Quiet())
    chip.frame(0, start_s=0.2, clock_hz=250e3)
    with pytest.raises(UsageError, match=r"until 0\.200064 s"):
        chip.frame(0, start_s=0.1, clock_hz=250e3)


def test_updates_come_at_the_period_of_smpl_prd():
    host = Host()
    host.wait(1.0)
    host.send(0)
    times = np.array(host.world.times)
    assert np.allclose(np.diff(times), 1 / 819.2, rtol=1e-12)
    assert times[0] == pytest.approx(0.150 + 1 / 819.2)
