"""Stream seven registers at 819.2 SPS through the real firmware binary for a minute of simulated time.

The ATmega328P's ELF runs in yasimavr with the simulated chip on its pins; the serial transport receives.
Every frame is judged from its edges, every scan counted. Exit 1 where a scan was lost or repeated or a
frame broke a limit. Takes one to two minutes of wall time for the minute.

    python scripts/rig_stream.py --seconds 60
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.bus.serial import SerialBus
from adis_gonio.sensor import Adis16354
from adis_gonio.sim import World
from firmware import avr_build
from firmware.rig import Rig

RATE = 819.2
SEVEN = ("XGYRO_OUT", "YGYRO_OUT", "ZGYRO_OUT", "XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "SUPPLY_OUT")


def main() -> int:
    """Stream and judge; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args()
    if reason := avr_build.missing():
        print(reason)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        elf = avr_build.elf(Path(folder))
        print(avr_build.make(elf.parent, "size").strip())
        rig = Rig(elf, World(seed=1))
        rig.sleep_s(0.02)
        begun = time.perf_counter()
        words, times, lost, bytes_in = run(rig, options.seconds)
        wall_s = time.perf_counter() - begun
    steps = np.diff(times) * RATE
    repeated = int((~(words & 0x8000).astype(bool).all(axis=1)).sum())
    gaps = int((np.rint(steps) - 1).sum())
    print(f"{len(times)} scans in {np.ptp(times):.3f} s")
    print(f"lost by the firmware's count {lost}, by time {gaps}; repeated {repeated}")
    print(f"distance of scans {steps.min():.4f} to {steps.max():.4f} periods")
    ratio = bytes_in / (14 * len(times))
    print(f"bytes on the line: {bytes_in / len(times):.3f} a scan of 14 bytes, ratio {ratio:.4f}")
    print(f"{rig.log.frames} frames, {len(rig.log.violations)} violations, tightest in µs:")
    print({name: round(value / 16, 3) for name, value in sorted(rig.log.least.items())})
    print(f"{wall_s:.1f} s of wall time")
    sound = not (lost or gaps or repeated or rig.log.violations or rig.mismatches)
    return 0 if sound and ratio <= 1.15 else 1


def run(rig: Rig, seconds: float) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Words (n, 7), times (n,), lost scans and received bytes of a stream."""
    words, times, lost = [], [], 0
    with Adis16354(SerialBus(rig.port, url="serial:rig", clock=rig)) as sensor:
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


if __name__ == "__main__":
    sys.exit(main())
