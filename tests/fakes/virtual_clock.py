"""A clock for models of devices, on which waits take no time."""


class VirtualClock:
    """Clock that advances only by simulated waits and work, so that a time-out takes no real time."""

    def __init__(self, now_s: float = 0.0) -> None:
        self._now_s = now_s

    def now_s(self) -> float:
        """Return the present time in s of the virtual clock."""
        return self._now_s

    def sleep_s(self, seconds: float) -> None:
        """Advance the clock by `seconds`, without waiting."""
        if seconds > 0:
            self._now_s += seconds

    def advance_to(self, time_s: float) -> None:
        """Advance the clock to a time in s at which the device's work ends, unless it is later already."""
        self._now_s = max(self._now_s, time_s)
