"""The line-level chip in process: edges by hand, or frames made of edges."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

PS = 1_000_000
"""Picoseconds in a microsecond."""

INPUTS = (
    "supply",
    *(f"{sensor}_{axis}" for sensor in ("gyro", "accl", "temp") for axis in "xyz"),
    "aux",
)
FRAME = np.dtype([("begin", "i8"), ("half", "i8"), ("word", "u2"), ("bits", "u2")], align=True)
"""A frame: fall of chip select and half a clock in ps, word, clocks."""
ANSWER = np.dtype([("word", "u2"), ("known", "u2"), ("loose", "u2")])
"""What came back, its bits that the sheet settles, 1 where its number is only settled to 1 LSB."""

_I64 = ctypes.c_int64
_SIGNATURES = {
    "chip_new": (ctypes.c_void_p, []),
    "chip_free": (None, [ctypes.c_void_p]),
    "chip_set": (ctypes.c_int, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_double]),
    "chip_input": (None, [ctypes.c_void_p, _I64, ctypes.c_int, ctypes.c_double]),
    "chip_power_on": (None, [ctypes.c_void_p, _I64]),
    "chip_cs": (None, [ctypes.c_void_p, _I64, ctypes.c_int]),
    "chip_sck": (None, [ctypes.c_void_p, _I64, ctypes.c_int]),
    "chip_mosi": (None, [ctypes.c_void_p, _I64, ctypes.c_int]),
    "chip_rst": (None, [ctypes.c_void_p, _I64, ctypes.c_int]),
    "chip_miso": (ctypes.c_int, [ctypes.c_void_p, _I64]),
    "chip_dio": (ctypes.c_int, [ctypes.c_void_p, _I64, ctypes.c_int]),
    "chip_run": (None, [ctypes.c_void_p, _I64]),
    "chip_frames": (
        ctypes.c_int,
        [ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p],
    ),
    "chip_violation_name": (ctypes.c_char_p, [ctypes.c_int]),
    "chip_violations": (ctypes.c_uint32, [ctypes.c_void_p, ctypes.c_int]),
    "chip_update_count": (ctypes.c_uint64, [ctypes.c_void_p]),
}


class LineChip:
    """A chip of its own, powered on at time 0; times are in µs.

    Parameters
    ----------
    library : Path
        libchip.so.
    parameters : float
        Of chip.c.
    """

    def __init__(self, library: Path, **parameters: float) -> None:
        self._lib = ctypes.CDLL(str(library))
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(self._lib, name)
            function.restype, function.argtypes = result, arguments
        self._chip = self._lib.chip_new()
        for name, value in parameters.items():
            self.set(name, value)
        self._lib.chip_power_on(self._chip, 0)

    def close(self) -> None:
        """Free it."""
        if self._chip:
            self._lib.chip_free(self._chip)
            self._chip = None

    def set(self, name: str, value: float) -> None:
        """Set a parameter."""
        if not self._lib.chip_set(self._chip, name.encode(), value):
            raise KeyError(name)

    def power_on(self, now_us: float) -> None:
        """Power on again, with the parameters as they are now."""
        self._lib.chip_power_on(self._chip, round(now_us * PS))

    def input(self, now_us: float, name: str, value: float) -> None:
        """Set what the chip measures: V, °/s, mg, °C."""
        self._lib.chip_input(self._chip, round(now_us * PS), INPUTS.index(name), value)

    def frames(
        self, begin_us: NDArray[np.float64], words: Sequence[int], clock_hz: float = 1e6
    ) -> NDArray[np.uint16]:
        """Frames whose chip select falls at these times; the words shifted out."""
        frames = np.zeros(len(words), FRAME)
        frames["begin"] = np.rint(np.asarray(begin_us, float) * PS)
        frames["half"] = round(0.5e12 / clock_hz)
        frames["word"], frames["bits"] = words, 16
        return np.asarray(self.exchange(frames)[0]["word"])

    def exchange(self, frames: NDArray[np.void]) -> tuple[NDArray[np.void], bool]:
        """Frames of any length (n,) FRAME; answers (n,) ANSWER, and whether an update's place is open."""
        answers = np.zeros(len(frames), ANSWER)
        unsure = self._lib.chip_frames(self._chip, len(frames), frames.ctypes.data, answers.ctypes.data)
        return answers, bool(unsure)

    def line(self, name: str, now_us: float, level: int) -> None:
        """Drive cs, sck, mosi or rst."""
        getattr(self._lib, f"chip_{name}")(self._chip, round(now_us * PS), level)

    def miso(self, now_us: float) -> int:
        """Level of MISO: 0, 1, or -1 where it is not driven."""
        return int(self._lib.chip_miso(self._chip, round(now_us * PS)))

    def dio(self, now_us: float, line: int) -> int:
        """Level of DIO1 or DIO2, likewise."""
        return int(self._lib.chip_dio(self._chip, round(now_us * PS), line))

    def updates(self, now_us: float) -> int:
        """Updates of the outputs until then."""
        self._lib.chip_run(self._chip, round(now_us * PS))
        return int(self._lib.chip_update_count(self._chip))

    def violations(self) -> dict[str, int]:
        """Counts by kind, where there are any."""
        found = {}
        kind = 0
        while name := self._lib.chip_violation_name(kind):
            if count := self._lib.chip_violations(self._chip, kind):
                found[name.decode()] = int(count)
            kind += 1
        return found
