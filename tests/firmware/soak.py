"""A long stream through a rig: what was lost, repeated, violated, and what it took."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from adis_gonio.device.sensor import Adis16354
from firmware.board_tests import SEVEN, open_serial

RATE = 819.2
MOST_RATIO = 1.15
"""Bytes on the line to bytes of scans."""


@dataclass(frozen=True)
class StreamFigures:
    """What a stream of seven registers at the full rate came to on one rig.

    Attributes
    ----------
    scans, seconds : int, float
        Scans and simulated time between the first and the last.
    lost, repeated : int
        Scans that are missing by any count, and such as hold no new data.
    frames, violations : int
        Frames at the chip's pins, and limits that they broke.
    period_us, stall_us : float
        Tightest of fast mode.
    ratio : float
        Bytes on the line to bytes of scans.
    wall_s : float
    """

    scans: int
    seconds: float
    lost: int
    repeated: int
    frames: int
    violations: int
    period_us: float
    stall_us: float
    ratio: float
    wall_s: float

    @property
    def sound(self) -> bool:
        """True where nothing is lost, repeated or broken, and the line is used well."""
        return not (self.lost or self.repeated or self.violations) and self.ratio <= MOST_RATIO


def table(rows: dict[str, StreamFigures]) -> str:
    """Markdown table of the figures of rigs by their names."""
    lines = [
        "| rig | scans | simulated s | lost | repeated | frames | violations | period µs | stall µs "
        "| bytes ratio | wall s |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, f in rows.items():
        lines.append(
            f"| {name} | {f.scans} | {f.seconds:.2f} | {f.lost} | {f.repeated} | {f.frames} "
            f"| {f.violations} | {f.period_us:.2f} | {f.stall_us:.2f} | {f.ratio:.3f} | {f.wall_s:.0f} |"
        )
    return "\n".join(lines)


def soak(rig: Any, seconds: float) -> StreamFigures:
    """Stream seven registers at the full rate.

    Raises
    ------
    AssertionError
        The chip shifted out other bits than the driver took in.
    """
    begun = time.perf_counter()
    words, times, lost, bytes_in = _run(rig, seconds)
    steps = np.diff(times) * RATE
    tightest = rig.log.tightest_us()
    figures = StreamFigures(
        scans=len(times),
        seconds=float(np.ptp(times)),
        lost=lost + int((np.rint(steps) - 1).sum()),
        repeated=int((~(words & 0x8000).astype(bool).all(axis=1)).sum()),
        frames=rig.log.frames,
        violations=len(rig.log.violations),
        period_us=tightest["fast period"],
        stall_us=tightest["fast stall"],
        ratio=bytes_in / (14 * len(times)),
        wall_s=time.perf_counter() - begun,
    )
    if not rig.log.violations:
        rig.check()
    return figures


def _run(rig: Any, seconds: float) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Words (n, 7), times (n,), lost scans and received bytes of a stream."""
    words, times, lost = [], [], 0
    with Adis16354(open_serial(rig)) as sensor:
        sensor.configure(smpl_prd=1, filter_m=0, data_ready=True)
        with sensor.stream(SEVEN) as stream:
            before = rig.port.received
            end_s = rig.now_s() + seconds
            while rig.now_s() < end_s:
                block = next(stream)
                words.append(block.words)
                times.append(block.time_s)
                lost += block.lost
            bytes_in = rig.port.received - before
    return np.concatenate(words), np.concatenate(times), lost, bytes_in
