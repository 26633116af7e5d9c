#!/usr/bin/env python3
"""Trace random small sessions: each ends in a result or in one line of the package's own errors.

    python scripts/small_sessions.py --sessions 1000 --seed 100

Exit status 1 if a trace ends in another exception or in an error of several lines.
"""

from __future__ import annotations

import argparse
import sys
import traceback
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from tracing.odd_sessions import ending


def main() -> int:
    """Run and print; 1 if a session ends badly."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sessions", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="the first session")
    options = parser.parse_args()
    results, errors, bad = 0, 0, []
    for seed in range(options.seed, options.seed + options.sessions):
        try:
            text = ending(seed)
        except Exception:  # any failure is counted, the next session runs
            bad.append(seed)
            traceback.print_exc()
            continue
        results, errors = results + (not text), errors + bool(text)
        if "\n" in text:
            bad.append(seed)
    print(f"{results} results, {errors} errors of the package, bad: {bad or 'none'}")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
