"""A long stream through a rig: what was lost, repeated, violated, and what it took."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from adis_gonio.sensor import Adis16354
from firmware.board_tests import SEVEN, open_serial

RATE = 819.2
MOST_RATIO = 1.15
"""Bytes on the line to bytes of scans."""


def soak(rig: Any, seconds: float) -> bool:
    """Stream seven registers at the full rate, print the figures; False where a target is missed."""
    begun = time.perf_counter()
    words, times, lost, bytes_in = _run(rig, seconds)
    wall_s = time.perf_counter() - begun
    steps = np.diff(times) * RATE
    repeated = int((~(words & 0x8000).astype(bool).all(axis=1)).sum())
    gaps = int((np.rint(steps) - 1).sum())
    ratio = bytes_in / (14 * len(times))
    violations = rig.log.violations
    lines = [
        f"{len(times)} scans in {np.ptp(times):.3f} s",
        f"lost by the firmware's count {lost}, by time {gaps}; repeated {repeated}",
        f"distance of scans {steps.min():.4f} to {steps.max():.4f} periods",
        f"bytes on the line: {bytes_in / len(times):.3f} a scan of 14 bytes, ratio {ratio:.4f}",
        f"{rig.log.frames} frames, {len(violations)} violations, tightest in µs:",
        str({name: round(value, 3) for name, value in sorted(rig.log.tightest_us().items())}),
        f"{wall_s:.1f} s of wall time",
        *violations[:5],
    ]
    print("\n".join(lines))  # noqa: T201
    try:
        rig.check()
    except AssertionError:
        return False
    return not (lost or gaps or repeated) and ratio <= MOST_RATIO


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
