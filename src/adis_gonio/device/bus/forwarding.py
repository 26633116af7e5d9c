"""A bus that forwards every call to another bus; a subclass changes or observes some of the calls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, TypeVar

import numpy as np

from adis_gonio.device.bus.contract import FrameStream, SpiBus, SpiTiming, Words

T = TypeVar("T")


class ForwardingBus(SpiBus):
    """Base class of buses in front of another bus.

    Parameters
    ----------
    inner : SpiBus
        The other bus; `close` also closes it.
    """

    def __init__(self, inner: SpiBus) -> None:
        super().__init__(inner.timing)
        self.inner = inner
        self.url = inner.url
        self.capabilities = inner.capabilities
        self.edge_rises = inner.edge_rises
        self.unbroken_frames = inner.unbroken_frames

    @property
    def kind(self) -> str:
        """Name of the class of the inner bus, for a report."""
        return self.inner.kind

    @property
    def stage(self) -> Any:
        """Stage of the inner bus, which a program can move; None if the inner bus has no such stage."""
        return getattr(self.inner, "stage", None)

    @property
    def world(self) -> Any:
        """Simulated sensor and surroundings of the inner bus; None if the inner bus is no simulator."""
        return getattr(self.inner, "world", None)

    @property
    def virtual_time(self) -> bool:
        """True if the clock of the inner bus advances only during calls."""
        return bool(getattr(self.inner, "virtual_time", False))

    def forward(
        self,
        name: str,
        action: Callable[[], T],
        frames: Words | None = None,
        arguments: Sequence[Any] = (),
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
