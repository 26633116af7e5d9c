"""Every bridge's transport through the kernel: the same tests for each and for both HID backends."""

import time
from dataclasses import dataclass

import pytest

from adis_gonio.base.errors import BusError, BusTimeoutError, CannotOpenError, UsageError
from adis_gonio.device.bus import Capability, SpiBus, open_bus
from adis_gonio.device.sensor import open_sensor
from kernel.bench import Bench

READ_SUPPLY, SUPPLY_5_V = 0x0200, 2730


@dataclass(frozen=True)
class Bridge:
    """A kind of board, how it is opened and where its data go."""

    name: str
    kind: str
    options: str
    data_in: int
    data_out: int
    unplugged_after: int = 60

    @property
    def any(self) -> str:
        """URL that names no board."""
        return f"{self.kind}:{self.options.format(serial='')}"

    @property
    def check(self) -> bool:
        """Whether the driver's check of the chip, two hundred frames, is left on.

        Not over the serial fake: it needs some 5 ms a frame in the guest, more than a firmware may take for
        its answer. That path is checked with the real firmware, which runs on the host.
        """
        return self.kind != "serial"

    def url(self, serial: str = "A1") -> str:
        """URL of a board by its serial number."""
        return f"{self.kind}:{self.options.format(serial=serial)}"


BRIDGES = (
    Bridge("mcp2210-hidraw", "mcp2210", "{serial}?backend=hidraw", 0x81, 0x01),
    Bridge("mcp2210-libusb", "mcp2210", "{serial}?backend=libusb", 0x81, 0x01),
    Bridge("cp2130", "cp2130", "{serial}", 0x82, 0x01),
    Bridge("serial", "serial", "?serial_number={serial}", 0x83, 0x04, unplugged_after=3),
)
each_bridge = pytest.mark.parametrize("bridge", BRIDGES, ids=lambda bridge: bridge.name)


def supply_is_read(bus: SpiBus) -> bool:
    """A word that only the simulated chip can have given."""
    return abs((bus.exchange([READ_SUPPLY, 0])[1] & 0xFFF) - SUPPLY_5_V) < 100


@each_bridge
def test_two_boards_are_told_apart_and_the_one_in_use_is_refused(bench: Bench, bridge: Bridge) -> None:
    ports = [bench.plug(bridge.kind, serial) for serial in ("A1", "B2")]
    with pytest.raises(UsageError, match=rf"{bridge.kind}:\S+ or {bridge.kind}:\S+"):
        open_bus(bridge.any)
    with open_bus(bridge.url("B2")) as bus:
        assert supply_is_read(bus)
        with pytest.raises(CannotOpenError, match="busy"):
            open_bus(bridge.url("B2"))
    assert [bench.state(port)["frames"] for port in ports] == [0, 2]


@each_bridge
def test_the_driver_works_until_the_board_is_pulled_out_of_a_stream_and_again_when_it_is_back(
    bench: Bench, bridge: Bridge
) -> None:
    port = bench.plug(bridge.kind, "A1")
    with open_sensor(bridge.url(), check=bridge.check) as sensor:
        assert sensor.quantity("SUPPLY_OUT").value == pytest.approx(5.0, abs=0.1)
        sensor.write("ALM_MAG1", 0x1234)
        assert sensor.read("ALM_MAG1") == 0x1234
        if Capability.STREAM in sensor.bus.capabilities:
            # A rate that the guest's fake can keep.
            sensor.configure(sample_rate_hz=5, filter_m=0, data_ready=True)
        with sensor.stream(["XACCL_OUT", "YACCL_OUT", "ZACCL_OUT"], block_scans=4) as stream:
            assert len(next(stream)) > 0
            bench.unplug_after(port, bridge.unplugged_after)
            start = time.monotonic()
            with pytest.raises(BusError, match=f"{bridge.kind}:"):  # noqa: PT012 - any block may be it
                for _ in range(100):
                    next(stream)
            assert time.monotonic() - start < 5
        with pytest.raises(BusError):
            sensor.bus.exchange([READ_SUPPLY])
    bench.unplug(port)
    with pytest.raises(CannotOpenError, match=r"no .+ is connected"):
        open_bus(bridge.url())
    bench.plug(bridge.kind, "A1")
    with open_bus(bridge.url()) as bus:
        assert supply_is_read(bus)


@each_bridge
def test_silence_refusal_and_a_stall_are_typed_errors_and_the_bus_works_afterwards(
    bench: Bench, bridge: Bridge
) -> None:
    port = bench.plug(bridge.kind, "A1")
    with open_bus(bridge.url()) as bus:
        assert supply_is_read(bus)
        # A late answer is nobody's. The kernel gives a write on hidraw 5 s.
        for endpoint, longest_s in ((bridge.data_in, 5), (bridge.data_out, 8)):
            bench.refuse(port, endpoint)
            start = time.monotonic()
            with pytest.raises(BusTimeoutError):
                bus.exchange([0x0E00, 0])
            assert time.monotonic() - start < longest_s
            bench.heal(port)
            assert supply_is_read(bus)
        bench.stall(port, bridge.data_out)
        with pytest.raises(BusError, match=f"{bridge.kind}:"):
            bus.exchange([READ_SUPPLY, 0])
        if bridge.kind != "cp2130":  # its bus clears the halt
            bench.heal(port)
        assert supply_is_read(bus)
        # Not serial: Linux gives a tty 30 s to get rid of its bytes, and nobody but root may shorten that.
        if bridge.kind != "serial":
            bench.refuse(port, bridge.data_out)
            with pytest.raises(BusTimeoutError):
                bus.exchange([0x0E00, 0])
        start = time.monotonic()
    assert time.monotonic() - start < 10
    bench.heal(port)
    with open_bus(bridge.url()) as bus:
        assert supply_is_read(bus)


def test_a_cp2130s_reset_pin_resets_the_chip(bench: Bench) -> None:
    bench.plug("cp2130", "A1")
    with open_bus("cp2130:?reset_gpio=5") as bus:
        assert Capability.HARD_RESET in bus.capabilities
        bus.exchange([0xA634, 0xA712, 0])  # ALM_MAG1 = 0x1234
        assert bus.exchange([0x2600, 0])[1] == 0x1234
        bus.hard_reset()
        bus.sleep_s(0.5)
        assert bus.exchange([0x2600, 0])[1] == 0
