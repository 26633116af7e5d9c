"""Plant effects in measured recordings and count how many `trace` finds, and what it finds wrongly.

    python scripts/planted_effects.py [--seeds 5] [--first-seed 100]

Each seed plants every kind of examples/measured/plant_effect.py in both recordings (22 plantings).
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from tracing.planting import KINDS, RECORDINGS, Planted, planted


def outcome(job: tuple[str, str, int]) -> tuple[tuple[str, str, int], Planted | None]:
    """Plant and trace one effect."""
    return job, planted(*job)


def main() -> int:
    """Print each planting and the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=100)
    asked = parser.parse_args()
    seeds = range(asked.first_seed, asked.first_seed + asked.seeds)
    jobs = [(name, kind, seed) for seed in seeds for name in RECORDINGS for kind in KINDS]
    count, found, false = 0, 0, 0
    with ProcessPoolExecutor() as pool:
        for (name, kind, seed), one in pool.map(outcome, jobs):
            if one is None:
                print(f"{name:20} {kind:22} seed {seed}  not visible in this recording")
                continue
            count += 1
            found += one.found
            false += bool(one.false)
            before, after = (one.document["error"][k]["heldout_rms_mg"] for k in ("before", "after"))
            wrong = f"  WRONGLY FOUND: {', '.join(sorted(one.false))}" if one.false else ""
            print(
                f"{name:20} {kind:22} seed {seed}  {one.answer['times_the_limit']:5.2f} times the limit"
                f"  {'found' if one.found else 'MISSED':6}  held-out {before:.3g} → {after:.3g} mg{wrong}",
                flush=True,
            )
    print(f"found {found} of {count}; {false} with another effect called found")
    return 0


if __name__ == "__main__":
    sys.exit(main())
