"""The project's firmware as a device model, byte by byte, written from firmware_proto/PROTOCOL.md alone.

It shares no code with the package or with the C core: framing, CRC and bodies are implemented here again.
`feed` takes the bytes that arrive now, `run` simulates until a time, `out` contains the packets that it
sends, each with the time at which its last byte is ready.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections import deque

from adis_gonio.sim.testing.pins import ChipPins

VERSION = 1
NO_SESSION, UNKNOWN, BAD_LENGTH, BUSY, BAD_FRAME, WRITE_COUNT, BAD_VALUE, ID_REUSED, OTHER_VERSION = range(
    1, 10
)
RISING, FALLING, PERIOD = 0, 1, 2
CLOCKS = (2_000_000, 1_000_000, 500_000, 250_000, 125_000, 0)
MAX_FRAMES, MAX_LIST, MAX_SCAN_BYTES, MAX_WAIT = 100, 32, 230, 65_000
DEFAULTS = (250_000, 75, 160)
TRIGGER_S = 4e-6


def crc(data: bytes) -> int:
    """CRC-32 of the bytes (CRC-32/ISO-HDLC, as in zlib)."""
    return zlib.crc32(data)


def stuff(data: bytes) -> bytes:
    """Encode bytes by COBS, so that the result has no zero byte."""
    out, run = bytearray(), bytearray()
    for k, byte in enumerate(data):
        if byte:
            run.append(byte)
        if not byte or len(run) == 254:
            out += bytes([len(run) + 1]) + run
            run.clear()
            if byte and k == len(data) - 1:
                return bytes(out)
    return bytes(out + bytes([len(run) + 1]) + run)


def unstuff(data: bytes) -> bytes | None:
    """Decode bytes encoded by COBS; None if they are invalid."""
    out, k = bytearray(), 0
    while k < len(data):
        size = data[k]
        if not size or k + size > len(data):
            return None
        out += data[k + 1 : k + size]
        k += size
        if size < 255 and k < len(data):
            out.append(0)
    return bytes(out)


class SimulatedFirmware:
    """The firmware of a simulated board, connected to a simulated chip.

    Parameters
    ----------
    pins : ChipPins
        Pins with the clock of the firmware.
    baud : int
        Baud rate of the bytes that it sends.
    drift : float
        Relative error of the board's own clock.
    start_us : int
        Its clock at power-on.
    boot_s : float
        Silence after power-on and after a reset of the board.
    """

    def __init__(
        self,
        pins: ChipPins,
        *,
        baud: int = 500_000,
        drift: float = 0.0,
        start_us: int = 0,
        boot_s: float = 0.0,
        board: str = "simulated F1",
        capabilities: int = 7,
        version: int = VERSION,
    ) -> None:
        self.pins = pins
        self.byte_s = 10 / baud
        self.drift = drift
        self.start_us = start_us
        self.boot_s = boot_s
        self.board = board
        self.capabilities = capabilities
        self.version = version
        self.out: deque[tuple[float, bytes]] = deque()
        self.executed: list[bytes] = []
        self.counters = dict.fromkeys(
            ("packets", "crc", "cobs", "length", "discarded", "repeated", "overruns"), 0
        )
        self.frames = 0
        self.all_lost = 0
        self.scan_packets = 0
        self.restart()

    # -- life -------------------------------------------------------------------------------------------

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
        """Reading of the board's 32-bit microsecond clock at a time in s, including its drift."""
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
        """Time in s of the firmware's next action without a request; None if it only waits."""
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

    def send(self, kind: int, request_id: int, body: bytes) -> None:
        """Queue a packet to the host: its type, the id of the request, and its body."""
        self._put(self._packed(kind, request_id, body))

    @staticmethod
    def _packed(kind: int, request_id: int, body: bytes) -> bytes:
        raw = struct.pack("<BH", kind, request_id) + body
        assert len(raw) + 4 <= 252
        return stuff(raw + struct.pack("<I", crc(raw))) + b"\0"

    def _put(self, data: bytes, ready_s: float | None = None) -> None:
        start = max(self.pins.clock.now_s() if ready_s is None else ready_s, self._line_free_s)
        self._line_free_s = start + len(data) * self.byte_s
        self.out.append((self._line_free_s, data))

    def _packet(self, stuffed: bytes) -> None:
        raw = unstuff(stuffed)
        if raw is None:
            self.counters["cobs"] += 1
        elif not 7 <= len(raw) <= 252:
            self.counters["length"] += 1
        elif crc(raw[:-4]) != struct.unpack("<I", raw[-4:])[0]:
            self.counters["crc"] += 1
        else:
            self.counters["packets"] += 1
            self._request(raw)

    def _request(self, raw: bytes) -> None:
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
        before = len(self.out)
        self.executed.append(raw)
        handler = getattr(self, f"_do_{kind:02x}", None)
        if handler is None:
            self._refuse(kind, request_id, UNKNOWN)
        else:
            handler(request_id, body)
        reply = self.out[-1][1] if len(self.out) > before else b""
        if self._session:
            self._last = (request_id, check, reply)

    def _refuse(self, kind: int, request_id: int, code: int, detail: int = 0) -> None:
        self.send(0xFF, request_id, struct.pack("<BBH", kind, code, detail))

    # -- requests ---------------------------------------------------------------------------------------

    def _do_01(self, request_id: int, body: bytes) -> None:
        if len(body) != 5:
            self._refuse(1, request_id, BAD_LENGTH)
            return
        version, nonce = struct.unpack("<BI", body)
        if version != self.version:
            self._refuse(1, request_id, OTHER_VERSION, self.version)
            return
        self._session, self._nonce = True, nonce
        self._stream = None
        self._timing = DEFAULTS
        limits = (MAX_FRAMES, MAX_LIST, MAX_SCAN_BYTES, MAX_WAIT)
        fixed = (self.version, 0, 1, 0, self.capabilities, *limits)
        times = (self.now_us(self.pins.clock.now_s()), nonce, *CLOCKS)
        self.send(0x81, request_id, struct.pack("<BBBBHBBBHII6I", *fixed, *times) + self.board.encode())

    def _do_02(self, request_id: int, body: bytes) -> None:
        if len(body) != 8:
            self._refuse(2, request_id, BAD_LENGTH)
        elif self._stream is not None:
            self._refuse(2, request_id, BUSY)
        else:
            clock, stall, period = struct.unpack("<IHH", body)
            fits = [hz for hz in CLOCKS if 0 < hz <= clock]
            if not fits or stall > MAX_WAIT or period > MAX_WAIT:
                self._refuse(2, request_id, BAD_VALUE, 0 if not fits else 4 if stall > MAX_WAIT else 6)
                return
            self._timing = (fits[0], stall, period)
            self.send(0x82, request_id, struct.pack("<IHH", *self._timing))

    def _do_03(self, request_id: int, body: bytes) -> None:
        count = len(body) // 2
        if len(body) % 2 != 1 or not 1 <= count <= MAX_FRAMES:
            self._refuse(3, request_id, BAD_LENGTH)
            return
        if self._stream is not None:
            self._refuse(3, request_id, BUSY)
            return
        frames = struct.unpack_from(f"<{count}H", body, 1)
        bad = [k for k, frame in enumerate(frames) if frame & 0x4000]
        writes = sum(frame >> 15 for frame in frames)
        if bad:
            self._refuse(3, request_id, BAD_FRAME, bad[0])
        elif writes != body[0]:
            self._refuse(3, request_id, WRITE_COUNT, writes)
        else:
            words = [self.frame(frame) for frame in frames]
            self.send(0x83, request_id, struct.pack(f"<{count}H", *words))

    def frame(self, word: int, not_before_s: float = -math.inf) -> int:
        """Send a frame to the chip as soon as the timing allows; return the word received."""
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

    def _do_04(self, request_id: int, body: bytes) -> None:
        if len(body) < 10 or len(body) % 2:
            self._refuse(4, request_id, BAD_LENGTH)
            return
        if self._stream is not None:
            self._refuse(4, request_id, BUSY)
            return
        trigger, scans, decimation, period_us = struct.unpack_from("<BBHI", body)
        frames = struct.unpack_from(f"<{(len(body) - 8) // 2}H", body, 8)
        bad = [k for k, frame in enumerate(frames) if frame & 0xC000]
        if bad:
            self._refuse(4, request_id, BAD_FRAME, bad[0])
        elif len(frames) > MAX_LIST:
            self._refuse(4, request_id, BAD_LENGTH)
        elif trigger > PERIOD:
            self._refuse(4, request_id, BAD_VALUE, 0)
        elif not scans or scans * 2 * len(frames) > MAX_SCAN_BYTES:
            self._refuse(4, request_id, BAD_VALUE, 1)
        elif not decimation:
            self._refuse(4, request_id, BAD_VALUE, 2)
        elif (trigger == PERIOD) != bool(period_us):
            self._refuse(4, request_id, BAD_VALUE, 4)
        else:
            now = self.pins.clock.now_s()
            self._stream = _Stream(self, request_id, trigger, scans, decimation, period_us, frames, now)
            self.send(0x84, request_id, struct.pack("<I", self.now_us(now)))

    def _do_05(self, request_id: int, body: bytes) -> None:
        if body:
            self._refuse(5, request_id, BAD_LENGTH)
            return
        if self._stream is not None:
            self._stream.flush(self.pins.clock.now_s())
            self._totals = (self._stream.sent, self._stream.lost)
            self._stream = None
        self.send(0x85, request_id, struct.pack("<II", *self._totals))

    def _do_06(self, request_id: int, body: bytes) -> None:
        if len(body) != 2:
            self._refuse(6, request_id, BAD_LENGTH)
            return
        low_us = struct.unpack("<H", body)[0]
        if self._stream is not None:
            self._refuse(6, request_id, BUSY)
        elif not 10 <= low_us <= 50_000:
            self._refuse(6, request_id, BAD_VALUE, 0)
        else:
            clock = self.pins.clock
            clock.advance_to(clock.now_s() + low_us * 1e-6)
            self.pins.hard_reset()
            self.send(0x86, request_id, struct.pack("<I", self.now_us(clock.now_s())))

    def _do_07(self, request_id: int, body: bytes) -> None:
        if body:
            self._refuse(7, request_id, BAD_LENGTH)
            return
        now = self.pins.clock.now_s()
        figures = [value & 0xFFFF for value in self.counters.values()]
        edges = self.pins.data_ready_edges()
        lost = self.all_lost
        self.send(
            0x87, request_id, struct.pack("<IIII7H", self.now_us(now), edges, lost, self.frames, *figures)
        )


class _Stream:
    """A running stream of scans; `scan` makes each scan when the firmware has passed its trigger."""

    def __init__(
        self,
        firmware: SimulatedFirmware,
        request_id: int,
        trigger: int,
        scans: int,
        decimation: int,
        period_us: int,
        frames: tuple[int, ...],
        now_s: float,
    ) -> None:
        self.firmware = firmware
        self.id = request_id
        self.scans = scans
        self.decimation = decimation
        self.frames = frames
        self.sent = self.lost = 0
        self._rising = trigger == RISING
        self._period_s = period_us * 1e-6 / (1 + firmware.drift) if trigger == PERIOD else None
        self._after_s = now_s
        self._words: list[int] = []
        self._times: list[float] = []
        self._first_lost = 0
        self._blocked_s = -math.inf

    def next_trigger_s(self) -> float | None:
        """Time in s of the next trigger that starts a scan; None if no data-ready edge follows."""
        if self._period_s is not None:
            return self._after_s + self._period_s * self.decimation
        chip = self.firmware.pins.chip
        if not chip.data_ready_enabled:
            return None
        first = chip.next_edge_s(max(self._after_s, chip.time_s), rising=self._rising)
        return None if first is None else first + (self.decimation - 1) * chip.update_period_s

    def scan(self, trigger_s: float) -> None:
        """Make the scan of a trigger: send the read frames and an idle frame; count missed triggers."""
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
        period = self._period_s or firmware.pins.chip.update_period_s
        missed = int((end_s - trigger_s) / (period * self.decimation))
        self._after_s = trigger_s + missed * period * self.decimation + (0 if self._period_s else 1e-9)
        if missed or len(self._times) == self.scans:
            self.flush(end_s)
        self._lose(missed)

    def _lose(self, count: int) -> None:
        self.lost += count
        self.firmware.all_lost += count

    def flush(self, now_s: float) -> None:
        """Send the scans collected so far to the host as a packet."""
        if not self._times:
            return
        firmware = self.firmware
        first, last = firmware.now_us(self._times[0]), firmware.now_us(self._times[-1])
        head = struct.pack(
            "<IHII",
            self.sent & 0xFFFF_FFFF,
            self._first_lost & 0xFFFF,
            first,
            (last - first) & 0xFFFF_FFFF,
        )
        body = head + struct.pack(f"<{len(self._words)}H", *self._words)
        # Two buffers: one is sent while the other fills; if both are full, triggers are lost.
        self._blocked_s = firmware._line_free_s
        firmware._put(firmware._packed(0xC4, self.id, body), now_s)
        firmware.scan_packets += 1
        self.sent += len(self._times)
        self._words, self._times = [], []
