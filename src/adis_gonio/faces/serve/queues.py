"""A client's queue of scans: bounded, and what does not fit pushes out the oldest, counted."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray


class ScanQueue:
    """Scans (structured arrays) waiting for a client.

    Parameters
    ----------
    capacity : int
        Most scans that are held.

    Attributes
    ----------
    lost : int
        Scans that were pushed out, since the queue began.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._blocks: deque[NDArray[np.void]] = deque()
        self._held = 0
        self.lost = 0

    def __len__(self) -> int:
        return self._held

    def put(self, scans: NDArray[np.void]) -> int:
        """Append scans; return how many old ones were pushed out."""
        self._blocks.append(scans)
        self._held += len(scans)
        pushed = max(0, self._held - self._capacity)
        self._drop(pushed)
        self.lost += pushed
        return pushed

    def take(self, most: int) -> bytes:
        """The oldest scans, up to `most`, as bytes."""
        parts: list[bytes] = []
        left = min(most, self._held)
        self._held -= left
        while left:
            block = self._blocks.popleft()
            parts.append(block[:left].tobytes())
            if len(block) > left:
                self._blocks.appendleft(block[left:])
            left -= min(left, len(block))
        return b"".join(parts)

    def _drop(self, count: int) -> None:
        self._held -= count
        while count:
            block = self._blocks.popleft()
            if len(block) > count:
                self._blocks.appendleft(block[count:])
            count -= min(count, len(block))
