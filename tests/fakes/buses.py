"""Buses for tests: one that keeps the frames that pass, one that always gives one reply."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.device.bus import FrameStream, SpiBus, SpiTiming, Words
from adis_gonio.device.bus.contract import ForwardingBus

SLOW = SpiTiming(250_000, 75.0, 160.0)


class RecordingBus(ForwardingBus):
    """Passes everything on to another bus and keeps each batch with the timing in force.

    `inner` may be any bus; what it raises goes through.
    """

    def __init__(self, inner: SpiBus) -> None:
        super().__init__(inner)
        self.batches: list[tuple[SpiTiming, Words]] = []
        self.streamed: list[int] = []

    @property
    def frames(self) -> list[int]:
        """Every frame that was sent, in order, those of streams included."""
        return [int(frame) for _, batch in self.batches for frame in batch] + self.streamed

    @property
    def writes(self) -> list[int]:
        """Frames with the write bit."""
        return [frame for frame in self.frames if frame & 0x8000]

    def stream(self, frames: Sequence[int], *, block_scans: int = 256) -> FrameStream:
        self.streamed += list(frames)
        return self.inner.stream(frames, block_scans=block_scans)

    def _exchange(self, frames: Words) -> Words:
        self.batches.append((self.timing, frames.copy()))
        return self.inner.exchange_array(frames)


class ConstantBus(SpiBus):
    """Answers every frame with the same word, as an unconnected data line does."""

    def __init__(self, word: int) -> None:
        super().__init__(SLOW)
        self.url = "constant:"
        self.word = word
        self.time_s = 0.0

    def now_s(self) -> float:
        return self.time_s

    def sleep_s(self, seconds: float) -> None:
        self.time_s += seconds

    def _exchange(self, frames: Words) -> Words:
        self.time_s += frames.size * self.timing.frame_s
        return np.full(frames.size, self.word, np.uint16)

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        return timing

    def _close(self) -> None:
        pass
