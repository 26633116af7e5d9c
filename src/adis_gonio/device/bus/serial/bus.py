"""A board with the project's firmware as a bus; the firmware makes the timing and the streams.

Batches longer than the firmware takes go in several requests; it keeps stall and period across them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from adis_gonio.base.errors import BusError, BusTimeoutError, ProtocolError, UsageError
from adis_gonio.device.bus.contract import RESERVED_BIT, Capability, FrameStream, SpiTiming, Words
from adis_gonio.device.bus.host import RESET_PULSE_S, SAFE_TIMING, WALL, Clock, HostBus
from adis_gonio.device.bus.serial.clocks import ClockMap
from adis_gonio.device.bus.serial.link import B, Port, RefusedError, SerialLink
from adis_gonio.device.bus.serial.stream import SerialStream
from adis_gonio.device.bus.wire import Body, Packet
from adis_gonio.device.bus.wire import protocol as wire

BOOT_S = 3.0
"""How long a hello is repeated after opening: many boards reset then, and their boot loader waits."""
AGAIN_S = 1.5
"""How long where the board runs already."""
_USB_BYTE_S = 1e-6
"""A byte on a full-speed bus, where the board is a USB device itself: 64 of them in some 60 µs."""
_GATHER_S = 0.01
"""A stream's bytes are fetched so often at most: fewer, larger reads cost less."""


class SerialBus(HostBus):
    """A bus over an open serial port.

    Parameters
    ----------
    port : Port
        Belongs to the bus from now on.
    url : str
        For messages.
    clock : Clock
        The bus's clock.
    boot_s : float
        How long the firmware is waited for.
    trigger : Trigger
        Edge of data-ready that starts a scan of a stream; the chip's pulse is low unless MSC_CTRL[1].
    baud : int
        Tells how long a packet was on its way, which its times take into account; a board that is a USB
        device itself has none.
    link : SerialLink
        In place of one of its own making.
    release : callable
        Called when the bus is closed, in place of the port's own `close`.

    Attributes
    ----------
    firmware : HelloReply
        What the firmware said of itself.

    Raises
    ------
    BusTimeoutError
        No firmware answers.
    ProtocolError
        It speaks another version.
    """

    def __init__(
        self,
        port: Port,
        *,
        url: str = "serial:",
        clock: Clock = WALL,
        boot_s: float = BOOT_S,
        trigger: wire.Trigger = wire.Trigger.FALLING,
        baud: int = wire.BAUD,
        link: SerialLink | None = None,
        release: Callable[[], object] | None = None,
    ) -> None:
        super().__init__(url, clock, release or port.close)
        self._trigger = trigger
        self.edge_rises = trigger is wire.Trigger.RISING
        self._link = link or SerialLink(port, url=url, clock=clock)
        self._stream: SerialStream | None = None
        self._counted = 0
        self._board_us = 0
        self._lost_session = False
        self.firmware = self._link.hello(boot_s)
        native = self.firmware.capabilities & wire.FirmwareCapability.USB
        self._byte_s = _USB_BYTE_S if native else 10 / baud
        self.unbroken_frames = max(1, self.firmware.max_frames)
        self._timing = self._configure(SAFE_TIMING)
        self.capabilities = self._offered()
        if Capability.EVENT_COUNTER in self.capabilities:
            self._counted = self.count_edges()

    def _offered(self) -> frozenset[Capability]:
        has = wire.FirmwareCapability(self.firmware.capabilities & 0x7)
        offered = set()
        if wire.FirmwareCapability.DATA_READY in has:
            offered.add(Capability.EVENT_COUNTER)
            if wire.FirmwareCapability.STREAM in has:
                offered.add(Capability.STREAM)
        if wire.FirmwareCapability.HARD_RESET in has:
            offered.add(Capability.HARD_RESET)
        return frozenset(offered)

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
            raise ProtocolError(f"{self.url}: the firmware set {reply} where {request} was asked")
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
            self._release()

    # -- optional capabilities ---------------------------------------------------------------------------

    def stream(self, frames: Sequence[int], *, block_scans: int = 256) -> FrameStream:
        """Run read frames once at each data-ready edge.

        Raises
        ------
        UsageError
            The list is empty, too long or holds a write, or a stream is running.
        """
        with self._lock:
            self._require_open()
            if Capability.STREAM not in self.capabilities:
                raise self._lacks(Capability.STREAM)
            self._refuse_while_streaming()
            if not frames or any(not 0 <= frame < RESERVED_BIT for frame in frames):
                raise UsageError("a stream takes at least one read frame and no writes")
            width, firmware = len(frames), self.firmware
            fit = firmware.max_scan_bytes // (2 * width)
            if width > firmware.max_list or not fit:
                raise UsageError(f"{self.url}: a stream takes at most {firmware.max_list} frames")
            if block_scans < 1:
                raise UsageError(f"a block of {block_scans} scans is not possible; give at least 1")
            self._link.scans.clear()
            packet_scans = min(fit, block_scans)
            request = wire.StreamRequest(self._trigger, packet_scans, 1, 0, np.array(frames, np.uint16))
            reply = self._ask(request, wire.StreamReply)
            self._stream = SerialStream(
                self,
                stream_id=self._link.last_id,
                width=width,
                packet_scans=packet_scans,
                block_scans=block_scans,
                clock=ClockMap(reply.now_us, self.now_s()),
                byte_s=self._byte_s,
                stop=self._stop,
            )
            return self._stream

    def _pull_reset(self) -> None:
        self._refuse_while_streaming()
        self._ask(wire.ResetRequest(round(RESET_PULSE_S * 1e6)), wire.ResetReply, RESET_PULSE_S)

    def _count_edges(self) -> int:
        return self.count_events()[0]

    def count_events(self) -> tuple[int, float]:
        """Data-ready edges since the last call, and the time by the firmware's clock in s."""
        with self._lock:
            self._require(Capability.EVENT_COUNTER)
            now = self._ask(wire.StatisticsRequest(), wire.StatisticsReply)
            # The firmware never sets its counter back: a reply that was lost loses no edges.
            new, self._counted = (now.edges - self._counted) & 0xFFFF_FFFF, now.edges
            self._board_us += (now.now_us - self._board_us) & 0xFFFF_FFFF
            return new, self._board_us * 1e-6

    # -- for streams ------------------------------------------------------------------------------------

    def next_scans(self, wait_s: float) -> tuple[Packet, float] | None:
        """Next packet of scans and its arrival; None where none came in time."""
        with self._lock:
            self._require_open()
            scans = self._link.scans
            end_s = self.now_s() + wait_s
            while not scans:
                left = end_s - self.now_s()
                if left <= 0:
                    return None
                if self._link.pump(left) and not scans:
                    self.sleep_s(_GATHER_S)
            return scans.popleft()

    def count_edges(self) -> int:
        """Data-ready edges that the firmware has counted (u32)."""
        with self._lock:
            self._require_open()
            return self._ask(wire.StatisticsRequest(), wire.StatisticsReply).edges

    def _stop(self) -> None:
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

    def _ask(self, request: Body, reply: type[B], runs_s: float = 0.0) -> B:
        if self._lost_session:
            self._renew()
        try:
            return self._link.request(request, reply, runs_s)
        except RefusedError as refused:
            forgotten = refused.code in (wire.Refusal.NO_SESSION, wire.Refusal.BUSY)
            if not forgotten or self._stream is not None:
                raise ProtocolError(f"{self.url}: {refused}") from refused
            self._lost_session = True
            if not refused.once:
                # An earlier copy may have been executed before the firmware restarted.
                raise ProtocolError(f"{self.url}: the firmware restarted during a request") from refused
        except BusTimeoutError:
            self._lost_session = True
            raise
        self._renew()
        try:
            return self._link.request(request, reply, runs_s)
        except RefusedError as refused:
            raise ProtocolError(f"{self.url}: {refused}") from refused

    def _renew(self) -> None:
        """Open a new session and set the timing in force, which a hello sets back."""
        self.firmware = self._link.hello(AGAIN_S)
        timing = self.timing
        request = wire.ConfigureRequest(
            int(timing.clock_hz), math.ceil(timing.stall_us), math.ceil(timing.period_us)
        )
        try:
            self._link.request(request, wire.ConfigureReply)
        except RefusedError as refused:
            raise ProtocolError(f"{self.url}: {refused}") from refused
        self._lost_session = False
