"""The driver over every bridge's fake: identify, configure, scan; the chip punishes what is wrong."""

import sys

import numpy as np
import pytest

from adis_gonio.bus import BusUrl, cp2130, mcp2210, open_bus, serial, spidev
from adis_gonio.sensor.driver import Adis16354
from adis_gonio.sensor.scanning import PolledScans, StreamedScans
from adis_gonio.sim import SimulatedChip, World
from adis_gonio.sim.chip import State
from fakes.clock import DeviceClock, VirtualClock
from fakes.cp2130_device import Cp2130Device
from fakes.cp2130_usb import FakeUsbBackend, UsbBoard
from fakes.firmware import FakeFirmware
from fakes.mcp2210_device import Mcp2210Device
from fakes.mcp2210_hid import FakeHid, HidBoard
from fakes.pins import ChipPins
from fakes.serial_port import FakePort, PtyBoard
from fakes.spidev_kernel import FakeSpidevKernel

SEED = 4
BRIDGES = ("mcp2210", "cp2130", "spidev", "serial")


def make(kind):
    """A bus of a kind with its chip, both in virtual time."""
    clock = VirtualClock()
    chip = SimulatedChip(World(seed=SEED), start_s=-0.5)
    pins = ChipPins(chip, clock)
    if kind == "mcp2210":
        hid = FakeHid(HidBoard(Mcp2210Device(pins)))
        return mcp2210.open_from_url(BusUrl.parse("mcp2210:"), hid=hid, clock=clock), chip
    if kind == "cp2130":
        backend = FakeUsbBackend(UsbBoard(Cp2130Device(pins)))
        return cp2130.open_from_url(BusUrl.parse("cp2130:"), backend=backend, clock=clock), chip
    if kind == "spidev":
        kernel = FakeSpidevKernel({"/dev/spidev0.0": pins})
        url = BusUrl.parse("spidev:/dev/spidev0.0")
        return spidev.open_from_url(url, system=kernel, clock=clock), chip
    port = FakePort(FakeFirmware(pins))
    return serial.open_from_url(BusUrl.parse("serial:x"), port=port, clock=clock), chip


@pytest.mark.parametrize("kind", BRIDGES)
def test_the_driver_identifies_configures_and_scans(kind):
    bus, chip = make(kind)
    with Adis16354(bus) as sensor:
        assert sensor.read("SMPL_PRD") == 1
        sensor.configure(filter_m=2, gyro_range_dps=150)
        sensor.write("XACCL_OFF", 100)
        block = sensor.read_scans(64)
        norms = np.linalg.norm(block.values()[:, :3], axis=1)
        assert norms.mean() == pytest.approx(1000, abs=60)
        assert sensor.self_test().passed
        assert sensor.status().word & 0x8 == 0, "no frame came too fast"
        sensor.configure(sample_rate_hz=100)
        sensor.read_scans(10, ["XACCL_OUT"])
    assert chip.state is not State.DEAD


@pytest.mark.parametrize("kind", BRIDGES)
def test_what_was_missed_is_counted(kind):
    bus, _ = make(kind)
    with Adis16354(bus) as sensor, sensor.stream(["XACCL_OUT", "ZACCL_OUT"], block_scans=32) as stream:
        assert isinstance(stream, PolledScans)
        blocks = [next(stream) for _ in range(12)]
    scans = sum(len(block) for block in blocks)
    lost = sum(block.lost for block in blocks)
    times = np.concatenate([block.time_s for block in blocks])
    assert scans + lost == pytest.approx((times[-1] - times[0]) * 819.2, abs=5)
    if kind == "spidev":
        assert lost < 0.05 * scans


def test_the_firmware_streams_where_data_ready_is_enabled():
    bus, _ = make("serial")
    with Adis16354(bus) as sensor:
        sensor.configure(data_ready=True)
        with sensor.stream(["XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "XTEMP_OUT"], block_scans=128) as stream:
            assert isinstance(stream, StreamedScans)
            blocks = [next(stream) for _ in range(4)]
        assert sum(block.lost for block in blocks) == 0
        assert sum(len(block) for block in blocks) >= 512
        assert sensor.read("SMPL_PRD") == 1


@pytest.mark.skipif(sys.platform == "win32", reason="a pty needs POSIX")
def test_a_stream_over_a_real_tty_loses_nothing():
    chip = SimulatedChip(World(seed=SEED), start_s=-0.5)
    with (
        PtyBoard(FakeFirmware(ChipPins(chip, DeviceClock()))) as board,
        Adis16354(open_bus(f"serial:{board.path}")) as sensor,
    ):
        sensor.configure(data_ready=True, sample_rate_hz=163.8)
        with sensor.stream(["XACCL_OUT", "ZACCL_OUT"], block_scans=32) as stream:
            blocks = [next(stream) for _ in range(3)]
    times = np.concatenate([block.time_s for block in blocks])
    assert sum(block.lost for block in blocks) == 0
    assert np.diff(times) == pytest.approx(1 / 163.84, rel=0.05)
