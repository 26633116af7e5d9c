"""Stream seven registers at 819.2 SPS through the Pico's firmware for a minute of simulated time.

The UF2 runs in an emulated RP2040 with a chip on its pins and a USB host; the serial transport receives.
Every frame is judged, every scan counted. Exit 1 where a scan was lost or repeated or a frame broke a
limit. Takes one to two minutes of wall time for the minute.

    python scripts/rig_rp2040_stream.py --seconds 60
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from firmware import pico_build
from firmware.pico_rig import PicoRig
from firmware.soak import soak


def main() -> int:
    """Stream and judge; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args()
    if reason := pico_build.missing():
        print(reason)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        image = pico_build.uf2(Path(folder))
        print(pico_build.make(image.parent, "size").strip())
        rig = PicoRig(image)
        rig.sleep_s(0.1)
        return 0 if soak(rig, options.seconds) else 1


if __name__ == "__main__":
    sys.exit(main())
