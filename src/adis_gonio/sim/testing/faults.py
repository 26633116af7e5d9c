"""Simulated faults between host and device, drawn from a seed: of bytes, USB packets and SPI frames.

`Faults` has the probability of each kind of fault, and draws the faults. `FaultyStream` applies them to the
bytes of a serial line, and a model of a USB device asks `Faults` for each packet. Kinds of faults of a byte
or a packet:

* `drop`: it is lost; `duplicate`: it arrives twice; `flip`: one of its bits is changed;
* `delay`: it arrives late, by `delay_s` on average; `chunk`: a pause of 2 ms comes before it (bytes only).

Kinds of faults of a device, drawn for each packet:

* `hang`: the device does not react for `hang_s` (also the device on a serial line);
* `busy`: it refuses the request; `progress`: it reports that it is still at work;
* `stuck`: it does not finish this transfer or any later one, until a reset or a cancel;
* `short`: it returns one byte too few; `unplug`: it is disconnected.

`FaultyBus` is a bus around another bus that corrupts its frames, for drivers and host code that have to
notice. Each kind of fault has its own generator, so the faults of a frame do not depend on its batch or on
the other kinds.
"""

from __future__ import annotations

import math
import random
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.errors import BusTimeoutError, ProtocolError, UsageError
from adis_gonio.device.bus.contract import FRAME_BITS, FrameBlock, FrameStream, SpiBus, Words
from adis_gonio.device.bus.forwarding import ForwardingBus


@dataclass
class Faults:
    """Probabilities of the faults of a serial line or device, and the random draws from them.

    Each kind of fault is explained in the text of the module. The field with its name is the probability of
    this fault for one byte or packet. `seed` starts the random draws, `delay_s` is the mean delay and
    `hang_s` the length of a hang, both in s.

    `seen` counts the faults that happened, by kind.
    """

    seed: int = 0
    drop: float = 0.0
    duplicate: float = 0.0
    flip: float = 0.0
    delay: float = 0.0
    chunk: float = 0.0
    hang: float = 0.0
    unplug: float = 0.0
    busy: float = 0.0
    progress: float = 0.0
    stuck: float = 0.0
    short: float = 0.0
    delay_s: float = 0.05
    hang_s: float = 0.6
    seen: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.dice = random.Random(self.seed)
        self.hung_until_s = -math.inf

    def happens(self, kind: str) -> bool:
        """Draw at random if a fault of this kind happens now; if so, count it in `seen` and return True."""
        rate = getattr(self, kind)
        if rate and self.dice.random() < rate:
            self.seen[kind] += 1
            return True
        return False

    def hangs(self, now_s: float) -> bool:
        """Return True while the device hangs, that is, does not react.

        Each call may start a hang.
        """
        if now_s >= self.hung_until_s and self.happens("hang"):
            self.hung_until_s = now_s + self.hang_s
        return now_s < self.hung_until_s

    def flipped(self, data: bytes, first: int, last: int) -> bytes:
        """Return a copy of `data` in which some bytes have one flipped bit.

        Each byte from `first` to `last` (exclusive) may be affected.
        """
        out = bytearray(data)
        for k in range(first, min(last, len(out))):
            if self.happens("flip"):
                out[k] ^= 1 << self.dice.randrange(8)
        return bytes(out)

    def delayed_s(self) -> float:
        """Draw the additional delay of a transfer in s; 0 if no delay happens."""
        return self.delay_s * self.dice.random() * 2 if self.happens("delay") else 0.0


class FaultyStream:
    """One direction of a serial line: the bytes in transit, in order, each with its time of arrival.

    Parameters
    ----------
    faults : Faults
        Probabilities and random draws of the faults.
    byte_s : float
        Time in s that the line needs for a byte.
    """

    def __init__(self, faults: Faults, byte_s: float = 0.0) -> None:
        self.faults = faults
        self._byte_s = byte_s
        self._queue: deque[tuple[float, int]] = deque()
        self._last_s = -math.inf

    def put(self, data: bytes, now_s: float) -> None:
        """Send bytes into the line at the time `now_s`; faults may lose, double, change or delay them."""
        faults = self.faults
        for byte in data:
            if faults.happens("drop"):
                continue
            if faults.happens("flip"):
                byte ^= 1 << faults.dice.randrange(8)
            # A chunk is a pause inside a packet, as made by a hub or a driver; a delay may be long.
            extra = faults.delayed_s() + (0.002 if faults.happens("chunk") else 0.0)
            self._last_s = max(self._last_s, now_s) + self._byte_s + extra
            for _ in range(2 if faults.happens("duplicate") else 1):
                self._queue.append((self._last_s, byte))

    def next_s(self) -> float | None:
        """Return the time in s at which the next byte arrives; None if no byte is in transit."""
        return self._queue[0][0] if self._queue else None

    def take(self, now_s: float, size: int) -> bytes:
        """Remove up to `size` bytes that have arrived by the time `now_s` from the line; return them."""
        taken = bytearray()
        while self._queue and len(taken) < size and self._queue[0][0] <= now_s:
            taken.append(self._queue.popleft()[1])
        return bytes(taken)


@dataclass(frozen=True)
class BusFaults:
    """Probabilities (0 to 1) of faults of SPI frames, and the properties of these faults.

    Attributes
    ----------
    seed : int
        Seed of all random draws.
    bit_errors : float
        Probability that a bit of a reply is flipped, as by noise on the data line; SPI cannot detect it.
    lost_frames : float
        Probability that a frame does not reach the chip, as with a loose chip select: its reply is
        `idle_word`, and the next frame gets the reply that this frame would have got. A stream omits the
        scan and counts it as lost.
    stuck_words : float
        Probability that a reply is repeated in place of the next `stuck_frames` replies.
    stuck_frames : int
        Number of replies that are replaced, at least 1.
    busy : float
        Probability that the bridge refuses a batch before it sends a frame: `ProtocolError`.
    silent : float
        Probability that a batch is sent but not answered: `BusTimeoutError`.
    idle_word : int
        Word that an undriven data line gives.
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
                raise UsageError(f"{kind} is {rate}: take a probability from 0 to 1")
        if self.stuck_frames < 1:
            raise UsageError(f"stuck_frames is {self.stuck_frames}: take 1 or more")
        if not 0 <= self.idle_word <= 0xFFFF:
            raise UsageError(f"idle_word is {self.idle_word}: take 0 to 65535")


_KINDS = tuple(entry.name for entry in fields(BusFaults) if isinstance(entry.default, float))
"""Kinds of faults: the fields of `BusFaults` that are probabilities."""
NO_FAULTS = BusFaults()


class FaultyBus(ForwardingBus):
    """A bus that passes frames to another bus and corrupts the replies.

    Parameters
    ----------
    inner : SpiBus
        Other bus; `close` also closes it.
    faults : BusFaults
        Probabilities of the faults.

    Attributes
    ----------
    seen : Counter
        Number of faults that happened, by name of the field of `BusFaults`.
    """

    def __init__(self, inner: SpiBus, faults: BusFaults = NO_FAULTS) -> None:
        super().__init__(inner)
        self.seen: Counter[str] = Counter()
        self.faults = faults

    @property
    def faults(self) -> BusFaults:
        """Probabilities of the faults; assigning new ones restarts the random draws from their seed."""
        return self._faults

    @faults.setter
    def faults(self, faults: BusFaults) -> None:
        with self._lock:
            self._faults = faults
            seeds = np.random.SeedSequence(faults.seed).spawn(len(_KINDS))
            self._dice = {k: np.random.default_rng(s) for k, s in zip(_KINDS, seeds, strict=True)}
            self._stuck_left, self._stuck_word = 0, 0

    # -- faulty calls --------------------------------------------------------------------------------

    def stream(self, frames: Sequence[int], *, block_scans: int = 256) -> FrameStream:
        """Start a stream of the read frames `frames` on the inner bus, with faults in its scans.

        A block of the stream holds about `block_scans` scans.
        """
        return _FaultyFrames(self, super().stream(frames, block_scans=block_scans))

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
                self.inner.sleep_s(len(part) * self.timing.frame_s)  # the bridge still clocks them
            else:
                replies[part] = self.inner.exchange_array(frames[part])
        return replies

    def _spoilt(self, words: Words) -> Words:
        """Return a copy of replies (n,), some replaced by an earlier reply and some with flipped bits."""
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
        """Draw the items, out of `count`, that a fault of this kind affects; return a mask (count,).

        The affected items are counted in `seen`.
        """
        rate = getattr(self._faults, kind)
        if not rate:
            return np.zeros(count, bool)
        struck: NDArray[np.bool_] = self._dice[kind].random(count) < rate
        self.seen[kind] += int(struck.sum())
        return struck

    def _happens(self, kind: str) -> bool:
        return bool(self._struck(kind, 1)[0])


class _FaultyFrames(FrameStream):
    """A stream of the wrapped bus, with flipped bits, repeated words and lost scans."""

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
        """Close the stream of the wrapped bus."""
        self._inner.close()
