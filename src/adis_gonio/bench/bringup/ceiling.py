"""A bus that never clocks faster than the link was found to be free of errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from adis_gonio.device.bus import FrameStream, SpiBus, SpiTiming, Words


class ClockCeiling(SpiBus):
    """Passes everything on to another bus; `ceiling_hz` limits the clock from the next `configure` on."""

    def __init__(self, inner: SpiBus, ceiling_hz: float) -> None:
        super().__init__(inner.timing)
        self.inner = inner
        self.ceiling_hz = ceiling_hz
        self.url = inner.url
        self.capabilities = inner.capabilities
        self.edge_rises = inner.edge_rises
        self.unbroken_frames = inner.unbroken_frames

    def now_s(self) -> float:
        """Monotonic time of the bus in s."""
        return self.inner.now_s()

    def sleep_s(self, seconds: float) -> None:
        """Wait on the bus's clock."""
        self.inner.sleep_s(seconds)

    def stream(self, frames: Sequence[int], *, block_scans: int = 256) -> FrameStream:
        """As the bus."""
        return self.inner.stream(frames, block_scans=block_scans)

    def hard_reset(self) -> None:
        """As the bus."""
        self.inner.hard_reset()

    def read_event_counter(self) -> int:
        """As the bus."""
        return self.inner.read_event_counter()

    def _exchange(self, frames: Words) -> Words:
        return self.inner.exchange_array(frames)

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        return self.inner.configure(replace(timing, clock_hz=min(timing.clock_hz, self.ceiling_hz)))

    def _close(self) -> None:
        self.inner.close()
