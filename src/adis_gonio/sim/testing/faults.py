"""Simulated faults between host and device, drawn from a seed: of bytes, USB packets and SPI frames.

`Faults` has the probability of each kind of fault, and draws the faults. `FaultyStream` applies them to the
bytes of a serial line, `FaultyBus` to the frames of another bus, and a model of a USB device asks `Faults`
for each packet. Kinds of faults of a byte, a packet or a frame:

* `drop`: it is lost; `duplicate`: it arrives twice; `flip`: one of its bits is changed;
* `delay`: it arrives late, by `delay_s` on average; `chunk`: a pause of 2 ms comes before it (bytes only).

Kinds of faults of a device, drawn for each packet or batch of frames:

* `hang`: the device does not react for `hang_s` (also the device on a serial line; a bus: for this batch);
* `busy`: it refuses the request; `progress`: it reports that it is still at work;
* `stuck`: it does not finish this transfer or any later one, until a reset or a cancel;
* `short`: it returns one byte too few; `unplug`: it is disconnected.

A lost frame does not reach the chip, as with a loose chip select: its reply is `IDLE`, and the next frame
gets the reply that this frame would have got. A stream omits the scan and counts it as lost. The reply of
a frame that arrives twice also takes the place of the next reply.
"""

from __future__ import annotations

import math
import random
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from adis_gonio.base.errors import BusTimeoutError, ProtocolError, UsageError
from adis_gonio.device.bus.contract import FRAME_BITS, ForwardingBus, FrameBlock, FrameStream, SpiBus, Words


@dataclass
class Faults:
    """Probabilities of the faults of a serial line, device or bus, and the random draws from them.

    Each kind of fault is explained in the text of the module. The field with its name is the probability of
    this fault for one byte, packet or frame. `seed` starts the random draws, `delay_s` is the mean delay
    and `hang_s` the length of a hang, both in s.

    `seen` counts the faults that happened, by kind.

    Raises
    ------
    UsageError
        A probability is not within 0 to 1.
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
        for entry in fields(self):
            rate = getattr(self, entry.name)
            if isinstance(entry.default, float) and not entry.name.endswith("_s") and not 0 <= rate <= 1:
                raise UsageError(f"{entry.name} is {rate}: take a probability from 0 to 1")
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


IDLE = 0xFFFF
"""Word that an undriven data line gives."""


class FaultyBus(ForwardingBus):
    """A bus that passes frames to another bus and corrupts the replies.

    Parameters
    ----------
    inner : SpiBus
        Other bus; `close` also closes it.
    faults : Faults or None
        Probabilities of the faults `drop`, `duplicate`, `flip`, `busy` and `hang`; None for no faults.
    """

    def __init__(self, inner: SpiBus, faults: Faults | None = None) -> None:
        super().__init__(inner)
        self.faults = faults or Faults()
        self._last = IDLE

    def stream(self, frames: Sequence[int], *, block_scans: int = 256) -> FrameStream:
        """Start a stream of the read frames `frames` on the inner bus, with faults in its scans.

        A block of the stream holds about `block_scans` scans.
        """
        return _FaultyFrames(self, super().stream(frames, block_scans=block_scans))

    def _exchange(self, frames: Words) -> Words:
        if self.faults.happens("busy"):
            raise ProtocolError(f"{self.url}: the bridge is busy and has sent nothing (a fault by seed)")
        drawn = self._draw_faults(len(frames))
        replies = np.full(len(frames), IDLE, np.uint16)
        for part in np.split(np.arange(len(frames)), np.flatnonzero(np.diff(drawn[0])) + 1):
            if drawn[0, part[0]]:
                self.inner.sleep_s(len(part) * self.timing.frame_s)  # the bridge still clocks them
            else:
                replies[part] = self.inner.exchange_array(frames[part])
        if self.faults.happens("hang"):
            raise BusTimeoutError(f"{self.url}: the bridge does not answer (a fault by seed)")
        return self._corrupted(replies, drawn)

    def _draw_faults(self, count: int) -> Words:
        """Draw the faults of some frames, one frame after another, whatever the size of a batch.

        Returns
        -------
        (3, count) uint16
            1 if the frame is lost, else 0; 1 if its reply is the reply before; bits of its reply to flip.
        """
        faults = self.faults
        rows = []
        for _ in range(count):
            lost, repeated = faults.happens("drop"), faults.happens("duplicate")
            rows.append((lost, repeated, faults.happens("flip") << faults.dice.randrange(FRAME_BITS)))
        return np.array(rows, np.uint16).reshape(-1, 3).T

    def _corrupted(self, words: Words, drawn: Words) -> Words:
        """Return a copy of the replies (n,) with those faults that `_draw_faults` (3, n) has."""
        before = np.append(np.uint16(self._last), words[:-1])
        self._last = int(words[-1])
        return np.asarray(np.where(drawn[1], before, words) ^ drawn[2])


class _FaultyFrames(FrameStream):
    """A stream of the wrapped bus, with flipped bits, repeated words and lost scans."""

    def __init__(self, bus: FaultyBus, inner: FrameStream) -> None:
        self._bus = bus
        self._inner = inner

    def __next__(self) -> FrameBlock:
        block = next(self._inner)
        with self._bus._lock:
            drawn = self._bus._draw_faults(block.words.size)
            words = self._bus._corrupted(block.words.ravel(), drawn).reshape(block.words.shape)
        lost = drawn[0].reshape(words.shape).any(axis=1)
        return FrameBlock(words[~lost], block.time_s[~lost], block.lost + int(lost.sum()))

    def close(self) -> None:
        """Close the stream of the wrapped bus."""
        self._inner.close()
