"""Buses for tests: one that writes down what passes, one that plays a script."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.device.bus import FrameStream, SpiBus, SpiTiming, Words, WrappedBus

SLOW = SpiTiming(250_000, 75.0, 160.0)


class RecordingBus(WrappedBus):
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

    def _start_stream(self, frames: Sequence[int], block_scans: int) -> FrameStream:
        self.streamed += list(frames)
        return super()._start_stream(frames, block_scans)

    def _exchange(self, frames: Words) -> Words:
        self.batches.append((self.timing, frames.copy()))
        return super()._exchange(frames)


class ScriptedBus(SpiBus):
    """Answers from a list of (frame, reply); fails on another frame and on what was left unused."""

    def __init__(self, script: Sequence[tuple[int, int]]) -> None:
        super().__init__(SLOW)
        self.url = "scripted:"
        self.script = list(script)
        self.at = 0
        self.time_s = 0.0

    def now_s(self) -> float:
        return self.time_s

    def sleep_s(self, seconds: float) -> None:
        self.time_s += seconds

    def _exchange(self, frames: Words) -> Words:
        replies = []
        for frame in frames:
            assert self.at < len(self.script), f"frame 0x{frame:04X} after the script's end"
            expected, reply = self.script[self.at]
            assert frame == expected, f"frame {self.at}: sent 0x{frame:04X}, script has 0x{expected:04X}"
            replies.append(reply)
            self.at += 1
            self.time_s += self.timing.frame_s
        return np.array(replies, np.uint16)

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        return timing

    def _close(self) -> None:
        assert self.at == len(self.script), f"{len(self.script) - self.at} steps of the script left unused"


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
