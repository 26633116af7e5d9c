"""The firmware's clock on the host's: wraps undone, offset and rate followed.

A packet cannot arrive before it was sent, so the earliest arrivals of a while lie on the true line; a
straight line through them gives offset and rate (a ceramic resonator is off by up to 0.5 %). Times that
were handed out stay: the map is bent towards the line, never torn.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_WRAP_US = 1 << 32
_WHILE_S = 1.0
"""Arrivals of so long give one point, the earliest."""
_POINTS = 32
_LEAST_POINTS = 4
_STEEPEST = 0.02
"""Most that the map's rate is off 1; resonators are four times better."""


class ClockMap:
    """Map from the firmware's µs (u32) to the bus's clock.

    Parameters
    ----------
    now_us : int
        Firmware's clock in a reply.
    arrival_s : float
        When that reply came in.
    """

    def __init__(self, now_us: int, arrival_s: float) -> None:
        self._us = now_us
        self._s = 0.0
        self._anchor = (0.0, arrival_s)
        self._points: list[tuple[float, float]] = []
        self._fitted: tuple[float, float, float] | None = None

    def times(self, first_us: int, span_us: int, count: int, arrival_s: float) -> NDArray[np.float64]:
        """Times (count,) of evenly spaced scans on the bus's clock.

        Parameters
        ----------
        first_us, span_us : int
            Time of the first scan, and from there to the last.
        arrival_s : float
            When the packet came in.
        """
        first_s = self._unwrap(first_us)
        end_s = first_s + span_us * 1e-6
        self._learn(end_s, arrival_s)
        at_s, at_host_s = self._anchor
        if end_s <= at_s:
            rate = 1.0
        else:
            rate = (self._line(end_s) - at_host_s) / (end_s - at_s)
            rate = min(max(rate, 1 - _STEEPEST), 1 + _STEEPEST)
            self._anchor = (end_s, at_host_s + rate * (end_s - at_s))
        return at_host_s + rate * (np.linspace(first_s, end_s, count) - at_s)

    def _unwrap(self, us: int) -> float:
        """Seconds since the start for a time that is at most half a wrap away from the last one."""
        step = (us - self._us + _WRAP_US // 2) % _WRAP_US - _WRAP_US // 2
        self._us = us
        self._s += step * 1e-6
        return self._s

    def _learn(self, time_s: float, arrival_s: float) -> None:
        late_s = arrival_s - time_s
        points = self._points
        if points and time_s - points[-1][0] < _WHILE_S:
            points[-1] = (points[-1][0], min(points[-1][1], late_s))
        else:
            if len(points) >= _LEAST_POINTS:
                self._fit()
            points.append((time_s, late_s))
            del points[:-_POINTS]

    def _fit(self) -> None:
        """Straight line through the points, all of which are complete now."""
        at, late = np.array(self._points).T
        middle = float(at.mean())
        slope = float((at - middle) @ late / ((at - middle) @ (at - middle)))
        self._fitted = (middle, float(late.mean()), slope)

    def _line(self, time_s: float) -> float:
        if self._fitted is None:
            return time_s + min(late for _, late in self._points)
        middle, offset, slope = self._fitted
        return time_s + offset + slope * (time_s - middle)
