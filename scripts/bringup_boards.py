"""The bring-up on simulated boards: each fault named by the right step, no sound board accused.

    python scripts/bringup_boards.py [--seeds 100] [--faulty-seeds 20] [--jobs 2]

Sound boards differ by seed in the part (bias, gain, noise), in attitude, in what the flash holds and in
what the bridge offers. Faulty boards are those of tests/fakes/boards.py. Ends with status 1 where a fault
is not named by its step and by no other, or a sound board is accused.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.bench.bringup import Bringup, Permission, Verdict, bring_up
from fakes.boards import FAULTY, sound

ALL = Permission(writes=True, flash=True)


def one(job: tuple[str, int]) -> tuple[str, int, tuple[str, ...], str, bool, int]:
    """One board: its name, seed, accused steps, the sentence of the first, all undone, steps done."""
    name, seed = job
    board = FAULTY[name][0] if name else sound(seed)
    found: Bringup = bring_up(board.open(seed), permission=ALL)
    said = found.row(found.accused[0]).text if found.accused else ""
    done = sum(row.verdict is not Verdict.NOT_MEASURED for row in found.rows)
    return name, seed, found.accused, said, found.undone_ok, done


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--faulty-seeds", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    jobs = [("", seed) for seed in range(given.seeds)]
    jobs += [(name, seed) for name in FAULTY for seed in range(given.faulty_seeds)]
    with ProcessPoolExecutor(given.jobs) as pool:
        results = list(pool.map(one, jobs, chunksize=4))
    print(f"{'board':36}{'step':16}{'named':>8}{'others':>8}  what it says (seed 0)")
    good = True
    for name, (_, step, word) in FAULTY.items():
        mine = [result for result in results if result[0] == name]
        named = sum(accused == (step,) and word in said for _, _, accused, said, _, _ in mine)
        others = sum(any(other != step for other in accused) for _, _, accused, _, _, _ in mine)
        good &= named == len(mine) and not others
        print(f"{name:36}{step:16}{f'{named}/{len(mine)}':>8}{others:>8}  {mine[0][3]}")
    sounds = [result for result in results if not result[0]]
    accused = [result for result in sounds if result[2]]
    undone = all(result[4] for result in results)
    steps = sum(result[5] for result in sounds)
    for _, seed, steps_accused, said, _, _ in accused:
        print(f"sound board {seed} accused: {', '.join(steps_accused)}: {said}")
    print(f"sound boards accused: {len(accused)} of {len(sounds)} ({steps} steps done on them)")
    print(f"every register as it was found: {'yes' if undone else 'NO'}")
    return 0 if good and undone and not accused else 1


if __name__ == "__main__":
    sys.exit(main())
