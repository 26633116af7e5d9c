"""A bench for each bridge: its fake around a simulated chip in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from adis_gonio.device.bus import BusUrl, SpiBus, cp2130, mcp2210, serial, spidev
from adis_gonio.sim import SimulatedChip, World
from adis_gonio.sim.testing.bus_contract import WatchedChip
from adis_gonio.sim.testing.faults import Faults
from adis_gonio.sim.testing.firmware import SimulatedFirmware
from adis_gonio.sim.testing.pins import ChipPins
from fakes.cp2130_device import Cp2130Device
from fakes.mcp2210_device import Mcp2210Device
from fakes.mcp2210_hid import FakeHid, HidBoard
from fakes.serial_port import FakePort
from fakes.spidev_kernel import FakeSpidevKernel
from fakes.virtual_clock import VirtualClock

SPIDEV_PATH = "/dev/spidev0.0"


def _hang(board: Any, clock: VirtualClock, seconds: float) -> None:
    board.faults = Faults(hang=1.0, hang_s=seconds)
    board.faults.hangs(clock.now_s())
    board.faults.hang = 0.0


def open_bridge(kind: str, options: str = "", seed: int = 4) -> tuple[SpiBus, SimulatedChip]:
    """Open a bus of a kind in virtual time; return it with its chip, which is not watched."""
    clock = VirtualClock()
    chip = SimulatedChip(World(seed=seed), start_s=-0.5)
    pins = ChipPins(chip, clock)
    url = BusUrl.parse(f"{kind}:{options}")
    if kind == "mcp2210":
        return mcp2210.open_from_url(url, hid=FakeHid(HidBoard(Mcp2210Device(pins))), clock=clock), chip
    if kind == "cp2130":
        from fakes.cp2130_usb import FakeUsbBackend, UsbBoard  # needs pyusb

        backend = FakeUsbBackend(UsbBoard(Cp2130Device(pins)))
        return cp2130.open_from_url(url, backend=backend, clock=clock), chip
    if kind == "spidev":
        url = BusUrl.parse(f"spidev:{SPIDEV_PATH}")
        return spidev.open_from_url(url, system=FakeSpidevKernel({SPIDEV_PATH: pins}), clock=clock), chip
    url = BusUrl.parse(f"serial:x{options}")
    return serial.open_from_url(url, port=FakePort(SimulatedFirmware(pins)), clock=clock), chip


class UsbBench:
    """USB boards at ports; `open` takes the URL of one of them."""

    seed: int
    """Seed of every board's world."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.boards: list[Any] = []

    def pins(self) -> ChipPins:
        """Return the pins of a new chip."""
        return ChipPins(WatchedChip(World(seed=self.seed), start_s=-0.5), self.clock)

    @property
    def board(self) -> Any:
        return self.boards[0]

    @property
    def device(self) -> Any:
        return self.board.device

    @property
    def chip(self) -> Any:
        return self.device.pins.chip

    def set_faults(self, faults: Faults) -> None:
        """Let the first board's cable go wrong from now on."""
        self.board.faults = faults

    def silence(self, seconds: float = 0.4) -> None:
        """Let the first board hang from now on."""
        _hang(self.board, self.clock, seconds)

    def reader(self, bus: Any) -> tuple[Any, str]:
        """Return the object and the name of its method by which the bus reads."""
        raise NotImplementedError

    def unplug(self) -> None:
        """Pull the first board out."""
        self.board.plugged = False

    def plug_in(self) -> None:
        """Plug the first board in again."""
        self.board.replug()


class Cp2130Bench(UsbBench):
    """CP2130 boards behind the real pyusb; `otp` goes to each device."""

    seed = 6

    def __init__(self, serials=("A1",), *, faults=None, latency_s=0.1e-3, **otp):
        from fakes.cp2130_usb import FakeUsbBackend, UsbBoard  # needs pyusb

        super().__init__()
        for k, serial_number in enumerate(serials):
            device = Cp2130Device(self.pins(), serial_number, **otp)
            self.boards.append(UsbBoard(device, address=5 + k, faults=faults, latency_s=latency_s))
        self.backend = FakeUsbBackend(*self.boards)

    def reader(self, bus: Any) -> tuple[Any, str]:
        return self.board, "bulk_in"

    def open(self, url: str = "cp2130:") -> SpiBus:
        return cp2130.open_from_url(BusUrl.parse(url), backend=self.backend, clock=self.clock)

    def urls(self) -> list[str]:
        """Return the URLs of the boards that are listed."""
        return [device.url for device in cp2130.find_devices(backend=self.backend)]


class Mcp2210Bench(UsbBench):
    """MCP2210 boards behind a module hid."""

    seed = 5

    def __init__(self, serials=("A1",), *, faults=None, latency_s=0.5e-3):
        super().__init__()
        for k, serial_number in enumerate(serials):
            device = Mcp2210Device(self.pins(), serial_number)
            self.boards.append(HidBoard(device, path=f"1-{k + 1}:1.0", faults=faults, latency_s=latency_s))
        self.hid = FakeHid(*self.boards)

    def reader(self, bus: Any) -> tuple[Any, str]:
        return bus._device, "read"

    def open(self, url: str = "mcp2210:") -> SpiBus:
        return mcp2210.open_from_url(BusUrl.parse(url), hid=self.hid, clock=self.clock)

    def urls(self) -> list[str]:
        """Return the URLs of the boards that are listed."""
        return [device.url for device in mcp2210.find_devices(hid=self.hid)]


class SerialBench:
    """The firmware behind a serial port; `board` goes to the firmware."""

    seed = 8

    def __init__(self, *, faults=None, watched=True, **board):
        self.clock = VirtualClock()
        kind = WatchedChip if watched else SimulatedChip
        self.chip = kind(World(seed=self.seed), start_s=-0.5)
        self.firmware = SimulatedFirmware(ChipPins(self.chip, self.clock), **board)
        self.port = FakePort(self.firmware, faults)

    def open(self, options: str = "") -> SpiBus:
        return serial.open_from_url(BusUrl.parse(f"serial:fake{options}"), port=self.port, clock=self.clock)

    def set_faults(self, faults: Faults) -> None:
        """Let the line go wrong from now on."""
        self.port.faults = faults

    def silence(self, seconds: float = 2.0) -> None:
        """Let the board hang from now on."""
        _hang(self.port, self.clock, seconds)

    def unplug(self) -> None:
        """Pull the board out."""
        self.port.plugged = False

    def plug_in(self) -> None:
        """Plug the board in again: it starts anew."""
        self.port = FakePort(self.firmware)
        self.firmware.restart()


class SpidevBench:
    """A machine with one SPI file; `options` go to its kernel."""

    seed = 7

    def __init__(self, **options):
        self.clock = VirtualClock()
        self.chip = WatchedChip(World(seed=self.seed), start_s=-0.5)
        self.pins = ChipPins(self.chip, self.clock)
        self.kernel = FakeSpidevKernel({SPIDEV_PATH: self.pins}, **options)

    def open(self, options: str = "") -> SpiBus:
        url = BusUrl.parse(f"spidev:{SPIDEV_PATH}{options}")
        return spidev.open_from_url(url, system=self.kernel, clock=self.clock)

    def set_faults(self, faults: Faults) -> None:
        """Let calls of the kernel fail from now on."""
        self.kernel.faults = faults


class StoppedHost:
    """Clock of a host that stops for 5 s at its look number `at` at the clock; its devices work on."""

    def __init__(self, clock: VirtualClock, at: int, work: Callable[[], object] = int) -> None:
        self.sleep_s, self.looks = clock.sleep_s, 0
        self._clock, self._at, self._work = clock, at, work

    def now_s(self) -> float:
        self.looks += 1
        for _ in range(50 if self.looks == self._at else 0):
            self._clock.sleep_s(0.1)
            self._work()
        return self._clock.now_s()
