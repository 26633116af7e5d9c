"""The CP2130 as a bus: one bulk WriteRead of two bytes a frame.

Timing
    The chip selects, clocks and deselects within a command; stall and period are kept by the host: the
    next command is only sent when both have passed since the last reply came in, which is later than its
    rise of CS. So a command is never queued behind another, which the chip would not survive. A frame
    takes one bulk transfer each way: 500 frames a second where each waits for a USB frame of its own
    (1 ms), 4000 where both together take 0.25 ms. These are bounds; none was measured.
Errors
    Bulk replies carry no tag, so a late one would look like the next one's. After a time-out the device
    is therefore reset (USB port reset) and set up anew; after any other failure halts of its pipes are
    ended and replies thrown away. A frame whose command may have left is never repeated.
Not protected
    The data carry no checksum of their own. On the cable USB's CRC guards them.
"""

from __future__ import annotations

import errno
import functools
from collections.abc import Callable
from typing import Protocol

import numpy as np

from adis_gonio.base.errors import BusError, BusTimeoutError, CannotOpenError, ProtocolError, UsageError
from adis_gonio.device.bus.contract import Capability, SpiTiming, Words
from adis_gonio.device.bus.cp2130.requests import (
    CLOCKS_HZ,
    COUNTER_MODES,
    EVENT_PIN,
    PACKET,
    TYPE_IN,
    TYPE_OUT,
    ControlRequest,
    GpioMode,
    clock_code,
    delay_request,
    frame_command,
    gpio_request,
    parse_counter,
    parse_frame,
    parse_selects,
    parse_spi_words,
    select_request,
    spi_word,
    spi_word_request,
)
from adis_gonio.device.bus.host import (
    RESET_PULSE_S,
    SAFE_TIMING,
    WALL,
    Clock,
    HostBus,
    gone,
    require_separate_pins,
)

TIMEOUT_S = 0.25
"""Time for one transfer; the chip needs less than 1 ms."""
_DRAIN_MS = 5
_MOST_LATE = 64
_GONE = (errno.ENODEV, errno.ENOENT, errno.ESHUTDOWN)
_LATE = (errno.ETIMEDOUT, 10060)


class UsbDevice(Protocol):
    """What of a pyusb device is used."""

    def ctrl_transfer(
        self,
        bm_request_type: int,
        b_request: int,
        w_value: int,
        w_index: int,
        data_or_length: bytes | int,
        timeout: int,
        /,
    ) -> object:
        """Control transfer; bytes for one to the host."""

    def write(self, endpoint: int, data: bytes, timeout: int, /) -> int:
        """Bulk transfer to the device."""

    def read(self, endpoint: int, size: int, timeout: int, /) -> object:
        """Bulk transfer to the host; an array of bytes."""

    def clear_halt(self, endpoint: int, /) -> None:
        """End a stall."""

    def reset(self) -> None:
        """Reset the port."""


class Cp2130Bus(HostBus):
    """A bus over an open USB device.

    Parameters
    ----------
    device : UsbDevice
        Interface 0 is claimed.
    usb_error : type
        What `device` raises.
    claim : callable
        Claims the interface again after a port reset.
    release : callable
        Called when the bus is closed.
    endpoints : tuple of int
        Bulk endpoints out and in.
    url : str
        For messages.
    cs : int
        GPIO that is chip select, which is also the channel.
    reset_gpio : int or None
        GPIO on the chip's RST, driven open-drain.
    event_counter : bool
        Offer the event counter of GPIO.4, which the board's OTP must have made one.
    timeout_s : float
        Time for one transfer.
    clock : Clock
        The bus's clock.

    Raises
    ------
    UsageError
        Two duties on a pin, or no event counter on this board.
    CannotOpenError
        The pin of `cs` is no chip select.
    BusError
        The device does not take its settings.
    """

    def __init__(
        self,
        device: UsbDevice,
        usb_error: type[OSError],
        *,
        claim: Callable[[], object],
        release: Callable[[], object],
        endpoints: tuple[int, int],
        url: str = "cp2130:",
        cs: int = 0,
        reset_gpio: int | None = None,
        event_counter: bool = False,
        timeout_s: float = TIMEOUT_S,
        clock: Clock = WALL,
    ) -> None:
        super().__init__(url, clock, release)
        self._device = device
        self._usb_error = usb_error
        self._claim = claim
        self._out_endpoint, self._in_endpoint = endpoints
        self._cs = cs
        self._reset_gpio = reset_gpio
        self._timeout_s = timeout_s
        self._unsure = False
        self._must_reset = False
        event = EVENT_PIN if event_counter else None
        require_separate_pins(url, cs, reset_gpio, event, f"GPIO.{EVENT_PIN}")
        self._drain()
        self._timing = self._configure(SAFE_TIMING)
        offered = set()
        self._drive_reset(1)
        if reset_gpio is not None:
            offered.add(Capability.HARD_RESET)
        self._counted = 0
        if event_counter:
            mode, self._counted = parse_counter(self._in(ControlRequest.GET_EVENT_COUNTER, 3))
            if mode not in COUNTER_MODES:
                raise UsageError(f"{url}: GPIO.{EVENT_PIN} of this board is no event counter (see its OTP)")
            offered.add(Capability.EVENT_COUNTER)
        self.capabilities = frozenset(offered)

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
        word = spi_word(code)
        self._out(ControlRequest.SET_SPI_WORD, spi_word_request(self._cs, word))
        self._out(ControlRequest.SET_SPI_DELAY, delay_request(self._cs))
        self._out(ControlRequest.SET_CHIP_SELECT, select_request(self._cs))
        if parse_spi_words(self._in(ControlRequest.GET_SPI_WORD, PACKET))[self._cs] != word:
            raise ProtocolError(f"{self.url}: the CP2130 did not take its SPI word")
        channels, pins = parse_selects(self._in(ControlRequest.GET_CHIP_SELECT, PACKET))
        if channels != {self._cs}:
            raise ProtocolError(f"{self.url}: the CP2130 did not take its chip select")
        if self._cs not in pins:
            raise CannotOpenError(
                f"{self.url}: GPIO.{self._cs} of this board is no chip select, by its OTP or until it is"
                " plugged in again: wire CS to another and say which (?cs=)"
            )

    def _exchange(self, frames: Words) -> Words:
        self._settle()
        replies = np.empty(len(frames), np.uint16)
        try:
            for k, frame in enumerate(frames.tolist()):
                self._pace.wait(self._timing)
                self._bulk_out(frame_command(frame))
                replies[k] = parse_frame(self._bulk_in(PACKET, self._timeout_s))
                self._pace.done(self._timing)
        except BusError as error:
            self._fail(error)
            raise
        except BaseException:  # the operator's Ctrl-C: a reply may still come
            self._unsure = self._must_reset = True
            raise
        return replies

    # -- optional capabilities ---------------------------------------------------------------------------

    def _pull_reset(self) -> None:
        self._settle()
        for level in (0, 1):
            self._drive_reset(level)
            self.sleep_s(RESET_PULSE_S)

    def _drive_reset(self, level: int) -> None:
        if self._reset_gpio is not None:
            mode = gpio_request(self._reset_gpio, GpioMode.OPEN_DRAIN, level)
            self._out(ControlRequest.SET_GPIO_MODE, mode)

    def _count_edges(self) -> int:
        """Edges since the last call or port reset."""
        self._settle()
        _, count = parse_counter(self._in(ControlRequest.GET_EVENT_COUNTER, 3))
        # The counter is never set back, so that a read that fails loses nothing.
        new, self._counted = (count - self._counted) & 0xFFFF, count
        return new

    # -- transfers -----------------------------------------------------------------------------------------

    @property
    def _timeout_ms(self) -> int:
        return max(1, round(self._timeout_s * 1000))

    def _out(self, request: ControlRequest, data: bytes) -> None:
        self._call(
            lambda: self._device.ctrl_transfer(TYPE_OUT, request, 0, 0, data, self._timeout_ms),
            request.name,
        )

    def _in(self, request: ControlRequest, size: int) -> bytes:
        ms = self._timeout_ms
        return _bytes(
            self._call(lambda: self._device.ctrl_transfer(TYPE_IN, request, 0, 0, size, ms), request.name)
        )

    def _bulk_out(self, data: bytes) -> None:
        sent = self._call(lambda: self._device.write(self._out_endpoint, data, self._timeout_ms), "a frame")
        if sent != len(data):
            raise ProtocolError(f"{self.url}: {sent} of {len(data)} bytes of a command left")

    def _bulk_in(self, size: int, timeout_s: float) -> bytes:
        ms = max(1, round(timeout_s * 1000))
        return _bytes(self._call(lambda: self._device.read(self._in_endpoint, size, ms), "a reply"))

    def _call(self, action: Callable[[], object], what: str) -> object:
        try:
            return action()
        except self._usb_error as error:
            raise self._typed(error, what) from error

    def _typed(self, error: OSError, what: str) -> BusError:
        if error.errno in _GONE:
            return gone(self.url)
        if error.errno in _LATE:
            return BusTimeoutError(f"{self.url}: no answer to {what} within {self._timeout_s:g} s")
        if error.errno == errno.EACCES:
            return CannotOpenError(f"{self.url}: the permission was taken away")
        return ProtocolError(f"{self.url}: {what} failed: {error.strerror or error}")

    # -- after a failure -----------------------------------------------------------------------------------

    def _fail(self, error: BusError) -> None:
        """Note what a failure asks for, and do it where the device is there."""
        self._unsure = True
        self._must_reset |= isinstance(error, BusTimeoutError)
        if not isinstance(error, CannotOpenError):
            try:
                self._settle()
            except BusError:
                self._unsure = True  # the first error counts, the next use tries again

    def _settle(self) -> None:
        """Bring the device to a known state where it may not be in one."""
        if not self._unsure:
            return
        if self._must_reset:
            self._reset()
        else:
            self._end_halts()
        self._drain()
        self._unsure = False

    def _reset(self) -> None:
        self._call(self._device.reset, "a port reset")
        self._call(self._claim, "claiming the interface")
        code = clock_code(self._timing.clock_hz)
        assert code is not None, "the timing in force was configured"
        self._set_up(code)
        self._drive_reset(1)
        if Capability.EVENT_COUNTER in self.capabilities:
            _, self._counted = parse_counter(self._in(ControlRequest.GET_EVENT_COUNTER, 3))
        self._must_reset = False
        self._pace.done(self._timing)

    def _end_halts(self) -> None:
        for endpoint in (self._in_endpoint, self._out_endpoint):
            self._call(functools.partial(self._device.clear_halt, endpoint), "ending a halt")

    def _drain(self) -> None:
        """Throw away what waits in the pipe."""
        for _ in range(_MOST_LATE):
            try:
                self._bulk_in(PACKET, _DRAIN_MS / 1000)
            except BusTimeoutError:
                return
            except ProtocolError:
                self._end_halts()
        raise ProtocolError(f"{self.url}: replies that nobody asked for; does another program use it?")


def _bytes(data: object) -> bytes:
    return bytes(data)  # type: ignore[call-overload,no-any-return]  # pyusb gives array.array, untyped
