"""Scans that say by their own words which sample of the chip they are, so that a receiver can be judged."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from fakes.firmware import TRIGGER_S, FakeFirmware

RATE_HZ = 819.2
FRAME_S = 40e-6
SCANS = 0xC4


def words_of(samples: np.ndarray, width: int) -> np.ndarray:
    """Words (n, width) uint16 of samples by their numbers: two hold the number, the others depend on it."""
    column = np.arange(width, dtype=np.uint64)
    mixed = (samples.astype(np.uint64)[:, None] + column) * 0x9E3779B97F4A7C15
    words = (mixed >> 40).astype(np.uint16)
    words[:, 0] = samples & 0xFFFF
    words[:, 1] = samples >> 16
    return words


class NumberingFirmware(FakeFirmware):
    """Answers each frame of a scan with a word of its sample, without asking the chip."""

    packets = 0
    _words: list[int] | None = None
    _column = 0

    def frame(self, word: int, not_before_s: float = -1.0) -> int:
        if not_before_s > 0:  # the first of a scan
            sample = round((not_before_s - TRIGGER_S) * RATE_HZ)
            # The first reply of a list is thrown away.
            self._words = [0, *words_of(np.array([sample]), 32)[0].tolist()]
            self._column = 0
            self.pins.free_s = not_before_s
        self.pins.free_s += FRAME_S
        self._column += 1
        return self._words[self._column - 1] if self._words else 0

    def _packed(self, kind: int, request_id: int, body: bytes) -> bytes:
        self.packets += kind == SCANS
        return FakeFirmware._packed(kind, request_id, body)


@dataclass
class Judge:
    """Looks at every block of a stream; `found` counts scans, lost ones, wrong words and wrong counts."""

    width: int
    found: Counter = field(default_factory=Counter)
    _next: int = -1

    def look(self, words: np.ndarray, lost: int) -> None:
        """The next block."""
        samples = words[:, 0].astype(np.int64) | words[:, 1].astype(np.int64) << 16
        self.found["scans"] += len(samples)
        self.found["lost"] += lost
        self.found["wrong words"] += int((words_of(samples, self.width) != words).sum())
        self.found["backwards"] += int((np.diff(samples, prepend=self._next - 1) <= 0).sum())
        if self._next >= 0:  # what is lost before the first block nobody can know by its words
            gone = int(samples[-1]) + 1 - self._next - len(samples)
            self.found["wrong counts"] += gone != lost
            self.found["gaps"] += gone > 0
        self._next = int(samples[-1]) + 1

    @property
    def sound(self) -> bool:
        """True where nothing was wrong."""
        return not (self.found["wrong words"] or self.found["wrong counts"] or self.found["backwards"])
