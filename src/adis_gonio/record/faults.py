"""What was wrong in a dwell: judged by its own words, by STATUS after it, by its supply and what was lost.

The supply and over-range bits of STATUS fall by themselves when the condition ends (DS p. 20), so STATUS
after a dwell does not tell what happened within it. EA, bit 14 of every output word, does: it stands as
long as any bit of STATUS stands. The archive keeps the words as they came, so that sessions of all times
are judged alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import counted
from adis_gonio.record.blocks import Block

SUPPLY_LIMITS_V = (4.75, 5.25)
"""Specified supply (DS, B)."""

WITHOUT_NEWS = "they held no new data (ND), so their data-ready edge was not the sensor's"


@dataclass(frozen=True)
class Alarms(JsonRecord):
    """When an error or alarm stood within a dwell (EA).

    Attributes
    ----------
    scans : int
        Scans with EA.
    times : int
        Runs of such scans.
    first_s : float
        From the dwell's first scan to the first with EA.
    longest_s : float
        Longest run, from its first scan to the one after it.
    """

    scans: int
    times: int
    first_s: float
    longest_s: float

    def __str__(self) -> str:
        times = "once" if self.times == 1 else f"{self.times} times"
        return (
            f"an error or alarm stood in {counted(self.scans, 'scan')} ({times}, at most"
            f" {self.longest_s:.3g} s, first {self.first_s:.3g} s into the dwell)"
        )


def alarms_of(scans: Block) -> Alarms | None:
    """When EA stood in the scans of a dwell; None where it never did, or the sensor has no such bit."""
    alarm = scans.alarm
    if alarm is None or not alarm.any():
        return None
    edges = np.flatnonzero(np.diff(alarm.astype(np.int8), prepend=0, append=0))
    starts, ends = edges[::2], edges[1::2]
    period_s = float(np.median(np.diff(scans.time_s))) if len(scans) > 1 else 0.0
    after_s = np.append(scans.time_s, scans.time_s[-1] + period_s)
    return Alarms(
        int(alarm.sum()),
        len(starts),
        float(scans.time_s[starts[0]] - scans.time_s[0]),
        float((after_s[ends] - scans.time_s[starts]).max()),
    )
