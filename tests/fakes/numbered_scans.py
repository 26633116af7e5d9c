"""A chip whose output words say which update they are of, so that whoever receives scans can be judged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from adis_gonio.device.sensor.settings import ScanBlock
from adis_gonio.sim import SimulatedChip, World
from adis_gonio.sim.sampling import OUTPUTS, Inputs, SignalChain, Updates

WRAP = 1 << 14
"""Updates after which the words of a column come again: 20 s at the full rate."""
RATE_HZ = 819.2
DATA = WRAP - 1
_FACTORS = {row.name: 4 * k + 5 for k, row in enumerate(OUTPUTS)}
"""Odd ones: each word alone tells its update, and words of one column in another tell a wrong one."""


def words_of(updates: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Words (n, k) uint16 without flags that registers hold after updates (n,)."""
    return (updates[:, None] * np.array([_FACTORS[name] for name in names]) & DATA).astype(np.uint16)


class NumberingSampler(SignalChain):
    """Counts the updates instead of measuring."""

    taken = 0

    def update(self, inputs: Inputs) -> Updates:
        n = len(inputs.supply_v)
        updates = self.taken + np.arange(n)
        self.taken += n
        words = words_of(updates, [row.name for row in OUTPUTS])
        return Updates(words, np.zeros(n, np.int64), np.zeros((n, len(OUTPUTS)), np.int64))


class Nowhere(World):
    """Inputs that nobody looks at."""

    def sample(self, time_s: np.ndarray) -> Inputs:
        one, three = np.zeros(len(time_s)), np.zeros((len(time_s), 3))
        return Inputs(three, three, three, one, one)


class NumberedChip(SimulatedChip):
    """The chip with updates of its own, flags and data-ready, but numbers instead of measurements."""

    def __init__(self, **options) -> None:
        super().__init__(Nowhere(seed=1), **options)
        self._sampler = NumberingSampler(self.variant, self.memory)

    @property
    def updates(self) -> int:
        """So many were made."""
        return self._sampler.taken


@dataclass
class Judge:
    """Looks at every block; `found` counts scans, lost ones, mixed and repeated rows, wrong counts.

    Parameters
    ----------
    names : registers of a scan
    slack : int or None
        Scans by which the count of lost ones may be off after any block; None leaves `off` to be judged.

    Attributes
    ----------
    off : int
        Scans that were lost since the first block, less those that were told.
    """

    names: Sequence[str]
    slack: int | None = 0
    found: Counter = field(default_factory=Counter)
    off: int = 0
    _last: tuple[int, float] | None = None

    def look(self, block: ScanBlock) -> None:
        """Take the next block."""
        inverse = [pow(_FACTORS[name], -1, WRAP) for name in self.names]
        told = (block.words & DATA).astype(np.int64) * np.array(inverse) & DATA
        last, last_s = self._last or (int(told[0, 0]) - 1, block.time_s[0])
        steps = np.diff(told[:, 0], prepend=last)
        # Times tell how often the words came round meanwhile, as after some time-outs in a row.
        expected = np.diff(block.time_s, prepend=last_s) * RATE_HZ
        steps += WRAP * np.rint((expected - steps) / WRAP).astype(np.int64)
        self.found["scans"] += len(told)
        self.found["lost"] += block.lost
        self.found["mixed"] += int((told != told[:, :1]).any(axis=1).sum())
        self.found["backwards"] += int((steps <= 0).sum())
        if self._last is not None:  # what is lost before the first block its words cannot tell
            gone = int((steps - 1).sum())
            self.off += gone - block.lost - block.dropped
            self.found["wrong counts"] += self.slack is not None and abs(self.off) > self.slack
            self.found["gaps"] += gone > 0
        self._last = (int(told[-1, 0]), float(block.time_s[-1]))

    @property
    def sound(self) -> bool:
        """True where nothing was wrong."""
        return not (self.found["mixed"] or self.found["wrong counts"] or self.found["backwards"])
