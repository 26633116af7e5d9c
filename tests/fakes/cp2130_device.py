"""A CP2130 as its firmware behaves: control requests and two bulk pipes; no host, no USB stack.

`control_in`, `control_out`, `bulk_out` and `bulk_in` are all that a USB stack needs, in process or behind
USB/IP. A request that the device does not know raises `StallError`.
"""

import struct
from collections import deque
from dataclasses import dataclass, field

from adis_gonio.sim.testing.pins import ChipPins

VENDOR_ID, PRODUCT_ID = 0x10C4, 0x87A0
WRITE_FIRST, READ_FIRST = (0x01, 0x82), (0x02, 0x81)
"""Endpoints out and in, by the transfer priority in the OTP."""
PACKET = 64
CLOCKS_HZ = (12e6, 6e6, 3e6, 1.5e6, 750e3, 375e3, 187.5e3, 93.75e3)
HEADER = struct.Struct("<HBBI")
READ, WRITE, WRITE_READ, READ_RTR = 0, 1, 2, 4
CHANNELS = 11
FIFO = 256
INPUT, OPEN_DRAIN, PUSH_PULL, CHIP_SELECT = 0, 1, 2, 3
PIN_BITS = (3, 4, 5, 6, 7, 8, 10, 11, 12, 13, 14)
"""Bits of GPIO.0 to GPIO.10 in words of pins; channels count from bit 0."""
EVENT_PIN = 4


class StallError(Exception):
    """The endpoint answers STALL."""


Stall = StallError


@dataclass
class Cp2130Device:
    """The device.

    Attributes
    ----------
    pins : ChipPins
        The chip's wires.
    cs_pin, reset_pin : int
        GPIO that the chip's CS and RST hang on.
    endpoints : tuple of int
        Bulk endpoints out and in: `WRITE_FIRST` or `READ_FIRST`.
    functions : list of int
        What the OTP made of each pin: `CHIP_SELECT`, a GPIO, or 4 and more for the pin's own duty. A GPIO
        request makes a GPIO of any; nothing makes it a chip select again.
    tells_all : bool
        The word of pins in the answer about chip selects holds all that are one, not the selected alone.
    counter_mode : int
        What the OTP made of GPIO.4: 4 counts rising edges, 0 means no counter.
    stuck : bool
        Bulk commands are taken and nothing happens, until a reset.
    short : bool
        The next reply loses its last byte.
    """

    pins: ChipPins
    serial: str = "00A1B2C3"
    cs_pin: int = 0
    reset_pin: int = 5
    endpoints: tuple[int, int] = WRITE_FIRST
    functions: list[int] = field(default_factory=lambda: [CHIP_SELECT] * CHANNELS)
    tells_all: bool = False
    counter_mode: int = 4
    stuck: bool = False
    short: bool = False
    otp_requests: int = 0
    resets: int = 0
    words: bytearray = field(default_factory=lambda: bytearray(CHANNELS))
    selected: list[int] = field(default_factory=lambda: [0] * CHANNELS)
    delays: list[bytes] = field(default_factory=lambda: [bytes(7)] * CHANNELS)

    def __post_init__(self) -> None:
        self._replies: deque[bytes] = deque()
        self._command = b""
        self._mode = self.counter_mode
        self._counter_zero = 0
        self.functions[EVENT_PIN] = self.counter_mode or self.functions[EVENT_PIN]
        self._levels = [1] * CHANNELS

    def usb_reset(self) -> None:
        """The port was reset or the host set a configuration: RAM settings and pipes are empty."""
        self.resets += 1
        self.stuck = False
        self._replies.clear()
        self._command = b""
        self.words = bytearray(CHANNELS)
        self.selected = [0] * CHANNELS
        self.delays = [bytes(7)] * CHANNELS

    def clear_halt(self, endpoint: int) -> None:
        """A halt was cleared; what waited in the pipe stays."""

    # -- control ------------------------------------------------------------------------------------

    def control_in(self, request: int, value: int, index: int, length: int) -> bytes:
        """Vendor request to the host, bmRequestType 0xC0."""
        self._check(request, value, index)
        if request == 0x22:
            levels = sum(1 << bit for bit, level in zip(PIN_BITS, self._levels, strict=True) if level)
            push_pull = sum(
                1 << bit for bit, kind in zip(PIN_BITS, self.functions, strict=True) if kind == PUSH_PULL
            )
            answer = struct.pack(">HH", levels, push_pull)
        elif request == 0x24:
            on = [k for k, state in enumerate(self.selected) if state]
            pins = [k for k in (range(CHANNELS) if self.tells_all else on) if self._is_select(k)]
            answer = struct.pack(">HH", sum(1 << k for k in on), sum(1 << PIN_BITS[k] for k in pins))
        elif request == 0x30:
            answer = bytes(self.words)
        elif request == 0x44:
            edges = self._edges()
            overflow = 0x80 if edges > 0xFFFF else 0
            answer = struct.pack(">BH", self._mode | overflow, edges & 0xFFFF)
        elif request == 0x46:
            answer = b"\0"
        else:
            raise StallError(f"control in 0x{request:02X}")
        return answer[:length]

    def control_out(self, request: int, value: int, index: int, data: bytes) -> None:
        """Vendor request to the device, bmRequestType 0x40."""
        self._check(request, value, index)
        if request == 0x23 and len(data) == 3 and data[0] < CHANNELS and data[1] <= PUSH_PULL:
            self._drive(*data)
        elif request == 0x25 and len(data) == 2 and data[0] < CHANNELS and data[1] <= 2:
            if data[1] == 2:
                self.selected = [0] * CHANNELS
            self.selected[data[0]] = int(data[1] > 0)
        elif request == 0x31 and len(data) == 2 and data[0] < CHANNELS:
            self.words[data[0]] = data[1]
        elif request == 0x33 and len(data) == 8 and data[0] < CHANNELS:
            self.delays[data[0]] = data[1:]
        elif request == 0x45 and len(data) == 3:
            self._mode, count = struct.unpack(">BH", data)
            self._counter_zero = self.pins.data_ready_edges() - count
        else:
            raise StallError(f"control out 0x{request:02X}")

    def _check(self, request: int, value: int, index: int) -> None:
        if 0x60 <= request <= 0x6F:
            self.otp_requests += 1
        if value or index:
            raise StallError("wValue and wIndex are 0")

    def _edges(self) -> int:
        edges = self.pins.data_ready_edges()
        counts = self.functions[EVENT_PIN] == self._mode and self._mode >= 4
        return edges - self._counter_zero if counts else 0

    def _is_select(self, pin: int) -> bool:
        return self.functions[pin] == CHIP_SELECT

    def _reset_is_low(self) -> bool:
        pin = self.reset_pin
        return self.functions[pin] in (OPEN_DRAIN, PUSH_PULL) and not self._levels[pin]

    def _drive(self, pin: int, mode: int, level: int) -> None:
        was_low = self._reset_is_low()
        self.functions[pin], self._levels[pin] = mode, level
        if was_low and not self._reset_is_low():
            self.pins.hard_reset()

    # -- bulk -----------------------------------------------------------------------------------------

    def bulk_out(self, data: bytes) -> None:
        """Bytes to the device; commands may come in pieces."""
        if self.stuck:
            return
        self._command += data
        while len(self._command) >= HEADER.size:
            zero, command, zero_2, length = HEADER.unpack_from(self._command)
            if zero or zero_2 or command not in (READ, WRITE, WRITE_READ, READ_RTR) or length > FIFO:
                self._command = b""
                raise StallError("bulk out")
            size = HEADER.size + (length if command in (WRITE, WRITE_READ) else 0)
            if len(self._command) < size:
                return
            payload, self._command = self._command[HEADER.size : size], self._command[size:]
            if command in (READ, READ_RTR):
                payload = bytes(length)
            reply = self._transfer(payload)
            if command != WRITE:
                if self.short:
                    reply, self.short = reply[:-1], False
                self._replies.extend(reply[k : k + PACKET] for k in range(0, len(reply), PACKET))

    def bulk_in(self) -> bytes | None:
        """Next packet to the host; None where there is none (NAK)."""
        return self._replies.popleft() if self._replies else None

    def _transfer(self, data: bytes) -> bytes:
        channels = [k for k, on in enumerate(self.selected) if on]
        word = self.words[channels[0]] if channels else 0
        return self.pins.transfer(
            data,
            clock_hz=CLOCKS_HZ[word & 7],
            mode=(word >> 4 & 1) << 1 | word >> 5 & 1,
            selected=channels == [self.cs_pin] and self._is_select(self.cs_pin),
        )
