"""The MCP2210 as a bus: one transaction of two bytes a frame.

Timing
    The chip makes CS around every transaction; its own delays come in steps of 100 µs and lie within the
    CS-low time, so they are zero. Stall and period are kept by the host: a transfer is only sent when
    both have passed since the answer that reported the last frame's end, which is later than its rise of
    CS. A frame takes two commands, start and fetch. A command is a report each way, which the maker's
    sibling MCP2221 does 500 times a second at xHCI controllers and 333 times at EHCI (EasyMCP2221, "USB
    speed limits"): at most 167 to 250 frames a second, whatever the clock. A fetch that is answered "not
    yet" (engine started, or status 0xF8) costs a command more.
Errors
    HID answers come in order and carry the command's code. After any failure the transfer is cancelled,
    and answers are thrown away up to that to a mark with a number of its own, so that a late one, be it
    of an earlier cancel, is never taken for another's.
    A transfer that was refused (busy, stuck engine) has clocked nothing and is tried once more; one that
    was accepted is never repeated. Where the device does not even take a report, nothing more is sent to it
    until the bus is used again.
Not protected
    The data of an answer carry no checksum of their own. On the cable USB's CRC guards them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from adis_gonio.base.errors import BusError, BusTimeoutError, ProtocolError, UsageError
from adis_gonio.device.bus.contract import Capability, SpiTiming, Words
from adis_gonio.device.bus.host import (
    RESET_PULSE_S,
    SAFE_TIMING,
    WALL,
    Clock,
    HostBus,
    busy,
    gone,
    require_separate_pins,
)
from adis_gonio.device.bus.mcp2210.reports import (
    COUNT_RISING_EDGES,
    EVENT_MODE_MASK,
    EVENT_PIN,
    FRAME_BYTES,
    REPORT,
    SLOWEST_HZ,
    STARTS_WITHOUT_DATA,
    AnswerStatus,
    ChipSettings,
    Command,
    Designation,
    Engine,
    Progress,
    SpiSettings,
    is_mark,
    mark,
    parse_events,
    parse_pins,
    pins_request,
    request,
    status_of,
    status_words,
    transfer,
)
from adis_gonio.device.bus.mcp2210.writes import WRITE_S, HidDevice

TIMEOUT_S = 0.25
"""Time for one answer; the chip needs 1 to 2 ms."""
_TRIES = 2
_MOST_LATE = 64
"""Answers of others that are thrown away before the device is called confused."""


class Mcp2210Bus(HostBus):
    """A bus over an open HID device.

    Parameters
    ----------
    device : HidDevice
        Belongs to the bus from now on.
    url : str
        For messages.
    cs : int
        GP that is chip select.
    reset_gpio : int or None
        GP on the chip's RST; driven low or left floating.
    event_counter : bool
        Data-ready is wired to GP6: count its edges.
    timeout_s : float
        Time for one answer.
    clock : Clock
        The bus's clock.
    release : callable
        Called when the bus is closed, in place of the device's own `close`.

    Raises
    ------
    UsageError
        A pin has two duties.
    BusError
        The device does not take its settings.
    """

    def __init__(
        self,
        device: HidDevice,
        *,
        url: str = "mcp2210:",
        cs: int = 0,
        reset_gpio: int | None = None,
        event_counter: bool = False,
        timeout_s: float = TIMEOUT_S,
        clock: Clock = WALL,
        release: Callable[[], object] | None = None,
    ) -> None:
        super().__init__(url, clock, release or device.close)
        self._device = device
        self._cs = cs
        self._reset_gpio = reset_gpio
        self._timeout_s = timeout_s
        self._unsure = True
        self._takes_reports = True
        self._marked = 0
        event = EVENT_PIN if event_counter else None
        require_separate_pins(url, cs, reset_gpio, event, f"GP{EVENT_PIN}")
        offered = set()
        if reset_gpio is not None:
            offered.add(Capability.HARD_RESET)
        if event_counter:
            offered.add(Capability.EVENT_COUNTER)
        self.capabilities = frozenset(offered)
        device.set_nonblocking(1)
        self._settle()
        self._set_pins()
        self._timing = self._configure(SAFE_TIMING)

    # -- frames --------------------------------------------------------------------------------------

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        if timing.clock_hz < SLOWEST_HZ:
            raise UsageError(f"{self.url}: the slowest clock is {SLOWEST_HZ} Hz, not {timing.clock_hz:g}")
        self._settle()
        wanted = SpiSettings.for_frames(timing.clock_hz, self._cs)
        self._ask_done(Command.SET_SPI, wanted.request())
        got = SpiSettings.parse(self._ask(Command.GET_SPI))
        if (
            replace(got, bit_rate_hz=wanted.bit_rate_hz) != wanted
            or not 0 < got.bit_rate_hz <= timing.clock_hz
        ):
            raise ProtocolError(f"{self.url}: the MCP2210 did not take its settings: {got}")
        return SpiTiming(float(got.bit_rate_hz), timing.stall_us, timing.period_us)

    def _exchange(self, frames: Words) -> Words:
        self._settle()
        replies = np.empty(len(frames), np.uint16)
        try:
            for k, frame in enumerate(frames.tolist()):
                replies[k] = self._frame(frame)
        except BaseException as error:  # an interruption by the operator leaves an answer behind as well
            self._unsure = True
            if isinstance(error, BusError) and self._takes_reports:
                self._settle_quietly()
            raise
        return replies

    def _frame(self, frame: int) -> int:
        self._pace.wait(self._timing)
        self._start(frame.to_bytes(FRAME_BYTES, "big"))
        data = b""
        deadline = self._clock.now_s() + self._timeout_s
        while True:
            progress = Progress.of_poll(self._ask(Command.TRANSFER, transfer()))
            data += progress.data
            if progress.engine is Engine.FINISHED:
                break
            if self._clock.now_s() > deadline:
                raise BusTimeoutError(
                    f"{self.url}: the SPI engine does not finish a frame within {self._timeout_s:g} s"
                )
        self._pace.done(self._timing)
        if len(data) != FRAME_BYTES:
            raise ProtocolError(f"{self.url}: a frame ended with {len(data)} of {FRAME_BYTES} bytes")
        return int.from_bytes(data, "big")

    def _start(self, data: bytes) -> None:
        """Begin a transaction; what is refused has clocked nothing and is tried once more."""
        for left in range(_TRIES - 1, -1, -1):
            answer = self._ask(Command.TRANSFER, transfer(data))
            status = status_of(answer, Command.TRANSFER)
            if status == AnswerStatus.DONE:
                progress = Progress.parse(answer)
                if STARTS_WITHOUT_DATA and progress.engine is not Engine.STARTED:
                    raise ProtocolError(f"{self.url}: data before the transfer has started")
                return
            if status not in (AnswerStatus.BUSY, AnswerStatus.NOT_OWNED):
                raise ProtocolError(f"{self.url}: {status_words(status)}")
            if left:
                self._cancel()
                self._pace.wait(self._timing)
        raise busy(self.url, f"the SPI side ({status_words(status)})")

    # -- optional capabilities -----------------------------------------------------------------------

    def _pull_reset(self) -> None:
        bit = 1 << (self._reset_gpio or 0)
        self._settle()
        values = parse_pins(self._ask(Command.GET_GPIO_VALUES), Command.GET_GPIO_VALUES)
        inputs = parse_pins(self._ask(Command.GET_GPIO_DIRECTIONS), Command.GET_GPIO_DIRECTIONS)
        self._ask_done(Command.SET_GPIO_VALUES, pins_request(Command.SET_GPIO_VALUES, values & ~bit))
        for directions in (inputs & ~bit, inputs | bit):
            report = pins_request(Command.SET_GPIO_DIRECTIONS, directions)
            self._ask_done(Command.SET_GPIO_DIRECTIONS, report)
            self.sleep_s(RESET_PULSE_S)

    def _count_edges(self) -> int:
        """Edges on GP6 since the last call."""
        self._settle()
        return parse_events(self._ask(Command.EVENTS))

    def _set_pins(self) -> None:
        now = ChipSettings.parse(self._ask(Command.GET_CHIP))
        wanted = now.with_pin(self._cs, Designation.CS)
        if self._reset_gpio is not None:
            wanted = wanted.with_pin(self._reset_gpio, Designation.GPIO)
            wanted = replace(wanted, directions=wanted.directions | 1 << self._reset_gpio)
        if Capability.EVENT_COUNTER in self.capabilities:
            wanted = wanted.with_pin(EVENT_PIN, Designation.DEDICATED)
            flags = wanted.flags & ~EVENT_MODE_MASK | COUNT_RISING_EDGES << 1
            wanted = replace(wanted, flags=flags)
        if wanted != now:
            self._ask_done(Command.SET_CHIP, wanted.request())
        if Capability.EVENT_COUNTER in self.capabilities:
            self._ask(Command.EVENTS)

    # -- reports --------------------------------------------------------------------------------------

    def _ask_done(self, command: Command, report: bytes) -> None:
        status = status_of(self._ask(command, report), command)
        if status != AnswerStatus.DONE:
            raise ProtocolError(f"{self.url}: {status_words(status)}")

    def _ask(self, command: Command, report: bytes | None = None) -> bytes:
        """Send a report and return its own answer."""
        try:
            return self._converse(command, report if report is not None else request(command))
        except BaseException:
            self._unsure = True
            raise

    def _converse(self, command: Command, report: bytes) -> bytes:
        answer = self._await(report, lambda answer: len(answer) != REPORT or answer[0] == command)
        status_of(answer, command)
        return answer

    def _await(self, report: bytes, is_mine: Callable[[bytes], bool]) -> bytes:
        """Send a report and return the first answer that is its own."""
        while self._read(0):
            pass  # an answer that nobody waits for
        self._write(report)
        deadline = self._clock.now_s() + self._timeout_s
        for _ in range(_MOST_LATE):
            left = deadline - self._clock.now_s()
            answer = self._read(max(1, round(left * 1000))) if left > 0 else b""
            if not answer:
                raise BusTimeoutError(f"{self.url}: no answer within {self._timeout_s:g} s")
            if is_mine(answer):
                return answer  # others are late, of requests that were given up
        raise ProtocolError(f"{self.url}: only answers to other commands; does another program use it?")

    def _write(self, report: bytes) -> None:
        try:
            sent = self._device.write(b"\0" + report)
            self._takes_reports = True
        except TimeoutError as error:
            self._takes_reports = False
            raise BusTimeoutError(f"{self.url}: the device takes no report within {WRITE_S:g} s") from error
        except (OSError, ValueError) as error:
            raise gone(self.url) from error
        if sent < 0:
            raise gone(self.url)

    def _read(self, timeout_ms: int) -> bytes:
        try:
            return bytes(self._device.read(REPORT, timeout_ms))
        except (OSError, ValueError) as error:
            raise gone(self.url) from error

    # -- after a failure -------------------------------------------------------------------------------

    def _settle(self) -> None:
        """Bring the device to a known state where it may not be in one."""
        if self._unsure:
            self._cancel()
            self._unsure = False

    def _settle_quietly(self) -> None:
        """The same on an error's way out: the first error counts, the next use tries again."""
        try:
            self._settle()
        except BusError:
            self._unsure = True

    def _cancel(self) -> None:
        self._converse(Command.CANCEL, request(Command.CANCEL))
        # That may have been the answer to an earlier cancel. Answers keep their order: with the mark's
        # own, all earlier ones are behind.
        self._marked = (self._marked + 1) & 0xFF
        number = self._marked
        self._await(mark(number), lambda answer: is_mark(answer, number))
        self._pace.done(self._timing)
