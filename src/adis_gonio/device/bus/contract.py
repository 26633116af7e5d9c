"""The contract of a bus that carries 16-bit SPI frames: first this text, then the classes.

Unit of work
    A *batch of frames*. A frame is one 16-bit word, shifted MSB first in SPI mode 3 (CPOL 1, CPHA 1)
    while chip select is low for exactly 16 clocks. Each frame of a batch has a chip-select period of
    its own; a batch is never one long transfer and never a byte string.
Replies
    `exchange(frames)` returns one reply a frame: the 16 bits shifted *out* during that frame. The bus
    knows neither registers nor units, nor that the chip replies one frame late: the driver of the sensor
    knows them.
Who waits
    The bus. Between frames it keeps chip select high for at least `SpiTiming.stall_us`, starts frames
    at least `period_us` apart and never clocks faster than `clock_hz`; this also applies between the last
    frame of one batch and the first frame of the next. Slower is always allowed.
Timing is configuration
    `configure(timing)` sets the timing and returns the timing that the bus achieves. Other calls have no
    arguments for delays. A bus that cannot keep a timing, such as a clock below its slowest, raises
    `UsageError` and leaves the old timing in force.
Bit 14
    is zero in every frame of this family. A batch with a frame outside 0…0xFFFF or with bit 14 set is
    refused whole (`UsageError`) before anything is sent.
Errors
    A failed exchange raises one typed error (see `adis_gonio.base.errors`) within the bus's time-out and
    leaves the bus usable. No reply of a failed batch is returned. The bus never repeats a frame on its
    own unless it is certain that the first try did not reach the chip.
Threads
    A bus may be shared by threads: batches are atomic and do not interleave.
Closing
    `close()` may be called twice. Any other use after it raises `BusClosedError`.
Time
    `now_s()` is the bus's own monotonic clock and `sleep_s()` waits on it. A simulated bus has a
    virtual clock: waiting costs nothing, and drivers must wait by the bus, never by `time.sleep`.
Optional capabilities
    are members of the set `bus.capabilities`. A driver checks, for instance, if `Capability.STREAM` is in
    this set, and also works on a bus without optional capabilities.
"""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base import Closing
from adis_gonio.base.errors import BusClosedError, CapabilityError, ProtocolError, UsageError

T = TypeVar("T")
Words = NDArray[np.uint16]

FRAME_BITS = 16
RESERVED_BIT = 1 << 14


class Capability(StrEnum):
    """Optional function of a bus, in addition to `exchange`."""

    STREAM = "stream"
    """The bus can run a list of read frames at each data-ready edge and deliver the replies in blocks."""
    HARD_RESET = "hard-reset"
    """The bus can pull the chip's RST line."""
    EVENT_COUNTER = "event-counter"
    """The bus counts data-ready edges in hardware, so that lost samples can be proved."""


@dataclass(frozen=True)
class SpiTiming:
    """SPI timing of a bus: maximum clock in Hz, minimum stall and minimum frame period in µs.

    The stall is the pause between two frames. The period is the time from the start of a frame to the start
    of the next one.
    """

    clock_hz: float
    stall_us: float
    period_us: float

    def __post_init__(self) -> None:
        if not (self.clock_hz > 0 and self.stall_us >= 0 and self.period_us >= 0):
            raise UsageError(f"timing {self} is not possible: clock > 0, stall and period >= 0")

    @property
    def frame_s(self) -> float:
        """Shortest time in s from the start of a frame to the start of the next one."""
        return max(FRAME_BITS / self.clock_hz + self.stall_us * 1e-6, self.period_us * 1e-6)


@dataclass(frozen=True)
class FrameBlock:
    """Scans that a streaming bus delivers together.

    Attributes
    ----------
    words : (n, k) uint16
        Reply to each of the k frames of the stream's list, for n scans. The chip replies one frame late,
        but each reply is in the column of its own frame.
    time_s : (n,) float
        Time of each scan's trigger on the bus's clock.
    lost : int
        Number of triggers between the end of the previous block and the end of this block that gave no
        scan.
    """

    words: Words
    time_s: NDArray[np.float64]
    lost: int = 0


class SpiBus(Closing):
    """Base class of all SPI buses, which adds checks, locking and closing.

    A subclass implements `_exchange`, `_configure` and `_close`, sets `url`, and for its capabilities sets
    `capabilities` and implements `_start_stream`, `_pull_reset` and `_count_edges`. The module's text has
    the contract; `adis_gonio.testing.BusContract` is the test class that proves it.
    """

    url: str = ""
    capabilities: frozenset[Capability] = frozenset()
    edge_rises: bool = False
    """True if a rising edge of data-ready starts a scan of a stream; False if a falling edge does."""
    unbroken_frames: int | None = None
    """Largest number of frames that the bus runs without a pause; None if there is no limit."""

    def __init__(self, timing: SpiTiming) -> None:
        self.kind = type(self).__name__
        """Name of the class of this bus, for a report."""
        self._timing = timing
        self._closed = False
        self._lock = threading.RLock()

    # -- public methods --------------------------------------------------------------------------

    @property
    def timing(self) -> SpiTiming:
        """Timing that the bus uses now."""
        return self._timing

    @property
    def closed(self) -> bool:
        """True after `close` was called."""
        return self._closed

    def configure(self, timing: SpiTiming) -> SpiTiming:
        """Set the timing; return the timing that the bus achieves, which is never faster."""
        with self._lock:
            self._require_open()
            self._timing = self._configure(timing)
            return self._timing

    def exchange(self, frames: Sequence[int]) -> list[int]:
        """Send a batch of frames and return one 16-bit reply for each frame.

        Raises
        ------
        UsageError
            A frame is not a 16-bit word or has bit 14 set; nothing was sent.
        BusError
            The batch failed; no reply is returned, the bus stays usable.
        """
        for k, frame in enumerate(frames):
            if isinstance(frame, bool) or not isinstance(frame, int | np.integer):
                raise UsageError(f"frame {k} is {frame!r}: frames are integers of 16 bits")
            if not 0 <= frame <= 0xFFFF:
                raise UsageError(f"frame {k} is {frame}: frames are integers from 0 to 65535")
        return [int(reply) for reply in self.exchange_array(np.array(frames, dtype=np.uint16))]

    def exchange_array(self, frames: Words) -> Words:
        """Send a batch of frames and return the replies; faster than `exchange`.

        Both arrays are (n,) uint16. It raises the errors of `exchange`.
        """
        if frames.dtype != np.uint16 or frames.ndim != 1:
            raise UsageError("frames must be a one-dimensional array of uint16")
        reserved = np.flatnonzero(frames & RESERVED_BIT)
        if reserved.size:
            k = int(reserved[0])
            raise UsageError(f"frame {k} is 0x{int(frames[k]):04X}: bit 14 must be 0")
        with self._lock:
            self._require_open()
            if not frames.size:
                return np.empty(0, np.uint16)
            return self._checked(self._exchange(frames), frames.size)

    def _checked(self, replies: Words, count: int) -> Words:
        """Return the replies of `_exchange` as (count,) uint16, after a check of their number and range.

        Raises `ProtocolError` unless `replies` are `count` integers from 0 to 0xFFFF.
        """
        if isinstance(replies, np.ndarray) and replies.dtype == np.uint16 and replies.shape == (count,):
            return replies
        try:
            there: NDArray[Any] = np.asarray(replies)
        except ValueError:  # values of different shapes
            there = np.empty(0)
        whole = there.shape == (count,) and there.dtype.kind in "iu"
        if not whole or not ((there >= 0) & (there <= 0xFFFF)).all():
            raise ProtocolError(
                f"{self.url or type(self).__name__}: the bus answered {count} frames with"
                f" {there.size} values, not with {count} words of 16 bits"
            )
        return there.astype(np.uint16)

    def close(self) -> None:
        """Release the device behind the bus; a second call does nothing."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self._close()

    # -- time -----------------------------------------------------------------------------------

    def now_s(self) -> float:
        """Return the present time in s on the monotonic clock of this bus, which may be virtual."""
        return time.monotonic()

    def sleep_s(self, seconds: float) -> None:
        """Wait for `seconds` on the clock of this bus."""
        time.sleep(seconds)

    def witness(self, name: str, observe: Callable[[], T]) -> T:
        """Return `observe()`, a JSON value from outside the bus, such as an answer of the operator.

        A recording bus records the value under `name`, and a replay returns the recorded value instead.
        """
        return observe()

    # -- optional capabilities --------------------------------------------------------------------

    def stream(self, frames: Sequence[int], *, block_scans: int = 256) -> FrameStream:
        """Start a stream that runs the read frames `frames` once at each data-ready edge.

        It needs `Capability.STREAM`; a block of the stream holds about `block_scans` scans.

        Raises
        ------
        UsageError
            The list is empty, too long or contains a write, or a stream is running.
        """
        with self._lock:
            self._require(Capability.STREAM)
            if not frames or any(not 0 <= frame < RESERVED_BIT for frame in frames):
                raise UsageError("a stream takes at least one read frame and no writes")
            if block_scans < 1:
                raise UsageError(f"a block of {block_scans} scans is not possible; give at least 1")
            return self._start_stream(frames, block_scans)

    def hard_reset(self) -> None:
        """Reset the chip by its RST line (needs `Capability.HARD_RESET`); the caller waits for start-up."""
        with self._lock:
            self._require(Capability.HARD_RESET)
            self._pull_reset()

    def read_event_counter(self) -> int:
        """Return the number of data-ready edges since the last call (needs `Capability.EVENT_COUNTER`).

        Some counters have 16 bits, so call it at least once a minute.
        """
        with self._lock:
            self._require(Capability.EVENT_COUNTER)
            return self._count_edges()

    def count_events(self) -> tuple[int, float]:
        """Return the number of data-ready edges since the last call, and the time of counting in s.

        Two calls give the rate of data-ready. The time is on the clock of the bridge if it has one, else on
        the clock of the host. The time includes the unknown delay of the answer: use only differences of
        times.
        """
        return self.read_event_counter(), self.now_s()

    # -- methods of a bridge -----------------------------------------------------------------------

    @abstractmethod
    def _exchange(self, frames: Words) -> Words:
        """Send n frames (n,) and return their n replies (n,).

        The caller has checked that the frames are valid, n is at least 1 and the bus is open; it holds the
        lock.
        """

    @abstractmethod
    def _configure(self, timing: SpiTiming) -> SpiTiming:
        """Apply a timing to the device; return the timing that it achieves."""

    @abstractmethod
    def _close(self) -> None:
        """Release the device; `close` calls this at most once."""

    def _start_stream(self, frames: Sequence[int], block_scans: int) -> FrameStream:
        """Start a stream of the read frames `frames` and return it.

        A block of the stream has about `block_scans` scans. The caller has checked the frames and holds the
        lock.
        """
        raise NotImplementedError

    def _pull_reset(self) -> None:
        """Pull the chip's RST line low for about 1 ms; the caller holds the lock."""
        raise NotImplementedError

    def _count_edges(self) -> int:
        """Return the number of data-ready edges since the last call; the caller holds the lock."""
        raise NotImplementedError

    def _require_open(self) -> None:
        if self._closed:
            raise BusClosedError(f"{self.url or type(self).__name__}: the bus is closed")

    def _require(self, capability: Capability) -> None:
        self._require_open()
        if capability not in self.capabilities:
            raise CapabilityError(f"{self.url or type(self).__name__} has no capability '{capability}'")


class FrameStream(Closing):
    """A running stream: an iterator of `FrameBlock` that ends after `close`.

    While the stream runs, `exchange` of its bus raises `UsageError`; `close` ends this.
    """

    @abstractmethod
    def __next__(self) -> FrameBlock:
        """Return the next block; raise `BusError` on failure, or `StopIteration` after `close`."""

    @abstractmethod
    def close(self) -> None:
        """Stop the stream and free the bus; may be called twice."""

    def __iter__(self) -> Iterator[FrameBlock]:
        return self


class ForwardingBus(SpiBus):
    """Base class of buses in front of another bus.

    Parameters
    ----------
    inner : SpiBus
        The other bus; `close` also closes it.

    Attributes
    ----------
    stage, world : object or None
        Stage of the inner bus, which a program can move, and its simulated sensor and surroundings; None
        without them.
    virtual_time : bool
        True if the clock of the inner bus advances only during calls.
    """

    def __init__(self, inner: SpiBus) -> None:
        super().__init__(inner.timing)
        self.inner = inner
        self.kind, self.url = inner.kind, inner.url
        self.capabilities = inner.capabilities
        self.edge_rises = inner.edge_rises
        self.unbroken_frames = inner.unbroken_frames
        self.stage: Any = getattr(inner, "stage", None)
        self.world: Any = getattr(inner, "world", None)
        self.virtual_time = bool(getattr(inner, "virtual_time", False))

    def forward(
        self, name: str, action: Callable[[], T], frames: Words | None = None, arguments: Sequence[Any] = ()
    ) -> T:
        """Run `action`, which calls the method `name` of the inner bus, and return its result.

        A subclass overrides this method to observe the calls. `frames` and `arguments` (JSON values) are
        the arguments of the call.
        """
        return action()

    def now_s(self) -> float:
        """Return the time in s on the clock of the inner bus."""
        return self.inner.now_s()

    def sleep_s(self, seconds: float) -> None:
        """Wait for some seconds on the clock of the inner bus."""
        self.forward("sleep_s", lambda: self.inner.sleep_s(seconds), arguments=[float(seconds)])

    def witness(self, name: str, observe: Callable[[], T]) -> T:
        """Call the method `witness` of the inner bus and return its result, normally `observe()`.

        A recording bus also records the result under `name`. A replaying bus returns the recorded value
        instead.
        """
        return self.inner.witness(name, observe)

    def hard_reset(self) -> None:
        """Reset the chip by the RST line of the inner bus."""
        self.forward("hard_reset", self.inner.hard_reset)

    def read_event_counter(self) -> int:
        """Return the number of data-ready edges, counted by the inner bus, since the last call."""
        return self.forward("read_event_counter", self.inner.read_event_counter)

    def count_events(self) -> tuple[int, float]:
        """Return data-ready edges since the last call, and the time in s, from the inner bus."""
        return self.forward("count_events", self.inner.count_events)

    def stream(self, frames: Sequence[int], *, block_scans: int = 256) -> FrameStream:
        """Start a stream of the read frames `frames` on the inner bus.

        A block of the stream has about `block_scans` scans.
        """

        def start() -> FrameStream:
            return self.inner.stream(frames, block_scans=block_scans)

        return self.forward("stream", start, np.array(frames).astype(np.uint16), [block_scans])

    def _exchange(self, frames: Words) -> Words:
        return self.forward("exchange", lambda: self.inner.exchange_array(frames), frames)

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        return self.forward("configure", lambda: self.inner.configure(timing), arguments=[asdict(timing)])

    def _close(self) -> None:
        self.forward("close", self.inner.close)
