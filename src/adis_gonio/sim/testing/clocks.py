"""Clocks of device models: one that stands still unless somebody waits or works, and the wall's."""

from __future__ import annotations

import time


class VirtualClock:
    """Time that only moves on when it is waited for; a time-out costs nothing."""

    def __init__(self, now_s: float = 0.0) -> None:
        self._now_s = now_s

    def now_s(self) -> float:
        """Time in s."""
        return self._now_s

    def sleep_s(self, seconds: float) -> None:
        """Let time pass."""
        if seconds > 0:
            self._now_s += seconds

    def advance_to(self, time_s: float) -> None:
        """Work goes on until a time."""
        self._now_s = max(self._now_s, time_s)


class DeviceClock:
    """The wall's clock, from 0 on, for device models that live in real time (pty, USB/IP)."""

    def __init__(self) -> None:
        self._zero_s = time.monotonic()

    def now_s(self) -> float:
        """Time since it was made, in s."""
        return time.monotonic() - self._zero_s

    def sleep_s(self, seconds: float) -> None:
        """Wait."""
        time.sleep(max(0.0, seconds))

    def advance_to(self, time_s: float) -> None:
        """Wait until the work would be done."""
        self.sleep_s(time_s - self.now_s())


class WorkClock(DeviceClock):
    """The same for a model whose answers carry the time at which they are ready.

    Work sets it forward at once, before the wall's clock has come so far; whoever sends the answer waits
    for it. A model that slept for every frame would be late by as many wake-ups of a busy machine.
    """

    def __init__(self) -> None:
        super().__init__()
        self._done_s = 0.0

    def wall_s(self) -> float:
        """The wall's clock."""
        return super().now_s()

    def now_s(self) -> float:
        """The wall's time, or that up to which work is done where it is ahead."""
        return max(self.wall_s(), self._done_s)

    def advance_to(self, time_s: float) -> None:
        """Work is done until a time."""
        self._done_s = max(self._done_s, time_s)
