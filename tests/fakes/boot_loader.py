"""A board that resets when its port is opened: its boot loader hears the line first, at its own baud rate.

The loader is Optiboot as its source describes it: STK500 commands at 115 200 baud, each ended by a blank; a
wrong ending, or a second without a sound byte, and the watchdog starts the application. It hears the line
bit by bit: bytes at the host's rate are levels in time, which it samples in the middle of its own bits.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator

from adis_gonio.sim.testing.firmware import SimulatedFirmware

BIT_S = 8 * 17 / 16e6
"""115 200 baud of a 16 MHz AVR: 117 647."""
WATCHDOG_S = 1.0
LEAVE_S = 0.016
START_UP_S = 0.069
BLANK = 0x20
ERASES = ord("d")
ARGUMENTS = {ord("A"): 1, ord("B"): 20, ord("E"): 5, ord("U"): 2, ord("V"): 4, ord("t"): 3}


class Line:
    """What one end sends, as levels in time."""

    def __init__(self, baud: float) -> None:
        self._bit_s = 1 / baud
        self._bytes: list[tuple[float, int]] = []

    def add(self, byte: int, end_s: float) -> None:
        """A byte whose stop bit ends at a time."""
        self._bytes.append((end_s - 10 * self._bit_s, byte))

    def level(self, time_s: float) -> bool:
        for start_s, byte in reversed(self._bytes):
            if time_s >= start_s:
                bit = math.floor((time_s - start_s) / self._bit_s)
                return bit > 8 or (bit > 0 and bool(byte >> (bit - 1) & 1))
        return True

    def falls_after(self, time_s: float) -> float | None:
        """First falling edge from a time on."""
        for start_s, byte in self._bytes:
            if start_s + 10 * self._bit_s < time_s:
                continue
            levels = [True, False, *(bool(byte >> k & 1) for k in range(8)), True]
            for k in range(10):
                at_s = start_s + k * self._bit_s
                if levels[k] and not levels[k + 1] and at_s >= time_s:
                    return at_s
        return None


class BootLoader:
    """Optiboot from a reset on.

    Parameters
    ----------
    reset_s : float
        When the board was reset.
    start_s : float
        From there to its receiver's being on.
    blinks_s : float
        How long it blinks before it reads; its receiver holds two bytes meanwhile.
    stubborn : bool
        Does not mind what it hears, and leaves after its second alone.

    Attributes
    ----------
    erased : int
        Commands to erase a page that it has obeyed.
    overheard : int
        Bytes other than zero that were on the line while it would have obeyed.
    left_s : float or None
        When it left.
    """

    def __init__(
        self, reset_s: float, baud: float, *, start_s=START_UP_S, blinks_s=0.0, stubborn=False
    ) -> None:
        self.erased = self.overheard = 0
        self.left_s: float | None = None
        self._line = Line(baud)
        self._from_s = reset_s + start_s
        self._reads_from_s = self._from_s + blinks_s
        self._deadline_s = self._reads_from_s + WATCHDOG_S
        self._fifo: deque[tuple[int, bool]] = deque()
        self._stubborn = stubborn
        self._program = self._commands()
        next(self._program)

    def hear(self, byte: int, end_s: float) -> None:
        """A byte has passed on the line."""
        self.run(end_s)
        if byte and self.left_s is None and end_s > self._from_s and len(self._fifo) != 2:
            self.overheard += 1
        self._line.add(byte, end_s)

    def run(self, time_s: float) -> None:
        """Live until a time."""
        while self.left_s is None:
            fall_s = self._line.falls_after(self._from_s)
            if fall_s is None or fall_s + 9.5 * BIT_S > time_s:
                break
            self._read_to(fall_s)
            bits = [self._line.level(fall_s + (k + 1.5) * BIT_S) for k in range(9)]
            self._from_s = fall_s + 9.5 * BIT_S
            if len(self._fifo) < 2:
                self._fifo.append((sum(bit << k for k, bit in enumerate(bits[:8])), bits[8]))
        self._read_to(time_s)

    def _read_to(self, time_s: float) -> None:
        while self._fifo and time_s >= self._reads_from_s and self.left_s is None:
            byte, sound = self._fifo.popleft()
            now_s = max(self._reads_from_s, self._from_s)
            if sound:
                self._deadline_s = max(self._deadline_s, now_s + WATCHDOG_S)
            if not self._stubborn and self._program.send(byte):
                self._deadline_s = now_s + LEAVE_S
                self._fifo.clear()
                self.left_s = self._deadline_s  # it reads no more
        if self.left_s is None and time_s >= self._deadline_s:
            self.left_s = self._deadline_s

    def _commands(self) -> Generator[bool, int, None]:
        """Takes bytes; yields True where the loader gives up."""
        gives_up = False
        while True:
            command = yield gives_up
            if command == ERASES:
                yield False
                length = yield False
                yield False
                self.erased += 1
                for _ in range(length):
                    yield False
            for _ in range(ARGUMENTS.get(command, 0)):
                yield False
            gives_up = (yield False) != BLANK


class BootingBoard(SimulatedFirmware):
    """The firmware behind a boot loader; `open` on its port resets it, as does `restart`."""

    def __init__(self, pins, *, baud: int = 500_000, **loader) -> None:
        self._loader_options = loader
        self._baud = baud
        super().__init__(pins, baud=baud)

    def restart(self) -> None:
        super().restart()
        self.loader = BootLoader(self.pins.clock.now_s(), self._baud, **self._loader_options)
        self.awake_s = math.inf

    def run(self, time_s: float) -> None:
        self.loader.run(time_s)
        if self.loader.left_s is not None:
            self.awake_s = self.loader.left_s + START_UP_S
        super().run(time_s)

    def feed(self, data: bytes) -> None:
        now_s = self.pins.clock.now_s()
        for byte in data:
            self.loader.hear(byte, now_s)
        super().feed(data)
