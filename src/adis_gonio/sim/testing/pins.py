"""The four SPI wires and RST between a bridge and a simulated chip."""

from __future__ import annotations

from typing import Protocol

from adis_gonio.sim.chip import SimulatedChip

RIGHT_MODE = 3


class PinClock(Protocol):
    """A clock on which work takes its time (see `adis_gonio.sim.testing.clocks`)."""

    def now_s(self) -> float:
        """Time in s."""

    def advance_to(self, time_s: float) -> None:
        """Work goes on until a time."""


class ChipPins:
    """A chip on a bridge's pins; the bridge says what it does with them, the chip punishes what is wrong.

    Parameters
    ----------
    chip : SimulatedChip
    clock : PinClock
        Work on the wires takes its time on it.
    """

    def __init__(self, chip: SimulatedChip, clock: PinClock) -> None:
        self.chip = chip
        self.clock = clock
        self.free_s = clock.now_s()
        self.transfers = 0

    def transfer(
        self,
        data: bytes,
        *,
        clock_hz: float,
        mode: int = RIGHT_MODE,
        cs_hold_s: float = 0.0,
        selected: bool = True,
        start_s: float | None = None,
    ) -> bytes:
        """One chip-select period; returns as many bytes as it was given.

        It starts now, or at `start_s` where the bridge times its frames itself.
        """
        now = self.clock.now_s() if start_s is None else start_s
        start = max(now, self.free_s, self.chip.time_s)
        self.free_s = start + 8 * len(data) / clock_hz + cs_hold_s
        self.clock.advance_to(self.free_s)
        self.transfers += 1
        if not selected:
            return b"\xff" * len(data)
        word, bits = int.from_bytes(data[:2].ljust(2, b"\0"), "big"), 8 * len(data)
        if mode != RIGHT_MODE:
            # A wrong edge or level costs the chip one of the clocks; what it sees is shifted.
            word, bits = word >> 1, bits - 1
        reply = self.chip.frame(word, start_s=start, clock_hz=clock_hz, bits=bits, cs_hold_s=cs_hold_s)
        if bits != 16:
            reply ^= 0x2222
        return reply.to_bytes(2, "big").ljust(len(data), b"\xff")[: len(data)]

    def hard_reset(self) -> None:
        """RST goes high again."""
        self.chip.hard_reset(max(self.clock.now_s(), self.chip.time_s))

    def data_ready_edges(self) -> int:
        """Edges so far."""
        return self.chip.data_ready_edges(max(self.clock.now_s(), self.chip.time_s))
