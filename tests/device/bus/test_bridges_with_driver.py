"""The driver over every bridge's fake: identify, configure, scan; the chip punishes what is wrong."""

import contextlib
import sys

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.device.bus import open_bus
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.device.sensor.scanning import PolledScans, StreamedScans
from adis_gonio.sim import SimulatedChip, World, chip as chip_module
from adis_gonio.sim.chip import State
from adis_gonio.sim.testing.doubles import SimulatedBoard
from adis_gonio.sim.testing.firmware import SimulatedFirmware
from adis_gonio.sim.testing.pins import ChipPins, WorkClock
from fakes.benches import StoppedHost, open_bridge

SEED = 4
BRIDGES = ("mcp2210", "cp2130", "spidev", "serial")


@pytest.mark.parametrize("kind", BRIDGES)
def test_the_driver_identifies_configures_and_scans(kind):
    bus, chip = open_bridge(kind)
    with Adis16354(bus) as sensor:
        assert sensor.read("SMPL_PRD") == 1
        sensor.configure(filter_m=2, gyro_range_dps=150)
        sensor.write("XACCL_OFF", 100)
        block = sensor.read_scans(64)
        norms = np.linalg.norm(block.values()[:, :3], axis=1)
        assert norms.mean() == pytest.approx(1000, abs=60)
        assert not sensor.self_test().self_test_failures
        assert sensor.status().word & 0x8 == 0, "no frame came too fast"
        sensor.configure(sample_rate_hz=100)
        sensor.read_scans(10, ["XACCL_OUT"])
    assert chip.state is not State.DEAD


@pytest.mark.parametrize("kind", BRIDGES)
def test_what_was_missed_is_counted(kind):
    bus, _ = open_bridge(kind)
    names = ["XACCL_OUT", "ZACCL_OUT"]
    with Adis16354(bus) as sensor, sensor.stream(names, block_scans=32, leave_registers=True) as stream:
        assert isinstance(stream, PolledScans)
        blocks = [next(stream) for _ in range(12)]
    scans = sum(len(block) for block in blocks)
    lost = sum(block.lost for block in blocks)
    times = np.concatenate([block.time_s for block in blocks])
    assert scans + lost == pytest.approx((times[-1] - times[0]) * 819.2, abs=5)
    if kind == "spidev":
        assert lost < 0.05 * scans


def test_the_firmware_streams_where_data_ready_is_enabled():
    bus, _ = open_bridge("serial")
    with Adis16354(bus) as sensor:
        sensor.configure(data_ready=True)
        with sensor.stream(["XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "XTEMP_OUT"], block_scans=128) as stream:
            assert isinstance(stream, StreamedScans)
            blocks = [next(stream) for _ in range(4)]
        assert sum(block.lost for block in blocks) == 0
        assert sum(len(block) for block in blocks) >= 512
        assert sensor.read("SMPL_PRD") == 1


def watched(kind, options=""):
    """The same with a chip that keeps the writes that its pins saw."""
    bus, chip = open_bridge(kind, options)
    writes = []
    frame = chip.frame

    def watch(word, **how):
        if word & 0x8000:
            writes.append(word)
        return frame(word, **how)

    chip.frame = watch
    return bus, chip, writes


ENABLED = {"serial": 0xC4, "serial rising": 0xC6, "mcp2210": 0xC4}


@pytest.mark.parametrize("kind", ENABLED)
@pytest.mark.parametrize("ending", ["closed", "interrupted", "failed"])
def test_a_stream_enables_data_ready_while_it_runs_and_sets_it_back_however_it_ends(kind, ending):
    options = {"serial": "", "serial rising": "?edge=rising", "mcp2210": "?event_counter=1"}[kind]
    bus, chip, writes = watched(kind.partition(" ")[0], options)
    with Adis16354(bus) as sensor:
        sensor.configure(linear_g=True, origin=True)
        writes.clear()
        error = {"closed": None, "interrupted": KeyboardInterrupt, "failed": ValueError}[ending]
        with (
            contextlib.nullcontext() if error is None else pytest.raises(error),
            sensor.stream(["XACCL_OUT", "YACCL_OUT"], block_scans=16) as stream,
        ):
            assert isinstance(stream, PolledScans if kind == "mcp2210" else StreamedScans)
            assert len(next(stream)) > 0
            assert chip.memory["MSC_CTRL"] == ENABLED[kind]
            if error is not None:
                raise error
        assert chip.memory["MSC_CTRL"] == 0xC0
        assert writes == [0xB400 | ENABLED[kind], 0xB4C0], "the low byte alone, twice"
        assert sensor.read("SMPL_PRD") == 1


def test_a_stream_that_leaves_the_registers_writes_nothing():
    bus, chip, writes = watched("serial")
    with Adis16354(bus) as sensor:
        with sensor.stream(["XACCL_OUT"], leave_registers=True) as stream:
            assert "polling" in stream.how
            assert len(next(stream)) > 0
        assert not writes
        sensor.configure(data_ready=True)
        writes.clear()
        for leave in (False, True):
            with sensor.stream(["XACCL_OUT"], leave_registers=leave) as stream:
                assert "data-ready edge" in stream.how
                assert len(next(stream)) > 0
        assert not writes
    assert chip.memory["MSC_CTRL"] == 0x04


def test_without_the_wire_a_stream_polls_and_data_ready_is_off_again(monkeypatch):
    bus, chip, _ = watched("serial")
    monkeypatch.setattr(ChipPins, "data_ready_edges", lambda pins: 0)
    with Adis16354(bus) as sensor, sensor.stream(["XACCL_OUT"]) as stream:
        assert isinstance(stream, PolledScans)
        assert chip.memory["MSC_CTRL"] == 0
        assert len(next(stream)) > 0


def test_a_stream_that_cannot_begin_sets_data_ready_back():
    bus, chip, _ = watched("serial")
    with Adis16354(bus) as sensor:
        too_many = ["XACCL_OUT"] * 40
        with pytest.raises(UsageError, match="at most 32 frames"):
            sensor.stream(too_many)
        assert chip.memory["MSC_CTRL"] == 0


def test_what_somebody_else_has_set_meanwhile_is_left():
    bus, chip, _ = watched("mcp2210", "?event_counter=1")
    with Adis16354(bus) as sensor:
        with sensor.stream(["XACCL_OUT"]) as stream:
            next(stream)
            sensor.write("MSC_CTRL", 0x07)
        assert chip.memory["MSC_CTRL"] == 0x07


@pytest.mark.parametrize(("options", "exact"), [("", False), ("?event_counter=1", True)])
def test_the_event_counter_counts_by_the_chips_own_clock(monkeypatch, options, exact):
    """The chip samples 4 % faster than its data sheet says, which time alone does not tell."""
    nominal = chip_module.chip_memory.update_period_s
    monkeypatch.setattr(chip_module.chip_memory, "update_period_s", lambda word: nominal(word) / 1.04)
    bus, chip = open_bridge("mcp2210", options)
    with Adis16354(bus) as sensor, sensor.stream(["XACCL_OUT", "ZACCL_OUT"], block_scans=32) as stream:
        first = next(stream)
        begin = chip.data_ready_edges(bus.now_s()) if exact else bus.now_s() * 819.2 * 1.04
        blocks = [next(stream) for _ in range(40)]
        end = chip.data_ready_edges(bus.now_s()) if exact else bus.now_s() * 819.2 * 1.04
    counted = sum(len(block) + block.lost for block in blocks)
    assert first.lost >= 0
    if exact:
        assert counted == pytest.approx(end - begin, abs=12)
    else:
        assert counted < 0.97 * (end - begin)


@pytest.mark.skipif(sys.platform == "win32", reason="a pty needs POSIX")
def test_a_stream_over_a_real_tty_loses_nothing():
    chip = SimulatedChip(World(seed=SEED), start_s=-0.5)
    with (
        SimulatedBoard(SimulatedFirmware(ChipPins(chip, WorkClock()))) as board,
        Adis16354(open_bus(f"serial:{board.path}")) as sensor,
    ):
        sensor.configure(data_ready=True, sample_rate_hz=163.8)
        with sensor.stream(["XACCL_OUT", "ZACCL_OUT"], block_scans=32) as stream:
            blocks = [next(stream) for _ in range(3)]
    times = np.concatenate([block.time_s for block in blocks])
    assert sum(block.lost for block in blocks) == 0
    assert np.diff(times) == pytest.approx(1 / 163.84, rel=0.05)


@pytest.mark.parametrize(
    ("bridge", "count"), [("cp2130:?event_counter=1", 8), ("mcp2210:?event_counter=1", 3), ("spidev:", 8)]
)
def test_a_host_that_stops_at_any_time_of_a_polled_stream_counts_each_update_once(bridge, count):
    kind, _, options = bridge.partition(":")
    for at in range(1, 30):
        bus, _ = open_bridge(kind, options)
        with Adis16354(bus) as sensor:
            sensor.write("SMPL_PRD", 8)
            bus._clock = clock = StoppedHost(bus._clock, at)
            with sensor.stream(block_scans=8) as stream:
                blocks = [next(stream) for _ in range(count)]
            if clock.looks < at:
                break
            times = np.concatenate([block.time_s for block in blocks])
            updates = len(times) + sum(block.lost for block in blocks)
            period_s = sensor.configuration().sample_period_s
        assert updates == pytest.approx(1 + np.ptp(times) / period_s, abs=1.5), at
    assert at > 15
