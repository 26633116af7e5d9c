"""Stream seven registers at 819.2 SPS through the second rig for a minute of simulated time.

The ATmega328P's ELF runs on simavr's core with the line-level chip at its pins; pyserial and the serial
transport receive over a pty, behind an adapter with a baud error and a latency. The chip's outputs count
its updates, so lost, repeated and mixed scans show in the data themselves. Exit 1 where a scan was lost
or repeated or a frame broke a limit. The board keeps the pace of the wall clock: a minute takes a minute.

    python scripts/rig_simavr_stream.py --seconds 60 --baud 490000 --latency-ms 16
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from firmware import avr_build
from rig_simavr import build
from rig_simavr.board import Board, violations
from rig_simavr.client import RATE_HZ, stream


def main() -> int:
    """Stream and judge; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--baud", type=float, default=500_000, help="the adapter's, such as 490000")
    parser.add_argument("--latency-ms", type=float, default=1.0, help="the adapter's latency timer")
    parser.add_argument("--resonator-ppm", type=float, default=0.0, help="error of the board's clock")
    options = parser.parse_args()
    if reason := build.missing():
        print(reason)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        program = build.make(Path(folder), "rig") / "rig"
        elf = build.elf(Path(folder))
        print(avr_build.make(elf.parent, "size").strip())
        begun = time.perf_counter()
        with Board(
            program,
            elf,
            baud=options.baud,
            latency_ms=options.latency_ms,
            cpu_ppm=options.resonator_ppm,
            seconds=options.seconds + 60,
        ) as board:
            got = stream(board, options.seconds)
        wall_s = time.perf_counter() - begun
    steps = np.diff(got.time_s) * RATE_HZ
    report = got.report
    print(f"{len(got.time_s)} scans in {np.ptp(got.time_s):.3f} s")
    print(
        f"lost by the firmware's count {got.lost}, by the chip's own {got.skipped};"
        f" repeated {got.repeated}, not new {got.stale}, mixed {got.mixed}"
    )
    print(f"distance of scans {steps.min():.4f} to {steps.max():.4f} periods")
    ratio = got.line_bytes / 14
    print(f"bytes on the line: {got.line_bytes:.3f} a scan of 14 bytes, ratio {ratio:.4f}")
    print(f"{report['frames']} frames, {sum(violations(report).values())} violations, tightest in µs:")
    print(report["extremes_us"])
    print({name: report[name] for name in ("board_framing", "board_overruns", "host_framing")})
    print(f"{wall_s:.1f} s of wall time")
    return 0 if got.sound and ratio <= 1.15 else 1


if __name__ == "__main__":
    sys.exit(main())
