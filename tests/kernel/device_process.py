"""The process that is the boards: a command and its answer are dictionaries on a connection.

It must not be the client's process: hidapi opens and closes with the interpreter's lock held while the
kernel talks to the device, so a device in the same process could never answer.

| command | meaning |
|---|---|
| plug kind serial port | plug a board in |
| unplug port | pull it out |
| stall port address | halt an endpoint until the host clears it |
| refuse port address | the endpoint does not answer |
| heal port | end stalls and refusals; what waited goes on, late |
| unplug_after port count | pull it out when that many more transfers of data have gone either way |
| state port | figures of the board: frames on the chip's pins, line state, baud rate |
"""

from __future__ import annotations

from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from kernel.boards import BulkBoard, HidBoard, SerialBoard
from kernel.echoes import EchoSerial
from kernel.urb import UsbDevice, plug_in, pull_out

Figures = Callable[[], dict[str, Any]]
Made = tuple[UsbDevice, Figures]


def _mcp2210(serial: str) -> Made:
    from fakes.mcp2210_device import Mcp2210Device

    pins = _pins()
    return HidBoard(Mcp2210Device(pins, serial=serial), serial), lambda: {"frames": pins.transfers}


def _cp2130(serial: str) -> Made:
    from fakes.cp2130_device import Cp2130Device

    pins = _pins()
    return BulkBoard(Cp2130Device(pins, serial=serial), serial), lambda: {"frames": pins.transfers}


def _serial(serial: str) -> Made:
    from adis_gonio.sim.testing.firmware import SimulatedFirmware
    from kernel.firmware_model import FirmwareModel

    pins = _pins()
    board = SerialBoard(FirmwareModel(SimulatedFirmware(pins)), serial)
    return board, lambda: {"frames": pins.transfers}


def _pins() -> Any:
    """A simulated chip at rest; imported late, because the guest takes seconds for numpy."""
    from adis_gonio.sim import SimulatedChip, World
    from adis_gonio.sim.testing.pins import ChipPins, DeviceClock

    world = World(seed=1)
    pins = ChipPins(SimulatedChip(world, world.variant, start_s=-0.5), DeviceClock())
    pins.data_ready_edges()  # the chip lives up to now before anybody waits for it
    return pins


def _echo_serial(serial: str) -> Made:
    board = SerialBoard(EchoSerial(), serial)
    return board, lambda: {"line_state": board.line_state, "baud_rate": board.baud_rate}


KINDS: dict[str, Callable[[str], Made]] = {
    "mcp2210": _mcp2210,
    "cp2130": _cp2130,
    "serial": _serial,
    "echo-serial": _echo_serial,
}


class Boards:
    """What is plugged in, by port."""

    def __init__(self) -> None:
        self._plugged: dict[int, UsbDevice] = {}
        self._figures: dict[int, Figures] = {}
        self._count = 0

    def plug(self, *, kind: str, serial: str, port: int) -> dict[str, Any]:
        """Make a board and plug it in."""
        self._count += 1
        board, self._figures[port] = KINDS[kind](serial)
        self._plugged[port] = board
        plug_in(board, port, number=self._count)
        return {}

    def unplug(self, *, port: int) -> dict[str, Any]:
        """Pull a board out; nothing happens where none is."""
        board = self._plugged.pop(port, None)
        if board is not None:
            pull_out(board)
        return {}

    def stall(self, *, port: int, address: int) -> dict[str, Any]:
        """Halt an endpoint."""
        self._plugged[port].stall(address)
        return {}

    def refuse(self, *, port: int, address: int) -> dict[str, Any]:
        """Make an endpoint deaf or dumb."""
        self._plugged[port].refuse(address)
        return {}

    def heal(self, *, port: int) -> dict[str, Any]:
        """End stalls and refusals."""
        self._plugged[port].heal()
        return {}

    def unplug_after(self, *, port: int, count: int) -> dict[str, Any]:
        """Pull the board out in the middle of what the host does."""
        self._plugged[port].on_transfer(count, lambda: self.unplug(port=port))
        return {}

    def state(self, *, port: int) -> dict[str, Any]:
        """Figures of a board."""
        return self._figures[port]()


def serve(connection: Connection) -> None:
    """Run commands until None is received."""
    boards = Boards()
    while (arguments := connection.recv()) is not None:
        try:
            answer = getattr(boards, arguments.pop("do"))(**arguments)
        except Exception as error:  # whatever it was, the test that asked shall show it
            answer = {"error": f"{type(error).__name__}: {error}"}
        connection.send(answer)
