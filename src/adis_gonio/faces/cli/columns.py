"""Lines of `stream`: mean and standard deviation of every value, as wide as the screen allows."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adis_gonio.record.blocks import Block

_TIME = 9
_MEANS_TIME = 7
_FULL = 19
_MEANS = 9


def screen_width() -> int | None:
    """Columns of the terminal that standard output is; None where it is none, and any width will do."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


@dataclass(frozen=True)
class Columns:
    """Which values a line shows, and how.

    Attributes
    ----------
    heads : tuple of str
        Lines that stand above the first one.
    shown : int
        Values from the left that find room.
    cell, time_cell : int
        Widths.
    spread : bool
        True where the standard deviation stands beside the mean.
    note : str
        What the screen was too narrow for; empty where it shows all.
    """

    heads: tuple[str, ...]
    shown: int
    cell: int
    time_cell: int
    spread: bool
    note: str = ""

    @classmethod
    def fitting(cls, names: Sequence[str], units: Sequence[str], width: int | None) -> Columns:
        """Columns for registers with their units; first the deviations give way, then the last values."""
        short = [name.removesuffix("_OUT") for name in names]
        units = [unit or "1" for unit in units]
        if width is None or _TIME + _FULL * len(short) <= width:
            pairs = zip(short, units, strict=True)
            head = f"{'time/s':>{_TIME}}" + "".join(f"{f'{name}/{unit}':>{_FULL}}" for name, unit in pairs)
            return cls((head,), len(short), _FULL, _TIME, spread=True)
        cell = max([_MEANS, *(len(name) + 1 for name in short)])
        room = max(1, (width - _MEANS_TIME) // cell)
        left_out = short[room:]
        heads = tuple(
            f"{first:>{_MEANS_TIME}}" + "".join(f"{word:>{cell}}" for word in row[:room])
            for first, row in (("time", short), ("s", units))
        )
        note = f"the screen has {width} columns: means only"
        if left_out:
            note += f", without {', '.join(left_out)} (choose with --registers)"
        return cls(heads, min(room, len(short)), cell, _MEANS_TIME, spread=False, note=note)

    def line(self, blocks: Sequence[Block], since_s: float) -> str:
        """One line of blocks that are not empty; its time is that of their last scan."""
        values = np.concatenate([block.values() for block in blocks])
        time_s = float(blocks[-1].time_s[-1]) - since_s
        cells = [
            f"{mean:.2f} ± {sd:.2f}" if self.spread else f"{mean:.2f}"
            for mean, sd in zip(values.mean(axis=0), values.std(axis=0), strict=True)
        ]
        return f"{time_s:{self.time_cell}.2f}" + "".join(
            f"{cell:>{self.cell}}" for cell in cells[: self.shown]
        )
