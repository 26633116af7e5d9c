"""`cp2130:` - a board with Silicon Labs' CP2130, by pyusb (extra `usb`).

`cp2130:` if one board is connected, `cp2130:SERIAL` if there are several. Options:

| option | meaning | default |
|---|---|---|
| `cs` | GPIO that is chip select, 0 to 10; the board must have made it one | 0 |
| `reset_gpio` | GPIO on the chip's RST | none |
| `event_counter` | 1: data-ready is wired to the event counter, GPIO.4 | 0 |
| `timeout_ms` | time for one transfer | 250 |
| `bus`, `address` | location of the board, if boards have equal serial numbers | |

A frame is one bulk WriteRead of two bytes. Requests are described in AN792; every parser takes any bytes
and either returns their meaning or raises `ProtocolError`.

Timing
    Within one command the chip lowers CS (chip select), clocks the frame and raises CS. The host keeps
    stall and period (see `SpiTiming`): it sends the next command only when stall and period have passed
    since the last reply arrived, which is later than the rise of CS. Two commands are therefore never
    queued in the chip, which could not handle them. A frame takes one bulk transfer each way: 500 frames a
    second if each transfer waits for its own USB frame (1 ms), 4000 if both together take 0.25 ms. These
    are bounds; none was measured.
Errors
    Bulk replies carry no tag, so a late reply would look like the next one. After a time-out the device
    is therefore reset (USB port reset) and configured again; after any other failure halts of its pipes are
    cleared and replies discarded. A frame is never repeated if its command may have left.
Not protected
    The data carry no checksum of their own. On the cable the CRC of USB protects them.
"""

from __future__ import annotations

import contextlib
import errno
import struct
from collections.abc import Callable, Sequence
from enum import IntEnum
from functools import partial
from typing import Any

from adis_gonio.base.errors import (
    BusError,
    BusTimeoutError,
    CannotOpenError,
    NotInstalledError,
    ProtocolError,
    UsageError,
    install_extra,
)
from adis_gonio.device.bus import host
from adis_gonio.device.bus.contract import Capability, SpiTiming
from adis_gonio.device.bus.opening import BusUrl, Device

VENDOR_ID, PRODUCT_ID = 0x10C4, 0x87A0
TYPE_OUT, TYPE_IN = 0x40, 0xC0
PACKET = 64
CHANNELS = 11
FRAME_BYTES = 2

CLOCKS_HZ = (12e6, 6e6, 3e6, 1.5e6, 750e3, 375e3, 187.5e3, 93.75e3)
"""SPI clocks of the CP2130 in Hz; the index of a clock is its code."""


CPHA_BIT, CPOL_BIT, PUSH_PULL_BIT = 5, 4, 3
"""Positions of three bits in the SPI configuration byte; not confirmed by a document.

Bits 2:0 of the byte are the clock code.
"""

EVENT_PIN = 4
"""GPIO.4, the only pin that can count edges."""
COUNTER_MODES = (4, 5, 6, 7)
"""Codes of the modes in which the event counter counts; not confirmed by a document.

In this order it counts rising edges, falling edges, negative pulses, positive pulses. The function of the
pin is programmed into one-time memory (OTP), at the factory or by the buyer, and never by this package.
"""

PIN_BITS = (3, 4, 5, 6, 7, 8, 10, 11, 12, 13, 14)
"""Bits of GPIO.0 to GPIO.10 in a word of pins; not confirmed by a document.

The reply to `GET_CHIP_SELECT` has two words. In the first, bit k is set if the chip select of channel k is
enabled. In the second, the bits in this tuple are set for the pins that are a chip select.
"""


class ControlRequest(IntEnum):
    """USB control requests that this package sends; none concerns the one-time memory (OTP)."""

    SET_GPIO_MODE = 0x23
    GET_CHIP_SELECT = 0x24
    SET_CHIP_SELECT = 0x25
    GET_SPI_WORD = 0x30
    SET_SPI_WORD = 0x31
    SET_SPI_DELAY = 0x33
    GET_EVENT_COUNTER = 0x44


_OPEN_DRAIN = 1
"""Value of a GPIO pin's mode byte for an open-drain output."""
_THIS_ONE_ONLY = 2
_WRITE_READ = 2
_HEADER = struct.Struct("<HBBI")
_FRAME = struct.Struct(">H")
_COUNTER = struct.Struct(">BH")
"""Mode and count of the event counter; the count wraps."""
_SELECTS = struct.Struct(">HH")
_SPI_WORDS = struct.Struct(f"{CHANNELS}B")


def clock_code(clock_hz: float) -> int | None:
    """Return the index in `CLOCKS_HZ` of the fastest clock not above `clock_hz`; None if all are faster."""
    return next((code for code, clock in enumerate(CLOCKS_HZ) if clock <= clock_hz), None)


def unpack(data: bytes, layout: struct.Struct, what: str) -> tuple[int, ...]:
    """Return the values in a reply; raise `ProtocolError`, which names `what`, if it has another size."""
    if len(data) != layout.size:
        raise ProtocolError(f"CP2130: {what} of {len(data)} bytes instead of {layout.size}")
    return layout.unpack(data)


_DRAIN_MS = 5
_MOST_LATE = 64


class Cp2130Bus(host.UsbBus):
    """A bus over an open USB device with the CP2130.

    Parameters
    ----------
    device : usb.core.Device
        A device of pyusb; its interface 0 is claimed.
    usb_error : type
        Class of the errors of `device`.
    claim : callable
        Called to claim the interface again after a port reset.
    endpoints : tuple of int
        Addresses of the bulk endpoints out and in.
    options : UsbOptions
        The SPI channel has the number of the pin `cs`. RST is driven open-drain. The event counter is
        GPIO.4, which must be configured in the board's OTP.

    Raises
    ------
    UsageError
        The board has no event counter.
    CannotOpenError
        The pin of `cs` is no chip select.
    BusError
        The device does not take its settings.
    """

    def __init__(
        self,
        device: Any,
        usb_error: type[OSError],
        claim: Callable[[], object],
        endpoints: tuple[int, int],
        url: str,
        options: host.UsbOptions,
        clock: host.Clock = host.WALL,
    ) -> None:
        super().__init__(url, options, clock)
        self._device = device
        self._usb_error = usb_error
        self._claim = claim
        self._out_endpoint, self._in_endpoint = endpoints
        self._must_reset = False
        self._drain()
        self._timing = self._configure(host.SAFE_TIMING)
        self._drive_reset(1)
        self._counted = 0
        if options.event_counter:
            mode, self._counted = self._counter()
            if mode not in COUNTER_MODES:
                raise UsageError(f"{url}: GPIO.{EVENT_PIN} of this board is no event counter (see its OTP)")

    # -- frames ----------------------------------------------------------------------------------------

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        code = clock_code(timing.clock_hz)
        if code is None:
            raise UsageError(
                f"{self.url}: the slowest clock is {CLOCKS_HZ[-1]:g} Hz, not {timing.clock_hz:g}"
            )
        self._settle()
        self._set_up(code)
        return SpiTiming(CLOCKS_HZ[code], timing.stall_us, timing.period_us)

    def _set_up(self, code: int) -> None:
        """Set the SPI channel to mode 3 without delays, and enable its push-pull chip select alone.

        `code` is the index of the SPI clock in `CLOCKS_HZ`.
        """
        word, channel = 1 << CPHA_BIT | 1 << CPOL_BIT | 1 << PUSH_PULL_BIT | code, self._options.cs
        self._out(ControlRequest.SET_SPI_WORD, bytes((channel, word)))
        # Without delays and "CS toggle" (per byte) CS stays low for a command: not confirmed by a document.
        # If a scope shows CS rising between the two bytes of a frame, change this mask.
        self._out(ControlRequest.SET_SPI_DELAY, bytes((channel, *[0] * 7)))
        self._out(ControlRequest.SET_CHIP_SELECT, bytes((channel, _THIS_ONE_ONLY)))
        words = unpack(self._in(ControlRequest.GET_SPI_WORD, PACKET), _SPI_WORDS, "SPI words")
        if words[channel] != word:
            raise ProtocolError(f"{self.url}: the CP2130 did not take its SPI word")
        selects = self._in(ControlRequest.GET_CHIP_SELECT, PACKET)
        channels, pins = unpack(selects, _SELECTS, "chip selects")
        if channels & (1 << CHANNELS) - 1 != 1 << channel:
            raise ProtocolError(f"{self.url}: the CP2130 did not take its chip select")
        if not pins >> PIN_BITS[channel] & 1:
            raise CannotOpenError(
                f"{self.url}: GPIO.{channel} of this board is no chip select, by its OTP or until it is"
                " plugged in again: wire CS to another and say which (?cs=)"
            )

    def _frame(self, frame: int) -> int:
        # This command sends a frame and receives the reply at the same time.
        command = _HEADER.pack(0, _WRITE_READ, 0, FRAME_BYTES) + frame.to_bytes(FRAME_BYTES, "big")
        sent = self._call("a frame", self._device.write, self._out_endpoint, command, self._ms)
        if sent != len(command):
            raise ProtocolError(f"{self.url}: only {sent} of {len(command)} bytes of a command were sent")
        return unpack(self._bulk_in(PACKET, self._options.timeout_s), _FRAME, "a frame")[0]

    # -- optional capabilities ---------------------------------------------------------------------------

    def _pull_reset(self) -> None:
        self._settle()
        for level in (0, 1):
            self._drive_reset(level)
            self.sleep_s(host.RESET_PULSE_S)

    def _drive_reset(self, level: int) -> None:
        if self._options.reset_gpio is not None:
            self._out(ControlRequest.SET_GPIO_MODE, bytes((self._options.reset_gpio, _OPEN_DRAIN, level)))

    def _counter(self) -> tuple[int, int]:
        data = self._in(ControlRequest.GET_EVENT_COUNTER, 3)
        mode, count = unpack(data, _COUNTER, "an event counter")
        return mode & 7, count

    def _count_edges(self) -> int:
        """Return the number of data-ready edges since the last call, or since a later port reset."""
        self._settle()
        _, count = self._counter()
        # The counter is never set back, so that a read that fails loses nothing.
        new, self._counted = (count - self._counted) & 0xFFFF, count
        return new

    # -- transfers -----------------------------------------------------------------------------------------

    def _out(self, request: ControlRequest, data: bytes) -> None:
        self._call(request.name, self._device.ctrl_transfer, TYPE_OUT, request, 0, 0, data, self._ms)

    def _in(self, request: ControlRequest, size: int) -> bytes:
        return bytes(
            self._call(request.name, self._device.ctrl_transfer, TYPE_IN, request, 0, 0, size, self._ms)
        )

    def _bulk_in(self, size: int, timeout_s: float) -> bytes:
        ms = round(timeout_s * 1000)
        return bytes(self._call("a reply", self._device.read, self._in_endpoint, size, ms))

    @property
    def _ms(self) -> int:
        return round(self._options.timeout_s * 1000)

    def _call(self, what: str, transfer: Callable[..., Any], *arguments: object) -> Any:
        """Call a method of the USB device and convert its errors to errors of a bus.

        `what` names the operation in the message. `transfer` is the method, with its arguments.
        """
        try:
            return transfer(*arguments)
        except self._usb_error as error:
            raise self._typed(error, what) from error

    def _typed(self, error: OSError, what: str) -> BusError:
        if error.errno in (errno.ENODEV, errno.ENOENT, errno.ESHUTDOWN):
            return host.gone_error(self.url)
        if error.errno in (errno.ETIMEDOUT, 10060):  # the second is Windows'
            return BusTimeoutError(f"{self.url}: no answer to {what} within {self._options.timeout_s:g} s")
        if error.errno == errno.EACCES:
            return CannotOpenError(f"{self.url}: the permission was taken away")
        return ProtocolError(f"{self.url}: {what} failed: {error.strerror or error}")

    # -- after a failure -----------------------------------------------------------------------------------

    def _note_failure(self, error: BaseException) -> bool:
        # After a time-out or an interruption a reply may still come.
        self._must_reset |= isinstance(error, BusTimeoutError) or not isinstance(error, BusError)
        return isinstance(error, BusError) and not isinstance(error, CannotOpenError)

    def _recover(self) -> None:
        if self._must_reset:
            self._reset()
        else:
            self._end_halts()
        self._drain()

    def _reset(self) -> None:
        self._call("a port reset", self._device.reset)
        self._call("claiming the interface", self._claim)
        code = clock_code(self._timing.clock_hz)
        assert code is not None, "the timing in force was configured"
        self._set_up(code)
        self._drive_reset(1)
        if Capability.EVENT_COUNTER in self.capabilities:
            _, self._counted = self._counter()
        self._must_reset = False
        self._pace.done(self._timing)

    def _end_halts(self) -> None:
        for endpoint in (self._in_endpoint, self._out_endpoint):
            self._call("ending a halt", self._device.clear_halt, endpoint)

    def _drain(self) -> None:
        """Read and discard late replies until none comes."""
        for _ in range(_MOST_LATE):
            try:
                self._bulk_in(PACKET, _DRAIN_MS / 1000)
            except BusTimeoutError:
                return
            except ProtocolError:
                self._end_halts()
        raise ProtocolError(f"{self.url}: unexpected replies; does another program use it?")


_INTERFACE = 0


def open_from_url(url: BusUrl, *, backend: Any = None, clock: host.Clock = host.WALL) -> Cp2130Bus:
    """Open a CP2130 board by its URL (see the module's text).

    Parameters
    ----------
    backend : usb.backend.IBackend
        Backend of pyusb to use instead of libusb; None is libusb.
    clock : Clock
        The bus's clock.

    Raises
    ------
    UsageError
        An unknown option, or several boards fit.
    NotInstalledError
        pyusb or libusb-package is not installed.
    CannotOpenError
        No such board, no permission, or another program has it.
    """
    options = host.UrlOptions(url, ("cs", "reset_gpio", "event_counter", "timeout_ms", "bus", "address"))
    usual = host.UsbOptions.of(options, CHANNELS, EVENT_PIN, f"GPIO.{EVENT_PIN}")
    place = options.number_or_none("bus", 0, 999), options.number_or_none("address", 0, 255)
    usb = _load()
    boards = _boards(usb, backend)
    fits = [
        board
        for board in boards
        if place[0] in (None, board.bus)
        and place[1] in (None, board.address)
        and (not url.place or _serial(usb, board) == url.place)
    ]
    if not fits and (denied := [board for board in boards if _serial(usb, board) is None]):
        raise host.permission_error(url.text, _node(denied[0]), "usb 87a0")
    what = "such CP2130" if boards else "CP2130"
    device = host.choose_board(url, what, fits, boards, lambda boards: _devices(usb, boards))

    def claim() -> None:
        usb.util.claim_interface(device, _INTERFACE)

    with contextlib.ExitStack() as stack:
        stack.callback(usb.util.dispose_resources, device)
        try:
            with contextlib.suppress(NotImplementedError):
                if device.is_kernel_driver_active(_INTERFACE):
                    device.detach_kernel_driver(_INTERFACE)
            claim()
            endpoints = _endpoints(usb, url.text, device)
        except usb.core.USBError as error:
            gone = partial(host.gone_error, url.text)
            raise host.opening_error(error, url.text, _node(device), "usb 87a0", gone) from error
        bus = Cp2130Bus(device, usb.core.USBError, claim, endpoints, url.text, usual, clock)
        return bus.take_over(stack)


def find_devices(*, backend: Any = None) -> list[Device]:
    """List the connected CP2130 boards with the URL of each.

    `backend` is a backend of pyusb to use instead of libusb; None is libusb.
    """
    usb = _load()
    return _devices(usb, _boards(usb, backend))


def _load() -> Any:
    try:
        import usb.core
        import usb.util
    except ImportError:
        raise NotInstalledError(f"cp2130: pyusb is not installed: {install_extra('usb')}") from None
    return usb


def _libusb() -> Any:
    """Return a backend of pyusb: the libusb of package libusb-package, or else the libusb of the system."""
    try:
        import libusb_package
    except ImportError:
        import usb.backend.libusb1

        return usb.backend.libusb1.get_backend()
    return libusb_package.get_libusb1_backend()


def _boards(usb: Any, backend: Any) -> list[Any]:
    backend = backend or _libusb()
    if backend is None:
        raise NotInstalledError(f"cp2130: libusb is not installed: {install_extra('usb')}")
    try:
        found = usb.core.find(find_all=True, backend=backend, idVendor=VENDOR_ID, idProduct=PRODUCT_ID)
        return sorted(found, key=lambda board: (board.bus or 0, board.address or 0))
    except usb.core.USBError as error:
        raise ProtocolError(f"cp2130: USB devices cannot be listed: {error.strerror or error}") from error


def _endpoints(usb: Any, url: str, device: Any) -> tuple[int, int]:
    """Return the addresses of the bulk endpoints to and from the board.

    They are read from the USB descriptors: 0x01 and 0x82, or 0x02 and 0x81 if the board's OTP gives reading
    the higher priority.
    """
    interface = usb.util.find_descriptor(
        device.get_active_configuration(), bInterfaceNumber=_INTERFACE, bAlternateSetting=0
    )
    bulk = [
        endpoint.bEndpointAddress
        for endpoint in interface or ()
        if usb.util.endpoint_type(endpoint.bmAttributes) == usb.util.ENDPOINT_TYPE_BULK
    ]
    out = [address for address in bulk if address < usb.util.ENDPOINT_IN]
    back = [address for address in bulk if address >= usb.util.ENDPOINT_IN]
    if len(out) != 1 or len(back) != 1:
        raise ProtocolError(f"{url}: this board has no pair of bulk endpoints: is it a CP2130?")
    return out[0], back[0]


def _serial(usb: Any, board: Any) -> str | None:
    """Return the serial number of a board, which must be opened to read it; None without permission."""
    try:
        return str(board.serial_number or "")
    except (usb.core.USBError, ValueError, NotImplementedError):
        return None
    finally:
        usb.util.dispose_resources(board)


def _node(board: Any) -> str:
    return f"/dev/bus/usb/{board.bus or 0:03d}/{board.address or 0:03d}"


def _devices(usb: Any, boards: Sequence[Any]) -> list[Device]:
    serials = [_serial(usb, board) for board in boards]
    devices = []
    for board, serial in zip(boards, serials, strict=True):
        unique = serial and serial.isalnum() and serials.count(serial) == 1
        place = serial if unique else f"?bus={board.bus}&address={board.address}"
        denied = host.NO_PERMISSION if serial is None else ""
        devices.append(Device(f"cp2130:{place}", f"CP2130, USB to SPI, {_node(board)}{denied}"))
    return devices
