"""Open modelled boards 10 000 times, and count the pages that their boot loaders erase.

The boot loader (Optiboot, in several builds) samples at its own rate what the host sends at 500 kBd; ids,
nonces, delays, clock errors and phases are drawn anew for each opening. Ways of opening: a hello at once, a
run of zero delimiters and a wait before the hello, single zeros before it, and whatever the serial
transport does. Exit 1 where any but the first erases a page.

    python scripts/bootloader_openings.py --openings 10000
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from rig_simavr import build
from rig_simavr.bootloader import (
    BOARDS,
    Openings,
    hello_at_once,
    open_often,
    transport_sends,
    zeros_apart,
    zeros_first,
)

WAYS = {
    "hello at once": hello_at_once,
    "run of zeros, two seconds, hello": zeros_first,
    "single zeros, hello": zeros_apart,
    "the transport": transport_sends,
}


def main() -> int:
    """Open and count; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--openings", type=int, default=10_000)
    options = parser.parse_args()
    if reason := build.missing_compiler():
        print(reason)
        return 2
    failed = False
    with tempfile.TemporaryDirectory() as folder:
        library = build.make(Path(folder), "chip") / "libboot.so"
        print(f"{options.openings} openings of each board; latest start of the firmware after the reset")
        for way, sends in WAYS.items():
            first = ", ".join(
                f"{len(data)} bytes at {at:.2f} s" for at, data in sends(random.Random(0))[:3]
            )
            print(f"{way}: {first}, …")
            for board in BOARDS:
                seen = open_often(library, sends, board, range(options.openings))
                print(f"  {line(seen)}  {board}")
                failed |= way != "hello at once" and bool(seen.page_erases or seen.page_writes)
    return 1 if failed else 0


def line(seen: Openings) -> str:
    """Counts of a board in words."""
    return (
        f"{seen.bytes:7d} bytes, {seen.framing_errors:7d} framing errors, {seen.commands:6d} commands,"
        f" {seen.page_erases:3d} pages erased, {seen.page_writes} written,"
        f" firmware by {seen.last_start_s:.2f} s"
    )


if __name__ == "__main__":
    sys.exit(main())
