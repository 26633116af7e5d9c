"""Self-test, autonull, restore, sleep, resets."""

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.sim import State
from sim.chip_rig import Host, Quiet, rd, signed, wr


def start_self_test(host):
    host.send(wr(0x35, 0x04))


def test_the_self_test_takes_35_ms_and_its_bit_clears_itself():
    host = Host()
    start_self_test(host)
    begin = host.now - 200e-6 + 16 / host.clock_hz
    host.now = begin + 34e-3
    assert host.read(0x34) == 0x0400
    host.now = begin + 35.1e-3
    assert host.read(0x34) == 0
    assert host.read(0x3C) == 0


def test_outputs_are_unavailable_during_the_self_test_and_come_back():
    host = Host(Quiet(accel_mg=(1000.0, 0, 0)))
    start_self_test(host)
    host.wait(0.01)
    assert host.read(0x0A) == 0
    host.wait(0.03)
    host.settle(2)
    assert host.read(0x0A) == 0x885C


@pytest.mark.parametrize(
    ("part", "bits"),
    [
        ("zaccl", 0x8020),
        ("yaccl", 0x4020),
        ("xaccl", 0x2020),
        ("zgyro", 0x1020),
        ("ygyro", 0x0820),
        ("xgyro", 0x0420),
    ],
)
def test_a_failed_self_test_names_its_part_in_status(part, bits):
    host = Host(self_test_failures=(part,))
    start_self_test(host)
    host.wait(0.02)
    assert host.read(0x3C) == 0
    host.wait(0.03)
    assert host.read(0x0C) & 0x4000
    assert host.read(0x3C) == bits
    host.settle(3)
    assert host.read(0x3C) == 0


def test_several_parts_can_fail_and_unknown_ones_are_refused():
    host = Host(self_test_failures=("xaccl", "zgyro"))
    start_self_test(host)
    host.wait(0.05)
    assert host.read(0x3C) == 0x3020
    with pytest.raises(UsageError, match="waccl"):
        Host(self_test_failures=("waccl",))


def test_a_self_test_leaves_the_low_byte_of_msc_ctrl_alone():
    host = Host()
    host.write_low(0x34, 0xC6)
    start_self_test(host)
    host.wait(0.05)
    assert host.read(0x34) == 0x00C6


def test_commands_but_a_reset_are_ignored_during_the_self_test():
    host = Host()
    start_self_test(host)
    host.write_low(0x3E, 0x08)
    host.wait(0.2)
    assert host.read(0x00) == 0
    start_self_test(host)
    host.reset()
    assert host.read(0x34) == 0


@pytest.mark.parametrize(("bits", "sign"), [(0x01, 1), (0x02, -1), (0x03, 0)])
def test_the_manual_self_test_moves_gyros_both_ways_and_accelerometers_one_way_only(bits, sign):
    host = Host(Quiet(accel_mg=(0.0, 0.0, 0.0)))
    host.send(wr(0x35, bits))
    host.settle(10)
    accel = [signed(host.read(a), 14) for a in (0x0A, 0x0C, 0x0E)]
    gyro = [signed(host.read(a), 14) for a in (0x04, 0x06, 0x08)]
    assert accel == [max(sign, 0) * round(250 / 0.4672)] * 3
    assert gyro == [sign * round(50 / 0.07326)] * 3
    host.send(wr(0x35, 0))
    host.settle(10)
    assert signed(host.read(0x0A), 14) == 0


def test_linear_g_compensation_takes_the_gs_out_of_the_gyros():
    host = Host(Quiet(accel_mg=(0.0, 0.0, -8000.0), gyro_dps=(0.0, 0.0, -8 * 0.05)), part="adis16350")
    assert signed(host.read(0x08), 14) == round(-0.4 / 0.07326)
    host.write_low(0x34, 0x80)
    host.settle(10)
    assert signed(host.read(0x08), 14) == 0


def gyro_numbers(host):
    host.settle(10)
    return [signed(host.read(a), 14) for a in (0x04, 0x06, 0x08)]


def test_autonull_zeroes_the_gyros_and_saves_by_itself():
    host = Host(Quiet(gyro_dps=(3.0, -2.0, 1.0), accel_mg=(100.0, 0, 0)))
    assert gyro_numbers(host) == [41, -27, 14]
    host.write_low(0x3E, 0x01)
    host.wait(0.2)
    assert gyro_numbers(host) == [0, 0, 0]
    offsets = [signed(host.read(a), 13) for a in (0x1A, 0x1C, 0x1E)]
    assert offsets == [round(-rate / 0.018315) for rate in (3.0, -2.0, 1.0)]
    assert host.read(0x00) == 1
    assert host.read(0x20) == 0
    host.reset()
    assert gyro_numbers(host) == [0, 0, 0]


def test_autonull_replaces_an_offset_that_was_there():
    host = Host(Quiet(gyro_dps=(3.0, 0, 0)), flash={"XGYRO_OFF": 0x0100})
    host.write_low(0x3E, 0x01)
    host.wait(0.2)
    assert gyro_numbers(host) == [0, 0, 0]


def test_autonull_stops_at_the_limits_of_thirteen_bits():
    host = Host(Quiet(gyro_dps=(90.0, -90.0, 0)))
    host.write_low(0x3E, 0x01)
    host.wait(0.2)
    assert host.read(0x1A) == 0x1000
    assert host.read(0x1C) == 0x0FFF


def test_precision_autonull_averages_over_thirty_seconds():
    def noisy(t):
        return np.stack([2.0 + 20 * np.sign(np.sin(7 * t)), -1.0 + 0 * t, 0 * t], axis=1)

    host = Host(Quiet(gyro_dps=noisy))
    host.write_low(0x3E, 0x10)
    begin = host.now
    host.now = begin + 29.9
    host.chip.run_to(host.now)
    assert host.chip.state is State.NULLING
    assert host.chip.memory["XGYRO_OFF"] == 0
    host.now = begin + 30.2
    assert host.read(0x00) == 1
    assert signed(host.read(0x1A), 13) == pytest.approx(-2.0 / 0.018315, abs=15)
    assert signed(host.read(0x1C), 13) == round(1.0 / 0.018315)


def test_only_a_reset_ends_a_precision_autonull_early():
    host = Host()
    host.write_low(0x3E, 0x10)
    host.wait(1.0)
    host.write(0x20, 0x55)
    host.write_low(0x3E, 0x08)
    assert host.chip.state is State.NULLING
    assert host.read(0x38) != 0x0402
    host.write_low(0x3E, 0x80)
    assert host.chip.state is State.STARTING
    host.wait(0.2)
    assert host.read(0x20) == 0
    assert host.read(0x1A) == 0
    assert host.read(0x00) == 0


def test_the_factory_restore_zeroes_six_offsets_and_saves_by_itself():
    host = Host(flash=dict.fromkeys(("XGYRO_OFF", "ZGYRO_OFF", "XACCL_OFF", "YACCL_OFF"), 257))
    host.write(0x26, 0x0123)
    host.write_low(0x3E, 0x02)
    host.wait(0.2)
    assert [host.read(a) for a in range(0x1A, 0x26, 2)] == [0] * 6
    assert host.read(0x26) == 0x0123
    assert host.read(0x00) == 1
    host.reset()
    assert [host.read(a) for a in range(0x1A, 0x26, 2)] == [0] * 6
    assert host.read(0x26) == 0x0123


def test_of_several_commands_at_once_the_reset_wins():
    host = Host()
    host.write_low(0x3E, 0x88)
    host.wait(0.3)
    assert host.read(0x00) == 0


@pytest.mark.parametrize("count", [1, 4, 20])
def test_sleep_lasts_its_count_of_half_seconds_and_three_ms_of_recovery(count):
    host = Host()
    host.write_low(0x3A, count)
    asleep = host.now - 200e-6 + 16 / host.clock_hz
    host.now = asleep + 0.5 * count - 1e-3
    host.chip.run_to(host.now)
    assert host.chip.state is State.ASLEEP
    updates = len(host.world.times)
    host.chip.run_to(asleep + 0.5 * count + 2.9e-3)
    assert host.chip.state is State.WAKING
    assert len(host.world.times) == updates, "a sleeping part takes no samples"
    host.now = asleep + 0.5 * count + 3.1e-3
    assert host.read(0x38) == 0x0402
    assert host.read(0x3A) == 0


def test_a_pulse_of_chip_select_wakes_the_chip_and_its_frame_is_lost():
    host = Host()
    host.write_low(0x3A, 200)
    host.wait(1.0)
    assert host.chip.frame(0, start_s=host.now, clock_hz=250e3, bits=0) == 0xFFFF
    host.wait(1e-3)
    assert host.send(wr(0x20, 0x55)) != 0x0402
    host.wait(3e-3)
    assert host.read(0x20) == 0
    assert host.read(0x38) == 0x0402


def test_the_next_update_of_a_sleeping_chip_comes_after_its_sleep():
    host = Host()
    host.write_low(0x3A, 20)
    expected_s = host.now + 10.003 + 1 / 819.2
    assert host.chip.next_update_s(host.now + 9.9) == pytest.approx(expected_s, abs=1e-3)
    assert host.chip.state is State.RUNNING


def test_a_frame_wakes_the_chip_too():
    host = Host()
    host.write_low(0x3A, 200)
    host.wait(1.0)
    host.send(rd(0x38))
    host.wait(3.2e-3)
    assert host.read(0x38) == 0x0402


@pytest.mark.parametrize(
    ("smpl_prd", "hold_s", "sleeps"),
    [(1, 9e-6, True), (1, 11e-6, False), (10, 79e-6, True), (10, 81e-6, False)],
)
def test_sleep_needs_chip_select_high_soon_after_the_last_clock(smpl_prd, hold_s, sleeps):
    host = Host(flash={"SMPL_PRD": smpl_prd})
    host.chip.frame(wr(0x3A, 1), start_s=host.now, clock_hz=250e3, cs_hold_s=hold_s)
    assert (host.chip.state is State.ASLEEP) is sleeps


def test_a_software_reset_takes_150_ms_and_empties_everything():
    host = Host(Quiet(supply_v=5.3))
    host.settle(3)
    host.write_low(0x3E, 0x80)
    rise = host.now - 200e-6 + 16 / host.clock_hz
    host.chip.run_to(rise + 0.1499)
    assert host.chip.state is State.STARTING
    host.now = rise + 0.1501
    assert host.send(rd(0x0A)) == 0
    assert host.send(rd(0x3C)) == 0, "no update yet, so nothing new"
    assert host.send(0) == 0, "STATUS was emptied"


def test_a_hard_reset_ends_what_was_going_on():
    host = Host()
    host.write_low(0x3E, 0x08)
    host.chip.hard_reset(host.now)
    host.wait(0.2)
    assert host.read(0x00) == 0
    assert host.read(0x38) == 0x0402


def test_after_a_reset_the_filter_starts_from_empty_taps():
    host = Host(Quiet(accel_mg=(1000.0, 0, 0)), flash={"SENS_AVG": 0x0406})
    host.reset()
    host.settle(20)
    assert abs(signed(host.read(0x0A), 14)) < 1000
    host.settle(130)
    assert signed(host.read(0x0A), 14) == 2140
