"""The project's firmware as a device model, byte by byte, written from firmware_proto/PROTOCOL.md alone.

It shares no code with the package or with the C core: the bodies are implemented here again; the packages
cobs and zlib do framing and CRC.
A stream takes a scan at each edge of data-ready: the period and the decimation of PROTOCOL.md are refused.
In `SimulatedFirmware`, `feed` takes the bytes that arrive now, `run` simulates until a time, `out` contains
the packets that it sends, each with the time at which its last byte is ready.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import KW_ONLY, InitVar, dataclass
from functools import partial

from adis_gonio.device.bus.wire import load_cobs
from adis_gonio.sim.testing.pins import ChipPins

VERSION = 1
NO_SESSION, UNKNOWN, BAD_LENGTH, BUSY, BAD_FRAME, WRITE_COUNT, BAD_VALUE, ID_REUSED, OTHER_VERSION = range(
    1, 10
)
RISING, FALLING = 0, 1
CLOCKS = (2_000_000, 1_000_000, 500_000, 250_000, 125_000, 0)
MAX_FRAMES, MAX_LIST, MAX_SCAN_BYTES, MAX_WAIT = 100, 32, 230, 65_000
DEFAULTS = (250_000, 75, 160)
TRIGGER_S = 4e-6


class _RefusalError(Exception):
    """Raised if a request is refused, with the code and the detail of the refusal."""

    def __init__(self, code: int, detail: int = 0) -> None:
        super().__init__()
        self.code, self.detail = code, detail


def _require(holds: object, code: int, detail: int = 0) -> None:
    if not holds:
        raise _RefusalError(code, detail)


def _unpacked(layout: str, body: bytes) -> tuple[int, ...]:
    _require(len(body) == struct.calcsize(layout), BAD_LENGTH)
    return struct.unpack(layout, body)


@dataclass(eq=False)
class SimulatedFirmware:
    """The firmware of a simulated board, connected to a simulated chip.

    Parameters
    ----------
    pins : ChipPins
        Pins of the chip, with the clock on which the firmware works.
    baud : int
        Baud rate of the bytes that it sends.
    drift : float
        Relative error of the board's own clock.
    start_us : int
        Reading in µs of the board's own clock at power-on.
    boot_s : float
        Silence in s after power-on and after a reset of the board.
    board : str
        Name of the board in its answer to the first request.
    capabilities : int
        Bits of the optional functions of the board, as in this answer (PROTOCOL.md).
    version : int
        Version of the protocol that the firmware speaks; it refuses a host that asks for another one.

    Attributes
    ----------
    out : deque of (float, bytes)
        Packets to the host, each with the time in s at which its last byte is ready.
    executed : list of bytes
        Requests that were executed, without their framing.
    """

    pins: ChipPins
    _: KW_ONLY
    baud: int = 500_000
    drift: float = 0.0
    start_us: int = 0
    boot_s: float = 0.0
    board: str = "simulated F1"
    capabilities: int = 7
    version: int = VERSION

    def __post_init__(self) -> None:
        self.byte_s = 10 / self.baud
        self.out: deque[tuple[float, bytes]] = deque()
        self.executed: list[bytes] = []
        counters = ("packets", "crc", "cobs", "length", "discarded", "repeated", "overruns")
        self.counters = dict.fromkeys(counters, 0)
        self.frames = self.all_lost = self.scan_packets = 0
        self.restart()

    # -- start -------------------------------------------------------------------------------------------

    def restart(self) -> None:
        """Start again, as after power-on or a reset by the DTR line."""
        self.awake_s = self.pins.clock.now_s() + self.boot_s
        self._buffer = bytearray()
        self._session = False
        self._nonce = -1
        self._last = (-1, -1, b"")
        self._timing = DEFAULTS
        self._start_s = self._rise_s = -math.inf
        self._line_free_s = 0.0
        self._stream: _Stream | None = None
        self._totals = (0, 0)
        self.out.clear()

    def now_us(self, time_s: float) -> int:
        """Return the board's 32-bit microsecond clock at a time in s, including its drift."""
        return (self.start_us + round(time_s * 1e6 * (1 + self.drift))) & 0xFFFF_FFFF

    def feed(self, data: bytes) -> None:
        """Receive bytes from the host at the present time and execute each complete packet."""
        if self.pins.clock.now_s() < self.awake_s:
            return
        for byte in data:
            if byte:
                self._buffer.append(byte)
                if len(self._buffer) > 600:
                    del self._buffer[300:]
            elif self._buffer:
                taken, self._buffer = bytes(self._buffer), bytearray()
                self._packet(taken)

    def next_event_s(self) -> float | None:
        """Return the time in s of the next trigger of the running stream.

        Returns None if no stream runs, or if no data-ready edge follows.
        """
        if self._stream is None:
            return None
        return self._stream.next_trigger_s()

    def run(self, time_s: float) -> None:
        """Make all scans of the stream that are due up to a time in s."""
        while self._stream is not None:
            trigger = self._stream.next_trigger_s()
            if trigger is None or trigger > time_s:
                return
            self._stream.scan(trigger)

    # -- packets ----------------------------------------------------------------------------------------

    def send(self, kind: int, request_id: int, body: bytes, ready_s: float | None = None) -> None:
        """Queue a packet to the host: its type, the id of the request, and its body.

        `kind` is the number of the type; `ready_s` is the time in s at which the packet is ready, None for
        now.
        """
        raw = struct.pack("<BH", kind, request_id) + body
        assert len(raw) + 4 <= 252
        stuffed: bytes = load_cobs().encode(raw + struct.pack("<I", zlib.crc32(raw)))
        self._put(stuffed + b"\0", ready_s)

    def _put(self, data: bytes, ready_s: float | None = None) -> None:
        start = max(self.pins.clock.now_s() if ready_s is None else ready_s, self._line_free_s)
        self._line_free_s = start + len(data) * self.byte_s
        self.out.append((self._line_free_s, data))

    def _packet(self, stuffed: bytes) -> None:
        try:
            raw: bytes = load_cobs().decode(stuffed)
        except load_cobs().DecodeError:
            self.counters["cobs"] += 1
            return
        if not 7 <= len(raw) <= 252:
            self.counters["length"] += 1
        elif zlib.crc32(raw[:-4]) != struct.unpack("<I", raw[-4:])[0]:
            self.counters["crc"] += 1
        else:
            self.counters["packets"] += 1
            self._request(raw)

    def _request(self, raw: bytes) -> None:
        """Execute, repeat, refuse or discard a request, by its type and its id.

        A hello with a new nonce opens a session; without a session all other requests are refused. If the
        last request arrives again, its reply is sent again; an older request is discarded.
        """
        kind, request_id = struct.unpack_from("<BH", raw)
        check = struct.unpack("<I", raw[-4:])[0]
        body = raw[3:-4]
        if kind & 0x80:
            self.counters["discarded"] += 1
            return
        hello = kind == 1 and len(body) == 5
        nonce = struct.unpack_from("<I", body, 1)[0] if hello else -1
        fresh = hello and (not self._session or nonce != self._nonce)
        if not fresh:
            if not self._session:
                self._refuse(kind, request_id, NO_SESSION)
                return
            step = (request_id - self._last[0]) & 0xFFFF
            if step == 0:
                if check == self._last[1]:
                    self.counters["repeated"] += 1
                    self._put(self._last[2])
                else:
                    self._refuse(kind, request_id, ID_REUSED)
                return
            if step > 32767:
                self.counters["discarded"] += 1
                return
        self.executed.append(raw)
        try:
            self.send(kind | 0x80, request_id, self._execute(kind, request_id, body))
        except _RefusalError as refused:
            self._refuse(kind, request_id, refused.code, refused.detail)
        if self._session:
            self._last = (request_id, check, self.out[-1][1])

    def _refuse(self, kind: int, request_id: int, code: int, detail: int = 0) -> None:
        self.send(0xFF, request_id, struct.pack("<BBH", kind, code, detail))

    # -- requests ---------------------------------------------------------------------------------------

    def _execute(self, kind: int, request_id: int, body: bytes) -> bytes:
        """Execute a request of type `kind`; return the body of its reply."""
        requests: dict[int, Callable[[bytes], bytes]] = {
            1: self._hello,
            2: self._configure,
            3: self._exchange,
            4: partial(self._begin_stream, request_id),
            5: self._stop,
            6: self._reset,
            7: self._count,
        }
        _require(kind in requests, UNKNOWN)
        return requests[kind](body)

    def _require_idle(self) -> None:
        _require(self._stream is None, BUSY)

    def _hello(self, body: bytes) -> bytes:
        version, nonce = _unpacked("<BI", body)
        _require(version == self.version, OTHER_VERSION, self.version)
        self._session, self._nonce = True, nonce
        self._stream = None
        self._timing = DEFAULTS
        limits = (MAX_FRAMES, MAX_LIST, MAX_SCAN_BYTES, MAX_WAIT)
        fixed = (self.version, 0, 1, 0, self.capabilities, *limits)
        times = (self.now_us(self.pins.clock.now_s()), nonce, *CLOCKS)
        return struct.pack("<BBBBHBBBHII6I", *fixed, *times) + self.board.encode()

    def _configure(self, body: bytes) -> bytes:
        clock, stall, period = _unpacked("<IHH", body)
        self._require_idle()
        fits = [hz for hz in CLOCKS if 0 < hz <= clock]
        _require(fits, BAD_VALUE, 0)
        _require(stall <= MAX_WAIT, BAD_VALUE, 4)
        _require(period <= MAX_WAIT, BAD_VALUE, 6)
        self._timing = (fits[0], stall, period)
        return struct.pack("<IHH", *self._timing)

    def _exchange(self, body: bytes) -> bytes:
        count = len(body) // 2
        _require(len(body) % 2 == 1 and 1 <= count <= MAX_FRAMES, BAD_LENGTH)
        self._require_idle()
        frames = struct.unpack_from(f"<{count}H", body, 1)
        bad = [k for k, frame in enumerate(frames) if frame & 0x4000]
        writes = sum(frame >> 15 for frame in frames)
        _require(not bad, BAD_FRAME, bad[0] if bad else 0)
        _require(writes == body[0], WRITE_COUNT, writes)
        return struct.pack(f"<{count}H", *(self.frame(frame) for frame in frames))

    def frame(self, word: int, not_before_s: float = -math.inf) -> int:
        """Send a frame to the chip as soon as the timing allows; return the reply.

        The frame does not start before `not_before_s`.
        """
        clock, stall, period = self._timing
        start = max(
            self.pins.clock.now_s() if math.isinf(not_before_s) else not_before_s,
            self._rise_s + stall * 1e-6,
            self._start_s + period * 1e-6,
        )
        reply = self.pins.transfer(word.to_bytes(2, "big"), clock_hz=clock, start_s=start)
        self._rise_s = self.pins.free_s
        self._start_s = self._rise_s - 16 / clock
        self.frames += 1
        return int.from_bytes(reply, "big")

    def _begin_stream(self, request_id: int, body: bytes) -> bytes:
        _require(len(body) >= 10 and len(body) % 2 == 0, BAD_LENGTH)
        self._require_idle()
        trigger, scans, decimation, period_us = struct.unpack_from("<BBHI", body)
        frames = struct.unpack_from(f"<{(len(body) - 8) // 2}H", body, 8)
        bad = [k for k, frame in enumerate(frames) if frame & 0xC000]
        _require(not bad, BAD_FRAME, bad[0] if bad else 0)
        _require(len(frames) <= MAX_LIST, BAD_LENGTH)
        _require(trigger <= FALLING, BAD_VALUE, 0)
        _require(scans and scans * 2 * len(frames) <= MAX_SCAN_BYTES, BAD_VALUE, 1)
        _require(decimation == 1, BAD_VALUE, 2)
        _require(not period_us, BAD_VALUE, 4)
        now = self.pins.clock.now_s()
        self._stream = _Stream(self, request_id, trigger == RISING, scans, frames, now)
        return struct.pack("<I", self.now_us(now))

    def _stop(self, body: bytes) -> bytes:
        _require(not body, BAD_LENGTH)
        if self._stream is not None:
            self._stream.flush(self.pins.clock.now_s())
            self._totals = (self._stream.sent, self._stream.lost)
            self._stream = None
        return struct.pack("<II", *self._totals)

    def _reset(self, body: bytes) -> bytes:
        (low_us,) = _unpacked("<H", body)
        self._require_idle()
        _require(10 <= low_us <= 50_000, BAD_VALUE, 0)
        clock = self.pins.clock
        clock.advance_to(clock.now_s() + low_us * 1e-6)
        self.pins.hard_reset()
        return struct.pack("<I", self.now_us(clock.now_s()))

    def _count(self, body: bytes) -> bytes:
        _require(not body, BAD_LENGTH)
        now, edges = self.now_us(self.pins.clock.now_s()), self.pins.data_ready_edges()
        figures = [value & 0xFFFF for value in self.counters.values()]
        return struct.pack("<IIII7H", now, edges, self.all_lost, self.frames, *figures)


@dataclass(eq=False)
class _Stream:
    """A running stream of scans, each started by an edge of data-ready.

    The fields have the content of the request that started the stream; `begun_s` is the time of its start
    in s.
    """

    firmware: SimulatedFirmware
    id: int
    rising: bool
    scans: int
    frames: tuple[int, ...]
    begun_s: InitVar[float]

    def __post_init__(self, begun_s: float) -> None:
        self.sent = self.lost = 0
        self._after_s = begun_s
        self._words: list[int] = []
        self._times: list[float] = []
        self._first_lost = 0
        self._blocked_s = -math.inf

    def next_trigger_s(self) -> float | None:
        """Return the time in s of the next trigger that starts a scan; None if no edge follows."""
        chip = self.firmware.pins.chip
        if not chip.data_ready_enabled:
            return None
        return chip.next_edge_s(max(self._after_s, chip.time_s), rising=self.rising)

    def scan(self, trigger_s: float) -> None:
        """Make the scan that a trigger starts, and count the triggers that are missed during it.

        `trigger_s` is the time of the trigger in s. The scan sends the read frames and an idle frame.
        """
        firmware = self.firmware
        if trigger_s < self._blocked_s:
            self._lose(1)
            self._after_s = trigger_s
            return
        words = [
            firmware.frame(frame, trigger_s + TRIGGER_S if k == 0 else -1.0)
            for k, frame in enumerate((*self.frames, 0))
        ][1:]
        end_s = firmware.pins.free_s
        if not self._times:
            self._first_lost = self.lost
        self._times.append(trigger_s)
        self._words += words
        period = firmware.pins.chip.update_period_s
        missed = int((end_s - trigger_s) / period)
        self._after_s = trigger_s + missed * period + 1e-9
        if missed or len(self._times) == self.scans:
            self.flush(end_s)
        self._lose(missed)

    def _lose(self, count: int) -> None:
        self.lost += count
        self.firmware.all_lost += count

    def flush(self, now_s: float) -> None:
        """Send the scans collected so far to the host as a packet.

        `now_s` is the time in s at which the packet is ready to be sent.
        """
        if not self._times:
            return
        firmware = self.firmware
        first, last = firmware.now_us(self._times[0]), firmware.now_us(self._times[-1])
        counts = self.sent & 0xFFFF_FFFF, self._first_lost & 0xFFFF
        head = struct.pack("<IHII", *counts, first, (last - first) & 0xFFFF_FFFF)
        body = head + struct.pack(f"<{len(self._words)}H", *self._words)
        # Two buffers: one is sent while the other fills; if both are full, triggers are lost.
        self._blocked_s = firmware._line_free_s
        firmware.send(0xC4, self.id, body, now_s)
        firmware.scan_packets += 1
        self.sent += len(self._times)
        self._words, self._times = [], []
