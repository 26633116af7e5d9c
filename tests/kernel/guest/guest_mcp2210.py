"""`mcp2210:` through the kernel's USB and HID stacks, with both of hidapi's backends."""

import time

import pytest

from adis_gonio.bus import open_bus
from adis_gonio.errors import BusError, BusTimeoutError, CannotOpenError, UsageError
from adis_gonio.sensor import open_sensor
from kernel.bench import Bench

BACKENDS = ("hidraw", "libusb")
HID_IN, HID_OUT = 0x81, 0x01
READ_SUPPLY, SUPPLY_5_V = 0x0200, 2730


def supply_word(bus) -> int:
    return bus.exchange([READ_SUPPLY, 0])[1] & 0xFFF


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_driver_finds_its_chip_and_writes_a_register(bench: Bench, backend: str) -> None:
    bench.plug("mcp2210", "A1")
    with open_sensor(f"mcp2210:?backend={backend}") as sensor:
        assert sensor.quantity("SUPPLY_OUT").value == pytest.approx(5.0, abs=0.1)
        sensor.write("ALM_MAG1", 0x1234)
        assert sensor.read("ALM_MAG1") == 0x1234


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_boards_are_told_apart_by_serial_number(bench: Bench, backend: str) -> None:
    ports = [bench.plug("mcp2210", serial) for serial in ("A1", "B2")]
    with pytest.raises(UsageError, match=r"mcp2210:A1 or mcp2210:B2"):
        open_bus(f"mcp2210:?backend={backend}")
    with open_bus(f"mcp2210:B2?backend={backend}") as bus:
        assert abs(supply_word(bus) - SUPPLY_5_V) < 100
    assert [bench.state(port)["frames"] for port in ports] == [0, 2]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_board_pulled_out_in_the_middle_is_a_clear_error_and_works_when_it_is_back(
    bench: Bench, backend: str
) -> None:
    port = bench.plug("mcp2210", "A1")
    with open_bus(f"mcp2210:?backend={backend}") as bus:
        bench.unplug_after(port, 21)
        start = time.monotonic()
        with pytest.raises(BusError, match=r"mcp2210:"):
            bus.exchange([READ_SUPPLY] * 100)
        assert time.monotonic() - start < 5
        with pytest.raises(BusError):
            bus.exchange([READ_SUPPLY])
    bench.unplug(port)
    with pytest.raises(CannotOpenError, match="no MCP2210 is connected"):
        open_bus(f"mcp2210:?backend={backend}")
    bench.plug("mcp2210", "A1")
    with open_bus(f"mcp2210:?backend={backend}") as bus:
        assert abs(supply_word(bus) - SUPPLY_5_V) < 100


@pytest.mark.parametrize("backend", BACKENDS)
def test_silence_is_a_time_out_and_late_answers_are_nobodys(bench: Bench, backend: str) -> None:
    port = bench.plug("mcp2210", "A1")
    with open_bus(f"mcp2210:?backend={backend}") as bus:
        assert abs(supply_word(bus) - SUPPLY_5_V) < 100
        bench.refuse(port, HID_IN)
        start = time.monotonic()
        with pytest.raises(BusTimeoutError):
            bus.exchange([0x0E00, 0])
        assert time.monotonic() - start < 5
        bench.heal(port)
        assert abs(supply_word(bus) - SUPPLY_5_V) < 100


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_stalled_endpoint_is_a_typed_error_and_the_bus_works_afterwards(
    bench: Bench, backend: str
) -> None:
    port = bench.plug("mcp2210", "A1")
    with open_bus(f"mcp2210:?backend={backend}") as bus:
        bench.stall(port, HID_OUT)
        with pytest.raises(BusError, match=r"mcp2210:"):
            bus.exchange([READ_SUPPLY, 0])
        bench.heal(port)
        assert abs(supply_word(bus) - SUPPLY_5_V) < 100


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_board_in_use_is_refused_to_a_second_program(bench: Bench, backend: str) -> None:
    bench.plug("mcp2210", "A1")
    with open_bus(f"mcp2210:?backend={backend}"), pytest.raises(CannotOpenError, match="busy"):
        open_bus(f"mcp2210:?backend={backend}")
    open_bus(f"mcp2210:?backend={backend}").close()
