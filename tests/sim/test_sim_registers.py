"""The register file against the data sheet: defaults, access, widths, byte writes, flash."""

import pytest

from adis_gonio.base.errors import UsageError
from sim.chip_rig import Host, rd, wr

# address: (default, bits that a write changes, bits with a flash copy); written down a second time here,
# from the data sheet, so that a slip in the table is seen.
CONTROL = {
    0x1A: (0, 0x1FFF, 0x1FFF), 0x1C: (0, 0x1FFF, 0x1FFF), 0x1E: (0, 0x1FFF, 0x1FFF),
    0x20: (0, 0x0FFF, 0x0FFF), 0x22: (0, 0x0FFF, 0x0FFF), 0x24: (0, 0x0FFF, 0x0FFF),
    0x26: (0, 0xBFFF, 0xBFFF), 0x28: (0, 0xBFFF, 0xBFFF),
    0x2A: (0, 0x00FF, 0x00FF), 0x2C: (0, 0x00FF, 0x00FF),
    0x2E: (0, 0xFFD7, 0xFFD7), 0x30: (0, 0x0FFF, 0), 0x32: (0, 0x0303, 0),
    0x34: (0, 0x07C7, 0x00C7), 0x36: (1, 0x00FF, 0x00FF), 0x38: (0x0402, 0x0707, 0x0707),
}  # fmt: skip
READ_ONLY = [0x00, *range(0x02, 0x18, 2), 0x3C]
# What the chip does by itself with some bits is not the register file's business here.
HARMLESS = {0x34: 0xFBFF, 0x32: 0xFCFF, 0x2E: 0x00D7}


def pattern(address, word):
    return word & HARMLESS.get(address, 0xFFFF)


@pytest.mark.parametrize("address", CONTROL)
def test_default(address):
    assert Host().read(address) == CONTROL[address][0]


def test_defaults_of_the_registers_that_are_not_written_through():
    host = Host()
    assert host.read(0x3A) == 0
    assert host.read(0x3C) == 0
    assert host.read(0x00) == 0


@pytest.mark.parametrize("word", [0x5A33, 0xA5CC, 0xFFFF, 0x0000])
@pytest.mark.parametrize("address", CONTROL)
def test_a_write_changes_the_bits_that_exist_and_no_others(address, word):
    host = Host()
    word = pattern(address, word)
    host.write_low(address, word & 0xFF)
    host.send(wr(address + 1, word >> 8))
    if address == 0x36:
        host.clock_hz = 250e3
    default, mask, _ = CONTROL[address]
    if address == 0x32:
        assert host.read(address) & 0x0003 == word & 0x0003
        return
    assert host.read(address) == (default & ~mask | word & mask)


@pytest.mark.parametrize("address", CONTROL)
def test_the_low_byte_is_written_at_the_even_and_the_high_byte_at_the_odd_address(address):
    default, mask, _ = CONTROL[address]
    low, high = pattern(address, 0x0055), pattern(address, 0x0500)
    host = Host()
    host.send(wr(address, low))
    assert host.read(address) == (default & ~(mask & 0xFF) | low & mask)
    host = Host()
    host.send(wr(address + 1, high >> 8))
    if address == 0x32:
        return
    assert host.read(address) == (default & ~(mask & 0xFF00) | high & mask)


@pytest.mark.parametrize("address", READ_ONLY)
def test_writes_to_read_only_registers_change_nothing(address):
    host, twin = Host(), Host()
    for k in (0, 1):
        host.send(wr(address + k, 0xFF))
        twin.send(0)
    host.settle(3)
    twin.settle(3)
    assert host.read(address) == twin.read(address)


@pytest.mark.parametrize("address", [0x18, 0x19])
def test_writes_to_the_reserved_address_change_nothing(address):
    host = Host()
    host.send(wr(address, 0xFF))
    assert host.read(0x18) == 0
    assert host.read(0x1A) == 0


@pytest.mark.parametrize("address", CONTROL)
def test_an_unsaved_write_does_not_survive_a_reset(address):
    host = Host()
    host.write(address, pattern(address, 0x0105))
    host.reset()
    assert host.read(address) == CONTROL[address][0]


@pytest.mark.parametrize("address", CONTROL)
def test_a_saved_write_survives_in_the_bits_with_a_flash_copy(address):
    host = Host()
    default, _, flash = CONTROL[address]
    word = pattern(address, 0x0105)
    host.write(address, word)
    before = host.read(0x00)
    host.save()
    assert host.read(0x00) == before + 1
    host.reset()
    assert host.read(address) == (word & flash | default & ~flash)
    host.chip.hard_reset(host.now)
    host.wait(0.2)
    assert host.read(address) == (word & flash | default & ~flash)


def test_a_write_after_saving_is_lost_and_the_saved_value_comes_back():
    host = Host()
    host.write(0x20, 0x123)
    host.save()
    host.write(0x20, 0x7FF)
    host.reset()
    assert host.read(0x20) == 0x123


def test_endurance_wraps_at_32768():
    host = Host(endurance=32767)
    assert host.read(0x00) == 32767
    host.save()
    assert host.read(0x00) == 0


def test_endurance_survives_resets():
    host = Host(endurance=12)
    host.reset()
    host.chip.hard_reset(host.now)
    host.wait(0.2)
    assert host.read(0x00) == 12


def test_a_flash_update_takes_a_hundred_milliseconds():
    host = Host()
    host.write_low(0x3E, 0x08)
    host.wait(0.099)
    assert host.chip.memory["ENDURANCE"] == 0
    host.chip.run_to(host.now)
    assert host.chip.memory["ENDURANCE"] == 0
    host.chip.run_to(host.now + 0.002)
    assert host.chip.memory["ENDURANCE"] == 1


def test_a_flash_update_at_low_supply_saves_nothing_and_says_so():
    host = Host()
    host.write(0x20, 0x123)
    host.world.supply_v = 4.5
    host.settle(3)
    host.save()
    host.world.supply_v = 5.0
    host.settle(3)
    assert host.read(0x3C) == 0x0004, "the failed flash update stays, the low supply is over"
    assert host.read(0x00) == 0
    host.reset()
    assert host.read(0x20) == 0


def test_a_chip_can_come_with_what_was_saved_before():
    host = Host(flash={"XACCL_OFF": 0x0FF, "SMPL_PRD": 0x03}, endurance=4)
    assert host.read(0x20) == 0x0FF
    assert host.read(0x36) == 0x03
    with pytest.raises(UsageError, match="flash copy"):
        Host(flash={"AUX_DAC": 1})
    with pytest.raises(UsageError, match="did you mean"):
        Host(flash={"XACCL_OF": 1})


def test_the_auxiliary_output_waits_for_its_latch_command():
    host = Host()
    host.write(0x30, 0x0FFF)
    assert host.chip.aux_dac_v == 0
    host.write_low(0x3E, 0x04)
    assert host.chip.aux_dac_v == pytest.approx(2.5)
    host.write(0x30, 0x0800)
    assert host.chip.aux_dac_v == pytest.approx(2.5)
    host.reset()
    assert host.chip.aux_dac_v == 0


def test_a_register_is_written_at_the_rise_of_chip_select_of_its_frame():
    host = Host()
    host.send(wr(0x20, 0x11))
    host.send(rd(0x20))
    assert host.send(0) == 0x11
