"""What IIO says of a channel, and how a scan's bytes become values; no I/O.

A format is written `[be|le]:[s|u]BITS/STORAGE[Xrepeat]>>SHIFT`; a capital sign says that the number fills
its storage. value = (raw + offset) * scale, in m/s², rad/s, milli-degree Celsius, millivolt. Source: the
kernel's Documentation/ABI/testing/sysfs-bus-iio.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import CannotOpenError, UsageError
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

_FORMAT = re.compile(r"(be|le):([suSU])(\d+)/(\d+)(?:[Xx](\d+))?>>(\d+)")

COLUMNS: dict[str, tuple[str, float]] = {
    **{f"accel_{axis}": (f"a{axis}", 1000.0 / STANDARD_GRAVITY_MPS2) for axis in "xyz"},
    **{f"anglvel_{axis}": (f"g{axis}", 180.0 / np.pi) for axis in "xyz"},
    "temp": ("temp_c", 1e-3),
    "temp0": ("temp_c", 1e-3),
    "temp_x": ("temp_c", 1e-3),
    "voltage0_supply": ("supply_v", 1e-3),
}
"""Column of a session and factor from IIO's unit, by channel; the first temperature there is counts."""

ACCELS = ("accel_x", "accel_y", "accel_z")


@dataclass(frozen=True)
class SampleFormat:
    """Format of a channel's samples in a scan."""

    big_endian: bool
    signed: bool
    bits: int
    storage: int
    shift: int

    @classmethod
    def parse(cls, text: str) -> SampleFormat:
        """Format of its text.

        Raises
        ------
        CannotOpenError
            Not a format, or one that this program does not read (repeated or odd-sized samples).
        """
        found = _FORMAT.fullmatch(text.strip())
        if found is None:
            raise CannotOpenError(f"'{text}' is no format of an IIO sample")
        end, sign, bits, storage, repeat, shift = found.groups()
        parsed = cls(end == "be", sign in "sS", int(bits), int(storage), int(shift))
        whole = parsed.storage in (8, 16, 32, 64) and parsed.bits > 0
        if not whole or parsed.bits + parsed.shift > parsed.storage or repeat not in (None, "1"):
            raise CannotOpenError(f"'{text}': samples of this format are not read")
        return parsed

    @property
    def dtype(self) -> np.dtype[np.unsignedinteger]:
        """The stored word for numpy."""
        return np.dtype(f"{'>' if self.big_endian else '<'}u{self.storage // 8}")

    def numbers(self, words: np.ndarray) -> np.ndarray:
        """Numbers (n,) of stored words (n,): shifted, masked, sign extended; int64."""
        left = 64 - self.bits - self.shift
        wide = words.astype(np.uint64) << np.uint64(left)
        down = np.uint64(64 - self.bits)
        return wide.view(np.int64) >> np.int64(down) if self.signed else (wide >> down).astype(np.int64)


@dataclass(frozen=True)
class IioChannel:
    """A channel of a device.

    Attributes
    ----------
    id : str
        Such as `accel_x`; with the label that the kernel appends to a file's name, `voltage0_supply`.
    index : int
        Place in a scan; -1 where it cannot be buffered.
    format : SampleFormat or None
        None where it cannot be buffered.
    scale, offset : float
        value = (raw + offset) * scale.
    """

    id: str
    index: int = -1
    format: SampleFormat | None = None
    scale: float = 1.0
    offset: float = 0.0

    @property
    def column(self) -> str:
        """Column of a session; empty for a channel that has none."""
        return COLUMNS.get(self.id, ("", 0.0))[0]

    def values(self, numbers: np.ndarray) -> Floats:
        """Values (n,) in the column's unit: mg, °/s, °C, V."""
        factor = COLUMNS[self.id][1] * self.scale
        values: Floats = (numbers + self.offset) * factor
        return values


def wanted(channels: Sequence[IioChannel], where: str) -> tuple[IioChannel, ...]:
    """Channels that a session has columns for, one a column, in the order of the columns.

    Raises
    ------
    CannotOpenError
        Not an accelerometer of three axes.
    """
    found = {channel.id: channel for channel in channels}
    missing = [name for name in ACCELS if name not in found]
    if missing:
        raise CannotOpenError(f"{where}: no accelerometer of three axes ({', '.join(missing)} missing)")
    chosen: dict[str, IioChannel] = {}
    for name, (column, _) in COLUMNS.items():
        if name in found:
            chosen.setdefault(column, found[name])
    gyros = [column for column in ("gx", "gy", "gz") if column in chosen]
    if len(gyros) < 3:
        for column in gyros:
            del chosen[column]
    return tuple(chosen.values())


class BufferLayout:
    """Where the samples of enabled channels stand in a scan.

    Each stands at a multiple of its own size, in the order of the index; a scan's size is a multiple of its
    largest sample.
    """

    def __init__(self, channels: Sequence[IioChannel]) -> None:
        self.channels = tuple(sorted(channels, key=lambda channel: channel.index))
        at, largest = 0, 1
        offsets: list[int] = []
        formats: list[np.dtype[np.unsignedinteger]] = []
        for channel in self.channels:
            if channel.format is None or channel.index < 0:
                raise UsageError(f"{channel.id} cannot be buffered")
            size = channel.format.dtype.itemsize
            at += -at % size
            offsets.append(at)
            formats.append(channel.format.dtype)
            at, largest = at + size, max(largest, size)
        self.size = at + -at % largest
        self._dtype = np.dtype(
            {
                "names": [channel.id for channel in self.channels],
                "formats": formats,
                "offsets": offsets,
                "itemsize": self.size,
            }
        )

    def numbers(self, data: bytes) -> dict[str, np.ndarray]:
        """Numbers (n,) int64 by channel of whole scans."""
        scans = np.frombuffer(data, self._dtype)
        return {
            channel.id: channel.format.numbers(scans[channel.id])
            for channel in self.channels
            if channel.format is not None
        }


def number_of(attributes: Mapping[str, str], name: str, default: float, where: str) -> float:
    """Number of an attribute's text, or a default where there is no such attribute."""
    text = attributes.get(name)
    if text is None:
        return default
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise CannotOpenError(f"{where}: {name} is '{text.strip()[:40]}', which is no finite number")
    return number
