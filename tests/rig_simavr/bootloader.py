"""Openings of a board with Optiboot: what its receiver makes of bytes at another rate than its own."""

from __future__ import annotations

import ctypes
import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from adis_gonio.base.errors import BusTimeoutError
from adis_gonio.device.bus.serial import HELLO_EVERY_S, SerialBus, SerialLink
from adis_gonio.device.bus.wire import Packet, encode, protocol as wire

PS = 1_000_000_000_000
"""Picoseconds in a second."""


class _Options(ctypes.Structure):
    _fields_ = tuple(
        (name, ctypes.c_int64)
        for name in ("reset", "start", "blink", "watchdog", "give_up", "phase", "tick", "per_bit")
    )


class _Counts(ctypes.Structure):
    _fields_ = tuple(
        (name, ctypes.c_uint32)
        for name in (
            "bytes",
            "framing_errors",
            "overruns",
            "commands",
            "replies",
            "page_erases",
            "page_writes",
        )
    )


@dataclass(frozen=True)
class Board:
    """How a board starts; times in s. The defaults are an Uno's with Optiboot.

    Attributes
    ----------
    reset_s : float
        Length of the reset pulse that opening the port makes.
    start_s : float
        Oscillator's start-up behind it.
    blink_s : float
        The LED blinks; bytes wait in the receiver.
    watchdog_s : float
        Silence after which the application is started.
    baud : float
        What the boot loader's divider makes of 115 200.
    samples_a_bit : int
        8 at double speed, else 16.
    """

    reset_s: float = 0.001
    start_s: float = 0.065
    blink_s: float = 0.375
    watchdog_s: float = 1.0
    baud: float = 16e6 / 8 / 17
    samples_a_bit: int = 8


@dataclass
class Openings:
    """Counts over openings, and the latest start of an application."""

    openings: int = 0
    bytes: int = 0
    framing_errors: int = 0
    commands: int = 0
    page_erases: int = 0
    page_writes: int = 0
    last_start_s: float = 0.0


Sent = Iterable[tuple[float, bytes]]
"""Times from opening in s, and the bytes that go out then."""


class BootLoader:
    """The bit-level model (boot.c).

    Parameters
    ----------
    library : Path
        libboot.so.
    """

    def __init__(self, library: Path) -> None:
        self._opening = ctypes.CDLL(str(library)).boot_opening
        self._opening.restype = ctypes.c_int64
        self._opening.argtypes = [ctypes.c_void_p, ctypes.c_int, *([ctypes.c_void_p] * 2), ctypes.c_int64,
                                  ctypes.c_void_p]  # fmt: skip
        self.seen = Openings()

    def open(self, sent: Sent, *, baud: float, board: Board | None = None, phase_s: float = 0.0) -> float:
        """One opening; returns when the application starts, in s."""
        board = board or Board()
        times = (board.reset_s, board.start_s, board.blink_s, board.watchdog_s, 0.016, phase_s)
        tick = PS / board.baud / board.samples_a_bit
        options = _Options(*(round(value * PS) for value in times), round(tick), board.samples_a_bit)
        at: list[int] = []
        data = bytearray()
        for time_s, chunk in sent:
            at += [round(time_s * PS)] * len(chunk)
            data += chunk
        counts = _Counts()
        ended = self._opening(
            ctypes.byref(options),
            len(data),
            (ctypes.c_int64 * len(at))(*at),
            (ctypes.c_uint8 * len(data))(*data),
            round(PS / baud),
            ctypes.byref(counts),
        )
        seen = self.seen
        seen.openings += 1
        for name in ("bytes", "framing_errors", "commands", "page_erases", "page_writes"):
            setattr(seen, name, getattr(seen, name) + getattr(counts, name))
        seen.last_start_s = max(seen.last_start_s, ended / PS)
        return float(ended / PS)


class CapturingPort:
    """A port that answers nothing and keeps what was sent with its time; it is its own clock."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, bytes]] = []
        self._now_s = 0.0

    def now_s(self) -> float:
        return self._now_s

    def sleep_s(self, seconds: float) -> None:
        self._now_s += seconds

    def receive(self, wait_s: float, /) -> bytes:
        self._now_s += wait_s
        return b""

    def send(self, data: bytes, /) -> None:
        self.sent.append((self._now_s, data))

    def close(self) -> None:
        pass


def transport_sends(dice: random.Random) -> list[tuple[float, bytes]]:
    """What the serial transport sends to a board that stays silent."""
    port = CapturingPort()
    link = SerialLink(port, url="serial:", clock=port, dice=dice)
    try:
        SerialBus(port, clock=port, link=link)
    except BusTimeoutError:
        return port.sent
    raise AssertionError("a silent board answered")


def hello_at_once(dice: random.Random, seconds: float = 3.0) -> list[tuple[float, bytes]]:
    """A hello as soon as the port is open, repeated: how not to do it."""
    request = wire.HelloRequest(wire.VERSION, dice.randrange(1 << 32))
    packet = encode(Packet.of(request, dice.randrange(1 << 16)))
    return [(k * HELLO_EVERY_S, packet) for k in range(round(seconds / HELLO_EVERY_S))]


def zeros_first(
    dice: random.Random, zeros: int = 64, wait_s: float = 2.0, seconds: float = 4.0
) -> list[tuple[float, bytes]]:
    """A run of delimiters, a wait until any boot loader is over, then hellos."""
    hellos = hello_at_once(dice, seconds - wait_s)
    return [(0.0, bytes(zeros)), *((wait_s + at, packet) for at, packet in hellos)]


def zeros_apart(
    dice: random.Random, zeros: int = 13, every_s: float = 0.02, seconds: float = 3.0
) -> list[tuple[float, bytes]]:
    """Single delimiters 20 ms apart, a pause in which a loader leaves, then hellos.

    A zero alone is 0xFE to any receiver near 115 200 baud, and two of them are no command: a loader leaves.
    In a run without gaps the two clocks beat, and what should end a command may be a blank by chance.
    """
    begin_s = zeros * every_s + 0.16
    hellos = hello_at_once(dice, seconds - begin_s)
    return [
        *((k * every_s, b"\x00") for k in range(zeros)),
        *((begin_s + at, packet) for at, packet in hellos),
    ]


BOARDS: Sequence[Board] = (
    Board(),
    Board(blink_s=0.0),
    Board(watchdog_s=0.5),
    Board(reset_s=0.010, start_s=0.004),
    Board(baud=16e6 / 16 / 9, samples_a_bit=16),
    Board(blink_s=0.0, baud=115_200.0, samples_a_bit=16),
    Board(baud=16e6 / 16 / 17, samples_a_bit=16),
)
"""Boot loaders of other builds: no blinking, another watchdog, other fuses, other dividers."""


def open_often(
    library: Path,
    way: Callable[[random.Random], Sent],
    board: Board,
    seeds: range,
    *,
    baud: float = wire.BAUD,
) -> Openings:
    """Openings that differ in ids, nonces, the host's delay, both clocks' errors and phases."""
    boot = BootLoader(library)
    for seed in seeds:
        dice = random.Random(seed)
        sent, late_s = way(dice), dice.uniform(0, 0.3)
        host = baud * (1 + dice.uniform(-0.025, 0.025))
        boot.open(
            [(at + late_s, data) for at, data in sent], baud=host, board=board, phase_s=dice.random() * 1e-6
        )
    return boot.seen
