"""What lies between two dwells: the samples while the part was turned from one to the other.

A samples CSV that holds its dwells alone has none. An archive has what was recorded before and after its
dwells, a continuous recording has everything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from adis_gonio.base.numbers import counted

if TYPE_CHECKING:
    from adis_gonio.base.arrays import Floats
    from adis_gonio.model.records import Dwell


@dataclass(frozen=True)
class Turn:
    """Samples between two dwells that follow one another.

    Attributes
    ----------
    before, position : int
        Numbers (`Dwell.position`) of the dwell in which it begins and of the one in which it ends.
    time_s : (n,) float
        Time of each sample, increasing, on the clock of the dwells; n may be 0.
    accel, gyro : (n, 3) float
        As in `Dwell`; `gyro` None where there are no gyros.
    temperature_c, supply_v : (n,) float or None
    temperatures_c : (n, 3) float or None
        As in `Dwell`.
    turned_deg : float or None
        How far the part was turned by a mark or a stop, about the vertical, positive counter-clockwise seen
        from above; None where nobody declares it.
    """

    before: int
    position: int
    time_s: Floats
    accel: Floats
    gyro: Floats | None = None
    temperature_c: Floats | None = None
    supply_v: Floats | None = None
    turned_deg: float | None = None
    temperatures_c: Floats | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    def __repr__(self) -> str:
        return f"Turn({self.before} to {self.position}: {counted(len(self), 'sample')})"


def turns_of_recording(recording: Dwell, dwells: Sequence[Dwell]) -> tuple[Turn, ...]:
    """Turns of a continuous recording between its dwells; views of its rows, no copies."""
    made = []
    for before, after in pairwise(dwells):
        low = int(recording.time_s.searchsorted(before.time_s[-1], side="right"))
        high = int(recording.time_s.searchsorted(after.time_s[0], side="left"))
        rows = slice(low, max(low, high))
        made.append(
            Turn(
                before.position,
                after.position,
                recording.time_s[rows],
                recording.accel[rows],
                _rows(recording.gyro, rows),
                _rows(recording.temperature_c, rows),
                _rows(recording.supply_v, rows),
                temperatures_c=_rows(recording.temperatures_c, rows),
            )
        )
    return tuple(made)


def _rows(series: Floats | None, rows: slice) -> Floats | None:
    return None if series is None else series[rows]
