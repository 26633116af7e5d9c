"""`serial:/dev/ttyUSB0` - a board with the project's firmware (firmware_proto/), by pyserial.

`serial:` if there is one USB serial port, or one with the name of this firmware (a Raspberry Pi Pico);
`serial:socket://host:port` and pyserial's other URLs too.

| option | meaning | default |
|---|---|---|
| `baud` | 500000, or 1000000 if the firmware was built with it; a Pico has none | 500000 |
| `edge` | edge of data-ready that starts a scan: `falling` or `rising` | falling |
| `boot_ms` | longest wait for the firmware after opening or a lost session | 3000 |
| `serial_number` | USB serial number, instead of a port | |

Requests and replies follow firmware_proto/PROTOCOL.md. A request is repeated with its own id until it is
answered or its tries are used up; the firmware executes an id once, so that repeating is safe for writes
too. A reply with another id is late and is discarded.

The firmware keeps the timing and runs the streams. Batches longer than its limit are sent in several
requests; the firmware keeps stall and period between them.

A `ClockMap` converts times of the firmware's clock to the clock of the host. The delay of a packet varies,
but is never negative. The packets with the smallest delay in each second therefore show the true relation
of the clocks, and a straight line fitted to them gives offset and rate of the firmware's clock (a ceramic
resonator is off by up to 0.5 %). If the line changes, later times approach it gradually, so that converted
times have no jumps.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import random
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.errors import (
    BusError,
    BusTimeoutError,
    NotInstalledError,
    ProtocolError,
    UsageError,
    install_extra,
)
from adis_gonio.device.bus import host
from adis_gonio.device.bus.contract import Capability, FrameBlock, FrameStream, SpiTiming, Words
from adis_gonio.device.bus.host import RESET_PULSE_S, SAFE_TIMING, WALL, Clock, HostBus
from adis_gonio.device.bus.opening import BusUrl, Device
from adis_gonio.device.bus.wire import Body, Packet, Receiver, encode, load_cobs, protocol as wire

RETRY_S = wire.RETRY_MS / 1000
TRIES = 5
"""Number of times that a request is sent before the firmware counts as silent."""
HELLO_EVERY_S = 0.3

# Opening a port resets many boards. Their boot loader then listens at another baud rate (Optiboot: 115 200)
# and interprets the bytes as commands, such as to erase a page. It leaves at once, though, if the second
# byte of a command is no blank, and zeros at our rate can never look like the command to erase: it has
# neighbouring bits that are set, but zeros are high only for a stop bit of 2 us in 20.
ZEROS = bytes(1)
"""Zero byte, sent to make a boot loader leave; the firmware reads it as an empty packet.

For a boot loader the first zero is no command and the second is not the blank that must follow a command:
two of them make it leave. They need a gap between them, since a run of zeros keeps some loaders in step.
"""
ZEROS_EVERY_S = 0.02
ZEROS_FIRST_S = 0.24
"""Time in s for which zeros are sent before the first hello after opening.

A boot loader listens 70 ms after the reset, 90 ms at most; its start-up takes 65 ms (confidence B).
"""
ZEROS_AGAIN_S = 0.06
LEAVE_S = 0.16
"""Silence in s after the last zero.

A boot loader needs 16 ms to leave (its watchdog), and a start-up follows.
"""
EARLY_HELLOS = 2
"""Number of hellos before the time of a boot loader is over.

The first is for boards that did not reset, the second for loaders that blink before they listen (Optiboot:
0.4 s), which lose the first.
"""
LOADER_S = 2.0
"""Longest time in s for which a boot loader waits; most wait one second.

A loader that ignores the zeros receives nothing more until this time is over.
"""

B = TypeVar("B", bound=Body)


class RefusedError(Exception):
    """The firmware refused a request and did not execute the refused copy.

    Attributes
    ----------
    code : int
        Reason of the refusal, one of `wire.Refusal`.
    once : bool
        True if the request was sent only once, so no earlier copy can have been executed.
    """

    def __init__(self, request: str, error: wire.Error, *, once: bool) -> None:
        text = wire.REFUSAL_TEXT.get(error.code, f"code {error.code}")
        super().__init__(f"the firmware refused {request}: {text} ({error.detail})")
        self.code = error.code
        self.once = once


class SerialLink:
    """The host's side of the serial protocol: sends requests and sorts the packets that arrive.

    Parameters
    ----------
    port : SerialPort
        The open port, or another object with its methods.
    url : str
        URL of the bus, used in messages.
    clock : Clock
        Clock for waits.
    dice : random.Random
        Draws nonces and the first id.

    Attributes
    ----------
    scans : deque of (Packet, float)
        Packets of streams with their times of arrival, in order.
    """

    def __init__(
        self, port: SerialPort, *, url: str, clock: Clock, dice: random.Random | None = None
    ) -> None:
        self.port = port
        self.url = url
        self.retries = self.late = 0
        """Numbers of repeated requests and of late replies."""
        self.receiver = Receiver()
        self.scans: deque[tuple[Packet, float]] = deque()
        self._clock = clock
        self._dice = dice or random.Random()
        # Ids continue over sessions on this port, so that a late packet of an old session has an old id.
        self.last_id = self._dice.randrange(1 << 16)
        self._replies: deque[Packet] = deque()

    # -- requests ---------------------------------------------------------------------------------------

    def hello(self, wait_s: float) -> wire.HelloReply:
        """Open a session with the firmware; try for `wait_s` seconds, because a board may be booting.

        Zeros are sent before each hello, so that a listening boot loader leaves instead of reading it.

        Raises
        ------
        BusTimeoutError
            No firmware answered.
        ProtocolError
            The firmware speaks another version of the protocol.
        """
        nonce = self._dice.randrange(1 << 32)
        packet = self._packet(wire.HelloRequest(wire.VERSION, nonce))
        end_s = self._clock.now_s() + wait_s
        bad = self.receiver.bad.total()
        quiet_s = end_s - max(wait_s - LOADER_S, HELLO_EVERY_S)

        for sent in itertools.count():
            if sent and self._clock.now_s() >= end_s:
                break
            if sent == EARLY_HELLOS:
                self._listen(quiet_s - self._clock.now_s())
            zeros_end_s = self._clock.now_s() + (ZEROS_AGAIN_S if sent else ZEROS_FIRST_S)
            while self._clock.now_s() < zeros_end_s:
                self.port.send(ZEROS)
                self._listen(ZEROS_EVERY_S)
            self._listen(LEAVE_S)
            self.port.send(packet)
            answer = self._await(wire.HelloReply, HELLO_EVERY_S, nonce)
            if isinstance(answer, wire.Error):
                if answer.code == wire.Refusal.PROTOCOL_VERSION:
                    raise self._other_version(answer.detail)
                raise ProtocolError(f"{self.url}: {RefusedError('hello', answer, once=True)}")
            if answer is not None:
                if answer.protocol != wire.VERSION:
                    raise self._other_version(answer.protocol)
                return answer
            self.retries += 1
        noise = ", only noise (another baud rate?)" if self.receiver.bad.total() > bad else ""
        raise BusTimeoutError(
            f"{self.url}: no adis-gonio firmware answers within {wait_s:g} s{noise}; is it flashed, and is"
            " this its port (docs/hardware.md)?"
        )

    def request(self, body: Body, reply: type[B], runs_s: float = 0.0) -> B:
        """Send a request and return its reply.

        Parameters
        ----------
        body : Body
            Content of the request.
        reply : type
            Class of the expected reply.
        runs_s : float
            Time in s that the firmware needs to execute the request.

        Raises
        ------
        RefusedError
            The firmware refused the request.
        BusTimeoutError
            No answer to any try.
        """
        packet = self._packet(body)
        for sent in range(1, TRIES + 1):
            self.port.send(packet)
            answer = self._await(reply, RETRY_S + 1.1 * runs_s)
            if isinstance(answer, wire.Error):
                raise RefusedError(type(body).__name__, answer, once=sent == 1)
            if answer is not None:
                return answer
            self.retries += 1
        raise BusTimeoutError(
            f"{self.url}: no answer from the firmware to {TRIES} tries of {type(body).__name__}"
        )

    def pump(self, wait_s: float) -> bool:
        """Receive packets and sort them into scans and replies.

        Return False if nothing arrived within `wait_s` seconds.
        """
        data = self.port.receive(wait_s)
        if not data:
            return False
        arrival_s = self._clock.now_s()
        for packet in self.receiver.feed(data):
            if packet.type == wire.PacketType.SCANS:
                self.scans.append((packet, arrival_s))
            else:
                self._replies.append(packet)
        return True

    def pumps(self, wait_s: float) -> Iterator[bool]:
        """Receive packets for `wait_s` seconds; yield before the first reception and after each one.

        The last reception begins after this time, for bytes that came while the host was too busy to read
        them. The first yielded value is False; then the values of `pump` follow.
        """
        end_s, left = self._clock.now_s() + wait_s, math.inf
        yield False
        while left > 0:
            left = end_s - self._clock.now_s()
            yield self.pump(max(left, 0.0))

    def _listen(self, wait_s: float) -> None:
        """Receive packets for `wait_s` seconds without sending."""
        for _ in self.pumps(wait_s):
            pass

    # -- packets ----------------------------------------------------------------------------------------

    def _packet(self, body: Body) -> bytes:
        self.last_id = (self.last_id + 1) & 0xFFFF
        return encode(Packet.of(body, self.last_id))

    def _await(self, reply: type[B], wait_s: float, nonce: int | None = None) -> B | wire.Error | None:
        """Return the reply or the refusal of the last request; None if neither comes within `wait_s`.

        `reply` is the class of the expected reply. `nonce` is the number that the reply to a hello must
        repeat; None for other requests.
        """
        for _ in self.pumps(wait_s):
            while self._replies:
                answer = self._judge(self._replies.popleft(), reply)
                foreign = isinstance(answer, wire.HelloReply) and answer.nonce != nonce
                if answer is not None and not foreign:
                    return answer
                self.late += 1
        return None

    def _judge(self, packet: Packet, reply: type[B]) -> B | wire.Error | None:
        """Decode a packet as the reply to the last request; None if it is invalid or not that reply."""
        if packet.id != self.last_id:
            return None
        try:
            if packet.type == reply.TYPE:
                return reply.unpack(packet.body)
            if packet.type == wire.PacketType.ERROR:
                error = wire.Error.unpack(packet.body)
                return error if error.request | wire.REPLY_BIT == reply.TYPE else None
        except ProtocolError:
            pass
        return None

    def _other_version(self, version: int) -> ProtocolError:
        return ProtocolError(
            f"{self.url}: the firmware speaks protocol version {version}, this package {wire.VERSION}:"
            " flash the firmware of this release (docs/hardware.md)"
        )


_WRAP_US = 1 << 32
_WHILE_S = 1.0
"""Period in s of which the earliest arrival makes one point of the line fit of `ClockMap`."""
_STEEPEST = 0.02
"""Largest deviation of the rate of the clock map from 1; resonators deviate less."""


class ClockMap:
    """Converts times of the firmware's 32-bit microsecond clock to times of the bus's clock in s.

    Parameters
    ----------
    now_us : int
        Time of the firmware's clock in µs, as a reply of the firmware states it.
    arrival_s : float
        Time in s on the bus's clock at which that reply arrived.
    """

    def __init__(self, now_us: int, arrival_s: float) -> None:
        self._us = now_us
        self._s = 0.0
        self._anchor = (0.0, arrival_s)
        self._points: list[tuple[float, float]] = []
        self._fitted: np.polynomial.Polynomial | None = None

    def times(self, first_us: int, span_us: int, count: int, arrival_s: float) -> NDArray[np.float64]:
        """Return the times (count,) in s of the evenly spaced scans of a packet, on the bus's clock.

        Parameters
        ----------
        first_us, span_us : int
            Time of the first scan on the firmware's clock, and duration from the first to the last scan, in
            µs.
        arrival_s : float
            Time in s on the bus's clock at which the packet arrived.
        """
        # The 32-bit clock wraps; a time differs by less than half its range from the time before.
        self._s += ((first_us - self._us + _WRAP_US // 2) % _WRAP_US - _WRAP_US // 2) * 1e-6
        self._us, first_s = first_us, self._s
        end_s = first_s + span_us * 1e-6
        self._learn(end_s, arrival_s)
        at_s, at_host_s = self._anchor
        if end_s <= at_s:
            rate = 1.0
        else:
            rate = (self._line(end_s) - at_host_s) / (end_s - at_s)
            rate = min(max(rate, 1 - _STEEPEST), 1 + _STEEPEST)
            self._anchor = (end_s, at_host_s + rate * (end_s - at_s))
        return at_host_s + rate * (np.linspace(first_s, end_s, count) - at_s)

    def _learn(self, time_s: float, arrival_s: float) -> None:
        """Add the smallest difference of both clocks in each period of `_WHILE_S`, at the board's time."""
        late_s = arrival_s - time_s
        points = self._points
        if points and time_s - points[-1][0] < _WHILE_S:
            points[-1] = (points[-1][0], min(points[-1][1], late_s))
        else:
            if len(points) >= 4:
                # Fit a straight line to the clock difference against the board's time.
                at, late = np.array(points).T
                self._fitted = np.polynomial.Polynomial.fit(at, late, 1)
            points.append((time_s, late_s))
            del points[:-32]

    def _line(self, time_s: float) -> float:
        if self._fitted is None:
            return time_s + min(late for _, late in self._points)
        return time_s + float(self._fitted(time_s))


SILENCE_S = 3.0
"""Time in s without a data-ready edge after which the chip counts as not sampling.

The slowest sample period of the chip is 2.42 s.
"""
_PACKETS_MISSED = 4
"""Number of due packets that may be missing before the serial line counts as faulty.

The count of data-ready edges gives the number of due packets.
"""
_AROUND = wire.HEADER_SIZE + wire.CRC_SIZE + 2
"""Number of bytes that a packet has on the line in addition to its body: header, CRC, COBS, delimiter."""


@dataclass(eq=False)
class SerialStream(FrameStream):
    """A running stream of the firmware, as an iterator of blocks.

    Parameters
    ----------
    owner : SerialBus
        The bus that started the stream.
    id : int
        Id of the request that started the stream; packets of other streams are discarded.
    width : int
        Number of frames in a scan.
    packet_scans : int
        Number of scans in a full packet.
    block_scans : int
        Minimum number of scans in a block.
    clock : ClockMap
        Converts the times of scans.
    """

    owner: SerialBus
    id: int
    width: int
    packet_scans: int
    block_scans: int
    clock: ClockMap
    _open: bool = True
    _next_sequence: int = 0
    _lost: int = 0

    def __next__(self) -> FrameBlock:
        """Return the next block of scans.

        Raises
        ------
        BusTimeoutError
            No data-ready edges, the firmware is silent, or no packet comes through whole.
        CannotOpenError
            The board was unplugged.
        """
        parts: list[FrameBlock] = []
        have = 0
        while have < self.block_scans:
            if not self._open:
                if parts:
                    break
                raise StopIteration
            part = self._part()
            if part is not None:
                parts.append(part)
                have += len(part.time_s)
        return FrameBlock(
            np.concatenate([part.words for part in parts]),
            np.concatenate([part.time_s for part in parts]),
            sum(part.lost for part in parts),
        )

    def close(self) -> None:
        """Stop the stream, so that the bus accepts other requests again."""
        if self._open:
            self._open = False
            self.owner.stop_stream()

    def _part(self) -> FrameBlock | None:
        """Wait for a packet and return its scans; None if it is invalid or belongs to another stream."""
        packet, arrival_s = self._packet()
        if packet.id != self.id:
            return None
        try:
            scans = wire.Scans.unpack(packet.body)
        except ProtocolError:
            return None
        count, rest = divmod(len(scans.words), self.width)
        missed = (scans.sequence - self._next_sequence) & 0xFFFF_FFFF
        # More than half the range is a packet from before: a repetition on the line.
        if not count or rest or missed > 0x8000_0000:
            return None
        lost = missed + ((scans.lost - self._lost) & 0xFFFF)
        self._next_sequence = (scans.sequence + count) & 0xFFFF_FFFF
        self._lost = scans.lost
        left_s = arrival_s - (len(packet.body) + _AROUND) * self.owner.byte_s
        times = self.clock.times(scans.first_us, scans.span_us, count, left_s)
        self.owner.streamed_s = float(times[-1])
        return FrameBlock(scans.words.reshape(count, self.width), times, lost)

    def _packet(self) -> tuple[Packet, float]:
        """Wait for the next packet of scans; return it and its time of arrival in s.

        It raises `BusTimeoutError` if the firmware counts no data-ready edge for `SILENCE_S` seconds (the
        chip is silent), or counts edges although no packet arrives (the serial line is faulty).
        """
        owner = self.owner
        first: int | None = None
        edges: int | None = None
        begin_s = since_s = owner.now_s()
        while True:
            found = owner.next_scans(0.5)
            if found is not None:
                return found
            asked_s = owner.now_s()  # the reply may wait for a busy host
            now_edges = owner.count_edges()
            first = now_edges if first is None else first
            unheard = (now_edges - first) & 0xFFFF_FFFF
            if unheard > _PACKETS_MISSED * self.packet_scans and asked_s - begin_s > SILENCE_S:
                raise BusTimeoutError(
                    f"{owner.url}: {unheard} data-ready edges, but no packet of scans came through whole in"
                    f" {asked_s - begin_s:.1f} s: check the cable and the baud rate"
                )
            if now_edges != edges:
                edges, since_s = now_edges, owner.now_s()
            elif asked_s - since_s > SILENCE_S:
                raise BusTimeoutError(
                    f"{owner.url}: no data-ready edge in {SILENCE_S:g} s: enable the line in MSC_CTRL[2],"
                    " and check the wire from the chip's DIO1 to the board"
                )


BOOT_S = 3.0
"""Time in s for which a hello is repeated, after opening and after a lost session.

Many boards reset on opening, and their boot loader waits.
"""
_USB_BYTE_S = 1e-6
"""Time in s of a byte on full-speed USB: 64 bytes take about 60 µs."""
_GATHER_S = 0.01
"""Shortest interval in s between reads of a stream, since fewer, larger reads cost less."""


class SerialBus(HostBus):
    """A bus over an open serial port to a board with the project's firmware.

    Parameters
    ----------
    port : SerialPort
        The open port, which the bus closes.
    url : str
        URL of the bus, used in messages.
    clock : Clock
        The bus's clock.
    boot_s : float
        Longest wait in s for the answer to a hello.
    trigger : Trigger
        Edge of data-ready that starts a scan of a stream; the chip's data-ready pulse is low unless bit
        MSC_CTRL[1] is set.
    baud : int
        Baud rate, from which the travel time of a packet follows; unused if the board is a USB device.
    link : SerialLink
        Link to use; None makes a new one over `port`.

    Attributes
    ----------
    firmware : HelloReply
        Reply of the firmware to the hello.
    byte_s : float
        Time in s of a byte on the line.
    streamed_s : float
        Time in s of the last scan of all streams, on the bus's clock.

    Raises
    ------
    BusTimeoutError
        No firmware answers.
    ProtocolError
        The firmware speaks another version of the protocol.
    """

    def __init__(
        self,
        port: SerialPort,
        *,
        url: str = "serial:",
        clock: Clock = WALL,
        boot_s: float = BOOT_S,
        trigger: wire.Trigger = wire.Trigger.FALLING,
        baud: int = wire.BAUD,
        link: SerialLink | None = None,
    ) -> None:
        super().__init__(url, clock)
        self._resources.callback(port.close)
        self._boot_s = boot_s
        self._trigger = trigger
        self.edge_rises = trigger is wire.Trigger.RISING
        self._link = link or SerialLink(port, url=url, clock=clock)
        self._stream: SerialStream | None = None
        self._counted = 0
        self._board_us = 0
        self.streamed_s = 0.0
        self._lost_session = False
        self.firmware = self._link.hello(boot_s)
        native = self.firmware.capabilities & wire.FirmwareCapability.USB
        self.byte_s = _USB_BYTE_S if native else 10 / baud
        self.unbroken_frames = max(1, self.firmware.max_frames)
        self._timing = self._configure(SAFE_TIMING)
        has, flag = self.firmware.capabilities, wire.FirmwareCapability
        needs = {
            Capability.EVENT_COUNTER: flag.DATA_READY,
            Capability.STREAM: flag.DATA_READY | flag.STREAM,
            Capability.HARD_RESET: flag.HARD_RESET,
        }
        self.capabilities = frozenset(one for one, bits in needs.items() if has & bits == bits)
        if Capability.EVENT_COUNTER in self.capabilities:
            self._counted = self.count_edges()

    # -- frames -----------------------------------------------------------------------------------------

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        self._refuse_while_streaming()
        most = self.firmware.max_wait_us
        stall, period = math.ceil(timing.stall_us), math.ceil(timing.period_us)
        if max(stall, period) > most:
            raise UsageError(f"{self.url}: stall and period are at most {most} µs on this board")
        slowest = min((hz for hz in self.firmware.clocks_hz if hz), default=0)
        if not 0 < slowest <= timing.clock_hz:
            raise UsageError(f"{self.url}: the slowest clock is {slowest} Hz, not {timing.clock_hz:g}")
        clock = min(math.floor(timing.clock_hz), 0xFFFF_FFFF)
        request = wire.ConfigureRequest(clock, stall, period)
        reply = self._ask(request, wire.ConfigureReply)
        if reply.clock_hz > timing.clock_hz or reply.stall_us < stall or reply.period_us < period:
            raise ProtocolError(f"{self.url}: the firmware set {reply} instead of {request}")
        return SpiTiming(float(reply.clock_hz), float(reply.stall_us), float(reply.period_us))

    def _exchange(self, frames: Words) -> Words:
        self._refuse_while_streaming()
        size = self.unbroken_frames or len(frames)
        return np.concatenate([self._batch(frames[at : at + size]) for at in range(0, len(frames), size)])

    def _batch(self, frames: Words) -> Words:
        writes = int(np.count_nonzero(frames & wire.WRITE_BIT))
        runs_s = (len(frames) + 1) * self.timing.frame_s
        reply = self._ask(wire.ExchangeRequest(writes, frames), wire.ExchangeReply, runs_s)
        if len(reply.words) != len(frames):
            raise ProtocolError(f"{self.url}: {len(reply.words)} words came in for {len(frames)} frames")
        return reply.words

    def _close(self) -> None:
        try:
            if self._stream is not None:
                self._stream.close()
        finally:
            super()._close()

    # -- optional capabilities ---------------------------------------------------------------------------

    def _start_stream(self, frames: Sequence[int], block_scans: int) -> FrameStream:
        self._refuse_while_streaming()
        width, firmware = len(frames), self.firmware
        fit = firmware.max_scan_bytes // (2 * width)
        if width > firmware.max_list or not fit:
            raise UsageError(f"{self.url}: a stream takes at most {firmware.max_list} frames")
        self._link.scans.clear()
        packet_scans = min(fit, block_scans)
        request = wire.StreamRequest(self._trigger, packet_scans, 1, 0, np.array(frames, np.uint16))
        reply = self._ask(request, wire.StreamReply)
        # The map of the stream before ran ahead if its first reply was late.
        clock = ClockMap(reply.now_us, max(self.now_s(), self.streamed_s))
        self._stream = SerialStream(self, self._link.last_id, width, packet_scans, block_scans, clock)
        return self._stream

    def _pull_reset(self) -> None:
        self._refuse_while_streaming()
        self._ask(wire.ResetRequest(round(RESET_PULSE_S * 1e6)), wire.ResetReply, RESET_PULSE_S)

    def _count_edges(self) -> int:
        return self.count_events()[0]

    def count_events(self) -> tuple[int, float]:
        """Return the number of data-ready edges since the last call, and the firmware's time in s."""
        with self._lock:
            self._require(Capability.EVENT_COUNTER)
            now = self._ask(wire.StatisticsRequest(), wire.StatisticsReply)
            # The firmware never resets its counter, so a lost reply loses no edges.
            new, self._counted = (now.edges - self._counted) & 0xFFFF_FFFF, now.edges
            self._board_us += (now.now_us - self._board_us) & 0xFFFF_FFFF
            return new, self._board_us * 1e-6

    # -- for streams ------------------------------------------------------------------------------------

    def next_scans(self, wait_s: float) -> tuple[Packet, float] | None:
        """Return the next packet of scans and its time of arrival in s.

        Return None if no packet comes within `wait_s` seconds.
        """
        with self._lock:
            self._require_open()
            for more in self._link.pumps(wait_s):
                if self._link.scans:
                    return self._link.scans.popleft()
                if more:
                    self.sleep_s(_GATHER_S)
            return None

    def count_edges(self) -> int:
        """Return the number of data-ready edges that the firmware has counted since power-on.

        The number has 32 bits and wraps.
        """
        with self._lock:
            self._require_open()
            return self._ask(wire.StatisticsRequest(), wire.StatisticsReply).edges

    def stop_stream(self) -> None:
        """End the running stream, so that the bus accepts other requests again."""
        with self._lock:
            self._stream = None
            try:
                self._link.request(wire.StopRequest(), wire.StopReply)
            except (BusError, RefusedError):
                self._lost_session = True  # the hello before the next request stops it
            self._link.scans.clear()

    def _refuse_while_streaming(self) -> None:
        if self._stream is not None:
            raise UsageError(f"{self.url}: a stream is running; close it first")

    # -- requests ---------------------------------------------------------------------------------------

    def _ask(self, request: Body, reply: type[B], runs_s: float = 0.0, *, renews: bool = True) -> B:
        """Send a request and return its reply; `renews` opens a lost session again and repeats it once."""
        if renews and self._lost_session:
            self._renew()
        try:
            return self._link.request(request, reply, runs_s)
        except RefusedError as refused:
            forgotten = refused.code in (wire.Refusal.NO_SESSION, wire.Refusal.BUSY)
            if not (renews and forgotten) or self._stream is not None:
                raise ProtocolError(f"{self.url}: {refused}") from refused
            self._lost_session = True
            if not refused.once:
                # An earlier copy may have been executed before the firmware restarted.
                raise ProtocolError(f"{self.url}: the firmware restarted during a request") from refused
        except BusTimeoutError:
            self._lost_session = True
            raise
        self._renew()
        return self._ask(request, reply, runs_s, renews=False)

    def _renew(self) -> None:
        """Open a new session by a hello request, which resets the SPI timing; set the timing again."""
        self.firmware = self._link.hello(self._boot_s)
        timing = self.timing
        stall, period = math.ceil(timing.stall_us), math.ceil(timing.period_us)
        request = wire.ConfigureRequest(int(timing.clock_hz), stall, period)
        self._ask(request, wire.ConfigureReply, renews=False)
        self._lost_session = False


SLICE_S = 0.05
"""Longest single wait in s of a read; it is constant, because a change would configure the port again."""
WRITE_S = 1.0
BUFFER = 65536
PRODUCT = "adis-gonio"
"""Beginning of the product name by which a board with this firmware is recognised.

The firmware is then a USB device, with any VID:PID.
"""


def load() -> Any:
    """Import pyserial and return its module.

    Raises
    ------
    NotInstalledError
        pyserial is missing, or another package has its name.
    """
    try:
        import serial
        import serial.tools.list_ports
    except ImportError:
        raise NotInstalledError(f"serial: pyserial is not installed: {install_extra('serial')}") from None
    if not hasattr(serial, "serial_for_url"):
        raise NotInstalledError(
            "serial: module 'serial' belongs to package serial, not pyserial: pip uninstall serial;"
            " pip install --force-reinstall pyserial"
        )
    return serial


class SerialPort:
    """An open port of pyserial, with methods that raise only errors of this package.

    The modem lines are not used, so a port without them (a pty, many sockets) also works.
    """

    def __init__(self, serial: Any, port: Any, url: str) -> None:
        self._serial = serial
        self._port = port
        self._url = url
        # pyserial's socket reports at most one waiting byte, and reading single bytes is too slow for a
        # stream.
        self._whole = not type(port).__module__.endswith(".protocol_socket")

    def receive(self, wait_s: float, /) -> bytes:
        """Return the bytes that have arrived, after waiting at most `wait_s` seconds for the first."""
        end_s = time.monotonic() + wait_s
        try:
            while True:
                waiting = self._port.in_waiting
                data: bytes = self._port.read(waiting or int(wait_s > 0))
                if data or time.monotonic() >= end_s:
                    return data if self._whole or not data else data + self._rest()
        except (OSError, TypeError, AttributeError) as error:
            # pyserial raises TypeError if another thread closes the port during a read.
            raise host.gone_error(self._url) from error

    def _rest(self) -> bytes:
        """Return the further bytes that a socket has ready, without waiting for more."""
        self._port.timeout = 0
        try:
            rest: bytes = self._port.read(BUFFER)
        finally:
            self._port.timeout = SLICE_S
        return rest

    def send(self, data: bytes, /) -> None:
        """Send all bytes of `data`; raise `BusTimeoutError` if the port does not take them in time."""
        try:
            self._port.write(data)
        except self._serial.SerialTimeoutException as error:
            raise BusTimeoutError(f"{self._url}: the port takes no bytes within {WRITE_S:g} s") from error
        except (OSError, TypeError, AttributeError) as error:
            raise host.gone_error(self._url) from error

    def close(self) -> None:
        """Close the port. Linux waits up to 30 s if a hanging board has not taken all bytes."""
        with contextlib.suppress(OSError):
            self._port.close()


def open_port(place: str, baud: int, url: str) -> SerialPort:
    """Open a serial port, locked against other programs.

    Parameters
    ----------
    place : str
        Device file, COM port, or a URL of pyserial such as `socket://host:port`.
    baud : int
        Baud rate.
    url : str
        URL of the bus, used in messages.

    Raises
    ------
    CannotOpenError
        The port is missing, busy or not permitted.
    """
    serial = load()
    options: dict[str, Any] = {} if "://" in place else {"exclusive": True}
    try:
        port = serial.serial_for_url(
            place, baudrate=baud, timeout=SLICE_S, write_timeout=WRITE_S, **options
        )
    except ValueError as error:
        raise UsageError(f"{url}: {error}") from error
    except OSError as error:
        raise _cannot_open(error, place, url) from error
    return SerialPort(serial, port, url)


def list_boards() -> list[Any]:
    """Return the USB serial ports of pyserial's list, sorted by device file."""
    ports = load().tools.list_ports.comports()
    return sorted((port for port in ports if port.vid is not None), key=lambda port: str(port.device))


def names_itself(port: Any) -> bool:
    """Return True if a port's USB strings identify this package's firmware.

    They do on the Raspberry Pi Pico.
    """
    return str(port.product or "").startswith(PRODUCT)


def devices(ports: Sequence[Any]) -> list[Device]:
    """Convert ports of pyserial to devices for a list, without opening them.

    Opening a port would reset many boards.
    """
    rows = []
    for port in ports:
        name = port.product or port.description or "serial port"
        number = f", serial number {port.serial_number}" if port.serial_number else ""
        text = f"{name} ({port.vid:04x}:{port.pid:04x}{number})"
        if not names_itself(port):
            text += ", if it has the adis-gonio firmware"
        rows.append(Device(f"serial:{port.device}", text))
    return rows


def _cannot_open(error: OSError, place: str, url: str) -> BusError:
    def missing() -> BusError:
        return host.missing_error(url, f"port {place}", devices(list_boards()))

    if "FileNotFoundError" in str(error):
        return missing()
    # Windows reports a port in use as "access denied", which pyserial gives as text only.
    if any(word in str(error) for word in ("exclusively lock", "PermissionError")):
        return host.busy_error(url, place)
    return host.opening_error(error, url, place, "tty", missing)


def open_from_url(
    url: BusUrl, *, port: SerialPort | None = None, clock: host.Clock = host.WALL
) -> SerialBus:
    """Open a board with the project's firmware by its URL (see the module's text).

    Parameters
    ----------
    port : SerialPort
        An open port to use; None opens the port of the URL by pyserial.
    clock : Clock
        The bus's clock.

    Raises
    ------
    UsageError
        An unknown option, or several ports fit.
    NotInstalledError
        pyserial or cobs is not installed.
    CannotOpenError
        No such port, no permission, or another program has it.
    BusTimeoutError
        No firmware answers.
    """
    options = host.UrlOptions(url, ("baud", "edge", "boot_ms", "serial_number"))
    baud = options.number("baud", wire.BAUD, 300, 4_000_000)
    trigger = wire.Trigger[options.one_of("edge", ("falling", "rising")).upper()]
    boot_ms = options.number("boot_ms", round(BOOT_S * 1000), 100, 60_000)
    number = options.text("serial_number")
    load_cobs()  # report a missing package before opening the port, which resets many boards
    if port is None:
        port = open_port(_place(url, number), baud, url.text)
    try:
        return SerialBus(port, url=url.text, clock=clock, boot_s=boot_ms / 1000, trigger=trigger, baud=baud)
    except BaseException:
        port.close()
        raise


def find_devices() -> list[Device]:
    """List the USB serial ports; opening one shows if its board runs the firmware."""
    return devices(list_boards())


def _place(url: BusUrl, number: str) -> str:
    if url.place:
        return url.place
    boards = list_boards()
    fits = [board for board in boards if not number or board.serial_number == number]
    if len(fits) > 1:
        fits = [board for board in fits if names_itself(board)] or fits
    what = f"port with serial number {number}" if number else "USB serial port"
    return str(host.choose_board(url, what, fits, boards, devices).device)
