"""Stream seven registers at 819.2 SPS through the real firmware's binaries, and print one table.

Three rigs: `yasimavr` (the ATmega328P's ELF with the simulated chip on its pins), `simavr` (the same ELF on
another core, with a second, independent chip at line level and a pty), `rp2040` (the Pico's UF2 in an
emulated RP2040 with a chip on its pins and a USB host). Every frame is judged from the pins, every scan
counted. Exit 1 where a scan was lost or repeated or a frame broke a limit, 2 where a rig is missing; a
minute takes minutes.

    python scripts/rig_streams.py --seconds 60
    python scripts/rig_streams.py --rig simavr --baud 490000 --latency-ms 16
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from firmware.soak import StreamFigures, soak, table


def yasimavr(options: argparse.Namespace, folder: Path) -> StreamFigures | str:
    """The ATmega's rig, or why it is missing."""
    from firmware import avr_build

    if reason := avr_build.missing():
        return reason
    from adis_gonio.sim import World
    from firmware.rig import Rig

    rig = Rig(avr_build.elf(folder), World(seed=1))
    rig.sleep_s(0.02)
    return soak(rig, options.seconds)


def simavr(options: argparse.Namespace, folder: Path) -> StreamFigures | str:
    """The second rig of the ATmega, or why it is missing."""
    from rig_simavr import build
    from rig_simavr.board import Board, violations
    from rig_simavr.client import RATE_HZ, stream

    if reason := build.missing():
        return reason
    program = build.make(folder, "rig") / "rig"
    begun = time.perf_counter()
    with Board(
        program,
        build.elf(folder),
        baud=options.baud,
        latency_ms=options.latency_ms,
        cpu_ppm=options.resonator_ppm,
        seconds=options.seconds + 60,
    ) as board:
        got = stream(board, options.seconds)
    report = got.report
    steps = np.diff(got.time_s) * RATE_HZ
    return StreamFigures(
        scans=len(got.time_s),
        seconds=float(np.ptp(got.time_s)),
        lost=max(got.lost + got.skipped, int((np.rint(steps) - 1).clip(0).sum())),
        repeated=got.repeated + got.stale + got.mixed,
        frames=report["frames"],
        violations=sum(violations(report).values()),
        period_us=report["extremes_us"]["period"],
        stall_us=report["extremes_us"]["stall"],
        ratio=got.line_bytes / 14,
        wall_s=time.perf_counter() - begun,
    )


def rp2040(options: argparse.Namespace, folder: Path) -> StreamFigures | str:
    """The Pico's rig, or why it is missing."""
    from firmware import pico_build

    if reason := pico_build.missing():
        return reason
    from firmware.pico_rig import PicoRig

    rig = PicoRig(pico_build.uf2(folder))
    rig.sleep_s(0.1)
    return soak(rig, options.seconds)


RIGS: dict[str, Callable[[argparse.Namespace, Path], StreamFigures | str]] = {
    "yasimavr": yasimavr,
    "simavr": simavr,
    "rp2040": rp2040,
}


def main() -> int:
    """Stream and judge; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rig", choices=RIGS, action="append", help="one of them; by default all")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--baud", type=float, default=500_000, help="simavr: the adapter's, such as 490000")
    parser.add_argument("--latency-ms", type=float, default=1.0, help="simavr: the adapter's latency timer")
    parser.add_argument(
        "--resonator-ppm", type=float, default=0.0, help="simavr: error of the board's clock"
    )
    options = parser.parse_args()
    rows: dict[str, StreamFigures] = {}
    asked = options.rig or list(RIGS)
    for name in asked:
        with tempfile.TemporaryDirectory() as folder:
            figures = RIGS[name](options, Path(folder))
        if isinstance(figures, str):
            print(f"{name}: {figures}", file=sys.stderr)
            continue
        rows[name] = figures
        print(f"{name}: {'sound' if figures.sound else 'NOT sound'}", file=sys.stderr)
    print(table(rows))
    return 2 if len(rows) < len(asked) else int(not all(figures.sound for figures in rows.values()))


if __name__ == "__main__":
    sys.exit(main())
