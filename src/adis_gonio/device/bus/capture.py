"""Captures of a logic analyser (VCD files, IEEE 1364) read as calls of a bus, one for each SPI frame.

A frame begins when chip select falls and ends when it rises. The chip uses SPI mode 3: both data lines are
sampled at each rising edge of the clock, MSB first. Signals are found by their usual names.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TextIO

import numpy as np

from adis_gonio.base.errors import DataError
from adis_gonio.device.bus.contract import FRAME_BITS
from adis_gonio.device.bus.recording import Call

SIGNALS = {
    "cs": ("cs", "ncs", "csn", "cs_n", "ss", "nss", "cs#", "/cs", "enable"),
    "clock": ("sclk", "sck", "clk", "clock", "spi_clk"),
    "mosi": ("mosi", "din", "sdi", "copi"),
    "miso": ("miso", "dout", "sdo", "cipo"),
}
"""Accepted names of each signal, in small letters."""
_UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "ps": 1e-12, "fs": 1e-15}


class LogicCapture:
    """The SPI frames of a VCD file.

    Parameters
    ----------
    path : str or Path
        The VCD file.

    Attributes
    ----------
    damage : str
        Reason why the last frame is incomplete; empty if it is complete. Known after the iteration.

    Raises
    ------
    DataError
        The file cannot be read, is no VCD file, or lacks one of the four signals.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.damage = ""
        with self._opened() as file:
            self._step_s, self._codes = _read_header(self.path, file)

    def __iter__(self) -> Iterator[Call]:
        levels = dict.fromkeys(SIGNALS, "1")
        begin_s, number = -1.0, 0
        bits: list[tuple[str, str]] = []
        clocks_s: list[float] = []
        for time_s, name, level in self._changes():
            rose, fell = levels[name] == "0" and level == "1", levels[name] == "1" and level == "0"
            levels[name] = level
            if name == "cs" and fell:
                begin_s, bits, clocks_s = time_s, [], []
            elif name == "clock" and rose and begin_s >= 0:
                bits.append((levels["mosi"], levels["miso"]))
                clocks_s.append(time_s)
            elif name == "cs" and rose and begin_s >= 0:
                number += 1
                yield _frame(number, begin_s, time_s, bits, clocks_s)
                begin_s = -1.0
        self.damage = "ends within a frame" if begin_s >= 0 else ""

    def _opened(self) -> TextIO:
        try:
            return self.path.open(encoding="ascii", errors="replace")
        except OSError as error:
            raise DataError(f"{self.path}: cannot be read: {error.strerror}") from None

    def _changes(self) -> Iterator[tuple[float, str, str]]:
        """Yield the time in s, the name and the new level, `0` or `1`, of each signal that changes.

        An unknown level counts as `0`.
        """
        with self._opened() as file:
            _read_header(self.path, file)
            time_s = 0.0
            for line in file:
                for word in line.split():
                    if word[0] == "#" and word[1:].isdecimal():
                        time_s = int(word[1:]) * self._step_s
                    elif word[0] in "01xzXZ" and word[1:] in self._codes:
                        yield time_s, self._codes[word[1:]], "1" if word[0] == "1" else "0"


def _read_header(path: Path, file: TextIO) -> tuple[float, Mapping[str, str]]:
    """Read a VCD header; return the time unit in s, and the name of the signal by identifier code.

    `path` is the name of the file, for messages.
    """
    text = ""
    for line in file:
        text += line
        if "$enddefinitions" in line or len(text) > 1_000_000:
            break
    if "$enddefinitions" not in text:
        raise DataError(f"{path}: is no VCD file: it has no $enddefinitions")
    scale = re.search(r"(\d+)\s*([munpf]?s)", text.partition("$timescale")[2])
    if scale is None:
        raise DataError(f"{path}: has no $timescale")
    names = {name.lower(): code for code, name in re.findall(r"\$var\s+\S+\s+1\s+(\S+)\s+(\S+)", text)}
    codes: dict[str, str] = {}
    for signal, accepted in SIGNALS.items():
        found = [names[name] for name in accepted if name in names]
        if not found:
            there = ", ".join(names) or "none"
            raise DataError(
                f"{path}: no signal is called {' or '.join(accepted[:3])}; its signals are {there}:"
                " rename one in the analyser"
            )
        codes[found[0]] = signal
    return int(scale[1]) * _UNITS_S[scale[2]], codes


def _frame(
    number: int, begin_s: float, end_s: float, bits: list[tuple[str, str]], clocks_s: list[float]
) -> Call:
    """Make the `Call` of one captured frame; a frame without exactly 16 clocks has an error.

    `number` is the number of the frame in the capture, `begin_s` and `end_s` are the times at which chip
    select fell and rose, `bits` holds the levels of MOSI and MISO at each rising clock edge, `clocks_s` the
    times of these edges.
    """
    words = [int("".join(column) or "0", 2) for column in zip(*bits, strict=True)] or [0, 0]
    clock_hz = (len(clocks_s) - 1) / (clocks_s[-1] - clocks_s[0]) if len(clocks_s) > 1 else 0.0
    error = None
    if len(bits) != FRAME_BITS:
        error = DataError(f"{len(bits)} clocks, not {FRAME_BITS}")
    frame, reply = (np.array([word & 0xFFFF], np.uint16) for word in words)
    return Call(number, "frame", begin_s, end_s, frame, (clock_hz,), reply, error)
