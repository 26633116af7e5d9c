"""Words of many scans to numbers and units, vectorised."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import ChipError, UsageError
from adis_gonio.device.bus import Words
from adis_gonio.device.sensor.registers import (
    ACCEL_OUT,
    EA,
    GYRO_OUT,
    ND,
    TEMP_OUT,
    Kind,
    Register,
    registers,
)
from adis_gonio.device.sensor.variants import Variant, variant

_IN_CACHE = 32_768
"""Words in one step: long enough for numpy's inner loops, short enough for the cache."""


def decode_numbers(table: Sequence[Register], words: Words) -> NDArray[np.int32]:
    """Decode words to integers: flags and unused bits removed, sign extended.

    Parameters
    ----------
    table : k registers
    words : (n, k) uint16

    Returns
    -------
    (n, k) int32
    """
    width = words.shape[1]
    masks, signs = _masks_and_signs(tuple((row.bits, row.signed) for row in table))
    scans = len(masks) // width
    bits = np.empty(scans * width, np.uint16)
    numbers = np.empty(words.shape, np.int32)
    for at in range(0, words.shape[0], scans):
        part = words[at : at + scans].reshape(-1)
        size = part.size
        held = bits[:size]
        np.bitwise_and(part, masks[:size], out=held)
        np.bitwise_xor(held, signs[:size], out=held)
        np.subtract(held, signs[:size], out=held)
        numbers[at : at + scans].reshape(-1)[:] = held.view(np.int16)
    for k, row in enumerate(table):
        if row.bits == 16 and not row.signed:  # the only kind that is not a signed number of 16 bits
            numbers[:, k] &= 0xFFFF
    return numbers


@lru_cache(maxsize=64)
def _masks_and_signs(layout: tuple[tuple[int, bool], ...]) -> tuple[Words, Words]:
    """Data masks and sign bits for the words of as many scans as are decoded at a time.

    (word & mask ^ sign) - sign masks the flags off and extends the sign; sign is 0 for unsigned registers.
    """
    mask = np.array([(1 << bits) - 1 for bits, _ in layout], np.uint16)
    sign = np.array([1 << bits - 1 if signed else 0 for bits, signed in layout], np.uint16)
    scans = max(1, _IN_CACHE // len(layout))
    return np.tile(mask, scans), np.tile(sign, scans)


def scales(
    table: Sequence[Register], part: Variant, gyro_range_dps: int | None
) -> tuple[Floats, Floats, tuple[str, ...]]:
    """For each of k registers: value of an LSB (k,), value at number zero (k,), and unit.

    Raises
    ------
    ChipError
        A gyro is among the registers, but the gyro range is unknown (None).
    """
    lsb, zero, units = [], [], []
    for row in table:
        if row.kind is Kind.GYRO and gyro_range_dps is None:
            raise ChipError(
                f"{row.name}: SENS_AVG has no valid gyro range, so its scale is unknown;"
                " set one (configure(gyro_range_dps=300))"
            )
        a, b, unit = part.lsb(row.kind, gyro_range_dps or 300)
        lsb.append(a)
        zero.append(b)
        units.append(unit)
    return np.array(lsb), np.array(zero), tuple(units)


@dataclass(frozen=True)
class ScanBlock:
    """Successive scans of the same registers, with their times.

    Attributes
    ----------
    registers : tuple of str
        Names of the k registers.
    words : (n, k) uint16
        Words as read, including flags.
    time_s : (n,) float
        Time of each scan on the bus's clock, in s.
    lost : int
        Missed updates of the chip from the end of the previous block to the end of this one.
    variant, gyro_range_dps
        Variant and gyro range that decode the words.
    missed : (n,) int or None
        Missed updates just before each scan, if known.
    dropped : int
        Omitted scans: a word lacked ND, so that the edge that started the scan was not an update.
    """

    registers: tuple[str, ...]
    words: Words
    time_s: Floats
    lost: int = 0
    variant: str = "adis16354"
    gyro_range_dps: int | None = 300
    missed: NDArray[np.int64] | None = None
    dropped: int = 0

    def __len__(self) -> int:
        return len(self.words)

    @property
    def table(self) -> tuple[Register, ...]:
        """Descriptions of the registers, one for each column."""
        return registers(self.registers)

    def numbers(self) -> NDArray[np.int32]:
        """Decoded register contents (n, k) as signed integers, without flags and unused bits."""
        return decode_numbers(self.table, self.words)

    def values(self) -> Floats:
        """Measured values (n, k) in the units of `units` (mg, °/s, °C, V)."""
        lsb, zero, _ = scales(self.table, variant(self.variant), self.gyro_range_dps)
        values: Floats = zero + lsb * self.numbers()
        return values

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of the values in each column."""
        return scales(self.table, variant(self.variant), self.gyro_range_dps)[2]

    def column(self, name: str) -> Floats:
        """Measured values (n,) of one register in its unit."""
        return self.select((name,)).values()[:, 0]

    def select(self, names: Sequence[str]) -> ScanBlock:
        """Copy of the block with only the named registers."""
        try:
            columns = [self.registers.index(name) for name in names]
        except ValueError:
            missing = next(name for name in names if name not in self.registers)
            raise UsageError(f"{missing} was not scanned; scanned: {', '.join(self.registers)}") from None
        return replace(self, registers=tuple(names), words=self.words[:, columns])

    def first(self, count: int) -> ScanBlock:
        """Copy of the first `count` scans, with the share of `lost` that belongs to them."""
        missed = None if self.missed is None else self.missed[:count]
        return replace(
            self,
            words=self.words[:count],
            time_s=self.time_s[:count],
            lost=self.lost if missed is None else int(missed.sum()),
            missed=missed,
        )

    @property
    def accel_mg(self) -> Floats:
        """Acceleration (n, 3) in mg (thousandths of 9.80665 m/s²)."""
        return self.select(ACCEL_OUT).values()

    @property
    def gyro_dps(self) -> Floats:
        """Rates of turn (n, 3) in °/s."""
        return self.select(GYRO_OUT).values()

    @property
    def temperature_c(self) -> Floats:
        """Mean (n,) in °C of the die temperatures that were scanned."""
        names = tuple(name for name in TEMP_OUT if name in self.registers)
        mean: Floats = self.select(names or TEMP_OUT).values().mean(axis=1)
        return mean

    @property
    def supply_v(self) -> Floats:
        """Supply voltage (n,) in V."""
        return self.column("SUPPLY_OUT")

    @property
    def fresh(self) -> NDArray[np.bool_]:
        """For each word (n, k): True if its flag ND marks data that had not been read before."""
        return (self.words & ND).astype(bool)

    @property
    def alarm(self) -> NDArray[np.bool_]:
        """For each scan (n,): True if a flag EA reports an error or alarm in STATUS."""
        outputs = [k for k, row in enumerate(self.table) if row.flags]
        flags: NDArray[np.bool_] = np.any((self.words[:, outputs] & EA).astype(bool), axis=1)
        return flags


def join(blocks: Sequence[ScanBlock]) -> ScanBlock:
    """Join successive blocks of equal registers to one block."""
    first = blocks[0]
    missed = [block.missed for block in blocks if block.missed is not None]
    return replace(
        first,
        words=np.concatenate([block.words for block in blocks]),
        time_s=np.concatenate([block.time_s for block in blocks]),
        lost=sum(block.lost for block in blocks),
        missed=np.concatenate(missed) if len(missed) == len(blocks) else None,
        dropped=sum(block.dropped for block in blocks),
    )
