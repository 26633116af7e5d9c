"""Random bytes into both parsers of the wire protocol: the C core under sanitizers, the Python receiver.

Ten million bytes each unless told otherwise. Exit 1 where something crashed, or the core sent a frame
with the write bit or with bit 14 that nobody asked for.

    python scripts/fuzz_wire.py --bytes 10000000 --seed 1
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from adis_gonio.bus.wire import Receiver

HOST = Path(__file__).parents[1] / "firmware_proto" / "host"
CHUNK = 4096


def fuzz_core(count: int, seed: int) -> bool:
    """The C core: random bytes, sound packets of random content, damaged requests."""
    with tempfile.TemporaryDirectory() as folder:
        program = f"{folder}/fuzz"
        subprocess.run(["make", "-s", "-C", HOST, f"BUILD={folder}", program], check=True)
        done = subprocess.run([program, str(count), str(seed)], check=False)
    return done.returncode == 0


def fuzz_receiver(count: int, seed: int) -> bool:
    """The Python receiver: random bytes with many delimiters."""
    dice = random.Random(seed)
    receiver, begin = Receiver(), time.perf_counter()
    for _ in range(-(-count // CHUNK)):
        receiver.feed(dice.randbytes(CHUNK // 2) + dice.randbytes(CHUNK // 2).replace(b"\x01", b"\0"))
    print(f"Python: {count} bytes in {time.perf_counter() - begin:.1f} s, {receiver.counts}")
    return receiver.counts.bad > 0


def main() -> int:
    """Run both; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--bytes", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    sound = [fuzz_core(options.bytes, options.seed), fuzz_receiver(options.bytes, options.seed)]
    return 0 if all(sound) else 1


if __name__ == "__main__":
    sys.exit(main())
