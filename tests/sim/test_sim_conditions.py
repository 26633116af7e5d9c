"""STATUS, supply, over-range, alarms and the DIO lines."""

import numpy as np
import pytest

from sim.chip_rig import Host, Quiet

PERIOD = 1 / 819.2


def status(host):
    host.settle(3)
    return host.read(0x3C)


@pytest.mark.parametrize(("supply_v", "bits"), [(4.70, 0x01), (4.75, 0), (5.0, 0), (5.25, 0), (5.30, 0x02)])
def test_supply_limits(supply_v, bits):
    assert status(Host(Quiet(supply_v=supply_v))) == bits


def test_status_is_cleared_by_a_read_and_a_standing_condition_comes_back_with_the_next_update():
    host = Host(Quiet(supply_v=5.3), flash={"SMPL_PRD": 0x80})
    host.settle(2)
    assert host.read(0x3C) == 2
    assert host.read(0x3C) == 0
    host.settle(1.1)
    assert host.read(0x3C) == 2


PASSING = {
    "supply_v": (4.6, 5.0),
    "accel_mg": ((0, 1710.0, 0), (0, 0, 0)),
    "gyro_dps": ((0, 0, 301.0), (0, 0, 0)),
}


@pytest.mark.parametrize("name", PASSING)
def test_supply_and_over_range_bits_fall_by_themselves_at_the_next_update(name):
    host = Host(flash={"SMPL_PRD": 0x09})
    during, after = PASSING[name]
    setattr(host.world, name, during)
    host.settle(3)
    host.chip.run_to(host.now)
    setattr(host.world, name, after)
    assert host.read(0x0A) & 0x4000, "no update since: it still stands"
    host.settle(1.1)
    assert not host.read(0x0A) & 0x4000
    assert host.read(0x3C) == 0


def test_bits_of_a_part_that_does_not_let_them_fall_stay_until_they_are_read():
    host = Host(status_falls=False)
    host.world.supply_v = 4.6
    host.settle(3)
    host.send(0)
    host.world.supply_v = 5.0
    host.settle(50)
    assert host.read(0x3D) == 1
    assert status(host) == 0


def test_an_alarm_stays_in_status_after_its_condition():
    host = Host(Quiet(accel_mg=(800.0, 0, 0)))
    host.write(0x26, 0x8000 | 100)
    host.write(0x2E, 0x0510)
    host.settle(3)
    host.send(0)
    host.world.accel_mg = (0.0, 0.0, 0.0)
    host.settle(50)
    assert host.read(0x3C) == 0x0100


@pytest.mark.parametrize(
    ("accel", "gyro", "part", "bits"),
    [
        ((1700.0, 0, 0), (0, 0, 0), "adis16354", 0),
        ((0, -1710.0, 0), (0, 0, 0), "adis16354", 0x10),
        ((0, 1710.0, 0), (0, 0, 0), "adis16350", 0),
        ((0, 0, 10100.0), (0, 0, 0), "adis16350", 0x10),
        ((0, 0, 0), (0, 0, 300.0), "adis16354", 0),
        ((0, 0, 0), (0, 0, -301.0), "adis16354", 0x10),
    ],
)
def test_over_range(accel, gyro, part, bits):
    assert status(Host(Quiet(accel, gyro), part=part)) == bits


def test_over_range_follows_the_gyro_range():
    host = Host(Quiet(gyro_dps=(80.0, 0, 0)), flash={"SENS_AVG": 0x0104})
    assert status(host) == 0x10


SOURCES = {  # number in ALM_CTRL: (input, value in its unit, its number)
    1: ("supply_v", 5.1, 2785),
    2: ("gyro_dps", (100.0, 0, 0), 1365),
    3: ("gyro_dps", (0, 100.0, 0), 1365),
    4: ("gyro_dps", (0, 0, 100.0), 1365),
    5: ("accel_mg", (800.0, 0, 0), 1712),
    6: ("accel_mg", (0, 800.0, 0), 1712),
    7: ("accel_mg", (0, 0, 800.0), 1712),
    8: ("temperature_c", (40.0, 25, 25), 103),
    9: ("temperature_c", (25, 40.0, 25), 103),
    10: ("temperature_c", (25, 25, 40.0), 103),
    11: ("aux_v", 1.5, 2457),
}


@pytest.mark.parametrize("alarm", [1, 2])
@pytest.mark.parametrize("source", SOURCES)
def test_each_source_of_each_alarm_on_both_sides_of_its_threshold(source, alarm):
    name, value, number = SOURCES[source]
    for greater, threshold, expected in (
        (1, number - 2, True),
        (1, number, False),
        (1, number + 2, False),
        (0, number + 2, True),
        (0, number, False),
        (0, number - 2, False),
    ):
        host = Host(Quiet(accel_mg=(0.0, 0.0, 0.0)))
        setattr(host.world, name, value)
        host.settle(30)
        host.write(0x24 + 2 * alarm, greater << 15 | threshold)
        host.write(0x2E, source << (8 if alarm == 1 else 12) | 0x10)
        assert status(host) == (0x100 << (alarm - 1) if expected else 0)


def test_thresholds_of_signed_sources_are_signed():
    host = Host(Quiet(accel_mg=(-500.0, 0, 0), temperature_c=(10.0, 25, 25)))
    host.write(0x26, 0x0000 | (-900 & 0x3FFF))
    host.write(0x28, 0x0000 | (-100 & 0x0FFF))
    host.write(0x2E, 0x8510)
    assert status(host) == 0x300


def test_no_source_no_alarm():
    host = Host()
    host.write(0x26, 0x0000)
    host.write(0x28, 0x8000)
    for word in (0x0000, 0xCC10, 0xFF00):
        host.write(0x2E, word)
        assert status(host) == 0


def burst(t):
    """One update of 1 g in every 40."""
    tick = np.rint((t - 0.150) / PERIOD).astype(int)
    return np.where((tick % 40 == 0)[:, None], [1000.0, 0, 0], [0.0, 0, 0])


@pytest.mark.parametrize(("filtered", "expected"), [(0x00, 0x100), (0x10, 0)])
def test_an_alarm_looks_at_filtered_or_unfiltered_data(filtered, expected):
    host = Host(Quiet(accel_mg=burst))
    host.write(0x26, 0x8000 | 1000)
    host.write(0x2E, 0x0500 | filtered)
    host.settle(100)
    assert host.read(0x3C) == expected


@pytest.mark.parametrize("filtered", [0x00, 0x10])
@pytest.mark.parametrize(
    ("lsb_a_sample", "greater", "threshold", "expected"),
    [
        (2.1, 1, 2, True),
        (1.9, 1, 2, False),
        (-2.1, 0, -2, True),
        (-1.9, 0, -2, False),
        (-2.1, 1, 0, False),
    ],
)
@pytest.mark.parametrize("samples", [20, 100])
def test_a_rate_alarm_compares_the_mean_change_a_sample(
    lsb_a_sample, greater, threshold, expected, filtered, samples
):
    slope = lsb_a_sample * 0.4672 / PERIOD
    host = Host(Quiet(accel_mg=lambda t: np.stack([slope * (t - 0.5), 0 * t, 0 * t], 1)))
    host.write(0x2A, samples)
    host.write(0x26, greater << 15 | threshold & 0x3FFF)
    host.settle(260)
    host.read(0x3C)
    host.write(0x2E, 0x0540 | filtered)
    assert status(host) == (0x100 if expected else 0)


def test_a_rate_alarm_is_quiet_until_it_has_its_samples():
    host = Host(Quiet(accel_mg=(1000.0, 0, 0)))
    host.write(0x2A, 200)
    host.write(0x26, 0x8000 | 100)
    host.write(0x2E, 0x0550)
    host.write_low(0x36, 0x02)  # empties the taps
    host.settle(150)
    assert host.read(0x3C) == 0


def test_an_alarm_sets_ea():
    host = Host(Quiet(accel_mg=(800.0, 0, 0)))
    host.write(0x26, 0x8000 | 100)
    host.write(0x2E, 0x0510)
    host.settle(3)
    assert host.read(0x0C) & 0x4000


# -- DIO lines ------------------------------------------------------------------------------------


def levels(host, after=0.5):
    """Levels a fraction of a period after the latest update."""
    update = host.chip.next_update_s(host.now)
    host.now = update + after * PERIOD
    return host.chip.dio(host.now)


def test_lines_are_inputs_until_something_drives_them():
    assert levels(Host()) == (None, None)


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        (0x0001, (0, None)),
        (0x0101, (1, None)),
        (0x0202, (None, 1)),
        (0x0203, (0, 1)),
        (0x0100, (None, None)),
    ],
)
def test_general_outputs(word, expected):
    host = Host()
    host.write(0x32, word)
    assert levels(host) == expected


def test_general_inputs_are_read_from_the_lines():
    host = Host()
    host.chip.external_levels = (1, 0)
    assert host.read(0x32) == 0x0100
    host.write(0x32, 0x0001)
    assert host.read(0x32) == 0x0001
    host.chip.external_levels = (0, 1)
    assert host.read(0x32) == 0x0201


@pytest.mark.parametrize("edge", ["first", "last"])
@pytest.mark.parametrize("polarity", [0, 1])
@pytest.mark.parametrize("line", [0, 1])
def test_data_ready_pulses_on_its_line_with_its_polarity(polarity, line, edge):
    host = Host(update_edge=edge)
    host.write_low(0x34, 0x04 | polarity << 1 | line)
    behind, ahead, rest = (levels(host, after)[line] for after in (0.01, 0.99, 0.5))
    pulse, other = (behind, ahead) if edge == "first" else (ahead, behind)
    assert (pulse, other, rest) == (polarity, 1 - polarity, 1 - polarity)
    assert levels(host)[1 - line] is None


@pytest.mark.parametrize("edge", ["first", "last"])
@pytest.mark.parametrize("polarity", [0, 1])
def test_the_time_of_a_data_ready_edge_is_that_at_which_the_line_changes(polarity, edge):
    host = Host(update_edge=edge, data_ready_pulse_s=30e-6)
    host.write_low(0x34, 0x04 | polarity << 1)
    for rising in (False, True):
        update = host.chip.next_update_s(host.now + PERIOD)
        at = update + host.chip.edge_after_update_s(rising=rising)
        before, after = (host.chip.dio(at + dt)[0] for dt in (-1e-6, 1e-6))
        assert (before, after) == (int(not rising), int(rising))
        host.now = at + 1e-5


def test_data_ready_comes_once_an_update():
    host = Host()
    host.write_low(0x34, 0x06)
    before = host.chip.data_ready_edges(host.now)
    assert host.chip.data_ready_edges(host.now + 1.0) - before in (819, 820)
    host.now += 1.0
    host.write_low(0x34, 0x00)
    before = host.chip.data_ready_edges(host.now)
    assert host.chip.data_ready_edges(host.now + 1.0) == before


@pytest.mark.parametrize("polarity", [0, 1])
@pytest.mark.parametrize("line", [0, 1])
def test_an_alarm_drives_its_line_until_status_is_read(polarity, line):
    host = Host(Quiet(accel_mg=(800.0, 0, 0)))
    host.write(0x26, 0x8000 | 100)
    host.write(0x2E, 0x0514 | polarity << 1 | line)
    assert levels(host)[line] == polarity
    host.world.accel_mg = (0.0, 0.0, 0.0)
    host.settle(20)
    assert levels(host)[line] == polarity
    host.read(0x3C)
    assert levels(host)[line] == 1 - polarity
    assert levels(host)[1 - line] is None


def test_data_ready_goes_before_alarm_before_general_output():
    host = Host(Quiet(accel_mg=(800.0, 0, 0)))
    host.write(0x32, 0x0003)
    assert levels(host) == (0, 0)
    host.write(0x26, 0x8000 | 100)
    host.write(0x2E, 0x0516)
    assert levels(host) == (1, 0)
    host.write_low(0x34, 0x04)
    assert levels(host, 0.5) == (1, 0)
    assert levels(host, 0.01) == (0, 0)
    host.read(0x3C)
    host.world.accel_mg = (0.0, 0.0, 0.0)
    host.settle(20)
    host.read(0x3C)
    assert levels(host, 0.5) == (1, 0), "data-ready holds the line, the alarm is over"


@pytest.mark.parametrize("edge", ["first", "last"])
@pytest.mark.parametrize("rising", [False, True])
def test_the_next_edge_is_later_than_the_time_that_is_asked_for(edge, rising):
    chip = Host(update_edge=edge, flash={"MSC_CTRL": 0x04}).chip
    edges = [1.0]
    for _ in range(4):
        edges.append(chip.next_edge_s(edges[-1], rising=rising))
    assert np.diff(edges[1:]) == pytest.approx([PERIOD] * 3, rel=1e-6)
    begin, end = (chip.edge_after_update_s(rising=way) for way in (False, True))
    assert end - begin == pytest.approx(50e-6), "by default"


def test_a_line_has_no_pulse_before_the_first_update():
    chip = Host(start=False, flash={"MSC_CTRL": 0x06}).chip
    assert [chip.dio(0.150 + after)[0] for after in (1e-6, 1e-5, PERIOD - 1e-5)] == [0, 0, 0]
    assert chip.dio(0.150 + PERIOD + 1e-5)[0] == 1
