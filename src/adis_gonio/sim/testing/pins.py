"""The SPI wires and RST between a bridge and a simulated chip, and the clocks of device models.

`DeviceClock` and `WorkClock` follow the wall clock. A clock for tests may advance only if the program waits
or works.
"""

from __future__ import annotations

import time

from adis_gonio.sim.chip import SimulatedChip


class DeviceClock:
    """Real-time clock that starts at 0, for models of devices that a host opens (pty, USB/IP)."""

    def __init__(self) -> None:
        self._zero_s = time.monotonic()

    def now_s(self) -> float:
        """Return the time in s since the clock was created."""
        return time.monotonic() - self._zero_s

    def sleep_s(self, seconds: float) -> None:
        """Wait for `seconds` in real time."""
        time.sleep(max(0.0, seconds))

    def advance_to(self, time_s: float) -> None:
        """Wait in real time until a time in s at which the device's work ends."""
        self.sleep_s(time_s - self.now_s())


class WorkClock(DeviceClock):
    """Real-time clock of a device model that computes each answer with the time at which it is ready.

    Work advances this clock at once, ahead of the wall clock; the sender of an answer waits for its time. A
    model that slept for every frame would be late by as many wake-ups of a busy machine.
    """

    def __init__(self) -> None:
        super().__init__()
        self._done_s = 0.0

    def wall_s(self) -> float:
        """Real time in s since the clock was created, regardless of simulated work."""
        return super().now_s()

    def now_s(self) -> float:
        """Return the time in s of the simulated device.

        It is real time, or the end of the device's work if that is later.
        """
        return max(self.wall_s(), self._done_s)

    def advance_to(self, time_s: float) -> None:
        """Record that the device works until a time in s, without waiting."""
        self._done_s = max(self._done_s, time_s)


RIGHT_MODE = 3


class ChipPins:
    """The SPI and RST pins of a simulated chip, for models of bridges.

    Wrong use of the pins, such as a wrong SPI mode, gives wrong replies.

    Parameters
    ----------
    chip : SimulatedChip
        The chip.
    clock : DeviceClock
        Clock on which transfers take time, or another one with its methods.
    """

    def __init__(self, chip: SimulatedChip, clock: DeviceClock) -> None:
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
        """Clock bytes to the chip during one low phase of chip select; return the bytes that it sends.

        The transfer starts now, or at `start_s` if the bridge times its frames itself. `mode` is the SPI
        mode, `cs_hold_s` the time from the last clock to the rise of chip select; `selected` is False if
        chip select stays high.
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
            # A wrong edge or level costs the chip one of the clocks, so that its word is shifted.
            word, bits = word >> 1, bits - 1
        reply = self.chip.frame(word, start_s=start, clock_hz=clock_hz, bits=bits, cs_hold_s=cs_hold_s)
        if bits != 16:
            reply ^= 0x2222
        return reply.to_bytes(2, "big").ljust(len(data), b"\xff")[: len(data)]

    def hard_reset(self) -> None:
        """Pulse the RST line of the chip; its start-up follows."""
        self.chip.hard_reset(max(self.clock.now_s(), self.chip.time_s))

    def data_ready_edges(self) -> int:
        """Return the number of data-ready pulses of the chip since power-on."""
        return self.chip.data_ready_edges(max(self.clock.now_s(), self.chip.time_s))
