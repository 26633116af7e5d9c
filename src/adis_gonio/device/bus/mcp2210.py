"""`mcp2210:` - a board with Microchip's MCP2210, by hidapi (extra `hid`).

`mcp2210:` if one board is connected, `mcp2210:SERIAL` if there are several. Options:

| option | meaning | default |
|---|---|---|
| `cs` | GP that is chip select, 0 to 8 | 0 |
| `reset_gpio` | GP on the chip's RST | none |
| `event_counter` | 1: data-ready is wired to GP6 | 0 |
| `timeout_ms` | time for one answer | 250 |
| `backend` | `hidraw` or `libusb`, on Linux | hidraw |
| `path` | the device's path in hidapi, if boards have equal serial numbers | |

A frame is one SPI transaction of two bytes. Reports have 64 bytes each way, little endian; every parser
takes any bytes and either returns their meaning or raises `ProtocolError`.

Timing
    The chip drives CS (chip select) around every transaction. Its own delays have steps of 100 µs and lie
    within the time in which CS is low, so they are set to zero. The host keeps stall and period (see
    `SpiTiming`): it sends a transfer only when stall and period have passed since the answer that reported
    the end of the last frame, which is later than the rise of CS. A frame takes two commands, start and
    fetch. A command is a report each way. The similar MCP2221 of the same maker exchanges 500 reports a
    second at xHCI controllers and 333 at EHCI (EasyMCP2221, "USB speed limits"). This would allow at most
    167 to 250 frames a second, at any SPI clock. A fetch with the answer "not yet" (engine started, or
    status 0xF8) costs one more command.
Errors
    HID answers arrive in order and carry the code of their command. After any failure the host cancels the
    transfer and sends a mark, a harmless report with a unique number. It discards all answers up to the
    answer to the mark, so that a late answer is never used for another command. A transfer that was refused
    (busy, stuck engine) has clocked nothing and is tried once more; a transfer that was accepted is never
    repeated. If the device does not take a report, nothing more is sent to it until the bus is used again.
Writes
    If a device takes no report, a write of hidapi fails after 5 s on hidraw (the kernel's limit) and after
    1 s on libusb, whatever `timeout_ms` is.
Not protected
    The data of an answer carry no checksum of their own. On the cable the CRC of USB protects them.
"""

from __future__ import annotations

import contextlib
import importlib
import struct
import sys
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, NamedTuple
from urllib.parse import quote

from adis_gonio.base.errors import (
    BusError,
    BusTimeoutError,
    NotInstalledError,
    ProtocolError,
    UsageError,
    install_extra,
)
from adis_gonio.device.bus import host
from adis_gonio.device.bus.contract import SpiTiming
from adis_gonio.device.bus.opening import BusUrl, Device

VENDOR_ID, PRODUCT_ID = 0x04D8, 0x00DE
REPORT = 64
PINS = 9
BASE_HZ = 12_000_000
SLOWEST_HZ = 1_500
FRAME_BYTES = 2

STARTS_WITHOUT_DATA = True
"""The answer that accepts a transfer carries no data; not confirmed by a document.

The data come with the next answer, even if the bytes were already clocked. This follows from the maker's
example; a board that differs causes the error "data before the transfer has started".
"""

EVENT_PIN = 6
"""GP6, the only pin that can count events."""
COUNT_RISING_EDGES = 0b010
"""Value of bits 3:1 of the chip settings that makes GP6 count rising edges.

It is not confirmed by a document.
"""
EVENT_MODE_MASK = 0b1110


ECHO = 2
"""Index of the byte in the answer to an EEPROM read that repeats the address; not confirmed by a document.

It is the only part of a harmless request that this chip repeats, so it marks a place in the order of
answers.
"""


class Command(IntEnum):
    """Commands that this package sends to the MCP2210; none writes to its NVRAM or EEPROM."""

    CANCEL = 0x11
    EVENTS = 0x12
    GET_CHIP = 0x20
    SET_CHIP = 0x21
    SET_GPIO_VALUES = 0x30
    GET_GPIO_VALUES = 0x31
    SET_GPIO_DIRECTIONS = 0x32
    GET_GPIO_DIRECTIONS = 0x33
    SET_SPI = 0x40
    GET_SPI = 0x41
    TRANSFER = 0x42
    READ_EEPROM = 0x50


DONE, NOT_OWNED, BUSY = 0x00, 0xF7, 0xF8
"""Status of a command, the second byte of its answer.

The command was done, refused for another SPI master, or refused for a transfer that is still running.
"""
STATUS_WORDS = {
    NOT_OWNED: "another master has the SPI bus",
    BUSY: "the SPI engine is busy",
    0xF9: "the command is unknown: is this an MCP2210?",
    0xFA: "a write failed",
    **dict.fromkeys((0xFB, 0xFC, 0xFD), "access denied: the settings are protected"),
}


class Engine(IntEnum):
    """State of the SPI transfer engine: the fourth byte of the answer to a transfer."""

    FINISHED = 0x10
    STARTED = 0x20
    RUNNING = 0x30


class Designation(IntEnum):
    """Function of a pin of the MCP2210: GPIO, chip select, or the dedicated function."""

    GPIO = 0
    CS = 1
    DEDICATED = 2


_CHIP = struct.Struct("<9sHHB")
_SPI = struct.Struct("<IHHHHHHB")
_WORD = struct.Struct("<H")


def request(command: Command, body: bytes = b"") -> bytes:
    """Return the HID report of 64 bytes that carries a command to the device, without a report id.

    `body` has the bytes after the command byte; zeros fill the rest.
    """
    return (bytes([command]) + body).ljust(REPORT, b"\0")


def status_of(answer: bytes, command: Command) -> int:
    """Return the status byte of the answer to a command, after checks of the answer.

    Raises
    ------
    ProtocolError
        The answer has not 64 bytes or belongs to another command.
    """
    if len(answer) != REPORT:
        raise ProtocolError(f"MCP2210: an answer of {len(answer)} bytes instead of {REPORT}")
    if answer[0] != command:
        raise ProtocolError(f"MCP2210: answer to 0x{answer[0]:02X} instead of 0x{command:02X}")
    return answer[1]


def status_words(status: int) -> str:
    """Return the meaning of a status byte in words, for messages."""
    return STATUS_WORDS.get(status, f"status 0x{status:02X}")


def data_of(answer: bytes, command: Command) -> bytes:
    """Return the content of the answer to a command that was done: its bytes from the fifth on.

    Raises
    ------
    ProtocolError
        The answer has not 64 bytes or belongs to another command, or the command was refused.
    """
    if status := status_of(answer, command):
        raise ProtocolError(f"MCP2210: {command.name} is refused: {status_words(status)}")
    return answer[4:]


def unpack(answer: bytes, command: Command, layout: struct.Struct) -> tuple[Any, ...]:
    """Return the values in the content of an answer to `command`; raises the errors of `data_of`."""
    return layout.unpack_from(data_of(answer, command))


def mark(number: int) -> bytes:
    """Return a harmless report whose answer repeats a number (u8), to find its place among late answers.

    It reads a byte of the EEPROM, which is discarded.
    """
    return request(Command.READ_EEPROM, bytes([number]))


def is_mark(answer: bytes, number: int) -> bool:
    """Return True if an answer belongs to the report `mark(number)`."""
    return len(answer) == REPORT and answer[0] == Command.READ_EEPROM and answer[ECHO] == number


class ChipSettings(NamedTuple):
    """Settings of the nine pins in RAM (commands 0x20, 0x21).

    `designations` has a byte for each pin: GPIO, chip select or dedicated function. `outputs` and
    `directions` have a bit for each pin: its level as an output, and 1 if it is an input. `flags` is the
    last byte of the command.
    """

    designations: bytes
    outputs: int
    directions: int
    flags: int


class SpiSettings(NamedTuple):
    """SPI settings in RAM (commands 0x40, 0x41): bit rate, chip-select levels, delays, length, mode.

    The three delays have steps of 100 µs.
    """

    bit_rate_hz: int
    idle_cs: int
    active_cs: int
    cs_to_data: int
    last_to_cs: int
    between: int
    transaction: int
    mode: int


def progress(answer: bytes) -> tuple[Engine, bytes]:
    """Return the state of the SPI engine, and the bytes received since the last answer.

    `answer` is the answer to a transfer. While the engine clocks, it refuses a transfer without data, which
    asks for the received bytes, with status 0xF8 (data sheet DS22288A, figure 3-23); this counts as
    `Engine.STARTED`.

    Raises
    ------
    ProtocolError
        The answer belongs to another command, the transfer was refused, or the content is not possible.
    """
    if status_of(answer, Command.TRANSFER) == BUSY:
        return Engine.STARTED, b""
    data, count, state = data_of(answer, Command.TRANSFER), answer[2], answer[3]
    if count > FRAME_BYTES:
        raise ProtocolError(f"MCP2210: {count} bytes came in for a frame of {FRAME_BYTES}")
    if state not in {*Engine}:
        raise ProtocolError(f"MCP2210: engine state 0x{state:02X} is not defined")
    if state == Engine.STARTED and count:
        raise ProtocolError("MCP2210: data before the transfer has started")
    return Engine(state), data[:count]


AT_ONCE_S = 0.5
"""Time in s after which a write that fails was not taken by the device.

A write without a device fails at once.
"""

_TRIES = 2
"""Number of times that a transfer is sent if the device refuses it."""
_MOST_LATE = 64
"""Largest number of answers to other commands that are discarded before an error is raised."""


class Mcp2210Bus(host.UsbBus):
    """A bus over an open HID device with the MCP2210.

    Parameters
    ----------
    device : hid.device
        The open device; the bus closes it.
    options : UsbOptions
        Pins and time-out. RST is driven low or left floating; GP6 counts events.

    Raises
    ------
    BusError
        The device does not take its settings.
    """

    def __init__(
        self, device: Any, url: str, options: host.UsbOptions, clock: host.Clock = host.WALL
    ) -> None:
        super().__init__(url, options, clock)
        self._device = device
        self._unsure = True
        self._takes_reports = True
        self._marked = 0
        device.set_nonblocking(1)
        self._settle()
        self._set_pins()
        self._timing = self._configure(host.SAFE_TIMING)

    # -- frames --------------------------------------------------------------------------------------

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        if timing.clock_hz < SLOWEST_HZ:
            raise UsageError(f"{self.url}: the slowest clock is {SLOWEST_HZ} Hz, not {timing.clock_hz:g}")
        self._settle()
        # Frames of two bytes in SPI mode 3. The delays are zero, because the host times the frames. The
        # chip divides 12 MHz; the rate is the fastest possible one not above the wanted clock.
        rate, idle = BASE_HZ // -int(-BASE_HZ // timing.clock_hz), (1 << PINS) - 1
        wanted = SpiSettings(rate, idle, idle & ~(1 << self._options.cs), 0, 0, 0, FRAME_BYTES, 3)
        self._set(Command.SET_SPI, _SPI, *wanted)
        got = SpiSettings(*self._get(Command.GET_SPI, _SPI))
        if got[1:] != wanted[1:] or not 0 < got.bit_rate_hz <= timing.clock_hz:
            raise ProtocolError(f"{self.url}: the MCP2210 did not take its settings: {got}")
        return SpiTiming(float(got.bit_rate_hz), timing.stall_us, timing.period_us)

    def _frame(self, frame: int) -> int:
        self._start(frame.to_bytes(FRAME_BYTES, "big"))
        data = b""
        deadline = self._clock.now_s() + self._options.timeout_s
        while True:
            late = self._clock.now_s() > deadline  # a busy host may read the next answer much later
            engine, received = progress(self._ask(Command.TRANSFER))
            data += received
            if engine is Engine.FINISHED:
                break
            if late:
                raise BusTimeoutError(
                    f"{self.url}: the SPI engine does not finish a frame within"
                    f" {self._options.timeout_s:g} s"
                )
        if len(data) != FRAME_BYTES:
            raise ProtocolError(f"{self.url}: a frame ended with {len(data)} of {FRAME_BYTES} bytes")
        return int.from_bytes(data, "big")

    def _start(self, data: bytes) -> None:
        """Start an SPI transaction with these bytes; try once more if the device refuses it.

        A refused transaction has clocked nothing.
        """
        for left in range(_TRIES - 1, -1, -1):
            answer = self._ask(Command.TRANSFER, bytes([len(data), 0, 0]) + data)
            status = status_of(answer, Command.TRANSFER)
            if status == DONE:
                if STARTS_WITHOUT_DATA and progress(answer)[0] is not Engine.STARTED:
                    raise ProtocolError(f"{self.url}: data before the transfer has started")
                return
            if status not in (BUSY, NOT_OWNED):
                raise ProtocolError(f"{self.url}: {status_words(status)}")
            if left:
                self._cancel()
                self._pace.wait(self._timing)
        raise host.busy_error(self.url, f"the SPI side ({status_words(status)})")

    # -- optional capabilities -----------------------------------------------------------------------

    def _pull_reset(self) -> None:
        bit = 1 << (self._options.reset_gpio or 0)
        self._settle()
        (values,) = self._get(Command.GET_GPIO_VALUES, _WORD)
        (inputs,) = self._get(Command.GET_GPIO_DIRECTIONS, _WORD)
        self._set(Command.SET_GPIO_VALUES, _WORD, values & ~bit)
        for directions in (inputs & ~bit, inputs | bit):
            self._set(Command.SET_GPIO_DIRECTIONS, _WORD, directions)
            self.sleep_s(host.RESET_PULSE_S)

    def _count_edges(self) -> int:
        """Return the number of data-ready edges on pin GP6 since the last call."""
        self._settle()
        return int(self._get(Command.EVENTS, _WORD)[0])

    def _set_pins(self) -> None:
        now, options = ChipSettings(*self._get(Command.GET_CHIP, _CHIP)), self._options
        if max(now.designations) > Designation.DEDICATED:
            raise ProtocolError(f"{self.url}: a pin's designation is none of GPIO, CS, dedicated")
        designations, directions, flags = bytearray(now.designations), now.directions, now.flags
        designations[options.cs] = Designation.CS
        if options.reset_gpio is not None:
            designations[options.reset_gpio] = Designation.GPIO
            directions |= 1 << options.reset_gpio
        if options.event_counter:
            designations[EVENT_PIN] = Designation.DEDICATED
            flags = flags & ~EVENT_MODE_MASK | COUNT_RISING_EDGES << 1
        wanted = ChipSettings(bytes(designations), now.outputs, directions, flags)
        if wanted != now:
            self._set(Command.SET_CHIP, _CHIP, *wanted)
        if options.event_counter:
            self._ask(Command.EVENTS)

    # -- reports --------------------------------------------------------------------------------------

    def _get(self, command: Command, layout: struct.Struct) -> tuple[Any, ...]:
        return unpack(self._ask(command), command, layout)

    def _set(self, command: Command, layout: struct.Struct, *values: Any) -> None:
        data_of(self._ask(command, bytes(3) + layout.pack(*values)), command)

    def _ask(self, command: Command, body: bytes = b"") -> bytes:
        """Send a command with the bytes `body` after its code, and return its answer.

        A transfer without a body fetches received bytes. After an error, the next use of the bus first
        brings the device back to a known state.
        """
        report = request(command, body)
        try:
            answer = self._await(report, lambda answer: len(answer) != REPORT or answer[0] == command)
            status_of(answer, command)
        except BaseException:
            self._unsure = True
            raise
        return answer

    def _await(self, report: bytes, is_mine: Callable[[bytes], bool]) -> bytes:
        """Send a report and return the first answer for which `is_mine` is true."""
        while self._read(0):
            pass  # discard late answers
        self._write(report)
        deadline = self._clock.now_s() + self._options.timeout_s
        for _ in range(_MOST_LATE):
            # At least 1 ms, because an answer may have come while the host was too busy to read it.
            answer = self._read(max(1, round(1000 * (deadline - self._clock.now_s()))))
            if not answer:
                raise BusTimeoutError(f"{self.url}: no answer within {self._options.timeout_s:g} s")
            if is_mine(answer):
                return answer  # others are late, of requests that were given up
        raise ProtocolError(f"{self.url}: only answers to other commands; does another program use it?")

    def _write(self, report: bytes) -> None:
        begin_s = self._clock.now_s()
        try:
            sent = self._device.write(b"\0" + report)
        except (OSError, ValueError) as error:
            raise host.gone_error(self.url) from error
        self._takes_reports = sent >= 0
        if sent < 0 and self._clock.now_s() - begin_s > AT_ONCE_S:
            raise BusTimeoutError(f"{self.url}: the device takes no report")
        if sent < 0:
            raise host.gone_error(self.url)

    def _read(self, timeout_ms: int) -> bytes:
        try:
            return bytes(self._device.read(REPORT, timeout_ms))
        except (OSError, ValueError) as error:
            raise host.gone_error(self.url) from error

    # -- after a failure -------------------------------------------------------------------------------

    def _note_failure(self, error: BaseException) -> bool:
        return isinstance(error, BusError) and self._takes_reports

    def _recover(self) -> None:
        self._cancel()

    def _cancel(self) -> None:
        self._ask(Command.CANCEL)
        # The answer may belong to an earlier cancel. Answers keep their order: after the answer to the mark
        # no earlier answer can follow.
        self._marked = (self._marked + 1) & 0xFF
        number = self._marked
        self._await(mark(number), lambda answer: is_mark(answer, number))
        self._pace.done(self._timing)


_BACKENDS = ("hidraw", "libusb")


def open_from_url(url: BusUrl, *, hid: Any = None, clock: host.Clock = host.WALL) -> Mcp2210Bus:
    """Open an MCP2210 board by its URL (see the module's text).

    Parameters
    ----------
    hid : module
        Module to use instead of hidapi; None is hidapi.
    clock : Clock
        The bus's clock.

    Raises
    ------
    UsageError
        An unknown option, or several boards fit.
    NotInstalledError
        hidapi is not installed.
    CannotOpenError
        No such board, no permission, or another program has it.
    """
    options = host.UrlOptions(url, ("cs", "reset_gpio", "event_counter", "timeout_ms", "backend", "path"))
    backend = options.one_of("backend", _BACKENDS)
    usual = host.UsbOptions.of(options, PINS, EVENT_PIN, f"GP{EVENT_PIN}")
    hid = hid or _load(backend)
    boards = _boards(hid)
    wanted = options.text("path")
    fits = [
        board
        for board in boards
        if (not wanted or _path(board) == wanted) and (not url.place or _serial(board) == url.place)
    ]
    board = host.choose_board(url, "such MCP2210" if boards else "MCP2210", fits, boards, _devices)
    with contextlib.ExitStack() as stack:
        device = _open(hid, url.text, board, stack)
        stack.callback(device.close)
        return Mcp2210Bus(device, url.text, usual, clock).take_over(stack)


def find_devices(*, hid: Any = None) -> list[Device]:
    """List the connected MCP2210 boards with the URL of each.

    `hid` is a module to use instead of hidapi; None is hidapi.
    """
    return _devices(_boards(hid or _load(_BACKENDS[0])))


def _load(backend: str) -> Any:
    """Import the hidapi module for a backend, `hidraw` or `libusb`.

    On Linux the package has one module for each. Raises `NotInstalledError` without hidapi.
    """
    names = ["hidraw", "hid"] if sys.platform == "linux" and backend == "hidraw" else ["hid"]
    for name in names:
        with contextlib.suppress(ImportError):
            module = importlib.import_module(name)
            if hasattr(module, "device"):
                return module
            raise NotInstalledError(
                "mcp2210: module 'hid' belongs to package hid, not hidapi: pip uninstall hid;"
                " pip install --force-reinstall hidapi"
            )
    raise NotInstalledError(f"mcp2210: hidapi is not installed: {install_extra('hid')}")


def _open(hid: Any, url: str, board: dict[str, Any], stack: contextlib.ExitStack) -> Any:
    path = _path(board)
    node = _node(path)
    if host.permission_note(node):
        raise host.permission_error(url, node, f"{'hidraw' if 'hidraw' in node else 'usb'} 04d8")
    stack.enter_context(host.locked(node, url))
    device = hid.device()
    try:
        device.open_path(board["path"])
    except OSError:
        # hidapi reports only "open failed": find the reason.
        if not any(_path(other) == path for other in _boards(hid)):
            raise host.missing_error(url, "MCP2210 any more") from None
        raise host.busy_error(url, node) from None
    return device


def _boards(hid: Any) -> list[dict[str, Any]]:
    found = hid.enumerate(VENDOR_ID, PRODUCT_ID)
    return sorted(found, key=lambda board: (_serial(board), _path(board)))


def _path(board: dict[str, Any]) -> str:
    path = board["path"]
    return path.decode(errors="replace") if isinstance(path, bytes) else str(path)


def _serial(board: dict[str, Any]) -> str:
    return str(board.get("serial_number") or "")


def _node(path: str) -> str:
    """Return the device file of a hidapi path: the path itself, or for libusb the file of its USB port."""
    if path.startswith("/"):
        return path
    from pathlib import Path

    port = Path("/sys/bus/usb/devices") / path.partition(":")[0]
    try:
        bus, number = (int((port / name).read_text()) for name in ("busnum", "devnum"))
    except (OSError, ValueError):
        return path
    return f"/dev/bus/usb/{bus:03d}/{number:03d}"


def _devices(boards: Sequence[dict[str, Any]]) -> list[Device]:
    serials = [_serial(board) for board in boards]
    devices = []
    for board, serial in zip(boards, serials, strict=True):
        path = _path(board)
        unique = serial.isalnum() and serials.count(serial) == 1
        place = serial if unique else f"?path={quote(path, safe='/')}"
        name = board.get("product_string") or "MCP2210"
        devices.append(
            Device(f"mcp2210:{place}", f"{name}, HID to SPI, {path}{host.permission_note(_node(path))}")
        )
    return devices
