"""Blocks of samples (words of the chip, or values of any other sensor) and the alarms in them.

A session takes either kind of block: both have `time_s`, `lost`, `dropped`, `alarm` (None if the sensor
reports no alarms), `registers` (names of the columns), `units`, `values()`, `accel_mg` and `first`, and
this module's functions take both. The chip's kind is `ScanBlock`; a source that knows its values in units
gives `ValueBlock`.

The supply and over-range bits of STATUS clear when their condition ends (data sheet, p. 20), so STATUS
after a dwell does not show what happened within it. EA, bit 14 of every output word, does: it is set while
any bit of STATUS is set. The archive keeps the words, so that old sessions are judged by the same rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import counted
from adis_gonio.device.sensor.registers import ACCEL_OUT, GYRO_OUT, TEMP_OUT
from adis_gonio.device.sensor.settings import ScanBlock, join as join_scans
from adis_gonio.model.records import SERIES

GENERIC = "generic"
"""Name of the variant of a sensor of another make, of which only the samples are known."""

UNITS = dict.fromkeys(("ax", "ay", "az"), "mg") | dict.fromkeys(("gx", "gy", "gz"), "°/s")
UNITS |= {"temp_c": "°C", "supply_v": "V"}
"""Unit of each column that a `ValueBlock` may have, by the column's name."""


@dataclass(frozen=True)
class ValueBlock:
    """Block of samples as values in units, from a sensor other than the chip.

    Attributes
    ----------
    registers : tuple of str
        Names of the k columns, keys of `UNITS`; at least ax, ay and az.
    data : (n, k) float64
        Values of n samples, each column in its unit of `UNITS`.
    time_s : (n,) float64
        Time of each sample on the source's clock, in s.
    lost : int
        Number of samples missed between the block before and this block, as far as the source knows.
    variant, gyro_range_dps, dropped, alarm
        Constants: such a sensor has no known gyro range, drops no scans and reports no alarms.
    """

    registers: tuple[str, ...]
    data: Floats
    time_s: Floats
    lost: int = 0

    variant = GENERIC
    gyro_range_dps = None
    dropped = 0
    alarm = None
    """None, because a generic sensor reports no errors or alarms."""

    def __len__(self) -> int:
        return len(self.data)

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each column, in the order of `registers`."""
        return tuple(UNITS[name] for name in self.registers)

    def values(self) -> Floats:
        """Return the values (n, k) of n samples in k columns, each column in its unit."""
        return self.data

    @property
    def accel_mg(self) -> Floats:
        """Acceleration (n, 3) along x, y and z in mg."""
        return self.columns("ax", "ay", "az")

    def columns(self, *names: str) -> Floats:
        """Return the values of the named columns in the order of the names, (n, number of names)."""
        return self.data[:, [self.registers.index(name) for name in names]]

    def first(self, count: int) -> ValueBlock:
        """Return a copy with only the first `count` samples."""
        return replace(self, data=self.data[:count], time_s=self.time_s[:count])


Block = ScanBlock | ValueBlock


def join(blocks: Sequence[Block]) -> Block:
    """Join consecutive blocks of one sensor, with equal columns, to one block; sum their lost samples."""
    values = [block for block in blocks if isinstance(block, ValueBlock)]
    if not values:
        return join_scans([block for block in blocks if isinstance(block, ScanBlock)])
    return ValueBlock(
        values[0].registers,
        np.concatenate([block.data for block in values]),
        np.concatenate([block.time_s for block in values]),
        sum(block.lost for block in values),
    )


def cut(block: Block, low: int, high: int, *, counted: bool) -> Block:
    """Return a block with only the samples `low` to `high` (exclusive) of a block.

    If `counted` is True, it has the numbers of lost and dropped scans of the whole block; otherwise zero.
    """
    rows = slice(low, high)
    lost = block.lost if counted else 0
    if isinstance(block, ValueBlock):
        return replace(block, data=block.data[rows], time_s=block.time_s[rows], lost=lost)
    dropped = block.dropped if counted else 0
    words, time_s = block.words[rows], block.time_s[rows]
    return replace(block, words=words, time_s=time_s, lost=lost, missed=None, dropped=dropped)


def count_alarms(block: Block) -> int:
    """Return the number of samples whose flag EA reports an error or alarm; 0 for a sensor without EA."""
    return 0 if block.alarm is None else int(block.alarm.sum())


def block_series(block: Block) -> dict[str, Any]:
    """Convert the samples of a block to keyword arguments of a `Dwell` or `Turn`.

    These are accel (n, 3) in LSB, or in mg for a generic sensor; gyro (n, 3) in °/s; temperature_c (n,);
    temperatures_c (n, 3) of the dies of the three gyros; supply_v (n,). A quantity that was not recorded
    completely is left out, and so are gyros of unknown range.

    Raises
    ------
    UsageError
        An accelerometer is missing.
    """
    names, made = set(block.registers), dict[str, Any]()
    if isinstance(block, ValueBlock):
        for name, members in SERIES.items():
            if names.issuperset(members):
                values = np.ascontiguousarray(block.columns(*members))
                made[name] = values if len(members) > 1 else values[:, 0]
        return made
    missing = [name for name in ACCEL_OUT if name not in names]
    if missing:
        raise UsageError(f"a recording needs the accelerometers; the scan lacks {', '.join(missing)}")
    made["accel"] = block.select(ACCEL_OUT).numbers().astype(np.float64)
    if names.issuperset(GYRO_OUT) and block.gyro_range_dps:
        made["gyro"] = block.gyro_dps
    if names.intersection(TEMP_OUT):
        made["temperature_c"] = block.temperature_c
    if names.issuperset(TEMP_OUT):
        made["temperatures_c"] = block.select(TEMP_OUT).values()
    if "SUPPLY_OUT" in names:
        made["supply_v"] = block.supply_v
    return made


WITHOUT_NEWS = "they had no new data (ND), so their data-ready edge did not come from the sensor"
"""Reason why scans were left out (`dropped`), for messages."""


class Alarms(JsonRecord):
    """Summary of the errors and alarms during a dwell that the flag EA of the output words reported.

    Attributes
    ----------
    scans : int
        Number of scans with EA.
    times : int
        Number of uninterrupted runs of scans with EA.
    first_s : float
        Time from the first scan of the dwell to the first scan with EA, in s.
    longest_s : float
        Duration of the longest run, from its first scan to the first scan without EA, in s.
    """

    scans: int
    times: int
    first_s: float
    longest_s: float

    def __str__(self) -> str:
        times = "once" if self.times == 1 else f"{self.times} times"
        return (
            f"an error or alarm in {counted(self.scans, 'scan')} ({times}, at most"
            f" {self.longest_s:.3g} s, first {self.first_s:.3g} s into the dwell)"
        )


def find_alarms(scans: Block) -> Alarms | None:
    """Summarize the alarms in the scans of a dwell; None without alarms or if the sensor has no flag EA."""
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
