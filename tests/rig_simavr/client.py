"""The real driver on a board's pty, in the board's time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.device.bus import SpiBus
from adis_gonio.device.bus.opening import BusUrl
from adis_gonio.device.bus.serial import open_from_url
from adis_gonio.device.sensor import Adis16354
from rig_simavr.board import Board, violations

SEVEN = ("XGYRO_OUT", "YGYRO_OUT", "ZGYRO_OUT", "XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "SUPPLY_OUT")
RATE_HZ = 819.2
_CHANNELS = (1, 2, 3, 4, 5, 6, 0)
"""The chip's channels of SEVEN, in its own order."""


def open_board(board: Board, *, boot_ms: int = 20_000) -> SpiBus:
    """The serial bus as `serial:` opens it, by pyserial; it waits in the board's time."""
    return open_from_url(BusUrl.parse(f"serial:{board.port}?boot_ms={boot_ms}"), clock=board)


@dataclass
class Streamed:
    """What a stream brought, judged by the chip's own count of updates in the data.

    Attributes
    ----------
    words : (n, 7) uint16
    time_s : (n,) float
    lost : int
        By the firmware's count.
    line_bytes : float
        On the line for a scan, of eight frames each.
    report : dict
        Of the board, at the end.
    """

    words: NDArray[np.uint16]
    time_s: NDArray[np.float64]
    lost: int
    line_bytes: float
    report: dict[str, Any] = field(repr=False)

    @property
    def updates(self) -> NDArray[np.int64]:
        """(n, 7): number of the update that each word is of, modulo 4096."""
        starts = 100 * np.array(_CHANNELS)
        return (self.words.astype(np.int64) - starts) % 4096

    @property
    def skipped(self) -> int:
        """Updates between the scans that no scan brought."""
        steps = np.diff(self.updates[:, 0]) % 4096
        return int((steps[steps > 1] - 1).sum())

    @property
    def repeated(self) -> int:
        """Scans of the update that the scan before them is of."""
        return int((np.diff(self.updates[:, 0]) % 4096 == 0).sum())

    @property
    def mixed(self) -> int:
        """Scans whose words are of different updates."""
        return int((self.updates != self.updates[:, :1]).any(axis=1).sum())

    @property
    def stale(self) -> int:
        """Scans with a word that was not new (ND)."""
        return int((~(self.words & 0x8000).astype(bool).all(axis=1)).sum())

    @property
    def sound(self) -> bool:
        """Nothing lost, repeated, mixed or against the chip's limits."""
        return not (
            self.lost
            or self.skipped
            or self.repeated
            or self.mixed
            or self.stale
            or violations(self.report)
        )


LINE_ERRORS = ("board_framing", "host_framing", "board_overruns")


def stream(board: Board, seconds: float) -> Streamed:
    """Seven registers at the full rate for so long in the board's time; line errors since the opening."""
    words, times, lost = [], [], 0
    with Adis16354(open_board(board)) as sensor:
        # A hello may have met a receiver that was being switched on, within a byte; it is repeated.
        opened = board.report()
        sensor.configure(smpl_prd=1, filter_m=0, data_ready=True)
        board.set("pattern", 1)
        board.sleep_s(0.01)
        board.forget_extremes()
        with sensor.stream(SEVEN) as scans:
            board.sleep_s(0.1)
            before = board.report()
            end_s = board.now_s() + seconds
            while board.now_s() < end_s:
                block = next(scans)
                words.append(block.words)
                times.append(block.time_s)
                lost += block.lost
            report = board.report()
            for name in LINE_ERRORS:
                report[name] -= opened[name]
            line_bytes = (report["heard"] - before["heard"]) * 8 / (report["frames"] - before["frames"])
        board.set("pattern", 0)
    return Streamed(np.concatenate(words), np.concatenate(times), lost, line_bytes, report)
