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
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.sim import World
from firmware import avr_build
from firmware.rig import Rig
from firmware.soak import soak


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
        return 0 if soak(rig, options.seconds) else 1


if __name__ == "__main__":
    sys.exit(main())
