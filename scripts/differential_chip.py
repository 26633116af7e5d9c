"""Compare the simulated chip with the line-level chip of the second rig on random frame sequences.

Both see the same frames at the same times; every bit that the facts of the part settle must agree
(tests/rig_simavr/differential.py says what is left out). Exit 1 where anything differs.

    python scripts/differential_chip.py --sequences 1000000
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from rig_simavr import build
from rig_simavr.differential import OPTIONS, Tally, run_lives

SEQUENCES = 50
"""Of a life."""
LIVES = 20
"""That a process takes at once."""
REPORT = 20_000
"""Sequences from one line of progress to the next."""


def block(library: Path, number: int) -> Tally:
    """Some lives."""
    return run_lives(library, range(number * LIVES, (number + 1) * LIVES), SEQUENCES, **OPTIONS)


def main() -> int:
    """Compare and print; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sequences", type=int, default=1_000_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first block of lives")
    parser.add_argument("--processes", type=int, default=multiprocessing.cpu_count())
    options = parser.parse_args()
    if reason := build.missing_compiler():
        print(reason)
        return 2
    total, begun = Tally(), time.perf_counter()
    blocks = range(options.first, options.first + -(-options.sequences // (LIVES * SEQUENCES)))
    with tempfile.TemporaryDirectory() as folder:
        library = build.make(Path(folder), "chip") / "libchip.so"
        with multiprocessing.Pool(options.processes) as pool:
            for tally in pool.imap(partial(block, library), blocks):
                for difference in tally.differences:
                    print(difference)
                total.add(tally)
                if total.sequences // REPORT > (total.sequences - tally.sequences) // REPORT:
                    print(
                        f"… {total.sequences} sequences, {len(total.differences)} differences", flush=True
                    )
    left_out = [name for name, taken in OPTIONS.items() if not taken]
    print(f"{total.sequences} sequences, {total.frames} frames, {total.bits} bits compared")
    print(
        f"left out: {', '.join(left_out) or 'nothing'}; lives cut short by an open order: {total.abandoned}"
    )
    print(f"{len(total.differences)} differences {dict(Counter(d.kind for d in total.differences))}")
    print(f"{time.perf_counter() - begun:.0f} s of wall time")
    return 1 if total.differences else 0


if __name__ == "__main__":
    sys.exit(main())
