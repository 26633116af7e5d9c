"""Faults of SPI frames, by seed: a bus around another one that spoils what passes.

For drivers and host code that have to notice. Each kind has a generator of its own, so that the same frames
meet the same faults however they are grouped into batches, and whatever other kinds are switched on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.errors import BusTimeoutError, ProtocolError, UsageError
from adis_gonio.device.bus.contract import FRAME_BITS, FrameBlock, FrameStream, SpiBus, SpiTiming, Words

_KINDS = ("bit_errors", "lost_frames", "stuck_words", "busy", "silent")


@dataclass(frozen=True)
class BusFaults:
    """What may go wrong with frames, as probabilities from 0 to 1.

    Attributes
    ----------
    seed : int
        Of all dice.
    bit_errors : float
        Of a bit of a reply to be turned, as noise on the data line does. Nothing on SPI tells.
    lost_frames : float
        Of a frame not to reach the chip, as with a loose chip select: its reply is `idle_word`, and the
        next reply is late by one frame. Of a stream the scan is left out and counted as lost.
    stuck_words : float
        Of a reply to stick: it comes again in the place of the `stuck_frames` next ones.
    stuck_frames : int
        From 1 on.
    busy : float
        Of a batch to be refused by the bridge, before a frame is sent: `ProtocolError`.
    silent : float
        Of a batch to end without an answer after it was sent: `BusTimeoutError`.
    idle_word : int
        What an undriven data line reads as.
    """

    seed: int = 0
    bit_errors: float = 0.0
    lost_frames: float = 0.0
    stuck_words: float = 0.0
    stuck_frames: int = 1
    busy: float = 0.0
    silent: float = 0.0
    idle_word: int = 0xFFFF

    def __post_init__(self) -> None:
        for kind in _KINDS:
            rate = getattr(self, kind)
            if not 0 <= rate <= 1:
                raise UsageError(f"{kind} is {rate}: a probability from 0 to 1")
        if self.stuck_frames < 1:
            raise UsageError(f"stuck_frames is {self.stuck_frames}: 1 or more")
        if not 0 <= self.idle_word <= 0xFFFF:
            raise UsageError(f"idle_word is {self.idle_word}: a word of 16 bits")


NO_FAULTS = BusFaults()


class FaultyBus(SpiBus):
    """A bus that spoils another one's frames.

    Parameters
    ----------
    inner : SpiBus
        Belongs to this one from now on: `close` closes it.
    faults : BusFaults

    Attributes
    ----------
    seen : Counter
        How often each kind has happened: turned bits, lost frames, replies that stuck, batches.
    """

    def __init__(self, inner: SpiBus, faults: BusFaults = NO_FAULTS) -> None:
        super().__init__(inner.timing)
        self.inner = inner
        self.url = inner.url
        self.capabilities = inner.capabilities
        self.edge_rises = inner.edge_rises
        self.unbroken_frames = inner.unbroken_frames
        self.seen: Counter[str] = Counter()
        self.faults = faults

    @property
    def faults(self) -> BusFaults:
        """What may go wrong; setting it begins its dice anew."""
        return self._faults

    @faults.setter
    def faults(self, faults: BusFaults) -> None:
        with self._lock:
            self._faults = faults
            seeds = np.random.SeedSequence(faults.seed).spawn(len(_KINDS))
            self._dice = {k: np.random.default_rng(s) for k, s in zip(_KINDS, seeds, strict=True)}
            self._stuck_left, self._stuck_word = 0, 0

    # -- what goes through as it is ------------------------------------------------------------------

    @property
    def stage(self) -> Any:
        """The inner bus's stage; None where it has none."""
        return getattr(self.inner, "stage", None)

    @property
    def world(self) -> Any:
        """The inner bus's world; None where it has none."""
        return getattr(self.inner, "world", None)

    def now_s(self) -> float:
        """Time of the inner bus."""
        return self.inner.now_s()

    def sleep_s(self, seconds: float) -> None:
        """Wait on the inner bus's clock."""
        self.inner.sleep_s(seconds)

    def hard_reset(self) -> None:
        """Pull the RST line of the inner bus."""
        self.inner.hard_reset()

    def read_event_counter(self) -> int:
        """Edges that the inner bus has counted."""
        return self.inner.read_event_counter()

    def count_events(self) -> tuple[int, float]:
        """Edges and time of the inner bus."""
        return self.inner.count_events()

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        return self.inner.configure(timing)

    def _close(self) -> None:
        self.inner.close()

    # -- what is spoilt ------------------------------------------------------------------------------

    def stream(self, frames: Sequence[int], *, block_scans: int = 256) -> FrameStream:
        """A stream of the inner bus, with faults in its words."""
        return _FaultyFrames(self, self.inner.stream(frames, block_scans=block_scans))

    def _exchange(self, frames: Words) -> Words:
        if self._happens("busy"):
            raise ProtocolError(f"{self.url}: the bridge is busy and has sent nothing (a fault by seed)")
        replies = self._sent(frames)
        if self._happens("silent"):
            raise BusTimeoutError(f"{self.url}: the bridge does not answer (a fault by seed)")
        return self._spoilt(replies)

    def _sent(self, frames: Words) -> Words:
        lost = self._struck("lost_frames", len(frames))
        replies = np.full(len(frames), self._faults.idle_word, np.uint16)
        edges = np.flatnonzero(np.diff(lost)) + 1
        for part in np.split(np.arange(len(frames)), edges):
            if lost[part[0]]:
                self.inner.sleep_s(len(part) * self.timing.frame_s)  # the bridge clocks them all the same
            else:
                replies[part] = self.inner.exchange_array(frames[part])
        return replies

    def _spoilt(self, words: Words) -> Words:
        """Replies (n,) with those that stick and turned bits."""
        words = words.copy()
        sticks = self._struck("stuck_words", len(words))
        if self._stuck_left or sticks.any():
            for k, word in enumerate(words):
                if self._stuck_left:
                    self._stuck_left -= 1
                    words[k] = self._stuck_word
                elif sticks[k]:
                    self._stuck_left, self._stuck_word = self._faults.stuck_frames, int(word)
        turned = self._struck("bit_errors", FRAME_BITS * len(words)).reshape(-1, FRAME_BITS)
        return words ^ (turned @ (1 << np.arange(FRAME_BITS))).astype(np.uint16)

    def _struck(self, kind: str, count: int) -> NDArray[np.bool_]:
        """Which of so many are struck by a kind of fault."""
        rate = getattr(self._faults, kind)
        if not rate:
            return np.zeros(count, bool)
        struck: NDArray[np.bool_] = self._dice[kind].random(count) < rate
        self.seen[kind] += int(struck.sum())
        return struck

    def _happens(self, kind: str) -> bool:
        return bool(self._struck(kind, 1)[0])


class _FaultyFrames(FrameStream):
    """A stream whose words are spoilt on their way."""

    def __init__(self, bus: FaultyBus, inner: FrameStream) -> None:
        self._bus = bus
        self._inner = inner

    def __next__(self) -> FrameBlock:
        block = next(self._inner)
        with self._bus._lock:
            words = self._bus._spoilt(block.words.ravel()).reshape(block.words.shape)
            lost = self._bus._struck("lost_frames", words.size).reshape(words.shape).any(axis=1)
        return FrameBlock(words[~lost], block.time_s[~lost], block.lost + int(lost.sum()))

    def close(self) -> None:
        """End the inner stream."""
        self._inner.close()
